"""Deaths: what no detection bears out any more, what has left the frame."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key, PyTree

from mpfjax.checks import check_whole
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.segments import spread
from mpfjax.vision.tracking.memory import ASSIGNED, EXTENT, LIVES, Lives, mean_boxes, remember
from mpfjax.vision.tracking.observation import TrackedFrame, within


class Bury(AbstractMove):
    """Count in how many frames each component was borne out, and empty those that are gone.

    A component dies where no detection has been assigned to it for more than `patience` frames in a
    row, for more than none while it is not confirmed; where its centre has left the frame; and
    where all its particles have zero likelihood. It is confirmed once detections have borne it out
    in `confirmation` frames. Where there are no pixels, the frame reaches as far as all
    detections so far. Memory: `Lives`, with `Found`, and that extent.

    Deaths are decided and not sampled (`approximate` is true). Raises `ValueError` for a number of
    frames that is not whole, or below 1.
    """

    confirmation: int = eqx.field(static=True, default=3)
    patience: int = eqx.field(static=True, default=20)

    def __check_init__(self) -> None:
        check_whole(confirmation=self.confirmation, patience=self.patience)

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
            confirmed=lives.confirmed & ~dead,
        )
        return memory | {LIVES: kept}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Count the frame, and end who is gone."""
        del key
        lives: Lives = mixture.memory[LIVES]
        borne_out = mixture.memory[ASSIGNED] >= 0
        seen = lives.seen + borne_out.astype(jnp.int32)
        unseen = jnp.where(borne_out, 0, lives.unseen + 1)
        confirmed = lives.alive & (seen >= self.confirmation)
        patience = jnp.where(confirmed, self.patience, 0)
        stays = lives.alive & mixture.active & (unseen <= patience)
        extent = observation.extent(mixture.memory[EXTENT])
        stays &= within(mean_boxes(mixture), extent)
        dies = ~spread(stays, mixture.component_indicators)
        log_weights = jnp.where(dies, -jnp.inf, mixture.log_weights)
        lives = lives._replace(seen=seen, unseen=unseen, confirmed=confirmed)
        return remember(mixture.replace(log_weights=log_weights), lives=lives, extent=extent)
