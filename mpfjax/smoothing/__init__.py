"""Smoothing given all observations, and forecasts given the observations so far."""

from mpfjax.lookahead.learned import learn_lookahead as learn_lookahead
from mpfjax.smoothing.conditional import conditional_filter as conditional_filter
from mpfjax.smoothing.sums import FixedLagSmoother as FixedLagSmoother
from mpfjax.smoothing.sums import smoothed_sums as smoothed_sums
from mpfjax.smoothing.trajectories import sample_trajectories as sample_trajectories
from mpfjax.smoothing.trajectories import trace_ancestors as trace_ancestors
from mpfjax.smoothing.variance import (
    log_marginal_likelihood_variance as log_marginal_likelihood_variance,
)
from mpfjax.smoothing.variance import mixture_weight_errors as mixture_weight_errors
