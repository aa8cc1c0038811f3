"""Hilbert curves, Sobol points and the noise that is made of them, against other ways to them."""

import itertools
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.stats import qmc

from mpfjax.models.noise import draw_noise, stratified_uniform
from mpfjax.moves.resampling.sorting import BITS, hilbert_index, order_by_key, sortable_bits
from mpfjax.operations.random import direction_numbers, sobol_points

# As one program each: to compile operations one by one takes longer.
hilbert_index, order_by_key, sortable_bits = map(
    eqx.filter_jit, (hilbert_index, order_by_key, sortable_bits)
)
FLOAT = np.dtype("float32")
KEYS = jax.random.split(jax.random.key(7), 4000)


@pytest.mark.parametrize(("d", "num_bits"), [(2, 5), (3, 3), (5, 2)])
def test_a_hilbert_curve_visits_every_cell_once_and_goes_to_a_neighbour(d, num_bits):
    cells = np.array(list(itertools.product(range(2**num_bits), repeat=d)), np.uint32).T
    index = np.asarray(hilbert_index(jnp.asarray(cells), num_bits))
    np.testing.assert_array_equal(np.sort(index), np.arange(2 ** (d * num_bits)))
    along = cells[:, np.argsort(index)].astype(int)
    np.testing.assert_array_equal(np.abs(np.diff(along, axis=1)).sum(axis=0), 1)


def test_a_hilbert_index_of_all_its_bits_goes_on_where_the_coarse_one_is():
    """Of cells within cells, the curve leaves one only when it has been everywhere in it."""
    d = 3
    num_bits = BITS // d
    cells = np.random.default_rng(0).integers(0, 2**num_bits, (d, 500)).astype(np.uint32)
    fine = np.asarray(hilbert_index(jnp.asarray(cells), num_bits))
    # The first axis of a coarser curve is another one for each number of bits but every d-th.
    coarse = np.asarray(hilbert_index(jnp.asarray(cells >> d), num_bits - d))
    np.testing.assert_array_equal(fine >> (d * d), coarse)


@pytest.mark.parametrize(("n", "num_segments"), [(1, 9), (33, 1), (1000, 9)])
def test_the_order_by_key_is_that_of_a_stable_sort(n, num_segments):
    rng = np.random.default_rng(n)
    values = rng.choice([-np.inf, -1.0, -0.0, 0.0, 1e-3, 2.5, np.inf, np.nan], n).astype(FLOAT)
    values = np.where(rng.random(n) < 0.5, values, rng.normal(size=n).astype(FLOAT))
    segments = rng.integers(0, num_segments, n)
    keys = sortable_bits(jnp.asarray(values))
    order = order_by_key(keys, jnp.asarray(segments, jnp.int32), num_segments)
    np.testing.assert_array_equal(order, np.lexsort((values, segments)))


def test_sobol_points_are_those_of_scipy():
    n, dimension = 512, 66
    expected = qmc.Sobol(dimension, scramble=False, bits=32).random(n)
    index = np.arange(n)
    directions = jnp.asarray(direction_numbers(dimension, 9))
    # scipy's are in the order of the Gray code.
    points = sobol_points(jnp.asarray(index ^ (index >> 1)), directions)
    np.testing.assert_array_equal(np.asarray(points).T / 2.0**32, expected)


N = 30
LABELS = jnp.asarray(np.sort(np.random.default_rng(2).integers(0, 3, N)), jnp.int32)


DRAWS = {
    "stratified": lambda key, d: draw_noise(key, "stratified", (N, d), FLOAT),
    "rqmc": lambda key, d: draw_noise(key, "rqmc", (N, d), FLOAT, LABELS, 3),
    "rqmc, dealt anew": lambda key, d: draw_noise(key, "rqmc", (N, d), FLOAT, LABELS, 3, True),
}


@cache
def draws(name, d):
    """Noise of thirty particles in three components, at many keys."""
    return np.asarray(jax.jit(jax.vmap(lambda key: DRAWS[name](key, d)))(KEYS))


def assert_independent(one, other):
    angle = np.arctan2(one, other) / (2 * np.pi) + 0.5
    assert scipy.stats.kstest(angle, "uniform").pvalue > 1e-4


@pytest.mark.exactness
@pytest.mark.parametrize(("name", "d"), [("rqmc", 1), *((name, 3) for name in DRAWS)])
def test_each_row_on_its_own_is_exactly_normal_and_its_columns_are_independent(name, d):
    found = draws(name, d)
    for row in (0, 1, 13, 29):
        for column in range(d):
            assert scipy.stats.kstest(found[:, row, column], "norm").pvalue > 1e-4
        for a, b in itertools.combinations(range(d), 2):
            assert_independent(found[:, row, a], found[:, row, b])
    bound = 5 / np.sqrt(len(KEYS))
    assert np.abs(found.mean(axis=0)).max() < bound
    assert np.abs((found**2).mean(axis=0) - 1).max() < np.sqrt(2) * bound


@pytest.mark.parametrize("d", [1, 3])
def test_rows_of_different_components_are_independent(d):
    labels = np.asarray(LABELS)
    first, last = (draws("rqmc", d)[:, labels == m, 0] for m in (0, 2))
    for a, b in ((0, 0), (1, 2), (3, 3)):
        assert_independent(first[:, a], last[:, b])


@pytest.mark.parametrize("d", [1, 2])
def test_rows_of_a_component_cover_the_normal_far_more_evenly(d):
    """Slot and noise together: the error of E[(slot / k) tanh z] over a component's slots."""
    n, labels = 128, jnp.repeat(jnp.arange(2, dtype=jnp.int32), 64)
    slots = (np.arange(n) % 64 / 64)[:, None]

    def error(kind):
        draw = jax.jit(jax.vmap(lambda key: draw_noise(key, kind, (n, d), FLOAT, labels, 2)))
        return (slots * np.tanh(np.asarray(draw(KEYS[:500]))))[:, 64:].mean(axis=(1, 2)).std()

    assert error("rqmc") < 0.25 * error("independent")


@pytest.mark.parametrize("name", ["rqmc", "stratified"])
@pytest.mark.parametrize("d", [1, 3])
def test_noise_dealt_twice_is_independent_of_itself_and_still_a_point_set(name, d):
    """The mean product of the two draws of each slot has an error of 1 / √N, over rows and keys."""
    n, keys = 1000, jax.random.split(jax.random.key(3), 400)

    def draw(key):
        return draw_noise(key, name, (n, d), FLOAT, shuffle=True)

    found = np.asarray(jax.jit(jax.vmap(draw))(keys), float)
    products = np.mean(found[0::2] * found[1::2], axis=1)
    assert np.abs(products.mean(axis=0)).max() < 4 / np.sqrt(n * len(products))
    assert np.sqrt(np.mean(products**2)) < 1.5 / np.sqrt(n)
    # The mean of all rows is far more exact than of independent ones.
    assert np.sqrt(np.mean(found.mean(axis=1) ** 2)) < 0.3 / np.sqrt(n)


@pytest.mark.exactness
def test_a_hundred_thousand_rows_stay_finite_and_uniform_ones_fill_each_cell():
    for kind in ("rqmc", "stratified"):
        noise = draw_noise(KEYS[0], kind, (100_000, 2), FLOAT)
        assert np.isfinite(noise).all()
        assert len(np.unique(noise[:, 0])) > 99_000
    points = np.asarray(stratified_uniform(KEYS[0], 50))
    np.testing.assert_array_equal(np.sort(np.floor(50 * points)), np.arange(50))
