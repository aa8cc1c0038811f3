"""The particle mixture: one set of joint weights, and all quantities derived from it."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, Float, Inexact, Int, PyTree, Shaped

from mpfjax.checks import SHARES, Renamed, as_numbers, checked, saying
from mpfjax.operations.islands import (
    excess_over_islands,
    island_index,
    num_islands,
    sum_over_islands,
)
from mpfjax.operations.logarithms import (
    as_inexact,
    default_float,
    exp,
    finite_max,
    log_or_nothing,
    log_sum_exp,
    scaled_exp,
    softmax,
)
from mpfjax.operations.prefix_sums import sum_before
from mpfjax.operations.segments import (
    segment_any,
    segment_counts,
    segment_log_sum_exp,
    segment_softmax,
    segment_sum,
    spread,
)
from mpfjax.operations.stored import along_rows, select_rows, take


class MarginalisedState(NamedTuple):
    """Particles of a conditionally linear model: a latent, and the moments of the rest given it.

    - `latent`: z_t, a pytree whose leaves have a leading axis n.
    - `mean`, `covariance`: E and Cov of x_t given z_0, ..., z_t and y_1..y_t, (n, d) and (n, d, d).

    Means over particles, such as `ParticleMixture.mean` and `component_means`, have this form too;
    their covariance is the covariance of x_t, E[Cov[x | z]] + Cov[E[x | z]]. Distances between
    particles and flattened states are computed from `latent` and `mean`.
    """

    latent: PyTree
    mean: Float[Array, "*n d"]
    covariance: Float[Array, "*n d d"]


# Ancestor indices of particles that have no single ancestor in the step before.
NO_ANCESTOR, BEGAN_ANEW = -1, -2


class Within(eqx.Module):
    """What a mixture carries from move to move within a step, and nowhere else.

    - `parents`: x_{t-1} of each particle after the propagation, where a move of the chain asks for
      it (`AbstractMove.needs_parents`).
    - `resampled`: (m,), which of the components that the step began with have been resampled.
    - `log_increment`: the growth of the total weight so far, as a logarithm.
    - `in_order`: whether a move has put each component's particles in an order, along which a
      propagation that follows spreads its point sets.
    """

    resampled: Bool[Array, " m"]
    log_increment: Float[Array, ""]
    parents: PyTree = None
    in_order: bool = eqx.field(static=True, default=False)


class ParticleMixture(eqx.Module):
    """P_t = {N, M, Π, X, W, C}, the particles of a mixture (Vermaak et al. 2003, section 3).

    It stores ONE set of joint log-weights ℓ_i = log(π_{c_i} w_i), normalised over all particles.
    Mixture weights π_m = Σ_{c_i = m} exp ℓ_i and particle weights w_i = exp(ℓ_i) / π_{c_i} are
    derived and never stored. A reclustering (section 4) therefore only changes the indicators, and
    the exact re-weighting follows. Shapes are fixed: a slot of weight zero (ℓ = -inf) is empty, and
    a component without an occupied slot is empty too.

    - `particles`: a pytree whose leaves have a leading axis n, the states X.
    - `log_weights`: ℓ, shape (n,), -inf in an empty slot.
    - `component_indicators`: C, shape (n,), in [0, num_components).
    - `ancestor_indices`: shape (n,), the slot of each particle's parent in the previous step's
      mixture; -1 if it has no single parent (`AbstractMove.keeps_parents`), -2 if its state was
      restarted some steps before, by `with_initialisation` or `with_restarts`.
    - `num_components`: M, the maximum number of components, empty ones included; static. The
      filters of the literature call it `max_components`.
    - `memory`: quantities that moves store from step to step, by the move's name.
    - `usable_slots`: how many slots a move may fill, the first ones; None is all of them. Only
      `monte_carlo(..., num_slots=...)` sets it.
    - `t`: the number of steps; zero in a mixture of x_0. Within a step it is the number of that
      step.
    - `within`: what the moves of a step pass on to each other; None outside a step.
    - `log_scale`: the logarithm of a common factor of all weights. It is stored separately from ℓ,
      which would lose its digits if a log-likelihood of a million were added. After a step it is
      zero. In a mixture of x_0 it is the contribution of the initial moves to the first increment.
    - `waits`: whether resampling is postponed until the first observation. If that observation
      selected x_0, the weights are the inverse of the selection until it has weighted x_1 too, and
      an earlier resampling would undo the selection. None if no initial move changes weights.
    - `periods`: the periods of the model's state, in the form of one state, so that means and
      covariances are circular. Within a step it is None.

    The properties are those of a single mixture. For a stack of mixtures, as returned by
    `monte_carlo` and `collect=None`, they raise a `ValueError` that recommends `jax.vmap` over the
    leading axes.
    """

    particles: PyTree
    log_weights: Float[Array, " n"]
    component_indicators: Int[Array, " n"]
    ancestor_indices: Int[Array, " n"]
    num_components: int = eqx.field(static=True)
    memory: dict[str, PyTree] = eqx.field(default_factory=dict)
    usable_slots: Int[Array, ""] | None = None
    log_scale: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), default_float()))
    t: Int[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), jnp.int32))
    within: Within | None = None
    waits: Bool[Array, ""] | None = None
    periods: PyTree = None

    @property
    def num_particles(self) -> int:
        """N, the number of slots, occupied or not."""
        self._require_one()
        return self.log_weights.shape[0]

    @property
    def num_usable_slots(self) -> int | Int[Array, ""]:
        """How many slots a move may fill: `usable_slots`, or N where that is None."""
        return self.num_particles if self.usable_slots is None else self.usable_slots

    @property
    def occupied(self) -> Bool[Array, " n"]:
        """Which slots contain a particle of positive weight."""
        return self.log_weights > -jnp.inf

    @property
    def began_anew(self) -> Bool[Array, " n"]:
        """Which slots contain a state that was restarted some steps before (`with_restarts`)."""
        return self.ancestor_indices == BEGAN_ANEW

    @property
    def weights(self) -> Float[Array, " n"]:
        """exp ℓ, the joint weights; they sum to one over all particles."""
        self._require_one()
        values, log_scale = scaled_exp(self.log_weights)
        return values * exp(log_scale)

    @property
    def log_mass(self) -> Float[Array, ""]:
        """log Σ exp ℓ: zero once normalised, and the growth of the total weight before."""
        self._require_one()
        return log_sum_exp(self.log_weights) + self.log_scale

    @property
    def log_mixture_weights(self) -> Float[Array, " m"]:
        """log π_m, -inf for an empty component."""
        self._require_one()
        if self.num_components == 1:
            return log_sum_exp(self.log_weights)[None]
        return segment_log_sum_exp(self.log_weights, self.component_indicators, self.num_components)

    @property
    def mixture_weights(self) -> Float[Array, " m"]:
        """π_m, zero for an empty component."""
        return jnp.exp(self.log_mixture_weights)

    @property
    def component_counts(self) -> Int[Array, " m"]:
        """The number of occupied slots of each component."""
        self._require_one()
        labels = self.component_indicators
        if self.num_components == 1:
            # Labels that nothing reads are then not copied from step to step.
            labels = jnp.zeros_like(labels)
        return segment_counts(self.occupied, labels, self.num_components)

    @property
    def active(self) -> Bool[Array, " m"]:
        """Which components have particles."""
        self._require_one()
        if self.num_components == 1:
            return jnp.any(self.occupied)[None]
        return segment_any(self.occupied, self.component_indicators, self.num_components)

    @property
    def component_weights(self) -> Float[Array, " n"]:
        """w_i, the weights within each component; they sum to one in each active component."""
        self._require_one()
        if self.num_components == 1:
            return softmax(self.log_weights)
        return segment_softmax(self.log_weights, self.component_indicators, self.num_components)

    @property
    def component_effective_sample_sizes(self) -> Float[Array, " m"]:
        """1 / Σ w_i² of each component, zero for an empty one."""
        if self.num_components == 1:
            return self.effective_sample_size[None]
        squares, labels = self.component_weights**2, self.component_indicators
        total = segment_sum(squares, labels, self.num_components)
        return 1 / jnp.where(total > 0, total, jnp.inf)

    @property
    def effective_sample_size(self) -> Float[Array, ""]:
        """(Σ exp ℓ)² / Σ exp 2ℓ over all particles, zero where there is none."""
        self._require_one()
        values, _ = scaled_exp(self.log_weights)
        squares = jnp.sum(values**2)
        return jnp.sum(values) ** 2 * (1 / jnp.where(squares > 0, squares, jnp.inf))

    def component_expectations(self, values: Shaped[Array, "n *rest"]) -> Inexact[Array, "m *rest"]:
        """Σ_{c_i = m} w_i v_i, the weighted mean of `values` in each component, zero if empty.

        Integers and booleans are averaged as floating-point numbers.
        """
        values = _numbers(values)
        weights = self.component_weights.astype(values.dtype)
        filled = jnp.where(along_rows(self.occupied, values), values, jnp.zeros((), values.dtype))
        products = along_rows(weights, values) * filled
        return segment_sum(products, self.component_indicators, self.num_components)

    def component_groups(self, groups: Int[Array, " n"]) -> Int[Array, " m"]:
        """The group of each component, where the particles of each are of one."""
        return jnp.round(self.component_expectations(groups)).astype(jnp.int32)

    def component_means(self) -> PyTree:
        """The weighted mean of each component: every leaf (m, ...), NaN for an empty one.

        Leaves that are not floating point are averaged as in `component_expectations`. For periodic
        components of the state (the model's `periods`) it is the direction of the mean vector on
        the circle (Mardia and Jupp 2000), and at most half a period.
        """
        means = _averages(self.component_expectations, self.particles, self.periods)
        if isinstance(means, MarginalisedState):
            within = self._component_spread(self.particles.mean)
            means = means._replace(covariance=means.covariance + within)
        # Zero would look like a place.
        nowhere = jax.tree.map(partial(jnp.full_like, fill_value=jnp.nan), means)
        return select_rows(self.active, means, nowhere)

    def component_covariances(self) -> Float[Array, "m d d"]:
        """The weighted covariance of each component's flattened state, zero for an empty one.

        Periodic components of the state (the model's `periods`) differ from their mean by the
        shorter way around the circle.
        """
        if (periods := self.periods) is not None:
            shapes = jax.tree.map(lambda leaf: leaf[:1].shape, points(self.particles))
            every = jax.tree.map(jnp.broadcast_to, points(periods), shapes)
            periods = flatten_states(every)[0]
        covariances = self._component_spread(flatten_states(self.particles), periods)
        if not isinstance(self.particles, MarginalisedState):
            return covariances
        d = self.particles.mean.shape[1]
        within = self.component_expectations(self.particles.covariance)
        return covariances.at[:, -d:, -d:].add(within.astype(covariances.dtype))

    def _component_spread(
        self, values: Float[Array, "n d"], periods: Float[Array, " d"] | None = None
    ) -> Float[Array, "m d d"]:
        """The weighted covariance of the values in each component."""
        means = _averages(self.component_expectations, values, periods)
        centred = values - spread(means, self.component_indicators)
        if periods is not None:
            turns = jnp.round(centred / jnp.where(periods > 0, periods, jnp.inf)[None])
            centred -= periods[None] * turns
        return self.component_expectations(centred[:, :, None] * centred[:, None, :])

    def mean(self) -> PyTree:
        """E[x_t | y_1..y_t], leaf by leaf, over the whole mixture; see `expectation`.

        For periodic components of the state it is the circular mean, as in `component_means`.
        """
        mass = jnp.exp(self.log_mass) if num_islands() > 1 else None
        means = _averages(self.expectation, self.particles, self.periods, mass)
        if not isinstance(means, MarginalisedState):
            return means
        centred = self.particles.mean - sum_over_islands(means.mean)[None]
        between = self.expectation(centred[:, :, None] * centred[:, None, :])
        return means._replace(covariance=means.covariance + between)

    average = Renamed("average", "expectation")
    component_averages = Renamed("component_averages", "component_expectations")
    repeated = Renamed("repeated", "repeat")
    weighed = Renamed("weighed", "reweight")

    def expectation(self, values: Shaped[Array, "n *rest"]) -> Inexact[Array, " *rest"]:
        """Σ_i exp(ℓ_i) v_i, the estimate of an expectation under the filtering distribution.

        The average of the indicator of an event is its probability:
        `m.expectation(m.particles["mode"] == 2)`. Integers and booleans are averaged as
        floating-point numbers.
        """
        values = _numbers(values)
        is_filled, zero = along_rows(self.occupied, values), jnp.zeros((), values.dtype)
        filled = jnp.where(is_filled, values, zero)
        products = along_rows(self.weights.astype(values.dtype), values) * filled
        # On a CPU, XLA may take thirty times as long for a sum that also multiplies.
        return jnp.sum(jnp.where(is_filled, products, zero), axis=0)

    def variance(self, values: Shaped[Array, "n *rest"]) -> Inexact[Array, " *rest"]:
        """Σ_i exp(ℓ_i) (v_i - E[v])², of each entry separately; see `expectation`.

        It is computed about the mean, because E[v²] - E[v]² would be only rounding error if v is
        far from zero.
        """
        values = _numbers(values)
        mean = sum_over_islands(self.expectation(values))
        return self.expectation(jnp.abs(values - mean[None]) ** 2)

    @checked
    def quantile(
        self,
        values: Shaped[Array, "n *rest"] | Callable[[PyTree], Array],
        q: Annotated[float | Sequence[float] | Float[Array, "*q"], SHARES],
    ) -> Inexact[Array, "..."]:
        """Weighted quantiles of a value of each particle: the smallest v with P(value <= v) >= q.

        - `values`: (n, ...), of which each entry is treated separately, or a function of the
          particles that returns them.
        - `q`: in [0, 1], a number or several, whose axes come first in the result.

        `mixture.quantile(mixture.particles[:, 0], [0.05, 0.95])` is a 90% interval of the first
        component of x_t. Particles are weighted, unlike in `jnp.quantile`. The means of a
        `MarginalisedState` spread less than x_t does.
        """
        weights, shares = self.weights, jnp.asarray(q, self.log_weights.dtype)
        values = _numbers(values(self.particles) if callable(values) else values)

        def of_column(column: Inexact[Array, " n"]) -> Inexact[Array, " q"]:
            order = jnp.argsort(jnp.where(self.occupied, column, jnp.inf))
            below, total = sum_before(weights[order])
            places = jnp.searchsorted(below, shares.reshape(-1) * total) - 1
            return column[order][jnp.maximum(places, 0)]

        columns = values.reshape(self.num_particles, -1)
        quantiles = jax.vmap(of_column, in_axes=1, out_axes=1)(columns)
        return quantiles.reshape(*shares.shape, *values.shape[1:])

    def reweight(self, *log_factors: Float[Array, "#n"]) -> "ParticleMixture":
        """The mixture with its weights multiplied by exp of the factors, one array or several.

        The largest factor of the occupied slots is moved to `log_scale`, so that a constant of any
        size only changes the total weight. An empty slot stays empty for any factor.
        """
        log_weights, log_scale = self.log_weights, self.log_scale
        for factors in log_factors:
            factors = factors.astype(log_weights.dtype)
            common = finite_max(jnp.where(self.occupied, factors, -jnp.inf))
            log_weights = log_weights + (factors - common)
            log_scale = log_scale + common
        log_weights = jnp.where(self.occupied, log_weights, -jnp.inf)
        return self.replace(log_weights=log_weights, log_scale=log_scale)

    def normalised(self, previous: "ParticleMixture") -> tuple["ParticleMixture", Float[Array, ""]]:
        """The mixture with total weight one over all islands, and the log of its previous total.

        If no weight is left, the weights are those of `previous`.
        """
        # The scale is removed first, which is exact. If it were added to the logarithm of the sum,
        # that would be lost to rounding.
        values, log_largest = scaled_exp(self.log_weights)
        log_sum = log_or_nothing(jnp.sum(values))
        log_excess, log_total, log_scale = excess_over_islands(self.log_scale, log_largest, log_sum)
        has_mass = log_total > -jnp.inf
        log_share = log_excess - jnp.where(has_mass, log_total, 0.0)
        shares = (self.log_weights - log_largest) + log_share
        # A comparison with NaN is false, but NaN is not a step of zero likelihood.
        keep = has_mass | jnp.isnan(log_total)
        log_weights = jnp.where(keep, shares, previous.log_weights)
        waits = None if self.waits is None else jnp.zeros_like(self.waits)
        normal = self.replace(
            log_weights=log_weights, log_scale=jnp.zeros_like(log_total), waits=waits
        )
        return normal, log_scale + log_total

    def at_step(self) -> "ParticleMixture":
        """The mixture at the beginning of a step, each particle its own ancestor."""
        indices = jnp.arange(self.num_particles, dtype=jnp.int32)
        if num_islands() > 1:
            indices += self.num_particles * island_index()
        within = Within(jnp.zeros(self.num_components, bool), jnp.zeros((), self.log_weights.dtype))
        return self.replace(ancestor_indices=indices, t=self.t + 1, within=within, periods=None)

    @property
    def parents(self) -> PyTree:
        """x_{t-1} of each particle within a step, after the propagation; None where not kept."""
        return None if self.within is None else self.within.parents

    @property
    def in_order(self) -> bool:
        """Whether a move of this step has put each component's particles in an order."""
        return self.within is not None and self.within.in_order

    def with_parents(self) -> "ParticleMixture":
        """The mixture that keeps x_{t-1}, before a propagation; as it is if it keeps it already."""
        return self if self.parents is not None else self._within(parents=self.particles)

    def with_resampled(self, due: Bool[Array, " m"]) -> "ParticleMixture":
        """The mixture of a step in which these components have been resampled too."""
        return self if self.within is None else self._within(resampled=self.within.resampled | due)

    def with_resampled_of(self, other: "ParticleMixture") -> "ParticleMixture":
        """The mixture in which only these components count as resampled, whatever was since."""
        return self if other.within is None else self._within(resampled=other.within.resampled)

    def normalised_within(self, previous: "ParticleMixture") -> "ParticleMixture":
        """The mixture of a step, `normalised`, with the growth of its weight in `log_increment`."""
        normal, log_growth = self.normalised(previous)
        assert self.within is not None
        return normal._within(log_increment=self.within.log_increment + log_growth)

    def with_order(self, in_order: bool) -> "ParticleMixture":
        """The mixture of a step in which each component's particles are in an order, or not."""
        return self._within(in_order=in_order)

    def broken_where(self, fault: Bool[Array, "..."]) -> "ParticleMixture":
        """The mixture, whose increment of log Ẑ is NaN if there is any fault."""
        growth = jnp.where(jnp.any(fault), jnp.nan, 0.0).astype(self.log_scale.dtype)
        if self.within is None:
            return self.replace(log_scale=self.log_scale + growth)
        return self._within(log_increment=self.within.log_increment + growth)

    def _within(self, **fields: PyTree) -> "ParticleMixture":
        if self.within is None:
            return self
        return self.replace(within=dataclasses.replace(self.within, **fields))

    def at(self, slots: Int[Array, " k"]) -> "ParticleMixture":
        """The particles of these slots, with all that belongs to them.

        These are their weights, component indicators and ancestors, and within a step their
        parents. A move that takes particles from other slots than their own takes them so.
        """
        return self.map_slots(partial(take, indices=slots))

    def repeat(self, number: int) -> "ParticleMixture":
        """Each particle so many times, side by side, each time with its whole weight."""
        return self.map_slots(partial(jnp.repeat, repeats=number, axis=0))

    def map_slots(self, function: Callable[[Array], Array]) -> "ParticleMixture":
        """The mixture after a function of each array that has an entry for each slot."""
        arrays = jax.tree.map(function, attrgetter(*_OF_SLOTS)(self))
        mapped = self.replace(**dict(zip(_OF_SLOTS, arrays, strict=True)))
        return mapped._within(parents=jax.tree.map(function, self.parents))

    def replace(self, **fields: PyTree) -> "ParticleMixture":
        """A copy with some fields changed."""
        return dataclasses.replace(self, **fields)

    def _require_one(self) -> None:
        shape = self.log_weights.shape
        if len(shape) != 1:
            how = "jax.vmap(lambda mixture: mixture.mean())(mixtures)"
            stack = " x ".join(map(str, shape[:-1]))
            raise ValueError(f"mixture: a stack of {stack} mixtures has no property of one; {how}")


_OF_SLOTS = ("particles", "log_weights", "component_indicators", "ancestor_indices")


def no_ancestors(mixture: ParticleMixture) -> Int[Array, " n"]:
    """The ancestor indices of particles that come from no single one."""
    return jnp.full_like(mixture.ancestor_indices, NO_ANCESTOR)


def single_component(particles: PyTree, num_components: int = 1) -> ParticleMixture:
    """Equally weighted particles, all in component 0, each its own ancestor."""
    num_slots = jax.tree.leaves(particles)[0].shape[0]
    return ParticleMixture(
        particles=particles,
        log_weights=jnp.full(num_slots, -jnp.log(num_slots), default_float()),
        component_indicators=jnp.zeros(num_slots, jnp.int32),
        ancestor_indices=jnp.arange(num_slots, dtype=jnp.int32),
        num_components=num_components,
    )


def points(particles: PyTree) -> PyTree:
    """The leaves of the particles that give their places: all but covariances they may carry."""
    if isinstance(particles, MarginalisedState):
        return particles.latent, particles.mean
    return particles


def flatten_states(particles: PyTree) -> Float[Array, "n d"]:
    """All leaves of the particles side by side, one row a particle."""
    # Whole numbers beside others, in the type of these.
    with jax.numpy_dtype_promotion("standard"):
        rows = jax.vmap(lambda one: ravel_pytree(one)[0])(points(particles))
    return as_inexact(rows)


def _averages(
    average: Callable[[Array], Array],
    values: PyTree,
    periods: PyTree,
    mass: Float[Array, ""] | None = None,
) -> PyTree:
    """The averages of the values, leaf by leaf, on a circle where there is a period.

    With the `mass` of one island, what sums to the average over all of them.
    """
    if periods is None:
        return jax.tree.map(average, values)
    if isinstance(values, MarginalisedState):
        latent, mean = _averages(average, points(values), points(periods), mass)
        return MarginalisedState(latent, mean, average(values.covariance))

    def on_circle(values: Array, period: ArrayLike) -> Array:
        mean, period = average(values), jnp.asarray(period)
        scale = jnp.where(period > 0, period, 1.0) / (2 * jnp.pi)
        angles = values / jnp.broadcast_to(scale, values.shape)
        sine, cosine = average(jnp.sin(angles)), average(jnp.cos(angles))
        if mass is not None:
            sine, cosine = sum_over_islands(sine), sum_over_islands(cosine)
        angle = jnp.arctan2(sine, cosine) * jnp.broadcast_to(scale, mean.shape)
        angle = angle if mass is None else angle * mass.astype(angle.dtype)
        return jnp.where(jnp.broadcast_to(period > 0, mean.shape), angle, mean)

    with saying("periods", "in the form of one state"):
        return jax.tree.map(on_circle, values, periods)


def _numbers(values: Shaped[Array, "*shape"]) -> Inexact[Array, "*shape"]:
    """The values as an array to be averaged: also from numpy, and in floating point."""
    return jnp.asarray(as_numbers("values", values, floating=True, may_be_complex=True))
