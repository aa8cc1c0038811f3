"""Posteriors as ArviZ reads them."""

import sys
import types

import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.tuning import to_inference_data
from mpfjax.tuning.gibbs import GibbsPosterior
from mpfjax.tuning.metropolis import Posterior
from mpfjax.tuning.sequential import SequentialPosterior

RNG = np.random.default_rng(0)
CHAINS = Posterior(
    parameters={"a": RNG.normal(size=(3, 50)), "b": RNG.normal(size=(3, 50, 2))},
    log_marginal_likelihoods=RNG.normal(size=(3, 50)),
    accepted=RNG.random((3, 50)) < 0.3,
    stopped=None,
)
STATES = {"position": RNG.normal(size=(3, 50, 6, 2)), "speed": RNG.normal(size=(3, 50, 6))}
GIBBS = GibbsPosterior(
    parameters=CHAINS.parameters,
    trajectories=STATES,
    accepted=RNG.random((3, 50)),
    renewed=RNG.random((3, 50, 6)) < 0.7,
    stopped=None,
)


@pytest.fixture(scope="module")
def arviz():
    return pytest.importorskip(
        "arviz", reason="the extra 'arviz' brings 125 MB, mostly pandas, and is not in 'test'"
    )


def test_of_metropolis_hastings(arviz):
    data = to_inference_data(CHAINS)
    np.testing.assert_array_equal(data["posterior"]["b"], CHAINS.parameters["b"])
    assert data["posterior"]["a"].dims == ("chain", "draw")
    stats = data["sample_stats"]
    np.testing.assert_array_equal(stats["accepted"], CHAINS.accepted)
    np.testing.assert_array_equal(stats["log_marginal_likelihood"], CHAINS.log_marginal_likelihoods)
    ess = float(arviz.ess(data)["a"])
    assert 50 < ess < 400  # independent draws


def test_of_particle_gibbs(arviz):
    data = to_inference_data(GIBBS)
    posterior = data["posterior"]
    assert posterior["state_position"].dims[:3] == ("chain", "draw", "time")
    np.testing.assert_array_equal(posterior["state_position"], STATES["position"])
    assert posterior["state_speed"].dims == ("chain", "draw", "time")
    np.testing.assert_array_equal(posterior["time"], np.arange(6))
    np.testing.assert_array_equal(data["sample_stats"]["renewed"], GIBBS.renewed)
    np.testing.assert_array_equal(data["sample_stats"]["acceptance_rate"], GIBBS.accepted)


def test_of_smc2_samples_count_as_often_as_they_weigh(arviz):
    weights = np.array([0.5, 0.0, 0.25, 0.25])
    one = {"a": np.arange(4.0), "b": np.arange(8.0).reshape(4, 2)}
    cloud = SequentialPosterior(
        parameters={name: np.repeat(values, 50, axis=0) for name, values in one.items()},
        log_weights=np.log(np.repeat(weights, 50) / 50, where=np.repeat(weights, 50) > 0,
                           out=np.full(200, -np.inf)),
        log_likelihood_increments=np.zeros(1), effective_sample_sizes=np.zeros(1),
        acceptance_rates=np.zeros(1), num_particles=np.ones(1, int),
        num_invalid={},
    )  # fmt: skip
    posterior = to_inference_data(cloud)["posterior"]
    drawn = posterior["a"].values
    assert drawn.shape == (1, 200)
    np.testing.assert_array_equal(np.bincount(drawn[0].astype(int), minlength=4), 200 * weights)
    assert posterior["b"].shape == (1, 200, 2)
    assert float(arviz.ess(posterior["a"].values)) > 50


@pytest.mark.usefixtures("arviz")
def test_of_what_particle_gibbs_collected():
    first = STATES["speed"][:, :, 0]
    of_first = GibbsPosterior(CHAINS.parameters, first, GIBBS.accepted, GIBBS.renewed, None)
    data = to_inference_data(of_first)
    assert data["posterior"]["state"].dims == ("chain", "draw")


@pytest.mark.usefixtures("arviz")
def test_of_trajectories():
    data = to_inference_data(jnp.asarray(STATES["speed"][0]))
    assert data["posterior"]["state"].dims == ("chain", "draw", "time")
    assert data["posterior"]["state"].shape == (1, 50, 6)


def before_1(posterior=None, *, sample_stats=None, dims=None, coords=None):
    """The parameters that `arviz.from_dict` had before 1."""
    return {"posterior": posterior, "sample_stats": sample_stats}, dims, coords


def from_1_on(data, *, dims=None, coords=None):
    """Groups in one mapping."""
    return data, dims, coords


@pytest.mark.parametrize("from_dict", [before_1, from_1_on])
def test_either_version_gets_the_same_groups(from_dict, monkeypatch):
    arviz = types.ModuleType("arviz")
    monkeypatch.setattr(arviz, "from_dict", from_dict, raising=False)
    monkeypatch.setitem(sys.modules, "arviz", arviz)
    groups, dims, coords = to_inference_data(GIBBS)
    assert set(groups["posterior"]) == {"a", "b", "state_position", "state_speed"}
    assert set(groups["sample_stats"]) == {"acceptance_rate", "renewed"}
    assert dims["state_position"] == ["time", "state_position_dim_1"]
    assert dims["renewed"] == ["time"]
    np.testing.assert_array_equal(coords["time"], np.arange(6))


@pytest.mark.usefixtures("arviz")
@pytest.mark.parametrize(
    ("result", "named"),
    [
        (None, "result: None is not"),
        (3.0, r"result: 3\.0 is not"),
        (jnp.ones(4), "result: .* is not"),
        ({"a": jnp.ones((2, 3)), "b": jnp.ones((2, 4))}, r"(?s)result: .* nor trajectories"),
        (np.array([["a", "b"]]), "result: .* is not"),
        (
            GibbsPosterior(
                {"state": CHAINS.parameters["a"]}, STATES["speed"], GIBBS.accepted, GIBBS.renewed,
                None,
            ),
            "result: a parameter is called state",
        ),
    ],
)  # fmt: skip
def test_anything_else_is_named(result, named):
    with pytest.raises(ValueError, match=named):
        to_inference_data(result)


def test_without_arviz_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(ImportError, match="pip install arviz"):
        to_inference_data(CHAINS)
