"""Particle Gibbs against exact posteriors, with ten particles, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax import Filter, KMeans, Merge, Propagate, Resample, Split
from mpfjax.exact import grid_filter
from mpfjax.tuning import Positive, particle_gibbs
from tests.user_models import ScalarLinear

OBSERVATIONS = jnp.array([1.5, 0.2, -0.4, 0.8, 1.9, 1.1, 0.3, -0.9])
SQUARES = jnp.array([1.2, 0.3, 0.8, 1.6, 1.0])
MEAN, DEVIATION = 0.3, 0.5  # of a, before any observation
A = {"a": lambda filter: filter.model.a}


def draw_a(key, trajectory, observations, model):
    """a is normal given the trajectory: a regression of each state on the one before."""
    before, after = trajectory[:-1], trajectory[1:]
    precision = DEVIATION**-2 + jnp.sum(before**2) / model.q**2
    mean = (MEAN / DEVIATION**2 + jnp.sum(before * after) / model.q**2) / precision
    return {"a": mean + jax.random.normal(key) / jnp.sqrt(precision)}


def sample(num_steps=3, *, filter=None, observations=OBSERVATIONS, **options):
    if not {"draw", "log_prior"} & set(options):
        options["draw"] = draw_a
    options = {"parameters": A, "progress": False, "num_chains": 2} | options
    filter = mpfjax.particle_filter(ScalarLinear(), 10) if filter is None else filter
    arguments = {"key": jax.random.key(0), "filter": filter, "observations": observations}
    return particle_gibbs(**arguments | {"num_steps": num_steps} | options)


def assert_moments(chains, grid, log_densities):
    """Mean and variance over chains within four standard errors of those on the grid."""
    density = np.exp(log_densities - log_densities.max())
    density /= density.sum()
    mean = density @ grid
    moments = np.array([mean, density @ (grid - mean) ** 2])
    found = np.stack([chains.mean(axis=1), ((chains - mean) ** 2).mean(axis=1)], axis=1)
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert (error < 0.08 * np.array([np.sqrt(moments[1]), moments[1]])).all()
    z = (found.mean(axis=0) - moments) / error
    assert np.abs(z).max() < 4, z


class TestPosterior:
    def test_of_a_conditional_draw_is_the_exact_one(self):
        """Of the coefficient of a linear model, with a missing observation."""
        grid = jnp.linspace(-1.7, 2.3, 201)
        seen = OBSERVATIONS.at[2].set(jnp.nan)

        def log_density(a):
            # A missing observation is one of no precision.
            model = ScalarLinear(a=a)
            mean, variance, total = model.m, model.p**2, norm.logpdf(a, MEAN, DEVIATION)
            for y in np.asarray(seen):
                mean, variance = a * mean, a**2 * variance + model.q**2
                if np.isfinite(y):
                    innovation = variance + model.r**2
                    total += norm.logpdf(y, mean, jnp.sqrt(innovation))
                    gain = variance / innovation
                    mean, variance = mean + gain * (y - mean), (1 - gain) * variance
            return total

        log_densities = np.asarray(jax.jit(jax.vmap(log_density))(grid), float)
        filter = mpfjax.particle_filter(ScalarLinear(), 10)
        run = sample(
            320, filter=filter, observations=seen, missing="skip", num_chains=60,
            collect=lambda trajectory: trajectory[0],
        )  # fmt: skip
        assert_moments(run.parameters["a"][:, 20:], np.asarray(grid, float), log_densities)
        assert run.trajectories.shape == (60, 320)
        assert run.acceptance_rate == 1.0
        assert (run.renewal_rates > 0.5).all()
        assert run.stopped is None

    def test_of_metropolis_steps_through_a_mixture_is_the_exact_one(self):
        """Of the noise of the quadratic model, with K-means, merging and splitting in the chain."""
        model = mpfjax.QuadraticModel(0.4, 0.7, -2.0, 2.0)
        moves = [Resample(), Propagate(model), Merge(2.0), Split(1.0, 0.1, min_share=0.0)]
        filter = Filter(model, [*moves, KMeans(2)], 10, 3, initial_moves=[KMeans(2, reseed=True)])
        log_sigmas, states = jnp.linspace(-3.5, 2.5, 61), jnp.linspace(-5.0, 5.0, 301)

        def log_prior(parameters):
            return norm.logpdf(jnp.log(parameters["sigma_y"]), -0.5, 0.7)

        def log_density(log_sigma):
            sigma = jnp.exp(log_sigma)
            of_sigma = mpfjax.QuadraticModel(0.4, sigma, -2.0, 2.0)
            evidence = grid_filter(of_sigma, SQUARES, states).log_marginal_likelihood
            return evidence + log_prior({"sigma_y": sigma})

        log_densities = np.asarray(jax.jit(jax.vmap(log_density))(log_sigmas), float)
        # The prior is a density of σ, and the grid one of log σ.
        log_densities += np.asarray(log_sigmas, float)
        run = sample(
            320, filter=filter, observations=SQUARES, num_chains=60, log_prior=log_prior,
            parameters={"sigma_y": lambda filter: filter.model.sigma_y},
            transforms={"sigma_y": Positive()}, proposal_deviations=0.8,
        )  # fmt: skip
        chains = np.log(run.parameters["sigma_y"][:, 20:])
        assert_moments(chains, np.asarray(log_sigmas, float), log_densities)
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


def test_a_nan_ends_the_chains_with_what_they_have():
    filter = mpfjax.particle_filter(Fragile(a=0.5), 10)
    with pytest.warns(UserWarning, match="was NaN or inf at step"):
        run = sample(200, filter=filter)
    assert run.stopped.endswith(f"at step {run.accepted.shape[1]}")
    assert (run.parameters["a"] <= 0.9).all()
    with pytest.raises(RuntimeError, match="was NaN or inf"):
        sample(filter=mpfjax.particle_filter(Fragile(a=0.95), 10))


class NoTransition(ScalarLinear):
    log_transition = None


def log_prior(parameters):
    return norm.logpdf(parameters["a"], MEAN, DEVIATION)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"key": 0}, "key: 0 is no typed key"),
        ({"filter": 3}, "filter: 3 is not a filter"),
        ({"num_steps": 0}, "num_steps: 0"),
        ({"num_chains": 1.5}, "num_chains: 1.5"),
        ({"num_metropolis_steps": 0}, "num_metropolis_steps: 0"),
        ({"progress": "no"}, "progress: 'no'"),
        ({"backward": None}, "backward: None"),
        ({"collect": 3}, "collect: 3"),
        ({"draw": 3}, "draw: 3"),
        ({"draw": None}, "draw, log_prior: None and None; exactly one"),
        ({"draw": draw_a, "log_prior": log_prior}, "draw, log_prior: .*exactly one"),
        ({"log_prior": 3}, "log_prior: 3"),
        ({"log_prior": log_prior}, "ScalarLinear defines no log_initial"),
        (
            {"filter": mpfjax.particle_filter(NoTransition(), 10)},
            "NoTransition defines no log_transition, which backward sampling",
        ),
        (
            {
                "filter": mpfjax.particle_filter(NoTransition(), 10),
                "log_prior": log_prior, "backward": False,
            },
            "NoTransition defines no log_transition, which particle_gibbs with log_prior",
        ),
        ({"filter": mpfjax.gaussian_particle_filter(ScalarLinear(), 10)}, "filter: Gaussian"),
        ({"observations": [1.0, 2.0]}, "observations: a list"),
        ({"observations": np.full(3, np.nan)}, "observations: NaN"),
        ({"missing": 0}, "missing: 0"),
        ({"parameters": "a"}, "parameters: 'a'"),
        ({"transforms": {"b": Positive()}}, r"transforms: \['b'\]"),
    ],
)  # fmt: skip
def test_bad_arguments_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        sample(**options)


def test_one_step_of_time_and_no_observation_at_all():
    """Without observations the posterior is the prior."""
    run = sample(observations=jnp.full(1, jnp.nan), missing="skip")
    assert run.trajectories.shape == (2, 3, 2)
    assert np.isfinite(run.parameters["a"]).all()
