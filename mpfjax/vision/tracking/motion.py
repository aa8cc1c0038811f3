"""The objects' own step: propagate every component and weigh it by its detection and colours."""

import jax.numpy as jnp
from jaxtyping import Array, Key

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractPropagation
from mpfjax.moves.propagation import Propagate
from mpfjax.vision.tracking.assignment import own_detections
from mpfjax.vision.tracking.contact import in_front
from mpfjax.vision.tracking.memory import ASSIGNED, DOUBTS, REFERENCES, SCORES, shared_detections
from mpfjax.vision.tracking.model import AssignedFrame, DetectedObjectModel
from mpfjax.vision.tracking.observation import TrackedFrame
from mpfjax.vision.tracking.proposal import DetectionProposal


class PropagateObjects(AbstractPropagation):
    """`Propagate` every component, by the detection that is its own or shared and its colours.

    Given the assignments and the references, this is the exact step of the filter: draws from the
    `DetectionProposal`, weights L D / q. Components share no weights here: what they say of each
    other's mass, `ShareMass` takes away again.
    """

    model: DetectedObjectModel

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Draw x_t and weigh it."""
        source, shared = mixture.memory[ASSIGNED], shared_detections(mixture)
        borrowed = shared >= 0
        own = own_detections(jnp.where(borrowed, shared, source), observation.detections)
        seen = AssignedFrame(
            detections=own,
            weak=own.scores < mixture.memory[SCORES].strong,
            merged=in_front(mixture),
            borrowed=borrowed,
            doubts=jnp.where(borrowed, 0.0, mixture.memory[DOUBTS]),
            pixels=observation.pixels,
            references=mixture.memory.get(REFERENCES),
        )
        propagate = Propagate(self.model, DetectionProposal(self.model))
        return propagate(key, mixture, seen)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw x_t from the dynamics alone."""
        return Propagate(self.model).predict(key, mixture)
