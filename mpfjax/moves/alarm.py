"""The alarm: a cumulative sum of what speaks against all hypotheses (CUSUM, Page 1954)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.mixture import ParticleMixture
from mpfjax.operations.islands import num_islands, over_islands
from mpfjax.operations.logarithms import log_sum_exp

# In the memory: the sum so far.
SURPRISE = "log_evidence_against_hypotheses"
# Above it, all hypotheses are taken to be wrong.
ALARM = 5.0


def quiet() -> dict[str, Float[Array, ""]]:
    """The memory of the alarm before any observation."""
    return {SURPRISE: jnp.zeros(())}


def is_alarmed(mixture: ParticleMixture) -> Bool[Array, ""]:
    """Whether what was observed speaks against all hypotheses."""
    return mixture.memory[SURPRISE] > ALARM


def with_evidence_against(
    mixture: ParticleMixture, evidence: Float[Array, ""] | None
) -> ParticleMixture:
    """The mixture whose alarm has heard the evidence of one more step.

    The sum is bounded, so that it ends soon after the hypotheses are right again, and so is what
    one step can tell: an impossible one is not for ever.
    """
    if evidence is None:
        return mixture
    told = jnp.clip(jnp.where(jnp.isnan(evidence), 0.0, evidence), -2 * ALARM, 2 * ALARM)
    total = jnp.clip(mixture.memory[SURPRISE] + told, 0.0, 2 * ALARM)
    return mixture.replace(memory=mixture.memory | {SURPRISE: total})


def over_all_islands(log_value: Float[Array, ""]) -> Float[Array, ""]:
    """The logarithm of the sum over all islands of what each has."""
    return log_value if num_islands() == 1 else log_sum_exp(over_islands(log_value))
