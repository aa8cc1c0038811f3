"""A filter: a chain of moves on a particle mixture, one step at a time."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import check_flag, check_key, check_one_of, check_type, check_whole
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import (
    AbstractStateSpaceModel,
    HasInitialNoise,
    check_model,
    check_states,
    starts_from_noise,
)
from mpfjax.models.conditionally_linear import with_moments
from mpfjax.models.inputs import saying_that_none_were_given
from mpfjax.models.noise import NOISES, draw_noise
from mpfjax.moves.base import (
    AbstractMarkovMove,
    AbstractMove,
    AbstractRegrouping,
    AbstractResampling,
)
from mpfjax.moves.eve_indices import EVE_INDICES, evidence_variance, mass_variances
from mpfjax.moves.every import Every, with_inner
from mpfjax.moves.island_interaction import IslandInteraction
from mpfjax.moves.memory import check_memory
from mpfjax.moves.parents import runner
from mpfjax.moves.results import as_moves, check_result, check_weighed
from mpfjax.moves.sharing import give_inputs, tie, untie
from mpfjax.observations import Fault, faults_of, one_input, one_observation, raise_faults
from mpfjax.operations.across_islands import excess_over_islands, island_index, num_islands
from mpfjax.operations.compiling import jit_on_wide_vectors, with_floats_traced
from mpfjax.operations.floats import default_float
from mpfjax.operations.generator import split
from mpfjax.operations.logarithms import scaled_log_sum_exp


class StepInfo(eqx.Module):
    """The report of a step, which comes with its mixture."""

    log_likelihood_increment: Float[Array, ""]
    """log p(y_t | y_1..y_{t-1}), estimated; -inf where every particle has zero likelihood."""
    effective_sample_sizes: Float[Array, " m"]
    """of each component of the new mixture, zero for a dead one."""
    mixture_weights: Float[Array, " m"]
    """the mass of each component of the new mixture."""
    resampled: Bool[Array, " m"]
    """which components of the mixture that the step was given were resampled."""
    degenerate: Bool[Array, ""]
    """whether every particle had zero likelihood: the weights are then those of the prediction."""
    labels_ran_out: Bool[Array, ""]
    """whether all M > 1 labels are in use, so that more modes share one; see `Split.is_diffuse`."""
    log_marginal_likelihood_error: Float[Array, ""] | None = None
    """the standard error of log Ẑ of all steps so far, from this one run; None unless the filter
    is one of `mpfjax.smoothing.with_first_ancestors`."""
    mixture_weight_errors: Float[Array, " m"] | None = None
    """the standard error of each mixture weight; None likewise."""


# Moves that do not change the total mass; there is nothing to normalise after them.
_KEEP_MASS = (AbstractRegrouping, AbstractResampling, AbstractMarkovMove, IslandInteraction)
BROKEN_DENSITY = "model: a density was NaN or infinite for some particle"


class Start(NamedTuple):
    """The start of a run: its key, and x_0 where that was drawn before."""

    key: Key[Array, "*seeds"]
    particles: PyTree = None
    """one for each slot; the slots after the first `num_particles` are empty."""
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
    - `starts_empty`: at time 0 no slot holds a particle, and later all may become empty again.
      Moves start components, as the births of a tracker. A step without any mass has an increment
      of zero.

    Raises `ValueError` for N < 1, M < 1, N < M, no moves, moves that never use an observation, or
    fewer slots than `particles_per_component` asks for.
    """

    model: AbstractStateSpaceModel
    _moves: tuple[Any, ...]
    _initial_moves: tuple[Any, ...]
    num_particles: int = eqx.field(static=True)
    num_components: int = eqx.field(static=True)
    initial_noise: str = eqx.field(static=True)
    starts_empty: bool = eqx.field(static=True)

    def __init__(
        self,
        model: AbstractStateSpaceModel,
        moves: Iterable[Callable[..., ParticleMixture]],
        num_particles: int,
        num_components: int = 1,
        initial_moves: Iterable[AbstractMove] = (),
        initial_noise: str = "independent",
        starts_empty: bool = False,
    ) -> None:
        check_model(model, "Filter")
        moves = as_moves(moves, "moves")
        initial_moves = as_moves(initial_moves, "initial_moves")
        _check_sizes(num_particles, num_components)
        check_weighed(moves)
        for move in with_inner(moves):
            per_component = getattr(move, "particles_per_component", None)
            if per_component is not None and per_component * num_components > num_particles:
                raise ValueError(
                    f"particles_per_component: {per_component} for each of {num_components}"
                    f" components needs more than num_particles, {num_particles}"
                )
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
        """The mixture at time 0: draws of x_0 with equal weights, grouped by the initial moves."""
        check_key(key)
        start = Start(key, self._sample_initial(key))
        return with_floats_traced(lambda filter: _from_particles(filter, start), self)

    def _sample_initial(self, key: Key[Array, ""]) -> PyTree:
        key_initial = split_keys(key, 1 + len(self._initial_moves))[0]
        with saying_that_none_were_given(self.model):
            return sample_initial(key_initial, self.model, self.num_particles, self.initial_noise)

    def _init(self, start: Start) -> ParticleMixture:
        keys = split_keys(start.key, 1 + len(self._initial_moves))
        particles = start.particles
        if particles is None:
            particles = self._sample_initial(start.key)
        memory = {}
        for move in self.moves:
            if isinstance(move, AbstractMove):
                memory |= move.initial_memory(self.num_components)
        mixture = single_component(particles, self.num_components, start.num_particles)
        mixture = mixture.replace(memory=memory)
        for move_key, move in zip(keys[1:], self.initial_moves, strict=True):
            mixture = move(move_key, mixture)
        if self.starts_empty:
            mixture = mixture.replace(log_weights=jnp.full_like(mixture.log_weights, -jnp.inf))
        return mixture

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
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> tuple[ParticleMixture, StepInfo]:
        if mixture.num_components != self.num_components:
            raise ValueError(
                f"mixture: its num_components, {mixture.num_components}, is not the filter's,"
                f" {self.num_components}"
            )
        mixture = _own_ancestors(mixture)
        resampled = jnp.zeros(self.num_components, bool)
        increment = jnp.zeros((), mixture.log_weights.dtype)
        run = runner(self._moves)
        for move_key, move in zip(split_keys(key, len(self._moves)), self.moves, strict=True):
            if isinstance(move, AbstractMove):
                resampled |= move.would_resample(mixture, observation)
            after = (self._forgetting,) if isinstance(move, Every) else ()
            with saying_that_none_were_given(self.model):
                moved = run(move, move_key, mixture, observation, *after)
            moved = check_result(moved, mixture, move)
            if after:
                mixture = moved
                continue
            if not isinstance(move, _KEEP_MASS):
                moved, log_growth = _normalise(moved, mixture, self.starts_empty)
                increment += log_growth
            mixture = self._forgetting(moved)
        return mixture.replace(parents=None), _report(mixture, increment, resampled)

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
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[ParticleMixture, StepInfo]:
        mixture = _own_ancestors(mixture)
        for move_key, move in zip(split_keys(key, len(self._moves)), self.moves, strict=True):
            if not isinstance(move, AbstractMove):
                raise ValueError(f"moves: {move!r} does not define predict, for a missing y_t")
            with saying_that_none_were_given(self.model):
                moved = move.predict(move_key, mixture)
            mixture = self._forgetting(check_result(moved, mixture, move))
        increment = jnp.zeros((), mixture.log_weights.dtype)
        return mixture, _report(mixture, increment, jnp.zeros(self.num_components, bool))


