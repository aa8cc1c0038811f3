"""Gradient ascent on the log marginal likelihood or another objective, and its checkpoints."""

import functools
import json
import os
import warnings
from collections.abc import Callable, Mapping
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

from mpfjax.checks import (
    check_callable,
    check_finite,
    check_flag,
    check_key,
    check_type,
    check_whole,
    given,
    shown,
)
from mpfjax.filter import Filter
from mpfjax.running.storage import fingerprint, load_arrays, write_arrays
from mpfjax.tuning.curvature import errors_at
from mpfjax.tuning.identity import contents_of, unlike
from mpfjax.tuning.problem import (
    Objective,
    Parameters,
    Problem,
    Reals,
    pose,
    pose_evidence,
    scores,
    warn_of_bias,
)
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
    the default, "none", the climb ends elsewhere, however many particles there are, and a warning
    says so; not where all that is tuned belongs to a proposal, such as a `NetworkProposal`.

    - `observations`: as for `run_filter`; a list is several sequences, each run on its own.
    - `optimizer`: of optax. It steps in the transforms' unconstrained numbers.
    - `parameters`: what is tuned, by name: `{"sigma_y": lambda f: f.model.sigma_y}`; a node such
      as a network stands for all its arrays. Or a filter spec, a pytree of booleans like the
      filter. None is every floating point array of the model. What is named may be a Python float
      too, which becomes an array.
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
      if it had not been interrupted, and one that has ended is returned as it ended. Take another
      `num_steps` to go on further (a smaller one goes nowhere and returns where the file stands),
      or another `patience` or `tolerance` to go on until those end it; what ended at a number that
      is not finite stays there. All else must be the same: the filter and the observations to the
      bit, the parameters, transforms, key and seeds, and the optimiser, by the numbers in its
      closures, schedules' as well. Of functions of your own the code counts, of classes and of
      libraries' functions the names: take a new file after changing what these do. Another
      version of Python or optax may not know its own again.

    A log marginal likelihood or gradient that is not finite ends the climb with the last good
    parameters, a warning, and the step in `stopped`. Raises `ValueError` for a parameter that is
    no floating point number, is static, starts outside its domain or has no effect, for a
    checkpoint of another fit, naming what differs, or one that is cut off or lacks an array, and
    what `run_filter` does; `RuntimeError` where the start itself is not finite.
    """
    _check_climb(
        key, optimizer, num_steps, num_seeds, common_random_numbers, patience, tolerance,
        checkpoint, checkpoint_every, progress,
    )  # fmt: skip
    check_whole(0, curvature_seeds=curvature_seeds)
    problem = pose_evidence(filter, observations, parameters, transforms, missing)
    warn_of_bias("fit", problem)

    def described() -> dict[str, str]:
        observed = {"observations": fingerprint(problem.objective), "missing": missing}
        return contents_of("filter", problem.tree) | observed

    climb = _Climb("fit", "log_marginal_likelihood", key, problem, optimizer, num_seeds, described)
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

    Raises what `fit` does for the same arguments, and `ValueError` for an objective that is no
    floating point scalar. For a `checkpoint` the objective has to be the same as well: a function
    in its code and closure, an `equinox.Module` in its fields.
    """
    _check_climb(
        key, optimizer, num_steps, num_seeds, common_random_numbers, patience, tolerance,
        checkpoint, checkpoint_every, progress,
    )  # fmt: skip
    check_callable("a function of a key and a model", objective=objective)
    problem = pose(model, objective, parameters, transforms)
    _check_scalar(problem, key)

    def described() -> dict[str, str]:
        return contents_of("model", problem.tree) | contents_of("objective", objective)

    climb = _Climb("maximise", "value", key, problem, optimizer, num_seeds, described)
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


def _check_climb(
    key: Any,
    optimizer: Any,
    num_steps: Any,
    num_seeds: Any,
    common_random_numbers: Any,
    patience: Any,
    tolerance: Any,
    checkpoint: Any,
    checkpoint_every: Any,
    progress: Any,
) -> None:
    """The arguments that `fit` and `maximise` share, before anything compiles."""
    check_key(key)
    for method in ("init", "update"):
        if isinstance(optimizer, type) or not callable(getattr(optimizer, method, None)):
            raise ValueError(
                f"optimizer: {shown(optimizer)} has no {method}; take one of optax, such as"
                " optax.adam(0.05)"
            )
    check_whole(1, num_steps=num_steps, num_seeds=num_seeds, checkpoint_every=checkpoint_every)
    check_whole(1, **given(patience=patience))
    check_finite(tolerance=tolerance)
    check_flag(common_random_numbers=common_random_numbers, progress=progress)
    check_type((str, os.PathLike), "the path of a file", **given(checkpoint=checkpoint))
    if checkpoint is not None and Path(checkpoint).is_dir():
        raise ValueError(f"checkpoint: {checkpoint} is a directory, not a file")


