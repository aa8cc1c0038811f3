"""A filter: a chain of moves on a particle mixture, one step at a time."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int, Key, PyTree

from mpfjax.chain import (
    as_moves,
    check_chain,
    forgetting,
    give_inputs,
    moved_by,
    normalised,
    own_ancestors,
    tie,
    untie,
)
from mpfjax.checks import check_key, check_one_of, check_type
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import AbstractStateSpaceModel, require_model
from mpfjax.models.inputs import saying_that_none_were_given
from mpfjax.models.noise import NOISES
from mpfjax.moves.base import AbstractMove
from mpfjax.moves.initial import sample_initial, waiting_for_choice
from mpfjax.moves.report import StepInfo, step_info
from mpfjax.observations import Fault, faults_of, one_input, one_observation, raise_faults
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced
from mpfjax.operations.islands import drawn_once
from mpfjax.operations.random import split_keys

BROKEN_DENSITY = "model: a density was NaN or infinite for some particle"


class Start(NamedTuple):
    """The start of a run: its key, and x_0 where that was drawn before."""

    key: Key[Array, "*seeds"]
    particles: PyTree = None
    """one for each slot; the slots after the first `num_particles` are empty."""
    num_particles: Int[Array, "*seeds"] | None = None
    mixture: ParticleMixture | None = None
    """the whole mixture of x_0."""


class Filter(eqx.Module):
    """A particle filter: a chain of moves on a particle mixture.

    One step applies the moves in order and normalises. The increment of the marginal likelihood is
    the growth of the total mass, whatever the moves are.

    - `model`: draws x_0. Moves that hold the very same model share it. The filter is then a pytree
      with one copy of the model's parameters, and a gradient with respect to them is complete.
    - `moves`: callables `(key, mixture, observation) -> mixture`, usually `AbstractMove`s.
    - `num_particles`: N.
    - `num_components`: M, the most components; the filters of the literature call it
      `max_components`.
    - `initial_moves`: moves of x_0, which are given y_1 where it is known: regrouping, such as
      `KMeans(reseed=True)`, and `SelectInitial`. What they weigh is part of the first increment.
    - `initial_noise`: the noise of x_0 where the model has `initial_from_noise`: "independent", as
      the model's own `sample_initial` draws it, or "rqmc"; see `Propagate`.

    Raises `ValueError` for N < 1, M < 1, N < M, no moves, moves that never use an observation, or
    fewer slots than `particles_per_component` asks for.
    """

    model: AbstractStateSpaceModel
    _moves: tuple[Any, ...]
    _initial_moves: tuple[Any, ...]
    num_particles: int = eqx.field(static=True)
    num_components: int = eqx.field(static=True)
    initial_noise: str = eqx.field(static=True)

    def __init__(
        self,
        model: AbstractStateSpaceModel,
        moves: Iterable[Callable[..., ParticleMixture]],
        num_particles: int,
        num_components: int = 1,
        initial_moves: Iterable[AbstractMove] = (),
        initial_noise: str = "independent",
    ) -> None:
        require_model(model, "Filter")
        moves = as_moves(moves, "moves")
        initial_moves = as_moves(initial_moves, "initial_moves")
        check_chain(moves, num_particles, num_components)
        self.model = model
        self._moves = tie(moves, model)
        self._initial_moves = tie(initial_moves, model)
        self.num_particles = int(num_particles)
        self.num_components = int(num_components)
        check_one_of(NOISES, initial_noise=initial_noise)
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
        model = changes.get("model", self.model)
        own = {
            "model": model,
            "moves": untie(self._moves, model),
            "num_particles": self.num_particles,
            "num_components": self.num_components,
            "initial_moves": untie(self._initial_moves, model),
            "initial_noise": self.initial_noise,
        }
        return Filter(**own | changes)

    def init(
        self, key: Key[Array, ""], observation: PyTree = None, *, inputs: PyTree = None
    ) -> ParticleMixture:
        """The mixture of x_0: draws with equal weights, changed by the initial moves.

        Give it y_1, and u_1 if there are inputs, where an initial move looks at them, such as
        `SelectInitial`; without y_1 that move does nothing. y_1 is then given to `step` as well.
        """
        check_key(key)
        if observation is not None:
            observation = one_observation(observation)
        inputs = one_input(inputs, self.model)
        start = Start(key, drawn_once(key, self._sample_initial))
        mixture, faults = with_floats_traced(
            lambda filter: _from_particles(filter, start, observation, inputs), self
        )
        return raise_faults(mixture, faults)

    def _sample_initial(self, key: Key[Array, "*num"]) -> PyTree:
        key_initial = split_keys(key, 1 + len(self._initial_moves))[0]
        with saying_that_none_were_given(self.model):
            return sample_initial(key_initial, self.model, self.num_particles, self.initial_noise)

    def _init(self, start: Start, observation: PyTree = None) -> ParticleMixture:
        if start.mixture is not None:
            return start.mixture
        keys = split_keys(start.key, 1 + len(self._initial_moves))
        particles = start.particles
        if particles is None:
            draw = self._sample_initial
            particles = drawn_once(start.key, draw) if self._initial_moves else draw(start.key)
        memory = {}
        for move in self.moves:
            memory |= move.initial_memory(self.num_components)
        mixture = single_component(particles, self.num_components, start.num_particles)
        mixture = mixture.replace(memory=memory)
        for move_key, move in zip(keys[1:], self.initial_moves, strict=True):
            with saying_that_none_were_given(self.model):
                mixture = move(move_key, mixture, observation)
        if self.looks_at_first:
            mixture, log_mass = normalised(mixture, mixture)
            mixture = mixture.replace(log_scale=log_mass)
        return mixture

    @property
    def looks_at_first(self) -> bool:
        """Whether the initial moves may weigh x_0, by y_1 or otherwise."""
        return any(move.weighs for move in self._initial_moves)

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

    def _run(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree, inputs: PyTree
    ) -> tuple[ParticleMixture, StepInfo]:
        check_key(key)
        check_type(ParticleMixture, "a mixture, as init and step return it", mixture=mixture)
        if mixture.num_components != self.num_components:
            raise ValueError(
                f"mixture: its num_components, {mixture.num_components}, is not the filter's,"
                f" {self.num_components}"
            )
        inputs = one_input(inputs, self.model)
        *moved, faults = with_floats_traced(
            lambda filter: _step_and_faults(filter, key, mixture, observation, inputs), self
        )
        return raise_faults(tuple(moved), faults)

    def _step(
        self, key: Key[Array, "*keys"], mixture: ParticleMixture, observation: PyTree = None
    ) -> tuple[ParticleMixture, StepInfo]:
        """A step within a program; without an observation it only predicts."""
        moves = waiting_for_choice(self.moves, self.initial_moves)
        mixture = own_ancestors(mixture)
        resampled = jnp.zeros(self.num_components, bool)
        increment = jnp.zeros((), mixture.log_weights.dtype)
        for move_key, move in zip(split_keys(key, len(moves)), moves, strict=True):
            with saying_that_none_were_given(self.model):
                if observation is not None:
                    resampled |= move.would_resample(mixture, observation)
                moved = moved_by(move, move_key, mixture, observation, moves)
            if observation is not None and not move.keeps_mass:
                moved, log_growth = normalised(moved, mixture)
                increment += log_growth
            in_order = move.sorts or (moved.in_order and not move.propagates)
            mixture = forgetting(moves, moved)
            mixture = mixture.replace(in_order=in_order and observation is not None)
        mixture = mixture.replace(parents=None, in_order=False)
        return mixture, step_info(mixture, increment, resampled)


def step_and_faults(
    filter: Filter,
    key: Key[Array, "*keys"],
    mixture: ParticleMixture,
    observation: PyTree,
    inputs: PyTree = None,
) -> tuple[ParticleMixture, StepInfo, tuple[Fault, ...]]:
    """A step inside a compiled program, and what `raise_faults` needs when that has ended.

    `key` may hold the keys of the moves.
    """
    faults = faults_of(filter.model, observation, inputs)
    moved, info = filter.with_inputs(inputs)._step(key, mixture, observation)
    broken = Fault(~(info.log_likelihood_increment < jnp.inf), BROKEN_DENSITY)
    return moved, info, (*faults, broken)


_step_and_faults = jit_on_wide_vectors(step_and_faults)


@jit_on_wide_vectors
def _from_particles(filter, start, observation, inputs):
    # Not with the draws of x_0, whose last digits depend on the program that they are part of.
    faults = faults_of(filter.model, observation, inputs)
    return filter.with_inputs(inputs)._init(start, observation), faults
