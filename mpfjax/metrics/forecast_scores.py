"""Scores of forecasts against later observations; lower is better."""

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mpfjax.checks import check_not_negative_array, check_type, real_arrays
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel, require_model
from mpfjax.models.steps import likelihoods
from mpfjax.observations import one_observation
from mpfjax.operations.logarithms import log_sum_exp


def crps(
    values: Float[Array, "*batch n"],
    weights: Float[Array, "*batch n"],
    observations: Float[Array, " *batch"],
) -> Float[Array, " *batch"]:
    """The continuous ranked probability score of weighted draws, in the unit of the values.

    CRPS = ∫ (F(z) - 1{z >= y})² dz = E|Y - y| - E|Y - Y'| / 2 of the distribution F of the draws
    (Gneiting and Raftery 2007, section 4.2), by a sum over the draws in order, O(n log n). It is
    the absolute error where all weight is in one draw. A weight of zero leaves a draw out, and
    weights need not sum to one. A NaN in a row makes its score NaN.

    Use it to score the draws of `mpfjax.forecast(..., simulate_observation=...)`, with the weights
    of the forecast's mixtures. Raises `ValueError` for anything but arrays of real numbers, for
    shapes that do not fit, and for a weight below zero.
    """
    values, weights = real_arrays("... n", values=values, weights=weights)
    observations = real_arrays("...", observations=observations)
    check_not_negative_array(weights=weights)
    if weights.shape != values.shape:
        raise ValueError(f"weights: shape {weights.shape} is not that of values, {values.shape}")
    if observations.shape != values.shape[:-1]:
        raise ValueError(
            f"observations: shape {observations.shape} is not {values.shape[:-1]}, one for each row"
            " of values"
        )
    errors = jnp.where(weights > 0, values - observations[..., None], 0.0)
    order = jnp.argsort(errors, axis=-1)
    errors = jnp.take_along_axis(errors, order, axis=-1)
    shares = jnp.take_along_axis(weights, order, axis=-1)
    shares = shares / jnp.sum(shares, axis=-1, keepdims=True)
    middles = jnp.cumsum(shares, axis=-1) - 0.5 * shares
    return 2 * jnp.sum(shares * errors * ((errors > 0).astype(errors.dtype) - middles), axis=-1)


def log_score(
    model: AbstractStateSpaceModel, mixture: ParticleMixture, observation: PyTree
) -> Float[Array, ""]:
    """-log p(y) under a forecast, -log Σ_i exp(ℓ_i) L(y | x_i), in nats.

    The logarithmic score (Gneiting and Raftery 2007, section 4.1). `mixture` is one of a
    `Forecast`; `jax.vmap` maps over several, beside their observations. One step ahead it is the
    negative increment of log Ẑ that the bootstrap filter's next step would give. It is +inf where
    no particle has any likelihood.

    Use it to compare models that see the same observations, with likelihoods that are normalised.
    Raises `ValueError` for anything but a model and a mixture, and for a likelihood of another
    shape.
    """
    require_model(model, "log_score")
    check_type(ParticleMixture, "a mixture, as in a Forecast", mixture=mixture)
    observation = one_observation(observation)
    values = likelihoods(model, observation, mixture.particles)
    joint = jnp.where(mixture.occupied, mixture.log_weights + values, -jnp.inf)
    return -log_sum_exp(joint)