def step_and_faults(
    filter: Filter,
    key: Key[Array, ""],
    mixture: ParticleMixture,
    observation: PyTree,
    inputs: PyTree = None,
) -> tuple[ParticleMixture, StepInfo, tuple[Fault, ...]]:
    """A step inside a compiled program, and what `raise_faults` needs when that has ended."""
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


def sample_initial(
    key: Key[Array, ""],
    model: AbstractStateSpaceModel,
    num_particles: int,
    noise: str = "independent",
) -> PyTree:
    """The particles of x_0, of this noise if the model can; raises for leaves of another length."""
    if noise == "independent" or not starts_from_noise(model):
        particles = model.sample_initial(key, num_particles)
    else:
        maker = cast(HasInitialNoise, model)
        shape = (num_particles, maker.initial_noise_dimension)
        particles = maker.initial_from_noise(draw_noise(noise, key, shape, default_float()))
    check_states(particles, model, "sample_initial", num_particles)
    return with_moments(model, particles)


def _normalise(
    mixture: ParticleMixture, previous: ParticleMixture, may_be_empty: bool
) -> tuple[ParticleMixture, Float[Array, ""]]:
    """Remove the growth of the mass. If no mass is left, keep the previous weights or, where a
    mixture may be empty, none.

    The scale is removed first, which is exact. If it were added to it, the sum of the weights would
    be lost to rounding.
    """
    log_sum, log_largest = scaled_log_sum_exp(mixture.log_weights)
    own_scale = jnp.zeros_like(log_sum) if mixture.log_scale is None else mixture.log_scale
    log_excess, log_total, log_scale = excess_over_islands(own_scale, log_largest, log_sum)
    has_mass = log_total > -jnp.inf
    log_share = log_excess - jnp.where(has_mass, log_total, 0.0)
    normalised = (mixture.log_weights - log_largest) + log_share
    # A comparison with NaN is false, but NaN is not a step of zero likelihood.
    keep = has_mass | jnp.isnan(log_total)
    without_mass = mixture.log_weights if may_be_empty else previous.log_weights
    log_weights = jnp.where(keep, normalised, without_mass)
    log_growth = log_scale + log_total
    if may_be_empty:
        log_growth = jnp.where(keep, log_growth, 0.0)
    return mixture.replace(log_weights=log_weights, log_scale=None), log_growth


