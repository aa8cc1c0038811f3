"""Reading and writing of frames, boxes, ground truth and pictures."""
