"""Resampling by a look-ahead; that all chains are unbiased is in `together/test_chains.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import AuxiliaryResample, GaussNewtonProposal, Resample
from mpfjax.operations.segments import segment_sum
from tests.examples import AT_START, make_mixture
from tests.unbiased import assert_unbiased

KEY = jax.random.key(0)
SQUARE = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)


@pytest.mark.exactness
def test_laplaces_approximation_is_close_where_the_state_is_well_known():
    model = mpfjax.QuadraticModel(0.1, 0.2, -2.0, 2.0)
    states = jnp.array([0.8, 1.0, 1.3, -1.1])
    found = GaussNewtonProposal().log_normaliser(mpfjax.Step(model, jnp.float32(1.1)), states)
    grid = np.linspace(-3, 3, 6001)
    for value, state in zip(found, np.asarray(states, float), strict=True):
        likelihood = np.exp(-0.5 * ((1.1 - grid**2) / 0.2) ** 2) / 0.2
        transition = np.exp(-0.5 * ((grid - state) / 0.1) ** 2) / 0.1
        exact = np.log(np.sum(likelihood * transition) * (grid[1] - grid[0]) / (2 * np.pi))
        assert float(value) == pytest.approx(exact, abs=0.06)


RNG = np.random.default_rng(2)
# Its ancestors are in an order of their own, by which each particle is known.
MIXTURE = make_mixture(RNG.normal(size=30), RNG.normal(size=30), np.arange(30) % 3, 3).replace(
    ancestor_indices=jnp.asarray(RNG.permutation(30), jnp.int32)
)


@eqx.filter_jit
def moved_by(look, observation):
    return AuxiliaryResample(Resample(), look)(KEY, MIXTURE, mpfjax.Step(SQUARE, observation))


@pytest.mark.exactness
def test_what_is_expected_stays_the_same_in_every_component():
    """E[Σ_{c_i = m} exp(ℓ_i) φ(x_i)] is what it was, whatever the look-ahead."""
    move = AuxiliaryResample(
        Resample("multinomial", ess_threshold=0.4), lambda y, states: y * states
    )

    def sums(mixture):
        scaled = mixture.weights * jnp.exp(mixture.log_scale)
        values = jnp.stack([jnp.ones(30), mixture.particles, mixture.particles**2], axis=1)
        return segment_sum(
            scaled[:, None] * values, mixture.component_indicators, mixture.num_components
        )

    now = mpfjax.Step(SQUARE, jnp.float32(1.5))
    one = jax.jit(jax.vmap(lambda key: sums(move(key, MIXTURE, now))))
    moved = np.asarray(one(jax.random.split(KEY, 4000)))
    assert_unbiased(moved, sums(MIXTURE), errors=4.5, slack=1e-5)
    due = np.asarray(move(jax.random.key(0), MIXTURE.at_step(), now).within.resampled)
    assert due.any()
    assert not due.all()
    assert (moved.std(0)[:, 0] > 1e-3)[due].all()  # the mass does vary
    assert (moved.std(0)[~due] < 1e-5).all()


def test_ancestors_are_those_of_the_particles_and_the_promising_have_more():
    moved = moved_by(lambda y, states: y * states, jnp.float32(3.0))
    place = np.argsort(np.asarray(MIXTURE.ancestor_indices))[np.asarray(moved.ancestor_indices)]
    np.testing.assert_array_equal(moved.particles, np.asarray(MIXTURE.particles)[place])
    assert float(moved.particles.mean()) > float(MIXTURE.mean()) + 0.5


@pytest.mark.exactness
def test_a_look_ahead_of_zero_throughout_a_component_is_left_out():
    nothing = moved_by(lambda y, states: jnp.full(30, -jnp.inf), jnp.float32(1.5))
    plain = eqx.filter_jit(Resample())(KEY, MIXTURE, AT_START)
    np.testing.assert_array_equal(nothing.particles, plain.particles)
    np.testing.assert_allclose(nothing.log_weights, plain.log_weights, atol=1e-5)


@pytest.mark.exactness
def test_a_missing_a_broken_and_an_impossible_observation():
    def look(y, states):
        return jnp.where(
            y == 99, jnp.where(states > 0, jnp.nan, 0.0), SQUARE.log_likelihood(y, states)
        )

    filter = mpfjax.auxiliary_particle_filter(SQUARE, 20, look)
    seen = jnp.array([1.0, jnp.nan, 1.2, 1e30, 1.0])
    run = mpfjax.run_filter(KEY, filter, seen, missing="skip")
    np.testing.assert_array_equal(run.degenerate, [False, False, False, True, False])
    np.testing.assert_array_equal(run.resampled[:, 0], [True, False, True, True, True])
    assert float(run.log_likelihood_increments[1]) == 0.0
    assert np.isfinite(run.collected.particles).all()
    with pytest.raises(RuntimeError, match="NaN or infinite"):
        mpfjax.run_filter(KEY, filter, seen.at[2].set(99), missing="skip")
