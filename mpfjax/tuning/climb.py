"""Gradient ascent on the log marginal likelihood, and its checkpoints."""

import json
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Key, PyTree
from tqdm import tqdm

from mpfjax.filters import Filter
from mpfjax.storage import load_arrays, write_arrays
from mpfjax.tuning.curvature import errors_at
from mpfjax.tuning.problem import Parameters, Problem, Reals, pose, scores
from mpfjax.tuning.transforms import AbstractTransform


@dataclass(frozen=True)
class TuningRun:
    """What `fit` found, and how it got there."""

    filter: Filter
    """with the parameters of the end, or the last good ones where it was stopped."""
    parameters: dict[str, np.ndarray]
    """the same, by name, on their own scale."""
    standard_errors: dict[str, np.ndarray] | None
    """of every number in them; None where not asked for, or where there is no maximum."""
    log_marginal_likelihood: float
    """with these parameters: the mean over seeds, summed over sequences."""
    history: dict[str, np.ndarray]
    """by step: `log_marginal_likelihood`, the mean over seeds, and `deviation`, its standard
    deviation, with each parameter, by name, as it was then."""
    stopped: str | None
    """why it ended before `num_steps`, or None."""


def fit(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    optimizer: optax.GradientTransformation,
    num_steps: int,
    *,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
    num_seeds: int = 8,
    common_random_numbers: bool = False,
    missing: str = "error",
    patience: int | None = None,
    tolerance: float = 0.0,
    curvature_seeds: int = 0,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 50,
    progress: bool = True,
) -> TuningRun:
    """Climb the log marginal likelihood in some of a filter's parameters.

    Maximises the mean over seeds of log Ẑ(θ), summed over sequences, by the derivatives that the
    filter's moves have. Build the filter with `gradient="stop"`: those estimate the score. With
    the default, "none", the climb ends elsewhere, however many particles there are.

    - `observations`: as for `run_filter`; a list is several sequences, each run on its own.
    - `optimizer`: of optax. It steps in the transforms' unconstrained numbers.
    - `parameters`: what is tuned, by name: `{"sigma_y": lambda f: f.model.sigma_y}`; a node such
      as a network stands for all its arrays. Or a filter spec, a pytree of booleans like the
      filter. None is every floating point array of the model.
    - `transforms`: by name, such as `Positive()` for a scale; without one, no constraint.
    - `num_seeds`: runs a step, under one vmap. `common_random_numbers` takes the same seeds at
      every step: no noise between steps, but the error of those seeds stays.
    - `missing`: as for `run_filter`.
    - `patience`: end when the mean of so many steps is not more than `tolerance` nats above that
      of as many before them.
    - `curvature_seeds`: for `standard_errors` at the end, in whole batches of `num_seeds`; 0 for
      none.
    - `checkpoint`: a .npz file, without pickles, written every `checkpoint_every` steps and when
      it ends or is interrupted. Where it exists the climb goes on from it, the same to the bit as
      if it had not been interrupted.

    A log marginal likelihood or gradient that is not finite ends the climb with the last good
    parameters, a warning, and the step in `stopped`. Raises `ValueError` for a parameter that is
    no floating point array, starts outside its domain or has no effect, for a checkpoint of
    another fit, and what `run_filter` does; `RuntimeError` where the start itself is not finite.
    """
    for name, number in (
        ("num_steps", num_steps), ("num_seeds", num_seeds), ("checkpoint_every", checkpoint_every),
        ("patience", 1 if patience is None else patience),
    ):  # fmt: skip
        if number < 1:
            raise ValueError(f"{name}: {number} is less than 1")
    if curvature_seeds < 0:
        raise ValueError(f"curvature_seeds: {curvature_seeds} is negative")
    problem = pose(filter, observations, parameters, transforms, missing)
    climb = _Climb(key, problem, optimizer, num_seeds, common_random_numbers)
    state = climb.start()
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and path.exists():
        state = climb.load(path, state)
    stopped = None
    bar = tqdm(total=num_steps, initial=state.step, disable=not progress, unit="step")
    try:
        while state.step < num_steps and stopped is None:
            state, stopped = climb.advance(state)
            if stopped is None:
                bar.update()
                bar.set_postfix(log_Z=f"{state.log_likelihoods[-1]:.2f}", refresh=False)
                stopped = _converged(state.log_likelihoods, patience, tolerance)
            if path is not None and state.step % checkpoint_every == 0:
                climb.save(path, state)
    finally:
        bar.close()
        if path is not None and state.step > 0:
            climb.save(path, state)
    log_likelihood, state, stopped = climb.finish(state, stopped)
    errors = None
    if curvature_seeds:
        key_curvature = jax.random.fold_in(key, num_steps + 1)
        errors = errors_at(problem, state.reals, climb.batches(key_curvature, curvature_seeds))
    return TuningRun(
        filter=problem.filter_at(state.reals),
        parameters=problem.constrained(state.reals),
        standard_errors=errors,
        log_marginal_likelihood=log_likelihood,
        history=state.history(problem),
        stopped=stopped,
    )


