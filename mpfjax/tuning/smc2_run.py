"""SMC² from observation to observation: moves of the samples, doubling of N, and its file."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree
from tqdm import tqdm

from mpfjax.mixture import ParticleMixture
from mpfjax.observations import Series, as_series
from mpfjax.running.storage.checkpoints import Checkpoint, Notes
from mpfjax.running.storage.descriptions import fingerprint
from mpfjax.tuning.chains import warn_of_invalid
from mpfjax.tuning.parameter_particles import (
    FilterOf,
    Sampler,
    exchanged,
    extended,
    rejuvenated,
    started,
)

_CALLER = "smc2"


@dataclass(frozen=True)
class Observed:
    """The data of the filters, and how they were checked."""

    series: Series
    """in arrays of numpy."""
    missing: str
    model: Any

    @classmethod
    def checked(cls, observations: PyTree, inputs: PyTree, missing: str, model: Any) -> "Observed":
        """The data; a `ValueError` for anything but one sequence."""
        if isinstance(observations, list):
            raise ValueError(
                "observations: a list is several sequences, and this takes one;"
                " jnp.asarray(observations) is one of numbers"
            )
        series = as_series(observations, model, inputs, missing)
        return cls(jax.tree.map(np.asarray, series), missing, model)

    @property
    def length(self) -> int:
        """How many steps there are."""
        return self.series.length

    def first(self, length: int) -> "Observed":
        """The data up to a step."""
        return replace(self, series=jax.tree.map(lambda leaf: leaf[:length], self.series))

    def followed_by(self, observations: PyTree, inputs: PyTree) -> "Observed":
        """These data followed by others; a `ValueError` where the two do not fit."""
        new = Observed.checked(observations, inputs, self.missing, self.model).series
        before, after = self.series, new
        if (before.present is None) != (after.present is None):
            before, after = _with_all_present(before), _with_all_present(after)
        if _kind(before) != _kind(after):
            raise ValueError(
                f"observations: {_kind(after)} are not like those before, {_kind(before)}"
            )
        if (before.inputs is None) != (after.inputs is None):
            raise ValueError("inputs: there must be some for all observations, or for none")
        join = lambda *leaves: np.concatenate(leaves)  # noqa: E731
        return replace(self, series=jax.tree.map(join, before, after))

    def filter_of(self, capacity: int) -> FilterOf:
        """Runs over the data, in arrays with room for this many steps."""
        pad = lambda leaf: jnp.asarray(np.resize(leaf, (capacity, *leaf.shape[1:])))  # noqa: E731
        return FilterOf(jax.tree.map(pad, self.series))

    @property
    def fingerprint(self) -> str:
        """A digest of the observations, whether or not missing steps were looked for."""
        is_known = self.series.present is None
        missing = np.zeros(0, int) if is_known else np.flatnonzero(~np.asarray(self.series.present))
        return fingerprint((self.series.observations, self.series.inputs, missing))


def _with_all_present(series: Series) -> Series:
    if series.present is not None:
        return series
    return Series(series.observations, series.inputs, jnp.ones(series.length, bool))


def _kind(series: Series) -> str:
    """The structure, shapes and types of one step of a series."""
    return str(
        [
            f"{jax.tree_util.keystr(place)} {leaf.dtype}{list(leaf.shape[1:])}"
            for place, leaf in jax.tree_util.tree_leaves_with_path(series)
        ]
    )


@dataclass(frozen=True)
class Doubling:
    """The rule by which N is doubled."""

    max_particles: int | None
    acceptance_threshold: float

    def wanted(self, num_particles: int, acceptance_rate: float) -> bool:
        is_low = acceptance_rate < self.acceptance_threshold
        return is_low and self.max_particles is not None and 2 * num_particles <= self.max_particles


@dataclass(frozen=True)
class SamplesFile:
    """The file of the samples, and all that identifies them but the observations."""

    path: Path
    every: int
    identity: dict[str, str]

    def checkpoint(self, observed: Observed) -> Checkpoint:
        """The file of these observations, of which it has seen the first."""

        def identity(step: int) -> dict[str, str]:
            return self.identity | {"observations": observed.first(step).fingerprint}

        return Checkpoint(self.path, _CALLER, identity)


class Rows(eqx.Module):
    """The report of each observation so far."""

    increments: np.ndarray
    sizes: np.ndarray
    rates: np.ndarray
    num_particles: np.ndarray

    @classmethod
    def empty(cls, length: int) -> "Rows":
        increments, sizes, rates = (np.empty(length) for _ in range(3))
        return cls(increments, sizes, rates, np.empty(length, np.int64))

    def then(self, *row: float) -> "Rows":
        """These rows and one more."""
        leaves, structure = jax.tree.flatten(self)
        grown = (
            np.append(leaf, np.asarray(x, leaf.dtype)) for leaf, x in zip(leaves, row, strict=True)
        )
        return structure.unflatten(grown)


@dataclass(frozen=True)
class State:
    """The samples after some observations."""

    samples: ParticleMixture
    num_particles: int
    rows: Rows
    num_invalid: dict[str, int]

    @property
    def step(self) -> int:
        return len(self.rows.increments)

    def counting(self, found: Mapping[str, Any]) -> "State":
        """With further densities that were not numbers."""
        counts = {name: n + int(found.get(name, 0)) for name, n in self.num_invalid.items()}
        return replace(self, num_invalid=counts)


class _NoLikelihood(Exception):
    """No θ has any likelihood at an observation."""


@dataclass(frozen=True)
class Smc2Run:
    """SMC² over some observations."""

    sampler: Sampler
    """with the number of particles at the start."""
    observed: Observed
    key: Key[Array, ""]
    ess_threshold: float
    doubling: Doubling
    file: SamplesFile | None

    def with_observations(self, step: int, observations: PyTree, inputs: PyTree) -> "Smc2Run":
        """The same with the observations that follow."""
        observed = self.observed.first(step).followed_by(observations, inputs)
        held = self.sampler.run.series.length
        # With room for as many more, so that observations that come one by one share a program.
        capacity = held if observed.length <= held else max(observed.length, 2 * held)
        sampler = self.sampler.with_observations(observed.filter_of(capacity))
        return replace(self, sampler=sampler, observed=observed)

    def started(self, keys: Key[Array, " n"], reals: Any) -> State:
        """The samples of the prior."""
        samples = started(self.sampler, keys, reals)
        nothing = {"log_prior": 0, "log_marginal_likelihood": 0}
        return State(samples, self.sampler.num_particles, Rows.empty(0), nothing)

    def loaded(self, keys: Key[Array, " n"], reals: Any) -> State | None:
        """Those of the checkpoint, if there is one."""
        if self.file is None or not self.file.path.exists():
            return None

        def like(notes: Notes) -> PyTree:
            sampler = self.sampler.with_particles(notes["num_particles"])
            samples = eqx.filter_eval_shape(started, sampler, keys, reals)
            return {"samples": samples, "rows": Rows.empty(notes["step"])}

        notes, state = self.file.checkpoint(self.observed).load(like)
        return State(state["samples"], notes["num_particles"], state["rows"], notes["num_invalid"])

    def go(self, state: State, progress: bool) -> tuple[State, str | None]:
        """The samples after all observations, from a state on, and why the run ended early."""
        before, saved, stopped = dict(state.num_invalid), state.step, None
        bar = tqdm(total=self.observed.length, initial=saved, disable=not progress, unit="step")
        try:
            while state.step < self.observed.length:
                state = self._next(state)
                bar.update()
                if self.file is not None and state.step % self.file.every == 0:
                    self._save(state)
                    saved = state.step
        except KeyboardInterrupt:
            if not state.step:
                raise
            stopped = f"interrupted at step {state.step} of {self.observed.length}"
        except _NoLikelihood as error:
            stopped = str(error)
            if not state.step:
                raise RuntimeError(f"{_CALLER}: {stopped}") from error
        finally:
            bar.close()
            if state.step > saved:
                self._save(state)
        if stopped is not None:
            warnings.warn(f"{_CALLER}: {stopped}", stacklevel=4)
        new = {name: count - before[name] for name, count in state.num_invalid.items()}
        warn_of_invalid(_CALLER, new, stacklevel=5)
        return state, stopped

    def _next(self, state: State) -> State:
        """The samples after one more observation."""
        t, sampler = state.step, self._sampler(state.num_particles)
        keys = jax.random.split(jax.random.fold_in(self.key, t), 3)
        found = extended(sampler, keys[0], state.samples, jnp.asarray(t, jnp.int32))
        state = state.counting({"log_marginal_likelihood": found.invalid})
        increment, size, rate = float(found.increment), float(found.effective_sample_size), np.nan
        if increment == -np.inf:
            broken = f"; it was NaN or +inf in {int(found.invalid)}" if int(found.invalid) else ""
            raise _NoLikelihood(f"no sample has any likelihood at step {t}{broken}")
        samples, num_particles = found.samples, state.num_particles
        if size < self.ess_threshold * sampler.num_samples:
            so_far = jnp.asarray(t + 1, jnp.int32)
            moved = rejuvenated(sampler, keys[1], samples, so_far)
            state = state.counting(moved.invalid)
            samples, rate = moved.samples, float(moved.acceptance_rate)
            if self.doubling.wanted(num_particles, rate):
                more = exchanged(self._sampler(2 * num_particles), keys[2], samples, so_far)
                state = state.counting({"log_marginal_likelihood": more.invalid})
                # Where no filter of 2N particles has any likelihood, those of N are kept.
                if float(more.increment) > -np.inf:
                    samples, num_particles = more.samples, 2 * num_particles
                    increment += float(more.increment)
        rows = state.rows.then(increment, size, rate, num_particles)
        return replace(state, samples=samples, num_particles=num_particles, rows=rows)

    def _sampler(self, num_particles: int) -> Sampler:
        if num_particles == self.sampler.num_particles:
            return self.sampler
        return self.sampler.with_particles(num_particles)

    def _save(self, state: State) -> None:
        if self.file is not None:
            held = {"samples": state.samples, "rows": state.rows}
            self.file.checkpoint(self.observed).save(
                state.step, held, num_particles=state.num_particles, num_invalid=state.num_invalid
            )
