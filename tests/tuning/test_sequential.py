"""SMC² goes on, from its file or with what is seen later, and loses only what is broken."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax import Checkpoint, Series
from mpfjax.tuning import Positive, smc2
from mpfjax.tuning import sequential as observing
from tests.tuning.examples import OBSERVATIONS, PRIOR, A, interrupt, log_prior_of_a, sample_a
from tests.user_models import ScalarLinear

SERIES = Series.skipping(OBSERVATIONS)


FILTER = mpfjax.particle_filter(ScalarLinear(), 10)


def sample(**options):
    return smc2(**{
        "key": jax.random.key(0), "filter": FILTER, "observations": SERIES, "num_samples": 60,
        "sample_prior": sample_a, "log_prior": log_prior_of_a, "parameters": A, "num_moves": 5,
        "progress": False,
    } | options)  # fmt: skip


def part(first, last):
    """Some of the observations."""
    return Series.skipping(OBSERVATIONS[first:last])


class Faulty(ScalarLinear):
    """Every likelihood is the same: r."""

    def log_likelihood(self, observation, states):
        return jnp.broadcast_to(self.r, states.shape)


@pytest.mark.parametrize(
    ("value", "named"), [(-np.inf, "no sample has any likelihood"), (np.nan, "NaN or")]
)
def test_likelihoods_that_are_none_are_an_error(value, named):
    with pytest.raises(RuntimeError, match=named):
        sample(filter=mpfjax.particle_filter(Faulty(r=value), 10))


def sample_log_normal(key):
    return {"a": jnp.exp(sample_a(key)["a"])}


@pytest.mark.parametrize(
    ("log_prior", "sample_prior"),
    [
        (lambda p: norm.logpdf(p["a"], PRIOR[0], PRIOR[1] ** 2), sample_a),
        (lambda p: -log_prior_of_a(p), sample_a),
        (lambda p: log_prior_of_a({"a": jnp.log(p["a"])}), sample_log_normal),
    ],
    ids=["a variance", "a sign", "no Jacobian"],
)
def test_a_prior_must_be_that_of_its_draws(log_prior, sample_prior):
    transforms = {"a": Positive()} if sample_prior is sample_log_normal else {}
    with pytest.raises(ValueError, match="log_prior: it is not the log density of the draws"):
        sample(log_prior=log_prior, sample_prior=sample_prior, transforms=transforms)


ROWS = ("log_likelihood_increments", "effective_sample_sizes", "acceptance_rates")


def assert_same_rows(one, other, length=None):
    for name in ROWS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name)[:length])


def assert_same_samples(one, other):
    assert_same_rows(one, other)
    np.testing.assert_array_equal(one.parameters["a"], other.parameters["a"])
    np.testing.assert_array_equal(one.log_weights, other.log_weights)


@pytest.mark.weekly
def test_interrupted_and_resumed_the_samples_are_those_of_one_run(tmp_path, monkeypatch):
    """Also to observations that were not there before."""
    whole, file = sample(), Checkpoint(tmp_path / "samples.npz", every=3)
    assert np.isfinite(whole.acceptance_rates).any()
    with monkeypatch.context() as patch:
        interrupt(patch, observing, "extend", lambda sampler, key, samples, t: int(t) == 5)
        with pytest.warns(UserWarning, match="interrupted at step 5 of 8"):
            some = sample(checkpoint=file)
    assert some.stopped == "interrupted at step 5 of 8"
    assert_same_rows(some, whole, 5)
    grown = some.extend(part(5, 6), progress=False)
    assert_same_samples(grown.extend(part(6, 8), progress=False), whole)
    assert len(some.log_likelihood_increments) == 5
    with pytest.raises(ValueError, match=r"observations: .* is not like those before"):
        some.extend(jnp.zeros((2, 3)))
    six = Checkpoint(tmp_path / "6.npz")
    sample(observations=part(0, 6), checkpoint=six)
    assert_same_samples(sample(checkpoint=six), whole)
    assert_same_samples(sample(checkpoint=file), whole)
    with pytest.raises(ValueError, match=r"is of another smc2: observations.* is"):
        sample(observations=Series.skipping(OBSERVATIONS.at[0].add(1.0)), checkpoint=file)
    with pytest.raises(ValueError, match=r"another smc2: num_moves is 5 there and 2 here"):
        sample(num_moves=2, checkpoint=file)


class Fragile(ScalarLinear):
    """A likelihood that breaks where a is above 0.5, from observations above 1.8 on."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where((self.a > 0.5) & (observation > 1.8), jnp.nan, honest)


@pytest.mark.exactness
def test_a_nan_costs_its_sample_alone(monkeypatch):
    """The weight of such a θ is zero; nothing else is lost, and they are counted."""
    monkeypatch.setattr(observing, "_ESS_THRESHOLD", 0.0)
    filter = mpfjax.particle_filter(Fragile(), 10)
    with pytest.warns(UserWarning, match=r"was NaN or \+inf, taken for zero, \d+ times$"):
        run = sample(filter=filter)
    dropped = run.parameters["a"] > 0.5
    assert run.num_invalid == dropped.sum()
    assert 0 < dropped.sum() < 60
    assert (run.weights[dropped] == 0).all()
    assert (run.weights[~dropped] > 0).all()
    assert np.isfinite(run.log_marginal_likelihood)
    monkeypatch.setattr(observing, "_ESS_THRESHOLD", 1.0)
    with pytest.warns(UserWarning, match="taken for zero"):
        moved = sample(filter=filter)
    assert (moved.parameters["a"] <= 0.5).all()


def test_where_nobody_is_left_the_posterior_before_that_is():
    filter = mpfjax.particle_filter(Fragile(), 10)
    with pytest.warns(UserWarning, match="no sample has any likelihood.* at step 4"):
        run = sample(filter=filter, sample_prior=lambda key: {"a": 0.7 + 0 * sample_a(key)["a"]})
    assert run.stopped == "no sample has any likelihood, NaN or +inf in 60, at step 4"
    assert run.weights.sum() == pytest.approx(1.0, abs=1e-4)
    assert len(run.log_likelihood_increments) == 4
