"""Gradient ascent on the log marginal likelihood or another objective, and its checkpoints."""

import json
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Key, PyTree
from tqdm import tqdm

from mpfjax.filters import Filter
from mpfjax.storage import load_arrays, write_arrays
from mpfjax.tuning.curvature import errors_at
from mpfjax.tuning.problem import Objective, Parameters, Problem, Reals, pose, pose_evidence, scores
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
    if curvature_seeds < 0:
        raise ValueError(f"curvature_seeds: {curvature_seeds} is negative")
    problem = pose_evidence(filter, observations, parameters, transforms, missing)
    climb = _Climb("fit", "log_marginal_likelihood", key, problem, optimizer, num_seeds)
    end = climb.run(
        num_steps,
        common_random_numbers,
        patience,
        tolerance,
        checkpoint,
        checkpoint_every,
        progress,
    )
    errors = None
    if curvature_seeds:
        key_curvature = jax.random.fold_in(key, num_steps + 1)
        batches = climb.batches(key_curvature, curvature_seeds)
        errors = errors_at(problem, end.state.reals, batches, "curvature_seeds")
    return TuningRun(
        filter=problem.at(end.state.reals),
        parameters=problem.constrained(end.state.reals),
        standard_errors=errors,
        log_marginal_likelihood=end.value,
        history=climb.history(end.state),
        stopped=end.stopped,
    )


@dataclass(frozen=True)
class Maximisation:
    """What `maximise` found, and how it got there."""

    model: Any
    """with the parameters of the end, or the last good ones where it was stopped."""
    parameters: dict[str, np.ndarray]
    """the same, by name, on their own scale."""
    value: float
    """the objective with these parameters: the mean over seeds."""
    history: dict[str, np.ndarray]
    """by step: `value`, the mean over seeds, and `deviation`, its standard deviation, with each
    parameter, by name, as it was then."""
    stopped: str | None
    """why it ended before `num_steps`, or None."""


def maximise(
    key: Key[Array, ""],
    objective: Objective,
    model: Any,
    optimizer: optax.GradientTransformation,
    num_steps: int,
    *,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
    num_seeds: int = 1,
    common_random_numbers: bool = False,
    patience: int | None = None,
    tolerance: float = 0.0,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 50,
    progress: bool = True,
) -> Maximisation:
    """Climb any objective in some of a model's, or a filter's, parameters.

    Maximises the mean over seeds of `objective(key, model)`, a scalar that JAX can differentiate,
    as `fit` does the log marginal likelihood: same arguments, same checks, same report. Use it
    where the marginal likelihood is not what to maximise, as for an unnormalised likelihood on
    labelled frames (`LabelLikelihood`).

    - `objective`: an `equinox.Module` with a `__call__`, whose arrays are the data, or a function;
      one without randomness ignores its key, and needs one seed.
    - `model`: the pytree that it is a function of.
    - `parameters`: as for `fit`, picked from `model`; None is every floating point array of it.

    Raises what `fit` does for the same arguments.
    """
    problem = pose(model, objective, parameters, transforms)
    climb = _Climb("maximise", "value", key, problem, optimizer, num_seeds)
    end = climb.run(
        num_steps,
        common_random_numbers,
        patience,
        tolerance,
        checkpoint,
        checkpoint_every,
        progress,
    )
    return Maximisation(
        model=problem.at(end.state.reals),
        parameters=problem.constrained(end.state.reals),
        value=end.value,
        history=climb.history(end.state),
        stopped=end.stopped,
    )


@dataclass(frozen=True)
class _State:
    """Where a climb stands: all that a checkpoint holds."""

    step: int
    reals: Reals
    optimizer: PyTree
    values: tuple[float, ...] = ()
    deviations: tuple[float, ...] = ()
    path: tuple[Reals, ...] = ()


@dataclass(frozen=True)
class _End:
    """Where a climb ended: its state, the objective there, and why before its time."""

    state: _State
    value: float
    stopped: str | None


