"""Data association: costs of pairs, their joint probabilities, and who has which detection."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mpfjax.vision.tracking.gaussian import Gaussian

_FREEDOM = 4.0  # degrees, of Student's distribution of gaps
_DIMENSIONS = 4
_COLOUR_COST, _UNDECIDED = 14.0, 0.25  # of B², and where it is evidence neither for nor against
_ADAPTATION = 0.14  # the share of a frame in an object's colours
_WIDEST = -0.5  # log |S| counts as at most this: a detection at the prediction forms a pair
_TEMPERATURE = 2.0  # above 1 it allows for cues that are not independent
_RAISE = 0.01  # of the price of a column, beyond what decides
_ROUNDS, _SETTLED = 15, 1e-3  # most iterations of messages, and the change that ends them
_RESOLVED = 1e-6  # odds of all others below this are not told from none


def stronger(scores: Float[Array, " d"], areas: Float[Array, " d"]) -> Bool[Array, "d d"]:
    """Whether the first of a pair has the higher score, or the same and is the larger."""
    index = jnp.arange(len(scores))
    s, t = scores[:, None], scores[None]
    a, b = areas[:, None], areas[None]
    first = (a > b) | ((a == b) & (index[:, None] < index[None]))
    return (s > t) | ((s == t) & first)


def compatible(a: Int[Array, " m"], b: Int[Array, " d"]) -> Bool[Array, "m d"]:
    """Whether classes are the same, or one of them is 0 for none."""
    a, b = a[:, None], b[None]
    return (a == b) | (a == 0) | (b == 0)


def unlikeness(
    seen: Float[Array, "d bins"] | None, known: Float[Array, "m bins"]
) -> Float[Array, "m d"] | float:
    """The cost of colours: that of B² = 1/4 is 0, as it is where there are none.

    B² is the squared Bhattacharyya distance of histograms, the mean over the bands of a box.
    """
    if seen is None:
        return 0.0
    alike = jnp.sqrt(known) @ jnp.sqrt(seen).T / jnp.maximum(jnp.sum(known, axis=1)[:, None], 1.0)
    cost = _COLOUR_COST * (1 - alike - _UNDECIDED)
    return jnp.where(jnp.any(known > 0, axis=1)[:, None], cost, 0.0)


def learned_colours(
    known: Float[Array, "m bins"], seen: Float[Array, "m bins"], alone: Bool[Array, " m"]
) -> Float[Array, "m bins"]:
    """The histograms after those of the detections, 0 where there is none.

    The first one counts whole; later ones do where the object is `alone`: objects in contact would
    learn each other's colours.
    """
    is_known = jnp.any(known > 0, axis=1)
    rate = jnp.where(is_known, jnp.where(alone, _ADAPTATION, 0.0), 1.0)
    rate = jnp.where(jnp.any(seen > 0, axis=1), rate, 0.0)[:, None]
    return (1 - rate) * known + rate * seen


def mahalanobis(
    predicted: Gaussian,
    errors: Float[Array, "4"],
    places: Float[Array, "d 4"],
    slack: Float[Array, "2"] | None = None,
) -> Float[Array, "m d"]:
    """-2 log p of each detection under each prediction, up to a constant, with lengths in boxes.

    Student's density with ν = 4 degrees of freedom: (ν + 4) log(1 + |d - μ|² / ν) + log |S|. What
    has been unseen for long has a large |S|, and less of a claim. `slack`: deviations of x and y,
    in pixels, to be added to those of all predictions.
    """
    unit = predicted.unit
    total = predicted.var_place + (unit * errors[None]) ** 2
    if slack is not None:
        total = total + jnp.pad(slack, (0, 2))[None] ** 2
    gaps = places[None] - predicted.place[:, None]
    squares = jnp.sum(gaps**2 / total[:, None], axis=2)
    volumes = jnp.sum(jnp.log(total / unit**2), axis=1)
    tails = (_FREEDOM + _DIMENSIONS) * jnp.log1p(squares / _FREEDOM)
    return tails + jnp.minimum(volumes, _WIDEST)[:, None]


def marginals(log_odds: Float[Array, "m d"]) -> Float[Array, "m d"]:
    """The probability of each pair, where each row and each column is in at most one pair.

    An assignment has the weight Π exp(log_odds) over its pairs; a row or column without a pair
    contributes a factor of 1. The marginals of this joint distribution (joint probabilistic data
    association, Fortmann et al. 1983) are computed by loopy belief propagation with messages from
    rows to columns and back (Williams and Lau 2014). They are exact where the possible pairs form
    no cycle. Otherwise they are overconfident: up to .3 where each of two rows can go with each of
    two columns.
    """
    highest = jnp.maximum(jnp.max(log_odds, axis=1, keepdims=True, initial=0.0), 0.0)
    odds, none = jnp.exp(log_odds - highest), jnp.exp(-highest)

    def others(weighed: Float[Array, "m d"]) -> Float[Array, "m d"]:
        return jnp.maximum(none + jnp.sum(weighed, axis=1, keepdims=True) - weighed, _RESOLVED)

    def reply(carry: tuple) -> tuple:
        number, _, back = carry
        forth = odds / others(odds * back)
        reply = 1 / (1 + jnp.maximum(jnp.sum(forth, axis=0, keepdims=True) - forth, 0.0))
        return number + 1, jnp.max(jnp.abs(reply - back), initial=0.0), reply

    def unsettled(carry: tuple) -> Bool[Array, ""]:
        return (carry[0] < _ROUNDS) & (carry[1] > _SETTLED)

    *_, back = jax.lax.while_loop(unsettled, reply, (0, jnp.ones(()), jnp.ones_like(odds)))
    weighed = odds * back
    return weighed / (none + jnp.sum(weighed, axis=1, keepdims=True))


def probabilities(cost: Float[Array, "m d"]) -> Float[Array, "m d"]:
    """The marginals of pairs by their costs, -2 log p; a row without a pair costs nothing."""
    return marginals(-cost / (2 * _TEMPERATURE))


def argmax_pairs(value: Float[Array, "m d"]) -> Int[Array, " m"]:
    """The column of each row where the two are each other's largest value above 0, else -1."""
    m, d = value.shape
    rows = jnp.arange(m, dtype=jnp.int32)[:, None]
    columns = jnp.arange(d, dtype=jnp.int32)[None]
    highest = (value > 0) & (value == jnp.max(value, axis=1, keepdims=True, initial=0.0))
    highest &= value == jnp.max(value, axis=0, keepdims=True, initial=0.0)
    first = jnp.min(jnp.where(highest, columns, d), axis=1)
    mine = highest & (columns == first[:, None])
    owner = jnp.min(jnp.where(mine, rows, m), axis=0)
    kept = jnp.any(mine & (owner[None] == rows), axis=1)
    return jnp.where(kept, first, -1).astype(jnp.int32)


