"""Tracking by detection: a Kalman filter for each object."""
