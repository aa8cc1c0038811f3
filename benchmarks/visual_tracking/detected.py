"""Tracking without a drawn box: detections, and mixtures whose components are born of them."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import mpfjax
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove, AbstractPropagation
from mpfjax.vision import BackgroundSubtraction, Detections, ObjectTracker, Tracks
from mpfjax.vision.boxes.following import Snapshot
from mpfjax.vision.tracking.gaussian import Gaussian, boxes_of, places_of, units
from mpfjax.vision.tracking.state import TrackerState
from mpfjax.vision.tracking.track import offline_rows
from mpfjax.vision.tracking.tracker import WEAK_ERROR, advanced, colours_of

MAX_DETECTIONS, MAX_OBJECTS, PARTICLES = 32, 24, 16
DECIDED = "decided"
# Weights within a component differ by at most the factor e^30.
FARTHEST = 30.0


class Seen(NamedTuple):
    """A frame: its detections, and their colours."""

    detections: Detections
    colours: Any


class Decided(NamedTuple):
    """What the detections say of the components: the tracker's state and tracks, and births."""

    tracker: TrackerState
    tracks: Tracks
    born: Array


class NobodyYet(mpfjax.AbstractStateSpaceModel):
    """x_0 of a mixture whose components detections start: `FollowDetections` moves them."""

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Gaussian:
        """Boxes of one pixel."""
        del key
        return Gaussian(*(jnp.zeros((num_particles, 4)) for _ in Gaussian._fields))

    def sample_transition(self, key: Key[Array, ""], states: Gaussian) -> Gaussian:
        """The same."""
        del key
        return states

    def log_likelihood(self, observation: Seen, states: Gaussian) -> Float[Array, " n"]:
        """None."""
        del observation
        return jnp.zeros(len(states.place))


class Seats(AbstractMove):
    """The initial components, P particles each. They stand for nobody as yet."""

    weighs = False
    keeps_mass = True

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, now: mpfjax.Step
    ) -> ParticleMixture:
        """Deal the particles out."""
        del key, now
        seats = jnp.arange(mixture.num_particles, dtype=jnp.int32) // PARTICLES
        return mixture.replace(component_indicators=seats)


class Decide(AbstractMove):
    """Which detection each component has, which components end and which begin.

    As an `ObjectTracker` decides it, with the moments of the particles in the place of its own.
    """

    tracker: ObjectTracker
    start: TrackerState
    approximate = True
    weighs = False
    keeps_mass = True

    def initial_memory(
        self, model: mpfjax.AbstractStateSpaceModel, num_components: int
    ) -> dict[str, Any]:
        """Nobody, and no detection."""
        del model
        m, none = num_components, jnp.zeros(num_components, jnp.int32)
        never = jnp.zeros(m, bool)
        boxes, full, unsure = jnp.zeros((m, 4)), jnp.zeros((), bool), jnp.zeros(m)
        tracks = Tracks(boxes, none, never, none, full, never, none - 1, unsure, none)
        return {DECIDED: Decided(self.start, tracks, never)}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, now: mpfjax.Step
    ) -> ParticleMixture:
        """Remember what is decided."""
        seen: Seen = now.observation
        before = mixture.memory[DECIDED].tracker
        state = before._replace(objects=moments(mixture))
        state, tracks = advanced(self.tracker, state, seen.detections, seen.colours)
        born = (tracks.identities > 0) & (tracks.identities != before.lives.identities)
        decided = {DECIDED: Decided(state, tracks, born)}
        return mixture.replace(memory=mixture.memory | decided)


