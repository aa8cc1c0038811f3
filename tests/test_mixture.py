"""What is derived from a mixture, against its definition by numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.mixture import flatten_states, single_component
from mpfjax.moves.regrouping.features import ByFeatures
from tests.examples import example_mixtures, log_masses, make_mixture

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


class TestStatesThatAreNotFloats:
    """A switching model: a mode, and a flag, beside a position."""

    def mixture(self):
        rng = np.random.default_rng(1)
        states = {
            "position": rng.normal(size=(40, 2)).astype(np.float32),
            "mode": rng.integers(1, 4, 40).astype(np.int32),
            "seen": rng.random(40) < 0.3,
        }
        mixture = MIXTURES["dead components"]
        return mixture.replace(particles=jax.tree.map(jnp.asarray, states)), states

    def test_means_are_weighted_averages_of_the_values(self):
        mixture, states = self.mixture()
        weights = np.exp(np.asarray(mixture.log_weights, float))
        within = np.exp(np.asarray(mixture.log_component_weights, float))
        mean, by_component = mixture.mean(), mixture.component_means()
        for name, values in states.items():
            assert jnp.issubdtype(mean[name].dtype, jnp.floating)
            expected = np.einsum("i,i...->...", weights, values)
            np.testing.assert_allclose(mean[name], expected, rtol=1e-5, atol=1e-6)
            for m, slots in enumerate(members(mixture)):
                expected = np.einsum("i,i...->...", within[slots], values[slots])
                np.testing.assert_allclose(by_component[name][m], expected, rtol=1e-5, atol=1e-6)

    def test_the_average_of_an_event_is_its_probability(self):
        mixture, states = self.mixture()
        weights = np.exp(np.asarray(mixture.log_weights, float))
        found = mixture.average(mixture.particles["mode"] == 2)
        assert float(found) == pytest.approx(weights[states["mode"] == 2].sum(), rel=1e-5)

    def test_covariances_take_them_as_numbers(self):
        mixture, states = self.mixture()
        flat = np.column_stack([states["mode"], states["position"], states["seen"]]).astype(float)
        within = np.exp(np.asarray(mixture.log_component_weights, float))
        slots = members(mixture)[0]
        centred = flat[slots] - within[slots] @ flat[slots]
        expected = (within[slots, None] * centred).T @ centred
        np.testing.assert_allclose(mixture.component_covariances()[0], expected, atol=1e-5)

    def test_leaves_of_several_floating_point_types_stand_side_by_side(self):
        leaves = {"a": jnp.ones((4, 1), jnp.bfloat16), "b": jnp.ones(4, jnp.float32)}
        assert flatten_states(leaves).dtype == jnp.float32

    def test_regrouping_measures_whole_numbers_in_any_unit(self):
        mixture, states = self.mixture()
        features = ByFeatures(features=lambda state: state["mode"], scale=0.5).features_of(mixture)
        filled = np.asarray(mixture.occupied)
        modes = 2.0 * states["mode"][filled]
        np.testing.assert_allclose(np.asarray(features)[filled, 0], modes - modes.mean(), atol=1e-5)


STACKED = (
    "num_particles",
    "weights",
    "log_mass",
    "log_mixture_weights",
    "mixture_weights",
    "component_counts",
    "active",
    "log_component_weights",
    "component_weights",
    "component_effective_sample_sizes",
    "effective_sample_size",
)


@pytest.mark.parametrize("name", STACKED)
@pytest.mark.parametrize("num_components", [1, 6])
def test_a_stack_of_mixtures_has_no_property_of_one(name, num_components, as_installed):
    labels = np.zeros(40) if num_components == 1 else np.arange(40) % 6
    one = make_mixture(np.arange(40.0), np.zeros(40), labels, num_components)
    # As many as there are particles: shapes would fit.
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf] * 40), one)
    with pytest.raises(ValueError, match=r"mixture: a stack of 40 mixtures .* jax\.vmap"):
        getattr(stack, name)
    each = jax.vmap(lambda mixture: getattr(mixture, name))(stack) if name != STACKED[0] else None
    if each is not None:
        np.testing.assert_allclose(each[3], getattr(one, name), rtol=1e-6)


@pytest.mark.parametrize(
    "summary",
    [
        lambda mixture: mixture.mean(),
        lambda mixture: mixture.component_means(),
        lambda mixture: mixture.component_covariances(),
        lambda mixture: mixture.average(mixture.particles),
        lambda mixture: mixture.component_sums(mixture.particles),
        lambda mixture: mixture.component_averages(mixture.particles),
    ],
)
def test_a_stack_of_mixtures_has_no_summary_of_one(summary, as_installed):
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf] * 40), MIXTURES["ordinary"])
    with pytest.raises(ValueError, match="mixture: a stack of 40 mixtures"):
        summary(stack)


def test_replace_does_not_ignore_an_unknown_field():
    with pytest.raises(TypeError, match="limit"):
        single_component(jnp.zeros(5)).replace(limit=jnp.array(3, jnp.int32))
