"""Strong and weak detections, told apart by what becomes of the chains that they form."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import isotonic_regression
from scipy.special import expit, logit

from mpfjax.vision.tracking.gaussian import overlapping, shared
from mpfjax.vision.tracking.pairs import Pairs, intervals

# Minutes: in a street that is empty for a while, what is left must not set what is sure.
_REMEMBERED = 8192
_HIGH = 0.9  # the quantile of the scores that is called a sure score
_BINS = 10  # of shares of a sure detection's score
_CENTRES = (np.arange(_BINS) + 0.5) / _BINS
_SURE = 0.9  # a chain that reaches this share is an object
STRONG, WEAK = 0.5, 0.2  # the shares that are strong before anything is learned, and that count
_SLOPE = 0.15  # the prior odds are logistic in the share, of this scale
PRIOR = 5.0  # detections that the prior of each bin counts as
KEPT = 0.995  # kept from each frame to the next
_SAME, _DUPLICATE = 0.3, 0.6  # least overlap of boxes in a chain, and of a box with its duplicate
_AS_LARGE = 0.6  # least overlap of boxes with the same centre, of a chain whose boxes are apart
_GONE = 2  # longest gap in a chain, in frames with detections

Boxes, Scores = Float[np.ndarray, "d k"], Float[np.ndarray, " d"]
Chains = Float[np.ndarray, "c k"]


class ScoreState(NamedTuple):
    """The scores so far, chains of detections that overlap from frame to frame, and their fates.

    - `lasting`: frames after which a chain is an object.
    - `recent`: the latest scores, at most 8192.
    - `weak`, `strong`: the least score that counts, and from which on a detection is strong.
    - `boxes`: (c, 4), the last box of each living chain, or (c, 2), moved with the camera; `steps`:
      (c, 2), by how far it moved in a frame; `unseen`: frames with detections since its last one.
    - `age`: frames since its first detection, which counts as one; `sure`: whether it has proved to
      be an object; `pending`: (c, bins), its detections by share while that is not decided.
    - `good`, `bad`: (bins,), detections of chains that proved to be objects, and of chains that
      ended before.
    - `ages`: (d,), of the chains of this frame's detections; 1 for one more box of an object.
    """

    lasting: float
    recent: Float[np.ndarray, " k"]
    weak: float
    strong: float
    boxes: Float[np.ndarray, "c k"]
    steps: Float[np.ndarray, "c 2"]
    unseen: Int[np.ndarray, " c"]
    age: Float[np.ndarray, " c"]
    sure: Bool[np.ndarray, " c"]
    pending: Float[np.ndarray, "c bins"]
    good: Float[np.ndarray, " bins"]
    bad: Float[np.ndarray, " bins"]
    ages: Float[np.ndarray, " d"] = np.zeros(0)

    @classmethod
    def initial(cls, coordinates: int, lasting: float) -> "ScoreState":
        """No score seen yet, and no chain."""
        none, bins = np.zeros(0, int), np.zeros(_BINS)
        boxes, steps, pending = (np.zeros((0, width)) for width in (coordinates, 2, _BINS))
        chains = boxes, steps, none, 0.0 * none, none > 0, pending
        return cls(lasting, np.zeros(0), 0.0, 0.0, *chains, bins, bins)

    def after(
        self,
        boxes: Boxes,
        scores: Scores,
        overlaps: Pairs,
        moved: Chains,
        frames: float,
        variance: float,
    ) -> "ScoreState":
        """Remember the frame's scores, continue the chains, and set the thresholds.

        Weak detections sustain a track; only strong ones start one (Zhang et al. 2022, ByteTrack).
        Scores are measured as shares of a sure score, the 0.9 quantile of the last 8192, counted
        from zero or, where some scores are negative, from the lowest. If all are equal, all are
        strong. A chain is an object if it ever reaches nine tenths of a sure score, or lasts for
        `lasting` frames: something far away may never be scored highly. It is none if it ends
        before. With g detections of chains that are objects in a tenth of the range of scores, and
        b of chains that are none, one with such a score is an object with probability

            (g + n p) / (g + b + n),  n = 5

        made non-decreasing in the score by isotonic regression. Detections are strong from 1/2 on.
        Counts lose four tenths in a hundred frames. The chains' boxes have `moved` with the camera.
        Detections come strongest first, so many `frames` after those before. `variance`: of the
        distance of a point from one frame to the next.
        """
        recent = np.concatenate([self.recent, scores])[-_REMEMBERED:]
        rank = int(np.ceil(_HIGH * (len(recent) - 1)))
        sure = np.partition(recent, rank)[rank] if len(recent) else 0.0
        lowest = recent.min(initial=0.0)
        spread = sure - lowest
        shares = (scores - lowest) / spread if spread > 0 else np.ones_like(scores)
        single = np.ones(len(boxes), bool)
        is_same = (overlaps.rows < overlaps.columns) & (overlaps.values > _DUPLICATE)
        single[overlaps.columns[is_same]] = False
        state = self._continue(boxes[single], shares[single], moved, frames, variance)
        ages = np.ones(len(boxes))
        ages[single] = state.ages
        strong = lowest + state.strong_share() * spread
        # Where all scores are equal, rounding must not put them below the threshold.
        weak = min(lowest + WEAK * spread, strong) if len(recent) else -np.inf
        return state._replace(recent=recent, weak=weak, strong=strong, ages=ages)

    def _continue(
        self, detections: Boxes, shares: Scores, moved: Chains, frames: float, variance: float
    ) -> "ScoreState":
        """The chains after a frame whose detections have these shares of a sure score."""
        since = frames * (1 + self.unseen[:, None])
        ahead = moved + np.pad(since * self.steps, ((0, 0), (0, moved.shape[1] - 2)))
        # At a low rate what is fast leaves its last box; elsewhere steps are mostly errors.
        kinds = [
            overlapping(boxes, detections, _SAME, variance) for boxes in (ahead, self.boxes, moved)
        ]
        kinds[1:] = [each._replace(values=1 + each.values) for each in kinds[1:]]
        if moved.shape[1] > 2:
            kinds.append(self._fast(moved, detections, frames))
        rows, columns, nearness = (np.concatenate([each[i] for each in kinds]) for i in range(3))
        rows = Pairs(rows, columns, nearness, kinds[0].shape).partners
        is_detected = rows >= 0
        old, new = np.flatnonzero(is_detected), np.setdiff1d(np.arange(len(detections)), rows)
        steps = np.concatenate([self.steps, np.zeros((len(new), 2))])
        steps[old] = (detections[rows[old]] - moved[old])[:, :2] / since[old]
        # New chains come after the others.
        rows, is_detected = np.append(rows, new), np.append(is_detected, new >= 0)
        none = np.zeros(len(new), int)
        boxes = np.concatenate([moved, detections[new]])
        boxes[is_detected] = detections[rows[is_detected]]
        pending = np.concatenate([self.pending, np.zeros((len(new), _BINS))])
        share_of_each = np.where(is_detected, np.append(shares, 0.0)[rows], 0.0)
        bins = np.clip((share_of_each * _BINS).astype(int), 0, _BINS - 1)
        pending[is_detected, bins[is_detected]] += 1
        age = np.append(self.age + frames, none + 1)
        ages = np.ones(len(detections))
        ages[rows[is_detected]] = age[is_detected]
        is_sure = is_detected & ((share_of_each >= _SURE) | (age >= self.lasting))
        sure = np.append(self.sure, none > 0) | is_sure
        unseen = np.where(is_detected, 0, np.append(self.unseen, none) + 1)
        ended = unseen >= _GONE
        good, bad = pending[sure].sum(axis=0), pending[ended & ~sure].sum(axis=0)
        chains = boxes, steps, unseen, age, sure, np.where(sure[:, None], 0.0, pending)
        boxes, steps, unseen, age, sure, pending = (rows[~ended] for rows in chains)
        return self._replace(
            boxes=boxes, steps=steps, unseen=unseen, age=age, sure=sure, pending=pending, ages=ages,
            good=KEPT * self.good + good, bad=KEPT * self.bad + bad,
        )  # fmt: skip

    def _fast(self, moved: Chains, detections: Boxes, frames: float) -> Pairs:
        """Second boxes of chains, apart from the first: as large, and within one box a frame.

        The step of these chains is not known yet. Those with a choice are not continued.
        """
        young = np.flatnonzero(self.age == 1)
        first, reach = moved[young], frames * moved[young, 2:]
        low, high = first[:, 0] - reach[:, 0], first[:, 0] + reach[:, 0]
        rows, columns = intervals(low, high, detections[:, 0])
        sizes = np.array([0, 0, 1, 1])
        alike = shared(sizes * first[rows], sizes * detections[columns])
        near = np.abs(detections[columns, 1] - first[rows, 1]) < reach[rows, 1]
        pairs = Pairs(young[rows], columns, _SAME * alike, (len(moved), len(detections)))
        pairs = pairs.at(near & (alike > _AS_LARGE))
        return pairs.at(~pairs.rivals)

    def strong_share(self) -> float:
        """The share above which a detection is more probably an object than none."""
        prior = expit((_CENTRES - STRONG) / _SLOPE)
        number = self.good + self.bad + PRIOR
        odds = logit(rising((self.good + PRIOR * prior) / number, number))
        above = int(np.argmax(odds >= 0))
        if odds[-1] < 0:
            return _SURE
        if above == 0:
            return 0.0
        part = -odds[above - 1] / (odds[above] - odds[above - 1])
        return float(min(_CENTRES[above - 1] + part / _BINS, _SURE))


def rising(values: Float[np.ndarray, " k"], weights: Float[np.ndarray, " k"]) -> np.ndarray:
    """Isotonic regression: the nearest non-decreasing sequence, by weighted least squares."""
    return isotonic_regression(values, weights=weights).x
