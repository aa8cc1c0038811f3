"""Our trackers beside those that people use, on the same detections."""
