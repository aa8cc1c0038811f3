"""Exact references: grid filter, Kalman filter and smoother, and enumeration of regimes."""

from mpfjax.exact.grid import grid_filter as grid_filter
from mpfjax.exact.kalman import kalman_filter as kalman_filter
from mpfjax.exact.kalman import kalman_smoother as kalman_smoother
from mpfjax.exact.switching import switching_filter as switching_filter
