"""`fit` and `maximise`: gradient ascent on the log marginal likelihood, or another objective."""

from dataclasses import dataclass, replace
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, Rule, checked, shown, warn
from mpfjax.filter import Filter
from mpfjax.running.long_runs import Broken, Checkpoint, LongRun, State
from mpfjax.tuning.evidence import Score, names_but_proposals, pose_evidence, warn_of_bias
from mpfjax.tuning.problem import (
    Objective,
    Parameters,
    Problem,
    Reals,
    Transforms,
    averages,
    pose,
    scores,
)

_IS_OPTIMIZER = Rule(
    lambda value: not isinstance(value, type) and callable(getattr(value, "update", None)),
    "an optimiser of optax, as optax.adam(0.05)",
)
Optimizer = Annotated[optax.GradientTransformation, _IS_OPTIMIZER]

# Where fewer seeds than this count, the bias of log Ẑ is large and unknown.
_FEWEST_SEEDS = 2.0
_LAST_STEPS = 20


@dataclass(frozen=True)
class TuningRun:
    """The result of `fit` or `maximise`, and its history."""

    tuned: Any
    """the filter, or of `maximise` the model, with the parameters at the end; if it was stopped,
    the last good ones."""
    parameters: dict[str, np.ndarray]
    """the same, by name, on their own scale."""
    value: float
    """the objective with these parameters, of `fit` summed over sequences."""
    history: dict[str, np.ndarray]
    """by step: `value`, the objective, and `deviation`, the standard deviation over seeds, with
    each parameter, by name, as it was then; of `fit` also `effective_seeds`, the mean over
    sequences. Of a batch, the first two are scaled to all sequences."""
    stopped: str | None
    """why it ended before `num_steps`, or None."""
    effective_seeds: Float[np.ndarray, " series"] | None
    """of `fit`, for each sequence, (Σ Ẑ)² / Σ Ẑ² over seeds at the end: how many of them count;
    None if Ẑ was not finite there."""


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
    batch: Count | None = None,
    pooled: bool | None = None,
    score: Score = "filter",
    checkpoint: Checkpoint | None = None,
    progress: bool = True,
) -> TuningRun:
    """Maximise the log marginal likelihood over some of a filter's parameters.

    Maximises the sum over sequences s of

        log (1 / K Σ_k Ẑ_s(θ; k)),

    over K seeds k, by its jackknife estimate. Ẑ is unbiased, but log Ẑ of one seed is below log Z
    by about half its variance. That variance depends on θ, and over many sequences its effect does
    not average out. The logarithm of the mean over seeds is biased by about 1 / K of that, and the
    jackknife over seeds (Quenouille 1956) removes most of the rest. Build the filter with
    `gradient="stop"`, whose derivatives estimate the score, or use `score="fisher"`. With neither
    the optimisation ends somewhere else, for any number of particles, and a warning is issued.

    The parameters of a proposal, such as a `NetworkProposal`, do not change Z. For them alone the
    mean over seeds of log Ẑ is maximised, a lower bound of log Z that a better proposal raises; the
    gradient of a tighter bound would have more noise relative to its size (Rainforth et al. 2018).
    "none" is correct for them, and there is no warning.

    - `observations`: arrays or a `Series`; a list is several sequences, each run separately.
    - `optimizer`: an optimiser of optax. It steps in the unconstrained coordinates of the
      transforms.
    - `parameters`: what is tuned, by name: `{"sigma_y": lambda f: f.model.sigma_y}`. A node, such
      as a network, means all its arrays. None is every floating-point array of the model. A named
      Python float becomes an array.
    - `transforms`: by name, such as `Positive()` for a scale. A parameter without one is
      unconstrained.
    - `num_seeds`: K, the number of runs of each sequence in a step, under one vmap.
    - `batch`: the number of sequences in a step, in epochs of random order; None is all of them.
      Sequences in a batch have one shape. A `batch` that divides their number compiles once.
    - `pooled`: whether Ẑ or log Ẑ is averaged over seeds. None is as above: true unless all
      parameters are parameters of proposals.
    - `score`: how the gradient is estimated. "filter" uses the derivatives of the filter's moves.
      "fisher" draws a few trajectories backwards through each run, and uses the derivatives of
      log p(x_0, ..., x_t, y_1, ..., y_t | θ) along them (Fisher's identity). It has less noise and
      needs no derivative of draws or moves. The model needs `log_transition` and `log_initial` and
      may not be conditionally linear, the parameters must be the model's, and every move must leave
      each particle one parent.
    - `checkpoint`: a `Checkpoint`, from whose file the same call continues, also to a larger
      `num_steps`.

    A warning is issued if fewer than two seeds count (`effective_seeds`), because log Ẑ varies
    strongly from seed to seed: the bias is then about that of one seed.

    If the log marginal likelihood or the gradient is not finite, the optimisation ends with the
    last good parameters, a warning, and the step in `stopped`. Ctrl-C ends it with a warning as
    well. Raises `ValueError` for a parameter that is not a floating-point number, is static, starts
    outside its domain or has no effect, for "fisher" if one of its requirements is missing, and as
    `run_filter` does. Raises `RuntimeError` if the initial value is not finite. Use
    `standard_errors` with the result.
    """
    problem = pose_evidence(filter, observations, parameters, transforms, score)
    warn_of_bias("fit", problem)
    if pooled is None:
        pooled = bool(names_but_proposals(problem))
    what = "fit", "log marginal likelihood"
    ascent = _Ascent(*what, key, problem, optimizer, num_seeds, batch, pooled)
    data = {"observations": problem.objective, "score": score}
    values, run = ascent.climb(num_steps, checkpoint, progress, data)
    if values is None:
        return run
    if pooled:
        _warn_of_few_seeds(run.history["effective_seeds"], values)
    order = np.argsort(problem.objective.places)
    return replace(run, effective_seeds=_effective_seeds(values)[order])


