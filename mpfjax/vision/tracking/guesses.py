"""For how many frames without a detection an object's prediction is right, learned online."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import check_share, check_type
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.floats import default_float
from mpfjax.operations.indexing import take
from mpfjax.vision.tracking.deaths import Deaths
from mpfjax.vision.tracking.fates import KEPT, PRIOR, rising
from mpfjax.vision.tracking.memory import (
    ASSIGNED,
    GUESSES,
    LIVES,
    Lives,
    noises_of,
    remember,
)
from mpfjax.vision.tracking.model import DetectedObjectModel, boxes_of
from mpfjax.vision.tracking.observation import TrackedFrame, overlap

_BINS = 20  # of the frames that an object may be without a detection
_SCALE = 0.5  # of the prior's logistic curve, in longest guesses


class Guesses(NamedTuple):
    """Memory of `LearnGuesses`.

    - `owners`: the identity of the confirmed object in each component, 0 for none.
    - `frames`: for how many frames it has had no detection.
    - `right`, `wrong`: (bins,), guesses that were borne out, and those that were not, by the number
      of frames since the last detection.
    - `longest`: after so many frames without a detection an object is no longer shown.
    """

    owners: Int[Array, " m"]
    frames: Int[Array, " m"]
    right: Float[Array, " bins"]
    wrong: Float[Array, " bins"]
    longest: Int[Array, ""]


class LearnGuesses(AbstractMove):
    """Learn for how many frames without a detection the predicted box of an object is right.

    If the detector misses an object, its prediction is worth showing; if the object has left, it is
    not. Earlier objects tell which is the case. When an object has been without a detection for u
    frames, there are u guesses, k = 1, ..., u frames after its last detection. They were right if
    a detection is then assigned to it and overlaps its predicted box by `same` or more
    (intersection over union). They were wrong if the overlap is less, or if the object ends. Let r
    and w be the numbers of right and wrong guesses for a k. A guess is right with probability

        (r + n p) / (r + w + n),  n = 5

    made non-increasing in k by isotonic regression. The prior p is logistic in k, and is 1/2 after
    `deaths.longest_guess` frames. An object is shown while the probability is at least 1/2, within
    the other bounds of `deaths`. Counts lose four tenths in a hundred frames. The frames up to
    `deaths.patience` are divided into 20 bins.

    - `deaths`: the `Deaths` of the chain, which reads what is learned.

    It follows `Assign`, before the particles move, and changes only its memory, `Guesses`. Use it
    with any detector. Raises `ValueError` for a share outside [0, 1].
    """

    model: DetectedObjectModel
    deaths: Deaths
    same: float = eqx.field(static=True, default=0.5)

    def __check_init__(self) -> None:
        check_type(DetectedObjectModel, "a DetectedObjectModel", model=self.model)
        check_type(Deaths, "the chain's Deaths", deaths=self.deaths)
        check_share(same=self.same)

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({ASSIGNED, LIVES})

    def initial_memory(self, num_components: int) -> dict[str, Guesses]:
        """No guess yet."""
        none = jnp.zeros(num_components, jnp.int32)
        bins = jnp.zeros(_BINS, default_float())
        longest = jnp.asarray(self.deaths.longest_guess, jnp.int32)
        return {GUESSES: Guesses(none, none, bins, bins, longest)}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Count the guesses that this frame decides, and set the longest one."""
        del key
        lives: Lives = mixture.memory[LIVES]
        guesses: Guesses = mixture.memory[GUESSES]
        source = mixture.memory[ASSIGNED]
        moved = self.model.predicted(mixture.particles, noises_of(mixture, self.model))
        predicted = boxes_of(mixture.component_averages(moved.place))
        boxes = take(observation.detections.boxes, jnp.maximum(source, 0))
        same = jnp.diagonal(overlap(predicted, boxes)) >= self.same
        ended = (guesses.owners > 0) & (guesses.owners != lives.identities)
        resumed = (source >= 0) & lives.confirmed & (guesses.owners == lives.identities)
        right = KEPT * guesses.right + self._counted(guesses.frames, resumed & same)
        wrong = KEPT * guesses.wrong + self._counted(guesses.frames, ended | (resumed & ~same))
        unseen = mixture.memory[LIVES].unseen + 1
        return remember(
            mixture,
            guesses=Guesses(
                owners=jnp.where(lives.confirmed, lives.identities, 0),
                frames=jnp.where(source >= 0, 0, unseen),
                right=right,
                wrong=wrong,
                longest=self._longest(right, wrong),
            ),
        )

    def _counted(self, frames: Int[Array, " m"], which: Bool[Array, " m"]) -> Float[Array, " bins"]:
        """Guesses by bin, where each of the objects was without a detection for these frames."""
        edges = jnp.arange(_BINS + 1) * self._span // _BINS
        frames = jnp.where(which, frames, 0)[:, None]
        counts = jnp.clip(frames, edges[None, :-1], edges[None, 1:]) - edges[None, :-1]
        return jnp.sum(counts, axis=0).astype(default_float())

    def _longest(self, right: Float[Array, " bins"], wrong: Float[Array, " bins"]) -> Array:
        """The number of frames for which a guess is more probably right than wrong."""
        half = self.deaths.longest_guess + 0.5
        frames = (jnp.arange(_BINS, dtype=right.dtype) + 0.5) * (self._span / _BINS) + 0.5
        prior = jax.nn.sigmoid((half - frames) / (_SCALE * half))
        number = right + wrong + PRIOR
        values = (right + PRIOR * prior) / number
        probabilities = rising(values[::-1], number[::-1])
        bins = jnp.sum(probabilities >= 0.5, dtype=jnp.int32)
        return (bins * self._span) // _BINS

    @property
    def _span(self) -> int:
        """The frames of all bins together: a bin has one frame at least."""
        return max(self.deaths.patience, _BINS)
