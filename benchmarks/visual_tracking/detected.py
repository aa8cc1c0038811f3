"""Tracking without a drawn box: detections, and mixtures whose components are born of them."""

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import mpfjax
from benchmarks.visual_tracking.following import Snapshot
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove, AbstractPropagation
from mpfjax.vision import BackgroundSubtraction, ObjectTracker, Tracks
from mpfjax.vision.tracking.detections import BOXES, FrameDetections
from mpfjax.vision.tracking.gaussian import Gaussian, places_of, units
from mpfjax.vision.tracking.step import WEAK_ERROR, advance
from mpfjax.vision.tracking.track import offline_rows
from mpfjax.vision.tracking.tracker import with_colours

MAX_DETECTIONS, MAX_OBJECTS, PARTICLES = 32, 24, 16
# Weights within a component differ by at most the factor e^30.
FARTHEST = 30.0


class Seen(NamedTuple):
    """What the detections say of each of M components, as a tracker decided it.

    - `place`: (M, 4), of its detection; `there`, `born`: (M,), whether there is any, and whether
      the component begins there; `probability`: (M,), that the detection is its own.
    - `error`, `speed`: (M, 4), deviations of the detection, and of the velocity of a new object.
    - `noises`: (2, 4), deviations of place and velocity, in boxes.
    """

    place: Any
    there: Any
    born: Any
    probability: Any
    error: Any
    speed: Any
    noises: Any


class NobodyYet(mpfjax.AbstractStateSpaceModel):
    """x_0 of a mixture whose components detections start: `FollowDetections` moves them."""

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Gaussian:
        """Boxes of one pixel."""
        del key
        zero: Any = jnp.zeros((num_particles, 4))
        return Gaussian(zero, zero, zero, zero, zero)

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
        seen, owner = now.observation, mixture.component_indicators
        place, error = seen.place[owner], seen.error[owner]
        sizes = jnp.exp(mixture.particles.place[:, 2:])
        unit = jnp.concatenate([sizes, jnp.ones_like(sizes)], axis=1)
        with jax.numpy_rank_promotion("allow"):
            moved = mixture.particles.predict(*seen.noises, unit, 1.0)
        updated, gap, variance = moved.update(place, error)
        log_z = -0.5 * jnp.sum(gap**2 / variance + jnp.log(variance), axis=1)
        offset = log_z - mixture.component_expectations(log_z)[owner]
        ratio = jnp.exp(jnp.clip(offset, -FARTHEST, FARTHEST))
        p = seen.probability[owner]
        own = p * ratio / mixture.component_expectations(ratio)[owner]
        factor = jnp.where(seen.there[owner], own + 1 - p, 1.0)
        share = jnp.where(seen.there[owner], own / factor, 0.0)
        if not self.matched:
            share = jnp.where(jax.random.uniform(key, share.shape) < share, 1.0, 0.0)
        particles = updated.mix(moved, share[:, None])
        begun, born = Gaussian.initial(place, error, seen.speed[owner]), seen.born[owner]
        particles = jax.tree.map(partial(jnp.where, born[:, None]), begun, particles)
        weights = jnp.where(born, 1.0, mixture.component_weights * factor)
        total = mixture.replace(log_weights=jnp.log(weights))
        log_weights = jnp.log(total.component_weights / MAX_OBJECTS)
        return mixture.replace(particles=particles, log_weights=log_weights)


def moments(mixture: ParticleMixture) -> Gaussian:
    """Those of each component: of the mixture of its particles' Gaussians."""
    particles, owner = mixture.particles, mixture.component_indicators
    means: Any = jax.tree.map(mixture.component_expectations, particles)
    away = particles.place - means.place[owner]
    away_velocity = particles.velocity - means.velocity[owner]
    products = away**2, away * away_velocity, away_velocity**2
    spread = (
        a + mixture.component_expectations(b) for a, b in zip(means[2:], products, strict=True)
    )
    return Gaussian(means.place, means.velocity, *spread)


