"""How densely points lie that are of no object yet."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mpfjax.vision.tracking.scores import KEPT

_MARGIN = 6.0  # around all points, in deviations of their errors


class Clutter(NamedTuple):
    """Points without an object, and the area that they come from, in deviations of their errors.

    - `low`, `high`: (2,), the corners of all points so far.
    - `number`: of points of nobody, in so many `frames`; one in one frame before any.
    """

    low: Float[np.ndarray, "2"] = np.full(2, np.inf)
    high: Float[np.ndarray, "2"] = np.full(2, -np.inf)
    number: float = 1.0
    frames: float = 1.0

    def after(self, points: Float[np.ndarray, "d 2"], number: int) -> "Clutter":
        """With a frame's points, so many of them of nobody."""
        low, high = np.min([self.low, *points], axis=0), np.max([self.high, *points], axis=0)
        return Clutter(low, high, KEPT * self.number + number, KEPT * self.frames + 1)

    @property
    def cost(self) -> float:
        """2 log(2π λ), λ the density: what takes a pair's cost to that of a point of nobody."""
        sides = np.maximum(self.high - self.low, 0.0) + 2 * _MARGIN
        return 2 * float(np.log(2 * np.pi * self.number / self.frames / np.prod(sides)))
