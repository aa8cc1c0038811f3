"""Particle Gibbs against exact posteriors, with ten particles, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.tuning import Positive, particle_gibbs
from tests.tuning.exact_posteriors import (
    DEVIATION_OF_A,
    MEAN_OF_A,
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

SERIES = mpfjax.Series.skipping(OBSERVATIONS)


def draw_a(key, trajectory, observations, model):
    """a is normal given the trajectory: a regression of each state on the one before."""
    before, after = trajectory[:-1], trajectory[1:]
    precision = DEVIATION_OF_A**-2 + jnp.sum(before**2) / model.q**2
    mean = (MEAN_OF_A / DEVIATION_OF_A**2 + jnp.sum(before * after) / model.q**2) / precision
    return {"a": mean + jax.random.normal(key) / jnp.sqrt(precision)}


def sample(num_steps=3, *, filter=None, observations=SERIES, **options):
    if not {"draw", "log_prior"} & set(options):
        options["draw"] = draw_a
    options = {"parameters": A, "progress": False, "num_chains": 2} | options
    filter = mpfjax.particle_filter(ScalarLinear(), 10) if filter is None else filter
    arguments = {"key": jax.random.key(0), "filter": filter, "observations": observations}
    return particle_gibbs(**arguments | {"num_steps": num_steps} | options)


def assert_moments(chains, exact):
    """Mean and variance over chains within four standard errors of the exact ones."""
    moments = np.array([exact.mean, exact.variance])
    found = np.stack([chains.mean(axis=1), ((chains - exact.mean) ** 2).mean(axis=1)], axis=1)
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert (error < 0.08 * np.array([np.sqrt(exact.variance), exact.variance])).all()
    z = (found.mean(axis=0) - moments) / error
    assert np.abs(z).max() < 4, z


class TestPosterior:
    @pytest.mark.thorough
    def test_of_a_conditional_draw_is_the_exact_one(self):
        run = sample(320, num_chains=60, collect=lambda trajectory: trajectory[0])
        assert_moments(run.parameters["a"][:, 20:], posterior_of_a())
        assert run.trajectories.shape == (60, 320)
        assert run.acceptance_rate == 1.0
        assert (run.renewal_rates > 0.5).all()
        assert run.stopped is None

    @pytest.mark.thorough
    def test_of_metropolis_steps_through_a_mixture_is_the_exact_one(self):
        """With K-means, merging and splitting in the chain."""
        run = sample(
            320, filter=eager_mixture(), observations=SQUARES, num_chains=60,
            log_prior=log_prior_of_sigma, parameters=SIGMA, transforms={"sigma_y": Positive()},
            proposal_deviations=0.8,
        )  # fmt: skip
        chains = np.log(run.parameters["sigma_y"][:, 20:])
        assert_moments(chains, posterior_of_log_sigma())
        assert 0.2 < run.acceptance_rate < 0.8
        assert run.trajectories.shape == (60, 320, len(SQUARES) + 1)
        assert run.renewed.shape == (60, 320, len(SQUARES) + 1)


def test_draws_of_another_kind_are_named():
    for draw, named in (
        (lambda *arguments: {"b": 1.0}, r"draw: it gave \['b'\], no values by the names \['a'\]"),
        (lambda *arguments: 1.0, r"draw: it gave 1\.0"),
        (lambda *arguments: {"a": jnp.zeros(2)}, r"draw: a of shape \(2,\)"),
    ):
        with pytest.raises(ValueError, match=named):
            sample(draw=draw)


class Fragile(ScalarLinear):
    """A likelihood that breaks where a is above 0.9."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where(self.a > 0.9, jnp.nan, honest)


@pytest.mark.thorough
def test_a_nan_is_rejected_and_counted():
    filter = mpfjax.particle_filter(Fragile(a=0.5), 10)
    with pytest.warns(UserWarning, match=r"zero density: conditional_filter \d+ times$"):
        run = sample(200, filter=filter)
    assert run.stopped is None
    assert run.parameters["a"].shape == (2, 200)
    assert (run.parameters["a"] <= 0.9).all()
    assert (run.num_invalid["conditional_filter"] > 0).all()
    with pytest.raises(RuntimeError, match="was NaN or inf"):
        sample(filter=mpfjax.particle_filter(Fragile(a=0.95), 10))


class NoTransition(ScalarLinear):
    log_transition = None


@pytest.mark.thorough
def test_without_log_transition_the_trajectory_follows_its_ancestors():
    run = sample(filter=mpfjax.particle_filter(NoTransition(), 10))
    assert np.isfinite(run.parameters["a"]).all()
    assert run.renewal_rates[-1] > 0


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"key": 0}, "key: 0 is no typed key"),
        ({"filter": 3}, "filter: 3 is not a filter"),
        ({"num_steps": 0}, "num_steps: 0"),
        ({"num_chains": 1.5}, "num_chains: 1.5"),
        ({"collect": 3}, "collect: 3"),
        ({"draw": 3}, "draw: 3"),
        ({"draw": None}, "draw, log_prior: None and None; exactly one"),
        ({"draw": draw_a, "log_prior": log_prior_of_a}, "draw, log_prior: .*exactly one"),
        ({"log_prior": 3}, "log_prior: 3"),
        ({"log_prior": log_prior_of_a}, "ScalarLinear defines no log_initial"),
        (
            {
                "filter": mpfjax.particle_filter(NoTransition(), 10),
                "log_prior": log_prior_of_a,
            },
            "NoTransition defines no log_transition, which particle_gibbs with log_prior",
        ),
        ({"filter": mpfjax.gaussian_particle_filter(ScalarLinear(), 10)}, "filter: Gaussian"),
        ({"observations": [1.0, 2.0]}, "observations: a list"),
        ({"observations": np.full(3, np.nan)}, "observations: NaN"),
        ({"parameters": "a"}, "parameters: 'a'"),
        ({"transforms": {"b": Positive()}}, r"transforms: \['b'\]"),
    ],
)  # fmt: skip
def test_bad_arguments_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        sample(**options)


@pytest.mark.thorough
def test_one_step_of_time_and_no_observation_at_all():
    """Without observations the posterior is the prior."""
    run = sample(observations=mpfjax.Series.skipping(jnp.full(1, jnp.nan)))
    assert run.trajectories.shape == (2, 3, 2)
    assert np.isfinite(run.parameters["a"]).all()
