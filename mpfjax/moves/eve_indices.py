"""Eve indices: the particle of x_0 from which each particle descends, and variances from them.

A filter keeps them only if an `EveIndices` is in the memory of the mixture of x_0. `Resample` then
updates it, wherever it is in a chain or within a move.
`mpfjax.smoothing.variance.log_marginal_likelihood_variance` has the equations.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from mpfjax.memory import Memory, Offspring
from mpfjax.mixture import ParticleMixture
from mpfjax.operations.islands import num_islands
from mpfjax.operations.segments import segment_sum
from mpfjax.operations.stored import take

EVE_INDICES = "eve_indices"


class EveIndices(Memory):
    """The memory from which the errors of log Ẑ and of the masses are estimated, O(N + M²) numbers.

    - `indices`: (n,), the slot in x_0 that each particle descends from.
    - `groups`: (n,), the component in which each particle was last resampled.
    - `log_pair_factors`: (m, m), the logarithm of the factor by which a pair of particles without a
      common Eve index counts, by their groups. Among k independent draws, a share (k - 1) / k
      of the pairs are pairs of different draws. A pair's factor therefore grows by k / (k - 1)
      whenever the component that both are in is resampled.
    """

    indices: Int[Array, " n"]
    groups: Int[Array, " n"]
    log_pair_factors: Float[Array, "m m"]

    def family_masses(
        self, weights: Float[Array, " n"], labels: Int[Array, " n"], num_labels: int
    ) -> Float[Array, "labels n"]:
        """The weight of the descendants of each particle of x_0, by the particles' labels."""
        n = weights.shape[0]
        families = labels * n + self.indices
        return segment_sum(weights, families, num_labels * n).reshape(num_labels, n)

    @classmethod
    def of(cls, mixture: ParticleMixture) -> "EveIndices":
        """The Eve indices of x_0, where every particle is its own Eve."""
        n, m = mixture.num_particles, mixture.num_components
        return cls(
            indices=jnp.arange(n, dtype=jnp.int32),
            groups=jnp.zeros(n, jnp.int32),
            log_pair_factors=jnp.zeros((m, m), mixture.log_weights.dtype),
        )

    def at_start(self, mixture: ParticleMixture) -> "EveIndices":
        """Every particle its own Eve."""
        return EveIndices.of(mixture)

    def after_resampling(
        self, before: ParticleMixture, after: ParticleMixture, offspring: Offspring
    ) -> "EveIndices":
        """The Eve indices of the offspring."""
        parents, num_drawn, due, _ = offspring
        log_factors, groups = self.log_pair_factors, self.groups
        if before.num_components > 1:
            # Where nothing is drawn, the groups stay as they are, and nothing is averaged.
            any_due = jnp.any(due)
            log_factors = jnp.where(any_due, _by_components(self, before), log_factors)
            groups = jnp.where(any_due, after.component_indicators, take(groups, parents))
        k = num_drawn.astype(log_factors.dtype)
        # A component of one particle has no pair.
        grown = jnp.where(due & (k > 1), -jnp.log1p(-1 / jnp.maximum(k, 2)), 0.0)
        return EveIndices(take(self.indices, parents), groups, log_factors + jnp.diag(grown))

    def after_step(
        self, mixture: ParticleMixture, now: Any
    ) -> tuple["EveIndices", dict[str, PyTree]]:
        """The errors of log Ẑ and of the masses; none on islands, which families may span."""
        if num_islands() > 1:
            return self, {}
        assert mixture.within is not None
        is_degenerate = mixture.within.log_increment == -jnp.inf
        variance = jnp.where(is_degenerate, jnp.inf, evidence_variance(mixture))
        return self, {
            "log_marginal_likelihood_error": jnp.sqrt(jnp.maximum(variance, 0.0)),
            "mixture_weight_errors": jnp.sqrt(jnp.maximum(mass_variances(mixture), 0.0)),
        }


def evidence_variance(mixture: ParticleMixture) -> Float[Array, ""]:
    """The variance of log Ẑ, from the weight of each family. It may be negative."""
    eve: EveIndices = mixture.memory[EVE_INDICES]
    families = eve.family_masses(mixture.weights, eve.groups, mixture.num_components)
    relative = _variance(families, mixture)
    return relative + relative**2 / 2


def mass_variances(mixture: ParticleMixture) -> Float[Array, " m"]:
    """The variance of each mixture weight, from the share of each family in the component."""
    eve: EveIndices = mixture.memory[EVE_INDICES]
    m, masses = mixture.num_components, mixture.mixture_weights
    pairs = mixture.component_indicators * m + eve.groups
    families = eve.family_masses(mixture.weights, pairs, m * m).reshape(m, m, -1)
    # The mass of each family in a component, less the family's mass times the component's.
    excess = families - masses[:, None, None] * jnp.sum(families, axis=0)[None]
    return jax.vmap(_variance, (0, None))(excess, mixture)


def _variance(families: Float[Array, "m n"], mixture: ParticleMixture) -> Float[Array, ""]:
    """(Σ s)² - N / (N - 1) Σ s_i s_j Π k_m / (k_m - 1), over the pairs of different families."""
    eve: EveIndices = mixture.memory[EVE_INDICES]
    totals = jnp.sum(families, axis=1)
    of_different = totals[:, None] * totals[None] - families @ families.T
    num_drawn = jnp.asarray(mixture.num_usable_slots, families.dtype)
    log_factors = eve.log_pair_factors - jnp.log1p(-1 / jnp.maximum(num_drawn, 2))
    # The sums with factors of one, plus a correction for factors, which are close to one.
    of_same = jnp.sum(jnp.sum(families, axis=0) ** 2)
    return of_same - jnp.sum(of_different * jnp.expm1(log_factors))


def _by_components(eve: EveIndices, mixture: ParticleMixture) -> Float[Array, "m m"]:
    """The pair factors by component: the average over the pairs, by group, that are in two.

    Only pairs without a common Eve index count. The others would have been in the same
    component more often, and the factors would come out too large.
    """
    m = mixture.num_components
    pairs = mixture.component_indicators * m + eve.groups
    masses = eve.family_masses(mixture.weights, pairs, m * m)
    totals = jnp.sum(masses, axis=1).reshape(m, m)
    masses = masses.reshape(m, m, -1)
    largest = jnp.max(eve.log_pair_factors)
    factors = jnp.exp(eve.log_pair_factors - largest)

    def of_different(factors: Float[Array, "m m"]) -> Float[Array, "m m"]:
        of_same = jnp.einsum("cge,gh,dhe->cd", masses, factors, masses, optimize=True)
        return totals @ factors @ totals.T - of_same

    mass = of_different(jnp.ones_like(factors))
    # Where hardly a pair is left, rounding is all that there is.
    has_pairs = mass > 1e-4 * jnp.sum(totals, axis=1)[:, None] * jnp.sum(totals, axis=1)[None]
    averages = jnp.where(has_pairs, of_different(factors) / jnp.where(has_pairs, mass, 1.0), 1.0)
    return jnp.log(jnp.clip(averages, jnp.min(factors), 1.0)) + largest
