"""Moves on the joint state of several objects."""
