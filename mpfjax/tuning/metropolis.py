"""The posterior of a filter's parameters, by particle marginal Metropolis-Hastings."""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import check_callable, check_flag, check_key, check_type, check_whole
from mpfjax.filter import Filter
from mpfjax.tuning.chains import (
    BROKEN,
    Prior,
    checked_deviations,
    checked_prior,
    constrained,
    take_steps,
    walk,
)
from mpfjax.tuning.problem import Parameters, Problem, Reals, pose_evidence
from mpfjax.tuning.transforms import AbstractTransform


@dataclass(frozen=True)
class Posterior:
    """The chains of `metropolis_hastings`, without their starts."""

    parameters: dict[str, np.ndarray]
    """by name, on their own scale: shape (chains, steps, ...)."""
    log_marginal_likelihoods: Float[np.ndarray, "chains steps"]
    """log Ẑ of every state, summed over sequences."""
    accepted: Bool[np.ndarray, "chains steps"]
    """which steps moved."""
    stopped: str | None
    """why they ended before `num_steps`, or None."""

    @property
    def acceptance_rate(self) -> float:
        """The share of steps that moved."""
        return float(self.accepted.mean())


def metropolis_hastings(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    num_steps: int,
    *,
    log_prior: Callable[[dict[str, Array]], Float[Array, ""]],
    proposal_deviations: float | Mapping[str, Any] = 0.1,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
    num_chains: int = 1,
    missing: str = "error",
    progress: bool = True,
) -> Posterior:
    """Sample p(θ | y_1..y_t) with the filter's estimate Ẑ(θ) in place of the likelihood.

    Particle marginal Metropolis-Hastings (Andrieu, Doucet and Holenstein 2010, section 2.4.2), by
    blackjax's Rosenbluth-Metropolis-Hastings on pairs (u, key). u is θ in unconstrained numbers. A
    Gaussian random walk proposes u, and the key is always new. The log density of a pair,

        log p(θ) + log |∂θ/∂u| + log Ẑ(θ; key),

    is a function of the pair, and Ẑ is unbiased. So θ has exactly the posterior distribution,
    whatever the number of particles. With too few particles, chains stay at one state for long.
    Aim at a standard deviation of log Ẑ of about one (Doucet et al. 2015), and an acceptance of 10
    to 40%. No derivative is taken, so `gradient` does not matter. Use it where a point and its
    standard errors are not enough: with few observations, or posteriors that are skewed or have
    several modes.

    - `log_prior`: a function of the parameters by name, on their own scale, up to a constant; -inf
      where the prior is zero.
    - `proposal_deviations`: of the random walk, in unconstrained numbers: one for all, or by name,
      each a number or of the parameter's unconstrained shape. 2.4 / sqrt(d) standard errors is a
      good start.
    - `num_chains`: all start at the filter's own parameters, and run under one vmap. Drop their
      first steps.
    - `observations`, `parameters`, `transforms`, `missing`: as for `fit`.

    At a NaN or +inf the chains end with a warning, the states so far, and the step in `stopped`.
    Raises `ImportError` where blackjax is missing, `ValueError` for numbers below one, deviations
    that are not positive or of unknown parameters, a filter that is `approximate`, a prior that is
    no number, a start without one, and what `fit` does; `RuntimeError` where the start has no
    likelihood.
    """
    check_key(key)
    check_type(Filter, "a filter", filter=filter)
    check_whole(1, num_steps=num_steps, num_chains=num_chains)
    check_callable("a function of the parameters by name", log_prior=log_prior)
    check_flag(progress=progress)
    if filter.approximate:
        raise ValueError(
            "filter: an approximate one has no unbiased likelihood, and no exact chain"
        )
    blackjax = _blackjax()
    problem = pose_evidence(filter, observations, parameters, transforms, missing)
    start = problem.start()
    deviations = checked_deviations(proposal_deviations, start)
    chain = _Chain(problem, checked_prior(log_prior, problem, start, "at the start"), deviations)
    key_start, key_steps = jax.random.split(key)
    positions = {
        "reals": jax.tree.map(lambda u: jnp.broadcast_to(u, (num_chains, *u.shape)), start),
        "key": jax.random.key_data(jax.random.split(key_start, num_chains)),
    }
    init, advance = _kernels(blackjax, chain)
    states = init(positions)
    if not np.isfinite(states.logdensity).all():
        raise RuntimeError(f"metropolis_hastings: {BROKEN} at the start")
    (reals, densities, accepted), stopped = take_steps(
        "metropolis_hastings", advance, states, key_steps, num_steps, num_chains, progress
    )
    priors = jax.vmap(jax.vmap(chain.prior))(jax.tree.map(jnp.asarray, reals))
    return Posterior(
        parameters=constrained(problem, reals),
        log_marginal_likelihoods=densities - np.asarray(priors),
        accepted=accepted,
        stopped=stopped,
    )


class _Chain(eqx.Module):
    """The target on pairs of unconstrained numbers and a key, and its proposal."""

    problem: Problem
    prior: Prior
    deviations: Reals

    def log_density(self, position: dict[str, Any]) -> Float[Array, ""]:
        """Of a pair, up to a constant; an error where it is neither a number nor -inf."""
        reals, key = position["reals"], jax.random.wrap_key_data(position["key"])
        prior = self.prior(reals)
        # Where the prior is zero, the likelihood may not even be defined.
        evidence = jnp.where(prior == -jnp.inf, 0.0, self.problem.value(reals, key))
        density = prior + evidence
        return eqx.error_if(density, ~(density < jnp.inf), BROKEN)

    def propose(self, key: Array, position: dict[str, Any]) -> dict[str, Any]:
        """A Gaussian step in u, and a fresh key."""
        key_walk, key_fresh = jax.random.split(key)
        reals = walk(key_walk, position["reals"], self.deviations)
        return {"reals": reals, "key": jax.random.key_data(key_fresh)}


def _kernels(blackjax: ModuleType, chain: _Chain) -> tuple[Callable, Callable]:
    """The first states, and one step, of all chains."""

    def sampler(chain: _Chain) -> Any:
        return blackjax.rmh(chain.log_density, chain.propose)

    @eqx.filter_jit
    def init(chain: _Chain, positions: Any) -> Any:
        return jax.vmap(sampler(chain).init)(positions)

    @eqx.filter_jit
    def advance(chain: _Chain, keys: Array, states: Any) -> tuple[Any, PyTree]:
        states, info = jax.vmap(sampler(chain).step)(keys, states)
        return states, (states.position["reals"], states.logdensity, info.is_accepted)

    return eqx.Partial(init, chain), eqx.Partial(advance, chain)


def _blackjax() -> ModuleType:
    try:
        return importlib.import_module("blackjax")
    except ImportError as error:
        raise ImportError(
            'metropolis_hastings needs blackjax: pip install "mpfjax[mcmc]"'
        ) from error
