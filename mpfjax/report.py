"""The report of a step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.mixture import ParticleMixture


class StepInfo(eqx.Module):
    """The report of a step, which comes with its mixture.

    - `log_likelihood_increment`: log p(y_t | y_1..y_{t-1}), estimated; -inf where every particle
      has zero likelihood.
    - `effective_sample_sizes`: of each component of the new mixture, zero for a dead one.
    - `effective_sample_size`: 1 / Σ W², of the joint weights W of all particles.
    - `mixture_weights`: the mass of each component of the new mixture.
    - `resampled`: which components of the mixture that the step was given were resampled.
    - `degenerate`: whether every particle had zero likelihood: the weights are then those of the
      prediction.
    - `labels_ran_out`: whether all M > 1 labels are in use, so that more modes share one; see
      `Split.is_diffuse`.
    - `log_marginal_likelihood_error`: the standard error of log Ẑ of all steps so far, from this
      one run; None unless the filter is one of `mpfjax.with_eve_indices`.
    - `mixture_weight_errors`: the standard error of each mixture weight; None likewise.
    - `log_evidence_against_start`: log of p(y_t | x_{t-1} ~ p_0) over p(y_t | y_1..y_{t-1}): how
      much y_t speaks for a state that begins anew, against all that the filter knows; None unless a
      move tells it, as in `with_alarm` and `with_restarts`.
    - `surprised`: whether all hypotheses seem wrong: the cumulative sum of that evidence is above
      5, see `FilterRun.surprised`; None likewise.
    """

    log_likelihood_increment: Float[Array, ""]
    effective_sample_sizes: Float[Array, " m"]
    effective_sample_size: Float[Array, ""]
    mixture_weights: Float[Array, " m"]
    resampled: Bool[Array, " m"]
    degenerate: Bool[Array, ""]
    labels_ran_out: Bool[Array, ""]
    log_marginal_likelihood_error: Float[Array, ""] | None = None
    mixture_weight_errors: Float[Array, " m"] | None = None
    log_evidence_against_start: Float[Array, ""] | None = None
    surprised: Bool[Array, ""] | None = None


def report_of(
    mixture: ParticleMixture,
    **additions: Array,
) -> StepInfo:
    """The report of a step that ended in this mixture, with what its memories add."""
    assert mixture.within is not None
    # It is a diagnosis: the gradient of a run need not go through it at every step.
    squares = jnp.sum(jnp.exp(2 * jax.lax.stop_gradient(mixture.log_weights)))
    sizes = mixture.component_effective_sample_sizes
    increment = mixture.within.log_increment
    fields = {
        "log_likelihood_increment": increment,
        "effective_sample_sizes": sizes,
        "effective_sample_size": 1 / squares,
        "mixture_weights": mixture.mixture_weights,
        "resampled": mixture.within.resampled,
        "degenerate": increment == -jnp.inf,
        "labels_ran_out": jnp.all(sizes > 0) & (mixture.num_components > 1),
    }
    return StepInfo(**fields | additions)
