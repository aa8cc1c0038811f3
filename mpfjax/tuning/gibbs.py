"""The posterior of parameters and states together, by particle Gibbs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
from mpfjax.filter import Filter, sample_initial
from mpfjax.models.base import require
from mpfjax.observations import Series, as_arrays, present_steps
from mpfjax.running.scan import scan_filter
from mpfjax.smoothing.conditional import check_conditional, draw_trajectory, renew
from mpfjax.tuning.chains import (
    BROKEN,
    Prior,
    checked_deviations,
    checked_prior,
    constrained,
    is_broken,
    take_steps,
    walk,
)
from mpfjax.tuning.problem import Parameters, Problem, Reals, pose_filter
from mpfjax.tuning.transforms import AbstractTransform

Draw = Callable[[Key[Array, ""], PyTree, PyTree, Any], Mapping[str, Any]]


@dataclass(frozen=True)
class GibbsPosterior:
    """The chains of `particle_gibbs`, without their starts."""

    parameters: dict[str, np.ndarray]
    """by name, on their own scale: shape (chains, steps, ...)."""
    trajectories: PyTree
    """x_0, ..., x_t of every step, leaves (chains, steps, t + 1, ...), or what `collect` made."""
    accepted: Float[np.ndarray, "chains steps"]
    """the share of Metropolis steps that moved; 1 where the parameters are drawn."""
    renewed: Bool[np.ndarray, "chains steps times"]
    """which states of the trajectory changed in each step."""
    stopped: str | None
    """why they ended before `num_steps`, or None."""

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
    log_prior: Callable[[dict[str, Array]], Float[Array, ""]] | None = None,
    proposal_deviations: float | Mapping[str, Any] = 0.1,
    num_metropolis_steps: int = 5,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
    num_chains: int = 1,
    backward: bool = True,
    collect: Callable[[PyTree], PyTree] | None = None,
    missing: str = "error",
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
    - `num_chains`: all start at the filter's own parameters, each at a trajectory of its own, and
      run under one vmap. Drop their first steps.
    - `backward`: as for `conditional_filter`.
    - `collect`: a function of one trajectory, for what to keep of it; None keeps all.
    - `observations`: one sequence. `parameters`, `transforms`, `missing`: as for `fit`. Parameters
      are usually the model's; those of a proposal have no posterior.

    At a NaN or +inf the chains end with a warning, the steps so far, and the step in `stopped`.
    Raises `ValueError` for both or none of `draw` and `log_prior`, a draw of other names or shapes
    than the parameters, a list of sequences, and what `conditional_filter` and `fit` do;
    `RuntimeError` where the start has no likelihood.

    Use it where the trajectory makes the parameters' distribution simple, or long sequences make
    `metropolis_hastings` reject nearly all. If θ and the trajectory fix each other, as a small
    noise of the dynamics does, steps are short and `metropolis_hastings` is better.
    """
    check_key(key)
    check_type(Filter, "a filter", filter=filter)
    check_whole(
        num_steps=num_steps, num_chains=num_chains, num_metropolis_steps=num_metropolis_steps
    )
    check_flag(backward=backward, progress=progress)
    check_callable("a function of a trajectory", **given(collect=collect))
    what = "a function of a key, a trajectory, observations and a model"
    check_callable(what, **given(draw=draw))
    check_callable("a function of the parameters by name", **given(log_prior=log_prior))
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
    present = present_steps(observations, missing, filter.model)
    observations = as_arrays(observations)
    joint = LogJoint(observations, present)
    problem = pose_filter(filter, joint, parameters, transforms)
    start = problem.start()
    prior, deviations = None, {}
    if log_prior is not None:
        for density in ("log_transition", "log_initial"):
            require(filter.model, density, "particle_gibbs with log_prior")
        deviations = checked_deviations(proposal_deviations, start)
        prior = checked_prior(log_prior, problem, start, "at the start")
    sampler = _Sampler(problem, joint, prior, deviations, draw, num_metropolis_steps, backward)
    if draw is not None:
        _check_draw(sampler, start)
    key_start, key_steps = jax.random.split(key)
    try:
        states = _starts(sampler, jax.random.split(key_start, num_chains), start)
    except RuntimeError as error:
        if not is_broken(error):
            raise
        raise RuntimeError(f"particle_gibbs: {BROKEN} at the start") from error
    advance = eqx.Partial(_advance, sampler, collect)
    (reals, kept, accepted, renewed), stopped = take_steps(
        "particle_gibbs", advance, states, key_steps, num_steps, num_chains, progress
    )
    return GibbsPosterior(constrained(problem, reals), kept, accepted, renewed, stopped)


class LogJoint(eqx.Module):
    """log p(x_0, ..., x_t, y_1, ..., y_t | θ) of a trajectory and the observations there are."""

    observations: PyTree
    present: Bool[Array, " t"] | None

    def __call__(self, trajectory: PyTree, filter: Filter) -> Float[Array, ""]:
        """With the parameters of the filter's model."""
        model: Any = filter.model
        start, before, after = (
            jax.tree.map(lambda leaf, cut=cut: leaf[cut], trajectory)
            for cut in (slice(0, 1), slice(None, -1), slice(1, None))
        )

        def log_likelihood(observation: PyTree, state: PyTree) -> Float[Array, ""]:
            one = jax.tree.map(lambda leaf: leaf[None], state)
            return model.log_likelihood(observation, one)[0]

        seen = jax.vmap(log_likelihood)(self.observations, after)
        if self.present is not None:
            seen = jnp.where(self.present, seen, 0.0)
        steps = jnp.sum(model.log_transition(after, before))
        return model.log_initial(start)[0] + steps + jnp.sum(seen)


