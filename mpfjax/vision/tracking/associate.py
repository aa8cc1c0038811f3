"""Data association: costs of pairs, their joint probabilities, and who has which detection."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.special import expit

from mpfjax.moves.objects.association import iterate_replies
from mpfjax.vision.tracking.gaussian import Gaussian
from mpfjax.vision.tracking.pairs import Flags, Integers, Pairs, intervals
from mpfjax.vision.tracking.scores import KEPT, PRIOR

_FREEDOM = 4.0  # degrees, of Student's distribution of gaps
_COLOUR_COST, _UNDECIDED = 14.0, 0.25  # of B², and where it is evidence neither for nor against
_ADAPTATION = 0.14  # the share of a frame in an object's colours
_LEAST = 1e-30  # a row without a pair weighs at least this beside its best pair
_WIDEST = -0.5  # log |S| counts as at most this: a detection at the prediction forms a pair
_MOST_UNLIKE = 8.0  # at most the cost of vectors: some are of something else than their box
_LEAST_VARIANCE = 1e-3  # of distances between vectors
_MARGIN = 6.0  # around all points, in deviations of their errors
# Of m objects and d detections: rows of m, rows of d, and values of pairs.
Table, Places = Float[np.ndarray, "m bins"], Float[np.ndarray, "d k"]
Costs = Float[np.ndarray, "m d"]


def compatible(
    a: Int[np.ndarray, "*#classes"], b: Int[np.ndarray, "*#classes"]
) -> Bool[np.ndarray, "*classes"]:
    """Whether classes are the same, or one of them is 0 for none."""
    return (a == b) | (a == 0) | (b == 0)


def unlikeness(descriptors: Float[np.ndarray, "d bins"], references: Table) -> Costs:
    """The cost of colours: that of B² = 1/4 is 0, as it is where there are none.

    B² is the squared Bhattacharyya distance of histograms, the mean over the bands of a box.
    """
    total = np.maximum(np.sum(references, axis=1)[:, None], 1.0)
    alike = np.sqrt(references) @ np.sqrt(descriptors).T / total
    cost = _COLOUR_COST * (1 - alike - _UNDECIDED)
    return np.where(np.any(references, axis=1, keepdims=True), cost, 0.0)


def learned_descriptors(references: Table, descriptors: Table, alone: Flags) -> Table:
    """The histograms, or vectors, after those of the detections, 0 where there is none.

    The first one counts whole; later ones do where the object is `alone`: objects in contact would
    learn each other's colours.
    """
    first, rate = ~references.any(axis=1), np.where(alone, _ADAPTATION, 0.0)
    rate = np.where(descriptors.any(axis=1), np.where(first, 1.0, rate), 0.0)[:, None]
    return (1 - rate) * references + rate * descriptors


class Likeness(NamedTuple):
    """Cosine distances of objects' vectors to those of their detections, and of others.

    - `number`, `total`, `squares`: (2,), how many there were, their sum, and that of their squares;
      to the same object's first. Without any, vectors tell nothing.
    """

    number: Float[np.ndarray, "2"] = np.zeros(2)
    total: Float[np.ndarray, "2"] = np.zeros(2)
    squares: Float[np.ndarray, "2"] = np.zeros(2)

    def cost(self, distances: Costs) -> Costs:
        """-2 log of the odds that a pair at this distance is of the same object, beside motion.

        Distances of both kinds are normal with the same variance, so that the logarithm is linear,
        and weighs the more the further their means are apart (Fisher's discriminant). It counts as
        n / (n + 5) of it after n pairs, 0 where the distance is not known, and at most 8.
        """
        number = np.maximum(self.number, 1.0)
        means = self.total / number
        variance = np.mean(np.maximum(self.squares / number - means**2, 0.0)) + _LEAST_VARIANCE
        information = self.number.min() / (self.number.min() + PRIOR)
        slope = information * max(means[1] - means[0], 0.0) / variance
        cost = np.clip(2 * slope * (distances - means.mean()), -_MOST_UNLIKE, _MOST_UNLIKE)
        return np.where(np.isfinite(distances), cost, 0.0)

    def after(self, distances: Costs, same: Bool[np.ndarray, "m d"]) -> "Likeness":
        """With a frame's distances, of objects that have a detection: `same` says which."""
        had = np.any(same, axis=1, keepdims=True) & np.isfinite(distances)
        kinds = [distances[had & which] for which in (same, ~same)]
        sums = np.array([(len(kind), kind.sum(), (kind**2).sum()) for kind in kinds]).T
        return Likeness(*(KEPT * old + new for old, new in zip(self, sums, strict=True)))


def cosine_distances(
    references: Float[np.ndarray, "m e"], descriptors: Float[np.ndarray, "d e"]
) -> Float[np.ndarray, "m d"]:
    """1 - cos of the angle of vectors; NaN where one of them is zero, as where none is known."""
    with np.errstate(invalid="ignore", divide="ignore"):
        references, descriptors = (
            each / np.linalg.norm(each, axis=1, keepdims=True) for each in (references, descriptors)
        )
    return 1 - references @ descriptors.T


class Clutter(NamedTuple):
    """Points without an object, and the area that they come from, in deviations of their errors.

    - `corners`: (2, 2), the lowest and the highest of all points so far; none before any.
    - `number`: of points of nobody, in so many `frames`; one in one frame before any.
    """

    corners: Float[np.ndarray, "c 2"] = np.zeros((0, 2))
    number: float = 1.0
    frames: float = 1.0

    def after(self, places: Float[np.ndarray, "d k"], number: int) -> "Clutter":
        """With a frame's detections, so many of them of nobody."""
        corners = np.concatenate([self.corners, places[:, :2]])
        if len(corners):
            corners = np.array([corners.min(axis=0), corners.max(axis=0)])
        return Clutter(corners, KEPT * self.number + number, KEPT * self.frames + 1)

    @property
    def cost(self) -> float:
        """2 log(2π λ), λ the density: what takes a pair's cost to that of a point of nobody."""
        sides = np.sum(np.diff(self.corners, axis=0), axis=0) + 2 * _MARGIN
        return 2 * float(np.log(2 * np.pi * self.number / self.frames / np.prod(sides)))


def mahalanobis(
    predicted: Gaussian, errors: np.ndarray, places: Places, beside: Costs, others: float = 0.0
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


def marginals(log_odds: Costs) -> Costs:
    """The probability of each pair, where each row and each column is in at most one pair.

    An assignment has the weight Π exp(log_odds) over its pairs; a row or column without a pair
    contributes a factor of 1. The marginals are those of `mpfjax.moves.objects.association`.
    """
    highest = np.maximum(np.max(log_odds, axis=1, initial=0.0), 0.0)
    pairs, missed = np.exp(log_odds - highest[:, None]), np.exp(-highest) + _LEAST
    weighed = pairs * iterate_replies(pairs, missed, np.ones(pairs.shape[1]))
    return weighed / (missed + np.sum(weighed, axis=1))[:, None]


def probabilities(cost: Pairs, temperature: float) -> Float[np.ndarray, " p"]:
    """The marginals of pairs by their costs, -2 log p; a row without a pair costs nothing.

    A `temperature` above 1 allows for cues that are not independent.
    """
    log_odds = -cost.values / (2 * temperature)
    probability = expit(log_odds)
    rivals = cost.rivals
    block, rows, columns = cost._replace(values=log_odds).at(rivals).block(-np.inf)
    probability[rivals] = marginals(block)[rows, columns]
    return probability


def one_to_one(cost: Pairs) -> Integers:
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
