"""Starts and restarts, exact where the state is drawn anew, and the alarm."""

import warnings
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.moves.start.restart import Restart
from mpfjax.smoothing import smoothed_sums
from tests.marking import weekly
from tests.moves.start.test_sampler import PLANE, WithKeys
from tests.unbiased import assert_unbiased, ratios_to
from tests.user_models import ScalarLinear

KEY = jax.random.key(0)
STEPS, LENGTH, PROBABILITY = 9, 3, 0.01


def observations():
    rng = np.random.default_rng(0)
    places = np.array([3.0, 1.0]) + np.cumsum(0.1 * rng.normal(size=(STEPS, 2)), axis=0)
    return (places + 0.3 * rng.normal(size=(STEPS, 2))).astype(np.float32)


def mean(mixture):
    return mixture.mean()


class WithDensity(WithKeys):
    """With the density of a step."""

    def log_transition(self, states, previous_states):
        return jnp.sum(jax.scipy.stats.norm.logpdf(states, previous_states, 0.1), axis=1)


SEEN = observations()
GAPS = np.where(np.isin(np.arange(STEPS), [0, 5])[:, None], np.nan, SEEN)
# Carried away after six steps; the alarm rings at once, and the restart is by the next three.
CARRIED = np.concatenate([SEEN[:6], SEEN[:6] - 12.0])
PLAIN = mpfjax.mixture_particle_filter(WithDensity(), 100, 3)
START = mpfjax.with_initialisation(PLAIN, LENGTH)
restarts = partial(mpfjax.with_restarts, probability=PROBABILITY, num_observations=LENGTH)
FILTER = restarts(START)


@pytest.mark.exactness
def test_evidence_and_moments_are_unbiased_beyond_the_window():
    """Two observations are missing, the first among them."""
    series = mpfjax.Series.skipping(GAPS)
    runs = mpfjax.monte_carlo(jax.random.split(KEY, 300), START, series, mean)
    exact = kalman_filter(PLANE, series)
    increments = np.asarray(runs.log_likelihood_increments)
    assert (increments[:, : LENGTH - 1] == 0).all()
    ratios = ratios_to(exact, runs)
    assert_unbiased(ratios, loosest=0.05)
    assert_unbiased(ratios[:, None] * np.asarray(runs.collected)[:, -1], exact.means[-1])


def log_evidence_with_a_restart(seen, carried, model=PLANE):
    """log p(y), where the state began anew after so many steps with probability p."""
    alone, before, after = (
        kalman_filter(model, part).log_marginal_likelihood
        for part in (seen, seen[:carried], seen[carried:])
    )
    return jnp.logaddexp(np.log1p(-PROBABILITY) + alone, np.log(PROBABILITY) + before + after)


@pytest.mark.parametrize("islands", [1, *weekly([2])])
@pytest.mark.exactness
def test_evidence_and_moments_are_those_of_a_state_that_began_anew(islands):
    """Of a start by the first three observations, and one by those from the seventh on."""

    def run(key):
        filter = FILTER.replace(num_particles=60)
        return mpfjax.run_islands(key, filter, CARRIED, mean, num_islands=islands)

    keys = jax.random.split(KEY, 200)
    if islands == 1:
        runs = mpfjax.monte_carlo(keys, FILTER, CARRIED, mean)
    else:
        runs = jax.jit(jax.vmap(run))(keys)
    alarm = np.asarray(runs.alarm)
    assert alarm[:, 6:8].all()
    assert not alarm[:, 8:].any()
    ratios = ratios_to(log_evidence_with_a_restart(CARRIED, 6), runs)
    assert_unbiased(ratios, 1.0, loosest=0.05, errors=3.0)
    if islands == 1:
        means = kalman_filter(PLANE, CARRIED[6:]).means[-1]
        assert_unbiased(ratios[:, None] * np.asarray(runs.collected)[:, -1], means, loosest=0.5)


class Offset(WithDensity):
    """A large constant in each log-likelihood, and none at all far from the observation."""

    constant: float = 0.0
    reach: float = 1e9

    def log_likelihood(self, observation, states):
        log_density = super().log_likelihood(observation, states) + self.constant
        is_near = jnp.all(jnp.abs(states - observation[None]) < self.reach, axis=1)
        return jnp.where(is_near, log_density, -jnp.inf)


@pytest.mark.exactness
@pytest.mark.parametrize("change", [{"constant": -2e4}, {"reach": 10.0}], ids=["offset", "reach"])
def test_restarts_where_log_likelihoods_are_large_or_minus_infinity(change):
    plain = mpfjax.mixture_particle_filter(Offset(**change), 200, 3)
    filter = restarts(mpfjax.with_initialisation(plain, LENGTH))
    runs = mpfjax.monte_carlo(jax.random.split(KEY, 100), filter, CARRIED, mean)
    constants = change.get("constant", 0.0) * len(CARRIED)
    increments = np.asarray(runs.log_likelihood_increments, float)
    log_z = increments.sum(axis=1) - constants
    exact = float(log_evidence_with_a_restart(CARRIED, 6))
    assert abs(np.median(log_z) - exact) < 0.5
    means = kalman_filter(PLANE, CARRIED[6:]).means[-1]
    np.testing.assert_allclose(np.median(runs.collected[:, -1], axis=0), means, atol=0.1)
    assert np.asarray(runs.degenerate).any() == ("reach" in change)


