"""Partitioned sampling: one object after the other, with weighted resampling in between."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.arrays import to_rows
from mpfjax.checks import check, shown
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.multi_object import MultiObjectModel
from mpfjax.moves.base import AbstractPropagation, AbstractWrapper, Step
from mpfjax.moves.propagation.propagate import predict
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.logarithms import add_gradient, log_sum_exp
from mpfjax.operations.random import split
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import cond_if_any, take

Reassembly = Literal["evidence", "prior"]


class Partitioned(AbstractPropagation, AbstractWrapper):
    """Propagate one object after the other, resampling after each but the last.

    Smith and Gatica-Perez (2004), section 3: object j is propagated by its dynamics, the particles
    are resampled by importance weights ρ_i in proportion to a weight function g, and weights are
    divided by ρ_i. Here g is the object's factor of the target: its likelihood, and its potentials
    ψ with the objects propagated before it. Each g is multiplied into the joint weights. Resampling
    in proportion to the weights, with equal shares for the offspring, is then equivalent to the
    division. After the last object the weights contain L(y_t | x_t) D / q of the whole joint state,
    and Ẑ is unbiased for every order. All resampling is within components.

    - `orders`: the order in which objects are propagated, counted from 0. One order for all
      components, or one for each component. None is 0, ..., J-1.
    - `resample`: the resampling after each object; by default systematic, at every object, with
      equal allocation. With its gradient "stop" the objects' draws are constants too, and
      derivatives pass through their densities, as in `Propagate`.
    - `reassembly`: the weights of the components afterwards (section 4 and eq. 5). "evidence"
      multiplies each weight by the component's evidence, eq. 4 of Vermaak et al. (2003). "prior" is
      the paper's: each component returns to its previous weight, and only the total grows by the
      evidence. The marginal likelihood is then biased (`approximate` is true), but no component is
      lost by a single unlucky step. With one component both are the same.

    A component is lost if an object leaves it without weight. The others share its slots and, with
    "prior", its weight. If all weight is lost, the particles are propagated by their dynamics
    alone.

    Raises `ValueError` for orders that are no permutations, and an unknown reassembly; in a filter,
    for a model of one object, an order that is no permutation of its objects, and a number of
    orders other than one or the number of components.
    """

    orders: Any = eqx.field(converter=lambda orders: as_orders(orders), default=None)
    resample: Resample = eqx.field(default=Resample(allocation="equal"), kw_only=True)
    reassembly: Reassembly = eqx.field(static=True, default="evidence", kw_only=True)

    holds = ("resample",)

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for orders that do not fit the model's objects or components."""
        super().check(now, num_particles, num_components)
        check(MultiObjectModel, model=now.model)
        num_objects: int = now.model.num_objects  # pyright: ignore[reportAttributeAccessIssue]
        if self.orders is None:
            return
        if self.orders.shape[1] != num_objects:
            what = f"no permutation of the objects 0 to {num_objects - 1}"
            raise ValueError(f"orders: {shown(self.orders)} is {what}")
        if len(self.orders) not in (1, num_components):
            each = f"{len(self.orders)} of them, for {num_components} components"
            raise ValueError(f"orders: {each}")

    @property
    def approximate(self) -> bool:
        """Whether components return to their previous weight."""
        return self.reassembly == "prior"

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Propagate and weigh the objects of every particle in its component's order."""
        model, gradient = now.model, self.resample.gradient
        if now.is_missing:
            return predict(key, now.law, mixture, gradient, "independent")
        num_objects = model.num_objects
        # The objects' keys are those of the joint draw, so that one object is a plain filter.
        keys = split(key, 2 * num_objects)
        orders = np.arange(num_objects)[None] if self.orders is None else self.orders
        shape = (mixture.num_components, num_objects)
        orders = jnp.broadcast_to(orders, shape).astype(jnp.int32)
        observation = model.prepare_observation(now.observation)

        def stage(carry: tuple, inputs: tuple) -> tuple[tuple, None]:
            mixture, broken = carry
            rank, key_object, key_resample = inputs
            mixture = jax.lax.cond(
                rank > 0, lambda: self.resample.resample(key_resample, mixture), lambda: mixture
            )
            mixture, fault = self._advance(model, key_object, mixture, observation, orders, rank)
            return (mixture, broken | fault), None

        ranks = jnp.arange(num_objects, dtype=jnp.int32)
        inputs = (ranks, keys[:num_objects], keys[num_objects:])
        (moved, broken), _ = jax.lax.scan(stage, (mixture, jnp.zeros((), bool)), inputs)
        if self.reassembly == "prior" and mixture.num_components > 1:
            moved = _with_masses_of(mixture, moved)
        # Resampling may have lost a NaN, or left nothing of the particles but empty slots.
        log_weights = jnp.where(broken, jnp.nan, moved.log_weights)
        moved = moved.replace(log_weights=log_weights).with_resampled_of(mixture)
        lost = ~broken & ~jnp.any(moved.log_weights > -jnp.inf)

        def predicted() -> ParticleMixture:
            # Without weights: the step is then one of zero likelihood.
            nothing = jnp.full_like(mixture.log_weights, -jnp.inf)
            unseen = predict(key, now.law, mixture, gradient, "independent")
            unseen = unseen.replace(log_weights=nothing)
            return jax.tree.map(lambda new, old: jnp.where(lost, new, old), unseen, moved)

        return cond_if_any(lost, predicted, lambda: moved)

    def _advance(
        self,
        model: Any,
        key: Key[Array, ""],
        mixture: ParticleMixture,
        observation: PyTree,
        orders: Int[Array, "m objects"],
        rank: Int[Array, ""],
    ) -> tuple[ParticleMixture, Bool[Array, ""]]:
        """Move each particle's object of this rank; also whether a density was broken."""
        particles = mixture.particles
        objects = _of_particles(orders[:, rank], mixture)
        previous = model.object_states(particles, objects)
        states = model.sample_object_transition(key, previous, objects)
        if self.resample.gradient == "stop":
            states = jax.lax.stop_gradient(states)
        log_factors = model.object_log_likelihood(observation, states, objects)
        log_factors = log_factors.astype(mixture.log_weights.dtype)
        if self.resample.gradient == "stop":
            log_density = model.object_log_transition(states, previous, objects)
            log_factors = add_gradient(log_factors, log_density.astype(log_factors.dtype))
        moved = mixture.reweight(log_factors)
        if (interaction := model.interaction) is not None and model.num_objects > 1:
            ranks = jnp.arange(model.num_objects - 1, dtype=jnp.int32)
            has_moved = ranks < rank
            # Ranks still to come are replaced by the first: an object must not meet itself, since
            # a potential may have no gradient there.
            partners = orders[:, jnp.where(has_moved, ranks, 0)]

            def potential(partner: Int[Array, " m"]) -> Float[Array, " n"]:
                others = model.object_states(particles, _of_particles(partner, mixture))
                return interaction(states, others)

            values = jax.vmap(potential, in_axes=1)(partners).astype(log_factors.dtype)
            moved = moved.reweight(jnp.sum(jnp.where(has_moved[:, None], values, 0.0), axis=0))
        moved = moved.replace(particles=model.replace_object(particles, objects, states))
        return moved, jnp.any(~(moved.log_weights < jnp.inf))


