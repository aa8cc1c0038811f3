"""Boxes drawn in the first frame: models, moves and presets to follow them by colour."""
