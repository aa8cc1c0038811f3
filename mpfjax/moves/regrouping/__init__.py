"""Moves that rewrite component indicators and leave the distribution as it is."""