@pytest.mark.exactness
def test_online_smoothing_ends_where_a_state_begins_anew():
    """Runs that begin anew in any case are refused before, as the matrix asks."""
    with pytest.raises(RuntimeError, match="restarts"):
        smoothed_sums(KEY, restarts(PLAIN), CARRIED, lambda before, now: now[:, 0])


def test_derivatives_are_refused():
    @eqx.filter_grad
    def score(model, filter):
        filter = filter.replace(model=model)
        return mpfjax.run_filter(KEY, filter, SEEN[:3], mean).log_marginal_likelihood

    filter = mpfjax.with_initialisation(mpfjax.particle_filter(PLANE, 20), LENGTH)
    with pytest.raises(ValueError, match="no derivatives"):
        score(PLANE, filter)
    assert any(move.biases_score for move in filter.moves)


def test_a_start_and_restarts_are_one_whichever_comes_first():
    both = restarts(START), mpfjax.with_initialisation(restarts(PLAIN), LENGTH)
    assert eqx.tree_equal(*both)
    assert sum(isinstance(move, Restart) for move in both[0].moves) == 1
    assert eqx.tree_equal(mpfjax.with_alarm(FILTER), restarts(mpfjax.with_alarm(START)))
    starts = mpfjax.with_alarm(START), mpfjax.with_initialisation(mpfjax.with_alarm(PLAIN), LENGTH)
    assert eqx.tree_equal(*starts)


@pytest.mark.exactness
def test_an_alarm_begins_where_the_start_ends():
    """What it replaces explains nothing, and its increment is of all steps."""
    filter = mpfjax.with_alarm(START)
    runs = mpfjax.monte_carlo(jax.random.split(KEY, 20), filter, SEEN, mean)
    assert not np.asarray(runs.alarm).any()
    against = np.asarray(runs.log_evidence_against_start)
    assert (against[:, LENGTH:].max(axis=1) < 0).all()


MODEL = ScalarLinear()
SCALARS = np.array([0.3, -0.9, -1.2, 1.5, 1.4], np.float32)


@pytest.mark.exactness
def test_an_impossible_step_does_not_turn_the_alarm_off_for_ever():
    """It counts as much as one step can, and the alarm ends when all is right again."""
    filter = mpfjax.with_alarm(mpfjax.particle_filter(Bounded(), 200))
    told = np.array([0.0, 50.0, 0.0, 0.0, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0], np.float32)
    alarm = np.asarray(mpfjax.run_filter(jax.random.key(0), filter, told).alarm)
    assert not alarm[[0, 2, 3]].any()
    assert alarm[6]
    assert not alarm[-1]


class Bounded(ScalarLinear):
    """A still state from anywhere on a line, of which nothing farther than 30 is ever seen."""

    def sample_initial(self, key, num_particles):
        return jax.random.uniform(key, (num_particles,), minval=-12.0, maxval=12.0)

    def log_likelihood(self, observation, states):
        log_density = super().log_likelihood(observation, states)
        return jnp.where(jnp.abs(observation - states) < 30, log_density, -jnp.inf)


@pytest.mark.exactness
def test_a_run_that_ends_with_an_alarm_warns():
    filter, keys = mpfjax.with_alarm(START), jax.random.split(KEY, 8)
    with pytest.warns(RuntimeWarning, match="speak against all hypotheses in 8 of 8 runs"):
        mpfjax.monte_carlo(keys, filter, CARRIED, mean)
    with warnings.catch_warnings(action="error"):
        mpfjax.monte_carlo(keys, filter, SEEN, mean)
        mpfjax.monte_carlo(keys, FILTER, CARRIED, mean)


def test_the_evidence_is_that_of_the_prior_beside_the_increment():
    filter = mpfjax.with_alarm(mpfjax.particle_filter(MODEL, 4000))
    run = mpfjax.run_filter(KEY, filter, SCALARS)
    found = run.log_evidence_against_start + run.log_likelihood_increments
    deviation = np.sqrt(MODEL.a**2 * MODEL.p**2 + MODEL.q**2 + MODEL.r**2)
    exact = scipy.stats.norm.logpdf(SCALARS, MODEL.a * MODEL.m, deviation)
    np.testing.assert_allclose(found, exact, atol=0.1)


@pytest.mark.exactness
def test_keys_of_another_generator_start_a_filter():
    with jax.default_prng_impl("rbg"):
        run = mpfjax.run_filter(jax.random.key(0), START, SEEN[:LENGTH], mean)
    assert np.isfinite(run.log_marginal_likelihood)
