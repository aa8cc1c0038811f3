"""Posteriors as ArviZ is given them, in both forms of its `from_dict`."""

import sys
import types

import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import Series
from mpfjax.tuning import to_inference_data
from mpfjax.tuning.gibbs import GibbsPosterior
from mpfjax.tuning.happened import PosteriorTrajectories
from mpfjax.tuning.metropolis import Posterior
from mpfjax.tuning.predictive import Predictive
from mpfjax.tuning.sequential import SequentialPosterior

RNG = np.random.default_rng(0)
PARAMETERS = {"a": RNG.normal(size=(3, 50)), "b": RNG.normal(size=(3, 50, 2))}
STATES = {"position": RNG.normal(size=(3, 50, 6, 2)), "speed": RNG.normal(size=(3, 50, 6))}
ACCEPTED, RENEWED = RNG.random((3, 50)), RNG.random((3, 50, 6)) < 0.7


def before_1(posterior=None, *, dims=None, coords=None, **groups):
    return {"posterior": posterior} | groups, dims, coords


def from_1_on(data, *, dims=None, coords=None):
    return data, dims, coords


@pytest.fixture(params=[before_1, from_1_on], autouse=True)
def arviz(request, monkeypatch):
    module = types.ModuleType("arviz")
    monkeypatch.setattr(module, "from_dict", request.param, raising=False)
    monkeypatch.setitem(sys.modules, "arviz", module)


def of_metropolis():
    return Posterior(
        parameters=PARAMETERS, log_marginal_likelihoods=ACCEPTED, accepted=ACCEPTED > 0.5
    )


def of_gibbs(states=STATES):
    return GibbsPosterior(
        parameters=PARAMETERS, trajectories=states, accepted=ACCEPTED, renewed=RENEWED
    )


def test_of_metropolis_hastings():
    groups, dims, _ = to_inference_data(of_metropolis())
    assert groups["posterior"] == PARAMETERS
    assert set(groups["sample_stats"]) == {"log_marginal_likelihood", "accepted"}
    assert dims == {}


def test_of_particle_gibbs():
    groups, dims, coords = to_inference_data(of_gibbs())
    assert set(groups["posterior"]) == {"a", "b", "state_position", "state_speed"}
    assert set(groups["sample_stats"]) == {"acceptance_rate", "renewed"}
    assert dims["state_position"] == ["time", "state_position_dim_1"]
    assert dims["state_speed"] == dims["renewed"] == ["time"]
    np.testing.assert_array_equal(coords["time"], np.arange(6))
    groups, dims, _ = to_inference_data(of_gibbs(STATES["speed"][:, :, 0]))
    assert groups["posterior"]["state"].shape == (3, 50)
    assert set(dims) == {"renewed"}


def test_of_what_comes_next():
    ahead = Predictive({"speed": RNG.normal(size=(3, 50, 4))}, RNG.normal(size=(3, 50, 4, 2)))
    groups, dims, coords = to_inference_data(of_gibbs(), ahead)
    assert set(groups["posterior_predictive"]) == {"observation_ahead", "state_ahead_speed"}
    assert dims["observation_ahead"] == ["ahead", "observation_ahead_dim_1"]
    assert coords["ahead"].tolist() == [1, 2, 3, 4]
    assert coords["time"].tolist() == list(range(6))


def test_of_what_happened():
    seen, again = RNG.normal(size=5), RNG.normal(size=(3, 50, 5))
    present = np.arange(5) != 2
    past = PosteriorTrajectories(PARAMETERS, STATES, again, Series(seen, present=present))
    groups, dims, coords = to_inference_data(past)
    assert set(groups["posterior"]) == {"a", "b", "state_position", "state_speed"}
    assert dims["state_speed"] == ["time"]
    assert coords["time"].tolist() == list(range(6))
    assert dims["observation"] == ["observation_time"]
    assert coords["observation_time"].tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(groups["posterior_predictive"]["observation"], again)
    observed = groups["observed_data"]["observation"]
    np.testing.assert_array_equal(observed, np.where(present, seen, np.nan))
    assert "posterior_predictive" not in to_inference_data(past._replace(observations=None))[0]


def test_of_smc2_samples_count_as_often_as_they_weigh():
    weights = np.repeat([0.5, 0.0, 0.25, 0.25], 50) / 50
    with np.errstate(divide="ignore"):
        cloud = SequentialPosterior(
            {"a": np.repeat(np.arange(4.0), 50), "b": np.zeros((200, 2))}, np.log(weights),
            np.zeros(1), np.zeros(1), np.zeros(1), np.ones(1, int), {},
        )  # fmt: skip
    posterior = to_inference_data(cloud)[0]["posterior"]
    counts = np.bincount(posterior["a"][0].astype(int), minlength=4)
    np.testing.assert_array_equal(counts, [100, 0, 50, 50])
    assert posterior["b"].shape == (1, 200, 2)


def test_of_trajectories_and_of_nothing_else():
    groups, dims, _ = to_inference_data(jnp.asarray(STATES["speed"][0]))
    assert groups["posterior"]["state"].shape == (1, 50, 6)
    assert dims["state"] == ["time"]
    for wrong in (None, jnp.ones(4), {"a": jnp.ones((2, 3)), "b": jnp.ones((2, 4))}):
        with pytest.raises(ValueError, match=r"(?s)result: .* is no posterior"):
            to_inference_data(wrong)


def test_without_arviz_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(ImportError, match="pip install arviz"):
        to_inference_data(of_metropolis())
