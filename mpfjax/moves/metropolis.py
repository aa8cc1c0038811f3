"""Metropolis moves: each x_t moves by a kernel that leaves its target invariant."""

import abc
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import require
from mpfjax.models.law import law_of, refuse_marginalised
from mpfjax.moves.base import AbstractMarkovMove, Gradient, Step
from mpfjax.operations.logarithms import add_gradient, without_gradient
from mpfjax.operations.random import split, uniform
from mpfjax.operations.stored import select_rows

# A step of 2% to 100% of the dynamics' standard deviation suits likelihoods from narrow to broad.
_LEAST_STEP = 0.02


class _Target(NamedTuple):
    """The target of every particle: D(x_t | x_{t-1}) L(y_t | x_t), given its parent."""

    model: Any
    parents: PyTree
    observation: PyTree

    def __call__(self, states: PyTree) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """log D and log L, separately: with a large constant in L, their sum loses digits of D."""
        log_likelihood = law_of(self.model).log_likelihood(self.observation, states)
        return law_of(self.model).log_transition(states, self.parents), log_likelihood

    def ratio(self, new: tuple[Array, Array], old: tuple[Array, Array]) -> Float[Array, " n"]:
        """log π(x') - log π(x)."""
        return (new[0] - old[0]) + (new[1] - old[1])


class AbstractMetropolis(AbstractMarkovMove):
    """Metropolis-Hastings steps for every particle, given its parent x_{t-1}.

    The move of a resample-move filter (Gilks and Berzuini 2001). After x_t was drawn, weighted and
    possibly resampled, each x_t takes a step of a Markov chain that leaves D(x_t | x_{t-1}) L(y_t |
    x_t) invariant. The weights do not change, Ẑ remains unbiased, and the offspring of one particle
    become distinct. Components keep their weights and their particles. For several steps, list the
    move several times in the chain.

    Nothing is adapted to the particles that move, because this would not be exact. The length of a
    step is s times the standard deviation of the dynamics, where log s is uniform between log 0.02
    and 0 and drawn for each step. The standard deviation is estimated from new draws of D(. |
    x_{t-1}). Integer parts of the state do not move.

    - `gradient`: "none" differentiates the draws, "stop" the density of the state after the move,
      as with `gradient` of `Propagate`.

    Raises `ValueError` in a filter of a model without `log_transition`, and for a state of integers
    alone.
    """

    gradient: Gradient = eqx.field(static=True, default="none", kw_only=True)

    needs_parents = True
    """the target of x_t is given x_{t-1}."""

    # Derivatives do not see which moves are accepted.
    biases_score = property(lambda self: self.gradient == "none")

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
        if now.is_missing:
            return mixture
        if mixture.parents is None:
            who = f"moves: {type(self).__name__}"
            raise ValueError(f"{who} comes before any propagation: there is no x_t yet")
        target = _Target(now.model, mixture.parents, now.observation)
        states = mixture.particles
        if self.gradient == "stop":
            states = without_gradient(states)
        first = target(states)
        (key_step,) = split(key, 1)
        key_length, key_proposal, key_taken = split(key_step, 3)
        length = _LEAST_STEP ** uniform(key_length, (mixture.num_particles,), first[1].dtype)
        proposed, log_ratio = self.propose(key_proposal, length, states, target)
        log_ratio += target.ratio(target(proposed), first)
        # A ratio that is NaN is rejected.
        is_accepted = jnp.log(uniform(key_taken, log_ratio.shape, log_ratio.dtype)) < log_ratio
        states = select_rows(is_accepted, proposed, states)
        log_weights = mixture.log_weights
        if self.gradient == "stop":
            states = without_gradient(states)
            moved = jnp.where(mixture.occupied, target.ratio(target(states), first), 0.0)
            log_weights = add_gradient(log_weights, moved.astype(log_weights.dtype))
        return mixture.replace(particles=states, log_weights=log_weights)


class RandomWalkMetropolis(AbstractMetropolis):
    """Metropolis steps by a random walk: x' = x + s (a - b) / √2 with a, b ~ D(. | x_{t-1}).

    The difference of two draws from the dynamics is symmetric and has twice their covariance, so
    every particle walks in the units and along the correlations of its own dynamics. Differential
    evolution (ter Braak 2006) uses differences of particles in the same way, but is not exact here.
    `AbstractMetropolis` describes the arguments.

    Each step takes two draws of the dynamics, and one evaluation of D and L. Use it after a
    resampling that leaves few distinct particles.
    """

    def propose(
        self, key: Key[Array, ""], length: Float[Array, " n"], states: PyTree, target: _Target
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """x + s (a - b) / √2, whose reverse step has the same density."""
        rows, back = _as_rows(states)
        draws = [target.model.sample_transition(each, target.parents) for each in split(key, 2)]
        a, b = (_as_rows(each)[0] for each in draws)
        step = length.astype(rows.dtype)[:, None] * without_gradient(a - b) / math.sqrt(2)
        return back(rows + step), jnp.zeros_like(length)


def _as_rows(states: PyTree) -> tuple[Float[Array, "n d"], Callable[[Array], PyTree]]:
    """The floating point numbers of each particle as a row, and what makes states of such rows."""
    floats, rest = eqx.partition(states, eqx.is_inexact_array)
    if not jax.tree.leaves(floats):
        raise ValueError("model: a Metropolis move needs a state with floating point numbers")
    unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], floats))[1]
    rows = jax.vmap(lambda one: ravel_pytree(one)[0])(floats)
    return rows, lambda rows: eqx.combine(jax.vmap(unravel)(rows), rest)
