"""The random scenes, of objects that are lost, distracted, or cross, and the model of an object."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

import mpfjax

# The scenes' constants, chosen once for all methods. Pixels and frames.
BOX = 20.0  # sides of every object's box
MOMENTUM, DEVIATION = 0.5, 3.0  # AR2, as in the paper
SHARPNESS = 20.0  # λ
REACH = 8.0  # over which a box that is shifted stops looking like its object
NUM_FRAMES = 32
UNLIKE = 0.2  # how much an object looks like one of another kind
LOST = slice(12, 22)  # unseen in these frames
JUMP = 42.0  # from where the lost object was last seen to where it comes back
DISTRACTED = slice(3, 9)  # the distracter covers object 0 in the first of these frames
LEAD = 6.0  # by which it leads away in a frame
LIKENESS = 0.8  # of object 0 to its own reference, which the distracter fits exactly
MISSED = 0.2  # the share of frames in which one of a pair is not seen
PASSING = (40.0, 9.0)  # where one of a pair comes from and how far off the middle line it passes


class Blob(mpfjax.AbstractStateSpaceModel):
    """An object that moves by AR2 and is seen as a bump, among the bumps of others.

    The states are {"now": x_t, "before": x_{t-1}}, each (n, 2). log L = -λ d², where d² is one
    minus the largest a_k exp(-|x - o_k|² / 2s²) over the bumps k: it has no floor but λ, as a
    histogram distance has none but one.
    """

    start: Float[Array, "*objects 2"]
    before: Float[Array, "*objects 2"]

    def sample_initial(self, key, num_particles):
        shift = 2.0 * jax.random.normal(key, (num_particles, 2))
        return {"now": self.start[None] + shift, "before": self.before[None] + shift}

    def sample_transition(self, key, states):
        noise = DEVIATION * jax.random.normal(key, states["now"].shape)
        return {"now": expected(states) + noise, "before": states["now"]}

    def log_transition(self, states, previous_states):
        return -0.5 * squares(states["now"] - expected(previous_states)) / DEVIATION**2

    def with_history(self, states, previous_states):
        return {"now": states["now"], "before": previous_states["now"]}

    def log_likelihood(self, observation, states):
        bumps = jax.vmap(
            lambda place, height: (
                height * jnp.exp(-0.5 * squares(states["now"] - place[None]) / REACH**2)
            )
        )(observation["places"], observation["heights"])
        return -SHARPNESS * (1 - jnp.max(bumps, axis=0))


def expected(states: dict[str, Float[Array, "n 2"]]) -> Float[Array, "n 2"]:
    """x_{t-1} + 0.5 (x_{t-1} - x_{t-2})."""
    return states["now"] + MOMENTUM * (states["now"] - states["before"])


def squares(vectors: Float[Array, "n 2"]) -> Float[Array, " n"]:
    """|v|² of every row, written out."""
    return vectors[:, 0] ** 2 + vectors[:, 1] ** 2


def place_of(states: dict[str, Float[Array, "n 2"]]) -> Float[Array, "n 2"]:
    """Where an object is, for the repulsion."""
    return states["now"]


class Scene(NamedTuple):
    """One random scene: where the objects are, and what is seen of them."""

    places: Float[Array, "t objects 2"]
    seen: dict[str, Array]  # every leaf (t, objects, ...)


class Setting(NamedTuple):
    """A kind of scene and what is asked of it."""

    title: str
    num_objects: int
    num_particles: int
    hard: tuple[int, ...]  # the objects that have to be tracked at the end
    make: Callable[[Key[Array, ""]], Scene]


def wander(key: Key[Array, ""], starts: Float[Array, "objects 2"]) -> Float[Array, "t objects 2"]:
    """Paths that the model itself might have drawn; frame 0 is x_0."""
    noise = DEVIATION * jax.random.normal(key, (NUM_FRAMES, *starts.shape))

    def move(states, noise):
        now, before = states
        return (now + MOMENTUM * (now - before) + noise, now), now

    return jax.lax.scan(move, (starts, starts), noise)[1]


def times() -> Float[Array, " t"]:
    """The frames, counted from 0."""
    return jnp.arange(float(NUM_FRAMES))


def grid(num_objects: int, spacing: float) -> Float[Array, "objects 2"]:
    """Places in rows of four."""
    index = np.arange(num_objects)
    return jnp.asarray(spacing * np.stack([index % 4, index // 4], axis=1), jnp.float32)


def direction(key: Key[Array, ""]) -> Float[Array, "2"]:
    """Any direction."""
    angle = jax.random.uniform(key, (), maxval=2 * jnp.pi)
    return jnp.array([jnp.cos(angle), jnp.sin(angle)])


def jump(key: Key[Array, ""], path: Float[Array, "t 2"]) -> Float[Array, "t 2"]:
    """The path of an object that is displaced, in any direction, while nobody sees it."""
    away = JUMP * direction(key)
    last, back = LOST.start - 1, LOST.stop
    share = jnp.clip((times() - last) / (back - last), 0.0, 1.0)
    hidden = path[last][None] + share[:, None] * away[None]
    after = path[last] + away - path[back]
    moved = jnp.where((times() >= back)[:, None], path + after[None], hidden)
    return jnp.where((times() <= last)[:, None], path, moved)


def cross(key: Key[Array, ""], centre: Float[Array, "2"]) -> Float[Array, "t 2 2"]:
    """Two objects that come from two sides, linger side by side, and pass each other."""
    key_angle, key_noise = jax.random.split(key)
    cos, sin = direction(key_angle)
    u = (times() - (NUM_FRAMES - 1) / 2) / ((NUM_FRAMES - 1) / 2)
    along, aside = PASSING[0] * u**3, jnp.full(NUM_FRAMES, PASSING[1])
    turned = jnp.stack([cos * along - sin * aside, sin * along + cos * aside], axis=1)
    noise = 0.5 * jax.random.normal(key_noise, (NUM_FRAMES, 2, 2))
    return centre[None, None] + jnp.stack([turned, -turned], axis=1) + noise


def look(
    places: Float[Array, "t objects 2"],
    visible: Bool[Array, "t objects"],
    alike: Float[np.ndarray, "objects objects"],
    distracter: Float[Array, "t 2"] | None = None,
) -> Scene:
    """What each object's likelihood sees: the bumps of all that look like it, and how much."""
    num_objects = places.shape[1]
    heights = jnp.where(visible[:, None, :], jnp.asarray(alike, jnp.float32)[None], 0.0)
    there = jnp.zeros((NUM_FRAMES, num_objects, 1))
    extra = jnp.zeros((NUM_FRAMES, 1, 2))
    if distracter is not None:
        heights = heights.at[:, 0, 0].multiply(LIKENESS)
        there = there.at[DISTRACTED, 0].set(1.0)
        extra = distracter[:, None]
    bumps = jnp.concatenate([places, extra], axis=1)
    seen = {
        "places": jnp.broadcast_to(bumps[:, None], (NUM_FRAMES, num_objects, *bumps.shape[1:])),
        "heights": jnp.concatenate([heights, there], axis=2),
    }
    return Scene(places, seen)


