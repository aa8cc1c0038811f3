"""Vectors that a detector gives beside boxes, such as embeddings, and what their likeness tells."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mpfjax.vision.tracking.scores import KEPT, PRIOR

_MOST = 8.0  # cost of what is least alike: some vectors are of something else than their box
_LEAST = 1e-3  # variance of distances


class Likeness(NamedTuple):
    """Cosine distances of objects' vectors to those of their detections, and of others.

    - `number`, `total`, `squares`: (2,), how many there were, their sum, and that of their squares;
      to the same object's first. Without any, vectors tell nothing.
    """

    number: Float[np.ndarray, "2"] = np.zeros(2)
    total: Float[np.ndarray, "2"] = np.zeros(2)
    squares: Float[np.ndarray, "2"] = np.zeros(2)

    def cost(self, distances: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m d"]:
        """-2 log of the odds that a pair at this distance is of the same object, beside motion.

        Distances of both kinds are normal with the same variance, so that the logarithm is linear,
        and weighs the more the further their means are apart (Fisher's discriminant). It counts as
        n / (n + 5) of it after n pairs, 0 where the distance is not known, and at most 8.
        """
        number = np.maximum(self.number, 1.0)
        means = self.total / number
        variance = np.mean(np.maximum(self.squares / number - means**2, 0.0)) + _LEAST
        information = self.number.min() / (self.number.min() + PRIOR)
        slope = information * max(means[1] - means[0], 0.0) / variance
        cost = np.clip(2 * slope * (distances - means.mean()), -_MOST, _MOST)
        return np.where(np.isfinite(distances), cost, 0.0)

    def after(
        self, distances: Float[np.ndarray, "m d"], same: Bool[np.ndarray, "m d"]
    ) -> "Likeness":
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
