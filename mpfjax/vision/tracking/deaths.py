"""Deaths: what no detection bears out any more, what has left the frame."""

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
    EXTENT,
    HIDDEN,
    LIVES,
    SCORES,
    Lives,
    mean_boxes,
    remember,
    shared_detections,
)
from mpfjax.vision.tracking.observation import TrackedFrame, within


class Deaths(AbstractMove):
    """Count in how many frames each component was borne out, and empty those that are gone.

    A component dies where no detection has been assigned to it for more than `patience` frames in a
    row, or for more than none while it is not confirmed; where its centre has left the frame; and
    where all its particles have zero likelihood. It is confirmed once strong detections have borne
    it out in `confirmation` frames. Where others find no room, one that was
    believed in before that, as those of the first frame are, is waited for no longer than it is
    shown. Frames in which another hides it
    (`ShareDetections`) do not count as without a detection. Where there are no pixels, the frame
    reaches as far as all detections so far.
    A component is shown while it is confirmed, for at most `longest_guess` frames without a
    detection and `longest_unsure` without a strong one. Memory: `Lives`, with `Births`, and that
    extent.

    Deaths are decided and not sampled (`approximate` is true). Raises `ValueError` for a number of
    frames that is not whole, or below 1.
    """

    confirmation: int = eqx.field(static=True, default=2)
    patience: int = eqx.field(static=True, default=20)
    longest_guess: int = eqx.field(static=True, default=2)
    longest_unsure: int = eqx.field(static=True, default=8)

    def __check_init__(self) -> None:
        check_whole(confirmation=self.confirmation, patience=self.patience)
        check_whole(0, longest_guess=self.longest_guess, longest_unsure=self.longest_unsure)

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({ASSIGNED, SCORES})

    @property
    def approximate(self) -> bool:
        """True: a component's mass is thrown away."""
        return True

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """Nobody lives yet."""
        nothing = jnp.array([jnp.inf, jnp.inf, -jnp.inf, -jnp.inf])
        return {LIVES: Lives.none(num_components), EXTENT: nothing}

    def forget(self, memory: dict, dead: Bool[Array, " m"]) -> dict:
        """The dead have no name, and were never seen."""
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
        """Count the frame, and end who is gone."""
        del key
        lives: Lives = mixture.memory[LIVES]
        source, scores = mixture.memory[ASSIGNED], observation.detections.scores
        borne_out = source >= 0
        strong = borne_out & (take(scores, jnp.maximum(source, 0)) >= mixture.memory[SCORES].strong)
        seen = lives.seen + strong.astype(jnp.int32)
        missed = ~borne_out & (shared_detections(mixture) < 0)
        unseen = jnp.where(borne_out, 0, lives.unseen + missed.astype(jnp.int32))
        unsure = jnp.where(strong, 0, lives.unsure + (missed | borne_out).astype(jnp.int32))
        confirmed = lives.alive & (lives.confirmed | (seen >= self.confirmation))
        # Who was believed in at once, and not borne out since, makes room where there is none.
        in_the_way = lives.full & (seen < self.confirmation)
        patience = jnp.where(in_the_way, self.longest_guess, self.patience)
        patience = jnp.where(confirmed, patience, 0)
        stays = lives.alive & mixture.active & (unseen <= patience)
        extent = observation.extent(mixture.memory[EXTENT])
        stays &= within(mean_boxes(mixture), extent)
        dies = ~spread(stays, mixture.component_indicators)
        log_weights = jnp.where(dies, -jnp.inf, mixture.log_weights)
        guesses = unseen + jnp.where(shared_detections(mixture) < 0, self._hidden(mixture), 0)
        recent = (guesses <= self.longest_guess) & (unsure <= self.longest_unsure)
        lives = lives._replace(
            seen=seen,
            unseen=unseen,
            unsure=unsure,
            confirmed=confirmed,
            shown=confirmed & stays & recent,
        )
        return remember(mixture.replace(log_weights=log_weights), lives=lives, extent=extent)

    def _hidden(self, mixture: ParticleMixture) -> Int[Array, " m"]:
        return mixture.memory.get(HIDDEN, jnp.zeros(mixture.num_components, jnp.int32))
