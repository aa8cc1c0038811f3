"""Each inner operation against its plain numpy definition."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.moves.resampling.sorting import order_by_segment
from mpfjax.operations import prefix_sums
from mpfjax.operations.logarithms import exp, log_sum_exp, softmax
from mpfjax.operations.matrices import (
    cholesky,
    coordinates,
    draw_columns,
    inner,
    log_total,
    row_sums,
    solve_lower,
    transform,
)
from mpfjax.operations.prefix_sums import count_starts, count_upto, sum_before, to_units, unit_bits
from mpfjax.operations.segments import (
    segment_any,
    segment_argmax,
    segment_counts,
    segment_log_sum_exp,
    segment_reduce,
    segment_softmax,
    segment_sum,
    spread,
)
from mpfjax.operations.stored import cond_if_any, drawn_once
from tests.marking import quick_of

# As one program each, as in a filter: to compile operations one by one takes longer.
sum_before, count_starts, count_upto = map(eqx.filter_jit, (sum_before, count_starts, count_upto))
order_by_segment, segment_sum, draw_columns = map(
    eqx.filter_jit, (order_by_segment, segment_sum, draw_columns)
)

RNG = np.random.default_rng(0)
# On either side of one block, of blocks of blocks, and of those that need no filling up.
SIZES = (1, 33, 1024, 1025, 33_000)
# Masks for few segments or few entries, and scatters in lanes of many sizes.
SEGMENTS = ((1, 90), (4, 90), (5, 1102), (17, 90), (60, 1000), (600, 1102), (5, 1), (257, 64))


def close(found, expected, tolerance=1e-5):
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


def indices(values):
    return jnp.asarray(values, jnp.int32)


# Prefix sums and places.


@pytest.mark.parametrize("how", ["_blocked_sum_before", "_sum_before_by_scan"])
@pytest.mark.parametrize("n", SIZES)
def test_sums_before_never_fall_and_zeros_add_nothing(n, how):
    # Zeros in runs, some over whole blocks, at the front and at the end; sizes far apart.
    rows = np.exp(RNG.normal(scale=5, size=(5, n)))
    runs = np.repeat(RNG.random((5, -(-n // 40))) < 0.5, 40, axis=1)[:, :n]
    rows[runs | (RNG.random((5, n)) < 0.3)] = 0
    rows[:3] = 0
    rows[1, n // 2] = rows[2, -1] = 1
    rows[3] = RNG.random(n)
    values = jnp.asarray(rows, jnp.float32)
    before, total = map(np.asarray, jax.jit(jax.vmap(getattr(prefix_sums, how)))(values))
    line = np.concatenate([before, total[:, None]], axis=1)
    assert (np.diff(line) >= 0).all()
    assert (np.diff(line)[np.asarray(values) == 0] == 0).all()
    upto = np.cumsum(np.asarray(values, float), axis=1)
    np.testing.assert_allclose(line[:, 1:], upto, rtol=2e-5)


def test_units_keep_sums_of_values_in_any_order():
    """Of a million values in turn, at random and sorted."""
    n, num_bits = 2**20, unit_bits(2**20)
    values = np.exp(RNG.normal(scale=3, size=n))
    values[RNG.random(n) < 0.3] = 0
    for rows in (np.tile([1.4, 0.6], n // 2), values, np.sort(values)):
        rows = np.asarray(rows * n / rows.sum(), np.float32)
        units = np.asarray(jax.jit(to_units, static_argnums=1)(jnp.asarray(rows), num_bits))
        assert (units[rows == 0] == 0).all()
        exact = np.cumsum(rows.astype(float) * 2**num_bits)
        assert np.abs(np.cumsum(units) - exact).max() < 2**num_bits  # one slot of a million
        assert np.abs(units - rows.astype(float) * 2**num_bits).max() <= 64  # of the largest


def test_counts_and_whole_numbers_are_exact_where_float32_is_not():
    counts = np.array([2**23 - 1, 1, 2**24, 1, 0, 3])
    found = count_upto(indices(counts), int(counts.sum()))
    np.testing.assert_array_equal(found, np.cumsum(counts))


# Segments.


@eqx.filter_jit
def of_segments(values, labels, num_segments):
    """All that is found of each segment, of two columns of values; the last label is none's."""
    one, two = values.T
    table = segment_sum(values, labels, num_segments)
    return {
        "sum": table,
        "any": segment_any((one > 0) & (labels < num_segments), labels, num_segments),
        "max": segment_reduce("max", one, labels, num_segments, -jnp.inf),
        "argmax": segment_argmax(one, labels, num_segments),
        "counts": segment_counts(one > 0, labels, num_segments),
        "log_sum_exp": segment_log_sum_exp(two, labels, num_segments),
        "shares": segment_softmax(two, labels, num_segments),
        "spread": spread(table, jnp.minimum(labels, num_segments - 1)),
        "order": order_by_segment(labels, num_segments),
    }


