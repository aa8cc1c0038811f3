"""Boxes drawn in the first frame: models, moves and recipes to follow them by colour."""
