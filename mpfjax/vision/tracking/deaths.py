"""Deaths: the end of components without detections, or outside the frame."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key, PyTree

from mpfjax.checks import check_whole
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.indexing import take
from mpfjax.operations.segments import spread
from mpfjax.vision.tracking.memory import (
    ASSIGNED,
    GUESSES,
    LIVES,
    SCORES,
    Lives,
    mean_boxes,
    remember,
)
from mpfjax.vision.tracking.observation import TrackedFrame, within


class Deaths(AbstractMove):
    """Count in how many frames each component had a detection, and end those that have too few.

    A component ends if no detection has been assigned to it for more than `patience` frames in a
    row, or for more than `tentative_patience` while it is not confirmed; if it has left the frame,
    or its centre while it has no detection; or if all its particles have zero likelihood. It is
    confirmed after `confirmation` frames with strong detections. Components of the first frame are
    confirmed at once. Where there is no room for new components, an unconfirmed one ends in its
    first frame without a detection, and one that was confirmed at once and has had no strong
    detections since ends as soon as it is no longer shown.

    A component is shown while it is confirmed, for at most `longest_guess` frames without a
    detection, or as many as `LearnGuesses` has learned, and `longest_unsure` frames without a
    strong one. Memory: `Lives`, together with `Births`.

    Deaths are decided and not sampled (`approximate` is true). Raises `ValueError` for a number of
    frames that is not whole, or below 1.
    """

    confirmation: int = eqx.field(static=True, default=2)
    patience: int = eqx.field(static=True, default=20)
    longest_guess: int = eqx.field(static=True, default=2)
    longest_unsure: int = eqx.field(static=True, default=8)
    tentative_patience: int = eqx.field(static=True, default=1)

    def __check_init__(self) -> None:
        check_whole(confirmation=self.confirmation, patience=self.patience)
        check_whole(
            0,
            tentative_patience=self.tentative_patience,
            longest_guess=self.longest_guess,
            longest_unsure=self.longest_unsure,
        )

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({ASSIGNED, SCORES})

    @property
    def approximate(self) -> bool:
        """True: the mass of a component that ends is lost."""
        return True

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """No component is alive yet."""
        return {LIVES: Lives.none(num_components)}

    def forget(self, memory: dict, dead: Bool[Array, " m"]) -> dict:
        """Dead components have no identity and no counts."""
        lives: Lives = memory[LIVES]
        kept = lives._replace(
            identities=jnp.where(dead, 0, lives.identities),
            seen=jnp.where(dead, 0, lives.seen),
            unseen=jnp.where(dead, 0, lives.unseen),
            unsure=jnp.where(dead, 0, lives.unsure),
            confirmed=lives.confirmed & ~dead,
            shown=lives.shown & ~dead,
        )
        return memory | {LIVES: kept}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Count the frame, and end components."""
        del key
        lives: Lives = mixture.memory[LIVES]
        source, scores = mixture.memory[ASSIGNED], observation.detections.scores
        borne_out = source >= 0
        strong = borne_out & (take(scores, jnp.maximum(source, 0)) >= mixture.memory[SCORES].strong)
        seen = lives.seen + strong.astype(jnp.int32)
        unseen = jnp.where(borne_out, 0, lives.unseen + 1)
        unsure = jnp.where(strong, 0, lives.unsure + 1)
        confirmed = lives.alive & (lives.confirmed | (seen >= self.confirmation))
        # One that was confirmed at once and has had too few detections since makes room.
        in_the_way = lives.full & (seen < self.confirmation)
        patience = jnp.where(in_the_way, self.longest_guess, self.patience)
        tentative = jnp.where(lives.full, 0, self.tentative_patience)
        patience = jnp.where(confirmed, patience, tentative)
        stays = lives.alive & mixture.active & (unseen <= patience)
        boxes = mean_boxes(mixture)
        # Of an object that is not detected the centre has to be inside.
        sides = jnp.where(borne_out[:, None], boxes[:, 2:], 0.0)
        stays &= within(jnp.concatenate([boxes[:, :2], sides], axis=1), observation.extent)
        dies = ~spread(stays, mixture.component_indicators)
        log_weights = jnp.where(dies, -jnp.inf, mixture.log_weights)
        recent = (unseen <= self._longest_guess(mixture)) & (unsure <= self.longest_unsure)
        lives = lives._replace(
            seen=seen,
            unseen=unseen,
            unsure=unsure,
            confirmed=confirmed,
            shown=confirmed & stays & recent,
        )
        return remember(mixture.replace(log_weights=log_weights), lives=lives)

    def _longest_guess(self, mixture: ParticleMixture) -> Int[Array, ""] | int:
        guesses = mixture.memory.get(GUESSES)
        return self.longest_guess if guesses is None else guesses.longest
