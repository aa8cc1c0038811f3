"""Standard errors of log Ẑ, mixture weights and means: by Eve indices, or from a batch of runs.

The Eve index of a particle is the particle of x_0 from which it descends. A filter keeps them only
if an `EveIndices` is in the memory of the mixture of x_0.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.checks import checked
from mpfjax.filter import Filter
from mpfjax.memory import Memory, Offspring
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove, Step, all_of, check_keep_parents
from mpfjax.operations.islands import num_islands
from mpfjax.operations.logarithms import log_sum_exp
from mpfjax.operations.segments import segment_sum
from mpfjax.operations.stored import take
from mpfjax.running.results import FilterRun

EVE_INDICES = "eve_indices"  # the name in a mixture's memory
# Standard errors from fewer runs are not reliable.
FEWEST_RUNS = 4
# What the estimates hold for. Draws that are more even vary less than they say, or more.
_INDEPENDENT = {"scheme": "multinomial", "noise": "independent", "initial_noise": "independent"}


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
        log_pair_factors = jnp.zeros((m, m), mixture.log_weights.dtype)
        return cls(jnp.arange(n, dtype=jnp.int32), jnp.zeros(n, jnp.int32), log_pair_factors)

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

    def after_step(self, mixture: ParticleMixture, now: Any) -> tuple[Memory, dict[str, PyTree]]:
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
    masses = eve.family_masses(mixture.weights, pairs, m * m).reshape(m, m, -1)
    totals = jnp.sum(masses, axis=2)
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


class _KeepEveIndices(AbstractMove):
    """Puts an `EveIndices` into the mixture of x_0, which `Resample` then keeps up to date."""

    approximate = False
    biases_score = False
    weighs = False
    keeps_mass = True

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a chain of which the errors of one run are not known."""
        filter = now.filter
        check_keep_parents("filter", filter.moves, "with_eve_indices")
        moves = [move for move in (*filter.initial_moves, *filter.moves) if move is not self]
        for move in all_of(moves):
            if move.approximate or not move.keeps_families:
                name = type(move).__name__
                raise ValueError(f"filter: {name} is approximate or draws in a way of its own")

        # Draws that are more even than independent ones are not what the formulae are made of.
        def draws(node: Any) -> bool:
            return hasattr(node, "scheme") or hasattr(node, "noise")

        for part in [filter, *jax.tree.leaves(moves, is_leaf=draws)]:
            for option, independent in _INDEPENDENT.items():
                chosen = getattr(part, option, independent)
                if chosen != independent:
                    name = "the filter" if part is filter else type(part).__name__
                    which = f"{chosen!r}, not {independent!r}"
                    raise ValueError(f"filter: {option} of {name} is {which}")

    def around(self, reference: Any) -> AbstractMove:
        """Raise a `ValueError`: in conditional SMC one particle is not drawn."""
        raise ValueError("filter: with_eve_indices cannot keep a trajectory, which is not drawn")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture with a memory in which every particle is its own Eve."""
        return mixture.replace(memory=mixture.memory | {EVE_INDICES: EveIndices.of(mixture)})


@checked
def with_eve_indices(filter: Filter) -> Filter:
    """A copy of the filter that also stores the Eve index of each particle.

    Draws and weights are identical to the bit, except that no `SelectInitial` selects x_0, because
    its draws are not independent. A step takes O(N) more memory and time, and the runs can be
    passed to `log_marginal_likelihood_variance` and `mixture_weight_errors`. `StepInfo` then has
    both errors at every step. Raises `ValueError` for anything but a filter, for a filter whose
    particles have no single ancestors or whose Ẑ is not unbiased (one with an approximate move,
    `PropagateIndependently`, `PropagateInClusters` or `IslandInteraction`), and for draws that are
    not independent: a scheme other than "multinomial", or a noise other than "independent".
    """
    others = (move for move in filter.initial_moves if not isinstance(move, _KeepEveIndices))
    initial_moves = [move for move in others if not move.weighs]
    return filter.replace(initial_moves=[*initial_moves, _KeepEveIndices()])


@checked
def log_marginal_likelihood_variance(run: FilterRun | ParticleMixture) -> Float[Array, ""]:
    """An estimate of the variance of log Ẑ, from one run of `with_eve_indices(filter)`.

    Particles with different ancestors in x_0 are nearly independent. The fewer families have most
    of the weight, the more Ẑ varies (Chan and Lai 2013). A family is all descendants of one
    particle of x_0. For one component the estimate is that of Lee and Whiteley (2018), section 3:
    with S_e the weight of all descendants of particle e of x_0, and r resamplings so far,

        V = 1 - (N / (N - 1))^(r + 1) (1 - Σ_e S_e²).

    Ẑ² (1 - V) is then an unbiased estimate of Z², for any N, and N V is consistent for N times the
    relative variance of Ẑ. If log Ẑ is normal with variance s², then E[Ẑ²] / Z² = exp(s²), so s² =
    -log(1 - V). The function returns the first two terms of this, V + V² / 2. Further terms would
    add more noise than they remove bias. V alone is too small unless s² is small: on the quadratic
    model, with an MPF of 1000 particles after 100 steps, the mean of V is .83 s², and that of V +
    V² / 2 is .98 s². A single estimate may be negative.

    In a mixture, components are resampled separately. Two offspring in different components are
    drawn independently of each other. Of the pairs of offspring in the same component, with k_m
    draws, only a fraction (k_m - 1) / k_m are different draws. Hence a pair is weighted by the
    product of k_m / (k_m - 1) over the resamplings of components that contained both ancestors:

        V = 1 - N / (N - 1) Σ_{i, j without common Eve index} W_i W_j Π k_m / (k_m - 1).

    The products of all pairs would be O(N²) numbers. They are averaged over the pairs of each two
    components, which are M² numbers, and exact for one component or if all components are pooled
    before resampling (DPS). Resampling between objects within `Partitioned` is included.

    This holds for x_0 drawn independently and for scheme "multinomial", with any `ess_threshold`.
    The other schemes draw more evenly than the independent draws of the formula, and no consistent
    estimate is known for them. For "systematic" V is far too small: with N = 1000 and t = 100 it
    was a seventh of the variance for a PF on a linear Gaussian model, and negative for an MPF on
    the quadratic one. The estimate requires several families. If t is not much less than N, few are
    left. With one family it is 1.5, regardless of the true variance. A component of one particle,
    which has no pair, is omitted from the product.

    - `run`: a `FilterRun`, or a mixture that `step` returned. Use `jax.vmap` for the results of
      `monte_carlo`.

    The estimate is inf for a run with a step of zero likelihood, whose log Ẑ is -inf. Raises
    `ValueError` for a run of a filter without Eve indices, and one of islands. Use it to choose N:
    particle Metropolis-Hastings works best with a variance of about one (Doucet et al. 2015).
    """
    degenerate = run.degenerate if isinstance(run, FilterRun) else jnp.zeros(1, bool)
    return jnp.where(jnp.any(degenerate), jnp.inf, _evidence_variance(_with_lineage(run)))


@checked
def mixture_weight_errors(run: FilterRun | ParticleMixture) -> Float[Array, " m"]:
    """The standard error of each mixture weight π_m, from a run of `with_eve_indices(filter)`.

    It is the standard deviation of π_m over runs of the same filter. π_m is the estimate of the
    probability of an event, that a particle is in component m, and its variance is that of Lee and
    Whiteley (2018), section 4, for a normalised estimate: the formula of
    `log_marginal_likelihood_variance` with W_i (1[c_i = m] - π_m) instead of the weights,

        V_m = - N / (N - 1) Σ_{i, j without common Eve index} u_i u_j Π k_m / (k_m - 1).

    For one common resampling it is the sum over families of (S_em - π_m S_e)², where S_em is the
    part of family e that is in component m.

    It shows whether the data decide between two explanations: 0.7 ± 0.3 decides nothing. It holds
    under the same conditions as `log_marginal_likelihood_variance`: multinomial draws. It treats
    the components as fixed, so it does not account for runs that would have grouped the particles
    in another way. It is too small if few families are left: a component whose ancestors' families
    are in no other component appears certain. If V_m is negative, its root is returned as zero.

    - `run`: a `FilterRun`, or a mixture that `step` returned. `StepInfo.mixture_weight_errors` has
      them at every step. In `collect`, apply it to each mixture.

    Raises `ValueError` for a run of a filter without Eve indices, and one of islands. Use it to see
    whether a mixture weight is reliable.
    """
    return jnp.sqrt(jnp.maximum(_mass_variances(_with_lineage(run)), 0.0))


_evidence_variance = eqx.filter_jit(evidence_variance)
_mass_variances = eqx.filter_jit(mass_variances)


def _with_lineage(run: FilterRun | ParticleMixture) -> ParticleMixture:
    """The last mixture of a run; a `ValueError` unless it has Eve indices in common."""
    mixture = run.final if isinstance(run, FilterRun) else run
    if EVE_INDICES not in mixture.memory:
        raise ValueError("run: its filter stores no Eve indices; build it by with_eve_indices")
    if mixture.memory[EVE_INDICES].indices.ndim != 1:
        raise ValueError("run: islands, or several runs, have no Eve indices in common")
    return mixture


class BatchEstimate(NamedTuple):
    """Estimates from a batch of runs, with their standard errors.

    - `value` and `error`: the expectation, and its standard error.
    - `log_marginal_likelihood` and `log_marginal_likelihood_error`: log of the mean of Ẑ.
    - `effective_runs`: (Σ Ẑ)² / Σ Ẑ²: below about a third of the runs, the errors themselves are
      too small.
    """

    value: Float[Array, " *shape"]
    error: Float[Array, " *shape"]
    log_marginal_likelihood: Float[Array, ""]
    log_marginal_likelihood_error: Float[Array, ""]
    effective_runs: Float[Array, ""]


@checked
def batch_estimate(
    runs: FilterRun, quantity: Callable[[ParticleMixture], Float[Array, " *shape"]]
) -> BatchEstimate:
    """An expectation and log Z from B independent runs, each with its standard error.

    The runs are treated as one particle filter of B islands that do not interact: run b has the
    weight Ẑ_b, so that

        q = Σ_b Ẑ_b q_b / Σ_b Ẑ_b,   Ẑ = Σ_b Ẑ_b / B,

    and Ẑ is unbiased (Vergé et al. 2015). The errors are those of the jackknife over runs (Efron
    1982), (B - 1) / B Σ_b (q_(b) - mean of q_(.))², with q_(b) the estimate without run b. They
    require only independent runs, and hold for every scheme, noise and move. (`with_eve_indices`
    requires multinomial draws.)

    - `runs`: the result of `monte_carlo` for B keys, four or more. Twelve to thirty runs of N / B
      particles each are a good choice. Use enough particles that log Ẑ of a single run has a
      standard deviation of about one or less. Otherwise a few runs have most of the weight; see
      `effective_runs`.
    - `quantity`: a function of one mixture, such as `lambda m: m.expectation(m.particles > 0)`. For
      the weight of a mode use the probability of a region or an event, because the labels of
      components differ between runs.

    Runs of zero likelihood have no weight. Raises `ValueError` for fewer runs, and for anything but
    a stack of runs. Use it to see whether a mixture weight can be trusted.
    """
    number = runs.log_marginal_likelihood.size
    if runs.log_marginal_likelihood.ndim != 1 or number < FEWEST_RUNS:
        raise ValueError(f"runs: {number}; a standard error requires at least {FEWEST_RUNS}")
    logs = runs.log_marginal_likelihood
    values = jax.vmap(quantity)(runs.final)
    # Each run is left out in turn; a difference of sums would be lost to rounding.
    stays = jnp.concatenate([jnp.ones((1, number), bool), ~jnp.eye(number, dtype=bool)])
    log_evidences = jnp.where(stays, logs[None], -jnp.inf)
    shares = jax.nn.softmax(log_evidences, axis=1).astype(values.dtype)
    estimates = jax.vmap(lambda row: jnp.tensordot(row, values, axes=1))(shares)
    number_left = jnp.sum(stays, axis=1).astype(logs.dtype)
    log_z = jax.vmap(log_sum_exp)(log_evidences) - jnp.log(number_left)
    effective_runs = 1 / jnp.sum(jax.nn.softmax(logs) ** 2)
    errors = _jackknife(estimates[1:]), _jackknife(log_z[1:])
    return BatchEstimate(estimates[0], errors[0], log_z[0], errors[1], effective_runs)


def _jackknife(without: Float[Array, "b *shape"]) -> Float[Array, " *shape"]:
    number = without.shape[0]
    centred = without - jnp.mean(without, axis=0, keepdims=True)
    return jnp.sqrt((number - 1) / number * jnp.sum(centred**2, axis=0))
