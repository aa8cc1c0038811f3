"""Colour histograms of boxes: bins, sums, references."""
