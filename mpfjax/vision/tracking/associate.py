"""Data association: costs of pairs, their joint probabilities, and who has which detection."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.special import expit

from mpfjax.moves.objects.association import iterate_replies
from mpfjax.vision.tracking.gaussian import Gaussian
from mpfjax.vision.tracking.pairs import Pairs, intervals

_FREEDOM = 4.0  # degrees, of Student's distribution of gaps
_COLOUR_COST, _UNDECIDED = 14.0, 0.25  # of B², and where it is evidence neither for nor against
_ADAPTATION = 0.14  # the share of a frame in an object's colours
_LEAST = 1e-30  # a row without a pair weighs at least this beside its best pair
_WIDEST = -0.5  # log |S| counts as at most this: a detection at the prediction forms a pair
TEMPERATURE = 2.0  # above 1 it allows for cues that are not independent


def compatible(
    a: Int[np.ndarray, "*#classes"], b: Int[np.ndarray, "*#classes"]
) -> Bool[np.ndarray, "*classes"]:
    """Whether classes are the same, or one of them is 0 for none."""
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
) -> Pairs:
    """-2 log p of each detection under each prediction, up to a constant, with lengths in boxes.

    Student's density with ν = 4 degrees of freedom: (ν + 4) log(1 + |d - μ|² / ν) + log |S|. What
    has been unseen for long has a large |S|, and less of a claim. `beside`: what pairs cost beside
    distance, added to it. `others`: the cost that stands for the density of detections of nobody.
    Pairs that x or y alone put above a cost of 0 are none.
    """
    unit, place = predicted.unit, predicted.place
    total = predicted.var_place + (unit * errors) ** 2
    power = _FREEDOM + total.shape[1]
    volumes = np.minimum(np.sum(np.log(total / unit**2), axis=1) + others, _WIDEST)
    most = _FREEDOM * np.expm1((-volumes - np.min(beside, initial=0.0)) / power)
    # Most objects and detections are far apart: only near ones are worth all coordinates.
    reach = np.sqrt(np.maximum(most, 0.0) * total[:, :2].T)
    rows, columns = intervals(place[:, 0] - reach[0], place[:, 0] + reach[0], places[:, 0])
    near = np.abs(places[columns, 1] - place[rows, 1]) < reach[1, rows]
    rows, columns = rows[near], columns[near]
    gaps = places[columns] - place[rows]
    tails = power * np.log1p(np.sum(gaps**2 / total[rows], axis=1) / _FREEDOM)
    values = tails + volumes[rows] + beside[rows, columns]
    return Pairs(rows, columns, values, (len(place), len(places)))


def marginals(log_odds: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m d"]:
    """The probability of each pair, where each row and each column is in at most one pair.

    An assignment has the weight Π exp(log_odds) over its pairs; a row or column without a pair
    contributes a factor of 1. The marginals are those of `mpfjax.moves.objects.association`.
    """
    highest = np.maximum(np.max(log_odds, axis=1, initial=0.0), 0.0)
    pairs, missed = np.exp(log_odds - highest[:, None]), np.exp(-highest) + _LEAST
    weighed = pairs * iterate_replies(pairs, missed, np.ones(pairs.shape[1]))
    return weighed / (missed + np.sum(weighed, axis=1))[:, None]


def probabilities(cost: Pairs, temperature: float = TEMPERATURE) -> Float[np.ndarray, " p"]:
    """The marginals of pairs by their costs, -2 log p; a row without a pair costs nothing."""
    log_odds = -cost.values / (2 * temperature)
    probability = expit(log_odds)
    rivals = cost.rivals
    block, rows, columns = cost._replace(values=log_odds).at(rivals).block(-np.inf)
    probability[rivals] = marginals(block)[rows, columns]
    return probability


def one_to_one(cost: Pairs) -> Int[np.ndarray, " m"]:
    """A column for each row at the least total cost; -1 for none, at cost 0."""
    # A pair that costs more than none is as good as none, and one without rivals is chosen.
    cost = cost.at(cost.values < 0)
    source, rivals = np.full(cost.shape[0], -1), cost.rivals
    source[cost.rows[~rivals]] = cost.columns[~rivals]
    pairs = cost.at(rivals)
    block, rows, columns = pairs.block(0.0)
    chosen = np.zeros(block.shape, bool)
    chosen[linear_sum_assignment(block)] = True
    chosen = chosen[rows, columns]
    source[pairs.rows[chosen]] = pairs.columns[chosen]
    return source
