"""The log density of parameters in unconstrained numbers, and random walks on it.

For samplers: our own and others'.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.arrays import POSITIVE
from mpfjax.checks import checked, saying, shown
from mpfjax.operations.matrices import cholesky
from mpfjax.operations.stored import select_rows
from mpfjax.tuning.bijections import AbstractTransform
from mpfjax.tuning.evidence import UnbiasedFilter, pose_evidence
from mpfjax.tuning.problem import Parameters, Problem, Reals, Transforms

# The best scale of a random walk in d dimensions is this over sqrt(d), times the target's own
# deviations (Gelman, Roberts and Gilks 1996).
_BEST_SCALE = 2.38
_LEARNING_EXPONENT = 0.6

LogPrior = Callable[[dict[str, Array]], Float[Array, ""] | float]
SamplePrior = Callable[[Key[Array, ""]], Mapping[str, Array]]


class Prior(eqx.Module):
    """log p(θ) + log |∂θ/∂u|, of parameters in unconstrained numbers u."""

    function: LogPrior
    transforms: dict[str, AbstractTransform]

    def __call__(self, reals: Reals) -> Float[Array, ""]:
        """The log density, up to the constant that the function leaves out."""
        values = {name: self.transforms[name].constrain(u) for name, u in reals.items()}
        volumes = (self.transforms[name].log_jacobian(u) for name, u in reals.items())
        return sum(volumes, jnp.asarray(self.function(values)))


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


Evaluated = tuple[Point, Bool[Array, ""]]
"""A point, and whether one of its log densities was NaN or +inf."""


def evaluated(reals: Reals, log_prior: Array, log_likelihood: Array) -> Evaluated:
    """The point with these log densities, and whether one of them was NaN or +inf."""
    # Where the prior is zero, the likelihood may not even be defined.
    has_prior = (log_prior > -jnp.inf) & (log_prior < jnp.inf)
    invalid = is_invalid(log_prior) | (has_prior & is_invalid(log_likelihood))
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

    def evaluated(self, key: Key[Array, ""], reals: Reals) -> Evaluated:
        """Its two parts, and whether one of them is no number."""
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


def require_same_prior(
    key: Key[Array, ""], problem: Problem, prior: Prior, sample_prior: SamplePrior
) -> None:
    """Raise a `ValueError` unless `sample_prior` draws from the prior.

    A Metropolis step by the prior then leaves the distribution of the draws as it is. Means of
    bounded functions of each number are compared, before and after it; a constant that the prior
    leaves out cancels.
    """
    num = 8192
    draws = drawn(key, problem, sample_prior, num)
    rows, log_priors, moved, after = map(np.asarray, _metropolis_step(key, prior, draws))
    if not np.isfinite(log_priors).all():
        return  # said elsewhere
    centre, scale = np.median(rows, axis=0), np.subtract(*np.quantile(rows, [0.75, 0.25], axis=0))
    shares = np.exp(np.minimum(np.where(np.isnan(after), -np.inf, after) - log_priors, 0.0))
    before, then = (np.tanh((each - centre) / scale) for each in (rows, moved))
    changes = shares[:, None] * np.hstack([then - before, then**2 - before**2])
    errors = changes.std(axis=0) / np.sqrt(num)
    if (np.abs(changes.mean(axis=0)) > 6.0 * errors).any():
        raise ValueError(
            "log_prior: it is not the log density of the draws of sample_prior: a Metropolis step"
            " by it changes their distribution; is a factor missing, such as 1 / θ for a normal log"
            " θ?"
        )


@eqx.filter_jit
def _metropolis_step(key: Key[Array, ""], prior: Prior, draws: Reals) -> tuple[Array, ...]:
    """Draws in rows and their log density, and the same of a proposal for each."""
    _, shaped = ravel_pytree(jax.tree.map(lambda u: u[0], draws))
    rows = jax.vmap(lambda reals: ravel_pytree(reals)[0])(draws)
    low, high = jnp.quantile(rows, jnp.array([0.25, 0.75]), axis=0)
    moved = rows + (high - low)[None] * jax.random.normal(key, rows.shape)
    before, after = (jax.vmap(lambda row: prior(shaped(row)))(each) for each in (rows, moved))
    return rows, before, moved, after


def is_invalid(log_density: Float[Array, "*n"]) -> Bool[Array, "*n"]:
    """Whether a log density is no number: NaN or +inf."""
    return ~(log_density < jnp.inf)


def number_or_zero(log_density: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """A log density, -inf where it is no number."""
    return jnp.where(is_invalid(log_density), -jnp.inf, log_density)


class RandomWalk(eqx.Module):
    """u + F z, z standard normal, with F Fᵀ from the covariance of a posterior.

    The numbers of u stand in the order of their names.
    """

    factor: Float[Array, "d d"]
    mean: Float[Array, " d"]
    covariance: Float[Array, "d d"]
    log_scale: Float[Array, ""]

    def adapted(
        self, points: Float[Array, "chains d"], step: Array, acceptance: Float[Array, ""] | None
    ) -> "RandomWalk":
        """The walk after one more point of each chain.

        Adaptive Metropolis (Haario, Saksman and Tamminen 2001) in the stochastic approximation of
        Andrieu and Thoms (2008, algorithm 4), with gains (step + 2)^-0.6. The scale follows the
        acceptance, where that is given; noise in a likelihood would drive it to zero.
        """
        gain = (jnp.asarray(step, points.dtype) + 2.0) ** -_LEARNING_EXPONENT
        centred = points - self.mean[None]
        mean = self.mean + gain * jnp.mean(centred, axis=0)
        spread = jnp.matmul(centred.T, centred, precision="highest") / points.shape[0]
        covariance = self.covariance + gain * (spread - self.covariance)
        log_scale = self.log_scale
        if acceptance is not None:
            # The share of steps that the best random walk accepts.
            best = 0.44 if points.shape[1] == 1 else 0.234
            log_scale = log_scale + gain * (acceptance - best)
        return RandomWalk(jnp.exp(log_scale) * factor_of(covariance), mean, covariance, log_scale)


def random_walk(deviations: Reals, starts: Reals) -> RandomWalk:
    """The walk with these deviations, and with the mean of the chains' starts."""
    scales, _ = ravel_pytree(deviations)
    points = jax.vmap(lambda reals: ravel_pytree(reals)[0])(starts)
    covariance = jnp.diag(scales**2) / (_BEST_SCALE**2 / len(scales))
    nothing = jnp.zeros((), scales.dtype)
    return RandomWalk(jnp.diag(scales), jnp.mean(points, axis=0), covariance, nothing)


