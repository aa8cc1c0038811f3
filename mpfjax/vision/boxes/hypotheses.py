"""Rival hypotheses about objects, with colours that are learned."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import check
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractPropagation, Step
from mpfjax.vision.boxes.colour_model import BoxState, ColourModel, Seen
from mpfjax.vision.colour import Histograms, normalise

_ANCHOR = 0.2  # the share of the distance from the reference of the first frame
# d_hidden, squared, in units of Σ_c B². In a street scene, people were at a distance of .2 from
# themselves, .5 to .7 from others and 1 or more from the background.
_HIDDEN = 0.6


class LearnedColourModel(ColourModel):
    """A `ColourModel` of objects that change their appearance and that are hidden at times.

        L(y | x) ∝ exp(-d / 2σ²) + exp(-d_hidden / 2σ²)

    d is the squared distance of a `ColourModel`, including contrast: a fifth of it is the distance
    from the reference of the first frame, and the rest the distance from the particle's own
    `appearance`. The second term stands for a hidden object, and does not depend on
    the box. A hypothesis therefore stays near the place where its object vanished, and no
    look-alike at a distance of d_hidden or more attracts it. `appearance` is part of the state, and
    only `AdaptAppearance` changes it. All else is as in a `ColourModel`.

    Use it where objects hide behind others or turn round.
    """

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> BoxState:
        """x_0 of the `ColourModel`, with the appearance of the reference."""
        states = super().sample_initial(key, num_particles)
        return dataclasses.replace(states, appearance=self.references[states.reference])

    def log_likelihood(self, observation: Seen, states: BoxState) -> Float[Array, " n"]:
        """log of the sum of the two terms, visible and hidden."""
        log_seen, log_hidden, _ = self._log_terms(observation, states)
        return jnp.logaddexp(log_seen, log_hidden)

    def learn(self, observation: Seen, states: BoxState, rate: float) -> BoxState:
        """The states, after rate · P(seen | x, y) (h(x) - appearance) is added to appearances."""
        log_seen, log_hidden, counts = self._log_terms(observation, states)
        shown = normalise(counts, self.references_of(states)[0])
        # A box that holds no pixel, or more than can be counted, has no colours to learn.
        some = jnp.any(shown > 0, axis=(1, 2, 3)) & jnp.all(jnp.isfinite(shown), axis=(1, 2, 3))
        share = jnp.where(some, rate * jax.nn.sigmoid(log_seen - log_hidden), 0.0)
        share = share.astype(shown.dtype)[:, None, None, None]
        past = states.appearance
        assert past is not None
        change = jnp.where(share > 0, shown, past) - past
        return dataclasses.replace(states, appearance=past + share * change)

    def _log_terms(
        self, observation: Seen, states: BoxState
    ) -> tuple[Float[Array, " n"], Float[Array, ""], Histograms]:
        """log of the two terms of the likelihood, and the colours in the boxes."""
        counts, sides = self.counts(observation, states)
        weights, references = self.references_of(states)
        to_first = self.distances(counts, sides, weights, references)
        appearance = states.appearance
        assert appearance is not None
        to_learned = self.distances(counts, sides, weights, appearance)
        distances = _ANCHOR * to_first + (1 - _ANCHOR) * to_learned
        log_hidden = -0.5 * _HIDDEN / self.sigma**2
        return -0.5 * distances / self.sigma**2, log_hidden.astype(distances.dtype), counts


class AdaptAppearance(AbstractPropagation):
    """Let every particle learn the colours in its box, in proportion to P(object is visible).

        appearance <- appearance + rate · P(seen | x, y) (h(x) - appearance)

    P(seen | x, y) is the share of the first term in the likelihood of the `LearnedColourModel`.
    Rival hypotheses learn different appearances. A share of the first frame's remains in
    the model. The weights do not change.

    The model changes with the data (`approximate` is true). Use it after `Propagate`.
    """

    rate: float = eqx.field(static=True)

    approximate = True
    """appearances are learned from the same data that they explain."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model that learns no colours."""
        check(LearnedColourModel, model=now.model)

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Learn from this frame, unless it is missing."""
        if now.is_missing:
            return mixture
        particles = now.model.learn(now.observation, mixture.particles, self.rate)
        return mixture.replace(particles=particles)


def best_components(
    mixture: ParticleMixture, num_objects: int
) -> tuple[Int[Array, " k"], Bool[Array, " k"]]:
    """The heaviest component of each object, and whether the object has one at all."""
    objects = jnp.arange(num_objects, dtype=jnp.int32)
    is_own = component_references(mixture)[None] == objects[:, None]
    masses = jnp.where(is_own & mixture.active[None], mixture.log_mixture_weights[None], -jnp.inf)
    return jnp.argmax(masses, axis=1), jnp.max(masses, axis=1) > -jnp.inf


def component_references(mixture: ParticleMixture) -> Int[Array, " m"]:
    """The reference of each component."""
    return mixture.component_groups(mixture.particles.reference)
