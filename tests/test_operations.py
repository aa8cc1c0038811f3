"""Each inner operation against its plain numpy definition."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.operations import prefix_sums
from mpfjax.operations.islands import cond_if_any, drawn_once
from mpfjax.operations.logarithms import default_float, exp, largest, log_sum_exp, softmax
from mpfjax.operations.matrices import (
    cholesky,
    coordinates,
    draw_columns,
    inner,
    log_total,
    row_sums,
    solve_lower,
    transformed,
)
from mpfjax.operations.prefix_sums import (
    _blocked_sum_before,
    _scanned_sum_before,
    count_starts,
    count_upto,
    few_upto,
    sum_before,
)
from mpfjax.operations.segments import (
    runs_of,
    segment_any,
    segment_argmax,
    segment_counts,
    segment_log_sum_exp,
    segment_max,
    segment_softmax,
    segment_sum,
    segments_in_order,
    spread,
    whole,
)
from mpfjax.operations.sorting import order_by_segment
from mpfjax.operations.stored import count_places, take, to_int, whole_blocks
from tests.marking import quick_of, thorough
from tests.precision import float64

# As one program each, as in a filter: to compile operations one by one takes longer.
_blocked_sum_before, _scanned_sum_before, sum_before = map(
    eqx.filter_jit, (_blocked_sum_before, _scanned_sum_before, sum_before)
)
count_starts, count_upto, few_upto = map(eqx.filter_jit, (count_starts, count_upto, few_upto))
order_by_segment, segment_any, segment_counts = map(
    eqx.filter_jit, (order_by_segment, segment_any, segment_counts)
)
segment_argmax, segment_max, segment_sum = map(
    eqx.filter_jit, (segment_argmax, segment_max, segment_sum)
)
segment_log_sum_exp, segment_softmax, spread = map(
    eqx.filter_jit, (segment_log_sum_exp, segment_softmax, spread)
)
cholesky, draw_columns, row_sums, solve_lower = map(
    eqx.filter_jit, (cholesky, draw_columns, row_sums, solve_lower)
)

RNG = np.random.default_rng(0)
SIZES = (1, 2, 31, 32, 33, 100, 1024, 1025, 33_000)
# On either side of the number of segments up to which sums are unrolled.
FEW_AND_MANY = (1, 2, 4, 5, 16, 17)


@pytest.mark.parametrize("n", SIZES)
def test_sums_before(n):
    values = RNG.random(n).astype(np.float32)
    upto = np.cumsum(values.astype(float))
    before, total = sum_before(jnp.asarray(values))
    np.testing.assert_allclose(before, np.concatenate([[0], upto[:-1]]), rtol=1e-5)
    np.testing.assert_allclose(total, upto[-1], rtol=1e-5)


def test_sums_before_in_float64_and_under_vmap():
    values = RNG.random((3, 200))
    with float64():
        before, total = jax.vmap(sum_before)(jnp.asarray(values))
        assert before.dtype == np.float64
        upto = np.cumsum(values, axis=1)
        np.testing.assert_allclose(before, upto - values, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(total, upto[:, -1], rtol=1e-13)


@pytest.mark.parametrize("how", ["blocked", "scanned"])
@pytest.mark.parametrize("n", quick_of((*SIZES, 10_000), (1, 33, 1025, 33_000)))
def test_sums_never_fall_and_zeros_add_nothing(n, how):
    # Zeros in runs, some over whole blocks, at the front and at the end; sizes far apart.
    rows = np.exp(RNG.normal(scale=5, size=(20, n)))
    runs = np.repeat(RNG.random((20, -(-n // 40))) < 0.5, 40, axis=1)[:, :n]
    rows[runs | (RNG.random((20, n)) < 0.3)] = 0
    rows[:3] = 0
    rows[1, n // 2] = rows[2, -1] = 1
    sums = {"blocked": _blocked_sum_before, "scanned": _scanned_sum_before}
    values = jnp.asarray(rows, jnp.float32)
    before, total = map(np.asarray, jax.vmap(sums[how])(values))
    line = np.concatenate([before, total[:, None]], axis=1)
    assert (np.diff(line) >= 0).all()
    assert (np.diff(line)[np.asarray(values) == 0] == 0).all()
    np.testing.assert_allclose(total, np.asarray(values).sum(axis=1, dtype=float), rtol=1e-5)


@pytest.mark.parametrize("form", [prefix_sums._blocked, prefix_sums._scanned])
def test_sums_in_two_parts_are_exact(form):
    """Of multiples of 2^-24 far from each other in size, whose sums float32 could not hold."""
    rng = np.random.default_rng(7)
    rows = np.exp(rng.normal(scale=5, size=(5, 3100)))
    rows *= 2000 / rows.sum(axis=1, keepdims=True)
    rows[rng.random(rows.shape) < 0.3] = 0
    rows[0] = 0
    rows[1, 100] = 3000
    whole = np.floor(rows)
    parts = np.round((rows - whole) * 2**24)
    both = (jnp.asarray(whole, jnp.float32), jnp.asarray(parts, jnp.float32))
    before, total = jax.jit(jax.vmap(form))(*both)
    exact = np.cumsum(whole + parts / 2**24, axis=1)
    values = np.asarray(before.whole, float) + np.asarray(before.fraction, float)
    np.testing.assert_array_equal(values, exact - (whole + parts / 2**24))
    sums = np.asarray(total.whole, float) + np.asarray(total.fraction, float)
    np.testing.assert_array_equal(sums[:, 0], exact[:, -1])


def test_the_last_position_before_each_point():
    rng = np.random.default_rng(7)
    places = np.sort(np.round(rng.random(300) ** 2 * 64 * 2**12) / 2**12)
    points = np.append(rng.random(500) * 64, places)

    def parts(values):
        return prefix_sums.as_positions(jnp.asarray(values, jnp.float32))

    found = eqx.filter_jit(prefix_sums.last_before)(parts(places), parts(points), 64)
    points = points.astype(np.float32)
    np.testing.assert_array_equal(found, np.searchsorted(places, points, "right") - 1)


def test_random_positions_fill_lines_of_any_length_evenly():
    lengths = jnp.asarray(np.repeat([1, 3, 10**6, 2**30 + 1], 10_000), jnp.int32)
    drawn = jax.jit(prefix_sums.random_positions)(jax.random.key(0), lengths)
    shares = (np.asarray(drawn.whole) + np.asarray(drawn.fraction, float)) / np.asarray(lengths)
    for values in (shares, np.asarray(drawn.fraction)):
        found = np.sort(values.reshape(4, -1), axis=1)
        gaps = np.abs(found - np.linspace(0, 1, 10_000)[None]).max(axis=1)
        assert (gaps < 0.02).all()  # Kolmogorov and Smirnov's statistic, of one in a thousand


def test_exponentials_are_never_subnormal():
    powers = jnp.asarray([0.0, -70.0, -80.0, -95.0, -200.0, -jnp.inf, jnp.nan])
    values = np.asarray(exp(powers))
    np.testing.assert_allclose(values[:2], np.exp([0.0, -70.0]), rtol=1e-5)
    assert (values[2:6] == 0).all()
    assert np.isnan(values[6])
    smallest = values[1]
    assert smallest * np.finfo(np.float32).eps >= np.finfo(np.float32).tiny


@pytest.mark.parametrize("n", SIZES)
def test_count_upto_is_exact(n):
    ones = RNG.integers(0, 2, n)
    for values in (jnp.asarray(ones, jnp.int32), jnp.asarray(ones, bool)):
        np.testing.assert_array_equal(count_upto(values, n), np.cumsum(ones))


@pytest.mark.parametrize("n", [1, 24, 64, 65, 1000])
def test_few_upto_is_a_cumulative_sum_of_whole_numbers(n):
    counts = RNG.integers(0, 2**20, n)
    for values in (jnp.asarray(counts, jnp.int32), jnp.asarray(counts % 2, bool)):
        found = few_upto(values)
        assert found.dtype == jnp.int32
        np.testing.assert_array_equal(found, np.cumsum(values))
        np.testing.assert_array_equal(jax.vmap(few_upto)(values[None, ::-1])[0][-1], found[-1])


def test_count_upto_is_exact_where_float32_is_not():
    counts = np.array([2**23 - 1, 1, 2**24, 1, 0, 3])
    found = count_upto(jnp.asarray(counts, jnp.int32), int(counts.sum()))
    np.testing.assert_array_equal(found, np.cumsum(counts))


def test_whole_numbers_become_integers():
    whole = np.array([0, 1, 2, 3, 2**22, 2**23 - 1])
    found = to_int(jnp.asarray(whole, jnp.float32))
    assert found.dtype == jnp.int32
    np.testing.assert_array_equal(found, whole)


@pytest.mark.thorough
def test_more_places_than_float32_can_number():
    firsts = np.array([0, 1, 2**24 + 1, 2**24 + 3, 2**24 + 7])
    segments = segments_in_order(jnp.asarray(firsts, jnp.int32), 2**24 + 40)
    np.testing.assert_array_equal(segments[firsts], np.arange(5))
    np.testing.assert_array_equal(segments[firsts[1:] - 1], np.arange(4))


@pytest.mark.parametrize("n", [1, 7, 200])
def test_count_starts_is_a_search_for_the_last_start(n):
    starts = np.sort(RNG.integers(0, n + 3, n))
    expected = np.searchsorted(starts, np.arange(n), side="right") - 1
    found = count_starts(jnp.asarray(starts, jnp.int32), n)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("n", [1, 7, 8, 31, 32, 700, 1000, 1025, 1500])
def test_whole_blocks_need_no_filling_up(n):
    length = whole_blocks(n)
    assert n <= length < n + 32
    assert whole_blocks(length) == length


def test_places_are_counted_alone_and_under_two_vmaps():
    places = RNG.integers(0, 9, (2, 3, 20))
    expected = np.stack([[np.bincount(row, minlength=9) for row in rows] for rows in places])
    places = jnp.asarray(places, jnp.int32)

    def count(row):
        return count_places(row, 9)

    np.testing.assert_array_equal(jax.vmap(jax.vmap(count))(places), expected)
    np.testing.assert_array_equal(count(places[1, 2]), expected[1, 2])


def labelled(n, m):
    """Values with an empty segment where there is more than one."""
    labels = RNG.integers(0, m, n)
    labels[labels == m - 2] = m - 1
    return RNG.normal(size=n).astype(np.float32), labels


@pytest.mark.parametrize("m", FEW_AND_MANY)
class TestSegments:
    def test_sum(self, m):
        values, labels = labelled(90, m)
        rows = np.stack([values, values**2], axis=1)
        expected = np.stack([rows[labels == s].sum(axis=0) for s in range(m)])
        found = segment_sum(jnp.asarray(rows), jnp.asarray(labels, jnp.int32), m)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)

    def test_spread_gives_each_entry_its_segments_value(self, m):
        _, labels = labelled(90, m)
        of_segments = RNG.normal(size=(m, 2)).astype(np.float32)
        found = spread(jnp.asarray(of_segments), jnp.asarray(labels, jnp.int32))
        np.testing.assert_array_equal(found, of_segments[labels])

    def test_labels_out_of_range_are_left_out(self, m):
        labels = jnp.array([0, m, m - 1], jnp.int32)
        total = segment_sum(jnp.ones(3), labels, m)
        assert float(total.sum()) == 2

    def test_max_and_argmax(self, m):
        values, labels = labelled(90, m)
        arrays = jnp.asarray(values), jnp.asarray(labels, jnp.int32)
        largest = segment_max(*arrays, m)
        index = np.asarray(segment_argmax(*arrays, m))
        for s in range(m):
            members = values[labels == s]
            if members.size:
                assert largest[s] == members.max() == values[index[s]]
                assert labels[index[s]] == s
            else:
                assert largest[s] == -np.inf
                assert 0 <= index[s] < 90

    def test_counts(self, m):
        values, labels = labelled(90, m)
        found = segment_counts(jnp.asarray(values > 0), jnp.asarray(labels, jnp.int32), m)
        np.testing.assert_array_equal(
            found, [((labels == s) & (values > 0)).sum() for s in range(m)]
        )

    def test_log_sum_exp(self, m):
        values, labels = labelled(90, m)
        values = 100 * values
        values[::7] = -np.inf
        found = segment_log_sum_exp(jnp.asarray(values), jnp.asarray(labels, jnp.int32), m)
        expected = [
            np.logaddexp.reduce(values[labels == s].astype(float), initial=-np.inf)
            for s in range(m)
        ]
        np.testing.assert_allclose(found, expected, rtol=1e-5)

    def test_order_by_segment_is_a_stable_argsort(self, m):
        _, labels = labelled(90, m)
        labels[::5] = m  # the empty slots, which come last
        order, counts = order_by_segment(jnp.asarray(labels, jnp.int32), m)
        np.testing.assert_array_equal(order, np.argsort(labels, kind="stable"))
        np.testing.assert_array_equal(counts, np.bincount(labels.astype(int), minlength=m + 1)[:m])


@pytest.mark.parametrize(
    ("n", "m"),
    [(1, 5), (33, 256), (64, 257), *thorough([(31, 2), (32, 64), (1000, 64), (1024, 31)])],
)
def test_order_by_segment_counts_and_sorts_alike(n, m):
    rng = np.random.default_rng(n + m)
    for labels in (
        rng.integers(0, m + 1, n),
        np.full(n, m),
        np.zeros(n),
        np.arange(n)[::-1] % m,
    ):
        order, counts = order_by_segment(jnp.asarray(labels, jnp.int32), m)
        np.testing.assert_array_equal(order, np.argsort(labels, kind="stable"))
        np.testing.assert_array_equal(counts, np.bincount(labels.astype(int), minlength=m + 1)[:m])


def test_a_handful_of_entries_is_summed_by_masks():
    """No more entries than segments: some segments have two, some none."""
    labels = RNG.integers(0, 30, 40)
    values = RNG.normal(size=(40, 11)).astype(np.float32)
    arrays = jnp.asarray(values), jnp.asarray(labels, jnp.int32)
    sums = np.zeros((30, 11), np.float32)
    np.add.at(sums, labels, values)
    held = np.bincount(labels, minlength=50) > 0
    for columns in (1, 11):
        found = segment_sum(arrays[0][:, :columns], arrays[1], 50)
        np.testing.assert_allclose(found[:30], sums[:, :columns], rtol=1e-5, atol=1e-6)
    largest = segment_max(arrays[0][:, 0], arrays[1], 50)
    expected = [values[labels == m, 0].max(initial=-np.inf) for m in range(50)]
    np.testing.assert_array_equal(largest, np.array(expected, np.float32))
    shares = segment_softmax(arrays[0][:, 0], arrays[1], 50)
    np.testing.assert_allclose(segment_sum(shares, arrays[1], 50), held, rtol=1e-5)


@pytest.mark.parametrize(("m", "n"), [(7, 200), (60, 1000), (200, 1102), (600, 1102)])
def test_runs_of_one_segment_are_added_up_in_lanes(m, n):
    """From many entries a segment to hardly any, both ways through `vmap`, and its gradient."""
    rng = np.random.default_rng(5)
    labels = np.sort(rng.integers(-1, m + 1, (3, n)), axis=1)
    values = rng.normal(size=(3, n)).astype(np.float32)
    own = jax.jit(jax.vmap(lambda v, s: segment_sum(v, s, m)))
    shared = jax.jit(jax.vmap(lambda v, s: segment_sum(v, s, m), (0, None)))
    largest = jax.jit(jax.vmap(lambda v, s: segment_max(v, s, m)))
    each = [[v[s == k] for k in range(m)] for v, s in zip(values, labels, strict=True)]
    sums = [[own.sum() for own in row] for row in each]
    every = jnp.asarray(values), jnp.asarray(labels, jnp.int32)
    np.testing.assert_allclose(own(*every), sums, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(shared(every[0], every[1][1])[1], sums[1], rtol=1e-4, atol=1e-5)
    expected = [[own.max(initial=-np.inf) for own in row] for row in each]
    np.testing.assert_array_equal(largest(*every), np.float32(expected))
    weights = jnp.arange(1.0, m + 1.0)
    gradient = jax.grad(lambda v: jnp.sum(own(v, every[1]) * weights[None]))(every[0])
    inside = (labels >= 0) & (labels < m)
    np.testing.assert_array_equal(gradient, np.where(inside, labels + 1, 0))


@pytest.mark.parametrize("m", [1, 4, 5, 33])
@pytest.mark.parametrize("n", [20, 32, 1000])
def test_runs_are_summed_as_their_labels_say(n, m):
    """Segments of no entry, of one and of many blocks, and entries of none at the end."""
    rng = np.random.default_rng(n + m)
    labels = np.sort(rng.choice([*rng.integers(0, m, 4).tolist(), m - 1, m], n))
    values = rng.normal(size=n).astype(np.float32)
    mask = rng.random(n) < 0.7

    @jax.jit
    def reduced(labels, values, mask):
        runs = runs_of(whole(labels, m), m)
        filled = whole(values, 0.0), whole(values, -jnp.inf), whole(mask, False)
        return runs.sums(filled[0]), runs.maxima(filled[1]), *runs.extents(filled[2])

    found = reduced(jnp.asarray(labels, jnp.int32), values, mask)
    sums, maxima, firsts, lasts = map(np.asarray, found)
    for label in range(m):
        own = values[labels == label]
        np.testing.assert_allclose(sums[label], own.sum(), rtol=1e-5, atol=1e-5)
        assert maxima[label] == own.max(initial=-np.inf)
        places = np.flatnonzero((labels == label) & mask)
        if places.size:
            assert (firsts[label], lasts[label]) == (places[0], places[-1])


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
def test_the_largest_number(dtype):
    """NaN of either sign, infinities, zeros of both signs, the least numbers, and no number."""
    tiny = np.finfo(dtype).smallest_subnormal
    cases = [
        [-1.5, 3.25, 2.0], [-1.5, -3.25, -1.25], [-0.0, 0.0], [0.0, -tiny], [-tiny, -2 * tiny],
        [tiny, 0.0], [-np.inf, -np.inf], [1.0, np.inf], [np.nan, np.inf], [1.0, -np.nan], [],
    ]  # fmt: skip
    with float64():
        for case in cases:
            values = np.array(case, dtype)
            found = jax.jit(largest)(jnp.asarray(values))
            assert found.dtype == dtype
            np.testing.assert_array_equal(found, values.max(initial=-np.inf))
        table = RNG.standard_normal((5, 7)).astype(dtype)
        np.testing.assert_array_equal(largest(jnp.asarray(table), axis=1), table.max(axis=1))
        columns = jax.vmap(largest, in_axes=1)(jnp.asarray(table))
        np.testing.assert_array_equal(columns, table.max(axis=0))


def test_the_largest_number_is_a_constant_to_a_derivative():
    values = jnp.array([1.0, 3.0, 2.0])
    np.testing.assert_array_equal(jax.grad(largest)(values), np.zeros(3))
    assert largest(jnp.array([3, 7, 5])) == 7


@pytest.mark.parametrize("m", [1, 4, 33, 300])
def test_segment_any_says_which_segments_have_an_entry(m):
    rng = np.random.default_rng(m)
    labels, mask = rng.integers(0, m, 50), rng.random(50) < 0.5
    found = segment_any(jnp.asarray(mask), jnp.asarray(labels, jnp.int32), m)
    np.testing.assert_array_equal(found, np.bincount(labels[mask], minlength=m) > 0)


def test_runs_of_a_vmap_choose_together():
    """The condition stays one, whatever is batched, so that only one branch runs."""

    def doubled(needed, x):
        return cond_if_any(needed, lambda: jnp.where(needed, 2 * x, x), lambda: x)

    needed = jnp.asarray([[False, False], [False, True], [True, True]])
    values = jnp.arange(6.0).reshape(3, 2)
    run = jax.vmap(jax.vmap(doubled))
    np.testing.assert_array_equal(run(needed, values), jnp.where(needed, 2 * values, values))
    np.testing.assert_array_equal(jax.vmap(doubled)(needed[0], values[0]), values[0])
    (chosen,) = (
        line for line in str(jax.make_jaxpr(run)(needed, values)).split("\n") if "= cond[" in line
    )
    assert ":f32[3,2] = cond[" in chosen
    slopes = jax.grad(lambda x: jnp.sum(run(needed, x)))(values)
    np.testing.assert_array_equal(slopes, jnp.where(needed, 2.0, 1.0))


class TestTake:
    VALUES = np.arange(24.0, dtype=np.float32).reshape(2, 4, 3)
    INDICES = np.array([[3, 3, 0, 1, 2], [0, 1, 1, 3, 3]], np.int32)

    @pytest.mark.parametrize("axes", [(0, 0), (0, None), (None, 0)])
    def test_under_vmap_it_takes_each_runs_own(self, axes):
        values = self.VALUES if axes[0] == 0 else self.VALUES[0]
        indices = self.INDICES if axes[1] == 0 else self.INDICES[0]
        found = jax.vmap(take, axes)(jnp.asarray(values), jnp.asarray(indices))
        for run in range(2):
            own = self.VALUES[run if axes[0] == 0 else 0][self.INDICES[run if axes[1] == 0 else 0]]
            np.testing.assert_array_equal(found[run], own)

    def test_its_derivatives_are_those_of_indexing(self):
        def total(take, values):
            return jnp.sum(jax.vmap(take)(values, jnp.asarray(self.INDICES)) ** 3)

        values = jnp.asarray(self.VALUES)
        plain = lambda v, i: v[i]  # noqa: E731
        for slope in (jax.grad, jax.hessian):
            ours, theirs = (slope(lambda v, t=t: total(t, v))(values) for t in (take, plain))
            np.testing.assert_allclose(ours, theirs, rtol=1e-6)


class TestSoftmax:
    VALUES = np.array([0.3, -np.inf, -20.0, 1.2, -np.inf, 0.0], np.float32)

    @pytest.mark.parametrize("m", FEW_AND_MANY)
    def test_shares_sum_to_one_in_every_segment_that_has_any(self, m):
        labels = np.array([0, 0, m - 1, 0, m - 1, m - 1])
        found = segment_softmax(jnp.asarray(self.VALUES), jnp.asarray(labels, jnp.int32), m)
        for s in np.unique(labels):
            weights = np.exp(self.VALUES[labels == s].astype(float))
            np.testing.assert_allclose(found[labels == s], weights / weights.sum(), rtol=1e-5)

    def test_one_segment_is_softmax(self):
        alone = softmax(jnp.asarray(self.VALUES))
        segments = jnp.zeros(6, jnp.int32)
        np.testing.assert_array_equal(alone, segment_softmax(jnp.asarray(self.VALUES), segments, 1))
        assert (softmax(jnp.full(3, -jnp.inf)) == 0).all()

    @pytest.mark.parametrize("m", FEW_AND_MANY)
    def test_gradient_is_finite_where_that_of_what_uses_the_shares_is_not(self, m):
        segments = jnp.zeros(6, jnp.int32)

        def entropy(values):
            shares = segment_softmax(values, segments, m)
            return jnp.sum(jnp.where(jnp.asarray(self.VALUES) > -100, jnp.log(shares), 0.0))

        assert np.isfinite(jax.grad(entropy)(jnp.asarray(self.VALUES))).all()


class TestLogSumExp:
    def test_of_nothing_but_minus_infinity_is_minus_infinity_with_a_finite_gradient(self):
        values = jnp.full(5, -jnp.inf)
        assert log_sum_exp(values) == -jnp.inf
        assert np.isfinite(jax.grad(log_sum_exp)(values)).all()

    def test_its_gradient_is_the_softmax(self):
        values = jnp.array([1.0, -jnp.inf, 3.0, -200.0])
        gradient = jax.grad(log_sum_exp)(values)
        np.testing.assert_allclose(gradient, jax.nn.softmax(values), rtol=1e-6)

    @pytest.mark.parametrize("scale", [1e4, -1e4])
    def test_neither_overflows_nor_underflows(self, scale):
        values = jnp.array([scale, scale + 1.0])
        expected = scale + np.log(1 + np.e)
        np.testing.assert_allclose(log_sum_exp(values), expected, rtol=1e-6)

    def test_lets_nan_and_infinity_through(self):
        assert np.isnan(log_sum_exp(jnp.array([0.0, jnp.nan])))
        assert log_sum_exp(jnp.array([0.0, jnp.inf])) == jnp.inf


def test_take_is_indexing():
    values, indices = jnp.arange(12.0).reshape(6, 2), jnp.array([5, 0, 5], jnp.int32)
    np.testing.assert_array_equal(take(values, indices), np.asarray(values)[[5, 0, 5]])


def test_default_float_follows_the_precision():
    assert default_float() == np.float32
    with float64():
        assert default_float() == np.float64


@pytest.mark.parametrize("shape", [(50, 4, 4), (24, 8, 8), (100, 8, 8)])
def test_cholesky_of_many_small_matrices(shape):
    """Column by column, or in a loop over the columns where a few have many."""
    factors = np.tril(RNG.normal(size=shape) + 3 * np.eye(shape[1])).astype(np.float32)
    matrices = factors @ np.swapaxes(factors, 1, 2)
    found = np.asarray(cholesky(jnp.asarray(matrices)))
    np.testing.assert_array_equal(found, np.tril(found))
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), matrices, rtol=1e-3, atol=1e-3)


def test_cholesky_in_a_loop_has_the_derivative_of_numpys():
    with float64():
        factor = np.tril(RNG.normal(size=(6, 6))) + 3 * np.eye(6)
        matrix, change = factor @ factor.T, RNG.normal(size=(6, 6))

        def total(matrix, factored):
            return jnp.sum(change * factored(matrix[None])[0])

        found, expected = [
            jax.grad(total)(jnp.asarray(matrix), factored)
            for factored in (cholesky, jnp.linalg.cholesky)
        ]
        found, expected = (gradient + gradient.T for gradient in (found, expected))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_cholesky_does_not_depend_on_the_units():
    """A place in pixels beside a size in units of itself, whose variance is a millionth."""
    units = np.array([30.0, 20.0, 0.02, 0.01])
    correlations = np.full((4, 4), 0.5) + 0.5 * np.eye(4)
    matrix = (units[:, None] * correlations * units).astype(np.float32)
    found = np.asarray(cholesky(jnp.asarray(matrix)[None])[0])
    np.testing.assert_allclose(found, units[:, None] * np.linalg.cholesky(correlations), rtol=1e-4)


def test_cholesky_of_a_singular_matrix_leaves_out_the_direction():
    """Two coordinates that are one, in other units, and one that does not vary at all."""
    direction = np.array([2.0, 6e-3, 0.0], np.float32)
    matrix = np.outer(direction, direction)
    found = np.asarray(cholesky(jnp.asarray(matrix)[None])[0])
    np.testing.assert_allclose(found, np.stack([direction, 0 * direction, 0 * direction], axis=1))


def test_solve_lower_is_numpys():
    factors = np.tril(RNG.normal(size=(20, 3, 3)) + 3 * np.eye(3)).astype(np.float32)
    vectors = RNG.normal(size=(20, 3)).astype(np.float32)
    expected = np.linalg.solve(factors, vectors[:, :, None])[:, :, 0]
    found = solve_lower(jnp.asarray(factors), jnp.asarray(vectors))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    shared = solve_lower(jnp.asarray(factors[:1]), jnp.asarray(vectors))
    expected = np.linalg.solve(factors[0], vectors.T).T
    np.testing.assert_allclose(shared, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("columns", [1, 2, 16, 17, 40])
def test_row_sums(columns):
    values = np.random.default_rng(0).normal(size=(9, columns)).astype(np.float32)
    np.testing.assert_allclose(row_sums(jnp.asarray(values)), values.sum(axis=1), atol=1e-5)


@pytest.mark.parametrize("columns", [1, 2, 7, 16, 50])
def test_draw_columns_finds_the_column_of_each_quantile(columns):
    rng = np.random.default_rng(columns)
    weights = rng.exponential(size=(200, columns)) * (rng.random((200, columns)) < 0.6)
    weights[np.arange(200), rng.integers(0, columns, 200)] += 0.1
    uniform = rng.random(200)
    drawn = np.asarray(draw_columns(*(jnp.asarray(a, jnp.float32) for a in (uniform, weights))))
    upto = np.cumsum(weights, axis=1)
    rows = np.arange(200)
    target = uniform * upto[:, -1]
    assert (target <= upto[rows, drawn] + 1e-4).all()
    assert (target >= upto[rows, drawn] - weights[rows, drawn] - 1e-4).all()
    assert (weights[rows, drawn] > 0).all()


def test_draw_columns_by_two_quantiles_tells_any_number_of_columns_apart():
    """Blocks of 64 by the first, columns in a block by the second."""
    first, second = jnp.array([0.0, 0.5, 0.9999]), jnp.array([0.999, 0.5, 0.0])
    drawn = draw_columns(first, jnp.ones((3, 4096)), second)
    np.testing.assert_array_equal(drawn, [63, 32 * 64 + 32, 63 * 64])


def test_draw_columns_at_the_ends():
    weights = jnp.array([[0.0, 1.0, 0.0, 0.0, 2.0, 0.0]])
    first, last = (int(draw_columns(jnp.array([u]), weights)[0]) for u in (0.0, 0.99999994))
    assert (first, last) == (1, 4)


@pytest.mark.parametrize("num_segments", FEW_AND_MANY)
class TestSumsOfAMillion:
    """In float32, to the precision of a pairwise sum: none drifts as it grows."""

    n = 10**6

    def test_of_equal_values(self, num_segments):
        segments = np.arange(self.n) % num_segments
        found = segment_sum(
            jnp.full(self.n, 0.3, jnp.float32), jnp.asarray(segments, jnp.int32), num_segments
        )
        expected = np.float64(np.float32(0.3)) * np.bincount(segments)
        np.testing.assert_allclose(found, expected, rtol=2e-5)

    def test_of_values_far_from_zero(self, num_segments):
        segments = RNG.integers(0, num_segments, self.n)
        values = (1000 + RNG.normal(size=self.n)).astype(np.float32)
        found = segment_sum(jnp.asarray(values), jnp.asarray(segments, jnp.int32), num_segments)
        expected = np.bincount(segments, weights=values.astype(float))
        np.testing.assert_allclose(found, expected, rtol=2e-5)


def test_columns_of_no_weight_are_not_drawn_at_the_borders_of_blocks():
    """Quantiles exactly where a block, or a run of zeros, begins and ends."""
    for num_columns in (4, 9, 37, 100):
        weights = RNG.random((400, num_columns)).astype(np.float32)
        weights[RNG.random(weights.shape) < 0.6] = 0
        weights[:, 1] += weights.sum(axis=1) == 0
        upto = np.cumsum(weights, axis=1)
        border = np.argmax(RNG.random(weights.shape), axis=1)
        quantiles = np.concatenate([upto[np.arange(400), border] / upto[:, -1], np.zeros(400)])
        quantiles = np.concatenate([quantiles, np.full(400, np.nextafter(np.float32(1), 0))])
        table = np.tile(weights, (3, 1))
        found = draw_columns(
            jnp.asarray(np.minimum(quantiles, np.nextafter(np.float32(1), 0)), jnp.float32),
            jnp.asarray(table),
        )
        assert (table[np.arange(len(table)), np.asarray(found)] > 0).all()


@pytest.mark.thorough
def test_the_last_column_is_drawn_of_a_row_without_weight():
    found = draw_columns(jnp.array([0.0, 0.7]), jnp.zeros((2, 11)))
    np.testing.assert_array_equal(found, [10, 10])


@pytest.mark.parametrize("d", [3, 12])
def test_points_by_their_coordinates(d):
    """Sums that are written out, and products of matrices where there are too many."""
    points = RNG.normal(size=(40, d)).astype(np.float32)
    matrix = np.tril(RNG.normal(size=(d, d))).astype(np.float32)
    found = coordinates(jnp.asarray(points))
    for is_lower in (False, True):
        moved = transformed(jnp.asarray(matrix), found, is_lower)
        np.testing.assert_allclose(jnp.stack(moved, 1), points @ matrix.T, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(inner(found, found), np.sum(points**2, axis=1), rtol=1e-5)
    points[0] = -np.inf
    sums = log_total(coordinates(jnp.asarray(points)))
    np.testing.assert_allclose(sums, np.logaddexp.reduce(points, axis=1), rtol=1e-5, atol=1e-6)


def test_draws_that_are_made_once_are_the_same_and_stay_one_branch():
    """Of any type, with NaN, under `vmap` and in a gradient."""

    def draw(key):
        normal = jax.random.normal(key, (3,))
        return {
            "x": jnp.where(normal > 0, normal, jnp.nan),
            "n": jax.random.randint(key, (2,), 0, 9),
        }

    keys = jax.random.split(jax.random.key(0), 4)
    together = jax.vmap(lambda key: drawn_once(key, draw))
    for found, wanted in zip(
        jax.tree.leaves(jax.jit(together)(keys)),
        jax.tree.leaves(jax.vmap(draw)(keys)),
        strict=True,
    ):
        np.testing.assert_array_equal(found, wanted)
    assert "cond[" in str(jax.make_jaxpr(together)(keys))
    scaled = lambda a: jnp.sum(drawn_once(keys[0], lambda key: a * jax.random.normal(key, (3,))))  # noqa: E731
    np.testing.assert_allclose(jax.grad(scaled)(2.0), scaled(1.0), rtol=1e-6)
