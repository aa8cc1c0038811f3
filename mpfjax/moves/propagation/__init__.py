"""Moves that take particles from t-1 to t."""
