"""The objects' own step: propagate every component and weigh it by its detection and colours."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from mpfjax.checks import check_flag
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractPropagation
from mpfjax.operations.indexing import take
from mpfjax.vision.tracking.assignment import own_detections
from mpfjax.vision.tracking.memory import (
    ASSIGNED,
    DOUBTS,
    REFERENCES,
    SCORES,
    noises_of,
)
from mpfjax.vision.tracking.model import (
    AssignedFrame,
    DetectedObjectModel,
    ObjectState,
    log_normal,
)
from mpfjax.vision.tracking.observation import TrackedFrame

# Weights within a component differ by at most the factor e^30.
_FARTHEST = 30.0


class PropagateObjects(AbstractPropagation):
    """Propagate every hypothesis, and weigh it by the detection assigned to its component.

    The detection belongs to the object with probability 1 - doubt. The posterior of a hypothesis
    has two Gaussian parts: Kalman's update, for a detection that is its own, and the prediction,
    for one that is not. Where `matched` is false, one of the two is drawn by its posterior
    probability. Where it is true, the Gaussian with the moments of both is taken, as in
    probabilistic data association (Bar-Shalom and Tse 1975), and no random number is drawn.
    Hypothesis i has the weight

        w_i = (1 - doubt) Z_i / Z + doubt

    where Z_i is its predictive density of the detection and Z the mean of Z_i in the component.
    With σ, places are drawn and weighed by their colours as well. Weights compare hypotheses within
    a component only, since `ShareMass` replaces the mixture weights.

    Use `matched=False` where particles are rival hypotheses, `matched=True` where each component is
    one Gaussian.
    """

    model: DetectedObjectModel
    matched: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        check_flag(matched=self.matched)

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        names = {ASSIGNED, DOUBTS, SCORES}
        return frozenset(names if self.model.sigma is None else names | {REFERENCES})

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Predict, update by the detections, and weigh."""
        own = own_detections(mixture.memory[ASSIGNED], observation.detections)
        seen = AssignedFrame(
            detections=own,
            weak=own.scores < mixture.memory[SCORES].strong,
            doubts=mixture.memory[DOUBTS],
            pixels=observation.pixels,
            references=mixture.memory.get(REFERENCES),
        )
        key_which, key_place = jax.random.split(key)
        noises = noises_of(mixture, self.model)
        moved = self.model.predicted(mixture.particles, noises)
        places, errors = self.model.detection_of(seen, moved, noises)
        updated, gaps, variances = moved.gaussian.updated(places, errors)
        followed, log_factors = self._odds(log_normal(gaps, variances), mixture, seen)
        if not self.matched:
            draws = jax.random.uniform(key_which, followed.shape, followed.dtype)
            followed = (draws < followed).astype(followed.dtype)
        both = updated.mixed_with(moved.gaussian, followed[:, None])
        states = ObjectState.of(both, moved.label)
        states, log_colours = self.model.seen(key_place, seen, states)
        return mixture.replace(particles=states).weighed(log_factors, log_colours)

    def _odds(
        self, log_z: Float[Array, " n"], mixture: ParticleMixture, seen: AssignedFrame
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The probability that each hypothesis follows the detection, and its log weight."""
        labels = mixture.component_indicators
        log_z = jnp.where(mixture.occupied, log_z, 0.0)
        offsets = log_z - take(mixture.component_averages(log_z), labels)
        ratios = jnp.exp(jnp.clip(offsets, -_FARTHEST, _FARTHEST))
        means = take(mixture.component_averages(ratios), labels)
        doubts = take(seen.doubts, labels).astype(ratios.dtype)
        follows = (1 - doubts) * ratios / jnp.where(means > 0, means, 1.0)
        factors = follows + doubts
        detected = take(seen.detections.valid, labels) & (factors > 0)
        factors = jnp.where(detected, factors, 1.0)
        return jnp.where(detected, follows / factors, 0.0), jnp.log(factors)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Move every hypothesis by the dynamics alone."""
        del key
        moved = self.model.predicted(mixture.particles, noises_of(mixture, self.model))
        return mixture.replace(particles=moved)
