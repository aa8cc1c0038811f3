"""SMC² against exact posteriors, with ten particles in each filter, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.tuning import Positive, smc2
from tests.tuning.exact_posteriors import (
    DEVIATION_OF_A,
    DEVIATION_OF_LOG_SIGMA,
    MEAN_OF_A,
    MEAN_OF_LOG_SIGMA,
    OBSERVATIONS,
    SIGMA,
    SQUARES,
    A,
    eager_mixture,
    log_prior_of_a,
    log_prior_of_sigma,
    posterior_of_a,
    posterior_of_log_sigma,
)
from tests.user_models import ScalarLinear

NUM_RUNS = 24


def sample_a(key):
    return {"a": MEAN_OF_A + DEVIATION_OF_A * jax.random.normal(key)}


def sample_sigma(key):
    noise = jax.random.normal(key)
    return {"sigma_y": jnp.exp(MEAN_OF_LOG_SIGMA + DEVIATION_OF_LOG_SIGMA * noise)}


def sample(num_samples=60, *, key=None, filter=None, observations=OBSERVATIONS, **options):
    options = {
        "sample_prior": sample_a, "log_prior": log_prior_of_a, "parameters": A, "num_moves": 5,
        "missing": "skip", "progress": False,
    } | options  # fmt: skip
    filter = mpfjax.particle_filter(ScalarLinear(), 10) if filter is None else filter
    key = jax.random.key(0) if key is None else key
    arguments = {"key": key, "filter": filter, "observations": observations}
    return smc2(**arguments | {"num_samples": num_samples} | options)


def assert_posterior(runs, values, exact):
    """Evidence, mean and variance within four standard errors, over independent runs.

    Estimates times the estimated evidence have no bias, as those of any particle filter.
    """
    ratios = np.exp([run.log_marginal_likelihood - exact.log_evidence for run in runs])
    errors = [ratios - 1]
    for run, ratio, x in zip(runs, ratios, values, strict=True):
        assert run.weights.sum() == pytest.approx(1.0, abs=1e-4)
        mean, square = run.weights @ x, run.weights @ (x - exact.mean) ** 2
        errors.append(ratio * np.array([mean - exact.mean, square - exact.variance]))
    errors = np.column_stack([errors[0], np.array(errors[1:])])
    standard = errors.std(axis=0, ddof=1) / np.sqrt(len(runs))
    spread = np.array([1.0, np.sqrt(exact.variance), exact.variance])
    assert (standard < 0.08 * spread).all(), standard / spread
    z = errors.mean(axis=0) / standard
    assert np.abs(z).max() < 4, z


class TestPosterior:
    @pytest.mark.thorough
    def test_waste_free_through_a_mixture_is_the_exact_one(self):
        """With K-means, merging and splitting in the chain."""
        filter = eager_mixture()
        options = {"sample_prior": sample_sigma, "log_prior": log_prior_of_sigma}
        runs = [
            sample(
                240, key=key, filter=filter, observations=SQUARES, parameters=SIGMA,
                transforms={"sigma_y": Positive()}, ess_threshold=0.8, **options,
            )
            for key in jax.random.split(jax.random.key(1), NUM_RUNS)
        ]  # fmt: skip
        values = [np.log(run.parameters["sigma_y"]) for run in runs]
        assert_posterior(runs, values, posterior_of_log_sigma())
        rates = np.array([run.acceptance_rates for run in runs])
        moved = np.isfinite(rates)
        assert moved.any(axis=1).all()
        assert 0.1 < rates[moved].mean() < 0.8
        assert runs[0].parameters["sigma_y"].shape == (240,)

    @pytest.mark.thorough
    def test_ends_of_chains_are_the_exact_one_too(self):
        runs = [
            sample(200, key=key, waste_free=False, num_moves=3, ess_threshold=0.7)
            for key in jax.random.split(jax.random.key(2), NUM_RUNS)
        ]
        assert_posterior(runs, [run.parameters["a"] for run in runs], posterior_of_a())
        for run in runs:
            below = run.effective_sample_sizes < 0.7 * 200
            np.testing.assert_array_equal(np.isfinite(run.acceptance_rates), below)
            assert run.mean("a") == pytest.approx(run.weights @ run.parameters["a"], abs=1e-5)


def test_one_step_and_no_observation_at_all():
    """Without observations the samples are those of the prior."""
    run = sample(observations=jnp.full(1, jnp.nan))
    assert run.log_marginal_likelihood == pytest.approx(0.0, abs=1e-5)
    np.testing.assert_allclose(run.weights, 1 / 60, rtol=1e-5)


def nan_prior(parameters):
    return jnp.where(parameters["a"] < 9, jnp.nan, 0.0)


class Faulty(ScalarLinear):
    """Every likelihood is the same: r."""

    def log_likelihood(self, observation, states):
        return jnp.broadcast_to(self.r, states.shape)


@pytest.mark.parametrize(
    ("value", "named"), [(-np.inf, "no sample has any likelihood"), (np.nan, "was NaN")]
)
def test_likelihoods_that_are_none_are_an_error(value, named):
    with pytest.raises(RuntimeError, match=named):
        sample(filter=mpfjax.particle_filter(Faulty(r=value), 10))


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"key": 0}, "key: 0 is no typed key"),
        ({"filter": 3}, "filter: 3 is not a filter"),
        ({"filter": mpfjax.gaussian_particle_filter(ScalarLinear(), 10)}, "filter: an approx"),
        ({"num_samples": 0}, "num_samples: 0"),
        ({"num_samples": 10}, r"num_samples: 10 is no multiple of num_moves \+ 1, 6"),
        ({"num_moves": 0}, "num_moves: 0"),
        ({"ess_threshold": 1.5}, "ess_threshold: 1.5"),
        ({"waste_free": 1}, "waste_free: 1"),
        ({"progress": "no"}, "progress: 'no'"),
        ({"sample_prior": 3}, "sample_prior: 3"),
        ({"sample_prior": lambda key: 1.0}, r"sample_prior: it gave 1\.0"),
        ({"sample_prior": lambda key: {"b": 1.0}}, r"sample_prior: it gave \['b'\]"),
        ({"sample_prior": lambda key: {"a": jnp.zeros(2)}}, r"sample_prior: a of shape \(2,\)"),
        (
            {"sample_prior": lambda key: {"a": -1.0}, "transforms": {"a": Positive()}},
            "sample_prior: a draw of a is outside Positive's domain",
        ),
        ({"log_prior": None}, "log_prior: None"),
        ({"log_prior": nan_prior}, "log_prior: nan at a draw of sample_prior"),
        ({"observations": [1.0, 2.0]}, "observations: a list"),
        ({"observations": np.full(3, np.nan), "missing": "error"}, "observations: NaN"),
        ({"missing": 0}, "missing: 0"),
        ({"parameters": "a"}, "parameters: 'a'"),
    ],
)
def test_bad_arguments_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        sample(**options)
