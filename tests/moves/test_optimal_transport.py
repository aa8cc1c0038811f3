"""Transport in place of resampling, against Sinkhorn's iteration in numpy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import Resample
from tests.examples import example_mixtures, log_masses, make_mixture

MIXTURES = example_mixtures()
MOVE = Resample(gradient="ot", regularisation=0.3)
KEY = jax.random.key(0)


def by_hand(states, weights, points, regularisation):
    """Barycentres of the plan from weights to equal ones, by ten thousand iterations."""
    spread = states.shape[1] * states.var(axis=0).max()
    squares = ((points[:, None] - states[None]) ** 2).sum(axis=2) / spread
    kernel = np.exp(-squares / regularisation)
    u, v = np.ones(len(points)), np.ones(len(states))
    for _ in range(10_000):
        u = 1 / len(points) / (kernel @ v)
        v = weights / (kernel.T @ u)
    plan = u[:, None] * kernel * v[None]
    return plan @ states / plan.sum(axis=1, keepdims=True)


def test_particles_move_to_the_barycentres_of_the_plan():
    rng = np.random.default_rng(0)
    states, log_weights = rng.normal(size=(12, 2)), rng.normal(size=12)
    labels = np.repeat([0, 1], [5, 7])
    mixture = make_mixture(states, log_weights, labels, 2)
    moved = jax.jit(MOVE)(KEY, mixture)
    for m, size in enumerate((6, 6)):  # the slots are dealt equally
        ours = labels == m
        weights = np.exp(log_weights[ours]) / np.exp(log_weights[ours]).sum()
        points = states[ours][np.arange(size) * ours.sum() // size]
        expected = by_hand(states[ours], weights, points, 0.3)
        found = np.asarray(moved.particles)[np.asarray(moved.component_indicators) == m]
        np.testing.assert_allclose(found, expected, atol=0.01)


@pytest.mark.parametrize("example", MIXTURES)
def test_components_keep_their_mass_and_mean(example):
    before = MIXTURES[example]
    after = jax.jit(MOVE)(KEY, before)
    np.testing.assert_allclose(log_masses(after), log_masses(before), rtol=1e-6, atol=2e-5)
    filled = np.asarray(after.occupied)
    assert filled.all()
    assert np.isfinite(np.asarray(after.particles)[filled]).all()
    spread = np.sqrt(np.diagonal(before.component_covariances(), axis1=1, axis2=2)).max()
    np.testing.assert_allclose(
        after.component_means(), before.component_means(), atol=0.02 * spread + 1e-4
    )
    parents = np.asarray(before.component_indicators)[after.ancestor_indices]
    np.testing.assert_array_equal(parents, after.component_indicators)


def test_its_derivative_is_that_of_its_values():
    mixture = MIXTURES["one component"]

    def moment(log_weights):
        moved = MOVE(KEY, mixture.replace(log_weights=log_weights))
        return jnp.sum(moved.particles**2 * jnp.arange(80.0).reshape(40, 2))

    direction = np.cos(np.arange(40.0)).astype(np.float32)
    # The transport solver's own derivative is written for the default promotion.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        both = jax.jit(jax.value_and_grad(moment))
        gradient = np.asarray(both(mixture.log_weights)[1])
        steps = [mixture.log_weights + sign * 0.01 * direction for sign in (1, -1)]
        ends = [float(both(step)[0]) for step in steps]
    assert gradient @ direction == pytest.approx((ends[0] - ends[1]) / 0.02, rel=0.05)


def test_what_is_not_due_stays_and_whole_numbers_come_along():
    mixture = MIXTURES["ordinary"]
    kept = jax.jit(Resample(ess_threshold=0.0, gradient="ot"))(KEY, mixture)
    order = np.asarray(kept.ancestor_indices)
    np.testing.assert_array_equal(kept.particles, np.asarray(mixture.particles)[order])
    numbered = {"x": mixture.particles, "number": jnp.arange(40, dtype=jnp.int32)}
    moved = jax.jit(MOVE)(KEY, mixture.replace(particles=numbered))
    np.testing.assert_array_equal(moved.particles["number"], moved.ancestor_indices)


def test_states_without_floating_point_cannot_be_moved():
    mixture = MIXTURES["ordinary"].replace(particles=jnp.arange(40, dtype=jnp.int32))
    with pytest.raises(ValueError, match="gradient: 'ot' moves particles"):
        eqx.filter_jit(MOVE)(KEY, mixture)
