"""Which detections are strong and which are weak, by the scores that the detector has given."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Key

from mpfjax.checks import check_finite, check_share, given
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.vision.tracking.memory import SCORES, Scores, remember
from mpfjax.vision.tracking.observation import TrackedFrame

_REMEMBERED = 512
_HIGH = 0.9  # the quantile of the scores that stands for a sure detection


class RankScores(AbstractMove):
    """Set the scores from which a detection is strong, and from which it counts at all.

    Weak detections sustain a component and only strong ones found one (Zhang et al. 2022,
    ByteTrack). Detectors score on scales of their own, so both thresholds are shares of a sure
    detection's score, the 0.9 quantile of the last 512, counted from zero or, where some scores are
    negative, from the lowest. Equal scores are all strong.

    - `strong_share`, `weak_share`: of the way up to a sure detection's score.
    - `strong_score`, `weak_score`: thresholds in place of those, where the scale is known.

    It leaves the particles as they are; memory: `Scores`. Raises `ValueError` for shares outside
    [0, 1], a threshold that is not finite, and weak above strong.
    """

    strong_share: float = eqx.field(static=True, default=0.5)
    weak_share: float = eqx.field(static=True, default=0.25)
    strong_score: float | None = eqx.field(static=True, default=None)
    weak_score: float | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_share(strong_share=self.strong_share, weak_share=self.weak_share)
        check_finite(**given(strong_score=self.strong_score, weak_score=self.weak_score))
        if self.weak_share > self.strong_share:
            raise ValueError(
                f"weak_share: {self.weak_share} is above strong_share, {self.strong_share}"
            )
        weak = self.weak_score
        if weak is not None and self.strong_score is not None and weak > self.strong_score:
            raise ValueError(
                f"weak_score: {self.weak_score} is above strong_score, {self.strong_score}"
            )

    def initial_memory(self, num_components: int) -> dict[str, Scores]:
        """No score seen yet."""
        del num_components
        zero = jnp.zeros(())
        return {SCORES: Scores(jnp.zeros(_REMEMBERED), jnp.zeros((), jnp.int32), zero, zero)}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Remember the frame's scores and set the thresholds."""
        del key
        found, memory = observation.detections, mixture.memory[SCORES]
        # The oldest are overwritten; what is no detection is written nowhere.
        place = (memory.count + jnp.cumsum(found.valid, dtype=jnp.int32) - 1) % _REMEMBERED
        place = jnp.where(found.valid, place, _REMEMBERED)
        scores = found.scores.astype(memory.recent.dtype)
        recent = memory.recent.at[place].set(scores, mode="drop")
        count = memory.count + jnp.sum(found.valid, dtype=jnp.int32)
        known = jnp.arange(_REMEMBERED) < count
        number = jnp.maximum(jnp.minimum(count, _REMEMBERED), 1)
        rank = jnp.ceil(_HIGH * (number - 1).astype(recent.dtype)).astype(jnp.int32)
        sure = jnp.sort(jnp.where(known, recent, jnp.inf))[rank]
        lowest = jnp.minimum(jnp.min(jnp.where(known, recent, jnp.inf)), 0.0)
        strong = lowest + self.strong_share * (sure - lowest)
        weak = lowest + self.weak_share * (sure - lowest)
        if self.strong_score is not None:
            strong = jnp.full_like(strong, self.strong_score)
        if self.weak_score is not None:
            weak = jnp.full_like(weak, self.weak_score)
        # Equal scores, the lowest of all as they are, must not be lost to rounding.
        weak = jnp.where(count > 0, jnp.minimum(weak, strong), -jnp.inf)
        return remember(mixture, scores=Scores(recent, count, weak, strong))
