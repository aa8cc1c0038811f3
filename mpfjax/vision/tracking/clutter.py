"""How densely points lie that are of no object yet."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mpfjax.vision.tracking.scores import KEPT

_MARGIN = 6.0  # around all points, in deviations of their errors


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
