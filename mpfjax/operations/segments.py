"""Sums, maxima and other reductions by component.

In numpy: `[values[labels == m].sum() for m in range(M)]` and `per_component[labels]`. For few
components or particles there are M masks, which XLA fuses into its loops. For many there is one
scatter, shared by lanes, so that neighbours need not wait for each other and rounding errors of
long sums stay small.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mpfjax.operations.logarithms import (
    add_gradient,
    default_float,
    exp,
    finite_or_zero,
    log_or_nothing,
)
from mpfjax.operations.stored import EXACT_IN_FLOAT32, stored, take

# Up to this many segments, a sum has a mask for each; with more, up to this many masked entries.
# Masks run on vectors, and compile in half the time of a scatter. Runs of a `vmap` multiply them.
FEW_SEGMENTS = 4
_FEW_MASKED = 2**12
# One of up to this many values is selected by comparing, which is vectorised; a gather is not.
FEW_CHOICES = 16
# Neighbours that are added to the same place go to different lanes, each with a place of its own.
# In one place, a CPU would have to wait for each addition before the next.
_LANES = 8
# A sum over the entries runs on vectors where they lie side by side, column by column: up to ten
# times as fast. To bring many columns into that order costs more than it gains.
_FEW_COLUMNS = 9
# In float32, a million equal numbers, added one after the other, give a thousandth too much.
_LONGEST_SUM = 2**10
# The segments that occur are kept in the bits of at most this many words.
_WORD, _MOST_WORDS = 32, 8
_WORD_BITS = 5  # a word has 2^5 bits
_REDUCTIONS: dict[str, Callable[..., Array]] = {"add": jnp.sum, "max": jnp.max, "min": jnp.min}


@jax.jit
def spread(values: Shaped[Array, "m *rest"], labels: Int[Array, " n"]) -> Shaped[Array, "n *rest"]:
    """values[labels], each entry its segment's value; a label out of range gets some value.

    With up to 16 segments it is a choice between them, with more a gather of values that are stored
    for it: on a CPU, nothing that is fused with a gather runs on vectors.
    """
    num_segments = values.shape[0]
    if num_segments > FEW_CHOICES:
        return take(stored(values), labels)
    shape = (*labels.shape, *values.shape[1:])
    if num_segments == 1:
        return jnp.broadcast_to(values, shape)
    cases = map(partial(jnp.broadcast_to, shape=shape), jnp.split(values, num_segments))
    which = jax.lax.broadcast_in_dim(labels.astype(jnp.int32), shape, (0,))
    return jax.lax.select_n(which, *cases)


@partial(jax.jit, static_argnames="num_segments")
def segment_sum(
    values: Float[Array, "n *rest"], segments: Int[Array, " n"], num_segments: int
) -> Float[Array, "num_segments *rest"]:
    """The sum of the values in each segment; a label outside [0, num_segments) is left out."""
    columns = values.reshape(values.shape[0], -1).T
    sums = column_sums(columns, segments, num_segments)
    return sums.reshape(num_segments, *values.shape[1:])


def column_sums(
    columns: Float[Array, "c n"], segments: Int[Array, " n"], num_segments: int
) -> Float[Array, "num_segments c"]:
    """`segment_sum` of values that lie column by column, each entry beside the next."""
    sums = partial(segment_reduce, "add", segments=segments, num_segments=num_segments)
    if len(columns) <= _FEW_COLUMNS:
        # A sum of several columns at once would be of columns that are chosen number by number.
        return jnp.stack(list(map(sums, columns)), 1)
    return jax.vmap(sums)(columns).T


def are_masked(n: int, num_segments: int) -> bool:
    """Whether n entries are summed by a mask for each segment."""
    return num_segments <= FEW_SEGMENTS or n * num_segments <= _FEW_MASKED


@partial(jax.jit, static_argnames="num_segments")
def segment_any(
    mask: Bool[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Bool[Array, " num_segments"]:
    """Which segments have a masked entry; labels are in [0, num_segments)."""
    if num_segments > _MOST_WORDS * _WORD:
        return segment_counts(mask, segments, num_segments) > 0
    word_of, bit = segments >> _WORD_BITS, (segments & (_WORD - 1)).astype(jnp.uint32)
    bits = jnp.uint32(1) << bit
    words = []
    for word in range(-(-num_segments // _WORD)):
        of_word = jnp.where(mask & (word_of == word), bits, jnp.uint32(0))
        words.append(jax.lax.reduce(of_word, np.uint32(0), jax.lax.bitwise_or, (0,)))
    # Not gathered by label: XLA would read all particles again for each.
    shifts = jnp.arange(_WORD, dtype=jnp.uint32)
    occurs = (jnp.stack(words)[:, None] >> shifts[None]) & 1 > 0
    return occurs.reshape(-1)[:num_segments]


def segment_reduce(
    how: str,
    values: Shaped[Array, " n"],
    segments: Int[Array, " n"],
    num_segments: int,
    nothing: float = 0,
) -> Shaped[Array, " num_segments"]:
    """The sum ("add"), "max" or "min" of each segment's values, `nothing` for an empty one.

    Of these the sum has a derivative.
    """
    n, reduce = values.shape[0], _REDUCTIONS[how]
    if are_masked(n, num_segments):
        # XLA fuses the masks into the sum and never stores them.
        is_member = segments[None] == jnp.arange(num_segments, dtype=segments.dtype)[:, None]
        of_each = jnp.where(is_member, values[None], nothing)
        return reduce(of_each.astype(values.dtype), axis=1)
    # A power of two: enough that the rounding error of each lane's sum stays small.
    num_lanes = max(_LANES, 1 << max(-(-n // _LONGEST_SUM) - 1, 0).bit_length())
    padding = (0, -n % num_lanes)
    # One more, for values that are in no segment.
    labels = jnp.where((segments >= 0) & (segments < num_segments), segments, num_segments)
    labels = jnp.pad(labels, padding, constant_values=num_segments).reshape(-1, num_lanes)
    # The lane is added without other arithmetic. XLA would move such arithmetic out of a filter's
    # loop, and not see any more that two sums by the same labels use the same places.
    places = labels * num_lanes + jax.lax.broadcasted_iota(jnp.int32, labels.shape, 1)
    line = jnp.full((num_segments + 1) * num_lanes, nothing, values.dtype)
    combine = getattr(line.at[places.reshape(-1).astype(jnp.uint32)], how)
    terms = jax.lax.stop_gradient(stored(values) if how == "add" else values)
    lines = combine(jnp.pad(terms, padding), mode="promise_in_bounds")
    lines = lines.reshape(-1, num_lanes)[:num_segments]
    reduced = reduce(lines, axis=1).astype(values.dtype)
    if how != "add":
        return reduced
    # The form of JAX itself, whose derivative can be transposed.
    return add_gradient(reduced, jax.ops.segment_sum(values, segments, num_segments))


@partial(jax.jit, static_argnames="num_segments")
def segment_counts(
    mask: Bool[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Int[Array, " num_segments"]:
    """How many of the masked entries lie in each segment."""
    if mask.shape[0] >= EXACT_IN_FLOAT32:
        return segment_reduce("add", mask.astype(jnp.int32), segments, num_segments)
    return segment_sum(mask.astype(default_float()), segments, num_segments).astype(jnp.int32)


def segment_log_sum_exp(
    log_values: Float[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Float[Array, " num_segments"]:
    """log Σ exp in each segment, -inf in one that is empty or holds nothing but -inf."""
    values, shift = scaled_exp_of_segments(log_values, segments, num_segments)
    return log_or_nothing(segment_sum(values, segments, num_segments)) + shift


def scaled_exp_of_segments(
    log_values: Float[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> tuple[Float[Array, " n"], Float[Array, " num_segments"]]:
    """exp of the values divided by their segment's largest, and the logarithm of that."""
    constants = jax.lax.stop_gradient(log_values)
    largest = segment_reduce("max", constants, segments, num_segments, -jnp.inf)
    shift = finite_or_zero(largest)
    return exp(log_values - spread(shift, segments)), shift


