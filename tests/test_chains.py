"""The contracts of every chain of moves in the registry.

Two programs are compiled for each chain and shared by the tests: thousands of runs of the chain
at once, and its single step.
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import grid_filter, kalman_filter
from tests.marking import quick_of
from tests.registry import CHAINS, MANY_COMPONENTS, NUM_PARTICLES, QUICK_CHAINS
from tests.user_models import (
    BLINDED,
    BROKEN,
    DRIFT_AS_LINEAR_GAUSSIAN,
    EXPLODING,
    Drift,
    TrickyQuadraticModel,
    nothing_traced,
)

NUM_RUNS = 2000
OBSERVATIONS = jnp.array([1.5, 1.0, 0.4, 0.9])
GRID = jnp.linspace(-5.0, 5.0, 1001)
MODELS = {"quadratic": TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0), "drift": Drift()}

over_chains = pytest.mark.parametrize("chain", quick_of(CHAINS, QUICK_CHAINS))


def is_exact(chain):
    return not CHAINS[chain](MODELS["quadratic"]).approximate


class Truth(NamedTuple):
    """The exact answer: log p(y_1..y_s) and E[x_s], E[x_s²] at each step s."""

    log_evidence: np.ndarray
    first: np.ndarray
    second: np.ndarray


@cache
def truth(model):
    if model == "quadratic":
        run = grid_filter(MODELS[model], OBSERVATIONS, GRID)
        first, second = run.means[:, None], (run.variances + run.means**2)[:, None]
    else:
        run = kalman_filter(DRIFT_AS_LINEAR_GAUSSIAN, OBSERVATIONS[:, None])
        first = run.means
        second = jnp.diagonal(run.covariances, axis1=1, axis2=2) + first**2
    return Truth(*map(np.asarray, (jnp.cumsum(run.log_likelihood_increments), first, second)))


def joint_truth(chain, model):
    """The same for all objects of the chain, which are independent and see the same."""
    one, copies = truth(model), getattr(chain_filter(chain, model).model, "num_objects", 1)
    first, second = (np.tile(moment, copies) for moment in (one.first, one.second))
    return Truth(copies * one.log_evidence, first, second)


def moments(mixture):
    states = mixture.particles.reshape(mixture.num_particles, -1)
    return mixture.average(states), mixture.average(states**2), mixture.particles


@cache
def chain_filter(chain, model):
    return CHAINS[chain](MODELS[model])


# Regrouping is exact whatever the labels are, so that what the state is makes no difference to it:
# a second model for the chains without, and for one of each kind with it.
ON_BOTH_MODELS = ("mpf", "mpf rqmc", "guided mpf", "partitioned in clusters")
EXACT = [
    (chain, model)
    for chain in CHAINS
    if is_exact(chain)
    for model in MODELS
    if model == "quadratic"
    or chain in ON_BOTH_MODELS
    or chain_filter(chain, model).num_components == 1
]


QUICK = [(chain, model) for chain, model in EXACT if chain in QUICK_CHAINS if model == "quadratic"]


@cache
def runs(chain, model):
    keys = jax.random.split(jax.random.key(3), NUM_RUNS)
    run = mpfjax.monte_carlo(keys, chain_filter(chain, model), OBSERVATIONS, moments)
    return jax.tree.map(np.asarray, run)


@pytest.mark.parametrize(("chain", "model"), quick_of(EXACT, QUICK))
class TestExactness:
    def test_evidence_and_moments_are_unbiased(self, chain, model):
        """E[Ẑ/Z] = 1, and E[Ẑ/Z φ̂] = E[φ | y], at every step, within 4 standard errors.

        A particle filter's estimate of E[φ | y] is biased, but times its evidence it is not.
        """
        run, exact = runs(chain, model), joint_truth(chain, model)
        log_evidence = np.cumsum(run.log_likelihood_increments, axis=1)
        ratios = np.exp(log_evidence - exact.log_evidence)
        first, second, _ = run.collected
        # Loose estimates would prove nothing.
        assert (ratios.std(axis=0) / np.sqrt(NUM_RUNS) < 0.04).all()
        assert_unbiased(ratios, 1.0)
        assert_unbiased(ratios[..., None] * first, exact.first)
        assert_unbiased(ratios[..., None] * second, exact.second)

    def test_increments_add_up(self, chain, model):
        run = runs(chain, model)
        total = run.log_likelihood_increments.sum(axis=1)
        np.testing.assert_allclose(run.log_marginal_likelihood, total, rtol=1e-5, atol=1e-5)

    def test_final_mixture_is_normalised_and_finite(self, chain, model):
        final, filter = runs(chain, model).final, chain_filter(chain, model)
        assert not np.isnan(final.log_weights).any()
        np.testing.assert_allclose(np.exp(final.log_weights).sum(axis=1), 1.0, rtol=1e-5)
        assert (final.component_indicators >= 0).all()
        assert (final.component_indicators < filter.num_components).all()
        ancestors = np.asarray(final.ancestor_indices)
        if all(move.keeps_parents for move in filter.moves):
            assert ((ancestors >= 0) & (ancestors < NUM_PARTICLES)).all()
        else:
            assert (ancestors == -1).all()


def assert_unbiased(estimates, expected):
    """The mean over runs is within 4 standard errors of what is expected, in every entry."""
    standard_error = estimates.std(axis=0) / np.sqrt(NUM_RUNS)
    z = (estimates.mean(axis=0) - expected) / standard_error
    assert np.abs(z).max() < 4, f"standard errors away: {z}"


def test_what_is_approximate_is_declared():
    declared = {chain for chain in CHAINS if not is_exact(chain)}
    of_components = {
        "exclusion", "gaussian mixture", "gaussian mixture rqmc", "predictive Gaussian"
    }  # fmt: skip
    of_many = f"predictive Gaussian, M = {MANY_COMPONENTS}"
    assert declared == {"dps prior", of_many} | of_components


def step_keys(key, length):
    """The keys that `run_filter` gives to `init` and to each step."""
    key_initial, key_steps = jax.random.split(key)
    return key_initial, jax.random.split(key_steps, length)


@over_chains
class TestOnline:
    """The chain's single step, on the tricky quadratic model."""

    def test_step_by_step_equals_the_scan_and_a_loop_equals_vmap(self, chain):
        run, filter = runs(chain, "quadratic"), chain_filter(chain, "quadratic")
        # A run in which no particle lies within rounding of the edge between two offspring.
        for k, key in list(enumerate(jax.random.split(jax.random.key(3), NUM_RUNS)))[6:7]:
            initial, keys = step_keys(key, len(OBSERVATIONS))
            mixture = filter.init(initial, OBSERVATIONS[0])
            for t, observation in enumerate(OBSERVATIONS):
                mixture, info = filter.step(keys[t], mixture, observation)
                increment = run.log_likelihood_increments[k, t]
                np.testing.assert_allclose(info.log_likelihood_increment, increment, rtol=1e-3)
                np.testing.assert_allclose(
                    mixture.particles, run.collected[2][k, t], rtol=1e-4, atol=1e-4
                )
                np.testing.assert_array_equal(info.resampled, run.resampled[k, t])
            np.testing.assert_array_equal(
                mixture.component_indicators, run.final.component_indicators[k]
            )
            np.testing.assert_array_equal(mixture.ancestor_indices, run.final.ancestor_indices[k])

    def test_a_step_of_zero_likelihood_is_flagged_and_the_filter_goes_on(self, chain):
        filter = chain_filter(chain, "quadratic")
        mixture = started(chain)
        blinded, info = filter.step(jax.random.key(6), mixture, observed(BLINDED))
        assert float(info.log_likelihood_increment) == -np.inf
        assert bool(info.degenerate)
        np.testing.assert_allclose(float(blinded.mixture_weights.sum()), 1.0, rtol=1e-5)
        assert np.isfinite(blinded.particles).all()
        after, info = filter.step(jax.random.key(7), blinded, OBSERVATIONS[0])
        assert np.isfinite(info.log_likelihood_increment)
        assert not bool(info.degenerate)
        assert np.isfinite(after.mean()).all()

    @pytest.mark.parametrize("constant", [1e3, -1e3, 1e6, -1e6, 1e9, -1e9, 1e30, -1e30])
    def test_a_constant_moves_the_evidence_and_nothing_else(self, chain, constant):
        """Added to every log-likelihood, of any size that the type holds.

        What it leaves of the likelihoods' own digits is the same in both filters.
        """
        constant = np.float32(constant)
        with_it, without = (
            CHAINS[chain](TrickyQuadraticModel(0.3, 0.5, constant=constant, taken_off=taken_off))
            for taken_off in (np.float32(0), constant)
        )
        mixture = expected = started(chain)
        copies = getattr(with_it.model, "num_objects", 1)
        for t, observation in enumerate(OBSERVATIONS[1:3]):
            mixture, info = with_it.step(jax.random.key(t), mixture, observation)
            expected, plain = without.step(jax.random.key(t), expected, observation)
            assert float(mixture.weights.sum()) == pytest.approx(1, rel=1e-5)
            increment = copies * constant + plain.log_likelihood_increment
            np.testing.assert_allclose(
                info.log_likelihood_increment, increment, rtol=1e-6, atol=1e-5
            )
            if chain == "joint pf":
                # Here the model adds up its objects' log-likelihoods, and what that rounds away
                # no filter can know.
                return
            np.testing.assert_array_equal(info.resampled, plain.resampled)
            np.testing.assert_allclose(info.mixture_weights, plain.mixture_weights, atol=1e-5)
            np.testing.assert_allclose(mixture.weights, expected.weights, rtol=1e-4, atol=1e-6)
            np.testing.assert_allclose(mixture.particles, expected.particles, atol=1e-5)
            np.testing.assert_array_equal(mixture.ancestor_indices, expected.ancestor_indices)
            labels = mixture.component_indicators, expected.component_indicators
            np.testing.assert_array_equal(*labels)

    def test_a_nan_observation_is_an_error(self, chain):
        filter = chain_filter(chain, "quadratic")
        with pytest.raises(RuntimeError, match="observation"):
            filter.step(jax.random.key(6), started(chain), observed(jnp.nan))

    def test_a_nan_or_infinite_density_is_an_error(self, chain):
        filter = chain_filter(chain, "quadratic")
        for observation in (BROKEN, EXPLODING):
            with pytest.raises(RuntimeError, match="model: a density was NaN or infinite"):
                filter.step(jax.random.key(6), started(chain), observed(observation))

    def test_nothing_compiles_again_as_components_come_and_go(self, chain):
        filter = chain_filter(chain, "quadratic")
        mixture = started(chain)
        filter.step(jax.random.key(6), mixture, OBSERVATIONS[0])
        with nothing_traced():
            for t, observation in enumerate((2.0, 1.0, 0.0, 0.0, 0.0, 3.0, BLINDED, 1.0)):
                mixture, _ = filter.step(jax.random.key(t), mixture, observed(observation))

    def test_another_filter_of_the_same_shape_compiles_nothing(self, chain):
        filter = chain_filter(chain, "quadratic")
        mixture = started(chain)
        filter.step(jax.random.key(6), mixture, OBSERVATIONS[0])
        other = CHAINS[chain](TrickyQuadraticModel(0.4, 0.2, -2.0, 2.0))
        with nothing_traced():
            other.step(jax.random.key(6), mixture, OBSERVATIONS[1])


def observed(value):
    """A strongly typed observation: a weakly typed one would be another program to JAX."""
    return jnp.asarray(value, jnp.float32)


@cache
def started(chain):
    """The chain's mixture after one step."""
    filter = chain_filter(chain, "quadratic")
    mixture = filter.init(jax.random.key(4))
    return filter.step(jax.random.key(5), mixture, OBSERVATIONS[0])[0]


@pytest.mark.parametrize("chain", ["pf adaptive", "mpf"])
def test_a_missing_observation_moves_the_particles_and_leaves_the_masses(chain):
    filter = chain_filter(chain, "quadratic")
    mixture = started(chain)
    predicted, info = filter.predict(jax.random.key(6), mixture)
    assert float(info.log_likelihood_increment) == 0.0
    assert not np.array_equal(predicted.particles, mixture.particles)
    np.testing.assert_allclose(predicted.mixture_weights, mixture.mixture_weights, rtol=1e-5)
