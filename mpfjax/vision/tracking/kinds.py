"""What detections are: boxes, or points with an error of a given standard deviation."""

from typing import NamedTuple

import numpy as np

from mpfjax.vision.tracking.associate import TEMPERATURE


class Kind(NamedTuple):
    """All in which tracking boxes differs from tracking points.

    - `coordinates`: of a detection, (x, y, w, h) or (x, y).
    - `unit`: in pixels, the length in which places are given; 1 of boxes, which have sizes.
    - `temperature`: of the association; 1 where distance is the only cue.
    - `odds`: of an object at its first detection to those that confirm it, in logarithms; 0 of
      boxes, which two strong detections confirm.
    - `missed`: the log-probability that an object has no detection, in these odds.
    """

    coordinates: int = 4
    unit: float = 1.0
    temperature: float = TEMPERATURE
    odds: float = 0.0
    missed: float = 0.0

    @classmethod
    def of(cls, point_deviation: float | None) -> "Kind":
        """Boxes where there is no deviation.

        Before any point an object has odds of 1 to 10, and odds of 20 to 1 confirm it; one of its
        points in seven is missed.
        """
        if point_deviation is None:
            return BOXES
        return cls(2, float(point_deviation), 1.0, -np.log(10) - np.log(20), -np.log(7))

    @property
    def has_boxes(self) -> bool:
        """Whether detections have sizes, and so colours, and overlaps that tell cameras' motion."""
        return self.coordinates == 4


BOXES = Kind()