@partial(jax.jit, static_argnames="num_segments")
def segment_softmax(
    log_values: Float[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Float[Array, " n"]:
    """exp of the values as shares of their segment's sum, zero where that sum is zero."""
    values, _ = scaled_exp_of_segments(log_values, segments, num_segments)
    totals = segment_sum(values, segments, num_segments)
    shares = values / spread(jnp.where(totals == 0, 1.0, totals), segments)
    if not are_masked(len(values), num_segments):
        # Otherwise XLA takes the totals by a scatter, one particle after the other.
        shares = stored(shares)
    # As in `softmax`: without a gradient at -inf.
    return jnp.where(log_values == -jnp.inf, 0.0, shares)


def segment_argmax(
    values: Float[Array, " n"], segments: Int[Array, " n"], num_segments: int
) -> Int[Array, " num_segments"]:
    """The index of the largest value in each segment, any index where it is empty."""
    n = values.shape[0]
    values = jax.lax.stop_gradient(values)  # an index has no derivative
    limits = jnp.finfo(values.dtype)
    values = jnp.clip(values, limits.min, limits.max)
    largest = segment_reduce("max", values, segments, num_segments, float(limits.min))
    is_largest = values >= spread(largest, segments)
    index = jnp.where(is_largest, jnp.arange(n, dtype=jnp.int32), n - 1)
    if not are_masked(n, num_segments):
        index = stored(index)
    return segment_reduce("min", index, segments, num_segments, n - 1)


def first_places(segments: Int[Array, " n"], num_segments: int) -> Int[Array, " num_segments"]:
    """The first index with each segment's label, n - 1 for a label that does not occur."""
    n = segments.shape[0]
    return segment_reduce("min", jnp.arange(n, dtype=jnp.int32), segments, num_segments, n - 1)