def _effective_seeds(values: Float[np.ndarray, "seeds series"]) -> Float[np.ndarray, " series"]:
    """(Σ Ẑ)² / Σ Ẑ² of each series, from log Ẑ."""
    weights = np.exp(values - values.max(axis=0))
    return weights.sum(axis=0) ** 2 / (weights**2).sum(axis=0)


def _warn_of_few_seeds(history: np.ndarray, values: np.ndarray) -> None:
    """Warn where about one seed decides the likelihood of each series, in the last steps."""
    effective = history[-_LAST_STEPS:].mean()
    if effective < _FEWEST_SEEDS:
        spread = values.std(axis=0, ddof=1).mean() if len(values) > 1 else np.nan
        of = f", since log Ẑ has a standard deviation of {spread:.1f}" if len(values) > 1 else ""
        what = f"only {effective:.1f} of {len(values)} seeds count for a series{of}, and the"
        warn(f"fit: {what} parameters are biased; raise num_particles or num_seeds", UserWarning)


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
    """Maximise any objective over some of a model's, or a filter's, parameters.

    Maximises the mean over seeds of `objective(key, model)`, a scalar that JAX can differentiate,
    as `fit` does for the log marginal likelihood, with the same arguments, checks and report. Use
    it for another objective, such as that of an unnormalised likelihood on labelled frames.

    - `model`: the pytree that is the argument of the objective.
    - `objective`: a function, or an `equinox.Module` with a `__call__`, whose arrays are the data.
      A deterministic objective ignores its key, and needs one seed.
    - `parameters`: as for `fit`, selected from `model`; None is every floating-point array of it.

    Raises errors as `fit` does for the same arguments, and `ValueError` for an objective that is
    not a floating-point scalar.
    """
    problem = pose(model, objective, parameters, transforms)
    ascent = _Ascent("maximise", "value", key, problem, optimizer, num_seeds)
    value = eqx.filter_eval_shape(objective, key, problem.at(problem.start()))
    if getattr(value, "shape", None) != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise ValueError(f"objective: it returns {shown(value)}, no floating point scalar")
    _, run = ascent.climb(num_steps, checkpoint, progress, {"objective": objective})
    del run.history["effective_seeds"]  # of values that are no logarithms of likelihoods
    return run