def circular_orders(num_objects: int) -> Int[np.ndarray, "objects objects"]:
    """The circular shifts c, c+1, ..., c-1 of 0, ..., J-1, for c = 0, ..., J-1."""
    objects = np.arange(num_objects)
    return (objects[:, None] + objects[None]) % num_objects


def as_orders(orders: Any) -> Any:
    """One order a row; a `ValueError` for one that is no permutation."""
    if orders is None or isinstance(orders, AbstractStateSpaceModel):  # refused elsewhere
        return orders
    if isinstance(orders, Tracer):
        return jnp.atleast_2d(orders).astype(jnp.int32)
    table = to_rows(None, "orders", orders)
    is_order = np.sort(table, axis=1) == np.arange(table.shape[1])[None]
    if not np.ndim(orders) or not table.size or not is_order.all():
        raise ValueError(f"orders: {shown(orders)} is no permutation of objects from 0 on")
    return jnp.asarray(table, jnp.int32)


def _of_particles(objects: Int[Array, " m"], mixture: ParticleMixture) -> Int[Array, "*n"]:
    """The object of each particle's component; one for all where there is one component."""
    if mixture.num_components == 1:
        return objects[0]
    return take(objects, mixture.component_indicators)


def _with_masses_of(before: ParticleMixture, after: ParticleMixture) -> ParticleMixture:
    """The total mass of `after`, divided among its living components as in `before`."""
    masses = after.log_mixture_weights
    alive = masses > -jnp.inf
    prior = jnp.where(alive, before.log_mixture_weights, 0.0)
    log_total = log_sum_exp(jnp.where(alive, prior, -jnp.inf))
    shift = prior - jnp.where(alive, masses, 0.0) + log_sum_exp(after.log_weights) - log_total
    log_shift = spread(jnp.where(alive, shift, 0.0), after.component_indicators)
    return after.replace(log_weights=after.log_weights + log_shift)
