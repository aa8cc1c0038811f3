"""Scores of forecasts by weighted particles."""

from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mpfjax.arrays import NOT_NEGATIVE, real_array
from mpfjax.checks import checked
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.law import law_of
from mpfjax.models.observations import one_observation
from mpfjax.operations.logarithms import log_sum_exp


@checked
def crps(
    values: Float[Array, "*batch n"],
    weights: Annotated[Float[Array, "*batch n"], NOT_NEGATIVE],
    observations: Float[Array, " *batch"],
) -> Float[Array, " *batch"]:
    """The continuous ranked probability score of weighted draws, in the unit of the values.

    CRPS = ∫ (F(z) - 1{z >= y})² dz = E|Y - y| - E|Y - Y'| / 2 of the distribution F of the draws
    (Gneiting and Raftery 2007, section 4.2), by a sum over the sorted draws, O(n log n). It is the
    absolute error if all weight is on one draw. Draws of weight zero are ignored, and weights need
    not sum to one. A NaN in a row makes its score NaN.

    Use it to score the observations of `mpfjax.forecast`, with the weights of the forecast's
    mixtures. Raises `ValueError` for anything but arrays of real numbers, for shapes that do not
    agree, and for a negative weight.
    """
    values = real_array("... n", "values", values)
    *batch, n = map(str, values.shape)
    weights = real_array(" ".join([*batch, n]), "weights", weights)
    observations = real_array(" ".join(batch), "observations", observations)
    errors = jnp.where(weights > 0, values - observations[..., None], 0.0)
    order = jnp.argsort(errors, axis=-1)
    errors = jnp.take_along_axis(errors, order, axis=-1)
    shares = jnp.take_along_axis(weights, order, axis=-1)
    shares = shares / jnp.sum(shares, axis=-1, keepdims=True)
    middles = jnp.cumsum(shares, axis=-1) - 0.5 * shares
    return 2 * jnp.sum(shares * errors * ((errors > 0).astype(errors.dtype) - middles), axis=-1)


@checked
def log_score(
    model: AbstractStateSpaceModel, mixture: ParticleMixture, observation: PyTree
) -> Float[Array, ""]:
    """-log p(y) under a forecast, -log Σ_i exp(ℓ_i) L(y | x_i), in nats.

    The logarithmic score (Gneiting and Raftery 2007, section 4.1). `mixture` is one of a
    `Forecast`; `jax.vmap` maps over several, together with their observations. One step ahead it is
    the negative increment of log Ẑ in the next step of the bootstrap filter. It is +inf if the
    likelihood of every particle is zero.

    Use it to compare models of the same observations, with likelihoods that are normalised. Raises
    `ValueError` for anything but a model and a mixture, and for a likelihood of another shape.
    """
    observation = one_observation(observation)
    values = law_of(model).log_likelihood(observation, mixture.particles)
    return -log_sum_exp(jnp.where(mixture.occupied, mixture.log_weights + values, -jnp.inf))
