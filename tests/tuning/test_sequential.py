"""SMC² against exact posteriors, with ten particles in each filter, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Checkpoint, Series
from mpfjax.tuning import Positive, smc2
from mpfjax.tuning import sequential as observing
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


SERIES = Series.skipping(OBSERVATIONS)


def sample(num_samples=60, *, key=None, filter=None, observations=SERIES, **options):
    options = {
        "sample_prior": sample_a, "log_prior": log_prior_of_a, "parameters": A, "num_moves": 5,
        "progress": False,
    } | options  # fmt: skip
    filter = mpfjax.particle_filter(ScalarLinear(), 10) if filter is None else filter
    key = jax.random.key(0) if key is None else key
    arguments = {"key": key, "filter": filter, "observations": observations}
    return smc2(**arguments | {"num_samples": num_samples} | options)


def part(first, last):
    """Some of the observations."""
    return Series.skipping(OBSERVATIONS[first:last])


def with_thresholds(monkeypatch, ess=0.5, acceptance=0.2):
    monkeypatch.setattr(observing, "_ESS_THRESHOLD", ess)
    monkeypatch.setattr(observing, "_ACCEPTANCE_THRESHOLD", acceptance)


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
    def test_through_a_mixture_is_the_exact_one(self, monkeypatch):
        """With K-means, merging and splitting in the chain."""
        with_thresholds(monkeypatch, ess=0.8)
        filter = eager_mixture()
        options = {"sample_prior": sample_sigma, "log_prior": log_prior_of_sigma}
        runs = [
            sample(
                240, key=key, filter=filter, observations=SQUARES, parameters=SIGMA,
                transforms={"sigma_y": Positive()}, **options,
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
        for run in runs:
            below = run.effective_sample_sizes < 0.8 * 240
            np.testing.assert_array_equal(np.isfinite(run.acceptance_rates), below)
            mean = run.weights @ run.parameters["sigma_y"]
            assert run.mean("sigma_y") == pytest.approx(mean, abs=1e-5)

    @pytest.mark.thorough
    def test_where_the_particles_double_it_is_the_exact_one(self, monkeypatch):
        """From five, after every move, to twenty."""
        with_thresholds(monkeypatch, ess=0.9, acceptance=1.0)
        options = {"max_particles": 20}
        filter = mpfjax.particle_filter(ScalarLinear(), 5)
        keys = jax.random.split(jax.random.key(4), NUM_RUNS)
        runs = [sample(240, key=key, filter=filter, **options) for key in keys]
        assert_posterior(runs, [run.parameters["a"] for run in runs], posterior_of_a())
        assert all(run.num_particles[-1] == 20 for run in runs)

    @pytest.mark.thorough
    def test_of_further_observations_it_is_the_exact_one(self):
        runs = [
            sample(240, key=key, observations=part(0, 3))
            .extend(part(3, 4), progress=False)
            .extend(part(4, 8), progress=False)
            for key in jax.random.split(jax.random.key(5), NUM_RUNS)
        ]
        assert_posterior(runs, [run.parameters["a"] for run in runs], posterior_of_a())


def test_one_step_and_no_observation_at_all():
    """Without observations the samples are those of the prior."""
    run = sample(observations=Series.skipping(jnp.full(1, jnp.nan)))
    assert run.log_marginal_likelihood == pytest.approx(0.0, abs=1e-5)
    np.testing.assert_allclose(run.weights, 1 / 60, rtol=1e-5)


def nan_prior(parameters):
    return jnp.where(parameters["a"] < 9, jnp.nan, 0.0)


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


ROWS = ("log_likelihood_increments", "effective_sample_sizes", "acceptance_rates", "num_particles")


def assert_same_rows(one, other, length=None):
    for name in ROWS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name)[:length])


def assert_same_samples(one, other):
    assert_same_rows(one, other)
    np.testing.assert_array_equal(one.parameters["a"], other.parameters["a"])
    np.testing.assert_array_equal(one.log_weights, other.log_weights)


@pytest.mark.thorough
def test_further_observations_give_what_all_at_once_give():
    """Two at a time, with a missing one among them; to the bit, and the first stays as it is."""
    whole = sample()
    grown = first = sample(observations=part(0, 2))
    for t in range(2, len(OBSERVATIONS), 2):
        grown = grown.extend(part(t, t + 2), progress=False)
    assert grown.parameters["a"].shape == (60,)
    assert_same_samples(grown, whole)
    assert len(first.log_likelihood_increments) == 2
    np.testing.assert_array_equal(
        first.extend(part(2, 8), progress=False).parameters["a"], whole.parameters["a"]
    )
    with pytest.raises(ValueError, match=r"observations: .* are not like those before"):
        first.extend(jnp.zeros((2, 3)))


def interrupt_at(monkeypatch, step):
    """Ctrl-C at an observation."""
    real = observing.extended

    def interrupted(sampler, key, samples, t):
        if int(t) == step:
            raise KeyboardInterrupt
        return real(sampler, key, samples, t)

    monkeypatch.setattr(observing, "extended", interrupted)


@pytest.mark.thorough
def test_interrupted_and_resumed_the_samples_are_those_of_one_run(tmp_path, monkeypatch):
    """Also to observations that were not there before, and where N has doubled meanwhile."""
    with_thresholds(monkeypatch, acceptance=1.0)
    options = {"max_particles": 20}
    kept = options | {"checkpoint": Checkpoint(tmp_path / "samples.npz", every=3)}
    whole = sample(**options)
    assert set(whole.num_particles) == {10, 20}
    with monkeypatch.context() as patch:
        interrupt_at(patch, 5)
        with pytest.warns(UserWarning, match="interrupted at step 5 of 8"):
            some = sample(**kept)
    assert some.stopped == "interrupted at step 5 of 8"
    assert_same_rows(some, whole, 5)
    assert_same_samples(some.extend(part(5, 8), progress=False), whole)
    shorter = kept | {"observations": part(0, 6), "checkpoint": Checkpoint(tmp_path / "6.npz")}
    sample(**shorter)
    assert_same_samples(sample(**shorter | {"observations": SERIES}), whole)
    assert_same_samples(sample(**kept), whole)
    with pytest.raises(ValueError, match=r"is of another smc2: observations.* is"):
        sample(**kept, observations=Series.skipping(OBSERVATIONS.at[0].add(1.0)))
    with pytest.raises(ValueError, match=r"is of another smc2: num_moves is 5 there and 2 here"):
        sample(**kept | {"num_moves": 2})


@pytest.mark.thorough
def test_where_particles_double_weights_change_by_the_ratio_of_likelihoods(monkeypatch):
    """And the mean of these ratios joins the evidence."""
    with_thresholds(monkeypatch, acceptance=1.0)
    run, state = sample(max_particles=20)._goes_on
    samples = state.carry[0]
    steps = jnp.asarray(len(OBSERVATIONS), jnp.int32)
    found = observing.exchanged(run.sampler.with_particles(20), run.key, samples, steps)
    before, after = samples, found.samples
    ratios = after.particles.log_evidence - before.particles.log_evidence
    assert np.ptp(ratios) > 0.1
    np.testing.assert_allclose(
        after.log_weights + found.increment, before.log_weights + ratios, atol=1e-4
    )
    assert after.particles.mixture.log_weights.shape == (60, 20)
    np.testing.assert_array_equal(after.particles.reals["a"], before.particles.reals["a"])


class Fragile(ScalarLinear):
    """A likelihood that breaks where a is above 0.5, from observations above 1.8 on."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where((self.a > 0.5) & (observation > 1.8), jnp.nan, honest)


