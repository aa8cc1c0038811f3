"""The motion that all objects have in common: the camera's."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mpfjax.vision.tracking.associate import mahalanobis
from mpfjax.vision.tracking.gaussian import Gaussian
from mpfjax.vision.tracking.pairs import Pairs

_FREEDOM = 4.0  # degrees, of Student's distribution of what objects do on their own
_ROUNDS = 5
_RATE = 0.03  # of forgetting
_STILL = 0.02  # the deviation of the camera's motion before anything is known, in boxes
_LEAST, _MOST = 1e-3, 0.5
_LEADERS, _NEAREST = 8, 2  # whose detections, and how many of each, a jolt is sought by
_PRIOR = 5.0  # frames of many objects that the first deviation counts as


class CameraState(NamedTuple):
    """Standard deviations of the camera's motion along (x, y), in boxes.

    - `deviations`: of all of it; `left`: of what the pixels do not tell.
    - `weight`: how many frames of many objects they are the means of.
    """

    deviations: Float[np.ndarray, "2"] = np.full(2, _STILL)
    left: Float[np.ndarray, "2"] = np.full(2, _STILL)
    weight: float = _PRIOR

    def after(
        self,
        predicted: Gaussian,
        displacements: Float[np.ndarray, "#m 2"],
        is_known: bool,
        cost: Pairs,
        errors: Float[np.ndarray, "4"],
        places: Float[np.ndarray, "d 4"],
        box: Float[np.ndarray, "2"],
    ) -> tuple["CameraState", Float[np.ndarray, "2"]]:
        """The shift that all objects have in common, and the deviations after it.

        A camera that shakes or turns shifts all objects at once. An object and a detection form a
        pair where each has its least cost, below 0, with the other. Pair m has an innovation e_m
        with variance S_m. The model is

            e_m = c + noise,  c ~ N(0, σ_c²)

        with heavy-tailed noise for objects that move on their own. The posterior mean of c is
        computed by iterated weighted least squares, with Student's weights. σ_c² is the mean
        product of the innovations of different objects: their own noises are independent.
        `displacements` is by how much a jolt, or the motion from pixels, has moved each object:
        where the latter is `is_known`, c is what is left.
        """
        partner = cost._replace(values=-cost.values).partners
        rows = np.flatnonzero(partner >= 0)
        gaps = places[partner[rows], :2] - predicted.place[rows, :2]
        variances = (predicted.var_place + (predicted.unit * errors) ** 2)[rows, :2]
        prior = ((self.left if is_known else self.deviations) * box) ** 2
        shift = np.zeros(2)
        for _ in range(_ROUNDS):
            trust = (_FREEDOM + 1) / (_FREEDOM * variances + (gaps - shift) ** 2)
            shift = np.sum(trust * gaps, axis=0) / (np.sum(trust, axis=0) + 1 / prior)
        n = len(rows)
        information = max(n - 1, 0) / (n + 3)  # two objects tell less than many
        weight = min(self.weight + information, 1 / _RATE)
        all_of_it = (gaps + np.broadcast_to(displacements, (len(partner), 2))[rows]) / box
        deviations = _learn(self.deviations, all_of_it, information / weight)
        left = _learn(self.left, gaps / box, information / weight) if is_known else self.left
        return CameraState(deviations, left, weight), shift


def find_jolt(
    predicted: Gaussian,
    errors: Float[np.ndarray, "4"],
    places: Float[np.ndarray, "d 4"],
    unlike: Float[np.ndarray, "m d"],
    num_strong: Int[np.ndarray, " m"],
    near: Bool[np.ndarray, " m"],
    counts: Bool[np.ndarray, " d"],
) -> Float[np.ndarray, "2"]:
    """The shift of a jolt that leaves most objects without a detection, zero if there was none.

    `unlike` is infinite where the two are no pair, `num_strong` is 0 for what was not seen lately,
    and `near` says which have a detection near them, and `counts` which detections are looked at.
    Where at most half of the objects have, the shifts that bring one of the eight longest seen to
    one of the two detections next to it are tried: a camera moves all by the same. The one that
    explains most counts, if that is three quarters of them, and two more than without it.
    """
    rows = np.flatnonzero(num_strong)
    rows = rows[np.argsort(-num_strong[rows], kind="stable")]
    still = int(near[rows].sum())
    if 2 * still > len(rows) or len(rows) < still + 2:
        return np.zeros(2)
    objects, unlike, places = predicted.at(rows), unlike[np.ix_(rows, counts)], places[counts]

    def count_explained(shift: np.ndarray) -> int:
        cost = mahalanobis(objects.shift(shift), errors, places, unlike)
        return len(np.unique(cost.rows[cost.values < 0]))

    leaders = slice(_LEADERS)
    gaps = places[None, :, :2] - objects.place[leaders, None, :2]
    far = np.sum((gaps / objects.unit[leaders, None, :2]) ** 2, axis=2) + unlike[leaders]
    nearest = np.argsort(far, axis=1, kind="stable")[:, :_NEAREST]
    shifts = np.take_along_axis(gaps, nearest[..., None], axis=1).reshape(-1, 2)
    numbers = np.array([count_explained(shift) for shift in shifts])
    best = int(np.argmax(numbers)) if len(numbers) else 0
    is_jolt = len(numbers) and numbers[best] > still + 1 and 4 * numbers[best] >= 3 * len(rows)
    return shifts[best] if is_jolt else np.zeros(2)


def _learn(
    deviations: Float[np.ndarray, "2"], gaps: Float[np.ndarray, "n 2"], rate: float
) -> Float[np.ndarray, "2"]:
    """The deviations after a frame with n innovations, in boxes."""
    n = len(gaps)
    products = np.sum(gaps, axis=0) ** 2 - np.sum(gaps**2, axis=0)
    products = np.clip(products / max(n * (n - 1), 1), -(_MOST**2), _MOST**2)
    return np.sqrt(np.clip((1 - rate) * deviations**2 + rate * products, _LEAST**2, _MOST**2))
