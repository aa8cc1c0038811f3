"""Resampling at its edges and its slots; what every scheme keeps is in `test_contracts.py`."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import Resample
from mpfjax.moves.resampling.allocation import EQUAL_PARTS, FEWEST
from mpfjax.moves.resampling.ancestors import SCHEMES
from mpfjax.operations import prefix_sums
from tests.examples import AT_START, make_mixture
from tests.marking import quick_of
from tests.unbiased import assert_unbiased

NEARLY_ONE = 1 - 2.0**-24
KEY = jax.random.key(0)


@eqx.filter_jit
def draw(move, mixture, key=KEY):
    return move(key, mixture, AT_START)


def large_mixture(kind, n, m, in_order):
    """Components mixed, or side by side, as after a resampling that nothing regrouped."""
    rng = np.random.default_rng(7)
    labels = rng.integers(0, m, n)
    if in_order:
        labels = np.sort(labels)
    log_weights = rng.normal(size=n)
    if kind == "empty slots":
        log_weights[rng.random(n) < 0.5] = -np.inf
    elif kind == "underflowing weights":
        log_weights[rng.random(n) < 0.5] -= 200.0
    elif kind == "masses 200 nats apart":
        log_weights -= 200.0 * labels
    elif kind == "dead components":
        log_weights[labels % 2 == 1] = -np.inf
    elif kind == "no weight at the ends":
        for label in range(m):
            members = np.flatnonzero(labels == label)
            log_weights[[*members[:3], *members[-3:]]] -= 200.0
    return make_mixture(rng.normal(size=n), log_weights, labels, m)


KINDS = (
    "random weights", "empty slots", "underflowing weights", "masses 200 nats apart",
    "dead components", "no weight at the ends",
)  # fmt: skip


def redraw_with(move):
    """The move, compiled with every uniform draw set to one value, unless that is NaN."""
    honest = jax.random.uniform

    @eqx.filter_jit
    def redraw(key, uniform, mixture):
        def patched(key, shape=(), dtype=float, **options):
            drawn = honest(key, shape, dtype, **options)
            return jnp.where(jnp.isnan(uniform), drawn, uniform.astype(drawn.dtype))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jax.random, "uniform", patched)
            return move(key, mixture, AT_START)

    return redraw


@pytest.mark.exactness
@pytest.mark.parametrize(
    ("scheme", "n", "most"),
    quick_of(
        [("systematic", 100_000, None), *((s, 1003, 0) for s in SCHEMES)],
        [("systematic", 1003, 0), ("multinomial", 1003, 0)],
    ),
)
def test_no_particle_of_zero_weight_is_ever_fed(scheme, n, most, monkeypatch):
    """Not with random draws, nor with uniform draws at their ends; nor is mass moved.

    Float32 has no room for a hundred thousand exact cumulative weights: guards must hold, those of
    sums of units too, which few particles take here.
    """
    if most is not None:
        monkeypatch.setattr(prefix_sums, "MOST_IN_ONE_FLOAT", most)
    redraw = redraw_with(Resample(scheme))
    for kind, in_order in itertools.product(KINDS, (False, True)):
        mixture = large_mixture(kind, n, 9, in_order)
        weights = np.asarray(mixture.component_weights)
        for seed, uniform in enumerate((np.nan, 0.0, NEARLY_ONE)):
            moved = redraw(jax.random.key(seed), jnp.asarray(uniform, jnp.float32), mixture)
            filled = np.asarray(moved.occupied)
            parents = np.asarray(moved.ancestor_indices)[filled]
            assert (weights[parents] > 0).all(), kind
            labels = np.asarray(mixture.component_indicators)[parents]
            np.testing.assert_array_equal(np.asarray(moved.component_indicators)[filled], labels)
            # Thousands of equal shares in float32 add up to their whole but for rounding.
            np.testing.assert_allclose(
                moved.log_mixture_weights, mixture.log_mixture_weights, rtol=1e-5, atol=1e-3
            )


# Two million draws of each scheme, of particles of unlike weight in turn, or of a Gaussian cloud.
MANY, NUM_KEYS = 2**17, 20


@pytest.mark.exactness
@pytest.mark.parametrize(
    ("scheme", "kind", "m"),
    [("systematic", "random", 12), ("stratified", "in turn", 1), ("multinomial", "in turn", 1),
     ("multinomial", "sorted", 12), ("systematic", "sorted", 1)],
)  # fmt: skip
def test_means_of_many_particles_stay_where_they_are(scheme, kind, m):
    """Within four standard errors over the keys, of the mixture and of every component."""
    rng = np.random.default_rng(1)
    if kind == "in turn":
        states, weights = np.tile([1.0, 0.0], MANY // 2), np.tile([0.7, 0.3], MANY // 2)
    else:
        states = rng.normal(size=MANY)
        states = np.sort(states) if kind == "sorted" else states
        weights = np.exp(-((states - 1) ** 2) / 0.18)
    labels = np.arange(MANY) * m // MANY if kind == "sorted" else rng.integers(0, m, MANY)
    mixture = make_mixture(states, np.log(weights), labels, m)
    weights = np.exp(np.asarray(mixture.log_weights, float))

    def sums(values):
        return np.bincount(labels, values, minlength=m)

    exact, found = sums(weights * states) / sums(weights), []
    for key in jax.random.split(KEY, NUM_KEYS):
        moved = draw(Resample(scheme), mixture, key)
        offspring = np.bincount(moved.ancestor_indices, minlength=MANY)
        found.append(sums(offspring * states) / sums(offspring) - exact)
    # What rounding of a weight may do to a mean.
    assert_unbiased(found, 0.0, slack=4e-7)


@pytest.mark.exactness
def test_components_draw_their_offsets_independently():
    log_weights = np.tile(np.log([0.05, 0.95] * 5), 2)
    mixture = make_mixture(np.arange(20.0), log_weights, np.repeat([0, 1], 10), 2)
    keys = jax.random.split(KEY, 2000)
    moved = jax.jit(jax.vmap(lambda key: Resample().resample(key, mixture)))(keys)
    first, second = (np.asarray(moved.ancestor_indices == i).any(axis=1) for i in (0, 10))
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(2000)


def three_components(masses, spreads=(1.0, 1.0, 1.0), n=40, groups=None):
    """Components of these masses, whose log-weights have these standard deviations."""
    labels = np.repeat(np.arange(3), n)
    log_weights = np.random.default_rng(1).normal(size=3 * n) * np.repeat(spreads, n)
    for label, mass in enumerate(masses):
        own = labels == label
        with np.errstate(divide="ignore"):
            log_weights[own] += np.log(mass) - np.log(np.exp(log_weights[own]).sum())
    states = np.zeros(3) if groups is None else np.asarray(groups, float)
    return make_mixture(states[labels][:, None], log_weights, labels, 3)


def group(states):
    return states[:, 0].astype(jnp.int32)


ADAPTIVE, EQUAL, GROUPS = (
    Resample(ess_threshold=0.5), Resample(allocation="equal"), Resample(group=group)
)  # fmt: skip


@pytest.mark.exactness
@pytest.mark.parametrize(
    ("mixture", "move", "expected"),
    [
        # Half or a quarter is shared equally, however little mass a component has.
        (three_components((0.5, 0.5, 1e-12), (0, 0, 0), 100), Resample(),
         [None, None, 100 * EQUAL_PARTS[0]]),
        (three_components((0.5, 0.5, 1e-12), (2, 2, 2), 100), Resample(),
         [None, None, 100 * EQUAL_PARTS[1]]),
        # All of it, where particles are few.
        (three_components((0.98, 0.01, 0.01), (1, 2, 0), FEWEST), Resample(), [FEWEST] * 3),
        # What is not due keeps its slots, and the dead have none.
        (three_components((0.7, 0.3, 0.0), (0, 2.5, 2.5)), ADAPTIVE, [40, 80, 0]),
        (three_components((0.7, 0.0, 0.3)), EQUAL, [60, 0, 60]),
        # Groups share equally, and so do the components of a group that live.
        (three_components((0.9, 0.01, 0.09), groups=(0, 0, 1)), GROUPS, [30, 30, 60]),
        (three_components((0.9, 0.01, 0.09), groups=(4, 4, 4)), GROUPS, [40, 40, 40]),
        (three_components((0.5, 0.0, 0.5), groups=(0, 0, 1)), GROUPS, [60, 0, 60]),
    ],
)  # fmt: skip
def test_slots_are_shared(mixture, move, expected):
    """By mass and variance it is Neyman's allocation: see `test_exact_answers.py`."""
    found = np.asarray(draw(move, mixture).component_counts)
    assert found.sum() == mixture.num_particles
    for number, wanted in zip(found, expected, strict=True):
        assert wanted is None or abs(number - wanted) <= 1, found


@pytest.mark.parametrize("n", [3, 1, 29])
def test_fewer_slots_than_components_fill_up_all_the_same(n):
    rng = np.random.default_rng(n)
    mixture = make_mixture(np.zeros((n, 1)), rng.normal(size=n), rng.integers(0, 8, n), 8)
    found = draw(Resample(), mixture).component_counts
    assert found.sum() == n
    assert (np.asarray(found) >= np.asarray(mixture.active)).all()


@pytest.mark.exactness
def test_what_has_no_mass_gets_none():
    """As an island does that has died."""
    for m in (1, 6):
        mixture = make_mixture(np.zeros((12, 1)), np.zeros(12), np.arange(12) % m, m)
        mixture = mixture.replace(log_weights=jnp.full(12, -jnp.inf))
        np.testing.assert_array_equal(draw(Resample(), mixture).log_weights, -np.inf)