def kinds(*groups: int) -> Float[np.ndarray, "objects objects"]:
    """How much objects look alike, of groups of these sizes."""
    labels = np.repeat(np.arange(len(groups)), groups)
    return np.where(labels[:, None] == labels[None], 1.0, UNLIKE)


def missed(key: Key[Array, ""], num_objects: int) -> Bool[Array, "t objects"]:
    """Who is seen when, with detections that fail now and then, but for the first frames."""
    visible = jax.random.bernoulli(key, 1 - MISSED, (NUM_FRAMES, num_objects))
    return visible | (times() < 3)[:, None]


def lost_object(key: Key[Array, ""]) -> Scene:
    key_paths, key_jump = jax.random.split(key)
    places = wander(key_paths, grid(4, 120.0))
    places = places.at[:, 3].set(jump(key_jump, places[:, 3]))
    return look(places, jnp.ones((NUM_FRAMES, 4), bool).at[LOST, 3].set(False), kinds(1, 1, 1, 1))


def distracted_object(key: Key[Array, ""]) -> Scene:
    key_paths, key_angle = jax.random.split(key)
    places = wander(key_paths, grid(7, 120.0))
    away = LEAD * (times() - DISTRACTED.start)[:, None] * direction(key_angle)[None]
    distracter = places[DISTRACTED.start, 0][None] + away
    visible = jnp.ones((NUM_FRAMES, 7), bool).at[DISTRACTED.start, 0].set(False)
    return look(places, visible, kinds(*[1] * 7), distracter)


def crossing_pairs(key: Key[Array, ""]) -> Scene:
    keys = jax.random.split(key, 3)
    centres = jnp.array([[0.0, 0.0], [200.0, 0.0]])
    places = jnp.concatenate([cross(keys[i], centres[i]) for i in range(2)], axis=1)
    return look(places, missed(keys[2], 4), kinds(4))


def pair_and_lost(key: Key[Array, ""]) -> Scene:
    keys = jax.random.split(key, 4)
    pair = cross(keys[0], jnp.zeros(2))
    others = wander(keys[1], jnp.array([[200.0, 0.0], [0.0, 200.0]]))
    others = others.at[:, 1].set(jump(keys[2], others[:, 1]))
    places = jnp.concatenate([pair, others], axis=1)
    visible = missed(keys[3], 4).at[:, 2:].set(True).at[LOST, 3].set(False)
    return look(places, visible, kinds(2, 1, 1))


SCENES = {
    "a": Setting("one of four hidden, reappears elsewhere", 4, 200, (3,), lost_object),
    "b": Setting("one of seven, with a distracter", 7, 300, (0,), distracted_object),
    "c": Setting("two similar pairs cross", 4, 200, (0, 1, 2, 3), crossing_pairs),
    "d": Setting("one pair, one easy object, one lost", 4, 200, (0, 1, 2, 3), pair_and_lost),
    "e": Setting("as c, with half the particles", 4, 100, (0, 1, 2, 3), crossing_pairs),
}
