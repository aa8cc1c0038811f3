"""Markov chains of parameters: what their kernels are, and the loop over their steps."""

import abc
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import Checked, Count, CountOrZero, warn
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.running.long_runs import Checkpoint, LongRun, State, identity_of
from mpfjax.tuning.densities import SamplePrior, chosen, drawn
from mpfjax.tuning.problem import Problem, Reals
from mpfjax.tuning.walks import RandomWalk, random_walk

_MOST_DRAWS_OF_A_START = 100
# A program holds at most this many draws, or bytes of them, before they leave the device.
_MOST_DRAWS_AT_ONCE = 256
_MOST_BYTES_AT_ONCE = 2**24
# Between two calls of a program bars advance, files are written and Ctrl-C is handled.
_SECONDS_BETWEEN = 0.5


class Step(NamedTuple):
    """The result of one step of one chain."""

    state: Any
    """where the chain is; its `reals` are the parameters."""
    report: PyTree
    """what is kept of the step."""
    acceptance: Float[Array, ""]
    invalid: dict[str, Array]
    """how often a density was NaN or +inf, by its name."""


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


class ChainOptions(TypedDict, total=False):
    """What `metropolis_hastings` and `particle_gibbs` both take, beside their own arguments."""

    num_chains: int
    sample_prior: SamplePrior | None
    burn_in: int
    thinning: int
    checkpoint: Checkpoint | None
    progress: bool


class Chains(eqx.Module):
    """The present state of all chains."""

    states: Any
    walk: RandomWalk
    num_invalid: dict[str, Int[Array, " chains"]]


