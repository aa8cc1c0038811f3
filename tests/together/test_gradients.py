"""Derivatives of log Ẑ are the same in every mode, finite, and change no values.

That they are the score, the matrix asks.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, Propagate, Resample, with_score_gradient
from tests.marking import weekly
from tests.user_models import BLINDED, ScalarLinear, Window

NUM_PARTICLES = 48
MODEL = ScalarLinear()
ONE = jnp.array([[1.5], [1.0], [0.4], [0.9]])


@pytest.mark.exactness
def test_gradients_are_finite_where_weights_and_components_vanish():
    """In float32, with empty slots, dead components, and a step of zero likelihood throughout."""
    observations = jnp.array([1.5, 1.0, BLINDED, 0.4, 0.9])

    def log_evidence(model):
        resample = Resample(ess_threshold=0.7, particles_per_component=4, gradient="stop")
        moves = [resample, Propagate(gradient="stop"),
                 mpfjax.Merge(2.0, max_distance=1.0, patience=2)]  # fmt: skip
        filter = Filter(model, moves, 24, 6, initial_moves=[mpfjax.RandomPartition()])
        run = mpfjax.run_filter(jax.random.key(6), filter, observations)
        seen = jnp.isfinite(run.log_likelihood_increments)
        return jnp.sum(jnp.where(seen, run.log_likelihood_increments, 0.0)), run

    score = eqx.filter_jit(eqx.filter_grad(log_evidence, has_aux=True))
    grads, run = score(Window(0.3, 0.5))
    assert run.degenerate.tolist() == [False, False, True, False, False]
    assert (np.asarray(run.collected.log_weights)[-1] == -np.inf).any()
    assert not np.asarray(run.final.active).all()
    for leaf in (grads.sigma_x, grads.sigma_y):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf)
        assert leaf != 0


def mixture_of(model, m):
    return with_score_gradient(mpfjax.mixture_particle_filter(model, NUM_PARTICLES, m))


def gaussian_mixture_of(model, m):
    return mpfjax.gaussian_mixture_particle_filter(model, NUM_PARTICLES, m)


# On either side of the number of components up to which sums are unrolled. What is an index, a
# label or a shift is a constant in every order of differentiating.
@pytest.mark.exactness
@pytest.mark.parametrize(
    ("make", "m"), [(mixture_of, 3), *weekly([(mixture_of, 6), (gaussian_mixture_of, 6)])]
)
def test_first_and_second_derivatives_are_the_same_in_both_modes(make, m):
    def log_evidence(sigma):
        filter = make(mpfjax.QuadraticModel(sigma, 0.5, -2.0, 2.0), m)
        run = mpfjax.run_filter(jax.random.key(0), filter, ONE[:2, 0] ** 2, lambda mixture: None)
        return run.log_marginal_likelihood

    @jax.jit
    def derivatives(sigma):
        """First and second, forward over reverse and forward over forward."""
        modes = jax.grad(log_evidence), jax.jacfwd(log_evidence)
        return [jax.jvp(first, (sigma,), (jnp.ones_like(sigma),)) for first in modes]

    for reverse, forward in zip(*derivatives(jnp.asarray(0.3)), strict=True):
        assert np.isfinite(reverse)
        assert float(reverse) == pytest.approx(float(forward), rel=1e-3)
