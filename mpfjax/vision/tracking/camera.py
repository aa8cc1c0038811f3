"""The motion that all objects have in common: the camera's."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mpfjax.vision.tracking.associate import mahalanobis
from mpfjax.vision.tracking.gaussian import Gaussian
from mpfjax.vision.tracking.pairs import Integers

_FREEDOM = 4.0  # degrees, of Student's distribution of what objects do on their own
_ROUNDS = 5
_RATE = 0.03  # of forgetting
_STILL = 0.02  # the deviation of the camera's motion before anything is known, in boxes
_LEAST, _MOST = 1e-3, 0.5
_LEADERS, _NEAREST = 8, 2  # whose detections, and how many of each, a jolt is sought by
_PRIOR = 5.0  # frames of many objects that the first deviation counts as
Pair, Gaps = Float[np.ndarray, "2"], Float[np.ndarray, "n 2"]  # along x and y
Sides, Costs = Float[np.ndarray, "4"], Float[np.ndarray, "m d"]


class CameraState(NamedTuple):
    """Standard deviations of the camera's motion along (x, y), in boxes.

    - `deviations`: of all of it; `left`: of what the pixels do not tell.
    - `weight`: how many frames of many objects they are the means of.
    - `shift`: the latest, in boxes; `squares`, `products`: means over time of its square, and of
      its product with the shift before.
    """

    deviations: Pair = np.full(2, _STILL)
    left: Pair = np.full(2, _STILL)
    weight: float = _PRIOR
    shift: Pair = np.zeros(2)
    squares: Pair = np.full(2, _STILL**2)
    products: Pair = np.zeros(2)

    @property
    def steady(self) -> Pair:
        """The share of a shift that the next one repeats: the correlation of successive shifts.

        A camera that pans gives all objects a velocity. When it stops, the shift makes up for that
        velocity in each frame, the innovations are zero, and nothing would correct the two: this
        share of the shift is added to the velocities.
        """
        return np.clip(self.products / self.squares, 0.0, 1.0)

    def after(
        self, gaps: Gaps, variances: Gaps, displacements: Gaps, is_known: bool, box: Pair
    ) -> tuple["CameraState", Pair]:
        """The shift that all objects have in common, and the deviations after it.

        A camera that shakes or turns shifts all objects at once. Object m has an innovation, or
        gap, e_m with variance S_m. The model is

            e_m = c + noise,  c ~ N(0, σ_c²)

        with heavy-tailed noise for objects that move on their own. The posterior mean of c is
        computed by iterated weighted least squares, with Student's weights. σ_c² is the mean
        product of the innovations of different objects: their own noises are independent.
        `displacements` is by how much a jolt, or the motion from pixels, has moved each object:
        where the latter is `is_known`, c is what is left. `box` is the size of the mean box.
        """
        prior = ((self.left if is_known else self.deviations) * box) ** 2
        shift = np.zeros(2)
        for _ in range(_ROUNDS):
            trust = (_FREEDOM + 1) / (_FREEDOM * variances + (gaps - shift) ** 2)
            shift = np.sum(trust * gaps, axis=0) / (np.sum(trust, axis=0) + 1 / prior)
        n = len(gaps)
        information = max(n - 1, 0) / (n + 3)  # two objects tell less than many
        weight = min(self.weight + information, 1 / _RATE)
        deviations = _learn(self.deviations, (gaps + displacements) / box, information / weight)
        left = _learn(self.left, gaps / box, information / weight) if is_known else self.left
        now = shift / box
        squares, products = (
            (1 - _RATE) * mean + _RATE * now * other
            for mean, other in ((self.squares, now), (self.products, self.shift))
        )
        return CameraState(deviations, left, weight, now, squares, products), shift


def find_jolt(
    objects: Gaussian,
    ages: Integers,
    errors: Sides,
    places: Float[np.ndarray, "d 4"],
    unlike: Costs,
    num_near: int,
) -> Pair:
    """The shift of a jolt that leaves most objects without a detection, zero if there was none.

    `objects` were detected lately, the longest known first, each in so many frames (`ages`). At
    most half of them, `num_near`, have a detection near them; `unlike` is what pairs cost beside
    distance. The shifts that bring one of the eight longest known to one of the two detections next
    to it are tried: a camera moves all by the same. The one that explains most frames counts, if it
    explains three quarters of them, and two objects more than none does.
    """

    def ages_near(shift: np.ndarray) -> Integers:
        cost = mahalanobis(objects.shift(shift), errors, places, unlike)
        return ages[np.unique(cost.rows[cost.values < 0])]

    gaps = places[None, :, :2] - objects.place[:_LEADERS, None, :2]
    far = np.sum((gaps / objects.unit[:_LEADERS, None, :2]) ** 2, axis=2) + unlike[:_LEADERS]
    nearest = np.argsort(far, axis=1, kind="stable")[:, :_NEAREST]
    shifts = np.take_along_axis(gaps, nearest[..., None], axis=1).reshape(-1, 2)
    most, best = np.zeros(0, int), np.zeros(2)
    for shift in shifts:
        near = ages_near(shift)
        if near.sum() > most.sum():
            most, best = near, shift
    is_jolt = most.sum() >= 0.75 * ages.sum() and len(most) >= num_near + 2
    return best if is_jolt else np.zeros(2)


def _learn(deviations: Pair, gaps: Gaps, rate: float) -> Pair:
    """The deviations after a frame with n innovations, in boxes."""
    n = len(gaps)
    products = np.sum(gaps, axis=0) ** 2 - np.sum(gaps**2, axis=0)
    products = np.clip(products / max(n * (n - 1), 1), -(_MOST**2), _MOST**2)
    return np.sqrt(np.clip((1 - rate) * deviations**2 + rate * products, _LEAST**2, _MOST**2))
