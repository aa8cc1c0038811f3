"""Rao-Blackwellised backward sampling against all sequences of regimes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, PropagateRegimes
from mpfjax.exact import switching_filter
from mpfjax.smoothing import sample_trajectories
from tests.marking import weekly
from tests.switching import MODEL, NUM_REGIMES, OBSERVATIONS

NUM_RUNS, NUM_TRAJECTORIES = 40, 100


@eqx.filter_jit
def smoothed(filter, observations):
    """Trajectories of several runs of a filter."""

    def one(key):
        run = mpfjax.run_filter(key, filter, observations, None)
        key = jax.random.fold_in(key, 1)
        return sample_trajectories(key, filter, run, NUM_TRAJECTORIES, observations=observations)

    return jax.lax.map(one, jax.random.split(jax.random.key(0), NUM_RUNS))


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
    "far from zero": (*far_away(3000.0), 3000.0),
    "R singular": (*without_errors(), 0.0),
}


@pytest.mark.exactness
@pytest.mark.parametrize("case", ["R singular", *weekly(["far from zero"])])
def test_regimes_and_moments_are_those_of_all_sequences(case):
    model, observations, centre = CASES[case]
    filter = Filter(model, [PropagateRegimes()], 200)
    found = smoothed(filter, observations)
    exact = switching_filter(
        MODEL if centre else model, mpfjax.Series.skipping(observations - centre)
    )
    latent = np.asarray(found.latent)
    shares = np.stack([(latent == k).mean(axis=1) for k in range(NUM_REGIMES)], axis=-1)
    assert_close(shares, np.asarray(exact.smoothed_regime_probabilities))
    mean, truth = np.asarray(found.mean, float) - centre, np.asarray(exact.smoothed_means)
    assert_close(mean.mean(axis=1), truth)
    squares = np.asarray(found.covariance) + mean[..., :, None] * mean[..., None, :]
    second = np.asarray(exact.smoothed_covariances) + truth[:, :, None] * truth[:, None, :]
    assert_close(squares.mean(axis=1), second)
