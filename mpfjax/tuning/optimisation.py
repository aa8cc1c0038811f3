"""`fit` and `maximise`: gradient ascent on the log marginal likelihood, or another objective."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import (
    check_callable,
    check_key,
    check_whole,
    shown,
)
from mpfjax.filter import Filter
from mpfjax.running.storage.descriptions import fingerprint
from mpfjax.tuning.curvature import errors_at
from mpfjax.tuning.gradient_ascent import Optimisation, Plan
from mpfjax.tuning.problem import Objective, Parameters, Problem, pose, pose_evidence, warn_of_bias
from mpfjax.tuning.transforms import AbstractTransform


@dataclass(frozen=True)
class TuningRun:
    """The result of `fit`, and its history."""

    filter: Filter
    """with the parameters at the end; if it was stopped, the last good ones."""
    parameters: dict[str, np.ndarray]
    """the same, by name, on their own scale."""
    standard_errors: dict[str, np.ndarray] | None
    """of every number in them; None if not asked for, or if there is no maximum."""
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
    inputs: PyTree = None,
    missing: str = "error",
    patience: int | None = None,
    tolerance: float = 0.0,
    curvature_seeds: int = 0,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 50,
    checkpoint_name: str | None = None,
    progress: bool = True,
) -> TuningRun:
    """Maximise the log marginal likelihood over some of a filter's parameters.

    Maximises the mean over seeds of log Ẑ(θ), summed over sequences, with the derivatives of the
    filter's moves. Build the filter with `gradient="stop"`: its derivatives estimate the score.
    With the default, "none", the optimisation ends somewhere else, however many particles there
    are, and a warning says so. For the parameters of a proposal, such as a `NetworkProposal`,
    "none" is right, and there is no warning.

    - `observations`: as for `run_filter`; a list is several sequences, each run on its own.
    - `optimizer`: an optimiser of optax. It steps in the unconstrained numbers of the transforms.
    - `parameters`: what is tuned, by name: `{"sigma_y": lambda f: f.model.sigma_y}`. A node, such
      as a network, stands for all its arrays. Or a filter spec, a pytree of booleans like the
      filter. None is every floating point array of the model. A named Python float becomes an
      array.
    - `transforms`: by name, such as `Positive()` for a scale. A parameter without one has no
      constraint.
    - `num_seeds`: the number of runs in each step, under one vmap. `common_random_numbers` takes
      the same seeds in every step: there is no noise between steps, but the error of those seeds
      stays.
    - `inputs`, `missing`: as for `run_filter`; of several sequences, a list of inputs.
    - `patience`: a number of steps k. The optimisation ends when the mean of the last k steps is at
      most `tolerance` nats above the mean of the k steps before.
    - `curvature_seeds`: the seeds for `standard_errors` at the end, in whole batches of
      `num_seeds`; 0 for none.
    - `checkpoint`: a .npz file, without pickles. It is written every `checkpoint_every` steps, and
      when the optimisation ends or is interrupted. If the file exists, the optimisation goes on
      from it, the same to the bit as without the interruption. An optimisation that has ended is
      returned as it ended. To go on, take a larger `num_steps`, or another `patience` or
      `tolerance`. An optimisation that ended at a number that is not finite stays there. All else
      must be the same: the filter and the observations to the bit, the parameters, transforms, key
      and seeds, and the optimiser with the numbers in its closures and schedules. Functions and
      classes are compared by their names and by what they hold: take a new file after you change
      what they do. With another version of optax, the file may be refused.
    - `checkpoint_name`: what the optimisation is called, such as "adam, cosine". Its file is then
      recognised by this name, and functions and the optimiser are not compared; numbers and arrays
      are. Use it for functions that change what they hold, and across versions.

    If the log marginal likelihood or the gradient is not finite, the optimisation ends with the
    last good parameters, a warning, and the step in `stopped`. Raises `ValueError` for a parameter
    that is no floating point number, is static, starts outside its domain or has no effect. Raises
    it for a checkpoint of another fit, naming what differs, for one that is cut off or lacks an
    array, and where `run_filter` does. Raises `RuntimeError` if the start itself is not finite.
    """
    _check_optimisation(key, optimizer, num_seeds)
    plan = Plan(
        num_steps, common_random_numbers, patience, tolerance,
        checkpoint, checkpoint_every, checkpoint_name, progress,
    )  # fmt: skip
    check_whole(0, curvature_seeds=curvature_seeds)
    problem = pose_evidence(filter, observations, parameters, transforms, missing, inputs)
    warn_of_bias("fit", problem)

    observed = fingerprint(problem.objective)
    settings = {"filter": problem.tree, "observations": observed, "missing": missing}
    objective = "log_marginal_likelihood"
    optimisation = Optimisation(
        "fit", objective, key, problem, optimizer, num_seeds, settings, {}, plan
    )
    end = optimisation.run()
    errors = None
    if curvature_seeds:
        key_curvature = jax.random.fold_in(key, num_steps + 1)
        batches = optimisation.batches(key_curvature, curvature_seeds)
        errors = errors_at(problem, end.state.reals, batches, "curvature_seeds")
    return TuningRun(
        filter=problem.at(end.state.reals),
        parameters=problem.constrained(end.state.reals),
        standard_errors=errors,
        log_marginal_likelihood=end.value,
        history=optimisation.history(end.state),
        stopped=end.stopped,
    )


@dataclass(frozen=True)
class Maximisation:
    """The result of `maximise`, and its history."""

    model: Any
    """with the parameters at the end; if it was stopped, the last good ones."""
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
    checkpoint_name: str | None = None,
    progress: bool = True,
) -> Maximisation:
    """Maximise any objective in some of a model's, or a filter's, parameters.

    Maximises the mean over seeds of `objective(key, model)`, a scalar that JAX can differentiate,
    as `fit` does for the log marginal likelihood: same arguments, same checks, same report. Use it
    for another objective, such as that of an unnormalised likelihood on labelled frames
    (`LabelLikelihood`).

    - `objective`: a function, or an `equinox.Module` with a `__call__`, whose arrays are the data.
      An objective without randomness ignores its key, and needs one seed.
    - `model`: the pytree that the objective is a function of.
    - `parameters`: as for `fit`, picked from `model`; None is every floating point array of it.

    Raises what `fit` does for the same arguments, and `ValueError` for an objective that is not a
    floating point scalar. For a `checkpoint` the objective must also be the same: the code and
    closure of a function, the fields of an `equinox.Module`.
    """
    _check_optimisation(key, optimizer, num_seeds)
    plan = Plan(
        num_steps, common_random_numbers, patience, tolerance,
        checkpoint, checkpoint_every, checkpoint_name, progress,
    )  # fmt: skip
    check_callable("a function of a key and a model", objective=objective)
    problem = pose(model, objective, parameters, transforms)
    _check_scalar(problem, key)

    settings, code = {"model": problem.tree}, {"objective": objective}
    optimisation = Optimisation(
        "maximise", "value", key, problem, optimizer, num_seeds, settings, code, plan
    )
    end = optimisation.run()
    return Maximisation(
        model=problem.at(end.state.reals),
        parameters=problem.constrained(end.state.reals),
        value=end.value,
        history=optimisation.history(end.state),
        stopped=end.stopped,
    )


def _check_optimisation(key: Any, optimizer: Any, num_seeds: Any) -> None:
    """The other arguments that `fit` and `maximise` share, before anything compiles."""
    check_key(key)
    for method in ("init", "update"):
        if isinstance(optimizer, type) or not callable(getattr(optimizer, method, None)):
            raise ValueError(
                f"optimizer: {shown(optimizer)} has no {method}; take one of optax, such as"
                " optax.adam(0.05)"
            )
    check_whole(1, num_seeds=num_seeds)


def _check_scalar(problem: Problem, key: Key[Array, ""]) -> None:
    found = eqx.filter_eval_shape(problem.value, problem.start(), key)
    shape, dtype = getattr(found, "shape", None), getattr(found, "dtype", None)
    if shape != () or dtype is None or not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"objective: it returns {shown(found)}, no floating point scalar")
