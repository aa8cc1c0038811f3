"""The report of a step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.alarm import is_alarmed
from mpfjax.moves.eve_indices import EVE_INDICES, evidence_variance, mass_variances
from mpfjax.operations.islands import num_islands, over_islands


class StepInfo(eqx.Module):
    """The report of a step, which comes with its mixture."""

    log_likelihood_increment: Float[Array, ""]
    """log p(y_t | y_1..y_{t-1}), estimated; -inf where every particle has zero likelihood."""
    effective_sample_sizes: Float[Array, " m"]
    """of each component of the new mixture, zero for a dead one."""
    effective_sample_size: Float[Array, ""]
    """of the whole new mixture, of all islands."""
    mixture_weights: Float[Array, " m"]
    """the mass of each component of the new mixture."""
    resampled: Bool[Array, " m"]
    """which components of the mixture that the step was given were resampled."""
    degenerate: Bool[Array, ""]
    """whether every particle had zero likelihood: the weights are then those of the prediction."""
    labels_ran_out: Bool[Array, ""]
    """whether all M > 1 labels are in use, so that more modes share one; see `Split.is_diffuse`."""
    log_marginal_likelihood_error: Float[Array, ""] | None = None
    """the standard error of log Ẑ of all steps so far, from this one run; None unless the filter
    is one of `mpfjax.smoothing.with_first_ancestors`."""
    mixture_weight_errors: Float[Array, " m"] | None = None
    """the standard error of each mixture weight; None likewise."""
    log_evidence_against_start: Float[Array, ""] | None = None
    """log of p(y_t | x_{t-1} ~ p_0) over p(y_t | y_1..y_{t-1}): how much y_t speaks for a state
    that begins anew, against all that the filter knows; None unless a move tells it, as in
    `with_alarm` and `with_restarts`."""
    surprised: Bool[Array, ""] | None = None
    """whether all hypotheses seem wrong: the cumulative sum of that evidence is above 5, see
    `FilterRun.surprised`; None likewise."""


def report_of(
    mixture: ParticleMixture,
    increment: Float[Array, ""],
    resampled: Bool[Array, " m"],
    evidence_against: Float[Array, ""] | None,
) -> StepInfo:
    """The report of a step that ended in this mixture."""
    degenerate = increment == -jnp.inf
    of_evidence = of_masses = None
    # Families may have members on several islands.
    if EVE_INDICES in mixture.memory and num_islands() == 1:
        variance = jnp.where(degenerate, jnp.inf, evidence_variance(mixture))
        of_evidence = jnp.sqrt(jnp.maximum(variance, 0.0))
        of_masses = jnp.sqrt(jnp.maximum(mass_variances(mixture), 0.0))
    sizes, masses = mixture.component_effective_sample_sizes, mixture.mixture_weights
    return StepInfo(
        log_likelihood_increment=increment,
        effective_sample_sizes=sizes,
        effective_sample_size=_effective_size(masses, sizes),
        mixture_weights=masses,
        resampled=resampled,
        degenerate=degenerate,
        labels_ran_out=jnp.all(sizes > 0) & (mixture.num_components > 1),
        log_marginal_likelihood_error=of_evidence,
        mixture_weight_errors=of_masses,
        log_evidence_against_start=evidence_against,
        surprised=None if evidence_against is None else is_alarmed(mixture),
    )


def _effective_size(masses: Float[Array, " m"], sizes: Float[Array, " m"]) -> Float[Array, ""]:
    """1 / Σ exp 2ℓ over all particles of all islands, from the masses and sizes of components."""
    squares = jnp.sum(jnp.where(sizes > 0, masses**2 / jnp.where(sizes > 0, sizes, 1.0), 0.0))
    if num_islands() > 1:
        squares = jnp.sum(over_islands(squares))
    # It is a diagnosis: the gradient of a run need not go through it at every step.
    return jax.lax.stop_gradient(1 / squares)
