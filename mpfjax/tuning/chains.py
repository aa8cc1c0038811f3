"""Markov chains of parameters: what their kernels are, and the loop over their steps."""

import abc
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import Count, CountOrZero, warn
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.operations.stored import select_rows
from mpfjax.running.long_runs import Checkpoint, LongRun, State
from mpfjax.tuning.densities import RandomWalk, SamplePrior, drawn, random_walk
from mpfjax.tuning.problem import Problem, Reals
from mpfjax.tuning.summaries import effective_sample_size, numbers_of, row_of, split_r_hat, table

_MOST_DRAWS_OF_A_START = 100
# By one call of a program; between two of them bars advance and Ctrl-C is handled.
_STEPS_AT_ONCE = 10


@dataclass(frozen=True, kw_only=True, repr=False)
class PosteriorOfChains:
    """What the chains of every sampler leave, after their burn-in."""

    parameters: dict[str, np.ndarray]
    """by name, on their own scale: shape (chains, draws, ...)."""
    accepted: Float[np.ndarray, "chains draws"] | Bool[np.ndarray, "chains draws"]
    """which of these steps moved, or the share of their Metropolis steps that did."""
    stopped: str | None
    """why they ended before `num_steps`, or None."""
    num_invalid: Int[np.ndarray, " chains"]
    """how often in each chain a density was NaN or +inf, in all its steps."""
    problem: Problem = field(compare=False)
    """what was sampled: the filter, its parameters and the observations."""
    one_start: bool
    """whether several chains started at the same parameters, so that R-hat means nothing."""

    @property
    def acceptance_rate(self) -> float:
        """The share of steps, or of Metropolis steps, that moved."""
        return float(self.accepted.mean())

    def summary(self) -> dict[str, dict[str, float]]:
        """By parameter, or number of one: mean, deviation, quantiles, effective size and R-hat.

        Of split chains, as Vehtari et al. (2021) have them, without ranks. R-hat is NaN if all
        chains started at one point. It prints as a table.
        """
        rows = {}
        for name, draws in numbers_of(self.parameters, 2).items():
            rows[name] = row_of(draws.ravel())
            rows[name]["effective size"] = effective_sample_size(draws)
            rows[name]["R-hat"] = np.nan if self.one_start else split_r_hat(draws)
        return rows

    def __repr__(self) -> str:
        num_chains, num_draws = self.accepted.shape
        chains = f"{num_chains} chains" if num_chains > 1 else "1 chain"
        heading = f"{chains} of {num_draws} draws, {self.acceptance_rate:.0%} accepted"
        if self.one_start:
            heading += "; all start at one point: no R-hat without sample_prior"
        return table(heading + (f"; {self.stopped}" if self.stopped else ""), self.summary())


class Step(NamedTuple):
    """The result of one step of one chain."""

    state: Any  # its `reals` are the parameters
    report: tuple[Any, ...]  # parameters, their density or path, whether accepted, and the rest
    acceptance: Float[Array, ""]
    num_invalid: Int[Array, ""]  # how often a density was NaN or +inf


class AbstractKernel(eqx.Module):
    """A Markov kernel on parameters, and on whatever a chain carries with them."""

    learns_scale = False
    """whether the scale of its random walk follows the acceptance."""

    @abc.abstractmethod
    def start(self, key: Key[Array, ""], reals: Reals) -> tuple[Any, Bool[Array, ""]]:
        """The state at some parameters, and whether a chain can start there."""

    @abc.abstractmethod
    def step(self, key: Key[Array, ""], state: Any, walk: RandomWalk) -> Step:
        """One step of one chain."""


class Chains(eqx.Module):
    """The present state of all chains."""

    states: Any
    walk: RandomWalk
    num_invalid: Int[Array, " chains"]


