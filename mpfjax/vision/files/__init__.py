"""Frames, boxes, truth and pictures: what is read and written."""