class FollowDetections(AbstractPropagation):
    """Predict every hypothesis, update it by its component's detection, and weigh it.

    A particle carries the Gaussian moments of place and velocity given its detections
    (Rao-Blackwellisation). The detection is the object's own with the probability p of the pair. A
    particle follows it, or only the prediction, as is drawn by the posterior probability of the
    two: particles of a component are rival hypotheses. Where a component is one Gaussian
    (`matched`), a particle has the moments of both. Particle i has the weight

        w_i = p Z_i / Z + 1 - p

    where Z_i is its predictive density of the detection, and Z the mean of Z_i in the component.
    All components have the same mixture weight: they stand for objects that all exist, and not for
    rival hypotheses. Particles of a component that begins are about its detection.
    """

    matched: bool = eqx.field(static=True)
    approximate = True
    keeps_parents = False

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, now: mpfjax.Step
    ) -> ParticleMixture:
        """Follow the detections, and begin components."""
        decided, found = mixture.memory[DECIDED], now.observation.detections
        noises, owner = decided.tracker.noise.noises, mixture.component_indicators
        assert found.rows is not None  # `from_boxes` says them
        mine = found.rows[None] == decided.tracks.detections[:, None]
        rows = jnp.argmax(mine, axis=1)
        place, there = places_of(found.boxes[rows]), jnp.any(mine, axis=1)[owner]
        weak = found.scores[rows] < decided.tracker.scores.strong
        unit = units(place)
        error = unit * noises.errors[None]
        wide = error * jnp.where(weak, WEAK_ERROR, 1.0)[:, None]
        moved = mixture.particles.predicted(noises.place[None], noises.velocity[None])
        updated, gap, variance = moved.updated(place[owner], wide[owner])
        log_z = -0.5 * jnp.sum(gap**2 / variance + jnp.log(variance), axis=1)
        offset = log_z - mixture.component_averages(log_z)[owner]
        ratio = jnp.exp(jnp.clip(offset, -FARTHEST, FARTHEST))
        p = decided.tracks.probabilities[owner]
        own = p * ratio / mixture.component_averages(ratio)[owner]
        factor = jnp.where(there, own + 1 - p, 1.0)
        share = jnp.where(there, own / factor, 0.0)
        if not self.matched:
            share = jnp.where(jax.random.uniform(key, share.shape) < share, 1.0, 0.0)
        particles = updated.mixed_with(moved, share[:, None])
        begun = Gaussian.begun(place, error, unit * noises.speed[None])
        begun = Gaussian(*(moment[owner] for moment in begun))
        born = decided.born[owner]
        weights = jnp.where(born, 1.0, mixture.component_weights * factor)
        total = mixture.replace(log_weights=jnp.log(weights))
        log_weights = jnp.log(total.component_weights / MAX_OBJECTS)
        return mixture.replace(particles=begun.where(born, particles), log_weights=log_weights)


def moments(mixture: ParticleMixture) -> Gaussian:
    """Those of each component: of the mixture of its particles' Gaussians."""
    particles, owner = mixture.particles, mixture.component_indicators
    place, velocity, *spread = (mixture.component_averages(row) for row in particles)
    away, away_velocity = particles.place - place[owner], particles.velocity - velocity[owner]
    products = away**2, away * away_velocity, away_velocity**2
    between = (mixture.component_averages(row) for row in products)
    return Gaussian(place, velocity, *(a + b for a, b in zip(spread, between, strict=True)))


def make_mixtures() -> dict[str, mpfjax.Filter]:
    """The same chain with resampling and with Gaussian regeneration."""
    tracker = ObjectTracker(MAX_OBJECTS)

    def chain(resampling: AbstractMove, matched: bool) -> mpfjax.Filter:
        moves = Decide(tracker, tracker.init()), resampling, FollowDetections(matched)
        size = MAX_OBJECTS * PARTICLES
        return mpfjax.Filter(NobodyYet(), moves, size, MAX_OBJECTS, initial_moves=[Seats()])

    def motion(states: Gaussian) -> tuple[Array, Array]:
        return states.place, states.velocity

    regenerated = mpfjax.GaussianRegeneration(PARTICLES, where=motion, noise="stratified")
    return {
        "mpf": chain(mpfjax.Resample(particles_per_component=PARTICLES), matched=False),
        "gm_mpf": chain(regenerated, matched=True),
    }


def follow_detected(
    filter: mpfjax.Filter, keys: Array, stills: Iterable[np.ndarray], kept: list[Tracks]
) -> Iterator[Snapshot]:
    """A snapshot of the runs of a mixture for each frame, whose tracks go into `kept`."""
    detector = BackgroundSubtraction()
    mixtures = jax.vmap(filter.init)(keys)
    for t, still in enumerate(stills):
        found = Detections.from_boxes(detector.detect(still), MAX_DETECTIONS)
        seen = Seen(found, colours_of(still, found))
        mixtures, *done = _advance(filter, keys, jnp.asarray(t), mixtures, seen)
        tracks, snapshot = jax.tree.map(np.asarray, done)
        kept.append(tracks)
        yield snapshot


def rows_of_tracks(
    kept: list[Tracks], first: int, num_runs: int, snapshots: list[Snapshot]
) -> list[np.ndarray]:
    """The rows of each run's tracks, as many frames as there are snapshots."""
    rows, tracked = [], kept[: len(snapshots)]
    for run in range(num_runs):
        own = (jax.tree.map(lambda leaf, run=run: leaf[run], each) for each in tracked)
        rows.append(offline_rows(own, first))
    return rows


@eqx.filter_jit
def _advance(filter, keys, t, mixtures, seen):
    def step(key, mixture):
        mixture, _ = filter.step(jax.random.fold_in(key, t), mixture, seen)
        tracks = mixture.memory[DECIDED].tracks
        means = boxes_of(mixture.component_averages(mixture.particles.place))
        owner = mixture.component_indicators
        labels = jnp.where(tracks.identities[owner] > 0, owner, -1)
        points = mixture.particles.place[:, :2]
        snapshot = Snapshot(means, tracks.shown, points, labels)
        return mixture, tracks._replace(boxes=means), snapshot

    return jax.vmap(step)(keys, mixtures)
