"""A filter as a chain of moves, its runners, and the filters of the literature."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import (
    check_callable,
    check_key,
    check_one_of,
    check_type,
    check_whole,
    given,
    saying,
    shown,
)
from mpfjax.devices import (
    choose_devices,
    excess_over_islands,
    is_traced,
    island_index,
    jit_on_wide_vectors,
    num_islands,
    num_processors,
    over_devices,
    over_threads,
)
from mpfjax.generator import split
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.models.base import AbstractStateSpaceModel, check_model, check_states, mapped
from mpfjax.models.multi_object import MultiObjectModel, require_multi_object
from mpfjax.moves.base import AbstractMove, AbstractRegrouping, AbstractRejuvenation
from mpfjax.moves.clusters import PropagateInClusters
from mpfjax.moves.exchange import Exchange
from mpfjax.moves.features import Scale
from mpfjax.moves.gaussian import GaussianRegeneration
from mpfjax.moves.independent import PropagateIndependently
from mpfjax.moves.partitioned import Partitioned, check_orders
from mpfjax.moves.propagation import Predict, Propagate, Weigh
from mpfjax.moves.regrouping import KMeans, Merge, Pool, RandomPartition, Split
from mpfjax.moves.resampling import FEW_ROWS, Resample
from mpfjax.operations import default_float, scaled_log_sum_exp
from mpfjax.proposals import AbstractProposal


class StepInfo(eqx.Module):
    """What a step reports beside the mixture it returns."""

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


class FilterRun(eqx.Module):
    """The result of running a filter over observations y_1..y_t."""

    log_marginal_likelihood: Float[Array, ""]
    """log p(y_1..y_t), estimated: the sum of the increments."""
    log_likelihood_increments: Float[Array, " t"]
    collected: PyTree
    """what `collect` made of each step's mixture, stacked over t."""
    final: ParticleMixture
    resampled: Bool[Array, "t m"]
    """which components each step resampled."""
    degenerate: Bool[Array, " t"]
    """the steps at which every particle had zero likelihood."""


# Moves that leave the total mass as it is, so that there is nothing to normalise.
_KEEP_MASS = (AbstractRegrouping, AbstractRejuvenation, Exchange)
# Particles, times the components where these are few and have a row of them each: what a CPU's
# caches hold of all that a step makes of them.
_IN_NEAR_CACHE, _IN_CACHE = 2**15, 2**16
_WORTH_A_THREAD = 2**9  # particles, of all its runs
_BROKEN_DENSITY = "model: a density was NaN or infinite for some particle"


class _Start(NamedTuple):
    """Where a run starts: its key, and x_0 where that was drawn before."""

    key: Key[Array, "*seeds"]
    particles: PyTree = None
    """as many as there are slots, of which those after the first `num_particles` are empty."""
    num_particles: Int[Array, "*seeds"] | None = None


class _Tied(eqx.Module):
    """Stands in a move where the filter's own model belongs, so that it is stored only once."""


