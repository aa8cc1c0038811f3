"""The posterior of parameters and states together, by particle Gibbs."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import (
    check_callable,
    check_flag,
    check_key,
    check_type,
    check_whole,
    given,
    saying,
    shown,
)
from mpfjax.filter import Filter, Start
from mpfjax.models.base import require
from mpfjax.models.inputs import with_inputs
from mpfjax.models.steps import likelihoods
from mpfjax.moves.initial import sample_initial
from mpfjax.observations import Series, as_series
from mpfjax.running.scan import scan
from mpfjax.running.storage.checkpoints import check_checkpoint
from mpfjax.running.storage.descriptions import fingerprint
from mpfjax.smoothing.backward import log_transitions
from mpfjax.smoothing.conditional import check_conditional, draw_trajectory, is_possible, renew
from mpfjax.tuning.chains import (
    AbstractKernel,
    Plan,
    Run,
    Step,
    as_checkpoint,
    chosen,
)
from mpfjax.tuning.densities import LogPrior, Prior, is_invalid, number_or_zero
from mpfjax.tuning.problem import Parameters, Problem, Reals, pose_filter
from mpfjax.tuning.starts import SamplePrior, Starts, constrained
from mpfjax.tuning.transforms import AbstractTransform
from mpfjax.tuning.walks import RandomWalk, accepts, checked_deviations

Draw = Callable[[Key[Array, ""], PyTree, PyTree, Any], Mapping[str, Any]]


@dataclass(frozen=True)
class GibbsPosterior:
    """The chains of `particle_gibbs`, after their burn-in."""

    parameters: dict[str, np.ndarray]
    """by name, on their own scale: shape (chains, draws, ...)."""
    trajectories: PyTree
    """x_0, ..., x_t of every draw, leaves (chains, draws, t + 1, ...), or what `collect` made."""
    accepted: Float[np.ndarray, "chains draws"]
    """the share of these steps' Metropolis steps that moved; 1 where the parameters are drawn."""
    renewed: Bool[np.ndarray, "chains draws times"]
    """which states of the trajectory changed in these steps."""
    stopped: str | None = None
    """why they ended before `num_steps`, or None."""
    num_invalid: dict[str, np.ndarray] = field(default_factory=dict)
    """how often in each chain, in all its steps, the `log_prior` or `log_joint` of a proposal, the
    numbers of `draw`, or densities in the `conditional_filter` were NaN or +inf."""
    proposal_covariance: Float[np.ndarray, "d d"] | None = None
    """of the random walk after burn-in, in unconstrained numbers, in the order of their names."""

    @property
    def acceptance_rate(self) -> float:
        """The share of Metropolis steps that moved."""
        return float(self.accepted.mean())

    @property
    def renewal_rates(self) -> Float[np.ndarray, " times"]:
        """For each time, the share of steps in which the state changed."""
        return self.renewed.mean(axis=(0, 1))


