"""The posterior of parameters and states together, by particle Gibbs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import Count, CountOrZero, checked, saying
from mpfjax.filter import Filter
from mpfjax.models.base import require
from mpfjax.models.series import with_gaps
from mpfjax.running.long_runs import Checkpoint
from mpfjax.running.scan import scan
from mpfjax.smoothing.conditional import (
    check_conditional,
    draw_trajectory,
    possible_times,
    renew,
    shape_of_trajectory,
)
from mpfjax.tuning.chains import AbstractKernel, PosteriorOfChains, Sampling, Step
from mpfjax.tuning.densities import (
    LogPrior,
    Point,
    Prior,
    SamplePrior,
    checked_prior,
    chosen,
    evaluated,
    is_invalid,
)
from mpfjax.tuning.evidence import LogJoint, one_sequence
from mpfjax.tuning.problem import Parameters, Problem, Reals, Transforms, pose
from mpfjax.tuning.walks import RandomWalk, checked_deviations, metropolis_step

_NUM_METROPOLIS_STEPS = 5  # for one new trajectory; they cost little

Draw = Callable[[Key[Array, ""], PyTree, PyTree, Any], Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True, repr=False)
class GibbsPosterior(PosteriorOfChains):
    """The chains of `particle_gibbs`, after their burn-in.

    `accepted` is 1 if the parameters are drawn. Values that are not finite are counted for the
    `log_prior` and `log_joint` of a proposal, the values of `draw`, and densities in the
    `conditional_filter`.
    """

    trajectories: PyTree
    """x_0, ..., x_t of every draw, leaves (chains, draws, t + 1, ...), or what `collect` made."""
    renewed: Bool[np.ndarray, "chains draws times"]
    """which states of the trajectory changed in these steps."""

    @property
    def renewal_rates(self) -> Float[np.ndarray, " times"]:
        """For each time, the fraction of steps in which the state changed."""
        return self.renewed.mean(axis=(0, 1))


@checked
def particle_gibbs(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    num_steps: Count,
    *,
    draw: Draw | None = None,
    log_prior: LogPrior | None = None,
    proposal_deviations: float | Mapping[str, Any] = 0.1,
    parameters: Parameters = None,
    transforms: Transforms = None,
    collect: Callable[[PyTree], PyTree] | None = None,
    num_chains: Count = 1,
    sample_prior: SamplePrior | None = None,
    burn_in: CountOrZero = 0,
    thinning: Count = 1,
    checkpoint: Checkpoint | None = None,
    progress: bool = True,
) -> GibbsPosterior:
    """Sample p(θ, x_0, ..., x_t | y_1..y_t), parameters and trajectory in turn.

    Particle Gibbs (Andrieu, Doucet and Holenstein 2010, section 2.4.3). Given θ, a
    `conditional_filter` renews the trajectory: it leaves p(x | y, θ) invariant for every N, also if
    moves regroup. Given the trajectory, θ is either drawn, or moved by Metropolis steps on

        log p(θ) + log |∂θ/∂u| + log p(x_0 | θ) + Σ_t log D(x_t | x_{t-1}; θ) L(y_t | x_t; θ).

    So the pair has exactly the posterior distribution, for any number of particles.

    - `draw`: a function `(key, trajectory, observations, model) -> {name: value}` that draws all
      parameters from p(θ | x, y), on their own scale. The trajectory's leaves are (t + 1, ...), of
      one chain. `model` has the current parameters. Missing observations are included, as NaN.
    - `log_prior`: instead of `draw`: a function of the parameters by name, as for
      `metropolis_hastings`. The model then needs `log_transition` and `log_initial`.
    - `proposal_deviations`: of the Metropolis steps' random walk, as for `metropolis_hastings`;
      there are five steps for each new trajectory.
    - `collect`: a function of one trajectory that returns the part to store, such as `lambda
      trajectory: trajectory[-1]`, or `lambda trajectory: None`. None stores all.
    - `observations`: one sequence, arrays or a `Series`. `parameters`, `transforms`: as for `fit`.
      Parameters are usually the model's; parameters of a proposal have no posterior.
    - `num_chains`, `sample_prior`, `burn_in`, `thinning`, `checkpoint`: as for
      `metropolis_hastings`. Each chain starts at a separate trajectory. During the burn-in the
      random walk also adapts its scale, because the density given a trajectory has no noise: it
      aims at accepting 44% of the Metropolis steps for one coordinate, 23% for several. With `draw`
      nothing is adapted.

    The new trajectory is drawn by backward sampling, or for a model without `log_transition` from
    the genealogy, see `conditional_filter`.

    A proposal whose density is NaN or +inf is rejected. If the conditional filter meets such a
    density, the whole step is rejected. `num_invalid` counts both, with a warning. Ctrl-C returns
    the draws so far with a warning, if there are any. Raises `ValueError` for both or none of
    `draw` and `log_prior`, a draw of other names or shapes than the parameters, a list of
    sequences, a checkpoint of other chains, and as `conditional_filter` and `fit` do;
    `RuntimeError` if the initial values, or a hundred draws of the prior, have zero likelihood.

    Use it if the distribution of the parameters given the trajectory is simple, or if long
    sequences make `metropolis_hastings` reject nearly all proposals. If θ and the trajectory
    determine each other, as with a small noise of the dynamics, steps are short and
    `metropolis_hastings` is better.
    """
    if (draw is None) == (log_prior is None):
        raise ValueError("draw, log_prior: exactly one must be given")
    backward = callable(getattr(filter.model, "log_transition", None))
    check_conditional(filter, backward, "particle_gibbs")
    series = one_sequence(observations, filter.model)
    problem = pose(filter, LogJoint(series), parameters, transforms)
    deviations = checked_deviations(proposal_deviations, problem.start())
    sampling = Sampling(
        "particle_gibbs", key, problem, deviations, num_steps, num_chains, sample_prior,
        burn_in, thinning, checkpoint, progress,
    )  # fmt: skip
    prior = None
    if log_prior is not None:
        for density in ("log_transition", "log_initial"):
            require(filter.model, density, "particle_gibbs with log_prior")
        prior = checked_prior(log_prior, problem, key, sample_prior)
    kernel = _Kernel(problem, prior, draw, collect, backward)
    if draw is not None:  # Names and shapes are checked before anything compiles.
        trajectory = shape_of_trajectory(filter.model, series.length + 1)
        jax.eval_shape(kernel.drawn, key, problem.start(), trajectory)
    (paths, accepted, renewed), fields = sampling.run(kernel, {"observations": series})
    return GibbsPosterior(trajectories=paths, accepted=accepted, renewed=renewed, **fields)


class _Pair(eqx.Module):
    """The present state of a chain."""

    reals: Reals
    trajectory: PyTree


class _Kernel(AbstractKernel):
    """One step of a chain: the parameters, then the trajectory; the objective is a `LogJoint`."""

    problem: Problem
    prior: Prior | None
    draw: Draw | None
    collect: Callable[[PyTree], PyTree] | None
    backward: bool = eqx.field(static=True)

    @property
    def learns_scale(self) -> bool:
        """True: the density given a trajectory has no noise."""
        return self.draw is None

    def start(self, key: Key[Array, ""], reals: Reals) -> tuple[_Pair, Bool[Array, ""]]:
        """A trajectory of an ordinary run, and whether there is one."""
        key_run, key_back = jax.random.split(key)
        filter, series = self.problem.at(reals), self.problem.objective.series
        run = scan(key_run, filter, series, None)
        path = draw_trajectory(key_back, filter.model, run, series.inputs, self.backward)
        fine = jnp.all(jnp.isfinite(run.log_likelihood_increments))
        if self.prior is not None:
            fine &= jnp.isfinite(self.prior(reals))
        fine &= jnp.all(possible_times(filter.model, path, series.inputs))
        return _Pair(reals, path), fine

    def step(self, key: Key[Array, ""], state: _Pair, walk: RandomWalk) -> Step:
        """The next pair."""
        key_parameters, key_trajectory = jax.random.split(key)
        move = self._metropolis if self.draw is None else self._gibbs
        reals, accepted, invalid = move(key_parameters, state.reals, state.trajectory, walk)
        filter, before = self.problem.at(reals), state.trajectory
        series = self.problem.objective.series
        result = renew(key_trajectory, filter, series, before, self.backward)
        possible = possible_times(filter.model, result.trajectory, series.inputs)
        broken = jnp.any(is_invalid(result.run.log_likelihood_increments))
        broken |= ~jnp.all(result.possible & possible)
        pair = chosen(~broken, _Pair(reals, result.trajectory), state)
        invalid["conditional_filter"] = broken

        def changed(new: Array, old: Array) -> Bool[Array, " times"]:
            return jnp.any((new != old).reshape(new.shape[0], -1), axis=1)

        changes = jax.tree.leaves(jax.tree.map(changed, pair.trajectory, before))
        path = pair.trajectory
        if self.collect is not None:
            with saying("collect", "called with a trajectory"):
                path = self.collect(path)
        report = (pair.reals, path, accepted, jnp.any(jnp.stack(changes), axis=0))
        return Step(pair, report, accepted, invalid)

    def _gibbs(
        self, key: Key[Array, ""], reals: Reals, trajectory: PyTree, walk: RandomWalk
    ) -> tuple[Reals, Float[Array, ""], dict[str, Array]]:
        """The user's draw, unless it is no number."""
        del walk
        drawn = self.drawn(key, reals, trajectory)
        fine = jnp.all(jnp.stack([jnp.all(jnp.isfinite(u)) for u in drawn.values()]))
        return chosen(fine, drawn, reals), jnp.ones(()), {"draw": ~fine}

    def drawn(self, key: Key[Array, ""], reals: Reals, trajectory: PyTree) -> Reals:
        """The user's draw, in unconstrained numbers."""
        filter = self.problem.at(reals)
        with saying("draw", "called with a key, trajectory, observations and model"):
            series = self.problem.objective.series
            observations = with_gaps(series.observations, series.present)
            drawn = cast(Draw, self.draw)(key, trajectory, observations, filter.model)
        return self.problem.unconstrain(drawn, "draw")

    def _metropolis(
        self, key: Key[Array, ""], reals: Reals, trajectory: PyTree, walk: RandomWalk
    ) -> tuple[Reals, Float[Array, ""], dict[str, Array]]:
        """Steps of the random walk on the parameters given the trajectory."""
        prior = cast(Prior, self.prior)

        def evaluate(key: Key[Array, ""], reals: Reals) -> tuple[Point, dict[str, Array]]:
            del key
            log_joint = self.problem.objective(trajectory, self.problem.at(reals))
            return evaluated(reals, prior(reals), log_joint, "log_joint")

        def move(point: Point, key: Key[Array, ""]) -> tuple[Point, Any]:
            point, *report = metropolis_step(key, walk.factor, point, evaluate)
            return point, report

        keys = jax.random.split(key, _NUM_METROPOLIS_STEPS)
        point, (accepted, invalid) = jax.lax.scan(move, evaluate(key, reals)[0], keys)
        counts = jax.tree.map(lambda some: jnp.sum(some, dtype=jnp.int32), invalid)
        return point.reals, jnp.mean(accepted.astype(jnp.result_type(float))), counts