def _check_scalar(problem: Problem, key: Key[Array, ""]) -> None:
    found = eqx.filter_eval_shape(problem.value, problem.start(), key)
    shape, dtype = getattr(found, "shape", None), getattr(found, "dtype", None)
    if shape != () or dtype is None or not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"objective: it returns {shown(found)}, no floating point scalar")


@dataclass(frozen=True)
class _State:
    """Where a climb stands: all that a checkpoint holds."""

    step: int
    reals: Reals
    optimizer: PyTree
    values: tuple[float, ...] = ()
    deviations: tuple[float, ...] = ()
    path: tuple[Reals, ...] = ()
    fault: str | None = None
    """what was not finite, which no further step mends."""


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
        described: Callable[[], dict[str, str]],
    ) -> None:
        self.caller = caller
        self.objective = objective
        self.key = key
        self.problem = problem
        self.optimizer = optimizer
        self.num_seeds = num_seeds
        self.described = described
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
        self.common_random_numbers = common_random_numbers
        state = self.start()
        path = None if checkpoint is None else Path(checkpoint)
        if path is not None and path.exists():
            state = self.load(path, state)
        if state.fault is not None:
            self.warn(state.fault, stacklevel=4)
        saved = state
        # Of a climb that has ended before: the same values end it again.
        stopped = state.fault or _converged(state.values, patience, tolerance)
        bar = tqdm(total=num_steps, initial=state.step, disable=not progress, unit="step")
        try:
            while state.step < num_steps and stopped is None:
                state = self.advance(state)
                stopped = state.fault
                if stopped is None:
                    bar.update()
                    bar.set_postfix({self.objective: f"{state.values[-1]:.2f}"}, refresh=False)
                    stopped = _converged(state.values, patience, tolerance)
                if path is not None and state.step % checkpoint_every == 0:
                    self.save(path, state, stopped)
                    saved = state
            state, value = self.finish(state)
        finally:
            bar.close()
            if path is not None and state.step > 0 and state is not saved:
                self.save(path, state, state.fault or stopped)
        return _End(state, value, state.fault or stopped)

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

    def advance(self, state: _State) -> _State:
        """One step up; or, with the fault, the state before the step that led here."""
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
        return _State(
            step=state.step + 1,
            reals=reals,
            optimizer=optimizer,
            values=(*state.values, float(values.mean())),
            deviations=(*state.deviations, float(values.std())),
            path=(*state.path, state.reals),
        )

    def back(self, state: _State, fault: str) -> _State:
        """The last good parameters, whose own update is not to be had."""
        if state.step == 0:
            raise RuntimeError(f"{self.caller}: {fault} at the start")
        fault = f"{fault} at step {state.step}"
        self.warn(fault, stacklevel=6)
        return replace(state, reals=state.path[-1], fault=fault)

    def warn(self, fault: str, stacklevel: int) -> None:
        """Say what was not finite."""
        message = f"{self.caller}: {fault}; its result is of the step before"
        warnings.warn(message, stacklevel=stacklevel)

    def finish(self, state: _State) -> tuple[_State, float]:
        """The end, and the objective there; that of the step before where there is none."""
        if state.fault is None:
            values, _, fault = self.evaluate(state)
            if fault is None:
                return state, float(values.mean())
            state = self.back(state, fault)
        return state, state.values[-1]

    def save(self, path: Path, state: _State, stopped: str | None) -> None:
        """Write all of the state, and why it ended where it has."""
        arrays = {"fit": np.array(json.dumps(self.identity)), "step": np.array(state.step)}
        arrays["stopped"] = np.array(stopped or "")
        arrays["broken"] = np.array(state.fault is not None)
        write_arrays(path, arrays | self.arrays_of(state))

    def arrays_of(self, state: _State) -> dict[str, np.ndarray]:
        """The numbers of a state, by their names in a file."""
        arrays = {"values": np.array(state.values), "deviations": np.array(state.deviations)}
        for i, leaf in enumerate(jax.tree.leaves(state.optimizer)):
            arrays[f"optimizer {i}"] = _written(leaf)
        for name, value in state.reals.items():
            arrays[f"reals {name}"] = own = _written(value)
            rows = [_written(point[name]) for point in state.path]
            arrays[f"path {name}"] = np.array(rows, own.dtype).reshape(len(rows), *own.shape)
        return arrays

    def load(self, path: Path, start: _State) -> _State:
        """The state that was saved; raises `ValueError` for that of another fit, or half of one."""
        arrays = load_arrays(path)
        identity = _parsed(arrays.get("fit"))
        if identity is None:
            raise ValueError(f"checkpoint: {path} is no checkpoint of a climb")
        if identity != self.identity:
            raise ValueError(
                f"checkpoint: {path} is of another {self.caller}: {unlike(identity, self.identity)}"
            )
        step = self.check_arrays(path, arrays, start)
        leaves, structure = jax.tree.flatten(start.optimizer)
        path_of = {name: arrays[f"path {name}"] for name in start.reals}
        return _State(
            step=step,
            reals={
                name: _read(arrays[f"reals {name}"], like) for name, like in start.reals.items()
            },
            optimizer=structure.unflatten(
                _read(arrays[f"optimizer {i}"], like) for i, like in enumerate(leaves)
            ),
            values=tuple(map(float, arrays["values"])),
            deviations=tuple(map(float, arrays["deviations"])),
            path=tuple(
                {name: _read(rows[k, ...], start.reals[name]) for name, rows in path_of.items()}
                for k in range(step)
            ),
            fault=str(arrays["stopped"]) if arrays["broken"] else None,
        )

    def check_arrays(self, path: Path, arrays: dict[str, np.ndarray], start: _State) -> int:
        """The step, of a file whose arrays are all there and as they should be."""
        step = arrays.get("step", np.array(-1))
        if step.shape != () or step.dtype.kind != "i" or step < 1:
            raise ValueError(f"checkpoint: {path} is damaged: its step is {shown(step)}")
        expected: dict[str, tuple[tuple[int, ...], str]] = {
            "stopped": ((), "U"),
            "broken": ((), "b"),
        }
        for name, array in self.arrays_of(start).items():
            by_step = name in ("values", "deviations") or name.startswith("path ")
            shape = (int(step), *array.shape[1:]) if by_step else array.shape
            expected[name] = (shape, array.dtype.name)
        for name, (shape, kind) in expected.items():
            if name not in arrays:
                raise ValueError(f"checkpoint: {path} is damaged: it lacks the array {name!r}")
            array = arrays[name]
            if array.shape != shape or kind not in (array.dtype.name, array.dtype.kind):
                raise ValueError(
                    f"checkpoint: {path} is damaged: {name!r} is {array.dtype}{list(array.shape)},"
                    f" not {kind}{list(shape)}"
                )
        return int(step)

    @functools.cached_property
    def identity(self) -> dict[str, str]:
        """What has to be the same for a checkpoint to be of this climb, by name."""
        leaves = jax.tree_util.tree_leaves_with_path(self.problem.tree)
        return (
            {
                f"parameters {name}": jax.tree_util.keystr(leaves[index][0])
                for name, index in self.problem.tuned
            }
            | contents_of("transforms", self.problem.transforms)
            | contents_of("key", self.key)
            | contents_of("num_seeds", int(self.num_seeds))
            | contents_of("common_random_numbers", bool(self.common_random_numbers))
            | contents_of("optimizer", self.optimizer)
            | self.described()
        )


def _written(leaf: Any) -> np.ndarray:
    """A number of a state as a file can hold it."""
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    array = np.asarray(leaf)
    # numpy has no name of its own for bfloat16 and the like, which would not come back.
    return array.view(f"u{array.itemsize}") if array.dtype.kind == "V" else array


def _read(array: np.ndarray, like: Any) -> Array:
    """The number that was written, of the kind of another."""
    if isinstance(like, jax.Array) and jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(like))
    return jnp.asarray(array.view(like.dtype) if hasattr(like, "dtype") else array)


def _parsed(description: np.ndarray | None) -> dict[str, str] | None:
    """What a file says that it is of, or None for one that says nothing."""
    try:
        identity = json.loads(str(description))
    except ValueError:
        return None
    return identity if isinstance(identity, dict) else None


def _converged(values: tuple[float, ...], patience: int | None, tolerance: float) -> str | None:
    if patience is None or len(values) < 2 * patience:
        return None
    before = np.mean(values[-2 * patience : -patience])
    gain = float(np.mean(values[-patience:]) - before)
    if gain > tolerance:
        return None
    return f"{patience} steps gained {gain:.3g} nats, no more than the tolerance, {tolerance}"