@dataclass(frozen=True)
class _Ascent:
    """The steps up the gradient, for the public function `caller`."""

    caller: str
    objective: str
    key: Key[Array, ""]
    problem: Problem
    optimizer: optax.GradientTransformation
    num_seeds: int
    batch: int | None = None  # of the series in a step, where the objective is a `LogEvidence`
    pooled: bool = False

    def climb(
        self, num_steps: int, checkpoint: Checkpoint | None, progress: bool, data: dict[str, Any]
    ) -> tuple[Float[np.ndarray, "seeds series"] | None, TuningRun]:
        """The objective at the end, None where it is not finite, and the result."""
        reals = self.problem.start()
        optimizer = self.optimizer.init(reals)
        no_path = jax.tree.map(lambda u: np.empty((0, *u.shape), u.dtype), reals)
        start = State(0, (reals, optimizer), (np.empty(0), np.empty(0), np.empty(0), no_path))
        settings = {"key": self.key, "num_seeds": int(self.num_seeds)}
        settings |= {"batch": self.batch, "pooled": self.pooled} | self.problem.settings | data
        run = LongRun(self.caller, num_steps, checkpoint, progress, lambda step: settings)
        state, stopped = run.go(start, self._advance)
        (reals, _), (averages, deviations, effective, path) = state.carry, state.rows
        key = jax.random.fold_in(self.key, state.step)
        try:
            values = np.concatenate([
                self._evaluate(jax.random.fold_in(key, number), part, reals)[0]
                for number, part in enumerate(self._parts())
            ], axis=1)  # fmt: skip
            value = self._average(values)
        except Broken as fault:
            # The parameters are those of the step before, and so is their value.
            if stopped is None:
                stopped = f"{fault} at step {state.step}"
                warn(f"{self.caller}: {stopped}; its result is of the step before", UserWarning)
            reals = jax.tree.map(lambda rows: jnp.asarray(rows[-1]), path)
            values, value = None, float(averages[-1])
        history = {"value": averages, "deviation": deviations, "effective_seeds": effective}
        history |= self.problem.constrained_rows(path)
        parameters = jax.tree.map(np.asarray, self.problem.constrain(reals))
        return values, TuningRun(self.problem.at(reals), parameters, value, history, stopped, None)

    def _parts(self, rng: np.random.Generator | None = None) -> list[Problem]:
        """The problem, or one for each batch of series: in the order of `rng`, or as they stand."""
        if self.batch is None:
            return [self.problem]
        parts = self.problem.objective.parts(self.batch, rng)
        return [replace(self.problem, objective=part) for part in parts]

    def _average(self, values: Float[np.ndarray, "seeds series"]) -> float:
        """The average over seeds, summed over series."""
        return float(np.asarray(averages(jnp.asarray(values), self.pooled), float).sum())

    def _evaluate(
        self, key: Key[Array, ""], problem: Problem, reals: Reals
    ) -> tuple[Float[np.ndarray, "seeds series"], Reals]:
        """The objective of each seed, and the gradient of their average; `Broken` if not finite."""
        keys = jax.random.split(key, self.num_seeds)
        values, gradient = scores(keys, problem, reals, self.pooled)
        values = np.asarray(values, float)
        broken = [name for name, leaf in gradient.items() if not np.isfinite(leaf).all()]
        if not np.isfinite(values).all():
            raise Broken(f"the {self.objective} was {values.mean()}")
        if broken:
            raise Broken(f"the gradient of {', '.join(broken)} was not finite")
        return values, gradient

    def _advance(self, step: int, last: int, carry: PyTree) -> tuple[int, PyTree, PyTree]:
        """One step up."""
        reals, optimizer = carry
        factor = len(self._parts())  # batches in an epoch, of which each has an order of its own
        epoch, place = divmod(step, factor)
        seed = np.asarray(jax.random.key_data(self.key)).ravel()
        problem = self._parts(np.random.default_rng([*seed, epoch]))[place]
        values, gradient = self._evaluate(jax.random.fold_in(self.key, step), problem, reals)
        idle = [name for name, leaf in gradient.items() if not np.asarray(leaf).any()]
        if step == 0 and idle:
            what = f"the {self.objective} does not depend on {', '.join(idle)}"
            raise ValueError(f"parameters: {what}")
        descent = jax.tree.map(lambda leaf: -factor * leaf, gradient)
        # Optimisers need JAX's default promotion, whatever the caller has set.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            updates, optimizer = self.optimizer.update(descent, optimizer, reals)
            moved = optax.apply_updates(reals, updates)
        deviation = np.sqrt(factor) * values.sum(axis=1).std()
        row = factor * self._average(values), deviation, _effective_seeds(values).mean(), reals
        row = jax.tree.map(lambda leaf: np.asarray(leaf)[None], row)
        return step + 1, (moved, optimizer), row
