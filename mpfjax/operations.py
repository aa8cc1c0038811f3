"""The inner operations of every filter, in the forms that XLA runs fast, behind plain names."""

import math
from collections.abc import Callable
from functools import partial, reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Inexact, Int, PyTree, Shaped, UInt32

_FEW_SEGMENTS = 4
_FEW_COLUMNS = 16
# Neighbours that are added to the same place go to different lanes, each with a place of its own: a
# CPU would wait at every one of them for the last to be done.
_LANES, _LANES_OF_ROWS = 8, 4
# One after the other, a million equal numbers add up to a thousandth too much in float32.
_LONGEST_SUM = 2**10
_BLOCKS = (32, 16, 8)
_ONE_BLOCK = 128
_EXACT_IN_FLOAT32 = 2**23  # as exact as up to 2^24, and readable from the lowest bits
_COUNTED_BLOCK = 32
_MOST_COUNTED_SEGMENTS = 8 * _COUNTED_BLOCK  # of which a block's counts are eight a particle


def whole_blocks(n: int) -> int:
    """The length, n or more, at which a prefix sum's blocks need no filling up."""
    size = _block_size(n)
    return -(-n // size) * size


def _block_size(n: int) -> int:
    # Nothing that is fused with filling up runs on vectors, nor with dividing by an odd size.
    whole = (size for size in _BLOCKS if n % size == 0 and n > _BLOCKS[0])
    return next(whole, _BLOCKS[0])


def sum_before(values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """The exclusive prefix sums c_i = v_0 + ... + v_{i-1}, shape (n,), and the sum of all.

    For values that are not negative the sums never fall, c_{i+1} is c_i to the bit where v_i is
    zero, and the sum of all is what they are past the last value that is not: rounding gives no
    stretch of the line to a value of zero. On a CPU they are products of blocks with a triangle
    of ones, several times faster than XLA's own cumulative sum, which other platforms keep.
    """
    return jax.lax.platform_dependent(values, cpu=_blocked_sum_before, default=_scanned_sum_before)


def _scanned_sum_before(values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    upto = jnp.cumsum(values)
    total = upto[-1]
    # Each zero goes with the next that is not.
    starts = jnp.where(values == 0, total, jnp.minimum(_shifted(upto), total))
    return jax.lax.cummin(starts, reverse=True), total


def _shifted(values: Shaped[Array, " n"]) -> Shaped[Array, " n"]:
    return jnp.concatenate([jnp.zeros(1, values.dtype), values[:-1]])


def _blocked_sum_before(values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    n = values.shape[0]
    if n <= _ONE_BLOCK:
        sums = (values[None] @ _ones_before(n, whole_blocks(n + 1), values.dtype))[0]
        return sums[:n], sums[n]
    blocks = _in_blocks(values)
    size = blocks.shape[1]
    # Columns are summed in the same order, so that a zero adds nothing to the next one.
    within = blocks @ _ones_before(size, size, values.dtype)
    totals = within[:, -1] + blocks[:, -1]
    # A zero after the last block has the sum of all before it.
    before, _ = _blocked_sum_before(jnp.pad(totals, (0, 1)))
    if before.shape[0] > _ONE_BLOCK:
        before = stored(before)
    upto = before[1:, None]
    # Between blocks the order of summing changes: zeros at a block's end go with the next block.
    sums = jnp.where(within == totals[:, None], upto, jnp.minimum(before[:-1, None] + within, upto))
    return sums.reshape(-1)[:n], before[-1]


def _in_blocks(values: Float[Array, " n"]) -> Float[Array, "blocks size"]:
    n = values.shape[0]
    return jnp.pad(values, (0, whole_blocks(n) - n)).reshape(-1, _block_size(n))


def _ones_before(num_rows: int, num_columns: int, dtype: jnp.dtype) -> Float[Array, "rows columns"]:
    """The matrix with ones above its diagonal."""
    return jnp.triu(jnp.ones((num_rows, num_columns), dtype), 1)


def count_starts(starts: Int[Array, "*rows n"], num_slots: int) -> Int[Array, " num_slots"]:
    """For each slot s, the last i with starts_i <= s, given starts in ascending order.

    Rows are one line, the first row first.

    With starts_i the first slot of parent i this is every slot's parent, in O(n) and without a
    search: a one is scattered at each start, and the prefix sum counts them. Parents without
    offspring start where the next one does and are passed over. Starts at or past `num_slots`
    are dropped; a slot before the first start gets -1.
    """
    # Those that are dropped get a place of their own.
    num_places = whole_blocks(num_slots + 1)
    dtype = jnp.float32 if starts.size < _EXACT_IN_FLOAT32 else jnp.int32
    starts = stored(jnp.minimum(starts, num_slots), num_slots + 1)
    if starts.ndim == 1 or starts.shape[0] == 1:
        at_start = count_places(starts.reshape(-1), num_places, dtype)
    else:  # a row has long runs without offspring, which are another row's
        lane = jnp.arange(starts.shape[1], dtype=jnp.int32) % _LANES_OF_ROWS
        places = (starts + num_places * lane[None]).reshape(-1)
        lanes = count_places(places, _LANES_OF_ROWS * num_places, dtype)
        # Written out: on several threads XLA takes ten times as long to sum over these few rows.
        at_start = reduce(jnp.add, lanes.reshape(_LANES_OF_ROWS, -1))
    return count_upto(at_start, starts.size)[:num_slots] - 1


def segments_in_order(firsts: Int[Array, " m"], num_places: int) -> Int[Array, " num_places"]:
    """Each place's segment, where segments lie side by side from ascending first places.

    An empty segment has no place, and places past the last segment's are the last one's.
    """
    num_segments = firsts.shape[0]
    if num_segments > _FEW_SEGMENTS:
        return count_starts(firsts, num_places)
    place = jnp.arange(num_places, dtype=jnp.int32)
    segments = jnp.zeros(num_places, jnp.int32)
    for m in range(1, num_segments):
        segments = segments + (place >= firsts[m]).astype(jnp.int32)
    return segments


def count_places(
    places: Int[Array, " n"], num_places: int, dtype: DTypeLike = jnp.int32
) -> Shaped[Array, " num_places"]:
    """How many of the entries name each place, all of which must be in [0, num_places)."""

    def scatter(rows: Int[Array, "k n"]) -> Shaped[Array, "k num_places"]:
        line = jnp.zeros(rows.shape[0] * num_places, dtype).at[_on_one_line(rows, num_places)]
        return line.add(1, mode="promise_in_bounds").reshape(-1, num_places)

    return _in_rows(scatter)(places)


def inverse_permutation(places: Int[Array, " n"]) -> Int[Array, " n"]:
    """The index that stands at each place, given every index's place."""
    n = places.shape[0]

    def scatter(rows: Int[Array, "k n"]) -> Int[Array, "k n"]:
        index = jnp.broadcast_to(jnp.arange(n, dtype=jnp.int32), rows.shape).reshape(-1)
        line = jnp.zeros(index.shape, jnp.int32).at[_on_one_line(rows, n)]
        return line.set(index, mode="promise_in_bounds", unique_indices=True).reshape(-1, n)

    return _in_rows(scatter)(stored(places, n))


def _on_one_line(rows: Int[Array, "k n"], num_places: int) -> UInt32[Array, " k*n"]:
    firsts = num_places * jnp.arange(rows.shape[0], dtype=jnp.int32)
    return _from_the_start((rows + firsts[:, None]).reshape(-1))


def _in_rows(scatter: Callable[..., Array]) -> Callable[..., Array]:
    """A scatter over one row that under `vmap` scatters all rows at once, over one line of places.

    On a CPU that takes about half the time of a scatter with pairs of indices. To a derivative it
    is a constant: JAX would apply the rule below to itself without end.
    """
    scatter_rows = jax.custom_batching.custom_vmap(scatter)

    @scatter_rows.def_vmap
    def _(
        axis_size: int, in_batched: list[bool], *arguments: Shaped[Array, "..."]
    ) -> tuple[Shaped[Array, "b k p"], bool]:
        every = [
            rows if is_batched else jnp.broadcast_to(rows, (axis_size, *rows.shape))
            for rows, is_batched in zip(arguments, in_batched, strict=True)
        ]
        scattered = scatter_rows(*(rows.reshape(-1, rows.shape[-1]) for rows in every))
        return scattered.reshape(axis_size, -1, scattered.shape[-1]), True

    return lambda *arguments: scatter_rows(*(row[None] for row in without_gradient(arguments)))[0]


def stored(values: Shaped[Array, "*rest n"], bound: int | None = None) -> Shaped[Array, "*rest n"]:
    """The same finite numbers, computed once and kept, where XLA for a CPU would not keep them.

    It would compute them again within whatever uses them, once for every particle even where they
    are one a component, and without vectors within a scatter or gather over flattened rows. A
    product with the identity is what it computes on its own. `bound` is above all whole numbers
    there may be; where it is above 2^23, more than is certain to come out exactly, nothing is done.
    """
    if bound is not None and bound > _EXACT_IN_FLOAT32:
        return values
    return jax.lax.platform_dependent(values, cpu=_times_identity, default=lambda values: values)


def _times_identity(values: Array) -> Array:
    # The blocks are those of the prefix sums, so that nothing is divided within the loop.
    is_float = jnp.issubdtype(values.dtype, jnp.floating)
    *rest, n = values.shape
    size = _block_size(n)
    lines = values if is_float else values.astype(jnp.float32)
    lines = jnp.pad(lines, [(0, 0)] * len(rest) + [(0, whole_blocks(n) - n)])
    blocks = lines.reshape(*rest, -1, size)
    product = (blocks @ jnp.eye(size, dtype=lines.dtype)).reshape(lines.shape)
    return (product if is_float else to_int(product))[..., :n].astype(values.dtype)


def to_int(
    values: Float[Array, "*shape"], bound: int = _EXACT_IN_FLOAT32 - 1
) -> Int[Array, "*shape"]:
    """Whole numbers from 0 to `bound` as integers.

    Added to 2^23 they stand in the lowest bits, as long as they are smaller. XLA's own conversion
    costs a CPU several times as much, since it looks for NaN and for what is out of range.
    """
    if values.dtype != jnp.float32 or bound >= _EXACT_IN_FLOAT32:
        return values.astype(jnp.int32)
    shift = np.float32(2**23)
    return jax.lax.bitcast_convert_type(values + shift, jnp.int32) - shift.view(np.int32)


def count_upto(values: Shaped[Array, " n"], bound: int) -> Int[Array, " n"]:
    """The inclusive prefix sums of whole numbers of whatever type, or of members, exact.

    `bound` is what their sum cannot exceed.
    """
    scanned = partial(jnp.cumsum, dtype=jnp.int32)
    if bound >= _EXACT_IN_FLOAT32:
        return scanned(values)
    return jax.lax.platform_dependent(values, cpu=_blocked_count_upto, default=scanned)


def _blocked_count_upto(values: Shaped[Array, " n"]) -> Int[Array, " n"]:
    n = values.shape[0]
    blocks = _in_blocks(values.astype(jnp.float32))
    before, _ = _blocked_sum_before(jnp.sum(blocks, axis=1))
    size = blocks.shape[1]
    # No order of summing rounds: what is before a block may be summed along with its first entry.
    is_first = jnp.arange(size) == 0
    blocks = blocks + jnp.where(is_first[None], before[:, None], 0.0)
    upto = blocks @ jnp.triu(jnp.ones((size, size), blocks.dtype))
    return to_int(upto).reshape(-1)[:n]


def row_sums(values: Float[Array, "n d"]) -> Float[Array, " n"]:
    """Σ_k v_ik. Over a few columns it is written out, which a CPU runs twenty times faster."""
    if not 0 < values.shape[1] <= _FEW_COLUMNS:
        return jnp.sum(values, axis=1)
    total = values[:, 0]
    for k in range(1, values.shape[1]):
        total = total + values[:, k]
    return total


def draw_columns(uniform: Float[Array, " k"], weights: Float[Array, "k n"]) -> Int[Array, " k"]:
    """The column of each row that holds the given quantile, in [0, 1), of the row's weights.

    A column of weight zero is not drawn, unless the whole row is zero: its last column then is.
    Two levels, blocks of columns and columns in a block, take one pass over the table.
    """
    # In both, rounding may leave the target on either side of a border, or past the end.
    num_rows, num_columns = weights.shape
    size = max(math.isqrt(num_columns), 1)
    num_blocks = -(-num_columns // size)
    padded = jnp.pad(weights, ((0, 0), (0, num_blocks * size - num_columns)))
    blocks = padded.reshape(num_rows, num_blocks, size)
    sums = jnp.sum(blocks, axis=2)
    upto = jnp.cumsum(sums, axis=1)
    target = uniform * upto[:, -1]
    block = _first_above(target, upto, sums)
    rows = jnp.arange(num_rows, dtype=jnp.int32)
    chosen = blocks[rows, block]
    rest = target - (upto[rows, block] - sums[rows, block])
    column = _first_above(rest, jnp.cumsum(chosen, axis=1), chosen)
    return jnp.minimum(block * size + column, num_columns - 1)


def _first_above(
    target: Float[Array, " k"], upto: Float[Array, "k n"], weights: Float[Array, "k n"]
) -> Int[Array, " k"]:
    """In each row the first place of positive weight whose cumulative sum is above the target.

    The last place of positive weight where none is, and the last of all where none has weight.
    """
    last = weights.shape[1] - 1
    place = jnp.arange(last + 1, dtype=jnp.int32)[None]
    is_positive = weights > 0
    first = jnp.min(jnp.where(is_positive & (upto > target[:, None]), place, last + 1), axis=1)
    last_positive = jnp.max(jnp.where(is_positive, place, -1), axis=1)
    last_positive = jnp.where(last_positive < 0, last, last_positive)
    return jnp.minimum(first, last_positive)


def spread(
    values: Shaped[Array, "m *rest"], segments: Int[Array, " n"]
) -> Shaped[Array, "n *rest"]:
    """values[segments], each entry its segment's value; a label out of range gets some value.

    Few segments are chosen between, many are gathered: on a CPU a gather keeps all that is
    computed along with it from running on vectors.
    """
    num_segments = values.shape[0]
    if num_segments > _FEW_SEGMENTS:
        return take(values, segments)
    chosen = jnp.broadcast_to(values[0], (*segments.shape, *values.shape[1:]))
    for m in range(1, num_segments):
        is_member = (segments == m).reshape(-1, *[1] * (values.ndim - 1))
        chosen = jnp.where(is_member, values[m][None], chosen)
    return chosen


def segment_sum(
    values: Float[Array, "n *rest"], segments: Int[Array, " n"], num_segments: int
) -> Float[Array, "num_segments *rest"]:
    """The sum of the values in each segment; a label outside [0, num_segments) is left out."""
    if num_segments > _FEW_SEGMENTS:
        columns = values.reshape(values.shape[0], -1).T
        sums = jax.vmap(lambda column: _scattered_sum(column, segments, num_segments))(columns)
        return sums.T.reshape(num_segments, *values.shape[1:])
    member = _members(segments, num_segments, values.ndim - 1)
    return jnp.sum(jnp.where(member, values[None], jnp.zeros((), values.dtype)), axis=1)


def segment_max(
    values: Float[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Float[Array, " num_segments"]:
    """The largest value in each segment, -inf in an empty one."""
    if num_segments > _FEW_SEGMENTS:
        return _scattered("max", values, segments, num_segments, -jnp.inf)
    member = _members(segments, num_segments)
    return jnp.max(jnp.where(member, values[None], jnp.array(-jnp.inf, values.dtype)), axis=1)


def segment_counts(
    mask: Bool[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Int[Array, " num_segments"]:
    """How many of the masked entries lie in each segment."""
    if mask.shape[0] >= _EXACT_IN_FLOAT32:
        return _scattered("add", mask.astype(jnp.int32), segments, num_segments, 0)
    return segment_sum(mask.astype(default_float()), segments, num_segments).astype(jnp.int32)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _scattered_sum(
    values: Float[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Float[Array, " num_segments"]:
    return _scattered("add", values, segments, num_segments, 0)


@_scattered_sum.defjvp
def _scattered_sum_jvp(num_segments: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    values, segments = primals
    # In JAX's own form, which can be transposed.
    tangent = jax.ops.segment_sum(tangents[0], segments, num_segments)
    return _scattered_sum(values, segments, num_segments), tangent


def _scattered(
    how: str,
    values: Shaped[Array, " n"],
    segments: Int[Array, " n"],
    num_segments: int,
    initial: float,
) -> Shaped[Array, " num_segments"]:
    """The values of each segment added up, or their "max" or "min", beginning at `initial`.

    Where there are many in a segment they are dealt to lanes.
    """
    n = values.shape[0]
    num_lanes = _num_lanes(n) if n >= _LANES * num_segments else 1
    padding = ((0, 0), (0, -n % num_lanes))

    def scatter(
        rows: Shaped[Array, "k n"], labels: Int[Array, "k n"]
    ) -> Shaped[Array, "k num_segments"]:
        num_rows = rows.shape[0]
        # One more, for what is in no segment.
        labels = jnp.where((labels >= 0) & (labels < num_segments), labels, num_segments)
        labels = jnp.pad(labels, padding, constant_values=num_segments)
        labels = labels.reshape(num_rows, -1, num_lanes)
        # Row and lane are added as they are: XLA would take arithmetic on them out of a filter's
        # loop, and then no longer see that two sums by the same labels have the same places.
        row, lane = (jax.lax.broadcasted_iota(jnp.int32, labels.shape, axis) for axis in (0, 2))
        places = (labels * num_lanes + lane) * num_rows + row
        line = jnp.full((num_segments + 1) * num_lanes * num_rows, initial, rows.dtype)
        combine = getattr(line.at[_from_the_start(places.reshape(-1))], how)
        lines = combine(jnp.pad(rows, padding).reshape(-1), mode="promise_in_bounds")
        lines = lines.reshape(-1, num_lanes, num_rows)[:num_segments]
        return _OVER_LANES[how](lines, axis=1).T.astype(rows.dtype)

    return _in_rows(scatter)(values, segments)


def _num_lanes(n: int) -> int:
    """A power of two, of which no lane gets more than so many: a long sum would drift."""
    return max(_LANES, 1 << max(-(-n // _LONGEST_SUM) - 1, 0).bit_length())


_OVER_LANES: dict[str, Callable[..., Array]] = {"add": jnp.sum, "max": jnp.max, "min": jnp.min}


def exp(log_values: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """e to these powers, zero where it is too small to count beside 1, squares and sums included.

    Arithmetic on subnormal numbers, which weights a little above zero would lead to, takes a
    hundred times as long.
    """
    info = jnp.finfo(log_values.dtype)
    smallest = math.log(info.tiny) - math.log(info.eps)
    return jnp.where(log_values < smallest, 0.0, jnp.exp(log_values))  # NaN stays


def scaled_exp(log_values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """exp of the values over the largest exp of them, and the logarithm of that one.

    All that is derived from weights starts from these, which XLA then computes once.
    """
    log_scale = finite_max(log_values)
    return exp(log_values - log_scale), log_scale


def finite_max(log_values: Float[Array, " n"]) -> Float[Array, ""]:
    """What logarithms may be reduced by: the largest, or 0 where that is infinite or NaN.

    It is a constant to a derivative.
    """
    return _finite(jnp.max(jax.lax.stop_gradient(log_values), initial=-jnp.inf))


def log_sum_exp(log_values: Float[Array, " n"]) -> Float[Array, ""]:
    """log Σ exp, -inf where every entry is -inf, with a gradient that is finite there too."""
    log_total, log_scale = scaled_log_sum_exp(log_values)
    return log_total + log_scale


def scaled_log_sum_exp(
    log_values: Float[Array, " n"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """log Σ exp in two parts: that of the values over the largest, and the largest.

    Of logarithms beyond a million or so the sum of both would keep little of the first.
    """
    values, log_scale = scaled_exp(log_values)
    return _log(jnp.sum(values)), log_scale


def segment_log_sum_exp(
    log_values: Float[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Float[Array, " num_segments"]:
    """log Σ exp in each segment, -inf in one that is empty or holds nothing but -inf."""
    shift = _finite(segment_max(jax.lax.stop_gradient(log_values), segments, num_segments))
    total = segment_sum(exp(log_values - spread(shift, segments)), segments, num_segments)
    return _log(total) + shift


def softmax(log_values: Float[Array, " n"]) -> Float[Array, " n"]:
    """exp of the values as shares of their sum, all zero where every entry is -inf."""
    values, _ = scaled_exp(log_values)
    total = jnp.sum(values)
    shares = values / jnp.where(total == 0, 1.0, total)
    return _masked(log_values, shares)


def segment_softmax(
    log_values: Float[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Float[Array, " n"]:
    """exp of the values as shares of their segment's sum, zero where that sum is zero."""
    shift = _finite(segment_max(jax.lax.stop_gradient(log_values), segments, num_segments))
    values = exp(log_values - spread(shift, segments))
    totals = segment_sum(values, segments, num_segments)
    shares = values / spread(jnp.where(totals == 0, 1.0, totals), segments)
    return _masked(log_values, shares)


def segment_argmax(
    values: Float[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Int[Array, " num_segments"]:
    """The index of the largest value in each segment, some index where it is empty."""
    n = values.shape[0]
    values = jax.lax.stop_gradient(values)  # an index has no derivative
    is_largest = values >= spread(segment_max(values, segments, num_segments), segments)
    index = jnp.where(is_largest, jnp.arange(n, dtype=jnp.int32), n - 1)
    if num_segments > _FEW_SEGMENTS:
        return _scattered("min", index, segments, num_segments, n - 1)
    member = _members(segments, num_segments)
    return jnp.min(jnp.where(member, index[None], n - 1), axis=1)


def order_by_segment(
    segments: Int[Array, " n"], num_segments: int
) -> tuple[Int[Array, " n"], Int[Array, " num_segments"]]:
    """The indices that make segments contiguous and ascending, and how many each segment has.

    The original order is kept within each; a label equal to `num_segments` comes last. Up to a few
    hundred segments it is counted which place an entry comes to, in O(n); for more, label and
    index are packed into one integer where they fit, since sorting one array is several times
    faster than sorting pairs.
    """
    n = segments.shape[0]
    if num_segments <= _MOST_COUNTED_SEGMENTS and n < _EXACT_IN_FLOAT32:
        places, counts = _places_by_segment(segments, num_segments)
        return inverse_permutation(places), counts
    counts = segment_counts(jnp.ones(n, bool), segments, num_segments)
    if (num_segments + 1) * n >= 2**31:
        return jnp.argsort(segments, stable=True).astype(jnp.int32), counts
    index = jnp.arange(n, dtype=jnp.int32)
    return jax.lax.sort(segments.astype(jnp.int32) * n + index) % n, counts


def _places_by_segment(
    segments: Int[Array, " n"], num_segments: int
) -> tuple[Int[Array, " n"], Int[Array, " num_segments"]]:
    """Each entry's place in the order, which is how many come before it, and segments' counts.

    A table holds how many of each segment every block of entries has, a row for each segment. In
    one prefix sum over all of it, row after row, a cell's share of the order begins; an entry's
    rank within its cell is how many of those before it in the block are of its segment.
    """
    n = segments.shape[0]
    # Odd, since rows a power of two apart would share a few places of a cache.
    num_blocks = -(-n // _COUNTED_BLOCK) | 1
    cells = segments * num_blocks + jnp.arange(n, dtype=jnp.int32) // _COUNTED_BLOCK
    num_cells = whole_blocks((num_segments + 1) * num_blocks + 1)
    # One place further on, so that what is summed up to a cell is what is before it.
    before = count_upto(count_places(cells + 1, num_cells, jnp.float32), n)
    # The start of the first block is filled up with what names no cell.
    line = jnp.pad(cells, (_COUNTED_BLOCK, 0), constant_values=-1)
    ranks = jnp.zeros(n, jnp.int32)
    for back in range(1, _COUNTED_BLOCK):
        earlier = jax.lax.slice_in_dim(line, _COUNTED_BLOCK - back, _COUNTED_BLOCK - back + n)
        ranks = ranks + (earlier == cells).astype(jnp.int32)
    firsts = before[: (num_segments + 1) * num_blocks : num_blocks]
    return take(before, cells) + ranks, jnp.diff(firsts)


def cholesky(matrices: Float[Array, "n d d"]) -> Float[Array, "n d d"]:
    """Lower triangular factors F with F Fᵀ = matrix, for positive semidefinite matrices.

    A direction of no variance gets a column of zeros; each coordinate is held against its own
    variance, so that units do not matter. Batched LAPACK calls on thousands of tiny matrices cost
    far more than their arithmetic; here all of them go through each of the d columns at once.
    """
    d = matrices.shape[-1]
    tiny = 8 * d * jnp.finfo(matrices.dtype).eps * jnp.diagonal(matrices, axis1=1, axis2=2)
    factors = jnp.zeros_like(matrices)
    for j in range(d):
        rest = matrices[:, :, j] - jnp.einsum("nik,nk->ni", factors, factors[:, j])
        positive = rest[:, j] > tiny[:, j]
        pivot = jnp.sqrt(jnp.where(positive, rest[:, j], 1.0))
        column = jnp.where(positive[:, None], rest / pivot[:, None], 0.0)
        factors = factors.at[:, j:, j].set(column[:, j:])
    return factors


def solve_lower(
    factors: Float[Array, "#n d d"], vectors: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """F⁻¹ v of lower triangular F, by forward substitution; one F for all, or one for each.

    Written out for the same reason as `cholesky`; LAPACK's own has also been seen to hang where
    a program solves for several large batches at once.
    """
    solved = jnp.zeros_like(vectors)
    for i in range(vectors.shape[1]):
        rest = vectors[:, i] - jnp.sum(factors[:, i] * solved, axis=1)
        solved = solved.at[:, i].set(rest / factors[:, i, i])
    return solved


def take(values: Array, indices: Int[Array, " n"]) -> Array:
    """values[indices] for indices that are known to lie in range."""
    return values.at[_from_the_start(indices)].get(mode="promise_in_bounds")


def _from_the_start(indices: Int[Array, "*shape"]) -> UInt32[Array, "*shape"]:
    """Indices without a sign, of which JAX need not ask whether they count from the end."""
    return indices.astype(jnp.uint32)


@jax.custom_jvp
def add_gradient(
    values: Float[Array, " *shape"], source: Float[Array, " *shape"]
) -> Float[Array, " *shape"]:
    """`values`, to the bit, whose derivatives of every order are those of `values + source`.

    Where nothing is differentiated the source is not even computed.
    """
    del source
    return values


@add_gradient.defjvp
def _add_gradient_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return add_gradient(*primals), tangents[0] + tangents[1]


def without_gradient(tree: PyTree) -> PyTree:
    """The same values, all of them constants to a derivative."""
    return jax.tree.map(
        lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, tree
    )


def as_inexact(values: Shaped[Array, "*shape"]) -> Inexact[Array, "*shape"]:
    """The same numbers in floating point: whole ones and booleans have no averages of their own."""
    is_inexact = jnp.issubdtype(values.dtype, jnp.inexact)
    return values if is_inexact else values.astype(default_float())


def default_float() -> jnp.dtype:
    """The floating point type of new arrays: float32, or float64 where JAX is set to it."""
    return jnp.result_type(float)


def _finite(largest: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """What may be taken off a logarithm: the largest, or nothing where that is infinite or NaN."""
    return jnp.where(jnp.isfinite(largest), largest, 0.0)


def _masked(log_values: Float[Array, " n"], shares: Float[Array, " n"]) -> Float[Array, " n"]:
    """The shares, with no gradient at -inf, where what uses them may have none that is finite."""
    return jnp.where(log_values == -jnp.inf, 0.0, shares)


def _log(total: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """log, -inf at zero with a gradient of zero; NaN comes out as NaN."""
    empty = total == 0
    return jnp.where(empty, -jnp.inf, jnp.log(jnp.where(empty, 1.0, total)))


def _members(
    segments: Int[Array, " n"], num_segments: int, trailing: int = 0
) -> Bool[Array, "num_segments n ..."]:
    """Who belongs to which segment; XLA fuses the mask into its reduction and never stores it."""
    labels = jnp.arange(num_segments, dtype=segments.dtype)
    member = segments[None] == labels[:, None]
    return member.reshape(member.shape + (1,) * trailing)
