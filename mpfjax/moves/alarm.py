"""The alarm: a cumulative sum of what speaks against all hypotheses (CUSUM, Page 1954)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import Moves, Step
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


def hearing(
    moves: Moves, mixture: ParticleMixture, now: Step, increment: Float[Array, ""]
) -> tuple[ParticleMixture, Float[Array, ""] | None]:
    """The mixture whose alarm has heard of one more step, and what a move told it, if one does.

    The sum is bounded, so that it ends soon after the hypotheses are right again, and so is what
    one step can tell: an impossible one is not for ever.
    """
    for move in moves:
        evidence = move.evidence_against(mixture, now, increment)
        if evidence is not None:
            told = jnp.where(jnp.isnan(evidence), 0.0, evidence)
            total = mixture.memory[SURPRISE] + jnp.clip(told, -2 * ALARM, 2 * ALARM)
            memory = mixture.memory | {SURPRISE: jnp.clip(total, 0.0, 2 * ALARM)}
            return mixture.replace(memory=memory), evidence
    return mixture, None


def over_all_islands(log_value: Float[Array, ""]) -> Float[Array, ""]:
    """The logarithm of the sum over all islands of what each has."""
    return log_value if num_islands() == 1 else log_sum_exp(over_islands(log_value))
