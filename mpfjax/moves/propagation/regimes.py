"""Finitely many latents: the optimal proposal, and all children of each particle with few kept."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp, ndtr
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import check_type, given
from mpfjax.mixture import MarginalisedState, ParticleMixture
from mpfjax.models.base import require
from mpfjax.models.conditionally_linear import (
    AbstractConditionallyLinearModel,
    predicted,
    require_marginalised,
    updated,
)
from mpfjax.models.steps import log_predictive
from mpfjax.moves.base import AbstractPropagation
from mpfjax.moves.regrouping.group_by import GroupBy
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.generator import uniform
from mpfjax.operations.indexing import take
from mpfjax.operations.segments import spread
from mpfjax.proposals import AbstractProposal


class RegimeProposal(AbstractProposal):
    """The optimal proposal of a latent with finitely many values, p(z_t | z_{t-1}, y_1..y_t).

    Each of the K values of z_t that may follow is weighed by p(z_t | z_{t-1}) and the predictive
    density of y_t, and one is drawn (Chen and Liu 2000; Doucet, Gordon and Krishnamurthy 2001). Its
    `log_normaliser` is exactly log p(y_t | z_{t-1}, y_1..y_{t-1}), so that
    `auxiliary_particle_filter(model, N, RegimeProposal(model))` is fully adapted: all weights are
    equal after a step. One step takes K predictive densities a particle.

    - `model`: a conditionally linear model with `all_transitions` and `log_transition`.

    Raises `ValueError` for another model. Use it where the number of regimes is small.
    """

    model: AbstractConditionallyLinearModel

    def __check_init__(self) -> None:
        require_finite(self.model, "RegimeProposal")
        require(self.model, "log_transition", "RegimeProposal")

    def propose(
        self, key: Key[Array, ""], observation: PyTree, previous_states: MarginalisedState
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """z_t, and log q of each."""
        n, dtype = previous_states.mean.shape[0], previous_states.mean.dtype
        return self._drawn(uniform(key, (n,), dtype), observation, previous_states)

    def noise_dimension(self, previous_states: MarginalisedState) -> int:
        """1."""
        del previous_states
        return 1

    def propose_from_noise(
        self, noise: Float[Array, "n 1"], observation: PyTree, previous_states: MarginalisedState
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """The same, made of this noise."""
        return self._drawn(ndtr(noise[:, 0]), observation, previous_states)

    def log_normaliser(
        self, observation: PyTree, previous_states: MarginalisedState
    ) -> Float[Array, " n"]:
        """log p(y_t | z_{t-1}, y_1..y_{t-1}) of every particle, exactly."""
        _, _, log_factors = children(self.model, observation, previous_states)
        return logsumexp(log_factors, axis=0)

    def _drawn(
        self, shares: Float[Array, " n"], observation: PyTree, previous: MarginalisedState
    ) -> tuple[PyTree, Float[Array, " n"]]:
        latents, log_priors, log_factors = children(self.model, observation, previous)
        # Where y_t is impossible after each of them, they are drawn by their own law.
        possible = jnp.max(log_factors, axis=0) > -jnp.inf
        log_factors = jnp.where(possible[None], log_factors, log_priors)
        log_shares = log_factors - logsumexp(log_factors, axis=0)[None]
        upto = jnp.cumsum(jnp.exp(jax.lax.stop_gradient(log_shares)), axis=0)
        kept = jnp.sum(upto[:-1] <= shares[None] * upto[-1:], axis=0, dtype=jnp.int32)
        latent = jax.tree.map(lambda *rows: _row(jnp.stack(rows), kept), *latents)
        return latent, _row(log_shares, kept)


class PropagateRegimes(AbstractPropagation):
    """Try all K regimes for each particle, then resample optimally to the number of slots.

    z_t takes K values, and every particle has K children, each with the weight w_i p(z_t | z_{t-1})
    p(y_t | ...). Of these N K children, every component keeps as many as it has slots, by the
    optimal resampling of Fearnhead and Clifford (2003): a child of weight w is kept with the
    probability min(w / c, 1), and then has the weight max(w, c). The constant c makes the expected
    number of children equal to the number of slots. Heavy children keep their weight, and none is
    kept twice. Of all unbiased choices this one changes the weights least. A component keeps its
    mass, and Ẑ is unbiased. A `Resample` before it would only add noise: `Filter(model,
    [PropagateRegimes(model)], N)` is the whole filter.

    - `model`: a conditionally linear model with `all_transitions`.
    - `group`: a `GroupBy` that regroups the children before the choice; None leaves them in their
      parents' components. With a group by the regime, every regime has its share of the slots at
      every step, however improbable it is: the IMM particle filter (Blom and Bloem 2007) with
      Kalman filters for particles.
    - `scheme`: of `Resample`, usually "systematic" or "stratified".

    A derivative treats the probabilities of being kept as constants, as that of
    `Resample(gradient="stop")` does, so that derivatives of Ẑ are unbiased. Without an observation,
    children have the weight w_i p(z_t | z_{t-1}). Raises `ValueError` for another model. Use it
    where K is small.
    """

    model: AbstractConditionallyLinearModel
    group: GroupBy | None = None
    scheme: str = eqx.field(static=True, default="systematic")

    def __check_init__(self) -> None:
        require_finite(self.model, "PropagateRegimes")
        check_type(GroupBy, "a GroupBy", **given(group=self.group))
        Resample(self.scheme)

    def would_resample(
        self, mixture: ParticleMixture, observation: PyTree = None
    ) -> Bool[Array, " m"]:
        """All living components."""
        del observation
        return mixture.active

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Propagate, and weigh by y_t."""
        latents, _, log_factors = children(self.model, observation, mixture.particles)
        moved = self._chosen(key, mixture, latents, log_factors)
        return moved.replace(particles=updated(self.model, observation, moved.particles)[0])

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The same with no observation to weigh by."""
        pairs = self.model.all_transitions(mixture.particles.latent)  # pyright: ignore
        latents, log_priors = [latent for latent, _ in pairs], jnp.stack([log for _, log in pairs])
        moved = self._chosen(key, mixture, latents, log_priors)
        # A common factor of the transition probabilities must not add to the mass.
        log_weights = moved.log_weights + (moved.log_scale - mixture.log_scale)
        return moved.replace(log_weights=log_weights, log_scale=mixture.log_scale)

    def _chosen(
        self,
        key: Key[Array, ""],
        mixture: ParticleMixture,
        latents: list[PyTree],
        log_factors: Float[Array, "k n"],
    ) -> ParticleMixture:
        """N of the N K children, their moments predicted."""
        n, k, state = mixture.num_particles, len(latents), mixture.particles
        latent = jax.tree.map(lambda *rows: _flat(jnp.stack(rows, axis=1)), *latents)
        parents = jnp.arange(n * k, dtype=jnp.int32) // k
        family = mixture.replace(
            particles=MarginalisedState(
                latent, take(state.mean, parents), take(state.covariance, parents)
            ),
            log_weights=take(mixture.log_weights, parents),
            component_indicators=take(mixture.component_indicators, parents),
            ancestor_indices=take(mixture.ancestor_indices, parents),
            memory={},
            usable_slots=jnp.asarray(mixture.num_usable_slots, jnp.int32),
        ).weighed(log_factors.T.reshape(-1))
        if self.group is not None:
            family = self.group(key, family)
        chances = jax.lax.stop_gradient(_chances(family, Resample(self.scheme)))
        log_chances = jnp.where(
            chances > 0, jnp.log(jnp.where(chances > 0, chances, 1.0)), -jnp.inf
        )
        places = jnp.arange(n * k, dtype=jnp.int32)
        chosen = Resample(self.scheme)(
            key, family.replace(particles=places, log_weights=log_chances)
        )
        place = chosen.particles[:n]
        log_ratios = jnp.where(chances > 0, family.log_weights - log_chances, 0.0)
        log_weights = chosen.log_weights[:n] + take(log_ratios, place)
        own = place // k
        parent = jax.tree.map(lambda leaf: take(leaf, own), state)
        drawn = jax.tree.map(lambda leaf: take(leaf, place), latent)
        return mixture.replace(
            particles=predicted(self.model, drawn, parent),
            log_weights=log_weights,
            component_indicators=chosen.component_indicators[:n],
            ancestor_indices=chosen.ancestor_indices[:n],
            log_scale=family.log_scale,
        )


def children(
    model: Any, observation: PyTree, state: MarginalisedState
) -> tuple[list[PyTree], Float[Array, "k n"], Float[Array, "k n"]]:
    """The K latents that may follow each particle, log p(z_t | z_{t-1}), and that times p(y_t)."""
    pairs = model.all_transitions(state.latent)
    latents, log_priors = [latent for latent, _ in pairs], jnp.stack([log for _, log in pairs])
    log_densities = [log_predictive(model, observation, latent, state) for latent in latents]
    return latents, log_priors, log_priors + jnp.stack(log_densities)


def _chances(family: ParticleMixture, resample: Resample) -> Float[Array, " c"]:
    """min(w / c, 1) of each child: the chance to be kept, which sums to its component's slots.

    With all children for which w >= c kept, c is what the others weigh over the slots that are
    left. It starts with no child kept, and c only falls, until no more are kept: as many steps as
    there are different sets, mostly fewer than ten.
    """
    weights, labels = family.component_weights, family.component_indicators
    slots = resample.deal(family, family.active, family.component_counts).astype(weights.dtype)

    def thresholds(previous: Float[Array, " m"]) -> Float[Array, " m"]:
        is_heavy = weights >= spread(previous, labels)
        columns = jnp.stack([is_heavy.astype(weights.dtype), jnp.where(is_heavy, 0.0, weights)], 1)
        num_heavy, rest = family.component_sums(columns).T
        left = slots - num_heavy
        lower = jnp.where(left >= 1, rest / jnp.maximum(left, 1.0), previous)
        return jnp.minimum(previous, lower)

    def is_falling(pair: tuple[Array, Array]) -> Bool[Array, ""]:
        return jnp.any(pair[1] < pair[0])

    first = 1 / jnp.maximum(slots, 1.0)
    _, threshold = jax.lax.while_loop(
        is_falling, lambda pair: (pair[1], thresholds(pair[1])), (first, thresholds(first))
    )
    own = spread(threshold, labels)
    return jnp.where(weights >= own, (weights > 0).astype(weights.dtype), weights / own)


def require_finite(model: Any, needed_by: str) -> None:
    """Raise a `ValueError` for a model that does not list what may follow its latent."""
    require_marginalised(model, needed_by)
    require(model, "all_transitions", needed_by)


def _row(table: Array, rows: Int[Array, " n"]) -> Array:
    """table[rows[i], i] of each i, by comparing, which runs on vectors."""
    found = table[0]
    for k in range(1, table.shape[0]):
        is_row = (rows == k).reshape(-1, *[1] * (found.ndim - 1))
        found = jnp.where(is_row, table[k], found)
    return found


def _flat(leaf: Array) -> Array:
    """(n, k, ...) as (n k, ...)."""
    return leaf.reshape(-1, *leaf.shape[2:])
