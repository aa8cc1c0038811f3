"""Hilbert curves, Sobol points and the noise that is made of them, against other ways to them."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.stats import qmc

from mpfjax.models.noise import draw_family_noise, draw_noise, rqmc_normal
from mpfjax.operations.random import (
    MOST_DIMENSIONS,
    direction_numbers,
    scrambled_directions,
    sobol_points,
)
from mpfjax.operations.sorting import (
    bits_per_dimension,
    hilbert_index,
    order_by_key,
    sortable_bits,
)
from tests.marking import thorough

# As one program each: to compile operations one by one takes longer.
hilbert_index, rqmc_normal, order_by_key, sortable_bits = map(
    eqx.filter_jit, (hilbert_index, rqmc_normal, order_by_key, sortable_bits)
)
FLOAT = np.dtype("float32")
KEYS = jax.random.split(jax.random.key(7), 4000)


@pytest.mark.parametrize(
    ("d", "num_bits"), [(1, 4), (2, 1), (2, 5), (3, 3), (4, 2), (5, 2), (6, 2), (8, 1)]
)
def test_a_hilbert_curve_visits_every_cell_once_and_goes_to_a_neighbour(d, num_bits):
    cells = np.array(list(itertools.product(range(2**num_bits), repeat=d)), np.uint32).T
    index = np.asarray(hilbert_index(jnp.asarray(cells), num_bits))
    np.testing.assert_array_equal(np.sort(index), np.arange(2 ** (d * num_bits)))
    along = cells[:, np.argsort(index)].astype(int)
    np.testing.assert_array_equal(np.abs(np.diff(along, axis=1)).sum(axis=0), 1)


def test_a_hilbert_index_of_all_its_bits_goes_on_where_the_coarse_one_is():
    """Of cells within cells, the curve leaves one only when it has been everywhere in it."""
    d = 3
    num_bits = bits_per_dimension(d)
    cells = np.random.default_rng(0).integers(0, 2**num_bits, (d, 500)).astype(np.uint32)
    fine = np.asarray(hilbert_index(jnp.asarray(cells), num_bits))
    # The first axis of a coarser curve is another one for each number of bits but every d-th.
    coarse = np.asarray(hilbert_index(jnp.asarray(cells >> d), num_bits - d))
    np.testing.assert_array_equal(fine >> (d * d), coarse)


@pytest.mark.parametrize("n", [1, 2, 33, 1000])
@pytest.mark.parametrize("num_segments", [1, 9])
def test_the_order_by_key_is_that_of_a_stable_sort(n, num_segments):
    rng = np.random.default_rng(n)
    values = rng.choice([-np.inf, -1.0, -0.0, 0.0, 1e-3, 2.5, np.inf, np.nan], n).astype(FLOAT)
    values = np.where(rng.random(n) < 0.5, values, rng.normal(size=n).astype(FLOAT))
    segments = rng.integers(0, num_segments, n)
    for column in (values, rng.integers(-5, 5, n)):
        keys = sortable_bits(jnp.asarray(column))
        order = order_by_key(keys, jnp.asarray(segments, jnp.int32), num_segments)
        np.testing.assert_array_equal(order, np.lexsort((column, segments)))


def test_sobol_points_are_those_of_scipy():
    n = 512
    expected = qmc.Sobol(MOST_DIMENSIONS, scramble=False, bits=32).random(n)
    index = np.arange(n)
    directions = jnp.asarray(direction_numbers(MOST_DIMENSIONS, 9))
    # scipy's are in the order of the Gray code.
    points = sobol_points(jnp.asarray(index ^ (index >> 1)), directions)
    np.testing.assert_array_equal(np.asarray(points).T / 2.0**32, expected)


def test_a_scrambled_net_is_a_net():
    """In every grid of 2^m cells that the unscrambled points have one each in, so have these."""
    m, d = 8, 3
    for key in jax.random.split(jax.random.key(1), 3):
        points = np.asarray(sobol_points(jnp.arange(2**m), scrambled_directions(key, d, m)))
        plain = np.asarray(sobol_points(jnp.arange(2**m), jnp.asarray(direction_numbers(d, m))))
        assert (points != plain).any(axis=1).all()
        found = 0
        for digits in itertools.product(range(m + 1), repeat=d):
            if sum(digits) == m:
                counts = [cell_counts(rows, digits) for rows in (plain, points)]
                np.testing.assert_array_equal(*counts)
                found += list(counts[0]) == [0, 2**m]
        assert found > 20


def cell_counts(points, digits):
    """How many cells of such a grid have each number of points."""
    cells = np.zeros(points.shape[1], int)
    for row, number in zip(points.astype(np.int64), digits, strict=True):
        cells = (cells << number) | (row >> (32 - number))
    return np.bincount(np.bincount(cells, minlength=1 << sum(digits)))


def test_more_dimensions_than_the_table_holds():
    with pytest.raises(ValueError, match=r"noise_dimension: 65 is not in 1, .* 64"):
        direction_numbers(65)
    with pytest.raises(ValueError, match="sort_by: 9 coordinates"):
        bits_per_dimension(9)


LABELS = jnp.asarray(np.sort(np.random.default_rng(2).integers(0, 3, 30)), jnp.int32)


@pytest.fixture(scope="module", params=[1, 3])
def draws(request):
    """Noise of thirty particles in three components, at many keys."""

    def draw(key):
        return rqmc_normal(key, (30, request.param), FLOAT, LABELS, 3)

    return np.asarray(jax.jit(jax.vmap(draw))(KEYS))


class TestRqmcNormal:
    def test_each_row_on_its_own_is_exactly_normal(self, draws):
        for row in (0, 1, 13, 29):
            for column in range(draws.shape[2]):
                assert scipy.stats.kstest(draws[:, row, column], "norm").pvalue > 1e-4
        bound = 5 / np.sqrt(len(KEYS))
        assert np.abs(draws.mean(axis=0)).max() < bound
        assert np.abs((draws**2).mean(axis=0) - 1).max() < np.sqrt(2) * bound

    def test_columns_of_a_row_are_independent(self, draws):
        for a, b in itertools.combinations(range(draws.shape[2]), 2):
            for row in (0, 7, 29):
                pair = np.arctan2(draws[:, row, a], draws[:, row, b]) / (2 * np.pi) + 0.5
                assert scipy.stats.kstest(pair, "uniform").pvalue > 1e-4

    def test_rows_of_different_components_are_independent(self, draws):
        labels = np.asarray(LABELS)
        first, last = draws[:, labels == 0, 0], draws[:, labels == 2, 0]
        for a, b in ((0, 0), (1, 2), (3, 3)):
            pair = np.arctan2(first[:, a], last[:, b]) / (2 * np.pi) + 0.5
            assert scipy.stats.kstest(pair, "uniform").pvalue > 1e-4

    def test_rows_of_a_component_cover_the_normal_far_more_evenly(self):
        """Slot and noise together: the error of E[(slot / k) tanh z] over a component's slots."""
        n, labels = 128, jnp.repeat(jnp.arange(2, dtype=jnp.int32), 64)
        slots = (np.arange(n) % 64 / 64)[:, None]

        def error(kind, d):
            def draw(key):
                return draw_noise(kind, key, (n, d), FLOAT, labels, 2)

            z = np.asarray(jax.jit(jax.vmap(draw))(KEYS[:500]))
            return (slots * np.tanh(z))[:, 64:].mean(axis=(1, 2)).std()

        for d in (1, 2):
            assert error("rqmc", d) < 0.25 * error("independent", d)

    def test_stays_finite_for_a_hundred_thousand_rows(self):
        noise = rqmc_normal(jax.random.key(8), (100_000, 2), FLOAT)
        assert np.isfinite(noise).all()
        assert len(np.unique(np.asarray(noise)[:, 0])) > 99_000

    def test_one_row(self):
        assert rqmc_normal(jax.random.key(8), (1, 2), FLOAT).shape == (1, 2)


