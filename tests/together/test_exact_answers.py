"""Small cases whose answer is known exactly, in seconds: each once caught a bug put in by hand.

What moves of their own files are tested for over thousands of runs is here without Monte Carlo
noise, or with so much power that a wrong key, sign or power shows.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax import GaussNewtonProposal, MultiObjectModel, Partitioned, Propagate, PropagateNested
from mpfjax.moves.resampling.allocation import EQUAL_PARTS, demands_by_variance
from mpfjax.tuning import metropolis_hastings, smc2
from tests.examples import make_mixture
from tests.unbiased import assert_unbiased
from tests.user_models import ScalarLinear

MODEL = ScalarLinear()
STATES = np.linspace(-2.0, 2.0, 24)

NORMAL = scipy.stats.norm.logpdf


GUIDED = Propagate(GaussNewtonProposal(1, inflation=1.0))


@pytest.mark.parametrize(
    "move", [GUIDED, PropagateNested(GUIDED, 4)], ids=["guided", "several proposals"]
)
def test_a_step_weighs_by_the_likelihood_times_the_dynamics_over_the_proposal(move):
    """Draw for draw: with the best proposal no other weight than p(y_t | x_{t-1}) is right.

    All K factors of a particle are this, and so is their mean.
    """
    before = make_mixture(STATES, 0.3 * np.arange(24), np.zeros(24), 1)
    after = eqx.filter_jit(move)(jax.random.key(0), before, mpfjax.Step(MODEL, jnp.array(0.7)))
    expected = np.asarray(before.log_weights) + NORMAL(0.7, 0.9 * STATES, np.hypot(0.6, 0.5))
    found = np.asarray(after.log_weights) + np.asarray(after.log_scale)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.exactness
def test_many_metropolis_steps_leave_the_target_as_it_is():
    """Of exact draws from p(x_1 | x_0, y_1): mean and variance, with a likelihood that is narrow.

    A ratio to any state but the present one, or a reverse density that is not that of the reverse
    step, adds up over the steps.
    """
    n, y = 20_000, 1.0
    model = ScalarLinear(r=0.15)
    rng = np.random.default_rng(0)
    parents = rng.normal(size=n)
    variance = 1 / (1 / 0.36 + 1 / 0.15**2)
    mean = variance * (0.9 * parents / 0.36 + y / 0.15**2)
    states = mean + np.sqrt(variance) * rng.normal(size=n)
    mixture = make_mixture(states, np.zeros(n), np.zeros(n), 1)
    before = mixture.replace(particles=jnp.asarray(parents, jnp.float32)).at_step()
    mixture = before.with_parents().replace(particles=mixture.particles)
    start, move = mixture.particles, eqx.filter_jit(mpfjax.RandomWalkMetropolis())
    for key in jax.random.split(jax.random.key(1), 24):
        mixture = move(key, mixture, mpfjax.Step(model, jnp.array(y)))
    residuals = (np.asarray(mixture.particles, float) - mean) / np.sqrt(variance)
    assert np.mean(np.asarray(mixture.particles) != np.asarray(start)) > 0.6
    assert abs(residuals.mean()) < 4 / np.sqrt(n)
    assert abs(residuals.var() - 1) < 4 * np.sqrt(2 / n)
    assert abs((residuals**3).mean()) < 4 * np.sqrt(15 / n)


@pytest.mark.exactness
@pytest.mark.parametrize("dead", [None, 1])
def test_prior_masses_of_dps_are_those_of_the_living_and_the_total_is_the_evidence(dead):
    """Each living component's share is that of before among the living (section 4)."""
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(3), 8)
    before = make_mixture(rng.normal(size=(24, 2)), rng.normal(size=24), labels, 3)
    if dead is not None:
        log_weights = np.where(labels == dead, -np.inf, before.log_weights)
        before = before.replace(log_weights=jnp.asarray(log_weights, jnp.float32))
    model = MultiObjectModel(ScalarLinear(), 2, shared_observation=True)
    now = mpfjax.Step(model, jnp.array(0.5))
    prior, evidence = (
        eqx.filter_jit(Partitioned(reassembly=name))(jax.random.key(0), before, now)
        for name in ("prior", "evidence")
    )
    shares = np.exp(np.asarray(before.log_mixture_weights, float))
    found = np.exp(np.asarray(prior.log_mixture_weights, float))
    np.testing.assert_allclose(found / found.sum(), shares / shares.sum(), rtol=1e-4)
    np.testing.assert_allclose(prior.log_mass, evidence.log_mass, rtol=1e-4)


