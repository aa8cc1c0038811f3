"""Moves that change component indicators and leave the distribution unchanged."""
