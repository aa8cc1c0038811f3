"""Filters whose noise is a point set over slot and noise: how exact, and on what states."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax import Propagate, PropagateNested, Resample
from tests.examples import AT_START, make_mixture
from tests.marking import quick_of
from tests.user_models import DRIFT_AS_LINEAR_GAUSSIAN, Drift

KEY = jax.random.key(0)
QUADRATIC = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)


@pytest.mark.weekly
def test_the_error_of_the_evidence_falls_faster_than_that_of_independent_noise():
    """Sobol points in the plane, particles along a Hilbert curve; 400 runs give sd to 3.5%."""
    model, seen = DRIFT_AS_LINEAR_GAUSSIAN, jnp.linspace(-1.0, 1.5, 10)[:, None]

    @cache
    def deviation(noise, num_particles):
        filter = mpfjax.particle_filter(model, num_particles, noise=noise)
        keys = jax.random.split(KEY, 400)
        run = mpfjax.monte_carlo(keys, filter, seen, lambda mixture: None)
        return np.asarray(run.log_marginal_likelihood, float).std()

    # An error of 5% in each ratio; it is 0.47 at N = 512.
    assert deviation("rqmc", 512) < 0.6 * deviation("independent", 512)
    # With independent noise it would be 1 / √8, which is 0.35; it is 0.25.
    assert deviation("rqmc", 512) < 0.31 * deviation("rqmc", 64)


# Steps that nothing has resampled or sorted: the same index must not serve a slot again. Errors of
# independent noise fall as 1 / √N, and those of point sets, which are at most as large, as fast.
SIZE, NAN = 16_000, np.nan
WALK = mpfjax.LinearGaussianModel(A=[[1.0]], Q=[[1.0]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
FOUR = np.array([[0.7], [0.3], [1.5], [0.5]])
OF_GAP = scipy.stats.multivariate_normal.logpdf([0.7, 1.5], np.zeros(2), [[3.0, 2], [2, 5.0]])
# The place at s and that at t have 1 + min(s, t) in common; each is seen with an error of one.
SHARED = 1 + np.minimum(*np.ogrid[1:5, 1:5]) + np.eye(4)
OF_FOUR = scipy.stats.multivariate_normal.logpdf(FOUR[:, 0], np.zeros(4), SHARED)


def variance(mixture):
    states = mixture.particles[:, 0]
    return mixture.expectation((states - mixture.expectation(states)) ** 2)


def below(mixture):
    return mixture.expectation(mixture.particles < 0)


def pf():
    return mpfjax.particle_filter(WALK, SIZE, noise="rqmc")


def never_resampled():
    return mpfjax.Filter(WALK, [PropagateNested(Propagate(noise="rqmc"), 2)], SIZE)


# A filter, observations, what is estimated (None is log Ẑ), its exact value, and √N times the most
# that its error may be. Of N draws, a variance has an error of √(2 / N) of itself.
DEALT_ANEW = {
    "variance of a forecast": (
        pf, [[0.7], [NAN], [NAN]], variance, 8 / 3, 1.5 * 8 / 3 * np.sqrt(2)
    ),
    "evidence after a gap": (pf, [[0.7], [NAN], [1.5]], None, OF_GAP, 0.8),
    "families": (never_resampled, FOUR, None, OF_FOUR, 2.4),
    "masses after a gap": (
        lambda: mpfjax.mixture_particle_filter(QUADRATIC, SIZE, 4, noise="rqmc"),
        [1.0, 0.9, NAN, 1.1, 1.0], below, 0.5, 0.5,
    ),

}  # fmt: skip


QUICK = ("families",)


@pytest.mark.exactness
@pytest.mark.parametrize("name", quick_of(DEALT_ANEW, QUICK, one_in=3))
def test_errors_are_at_most_those_of_independent_noise_where_nothing_is_sorted(name):
    make, observations, collect, exact, bound = DEALT_ANEW[name]
    collected = collect or (lambda mixture: None)
    keys, seen = jax.random.split(jax.random.key(5), 16), np.array(observations, np.float32)
    run = mpfjax.monte_carlo(keys, make(), mpfjax.Series.skipping(seen), collected)
    found = run.log_marginal_likelihood if collect is None else run.collected[:, -1]
    errors = np.asarray(found, float) - exact
    assert np.sqrt(np.mean(errors**2)) < bound / np.sqrt(SIZE)


@pytest.mark.exactness
def test_without_an_observation_the_noise_is_a_point_set_as_well():
    filter = mpfjax.particle_filter(QUADRATIC, 512, noise="rqmc")
    mixture = filter.init(KEY)
    start = filter.step(KEY, mixture, jnp.array(1.0))[0].replace(particles=jnp.zeros(512))
    spreads = [np.std(filter.predict(key, start)[0].particles) for key in jax.random.split(KEY, 8)]
    assert np.std(spreads) < 0.01 * np.mean(spreads)


@eqx.filter_jit
def resampled(mixture, along_curve=True):
    return Resample(along_curve=along_curve)(KEY, mixture, AT_START)


@pytest.mark.exactness
@pytest.mark.parametrize("dimension", [1, 2])
def test_particles_of_a_component_stand_near_their_neighbours(dimension):
    """The way through all particles in turn is far shorter than in the order that they had."""
    rng = np.random.default_rng(0)
    states, labels = rng.normal(size=(400, dimension)), rng.integers(0, 3, 400)
    states += 50 * labels[:, None]
    mixture = make_mixture(states, np.zeros(400), labels, 3)

    def way(mixture):
        within = np.diff(mixture.component_indicators) == 0
        steps = np.diff(np.asarray(mixture.particles), axis=0)
        return np.linalg.norm(steps, axis=1)[within].sum()

    plain, sorted_ = resampled(mixture, False), resampled(mixture)
    assert way(sorted_) < 0.3 * way(plain)
    assert (np.diff(sorted_.component_indicators) >= 0).all()


def test_many_coordinates_are_sorted_along_the_first_principal_ones():
    """25 numbers that two others make, in units of their own, and with an empty slot."""
    rng = np.random.default_rng(0)
    causes = rng.normal(size=(400, 2))
    states = causes @ rng.normal(size=(2, 25)) + 0.05 * rng.normal(size=(400, 25))
    states, log_weights = states * 10.0 ** np.arange(-12, 13), np.zeros(400)
    states[7], log_weights[7] = np.nan, -np.inf
    mixture = make_mixture(states, log_weights, np.zeros(400, int), 1)
    ancestors = np.asarray(resampled(mixture).ancestor_indices)
    assert 7 not in ancestors

    def way(order):
        return np.linalg.norm(np.diff(causes[order], axis=0), axis=1).sum()

    # 1 without the sorting; the third component is noise, which lengthens the way.
    assert way(ancestors) < 0.4 * way(np.sort(ancestors))


def test_standardised_coordinates_make_units_immaterial():
    rng = np.random.default_rng(1)
    states, labels = rng.normal(size=(200, 3)), rng.integers(0, 6, 200)
    ancestors = [
        resampled(make_mixture(states * unit, np.zeros(200), labels, 6)).ancestor_indices
        for unit in (1.0, np.array([2.0**-9, 1.0, 2.0**12]))
    ]
    np.testing.assert_array_equal(*ancestors)


@pytest.mark.exactness
def test_components_of_one_particle_and_all_particles_at_one_point():
    propagate = eqx.filter_jit(Propagate(noise="rqmc"))
    now = mpfjax.Step(Drift(), jnp.array(0.5))
    labels = np.array([0, 1, 2, 3, 4, 4, 4, 4, 4, 4])
    for states in (np.ones((10, 2)), np.arange(20.0).reshape(10, 2)):
        mixture = make_mixture(states, np.zeros(10), labels, 5)
        moved = propagate(KEY, resampled(mixture), now)
        assert np.isfinite(moved.particles).all()
        assert len(np.unique(moved.particles[:, 0])) == 10


class OneSided(mpfjax.QuadraticModel):
    """A subclass that draws another x_0, and inherits how the old one was made of noise."""

    def sample_initial(self, key, num_particles):
        return jnp.full(num_particles, 1.5) + 0 * super().sample_initial(key, num_particles)


@pytest.mark.exactness
def test_x_0_is_a_point_set_unless_it_has_another_law():
    filter = mpfjax.particle_filter(OneSided(0.3, 0.5), 20, noise="rqmc")
    np.testing.assert_array_equal(filter.init(KEY).particles, 1.5)
    model = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0, initial_draw="independent")
    start = mpfjax.particle_filter(model, 100, noise="rqmc").init(KEY)
    assert np.diff(np.sort(start.particles)).max() < 4 * 4.0 / 100
