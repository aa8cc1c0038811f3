"""`fit` and `maximise`: gradient ascent on the log marginal likelihood, or another objective."""

from dataclasses import dataclass
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, CountOrZero, Rule, checked, shown, warn
from mpfjax.filter import Filter
from mpfjax.running.long_runs import Broken, Checkpoint, LongRun, State, identity_of
from mpfjax.tuning.curvature import errors_at
from mpfjax.tuning.evidence import pose_evidence, warn_of_bias
from mpfjax.tuning.problem import Objective, Parameters, Problem, Reals, Transforms, pose, scores

Optimizer = Annotated[
    optax.GradientTransformation,
    Rule(
        lambda value: not isinstance(value, type) and callable(getattr(value, "update", None)),
        "an optimiser of optax, as optax.adam(0.05)",
    ),
]


@dataclass(frozen=True)
class TuningRun:
    """The result of `fit` or `maximise`, and its history."""

    tuned: Any
    """the filter, or of `maximise` the model, with the parameters at the end; if it was stopped,
    the last good ones."""
    parameters: dict[str, np.ndarray]
    """the same, by name, on their own scale."""
    value: float
    """the objective with these parameters, of `fit` the log marginal likelihood summed over
    sequences: the mean over seeds."""
    history: dict[str, np.ndarray]
    """by step: `value`, the mean over seeds, and `deviation`, its standard deviation, with each
    parameter, by name, as it was then."""
    stopped: str | None
    """why it ended before `num_steps`, or None."""
    standard_errors: dict[str, np.ndarray] | None = None
    """of every number in the parameters; None if not asked for, or if there is no maximum."""


