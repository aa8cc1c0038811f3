"""What comes next over the posterior of parameters and states, against the exact distribution."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax import Series
from mpfjax.exact import kalman_filter, kalman_smoother
from mpfjax.tuning import (
    metropolis_hastings,
    particle_gibbs,
    posterior_predictive,
    posterior_trajectories,
    smc2,
)
from mpfjax.tuning.evidence import pose_evidence
from tests.marking import weekly
from tests.tuning.examples import Pushed

KEY, NUM_STEPS = jax.random.key(0), 3
SEEN = np.float32([1.5, 2.2, np.nan, 4.1, np.nan, np.nan, np.nan])
INPUTS = np.float32([0.4, -0.2, 0.7, 0.1, 0.5, -1.0, 0.3])
SERIES = Series.skipping(SEEN[:-NUM_STEPS], INPUTS[:-NUM_STEPS])


class Drifting(Pushed):
    """x_t = a x_{t-1} + u_t + d + N(0, q²) with d ~ N(0, 1): all is normal, d included."""

    d: jax.Array = eqx.field(converter=jnp.asarray, default=0.0)

    def transition_mean(self, states):
        return super().transition_mean(states) + self.d

    def sample_observation(self, key, states):
        return self.h * states + self.r * jax.random.normal(key, states.shape)


FILTER = mpfjax.particle_filter(Drifting(), 5)
OF_D = {"parameters": {"d": lambda filter: filter.model.d}, "progress": False}
CHAINS = {"num_chains": 100, "burn_in": 30} | OF_D


def exact_moments():
    """Of x and y after the last observation, and of x from x_0 and y before, given what was seen.

    By a Kalman filter, and smoother, of the state (x, d).
    """
    m = jax.tree.map(float, Drifting())
    model = mpfjax.LinearGaussianModel(
        A=[[m.a, 1.0], [0.0, 1.0]], Q=np.diag([m.q**2, 0.0]), B=[[1.0], [0.0]],
        H=[[m.h, 0.0]], R=[[m.r**2]], m0=[m.m, 0.0], P0=np.diag([m.p**2, 1.0]),
    )  # fmt: skip
    found = kalman_filter(model, mpfjax.Series.skipping(SEEN[:, None], INPUTS[:, None]))
    past = Series(SERIES.observations[:, None], SERIES.inputs[:, None], skips_missing=True)
    past = kalman_smoother(model, past)
    ahead = found.means[-NUM_STEPS:, 0], found.covariances[-NUM_STEPS:, 0, 0]
    past = past.means[:, 0], past.covariances[:, 0, 0]

    def of_observations(mean, variance):
        return m.h * mean, m.h**2 * variance + m.r**2

    moments = ahead, of_observations(*ahead), past, of_observations(past[0][1:], past[1][1:])
    return jax.tree.map(np.asarray, moments)


def log_prior(parameters):
    return norm.logpdf(parameters["d"])


def sample_prior(key):
    return {"d": jax.random.normal(key)}


PRIOR = {"log_prior": log_prior, "sample_prior": sample_prior}


def by_metropolis():
    run = metropolis_hastings(KEY, FILTER, SERIES, 200, proposal_deviations=0.8, **PRIOR, **CHAINS)
    own = jax.random.wrap_key_data(run.key_data[3, 7])
    (again,) = run.problem.objective(own, run.problem.having({"d": run.parameters["d"][3, 7]}))
    assert float(again) == pytest.approx(run.log_marginal_likelihoods[3, 7], abs=1e-4)
    of_two = pose_evidence(FILTER, [SERIES, SERIES], OF_D["parameters"], None)
    with pytest.raises(ValueError, match="posterior: it is given several sequences"):
        posterior_predictive(KEY, replace(run, problem=of_two), 1)
    return run


def by_gibbs():
    return particle_gibbs(KEY, FILTER, SERIES, 200, proposal_deviations=0.8, **PRIOR, **CHAINS)


class NoDensity(Drifting):
    log_transition = None


def by_genealogy():
    filter = mpfjax.particle_filter(NoDensity(), 20)
    return metropolis_hastings(KEY, filter, SERIES, 200, proposal_deviations=0.8, **PRIOR, **CHAINS)


def by_smc2():
    return smc2(KEY, FILTER, SERIES, 4000, num_moves=3, **PRIOR, **OF_D)


def z_scores(values, mean, variance, independent=None):
    """Of means and variances over chains, or over so many `independent` draws of one chain."""
    moments = np.stack([values - mean, (values - mean) ** 2 - variance])
    if independent is not None:
        error = moments.std(axis=2) / np.sqrt(independent)
    else:
        error = moments.mean(axis=2).std(axis=1, keepdims=True) / np.sqrt(len(values))
    return moments.mean(axis=(1, 2)) / error[:, 0]


@pytest.mark.exactness
@pytest.mark.parametrize("sample", [by_metropolis, *weekly([by_gibbs, by_genealogy, by_smc2])])
def test_means_and_variances_are_the_exact_ones(sample):
    """Within four standard errors, over chains; of `smc2`, by its effective sample size."""
    run = sample()
    ahead = posterior_predictive(jax.random.key(1), run, NUM_STEPS, inputs=INPUTS[-NUM_STEPS:])
    past = posterior_trajectories(jax.random.key(2), run)
    found = *ahead, past.states, past.observations
    for values, (mean, variance) in zip(found, exact_moments(), strict=True):
        independent = run.effective_sample_sizes.min() if sample is by_smc2 else None
        z = z_scores(values, mean, variance, independent)
        assert z.shape == (2, len(mean))
        assert np.abs(z).max() < 4, z
