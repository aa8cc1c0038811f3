"""Metropolis moves: each x_t moves by a kernel that keeps its own target; the weights stay."""

import abc
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, Exponent, InnerShare
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import require
from mpfjax.models.law import law_of, refuse_marginalised
from mpfjax.moves.base import AbstractMarkovMove, Gradient, Step, is_missing
from mpfjax.moves.propagation.tempered import accepted
from mpfjax.operations.logarithms import add_gradient, without_gradient
from mpfjax.operations.matrices import row_sums
from mpfjax.operations.random import normal, split, uniform


class _Target(NamedTuple):
    """The target of every particle: D(x_t | x_{t-1}) L(y_t | x_t)^β, given its parent."""

    model: Any
    parents: PyTree
    observation: PyTree
    exponent: float

    def __call__(self, states: PyTree) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """log D and log L, separately: with a large constant in L, their sum loses digits of D."""
        log_likelihood = law_of(self.model).log_likelihood(self.observation, states)
        return law_of(self.model).log_transition(states, self.parents), log_likelihood

    def ratio(self, new: tuple[Array, Array], old: tuple[Array, Array]) -> Float[Array, " n"]:
        """log π(x') - log π(x)."""
        return (new[0] - old[0]) + self.exponent * (new[1] - old[1])


class AbstractMetropolis(AbstractMarkovMove):
    """Steps of Metropolis and Hastings for every particle, given its parent x_{t-1}.

    The move of a resample-move filter (Gilks and Berzuini 2001). After x_t was drawn and weighed,
    and perhaps resampled, each x_t takes `num_moves` steps of a Markov chain that leaves D(x_t |
    x_{t-1}) L(y_t | x_t)^β invariant. The weights do not change, Ẑ stays unbiased, and offspring of
    one particle become distinct. Components keep their mass and their particles.

    Nothing is tuned on the particles that move, since that would not be exact. The length of a step
    is s times the standard deviation of the dynamics, where log s is uniform between log
    `least_step` and 0 and drawn anew each time. The standard deviation is that of new draws from
    D(. | x_{t-1}). Integer parts of the state do not move.

    - `num_moves`: how many steps each particle takes.
    - `least_step`: the smallest s.
    - `exponent`: β, for a likelihood that enters by powers, as with `Reweight(exponent)`.
    - `gradient`: "none" differentiates the draws, "stop" the density of the state after the move,
      as with `gradient` of `Propagate`.

    Raises `ValueError` for no steps, a least step or an exponent out of range, and in a filter of a
    model without `log_transition`.
    """

    num_moves: Count = eqx.field(static=True, default=1)
    least_step: InnerShare = eqx.field(static=True, default=0.02, kw_only=True)
    exponent: Exponent = eqx.field(static=True, default=1.0, kw_only=True)
    gradient: Gradient = eqx.field(static=True, default="none", kw_only=True)

    needs_parents = True
    """the target of x_t is given x_{t-1}."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model without `log_transition`."""
        refuse_marginalised(now.model, type(self).__name__)
        require(now.model, "log_transition", type(self).__name__)

    @abc.abstractmethod
    def propose(
        self, key: Key[Array, ""], length: Float[Array, " n"], states: PyTree, target: _Target
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """A proposal for every particle, and log q(x | x') - log q(x' | x)."""

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Move every particle, unless y_t is missing."""
        if is_missing(now):
            return mixture
        if mixture.parents is None:
            who = f"moves: {type(self).__name__}"
            raise ValueError(f"{who} comes before any propagation: there is no x_t yet")
        target = _Target(now.model, mixture.parents, now.observation, self.exponent)
        states = mixture.particles
        if self.gradient == "stop":
            states = without_gradient(states)
        first = densities = target(states)
        dtype = densities[1].dtype
        for step_key in split(key, self.num_moves):
            key_length, key_proposal, key_taken = split(step_key, 3)
            length = self.least_step ** uniform(key_length, (mixture.num_particles,), dtype)
            proposed, log_ratio = self.propose(key_proposal, length, states, target)
            those = target(proposed)
            log_ratio += target.ratio(those, densities)
            new, old = (proposed, those), (states, densities)
            states, densities = accepted(key_taken, log_ratio, new, old)
        log_weights = mixture.log_weights
        if self.gradient == "stop":
            states = without_gradient(states)
            moved = jnp.where(mixture.occupied, target.ratio(target(states), first), 0.0)
            log_weights = add_gradient(log_weights, moved.astype(log_weights.dtype))
        return mixture.replace(particles=states, log_weights=log_weights)


class RandomWalkMetropolis(AbstractMetropolis):
    """Metropolis steps by a random walk: x' = x + s (a - b) / √2 with a, b ~ D(. | x_{t-1}).

    The difference of two draws from the dynamics is symmetric and has twice their covariance. Every
    particle therefore walks in the units and along the correlations of its own dynamics.
    Differential evolution (ter Braak 2006) uses differences of particles in the same way, but is
    not exact here. See `AbstractMetropolis`, which has the arguments.

    Each step takes two draws of the dynamics, and one evaluation of D and L. Use it after a
    resampling that leaves few distinct particles.
    """

    def propose(
        self, key: Key[Array, ""], length: Float[Array, " n"], states: PyTree, target: _Target
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """x + s (a - b) / √2, whose reverse step has the same density."""
        rows, back = _as_rows(states)
        gaps = _gaps(key, target.model, target.parents)
        step = length.astype(rows.dtype)[:, None] * gaps / math.sqrt(2)
        return back(rows + step), jnp.zeros_like(length)


class MetropolisAdjustedLangevin(AbstractMetropolis):
    """Metropolis steps along the gradient: x' = x + s²/2 C ∇ log π(x) + s C^½ ξ, ξ ~ N(0, I).

    MALA (Roberts and Tweedie 1996) for π = D L^β, the gradient by JAX. C is diagonal: the variances
    of the dynamics, from pairs of fresh draws for all parents. See `AbstractMetropolis`, which has
    the arguments. Each step takes two draws of the dynamics, two gradients and an evaluation of D
    and L. Use it in more than a few dimensions, where D and L are smooth.
    """

    def propose(
        self, key: Key[Array, ""], length: Float[Array, " n"], states: PyTree, target: _Target
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """A step of the Langevin diffusion, and the reverse step's log density relative to it."""
        rows, back = _as_rows(states)
        key_spread, key_noise = split(key, 2)
        gaps = _gaps(key_spread, target.model, target.parents)
        deviations = jnp.sqrt(0.5 * jnp.mean(gaps**2, axis=0))
        unit = length.astype(rows.dtype)[:, None] * deviations[None]

        def drift(rows: Float[Array, "n d"]) -> Float[Array, "n d"]:
            """s/2 C^½ ∇ log π, in the units of the noise."""

            def total(rows: Float[Array, "n d"]) -> Float[Array, ""]:
                log_dynamics, log_likelihood = target(back(rows))
                return jnp.sum(log_dynamics) + target.exponent * jnp.sum(log_likelihood)

            return 0.5 * unit * jax.grad(total)(rows)

        noise, forth = normal(key_noise, rows.shape, rows.dtype), drift(rows)
        proposed = rows + unit * (forth + noise)
        # The noise of the reverse step, from x' to x.
        reverse = forth + drift(proposed) + noise
        log_ratio = row_sums(0.5 * (noise**2 - reverse**2))
        return back(proposed), log_ratio.astype(length.dtype)


def _as_rows(states: PyTree) -> tuple[Float[Array, "n d"], Callable[[Array], PyTree]]:
    """The floating point numbers of each particle as a row, and what makes states of such rows."""
    floats, rest = eqx.partition(states, eqx.is_inexact_array)
    unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], floats))[1]
    rows = jax.vmap(lambda one: ravel_pytree(one)[0])(floats)
    return rows, lambda rows: eqx.combine(jax.vmap(unravel)(rows), rest)


def _gaps(key: Key[Array, ""], model: Any, parents: PyTree) -> Float[Array, "n d"]:
    """The difference of two draws of x_t from each parent, as rows."""
    first, second = (_as_rows(model.sample_transition(own, parents))[0] for own in split(key, 2))
    return without_gradient(first - second)