class Sampling(Checked):
    """Chains on the parameters of a problem, for the public function `caller`."""

    caller: str
    key: Key[Array, ""]
    problem: Problem
    deviations: Reals
    """of the random walk at first."""
    num_steps: Count
    num_chains: Count = 1
    sample_prior: SamplePrior | None = None
    burn_in: CountOrZero = 0
    thinning: Count = 1
    checkpoint: Checkpoint | None = None
    progress: bool = True

    def __check_init__(self) -> None:
        super().__check_init__()
        if self.thinning > self.num_steps:
            raise ValueError(f"thinning: {self.thinning} is more than num_steps, {self.num_steps}")

    def run(
        self, kernel: AbstractKernel, settings: dict[str, Any], functions: dict[str, Any]
    ) -> tuple[PyTree, dict[str, Any]]:
        """The draws, leaves (chains, draws, ...), and further fields of a posterior.

        The last two arguments are those of `identity_of`.
        """
        settings = self.problem.settings | settings | {
            "proposal_deviations": self.deviations, "key": self.key, "burn_in": self.burn_in,
            "num_chains": self.num_chains, "thinning": self.thinning,
        }  # fmt: skip
        identity = identity_of(self.checkpoint, settings, functions)
        num_draws = self.num_steps // self.thinning
        last = self.burn_in + num_draws * self.thinning
        run = LongRun(self.caller, last, self.checkpoint, self.progress, lambda step: identity)
        key_starts, key_steps = jax.random.split(self.key)
        starts = self._starts(key_starts)
        at = eqx.filter_eval_shape(self._chains_at, kernel, key_starts, starts)
        report = eqx.filter_eval_shape(_one_step, kernel, key_steps, at[0], 0).report
        none = jax.tree.map(lambda leaf: np.empty((0, *leaf.shape), leaf.dtype), report)

        def start() -> State:
            return State(0, self._started(kernel, key_starts, starts), none)

        advance = self._advance(kernel, key_steps, report)
        state, stopped = run.go(State(0, at[0], none), start, advance)
        draws = jax.tree.map(lambda rows: np.moveaxis(rows[:num_draws], 0, 1), state.rows)
        num_invalid = jax.tree.map(np.asarray, state.carry.num_invalid)
        warn_of_invalid(self.caller, num_invalid)
        factor = np.asarray(state.carry.walk.factor)
        fields = {"num_invalid": num_invalid, "stopped": stopped, "problem": self.problem}
        return draws, fields | {"proposal_covariance": factor @ factor.T}

    def _starts(self, key: Key[Array, ""]) -> Reals:
        """Where each chain starts: the filter's own parameters, or a draw of the prior."""
        if self.sample_prior is not None:
            return drawn(key, self.problem, self.sample_prior, self.num_chains)
        return jax.tree.map(
            lambda reals: jnp.broadcast_to(reals, (self.num_chains, *reals.shape)),
            self.problem.start(),
        )

    def _chains_at(
        self, kernel: AbstractKernel, key: Key[Array, ""], reals: Reals
    ) -> tuple[Chains, Bool[Array, " chains"]]:
        """All chains at some parameters, and which can start there."""
        keys = jax.random.split(key, self.num_chains)
        return _start_all(kernel, keys, reals, random_walk(self.deviations, reals))

    def _started(self, kernel: AbstractKernel, key: Key[Array, ""], reals: Reals) -> Chains:
        """All chains at their starts.

        A draw of the prior at which a chain cannot start is drawn again.
        """
        chains, fine = self._chains_at(kernel, key, reals)
        where = "the start" if self.sample_prior is None else "any draw of sample_prior"
        for attempt in range(1, _MOST_DRAWS_OF_A_START if self.sample_prior else 1):
            if np.all(fine):
                break
            again = jax.random.fold_in(key, attempt)
            new, now_fine = self._chains_at(kernel, again, self._starts(again))
            states = jax.vmap(chosen)(fine, chains.states, new.states)
            walk = random_walk(self.deviations, states.reals)
            chains, fine = Chains(states, walk, chains.num_invalid), fine | now_fine
        if not np.all(fine):
            raise RuntimeError(f"{self.caller}: the prior or likelihood was NaN or inf at {where}")
        return chains

    def _num_draws(self, step: int) -> int:
        """How many draws there are after some steps."""
        return max(step - self.burn_in, 0) // self.thinning

    def _advance(
        self, kernel: AbstractKernel, key: Key[Array, ""], report: PyTree
    ) -> Callable[..., Any]:
        """Some steps of all chains, about as many as take half a second."""
        length = 1
        size = 8 * sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(report))
        capacity = max(2, min(_MOST_DRAWS_AT_ONCE, _MOST_BYTES_AT_ONCE // max(size, 1)))

        def advance(step: int, last: int, chains: Chains) -> tuple[int, Chains, PyTree]:
            nonlocal length
            last = min(step + length, last)
            began = time.monotonic()
            numbers = jnp.array([step, last, self.burn_in, self.thinning], jnp.int32)
            chains, buffers = _steps(kernel, key, chains, numbers, capacity)
            new = self._num_draws(last) - self._num_draws(step)
            # Waits for the program, so that an interruption comes before anything is taken over.
            rows = jax.tree.map(lambda leaf: np.asarray(leaf)[:new], buffers)
            seconds = time.monotonic() - began
            if seconds < _SECONDS_BETWEEN / 2:
                length = min(2 * length, (capacity - 1) * self.thinning)
            elif seconds > 2 * _SECONDS_BETWEEN:
                length = max(1, length // 2)
            return last, chains, rows

        return advance


def warn_of_invalid(caller: str, num_invalid: Mapping[str, Any]) -> None:
    """Warn of densities that were not numbers, by their names."""
    found = [f"{name} {np.sum(each)} times" for name, each in num_invalid.items() if np.any(each)]
    if found:
        warn(f"{caller}: NaN or +inf, taken for zero density: {', '.join(found)}", UserWarning)


@jit_on_wide_vectors
def _start_all(kernel, keys, reals, walk):
    """All chains at their starts, and which could start."""
    states, fine = jax.vmap(kernel.start)(keys, reals)
    steps = eqx.filter_eval_shape(_all_steps, kernel, keys[0], Chains(states, walk, {}), 0)
    counts = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, jnp.int32), steps.invalid)
    return Chains(states, walk, counts), fine


def _all_steps(kernel: Any, key: Key[Array, ""], chains: Chains, step: Any) -> Step:
    """One step of every chain."""
    num_chains = jax.tree.leaves(chains.states)[0].shape[0]
    keys = jax.random.split(jax.random.fold_in(key, step), num_chains)
    return jax.vmap(kernel.step, in_axes=(0, 0, None))(keys, chains.states, chains.walk)


# Traced once for calls of the same shapes: only the shapes of its report are asked for.
_one_step = jit_on_wide_vectors(_all_steps)


@jit_on_wide_vectors
def _steps(kernel, key, chains, numbers, capacity):
    """Some steps of all chains, and their draws: one program for any number of steps."""
    first, last, burn_in, thinning = numbers
    report = eqx.filter_eval_shape(_all_steps, kernel, key, chains, 0).report
    buffers = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), report)
    before = jnp.maximum(first - burn_in, 0) // thinning

    def advance(step: Array, carry: tuple[Chains, PyTree]) -> tuple[Chains, PyTree]:
        chains, buffers = carry
        steps = _all_steps(kernel, key, chains, step)
        points = jax.vmap(lambda reals: ravel_pytree(reals)[0])(steps.state.reals)
        acceptance = jnp.mean(steps.acceptance) if kernel.learns_scale else None
        walk = jax.lax.cond(
            step < burn_in,
            lambda: chains.walk.adapted(points, step, acceptance),
            lambda: chains.walk,
        )
        counts = jax.tree.map(
            lambda sum, new: sum + new.astype(sum.dtype), chains.num_invalid, steps.invalid
        )
        # A draw is the last of the steps that are written to its row.
        row = jnp.clip((step - burn_in) // thinning - before, 0, capacity - 1)
        buffers = jax.tree.map(lambda rows, leaf: rows.at[row].set(leaf), buffers, steps.report)
        return Chains(steps.state, walk, counts), buffers

    return jax.lax.fori_loop(first, last, advance, (chains, buffers))
