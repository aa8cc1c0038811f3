"""The scenes through SQMC of particles (Chopin and Papaspiliopoulos), with our model's functions.

particles has no x_0 before the first observation, so its time 0 is given a potential of one, and
its time t is ours. It takes a state for a row of numbers, along whose Hilbert curve it sorts.
"""
# The rival is installed for this benchmark only.
# pyright: reportMissingImports=false
# ruff: noqa: NPY002

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import particles
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from benchmarks.masses.__main__ import Found
from benchmarks.masses.scenes import Scene


class FeynmanKac(particles.FeynmanKac):
    """The bootstrap filter of a scene, made of uniform numbers."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(len(scene.observations) + 1)
        model = scene.model
        dimension, start = model.noise_dimension, model.initial_noise_dimension
        self.du = max(start, dimension)
        self.observations = jnp.asarray(scene.observations)
        one = jax.tree.map(lambda leaf: leaf[0], model.sample_initial(jax.random.key(0), 2))
        states_of = jax.vmap(ravel_pytree(one)[1])
        rows_of = jax.vmap(lambda state: ravel_pytree(state)[0])

        def first(shares: Array) -> Array:
            return rows_of(model.initial_from_noise(_normal(shares[:, :start])))

        def following(rows: Array, shares: Array) -> Array:
            noise = _normal(shares[:, :dimension])
            return rows_of(model.transition_from_noise(noise, states_of(rows)))

        self.first, self.following = jax.jit(first), jax.jit(following)
        self.weigh = jax.jit(lambda seen, rows: model.log_likelihood(seen, states_of(rows)))
        self.regions = jax.jit(lambda rows: scene.region(states_of(rows)))

    def Gamma0(self, u: np.ndarray) -> np.ndarray:
        """x_0."""
        return _squeezed(self.first(_columns(u)))

    def Gamma(self, t: int, xp: np.ndarray, u: np.ndarray) -> np.ndarray:
        """A step of the dynamics."""
        return _squeezed(self.following(_columns(xp), _columns(u)))

    def logG(self, t: int, xp: np.ndarray | None, x: np.ndarray) -> np.ndarray:
        """log L(y_t | x_t); zero for x_0."""
        if t == 0:
            return np.zeros(len(x))
        return np.asarray(self.weigh(self.observations[t - 1], _columns(x)), float)


def results_and_time(
    scene: Scene, num_particles: int, seeds: int, seed: int
) -> tuple[Found, float]:
    """What the runs say, and the median milliseconds of a step."""
    model = FeynmanKac(scene)
    found, logs, seconds = [], [], []
    for k in range(-1, seeds):  # the first one compiles
        np.random.seed(seed + k + 1)
        start = time.perf_counter()
        smc: Any = particles.SMC(fk=model, N=num_particles, qmc=True)
        smc.run()
        seconds.append(time.perf_counter() - start)
        regions = np.asarray(model.regions(_columns(smc.X)))
        found.append(np.bincount(regions, weights=smc.W, minlength=scene.num_regions))
        logs.append(smc.logLt)
    milliseconds = 1e3 * float(np.median(seconds[1:])) / len(scene.observations)
    return Found(np.array(found[1:]), np.array(logs[1:])), milliseconds


def _normal(shares: Array) -> Array:
    return jax.scipy.special.ndtri(jnp.clip(shares, 1e-7, 1 - 1e-7))


def _columns(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, np.float32).reshape(len(values), -1)


def _squeezed(values: Any) -> np.ndarray:
    rows = np.asarray(values, float)
    return rows[:, 0] if rows.shape[1] == 1 else rows
