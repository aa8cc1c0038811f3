"""Grouping by the user's own labels; `test_contracts.py` has what all regrouping shares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, GroupBy, Propagate, QuadraticModel, Resample
from tests.examples import make_mixture

KEY = jax.random.key(0)
MODEL = QuadraticModel(0.3, 0.5, -2.0, 2.0)


def side(states):
    return (states > 0).astype(jnp.int32)


def test_labels_are_the_components():
    mixture = make_mixture(np.array([-1.0, 2.0, -3.0, 4.0]), np.zeros(4), [1, 1, 0, 0], 2)
    np.testing.assert_array_equal(GroupBy(side)(KEY, mixture).component_indicators, [0, 1, 0, 1])


@pytest.mark.parametrize("num_components", [1, 2])
@pytest.mark.parametrize("label", [-1, 2])
def test_a_label_outside_is_a_named_error_unless_its_slot_is_empty(num_components, label):
    labels = np.array([0, label, 0], np.int32)
    group = GroupBy(lambda states: jnp.asarray(labels) + 0 * states.astype(jnp.int32))
    weightless = make_mixture(np.zeros(3), [0.0, -np.inf, 0.0], [0, 0, 0], num_components)
    assert int(group(KEY, weightless).component_indicators.max()) < num_components
    weighed = make_mixture(np.zeros(3), np.zeros(3), [0, 0, 0], num_components)
    with pytest.raises(RuntimeError, match=r"GroupBy: function gave a label outside \[0, "):
        jax.block_until_ready(group(KEY, weighed))


def test_a_label_outside_is_found_within_a_run():
    moves = [Resample(), Propagate(MODEL), GroupBy(lambda states: 2 * side(states))]
    with pytest.raises(RuntimeError, match="GroupBy"):
        mpfjax.run_filter(KEY, Filter(MODEL, moves, 20, 2), jnp.ones(3))


@pytest.mark.parametrize("function", [lambda states: states, lambda states: side(states)[:2], len])
def test_other_than_whole_numbers_is_refused(function):
    mixture = make_mixture(np.zeros(3), np.zeros(3), [0, 0, 0], 2)
    with pytest.raises(ValueError, match="function: it returned"):
        GroupBy(function)(KEY, mixture)


def test_each_label_keeps_its_particles_however_improbable_it_is():
    """Observations of x² say nothing of the sign; a plain filter of 20 particles loses one."""
    moves = [Resample(), Propagate(MODEL), GroupBy(side)]
    kept = Filter(MODEL, moves, 20, 2, initial_moves=[GroupBy(side)])
    run = mpfjax.run_filter(KEY, kept, jnp.full(100, 3.0), lambda mixture: mixture.component_counts)
    assert int(run.collected.min()) == 10
