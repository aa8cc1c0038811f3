"""Exact references: a grid filter for scalar models, Kalman's filter and smoother for linear ones,
and all sequences of regimes for switching ones.
"""

from mpfjax.exact.grid import grid_filter as grid_filter
from mpfjax.exact.kalman import kalman_filter as kalman_filter
from mpfjax.exact.kalman import kalman_smoother as kalman_smoother
from mpfjax.exact.switching import switching_filter as switching_filter
