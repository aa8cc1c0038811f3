"""Resampling around a reference: the law of ordinary resampling, given one of its offspring."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import ParticleMixture, Resample
from mpfjax.moves.conditional import REFERENCE, ConditionalResample
from tests.marking import quick_of

NUM_RUNS = 20_000
# Two components, in turn, with an empty slot: the first is uneven, the second nearly even.
WEIGHTS = np.array([0.3, 0.1, 0.02, 0.14, 0.0, 0.11, 0.2, 0.13])
LABELS = np.array([0, 1, 0, 1, 0, 1, 0, 1])
SCHEMES = {
    "systematic": Resample(),
    "systematic, sorted": Resample(sort_by=lambda x: -x),
    "systematic, fixed number": Resample(particles_per_component=3),
    "stratified": Resample("stratified"),
    "multinomial": Resample("multinomial"),
    "multinomial, adaptive": Resample("multinomial", ess_threshold=0.8),
    "systematic, adaptive": Resample(ess_threshold=0.8),
}
# One of each way to place the offspring, to share the slots, and to choose who is due.
QUICK_SCHEMES = (
    "systematic",
    "systematic, fixed number",
    "multinomial",
    "systematic, adaptive",
)


def mixture_around(slot):
    weights = jnp.asarray(WEIGHTS, jnp.float32)
    return ParticleMixture(
        particles=jnp.arange(8.0),
        log_weights=jnp.log(weights),
        component_indicators=jnp.asarray(LABELS, jnp.int32),
        ancestor_indices=jnp.arange(8, dtype=jnp.int32),
        num_components=2,
        memory={REFERENCE: {"slot": slot, "time": jnp.zeros((), jnp.int32)}},
    )


@pytest.fixture(scope="module", params=quick_of(SCHEMES, QUICK_SCHEMES))
def drawn(request):
    """Offspring of ordinary resampling, and around references drawn by their weights."""
    move = SCHEMES[request.param]

    @jax.jit
    @jax.vmap
    def one(key):
        key_reference, key_plain, key_around = jax.random.split(key, 3)
        slot = jax.random.categorical(key_reference, jnp.log(jnp.asarray(WEIGHTS, jnp.float32)))
        mixture = mixture_around(slot.astype(jnp.int32))
        around = ConditionalResample(move)(key_around, mixture)
        return slot, move(key_plain, mixture), around

    found = one(jax.random.split(jax.random.key(5), NUM_RUNS))
    return request.param, jax.tree.map(np.asarray, found)


def counts_of(mixture):
    """How many offspring each particle has."""
    filled = mixture.log_weights > -np.inf
    return ((mixture.ancestor_indices[:, :, None] == np.arange(8)) & filled[:, :, None]).sum(1)


def moments(counts):
    """Of the numbers of offspring, and of their products, which tell the schemes apart."""
    products = counts[:, :, None] * counts[:, None, :]
    return np.concatenate([counts, products.reshape(len(counts), -1)], axis=1).astype(float)


def test_references_by_weight_give_the_ordinary_law(drawn):
    """If the reference is any particle by its weight, nothing tells that one was kept."""
    _, (_, plain, around) = drawn
    difference = moments(counts_of(around)) - moments(counts_of(plain))
    error = difference.std(axis=0) / np.sqrt(NUM_RUNS)
    assert (np.abs(difference.mean(axis=0)) <= 4 * error + 1e-12).all()


@pytest.mark.parametrize(
    "drawn",
    quick_of([name for name in SCHEMES if name.startswith("systematic")], QUICK_SCHEMES),
    indirect=True,
)
def test_systematic_offspring_are_the_expected_number_rounded(drawn):
    """Which a shift that had nothing to do with the reference would not give."""
    _, (_, plain, around) = drawn
    for counts in (counts_of(plain), counts_of(around)):
        assert (np.ptp(counts, axis=0) <= 1).all()


def test_the_reference_has_an_offspring_in_its_slot(drawn):
    _, (slot, _, around) = drawn
    new = around.memory[REFERENCE]["slot"]
    rows = np.arange(NUM_RUNS)
    np.testing.assert_array_equal(around.ancestor_indices[rows, new], slot)
    np.testing.assert_array_equal(around.component_indicators[rows, new], LABELS[slot])
    assert np.isfinite(around.log_weights[rows, new]).all()


def test_every_slot_of_the_component_is_as_likely(drawn):
    """Where it is resampled."""
    name, (slot, plain, around) = drawn
    new, first = around.memory[REFERENCE]["slot"], LABELS[slot] == 0
    filled = plain.log_weights[0] > -np.inf
    number = ((plain.component_indicators[0] == 0) & filled).sum()
    shares = np.bincount(new[first], minlength=8)[:number] / first.sum()
    error = np.sqrt((1 - 1 / number) / number / first.sum())
    assert (np.abs(shares - 1 / number) < 4 * error).all(), name


def test_masses_and_weights_are_those_of_ordinary_resampling(drawn):
    _, (_, plain, around) = drawn
    np.testing.assert_allclose(around.log_weights.max(1), plain.log_weights.max(1), rtol=1e-5)
    for m in (0, 1):
        masses = [
            (np.exp(found.log_weights) * (found.component_indicators == m)).sum(1)
            for found in (plain, around)
        ]
        np.testing.assert_allclose(masses[1], masses[0], rtol=1e-5)
