"""Propagation of conditionally linear models, with the latents drawn or, if few, all tried."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp, ndtr
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import check
from mpfjax.mixture import MarginalisedState, ParticleMixture
from mpfjax.models.base import require
from mpfjax.models.conditionally_linear import AbstractConditionallyLinearModel
from mpfjax.models.law import Law
from mpfjax.moves.base import AbstractPropagation, Step
from mpfjax.moves.propagation.propagate import Propagate
from mpfjax.moves.propagation.proposals import ProposalOfNoise
from mpfjax.moves.regrouping.partitions import GroupBy
from mpfjax.moves.resampling.ancestors import draw_ancestors
from mpfjax.moves.resampling.line import Line, in_line
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.logarithms import log_or_nothing
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import select_rows, take

# A model's law says what is drawn: the name of the move for conditionally linear models.
PropagateMarginalised = Propagate


class RegimeProposal(ProposalOfNoise):
    """The optimal proposal of a latent with finitely many values, p(z_t | z_{t-1}, y_1..y_t).

    Each of the K values of z_t is weighted by p(z_t | z_{t-1}) and the predictive density of y_t,
    and one is drawn (Chen and Liu 2000; Doucet, Gordon and Krishnamurthy 2001). Its
    `log_normaliser` is exactly log p(y_t | z_{t-1}, y_1..y_{t-1}), so that
    `auxiliary_particle_filter(model, N, RegimeProposal())` is fully adapted: all weights are equal
    after a step. One step evaluates K predictive densities per particle.

    Raises `ValueError` in a filter of a model that is not conditionally linear, or has no
    `all_transitions` or `log_transition`. Use it if the number of regimes is small.
    """

    def check(self, now: Step) -> None:
        """Raise a `ValueError` for another model."""
        require_regimes(now.model, "RegimeProposal")
        require(now.model, "log_transition", "RegimeProposal")

    def noise_dimension(self, previous_states: MarginalisedState) -> int:
        """1."""
        return 1

    def propose_from_noise(
        self, noise: Float[Array, "n 1"], now: Step, previous_states: MarginalisedState
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """z_t as a function of this noise, and log q of each."""
        shares = ndtr(noise[:, 0])
        latents, log_priors, log_factors = children(now, previous_states)
        # Where y_t is impossible after each of them, they are drawn by their own law.
        possible = jnp.max(log_factors, axis=0) > -jnp.inf
        log_factors = jnp.where(possible[None], log_factors, log_priors)
        log_shares = log_factors - logsumexp(log_factors, axis=0)[None]
        upto = jnp.cumsum(jnp.exp(jax.lax.stop_gradient(log_shares)), axis=0)
        indices = jnp.sum(upto[:-1] <= shares[None] * upto[-1:], axis=0, dtype=jnp.int32)
        latent = jax.tree.map(lambda *rows: _row(jnp.stack(rows), indices), *latents)
        return latent, _row(log_shares, indices)

    def log_normaliser(self, now: Step, previous_states: MarginalisedState) -> Float[Array, " n"]:
        """log p(y_t | z_{t-1}, y_1..y_{t-1}) of every particle, exactly."""
        _, _, log_factors = children(now, previous_states)
        return logsumexp(log_factors, axis=0)


class PropagateRegimes(AbstractPropagation):
    """Evaluate all K regimes of each particle, then resample optimally to the number of slots.

    z_t takes K values, and every particle has K children, each with the weight w_i p(z_t | z_{t-1})
    p(y_t | ...). Of these N K children, every component retains as many as it has slots, by the
    optimal resampling of Fearnhead and Clifford (2003): a child of weight w is retained with
    probability min(w / c, 1), and then has the weight max(w, c). The constant c makes the expected
    number of children equal to the number of slots. Heavy children keep their weight, and none is
    duplicated. Of all unbiased choices this one changes the weights least. A component keeps its
    weight, and Ẑ is unbiased. A `Resample` before it would only add noise: `Filter(model,
    [PropagateRegimes()], N)` is the whole filter.

    - `regroup`: a `GroupBy` that regroups the children before the choice; None leaves them in their
      parents' components. Regrouped by the regime, every regime has its share of the slots at every
      step, however improbable it is: the IMM particle filter (Blom and Bloem 2007) with Kalman
      filters as particles.

    A derivative treats the probabilities of being retained as constants, as with
    `Resample(gradient="stop")`, so that derivatives of Ẑ are unbiased. Without an observation,
    children have the weight w_i p(z_t | z_{t-1}). Raises `ValueError` in a filter of a model that
    is not conditionally linear, or has no `all_transitions`. Use it if K is small.
    """

    regroup: GroupBy | None = None

    approximate = False
    biases_score = False
    keeps_families = False
    """it resamples without a memory of Eve indices."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for another model."""
        require_regimes(now.model, "PropagateRegimes")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Propagate, and weigh by y_t where it is there."""
        if now.is_missing:
            pairs = now.model.all_transitions(mixture.particles.latent)
            family = self._family(mixture, [latent for latent, _ in pairs])
            log_priors = jnp.concatenate([log for _, log in pairs])
            family = family.replace(log_weights=family.log_weights + log_priors)
            return self._select_children(key, mixture, family, now.law)
        mixture = mixture.with_resampled(mixture.active)
        latents, _, log_factors = children(now, mixture.particles)
        family = self._family(mixture, latents).reweight(log_factors.reshape(-1))
        moved = self._select_children(key, mixture, family, now.law)
        return moved.replace(particles=now.law.see(now.observation, moved.particles)[0])

    def _family(self, mixture: ParticleMixture, latents: list[PyTree]) -> ParticleMixture:
        """All children, those of a regime side by side, with their parents' weights and moments.

        Where one point of the line follows the other, each regime then has its share of them.
        """
        parents = jnp.tile(jnp.arange(mixture.num_particles, dtype=jnp.int32), len(latents))
        family = mixture.at(parents)
        latent = jax.tree.map(lambda *rows: jnp.concatenate(rows), *latents)
        return family.replace(particles=family.particles._replace(latent=latent), memory={})

    def _select_children(
        self, key: Key[Array, ""], mixture: ParticleMixture, family: ParticleMixture, law: Law
    ) -> ParticleMixture:
        """N of the N K children, their moments predicted."""
        if self.regroup is not None:
            regrouped = self.regroup.regroup(key, family)
            family = self.regroup.with_indicators(family, *regrouped)
        line = in_line(jax.lax.stop_gradient(family), None, along_curve=False)
        targets = Resample().deal(mixture, line, family.active)
        # More slots than children are of no use: a copy would have the moments that it copies.
        num_children = line.sums((line.weights > 0).astype(line.weights.dtype))
        targets = jnp.minimum(targets, num_children.astype(jnp.int32))
        threshold = _threshold(line, targets)
        least = line.of_places(threshold)
        heavy = (line.weights > 0).astype(line.weights.dtype)
        chances = jnp.where(line.weights >= least, heavy, line.weights / least)
        ancestors = draw_ancestors(
            key,
            line._replace(weights=chances, totals=targets.astype(chances.dtype)),
            targets,
            "systematic",
            num_slots=mixture.num_particles,
        )
        slots, places = ancestors.slots, ancestors.particles
        log_weights = take(family.log_weights, places)
        log_least = spread(log_or_nothing(threshold) + line.log_units, slots.components)
        gain = jax.lax.stop_gradient(jnp.maximum(log_least - log_weights, 0.0))
        selection = family.at(places)
        return selection.replace(
            particles=law.complete(selection.particles.latent, selection.particles),
            log_weights=jnp.where(slots.filled, log_weights + gain, -jnp.inf),
            component_indicators=slots.components,
            memory=mixture.memory,
        )


def require_regimes(model: Any, needed_by: str) -> None:
    """Raise a `ValueError` for a model without finitely many regimes."""
    check(AbstractConditionallyLinearModel, model=model)
    require(model, "all_transitions", needed_by)


def children(
    now: Step, state: MarginalisedState
) -> tuple[list[PyTree], Float[Array, "k n"], Float[Array, "k n"]]:
    """The K latents that may follow each particle, log p(z_t | z_{t-1}), and that times p(y_t)."""
    law, pairs = now.law, now.model.all_transitions(state.latent)
    latents, log_priors = [latent for latent, _ in pairs], jnp.stack([log for _, log in pairs])
    log_densities = [
        law.log_likelihood(now.observation, law.complete(latent, state)) for latent in latents
    ]
    return latents, log_priors, log_priors + jnp.stack(log_densities)


def _threshold(line: Line, targets: Int[Array, " m"]) -> Float[Array, " m"]:
    """c of each component, for which the chances min(w / c, 1) of its children sum to its slots.

    With all children for which w >= c kept, c is what the others weigh over the slots that are
    left. It starts with no child kept, and c only falls, until no more are kept: as many steps as
    there are different sets, mostly fewer than ten.
    """
    weights = line.weights
    slots = targets.astype(weights.dtype)

    def lower(previous: Float[Array, " m"]) -> Float[Array, " m"]:
        is_heavy = weights >= line.of_places(previous)
        left = slots - line.sums(is_heavy.astype(weights.dtype))
        rest = line.sums(jnp.where(is_heavy, 0.0, weights))
        return jnp.minimum(previous, jnp.where(left >= 1, rest / jnp.maximum(left, 1.0), previous))

    def is_falling(pair: tuple[Array, Array]) -> Bool[Array, ""]:
        return jnp.any(pair[1] < pair[0])

    first = line.totals / jnp.maximum(slots, 1.0)
    _, threshold = jax.lax.while_loop(
        is_falling, lambda pair: (pair[1], lower(pair[1])), (first, lower(first))
    )
    return threshold


def _row(table: Array, rows: Int[Array, " n"]) -> Array:
    """table[rows[i], i] of each i, by comparing, which runs on vectors."""
    row = table[0]
    for k in range(1, table.shape[0]):
        row = select_rows(rows == k, table[k], row)
    return row
