"""Tables of posteriors: effective sizes and R-hat of chains against what they must be."""

import numpy as np
import pytest
from scipy.signal import lfilter

from mpfjax.tuning.mcmc import Posterior
from mpfjax.tuning.problem import pose
from mpfjax.tuning.summaries import effective_sample_size, row_of, split_r_hat
from tests.user_models import ScalarLinear

RNG = np.random.default_rng(0)
PROBLEM = pose(ScalarLinear(), len, None, None)


@pytest.mark.parametrize("a", [0.0, 0.5, 0.9])
def test_the_effective_size_of_an_autoregression_is_known(a):
    """n (1 - a) / (1 + a)."""
    chains = lfilter([1.0], [1.0, -a], RNG.normal(size=(4, 20_000)), axis=1)
    expected = 80_000 * (1 - a) / (1 + a)
    assert effective_sample_size(chains) == pytest.approx(expected, rel=0.1)
    assert split_r_hat(chains) == pytest.approx(1.0, abs=0.01)


def test_chains_apart_and_chains_that_drift_have_a_large_r_hat():
    """Two normals at distance d: sqrt(1 + d² / 2) as the chains grow longer."""
    chains = RNG.normal(size=(2, 10_000))
    apart = chains + np.array([[0.0], [2.0]])
    assert split_r_hat(apart) == pytest.approx(np.sqrt(1 + 4 / 3), rel=0.02)
    assert effective_sample_size(apart) < 20
    assert split_r_hat(chains[:1] + np.linspace(0, 4, 10_000)) > 1.4
    assert np.isnan(split_r_hat(np.ones((2, 10))))
    assert np.isnan(effective_sample_size(np.ones((2, 3))))


def test_weighted_draws_count_as_often_as_they_weigh():
    values, counts = RNG.normal(size=50), RNG.integers(0, 5, 50)
    weighted, repeated = row_of(values, counts / counts.sum()), row_of(np.repeat(values, counts))
    for name in ("mean", "deviation"):
        assert weighted[name] == pytest.approx(repeated[name])
    assert abs(weighted["50%"] - repeated["50%"]) < 0.2


def posterior(one_start=False):
    draws = {"a": RNG.normal(size=(2, 100)), "b": RNG.normal(size=(2, 100, 2))}
    accepted = np.zeros((2, 100), bool)
    accepted[:, ::4] = True
    return Posterior(
        parameters=draws, accepted=accepted, log_marginal_likelihoods=draws["a"],
        stopped=None, num_invalid=np.zeros(2, int), problem=PROBLEM, key_data=None,
        one_start=one_start,
    )  # fmt: skip


def test_a_posterior_prints_a_table_of_its_numbers_and_not_its_arrays():
    lines = repr(posterior()).splitlines()
    assert lines[0] == "2 chains of 100 draws, 25% accepted"
    assert [line.split()[0] for line in lines[3:]] == ["a", "b[0]", "b[1]"]
    assert set(posterior().summary()["b[1]"]) == {
        "mean", "deviation", "5%", "50%", "95%", "effective size", "R-hat",
    }  # fmt: skip


def test_chains_of_one_start_have_no_r_hat_and_say_so():
    together = posterior(one_start=True)
    assert "no R-hat without sample_prior" in repr(together)
    assert np.isnan(together.summary()["a"]["R-hat"])
