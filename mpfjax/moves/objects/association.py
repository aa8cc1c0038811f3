"""Data association: joint probabilities of pairs by loopy belief propagation."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mpfjax.operations.logarithms import log_or_nothing, without_gradient

_ROUNDS, _SETTLED = 100, 1e-3  # most rounds of messages, and the relative change that ends them
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
    missed, alone = missed + _LEAST, alone + _LEAST
    constants = without_gradient((pairs, missed, alone))
    replies = iterate_replies(*constants)
    to_columns, to_rows = _claims(replies, *constants[:2]), replies
    log_total = (
        jnp.sum(jnp.log(missed + jnp.sum(pairs * to_rows, axis=1)))
        + jnp.sum(jnp.log(alone + jnp.sum(to_columns, axis=0)))
        - jnp.sum(jnp.logaddexp(0.0, log_or_nothing(to_columns) + jnp.log(to_rows)))
    )
    for _ in range(_FOLLOWED):
        replies = _next_replies(replies, pairs, missed, alone)
    row_sums = missed + jnp.sum(pairs * replies, axis=1)
    column_sums = alone + jnp.sum(_claims(replies, pairs, missed), axis=0)
    return Association(replies, row_sums, column_sums, log_total)


def iterate_replies(pairs: Any, missed: Any, alone: Any) -> Any:
    """The messages from columns to rows, once they settle; of arrays of JAX or of NumPy."""

    def goes_on(carry: tuple) -> Any:
        return (carry[0] < _ROUNDS) & (carry[1] > _SETTLED)

    def next_round(carry: tuple) -> tuple:
        number, _, replies = carry
        new = _next_replies(replies, pairs, missed, alone)
        return number + 1, (abs(new - replies) / new).max(initial=0.0), new

    start = (0, pairs.dtype.type(1), 0 * pairs + 1 / alone[None])
    loop = jax.lax.while_loop if isinstance(pairs, jax.Array) else _while
    return loop(goes_on, next_round, start)[-1]


def _while(goes_on: Callable, advanced: Callable, carry: tuple) -> tuple:
    while goes_on(carry):
        carry = advanced(carry)
    return carry


def _claims(replies: Any, pairs: Any, missed: Any) -> Any:
    return pairs / (missed[:, None] + _sums_of_others(pairs * replies, axis=1))


def _next_replies(replies: Any, pairs: Any, missed: Any, alone: Any) -> Any:
    return 1 / (alone[None] + _sums_of_others(_claims(replies, pairs, missed), axis=0))


def _sums_of_others(values: Any, axis: int) -> Any:
    """Sums of each row (1) or column (0) without the entry itself, which may be most of it."""
    totals = values.sum(axis=axis, keepdims=True)
    is_most = values > 0.5 * totals
    where = jnp.where if isinstance(values, jax.Array) else np.where
    rest = where(is_most, 0.0, values).sum(axis=axis, keepdims=True)
    return where(is_most, rest, totals - values)
