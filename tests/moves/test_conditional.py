"""Resampling around a reference: the law of ordinary resampling, given one of its offspring."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import ParticleMixture, Resample
from mpfjax.moves.conditional import REFERENCE
from tests.marking import quick_of

NUM_RUNS = 20_000
WEIGHTS = np.array([0.3, 0.1, 0.02, 0.14, 0.0, 0.11, 0.2, 0.13])
# Of two components, in turn, with an empty slot, the first is uneven and the second nearly even.
LABELS = {1: np.zeros(8, int), 2: np.array([0, 1, 0, 1, 0, 1, 0, 1]), 8: np.arange(8)[::-1]}
MOVES = {
    "systematic": Resample(),
    "systematic, sorted": Resample(sort_by=lambda x: -x),
    "systematic, fixed number": Resample(particles_per_component=3),
    "stratified": Resample("stratified"),
    "multinomial": Resample("multinomial"),
    "residual": Resample("residual"),
    "ssp": Resample("ssp"),
    "ssp, fixed number": Resample("ssp", particles_per_component=3),
    "multinomial, adaptive": Resample("multinomial", ess_threshold=0.8),
    "systematic, adaptive": Resample(ess_threshold=0.8),
    "ssp, adaptive": Resample("ssp", ess_threshold=0.8),
}
# Of one component, of two, and of one particle each.
CASES = {
    f"{name}, M = {m}": (name, m)
    for name, move in MOVES.items()
    for m in (1, 2, 8)
    if (move.particles_per_component or 1) * m <= len(WEIGHTS)
}
# One of each scheme and of each way to stand in line, to share the slots and to choose who is due.
QUICK_CASES = (
    "systematic, M = 1",
    "systematic, fixed number, M = 2",
    "stratified, M = 2",
    "multinomial, M = 1",
    "residual, M = 1",
    "ssp, M = 2",
    "systematic, adaptive, M = 2",
)


def mixture_around(slot, m):
    weights = jnp.asarray(WEIGHTS, jnp.float32)
    return ParticleMixture(
        particles=jnp.arange(8.0),
        log_weights=jnp.log(weights),
        component_indicators=jnp.asarray(LABELS[m], jnp.int32),
        ancestor_indices=jnp.arange(8, dtype=jnp.int32),
        num_components=m,
        memory={REFERENCE: {"slot": slot, "time": jnp.zeros((), jnp.int32)}},
    )


class Drawn(NamedTuple):
    """Offspring of ordinary resampling, and around references drawn by their weights."""

    case: tuple[str, int]
    slot: np.ndarray
    plain: ParticleMixture
    around: ParticleMixture


@pytest.fixture(scope="module", params=quick_of(CASES, QUICK_CASES))
def drawn(request):
    name, m = CASES[request.param]

    @jax.jit
    @jax.vmap
    def one(key):
        key_reference, key_plain, key_around = jax.random.split(key, 3)
        slot = jax.random.categorical(key_reference, jnp.log(jnp.asarray(WEIGHTS, jnp.float32)))
        mixture = mixture_around(slot.astype(jnp.int32), m)
        around = MOVES[name](key_around, mixture)
        return slot, MOVES[name](key_plain, mixture.replace(memory={})), around

    found = one(jax.random.split(jax.random.key(5), NUM_RUNS))
    return Drawn(CASES[request.param], *jax.tree.map(np.asarray, found))


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
    difference = moments(counts_of(drawn.around)) - moments(counts_of(drawn.plain))
    error = difference.std(axis=0) / np.sqrt(NUM_RUNS)
    assert (np.abs(difference.mean(axis=0)) <= 4 * error + 1e-12).all()


def test_of_one_reference_it_is_the_ordinary_law_weighed_by_its_offspring(drawn):
    """By brute force: ordinary draws, each counted as often as the reference has offspring."""
    ordinary, around = counts_of(drawn.plain), counts_of(drawn.around)
    for slot in np.flatnonzero(WEIGHTS):
        found = around[drawn.slot == slot]
        weights = (ordinary[:, slot] / ordinary[:, slot].mean())[:, None]
        expected = (weights * ordinary).mean(axis=0)
        residuals = weights * (ordinary - expected)
        errors = [part.std(axis=0) / np.sqrt(len(part)) for part in (found, residuals)]
        # What hardly ever happens has no standard error.
        rare = 10 / len(found)
        gap = np.abs(found.mean(axis=0) - expected)
        assert (gap <= 4.5 * np.hypot(*errors) + rare).all(), slot


def test_evenness_is_that_of_the_scheme(drawn):
    """Systematic offspring and those of SSP are the expected numbers, rounded up or down."""
    if not drawn.case[0].startswith(("systematic", "ssp")):
        return
    for counts in (counts_of(drawn.plain), counts_of(drawn.around)):
        assert (np.ptp(counts, axis=0) <= 1).all()


def test_the_reference_has_an_offspring_in_its_slot(drawn):
    around, new, rows = drawn.around, drawn.around.memory[REFERENCE]["slot"], np.arange(NUM_RUNS)
    np.testing.assert_array_equal(around.ancestor_indices[rows, new], drawn.slot)
    labels = LABELS[drawn.case[1]]
    np.testing.assert_array_equal(around.component_indicators[rows, new], labels[drawn.slot])
    assert np.isfinite(around.log_weights[rows, new]).all()


def test_every_slot_of_the_component_is_as_likely(drawn):
    """Where it is resampled."""
    new, first = drawn.around.memory[REFERENCE]["slot"], LABELS[drawn.case[1]][drawn.slot] == 0
    filled = drawn.plain.log_weights[0] > -np.inf
    own = (drawn.plain.component_indicators[0] == 0) & filled
    if not drawn.plain.log_weights[0, own].std() < 1e-6:
        return  # it is not due
    shares = np.bincount(new[first], minlength=8)[own] / first.sum()
    error = np.sqrt((1 - 1 / own.sum()) / own.sum() / first.sum())
    assert (np.abs(shares - 1 / own.sum()) <= 4 * error).all()


def test_masses_and_weights_are_those_of_ordinary_resampling(drawn):
    around, plain = drawn.around, drawn.plain
    np.testing.assert_allclose(around.log_weights.max(1), plain.log_weights.max(1), rtol=1e-5)
    for m in range(drawn.case[1]):
        masses = [
            (np.exp(found.log_weights) * (found.component_indicators == m)).sum(1)
            for found in (plain, around)
        ]
        np.testing.assert_allclose(masses[1], masses[0], rtol=1e-5)
