"""The lives of objects: who ends, who begins, who is shown for how long, and duplicates."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mpfjax.vision.tracking.gaussian import zeros
from mpfjax.vision.tracking.scores import KEPT, PRIOR, rising

_CONFIRMED = 2  # frames with strong detections after which there is an object
_TENTATIVE = 1  # frames that it may be missed in before
_BINS = 20  # of the frames that an object may be without a detection
_SCALE = 0.5  # of the logistic prior of coasting, in longest coasts
_BESIDE = 0.15  # an overlap with an older object from which on one appears beside it
_LEAST = 1 / 3  # the probability of another object below which one beside it is a duplicate


class Spans(NamedTuple):
    """Numbers of frames, at a frame rate.

    - `patience`: without a detection, after which an object ends.
    - `lasting`: of a chain of detections, after which it is an object's.
    - `coast`, `unsure`: without a detection, and without a strong one, in which one is shown.
    """

    patience: Int[Array, ""]
    lasting: Int[Array, ""]
    coast: Int[Array, ""]
    unsure: Int[Array, ""]

    @classmethod
    def at(cls, frames_per_second: Float[Array, ""]) -> "Spans":
        """A second, two, a tenth and three tenths."""
        frames = jnp.round(frames_per_second * np.array([1, 2, 0.1, 0.3], np.float32))
        least = np.array([8, 10, 1, 1], np.int32)
        return cls(*jnp.maximum(frames.astype(jnp.int32), least))

    @property
    def binned(self) -> Int[Array, ""]:
        """The frames without a detection of all bins: a bin has one at least."""
        return jnp.maximum(self.patience, _BINS)


class Lives(NamedTuple):
    """The identity of each object, and its counts of frames.

    - `identities`: (m,), 0 in an empty row; `classes`: (m,), 0 for none.
    - `seen`: (m,), in how many frames it had a strong detection.
    - `unseen`, `unsure`: (m,), for how many frames it has had no detection, and no strong one.
    - `confirmed`: (m,), whether it has had enough; `shown`: (m,), whether it should be shown.
    - `last_identity`: the highest ever given.
    - `full`: whether there was no room for a new object in the last frame.
    - `begun`: whether there was a frame before.
    """

    identities: Int[Array, " m"]
    classes: Int[Array, " m"]
    seen: Int[Array, " m"]
    unseen: Int[Array, " m"]
    unsure: Int[Array, " m"]
    confirmed: Bool[Array, " m"]
    shown: Bool[Array, " m"]
    last_identity: Int[Array, ""]
    full: Bool[Array, ""]
    begun: Bool[Array, ""]

    @classmethod
    def initial(cls, num_objects: int) -> "Lives":
        """Nobody yet."""
        none, zero = zeros(num_objects, dtype=np.int32), zeros(dtype=np.int32)
        return cls(none, none, none, none, none, none > 0, none > 0, zero, zero > 0, zero > 0)

    @property
    def alive(self) -> Bool[Array, " m"]:
        """Which rows stand for an object."""
        return self.identities > 0

    def counted(
        self,
        detected: Bool[Array, " m"],
        strong: Bool[Array, " m"],
        inside: Bool[Array, " m"],
        spans: Spans,
        coast: Int[Array, ""],
    ) -> "Lives":
        """The lives after a frame's detections, before any birth.

        An object ends if it has had no detection for more than a second, or for more than one frame
        while it is not confirmed, or if it is not `inside` the frame. It is
        confirmed after two frames with strong detections, or at once in the first frame. Where
        there is no room, an unconfirmed one ends in its first frame without a detection, and one
        that was confirmed at once and has had no strong detections since ends as soon as it is no
        longer shown: after `coast` frames without a detection, or three tenths of a second without
        a strong one.
        """
        seen = self.seen + strong.astype(jnp.int32)
        unseen = jnp.where(detected, 0, self.unseen + 1)
        unsure = jnp.where(strong, 0, self.unsure + 1)
        confirmed = self.alive & (self.confirmed | (seen >= _CONFIRMED))
        in_the_way = self.full & (seen < _CONFIRMED)
        tentative = jnp.where(self.full, 0, _TENTATIVE)
        most = jnp.where(confirmed, jnp.where(in_the_way, spans.coast, spans.patience), tentative)
        stays = self.alive & inside & (unseen <= most)
        recent = (unseen <= coast) & (unsure <= spans.unsure)
        return self._replace(
            identities=jnp.where(stays, self.identities, 0),
            seen=jnp.where(stays, seen, 0),
            unseen=jnp.where(stays, unseen, 0),
            unsure=jnp.where(stays, unsure, 0),
            confirmed=confirmed & stays,
            shown=confirmed & stays & recent,
        )

    def begins(
        self, born: Bool[Array, " m"], told: Int[Array, " m"], wanted: Int[Array, ""]
    ) -> "Lives":
        """The lives with those who are born; `wanted` is how many there should have been.

        `told` are the classes of the detections; an object keeps the first that there was.
        """
        kept = jnp.where(born, 0, self.classes)
        number = jnp.cumsum(born, dtype=jnp.int32)
        at_once = born & ~self.begun
        return Lives(
            identities=jnp.where(born, self.last_identity + number, self.identities),
            classes=jnp.where(kept > 0, kept, told),
            seen=jnp.where(born, 1, self.seen),
            unseen=jnp.where(born, 0, self.unseen),
            unsure=jnp.where(born, 0, self.unsure),
            confirmed=self.confirmed | at_once,
            shown=self.shown | at_once,
            last_identity=self.last_identity + number[-1],
            full=wanted > number[-1],
            begun=jnp.ones((), bool),
        )


class Coasting(NamedTuple):
    """Predictions in frames without a detection: (20,) that proved `right`, and `wrong`, by age."""

    right: Float[Array, " bins"]
    wrong: Float[Array, " bins"]

    @classmethod
    def initial(cls) -> "Coasting":
        """Nobody has coasted yet."""
        return cls(zeros(_BINS), zeros(_BINS))

    def after(
        self,
        before: Lives,
        now: Lives,
        detected: Bool[Array, " m"],
        right: Bool[Array, " m"],
        spans: Spans,
    ) -> "Coasting":
        """Count the coasting that this frame decides: all since an object's last detection.

        They were right if it is detected again and its prediction is `right`, and wrong if that is
        not so, or if it ends.
        """
        edges = jnp.arange(_BINS + 1, dtype=jnp.int32) * spans.binned // _BINS
        unseen = before.unseen + (~detected).astype(jnp.int32)
        counts = jnp.clip(unseen[:, None], edges[None, :-1], edges[None, 1:]) - edges[None, :-1]
        wrong = jnp.where(detected, ~right, ~now.alive)
        decided = (before.confirmed & which for which in (detected & right, wrong))
        dtype = self.right.dtype
        new = (jnp.sum(jnp.where(which[:, None], counts, 0), 0, dtype) for which in decided)
        return Coasting(*(KEPT * a + b for a, b in zip(self, new, strict=True)))

    def longest(self, spans: Spans) -> Int[Array, ""]:
        """For how many frames without a detection a prediction is right in half of the cases.

        With r right and w wrong ones in a bin, and a prior p that is logistic in the number of
        frames and 1/2 after a tenth of a second, one is right with probability

            (r + n p) / (r + w + n),  n = 5

        made non-increasing by isotonic regression.
        """
        half = spans.coast.astype(jnp.float32) + 0.5
        ages = (np.arange(_BINS, dtype=np.float32) + np.float32(0.5)) / _BINS
        frames = ages * spans.binned.astype(jnp.float32) + 0.5
        prior = jax.nn.sigmoid((half - frames) / (_SCALE * half))
        number = self.right + self.wrong + PRIOR
        values = (self.right + PRIOR * prior) / number
        bins = jnp.sum(rising(values[::-1], number[::-1]) >= 0.5, dtype=jnp.int32)
        return bins * spans.binned // _BINS


class Duplicates(NamedTuple):
    """Whether what appears beside an object is another object, or a second box of the same one.

    - `elders`: (m,), the identity of the object beside which each appeared, 0 for none and for one
      that has been apart from it.
    - `objects`, `duplicates`: how many proved to be objects, and how many to be duplicates.
    - `doubtful`: (m,), which are more probably duplicates.
    """

    elders: Int[Array, " m"]
    objects: Float[Array, ""]
    duplicates: Float[Array, ""]
    doubtful: Bool[Array, " m"]

    @classmethod
    def initial(cls, num_objects: int) -> "Duplicates":
        """Nobody began beside another one."""
        none = zeros(num_objects, dtype=np.int32)
        return cls(none, zeros(), zeros(), none > 0)

    def after(
        self,
        identities: Int[Array, " m"],
        stays: Bool[Array, " m"],
        detected: Bool[Array, " m"],
        overlaps: Float[Array, "m m"],
    ) -> "Duplicates":
        """Count what this frame decides, and give new objects their elders.

        One proves to be an object once it overlaps its elder by less than .15 in a frame in which
        both are detected. It was a duplicate if it ends before its elder does. While another
        object is less probable than a third, one with an elder is doubtful: it has only detections
        that the others leave, and is not shown.
        """
        alive, has_elder = identities > 0, self.elders > 0
        pairs = (self.elders[:, None] == identities[None]) & alive[None]
        elder_lives = jnp.any(pairs, axis=1)
        apart = (overlaps < _BESIDE) & detected[:, None] & detected[None]
        proved = has_elder & stays & jnp.any(pairs & apart, axis=1)
        older = alive[None] & (identities[None] < identities[:, None])
        beside = jnp.where(older, overlaps, 0.0)
        nearest = identities[jnp.argmax(beside, axis=1)]
        begun = jnp.where(jnp.max(beside, axis=1) > _BESIDE, nearest, 0)
        kept = jnp.where(elder_lives & ~proved, self.elders, 0)
        elders = jnp.where(alive, jnp.where(stays, kept, begun), 0)
        dtype, ended = self.objects.dtype, has_elder & ~stays & elder_lives
        objects = KEPT * self.objects + jnp.sum(proved, dtype=dtype)
        duplicates = KEPT * self.duplicates + jnp.sum(ended, dtype=dtype)
        probability = (objects + PRIOR / 2) / (objects + duplicates + PRIOR)
        return Duplicates(elders, objects, duplicates, (elders > 0) & (probability < _LEAST))
