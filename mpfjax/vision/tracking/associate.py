"""Data association: costs of pairs, their joint probabilities, and who has which detection."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.special import expit

from mpfjax.moves.objects.association import iterate_replies
from mpfjax.vision.tracking.gaussian import Gaussian

_FREEDOM = 4.0  # degrees, of Student's distribution of gaps
_COLOUR_COST, _UNDECIDED = 14.0, 0.25  # of B², and where it is evidence neither for nor against
_ADAPTATION = 0.14  # the share of a frame in an object's colours
_LEAST = 1e-30  # a row without a pair weighs at least this beside its best pair
_WIDEST = -0.5  # log |S| counts as at most this: a detection at the prediction forms a pair
TEMPERATURE = 2.0  # above 1 it allows for cues that are not independent


def compatible(a: Int[np.ndarray, " m"], b: Int[np.ndarray, " d"]) -> Bool[np.ndarray, "m d"]:
    """Whether classes are the same, or one of them is 0 for none."""
    if not a.any() or not b.any():
        return np.ones((len(a), len(b)), bool)
    a, b = a[:, None], b[None]
    return (a == b) | (a == 0) | (b == 0)


def unlikeness(
    descriptors: Float[np.ndarray, "d bins"], references: Float[np.ndarray, "m bins"]
) -> Float[np.ndarray, "m d"]:
    """The cost of colours: that of B² = 1/4 is 0, as it is where there are none.

    B² is the squared Bhattacharyya distance of histograms, the mean over the bands of a box.
    """
    total = np.maximum(np.sum(references, axis=1)[:, None], 1.0)
    alike = np.sqrt(references) @ np.sqrt(descriptors).T / total
    cost = _COLOUR_COST * (1 - alike - _UNDECIDED)
    return np.where(np.any(references, axis=1, keepdims=True), cost, 0.0)


def learned_descriptors(
    references: Float[np.ndarray, "m bins"],
    descriptors: Float[np.ndarray, "m bins"],
    alone: Bool[np.ndarray, " m"],
) -> Float[np.ndarray, "m bins"]:
    """The histograms, or vectors, after those of the detections, 0 where there is none.

    The first one counts whole; later ones do where the object is `alone`: objects in contact would
    learn each other's colours.
    """
    first, rate = ~references.any(axis=1), np.where(alone, _ADAPTATION, 0.0)
    rate = np.where(descriptors.any(axis=1), np.where(first, 1.0, rate), 0.0)[:, None]
    return (1 - rate) * references + rate * descriptors


def mahalanobis(
    predicted: Gaussian,
    errors: Float[np.ndarray, " k"],
    places: Float[np.ndarray, "d k"],
    beside: Float[np.ndarray, "m d"],
    others: float = 0.0,
) -> Float[np.ndarray, "m d"]:
    """-2 log p of each detection under each prediction, up to a constant, with lengths in boxes.

    Student's density with ν = 4 degrees of freedom: (ν + 4) log(1 + |d - μ|² / ν) + log |S|. What
    has been unseen for long has a large |S|, and less of a claim. `beside`: what pairs cost beside
    distance, added to it. `others`: the cost that stands for the density of detections of nobody.
    Pairs that x alone puts above a cost of 0 cost infinitely.
    """
    unit, place = predicted.unit, predicted.place
    total = predicted.var_place + (unit * errors) ** 2
    power = _FREEDOM + total.shape[1]
    volumes = np.minimum(np.sum(np.log(total / unit**2), axis=1) + others, _WIDEST)
    most = _FREEDOM * np.expm1((-volumes - np.min(beside, initial=0.0)) / power)
    # Most objects and detections are far apart: only near ones are worth all coordinates.
    near = (places[:, 0] - place[:, :1]) ** 2 < (most * total[:, 0])[:, None]
    rows, columns = np.nonzero(near)
    gaps = places[columns] - place[rows]
    tails = power * np.log1p(np.sum(gaps**2 / total[rows], axis=1) / _FREEDOM)
    cost = np.full(near.shape, np.inf)
    cost[rows, columns] = tails + volumes[rows] + beside[rows, columns]
    return cost


def marginals(log_odds: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m d"]:
    """The probability of each pair, where each row and each column is in at most one pair.

    An assignment has the weight Π exp(log_odds) over its pairs; a row or column without a pair
    contributes a factor of 1. The marginals are those of `mpfjax.moves.objects.association`.
    """
    highest = np.maximum(np.max(log_odds, axis=1, initial=0.0), 0.0)
    pairs, missed = np.exp(log_odds - highest[:, None]), np.exp(-highest) + _LEAST
    weighed = pairs * iterate_replies(pairs, missed, np.ones(pairs.shape[1]))
    return weighed / (missed + np.sum(weighed, axis=1))[:, None]


def probabilities(
    cost: Float[np.ndarray, "m d"], temperature: float = TEMPERATURE
) -> Float[np.ndarray, "m d"]:
    """The marginals of pairs by their costs, -2 log p; a row without a pair costs nothing."""
    rows, columns = np.nonzero(np.isfinite(cost))
    probability = np.zeros(cost.shape)
    probability[rows, columns] = expit(-cost[rows, columns] / (2 * temperature))
    block = _rivals(cost.shape, rows, columns)
    probability[block] = marginals(-cost[block] / (2 * temperature))
    return probability


def _rivals(
    shape: tuple[int, ...], rows: Int[np.ndarray, " p"], columns: Int[np.ndarray, " p"]
) -> tuple[np.ndarray, ...]:
    """The block of the few pairs that have a rival: another one in their row or column."""
    others = np.bincount(rows, minlength=shape[0])[rows] > 1
    others |= np.bincount(columns, minlength=shape[1])[columns] > 1
    return np.ix_(np.unique(rows[others]), np.unique(columns[others]))


def argmax_pairs(value: Float[np.ndarray, "m d"]) -> Int[np.ndarray, " m"]:
    """The column of each row where the two are each other's largest value above 0, else -1."""
    m, d = value.shape
    if not m or not d:
        return np.full(m, -1)
    first, rows = np.argmax(value, axis=1), np.arange(m)
    mutual = (np.argmax(value, axis=0)[first] == rows) & (value[rows, first] > 0)
    return np.where(mutual, first, -1)


def one_to_one(cost: Float[np.ndarray, "m d"]) -> Int[np.ndarray, " m"]:
    """A column for each row at the least total cost; -1 for none, at cost 0."""
    source = np.full(len(cost), -1)
    # A pair that costs more than none is as good as none, and one without rivals is chosen.
    rows, columns = np.nonzero(cost < 0)
    source[rows] = columns
    block = _rivals(cost.shape, rows, columns)
    source[block[0][:, 0]] = -1
    rows, columns = linear_sum_assignment(np.minimum(cost[block], 0.0))
    paired = cost[block][rows, columns] < 0
    source[block[0][rows[paired], 0]] = block[1][0, columns[paired]]
    return source
