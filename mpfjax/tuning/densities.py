"""The log density of parameters in unconstrained numbers, for samplers: our own and others'."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import check_callable, shown
from mpfjax.filter import Filter
from mpfjax.tuning.evidence import check_exact, pose_evidence
from mpfjax.tuning.problem import Parameters, Problem, Reals
from mpfjax.tuning.transforms import AbstractTransform

LogPrior = Callable[[dict[str, Array]], Float[Array, ""]]
SamplePrior = Callable[[Key[Array, ""]], Mapping[str, Array]]


class Prior(eqx.Module):
    """log p(θ) + log |∂θ/∂u|, of parameters in unconstrained numbers u."""

    function: LogPrior
    transforms: dict[str, AbstractTransform]

    def __call__(self, reals: Reals) -> Float[Array, ""]:
        """The log density, up to the constant that the function leaves out."""
        density = self.function(
            {name: self.transforms[name].constrain(u) for name, u in reals.items()}
        )
        for name, u in reals.items():
            density += self.transforms[name].log_jacobian(u)
        return density


class Evaluated(NamedTuple):
    """The log density at one point, in its two parts."""

    log_prior: Float[Array, "*chains"]
    """with the Jacobian; -inf where it is zero or no number."""
    log_likelihood: Float[Array, "*chains"]
    """-inf where it is zero, no number, or where the prior is zero."""
    invalid: dict[str, Bool[Array, "*chains"]]
    """which of the two was NaN or +inf."""

    @property
    def log_density(self) -> Float[Array, "*chains"]:
        """Their sum."""
        return self.log_prior + self.log_likelihood


def evaluated(
    log_prior: Float[Array, ""],
    log_likelihood: Float[Array, ""],
    name: str = "log_marginal_likelihood",
) -> Evaluated:
    """The two parts as numbers or -inf, and which of them was not a number, by name."""
    has_prior = (log_prior > -jnp.inf) & (log_prior < jnp.inf)
    # Where the prior is zero, the likelihood may not even be defined.
    invalid = {"log_prior": is_invalid(log_prior), name: has_prior & is_invalid(log_likelihood)}
    log_likelihood = jnp.where(has_prior, number_or_zero(log_likelihood), -jnp.inf)
    return Evaluated(number_or_zero(log_prior), log_likelihood, invalid)


class LogDensity(eqx.Module):
    """log p(θ) + log |∂θ/∂u| + log Ẑ(θ; key), a function of unconstrained numbers u by name.

    `log_density` makes it. JAX can transform it: jit, vmap over u and keys, and gradients, those of
    the filter's moves.
    """

    problem: Problem
    prior: Prior

    def __call__(self, reals: Reals, key: Key[Array, ""]) -> Float[Array, ""]:
        """The log density up to a constant; -inf where a part of it is NaN or +inf."""
        return self.evaluated(reals, key).log_density

    def evaluated(self, reals: Reals, key: Key[Array, ""]) -> Evaluated:
        """Its two parts, and whether they are numbers."""
        return evaluated(self.prior(reals), self.problem.value(reals, key))

    @property
    def start(self) -> Reals:
        """u of the filter's own parameters."""
        return self.problem.start()

    def constrain(self, reals: Reals) -> dict[str, Array]:
        """The parameters by name, on their own scale."""
        return self.problem.constrain(reals)

    def unconstrain(self, parameters: Mapping[str, Any]) -> Reals:
        """u of parameters by name."""
        return self.problem.unconstrain(parameters, "parameters")

    def filter_at(self, reals: Reals) -> Filter:
        """The filter with these parameters."""
        return self.problem.at(reals)


def log_density(
    filter: Filter,
    observations: PyTree,
    *,
    log_prior: LogPrior,
    parameters: Parameters = None,
    transforms: Mapping[str, AbstractTransform] | None = None,
) -> LogDensity:
    """The posterior's log density in unconstrained numbers, for samplers of other libraries.

    `density(u, key)` is log p(θ) + log |∂θ/∂u| + log Ẑ(θ; key), with θ = `density.constrain(u)`.
    Start at `density.start`.

    - With a fresh key for every proposal, and the value kept of the state that a chain is at, a
      Metropolis sampler has exactly the posterior (Andrieu and Roberts 2009), as
      `metropolis_hastings` has: log Ẑ must never be estimated again at the same state.
    - With one key for all calls it is a fixed function of u, for samplers by gradient such as
      NUTS. Their posterior then has the error of this one estimate, which falls as N grows. A
      filter that resamples is not continuous in u: build it with `gradient="stop"`, and take many
      particles.

    The arguments are those of `metropolis_hastings`. Raises `ValueError` where it does. Use it with
    blackjax as `partial(density, key=key)`, with numpyro as
    `potential_fn=lambda u: -density(u, key)`.
    """
    check_exact(filter, "likelihood")
    problem = pose_evidence(filter, observations, parameters, transforms)
    return LogDensity(problem, checked_prior(log_prior, problem, problem.start(), "at the start"))


def checked_prior(log_prior: Any, problem: Problem, at: Reals, where: str) -> Prior:
    """The prior; a `ValueError` for one that is no finite number at some point."""
    check_callable("a function of the parameters by name", log_prior=log_prior)
    density = log_prior(problem.constrain(at))
    is_number = eqx.is_array_like(density) and jnp.ndim(density) == 0
    if not is_number or not jnp.issubdtype(jnp.result_type(density), jnp.floating):
        raise ValueError(f"log_prior: {shown(density)} {where} is no floating point number")
    prior = Prior(log_prior, problem.transforms)
    value = float(prior(at))
    if not np.isfinite(value):
        raise ValueError(f"log_prior: {value} {where}")
    return prior


def drawn(key: Key[Array, ""], problem: Problem, sample_prior: SamplePrior, num: int) -> Reals:
    """Draws of the prior in unconstrained numbers, leaves (num, ...)."""
    check_callable("a function of a key", sample_prior=sample_prior)
    keys = jax.random.split(key, num)
    # By the way, the names and shapes are checked.
    problem.unconstrain(sample_prior(keys[0]), "sample_prior")
    draws, reals = jax.vmap(sample_prior)(keys), {}
    for name, index in problem.tuned:
        values, transform = jnp.asarray(draws[name]), problem.transforms[name]
        if not transform.contains(np.asarray(values)):
            kind = type(transform).__name__
            raise ValueError(f"sample_prior: a draw of {name} is outside {kind}'s domain")
        values = values.astype(problem.leaves[index].dtype)
        reals[name] = jax.vmap(transform.unconstrain)(values)
    return reals


def is_invalid(log_density: Float[Array, "*n"]) -> Bool[Array, "*n"]:
    """Whether a log density is no number: NaN or +inf."""
    return ~(log_density < jnp.inf)


def number_or_zero(log_density: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """A log density, -inf where it is no number."""
    return jnp.where(is_invalid(log_density), -jnp.inf, log_density)


def chosen(accepted: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    """One of two states."""
    return jax.tree.map(lambda after, before: jnp.where(accepted, after, before), new, old)