@dataclass(frozen=True)
class Sampling:
    """Chains on the parameters of a problem, for the public function `caller`."""

    caller: str
    key: Key[Array, ""]
    problem: Problem
    deviations: Reals  # of the random walk at first
    num_steps: Count
    num_chains: Count
    sample_prior: SamplePrior | None
    burn_in: CountOrZero
    checkpoint: Checkpoint | None
    progress: bool

    def run(self, kernel: AbstractKernel) -> tuple[tuple[PyTree, PyTree], dict[str, Any]]:
        """The second and the last entry of reports, (chains, draws, ...), and other fields."""
        settings = self.problem.settings | {
            "observations": self.problem.objective, "proposal_deviations": self.deviations,
            "key": self.key, "burn_in": self.burn_in, "num_chains": self.num_chains,
        }  # fmt: skip
        last = self.burn_in + self.num_steps
        run = LongRun(self.caller, last, self.checkpoint, self.progress, lambda step: settings)
        key_starts, key_steps = jax.random.split(self.key)
        chains, none = self._start_chains(kernel, key_starts)
        state, stopped = run.go(State(0, chains, none), self._advance(kernel, key_steps))
        draws = jax.tree.map(lambda rows: np.moveaxis(rows[: self.num_steps], 0, 1), state.rows)
        reals, values, accepted, others = draws
        num_invalid = np.asarray(state.carry.num_invalid)
        warn_of_invalid(self.caller, int(num_invalid.sum()))
        return (values, others), {
            "parameters": self.problem.constrained_rows(reals), "problem": self.problem,
            "num_invalid": num_invalid, "stopped": stopped, "accepted": accepted,
            "one_start": self.num_chains > 1 and self.sample_prior is None,
        }  # fmt: skip

    def _start_chains(self, kernel: AbstractKernel, key: Key[Array, ""]) -> tuple[Chains, PyTree]:
        """All chains at their starts, and reports of no steps.

        They start at the filter's own parameters, or at draws of the prior. A draw at which a chain
        cannot start is drawn again.
        """
        start, fine, states = self.problem.start(), np.zeros(self.num_chains, bool), None
        reals = jax.tree.map(lambda u: jnp.broadcast_to(u, (self.num_chains, *u.shape)), start)
        for attempt in range(_MOST_DRAWS_OF_A_START if self.sample_prior else 1):
            again = jax.random.fold_in(key, attempt) if attempt else key
            if self.sample_prior is not None:
                reals = drawn(again, self.problem, self.sample_prior, self.num_chains)
            keys = jax.random.split(again, self.num_chains)
            walk = random_walk(self.deviations, reals)
            new, now_fine, none = _start_all(kernel, keys, reals, walk)
            states = select_rows(jnp.asarray(~fine), new.states, states) if attempt else new.states
            fine = fine | np.asarray(now_fine)
            if fine.all():
                walk = random_walk(self.deviations, states.reals)
                return Chains(states, walk, new.num_invalid), jax.tree.map(np.asarray, none)
        where = "the start" if self.sample_prior is None else "any draw of sample_prior"
        raise RuntimeError(f"{self.caller}: the prior or likelihood was NaN or inf at {where}")

    def _advance(self, kernel: AbstractKernel, key: Key[Array, ""]) -> Callable[..., Any]:
        """A few steps of all chains."""

        def advance(step: int, last: int, chains: Chains) -> tuple[int, Chains, PyTree]:
            last = min(step + _STEPS_AT_ONCE, last)
            numbers = jnp.array([step, last, self.burn_in], jnp.int32)
            chains, buffers = _steps(kernel, key, chains, numbers)
            new = max(last - max(step, self.burn_in), 0)
            # Waits for the program, so that an interruption comes before anything is taken over.
            return last, chains, jax.tree.map(lambda leaf: np.asarray(leaf)[:new], buffers)

        return advance


def warn_of_invalid(caller: str, number: int) -> None:
    """Warn of so many densities that were not numbers."""
    if number > 0:
        warn(f"{caller}: a density was NaN or +inf, taken for zero, {number} times", UserWarning)


@jit_on_wide_vectors
def _start_all(kernel, keys, reals, walk):
    """All chains at their starts, which could start, and reports of no steps."""
    states, fine = jax.vmap(kernel.start)(keys, reals)
    chains = Chains(states, walk, jnp.zeros(len(keys), jnp.int32))
    report = eqx.filter_eval_shape(_all_steps, kernel, keys[0], chains, 0).report
    none = jax.tree.map(lambda leaf: jnp.zeros((0, *leaf.shape), leaf.dtype), report)
    return chains, fine, none


def _all_steps(kernel: Any, key: Key[Array, ""], chains: Chains, step: Any) -> Step:
    """One step of every chain."""
    keys = jax.random.split(jax.random.fold_in(key, step), len(chains.num_invalid))
    return jax.vmap(kernel.step, in_axes=(0, 0, None))(keys, chains.states, chains.walk)


@jit_on_wide_vectors
def _steps(kernel, key, chains, numbers):
    """Some steps of all chains, and their draws: one program for any number of steps."""
    first, last, burn_in = numbers
    report = eqx.filter_eval_shape(_all_steps, kernel, key, chains, 0).report
    rows = (_STEPS_AT_ONCE,)
    buffers = jax.tree.map(lambda leaf: jnp.zeros(rows + leaf.shape, leaf.dtype), report)

    def advance(step: Array, carry: tuple[Chains, PyTree]) -> tuple[Chains, PyTree]:
        chains, buffers = carry
        steps = _all_steps(kernel, key, chains, step)
        points = jax.vmap(lambda reals: ravel_pytree(reals)[0])(steps.state.reals)
        acceptance = jnp.mean(steps.acceptance) if kernel.learns_scale else None
        adapted = partial(chains.walk.adapted, points, step, acceptance)
        walk = jax.lax.cond(step < burn_in, adapted, lambda: chains.walk)
        # In the burn-in, in the row of the first draw, which overwrites it.
        row = jnp.maximum(step - jnp.maximum(first, burn_in), 0)
        buffers = jax.tree.map(lambda rows, leaf: rows.at[row].set(leaf), buffers, steps.report)
        return Chains(steps.state, walk, chains.num_invalid + steps.num_invalid), buffers

    return jax.lax.fori_loop(first, last, advance, (chains, buffers))