def one_to_one(cost: Float[Array, "m d"]) -> Int[Array, " m"]:
    """A column for each row at the least total cost, within hundredths; -1 for none, at cost 0.

    By an auction (Bertsekas 1988), all rows at once: a row without a column bids for the one that
    it gains most from, by as much as it gains more than from the next best, and a hundredth.
    """
    m, d = cost.shape
    rows, columns = jnp.arange(m, dtype=jnp.int32), jnp.arange(d, dtype=jnp.int32)[None]

    def bid(carry: tuple) -> tuple:
        prices, source, _ = carry
        values = -cost - prices[None]
        best = jnp.max(values, axis=1, initial=-jnp.inf)
        first = jnp.min(jnp.where(values == best[:, None], columns, d), axis=1)
        others = jnp.where(columns == first[:, None], 0.0, values)
        offer = best - jnp.max(others, axis=1, initial=0.0) + _RAISE
        wants = jnp.where((best > 0) & (source < 0), first, d)
        highest = jnp.zeros_like(prices).at[wants].max(offer, mode="drop")
        leads = wants == jnp.where(offer >= highest[jnp.minimum(first, d - 1)], first, -1)
        winner = jnp.full(d, m, jnp.int32).at[jnp.where(leads, wants, d)].min(rows, mode="drop")
        lost = (source >= 0) & (winner[jnp.maximum(source, 0)] < m)
        won = leads & (winner[jnp.minimum(first, d - 1)] == rows)
        source = jnp.where(won, first, jnp.where(lost, -1, source))
        return prices + highest, source, jnp.any(won)

    start = jnp.zeros(d, cost.dtype), jnp.full(m, -1, jnp.int32), jnp.asarray(True)
    return jax.lax.while_loop(lambda carry: carry[2], bid, start)[1]


def seated(
    wanted: Bool[Array, " d"], stronger: Bool[Array, "d d"], free: Bool[Array, " m"]
) -> Int[Array, " m"]:
    """The wanted row that each free place takes, the strongest first, -1 where it takes none."""
    number = jnp.sum(
        wanted[:, None] & stronger, axis=0, dtype=jnp.int32
    )  # of wanted ones before each
    place = jnp.cumsum(free, dtype=jnp.int32) - 1
    match = free[:, None] & wanted[None] & (place[:, None] == number[None])
    rows = jnp.where(match, jnp.arange(len(wanted), dtype=jnp.int32)[None], -1)
    return jnp.max(rows, axis=1, initial=-1)
