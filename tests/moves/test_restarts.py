"""Restarts: exact for their kernel, found again after being carried away, and cheap elsewhere."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax.moves.alarm import SURPRISE, is_alarmed
from mpfjax.smoothing import (
    FixedLagSmoother,
    conditional_filter,
    sample_trajectories,
    smoothed_sums,
)
from tests.marking import quick_of
from tests.unbiased import assert_unbiased
from tests.user_models import ScalarLinear

MODEL = ScalarLinear()
# The fourth and fifth are where only a restart gets to.
OBSERVATIONS = np.array([0.3, -0.9, -1.2, 1.5, 1.4, np.nan, 0.5], np.float32)
PROBABILITY = 0.1
SEEDS = 400


def log_evidence_on_a_grid():
    """log p(y_1..y_t) where x_{t-1} is drawn anew with probability p, by sums over a grid."""
    points = np.linspace(-8, 8, 1601)
    normal = scipy.stats.norm.pdf
    prior = normal(points, 0.5)
    prior /= prior.sum()
    step = normal(points[None], 0.9 * points[:, None], 0.6) * (points[1] - points[0])
    law, total = prior, 0.0
    for y in OBSERVATIONS:
        law = ((1 - PROBABILITY) * law + PROBABILITY * prior) @ step
        law = law if np.isnan(y) else law * normal(y, points, 0.5)
        total += np.log(law.sum())
        law = law / law.sum()
    return total


FILTERS = {
    "particle filter": mpfjax.particle_filter(MODEL, 60),
    "mixture": mpfjax.mixture_particle_filter(MODEL, 120, 3, regroup_every=2),
    "look-ahead": mpfjax.with_lookahead(mpfjax.particle_filter(MODEL, 60)),
    "nested": mpfjax.with_proposals_per_particle(mpfjax.particle_filter(MODEL, 60), 3),
}


@pytest.mark.parametrize("name", quick_of(FILTERS, ["mixture"]))
def test_evidence_is_unbiased_for_the_kernel(name):
    filter = mpfjax.with_restarts(FILTERS[name], probability=PROBABILITY)
    keys = jax.random.split(jax.random.key(0), SEEDS)
    runs = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, lambda mixture: None, missing="skip")
    ratios = np.exp(np.asarray(runs.log_marginal_likelihood) - log_evidence_on_a_grid())
    error = ratios.std() / np.sqrt(SEEDS)
    assert abs(ratios.mean() - 1) < 4 * error
    assert error < 0.06


def test_of_a_part_of_the_slots_they_take_a_share_of_that_part():
    """The alarm rings; the survivors keep three quarters of the slots that may be used."""
    filter = mpfjax.with_restarts(mpfjax.particle_filter(MODEL, 240), probability=PROBABILITY)
    mixture = filter.init(jax.random.key(0))
    log_weights = jnp.where(jnp.arange(240) < 40, -jnp.log(40.0), -jnp.inf)
    mixture = mixture.replace(
        log_weights=log_weights, usable_slots=jnp.int32(40), memory={SURPRISE: jnp.float32(9.0)}
    )
    moved, info = filter.step(jax.random.key(1), mixture, jnp.float32(0.3))
    np.testing.assert_array_equal(moved.component_counts, [30, 10])
    assert info.log_likelihood_increment > -3


def test_particles_for_every_component_must_be_left():
    with pytest.raises(ValueError, match="num_particles: 15 is less than 4 for restarts and one"):
        mpfjax.with_restarts(mpfjax.mixture_particle_filter(MODEL, 15, 12))


def test_an_impossible_step_does_not_turn_the_alarm_off_for_ever():
    """It counts as much as one step can, and the alarm ends when all is right again."""
    filter = mpfjax.with_alarm(mpfjax.particle_filter(Bounded(), 200))
    told = np.array([0.0, 50.0, 0.0, 0.0, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0], np.float32)
    surprised = np.asarray(mpfjax.run_filter(jax.random.key(0), filter, told).surprised)
    assert not surprised[[0, 2, 3]].any()
    assert surprised[6]
    assert not surprised[-1]


class Bounded(ScalarLinear):
    """A still state from anywhere on a line, of which nothing farther than 30 is ever seen."""

    def sample_initial(self, key, num_particles):
        return jax.random.uniform(key, (num_particles,), minval=-12.0, maxval=12.0)

    def log_likelihood(self, observation, states):
        log_density = super().log_likelihood(observation, states)
        return jnp.where(jnp.abs(observation - states) < 30, log_density, -jnp.inf)


def test_a_change_of_the_model_reaches_the_alarm():
    plain, other = mpfjax.particle_filter(MODEL, 60), ScalarLinear(m=3.0)
    changed = mpfjax.with_alarm(plain).replace(model=other)
    made = mpfjax.with_alarm(plain.replace(model=other))
    runs = [mpfjax.run_filter(jax.random.key(0), f, OBSERVATIONS[:3]) for f in (changed, made)]
    np.testing.assert_array_equal(*(run.log_evidence_against_start for run in runs))


@pytest.mark.exactness
def test_smoothing_knows_that_states_began_anew():
    """Beside a smoother on a grid whose kernel has the restarts."""
    points, normal = np.linspace(-8, 8, 801), scipy.stats.norm.pdf
    seen = OBSERVATIONS[:5]
    prior = normal(points, 0.5)
    prior /= prior.sum()
    step = normal(points[None], 0.9 * points[:, None], 0.6) * (points[1] - points[0])
    kernel = (1 - PROBABILITY) * step + PROBABILITY * (prior @ step)[None]
    filtered, future, exact = [prior], np.ones_like(points), []
    for y in seen:
        law = (filtered[-1] @ kernel) * normal(y, points, 0.5)
        filtered.append(law / law.sum())
    for t in reversed(range(len(filtered))):
        smoothed = filtered[t] * future
        exact.append(points @ smoothed / smoothed.sum())
        future = kernel @ (normal(seen[t - 1], points, 0.5) * future)
    exact = np.array(exact[::-1])
    filter = mpfjax.with_restarts(mpfjax.particle_filter(MODEL, 300), probability=PROBABILITY)

    def before(previous, states):
        return previous

    @jax.jit
    @jax.vmap
    def smooth(key):
        run = mpfjax.run_filter(key, filter, seen)
        paths = sample_trajectories(jax.random.fold_in(key, 1), MODEL, run, 100)
        sums = smoothed_sums(key, filter, seen, before).sums[-1]
        return paths.mean(axis=0), sums, run.log_marginal_likelihood

    means, sums, log_evidence = smooth(jax.random.split(jax.random.key(2), 60))
    weights = np.exp(np.asarray(log_evidence) - np.max(log_evidence))
    weights /= weights.mean()
    assert_unbiased(weights[:, None] * (np.asarray(means) - exact), 0.0, loosest=0.05)
    assert_unbiased(weights * (np.asarray(sums) - exact[:-1].sum()), 0.0, loosest=0.15)
    with pytest.raises(ValueError, match="restarts"):
        FixedLagSmoother(filter, before, 1, "mcmc")
    with pytest.raises(ValueError, match="restarts"):
        conditional_filter(jax.random.key(0), filter, seen, np.zeros(6, np.float32))


class Kidnapped(ScalarLinear):
    """A walk on a line 40 units long, of which it is told where it is; its prior is the line."""

    def sample_initial(self, key, num_particles):
        return jax.random.uniform(key, (num_particles,), minval=-20.0, maxval=20.0)


def nothing(mixture):
    return None


@pytest.fixture(scope="module")
def told():
    """Eight runs each, carried away at the twentieth step of forty or not, with each alarm."""
    rng = np.random.default_rng(0)
    model = Kidnapped(a=1.0, q=0.1, r=0.2)
    plain = mpfjax.mixture_particle_filter(model, 200, 3)
    keys, found = jax.random.split(jax.random.key(1), 8), {}
    for carried in (True, False):
        places = np.where(np.arange(40) < 20, -10.0, 11.0 if carried else -10.0)
        seen = (places + 0.2 * rng.normal(size=40)).astype(np.float32)
        for name, change in (("alarm", mpfjax.with_alarm), ("restarts", mpfjax.with_restarts)):
            with warnings.catch_warnings(record=True, action="always") as caught:
                run = mpfjax.monte_carlo(keys, change(plain), seen, nothing)
            found[name, carried] = run, [str(each.message) for each in caught]
    return found


@pytest.mark.parametrize("name", ["alarm", "restarts"])
def test_an_alarm_is_given_where_all_hypotheses_are_wrong(name, told):
    (run, messages), (calm, silence) = told[name, True], told[name, False]
    surprised = np.asarray(run.surprised)
    assert surprised[:, 20:23].any(axis=1).all()
    assert not surprised[:, :20].any()
    assert not np.asarray(calm.surprised).any()
    said = [each for each in messages if "speaks against all hypotheses in 8 of 8 runs" in each]
    assert len(said) == (name == "alarm")
    assert not silence


def test_after_a_restart_the_state_is_found_and_the_alarm_ends(told):
    run, _ = told["restarts", True]
    np.testing.assert_allclose(jax.vmap(lambda m: m.mean())(run.final), 11.0, atol=0.5)
    assert not np.asarray(jax.vmap(is_alarmed)(run.final)).any()


def test_the_evidence_is_that_of_the_prior_beside_the_increment(told):
    """p(y | x_0 ~ U) is 1/40 within the line, up to the constant in the model's likelihood."""
    run, _ = told["alarm", False]
    found = run.log_evidence_against_start + run.log_likelihood_increments
    np.testing.assert_allclose(found, -np.log(40), atol=0.4)


def test_collect_sees_the_time_and_the_inputs():
    def collect(mixture, t, inputs):
        return t, inputs

    filter = FILTERS["particle filter"]
    times, inputs = mpfjax.run_filter(
        jax.random.key(0), filter, OBSERVATIONS[:5], collect
    ).collected
    np.testing.assert_array_equal(times, [1, 2, 3, 4, 5])
    assert inputs is None