def particle_gibbs(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    num_steps: int,
    *,
    draw: Draw | None = None,
    log_prior: LogPrior | None = None,
    sample_prior: SamplePrior | None = None,
    proposal_deviations: float | Mapping[str, Any] = 0.1,
    num_metropolis_steps: int = 5,
    burn_in: int = 0,
    adapt: bool = True,
    thinning: int = 1,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
    num_chains: int = 1,
    backward: bool = True,
    collect: Callable[[PyTree], PyTree] | None = None,
    inputs: PyTree = None,
    missing: str = "error",
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 1000,
    checkpoint_name: str | None = None,
    progress: bool = True,
) -> GibbsPosterior:
    """Sample p(θ, x_0, ..., x_t | y_1..y_t), parameters and trajectory in turn.

    Particle Gibbs (Andrieu, Doucet and Holenstein 2010, section 2.4.3). Given θ, a
    `conditional_filter` renews the trajectory: it leaves p(x | y, θ) as it is for every N, also
    where moves regroup. Given the trajectory, θ is either drawn, or moved by Metropolis steps on

        log p(θ) + log |∂θ/∂u| + log p(x_0 | θ) + Σ_t log D(x_t | x_{t-1}; θ) L(y_t | x_t; θ).

    So the pair has exactly the posterior distribution, whatever the number of particles.

    - `draw`: a function `(key, trajectory, observations, model) -> {name: value}` that draws all
      parameters from p(θ | x, y), on their own scale. The trajectory's leaves are (t + 1, ...), of
      one chain. `model` has the present parameters. Missing observations are there, as NaN.
    - `log_prior`: in place of `draw`: a function of the parameters by name, as for
      `metropolis_hastings`. The model then needs `log_transition` and `log_initial`.
    - `proposal_deviations`: of the Metropolis steps' random walk, as for `metropolis_hastings`.
      `num_metropolis_steps`: how many of them there are for one new trajectory; they cost little.
    - `num_chains`, `sample_prior`, `burn_in`, `adapt`, `thinning`: as for `metropolis_hastings`.
      Each chain starts at a trajectory of its own. The random walk learns its scale too, since
      the density given a trajectory has no noise: it aims at accepting 44% of the Metropolis
      steps for one number, 23% for several. With `draw` nothing is learned.
    - `backward`: as for `conditional_filter`.
    - `collect`: a function of one trajectory that returns what to keep of it, such as
      `lambda trajectory: trajectory[-1]`, or `lambda trajectory: None`. None keeps all.
    - `checkpoint`, `checkpoint_every`, `checkpoint_name`: as for `metropolis_hastings`. The file
      holds what is kept of the trajectories too.
    - `observations`: one sequence. `parameters`, `transforms`, `inputs`, `missing`: as for `fit`.
      Parameters are usually the model's; those of a proposal have no posterior.

    A proposal whose density is NaN or +inf is rejected. If the conditional filter meets such a
    density, the whole step is rejected. `num_invalid` counts both, with a warning. Ctrl-C returns
    the draws so far with a warning, if there are any. Raises `ValueError` for both or none of
    `draw` and `log_prior`, a draw of other names or shapes than the parameters, a list of
    sequences, a checkpoint of other chains, and what `conditional_filter` and `fit` do;
    `RuntimeError` where the start, or a hundred draws of the prior, have no likelihood.

    Use it where the trajectory makes the parameters' distribution simple, or long sequences make
    `metropolis_hastings` reject nearly all. If θ and the trajectory fix each other, as a small
    noise of the dynamics does, steps are short and `metropolis_hastings` is better.
    """
    check_key(key)
    check_type(Filter, "a filter", filter=filter)
    check_whole(num_chains=num_chains, num_metropolis_steps=num_metropolis_steps)
    plan = Plan(num_steps, burn_in, thinning, adapt)
    check_flag(backward=backward, progress=progress)
    check_callable("a function of a trajectory", **given(collect=collect))
    what = "a function of a key, a trajectory, observations and a model"
    check_callable(what, **given(draw=draw))
    check_callable("a function of the parameters by name", **given(log_prior=log_prior))
    check_callable("a function of a key", **given(sample_prior=sample_prior))
    check_checkpoint(checkpoint, checkpoint_every, checkpoint_name)
    if (draw is None) == (log_prior is None):
        raise ValueError(
            f"draw, log_prior: {shown(draw)} and {shown(log_prior)}; exactly one must be given"
        )
    check_conditional(filter, backward, "particle_gibbs")
    if isinstance(observations, list):
        raise ValueError(
            "observations: a list is several sequences, and this takes one;"
            " jnp.asarray(observations) is one of numbers"
        )
    joint = LogJoint(as_series(observations, filter.model, inputs, missing))
    problem = pose_filter(filter, joint, parameters, transforms)
    deviations = checked_deviations(proposal_deviations, problem.start())
    key_start, key_steps = jax.random.split(key)
    starts = Starts(key_start, problem, num_chains, sample_prior, deviations)
    prior = None
    if log_prior is not None:
        for density in ("log_transition", "log_initial"):
            require(filter.model, density, "particle_gibbs with log_prior")
        prior = starts.checked(log_prior)
    kernel = _Kernel(problem, joint, prior, draw, collect, int(num_metropolis_steps), backward)
    if draw is not None:
        _check_draw(kernel, problem.start())
    settings = {
        "observations": fingerprint(joint), "missing": missing, "backward": bool(backward),
        "num_metropolis_steps": int(num_metropolis_steps),
    }  # fmt: skip
    settings |= starts.settings | plan.settings | {"key": key}
    code = {
        "draw": draw, "log_prior": log_prior, "sample_prior": sample_prior, "collect": collect
    }  # fmt: skip
    file = as_checkpoint(checkpoint, "particle_gibbs", checkpoint_name, settings, code)
    run = Run("particle_gibbs", kernel, starts, key_steps, plan, file)
    outcome = run.sample(checkpoint_every, progress)
    reals, kept, accepted, renewed = outcome.draws
    return GibbsPosterior(
        parameters=constrained(problem, reals),
        trajectories=kept,
        accepted=accepted,
        renewed=renewed,
        num_invalid=outcome.num_invalid,
        proposal_covariance=outcome.proposal_covariance,
        stopped=outcome.stopped,
    )


