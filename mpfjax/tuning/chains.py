"""The loop over the steps of Markov chains, which the samplers of parameters share."""

import abc
import math
import os
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree
from tqdm import tqdm

from mpfjax.checks import check_flag, check_whole
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.running.storage.checkpoints import Checkpoint, Notes, identity_of
from mpfjax.tuning.problem import Reals
from mpfjax.tuning.starts import Starts, drawn, repeated
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

    @property
    @abc.abstractmethod
    def learns_scale(self) -> bool:
        """Whether the scale of its random walk follows the acceptance."""

    @abc.abstractmethod
    def start(self, key: Key[Array, ""], reals: Reals) -> tuple[Any, Bool[Array, ""]]:
        """The state at some parameters, and whether a chain can start there."""

    @abc.abstractmethod
    def step(self, key: Key[Array, ""], state: Any, walk: RandomWalk) -> Step:
        """One step of one chain."""


@dataclass(frozen=True)
class Plan:
    """The length of chains, and which of their steps are kept."""

    num_steps: int
    burn_in: int
    thinning: int
    adapt: bool

    def __post_init__(self) -> None:
        check_whole(num_steps=self.num_steps, thinning=self.thinning)
        check_whole(0, burn_in=self.burn_in)
        check_flag(adapt=self.adapt)
        if self.thinning > self.num_steps:
            raise ValueError(
                f"thinning: {self.thinning} is more than num_steps, {self.num_steps}: no step"
                " would be kept"
            )

    @property
    def settings(self) -> dict[str, int]:
        """All that has to be the same for a checkpoint to fit, by name."""
        return {
            "burn_in": int(self.burn_in), "thinning": int(self.thinning), "adapt": bool(self.adapt)
        }  # fmt: skip

    @property
    def total(self) -> int:
        """The number of steps, of burn-in and after, up to the last one that is kept."""
        return self.burn_in + self.num_steps // self.thinning * self.thinning

    def num_draws(self, step: int) -> int:
        """How many draws there are after some steps."""
        return max(step - self.burn_in, 0) // self.thinning


class Chains(eqx.Module):
    """The present state of all chains."""

    states: Any
    walk: RandomWalk
    num_invalid: dict[str, Int[Array, " chains"]]


@dataclass(frozen=True)
class Outcome:
    """The draws of chains, leaves (chains, draws, ...), and their state at the end."""

    draws: PyTree
    chains: Chains
    stopped: str | None

    @property
    def proposal_covariance(self) -> np.ndarray:
        """Of the random walk at the end."""
        factor = np.asarray(self.chains.walk.factor)
        return factor @ factor.T

    @property
    def num_invalid(self) -> dict[str, np.ndarray]:
        """How often each density was no number, by chain."""
        return {name: np.asarray(counts) for name, counts in self.chains.num_invalid.items()}


