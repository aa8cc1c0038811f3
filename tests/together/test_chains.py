"""The contracts of every chain of moves in the registry, on a model of two modes.

What steps, constants in the likelihood and impossible observations do is asked in the matrix.
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import grid_filter
from tests.marking import quick_of
from tests.registry import CHAINS, NUM_PARTICLES, QUICK_CHAINS
from tests.unbiased import assert_unbiased
from tests.user_models import BLINDED, BROKEN, EXPLODING, TrickyQuadraticModel, nothing_traced

NUM_RUNS = 4000
OBSERVATIONS = jnp.array([1.5, 1.0, 0.4, 0.9])
GRID = jnp.linspace(-5.0, 5.0, 1001)
MODEL = TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0)

over_chains = pytest.mark.parametrize("chain", quick_of(QUICK_CHAINS, QUICK_CHAINS[:2]))


class Truth(NamedTuple):
    """The exact answer: log p(y_1..y_s) and E[x_s], E[x_s²] at each step s."""

    log_evidence: np.ndarray
    first: np.ndarray
    second: np.ndarray


@cache
def truth():
    run = grid_filter(MODEL, OBSERVATIONS, GRID)
    first, second = run.means[:, None], (run.variances + run.means**2)[:, None]
    return Truth(*map(np.asarray, (jnp.cumsum(run.log_likelihood_increments), first, second)))


def joint_truth(chain):
    """The same for all objects of the chain, which are independent and see the same."""
    one, copies = truth(), getattr(chain_filter(chain).model, "num_objects", 1)
    first, second = (np.tile(moment, copies) for moment in (one.first, one.second))
    return Truth(copies * one.log_evidence, first, second)


def moments(mixture):
    states = mixture.particles.reshape(mixture.num_particles, -1)
    return mixture.expectation(states), mixture.expectation(states**2)


@cache
def chain_filter(chain):
    return CHAINS[chain](MODEL)


# The parts of all other chains have an exact answer in a file of their own; other models, and more
# slots than particles, are in the matrix.
COVERING = ("pf rqmc", "mpf", "dps")
APPROXIMATE = {"gaussian mixture"}
EXACT = quick_of([chain for chain in CHAINS if chain not in APPROXIMATE], COVERING, one_in=8)


@cache
def runs(chain):
    keys = jax.random.split(jax.random.key(3), NUM_RUNS)
    run = mpfjax.monte_carlo(keys, chain_filter(chain), OBSERVATIONS, moments)
    return jax.tree.map(np.asarray, run)


@pytest.mark.exactness
@pytest.mark.parametrize("chain", EXACT)
def test_evidence_and_moments_are_unbiased(chain):
    """E[Ẑ/Z] = 1, and E[Ẑ/Z φ̂] = E[φ | y], at every step, within 4 standard errors.

    A particle filter's estimate of E[φ | y] is biased, but times its evidence it is not.
    """
    run, exact = runs(chain), joint_truth(chain)
    log_evidence = np.cumsum(run.log_likelihood_increments, axis=1)
    ratios = np.exp(log_evidence - exact.log_evidence)
    first, second = run.collected
    assert_unbiased(ratios, loosest=0.045)
    assert_unbiased(ratios[..., None] * first, exact.first)
    assert_unbiased(ratios[..., None] * second, exact.second)
    np.testing.assert_allclose(run.log_marginal_likelihood, log_evidence[:, -1], rtol=1e-4)
    final, filter = run.final, chain_filter(chain)
    np.testing.assert_allclose(np.exp(final.log_weights).sum(axis=1), 1.0, rtol=1e-5)
    assert (final.component_indicators >= 0).all()
    assert (final.component_indicators < filter.num_components).all()
    filled = final.log_weights > -np.inf
    ancestors = final.ancestor_indices[filled]
    if all(move.keeps_parents for move in filter.moves):
        assert ((ancestors >= 0) & (ancestors < NUM_PARTICLES)).all()
    else:
        assert (ancestors == -1).all()


def test_what_is_approximate_is_declared():
    declared = {chain for chain in CHAINS if chain_filter(chain).approximate}
    assert declared == APPROXIMATE


@over_chains
class TestOnline:
    """The chain's single step, on the tricky quadratic model."""

    def test_a_number_that_is_not_finite_is_an_error(self, chain):
        filter = chain_filter(chain)
        density = "model: a density was NaN or infinite"
        for value, words in ((jnp.nan, "observation"), (BROKEN, density), (EXPLODING, density)):
            with pytest.raises((ValueError, RuntimeError), match=words):
                filter.step(jax.random.key(6), started(chain), observed(value))

    def test_nothing_compiles_again(self, chain):
        """Not as components come and go, nor for another filter of the same shape."""
        mixture = started(chain)
        other = CHAINS[chain](TrickyQuadraticModel(0.4, 0.2, -2.0, 2.0))
        with nothing_traced():
            for t, observation in enumerate((2.0, 1.0, 0.0, 0.0, 0.0, 3.0, BLINDED, 1.0)):
                filter = other if t % 3 == 2 else chain_filter(chain)
                mixture, _ = filter.step(jax.random.key(t), mixture, observed(observation))


def observed(value):
    """A strongly typed observation: a weakly typed one would be another program to JAX."""
    return jnp.asarray(value, jnp.float32)


@cache
def started(chain):
    """The chain's mixture after one step."""
    filter = chain_filter(chain)
    mixture = filter.init(jax.random.key(4))
    return filter.step(jax.random.key(5), mixture, OBSERVATIONS[0])[0]
