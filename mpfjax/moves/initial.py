"""Selection of x_0: its draws, and the choice among many draws by the first observation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture, single_component
from mpfjax.moves.base import AbstractMove, Step
from mpfjax.moves.resampling.ancestors import draw_ancestors
from mpfjax.moves.resampling.line import Line, sorted_order
from mpfjax.operations.logarithms import default_float, exp, finite_or_zero
from mpfjax.operations.random import split
from mpfjax.operations.stored import apart, stored, take, whole

# A particle that the first observation tells nothing of keeps a quarter of its chance, so that no
# weight is more than four times the mean.
MOST_TRUST = 3 / 4
# A prior is wide where fewer draws fit y_1, and a smaller part of all.
FEWEST, LEAST_PART = 16, 1 / 64


class SelectInitial(AbstractMove):
    """An initial move that draws x_0 many times, and selects draws that explain y_1.

    K N draws of x_0 replace the N of the mixture. From each, x_1 is drawn twice. ν is the mean of
    the two likelihoods of y_1, shrunk towards the mean over all draws: the less the two likelihoods
    of a draw agree, the less information they contain on x_0 (`selection_weights`). N draws are
    selected with probabilities in proportion to ν, and weighted by 1 / ν, so that they represent
    x_0 as all draws do. Their total weight is part of the first increment, and Ẑ remains unbiased.
    A diffuse prior is covered as by K N particles, for 2 K further draws of x_1 in the whole run.

    Without an observation it does nothing. After it, the chain's `Resample` waits for y_1, because
    an earlier resampling would undo the selection.

    The filter's propagation draws and weights x_1.

    - `num_draws`: K.

    It must be the first of the `initial_moves`, before those that regroup. Raises `ValueError` for
    K < 1, and in a filter without `Propagate` or `PropagateNested`. Use it if the
    prior is somewhat broader than the likelihood; if it is far broader, use `with_initialisation`.
    """

    num_draws: Count = eqx.field(static=True)

    approximate = False
    keeps_families = False
    """what it keeps are no independent draws."""
    biases_score = False
    """any ν is exact, so that its derivative is not needed."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` if no move draws x_1 of each x_0."""
        require_propagation(now, "x_0 is chosen")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture of the chosen x_0, in one component; without y_1 the one given."""
        if now.observation is None:
            return mixture
        assert now.propagation is not None
        key_drawn, key_look, key_kept = split(key, 3)
        n, noise = mixture.num_particles, now.filter.initial_noise
        states = now.initial_law.sample_initial(key_drawn, self.num_draws * n, noise)
        # Stored, so that x_1 is drawn on vectors, and once, not wherever its likelihood is used.
        twice = single_component(states).repeat(2).map_slots(stored)
        log_factors = stored(now.propagation(key_look, twice, now).log_weights).reshape(-1, 2).T
        start = select(key_kept, states, log_factors, n, noise == "rqmc")
        return start.replace(num_components=mixture.num_components, memory=mixture.memory)

    def is_wide(self, log_weights: Float[np.ndarray, " n"]) -> bool:
        """Whether so few draws fit y_1 that chance decides the masses of modes.

        Their effective number is (Σ ν)² / Σ ν² over the K N draws, told from the weights of the N
        that were chosen in proportion to ν.
        """
        weights = np.exp(log_weights[log_weights > -np.inf].astype(float))
        number = self.num_draws * len(weights) / np.mean(1 / (len(weights) * weights))
        return bool(number < min(FEWEST, LEAST_PART * self.num_draws * len(log_weights)))


def require_propagation(now: Step, what: str) -> None:
    """Raise a `ValueError` for a filter none of whose moves draws x_t of each particle."""
    if now.propagation is None:
        which = "where Propagate or PropagateNested propagates, and none of its moves is one"
        raise ValueError(f"filter: {what} {which}")


def select(
    key: Key[Array, ""], states: PyTree, log_factors: Float[Array, "2 k"], size: int, in_order: bool
) -> ParticleMixture:
    """Of many draws a few, kept with probabilities in proportion to ν and weighing 1 / ν.

    The logarithm of their mass, of which 1 is the mean, is the mixture's `log_scale`.
    """
    trust = selection_weights(log_factors, jnp.ones_like(log_factors[0]))
    trust = stored(jax.lax.stop_gradient(trust))
    pool = single_component(states)
    order = sorted_order(pool, pool.component_indicators) if in_order else None
    weights = whole(trust if order is None else take(trust, order), 0.0)
    totals = jnp.sum(weights, keepdims=True)
    zero = jnp.zeros_like(totals)
    line = Line(pool.num_particles, weights, totals, zero, weights > 0, order, labels=None)
    targets = jnp.full(1, size, jnp.int32)
    indices = draw_ancestors(key, line, targets, "systematic", num_slots=size).particles
    # No ν is below a quarter, so that their inverses need no logarithms to be summed.
    trust = take(trust, indices).astype(default_float())
    total = jnp.sum(1 / trust)
    particles = jax.tree.map(lambda leaf: take(leaf, indices), states)
    return single_component(particles).replace(
        log_weights=-jnp.log(trust * total), log_scale=jnp.log(total / size)
    )


def selection_weights(
    log_factors: Float[Array, "2 n"], weights: Float[Array, " n"]
) -> Float[Array, " n"]:
    """ν of each particle, with a weighted mean of 1, from two draws of its likelihood.

    Let r be the correlation of the two draws. The mean of both tells E[L | x] with the reliability
    ρ = 2 r / (1 + r) (Spearman 1910, Brown 1910), and 1 + ρ (L̄_i / L̄ - 1) is its best linear
    predictor (Kelley 1927). Where a draw is mostly noise, ρ is near zero and all x are alike.
    Particles without weight do not count, nor do likelihoods that are no number.
    """
    log_factors = jnp.where((weights > 0)[None] & (log_factors < jnp.inf), log_factors, -jnp.inf)
    # Apart, so that the exponentials are taken on vectors, and once.
    first, second = apart(exp, log_factors - finite_or_zero(jnp.max(log_factors)))
    # All sums in one product: each one alone would be a kernel. Where the likelihoods are so much
    # alike that it loses their differences to rounding, trust in these does not matter.
    rows = jnp.stack([first, second, jnp.ones_like(weights)])
    sums = jnp.matmul(weights[None] * rows, rows.T, precision=jax.lax.Precision.HIGHEST)
    number = jnp.where(sums[2, 2] > 0, sums[2, 2], 1.0)
    mean = (sums[0, 2] + sums[1, 2]) / (2 * number)
    common = number * mean**2
    shared, total = sums[0, 1] - common, (sums[0, 0] + sums[1, 1]) / 2 - common
    correlation = jnp.clip(shared / jnp.where(total > 0, total, 1.0), 0.0, 1.0)
    trust = jnp.where(mean > 0, jnp.minimum(2 * correlation / (1 + correlation), MOST_TRUST), 0.0)
    ratios = (first + second) / jnp.where(mean > 0, 2 * mean, 1.0)
    return 1 + trust * (ratios - 1)
