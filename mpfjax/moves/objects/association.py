"""Which measurement is whose: joint probabilities of pairs by loopy belief propagation."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.operations.logarithms import without_gradient

_ROUNDS, _SETTLED = 100, 1e-4  # most rounds of messages, and the relative change that ends them
_FOLLOWED = 5  # rounds that a derivative of the marginals follows; each shrinks what is left out
_LEAST = 1e-30  # weights of rows and columns alone count as at least this, and stay finite


class Association(NamedTuple):
    """The marginals of rows and columns in pairs, and the messages that they come from."""

    replies: Float[Array, "m k"]  # messages to rows: the less, the more other rows claim the column
    row_sums: Float[Array, " m"]  # over each row's choices, as the replies leave them
    column_sums: Float[Array, " k"]
    log_total: Float[Array, ""]  # log of the sum over all assignments, in Bethe's approximation


def associate(
    pairs: Float[Array, "m k"], missed: Float[Array, " m"], alone: Float[Array, " k"]
) -> Association:
    """Sum over the assignments in which each row and each column is in at most one pair.

    An assignment has the weight Π `pairs` over its pairs, times `missed` of each other row, times
    `alone` of each other column. The marginals are those of joint probabilistic data association
    (Fortmann et al. 1983), by messages from rows to columns and back (Williams and Lau 2014):
    pairs replies / row_sums for a pair, missed / row_sums, and alone / column_sums. The total is
    Bethe's (Vontobel 2013). All are exact where the possible pairs form no cycle. Otherwise pairs
    are overconfident, by up to .41 where each of two rows can go with each of two columns.

    The total is stationary in the messages, so that its derivative is exact for what is
    approximated; that of the marginals follows the last rounds.
    """
    missed, alone = jnp.maximum(missed, _LEAST), jnp.maximum(alone, _LEAST)
    settled = without_gradient((pairs, missed, alone))

    def claims(replies: Array, pairs: Array, missed: Array, alone: Array) -> Array:
        return pairs / (missed[:, None] + _sums_of_others(pairs * replies, axis=1))

    def next_replies(replies: Array, *weights: Array) -> Array:
        return 1 / (weights[2][None] + _sums_of_others(claims(replies, *weights), axis=0))

    def unsettled(carry: tuple) -> Bool[Array, ""]:
        return (carry[0] < _ROUNDS) & (carry[1] > _SETTLED)

    def next_round(carry: tuple) -> tuple:
        number, _, replies = carry
        changed = next_replies(replies, *settled)
        change = jnp.max(jnp.abs(changed - replies) / changed, initial=0.0)
        return number + 1, change, changed

    first = jnp.broadcast_to(1 / settled[2], pairs.shape)
    start = (0, jnp.ones((), pairs.dtype), first)
    replies = jax.lax.while_loop(unsettled, next_round, start)[-1]
    to_columns, to_rows = claims(replies, *settled), replies
    log_total = (
        jnp.sum(jnp.log(missed + jnp.sum(pairs * to_rows, axis=1)))
        + jnp.sum(jnp.log(alone + jnp.sum(to_columns, axis=0)))
        - jnp.sum(jnp.logaddexp(0.0, _log(to_columns) + jnp.log(to_rows)))
    )
    for _ in range(_FOLLOWED):
        replies = next_replies(replies, pairs, missed, alone)
    row_sums = missed + jnp.sum(pairs * replies, axis=1)
    column_sums = alone + jnp.sum(claims(replies, pairs, missed, alone), axis=0)
    return Association(replies, row_sums, column_sums, log_total)


def _log(values: Float[Array, "m k"]) -> Float[Array, "m k"]:
    return jnp.where(values > 0, jnp.log(jnp.where(values > 0, values, 1.0)), -jnp.inf)


def _sums_of_others(values: Float[Array, "m k"], axis: int) -> Float[Array, "m k"]:
    """Sums of each row (1) or column (0) without the entry itself, which may be most of it."""
    totals = jnp.sum(values, axis=axis, keepdims=True)
    is_most = values > 0.5 * totals
    rest = jnp.sum(jnp.where(is_most, 0.0, values), axis=axis, keepdims=True)
    return jnp.where(is_most, rest, totals - values)
