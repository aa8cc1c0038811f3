"""Objects in a square of 2 km, seen every second in their position, among false plots."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

import mpfjax

STEPS, HALF_WIDTH, ROOM = 100, 1000.0, 100  # ROOM: plots of a scan
A = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
Q = 25.0 * np.kron(np.eye(2), [[0.25, 0.5], [0.5, 1.0]])
H, R, P0 = np.eye(4)[[0, 2]], 100.0 * np.eye(2), 100.0 * np.eye(4)
SPOTS = np.array([[0.0, 0.0], [400.0, -600.0], [-800.0, -200.0], [-200.0, 800.0]])
BIRTHS, SURVIVAL = 0.12, 0.99
# First and last step, spot, and velocity.
LIVES = (
    (0, 70, 0, 0, -10), (0, 100, 1, -10, 5), (0, 70, 2, 20, -5), (20, 100, 1, -7, -4),
    (20, 100, 1, -2.5, 10), (20, 100, 0, 7.5, -5), (40, 100, 2, 12, 7), (40, 100, 3, 15, -10),
    (60, 100, 2, 3, 15), (60, 100, 3, -3, -15), (80, 100, 0, -20, -15), (80, 100, 3, 15, -5),
)  # fmt: skip


class Scene(NamedTuple):
    """What a command line names, and what a filter is told of it."""

    known: bool  # whether objects appear at known spots, or anywhere
    p_d: float
    clutter: float


SCENES = {
    "known spots": Scene(True, 0.98, 60.0),
    "anywhere": Scene(False, 0.98, 60.0),
    "known spots, missed": Scene(True, 0.9, 60.0),
}


def drawn(scene: Scene, seed: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The true states, (t, k, 4), NaN where there is none, and plots, (t, ROOM, 2)."""
    rng = np.random.default_rng(seed)
    truth, plots = np.full((steps, len(LIVES), 4), np.nan), np.full((steps, ROOM, 2), np.nan)
    for k, (first, last, spot, vx, vy) in enumerate(LIVES):
        place = SPOTS[spot] if scene.known else rng.uniform(-600, 600, 2)
        for t in range(first, min(last, steps)):
            x, y = place + (t - first) * np.array([vx, vy])
            truth[t, k] = x, vx, y, vy
    for t in range(steps):
        there = truth[t, ~np.isnan(truth[t, :, 0])] @ H.T
        own = there + 10.0 * rng.normal(size=there.shape)
        own = own[rng.random(len(own)) < scene.p_d]
        false = rng.uniform(-HALF_WIDTH, HALF_WIDTH, (rng.poisson(scene.clutter), 2))
        seen = rng.permutation(np.concatenate([own, false]))[:ROOM]
        plots[t, : len(seen)] = seen
    return truth, plots


class Spots(mpfjax.AbstractBirth):
    """New objects near known spots, with velocities of 10 m/s."""

    rate: Any

    def sample(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n 4"]:
        """One of the spots, and a normal state around it."""
        key_spot, key_state = jax.random.split(key)
        spots = jax.random.choice(key_spot, jnp.asarray(SPOTS @ H, jnp.float32), (num_particles,))
        return spots + 10.0 * jax.random.normal(key_state, (num_particles, 4))


def _newborn(key: Key[Array, ""], places: Float[Array, "n 2"]) -> Float[Array, "n 4"]:
    v = 10.0 * jax.random.normal(key, places.shape)
    return jnp.stack([places[:, 0], v[:, 0], places[:, 1], v[:, 1]], axis=1)


def _locate(key: Key[Array, ""], plot: Float[Array, "2"], n: int) -> tuple[Array, Array]:
    noise = jax.random.normal(key, (n, 2))
    log_density = jnp.sum(jax.scipy.stats.norm.logpdf(noise), axis=1) - 2 * jnp.log(10.0)
    return plot[None] + 10.0 * noise, log_density


def model_of(scene: Scene) -> mpfjax.TargetsModel:
    """Motion, sensor, clutter and births."""
    square = mpfjax.Box([-HALF_WIDTH] * 2, [HALF_WIDTH] * 2)
    rate = jnp.asarray(BIRTHS)
    birth = Spots(rate) if scene.known else mpfjax.UniformBirth(rate, square, _newborn, _locate)
    motion = mpfjax.LinearGaussianModel(A, Q, H, R, np.zeros(4), P0)
    sensor = mpfjax.ClutteredModel(motion, scene.p_d, scene.clutter / (2 * HALF_WIDTH) ** 2)
    return mpfjax.TargetsModel(sensor, birth, SURVIVAL)


def told(truth: np.ndarray) -> tuple[np.ndarray, Bool[np.ndarray, "t k"]]:
    """Positions, and which are there."""
    return np.nan_to_num(truth @ H.T), ~np.isnan(truth[..., 0])
