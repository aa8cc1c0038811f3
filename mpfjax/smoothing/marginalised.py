"""Rao-Blackwellised backward sampling: latents backward in time, and moments of x given all y.

Lindsten, Bunch, Särkkä, Schön and Godsill (2016). The likelihood of y_{s+1}, ... and z_{s+1}, ...
as a function of x_s is exp(-u Ω u / 2 + λ u), up to a factor, with u the distance of x_s from the
mean of the trajectory's own particle: in terms of x itself, far from zero, the terms would cancel
except for rounding. The index of z_s given the future has the probabilities

    W_s^i p(z_{s+1} | z_s^i) p(y_{s+1} | i) ∫ N(x; m_i, P_i) exp(-u Ω u / 2 + λ u) dx,

with Ω and λ of s + 1, and m_i and P_i of x_{s+1} by particle i, given y_{s+1} too. Only the
information of an observation on the previous x enters Ω, so that R may be singular.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.mixture import MarginalisedState, ParticleMixture
from mpfjax.models import conditionally_linear as linear
from mpfjax.models import gaussians
from mpfjax.models.base import with_inputs
from mpfjax.models.gaussians import (
    Gaussian,
    Linear,
    apply,
    cholesky,
    particles_first,
    product,
    sandwich,
    solve_lower,
    symmetric,
    transpose,
    without_missing,
)
from mpfjax.models.law import law_of
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.operations.random import split
from mpfjax.running.results import after_first, append_last
from mpfjax.smoothing.backward import draw_ends, draw_exactly, rows_at


class Information(NamedTuple):
    """A likelihood of x, exp(-u Ω u / 2 + λ u) with u = x - centre, the trajectories last."""

    precision: Float[Array, "d d #n"]
    vector: Float[Array, "d #n"]
    centre: Float[Array, "d #n"]


def check_marginalised(
    model: Any, mixtures: ParticleMixture, observations: Any, method: str
) -> None:
    """Raise a `ValueError` for data that backward sampling cannot use."""
    if not linear.is_marginalised(model) or observations is None or method != "exact":
        raise ValueError("observations, method: y is for conditionally linear models, by 'exact'")
    lengths = {jnp.shape(leaf)[0] for leaf in jax.tree.leaves(observations)}
    num_steps = mixtures.log_weights.shape[0] - 1
    if lengths != {num_steps}:
        raise ValueError(f"observations: {sorted(lengths)} steps, not {num_steps}, from x_0 on")


@jit_on_wide_vectors
def sample_marginalised(key, model, mixtures, observations, inputs, num_trajectories):
    """Latents z_0, ..., z_t given y_1..y_t, and the moments of x_0, ..., x_t given both.

    Also the indices of their particles, (t + 1, k). `mixtures` are those of x_0, ..., x_t; `inputs`
    are those of the steps between them.
    """
    key_last, key_steps = split(key, 2)
    length = mixtures.log_weights.shape[0] - 1
    last, end = draw_ends(key_last, mixtures, num_trajectories)

    def back(carry: tuple[PyTree, Information], step: Any) -> tuple[Any, Any]:
        latent, future = carry
        step_key, earlier, observation, now = step
        model_now = with_inputs(model, now)
        indices = _indices(step_key, model_now, observation, latent, future, earlier)
        before = rows_at(indices, earlier.particles)
        future = _before(model_now, observation, latent, before, future)
        return (before.latent, future), (before.latent, future, indices)

    def forth(state: MarginalisedState, step: Any) -> tuple[Any, Any]:
        latent, observation, now = step
        law = law_of(with_inputs(model, now))
        state, _ = law.see(observation, law.complete(latent, state))
        return state, state

    nothing = _nothing(end.mean)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], mixtures)
    steps = (jax.random.split(key_steps, length), earlier, observations, inputs)
    _, past = jax.lax.scan(back, (end.latent, nothing), steps, reverse=True)
    latents, futures, indices = append_last(past, (end.latent, nothing, last))
    following = jax.tree.map(lambda leaf: leaf[1:], latents)
    start = law_of(model).start(jax.tree.map(lambda leaf: leaf[0], latents))
    _, later = jax.lax.scan(forth, start, (following, observations, inputs))
    smoothed = jax.vmap(_smoothed)(after_first(start, later), futures)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), smoothed), indices


def _nothing(mean: Float[Array, "n d"]) -> Information:
    n, d = mean.shape
    return Information(jnp.zeros((d, d, n), mean.dtype), jnp.zeros((d, n), mean.dtype), mean.T)


def _add(one: Information, other: Information) -> Information:
    """The product of two likelihoods that have one centre."""
    return Information(one.precision + other.precision, one.vector + other.vector, one.centre)


def _likelihood(target: Float[Array, "p #n"], emission: Linear, law: Gaussian) -> Information:
    """The likelihood of y = A x + b + N(0, C) as a function of x, around the mean of its law."""
    signal = sandwich(emission.matrix, law.covariance)
    # Each variance of y is at least a share of that which x itself makes. With less, Ω would round
    # away what is known of x in other directions.
    p, share = emission.noise.shape[0], float(jnp.finfo(emission.noise.dtype).eps) ** 0.5
    variances = jnp.stack([emission.noise[j, j] for j in range(p)])
    least = share * jnp.stack([signal[j, j] for j in range(p)])
    least = jnp.where((variances > 0) | (least > 0), least, 1.0)  # an exact y of an x known exactly
    lacking = jnp.maximum(least - variances, 0.0)[None]
    noise = emission.noise + jnp.eye(p, dtype=variances.dtype)[:, :, None] * lacking
    factor = cholesky(noise, floor=True)
    rows = solve_lower(factor, emission.matrix)
    innovation = target - emission.offset - apply(emission.matrix, law.mean)
    white = solve_lower(factor, innovation[:, None])[:, 0]
    return Information(product(transpose(rows), rows), apply(transpose(rows), white), law.mean)


def _before(
    model: Any, observation: PyTree, latent: PyTree, before: MarginalisedState, future: Information
) -> Information:
    """The likelihood of y_{s+1}, z_{s+1} and all that follows as a function of x_s, given z_s."""
    dynamics, law = linear.dynamics_of(model, latent, before), linear.gaussian_of(before)
    likelihood = _nothing(before.mean)
    if linear.is_mixed(model):
        mixed, shared = linear.latent_dynamics_of(model, before)
        rows = linear.latent_rows(model, latent)
        likelihood = _likelihood(rows, mixed, law)
        dynamics = gaussians.decorrelate(dynamics, mixed, shared, rows)
    emission = linear.emission_of(model, latent, before)
    if emission is not None:
        target = linear.observation_rows(model, observation, emission, before.mean.dtype)
        target, emission, _ = without_missing(target, emission)
        through = gaussians.through(dynamics, emission)
        likelihood = _add(likelihood, _likelihood(target, through, law))
        shared = product(dynamics.noise, transpose(emission.matrix))
        dynamics = gaussians.decorrelate(dynamics, through, shared, target)
    matrix, offset, noise = dynamics
    precision, vector, centre = future
    offset = offset + apply(matrix, law.mean) - centre
    vector = vector - apply(precision, offset)
    root = cholesky(noise)
    half = solve_lower(_one_plus(precision, root), transpose(product(precision, root)))
    white = solve_lower(_one_plus(precision, root), apply(transpose(root), vector)[:, None])[:, 0]
    precision = precision - product(transpose(half), half)
    vector = vector - apply(transpose(half), white)
    back = transpose(matrix)
    return _add(likelihood, Information(sandwich(back, precision), apply(back, vector), law.mean))


def _one_plus(
    precision: Float[Array, "d d #n"], root: Float[Array, "d d #n"]
) -> Float[Array, "d d #n"]:
    """The factor of I + Γᵀ Ω Γ."""
    identity = jnp.eye(precision.shape[0], dtype=precision.dtype)[:, :, None]
    return cholesky(identity + sandwich(transpose(root), precision), floor=True)


def _log_overlap(law: Gaussian, future: Information) -> Float[Array, " n"]:
    """log ∫ N(x; m, P) exp(-u Ω u / 2 + λ u) dx of each particle."""
    precision, vector, centre = future
    root, away = cholesky(law.covariance), law.mean - centre
    factor = _one_plus(precision, root)
    pull = apply(precision, away)
    white = solve_lower(factor, apply(transpose(root), vector - pull)[:, None])[:, 0]
    at_mean = apply(away[None], vector - 0.5 * pull)[0]
    log_volume = sum(jnp.log(factor[j, j]) for j in range(factor.shape[0]))
    return at_mean + 0.5 * apply(white[None], white)[0] - log_volume


def _indices(
    key: Key[Array, ""],
    model: Any,
    observation: PyTree,
    latent: PyTree,
    future: Information,
    earlier: ParticleMixture,
) -> Array:
    """The particle of s that each trajectory comes from."""
    n, state = earlier.log_weights.shape[0], earlier.particles

    def log_density(trajectory: tuple) -> Float[Array, " n"]:
        one_latent, *of_future = trajectory
        copies = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), one_latent)
        law = linear.predicted_gaussian(model, copies, state)
        log_density = law_of(model).log_transition(copies, state)
        emission = linear.emission_of(model, copies, state)
        if emission is not None:
            rows = linear.observation_rows(model, observation, emission, state.mean.dtype)
            law, log_factor = gaussians.update(law, rows, emission)
            log_density = log_density + log_factor
        one = Information(*(part[..., None] for part in of_future))
        return log_density + _log_overlap(law, one)

    trajectories = (latent, *(jnp.moveaxis(part, -1, 0) for part in future))
    return draw_exactly(key, log_density, trajectories, earlier, cost=16)[:, 0]


def _smoothed(state: MarginalisedState, future: Information) -> MarginalisedState:
    """The moments of x_s given y_1..y_s and the likelihood of the future."""
    n, law = state.mean.shape[0], linear.gaussian_of(state)
    root = cholesky(law.covariance)
    half = solve_lower(_one_plus(future.precision, root), transpose(root))
    covariance = symmetric(product(transpose(half), half))
    pull = future.vector - apply(future.precision, law.mean - future.centre)
    mean = law.mean + apply(covariance, pull)
    return MarginalisedState(state.latent, particles_first(mean, n), particles_first(covariance, n))