@dataclass(frozen=True)
class _State:
    """Where a climb stands: all that a checkpoint holds."""

    step: int
    reals: Reals
    optimizer: PyTree
    log_likelihoods: tuple[float, ...] = ()
    deviations: tuple[float, ...] = ()
    path: tuple[Reals, ...] = ()

    def history(self, problem: Problem) -> dict[str, np.ndarray]:
        """The steps so far, parameters on their own scale."""
        points = [problem.constrained(reals) for reals in self.path]
        return {
            "log_marginal_likelihood": np.array(self.log_likelihoods),
            "deviation": np.array(self.deviations),
        } | {name: np.array([point[name] for point in points]) for name in self.reals}


class _Climb:
    """The steps of one fit."""

    def __init__(
        self,
        key: Key[Array, ""],
        problem: Problem,
        optimizer: optax.GradientTransformation,
        num_seeds: int,
        common_random_numbers: bool,
    ) -> None:
        self.key = key
        self.problem = problem
        self.optimizer = optimizer
        self.num_seeds = num_seeds
        self.common_random_numbers = common_random_numbers

    def start(self) -> _State:
        reals = self.problem.start()
        return _State(0, reals, self.optimizer.init(reals))

    def batches(self, key: Key[Array, ""], num_seeds: int) -> list[Key[Array, " seeds"]]:
        """At least so many seeds, in batches of a shape that is compiled already."""
        num_batches = -(-num_seeds // self.num_seeds)
        return list(jax.random.split(key, (num_batches, self.num_seeds)))

    def evaluate(self, state: _State) -> tuple[np.ndarray, Reals, str | None]:
        """log Ẑ of each seed, the gradient of their mean, and what is wrong with either."""
        step = 0 if self.common_random_numbers else state.step
        keys = jax.random.split(jax.random.fold_in(self.key, step), self.num_seeds)
        values, gradient = scores(self.problem, state.reals, keys)
        values = np.asarray(values)
        broken = [name for name, leaf in gradient.items() if not np.isfinite(leaf).all()]
        if not np.isfinite(values).all():
            return values, gradient, f"the log marginal likelihood was {values.mean()}"
        if broken:
            return values, gradient, f"the gradient of {', '.join(broken)} was not finite"
        return values, gradient, None

    def advance(self, state: _State) -> tuple[_State, str | None]:
        """One step up; or, with the reason, the state before the step that led here."""
        values, gradient, fault = self.evaluate(state)
        if fault is not None:
            return self.back(state, fault)
        idle = [name for name, leaf in gradient.items() if not np.asarray(leaf).any()]
        if state.step == 0 and idle:
            raise ValueError(
                f"parameters: the log marginal likelihood does not depend on {', '.join(idle)};"
                " with gradient='stop' it never does on a proposal's"
            )
        descent = jax.tree.map(jnp.negative, gradient)
        # Optimisers are written for JAX's default promotion, whatever the caller has set.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            updates, optimizer = self.optimizer.update(descent, state.optimizer, state.reals)
            reals: Any = optax.apply_updates(state.reals, updates)
        following = _State(
            step=state.step + 1,
            reals=reals,
            optimizer=optimizer,
            log_likelihoods=(*state.log_likelihoods, float(values.mean())),
            deviations=(*state.deviations, float(values.std())),
            path=(*state.path, state.reals),
        )
        return following, None

    def back(self, state: _State, fault: str) -> tuple[_State, str]:
        """The last good parameters, whose own update is not to be had."""
        if state.step == 0:
            raise RuntimeError(f"fit: {fault} at the start")
        fault = f"{fault} at step {state.step}"
        warnings.warn(f"fit: {fault}; its result is of the step before", stacklevel=4)
        return replace(state, reals=state.path[-1]), fault

    def finish(self, state: _State, stopped: str | None) -> tuple[float, _State, str | None]:
        """The likelihood at the end; the step before where there is none."""
        values, _, fault = self.evaluate(state)
        if fault is None:
            return float(values.mean()), state, stopped
        state, stopped = self.back(state, fault)
        return state.log_likelihoods[-1], state, stopped

    def save(self, path: Path, state: _State) -> None:
        """Write all of the state."""
        arrays = {"fit": np.array(self.described()), "step": np.array(state.step)}
        arrays["log_likelihoods"] = np.array(state.log_likelihoods)
        arrays["deviations"] = np.array(state.deviations)
        for i, leaf in enumerate(jax.tree.leaves(state.optimizer)):
            arrays[f"optimizer {i}"] = np.asarray(leaf)
        for name, value in state.reals.items():
            arrays[f"reals {name}"] = np.asarray(value)
            arrays[f"path {name}"] = np.array([point[name] for point in state.path])
        write_arrays(path, arrays)

    def load(self, path: Path, start: _State) -> _State:
        """The state that was saved; raises `ValueError` for that of another fit, or half of one."""
        arrays = load_arrays(path)
        if str(arrays.get("fit")) != self.described():
            raise ValueError(
                f"checkpoint: {path} is of another fit, {arrays.get('fit')},"
                f" not of {self.described()}"
            )
        leaves, structure = jax.tree.flatten(start.optimizer)
        path_of = {name: arrays[f"path {name}"] for name in start.reals}
        return _State(
            step=int(arrays["step"]),
            reals={name: jnp.asarray(arrays[f"reals {name}"]) for name in start.reals},
            optimizer=structure.unflatten(
                jnp.asarray(arrays[f"optimizer {i}"]) for i in range(len(leaves))
            ),
            log_likelihoods=tuple(map(float, arrays["log_likelihoods"])),
            deviations=tuple(map(float, arrays["deviations"])),
            path=tuple(
                {name: jnp.asarray(values[k]) for name, values in path_of.items()}
                for k in range(int(arrays["step"]))
            ),
        )

    def described(self) -> str:
        """What has to be the same for a checkpoint to be of this fit."""
        start = self.problem.start()
        lengths = [
            [list(leaf.shape) for leaf in jax.tree.leaves(group[0])]
            for group in self.problem.groups
        ]
        optimizer = str(jax.tree.structure(self.optimizer.init(start)))
        return json.dumps(
            {
                "start": {name: np.asarray(value).tolist() for name, value in start.items()},
                "key": np.asarray(jax.random.key_data(self.key)).tolist(),
                "num_seeds": self.num_seeds,
                "common_random_numbers": self.common_random_numbers,
                "observations": lengths,
                "optimizer": optimizer,
            }
        )


def _converged(
    log_likelihoods: tuple[float, ...], patience: int | None, tolerance: float
) -> str | None:
    if patience is None or len(log_likelihoods) < 2 * patience:
        return None
    before = np.mean(log_likelihoods[-2 * patience : -patience])
    gain = float(np.mean(log_likelihoods[-patience:]) - before)
    if gain > tolerance:
        return None
    return f"{patience} steps gained {gain:.3g} nats, no more than the tolerance, {tolerance}"
