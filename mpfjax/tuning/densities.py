"""The log density of parameters in unconstrained numbers, for samplers: our own and others'."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.checks import checked, shown
from mpfjax.tuning.bijections import AbstractTransform
from mpfjax.tuning.evidence import UnbiasedFilter, pose_evidence
from mpfjax.tuning.problem import Parameters, Problem, Reals, Transforms

LogPrior = Callable[[dict[str, Array]], Float[Array, ""] | float]
SamplePrior = Callable[[Key[Array, ""]], Mapping[str, Array]]


class Prior(eqx.Module):
    """log p(θ) + log |∂θ/∂u|, of parameters in unconstrained numbers u."""

    function: LogPrior
    transforms: dict[str, AbstractTransform]

    def __call__(self, reals: Reals) -> Float[Array, ""]:
        """The log density, up to the constant that the function leaves out."""
        density = jnp.asarray(
            self.function({name: self.transforms[name].constrain(u) for name, u in reals.items()})
        )
        for name, u in reals.items():
            density += self.transforms[name].log_jacobian(u)
        return density


class Point(eqx.Module):
    """Parameters, and their log density in its two parts."""

    reals: Reals
    log_prior: Float[Array, "*n"]  # with the Jacobian; -inf where it is zero or no number
    log_likelihood: Float[Array, "*n"]  # -inf where it is no number, or either is zero
    mixture: PyTree = None  # where their filter stands, for samplers that go on with it
    key_data: Array | None = None  # of the key of their filter's run, for what makes it again

    @property
    def log_density(self) -> Float[Array, "*n"]:
        """Their sum."""
        return self.log_prior + self.log_likelihood


def evaluated(
    reals: Reals,
    log_prior: Float[Array, ""],
    log_likelihood: Float[Array, ""],
    name: str = "log_marginal_likelihood",
) -> tuple[Point, dict[str, Bool[Array, ""]]]:
    """The point with these log densities, and which of them was NaN or +inf, by name."""
    has_prior = (log_prior > -jnp.inf) & (log_prior < jnp.inf)
    # Where the prior is zero, the likelihood may not even be defined.
    invalid = {"log_prior": is_invalid(log_prior), name: has_prior & is_invalid(log_likelihood)}
    log_likelihood = jnp.where(has_prior, number_or_zero(log_likelihood), -jnp.inf)
    return Point(reals, number_or_zero(log_prior), log_likelihood), invalid


class LogDensity(eqx.Module):
    """log p(θ) + log |∂θ/∂u| + log Ẑ(θ; key), a function of unconstrained numbers u by name.

    `log_density` makes it. JAX can transform it: jit, vmap over u and keys, and gradients, those of
    the filter's moves.
    """

    problem: Problem
    prior: Prior

    def __call__(self, reals: Reals, key: Key[Array, ""]) -> Float[Array, ""]:
        """The log density up to a constant; -inf where a part of it is NaN or +inf."""
        return self.evaluated(key, reals)[0].log_density

    def evaluated(
        self, key: Key[Array, ""], reals: Reals
    ) -> tuple[Point, dict[str, Bool[Array, ""]]]:
        """Its two parts, and which of them are no numbers."""
        point, invalid = evaluated(reals, self.prior(reals), self.problem.value(key, reals))
        return dataclasses.replace(point, key_data=jax.random.key_data(key)), invalid

    @property
    def start(self) -> Reals:
        """u of the filter's own parameters."""
        return self.problem.start()

    def constrain(self, reals: Reals) -> dict[str, Array]:
        """The parameters by name, on their own scale."""
        return self.problem.constrain(reals)


@checked
def log_density(
    filter: UnbiasedFilter,
    observations: PyTree,
    *,
    log_prior: LogPrior,
    parameters: Parameters = None,
    transforms: Transforms = None,
) -> LogDensity:
    """The posterior's log density in unconstrained coordinates, for samplers of other libraries.

    `density(u, key)` is log p(θ) + log |∂θ/∂u| + log Ẑ(θ; key), with θ = `density.constrain(u)`.
    Start at `density.start`.

    - With a new key for every proposal, and a stored value for the current state of the chain, a
      Metropolis sampler has exactly the posterior (Andrieu and Roberts 2009), like
      `metropolis_hastings`: log Ẑ must never be estimated again at the same state.
    - With one key for all calls it is a fixed function of u, for samplers by gradient such as NUTS.
      Their posterior then has the error of this single estimate, which decreases as N grows. A
      filter that resamples is not continuous in u: build it with `gradient="stop"`, and use many
      particles.

    The arguments are those of `metropolis_hastings`. Raises `ValueError` in the same cases. Use it
    with blackjax as `partial(density, key=key)`, with numpyro as `potential_fn=lambda u:
    -density(u, key)`.
    """
    problem = pose_evidence(filter, observations, parameters, transforms)
    return LogDensity(problem, checked_prior(log_prior, problem))


def checked_prior(
    log_prior: LogPrior,
    problem: Problem,
    key: Key[Array, ""] | None = None,
    sample_prior: SamplePrior | None = None,
) -> Prior:
    """The prior; a `ValueError` for one that is no finite number where its parameters start."""
    at, where = problem.start(), "the start"
    if sample_prior is not None:
        draws = drawn(cast(Any, key), problem, sample_prior, 1)
        at, where = jax.tree.map(lambda u: u[0], draws), "a draw of sample_prior"
    density = log_prior(problem.constrain(at))
    shape = () if isinstance(density, int | float) else getattr(density, "shape", None)
    if shape != ():
        raise ValueError(f"log_prior: {shown(density)} at {where} is no floating point number")
    prior = Prior(log_prior, problem.transforms)
    if not np.isfinite(value := float(prior(at))):
        raise ValueError(f"log_prior: {value} at {where}")
    return prior


def drawn(key: Key[Array, ""], problem: Problem, sample_prior: SamplePrior, num: int) -> Reals:
    """Draws of the prior in unconstrained numbers, leaves (num, ...)."""
    draws: Any = jax.vmap(sample_prior)(jax.random.split(key, num))
    reals = jax.vmap(lambda draw: problem.unconstrain(draw, "sample_prior"))(draws)
    problem.require_inside(draws, "sample_prior")
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
