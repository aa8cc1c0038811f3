"""Resampling around a reference: the law of ordinary resampling, given one of its offspring."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import Resample
from mpfjax.moves.conditional import REFERENCE, ReferenceSlot
from tests.examples import AT_START, make_mixture
from tests.marking import quick_of
from tests.unbiased import assert_unbiased

NUM_RUNS = 10_000
WEIGHTS = np.array([0.3, 0.1, 0.02, 0.14, 0.0, 0.11, 0.2, 0.13])
# Of two components, in turn, with an empty slot, the first is uneven and the second nearly even.
LABELS = {1: np.zeros(8, int), 2: np.array([0, 1, 0, 1, 0, 1, 0, 1]), 8: np.arange(8)[::-1]}
CASES = {
    "M = 1": (Resample(), 1),
    "M = 2": (Resample(), 2),
    "M = 8": (Resample(), 8),
    "sorted, M = 1": (Resample(along_curve=True), 1),
    "fixed number, M = 2": (Resample(particles_per_component=3), 2),
    "adaptive, M = 2": (Resample(ess_threshold=0.8), 2),
}
QUICK = ["M = 2", "adaptive, M = 2"]
over_cases = pytest.mark.parametrize("case", quick_of(CASES, QUICK, one_in=3))


@cache
def drawn(case):
    """References drawn by weight; the offspring of multinomial resampling, and around them."""
    move, m = CASES[case]
    move = move.around(None)

    @jax.jit
    @jax.vmap
    def one(key):
        key_reference, key_plain, key_around = jax.random.split(key, 3)
        weights = jnp.asarray(WEIGHTS, jnp.float32)
        slot = jax.random.categorical(key_reference, jnp.log(weights)).astype(jnp.int32)
        mixture = make_mixture(np.arange(8.0), np.log(WEIGHTS), LABELS[m], m)
        memory = {REFERENCE: ReferenceSlot(slot)}
        around = move(key_around, mixture.replace(memory=memory), AT_START)
        return slot, move(key_plain, mixture, AT_START), around

    return jax.tree.map(np.asarray, one(jax.random.split(jax.random.key(5), NUM_RUNS)))


def counts_of(mixture):
    """How many offspring each particle has."""
    filled = mixture.log_weights > -np.inf
    return ((mixture.ancestor_indices[:, :, None] == np.arange(8)) & filled[:, :, None]).sum(1)


def moments(counts):
    """Of the numbers of offspring, and of their products, which tell the schemes apart."""
    products = counts[:, :, None] * counts[:, None, :]
    return np.concatenate([counts, products.reshape(len(counts), -1)], axis=1).astype(float)


@pytest.mark.exactness
@over_cases
def test_references_by_weight_give_the_ordinary_law(case):
    """If the reference is any particle by its weight, nothing tells that one was kept."""
    _, plain, around = drawn(case)
    assert_unbiased(moments(counts_of(around)) - moments(counts_of(plain)), 0.0, slack=1e-12)
    np.testing.assert_allclose(around.log_weights.max(1), plain.log_weights.max(1), rtol=1e-5)


@over_cases
def test_the_reference_has_an_offspring_in_any_slot_of_its_component(case):
    slots, _, around = drawn(case)
    new, rows = around.memory[REFERENCE].slot, np.arange(NUM_RUNS)
    labels = LABELS[CASES[case][1]]
    np.testing.assert_array_equal(around.ancestor_indices[rows, new], slots)
    np.testing.assert_array_equal(around.component_indicators[rows, new], labels[slots])
    assert np.isfinite(around.log_weights[rows, new]).all()
