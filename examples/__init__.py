"""Moves that the library does not hold, each a program that shows that it is exact."""
