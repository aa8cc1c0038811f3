"""Rendered scenes with true boxes."""
