"""Which detections, by score, prove to be of objects: by what becomes of their chains."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mpfjax.operations.floats import default_float
from mpfjax.operations.indexing import take
from mpfjax.vision.tracking.births import matched, stronger
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.observation import overlap

_BINS = 10  # of shares of a sure detection's score
_CENTRES = (np.arange(_BINS) + 0.5) / _BINS
_SURE = 0.9  # a chain that reaches this share is an object
_SLOPE = 0.15  # the prior odds are logistic in the share, of this scale
PRIOR = 5.0  # detections that the prior of each bin counts as
KEPT = 0.995  # kept from each frame to the next
_SAME, _DOUBLE = 0.3, 0.6  # least overlap of boxes in a chain, and of a box with its double
_GONE = 2  # longest gap in a chain, in frames


class Fates(NamedTuple):
    """Chains of detections that overlap from frame to frame, and counts from ended chains.

    - `boxes`: (c, 4), the last box of each chain; `unseen`: frames since its last detection.
    - `age`: frames since its first detection, which counts as one.
    - `sure`: whether it has proved to be an object; `pending`: (c, bins), its detections by share
      while it is not yet decided what they are.
    - `good`, `bad`: (bins,), detections of chains that proved to be objects, and of chains that
      ended before.
    """

    boxes: Float[Array, "c 4"]
    unseen: Int[Array, " c"]
    age: Int[Array, " c"]
    sure: Bool[Array, " c"]
    pending: Float[Array, "c bins"]
    good: Float[Array, " bins"]
    bad: Float[Array, " bins"]

    @classmethod
    def none(cls, num_chains: int) -> "Fates":
        """No chains yet, with room for this many."""
        bins = jnp.zeros(_BINS, default_float())
        return cls(
            jnp.zeros((num_chains, 4)),
            jnp.full(num_chains, _GONE, jnp.int32),
            jnp.zeros(num_chains, jnp.int32),
            jnp.zeros(num_chains, bool),
            jnp.zeros((num_chains, _BINS), default_float()),
            bins,
            bins,
        )

    def after(self, found: Detections, shares: Float[Array, " d"], lasting: int) -> "Fates":
        """Update with the detections of a frame, whose scores are these shares of a sure score.

        A chain is an object from a sure score on, or once it has lasted for `lasting` frames.
        """
        doubles = (overlap(found.boxes, found.boxes) > _DOUBLE) & stronger(found)
        single = found.valid & ~jnp.any(doubles & found.valid[:, None], axis=0)
        rows, goes_on = self._continued(found.boxes, single)
        taken = jnp.where(goes_on, rows, len(single))
        new = single & ~jnp.zeros_like(single).at[taken].set(True, mode="drop")
        begun, begins = matched(new, found, self.unseen >= _GONE)
        rows, seen = jnp.where(begins, begun, rows), goes_on | begins
        bins = jnp.clip((shares * _BINS).astype(jnp.int32), 0, _BINS - 1)
        one = jax.nn.one_hot(take(bins, rows), _BINS, dtype=self.pending.dtype)
        pending = self.pending + jnp.where(seen[:, None], one, 0.0)
        age = jnp.where(begins, 1, self.age + 1)
        proved = (take(shares, rows) >= _SURE) | (age >= lasting)
        sure = (self.sure & ~begins) | (seen & proved)
        unseen = jnp.where(seen, 0, jnp.minimum(self.unseen + 1, _GONE))
        ended = (unseen >= _GONE) & ~sure
        good = jnp.sum(jnp.where(sure[:, None], pending, 0.0), axis=0)
        bad = jnp.sum(jnp.where(ended[:, None], pending, 0.0), axis=0)
        return Fates(
            boxes=jnp.where(seen[:, None], take(found.boxes, rows), self.boxes),
            unseen=unseen,
            age=age,
            sure=sure,
            pending=jnp.where((sure | ended)[:, None], 0.0, pending),
            good=KEPT * self.good + good,
            bad=KEPT * self.bad + bad,
        )

    def _continued(
        self, boxes: Float[Array, "d 4"], single: Bool[Array, " d"]
    ) -> tuple[Int[Array, " c"], Bool[Array, " c"]]:
        """The detection that overlaps each chain most, and whether the two match mutually."""
        living = (self.unseen < _GONE)[:, None] & single[None]
        shares = jnp.where(living, overlap(self.boxes, boxes), 0.0)
        partner = jnp.argmax(shares, axis=1).astype(jnp.int32)
        mutual = take(jnp.argmax(shares, axis=0), partner) == jnp.arange(len(shares))
        return partner, mutual & (jnp.max(shares, axis=1) > _SAME)

    def strong_share(self, prior_share: Float[Array, ""]) -> Float[Array, ""]:
        """The share above which a detection is more probably an object than none.

        It is `prior_share` before anything is learned.
        """
        centres = jnp.asarray(_CENTRES, self.good.dtype)
        prior = jax.nn.sigmoid((centres - prior_share) / _SLOPE)
        number = self.good + self.bad + PRIOR
        odds = jax.scipy.special.logit(rising((self.good + PRIOR * prior) / number, number))
        above = jnp.argmax(odds >= 0)
        below = jnp.maximum(above - 1, 0)
        step = odds[above] - odds[below]
        part = jnp.where(step > 0, -odds[below] / jnp.where(step > 0, step, 1.0), 0.0)
        share = centres[below] + part * (centres[above] - centres[below])
        share = jnp.where(odds[0] >= 0, 0.0, share)
        return jnp.where(odds[-1] >= 0, jnp.minimum(share, _SURE), _SURE)


def rising(values: Float[Array, " k"], weights: Float[Array, " k"]) -> Float[Array, " k"]:
    """Isotonic regression: the nearest non-decreasing sequence, by weighted least squares.

    By its min-max formula (Barlow et al. 1972): entry i is the maximum over a ≤ i of the minimum
    over b ≥ i of the weighted mean of entries a to b.
    """
    sums = jnp.concatenate([jnp.zeros(1, values.dtype), jnp.cumsum(weights * values)])
    totals = jnp.concatenate([jnp.zeros(1, values.dtype), jnp.cumsum(weights)])
    begin, end = jnp.arange(len(values))[:, None], jnp.arange(len(values))[None]
    valid = begin <= end
    number = jnp.where(valid, totals[1:][None] - totals[:-1][:, None], 1.0)
    means = (sums[1:][None] - sums[:-1][:, None]) / number
    lowest = jax.lax.cummin(jnp.where(valid, means, jnp.inf), axis=1, reverse=True)
    return jnp.max(jnp.where(valid, lowest, -jnp.inf), axis=0)
