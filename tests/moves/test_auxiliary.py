"""Resampling by a look-ahead; that it is unbiased in every chain is in `tests/test_chains.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import mpfjax
from mpfjax import AuxiliaryResample, GaussNewtonProposal, NetworkProposal, Resample
from mpfjax.exact import kalman_filter
from tests.examples import make_mixture
from tests.marking import thorough

TWO = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.5], [0.0, 0.8]], Q=[[0.2, 0.1], [0.1, 0.3]], H=[[1.0, 0.0], [0.5, 1.0]],
    R=[[0.05, 0.02], [0.02, 0.1]], m0=[0.0, 0.3], P0=[[1.0, 0.2], [0.2, 0.5]],
)  # fmt: skip
ADAPTED = GaussNewtonProposal(TWO, 1, inflation=1.0)
SEEN = jnp.array([[0.8, 0.1], [1.5, 0.4], [0.1, -1.0]])
SQUARE = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)


def test_the_normaliser_is_the_predictive_density():
    states = np.random.default_rng(0).normal(size=(5, 2))
    found = ADAPTED.log_normaliser(SEEN[0], jnp.asarray(states, jnp.float32))
    A, Q, H, R = (np.asarray(getattr(TWO, name), float) for name in "AQHR")
    for value, state in zip(found, states, strict=True):
        exact = multivariate_normal(H @ A @ state, H @ Q @ H.T + R).logpdf(SEEN[0])
        assert float(value) == pytest.approx(exact, rel=1e-4)


def test_laplaces_approximation_is_close_where_the_state_is_well_known():
    model = mpfjax.QuadraticModel(0.1, 0.2, -2.0, 2.0)
    states = jnp.array([0.8, 1.0, 1.3, -1.1])
    found = GaussNewtonProposal(model).log_normaliser(jnp.float32(1.1), states)
    grid = np.linspace(-3, 3, 6001)
    for value, state in zip(found, np.asarray(states, float), strict=True):
        likelihood = np.exp(-0.5 * ((1.1 - grid**2) / 0.2) ** 2) / 0.2
        transition = np.exp(-0.5 * ((grid - state) / 0.1) ** 2) / 0.1
        exact = np.log(np.sum(likelihood * transition) * (grid[1] - grid[0]) / (2 * np.pi))
        assert float(value) == pytest.approx(exact, abs=0.06)


@pytest.mark.thorough
def test_fully_adapted_weights_are_equal_and_the_evidence_varies_less():
    filters = {
        "adapted": mpfjax.auxiliary_particle_filter(TWO, 100, ADAPTED),
        "bootstrap": mpfjax.particle_filter(TWO, 100),
    }
    keys = jax.random.split(jax.random.key(0), 300)

    def size(mixture):
        return mixture.effective_sample_size

    runs = {name: mpfjax.monte_carlo(keys, filter, SEEN, size) for name, filter in filters.items()}
    np.testing.assert_allclose(runs["adapted"].collected, 100.0, rtol=1e-3)
    errors = {
        name: np.asarray(run.log_marginal_likelihood)
        - float(kalman_filter(TWO, SEEN).log_marginal_likelihood)
        for name, run in runs.items()
    }
    assert errors["adapted"].std() < 0.3 * errors["bootstrap"].std()
    assert abs(errors["adapted"].mean()) < 0.05


def three_components():
    rng = np.random.default_rng(2)
    return make_mixture(rng.normal(size=30), rng.normal(size=30), np.arange(30) % 3, 3)


@pytest.mark.parametrize("ess_threshold", [1.0, *thorough([0.6])])
def test_what_is_expected_stays_the_same_in_every_component(ess_threshold):
    """E[Σ_{c_i = m} exp(ℓ_i) φ(x_i)] is what it was, whatever the look-ahead."""
    mixture = three_components()

    def look(y, states):
        return jnp.where(states > 1e3, -jnp.inf, y * states)

    move = AuxiliaryResample(Resample("multinomial", ess_threshold), look)

    def sums(mixture):
        scaled = mixture.weights * jnp.exp(mixture.log_scale)
        values = jnp.stack([jnp.ones(30), mixture.particles, mixture.particles**2], axis=1)
        return mixture.component_sums(scaled[:, None] * values)

    keys = jax.random.split(jax.random.key(0), 4000)
    moved = jax.jit(jax.vmap(lambda key: sums(move(key, mixture, jnp.float32(1.5)))))(keys)
    moved = np.asarray(moved)
    error = moved.mean(0) - np.asarray(sums(mixture))
    assert (np.abs(error) <= 4.5 * moved.std(0) / np.sqrt(4000) + 1e-5).all()
    assert (moved.std(0)[:, 0] > 1e-3).any()  # the mass does vary
    due = np.asarray(move.would_resample(mixture, jnp.float32(1.5)))
    assert due.any()
    if ess_threshold < 1:
        assert (moved.std(0)[~due] < 1e-5).all()


def test_ancestors_are_those_of_the_particles_and_the_promising_have_more():
    mixture = three_components().replace(
        ancestor_indices=jnp.asarray(np.random.default_rng(1).permutation(30), jnp.int32)
    )
    move = AuxiliaryResample(Resample(), lambda y, states: y * states)
    moved = eqx.filter_jit(move)(jax.random.key(0), mixture, jnp.float32(3.0))
    place = np.argsort(np.asarray(mixture.ancestor_indices))[np.asarray(moved.ancestor_indices)]
    np.testing.assert_array_equal(moved.particles, np.asarray(mixture.particles)[place])
    assert float(moved.particles.mean()) > float(mixture.mean()) + 0.5


class TestEdges:
    def run(self, look, observation=1.0):
        move = AuxiliaryResample(Resample(), look)
        return eqx.filter_jit(move)(jax.random.key(0), three_components(), jnp.float32(observation))

    def test_a_look_ahead_of_zero_throughout_a_component_is_left_out(self):
        nothing = self.run(lambda y, states: jnp.full(30, -jnp.inf))
        plain = eqx.filter_jit(Resample())(jax.random.key(0), three_components())
        np.testing.assert_array_equal(nothing.particles, plain.particles)
        np.testing.assert_allclose(nothing.log_weights, plain.log_weights, atol=1e-5)

    @pytest.mark.parametrize("value", [jnp.nan, jnp.inf])
    def test_a_broken_look_ahead_breaks_the_step(self, value):
        filter = mpfjax.auxiliary_particle_filter(
            SQUARE, 20, lambda y, states: jnp.where(states > 0, value, 0.0)
        )
        with pytest.raises(RuntimeError, match="NaN or infinite"):
            mpfjax.run_filter(jax.random.key(0), filter, jnp.ones(2))

    def test_a_missing_observation_and_a_step_of_zero_likelihood(self):
        filter = mpfjax.auxiliary_particle_filter(SQUARE, 20, SQUARE.log_likelihood)
        seen = jnp.array([1.0, jnp.nan, 1.2, 1e30, 1.0])
        run = mpfjax.run_filter(jax.random.key(0), filter, seen, missing="skip")
        np.testing.assert_array_equal(run.degenerate, [False, False, False, True, False])
        np.testing.assert_array_equal(run.resampled[:, 0], [True, False, True, True, True])
        assert float(run.log_likelihood_increments[1]) == 0.0
        assert np.isfinite(run.collected.particles).all()


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: AuxiliaryResample(None, ADAPTED), "resample"),
        (lambda: AuxiliaryResample(Resample(), 3), "lookahead: 3"),
        (lambda: AuxiliaryResample(Resample(), None), "lookahead: None"),
        (
            lambda: AuxiliaryResample(
                Resample(), NetworkProposal.create(jax.random.key(0), 1, 1, 0.3)
            ),
            "lookahead: NetworkProposal defines no log_normaliser",
        ),
        (lambda: mpfjax.auxiliary_particle_filter(SQUARE, 20, None), "lookahead: None"),
        (lambda: TestEdges().run(lambda y, states: 3.0), "lookahead: it returned 3.0"),
        (lambda: TestEdges().run(lambda y, states: states[:2]), r"lookahead: .* shape \(2,\)"),
    ],
)  # fmt: skip
def test_bad_input_is_named(make, named):
    with pytest.raises(ValueError, match=named):
        make()