@dataclass(frozen=True)
class Run:
    """Chains of a kernel, for the public function `caller`."""

    caller: str
    kernel: AbstractKernel
    starts: Starts
    key: Key[Array, ""]
    plan: Plan
    file: Checkpoint | None

    def sample(self, every: int, progress: bool) -> Outcome:
        """All steps, from the start or from the step of the checkpoint, which is written `every` so
        many.

        Ctrl-C ends the chains with a warning and the draws so far, if there are any.
        """
        chains, draws, step = self._loaded() or self._started()
        pieces, capacity = [draws], _capacity(draws)
        length, saved, stopped = 1, step, None
        bar = tqdm(total=self.plan.total, initial=step, disable=not progress, unit="step")
        try:
            while step < self.plan.total:
                length = min(length, (capacity - 1) * self.plan.thinning)
                last = min(step + length, self.plan.total, (step // every + 1) * every)
                began = time.monotonic()
                chains, piece = self._advanced(chains, step, last, capacity)
                length = _next_length(length, time.monotonic() - began)
                pieces.append(piece)
                bar.update(last - step)
                step = last
                if self.file is not None and step % every == 0:
                    pieces, saved = [self._saved(step, chains, pieces)], step
        except KeyboardInterrupt:
            if not self.plan.num_draws(step):
                raise
            stopped = f"interrupted at step {step} of {self.plan.total}"
        finally:
            bar.close()
            if self.file is not None and step > saved:
                pieces = [self._saved(step, chains, pieces)]
        if stopped is not None:
            warnings.warn(f"{self.caller}: {stopped}", stacklevel=3)
        most = self.plan.num_draws(self.plan.total)
        draws = jax.tree.map(lambda leaf: leaf[:, :most], _joined(pieces))
        outcome = Outcome(draws, chains, stopped)
        warn_of_invalid(self.caller, outcome.num_invalid, stacklevel=4)
        return outcome

    def _advanced(self, chains: Chains, step: int, last: int, capacity: int) -> tuple[Chains, Any]:
        plan = self.plan
        numbers = jnp.array([step, last, plan.burn_in, plan.thinning, plan.adapt], jnp.int32)
        chains, buffers = _steps(self.kernel, self.key, chains, numbers, capacity)
        new = plan.num_draws(last) - plan.num_draws(step)
        # Waits for the program, so that an interruption comes before anything is taken over.
        pieces = jax.tree.map(lambda leaf: np.moveaxis(np.asarray(leaf)[:new], 0, 1), buffers)
        return chains, pieces

    def _loaded(self) -> tuple[Chains, PyTree, int] | None:
        """The chains, the draws and the step of the checkpoint; None where there is none."""
        if self.file is None or not self.file.path.exists():
            return None
        starts = self.starts
        reals = repeated(starts.problem.start(), starts.num_chains)
        keys = jax.random.split(starts.key, starts.num_chains)
        walk = random_walk(starts.deviations, reals)
        chains, empty, _ = eqx.filter_eval_shape(_start_all, self.kernel, keys, reals, walk)

        def like(notes: Notes) -> PyTree:
            def rows(leaf: jax.ShapeDtypeStruct) -> np.ndarray:
                num_draws = self.plan.num_draws(notes["step"])
                return np.empty((leaf.shape[0], num_draws, *leaf.shape[2:]), leaf.dtype)

            return {"chains": chains, "draws": jax.tree.map(rows, empty)}

        notes, state = self.file.load(like)
        return state["chains"], state["draws"], notes["step"]

    def _started(self) -> tuple[Chains, PyTree, int]:
        """All chains at their starts, without draws.

        A draw of the prior at which a chain cannot start is drawn again.
        """
        key, problem, sample_prior = self.starts.key, self.starts.problem, self.starts.sample_prior
        num = self.starts.num_chains

        def at(key: Key[Array, ""], reals: Reals) -> tuple[Chains, PyTree, Array]:
            walk = random_walk(self.starts.deviations, reals)
            return _start_all(self.kernel, jax.random.split(key, num), reals, walk)

        reals = repeated(problem.start(), num)
        if sample_prior is not None:
            reals = drawn(jax.random.fold_in(key, 0), problem, sample_prior, num)
        chains, empty, fine = at(key, reals)
        for attempt in range(1, _MOST_DRAWS_OF_A_START):
            if np.all(fine) or sample_prior is None:
                break
            again = jax.random.fold_in(key, attempt)
            new, _, now_fine = at(again, drawn(again, problem, sample_prior, num))
            states = jax.vmap(chosen)(fine, chains.states, new.states)
            walk = random_walk(self.starts.deviations, states.reals)
            chains = Chains(states, walk, chains.num_invalid)
            fine |= now_fine
        if not np.all(fine):
            where = "the start" if sample_prior is None else "any draw of sample_prior"
            raise RuntimeError(
                f"{self.caller}: the log prior or log marginal likelihood was NaN or inf at {where}"
            )
        return chains, jax.tree.map(np.asarray, empty), 0

    def _saved(self, step: int, chains: Chains, pieces: list[PyTree]) -> PyTree:
        draws = _joined(pieces)
        if self.file is not None:
            self.file.save(step, {"chains": chains, "draws": draws})
        return draws


def chosen(accepted: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    """One of two states."""
    return jax.tree.map(lambda after, before: jnp.where(accepted, after, before), new, old)


def warn_of_invalid(caller: str, num_invalid: Mapping[str, Any], stacklevel: int) -> None:
    """Warn of densities that were not numbers, by their names."""
    counts = {name: int(np.sum(count)) for name, count in num_invalid.items()}
    found = [f"{name} {count} times" for name, count in counts.items() if count]
    if found:
        warnings.warn(
            f"{caller}: NaN or +inf, taken for zero density: {', '.join(found)}",
            stacklevel=stacklevel,
        )


def as_checkpoint(
    path: str | os.PathLike[str] | None,
    caller: str,
    name: str | None,
    settings: Mapping[str, Any],
    code: Mapping[str, Any],
) -> Checkpoint | None:
    """The file of chains, if they have one; its arguments are those of `identity_of`."""
    if path is None:
        return None
    identity = identity_of(name, settings, code)
    return Checkpoint(Path(path), caller, lambda step: identity)


def _next_length(length: int, seconds: float) -> int:
    """How many steps to take in the next call, given the time of the last one."""
    if seconds < _SECONDS_BETWEEN / 2:
        return 2 * length
    return max(1, length // 2) if seconds > 2 * _SECONDS_BETWEEN else length


def _joined(pieces: list[PyTree]) -> PyTree:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *pieces)


@jit_on_wide_vectors
def _start_all(kernel, keys, reals, walk):
    """All chains at their starts, draws of length none, and which could start."""
    states, fine = jax.vmap(kernel.start)(keys, reals)
    step, report = eqx.filter_eval_shape(_all_chains, kernel, keys[0], Chains(states, walk, {}), 0)
    counts = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, jnp.int32), step.invalid)
    empty = jax.tree.map(
        lambda leaf: jnp.zeros((leaf.shape[0], 0, *leaf.shape[1:]), leaf.dtype), report
    )
    return Chains(states, walk, counts), empty, fine


def _capacity(draws: PyTree) -> int:
    """How many draws a program holds; the same for all lengths of chains, so that they share it."""
    rows = [math.prod((leaf.shape[0], *leaf.shape[2:])) for leaf in jax.tree.leaves(draws)]
    size = 8 * sum(rows)
    return max(2, min(_MOST_DRAWS_AT_ONCE, _MOST_BYTES_AT_ONCE // max(size, 1)))


def _all_chains(kernel: Any, key: Key[Array, ""], chains: Chains, step: Any) -> tuple[Step, PyTree]:
    """One step of every chain, and what is kept of it."""
    num_chains = jax.tree.leaves(chains.states)[0].shape[0]
    keys = jax.random.split(jax.random.fold_in(key, step), num_chains)
    steps = jax.vmap(kernel.step, in_axes=(0, 0, None))(keys, chains.states, chains.walk)
    return steps, steps.report


@jit_on_wide_vectors
def _steps(kernel, key, chains, numbers, capacity):
    """Some steps of all chains, and their draws: one program for any number of steps."""
    first, last, burn_in, thinning, adapt = numbers
    _, report = eqx.filter_eval_shape(_all_chains, kernel, key, chains, 0)
    buffers = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), report)
    before = jnp.maximum(first - burn_in, 0) // thinning

    def advance(step: Array, carry: tuple[Chains, PyTree]) -> tuple[Chains, PyTree]:
        chains, buffers = carry
        steps, report = _all_chains(kernel, key, chains, step)
        points = jax.vmap(lambda reals: ravel_pytree(reals)[0])(steps.state.reals)
        acceptance = jnp.mean(steps.acceptance) if kernel.learns_scale else None
        walk = jax.lax.cond(
            (step < burn_in) & (adapt > 0),
            lambda: chains.walk.adapted(points, step, acceptance),
            lambda: chains.walk,
        )
        counts = jax.tree.map(
            lambda sum, new: sum + new.astype(sum.dtype), chains.num_invalid, steps.invalid
        )
        # A draw is the last of the steps that are written to its row.
        row = jnp.clip((step - burn_in) // thinning - before, 0, capacity - 1)
        buffers = jax.tree.map(lambda rows, leaf: rows.at[row].set(leaf), buffers, report)
        return Chains(steps.state, walk, counts), buffers

    return jax.lax.fori_loop(first, last, advance, (chains, buffers))