@pytest.mark.parametrize(("m", "n"), quick_of(SEGMENTS, SEGMENTS[1:6:2]))
def test_segments(m, n):
    """Some of them empty, some of nothing but -inf; some entries are in none."""
    rng = np.random.default_rng(m)
    labels = rng.integers(0, m + 1, n)
    labels[labels == m - 2] = m - 1
    values = rng.normal(size=(n, 2)).astype(np.float32)
    values[:, 1] *= 100
    values[::7, 1] = values[labels == m - 3, 1] = -np.inf
    found = of_segments(jnp.asarray(values), indices(labels), m)
    found = jax.tree.map(np.asarray, found)
    for s in range(m):
        own, logs = values[labels == s, 0], values[labels == s, 1].astype(float)
        close(found["sum"][s, 0], own.sum())
        assert found["any"][s] == (own > 0).any()
        assert found["max"][s] == own.max(initial=-np.inf)
        assert own.size == 0 or labels[found["argmax"][s]] == s
        assert own.size == 0 or values[found["argmax"][s], 0] == own.max()
        assert found["counts"][s] == (own > 0).sum()
        total = np.logaddexp.reduce(logs, initial=-np.inf)
        close(found["log_sum_exp"][s], total)
        shares = np.exp(logs - max(total, np.finfo(float).min))
        close(found["shares"][labels == s], shares)
    inside = np.minimum(labels, m - 1)
    np.testing.assert_array_equal(found["spread"], found["sum"][inside])
    np.testing.assert_array_equal(found["order"], np.argsort(labels, kind="stable"))


@pytest.mark.parametrize("columns", [1, 11])
@pytest.mark.parametrize(("m", "n"), [(3, 200), (60, 1000)])
def test_sums_of_segments_under_vmap_and_their_gradient(m, n, columns):
    rng = np.random.default_rng(5)
    labels = np.sort(rng.integers(-1, m + 1, (3, n)), axis=1)
    values = rng.normal(size=(3, n, columns)).astype(np.float32)
    own = jax.jit(jax.vmap(lambda v, s: segment_sum(v, s, m)))
    sums = [[v[s == k].sum(axis=0) for k in range(m)] for v, s in zip(values, labels, strict=True)]
    every = jnp.asarray(values), indices(labels)
    np.testing.assert_allclose(own(*every), sums, rtol=1e-4, atol=1e-5)
    weights = jnp.arange(1.0, m + 1.0)[None, :, None]
    gradient = jax.grad(lambda v: jnp.sum(own(v, every[1]) * weights))(every[0])
    inside = (labels >= 0) & (labels < m)
    np.testing.assert_array_equal(gradient[:, :, 0], np.where(inside, labels + 1, 0))


@pytest.mark.parametrize("m", [1, 5])
def test_shares_have_a_finite_gradient_where_what_uses_them_has_none(m):
    values = np.array([0.3, -np.inf, -20.0, 1.2, -np.inf, 0.0], np.float32)

    def entropy(values):
        shares = segment_softmax(values, jnp.zeros(6, jnp.int32), m)
        return jnp.sum(jnp.where(values > -100, jnp.log(shares), 0.0))

    assert np.isfinite(jax.grad(entropy)(jnp.asarray(values))).all()


