"""How the components share the slots: by what the variance of their masses asks for."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import QuadraticModel, Resample, mixture_particle_filter, run_filter
from mpfjax.moves.resampling.allocation import FEWEST, LEAST_SHARE, demands_for_least_error
from tests.examples import make_mixture
from tests.marking import thorough

MOVE = Resample(allocation="variance")
LEAST_ERROR = Resample(allocation="least_error")


@eqx.filter_jit
def _resampled(move, mixture):
    due = move.is_due(mixture)
    targets = move.deal(mixture, due, mixture.component_counts)
    return targets, move(jax.random.key(0), mixture)


def dealt(mixture, move=MOVE):
    """How many slots each component has after resampling."""
    targets, moved = _resampled(move, mixture)
    np.testing.assert_array_equal(moved.component_counts, targets)
    return np.asarray(targets)


def three_components(masses, spreads, n=40):
    """Components of these masses, whose log-weights have these standard deviations."""
    labels = np.repeat(np.arange(3), n)
    log_weights = np.random.default_rng(1).normal(size=3 * n) * np.repeat(spreads, n)
    for label, mass in enumerate(masses):
        own = labels == label
        log_weights[own] += np.log(mass) - np.log(np.exp(log_weights[own]).sum())
    return make_mixture(np.zeros((3 * n, 1)), log_weights, labels, 3)


def test_no_other_numbers_leave_less_variance_of_the_sum_of_the_masses():
    """Against every way to deal twelve slots to three components, by brute force."""
    rng = np.random.default_rng(3)
    labels, values = np.repeat([0, 1, 2], 4), rng.exponential(size=12) ** 2
    mixture = make_mixture(np.zeros((12, 1)), np.log(values), labels, 3)
    seconds = np.array([4 * np.sum(values[labels == m] ** 2) for m in range(3)])
    ways = [way for way in itertools.product(range(1, 13), repeat=3) if sum(way) == 12]
    variances = [float(np.sum(seconds / np.array(way))) for way in ways]
    found = tuple(int(number) for number in dealt(mixture))
    # The numbers in proportion are rounded, which costs a few in a hundred of so few slots.
    assert variances[ways.index(found)] <= 1.05 * min(variances)
    assert variances[ways.index((4, 4, 4))] > 1.1 * min(variances)


def test_a_component_of_no_mass_keeps_its_least_share():
    found = dealt(three_components((0.5, 0.5, 1e-12), (1.0, 1.0, 1.0)))
    assert found.sum() == 120
    assert found[2] == 120 // (3 * LEAST_SHARE)


def test_equal_masses_share_by_the_spread_of_their_weights():
    found = dealt(three_components((1.0, 1.0, 1.0), (0.0, 0.0, 1.5)))
    assert abs(found[0] - found[1]) <= 1
    assert found[2] > 1.3 * found[0]


def test_dead_components_get_nothing_and_what_is_not_due_stays():
    mixture = three_components((0.7, 0.3, 1.0), (0.0, 2.5, 2.5))
    alive = mixture.replace(
        log_weights=jnp.where(mixture.component_indicators == 2, -jnp.inf, mixture.log_weights)
    )
    found = dealt(alive, Resample(ess_threshold=0.5, allocation="variance"))
    assert list(found) == [40, 80, 0]


@pytest.mark.parametrize("n", [1, 3, *thorough([2, 4, 29])])
def test_fewer_slots_than_components_fill_up_all_the_same(n):
    rng = np.random.default_rng(n)
    mixture = make_mixture(np.zeros((n, 1)), rng.normal(size=n), rng.integers(0, 8, n), 8)
    found = dealt(mixture)
    assert found.sum() == n
    assert (found >= np.asarray(mixture.active)).all()


def group(states):
    return states[:, 0].astype(jnp.int32)


@pytest.mark.parametrize(
    ("groups", "expected"),
    [((0, 0, 1), [30, 30, 60]), ((0, 1, 0), [30, 60, 30]), ((4, 4, 4), [40, 40, 40])],
)
def test_groups_share_equally_and_so_do_the_components_of_a_group(groups, expected):
    mixture = three_components((0.9, 0.01, 0.09), (1.0, 2.0, 0.0))
    labels = jnp.asarray(groups, jnp.float32)[mixture.component_indicators]
    found = dealt(mixture.replace(particles=labels[:, None]), Resample(share_by=group))
    # A tenth of an equal share over all is dealt first.
    np.testing.assert_allclose(found, expected, atol=2)
    assert found.sum() == 120


def test_a_dead_component_takes_nothing_from_its_group():
    mixture = three_components((0.5, 0.3, 0.2), (1.0, 1.0, 1.0))
    labels = jnp.asarray((0.0, 0.0, 1.0))[mixture.component_indicators]
    log_weights = jnp.where(mixture.component_indicators == 1, -jnp.inf, mixture.log_weights)
    alive = mixture.replace(particles=labels[:, None], log_weights=log_weights)
    np.testing.assert_allclose(dealt(alive, Resample(share_by=group)), [60, 0, 60], atol=1)


def test_groups_that_would_have_no_say_are_refused():
    with pytest.raises(ValueError, match=r"share_by.*particles_per_component is 5"):
        Resample(particles_per_component=5, share_by=group)
    with pytest.raises(ValueError, match="allocation"):
        Resample(allocation="variance", share_by=group)


def test_an_allocation_beside_a_fixed_number_or_of_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match=r"allocation: 'variance'.*particles_per_component is 5"):
        Resample(particles_per_component=5, allocation="variance")
    with pytest.raises(ValueError, match="allocation"):
        mixture_particle_filter(QuadraticModel(0.3, 0.5, -2.0, 2.0), 10, 2, allocation="mass")


def criteria(masses, variances):
    """Variances of log Ẑ if all is settled later, and of the mixture weights, by slots."""
    jacobian = np.diag(masses) - np.outer(masses, masses)
    settled, of_weights = masses * variances, np.sum(jacobian**2, axis=0) * variances
    return [lambda slots, a=a: np.sum(a / slots, axis=-1) for a in (settled, of_weights)]


@pytest.mark.parametrize("masses", [[0.5, 0.3, 0.2], *thorough([[0.9, 0.099, 0.001]])])
def test_the_least_error_is_within_twice_the_least_of_each_criterion(masses):
    """Beside ways to share that are drawn at random, with large components: nothing is shrunk."""
    mixture = three_components(masses, (0.2, 1.0, 1.5), n=4000)
    sizes = np.asarray(mixture.component_effective_sample_sizes)
    demands, _ = demands_for_least_error(mixture, mixture.active)
    ways = np.random.default_rng(0).dirichlet(np.ones(3), size=20_000)
    found = np.asarray(demands) / np.sum(np.asarray(demands))
    for criterion in criteria(np.array(masses), 4000 / sizes):
        assert criterion(found) <= 2 * np.min(criterion(ways))


def test_of_two_components_the_one_that_seems_hopeless_keeps_a_quarter():
    """Its mass may be off as much as that of the other, whatever the other has."""
    labels = np.repeat([0, 1], 60)
    log_weights = np.where(labels == 0, 0.0, -25.0)
    found = dealt(make_mixture(np.zeros((120, 1)), log_weights, labels, 2), LEAST_ERROR)
    assert found.sum() == 120
    assert 30 <= found[1] <= 40


def test_where_particles_are_few_the_least_error_shares_equally():
    mixture = three_components((0.98, 0.01, 0.01), (1.0, 2.0, 0.0), n=FEWEST)
    assert list(dealt(mixture, LEAST_ERROR)) == [FEWEST] * 3


def test_narrow_likelihoods_leave_a_hopeless_component_half_an_equal_share():
    """Of three, the lightest asks for nothing; it gets more, the fewer effective ones there are."""
    masses = (0.5, 0.5, 1e-12)
    wide = dealt(three_components(masses, (0.0, 0.0, 0.0), n=400), LEAST_ERROR)
    narrow = dealt(three_components(masses, (2.0, 2.0, 2.0), n=400), LEAST_ERROR)
    assert wide[2] == FEWEST
    assert 5 * FEWEST < narrow[2] <= 200


def test_a_mixture_of_few_particles_draws_as_with_equal_shares():
    model = QuadraticModel(0.3, 0.5, -2.0, 2.0)
    runs = [
        run_filter(jax.random.key(0), mixture_particle_filter(model, 20, 2, allocation=allocation),
                   jnp.ones(5)).log_marginal_likelihood
        for allocation in ("least_error", "equal")
    ]  # fmt: skip
    assert runs[0] == runs[1]
