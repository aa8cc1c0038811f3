"""Point sets in steps that nothing has resampled: the same index must not serve a slot again.

Errors of independent noise fall as 1 / √N. Those of point sets are at most as large, and fall as
fast, where steps are not functions of each other.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax import Propagate, Resample
from mpfjax.exact import kalman_filter
from mpfjax.models.noise import draw_noise, stratified_normal
from mpfjax.operations.random import shuffled
from tests.marking import thorough

KEYS = jax.random.split(jax.random.key(5), 16)
WALK = mpfjax.LinearGaussianModel(A=[[1.0]], Q=[[1.0]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
SIZES = (1000, *thorough([8000]), 64_000)
NAN = jnp.nan


def runs_of(filter, observations, collect):
    return mpfjax.monte_carlo(KEYS, filter, jnp.array(observations), collect, missing="skip")


def rms(errors):
    return float(np.sqrt(np.mean(np.square(np.asarray(errors, float)))))


def variance(mixture):
    states = mixture.particles[:, 0]
    return mixture.average((states - mixture.average(states)) ** 2)


@pytest.mark.parametrize("size", SIZES)
def test_forecasts_have_the_right_variance(size):
    """x_3 given y_1 has the variance 2/3 + 2, and x_1 given nothing 2."""
    filter = mpfjax.particle_filter(WALK, size, noise="rqmc")
    for observations, exact in (([[0.7], [NAN], [NAN]], 8 / 3), ([[NAN]], 2.0)):
        found = runs_of(filter, observations, variance).collected[:, -1]
        # Of N independent draws, the variance has a standard error of √(2 / N) of itself.
        assert rms(found - exact) < 1.5 * exact * np.sqrt(2 / size), (observations, found)


@pytest.mark.parametrize("size", SIZES)
def test_the_evidence_after_a_missing_observation(size):
    """y_1 and y_3 are jointly normal; independent noise has an error of 1.1 / √N."""
    covariance = np.array([[3.0, 2.0], [2.0, 5.0]])
    exact = scipy.stats.multivariate_normal.logpdf([0.7, 1.5], np.zeros(2), covariance)
    filter = mpfjax.particle_filter(WALK, size, noise="rqmc")
    run = runs_of(filter, [[0.7], [NAN], [1.5]], lambda mixture: None)
    assert rms(run.log_marginal_likelihood - exact) < 0.8 / np.sqrt(size)


UNSORTED = {
    "never resampled": lambda size: [Resample(ess_threshold=0.0), Propagate(WALK, noise="rqmc")],
    "families": lambda size: [
        mpfjax.PropagateNested(Propagate(WALK, noise="rqmc"), 2),
    ],
}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", UNSORTED)
def test_the_evidence_where_nothing_is_resampled_nor_sorted(name, size):
    """Independent noise has errors of 1.6 / √N without families."""
    observations = jnp.array([[0.7], [0.3], [1.5], [0.5]])
    exact = float(kalman_filter(WALK, observations).log_marginal_likelihood)
    filter = mpfjax.Filter(WALK, UNSORTED[name](size), size)
    run = runs_of(filter, observations, lambda mixture: None)
    assert rms(run.log_marginal_likelihood - exact) < 2.4 / np.sqrt(size)


@pytest.mark.parametrize("size", SIZES)
def test_masses_of_a_mixture_after_a_missing_observation(size):
    """The modes ±1 are equally probable; independent noise has an error of 0.7 / √N."""
    model = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
    filter = mpfjax.mixture_particle_filter(model, size, 4, noise="rqmc")

    def below(mixture):
        return mixture.average(mixture.particles < 0)

    found = runs_of(filter, [1.0, 0.9, NAN, 1.1, 1.0], below).collected[:, -1]
    assert rms(found - 0.5) < 0.5 / np.sqrt(size)


class Drift(mpfjax.AbstractStateSpaceModel):
    """A velocity that regeneration redraws, and a place that sums it up; nothing is observed."""

    def sample_initial(self, key, num_particles):
        velocity = jax.random.normal(key, (num_particles,))
        return {"velocity": velocity, "place": jnp.zeros(num_particles)}

    def sample_transition(self, key, states):
        return states | {"place": states["place"] + states["velocity"]}

    def log_likelihood(self, observation, states):
        return 0.0 * states["place"]


@pytest.mark.parametrize("size", SIZES)
def test_regeneration_of_a_part_of_the_state_is_dealt_anew_as_well(size):
    """Velocities of three steps are independent of each other: their sum has variance 3.

    Its estimate has an error of √(30 / N) with independent noise, 18 of it from the spread of x_0.
    """
    redraw = mpfjax.GaussianRegeneration(where=lambda s: s["velocity"], noise="stratified")
    model = Drift()
    filter = mpfjax.Filter(model, [redraw, Propagate(model)], size)

    def place(mixture):
        return mixture.average(mixture.particles["place"] ** 2)

    found = runs_of(filter, np.zeros(3), place).collected[:, -1]
    assert rms(found - 3) < 1.6 * np.sqrt(30 / size)


def test_shuffled_indices_are_a_permutation_that_keeps_blocks_together():
    seeds = jax.random.bits(jax.random.key(0), (50,), jnp.uint32)
    num_digits, n = 10, 1 << 10
    places = eqx.filter_jit(jax.vmap(lambda seed: shuffled(jnp.arange(n), seed, num_digits)))
    found = np.asarray(places(seeds)).astype(int)
    np.testing.assert_array_equal(np.sort(found, axis=1), np.tile(np.arange(n), (50, 1)))
    for k in range(num_digits):
        blocks = (found >> k).reshape(50, -1, 1 << k)
        assert (blocks == blocks[:, :, :1]).all()


@pytest.mark.parametrize("d", [1, 3])
def test_noise_dealt_twice_is_independent_of_itself(d):
    """The mean product of the two draws of each slot has an error of 1 / √N, over rows and keys."""
    n, keys = 1000, jax.random.split(jax.random.key(3), 400)

    def rqmc(key):
        return draw_noise("rqmc", key, (n, d), jnp.dtype("float32"), shuffle=True)

    def stratified(key):
        return stratified_normal(key, (n, d), jnp.dtype("float32"))

    for draw in (rqmc, stratified):
        draws = np.asarray(jax.jit(jax.vmap(draw))(keys))
        products = np.mean(draws[0::2] * draws[1::2], axis=1)
        assert np.abs(products.mean(axis=0)).max() < 4 / np.sqrt(n * len(products))
        assert rms(products) < 1.5 / np.sqrt(n)
        # And still a point set: the mean of all rows is far more exact than of independent ones.
        assert rms(draws.mean(axis=1)) < 0.3 / np.sqrt(n)
