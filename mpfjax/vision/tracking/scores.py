"""Strong and weak detections, told apart by the scores that the detector has given so far."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Key

from mpfjax.checks import check_finite, check_share, check_whole, given
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.prefix_sums import few_upto
from mpfjax.vision.tracking.fates import Fates
from mpfjax.vision.tracking.memory import FATES, SCORES, Scores, remember
from mpfjax.vision.tracking.observation import TrackedFrame

_REMEMBERED = 512
_HIGH = 0.9  # the quantile of the scores that is called a sure score


class RankScores(AbstractMove):
    """Set the score above which a detection is strong, and the least score that counts at all.

    Weak detections sustain a component; only strong ones start one (Zhang et al. 2022, ByteTrack).
    Each detector has its own scale of scores. Scores are therefore measured as shares of a sure
    score, the 0.9 quantile of the last 512, counted from zero or, where some scores are negative,
    from the lowest. If all scores are equal, all are strong.

    The share above which a detection is strong is learned from earlier detections (`Fates`).
    Detections that overlap from frame to frame form a chain, with gaps of at most one frame. A
    chain is an object if it ever reaches nine tenths of a sure score, or lasts for `lasting`
    frames: something far away may never be scored highly. It is none if it ends before.
    Let a bin, a tenth of the range of scores, hold g detections of chains that are objects and b of
    chains that are none. A detection in this bin is an object with probability

        (g + n p) / (g + b + n),  n = 5

    made non-decreasing in the score by isotonic regression. The prior p rises through 1/2 at
    `strong_share`. Detections are strong from the share on where this probability is 1/2. Counts
    lose four tenths in a hundred frames.

    - `strong_share`: the share before anything is learned; `weak_share`: the least that counts.
    - `strong_score`, `weak_score`: thresholds in place of those, where the scale is known.
    - `lasting`: after so many frames a chain is an object whatever its scores.

    The particles do not change. Memory: `Scores` and `Fates`. Raises `ValueError` for shares
    outside [0, 1], for a threshold that is not finite, for a weak threshold above the strong one,
    and for a number of frames that is not whole, or below 1.
    """

    strong_share: float = eqx.field(static=True, default=0.5)
    weak_share: float = eqx.field(static=True, default=0.2)
    strong_score: float | None = eqx.field(static=True, default=None)
    weak_score: float | None = eqx.field(static=True, default=None)
    lasting: int = eqx.field(static=True, default=50)

    def __check_init__(self) -> None:
        check_share(strong_share=self.strong_share, weak_share=self.weak_share)
        check_whole(lasting=self.lasting)
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

    def initial_memory(self, num_components: int) -> dict[str, Scores | Fates]:
        """No score seen yet."""
        zero = jnp.zeros(())
        scores = Scores(jnp.zeros(_REMEMBERED), jnp.zeros((), jnp.int32), zero, zero)
        return {SCORES: scores, FATES: Fates.none(num_components)}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Remember the frame's scores and set the thresholds."""
        del key
        found, memory = observation.detections, mixture.memory[SCORES]
        # The oldest are overwritten; rows that are no detection are written nowhere.
        place = (memory.count + few_upto(found.valid) - 1) % _REMEMBERED
        place = jnp.where(found.valid, place, _REMEMBERED)
        scores = found.scores.astype(memory.recent.dtype)
        recent = memory.recent.at[place].set(scores, mode="drop")
        count = memory.count + jnp.sum(found.valid, dtype=jnp.int32)
        known = jnp.arange(_REMEMBERED) < count
        number = jnp.maximum(jnp.minimum(count, _REMEMBERED), 1)
        rank = jnp.ceil(_HIGH * (number - 1).astype(recent.dtype)).astype(jnp.int32)
        sure = jnp.sort(jnp.where(known, recent, jnp.inf))[rank]
        lowest = jnp.minimum(jnp.min(jnp.where(known, recent, jnp.inf)), 0.0)
        spread = sure - lowest
        shares = jnp.where(spread > 0, (scores - lowest) / jnp.where(spread > 0, spread, 1.0), 1.0)
        fates: Fates = mixture.memory[FATES].after(found, shares, self.lasting)
        share = fates.strong_share(jnp.asarray(self.strong_share, spread.dtype))
        strong = lowest + share * spread
        weak = lowest + self.weak_share * spread
        if self.strong_score is not None:
            strong = jnp.full_like(strong, self.strong_score)
        if self.weak_score is not None:
            weak = jnp.full_like(weak, self.weak_score)
        # Where all scores are equal, rounding must not put them below the threshold.
        weak = jnp.where(count > 0, jnp.minimum(weak, strong), -jnp.inf)
        return remember(mixture, scores=Scores(recent, count, weak, strong), fates=fates)
