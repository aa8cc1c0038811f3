"""Strong and weak detections, told apart by what becomes of the chains that they form."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mpfjax.vision.tracking.associate import argmax_pairs, seated
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.gaussian import overlap, zeros

_REMEMBERED = 512
_HIGH = 0.9  # the quantile of the scores that is called a sure score
_BINS = 10  # of shares of a sure detection's score
_CENTRES = (np.arange(_BINS, dtype=np.float32) + np.float32(0.5)) / _BINS
_SURE = 0.9  # a chain that reaches this share is an object
STRONG, WEAK = 0.5, 0.2  # the shares that are strong before anything is learned, and that count
_SLOPE = 0.15  # the prior odds are logistic in the share, of this scale
PRIOR = 5.0  # detections that the prior of each bin counts as
KEPT = 0.995  # kept from each frame to the next
_SAME, _DUPLICATE = 0.3, 0.6  # least overlap of boxes in a chain, and of a box with its duplicate
_GONE = 2  # longest gap in a chain, in frames


class ScoreState(NamedTuple):
    """The scores so far, chains of detections that overlap from frame to frame, and their fates.

    - `recent`: (512,), the latest scores; `count`: how many there were in all.
    - `weak`, `strong`: the least score that counts, and from which on a detection is strong.
    - `boxes`: (c, 4), the last box of each chain; `unseen`: frames since its last detection.
    - `age`: frames since its first detection, which counts as one; `sure`: whether it has proved to
      be an object; `pending`: (c, bins), its detections by share while that is not decided.
    - `good`, `bad`: (bins,), detections of chains that proved to be objects, and of chains that
      ended before.
    """

    recent: Float[Array, " k"]
    count: Int[Array, ""]
    weak: Float[Array, ""]
    strong: Float[Array, ""]
    boxes: Float[Array, "c 4"]
    unseen: Int[Array, " c"]
    age: Int[Array, " c"]
    sure: Bool[Array, " c"]
    pending: Float[Array, "c bins"]
    good: Float[Array, " bins"]
    bad: Float[Array, " bins"]

    @classmethod
    def initial(cls, num_chains: int) -> "ScoreState":
        """No score seen yet, and no chain."""
        none = zeros(num_chains, dtype=np.int32)
        return cls(
            recent=zeros(_REMEMBERED),
            count=zeros(dtype=np.int32),
            weak=zeros(),
            strong=zeros(),
            boxes=zeros(num_chains, 4),
            unseen=none + _GONE,
            age=none,
            sure=none > 0,
            pending=zeros(num_chains, _BINS),
            good=zeros(_BINS),
            bad=zeros(_BINS),
        )

    def after(
        self,
        found: Detections,
        stronger: Bool[Array, "d d"],
        overlaps: Float[Array, "d d"],
        shift: Float[Array, "#c 2"],
        lasting: Int[Array, ""],
    ) -> "ScoreState":
        """Remember the frame's scores, continue the chains, and set the thresholds.

        Weak detections sustain a track; only strong ones start one (Zhang et al. 2022, ByteTrack).
        Scores are measured as shares of a sure score, the 0.9 quantile of the last 512, counted
        from zero or, where some scores are negative, from the lowest. If all are equal, all are
        strong. A chain is an object if it ever reaches nine tenths of a sure score, or lasts for
        `lasting` frames: something far away may never be scored highly. It is none if it ends
        before. With g detections of chains that are objects in a tenth of the range of scores, and
        b of chains that are none, one with such a score is an object with probability

            (g + n p) / (g + b + n),  n = 5

        made non-decreasing in the score by isotonic regression. Detections are strong from 1/2 on.
        Counts lose four tenths in a hundred frames. Chains move with the camera, by `shift`.
        """
        # The oldest are overwritten; rows that are no detection are written nowhere.
        place = (self.count + jnp.cumsum(found.valid, dtype=jnp.int32) - 1) % _REMEMBERED
        place = jnp.where(found.valid, place, _REMEMBERED)
        recent = self.recent.at[place].set(found.scores, mode="drop")
        count = self.count + jnp.sum(found.valid, dtype=jnp.int32)
        known = jnp.arange(_REMEMBERED, dtype=jnp.int32) < count
        number = jnp.maximum(jnp.minimum(count, _REMEMBERED), 1)
        rank = jnp.ceil(_HIGH * (number - 1).astype(recent.dtype)).astype(jnp.int32)
        sure = jnp.sort(jnp.where(known, recent, jnp.inf))[rank]
        lowest = jnp.minimum(jnp.min(jnp.where(known, recent, jnp.inf)), 0.0)
        spread = sure - lowest
        shares = (found.scores - lowest) / jnp.where(spread > 0, spread, 1.0)
        shares = jnp.where(spread > 0, shares, 1.0)
        duplicates = (overlaps > _DUPLICATE) & stronger & found.valid[:, None]
        single = found.valid & ~jnp.any(duplicates, axis=0)
        state = self._continued(found.boxes, single, stronger, shift, shares, lasting)
        strong = lowest + state.strong_share() * spread
        # Where all scores are equal, rounding must not put them below the threshold.
        weak = jnp.where(count > 0, jnp.minimum(lowest + WEAK * spread, strong), -jnp.inf)
        return state._replace(recent=recent, count=count, weak=weak, strong=strong)

    def _continued(
        self,
        found: Float[Array, "d 4"],
        single: Bool[Array, " d"],
        stronger: Bool[Array, "d d"],
        shift: Float[Array, "#c 2"],
        shares: Float[Array, " d"],
        lasting: Array,
    ) -> "ScoreState":
        """The chains after a frame whose detections have these shares of a sure score."""
        moved = self.boxes + jnp.pad(shift, ((0, 0), (0, 2)))
        living = (self.unseen < _GONE)[:, None] & single[None]
        overlaps = jnp.maximum(overlap(self.boxes, found), overlap(moved, found))
        overlaps = jnp.where(living, overlaps, 0.0)
        rows = argmax_pairs(jnp.where(overlaps > _SAME, overlaps, 0.0))
        taken = jnp.where(rows >= 0, rows, len(single))
        new = single & ~jnp.zeros_like(single).at[taken].set(True, mode="drop")
        begun = seated(new, stronger, self.unseen >= _GONE)
        begins = begun >= 0
        rows = jnp.maximum(rows, begun)
        seen, own = rows >= 0, shares[jnp.maximum(rows, 0)]
        bins = jnp.clip((own * _BINS).astype(jnp.int32), 0, _BINS - 1)
        pending = self.pending + jnp.where(
            seen[:, None], jax.nn.one_hot(bins, _BINS, dtype=self.pending.dtype), 0.0
        )
        age = jnp.where(begins, 1, self.age + 1)
        proved = seen & ((own >= _SURE) | (age >= lasting))
        sure = (self.sure & ~begins) | proved
        unseen = jnp.where(seen, 0, jnp.minimum(self.unseen + 1, _GONE))
        ended = (unseen >= _GONE) & ~sure
        return self._replace(
            boxes=jnp.where(seen[:, None], found[jnp.maximum(rows, 0)], moved),
            unseen=unseen,
            age=age,
            sure=sure,
            pending=jnp.where((sure | ended)[:, None], 0.0, pending),
            good=KEPT * self.good + jnp.sum(jnp.where(sure[:, None], pending, 0.0), axis=0),
            bad=KEPT * self.bad + jnp.sum(jnp.where(ended[:, None], pending, 0.0), axis=0),
        )

    def strong_share(self) -> Float[Array, ""]:
        """The share above which a detection is more probably an object than none."""
        prior = jax.nn.sigmoid((_CENTRES - STRONG) / _SLOPE)
        number = self.good + self.bad + PRIOR
        odds = jax.scipy.special.logit(rising((self.good + PRIOR * prior) / number, number))
        above = jnp.argmax(odds >= 0)
        below = jnp.maximum(above - 1, 0)
        step = odds[above] - odds[below]
        part = jnp.where(step > 0, -odds[below] / jnp.where(step > 0, step, 1.0), 0.0)
        centres = jnp.asarray(_CENTRES)
        share = centres[below] + part * (centres[above] - centres[below])
        share = jnp.where(odds[0] >= 0, 0.0, share)
        return jnp.where(odds[-1] >= 0, jnp.minimum(share, _SURE), _SURE)


def rising(values: Float[Array, " k"], weights: Float[Array, " k"]) -> Float[Array, " k"]:
    """Isotonic regression: the nearest non-decreasing sequence, by weighted least squares.

    By its min-max formula (Barlow et al. 1972): entry i is the maximum over a ≤ i of the minimum
    over b ≥ i of the weighted mean of entries a to b.
    """
    sums, totals = jnp.cumsum(weights * values), jnp.cumsum(weights)
    begin, end = np.arange(len(values))[:, None], np.arange(len(values))[None]
    number = totals[None] - (totals - weights)[:, None]
    means = (sums[None] - (sums - weights * values)[:, None]) / jnp.where(end >= begin, number, 1.0)
    lowest = jax.lax.cummin(jnp.where(end >= begin, means, jnp.inf), axis=1, reverse=True)
    return jnp.max(jnp.where(end >= begin, lowest, -jnp.inf), axis=0)