FAMILY = 4
OF_FAMILIES = [1, *thorough([3])]


@pytest.fixture(scope="module", params=OF_FAMILIES)
def families(request):
    """Noise of four draws of each of thirty particles in three components, at many keys."""

    def draw(key):
        return draw_family_noise(key, (30, request.param), FAMILY, FLOAT, LABELS, 3)

    noise, shares = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(8), len(KEYS)))
    return np.asarray(noise).reshape(len(KEYS), 30, FAMILY, -1), np.asarray(shares)


class TestNoiseOfFamilies:
    def test_one_draw_at_random_is_exactly_normal(self, families):
        noise, _ = families
        which = np.random.default_rng(3).integers(0, FAMILY, len(KEYS))
        for slot in (0, 1, 13, 29):
            drawn = noise[np.arange(len(KEYS)), slot, which]
            for column in drawn.T:
                assert scipy.stats.kstest(column, "norm").pvalue > 1e-4

    def test_the_share_is_uniform_and_independent_of_the_noise(self, families):
        noise, shares = families
        for slot in (0, 7, 29):
            assert scipy.stats.kstest(shares[:, slot], "uniform").pvalue > 1e-4
            for draw, column in itertools.product((0, FAMILY - 1), range(noise.shape[3])):
                levels = scipy.stats.rankdata(noise[:, slot, draw, column]) / len(KEYS)
                both = np.mod(shares[:, slot] + levels, 1)
                assert scipy.stats.kstest(both, "uniform").pvalue > 1e-4

    def test_the_draws_of_a_particle_fill_strata_in_order(self, families):
        noise, _ = families
        strata = np.floor(FAMILY * scipy.stats.norm.cdf(noise[..., 0])).astype(int)
        assert (strata == np.arange(FAMILY)).all()


@pytest.mark.thorough
@pytest.mark.parametrize("num_draws", [2, 3])
def test_any_number_of_draws_fills_its_strata(num_draws):
    """Two strata are half of all numbers of 32 bits each, which int32 does not hold."""

    def draw(key):
        return draw_family_noise(key, (30, 1), num_draws, FLOAT, LABELS, 3)[0]

    noise = np.asarray(jax.vmap(draw)(KEYS[:20])).reshape(-1, 30, num_draws)
    strata = np.floor(num_draws * scipy.stats.norm.cdf(noise)).astype(int)
    assert (strata == np.arange(num_draws)).all()


def test_families_and_what_they_keep_are_one_net():
    """One of all draws in each cell of a coordinate; a draw kept by its share is even as well."""
    n, labels = 64, jnp.zeros(64, jnp.int32)

    def draw(key):
        return draw_family_noise(key, (n, 2), FAMILY, FLOAT, labels, 1)

    noise, shares = map(np.asarray, jax.jit(jax.vmap(draw))(KEYS[:200]))
    points = np.floor(n * FAMILY * scipy.stats.norm.cdf(noise)).astype(int)
    assert (np.sort(points, axis=1) == np.arange(n * FAMILY)[None, :, None]).all()
    kept = np.floor(FAMILY * shares).astype(int)
    first = noise[..., 0].reshape(-1, n, FAMILY)
    means = np.take_along_axis(first, kept[..., None], axis=2).mean(axis=(1, 2))
    assert means.std() < 0.25 / np.sqrt(n)