def _report(
    mixture: ParticleMixture, increment: Float[Array, ""], resampled: Bool[Array, " m"]
) -> StepInfo:
    degenerate = increment == -jnp.inf
    of_evidence = of_masses = None
    # Families may have members on several islands.
    if EVE_INDICES in mixture.memory and num_islands() == 1:
        variance = jnp.where(degenerate, jnp.inf, evidence_variance(mixture))
        of_evidence = jnp.sqrt(jnp.maximum(variance, 0.0))
        of_masses = jnp.sqrt(jnp.maximum(mass_variances(mixture), 0.0))
    sizes = mixture.component_effective_sample_sizes
    return StepInfo(
        log_likelihood_increment=increment,
        effective_sample_sizes=sizes,
        mixture_weights=mixture.mixture_weights,
        resampled=resampled,
        degenerate=degenerate,
        labels_ran_out=jnp.all(sizes > 0) & (mixture.num_components > 1),
        log_marginal_likelihood_error=of_evidence,
        mixture_weight_errors=of_masses,
    )


def _own_ancestors(mixture: ParticleMixture) -> ParticleMixture:
    own = jnp.arange(mixture.num_particles, dtype=jnp.int32)
    if num_islands() > 1:
        own += mixture.num_particles * island_index()
    return mixture.replace(ancestor_indices=own)


def split_keys(key: Key[Array, ""], num: int) -> list[Key[Array, ""]]:
    """One key for each move. The first keys do not depend on `num`: a longer chain starts with the
    same draws.
    """
    return list(split(key, num))


def _check_sizes(num_particles: int, num_components: int) -> None:
    check_whole(num_particles=num_particles, num_components=num_components)
    if num_particles < num_components:
        raise ValueError(
            f"num_particles: {num_particles} is less than num_components, {num_components};"
            " every component needs a particle"
        )