def factor_of(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """F of the best random walk on a target of this covariance."""
    return cholesky(covariance[None])[0] * math.sqrt(_BEST_SCALE**2 / len(covariance))


def metropolis_step(
    key: Key[Array, ""],
    factor: Float[Array, "d d"],
    point: Point,
    evaluate: Callable[[Key[Array, ""], Reals], Evaluated],
) -> tuple[Point, Bool[Array, ""], Bool[Array, ""]]:
    """A step of the walk u + F z, accepted or not.

    It returns the point, whether it moved, and whether a density was no number. `evaluate` gives
    the point at other parameters by a key that is always new, and the last of these.
    """
    key_walk, key_fresh, key_accept = jax.random.split(key, 3)
    u, unravel = ravel_pytree(point.reals)
    noise = jax.random.normal(key_walk, u.shape, u.dtype)
    reals = unravel(u + jnp.matmul(factor, noise, precision="highest"))
    proposed, invalid = evaluate(key_fresh, reals)
    gain = proposed.log_density - point.log_density  # where it is NaN, the step is rejected
    accepted = jnp.log(jax.random.uniform(key_accept, (), gain.dtype)) < gain
    return select_rows(accepted, proposed, point), accepted, invalid


def checked_deviations(values: float | Mapping[str, Any], start: Reals) -> Reals:
    """The deviation of each unconstrained number; a `ValueError` for anything else."""
    by_name = values if isinstance(values, Mapping) else dict.fromkeys(start, values)
    if set(by_name) != set(start):
        raise ValueError(f"proposal_deviations: those of {sorted(by_name)}, not of {sorted(start)}")
    deviations = {}
    for name, u in start.items():
        with saying(f"proposal_deviations of {name}"):
            deviations[name] = jnp.broadcast_to(jnp.asarray(by_name[name], u.dtype), u.shape)
        POSITIVE.check(deviations[name], f"proposal_deviations: {name}")
    return deviations