@checked
def fit(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    optimizer: Optimizer,
    num_steps: Count,
    *,
    parameters: Parameters = None,
    transforms: Transforms = None,
    num_seeds: Count = 8,
    curvature_seeds: CountOrZero = 0,
    checkpoint: Checkpoint | None = None,
    progress: bool = True,
) -> TuningRun:
    """Maximise the log marginal likelihood over some of a filter's parameters.

    Maximises the mean over seeds of log Ẑ(θ), summed over sequences, with the derivatives of the
    filter's moves. Build the filter with `gradient="stop"`: its derivatives estimate the score.
    With the default, "none", the optimisation ends somewhere else, however many particles there
    are, and a warning says so. For the parameters of a proposal, such as a `NetworkProposal`,
    "none" is right, and there is no warning.

    - `observations`: arrays or a `Series`; a list is several sequences, each run on its own.
    - `optimizer`: an optimiser of optax. It steps in the unconstrained numbers of the transforms.
    - `parameters`: what is tuned, by name: `{"sigma_y": lambda f: f.model.sigma_y}`. A node, such
      as a network, stands for all its arrays. None is every floating point array of the model. A
      named Python float becomes an array.
    - `transforms`: by name, such as `Positive()` for a scale. A parameter without one has no
      constraint.
    - `num_seeds`: the number of runs in each step, under one vmap.
    - `curvature_seeds`: the seeds for `standard_errors` at the end, in whole batches of
      `num_seeds`; 0 for none.
    - `checkpoint`: a `Checkpoint`, from whose file the same call goes on, also to a larger
      `num_steps`. All else must be the same: the filter and the observations to the bit, the
      parameters, transforms, key and seeds, and the steps that the optimiser takes.

    If the log marginal likelihood or the gradient is not finite, the optimisation ends with the
    last good parameters, a warning, and the step in `stopped`. Ctrl-C ends it with a warning as
    well. Raises `ValueError` for a parameter that is no floating point number, is static, starts
    outside its domain or has no effect. Raises it for a checkpoint of another fit, naming what
    differs, for one that is cut off or lacks an array, and where `run_filter` does. Raises
    `RuntimeError` if the start itself is not finite.
    """
    problem = pose_evidence(filter, observations, parameters, transforms)
    warn_of_bias("fit", problem)
    ascent = _Ascent("fit", "log_marginal_likelihood", key, problem, optimizer, num_seeds)
    data = {"observations": problem.objective}
    reals, run = ascent.climb(num_steps, checkpoint, progress, data, {})
    errors = None
    if curvature_seeds:
        key_curvature = jax.random.fold_in(key, num_steps + 1)
        shape = (-(-curvature_seeds // num_seeds), num_seeds)  # which is compiled already
        batches = list(jax.random.split(key_curvature, shape))
        errors = errors_at(problem, reals, batches, "curvature_seeds")
    return TuningRun(*run, standard_errors=errors)


@checked
def maximise(
    key: Key[Array, ""],
    model: Any,
    objective: Objective,
    optimizer: Optimizer,
    num_steps: Count,
    *,
    parameters: Parameters = None,
    transforms: Transforms = None,
    num_seeds: Count = 1,
    checkpoint: Checkpoint | None = None,
    progress: bool = True,
) -> TuningRun:
    """Maximise any objective in some of a model's, or a filter's, parameters.

    Maximises the mean over seeds of `objective(key, model)`, a scalar that JAX can differentiate,
    as `fit` does for the log marginal likelihood: same arguments, same checks, same report. Use it
    for another objective, such as that of an unnormalised likelihood on labelled frames
    (`LabelLikelihood`).

    - `model`: the pytree that the objective is a function of.
    - `objective`: a function, or an `equinox.Module` with a `__call__`, whose arrays are the data.
      An objective without randomness ignores its key, and needs one seed.
    - `parameters`: as for `fit`, picked from `model`; None is every floating point array of it.

    Raises what `fit` does for the same arguments, and `ValueError` for an objective that is not a
    floating point scalar. For a `checkpoint` the objective must also be the same.
    """
    problem = pose(model, objective, parameters, transforms)
    ascent = _Ascent("maximise", "value", key, problem, optimizer, num_seeds)
    found = eqx.filter_eval_shape(problem.value, key, problem.start())
    if getattr(found, "shape", None) != () or not jnp.issubdtype(found.dtype, jnp.floating):
        raise ValueError(f"objective: it returns {shown(found)}, no floating point scalar")
    functions = {"objective": (problem.value, key, problem.start())}
    data = {"objective": objective}
    _, run = ascent.climb(num_steps, checkpoint, progress, data, functions)
    return TuningRun(*run)


@dataclass(frozen=True)
class _Ascent:
    """The steps up the gradient, for the public function `caller`."""

    caller: str
    objective: str
    key: Key[Array, ""]
    problem: Problem
    optimizer: optax.GradientTransformation
    num_seeds: int

    def climb(
        self,
        num_steps: int,
        checkpoint: Checkpoint | None,
        progress: bool,
        data: dict[str, Any],
        functions: dict[str, Any],
    ) -> tuple[Reals, tuple]:
        """The parameters at the end, and the first fields of a `TuningRun`."""
        reals = self.problem.start()
        optimizer = self.optimizer.init(reals)
        no_path = jax.tree.map(lambda u: np.empty((0, *u.shape), u.dtype), reals)
        start = State(0, (reals, optimizer), (np.empty(0), np.empty(0), no_path))
        settings = {"key": self.key, "num_seeds": int(self.num_seeds)}
        settings |= self.problem.settings | data

        def first(reals: Reals) -> Any:
            return self._updated(reals, self.optimizer.init(reals), reals)

        functions |= {"optimizer": (first, reals)}
        identity = identity_of(self.caller, checkpoint, settings, functions)
        run = LongRun(self.caller, num_steps, checkpoint, progress, lambda step: identity)
        state, stopped = run.go(start, lambda: start, self._advance)
        (reals, _), (values, deviations, path) = state.carry, state.rows
        try:
            value = float(self._evaluated(state.step, reals)[0].mean())
        except Broken as fault:
            # The parameters are those of the step before, and so is their value.
            if stopped is None:
                stopped = f"{fault} at step {state.step}"
                warn(f"{self.caller}: {stopped}; its result is of the step before", UserWarning)
            reals, value = jax.tree.map(lambda rows: jnp.asarray(rows[-1]), path), float(values[-1])
        history = {"value": values, "deviation": deviations}
        history |= self.problem.constrained_rows(path)
        parameters = jax.tree.map(np.asarray, self.problem.constrain(reals))
        return reals, (self.problem.at(reals), parameters, value, history, stopped)

    def _evaluated(self, step: int, reals: Reals) -> tuple[np.ndarray, Reals]:
        """The objective of each seed, and the gradient of their mean; `Broken` if not finite."""
        keys = jax.random.split(jax.random.fold_in(self.key, step), self.num_seeds)
        values, gradient = scores(keys, self.problem, reals)
        values, named = np.asarray(values), self.objective.replace("_", " ")
        broken = [name for name, leaf in gradient.items() if not np.isfinite(leaf).all()]
        if not np.isfinite(values).all():
            raise Broken(f"the {named} was {values.mean()}")
        if broken:
            raise Broken(f"the gradient of {', '.join(broken)} was not finite")
        return values, gradient

    def _advance(self, step: int, last: int, carry: PyTree) -> tuple[int, PyTree, PyTree]:
        """One step up."""
        reals, optimizer = carry
        values, gradient = self._evaluated(step, reals)
        idle = [name for name, leaf in gradient.items() if not np.asarray(leaf).any()]
        if step == 0 and idle:
            named = self.objective.replace("_", " ")
            raise ValueError(f"parameters: the {named} does not depend on {', '.join(idle)}")
        updated, optimizer = self._updated(gradient, optimizer, reals)
        row = values.mean(), values.std(), jax.tree.map(np.asarray, reals)
        row = jax.tree.map(lambda leaf: np.asarray(leaf)[None], row)
        return step + 1, (updated, optimizer), row

    def _updated(self, gradient: Reals, optimizer: PyTree, reals: Reals) -> tuple[Reals, PyTree]:
        """One step of the optimiser."""
        descent = jax.tree.map(jnp.negative, gradient)
        # Optimisers need JAX's default promotion, whatever the caller has set.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            updates, optimizer = self.optimizer.update(descent, optimizer, reals)
            moved: Any = optax.apply_updates(reals, updates)
        return moved, optimizer
