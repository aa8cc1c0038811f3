"""Rao-Blackwellised backward sampling against all sequences of regimes, and a Kalman smoother."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, PropagateRegimes
from mpfjax.exact import kalman_filter, switching_filter
from mpfjax.smoothing import conditional_filter, sample_trajectories, smoothed_sums
from mpfjax.tuning import metropolis_hastings, particle_gibbs, smc2
from tests.marking import thorough
from tests.moves import test_marginalised_mixed as tests_mixed
from tests.moves.test_marginalised_mixed import Mixed, whole
from tests.smoothing import exact_smoothers
from tests.switching import MODEL, NUM_REGIMES, OBSERVATIONS

NUM_RUNS, NUM_TRAJECTORIES = 40, 100


def smoothed(filter, model, observations, num_runs):
    """Trajectories of several runs of a filter."""

    def one(key):
        run = mpfjax.run_filter(key, filter, observations, None)
        key = jax.random.fold_in(key, 1)
        return sample_trajectories(key, model, run, NUM_TRAJECTORIES, observations=observations)

    return jax.lax.map(one, jax.random.split(jax.random.key(0), num_runs))


def assert_close(estimates, expected):
    """The mean over runs is within 4 standard errors, with room for the bias of order 1 / N."""
    error = estimates.std(axis=0) / np.sqrt(len(estimates))
    assert error.max() < 0.05
    assert (np.abs(estimates.mean(axis=0) - expected) < 4 * error + 2e-3).all()


def far_away(distance):
    """The same model and observations, with the origin elsewhere."""
    offset = np.full(2, distance)
    stays = offset - np.asarray(MODEL.F) @ offset
    parts = (MODEL.b + jnp.asarray(stays, jnp.float32), MODEL.m0 + distance)
    return eqx.tree_at(lambda m: (m.b, m.m0), MODEL, parts), OBSERVATIONS + distance


def without_errors():
    """In one regime the position is seen exactly."""
    return eqx.tree_at(lambda m: m.R, MODEL, MODEL.R.at[2].set(0.0)), OBSERVATIONS


CASES = {
    "near": (MODEL, OBSERVATIONS, 0.0),
    "far from zero": (*far_away(3000.0), 3000.0),
    "R singular": (*without_errors(), 0.0),
}


@pytest.mark.parametrize("case", ["near", *thorough(["far from zero", "R singular"])])
def test_regimes_and_moments_are_those_of_all_sequences(case):
    model, observations, centre = CASES[case]
    filter = Filter(model, [PropagateRegimes(model)], 200)
    found = jax.jit(lambda: smoothed(filter, model, observations, NUM_RUNS))()
    exact = switching_filter(MODEL if centre else model, observations - centre)
    latent = np.asarray(found.latent)
    shares = np.stack([(latent == k).mean(axis=1) for k in range(NUM_REGIMES)], axis=-1)
    assert_close(shares, np.asarray(exact.smoothed_regime_probabilities))
    mean, truth = np.asarray(found.mean, float) - centre, np.asarray(exact.smoothed_means)
    assert_close(mean.mean(axis=1), truth)
    squares = np.asarray(found.covariance) + mean[..., :, None] * mean[..., None, :]
    second = np.asarray(exact.smoothed_covariances) + truth[:, :, None] * truth[:, None, :]
    assert_close(squares.mean(axis=1), second)


@pytest.mark.thorough
def test_in_the_mixed_form_they_are_those_of_the_smoother_of_the_whole_state():
    filter, series = mpfjax.particle_filter(Mixed(), 300), tests_mixed.OBSERVATIONS
    found = jax.jit(lambda: smoothed(filter, Mixed(), series, NUM_RUNS))()
    means, covariance = exact_smoothers.gaussian_smoother(whole(True), np.asarray(series))
    blocks = [covariance[3 * s : 3 * s + 3, 3 * s : 3 * s + 3] for s in range(len(means))]
    assert_close(np.asarray(found.latent).mean(axis=1)[..., 0], means[:, 0])
    mean = np.asarray(found.mean)
    assert_close(mean.mean(axis=1), means[:, 1:])
    squares = np.asarray(found.covariance) + mean[..., :, None] * mean[..., None, :]
    second = np.stack(blocks)[:, 1:, 1:] + means[:, 1:, None] * means[:, None, 1:]
    assert_close(squares.mean(axis=1), second)


def test_misuse_is_named():
    filter = mpfjax.particle_filter(MODEL, 10)
    run = mpfjax.run_filter(jax.random.key(0), filter, OBSERVATIONS, None)
    key = jax.random.key(1)
    for options, name in (
        ({}, "observations: there are none"),
        ({"observations": OBSERVATIONS[:3]}, "observations: .3. steps"),
        ({"observations": OBSERVATIONS, "method": "mcmc"}, "method"),
    ):
        with pytest.raises(ValueError, match=name):
            sample_trajectories(key, MODEL, run, 5, **options)
    quadratic = mpfjax.QuadraticModel()
    plain = mpfjax.particle_filter(quadratic, 10)
    run = mpfjax.run_filter(key, plain, jnp.ones(3), None)
    with pytest.raises(ValueError, match="observations: only"):
        sample_trajectories(key, quadratic, run, 5, observations=jnp.ones(3))


def test_what_draws_states_as_a_whole_refuses_by_name():
    """What keeps or sums whole trajectories says what to take in its place."""
    filter, key = mpfjax.particle_filter(MODEL, 4), jax.random.key(0)
    start = filter.init(key).particles
    path = jax.tree.map(lambda leaf: jnp.zeros((len(OBSERVATIONS) + 1, *leaf.shape[1:])), start)
    who = r"model: SwitchingLinearGaussianModel is conditionally linear, and "
    with pytest.raises(ValueError, match=who + "conditional_filter .* metropolis_hastings"):
        conditional_filter(key, filter, OBSERVATIONS, path)
    with pytest.raises(ValueError, match=who + "smoothed_sums .* sample_trajectories"):
        smoothed_sums(key, filter, OBSERVATIONS, lambda before, after: after.mean)
    with pytest.raises(ValueError, match=who + "particle_gibbs .* smc2"):
        particle_gibbs(key, filter, OBSERVATIONS, 2, log_prior=lambda parameters: jnp.zeros(()))


LINEAR = mpfjax.LinearGaussianModel(
    0.9 * np.eye(1), np.eye(1), np.eye(1), np.eye(1), np.zeros(1), np.eye(1)
)  # fmt: skip
SERIES = jnp.asarray(np.random.default_rng(0).normal(size=(12, 1)), jnp.float32)
START = {"m0": lambda filter: filter.model.m0}


def log_prior(parameters):
    return -0.5 * jnp.sum(parameters["m0"] - 2.0) ** 2


def by_metropolis(key, filter):
    run = metropolis_hastings(
        key, filter, SERIES, 300, log_prior=log_prior, proposal_deviations=1.5, num_chains=4,
        burn_in=50, parameters=START, progress=False,
    )  # fmt: skip
    return run.parameters["m0"].mean()


def by_smc2(key, filter):
    def sample_prior(key):
        return {"m0": 2.0 + jax.random.normal(key, (1,))}

    run = smc2(
        key, filter, SERIES, 300, log_prior=log_prior, sample_prior=sample_prior, parameters=START,
        progress=False,
    )  # fmt: skip
    return run.mean("m0")[0]


@pytest.mark.thorough
@pytest.mark.parametrize("sample", [by_metropolis, by_smc2])
def test_samplers_take_marginalised_models(sample):
    """With regimes that are alike one particle has the exact likelihood, as Kalman's filter."""
    parts = (LINEAR.A, LINEAR.Q, LINEAR.H, LINEAR.R, LINEAR.m0, LINEAR.P0)
    alike = mpfjax.SwitchingLinearGaussianModel(np.ones((1, 1)), *parts)
    grid = jnp.linspace(-3.0, 6.0, 200)

    def log_density(m0):
        model = mpfjax.LinearGaussianModel(*parts[:4], m0[None], parts[5])
        evidence = kalman_filter(model, SERIES).log_marginal_likelihood
        return evidence + log_prior({"m0": m0[None]})

    weights = jax.nn.softmax(jax.vmap(log_density)(grid))
    mean = weights @ grid
    deviation = jnp.sqrt(weights @ (grid - mean) ** 2)
    found = sample(jax.random.key(0), mpfjax.particle_filter(alike, 1))
    assert abs(found - mean) < 0.2 * deviation