# Logarithms.


def test_exponentials_are_never_subnormal():
    powers = jnp.asarray([0.0, -70.0, -80.0, -95.0, -200.0, -jnp.inf, jnp.nan])
    values = np.asarray(exp(powers))
    np.testing.assert_allclose(values[:2], np.exp([0.0, -70.0]), rtol=1e-5)
    assert (values[2:6] == 0).all()
    assert np.isnan(values[6])
    assert values[1] * np.finfo(np.float32).eps >= np.finfo(np.float32).tiny


@pytest.mark.parametrize(
    "values",
    [[1.0, -np.inf, 3.0, -200.0], [-np.inf] * 5, [1e4, 1e4 + 1], [-1e4, 1 - 1e4], [0.0, np.nan]],
)
def test_sums_of_exponentials(values):
    with np.errstate(invalid="ignore"):
        exact = np.logaddexp.reduce(values)
    array = jnp.asarray(values, jnp.float32)
    np.testing.assert_allclose(log_sum_exp(array), exact, rtol=1e-6)
    if not np.isnan(exact):
        shares = np.exp(values - max(exact, np.finfo(float).min))
        close(softmax(array), shares)
        close(jax.grad(log_sum_exp)(array), shares)


# Small matrices.


@pytest.mark.exactness
@pytest.mark.parametrize("shape", [(50, 4, 4), (24, 8, 8)])
def test_factors_of_many_small_matrices(shape):
    factors = np.tril(RNG.normal(size=shape) + 3 * np.eye(shape[1])).astype(np.float32)
    found = np.asarray(cholesky(jnp.asarray(factors @ np.swapaxes(factors, 1, 2))))
    signs = np.sign(np.diagonal(factors, axis1=1, axis2=2))[:, None]
    np.testing.assert_allclose(found, factors * signs, rtol=1e-3, atol=1e-3)
    vectors = RNG.normal(size=shape[:2]).astype(np.float32)
    expected = np.linalg.solve(factors, vectors[:, :, None])[:, :, 0]
    close(solve_lower(jnp.asarray(factors), jnp.asarray(vectors)), expected, 1e-3)
    expected = np.linalg.solve(factors[0], vectors.T).T
    close(solve_lower(jnp.asarray(factors[:1]), jnp.asarray(vectors)), expected, 1e-3)


@pytest.mark.exactness
def test_cholesky_judges_a_variance_beside_its_own_units():
    """A place in pixels beside a size in units of itself; a direction without variance."""
    units = np.array([30.0, 20.0, 0.02, 0.01])
    correlations = np.full((4, 4), 0.5) + 0.5 * np.eye(4)
    matrix = (units[:, None] * correlations * units).astype(np.float32)
    found = np.asarray(cholesky(jnp.asarray(matrix)[None])[0])
    np.testing.assert_allclose(found, units[:, None] * np.linalg.cholesky(correlations), rtol=1e-4)
    direction = np.array([2.0, 6e-3, 0.0], np.float32)
    found = np.asarray(cholesky(jnp.asarray(np.outer(direction, direction))[None])[0])
    np.testing.assert_allclose(found, np.stack([direction, 0 * direction, 0 * direction], axis=1))


