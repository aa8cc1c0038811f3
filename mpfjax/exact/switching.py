"""The sum over all sequences of regimes, for switching models."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from mpfjax.checks import checked
from mpfjax.exact.kalman import Law, LinearStep, Moments, checked_rows, filtered, smoothed
from mpfjax.models.linear import SwitchingLinearGaussianModel
from mpfjax.models.series import series_of, steps_of_inputs
from mpfjax.operations.logarithms import log_sum_exp


class SwitchingFilterRun(eqx.Module):
    """The filtering and the smoothing distribution of a switching model, with K regimes."""

    regime_probabilities: Float[Array, "t k"]
    """P(z_s | y_1..y_s)."""
    means: Float[Array, "t d"]
    """E[x_s | y_1..y_s]."""
    covariances: Float[Array, "t d d"]
    """Cov[x_s | y_1..y_s]."""
    smoothed_regime_probabilities: Float[Array, "t1 k"]
    """P(z_s | y_1..y_t), from s = 0 on."""
    smoothed_means: Float[Array, "t1 d"]
    """E[x_s | y_1..y_t], from s = 0 on."""
    smoothed_covariances: Float[Array, "t1 d d"]
    """Cov[x_s | y_1..y_t], from s = 0 on."""
    log_likelihood_increments: Float[Array, " t"]
    log_marginal_likelihood: Float[Array, ""]


_MOST_SEQUENCES = 2**20


@checked
def switching_filter(
    model: SwitchingLinearGaussianModel, observations: PyTree
) -> SwitchingFilterRun:
    """All K^(t+1) sequences of regimes z_0, ..., z_t, with a Kalman smoother for each.

    The result is exact. No recursion exists, because the number of Gaussians grows K-fold with
    every step. `observations` are an array (t, p), or a `Series` of one, of which `Series.skipping`
    omits each number that is NaN. Differentiable. Raises `ValueError` for another model, for
    observations that are not (t, p), and for more than a million sequences. Use it as the reference
    for a short series.
    """
    series = series_of(observations)
    rows = checked_rows(series, model.H.shape[-2], model.m0.dtype)
    length, k = rows.shape[0], model.num_regimes
    steps_of_inputs(series.inputs, length, model)
    if k ** (length + 1) > _MOST_SEQUENCES:
        number = f"{k}^{length + 1} sequences, more than {_MOST_SEQUENCES}"
        raise ValueError(f"observations: {length} steps of {k} regimes are {number}")
    return _enumerate_sequences(model, rows)


@eqx.filter_jit
def _enumerate_sequences(
    model: SwitchingLinearGaussianModel, observations: Float[Array, "t p"]
) -> SwitchingFilterRun:
    k, length = model.num_regimes, observations.shape[0]
    places = np.indices((k,) * (length + 1), np.int32).reshape(length + 1, -1).T
    sequences = jnp.asarray(places)
    log_prior = model.log_initial(sequences[:, 0])
    for s in range(length):
        log_prior = log_prior + model.log_transition(sequences[:, s + 1], sequences[:, s])
    of_each = jax.vmap(lambda sequence: _kalman_smoother(model, sequence, observations))
    of_filter, of_smoother, log_densities = of_each(sequences)
    log_weights = log_prior[:, None] + jnp.cumsum(log_densities, axis=1)
    log_evidence = jax.vmap(log_sum_exp)(log_weights.T)
    weights = jnp.exp(log_weights - log_evidence[None])
    is_regime = jax.nn.one_hot(sequences, k, dtype=weights.dtype)
    filtering = jnp.einsum("st,stk->tk", weights, is_regime[:, 1:])
    final = jnp.broadcast_to(weights[:, -1:], (len(places), length + 1))
    smoothing = jnp.einsum("st,stk->tk", final, is_regime)
    moments = _mixture_moments(weights, *of_filter), _mixture_moments(final, *of_smoother)
    increments = jnp.diff(log_evidence, prepend=jnp.zeros(1, log_evidence.dtype))
    return SwitchingFilterRun(
        filtering, *moments[0], smoothing, *moments[1], increments, log_evidence[-1]
    )


def _mixture_moments(
    weights: Float[Array, "s t"], means: Float[Array, "s t d"], covariances: Float[Array, "s t d d"]
) -> tuple[Float[Array, "t d"], Float[Array, "t d d"]]:
    """The moments of a mixture of Gaussians at each time."""
    mean = jnp.einsum("st,std->td", weights, means)
    centred = means - mean[None]
    squares = covariances + centred[..., :, None] * centred[..., None, :]
    return mean, jnp.einsum("st,stde->tde", weights, squares)


def _kalman_smoother(
    model: SwitchingLinearGaussianModel, sequence: Int[Array, " t1"], observations: Array
) -> tuple[Moments, Moments, Float[Array, " t"]]:
    """Filtered and smoothed moments, and log p(y_s | y_1..y_{s-1}), given the regimes."""

    def step_of(z: Int[Array, ""]) -> LinearStep:
        parts = *model.dynamics(z[None], z[None]), *model.emission(z[None])
        ranks = (2, 1, 2, 2, 1, 2)  # of one regime, or of all of them
        each = zip(parts, ranks, strict=True)
        return LinearStep(*(part.reshape(part.shape[-rank:]) for part, rank in each))

    d, (mean, covariance) = model.m0.shape[-1], model.initial_moments(sequence[:1])
    start = Law.of(mean.reshape(d), covariance.reshape(d, d))
    laws, increments = filtered(start, step_of, sequence[1:], observations)
    moments = smoothed(start, laws, step_of, sequence[1:])
    return laws.moments, moments, increments
