"""What is derived from a mixture, against its definition by numpy."""

import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.mixture import flatten_states, single_component
from tests.examples import example_mixtures, log_masses

MIXTURES = example_mixtures()
over_mixtures = pytest.mark.parametrize("mixture", MIXTURES.values(), ids=MIXTURES)


def members(mixture):
    """The filled slots of each component."""
    labels, filled = np.asarray(mixture.component_indicators), np.asarray(mixture.occupied)
    return [np.flatnonzero((labels == m) & filled) for m in range(mixture.num_components)]


@over_mixtures
def test_mixture_weights_are_the_masses_and_sum_to_one(mixture):
    np.testing.assert_allclose(
        mixture.log_mixture_weights, log_masses(mixture), rtol=1e-5, atol=1e-6
    )
    assert float(mixture.mixture_weights.sum()) == pytest.approx(1, rel=1e-5)
    assert float(mixture.log_mass) == pytest.approx(0, abs=1e-5)


@over_mixtures
def test_counts_and_living_components(mixture):
    counts = [len(slots) for slots in members(mixture)]
    np.testing.assert_array_equal(mixture.component_counts, counts)
    np.testing.assert_array_equal(mixture.active, np.array(counts) > 0)


@over_mixtures
def test_weights_within_components_sum_to_one_in_each_living_one(mixture):
    weights = np.exp(np.asarray(mixture.log_component_weights))
    for slots in members(mixture):
        if slots.size:
            assert weights[slots].sum() == pytest.approx(1, rel=1e-4)
    assert (weights[~np.asarray(mixture.occupied)] == 0).all()


@over_mixtures
def test_effective_sample_sizes(mixture):
    weights = np.exp(np.asarray(mixture.log_component_weights, float))
    sizes = np.asarray(mixture.component_effective_sample_sizes)
    for size, slots in zip(sizes, members(mixture), strict=True):
        expected = 1 / (weights[slots] ** 2).sum() if slots.size else 0.0
        assert size == pytest.approx(expected, rel=1e-4)
    total = np.exp(np.asarray(mixture.log_weights, float))
    expected = total.sum() ** 2 / (total**2).sum()
    assert float(mixture.effective_sample_size) == pytest.approx(expected, rel=1e-4)


@over_mixtures
def test_means_and_covariances_of_components(mixture):
    states = np.asarray(mixture.particles, float)
    weights = np.exp(np.asarray(mixture.log_component_weights, float))
    means, covariances = mixture.component_means(), mixture.component_covariances()
    for m, slots in enumerate(members(mixture)):
        w = weights[slots]
        mean = w @ states[slots] if slots.size else np.zeros(2)
        centred = states[slots] - mean
        covariance = (w[:, None] * centred).T @ centred
        np.testing.assert_allclose(means[m], mean, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(covariances[m], covariance, rtol=1e-3, atol=1e-4)


@over_mixtures
def test_the_mean_is_over_filled_slots(mixture):
    filled = np.asarray(mixture.occupied)
    weights = np.exp(np.asarray(mixture.log_weights, float))[filled]
    expected = weights @ np.asarray(mixture.particles, float)[filled]
    np.testing.assert_allclose(mixture.mean(), expected, rtol=1e-4, atol=1e-5)


def test_a_single_component_has_equal_weights_and_is_its_own_ancestor():
    mixture = single_component({"x": jnp.arange(6.0)}, 3)
    np.testing.assert_allclose(mixture.weights, 1 / 6, rtol=1e-6)
    np.testing.assert_array_equal(mixture.component_counts, [6, 0, 0])
    np.testing.assert_array_equal(mixture.ancestor_indices, np.arange(6))
    assert float(mixture.mean()["x"]) == pytest.approx(2.5)
    assert mixture.num_particles == 6


def test_flattening_puts_all_leaves_side_by_side():
    leaves = {"a": jnp.arange(3), "b": jnp.ones((3, 2, 2)), "c": jnp.zeros((3, 1))}
    flat = flatten_states(leaves)
    assert flat.shape == (3, 6)
    np.testing.assert_array_equal(flat[:, 0], [0.0, 1.0, 2.0])


def test_replace_changes_what_it_names_and_nothing_else():
    mixture = MIXTURES["ordinary"]
    changed = mixture.replace(component_indicators=jnp.zeros(40, jnp.int32))
    np.testing.assert_array_equal(changed.component_indicators, 0)
    assert changed.particles is mixture.particles
    assert changed.num_components == mixture.num_components