@pytest.mark.parametrize("columns", [1, 7, 16, 50])
def test_the_column_of_each_quantile_is_drawn(columns):
    """Where the quantile is, exactly on borders of blocks and of runs of zeros, and at both ends.

    The last column is drawn of a row without weight.
    """
    rng = np.random.default_rng(columns)
    weights = rng.exponential(size=(200, columns)) * (rng.random((200, columns)) < 0.4)
    weights[np.arange(200), rng.integers(0, columns, 200)] += 0.1
    weights = weights.astype(np.float32)
    upto = np.cumsum(weights, axis=1)
    border = upto[np.arange(200), rng.integers(0, columns, 200)] / upto[:, -1]
    below_one = np.nextafter(np.float32(1), 0)
    for quantile in (rng.random(200), border, np.zeros(200), np.ones(200)):
        quantile = np.minimum(quantile, below_one).astype(np.float32)
        drawn = np.asarray(draw_columns(jnp.asarray(quantile), jnp.asarray(weights)))
        ends, own = (array[np.arange(200), drawn] for array in (upto, weights))
        assert (own > 0).all()
        target = quantile * upto[:, -1]
        assert (target <= ends + 1e-4).all()
        assert (target >= ends - own - 1e-4).all()
    nothing = draw_columns(jnp.asarray(quantile), jnp.zeros((200, columns)))
    np.testing.assert_array_equal(nothing, columns - 1)


def test_two_quantiles_tell_any_number_of_columns_apart():
    """Blocks of 64 by the first, columns in a block by the second."""
    first, second = jnp.array([0.0, 0.5, 0.9999]), jnp.array([0.999, 0.5, 0.0])
    drawn = draw_columns(first, jnp.ones((3, 4096)), second)
    np.testing.assert_array_equal(drawn, [63, 32 * 64 + 32, 63 * 64])


@pytest.mark.parametrize("d", [3, 20])
def test_points_by_their_coordinates(d):
    """Sums that are written out, and products of matrices where there are too many."""
    points = RNG.normal(size=(40, d)).astype(np.float32)
    matrix = np.tril(RNG.normal(size=(d, d))).astype(np.float32)
    found = coordinates(jnp.asarray(points))
    for is_lower in (False, True):
        moved = transform(jnp.asarray(matrix), found, is_lower)
        close(jnp.stack(moved, 1), points @ matrix.T, 1e-4)
    close(inner(found, found), np.sum(points**2, axis=1))
    close(row_sums(jnp.asarray(points)), points.sum(axis=1))
    points[0] = -np.inf
    close(log_total(coordinates(jnp.asarray(points))), np.logaddexp.reduce(points, axis=1))


# Branches.


def test_runs_of_a_vmap_choose_together():
    """The condition stays one, whatever is batched, so that only one branch runs."""

    def doubled(needed, x):
        return cond_if_any(needed, lambda: jnp.where(needed, 2 * x, x), lambda: x)

    needed = jnp.asarray([[False, False], [False, True], [True, True]])
    values = jnp.arange(6.0).reshape(3, 2)
    run = jax.vmap(jax.vmap(doubled))
    np.testing.assert_array_equal(run(needed, values), jnp.where(needed, 2 * values, values))
    lines = str(jax.make_jaxpr(run)(needed, values)).split("\n")
    (chosen,) = (line for line in lines if "= cond[" in line)
    assert ":f32[3,2] = cond[" in chosen
    slopes = jax.grad(lambda x: jnp.sum(run(needed, x)))(values)
    np.testing.assert_array_equal(slopes, jnp.where(needed, 2.0, 1.0))


@pytest.mark.exactness
def test_draws_that_are_made_once_are_the_same_and_stay_one_branch():
    """Of any type, with NaN, under `vmap` and in a gradient."""

    def draw(key):
        normal = jax.random.normal(key, (3,))
        return jnp.where(normal > 0, normal, jnp.nan), jax.random.randint(key, (2,), 0, 9)

    keys = jax.random.split(jax.random.key(0), 4)
    together = jax.vmap(lambda key: drawn_once(key, draw))
    for found, wanted in zip(jax.jit(together)(keys), jax.vmap(draw)(keys), strict=True):
        np.testing.assert_array_equal(found, wanted)
    assert "cond[" in str(jax.make_jaxpr(together)(keys))
    scaled = lambda a: jnp.sum(drawn_once(keys[0], lambda key: a * jax.random.normal(key, (3,))))  # noqa: E731
    np.testing.assert_allclose(jax.grad(scaled)(2.0), scaled(1.0), rtol=1e-6)