class _Sampler(eqx.Module):
    """One step of a chain: the parameters, then the trajectory."""

    problem: Problem
    joint: LogJoint
    prior: Prior | None
    deviations: Reals
    draw: Draw | None
    num_metropolis_steps: int = eqx.field(static=True)
    backward: bool = eqx.field(static=True)

    def start(self, key: Key[Array, ""], reals: Reals) -> PyTree:
        """A trajectory of an ordinary run."""
        key_run, key_back = jax.random.split(key)
        filter = self.problem.at(reals)
        run = scan_filter(key_run, filter, self.joint.observations, self.joint.present, None)
        nothing = ~jnp.all(jnp.isfinite(run.log_likelihood_increments))
        drawn = draw_trajectory(key_back, filter.model, run, None, self.backward)
        return eqx.error_if(drawn, nothing, BROKEN)

    def step(
        self, key: Key[Array, ""], reals: Reals, trajectory: PyTree
    ) -> tuple[Reals, PyTree, Float[Array, ""], Bool[Array, " times"]]:
        """The next pair, the share of Metropolis steps that moved, and which states changed."""
        key_parameters, key_trajectory = jax.random.split(key)
        if self.draw is None:
            reals, accepted = self._metropolis(key_parameters, reals, trajectory)
        else:
            reals = self.drawn(key_parameters, reals, trajectory)
            accepted = jnp.ones(())
        filter = self.problem.at(reals)
        observations, present = self.joint.observations, self.joint.present
        found = renew(
            key_trajectory, filter, Series(observations, present), trajectory, self.backward
        )
        broken = ~jnp.all(found.run.log_likelihood_increments < jnp.inf) | ~jnp.all(found.possible)
        changes = [
            jnp.any((new != old).reshape(new.shape[0], -1), axis=1)
            for new, old in zip(
                jax.tree.leaves(found.trajectory), jax.tree.leaves(trajectory), strict=True
            )
        ]
        renewed = jnp.any(jnp.stack(changes), axis=0)
        return eqx.error_if((reals, found.trajectory, accepted, renewed), broken, BROKEN)

    def drawn(self, key: Key[Array, ""], reals: Reals, trajectory: PyTree) -> Reals:
        """The user's draw, in unconstrained numbers."""
        filter = self.problem.at(reals)
        with saying("in draw, which is called with a key, trajectory, observations and model"):
            drawn = cast(Draw, self.draw)(key, trajectory, self.joint.observations, filter.model)
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
        self, key: Key[Array, ""], reals: Reals, trajectory: PyTree
    ) -> tuple[Reals, Float[Array, ""]]:
        """Steps of a random walk on the parameters given the trajectory."""
        prior = cast(Prior, self.prior)

        def log_density(reals: Reals) -> Float[Array, ""]:
            log_prior = prior(reals)
            # Where the prior is zero, the likelihood may not even be defined.
            log_joint = self.joint(trajectory, self.problem.at(reals))
            density = log_prior + jnp.where(log_prior == -jnp.inf, 0.0, log_joint)
            return eqx.error_if(density, ~(density < jnp.inf), BROKEN)

        def move(
            place: tuple[Reals, Array], key: Key[Array, ""]
        ) -> tuple[tuple[Reals, Array], Array]:
            reals, current = place
            key_walk, key_accept = jax.random.split(key)
            proposed = walk(key_walk, reals, self.deviations)
            new = log_density(proposed)
            accepted = jnp.log(jax.random.uniform(key_accept, (), new.dtype)) < new - current
            choose = lambda after, before: jnp.where(accepted, after, before)  # noqa: E731
            return jax.tree.map(choose, (proposed, new), place), accepted

        keys = jax.random.split(key, self.num_metropolis_steps)
        (reals, _), accepted = jax.lax.scan(move, (reals, log_density(reals)), keys)
        return reals, jnp.mean(accepted.astype(jnp.result_type(float)))


def _check_draw(sampler: _Sampler, start: Reals) -> None:
    """Raise a `ValueError` for a draw of other names or shapes, before anything compiles."""
    length = jax.tree.leaves(sampler.joint.observations)[0].shape[0] + 1
    key, model = jax.random.key(0), sampler.problem.at(start).model
    states = jax.eval_shape(lambda key: sample_initial(key, model, 1), key)
    trajectory = jax.tree.map(
        lambda state: jax.ShapeDtypeStruct((length, *state.shape[1:]), state.dtype), states
    )
    jax.eval_shape(lambda *arguments: sampler.drawn(*arguments), key, start, trajectory)


@eqx.filter_jit
def _starts(sampler: _Sampler, keys: Key[Array, " chains"], start: Reals) -> tuple[Reals, PyTree]:
    """The filter's own parameters, and a trajectory, for each chain."""
    reals = jax.tree.map(lambda u: jnp.broadcast_to(u, (keys.shape[0], *u.shape)), start)
    return reals, jax.vmap(sampler.start)(keys, reals)


@eqx.filter_jit
def _advance(
    sampler: _Sampler,
    collect: Callable[[PyTree], PyTree] | None,
    keys: Key[Array, " chains"],
    states: tuple[Reals, PyTree],
) -> tuple[tuple[Reals, PyTree], PyTree]:
    """One step of all chains, and what is kept of it."""
    reals, trajectories, accepted, renewed = jax.vmap(sampler.step)(keys, *states)
    kept = trajectories
    if collect is not None:
        with saying("in collect, which is called with a trajectory"):
            kept = jax.vmap(collect)(trajectories)
    return (reals, trajectories), (reals, kept, accepted, renewed)
