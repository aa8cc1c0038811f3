"""The lives of objects: who ends, who begins, who is shown for how long, and duplicates."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import expit

from mpfjax.vision.tracking.pairs import Flags, Integers, Numbers, Pairs
from mpfjax.vision.tracking.scores import KEPT, PRIOR, rising

_CONFIRMED = 2  # frames with strong detections after which there is an object
_TENTATIVE = 1  # frames that it may be missed in before
_BINS = 20  # of the frames that an object may be without a detection
_SCALE = 0.5  # of the logistic prior of coasting, in longest coasts
BESIDE = 0.15  # an overlap with an older object from which on one appears beside it
_LEAST = 1 / 3  # the probability of another object below which one beside it is a duplicate


class Spans(NamedTuple):
    """Numbers of frames, at a frame rate.

    - `patience`: without a detection, after which an object ends.
    - `lasting`: of a chain of detections, after which it is an object's.
    - `coast`, `unsure`: without a detection, and without a strong one, in which one is shown.
    - `binned`: without a detection, over which it is learned for how long one is shown.
    """

    patience: float
    lasting: float
    coast: float
    unsure: float
    binned: float

    @classmethod
    def at(cls, frames_per_second: float, lost_seconds: float | None) -> "Spans":
        """The seconds given, by default one, but eight frames; two, a tenth and three tenths.

        A bin has a frame at least.
        """
        frames = np.round(frames_per_second * np.array([1, 2, 0.1, 0.3, 1]))
        spans = cls(*np.maximum(frames, [8, 10, 1, 1, _BINS]).tolist())
        if lost_seconds is None:
            return spans
        return spans._replace(patience=frames_per_second * lost_seconds)


class Lives(NamedTuple):
    """The identity of each object, and its counts of frames.

    - `identities`: (m,); `classes`: (m,), 0 for none; `scores`: (m,), of the latest detection.
    - `num_strong`: (m,), in how many frames it had a strong detection.
    - `unseen`, `unsure`: (m,), for how many frames it has had no detection, and no strong one.
    - `confirmed`: (m,), whether it has had enough; `shown`: (m,), whether it should be shown.
    - `odds`: (m,), in logarithms, that its points are not of nobody, to those that confirm it; 0 of
      boxes.
    """

    identities: Integers
    classes: Integers
    scores: Numbers
    num_strong: Integers
    unseen: Numbers
    unsure: Numbers
    confirmed: Flags
    shown: Flags
    odds: Numbers

    @classmethod
    def initial(
        cls, identities: Integers, classes: Integers, at_once: Flags, odds: float
    ) -> "Lives":
        """The lives of new objects; `at_once`: which are confirmed, and shown, from the first."""
        one, sure = np.ones_like(identities), at_once
        none = 0.0 * one
        return cls(identities, classes, none, one, none, none, sure, sure, none + odds)

    def at(self, rows: np.ndarray) -> "Lives":
        """The lives of some objects."""
        return Lives(*(row[rows] for row in self))

    def append(self, other: "Lives") -> "Lives":
        """The lives of these objects, followed by the others."""
        return Lives(*map(np.concatenate, zip(self, other, strict=True)))

    def advance(
        self, detected: Flags, strong: Flags, frames: float, spans: Spans, coast: float, full: bool
    ) -> tuple["Lives", Flags]:
        """The lives after a frame's detections, so many frames after those before; who lives on.

        An object ends if it has had no detection for longer than the patience, or for more than one
        frame while it is not confirmed. It is confirmed after two frames with strong detections
        where its odds are for it, or at once: in the first frame, and alone after weak detections
        in as many frames as one is shown without a strong one. Where there is no room, an
        unconfirmed one ends in its first frame without a detection, and one that was confirmed at
        once and has had no strong detections since ends as soon as it is no longer shown: after
        `coast` frames without a detection, or three tenths of a second without a strong one.
        """
        num_strong = self.num_strong + strong
        unseen = np.where(detected, 0.0, self.unseen + frames)
        unsure = np.where(strong, 0.0, self.unsure + frames)
        confirmed = self.confirmed | ((num_strong >= _CONFIRMED) & (self.odds >= 0))
        recent = confirmed & (unseen <= coast) & (unsure <= spans.unsure)
        lives = self._replace(num_strong=num_strong, unseen=unseen, unsure=unsure)
        lives = lives._replace(confirmed=confirmed, shown=recent)
        in_the_way = full & (num_strong < _CONFIRMED)
        tentative = 0 if full else _TENTATIVE * frames
        most = np.where(confirmed, np.where(in_the_way, spans.coast, spans.patience), tentative)
        return lives, unseen <= most


class Coasting(NamedTuple):
    """Predictions in frames without a detection: (20,) that proved `right`, and `wrong`, by age."""

    right: Float[np.ndarray, " bins"] = np.zeros(_BINS)
    wrong: Float[np.ndarray, " bins"] = np.zeros(_BINS)

    def after(self, unseen: Numbers, right: Flags, wrong: Flags, spans: Spans) -> "Coasting":
        """Count the coasting that this frame decides: all `unseen` frames since a detection.

        They were right if the object is detected again and its prediction is right, and wrong if
        that is not so, or if it ends.
        """
        edges = np.arange(_BINS + 1) * spans.binned // _BINS
        counts = np.clip(unseen[:, None], edges[:-1], edges[1:]) - edges[:-1]
        decided = (counts[which].sum(axis=0) for which in (right, wrong))
        return Coasting(*(KEPT * a + b for a, b in zip(self, decided, strict=True)))

    def longest(self, spans: Spans) -> float:
        """For how many frames without a detection a prediction is right in half of the cases.

        With r right and w wrong ones in a bin, and a prior p that is logistic in the number of
        frames and 1/2 after a tenth of a second, one is right with probability

            (r + n p) / (r + w + n),  n = 5

        made non-increasing by isotonic regression.
        """
        half = spans.coast + 0.5
        frames = (np.arange(_BINS) + 0.5) / _BINS * spans.binned + 0.5
        prior = expit((half - frames) / (_SCALE * half))
        number = self.right + self.wrong + PRIOR
        values = (self.right + PRIOR * prior) / number
        bins = np.sum(rising(values[::-1], number[::-1]) >= 0.5)
        return bins * spans.binned // _BINS


class Duplicates(NamedTuple):
    """Whether what appears beside an object is another object, or a second box of the same one.

    - `elders`: (m,), the identity of the object beside which each appeared, 0 for none and for one
      that has been apart from it.
    - `objects`, `duplicates`: how many proved to be objects, and how many to be duplicates.
    """

    elders: Integers = np.zeros(0, int)
    objects: float = 0.0
    duplicates: float = 0.0

    @property
    def doubtful(self) -> Flags:
        """Which are more probably duplicates."""
        probability = (self.objects + PRIOR / 2) / (self.objects + self.duplicates + PRIOR)
        return (self.elders > 0) & (probability < _LEAST)

    def after(
        self, identities: Integers, stays: Bool[np.ndarray, " k"], detected: Flags, overlaps: Pairs
    ) -> "Duplicates":
        """Count what this frame decides, and give new objects their elders.

        One proves to be an object once it overlaps its elder by less than .15 in a frame in which
        both are detected. It was a duplicate if it ends before its elder does. While another
        object is less probable than a third, one with an elder is doubtful: it has only detections
        that the others leave, and is not shown. `stays` are those before this frame who live on;
        they come first.
        """
        elder_lives = np.isin(self.elders, identities)
        ended = np.sum(~stays & elder_lives & (self.elders > 0))
        elders = np.where(elder_lives, self.elders, 0)[stays]
        k = len(elders)
        beside = overlaps.at(overlaps.values >= BESIDE)
        first, second = identities[beside.rows], identities[beside.columns]
        with_elder = np.append(elders, 0 * identities[k:])[beside.rows] == second
        is_apart = detected[:k].copy()
        is_apart[beside.rows[with_elder]] = False
        # Identities are in order.
        elder_rows = np.minimum(np.searchsorted(identities, elders), max(len(identities) - 1, 0))
        is_object = (elders > 0) & is_apart & detected[elder_rows]
        younger = beside.at((beside.rows >= k) & (second < first) & (beside.values > BESIDE))
        order, new_elders = np.argsort(younger.values), 0 * identities[k:]
        # Of several the last is written, with which it overlaps most.
        new_elders[younger.rows[order] - k] = identities[younger.columns[order]]
        objects = KEPT * self.objects + np.sum(is_object)
        duplicates = KEPT * self.duplicates + ended
        elders = np.append(np.where(is_object, 0, elders), new_elders)
        return Duplicates(elders, objects, duplicates)
