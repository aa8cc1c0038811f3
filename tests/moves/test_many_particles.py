"""Resampling of a hundred thousand particles and more, where float32 runs out of bits."""

import itertools
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Resample
from mpfjax.exact import kalman_filter
from mpfjax.moves.resampling.allocation import place_slots
from mpfjax.moves.resampling.ancestors import SCHEMES as SCHEMES_BY_NAME
from mpfjax.moves.resampling.ancestors import Dealt
from mpfjax.moves.resampling.line import in_line
from mpfjax.operations import prefix_sums
from mpfjax.smoothing.backward import draw
from tests.examples import make_mixture
from tests.marking import quick_of, thorough
from tests.moves.test_resampling import (
    KINDS,
    NEARLY_ONE,
    assert_sound,
    large_mixture,
    redraw_with,
)

SCHEMES = ("systematic", "stratified", "multinomial", "residual", "ssp")
CLOUDS = ("in turn", "random", "sorted")
NUM_KEYS = 30


@lru_cache(maxsize=2)
def cloud(kind, n, m):
    """Particles of unlike weight in turn; or a Gaussian cloud weighed by a likelihood."""
    rng = np.random.default_rng(1)
    if kind == "in turn":
        states, weights = np.tile([1.0, 0.0], n // 2), np.tile([0.7, 0.3], n // 2)
    else:
        states = rng.normal(size=n)
        if kind == "sorted":
            states = np.sort(states)
        weights = np.exp(-((states - 1) ** 2) / 0.18)
    labels = np.arange(n) * m // n if kind == "sorted" else rng.integers(0, m, n)
    return make_mixture(states, np.log(weights), labels, m)


@eqx.filter_jit
def parents(move, key, mixture):
    moved = move(key, mixture)
    return moved.ancestor_indices, moved.component_indicators


def gaps(scheme, kind, n, m):
    """By how much the mean of each component moves with each key, in float64, (keys, m)."""
    mixture = cloud(kind, n, m)
    states = np.asarray(mixture.particles, float)
    labels = np.asarray(mixture.component_indicators)
    weights = np.exp(np.asarray(mixture.log_weights, float))
    sums = lambda values: np.bincount(labels, values, minlength=m)  # noqa: E731
    exact = sums(weights * states) / sums(weights)
    found = []
    for key in jax.random.split(jax.random.key(0), NUM_KEYS):
        drawn, groups = map(np.asarray, parents(Resample(scheme), key, mixture))
        assert (labels[drawn] == groups).all()
        offspring = np.bincount(drawn, minlength=n)
        found.append(sums(offspring * states) / sums(offspring) - exact)
    return np.array(found)


@pytest.mark.parametrize(
    ("scheme", "kind", "n", "m"),
    [
        ("multinomial", "in turn", 2**17, 1),
        *thorough(
            (scheme, kind, 2**17, m)
            for scheme, kind, m in itertools.product(SCHEMES, CLOUDS, (1, 12))
            if (scheme, kind, m) != ("multinomial", "in turn", 1)
        ),
        *thorough(
            (scheme, kind, 2**20, m)
            for scheme, (kind, m) in itertools.product(
                SCHEMES, [("in turn", 1), ("random", 12), ("sorted", 12)]
            )
        ),
        *thorough([("stratified", "in turn", 2**22, 1), ("systematic", "random", 2**22, 12)]),
    ],
)
def test_means_stay_where_they_are(scheme, kind, n, m):
    """Within four standard errors over the keys, of the mixture and of every component."""
    found = gaps(scheme, kind, n, m)
    errors = found.std(axis=0, ddof=1) / np.sqrt(NUM_KEYS)
    # What rounding of a weight may do to a mean.
    assert (np.abs(found.mean(axis=0)) < 4 * errors + 1e-7).all()
    overall = found.mean(axis=1)
    assert abs(overall.mean()) < 4 * overall.std(ddof=1) / np.sqrt(NUM_KEYS) + 1e-7
    if kind == "in turn" and scheme != "systematic":
        assert 4 * overall.std(ddof=1) / np.sqrt(NUM_KEYS) < 0.0015 * np.sqrt(2**17 / n)


def in_few_slots(n, counts):
    """Particles of unlike weight in turn, of which each component is dealt but few slots."""
    labels = np.repeat(np.arange(len(counts)), n // len(counts))
    mixture = make_mixture(np.tile([1.0, 0.0], n // 2), np.log(np.tile([0.7, 0.3], n // 2)), labels,
                           len(counts))  # fmt: skip
    return mixture, jnp.asarray(counts, jnp.int32)


@pytest.mark.thorough
@pytest.mark.parametrize("scheme", SCHEMES)
def test_components_of_any_size_fill_their_slots_from_their_own_particles(scheme):
    n, counts = 2**18, [1, 2**17, 3, 40_000]
    mixture, targets = in_few_slots(n, counts)
    line = in_line(mixture)
    slots = place_slots(targets, n)
    expected = line.expected(targets)
    before, _ = line.positions(expected, targets, slots.firsts)
    weights = np.exp(np.asarray(mixture.log_weights, float)).reshape(4, -1)
    upto = np.cumsum(weights / weights.sum(axis=1, keepdims=True), axis=1)
    exact = np.pad(upto[:, :-1], ((0, 0), (1, 0))) * np.asarray(counts)[:, None]
    exact += np.asarray(slots.firsts)[:, None]
    found = np.asarray(before.whole, float) + np.asarray(before.fraction, float)
    np.testing.assert_allclose(found.reshape(4, -1), exact, rtol=0, atol=3e-3)
    widths = (
        np.diff(found.reshape(4, -1), axis=1)[:, 1000:1002] * (n // 4) / np.array(counts)[:, None]
    )
    np.testing.assert_allclose(np.sort(widths, axis=1), [[0.6, 1.4]] * 4, rtol=1e-4)
    dealt = Dealt(line, targets, slots, expected, before, None)
    starts = SCHEMES_BY_NAME[scheme](jax.random.key(0), dealt)
    offspring = np.diff(np.append(np.asarray(starts), sum(counts))).reshape(4, -1).sum(axis=1)
    np.testing.assert_array_equal(offspring, counts)


class TestTwoParts:
    """The form for many particles, used for few."""

    @pytest.fixture(autouse=True)
    def always(self, monkeypatch):
        monkeypatch.setattr(prefix_sums, "MOST_IN_ONE_FLOAT", 0)

    @pytest.mark.thorough
    @pytest.mark.parametrize("scheme", quick_of(SCHEMES, ["residual"]))
    @pytest.mark.parametrize("m", [9, *thorough([1])])
    def test_no_particle_of_zero_weight_is_ever_fed(self, scheme, m):
        for kind, in_order in itertools.product(KINDS, (False, True)):
            mixture = large_mixture(kind, 1003, m, in_order)
            for seed, uniform in enumerate((np.nan, 0.0, NEARLY_ONE)):
                key, value = jax.random.key(seed), jnp.asarray(uniform, jnp.float32)
                assert_sound(mixture, redraw_with(Resample(scheme), key, value, mixture))

    @pytest.mark.thorough
    def test_it_differs_from_the_form_for_few_by_rounding_alone(self, monkeypatch):
        mixture = large_mixture("empty slots", 1007, 5)
        for move in (Resample(), Resample(ess_threshold=0.9), Resample(particles_per_component=9)):
            two, one = [], []
            for found, limit in ((two, 0), (one, 100_000)):
                monkeypatch.setattr(prefix_sums, "MOST_IN_ONE_FLOAT", limit)
                # A new function each time, since jit remembers the last form.
                redraw = jax.jit(jax.vmap(lambda key: move(key, mixture).ancestor_indices))  # noqa: B023
                found.extend(np.asarray(redraw(jax.random.split(jax.random.key(0), 20))).ravel())
            assert (np.array(two) == np.array(one)).mean() > 0.999


@pytest.mark.thorough
def test_draws_by_weight_are_in_proportion_to_it():
    """Indices for backward sampling, which take a point on the same line."""
    log_weights = cloud("in turn", 2**20, 1).log_weights
    draw_many = jax.jit(lambda key, log_weights: draw(key, (10, 10**5), log_weights))
    drawn = np.asarray(draw_many(jax.random.key(0), log_weights))
    assert abs((drawn % 2 == 0).mean() - 0.7) < 4 * np.sqrt(0.21 / 10**6)
    assert np.corrcoef(np.sort(drawn.ravel()), np.arange(10**6))[0, 1] > 0.99999


@pytest.mark.thorough
@pytest.mark.parametrize("max_components", [None, 4])
def test_the_evidence_of_many_particles_is_unbiased(max_components):
    model = mpfjax.LinearGaussianModel(
        A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]]
    )
    seen = np.array([[0.8], [0.3], [2.1], [-0.4], [0.9]], np.float32)
    exact = float(kalman_filter(model, jnp.asarray(seen)).log_marginal_likelihood)
    if max_components is None:
        filter = mpfjax.particle_filter(model, 2**18)
    else:
        filter = mpfjax.mixture_particle_filter(model, 2**18, max_components)
    keys = jax.random.split(jax.random.key(0), NUM_KEYS)
    runs = mpfjax.monte_carlo(keys, filter, seen, lambda mixture: None)
    ratios = np.exp(np.asarray(runs.log_marginal_likelihood, float) - exact)
    error = ratios.std(ddof=1) / np.sqrt(NUM_KEYS)
    assert error < 1e-3
    assert abs(ratios.mean() - 1) < 4 * error