def test_slots_are_asked_for_by_mass_times_the_root_of_the_variance():
    """Beside the part that all share equally: Neyman's allocation, to the last per cent."""
    masses, variances = np.array([0.6, 0.3, 0.1]), np.array([4.0, 1.0, 25.0])
    counts = np.full(3, 100_000)
    asked = np.asarray(
        demands_by_variance(
            jnp.log(jnp.asarray(masses, jnp.float32)),
            jnp.asarray(counts / variances, jnp.float32),
            jnp.asarray(counts, jnp.int32),
            jnp.ones(3, bool),
            300_000,
        ),
        float,
    )
    neyman = masses * np.sqrt(variances)
    expected = EQUAL_PARTS[0] / 3 + (1 - EQUAL_PARTS[0]) * neyman / neyman.sum()
    np.testing.assert_allclose(asked / asked.sum(), expected, rtol=0.01)


class OfTheMean(mpfjax.AbstractStateSpaceModel):
    """y_t = θ + N(0, 1), whatever the state: every filter's evidence is exact."""

    mean: jax.Array

    def sample_initial(self, key, num_particles):
        return jnp.zeros(num_particles)

    def sample_transition(self, key, states):
        return states

    def log_likelihood(self, observation, states):
        return jnp.broadcast_to(-0.5 * (observation - self.mean) ** 2, states.shape)


def standard_normal(parameters):
    return -0.5 * parameters["mean"] ** 2


def sample_standard_normal(key):
    return {"mean": jax.random.normal(key)}


@pytest.mark.exactness
def test_evidence_of_smc2_is_the_exact_one_where_every_filter_is_exact():
    """Of y ~ N(θ, 1), θ ~ N(0, 1): log N(y; 0, I + 1 1ᵀ) without its constant, over ten runs."""
    observations = jnp.array([2.0, 1.4, 2.6, 1.8])
    filter = mpfjax.particle_filter(OfTheMean(jnp.array(0.0)), 2)
    runs = [
        smc2(
            key, filter, observations, 240, sample_prior=sample_standard_normal,
            log_prior=standard_normal, num_moves=5, progress=False,
        )
        for key in jax.random.split(jax.random.key(0), 10)
    ]  # fmt: skip
    y = np.asarray(observations, float)
    covariance = np.eye(4) + 1
    exact = -0.5 * y @ np.linalg.solve(covariance, y) - 0.5 * np.linalg.slogdet(covariance)[1]
    found = np.array([run.log_marginal_likelihood for run in runs])
    error = found.std(ddof=1) / np.sqrt(len(found))
    assert error < 0.1
    assert abs(found.mean() + 0.5 * found.var(ddof=1) - exact) < 4 * error
    assert_unbiased([run.mean("mean") for run in runs], y.sum() / 5)


@pytest.mark.exactness
def test_chains_accept_by_a_number_of_its_own():
    """Where every filter is exact, the posterior N(Σy / (t + 1), 1 / (t + 1)) and nothing else.

    A number that also made the proposal, or the filter, accepts steps to one side more often.
    """
    observations = jnp.array([0.6, 0.4])
    filter = mpfjax.particle_filter(OfTheMean(jnp.array(0.3)), 2)
    run = metropolis_hastings(
        jax.random.key(0), filter, observations, 400, log_prior=standard_normal,
        proposal_deviations=1.4, num_chains=200, progress=False,
    )  # fmt: skip
    draws = np.asarray(run.parameters["mean"], float)[:, 50:]
    scaled = (draws - 1.0 / 3) * np.sqrt(3)
    for power, moment in ((1, 0.0), (2, 1.0), (3, 0.0)):
        assert_unbiased((scaled**power).mean(axis=1), moment)
    assert 0.2 < run.acceptance_rate < 0.8