class Filter(eqx.Module):
    """A particle filter: a chain of moves on a particle mixture.

    One step applies the moves in order and normalises. The growth of the total mass is the
    increment of the marginal likelihood, whatever the moves are.

    - `model`: draws x_0. Moves that hold the very same model share it: the filter is a pytree
      with one copy of the model's parameters, so that its gradient is the gradient.
    - `moves`: callables `(key, mixture, observation) -> mixture`, usually `AbstractMove`s.
    - `num_particles`, `num_components`: N slots, and M, the most components.
    - `initial_moves`: regrouping of x_0, such as `KMeans(reseed=True)`.

    Raises `ValueError` for N < 1, M < 1, N < M, no moves, or fewer slots than
    `particles_per_component` asks for.
    """

    model: AbstractStateSpaceModel
    _moves: tuple[Any, ...]
    _initial_moves: tuple[Any, ...]
    num_particles: int = eqx.field(static=True)
    num_components: int = eqx.field(static=True)

    def __init__(
        self,
        model: AbstractStateSpaceModel,
        moves: Iterable[Callable[..., ParticleMixture]],
        num_particles: int,
        num_components: int = 1,
        initial_moves: Iterable[AbstractRegrouping] = (),
    ) -> None:
        check_model(model, "Filter")
        moves = _as_moves(moves, "moves")
        initial_moves = _as_moves(initial_moves, "initial_moves")
        _check_sizes(num_particles, num_components)
        if not moves:
            raise ValueError("moves: a filter needs at least one")
        for move in moves:
            per_component = getattr(move, "particles_per_component", None)
            if per_component is not None and per_component * num_components > num_particles:
                raise ValueError(
                    f"particles_per_component: {per_component} for each of {num_components}"
                    f" components needs more than num_particles, {num_particles}"
                )
        names = [n for move in moves if isinstance(move, AbstractMove) for n in _memory_of(move)]
        if len(set(names)) < len(names):
            raise ValueError(f"moves: two of them would share one memory, of {sorted(names)}")
        self.model = model
        self._moves = _tie(moves, model)
        self._initial_moves = _tie(initial_moves, model)
        self.num_particles = int(num_particles)
        self.num_components = int(num_components)

    @property
    def moves(self) -> tuple[Any, ...]:
        """The moves of one step, each with the filter's model where it shares it."""
        return _untie(self._moves, self.model)

    @property
    def approximate(self) -> bool:
        """Whether any move departs from the exact recursion."""
        return any(getattr(move, "approximate", True) for move in self.moves)

    def init(self, key: Key[Array, ""]) -> ParticleMixture:
        """The mixture at time 0: draws of x_0 with equal weights, grouped by the initial moves."""
        check_key(key)
        return self._init(_Start(key))

    def _init(self, start: _Start) -> ParticleMixture:
        keys = _split(start.key, 1 + len(self._initial_moves))
        particles = start.particles
        if particles is None:
            particles = _sample_initial(keys[0], self.model, self.num_particles)
        memory = {}
        for move in self.moves:
            if isinstance(move, AbstractMove):
                memory |= move.initial_memory(self.num_components)
        mixture = single_component(particles, self.num_components, start.num_particles)
        mixture = mixture.replace(memory=memory)
        for move_key, move in zip(keys[1:], _untie(self._initial_moves, self.model), strict=True):
            mixture = move(move_key, mixture)
        return mixture

    def step(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> tuple[ParticleMixture, StepInfo]:
        """The mixture at t and a report, from the mixture at t-1 and y_t.

        A NaN or infinite observation is an error, unless the model says that it takes NaN for what
        is missing; a step that has no observation is `predict`'s. Where every particle has zero
        likelihood the increment is -inf, the particles move on with the weights that they had
        before, and `degenerate` is true.
        """
        check_key(key)
        check_type(ParticleMixture, "a mixture, as init and step return it", mixture=mixture)
        leaves = jax.tree.leaves(observation)
        if not leaves:
            raise ValueError("observation: there is none; use predict to skip it")
        _require_numbers(leaves, "observation")
        for leaf in leaves:
            if _is_plain(leaf):
                _require_fitting(np.asarray(leaf), "observation")
        observation = as_arrays(observation)
        return with_floats_traced(
            lambda filter: _checked_step(filter, key, mixture, observation), self
        )

    def predict(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[ParticleMixture, StepInfo]:
        """One step without an observation: the particles propagate, the weights stay.

        For a missing y_t, or to forecast. The increment is zero. Raises `ValueError` for a move
        that does not say what it does without an observation.
        """
        check_key(key)
        check_type(ParticleMixture, "a mixture, as init and step return it", mixture=mixture)
        return with_floats_traced(lambda filter: _checked_predict(filter, key, mixture), self)

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
        for move_key, move in zip(_split(key, len(self._moves)), self.moves, strict=True):
            if isinstance(move, Resample):
                resampled |= move.is_due(mixture)
            moved = move(move_key, mixture, observation)
            if not isinstance(move, _KEEP_MASS):
                moved, log_growth = _normalise(moved, mixture.log_weights)
                increment += log_growth
            mixture = self._forgetting(moved)
        return mixture, _report(mixture, increment, resampled)

    def _forgetting(self, mixture: ParticleMixture) -> ParticleMixture:
        """The mixture, in whose memory there is nothing of components that have died."""
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
        for move_key, move in zip(_split(key, len(self._moves)), self.moves, strict=True):
            if not isinstance(move, AbstractMove):
                raise ValueError(f"moves: {move!r} does not define predict, for a missing y_t")
            mixture = self._forgetting(move.predict(move_key, mixture))
        increment = jnp.zeros((), mixture.log_weights.dtype)
        return mixture, _report(mixture, increment, jnp.zeros(self.num_components, bool))


@jit_on_wide_vectors
def _checked_step(filter, key, mixture, observation):
    takes_nan = getattr(filter.model, "handles_missing", False)
    what = "infinite" if takes_nan else "NaN or infinite"

    def check(leaf: Array) -> Array:
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            return leaf
        (usable,) = _usable(jnp, [leaf], takes_nan)
        return eqx.error_if(leaf, ~jnp.all(usable), f"observation: {what}; use predict to skip it")

    moved, info = filter._step(key, mixture, jax.tree.map(check, observation))
    broken = ~(info.log_likelihood_increment < jnp.inf)
    return eqx.error_if((moved, info), broken, _BROKEN_DENSITY)


@jit_on_wide_vectors
def _checked_predict(filter, key, mixture):
    return filter._predict(key, mixture)


def run_filter(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    collect: Callable[[ParticleMixture], PyTree] | None = None,
    *,
    missing: str = "error",
) -> FilterRun:
    """Run a filter over observations y_1..y_t in one scan.

    - `observations`: a pytree whose leaves have a leading axis t.
    - `collect`: what to keep of the mixture after each step, stacked over t; None keeps all of
      it. The same function object compiles once; a new lambda at every call compiles anew.
      What is derived from a mixture is written for one: `jax.vmap(lambda m: m.mean())` maps it over
      a collected stack.
    - `missing`: "error" raises a `ValueError` that names the first step whose observation holds a
      NaN or an infinity; "skip" takes such steps as missing, and only predicts. A model with
      `handles_missing = True` is given the NaN, and with "skip" only a step of nothing else is
      missing.

    Raises `ValueError` for an argument of another kind, no observations, leaves of different
    lengths, complex numbers or ones beyond what JAX's type holds, before anything compiles; for a
    model whose draws or densities are of the wrong shape or type, as it is traced; and a
    RuntimeError where its densities give NaN.
    """
    check_key(key)
    check_run(filter, collect)
    present = present_steps(observations, missing, filter.model)
    observations = as_arrays(observations)
    run = lambda filter: _run(key, filter, observations, present, collect)  # noqa: E731
    return checked(with_floats_traced(run, filter))


def monte_carlo(
    keys: Key[Array, " seeds"],
    filter: Filter,
    observations: PyTree,
    collect: Callable[[ParticleMixture], PyTree] | None = None,
    *,
    missing: str = "error",
    devices: int | Sequence[Any] | None = None,
    slots: int | None = None,
) -> FilterRun:
    """Run a filter once for each key, all on the same observations, under `vmap`.

    Every field of the result has a leading axis of seeds. Arguments and errors are those of
    `run_filter`; run k equals `run_filter(keys[k], ...)`.

    - `devices`: what the runs are spread over. None is every device there is, of all processes
      after `join_processes`; a number means the first few, a sequence those of `jax.devices()`.
      Any number of keys will do. Devices tell each other nothing; the result is gathered on the
      first one, and each process has all of it. Under the caller's own jit, grad or vmap None is
      one device. One device that is a CPU is kept busy by a thread for each processor, if there
      is enough to do.
    - `slots`: keep the particles in so many slots, of which all but N stay empty. Filters that
      differ in N alone then share one compiled program, at the cost of as many particles as there
      are slots. The particles are those of a run without, up to rounding, and `collect` sees the
      empty slots as well.

    Raises `ValueError` for more devices than there are, fewer slots than particles, and moves
    that fill every slot, `PropagateIndependently` and `PropagateInClusters`.
    """
    check_key(keys, "keys", batch=True)
    check_run(filter, collect)
    check_whole(**given(slots=slots))
    present = present_steps(observations, missing, filter.model)
    observations = as_arrays(observations)

    def run(filter: Filter) -> FilterRun:
        starts = _Start(keys)
        if slots is not None:
            starts, filter = _in_slots(keys, filter, slots)
        arguments = (filter, observations, present, collect)
        leave_to_caller = devices is None and is_traced((starts, arguments))
        chosen = None if leave_to_caller else choose_devices(devices)
        return over_devices(_run_each, _run_on_threads, starts, arguments, chosen)

    return checked(with_floats_traced(run, filter))


def particle_filter(
    model: AbstractStateSpaceModel,
    num_particles: int,
    *,
    proposal: AbstractProposal | None = None,
    scheme: str = "systematic",
    ess_threshold: float = 1.0,
    sort_by: Callable[[PyTree], Array] | None = None,
    gradient: str = "none",
) -> Filter:
    """The standard particle filter: resample, propagate.

    Vermaak et al. (2003), section 3, with one component; bootstrap unless a proposal is given.
    The right filter for a filtering distribution of one mode; it loses all but one of several.
    `gradient` is that of `Resample`, and "stop" that of `Propagate` as well: the one to tune by.
    """
    resample = Resample(scheme, ess_threshold, sort_by=sort_by, gradient=gradient)
    return Filter(
        model,
        moves=[resample, Propagate(model, proposal, _of_draws(gradient))],
        num_particles=num_particles,
    )


def mixture_particle_filter(
    model: AbstractStateSpaceModel,
    num_particles: int,
    max_components: int,
    *,
    proposal: AbstractProposal | None = None,
    scheme: str = "systematic",
    ess_threshold: float = 1.0,
    particles_per_component: int | None = None,
    sort_by: Callable[[PyTree], Array] | None = None,
    gradient: str = "none",
    features: Callable[[PyTree], Array] | None = None,
    scale: Scale = 1.0,
    merge: Merge | None = None,
    split: Split | None = None,
    kmeans: KMeans | None = None,
    initial_kmeans: KMeans | None = None,
) -> Filter:
    """The mixture particle filter: resample within components, propagate, regroup.

    Vermaak et al. (2003), sections 3 and 4. Components are resampled independently and meet only
    in their mixture weights, so that none can starve another; at every step those that overlap
    merge, diffuse ones split, and K-means refines the rest. All of it is exact. `features` and
    `scale` say in which coordinates and units all three see the particles (see `Features`; of one
    particle where the model is wrapped by `per_particle`). `merge`, `split` and `kmeans` set
    thresholds, with features and a scale of their own; see those moves for the defaults.
    `gradient` is that of `particle_filter`. Use it where the filtering distribution has several
    modes that must all be kept.
    """
    resample = Resample(scheme, ess_threshold, particles_per_component, sort_by, gradient)
    propagate = Propagate(model, proposal, _of_draws(gradient))
    return _mixture_filter(
        model, num_particles, max_components, [resample, propagate], features, scale,
        merge, split, kmeans, initial_kmeans,
    )  # fmt: skip


def gaussian_particle_filter(
    model: AbstractStateSpaceModel,
    num_particles: int,
    *,
    proposal: AbstractProposal | None = None,
    regeneration: GaussianRegeneration | None = None,
    importance: str = "propagated",
) -> Filter:
    """The Gaussian particle filter: redraw from the Gaussian of the moments, propagate.

    Kotecha and Djuric (2003); Lin et al. (2012), section 3. An approximation, for a filtering
    distribution that is close to one Gaussian; it cannot keep two modes. `importance` is that of
    `gaussian_mixture_particle_filter`.
    """
    return Filter(
        model,
        moves=_gaussian_moves(model, proposal, regeneration, importance),
        num_particles=num_particles,
    )


def gaussian_mixture_particle_filter(
    model: AbstractStateSpaceModel,
    num_particles: int,
    max_components: int,
    *,
    proposal: AbstractProposal | None = None,
    regeneration: GaussianRegeneration | None = None,
    importance: str = "propagated",
    features: Callable[[PyTree], Array] | None = None,
    scale: Scale = 1.0,
    merge: Merge | None = None,
    split: Split | None = None,
    kmeans: KMeans | None = None,
    initial_kmeans: KMeans | None = None,
) -> Filter:
    """GM-MPF: each component redrawn from the Gaussian of its moments, propagated, regrouped.

    Lin et al. (2012), section 4: the mixture particle filter with Gaussian regeneration in place
    of resampling. The paper leaves open what the sample of the importance function q of eqs. 8
    and 9 is, and `importance` offers both readings. "propagated": draws from the Gaussian of the
    filtering distribution, moved by the dynamics (or by `proposal`), are the sample, and weighed
    by L (or L D / q). "predictive_gaussian": those draws only give the moments of the prediction
    (eqs. 12 and 13), and the sample is drawn afresh from its Gaussian, N(μ̄, Σ̄), which stands in
    numerator and denominator of eq. 8 and cancels; one more approximation and one more draw.

    An approximation, good where each mode is close to a Gaussian. Raises `ValueError` for another
    `importance`, and for the second with a `proposal`, which it has no use for.
    """
    return _mixture_filter(
        model, num_particles, max_components,
        _gaussian_moves(model, proposal, regeneration, importance), features, scale,
        merge, split, kmeans, initial_kmeans,
    )  # fmt: skip


def _gaussian_moves(
    model: AbstractStateSpaceModel,
    proposal: AbstractProposal | None,
    regeneration: GaussianRegeneration | None,
    importance: str,
) -> list[AbstractMove]:
    """Redraw, propagate and weigh, with or without a second redraw between the last two."""
    redraw = GaussianRegeneration() if regeneration is None else regeneration
    check_type(GaussianRegeneration, "a GaussianRegeneration", regeneration=redraw)
    check_one_of(("propagated", "predictive_gaussian"), importance=importance)
    if importance == "propagated":
        return [redraw, Propagate(model, proposal)]
    if proposal is not None:
        raise ValueError(f"importance: {importance!r} draws from no proposal, but one was given")
    return [redraw, Predict(model), redraw, Weigh(model)]


def partitioned_sampling(
    model: MultiObjectModel,
    num_particles: int,
    order: str | Sequence[int] | Array | None = None,
    *,
    scheme: str = "systematic",
    ess_threshold: float = 1.0,
    gradient: str = "none",
) -> Filter:
    """Partitioned sampling: resample, then move one object after the other.

    MacCormick and Blake (1999); Smith and Gatica-Perez (2004), section 3. `order` is a
    permutation of the objects 0, ..., J-1, their own order for None, or "random" for a new one
    at every step. Needs far fewer particles than the joint particle filter, which is
    `particle_filter` on the same model; but the early objects of the order keep only a few
    distinct hypotheses, and hardly recover from an occlusion. Unbiased in every order, with an
    interaction as well. `ess_threshold` and `gradient` are those of the resampling between steps
    and objects.
    """
    require_multi_object(model, "partitioned_sampling")
    orders: Any = order
    if not (isinstance(order, str) and order == "random"):
        orders = check_orders(order, model.num_objects, "order")
        if orders.shape[0] != 1:
            raise ValueError(f"order: {orders.shape[0]} orders where there is one component")
    return Filter(
        model,
        moves=[
            Resample(scheme, ess_threshold, gradient=gradient),
            Partitioned(
                model, orders, scheme=scheme, ess_threshold=ess_threshold, gradient=gradient
            ),
        ],
        num_particles=num_particles,
    )


def distributed_partitioned_sampling(
    model: MultiObjectModel,
    num_particles: int,
    orders: str | Sequence[Sequence[int]] | Array | None = None,
    reassembly: str = "prior",
    *,
    scheme: str = "systematic",
    ess_threshold: float = 1.0,
    gradient: str = "none",
) -> Filter:
    """DPS: the particles dealt into C sets, in each of which the objects move in another order.

    Smith and Gatica-Perez (2004), section 4: pool and resample, deal into C sets at random, do
    partitioned sampling in each, reassemble. The impoverishment that a fixed order puts on its
    first objects falls on all alike. `orders` are C permutations of the objects, the J circular
    shifts for None, or "random" for J new ones at every step. `reassembly` is "prior", the
    paper's, where every set returns to its mass (an approximation: the marginal likelihood is
    biased), or "evidence", which is exact, and whose gradient can be; see `Partitioned`, for
    `gradient` as well. Use it where it is not known which object will be hard, and with enough
    particles for each set of N/C to track.
    """
    require_multi_object(model, "distributed_partitioned_sampling")
    if orders is None:
        orders = "circular"
    num_sets = model.num_objects
    if not isinstance(orders, str):
        orders = check_orders(orders, model.num_objects)
        num_sets = orders.shape[0]
    resample = Resample(scheme, ess_threshold, gradient=gradient)
    partitioned = Partitioned(
        model, orders, scheme=scheme, ess_threshold=ess_threshold, reassembly=reassembly,
        gradient=gradient,
    )  # fmt: skip
    return Filter(
        model,
        moves=[Pool(), resample, RandomPartition(), partitioned],
        num_particles=num_particles,
        num_components=num_sets,
    )


def independent_particle_filters(
    model: MultiObjectModel, num_particles: int, *, scheme: str = "systematic"
) -> Filter:
    """A small particle filter for each object, as if there were no other.

    N particles an object, so the cost of a joint filter of N. Exact where the objects do not
    interact, and then the one to beat; an interaction is left out, and look-alikes that cross
    end on the same object. Estimates are after resampling; see `PropagateIndependently`.
    """
    require_multi_object(model, "independent_particle_filters")
    return Filter(model, moves=[PropagateIndependently(model, scheme)], num_particles=num_particles)


def clustered_particle_filter(
    model: MultiObjectModel,
    num_particles: int,
    *,
    start: str = "apart",
    split_after: int | None = None,
    scheme: str = "systematic",
) -> Filter:
    """A joint filter of clusters of objects, each on its own until it meets another.

    Every object starts with a particle filter of its own. Where the predicted clouds of two
    meet, that is, where the interaction ψ between any of their points is not 1, they become one
    joint filter, weighted by ψ, in which objects still cross between rows: each of an object's N
    points serves every row, with the weight L f(point | row) / Σ f(point | any row). It is
    `independent_particle_filters` where nothing interacts, and unbiased where something does,
    at the N x J likelihood evaluations a step of partitioned sampling. The derivation, the
    options and what it asks of the object model are in `PropagateInClusters`.

    Use it in place of a joint filter, PS or DPS wherever ψ has compact support, as that of
    `PairwiseRepulsion` has; with a ψ that never ends all objects become one cluster at once.
    Estimates are after resampling. A cluster's distribution may have several modes, such as
    look-alikes in either order, and their mean is then nobody's place: take a median.
    """
    move = PropagateInClusters(model, start, split_after, scheme)
    return Filter(model, moves=[move], num_particles=num_particles)


def _of_draws(gradient: str) -> str:
    """What propagation does where resampling has this gradient."""
    return "stop" if gradient == "stop" else "none"


def _mixture_filter(
    model: AbstractStateSpaceModel,
    num_particles: int,
    max_components: int,
    moves: list[AbstractMove],
    features: Callable[[PyTree], Array] | None,
    scale: Scale,
    merge: Merge | None,
    split: Split | None,
    kmeans: KMeans | None,
    initial_kmeans: KMeans | None,
) -> Filter:
    """The given moves, then regrouping; x_0 grouped by K-means from seeds."""
    check_whole(max_components=max_components)
    check_type(Merge, "a Merge", **given(merge=merge))
    check_type(Split, "a Split", **given(split=split))
    check_type(KMeans, "a KMeans", **given(kmeans=kmeans, initial_kmeans=initial_kmeans))
    seen: dict[str, Any] = {"features": mapped(model, features), "scale": scale}
    kmeans = KMeans(**seen) if kmeans is None else kmeans
    if initial_kmeans is None:
        function, units = kmeans.features.function, kmeans.features.scale
        initial_kmeans = KMeans(10, reseed=True, features=function, scale=units)
    return Filter(
        model,
        moves=[
            *moves,
            Merge(**seen) if merge is None else merge,
            Split(**seen) if split is None else split,
            kmeans,
        ],
        num_particles=num_particles,
        num_components=max_components,
        initial_moves=[initial_kmeans],
    )


@jit_on_wide_vectors
def _run(key, filter, observations, present, collect):
    return scan_filter(key, filter, observations, present, collect)


def _in_slots(keys: Key[Array, " seeds"], filter: Filter, slots: int) -> tuple[_Start, Filter]:
    """Where the runs start, and the filter, both of so many slots whatever N is."""
    num_particles = filter.num_particles
    if slots < num_particles:
        raise ValueError(f"slots: {slots} is no whole number of at least N, {num_particles}")
    # How a model draws may depend on N: stratified draws do. So this is a program of its own.
    particles = _sample_each(keys, filter.model, num_particles, int(slots))
    limits = jnp.full(keys.shape, num_particles, jnp.int32)
    initial_moves = _untie(filter._initial_moves, filter.model)
    filter = Filter(filter.model, filter.moves, int(slots), filter.num_components, initial_moves)
    return _Start(keys, particles, limits), filter


@jit_on_wide_vectors
def _sample_each(keys, model, num_particles, slots):
    """x_0 of each run; the slots that stay empty hold one of its states as well."""

    def sample(key: Key[Array, ""]) -> PyTree:
        key_initial = _split(_split(key, 2)[0], 1)[0]
        particles = _sample_initial(key_initial, model, num_particles)
        index = np.minimum(np.arange(slots), num_particles - 1)
        return jax.tree.map(lambda leaf: leaf[index], particles)

    return jax.vmap(sample)(keys)


def _run_each(starts, filter, observations, present, collect):
    run_together = jax.vmap(lambda start: _scan(start, filter, observations, present, collect))
    num_runs = starts.key.shape[0]
    size = _group_size(num_runs, filter)
    if size == num_runs:
        return run_together(starts)
    in_groups = jax.tree.map(lambda leaf: leaf.reshape(-1, size, *leaf.shape[1:]), starts)
    runs = jax.lax.map(run_together, in_groups)
    return jax.tree.map(lambda leaf: leaf.reshape(num_runs, *leaf.shape[2:]), runs)


def _group_size(num_runs: int, filter: Filter) -> int:
    """How many runs go on together: on a CPU no more than leaves their particles in its cache."""
    num_rows = filter.num_components if filter.num_components <= FEW_ROWS else 1
    one_run = filter.num_particles * num_rows
    if jax.default_backend() != "cpu" or num_runs * one_run <= _IN_CACHE:
        return num_runs
    sizes = [size for size in range(1, num_runs + 1) if num_runs % size == 0]
    return max(size for size in sizes if size == 1 or size * one_run <= _IN_NEAR_CACHE)


_run_all = jit_on_wide_vectors(_run_each)


def _run_on_threads(starts, filter, observations, present, collect):
    """All runs on one device, which on a CPU is kept busy by several threads."""
    num_runs = starts.key.shape[0]
    num_worth_it = num_runs * filter.num_particles // _WORTH_A_THREAD
    num_threads = min(num_processors(), num_runs, num_worth_it)
    keeps_all = collect is None  # of which there had better not be two copies for a while
    arguments = (filter, observations, present, collect)
    leave_to_caller = is_traced((starts, arguments)) or jax.default_backend() != "cpu"
    if num_threads < 2 or keeps_all or leave_to_caller:
        return _run_all(starts, *arguments)
    return over_threads(_run_each, starts, arguments, num_threads)


def scan_filter(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    present: Bool[Array, " t"] | None,
    collect: Callable[[ParticleMixture], PyTree] | None,
) -> FilterRun:
    """`run_filter` under the caller's jit, unchecked; `present` is what `present_steps` gives."""
    return _scan(_Start(key), filter, observations, present, collect)


def _scan(
    start: _Start,
    filter: Filter,
    observations: PyTree,
    present: Bool[Array, " t"] | None,
    collect: Callable[[ParticleMixture], PyTree] | None,
) -> FilterRun:
    key_initial, key_steps = _split(start.key, 2)
    length = jax.tree.leaves(observations)[0].shape[0]

    def advance(mixture: ParticleMixture, inputs: PyTree) -> tuple[ParticleMixture, PyTree]:
        step_key, observation, is_present = inputs
        if is_present is None:
            mixture, info = filter._step(step_key, mixture, observation)
        else:
            mixture, info = jax.lax.cond(
                is_present,
                lambda: filter._step(step_key, mixture, observation),
                lambda: filter._predict(step_key, mixture),
            )
        with saying("in collect, which is called with the mixture after each step"):
            kept = mixture if collect is None else collect(mixture)
        return mixture, (kept, info.log_likelihood_increment, info.resampled, info.degenerate)

    inputs = (jax.random.split(key_steps, length), observations, present)
    initial = filter._init(start._replace(key=key_initial))
    final, outputs = jax.lax.scan(advance, _share_of_islands(initial), inputs)
    collected, increments, resampled, degenerate = outputs
    return FilterRun(
        log_marginal_likelihood=jnp.sum(increments),
        log_likelihood_increments=increments,
        collected=collected,
        final=final,
        resampled=resampled,
        degenerate=degenerate,
    )


def _sample_initial(
    key: Key[Array, ""], model: AbstractStateSpaceModel, num_particles: int
) -> PyTree:
    """The model's x_0; raises for leaves of another length."""
    particles = model.sample_initial(key, num_particles)
    check_states(particles, model, "sample_initial", num_particles)
    return particles


def _normalise(
    mixture: ParticleMixture, previous_log_weights: Float[Array, " n"]
) -> tuple[ParticleMixture, Float[Array, ""]]:
    """Remove the mass's growth; where no mass is left, go on with the weights of before.

    The scale goes first, and exactly: with it the sum of the weights would be rounded away.
    """
    log_sum, log_largest = scaled_log_sum_exp(mixture.log_weights)
    own_scale = jnp.zeros_like(log_sum) if mixture.log_scale is None else mixture.log_scale
    log_excess, log_total, log_scale = excess_over_islands(own_scale, log_largest, log_sum)
    has_mass = log_total > -jnp.inf
    log_share = log_excess - jnp.where(has_mass, log_total, 0.0)
    normalised = (mixture.log_weights - log_largest) + log_share
    # NaN compares false, and must not be taken for a step of zero likelihood.
    keep = has_mass | jnp.isnan(log_total)
    log_weights = jnp.where(keep, normalised, previous_log_weights)
    return mixture.replace(log_weights=log_weights, log_scale=None), log_scale + log_total


def _report(
    mixture: ParticleMixture, increment: Float[Array, ""], resampled: Bool[Array, " m"]
) -> StepInfo:
    return StepInfo(
        log_likelihood_increment=increment,
        effective_sample_sizes=mixture.component_effective_sample_sizes,
        mixture_weights=mixture.mixture_weights,
        resampled=resampled,
        degenerate=increment == -jnp.inf,
    )


def _own_ancestors(mixture: ParticleMixture) -> ParticleMixture:
    own = jnp.arange(mixture.num_particles, dtype=jnp.int32)
    if num_islands() > 1:
        own += mixture.num_particles * island_index()
    return mixture.replace(ancestor_indices=own)


def _share_of_islands(mixture: ParticleMixture) -> ParticleMixture:
    """The mixture's share of a whole that is made of as many as there are islands."""
    if num_islands() == 1:
        return mixture
    return mixture.replace(log_weights=mixture.log_weights - math.log(num_islands()))


def _split(key: Key[Array, ""], num: int) -> list[Key[Array, ""]]:
    """One key for each move; the first ones are the same whatever their number, so that a longer
    chain draws alike.
    """
    return list(split(key, num))


def _memory_of(move: AbstractMove) -> list[str]:
    return list(move.initial_memory(1))


def _tie(moves: tuple[Any, ...], model: Any) -> tuple[Any, ...]:
    is_model = lambda node: node is model  # noqa: E731
    return jax.tree.map(lambda node: _Tied() if node is model else node, moves, is_leaf=is_model)


def _untie(moves: tuple[Any, ...], model: Any) -> tuple[Any, ...]:
    is_tied = lambda node: isinstance(node, _Tied)  # noqa: E731
    return jax.tree.map(lambda node: model if is_tied(node) else node, moves, is_leaf=is_tied)


def as_arrays(observations: PyTree) -> PyTree:
    """Python's numbers as arrays of JAX's own types, everything else as it is."""

    def convert(leaf: Any) -> Any:
        if isinstance(leaf, jax.Array | np.ndarray | np.generic):
            return leaf
        return jnp.asarray(np.asarray(leaf))

    return jax.tree.map(convert, observations)


def present_steps(
    observations: PyTree, missing: str, model: Any = None
) -> Bool[Array, " t"] | None:
    """Which observations are there, or None where all are; raises for what cannot be run.

    To a model that handles missing ones a NaN is one, and only a step that holds nothing else is
    not there.
    """
    check_one_of(("error", "skip"), missing=missing)
    leaves = jax.tree.leaves(observations)
    if not leaves:
        raise ValueError("observations: there are none")
    lengths = {jnp.shape(leaf)[0] if jnp.ndim(leaf) else None for leaf in leaves}
    if len(lengths) > 1 or None in lengths:
        shapes = [jnp.shape(leaf) for leaf in leaves]
        is_list = isinstance(observations, list | tuple)
        hint = "; a list is so many arrays, jnp.asarray(observations) is one" if is_list else ""
        raise ValueError(f"observations: shapes {shapes} do not share a leading axis t{hint}")
    if lengths == {0}:
        raise ValueError("observations: the leading axis t is empty")
    _require_numbers(leaves, "observations")
    inexact = [leaf for leaf in leaves if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)]
    if not inexact:
        return None
    takes_nan = getattr(model, "handles_missing", False)
    if any(isinstance(leaf, Tracer) for leaf in inexact):
        return _present_traced(inexact, missing, takes_nan)
    for leaf in inexact:
        _require_fitting(np.asarray(leaf), "observations")
    usable = np.logical_and.reduce(_each_step(np, _usable(np, inexact, takes_nan), "all"))
    if not usable.all() and (missing == "error" or takes_nan):
        what = "infinite" if takes_nan else "NaN or infinite"
        hint = "" if takes_nan else "; missing='skip' takes such steps as missing"
        raise ValueError(
            f"observations: {what} at index {int(np.argmin(usable))} of the leading axis{hint}"
        )
    present = usable
    if takes_nan and missing == "skip":
        whole = len(inexact) < len(leaves)  # a leaf of whole numbers is always there
        seen = [~np.isnan(leaf) for leaf in inexact]
        present = np.logical_or.reduce(_each_step(np, seen, "any")) | whole
    return None if present.all() else jnp.asarray(present)


def _usable(numpy: Any, leaves: list[Any], takes_nan: bool) -> list[Any]:
    """Which numbers may be handed to the model."""
    return [~numpy.isinf(leaf) if takes_nan else numpy.isfinite(leaf) for leaf in leaves]


def _each_step(numpy: Any, masks: list[Any], how: str) -> list[Any]:
    """For every leaf, whether all or any of a step's numbers are in the mask."""
    return [getattr(numpy, how)(mask.reshape(mask.shape[0], -1), axis=1) for mask in masks]


def _require_numbers(leaves: list[Any], name: str) -> None:
    """Raise a `ValueError` for what is no number, and for complex ones.

    The imaginary part would be dropped, by the density at the latest.
    """
    for leaf in leaves:
        dtype = leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
        if jnp.issubdtype(dtype, jnp.complexfloating):
            raise ValueError(
                f"{name}: {dtype} is complex; give the real and the imaginary part as two numbers"
            )
        if not (jnp.issubdtype(dtype, jnp.number) or jnp.issubdtype(dtype, jnp.bool_)):
            raise ValueError(f"{name}: {shown(leaf)} is no array of numbers")


def _is_plain(leaf: Any) -> bool:
    return not isinstance(leaf, jax.Array | jax.ShapeDtypeStruct)


def _require_fitting(leaf: np.ndarray, name: str) -> None:
    """Raise a `ValueError` for finite numbers that JAX's own type would make infinite."""
    dtype = jax.dtypes.canonicalize_dtype(leaf.dtype)
    if dtype == leaf.dtype:
        return
    with np.errstate(over="ignore"):
        lost = np.isfinite(leaf) & ~np.isfinite(leaf.astype(dtype))
    if lost.any():
        first = tuple(map(int, np.argwhere(lost)[0]))
        raise ValueError(
            f"{name}: {leaf[first]:g} at index {first if len(first) != 1 else first[0]} is more"
            f" than {dtype} holds; set jax_enable_x64, or choose other units"
        )


def _present_traced(leaves: list[Array], missing: str, takes_nan: bool) -> Bool[Array, " t"] | None:
    """Under the caller's jit the values are not there to name: the check runs with the rest."""
    usable = jnp.stack(_each_step(jnp, _usable(jnp, leaves, takes_nan), "all")).all(axis=0)
    if takes_nan and missing == "skip":
        seen = jnp.stack(_each_step(jnp, [~jnp.isnan(leaf) for leaf in leaves], "any"))
        return eqx.error_if(seen.any(axis=0), ~usable, "observations: infinite")
    if missing == "skip":
        return usable
    return eqx.error_if(usable, ~usable, "observations: NaN or infinite")


def checked(run: FilterRun) -> FilterRun:
    """The run, or an error where a density of the model was NaN or infinite."""
    increments = run.log_likelihood_increments
    if isinstance(increments, Tracer):
        return eqx.error_if(run, ~(increments < jnp.inf), _BROKEN_DENSITY)
    bad = ~(np.asarray(increments) < np.inf).all(axis=tuple(range(increments.ndim - 1)))
    if bad.any():
        raise RuntimeError(f"{_BROKEN_DENSITY}, first at index {int(np.argmax(bad))} of the steps")
    return run


def _as_moves(moves: Any, name: str) -> tuple[Any, ...]:
    """The moves as a tuple; a `ValueError` for what is none, or a single one without its list."""
    if not isinstance(moves, Iterable) or isinstance(moves, str | dict | jax.Array | np.ndarray):
        raise ValueError(f"{name}: {shown(moves)} is not a list of moves")
    moves = tuple(moves)
    for move in moves:
        check_callable("a move, (key, mixture, observation) -> mixture", **{name: move})
    return moves


def check_run(filter: Any, collect: Any) -> None:
    """Raise a `ValueError` for what is no filter, or cannot collect."""
    check_type(Filter, "a Filter", filter=filter)
    check_callable("a function of a mixture", **given(collect=collect))


# What JAX says where Python asks for the value of a number that it traces.
_NEEDS_VALUE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


def with_floats_traced(run: Callable[[Filter], PyTree], filter: Filter) -> PyTree:
    """`run(filter)`, compiled once for all values of the Python floats in it.

    Such numbers would otherwise be constants of the program, and each value another program. They
    stay constants where the model asks for their value in Python, as in `if self.phi > 0`.
    """
    if not any(type(leaf) is float for leaf in jax.tree.leaves(filter)):
        return run(filter)
    arrays = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, default_float()) if type(leaf) is float else leaf, filter
    )
    try:
        return run(arrays)
    except _NEEDS_VALUE:
        return run(filter)


def _check_sizes(num_particles: int, num_components: int) -> None:
    check_whole(num_particles=num_particles, num_components=num_components)
    if num_particles < num_components:
        raise ValueError(
            f"num_particles: {num_particles} is less than num_components, {num_components};"
            " every component needs a particle"
        )
