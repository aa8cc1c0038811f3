"""Estimation of a filter's parameters by gradients, and their posterior."""

from mpfjax.tuning.bijections import Interval as Interval
from mpfjax.tuning.bijections import Positive as Positive
from mpfjax.tuning.bijections import Simplex as Simplex
from mpfjax.tuning.comparison import compare_evidence as compare_evidence
from mpfjax.tuning.curvature import standard_errors as standard_errors
from mpfjax.tuning.densities import log_density as log_density
from mpfjax.tuning.mcmc import metropolis_hastings as metropolis_hastings
from mpfjax.tuning.mcmc import particle_gibbs as particle_gibbs
from mpfjax.tuning.optimisation import fit as fit
from mpfjax.tuning.optimisation import maximise as maximise
from mpfjax.tuning.sequential import smc2 as smc2
from mpfjax.tuning.trajectories import posterior_predictive as posterior_predictive
from mpfjax.tuning.trajectories import posterior_trajectories as posterior_trajectories
