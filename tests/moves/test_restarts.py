"""Restarts: exact where the alarm sends one back, found again; an alarm only where it is due."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.mixture import single_component
from mpfjax.moves.alarm import SURPRISE
from mpfjax.smoothing import conditional_filter, sample_trajectories, smoothed_sums
from tests.marking import weekly
from tests.moves.start.test_start import KEY, SEEN, mean
from tests.moves.start.test_window import PLANE, WithKeys
from tests.unbiased import assert_unbiased, ratios_to
from tests.user_models import ScalarLinear

MODEL = ScalarLinear()
OBSERVATIONS = np.array([0.3, -0.9, -1.2, 1.5, 1.4], np.float32)


# Carried away after six steps; the alarm rings at once, and the start is by the next three.
CARRIED = np.concatenate([SEEN[:6], SEEN[:6] - 12.0])
PROBABILITY = 0.01
PLAIN = mpfjax.mixture_particle_filter(WithKeys(), 100, 3)
FILTER = mpfjax.with_restarts(
    mpfjax.with_start(PLAIN, 3), probability=PROBABILITY, num_observations=3
)


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
    surprised = np.asarray(runs.surprised)
    assert surprised[:, 6:8].all()
    assert not surprised[:, 8:].any()
    ratios = ratios_to(log_evidence_with_a_restart(CARRIED, 6), runs)
    assert_unbiased(ratios, 1.0, loosest=0.05, errors=3.0)
    if islands == 1:
        means = kalman_filter(PLANE, CARRIED[6:]).means[-1]
        assert_unbiased(ratios[:, None] * np.asarray(runs.collected)[:, -1], means, loosest=0.5)


@pytest.mark.weekly
def test_a_restart_may_reach_back_into_the_start():
    """The third observation belongs to both windows."""
    seen = np.concatenate([SEEN[:2], SEEN - 12.0, SEEN[-1:] - 12.0])
    runs = mpfjax.monte_carlo(jax.random.split(KEY, 200), FILTER, seen, mean)
    assert (np.asarray(runs.surprised).argmax(axis=1) == 2).all()
    assert_unbiased(ratios_to(log_evidence_with_a_restart(seen, 2), runs), loosest=0.1)


@pytest.mark.weekly
def test_the_gradient_through_a_restart_is_the_score():
    """Of the nine observations up to the restart, the last three of which are its own."""
    seen = CARRIED[:9]

    def at(scale):
        return eqx.tree_at(lambda m: m.P0, PLANE, scale * PLANE.P0)

    @jax.grad
    def score(scale, key):
        plain = mpfjax.particle_filter(at(scale), 150, gradient="stop")
        restarts = {"probability": PROBABILITY, "num_observations": 3}
        filter = mpfjax.with_restarts(mpfjax.with_start(plain, 3), **restarts)
        return mpfjax.run_filter(key, filter, seen, mean).log_marginal_likelihood

    run = jax.jit(lambda keys: jax.lax.map(lambda key: score(1.0, key), keys))
    scores = run(jax.random.split(KEY, 600))
    expected = jax.grad(lambda scale: log_evidence_with_a_restart(seen, 6, at(scale)))(1.0)
    assert_unbiased(scores, float(expected), loosest=0.25)


@pytest.mark.exactness
@pytest.mark.parametrize("log_new", [-3.0, 400.0])
def test_both_have_the_mass_of_their_evidence(log_new):
    """Old ones, at zero, grew by e^-4 before this step and by e^-2 in it; new ones are at one."""
    move, p = FILTER.moves[0], PROBABILITY
    old = single_component(jnp.zeros((100, 2)), 3).replace(
        component_indicators=jnp.arange(100) % 3, log_scale=jnp.float32(-2.0)
    )
    new = single_component(jnp.ones((100, 2))).replace(log_scale=jnp.float32(log_new))
    joined = move._joined(KEY, old, new, jnp.float32(-4.0))
    both = np.log1p(-p) - 2.0, np.log(p) + log_new + 4.0
    np.testing.assert_allclose(joined.log_mass, np.logaddexp(*both), rtol=1e-5)
    share = np.exp(both[1] - np.logaddexp(*both))
    at_one = np.asarray(joined.particles[:, 0] == 1)
    weights = np.exp(np.asarray(joined.log_weights - (joined.log_mass - joined.log_scale)))
    np.testing.assert_allclose(weights[at_one].sum(), share, rtol=1e-4)
    assert at_one.sum() == np.clip(round(100 * share), 6, 94)


def test_smoothing_refuses_a_run_with_restarts():
    mixtures = single_component(jnp.zeros((6, 2)), 3)
    some = mixtures.replace(ancestor_indices=jnp.array([0, 1, 2, 3, -1, -1]))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), mixtures, some, mixtures)
    with pytest.raises(ValueError, match="restarts"):
        sample_trajectories(KEY, WithDensity(), stacked, 5)
    filter = FILTER.replace(model=WithDensity())
    with pytest.raises(ValueError, match="restarts"):
        conditional_filter(KEY, filter, CARRIED, np.zeros((13, 2), np.float32))


@pytest.mark.exactness
def test_online_smoothing_ends_where_a_state_begins_anew():
    filter = FILTER.replace(model=WithDensity())
    with pytest.raises(RuntimeError, match="restarts"):
        smoothed_sums(KEY, filter, CARRIED, lambda before, now: now[:, 0])


class WithDensity(WithKeys):
    """With the density of a step."""

    def log_transition(self, states, previous_states):
        return jnp.sum(jax.scipy.stats.norm.logpdf(states, previous_states, 0.1), axis=1)


def test_what_cannot_restart_is_refused():
    with pytest.raises(ValueError, match="num_particles: 40, of which 2 may be all of the slots"):
        mpfjax.with_restarts(mpfjax.mixture_particle_filter(WithKeys(), 40, 12))
    with pytest.raises(ValueError, match="defines no log_initial"):
        mpfjax.with_restarts(mpfjax.particle_filter(MODEL, 50))


@pytest.mark.exactness
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


@pytest.mark.exactness
def test_a_change_of_the_model_reaches_the_alarm():
    plain, other = mpfjax.particle_filter(MODEL, 60), ScalarLinear(m=3.0)
    changed = mpfjax.with_alarm(plain).replace(model=other)
    made = mpfjax.with_alarm(plain.replace(model=other))
    runs = [mpfjax.run_filter(jax.random.key(0), f, OBSERVATIONS[:3]) for f in (changed, made)]
    np.testing.assert_array_equal(*(run.log_evidence_against_start for run in runs))


class Kidnapped(ScalarLinear):
    """A walk on a line 40 units long, of which it is told where it is; its prior is the line."""

    def sample_initial(self, key, num_particles):
        return jax.random.uniform(key, (num_particles,), minval=-20.0, maxval=20.0)

    def log_initial(self, states):
        return jnp.where(jnp.abs(states) < 20, 0.0, -jnp.inf)


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


@pytest.mark.exactness
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


@pytest.mark.exactness
def test_after_a_restart_the_state_is_found_and_the_alarm_ends(told):
    run, _ = told["restarts", True]
    np.testing.assert_allclose(jax.vmap(lambda m: m.mean())(run.final), 11.0, atol=0.5)
    assert not np.asarray(run.final.memory[SURPRISE].rings).any()


def test_the_evidence_is_that_of_the_prior_beside_the_increment(told):
    """p(y | x_0 ~ U) is 1/40 within the line, up to the constant in the model's likelihood."""
    run, _ = told["alarm", False]
    found = run.log_evidence_against_start + run.log_likelihood_increments
    np.testing.assert_allclose(found, -np.log(40), atol=0.4)


@pytest.mark.exactness
def test_collect_sees_the_time_and_the_inputs():
    def collect(mixture, t, inputs):
        return t, inputs

    filter = mpfjax.particle_filter(MODEL, 60)
    times, inputs = mpfjax.run_filter(KEY, filter, OBSERVATIONS, collect).collected
    np.testing.assert_array_equal(times, [1, 2, 3, 4, 5])
    assert inputs is None