class _Climb:
    """The steps of one maximisation, by the public function that is `caller`."""

    def __init__(
        self,
        caller: str,
        objective: str,
        key: Key[Array, ""],
        problem: Problem,
        optimizer: optax.GradientTransformation,
        num_seeds: int,
    ) -> None:
        self.caller = caller
        self.objective = objective
        self.key = key
        self.problem = problem
        self.optimizer = optimizer
        self.num_seeds = num_seeds
        self.common_random_numbers = False

    @property
    def named(self) -> str:
        """The objective in words."""
        return self.objective.replace("_", " ")

    def run(
        self,
        num_steps: int,
        common_random_numbers: bool,
        patience: int | None,
        tolerance: float,
        checkpoint: str | os.PathLike[str] | None,
        checkpoint_every: int,
        progress: bool,
    ) -> _End:
        """All steps, from the start or from where the checkpoint stands."""
        for name, number in (
            ("num_steps", num_steps), ("num_seeds", self.num_seeds),
            ("checkpoint_every", checkpoint_every),
            ("patience", 1 if patience is None else patience),
        ):  # fmt: skip
            if number < 1:
                raise ValueError(f"{name}: {number} is less than 1")
        self.common_random_numbers = common_random_numbers
        state = self.start()
        path = None if checkpoint is None else Path(checkpoint)
        if path is not None and path.exists():
            state = self.load(path, state)
        stopped = None
        bar = tqdm(total=num_steps, initial=state.step, disable=not progress, unit="step")
        try:
            while state.step < num_steps and stopped is None:
                state, stopped = self.advance(state)
                if stopped is None:
                    bar.update()
                    bar.set_postfix({self.objective: f"{state.values[-1]:.2f}"}, refresh=False)
                    stopped = _converged(state.values, patience, tolerance)
                if path is not None and state.step % checkpoint_every == 0:
                    self.save(path, state)
        finally:
            bar.close()
            if path is not None and state.step > 0:
                self.save(path, state)
        return self.finish(state, stopped)

    def history(self, state: _State) -> dict[str, np.ndarray]:
        """The steps so far, parameters on their own scale."""
        points = [self.problem.constrained(reals) for reals in state.path]
        return {
            self.objective: np.array(state.values),
            "deviation": np.array(state.deviations),
        } | {name: np.array([point[name] for point in points]) for name in state.reals}

    def start(self) -> _State:
        reals = self.problem.start()
        return _State(0, reals, self.optimizer.init(reals))

    def batches(self, key: Key[Array, ""], num_seeds: int) -> list[Key[Array, " seeds"]]:
        """At least so many seeds, in batches of a shape that is compiled already."""
        num_batches = -(-num_seeds // self.num_seeds)
        return list(jax.random.split(key, (num_batches, self.num_seeds)))

    def evaluate(self, state: _State) -> tuple[np.ndarray, Reals, str | None]:
        """The objective of each seed, the gradient of their mean, and what is wrong with either."""
        step = 0 if self.common_random_numbers else state.step
        keys = jax.random.split(jax.random.fold_in(self.key, step), self.num_seeds)
        values, gradient = scores(self.problem, state.reals, keys)
        values = np.asarray(values)
        broken = [name for name, leaf in gradient.items() if not np.isfinite(leaf).all()]
        if not np.isfinite(values).all():
            return values, gradient, f"the {self.named} was {values.mean()}"
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
                f"parameters: the {self.named} does not depend on {', '.join(idle)};"
                " with gradient='stop' no filter's ever does on a proposal's"
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
            values=(*state.values, float(values.mean())),
            deviations=(*state.deviations, float(values.std())),
            path=(*state.path, state.reals),
        )
        return following, None

    def back(self, state: _State, fault: str) -> tuple[_State, str]:
        """The last good parameters, whose own update is not to be had."""
        if state.step == 0:
            raise RuntimeError(f"{self.caller}: {fault} at the start")
        fault = f"{fault} at step {state.step}"
        warnings.warn(f"{self.caller}: {fault}; its result is of the step before", stacklevel=5)
        return replace(state, reals=state.path[-1]), fault

    def finish(self, state: _State, stopped: str | None) -> _End:
        """With the objective at the end; the step before where there is none."""
        values, _, fault = self.evaluate(state)
        if fault is None:
            return _End(state, float(values.mean()), stopped)
        state, stopped = self.back(state, fault)
        return _End(state, state.values[-1], stopped)

    def save(self, path: Path, state: _State) -> None:
        """Write all of the state."""
        arrays = {"fit": np.array(self.described()), "step": np.array(state.step)}
        arrays["values"] = np.array(state.values)
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
            values=tuple(map(float, arrays["values"])),
            deviations=tuple(map(float, arrays["deviations"])),
            path=tuple(
                {name: jnp.asarray(values[k]) for name, values in path_of.items()}
                for k in range(int(arrays["step"]))
            ),
        )

    def described(self) -> str:
        """What has to be the same for a checkpoint to be of this fit."""
        start = self.problem.start()
        data = eqx.filter(self.problem.objective, eqx.is_array)
        optimizer = str(jax.tree.structure(self.optimizer.init(start)))
        return json.dumps(
            {
                "start": {name: np.asarray(value).tolist() for name, value in start.items()},
                "key": np.asarray(jax.random.key_data(self.key)).tolist(),
                "num_seeds": self.num_seeds,
                "common_random_numbers": self.common_random_numbers,
                "data": [list(leaf.shape) for leaf in jax.tree.leaves(data)],
                "optimizer": optimizer,
            }
        )


def _converged(values: tuple[float, ...], patience: int | None, tolerance: float) -> str | None:
    if patience is None or len(values) < 2 * patience:
        return None
    before = np.mean(values[-2 * patience : -patience])
    gain = float(np.mean(values[-patience:]) - before)
    if gain > tolerance:
        return None
    return f"{patience} steps gained {gain:.3g} nats, no more than the tolerance, {tolerance}"
