"""The report of a step of a filter."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, PyTree

from mpfjax.checks import Renamed
from mpfjax.mixture import ParticleMixture

BROKEN_DENSITY = (
    "model: a density was NaN or infinite for some particle, or GroupBy: group gave a label outside"
    " [0, M)"
)

# Fields that are None unless a memory fills them.
_BY_MEMORIES = (
    "log_marginal_likelihood_error", "mixture_weight_errors", "log_evidence_against_start", "alarm",
)  # fmt: skip


class StepInfo(eqx.Module):
    """The report of a step, which is returned with its mixture.

    - `log_likelihood_increment`: log p(y_t | y_1..y_{t-1}), estimated; -inf if every particle has
      zero likelihood.
    - `effective_sample_sizes`: of each component of the new mixture, zero for an empty one.
    - `effective_sample_size`: 1 / Σ W², of the joint weights W of all particles.
    - `mixture_weights`: the weight of each component of the new mixture.
    - `resampled`: which components of the previous mixture were resampled.
    - `degenerate`: whether every particle had zero likelihood: the weights are then those of the
      prediction.
    - `labels_ran_out`: whether all M > 1 labels are in use, so that further modes share one; see
      `Split.is_diffuse`.
    - `log_marginal_likelihood_error`: the standard error of log Ẑ of all steps so far, from this
      single run; None unless the filter is from `mpfjax.with_eve_indices`.
    - `mixture_weight_errors`: the standard error of each mixture weight; None as above.
    - `log_evidence_against_start`: log of p(y_t | x_{t-1} ~ p_0) over p(y_t | y_1..y_{t-1}): the
      evidence of y_t for a state that restarts from the prior, against the filter's hypotheses;
      None unless a move computes it, as in `with_alarm` and `with_restarts`.
    - `alarm`: whether all hypotheses seem wrong: the cumulative sum of that evidence is above 5,
      see `FilterRun.alarm`; None as above.
    """

    log_likelihood_increment: Float[Array, ""]
    effective_sample_sizes: Float[Array, " m"]
    effective_sample_size: Float[Array, ""]
    mixture_weights: Float[Array, " m"]
    resampled: Bool[Array, " m"]
    degenerate: Bool[Array, ""]
    labels_ran_out: Bool[Array, ""]
    log_marginal_likelihood_error: Float[Array, ""] | None
    mixture_weight_errors: Float[Array, " m"] | None
    log_evidence_against_start: Float[Array, ""] | None
    alarm: Bool[Array, ""] | None
    surprised = Renamed("surprised", "alarm")

    @property
    def broken(self) -> Bool[Array, "..."]:
        """Whether the increment of log Ẑ is NaN or +inf."""
        return ~(self.log_likelihood_increment < jnp.inf)


def report_of(mixture: ParticleMixture, **additions: Array) -> StepInfo:
    """The report of a step that ended in this mixture, with what its memories add."""
    assert mixture.within is not None
    # It is a diagnosis: the gradient of a run need not go through it at every step.
    squares = jnp.sum(jnp.exp(2 * jax.lax.stop_gradient(mixture.log_weights)))
    sizes = mixture.component_effective_sample_sizes
    increment = mixture.within.log_increment
    fields: dict[str, Any] = dict.fromkeys(_BY_MEMORIES) | {
        "log_likelihood_increment": increment,
        "effective_sample_sizes": sizes,
        "effective_sample_size": 1 / squares,
        "mixture_weights": mixture.mixture_weights,
        "resampled": mixture.within.resampled,
        "degenerate": increment == -jnp.inf,
        "labels_ran_out": jnp.all(sizes > 0) & (mixture.num_components > 1),
    }
    return StepInfo(**fields | additions)


def with_densities(value: PyTree, increments: Float[Array, "*runs_and_t"]) -> PyTree:
    """`value`, or a RuntimeError where an increment of log Ẑ is NaN or +inf.

    A program cannot raise, so increments are looked at after it has ended. Under the caller's own
    jit nothing is raised: look at `StepInfo.broken` or `FilterRun.broken` outside.
    """
    if isinstance(increments, Tracer):
        return value
    broken = ~(np.asarray(increments) < np.inf)
    if broken.any():
        step = int(np.argmax(broken.any(axis=tuple(range(broken.ndim - 1))))) if broken.ndim else 0
        at = f", first at index {step} of the steps" if broken.ndim else ""
        raise RuntimeError(f"{BROKEN_DENSITY}{at}")
    return value
