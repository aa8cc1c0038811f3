"""What the samplers share: starts, burn-in, learning, files and interruptions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import multivariate_normal

import mpfjax
from mpfjax import Checkpoint
from mpfjax.tuning import chains as chains_of
from mpfjax.tuning import metropolis_hastings
from tests.tuning.examples import interrupt
from tests.user_models import ScalarLinear

COVARIANCE = np.array([[1.0, 0.9 * 0.05], [0.9 * 0.05, 0.05**2]])
MEAN = np.array([1.0, 2.0])


class Blind(ScalarLinear):
    """Observations say nothing: the posterior is the prior."""

    def log_likelihood(self, observation, states):
        return jnp.zeros(states.shape)


def correlated(parameters):
    point = jnp.stack([parameters["a"], parameters["q"]])
    return multivariate_normal.logpdf(point, jnp.asarray(MEAN), jnp.asarray(COVARIANCE))


def dispersed(key):
    """Starts that are far apart, and often outside of what is possible."""
    a, q = 5 * jax.random.normal(key, (2,))
    return {"a": MEAN[0] + a, "q": MEAN[1] + 0.05 * q}


BLIND = {
    "parameters": {"a": lambda filter: filter.model.a, "q": lambda filter: filter.model.q},
    "log_prior": correlated, "proposal_deviations": {"a": 0.05, "q": 0.3}, "progress": False,
}  # fmt: skip
FILTER = mpfjax.particle_filter(Blind(a=1.0, q=2.0), 2)


def blind(num_steps, *, num_chains=30, key=0, **options):
    arguments = (jax.random.key(key), FILTER, jnp.zeros(1), num_steps)
    return metropolis_hastings(*arguments, num_chains=num_chains, **BLIND | options)


class TestLearning:
    @pytest.mark.exactness
    def test_burn_in_finds_the_covariance_and_the_posterior_stays_right(self):
        """Of two numbers of correlation .9, one twenty times as wide as the other, from
        deviations that are the other way round.
        """
        options = {"sample_prior": dispersed, "burn_in": 600}
        run = blind(600, **options)
        points = np.stack([run.parameters["a"], run.parameters["q"]], axis=-1).astype(float)
        assert 0.25 < run.acceptance_rate < 0.45
        assert blind(600, **options | {"burn_in": 0}).acceptance_rate < 0.2
        scale = np.sqrt(np.diag(COVARIANCE))
        standard = (points - MEAN) / scale
        moments = [standard, standard**2 - 1, standard.prod(axis=-1, keepdims=True) - 0.9]
        for found in moments:
            means = found.mean(axis=1)
            error = means.std(axis=0, ddof=1) / np.sqrt(len(means))
            assert (error < 0.05).all()
            assert (np.abs(means.mean(axis=0)) < 4 * error).all()


WHOLE = {"burn_in": 9, "sample_prior": dispersed}


def after(steps):
    return lambda kernel, key, chains, numbers: int(numbers[0]) >= steps


def assert_same_draws(one, other):
    for a, b in zip(jax.tree.leaves(vars(one)), jax.tree.leaves(vars(other)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.exactness
def test_interrupted_anywhere_the_draws_are_those_of_one_run(tmp_path, monkeypatch):
    """In the burn-in, where nothing is lost, and after it, where the draws so far come back."""
    whole, file = blind(15, **WHOLE), Checkpoint(tmp_path / "chains.npz", 4)
    with monkeypatch.context() as patch:
        interrupt(patch, chains_of, "_steps", after(5))
        with pytest.raises(KeyboardInterrupt):
            blind(15, checkpoint=file, **WHOLE)
    with monkeypatch.context() as patch:
        interrupt(patch, chains_of, "_steps", after(14))
        with pytest.warns(UserWarning, match=r"interrupted at step \d+ of 24"):
            part = blind(15, checkpoint=file, **WHOLE)
    draws = part.parameters["a"].shape[1]
    assert 0 < draws < 15
    assert "interrupted" in part.stopped
    np.testing.assert_array_equal(part.parameters["a"], whole.parameters["a"][:, :draws])
    longer = blind(22, **WHOLE)
    options = WHOLE | {"checkpoint": file}
    assert_same_draws(blind(15, **options), whole)
    assert_same_draws(blind(22, **options), longer)
    with pytest.raises(ValueError, match=r"of another metro.*num_chains is .* and 3 here"):
        blind(15, num_chains=3, **options)
    np.testing.assert_array_equal(blind(15, **options).parameters["a"], whole.parameters["a"])


@pytest.mark.exactness
def test_a_start_without_a_likelihood_is_drawn_again():
    def half(parameters):
        return jnp.where(parameters["a"] > 0, correlated(parameters), -jnp.inf)

    def either(key):
        return dispersed(key) | {"a": jnp.where(jax.random.bernoulli(key), 1.0, -1.0)}

    run = blind(1, sample_prior=either, log_prior=half, key=3)  # its first draw is possible
    assert (run.parameters["a"] > 0).all()