class Decider:
    """Which detection each component has, which components end and which begin, in one run.

    As an `ObjectTracker` decides it, with the moments of the particles in the place of its own.
    """

    def __init__(self) -> None:
        self.tracker = ObjectTracker(MAX_OBJECTS)
        self.state, self.seats = self.tracker.init(), dict[int, int]()  # by identity

    def decide(self, moments: Gaussian, found: FrameDetections) -> tuple[Tracks, Seen]:
        """The tracks, a row for each component, and what its particles need of them."""
        own = [self.seats[name] for name in self.state.lives.identities.tolist()]
        state = self.state._replace(objects=moments.at(np.array(own, int)))
        self.state, tracks = advance(self.tracker, state, found)
        names = tracks.identities.tolist()
        kept = {name: seat for name, seat in self.seats.items() if name in names}
        free = [seat for seat in range(MAX_OBJECTS) if seat not in kept.values()]
        new = [name for name in names if name not in kept]
        self.seats = kept | dict(zip(new, free, strict=False))
        born = np.isin(np.arange(MAX_OBJECTS), free[: len(new)])
        rows = np.full(MAX_OBJECTS, -1)
        rows[[self.seats[name] for name in names]] = np.arange(len(names))
        # A row more, the last, stands for nobody.
        filled = {
            name: np.pad(value, [(0, 1)] + [(0, 0)] * (np.ndim(value) - 1))[rows]
            for name, value in tracks._asdict().items() if np.ndim(value)
        }  # fmt: skip
        filled["detections"] = np.where(rows >= 0, filled["detections"], -1)
        tracks = tracks._replace(**filled)
        return tracks, self._seen(tracks, found, born)

    def _seen(self, tracks: Tracks, found: FrameDetections, born: np.ndarray) -> Seen:
        noises, there = self.state.noise.noises, tracks.detections >= 0
        rows = np.argmax(found.rows == tracks.detections[:, None], axis=1) if len(found.rows) else 0
        boxes = np.where(there[:, None], np.append(found.boxes, np.ones((1, 4)), axis=0)[rows], 1.0)
        weak = there & (np.append(found.scores, 0.0)[rows] < self.state.scores.strong)
        unit = units(places_of(boxes))
        return Seen(
            places_of(boxes), there, born, tracks.probabilities,
            unit * noises.errors * np.where(weak & ~born, WEAK_ERROR, 1.0)[:, None],
            unit * noises.speed, np.stack([noises.place, noises.velocity]),
        )  # fmt: skip


def make_mixtures() -> dict[str, mpfjax.Filter]:
    """The same chain with resampling and with Gaussian regeneration."""

    def chain(resampling: AbstractMove, matched: bool) -> mpfjax.Filter:
        moves, size = (resampling, FollowDetections(matched)), MAX_OBJECTS * PARTICLES
        return mpfjax.Filter(NobodyYet(), moves, size, MAX_OBJECTS, initial_moves=[Seats()])

    def motion(states: Gaussian) -> tuple[Any, Any]:
        return states.place, states.velocity

    regenerated = mpfjax.GaussianRegeneration(
        particles_per_component=PARTICLES, where=motion, noise="stratified"
    )
    return {
        "mpf": chain(mpfjax.Resample(particles_per_component=PARTICLES), matched=False),
        "gm_mpf": chain(regenerated, matched=True),
    }


def follow_detected(
    filter: mpfjax.Filter, keys: Array, stills: Iterable[np.ndarray], kept: list[list[Tracks]]
) -> Iterator[Snapshot]:
    """A snapshot of the runs of a mixture for each frame, whose tracks go into `kept`."""
    detector = BackgroundSubtraction()
    deciders = [Decider() for _ in keys]
    mixtures = jax.vmap(filter.init)(keys)
    for t, still in enumerate(stills):
        boxes = detector.detect(still)[:MAX_DETECTIONS]
        found = with_colours(FrameDetections.of(boxes, t + 1, still.shape[:2], BOXES), still)
        means = jax.tree.map(np.asarray, _moments(mixtures))
        of_runs = (Gaussian(*rows) for rows in zip(*means, strict=True))
        decided = [each.decide(one, found) for one, each in zip(of_runs, deciders, strict=True)]
        seen = jax.tree.map(lambda *leaves: np.stack(leaves).astype(_kind(leaves[0])),
                            *(of_run for _, of_run in decided))  # fmt: skip
        mixtures, boxes, points, owner = _advance(filter, keys, jnp.asarray(t), mixtures, seen)
        tracks = [of_run for of_run, _ in decided]
        shown = np.stack([of_run.shown for of_run in tracks])
        alive = np.stack([of_run.identities > 0 for of_run in tracks])
        labels = np.where(np.take_along_axis(alive, owner, axis=1), owner, -1)
        kept.append([
            each._replace(boxes=np.asarray(its)) for each, its in zip(tracks, boxes, strict=True)
        ])  # fmt: skip
        yield Snapshot(np.asarray(boxes), shown, np.asarray(points), labels)


def rows_of_tracks(
    kept: list[list[Tracks]], first: int, num_runs: int, snapshots: list[Snapshot]
) -> list[np.ndarray]:
    """The rows of each run's tracks, as many frames as there are snapshots."""
    tracked = [
        [each._replace(number=number) for each in runs]
        for number, runs in enumerate(kept[: len(snapshots)], first)
    ]
    return [offline_rows([runs[run] for runs in tracked]) for run in range(num_runs)]


def _kind(leaf: np.ndarray) -> type:
    return bool if leaf.dtype == bool else np.float32


@eqx.filter_jit
def _moments(mixtures: ParticleMixture) -> Gaussian:
    return jax.vmap(moments)(mixtures)


@eqx.filter_jit
def _advance(filter, keys, t, mixtures, seen):
    def step(key, mixture, of_run):
        mixture, _ = filter.step(jax.random.fold_in(key, t), mixture, of_run)
        place = mixture.component_expectations(mixture.particles.place)
        boxes = jnp.concatenate([place[:, :2], jnp.exp(place[:, 2:])], axis=1)
        return mixture, boxes, mixture.particles.place[:, :2], mixture.component_indicators

    return jax.vmap(step)(keys, mixtures, seen)
