"""A filter: a chain of moves on a particle mixture, one step at a time."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, checked, format_fields, kinds, shown
from mpfjax.memory import after_step
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import AbstractStateSpaceModel, periods_of, with_inputs
from mpfjax.models.law import law_of
from mpfjax.models.noise import Noise
from mpfjax.models.observations import one_input, one_observation
from mpfjax.moves import base
from mpfjax.operations.compiling import jit_with_floats_traced
from mpfjax.operations.random import split
from mpfjax.operations.stored import drawn_once
from mpfjax.report import StepInfo, report_of, with_densities


class Filter(eqx.Module):
    """A particle filter: a chain of moves on a particle mixture.

    One step applies the moves in order and normalises. The growth of the total weight is the
    increment of the marginal likelihood, for any moves.

    - `model`: draws x_0, and is passed to the moves, which store none. So the filter is a pytree
      with one copy of the model's parameters, and a gradient with respect to them is complete.
    - `moves`: callables `(key, mixture, now) -> mixture`, usually `AbstractMove`s; `now` is a
      `Step`.
    - `num_particles`: N.
    - `num_components`: M, the maximum number of components; the filters of the literature call it
      `max_components`.
    - `initial_moves`: moves of x_0, which receive y_1 if it is known: regrouping, such as
      `KMeans(reseed=True)`, and `SelectInitial`. Weights that they change enter the first
      increment.
    - `initial_noise`: the noise of x_0, if the model has `initial_from_noise`; see `Propagate`.

    Raises `ValueError` for N < 1, M < 1, N < M, no moves, moves that never use an observation, a
    model that a move does not support, or fewer slots than `particles_per_component` requires.
    """

    model: AbstractStateSpaceModel
    moves: base.Moves
    initial_moves: base.Moves
    num_particles: int = eqx.field(static=True)
    num_components: int = eqx.field(static=True)
    initial_noise: Noise = eqx.field(static=True)
    _keeps_parents: bool = eqx.field(static=True, init=False, repr=False)

    @checked
    def __init__(
        self,
        model: AbstractStateSpaceModel,
        moves: Iterable[Callable[..., ParticleMixture]],
        num_particles: Count,
        num_components: Count = 1,
        initial_moves: Iterable[Callable[..., ParticleMixture]] = (),
        *,
        initial_noise: Noise = "independent",
    ) -> None:
        self.model = model
        self.moves = base.as_moves(moves, "moves")
        self.initial_moves = base.as_moves(initial_moves, "initial_moves")
        self.num_particles, self.num_components = int(num_particles), int(num_components)
        self.initial_noise = initial_noise
        self._keeps_parents = any(move.needs_parents for move in self.moves)

    def __check_init__(self) -> None:
        if self.num_particles < self.num_components:
            which = f"is less than num_components, {self.num_components}"
            raise ValueError(f"num_particles: {self.num_particles} {which}")
        if not any(move.weighs for move in self.moves):
            who = f"moves: {', '.join(map(base.name_of, self.moves)) or 'none'}"
            raise ValueError(f"{who} never weigh the particles by what is observed, as Propagate")
        now, moves = self._now(), (*self.initial_moves, *self.moves)
        if (check := getattr(self.model, "check_moves", None)) is not None:
            check(base.all_of(moves))
        for move in moves:
            move.check(now, self.num_particles, self.num_components)
        base.memory_of(self.moves, now, self.num_components)
        if self._keeps_parents:
            each = enumerate(self.moves)
            first = next((t for t, move in each if isinstance(move, base.AbstractPropagation)), 0)
            base.check_keep_parents("moves", self.moves[first:], "another move")

    @property
    def approximate(self) -> bool:
        """Whether any move, including the initial ones, departs from the exact recursion."""
        return any(move.approximate for move in (*self.initial_moves, *self.moves))

    @property
    def weighs_initially(self) -> bool:
        """Whether an initial move changes the weights of x_0, by y_1 or otherwise."""
        return any(move.weighs for move in self.initial_moves)

    def __repr__(self) -> str:
        return format_fields(self)

    def replace(self, **changes: Any) -> "Filter":
        """The filter with other arguments, which are checked again."""
        return dataclasses.replace(self, **changes)

    @checked
    def init(
        self, key: Key[Array, ""], observation: PyTree = None, *, inputs: PyTree = None
    ) -> ParticleMixture:
        """The mixture of x_0: draws with equal weights, changed by the initial moves.

        Pass y_1, and u_1 if there are inputs, if an initial move uses them, such as
        `SelectInitial`; without y_1 that move does nothing. Pass y_1 to `step` as well.
        """
        if observation is not None:
            observation = one_observation(observation, self.model)
        inputs = one_input(inputs, self.model)
        keys = split(key, 1 + len(self.initial_moves))
        # Not in one program with the moves, on which the last digits of the draws would depend.
        particles = drawn_once(keys[0], self._sample_initial)
        return _start(self, keys, observation, inputs, particles)

    @checked
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
        increment is -inf, the particles keep their previous weights, and `degenerate` is true.
        """
        return self._run(key, mixture, one_observation(observation, self.model), inputs)

    @checked
    def predict(
        self, key: Key[Array, ""], mixture: ParticleMixture, *, inputs: PyTree = None
    ) -> tuple[ParticleMixture, StepInfo]:
        """One step without an observation: the particles are propagated, the weights do not change.

        Use it for a missing y_t, or to forecast. The increment is zero.
        """
        return self._run(key, mixture, None, inputs)

    def _run(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree, inputs: PyTree
    ) -> tuple[ParticleMixture, StepInfo]:
        if (number := mixture.num_components) != self.num_components:
            raise ValueError(
                f"mixture: num_components, {number}, is not the filter's, {self.num_components}"
            )
        inputs = one_input(inputs, self.model)
        moved, info = _one_step(self, key, mixture, observation, inputs)
        return with_densities((moved, info), info.log_likelihood_increment)

    # Within a program.

    def _now(
        self, observation: PyTree = None, inputs: PyTree = None, is_initial: bool = False
    ) -> base.Step:
        """The step with this y_t and u_t."""
        return base.Step(with_inputs(self.model, inputs), observation, inputs, self, is_initial)

    def _sample_initial(self, key: Key[Array, ""]) -> PyTree:
        return law_of(self.model).sample_initial(key, self.num_particles, self.initial_noise)

    def _init(
        self,
        key: Key[Array, "*keys"],
        observation: PyTree = None,
        inputs: PyTree = None,
        particles: PyTree = None,
    ) -> ParticleMixture:
        """The mixture of x_0, of these particles if they are there."""
        key_drawn, *keys = split(key, 1 + len(self.initial_moves))
        if particles is None:
            draw = self._sample_initial
            particles = drawn_once(key_drawn, draw) if keys else draw(key_drawn)
        mixture = single_component(particles, self.num_components)
        now = self._now(observation, inputs, is_initial=True)
        mixture = mixture.replace(memory=base.memory_of(self.moves, now, self.num_components))
        for move_key, move in zip(keys, self.initial_moves, strict=True):
            mixture = move(move_key, mixture, now)
        if self.weighs_initially:
            mixture, log_mass = mixture.normalised(mixture)
            mixture = mixture.replace(log_scale=log_mass, waits=log_mass != 0)
        return mixture.replace(periods=periods_of(now.model))

    def _step(
        self,
        key: Key[Array, "*keys"],
        mixture: ParticleMixture,
        observation: PyTree = None,
        inputs: PyTree = None,
    ) -> tuple[ParticleMixture, StepInfo]:
        """A step; without an observation it only predicts."""
        now, mixture = self._now(observation, inputs), mixture.at_step()
        for move_key, move in zip(split(key, len(self.moves)), self.moves, strict=True):
            if self._keeps_parents and isinstance(move, base.AbstractPropagation):
                mixture = mixture.with_parents()
            moved = check_result(move(move_key, mixture, now), mixture, move)
            if observation is not None and not move.keeps_mass:
                moved = moved.normalised_within(mixture)
            mixture = moved
        mixture, additions = after_step(mixture, now)
        report = report_of(mixture, **additions)
        return mixture.replace(within=None, periods=periods_of(now.model)), report


_one_step = jit_with_floats_traced(Filter._step)
_start = jit_with_floats_traced(Filter._init)


def check_result(moved: Any, mixture: ParticleMixture, move: base.AbstractMove) -> ParticleMixture:
    """The result of a move; a `ValueError` unless it is a mixture of the same shapes and types."""
    if not isinstance(moved, ParticleMixture):
        who = f"moves: {base.name_of(move)} returned"
        raise ValueError(f"{who} {shown(moved)}, no ParticleMixture")
    expected = kinds((mixture.particles, mixture.log_weights, mixture.component_indicators))
    actual = kinds((moved.particles, moved.log_weights, moved.component_indicators))
    if actual != expected:
        raise ValueError(f"moves: {base.name_of(move)} returned {actual}, and was given {expected}")
    return moved
