"""What samplers are tried on: a linear model with known inputs, and a missing observation."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.stats import norm

import mpfjax
from mpfjax import Filter, KMeans, Merge, Propagate, Resample, Split
from tests.matrix.law import Law
from tests.user_models import ScalarLinear

# The coefficient a of a linear model, with known inputs and a missing observation.
OBSERVATIONS = jnp.array([1.5, 0.2, jnp.nan, 0.8, 1.9, 1.1, 0.3, -0.9])
INPUTS = jnp.array([0.6, -0.7, 0.2, 0.9, -0.3, 0.5, -0.8, 0.1])
SERIES = mpfjax.Series.skipping(OBSERVATIONS, INPUTS)
PRIOR = 0.3, 0.5
"""The mean and the deviation of a."""
LAW = Law(b=1.0)
"""That of `Pushed`, for exact answers."""
A = {"a": lambda filter: filter.model.a}


class Pushed(ScalarLinear):
    """x_t = a x_{t-1} + u_t + N(0, q²)."""

    inputs: Any = None

    def transition_mean(self, states):
        return self.a * states + self.inputs

    def transition_from_noise(self, noise, states):
        return self.transition_mean(states) + self.q * noise[:, 0]

    def log_transition(self, states, previous_states):
        return norm.logpdf(states, self.transition_mean(previous_states), self.q)

    def log_initial(self, states):
        return norm.logpdf(states, self.m, self.p)


def sample_a(key):
    return {"a": PRIOR[0] + PRIOR[1] * jax.random.normal(key)}


def log_prior_of_a(parameters):
    return norm.logpdf(parameters["a"], *PRIOR)


def eager_mixture(num_particles=10):
    """A filter of the quadratic model that merges, splits and regroups at every step."""
    model = mpfjax.QuadraticModel(0.4, 0.7, -2.0, 2.0)
    regrouping = [Merge(2.0), Split(1.0, min_distance=0.1, min_share=0.0), KMeans(2)]
    moves = [Resample(), Propagate(), *regrouping]
    return Filter(model, moves, num_particles, 3, initial_moves=[KMeans(2, reseed=True)])


def interrupt(monkeypatch, module, name, when):
    """Ctrl-C where a function of a module is called with arguments for which this is true."""
    real = getattr(module, name)

    def interrupted(*arguments):
        if when(*arguments):
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(module, name, interrupted)
