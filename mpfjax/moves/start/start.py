"""A start by the first observations, in place of draws of x_0 that few of them fit."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture, no_ancestors
from mpfjax.moves.base import AbstractMove, AbstractWrapper, Moves, Step, as_moves, is_missing
from mpfjax.moves.start.window import (
    Window,
    check_start,
    first_paths,
    inputs_of,
    observe,
    with_derivatives,
)
from mpfjax.operations.logarithms import add_gradient, default_float, log_sum_exp
from mpfjax.operations.random import split
from mpfjax.operations.stored import cond_if_any


def empty_window(now: Step, num_steps: int) -> Window:
    """Room for so many steps like this one, none of them present."""

    def room(leaf: Array) -> Array:
        return jnp.zeros((num_steps, *jnp.shape(leaf)), jnp.asarray(leaf).dtype)

    observations, inputs = jax.tree.map(room, (now.observation, inputs_of(now.model)))
    return Window(observations, inputs, jnp.zeros(num_steps, bool))


def with_step(window: Window, place: Array, now: Step) -> Window:
    """The window with this step at a place; an observation that is missing is not present there."""

    def put(leaves: Array, leaf: Any) -> Array:
        return leaves.at[place].set(jnp.asarray(leaf, leaves.dtype))

    observations = window.observations
    if not is_missing(now):
        observations = jax.tree.map(put, observations, now.observation)
    inputs = jax.tree.map(put, window.inputs, inputs_of(now.model))
    return Window(observations, inputs, window.present.at[place].set(not is_missing(now)))


class Begin(AbstractMove):
    """The initial move of a `Start`: the paths before any observation, and room for these.

    Without y_1, whose shapes it needs, it does nothing, and x_0 are plain draws.
    """

    num_observations: Count = eqx.field(static=True)

    weighs = False
    keeps_mass = True

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture that remembers paths."""
        if is_missing(now):
            return mixture
        memory = {
            "paths": first_paths(key, now.model, mixture.num_particles, self.num_observations),
            "window": empty_window(now, self.num_observations),
            "steps": jnp.zeros((), jnp.int32),
            "score": jnp.zeros((), default_float()),
        }
        return mixture.replace(memory=mixture.memory | {START: memory})


START = "the first observations"


class Start(AbstractWrapper):
    """In the first steps a tempered sampler of x_0 and noise, then the moves of the chain.

    After y_t, t up to L, the particles are those of `window_start` on y_1, ..., y_t: equally
    weighted in each island, and grouped as x_0 is. They come from no single ones of the step
    before, since their past has moved too. Derivatives of the increments are the score, by Fisher's
    identity.

    - `moves`: the chain's, up to the last that does more than regroup.
    - `grouping`: of the particles in these steps; usually the initial moves.
    - `num_observations`: L.

    `with_start` makes a filter with it.
    """

    moves: Moves = eqx.field(converter=lambda moves: as_moves(moves, "moves"))
    grouping: Moves = eqx.field(converter=lambda moves: as_moves(moves, "grouping"))
    num_observations: Count = eqx.field(static=True, default=8)

    holds = ("moves", "grouping")
    weighs = True
    keeps_mass = False
    keeps_parents = False
    """their past moves too."""
    keeps_families = False

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model whose x_0 cannot be moved."""
        super().check(now, num_particles, num_components)
        check_start(now.model, "a start by the first observations moves x_0")

    def around(self, reference: Any) -> AbstractMove:
        """Raise a `ValueError`: no trajectory can be kept where all of it moves."""
        raise ValueError("filter: a start by the first observations cannot keep a trajectory")

    def would_resample(self, mixture: ParticleMixture, now: Step) -> Array:
        """What the moves would, after the first steps."""
        due = super().would_resample(mixture, now)
        return due if START not in mixture.memory else due & ~self._is_first(mixture)

    def _is_first(self, mixture: ParticleMixture) -> Array:
        return mixture.memory[START]["steps"] < self.num_observations

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture after the observation."""
        if mixture.usable_slots is not None:
            raise ValueError("slots: a start by the first observations needs every slot")

        def as_ever() -> ParticleMixture:
            return in_turn(key, self.moves, mixture, now)

        if START not in mixture.memory:
            return as_ever()
        # Runs of one `vmap` may be at different steps, and each kind of step runs if any needs it.
        is_first, same = self._is_first(mixture), mixture.replace(in_order=False)
        later = cond_if_any(~is_first, as_ever, lambda: same)

        def observed() -> ParticleMixture:
            first = self._observed(key, mixture, now)
            return jax.tree.map(lambda new, old: jnp.where(is_first, new, old), first, later)

        return cond_if_any(is_first, observed, lambda: later)

    def _observed(
        self, key: Key[Array, ""], mixture: ParticleMixture, now: Step
    ) -> ParticleMixture:
        """The particles after one of the first observations."""
        own, n = mixture.memory[START], mixture.num_particles
        key_observe, key_group = split(key, 2)
        # Within the window also where the result is not taken.
        place = jnp.minimum(own["steps"], self.num_observations - 1)
        window, t = with_step(own["window"], place, now), place + 1
        paths, log_mean = observe(key_observe, now.model, window, own["paths"], t, n)
        cloud = jax.tree.map(lambda leaf: leaf[:n], paths)
        particles, log_target = with_derivatives(now.model, window, cloud, t)
        log_mass = log_sum_exp(mixture.log_weights) - np.log(n)
        log_weights = add_gradient(jnp.full(n, 0.0, log_target.dtype), log_target) + log_mass
        score = add_gradient(jnp.zeros_like(log_mean), jnp.mean(log_target))
        memory = {"paths": paths, "window": window, "steps": t, "score": score}
        moved = mixture.replace(
            particles=particles,
            log_weights=log_weights,
            log_scale=mixture.log_scale + (log_mean - own["score"]),
            ancestor_indices=no_ancestors(mixture),
            memory=mixture.memory | {START: memory},
        )
        # Regrouping x_0 waits for no observation.
        at_start = dataclasses.replace(now, is_initial=True)
        return in_turn(key_group, self.grouping, moved, at_start)


def in_turn(
    key: Key[Array, ""], moves: Moves, mixture: ParticleMixture, now: Step
) -> ParticleMixture:
    """The mixture after the moves, one after the other."""
    for move_key, move in zip(split(key, len(moves)), moves, strict=True) if moves else ():
        mixture = move(move_key, mixture, now)
    return mixture.replace(in_order=False)
