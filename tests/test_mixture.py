"""What is derived from a mixture, against its definition by numpy."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.mixture import single_component
from mpfjax.moves.regrouping.features import ByFeatures, OnCircles
from tests.examples import example_mixtures, log_masses

MIXTURES = example_mixtures()
over_mixtures = pytest.mark.parametrize("mixture", MIXTURES.values(), ids=MIXTURES)


def members(mixture):
    """The filled slots of each component."""
    labels, filled = np.asarray(mixture.component_indicators), np.asarray(mixture.occupied)
    return [np.flatnonzero((labels == m) & filled) for m in range(mixture.num_components)]


@over_mixtures
def test_what_is_derived_is_what_numpy_gives(mixture):
    """Masses, counts, weights and sample sizes, means and covariances, in double precision."""
    log_weights, states = np.asarray(mixture.log_weights, float), np.asarray(mixture.particles)
    filled, masses = np.asarray(mixture.occupied), log_masses(mixture)
    np.testing.assert_allclose(mixture.log_mixture_weights, masses, rtol=1e-5, atol=1e-6)
    assert float(mixture.log_mass) == pytest.approx(0, abs=1e-5)
    counts = [len(slots) for slots in members(mixture)]
    np.testing.assert_array_equal(mixture.component_counts, counts)
    np.testing.assert_array_equal(mixture.active, np.array(counts) > 0)
    total = np.exp(log_weights[filled])
    size = total.sum() ** 2 / (total**2).sum()
    assert float(mixture.effective_sample_size) == pytest.approx(size, rel=1e-4)
    np.testing.assert_allclose(mixture.mean(), total @ states[filled], rtol=1e-4, atol=1e-5)
    within = np.asarray(mixture.component_weights)
    assert (within[~filled] == 0).all()
    means, covariances = mixture.component_means(), mixture.component_covariances()
    for m, slots in enumerate(members(mixture)):
        w = np.exp(log_weights[slots] - masses[m])
        np.testing.assert_allclose(within[slots], w, rtol=1e-4, atol=1e-6)
        size = 1 / (w**2).sum() if slots.size else 0.0
        assert mixture.component_effective_sample_sizes[m] == pytest.approx(size, rel=1e-4)
        mean = w @ states[slots] if slots.size else np.full(2, np.nan)
        centred = states[slots] - mean
        np.testing.assert_allclose(means[m], mean, rtol=1e-4, atol=1e-5)
        covariance = (w[:, None] * centred).T @ centred
        np.testing.assert_allclose(covariances[m], covariance, rtol=1e-3, atol=1e-4)


@over_mixtures
def test_quantiles_are_those_of_the_weighted_distribution_function(mixture):
    """Of each coordinate, under jit, and of a stack under vmap."""
    log_weights, states = np.asarray(mixture.log_weights, float), np.asarray(mixture.particles)
    shares = jnp.array([0.0, 0.05, 0.31, 0.5, 0.95, 1.0])
    found = jax.jit(lambda mixture: mixture.quantile(mixture.particles, shares))(mixture)
    for d in range(states.shape[1]):
        order = np.argsort(states[:, d])
        order = order[np.isfinite(log_weights[order])]
        below = np.cumsum(np.exp(log_weights[order]))
        place = np.searchsorted(below, np.asarray(shares) * below[-1] * (1 - 1e-6))
        np.testing.assert_array_equal(found[:, d], states[order, d][place])
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), mixture)
    median = jax.vmap(lambda mixture: mixture.quantile(lambda states: states[:, 0], 0.5))(stack)
    np.testing.assert_array_equal(median, jnp.full(3, found[3, 0]))


@pytest.mark.exactness
def test_what_goes_round_is_averaged_on_its_circle():
    """A pose, in both forms of its state, against complex numbers."""
    periods, rng = np.array([0.0, 4.0, 2 * np.pi], np.float32), np.random.default_rng(3)
    states = rng.normal([1.0, 1.9, np.pi], 0.3, (40, 3)).astype(np.float32)
    states[:, 1:] = (states[:, 1:] + periods[1:] / 2) % periods[1:] - periods[1:] / 2
    mixture = MIXTURES["dead components"].replace(particles=jnp.asarray(states), periods=periods)
    means, covariances = mixture.component_means(), mixture.component_covariances()
    within, weights = np.asarray(mixture.component_weights), np.asarray(mixture.weights)
    for slots, mean, covariance in zip(members(mixture), means, covariances, strict=True):
        if slots.size:
            w, x = within[slots], states[slots]
            turns = np.angle(w @ np.exp(2j * np.pi * x[:, 1:] / periods[1:])) / (2 * np.pi)
            expected = np.array([w @ x[:, 0], *(turns * periods[1:])])
            np.testing.assert_allclose(mean, expected, atol=1e-4)
            gaps = x - expected
            gaps[:, 1:] -= periods[1:] * np.round(gaps[:, 1:] / periods[1:])
            np.testing.assert_allclose(covariance, (w[:, None] * gaps).T @ gaps, atol=1e-4)
    states = mixture.particles
    found = mixture.replace(
        particles={"x": states[:, :2], "heading": states[:, 2]},
        periods={"x": periods[:2], "heading": periods[2]},
    ).mean()
    turned = np.angle(weights @ np.exp(1j * np.asarray(states[:, 2])))
    assert found["heading"] == pytest.approx(turned, 1e-4)
    double = mixture.replace(periods=periods.astype(float))
    np.testing.assert_allclose(double.component_means(), means, rtol=1e-6)
    np.testing.assert_allclose(double.component_covariances(), covariances, rtol=1e-5)
    np.testing.assert_allclose(double.mean(), mixture.mean(), rtol=1e-6)
    # As features, near ones are as far apart as the numbers are.
    near = OnCircles((0.0, 4.0))(jnp.array([[0.0, 1.999], [0.3, -1.999]]))
    np.testing.assert_allclose(jnp.hypot(*(near[1] - near[0])[1:]), 0.002, rtol=0.01)
    with pytest.raises(ValueError, match="periods: 2 for a state of 3 numbers"):
        OnCircles((0.0, 4.0))(states)


def test_states_that_are_not_floats_are_averaged_as_numbers():
    """A switching model: a mode, and a flag, beside a position. An event has a probability."""
    rng = np.random.default_rng(1)
    states = {
        "position": rng.normal(size=(40, 2)).astype(np.float32),
        "mode": rng.integers(1, 4, 40).astype(np.int32),
        "seen": rng.random(40) < 0.3,
    }
    mixture, of_floats = (
        MIXTURES["dead components"].replace(particles=jax.tree.map(kind, states))
        for kind in (jnp.asarray, lambda leaf: jnp.asarray(leaf, jnp.float32))
    )
    for summary in ("mean", "component_means", "component_covariances"):
        one, other = (getattr(each, summary)() for each in (mixture, of_floats))
        chex.assert_trees_all_close(one, other, rtol=1e-5, atol=1e-6)
    weights = np.exp(np.asarray(mixture.log_weights, float))
    found = mixture.expectation(mixture.particles["mode"] == 2)
    assert float(found) == pytest.approx(weights[states["mode"] == 2].sum(), rel=1e-5)
    # Regrouping measures whole numbers in any unit.
    features = ByFeatures(features=lambda state: state["mode"], scale=0.5).features_of(mixture)
    filled = np.asarray(mixture.occupied)
    modes = 2.0 * states["mode"][filled]
    np.testing.assert_allclose(np.asarray(features)[filled, 0], modes - modes.mean(), atol=1e-5)


def test_a_variance_is_about_the_mean():
    """20 m from zero with 3 cm: E[x²] - E[x]² has no digit left, and may be negative."""
    rng = np.random.default_rng(0)
    places = np.float32(20 + 0.03 * rng.normal(size=(50, 2)))
    log_weights = np.log(rng.dirichlet(np.ones(50)))
    mixture = single_component(jnp.asarray(places)).replace(
        log_weights=jnp.asarray(log_weights, jnp.float32)
    )
    mean = np.exp(log_weights) @ places.astype(float)
    expected = np.exp(log_weights) @ (places - mean) ** 2
    np.testing.assert_allclose(mixture.variance(mixture.particles), expected, rtol=1e-4)
