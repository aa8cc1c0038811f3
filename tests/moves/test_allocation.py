"""How the components share the slots: by what the variance of their masses asks for."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import (
    QuadraticModel,
    Resample,
    mixture_particle_filter,
    run_filter,
    with_resampling,
)
from mpfjax.moves.resampling.allocation import EQUAL_PARTS, FEWEST, demands_by_variance
from mpfjax.moves.resampling.line import in_line
from tests.examples import make_mixture
from tests.marking import thorough

MOVE = Resample()


@eqx.filter_jit
def _resampled(move, mixture):
    due = move.would_resample(mixture)
    line = in_line(mixture, ~due[mixture.component_indicators])
    targets = move.deal(mixture, line, due)
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


@pytest.mark.parametrize("masses", [[0.5, 0.3, 0.2], *thorough([[0.9, 0.099, 0.001]])])
def test_z_has_nearly_the_least_variance(masses):
    """Beside ways to share that are drawn at random, with large components: nothing is shrunk."""
    mixture = three_components(masses, (1.5, 1.0, 0.2), n=4000)
    variances = 4000 / np.asarray(mixture.component_effective_sample_sizes)
    ways = np.random.default_rng(0).dirichlet(np.ones(3), size=20_000)

    def variance(shares):
        return np.sum(np.square(masses) * variances / shares, axis=-1)

    asked = demands_by_variance(
        mixture.log_mixture_weights, mixture.component_effective_sample_sizes,
        mixture.component_counts, mixture.active, mixture.num_usable_slots,
    )  # fmt: skip
    found = variance(np.asarray(asked))
    assert found <= np.min(variance(ways)) / (1 - EQUAL_PARTS[0])
    assert found < 0.9 * variance(np.full(3, 1 / 3))


@pytest.mark.parametrize(("spread", "part"), [(0.0, EQUAL_PARTS[0]), (2.0, EQUAL_PARTS[1])])
def test_a_component_of_no_mass_keeps_its_equal_part(spread, part):
    """It is more where a likelihood is narrow, which leaves few effective particles."""
    found = dealt(three_components((0.5, 0.5, 1e-12), (spread, spread, spread), n=100))
    assert found.sum() == 300
    assert abs(found[2] - 100 * part) <= 1


def test_between_these_parts_as_much_is_shared_equally_as_keeps_ten_effective_particles():
    mixture = three_components((0.5, 0.5, 1e-12), (0.8, 0.8, 0.8), n=50)
    sizes = np.asarray(mixture.component_effective_sample_sizes)
    expected = FEWEST * np.mean(50 / sizes)
    assert 50 * EQUAL_PARTS[0] < expected < 50 * EQUAL_PARTS[1]
    assert abs(dealt(mixture)[2] - expected) <= 1


def test_equal_masses_share_by_the_spread_of_their_weights():
    found = dealt(three_components((1.0, 1.0, 1.0), (0.0, 0.0, 1.5), n=400))
    assert abs(found[0] - found[1]) <= 1
    assert found[2] > 1.3 * found[0]


def test_dead_components_get_nothing_and_what_is_not_due_stays():
    mixture = three_components((0.7, 0.3, 1.0), (0.0, 2.5, 2.5))
    alive = mixture.replace(
        log_weights=jnp.where(mixture.component_indicators == 2, -jnp.inf, mixture.log_weights)
    )
    found = dealt(alive, Resample(ess_threshold=0.5))
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


def test_an_allocation_of_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="allocation"):
        Resample(allocation="mass")


def test_where_particles_are_few_all_is_shared_equally():
    mixture = three_components((0.98, 0.01, 0.01), (1.0, 2.0, 0.0), n=FEWEST)
    assert list(dealt(mixture)) == [FEWEST] * 3


def test_a_mixture_of_few_particles_draws_as_with_equal_shares():
    model = QuadraticModel(0.3, 0.5, -2.0, 2.0)
    filter = mixture_particle_filter(model, 20, 2)
    runs = [
        run_filter(
            jax.random.key(0), with_resampling(filter, Resample(allocation=allocation)), jnp.ones(5)
        ).log_marginal_likelihood
        for allocation in ("variance", "equal")
    ]
    assert runs[0] == runs[1]
