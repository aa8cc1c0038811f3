"""A filter: a chain of moves on a particle mixture, one step at a time."""

from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from mpfjax.chain import (
    INCREMENT,
    StepInfo,
    check_chain,
    forgetting,
    give_inputs,
    moved_by,
    normalised,
    own_ancestors,
    start_and_faults,
    step_and_faults,
    step_info,
    tie,
    untie,
)
from mpfjax.checks import Count, checked
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.noise import Noise
from mpfjax.models.observations import one_input, one_observation, raise_faults
from mpfjax.moves.base import AbstractMove, as_moves, initial_memory
from mpfjax.moves.initial import sample_initial
from mpfjax.operations.compiling import jit_with_floats_traced
from mpfjax.operations.random import split, split_keys
from mpfjax.operations.stored import drawn_once


class Filter(eqx.Module):
    """A particle filter: a chain of moves on a particle mixture.

    One step applies the moves in order and normalises. The growth of the total mass is the
    increment of the marginal likelihood, whatever the moves are.

    - `model`: draws x_0. Moves that hold the very same model share it. The filter is then a pytree
      with one copy of the model's parameters, and a gradient with respect to them is complete.
    - `moves`: callables `(key, mixture, observation) -> mixture`, usually `AbstractMove`s.
    - `num_particles`: N.
    - `num_components`: M, the most components; recipes call it `max_components`.
    - `initial_moves`: moves of x_0, which are given y_1 where it is known: regrouping, such as
      `KMeans(reseed=True)`, and `SelectInitial`. What they weigh is part of the first increment.
    - `initial_noise`: of x_0, where the model has `initial_from_noise`: that of `Propagate`.

    Raises `ValueError` for N < 1, M < 1, N < M, no moves, moves that never use an observation, or
    fewer slots than `particles_per_component` asks for.
    """

    model: AbstractStateSpaceModel
    _moves: tuple[Any, ...]
    _initial_moves: tuple[Any, ...]
    num_particles: int = eqx.field(static=True)
    num_components: int = eqx.field(static=True)
    initial_noise: Noise = eqx.field(static=True)

    @checked
    def __init__(
        self,
        model: AbstractStateSpaceModel,
        moves: Iterable[Callable[..., ParticleMixture]],
        num_particles: Count,
        num_components: Count = 1,
        initial_moves: Iterable[AbstractMove] = (),
        initial_noise: Noise = "independent",
    ) -> None:
        moves = as_moves(moves, "moves")
        check_chain(moves, num_particles, num_components)
        self.model = model
        self._moves = tie(moves, model)
        self._initial_moves = tie(as_moves(initial_moves, "initial_moves"), model)
        self.num_particles, self.num_components = int(num_particles), int(num_components)
        self.initial_noise = initial_noise

    @property
    def moves(self) -> tuple[Any, ...]:
        """The moves of one step; those that share the filter's model hold it."""
        return untie(self._moves, self.model)

    @property
    def initial_moves(self) -> tuple[Any, ...]:
        """The moves of x_0."""
        return untie(self._initial_moves, self.model)

    @property
    def approximate(self) -> bool:
        """Whether any move departs from the exact recursion."""
        return any(move.approximate for move in self.moves)

    def replace(self, **changes: Any) -> "Filter":
        """The filter with other arguments; moves that share its model share the new one."""
        kept = ("num_particles", "num_components", "initial_noise")
        own = {name: getattr(self, name) for name in kept}
        own["model"] = model = changes.get("model", self.model)
        own["moves"] = untie(self._moves, model)
        own["initial_moves"] = untie(self._initial_moves, model)
        return Filter(**own | changes)

    @checked
    def init(
        self, key: Key[Array, ""], observation: PyTree = None, *, inputs: PyTree = None
    ) -> ParticleMixture:
        """The mixture of x_0: draws with equal weights, changed by the initial moves.

        Give it y_1, and u_1 if there are inputs, where an initial move looks at them, such as
        `SelectInitial`; without y_1 that move does nothing. y_1 is then given to `step` as well.
        """
        if observation is not None:
            observation = one_observation(observation)
        inputs = one_input(inputs, self.model)
        keys = split(key, 1 + len(self._initial_moves))
        # Not in one program with the moves, on which the last digits of the draws would depend.
        particles = drawn_once(keys[0], self._sample_initial)
        return raise_faults(*_start(self, keys, observation, inputs, particles))

    def _sample_initial(self, key: Key[Array, ""]) -> PyTree:
        return sample_initial(key, self.model, self.num_particles, self.initial_noise)

    def _init(
        self, key: Key[Array, "*keys"], observation: PyTree = None, particles: PyTree = None
    ) -> ParticleMixture:
        """x_0 within a program, of these particles if they are there."""
        key_drawn, *keys = split_keys(key, 1 + len(self._initial_moves))
        if particles is None:
            draw = self._sample_initial
            particles = drawn_once(key_drawn, draw) if keys else draw(key_drawn)
        mixture = single_component(particles, self.num_components)
        increment = {INCREMENT: jnp.zeros_like(mixture.log_scale)} if self._reads_increment else {}
        memory = initial_memory(self.moves, self.num_components) | increment
        mixture = mixture.replace(memory=memory)
        for move_key, move in zip(keys, self.initial_moves, strict=True):
            mixture = move(move_key, mixture, observation)
        if self.looks_at_first:
            mixture, log_mass = normalised(mixture, mixture)
            mixture = mixture.replace(log_scale=log_mass)
        return mixture

    @property
    def looks_at_first(self) -> bool:
        """Whether the initial moves may weigh x_0, by y_1 or otherwise."""
        return any(move.weighs for move in self._initial_moves)

    @property
    def _reads_increment(self) -> bool:
        return any(INCREMENT in move.reads for move in self._moves)

    def with_inputs(self, inputs: PyTree) -> "Filter":
        """The filter at a step whose known inputs are u_t, which every model in it receives.

        `step`, `predict` and the runners do this themselves. None leaves the filter as it is.
        """
        return give_inputs(self, self.model, inputs)

    def step(
        self,
        key: Key[Array, ""],
        mixture: ParticleMixture,
        observation: PyTree,
        *,
        inputs: PyTree = None,
    ) -> tuple[ParticleMixture, StepInfo]:
        """The mixture at t and a report, from the mixture at t-1, y_t and the known inputs u_t.

        A NaN or infinite observation is an error, unless the model has `handles_missing`. For a
        step without an observation call `predict`. If every particle has zero likelihood, the
        increment is -inf, the particles keep the weights that they had before, and `degenerate`
        is true.
        """
        return self._run(key, mixture, one_observation(observation), inputs)

    def predict(
        self, key: Key[Array, ""], mixture: ParticleMixture, *, inputs: PyTree = None
    ) -> tuple[ParticleMixture, StepInfo]:
        """One step without an observation: the particles propagate, the weights stay.

        Use it for a missing y_t, or to forecast. The increment is zero. Raises `ValueError` for a
        move without a method `predict`.
        """
        return self._run(key, mixture, None, inputs)

    @checked
    def _run(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree, inputs: PyTree
    ) -> tuple[ParticleMixture, StepInfo]:
        if (found := mixture.num_components) != (own := self.num_components):
            raise ValueError(f"mixture: num_components, {found}, is not the filter's, {own}")
        inputs = one_input(inputs, self.model)
        *moved, faults = _one_step(self, key, mixture, observation, inputs)
        return raise_faults(tuple(moved), faults)

    def _step(
        self, key: Key[Array, "*keys"], mixture: ParticleMixture, observation: PyTree = None
    ) -> tuple[ParticleMixture, StepInfo]:
        """A step within a program; without an observation it only predicts."""
        mixture = own_ancestors(mixture)
        resampled = jnp.zeros(self.num_components, bool)
        increment = jnp.zeros((), mixture.log_weights.dtype)
        for move_key, move in zip(split_keys(key, len(self._moves)), self.moves, strict=True):
            if self._reads_increment:
                mixture = mixture.replace(memory=mixture.memory | {INCREMENT: increment})
            moved, redrawn = moved_by(move, move_key, mixture, observation, self)
            if observation is not None and not move.keeps_mass:
                moved, log_growth = normalised(moved, mixture)
                increment += log_growth
            resampled |= redrawn
            mixture = forgetting(self.moves, moved)
        mixture = mixture.replace(parents=None, in_order=False)
        return mixture, step_info(self.moves, mixture, observation, increment, resampled)


_one_step = jit_with_floats_traced(step_and_faults)
_start = jit_with_floats_traced(start_and_faults)
