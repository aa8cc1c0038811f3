"""A filter: a chain of moves on a particle mixture, one step at a time."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key, PyTree

from mpfjax.checks import (
    check_flag,
    check_key,
    check_numbered,
    check_one_of,
    check_type,
    check_whole,
)
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import AbstractStateSpaceModel, check_model
from mpfjax.models.inputs import saying_that_none_were_given
from mpfjax.models.noise import NOISES
from mpfjax.moves.base import (
    AbstractMarkovMove,
    AbstractMove,
    AbstractPropagation,
    AbstractRegrouping,
    AbstractResampling,
)
from mpfjax.moves.every import Every, with_inner
from mpfjax.moves.initial import (
    START,
    StartMemory,
    at_start,
    choose_initial,
    is_prior,
    leaving_start,
    looking_moves,
    sample_initial,
    started,
    unless_chosen,
)
from mpfjax.moves.island_interaction import IslandInteraction
from mpfjax.moves.memory import check_memory
from mpfjax.moves.parents import runner
from mpfjax.moves.report import StepInfo, step_info
from mpfjax.moves.results import (
    as_moves,
    check_result,
    check_sizes,
    check_weighed,
    normalised,
    same_mass,
)
from mpfjax.moves.sharing import give_inputs, tie, untie
from mpfjax.observations import Fault, faults_of, one_input, one_observation, raise_faults
from mpfjax.operations.across_islands import island_index, num_islands
from mpfjax.operations.choices import drawn_once
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced
from mpfjax.operations.generator import split_keys

# Moves that do not change the total mass; there is nothing to normalise after them.
_KEEP_MASS = (AbstractRegrouping, AbstractResampling, AbstractMarkovMove, IslandInteraction)
BROKEN_DENSITY = "model: a density was NaN or infinite for some particle"


class Start(NamedTuple):
    """The start of a run: its key, and x_0 where that was drawn before."""

    key: Key[Array, "*seeds"]
    particles: PyTree = None
    """one for each slot; the slots after the first `num_particles` are empty."""
    pool: PyTree = None
    """the draws of x_0 that a filter with `initial_draws` chooses from, likewise."""
    num_particles: Int[Array, "*seeds"] | None = None


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
    - `initial_moves`: regrouping of x_0, such as `KMeans(reseed=True)`.
    - `initial_noise`: the noise of x_0 where the model has `initial_from_noise`: "independent", as
      the model's own `sample_initial` draws it, "rqmc" or "stratified"; see `Propagate`.
    - `initial_draws`: K. With more than one, the first step draws x_0 anew, K N times, and keeps N
      by what they say of y_1 (`choose_initial`): a wide prior is covered as by K N particles, at
      the cost of 2 K more draws of x_1 in the whole run. A run's `initial` has those that were
      kept, and their weights. A first step that only predicts leaves x_0 as it is.
    - `starts_empty`: at time 0 no slot holds a particle, and later all may become empty again.
      Moves start components, as the births of a tracker. A step without any mass has an increment
      of zero.

    Raises `ValueError` for N < 1, M < 1, N < M, no moves, moves that never use an observation, or
    fewer slots than `particles_per_component` asks for; and for K > 1 with `starts_empty`, or with
    propagations other than `Propagate`, `PropagateMarginalised` and `PropagateNested`.
    """

    model: AbstractStateSpaceModel
    _moves: tuple[Any, ...]
    _initial_moves: tuple[Any, ...]
    num_particles: int = eqx.field(static=True)
    num_components: int = eqx.field(static=True)
    initial_noise: str = eqx.field(static=True)
    starts_empty: bool = eqx.field(static=True)
    initial_draws: int = eqx.field(static=True)

    def __init__(
        self,
        model: AbstractStateSpaceModel,
        moves: Iterable[Callable[..., ParticleMixture]],
        num_particles: int,
        num_components: int = 1,
        initial_moves: Iterable[AbstractMove] = (),
        initial_noise: str = "independent",
        starts_empty: bool = False,
        initial_draws: int = 1,
    ) -> None:
        check_model(model, "Filter")
        moves = as_moves(moves, "moves")
        initial_moves = as_moves(initial_moves, "initial_moves")
        check_sizes(with_inner(moves), num_particles, num_components)
        check_weighed(moves)
        check_memory(moves)
        runner(moves)
        self.model = model
        self._moves = tie(moves, model)
        self._initial_moves = tie(initial_moves, model)
        self.num_particles = int(num_particles)
        self.num_components = int(num_components)
        check_one_of(NOISES, initial_noise=initial_noise)
        check_flag(starts_empty=starts_empty)
        self.initial_noise = initial_noise
        self.starts_empty = bool(starts_empty)
        check_whole(initial_draws=initial_draws)
        if initial_draws > 1:
            num_drawn = 2 * initial_draws * num_particles
            check_numbered("draws up to", num_drawn, initial_draws=initial_draws)
            looking_moves(moves, starts_empty)
        self.initial_draws = int(initial_draws)

    @property
    def moves(self) -> tuple[Any, ...]:
        """The moves of one step; those that share the filter's model hold it."""
        return untie(self._moves, self.model)

    @property
    def initial_moves(self) -> tuple[Any, ...]:
        """The moves that group x_0."""
        return untie(self._initial_moves, self.model)

    @property
    def approximate(self) -> bool:
        """Whether any move departs from the exact recursion."""
        return any(getattr(move, "approximate", True) for move in self.moves)

    def init(self, key: Key[Array, ""]) -> ParticleMixture:
        """The mixture at time 0: draws of x_0 with equal weights, grouped by the initial moves.

        A filter with `initial_draws` draws x_0 anew when it sees y_1; `choose_initial` has these.
        If particles, weights or indicators were replaced by then, it goes on from what they are.
        """
        check_key(key)
        start = Start(key, drawn_once(key, self._sample_initial))
        return with_floats_traced(lambda filter: _from_particles(filter, start), self)

    def _sample_initial(self, key: Key[Array, "*num"]) -> PyTree:
        key_initial = split_keys(key, 1 + len(self._initial_moves))[0]
        with saying_that_none_were_given(self.model):
            return sample_initial(key_initial, self.model, self.num_particles, self.initial_noise)

    def _init(self, start: Start, grouped: bool = True) -> ParticleMixture:
        keys = split_keys(start.key, 1 + len(self._initial_moves))
        particles = start.particles
        if particles is None:
            draw = self._sample_initial
            particles = drawn_once(start.key, draw) if self._initial_moves else draw(start.key)
        memory = {}
        for move in self.moves:
            if isinstance(move, AbstractMove):
                memory |= move.initial_memory(self.num_components)
        mixture = single_component(particles, self.num_components, start.num_particles)
        mixture = mixture.replace(memory=memory)
        if grouped:
            mixture = self._grouped(keys[1:], mixture)
        if self.starts_empty:
            mixture = mixture.replace(log_weights=jnp.full_like(mixture.log_weights, -jnp.inf))
        return at_start(mixture) if self.initial_draws > 1 else mixture

    def _grouped(self, keys: Sequence[Key[Array, ""]], mixture: ParticleMixture) -> ParticleMixture:
        for move_key, move in zip(keys, self.initial_moves, strict=True):
            mixture = move(move_key, mixture)
        return mixture

    def with_one_draw(self) -> "Filter":
        """The filter with `initial_draws` of one, for runs that keep plain draws of x_0."""
        if self.initial_draws == 1:
            return self
        return Filter(
            self.model, self.moves, self.num_particles, self.num_components,
            self.initial_moves, self.initial_noise,
        )  # fmt: skip

    def choose_initial(
        self,
        key: Key[Array, "*keys"],
        mixture: ParticleMixture,
        observation: PyTree,
        pool: PyTree = None,
    ) -> ParticleMixture:
        """The mixture of x_0 that the first step, of this key and observation, goes on from.

        `step` calls it, and draws the same from this mixture as from that of `init`. Call it before
        where the history of an online run is kept: ancestor indices of the first step refer to
        it. `pool` are the draws of `sample_pool`, where that was called before.
        """
        moves = looking_moves(self.moves, self.starts_empty)
        _, key_kept, *keys = self._keys(key)[1]
        if pool is None:
            with saying_that_none_were_given(self.model):
                pool = self.sample_pool(key)
        looks = list(zip(keys, moves, strict=False))
        chosen = choose_initial(key_kept, mixture, pool, looks, observation, self.initial_noise)
        return self._grouped(keys[len(moves) :], chosen)

    def sample_pool(self, key: Key[Array, "*keys"]) -> PyTree:
        """The K N draws of x_0 of the first step, of this key."""
        number = self.initial_draws * self.num_particles
        return sample_initial(self._keys(key)[1][0], self.model, number, self.initial_noise)

    @property
    def num_step_keys(self) -> int:
        """How many keys that of a step is split into: one for each move, and those of the start."""
        if self.initial_draws == 1:
            return len(self._moves)
        looks = looking_moves(self._moves, self.starts_empty)
        return len(self._moves) + 2 + len(looks) + len(self._initial_moves)

    def _keys(self, key: Key[Array, "*keys"]) -> tuple[list, list]:
        """The keys of a step's moves, and those of the start."""
        keys = split_keys(key, self.num_step_keys)
        return keys[: len(self._moves)], keys[len(self._moves) :]

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
        check_key(key)
        check_type(ParticleMixture, "a mixture, as init and step return it", mixture=mixture)
        observation = one_observation(observation)
        inputs = one_input(inputs, self.model)
        *moved, faults = with_floats_traced(
            lambda filter: _step_and_faults(filter, key, mixture, observation, inputs), self
        )
        return raise_faults(tuple(moved), faults)

    def predict(
        self, key: Key[Array, ""], mixture: ParticleMixture, *, inputs: PyTree = None
    ) -> tuple[ParticleMixture, StepInfo]:
        """One step without an observation: the particles propagate, the weights stay.

        Use it for a missing y_t, or to forecast. The increment is zero. Raises `ValueError` for a
        move without a method `predict`.
        """
        check_key(key)
        check_type(ParticleMixture, "a mixture, as init and step return it", mixture=mixture)
        inputs = one_input(inputs, self.model)
        *moved, faults = with_floats_traced(
            lambda filter: _predict_and_faults(filter, key, mixture, inputs), self
        )
        return raise_faults(tuple(moved), faults)

    def _step(
        self, key: Key[Array, "*keys"], mixture: ParticleMixture, observation: PyTree
    ) -> tuple[ParticleMixture, StepInfo]:
        if mixture.num_components != self.num_components:
            raise ValueError(
                f"mixture: its num_components, {mixture.num_components}, is not the filter's,"
                f" {self.num_components}"
            )
        if self.initial_draws > 1:
            choose = lambda prior: self.choose_initial(key, prior, observation)  # noqa: E731
            mixture = jax.lax.cond(is_prior(mixture), choose, lambda kept: kept, mixture)
        mixture = _own_ancestors(mixture)
        resampled = jnp.zeros(self.num_components, bool)
        increment = jnp.zeros((), mixture.log_weights.dtype)
        run, is_normalised = runner(self._moves), False
        start: StartMemory | None = mixture.memory.get(START)
        for move_key, move in zip(self._keys(key)[0], self.moves, strict=True):
            if start is not None and isinstance(move, AbstractPropagation):
                increment += start.log_mass.astype(increment.dtype)
                mixture, start = started(mixture), None
            if isinstance(move, AbstractMove):
                due = move.would_resample(mixture, observation)
                resampled |= due if start is None else due & ~start.is_chosen
            after = (self._forgetting,) if isinstance(move, Every) else ()
            with saying_that_none_were_given(self.model):
                moved = run(move, move_key, mixture, observation, *after)
            if start is not None:
                moved = unless_chosen(moved, mixture)
            moved = check_result(moved, mixture, move)
            if after:
                mixture = moved
                continue
            if not isinstance(move, _KEEP_MASS) and not same_mass(moved, mixture):
                moved, log_growth = normalised(moved, mixture, self.starts_empty)
                increment, is_normalised = increment + log_growth, True
            mixture = self._forgetting(moved)
        if not is_normalised:
            mixture, log_growth = normalised(mixture, mixture, self.starts_empty)
            increment += log_growth
        return mixture.replace(parents=None), step_info(mixture, increment, resampled)

    def _forgetting(self, mixture: ParticleMixture) -> ParticleMixture:
        """The mixture without any memory of components that have died."""
        if not mixture.memory:
            return mixture
        memory, dead = mixture.memory, ~mixture.active
        for move in self.moves:
            if isinstance(move, AbstractMove):
                memory = move.forget(memory, dead)
        return mixture.replace(memory=memory)

    def _predict(
        self, key: Key[Array, "*keys"], mixture: ParticleMixture
    ) -> tuple[ParticleMixture, StepInfo]:
        mixture = _own_ancestors(mixture)
        mixture = leaving_start(mixture)
        for move_key, move in zip(self._keys(key)[0], self.moves, strict=True):
            if not isinstance(move, AbstractMove):
                raise ValueError(f"moves: {move!r} does not define predict, for a missing y_t")
            with saying_that_none_were_given(self.model):
                moved = move.predict(move_key, mixture)
            mixture = self._forgetting(check_result(moved, mixture, move))
        increment = jnp.zeros((), mixture.log_weights.dtype)
        return mixture, step_info(mixture, increment, jnp.zeros(self.num_components, bool))


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
def _from_particles(filter, start):
    # Not with the draws of x_0, whose last digits depend on the program that they are part of.
    return filter._init(start)


@jit_on_wide_vectors
def _predict_and_faults(filter, key, mixture, inputs):
    moved, info = filter.with_inputs(inputs)._predict(key, mixture)
    return moved, info, faults_of(filter.model, None, inputs)


def _own_ancestors(mixture: ParticleMixture) -> ParticleMixture:
    own = jnp.arange(mixture.num_particles, dtype=jnp.int32)
    if num_islands() > 1:
        own += mixture.num_particles * island_index()
    return mixture.replace(ancestor_indices=own)