class LogJoint(eqx.Module):
    """log p(x_0, ..., x_t, y_1, ..., y_t | θ) of a trajectory and the observations there are."""

    series: Series

    def __call__(self, trajectory: PyTree, filter: Filter) -> Float[Array, ""]:
        """With the parameters of the filter's model."""
        model: Any = filter.model
        start, after = (
            jax.tree.map(lambda leaf, cut=cut: leaf[cut], trajectory)
            for cut in (slice(0, 1), slice(1, None))
        )

        def log_likelihood(observation: PyTree, inputs: PyTree, state: PyTree) -> Float[Array, ""]:
            one = jax.tree.map(lambda leaf: leaf[None], state)
            return likelihoods(with_inputs(model, inputs), observation, one)[0]

        seen = jax.vmap(log_likelihood)(self.series.observations, self.series.inputs, after)
        if self.series.present is not None:
            seen = jnp.where(self.series.present, seen, 0.0)
        steps = jnp.sum(log_transitions(model, trajectory, self.series.inputs))
        return model.log_initial(start)[0] + steps + jnp.sum(seen)


class _Pair(eqx.Module):
    """The present state of a chain."""

    reals: Reals
    trajectory: PyTree


class _Kernel(AbstractKernel):
    """One step of a chain: the parameters, then the trajectory."""

    problem: Problem
    joint: LogJoint
    prior: Prior | None
    draw: Draw | None
    collect: Callable[[PyTree], PyTree] | None
    num_metropolis_steps: int = eqx.field(static=True)
    backward: bool = eqx.field(static=True)

    @property
    def learns_scale(self) -> bool:
        """True: the density given a trajectory has no noise."""
        return self.draw is None

    def start(self, key: Key[Array, ""], reals: Reals) -> tuple[_Pair, Bool[Array, ""]]:
        """A trajectory of an ordinary run, and whether there is one."""
        key_run, key_back = jax.random.split(key)
        filter = self.problem.at(reals)
        series = self.joint.series
        run = scan(Start(key_run), filter, series, None)
        drawn = draw_trajectory(
            key_back, filter.model, run, series.inputs, self.backward, checked=False
        )
        fine = jnp.all(jnp.isfinite(run.log_likelihood_increments))
        if self.prior is not None:
            fine &= jnp.isfinite(self.prior(reals))
        return _Pair(reals, drawn), fine & is_possible(filter.model, drawn, series.inputs)

    def step(self, key: Key[Array, ""], state: _Pair, walk: RandomWalk) -> Step:
        """The next pair."""
        key_parameters, key_trajectory = jax.random.split(key)
        move = self._metropolis if self.draw is None else self._gibbs
        reals, accepted, invalid = move(key_parameters, state.reals, state.trajectory, walk)
        filter, before = self.problem.at(reals), state.trajectory
        series = self.joint.series
        found = renew(key_trajectory, filter, series, before, self.backward, checked=False)
        broken = jnp.any(is_invalid(found.run.log_likelihood_increments))
        broken |= ~jnp.all(found.possible) | ~is_possible(
            filter.model, found.trajectory, series.inputs
        )
        pair = chosen(~broken, _Pair(reals, found.trajectory), state)
        invalid["conditional_filter"] = broken
        changes = [
            jnp.any((new != old).reshape(new.shape[0], -1), axis=1)
            for new, old in zip(
                jax.tree.leaves(pair.trajectory), jax.tree.leaves(before), strict=True
            )
        ]
        kept = pair.trajectory
        if self.collect is not None:
            with saying("in collect, which is called with a trajectory"):
                kept = self.collect(kept)
        report = (pair.reals, kept, accepted, jnp.any(jnp.stack(changes), axis=0))
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
        with saying("in draw, which is called with a key, trajectory, observations and model"):
            observations = self.joint.series.observations
            drawn = cast(Draw, self.draw)(key, trajectory, observations, filter.model)
        if not isinstance(drawn, Mapping) or set(drawn) != set(reals):
            names = sorted(drawn) if isinstance(drawn, Mapping) else shown(drawn)
            raise ValueError(f"draw: it gave {names}, no values by the names {sorted(reals)}")
        moved = {}
        for name, transform in self.problem.transforms.items():
            value, present = jnp.asarray(drawn[name]), transform.constrain(reals[name])
            if value.shape != present.shape:
                raise ValueError(
                    f"draw: {name} of shape {value.shape}, where the parameter's is {present.shape}"
                )
            moved[name] = transform.unconstrain(value.astype(present.dtype))
        return moved

    def _metropolis(
        self, key: Key[Array, ""], reals: Reals, trajectory: PyTree, walk: RandomWalk
    ) -> tuple[Reals, Float[Array, ""], dict[str, Array]]:
        """Steps of the random walk on the parameters given the trajectory."""
        prior = cast(Prior, self.prior)

        def log_density(reals: Reals) -> tuple[Array, dict[str, Array]]:
            log_prior, log_joint = prior(reals), self.joint(trajectory, self.problem.at(reals))
            has_prior = (log_prior > -jnp.inf) & (log_prior < jnp.inf)
            # Where the prior is zero, the likelihood may not even be defined.
            density = jnp.where(has_prior, log_prior + number_or_zero(log_joint), -jnp.inf)
            invalid = {
                "log_prior": is_invalid(log_prior),
                "log_joint": has_prior & is_invalid(log_joint),
            }
            return density, invalid

        def move(place: tuple[Reals, Array], key: Key[Array, ""]) -> tuple[tuple, tuple]:
            reals, current = place
            key_walk, key_accept = jax.random.split(key)
            proposed = walk.propose(key_walk, reals)
            new, invalid = log_density(proposed)
            accepted = accepts(key_accept, new - current)
            return chosen(accepted, (proposed, new), place), (accepted, invalid)

        keys = jax.random.split(key, self.num_metropolis_steps)
        place = (reals, log_density(reals)[0])
        (reals, _), (accepted, invalid) = jax.lax.scan(move, place, keys)
        counts = jax.tree.map(lambda some: jnp.sum(some, dtype=jnp.int32), invalid)
        return reals, jnp.mean(accepted.astype(jnp.result_type(float))), counts


def _check_draw(kernel: _Kernel, start: Reals) -> None:
    """Raise a `ValueError` for a draw of other names or shapes, before anything compiles."""
    length = kernel.joint.series.length + 1
    key, model = jax.random.key(0), kernel.problem.at(start).model
    states = jax.eval_shape(lambda key: sample_initial(key, model, 1), key)
    trajectory = jax.tree.map(
        lambda state: jax.ShapeDtypeStruct((length, *state.shape[1:]), state.dtype), states
    )
    jax.eval_shape(lambda *arguments: kernel.drawn(*arguments), key, start, trajectory)
