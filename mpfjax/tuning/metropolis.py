"""The posterior of a filter's parameters, by particle marginal Metropolis-Hastings."""

import importlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree
from tqdm import tqdm

from mpfjax.checks import (
    check_callable,
    check_flag,
    check_key,
    check_type,
    check_whole,
    shown,
)
from mpfjax.filter import Filter
from mpfjax.tuning.problem import Parameters, Problem, pose_evidence
from mpfjax.tuning.transforms import AbstractTransform

_BROKEN = "the log prior or log marginal likelihood was NaN or inf"


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
    chain = _Chain(problem, log_prior, _deviations(proposal_deviations, start))
    prior = _checked_prior(chain, start)
    if not np.isfinite(prior):
        raise ValueError(f"log_prior: {prior} at the start")
    key_start, key_steps = jax.random.split(key)
    positions = {
        "reals": jax.tree.map(lambda u: jnp.broadcast_to(u, (num_chains, *u.shape)), start),
        "key": jax.random.key_data(jax.random.split(key_start, num_chains)),
    }
    init, advance = _kernels(blackjax, chain)
    states = init(positions)
    if not np.isfinite(states.logdensity).all():
        raise RuntimeError(f"metropolis_hastings: {_BROKEN} at the start")
    path, accepted, stopped = [], [], None
    for step in tqdm(range(num_steps), disable=not progress, unit="step"):
        keys = jax.random.split(jax.random.fold_in(key_steps, step), num_chains)
        try:
            states, moved = advance(keys, states)
            accepted.append(np.asarray(moved))
        except RuntimeError as error:
            if _BROKEN not in str(error):
                raise
            stopped = f"{_BROKEN} at step {step}"
            warnings.warn(f"metropolis_hastings: {stopped}", stacklevel=2)
            break
        path.append(jax.tree.map(np.asarray, (states.position["reals"], states.logdensity)))
    if not path:
        raise RuntimeError(f"metropolis_hastings: {_BROKEN} in the first step")
    reals, densities = jax.tree.map(lambda *rows: np.stack(rows, axis=1), *path)
    priors = jax.vmap(jax.vmap(chain.log_prior_density))(jax.tree.map(jnp.asarray, reals))
    return Posterior(
        parameters={
            name: np.asarray(jax.vmap(jax.vmap(problem.transforms[name].constrain))(jnp.asarray(u)))
            for name, u in reals.items()
        },
        log_marginal_likelihoods=densities - np.asarray(priors),
        accepted=np.stack(accepted, axis=1),
        stopped=stopped,
    )


class _Chain(eqx.Module):
    """The target on pairs of unconstrained numbers and a key, and its proposal."""

    problem: Problem
    prior: Callable[[dict[str, Array]], Float[Array, ""]]
    deviations: dict[str, Array]

    def log_prior_density(self, reals: dict[str, Array]) -> Float[Array, ""]:
        """log p(θ) + log |∂θ/∂u|."""
        transforms = self.problem.transforms
        density = self.prior({name: transforms[name].constrain(u) for name, u in reals.items()})
        for name, u in reals.items():
            density += transforms[name].log_jacobian(u)
        return density

    def log_density(self, position: dict[str, Any]) -> Float[Array, ""]:
        """Of a pair, up to a constant; an error where it is neither a number nor -inf."""
        reals, key = position["reals"], jax.random.wrap_key_data(position["key"])
        prior = self.log_prior_density(reals)
        # Where the prior is zero, the likelihood may not even be defined.
        evidence = jnp.where(prior == -jnp.inf, 0.0, self.problem.value(reals, key))
        density = prior + evidence
        return eqx.error_if(density, ~(density < jnp.inf), _BROKEN)

    def propose(self, key: Array, position: dict[str, Any]) -> dict[str, Any]:
        """A Gaussian step in u, and a fresh key."""
        key_walk, key_fresh = jax.random.split(key)
        names = sorted(position["reals"])
        reals = {}
        for name, key_of in zip(names, jax.random.split(key_walk, len(names)), strict=True):
            u = position["reals"][name]
            reals[name] = u + self.deviations[name] * jax.random.normal(key_of, u.shape, u.dtype)
        return {"reals": reals, "key": jax.random.key_data(key_fresh)}


def _checked_prior(chain: _Chain, start: dict[str, Array]) -> float:
    """The log density at the start, of a prior that is a number."""
    values = {name: chain.problem.transforms[name].constrain(u) for name, u in start.items()}
    density = chain.prior(values)
    is_number = eqx.is_array_like(density) and jnp.ndim(density) == 0
    if not is_number or not jnp.issubdtype(jnp.result_type(density), jnp.floating):
        raise ValueError(f"log_prior: {shown(density)} at the start is no floating point number")
    return float(chain.log_prior_density(start))


def _kernels(blackjax: ModuleType, chain: _Chain) -> tuple[Callable, Callable]:
    """The first states, and one step, of all chains."""

    def sampler(chain: _Chain) -> Any:
        return blackjax.rmh(chain.log_density, chain.propose)

    @eqx.filter_jit
    def init(chain: _Chain, positions: Any) -> Any:
        return jax.vmap(sampler(chain).init)(positions)

    @eqx.filter_jit
    def advance(chain: _Chain, keys: Array, states: Any) -> tuple[Any, Array]:
        states, info = jax.vmap(sampler(chain).step)(keys, states)
        return states, info.is_accepted

    return eqx.Partial(init, chain), eqx.Partial(advance, chain)


def _deviations(given: float | Mapping[str, Any], start: dict[str, Array]) -> dict[str, Array]:
    by_name = given if isinstance(given, Mapping) else dict.fromkeys(start, given)
    if set(by_name) != set(start):
        raise ValueError(f"proposal_deviations: those of {sorted(by_name)}, not of {sorted(start)}")
    deviations = {}
    for name, u in start.items():
        try:
            value = np.asarray(by_name[name], float)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"proposal_deviations: {shown(by_name[name])} of {name} is no number"
            ) from error
        if not (np.isfinite(value).all() and (value > 0).all()):
            raise ValueError(f"proposal_deviations: {value} of {name} is not positive")
        if value.shape not in ((), u.shape):
            raise ValueError(
                f"proposal_deviations: shape {value.shape} of {name} is neither () nor {u.shape}"
            )
        deviations[name] = jnp.broadcast_to(jnp.asarray(value, u.dtype), u.shape)
    return deviations


def _blackjax() -> ModuleType:
    try:
        return importlib.import_module("blackjax")
    except ImportError as error:
        raise ImportError(
            'metropolis_hastings needs blackjax: pip install "mpfjax[mcmc]"'
        ) from error