def test_a_nan_costs_its_sample_alone(monkeypatch):
    """The weight of such a θ is zero; nothing else is lost, and they are counted."""
    with_thresholds(monkeypatch, ess=0.0)
    filter = mpfjax.particle_filter(Fragile(), 10)
    with pytest.warns(UserWarning, match=r"zero density: log_marginal_likelihood \d+ times$"):
        run = sample(filter=filter)
    dropped = run.parameters["a"] > 0.5
    assert run.num_invalid == {"log_prior": 0, "log_marginal_likelihood": dropped.sum()}
    assert 0 < dropped.sum() < 60
    assert (run.weights[dropped] == 0).all()
    assert (run.weights[~dropped] > 0).all()
    assert np.isfinite(run.log_marginal_likelihood)
    with_thresholds(monkeypatch, ess=1.0)
    with pytest.warns(UserWarning, match="zero density"):
        moved = sample(filter=filter)
    assert (moved.parameters["a"] <= 0.5).all()


def test_where_nobody_is_left_the_posterior_before_that_is():
    filter = mpfjax.particle_filter(Fragile(), 10)
    with pytest.warns(UserWarning, match="no sample has any likelihood.* at step 4"):
        run = sample(filter=filter, sample_prior=lambda key: {"a": 0.7 + 0 * sample_a(key)["a"]})
    assert run.stopped == "no sample has any likelihood, NaN or +inf in 60, at step 4"
    assert run.weights.sum() == pytest.approx(1.0, abs=1e-4)
    assert len(run.log_likelihood_increments) == 4


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"max_particles": 0}, "max_particles: 0"),
        ({"key": 0}, "key: 0 is no typed key"),
        ({"filter": 3}, "filter: 3 is not a filter"),
        ({"filter": mpfjax.gaussian_particle_filter(ScalarLinear(), 10)}, "filter: an approx"),
        ({"num_samples": 0}, "num_samples: 0"),
        ({"num_samples": 10}, r"num_samples: 10 is no multiple of num_moves \+ 1, 6"),
        ({"num_moves": 0}, "num_moves: 0"),
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
        ({"observations": np.full(3, np.nan)}, "observations: NaN"),
        ({"parameters": "a"}, "parameters: 'a'"),
    ],
)
def test_bad_arguments_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        sample(**options)
