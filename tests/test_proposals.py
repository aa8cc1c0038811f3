"""The Gauss-Newton proposal and its noise, and the proposal that is learned."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.stats

import mpfjax
from mpfjax import GaussNewtonProposal, NetworkProposal
from mpfjax.exact import grid_filter, kalman_filter
from mpfjax.models.noise import draw_noise, stratified_normal, stratified_uniform
from tests.precision import float64

LINEAR = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.3, 0.0], [0.0, 0.8, 0.1], [0.2, 0.0, 1.0]],
    Q=[[0.5, 0.1, 0.0], [0.1, 0.4, 0.1], [0.0, 0.1, 0.3]],
    H=[[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]],
    R=[[0.3, 0.1], [0.1, 0.2]],
    m0=[0.5, -0.5, 0.0],
    P0=np.eye(3),
)
FLOAT = np.dtype("float32")
OBSERVATION = jnp.array([1.0, -0.3])


@eqx.filter_jit
def propose(proposal, key, observation, previous):
    return proposal.propose(key, observation, previous)


def gaussian_fit(model, previous, observation):
    """Mean and covariance of p(x_t | x_{t-1}, y_t) on the linear model, by numpy."""
    A, Q, H, R = (np.asarray(part, float) for part in (model.A, model.Q, model.H, model.R))
    precision = np.linalg.inv(Q) + H.T @ np.linalg.inv(R) @ H
    covariance = np.linalg.inv(precision)
    prior = np.asarray(previous, float) @ A.T
    information = prior @ np.linalg.inv(Q) + H.T @ np.linalg.inv(R) @ np.asarray(observation)
    return information @ covariance, covariance


@pytest.mark.parametrize("inflation", [1.0, 1.3])
def test_the_log_density_is_that_of_the_gaussian_it_draws_from(inflation):
    proposal = GaussNewtonProposal(LINEAR, inflation=inflation)
    previous = LINEAR.sample_initial(jax.random.key(0), 20)
    states, log_density = propose(proposal, jax.random.key(1), OBSERVATION, previous)
    means, covariance = gaussian_fit(LINEAR, previous, OBSERVATION)
    expected = [
        scipy.stats.multivariate_normal(mean, inflation**2 * covariance).logpdf(state)
        for mean, state in zip(means, np.asarray(states), strict=True)
    ]
    np.testing.assert_allclose(log_density, expected, rtol=1e-3, atol=1e-3)


def test_draws_have_the_mean_and_covariance_of_that_gaussian():
    previous = jnp.broadcast_to(jnp.array([[0.4, 0.1, -0.2]]), (20_000, 3))
    proposal = GaussNewtonProposal(LINEAR, inflation=1.2)
    states, _ = propose(proposal, jax.random.key(2), OBSERVATION, previous)
    mean, covariance = gaussian_fit(LINEAR, previous[0], OBSERVATION)
    standard_error = np.sqrt(1.44 * np.diag(covariance) / 20_000)
    assert (np.abs(np.mean(states, axis=0) - mean) < 4 * standard_error).all()
    np.testing.assert_allclose(np.cov(np.asarray(states).T), 1.44 * covariance, atol=0.01)


def test_on_a_linear_model_without_inflation_the_weight_does_not_depend_on_the_draw():
    """The locally optimal proposal: L D / q is p(y_t | x_{t-1}), whatever was drawn."""
    proposal = GaussNewtonProposal(LINEAR, inflation=1.0, num_iterations=1)
    previous = LINEAR.sample_initial(jax.random.key(3), 30)
    factors = []
    for seed in range(3):
        states, log_density = propose(proposal, jax.random.key(seed), OBSERVATION, previous)
        factors.append(
            LINEAR.log_likelihood(OBSERVATION, states)
            + LINEAR.log_transition(states, previous)
            - log_density
        )
    np.testing.assert_allclose(factors[0], factors[1], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(factors[0], factors[2], rtol=1e-3, atol=1e-3)
    H, Q, R = (np.asarray(part, float) for part in (LINEAR.H, LINEAR.Q, LINEAR.R))
    predictive = scipy.stats.multivariate_normal(np.zeros(2), H @ Q @ H.T + R)
    predicted = np.asarray(LINEAR.observation_mean(LINEAR.transition_mean(previous)), float)
    expected = predictive.logpdf(np.asarray(OBSERVATION, float) - predicted)
    np.testing.assert_allclose(factors[0], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.thorough
def test_from_a_known_start_the_evidence_is_exact():
    """With x_0 known, one guided step has no noise left."""
    known = mpfjax.LinearGaussianModel(
        A=LINEAR.A, Q=LINEAR.Q, H=LINEAR.H, R=LINEAR.R, m0=LINEAR.m0, P0=1e-10 * jnp.eye(3)
    )
    proposal = GaussNewtonProposal(known, inflation=1.0)
    filter = mpfjax.particle_filter(known, 5, proposal=proposal)
    run = mpfjax.run_filter(jax.random.key(4), filter, OBSERVATION[None])
    exact = kalman_filter(known, OBSERVATION[None])
    np.testing.assert_allclose(
        run.log_marginal_likelihood, exact.log_marginal_likelihood, rtol=1e-3
    )


def test_on_the_quadratic_model_it_finds_the_mode_of_each_particles_own_side():
    model = mpfjax.QuadraticModel(0.5, 0.1)
    proposal = GaussNewtonProposal(model, num_iterations=8, inflation=0.01)
    previous = jnp.array([1.2, -1.2, 0.8, -0.8])
    states, _ = propose(proposal, jax.random.key(5), jnp.array(1.0), previous)
    np.testing.assert_allclose(states, [1.0, -1.0, 1.0, -1.0], atol=0.05)


def test_works_in_float64():
    with float64():
        model = mpfjax.QuadraticModel(0.5, 0.1)
        previous = jnp.array([1.2, -1.2])
        proposal = GaussNewtonProposal(model)
        states, log_density = propose(proposal, jax.random.key(6), jnp.array(1.0), previous)
        assert states.dtype == log_density.dtype == np.float64


class TestStratifiedNormal:
    KEYS = jax.random.split(jax.random.key(7), 4000)

    @pytest.mark.parametrize(("n", "d"), [(1, 1), (7, 1), (7, 3), (1000, 2)])
    def test_each_row_on_its_own_is_exactly_normal(self, n, d):
        draw = jax.jit(jax.vmap(lambda key: stratified_normal(key, (n, d), FLOAT)))
        draws = np.asarray(draw(self.KEYS))
        for row in {0, 1 % n, n // 2, n - 1}:
            for column in range(d):
                result = scipy.stats.kstest(draws[:, row, column], "norm")
                assert result.pvalue > 1e-4
        moments = draws[:, :, 0].mean(axis=0), (draws[:, :, 0] ** 2).mean(axis=0)
        assert np.abs(moments[0]).max() < 5 / np.sqrt(4000)
        assert np.abs(moments[1] - 1).max() < 5 * np.sqrt(2 / 4000)

    def test_rows_together_cover_the_normal_far_more_evenly(self):
        def error(draw):
            draws = jax.jit(jax.vmap(lambda key: draw(key, (100, 1), FLOAT)))(self.KEYS)
            return float(np.asarray(draws).mean(axis=(1, 2)).std())

        assert error(stratified_normal) < 0.35 * error(partial(draw_noise, "independent"))

    def test_columns_are_uncorrelated_over_keys(self):
        draw = jax.jit(jax.vmap(lambda key: stratified_normal(key, (5, 2), FLOAT)))
        draws = np.asarray(draw(self.KEYS))
        for row in range(5):
            correlation = np.corrcoef(draws[:, row, 0], draws[:, row, 1])[0, 1]
            assert abs(correlation) < 4 / np.sqrt(4000)

    def test_stays_finite_for_a_hundred_thousand_rows(self):
        assert np.isfinite(stratified_normal(jax.random.key(8), (100_000, 2), FLOAT)).all()


def test_stratified_uniform_puts_one_point_in_each_cell():
    points = np.asarray(stratified_uniform(jax.random.key(9), 50))
    np.testing.assert_array_equal(np.sort(np.floor(50 * points)), np.arange(50))


class Opaque(mpfjax.AbstractStateSpaceModel):
    """A model with nothing beyond the three methods."""

    def sample_initial(self, key, num_particles):
        return jnp.zeros(num_particles)

    def sample_transition(self, key, states):
        return states

    def log_likelihood(self, observation, states):
        return jnp.zeros(states.shape)


class TestBadInput:
    def test_a_model_without_what_the_fit_needs_is_named(self):
        with pytest.raises(ValueError, match="model: Opaque defines no transition_mean"):
            GaussNewtonProposal(Opaque())

    def test_a_model_without_a_transition_density_is_named(self):
        proposal = GaussNewtonProposal(LINEAR)
        with pytest.raises(ValueError, match="model: Opaque defines no log_transition"):
            mpfjax.particle_filter(Opaque(), 10, proposal=proposal)

    @pytest.mark.parametrize(
        ("name", "value"),
        [("num_iterations", 0), ("inflation", 0.0), ("inflation", float("nan"))],
    )
    def test_options_out_of_range_are_named(self, name, value):
        with pytest.raises(ValueError, match=f"{name}: "):
            GaussNewtonProposal(LINEAR, **{name: value})


class TestNetworkProposal:
    MODEL = mpfjax.QuadraticModel(0.2, 0.2, -1.5, 1.5)
    OBSERVATIONS = jnp.array([1.0, 0.8, 0.9, 1.3, 1.2, 0.7])

    def filter(self, proposal):
        return mpfjax.particle_filter(self.MODEL, 24, proposal=proposal)

    def test_the_log_density_is_that_of_the_gaussian_it_draws_from(self):
        proposal = NetworkProposal.create(jax.random.key(0), 3, 2, jnp.array([0.5, 1.0, 2.0]))
        previous = LINEAR.sample_initial(jax.random.key(1), 20)
        states, log_density = propose(proposal, jax.random.key(2), OBSERVATION, previous)
        for state, before, found in zip(states, previous, log_density, strict=True):
            outputs = np.asarray(proposal.network(jnp.concatenate([before, OBSERVATION])))
            mean = np.asarray(before) + np.asarray(proposal.scale) * outputs[:3]
            deviations = np.asarray(proposal.scale) * np.exp(outputs[3:])
            expected = scipy.stats.norm(mean, deviations).logpdf(np.asarray(state)).sum()
            assert float(found) == pytest.approx(expected, abs=1e-3)

    @pytest.mark.thorough
    def test_the_evidence_is_unbiased_before_it_has_learned_anything(self):
        filter = self.filter(NetworkProposal.create(jax.random.key(0), 1, 1, 0.4))
        keys = jax.random.split(jax.random.key(3), 2000)
        run = mpfjax.monte_carlo(keys, filter, self.OBSERVATIONS, lambda mixture: None)
        exact = grid_filter(self.MODEL, self.OBSERVATIONS, jnp.linspace(-4.0, 4.0, 801))
        ratios = np.exp(run.log_marginal_likelihood - exact.log_marginal_likelihood)
        standard_error = ratios.std() / np.sqrt(2000)
        assert standard_error < 0.03
        assert abs(ratios.mean() - 1) < 4 * standard_error

    @pytest.mark.thorough
    def test_it_learns_by_the_filters_own_bound(self):
        """It ends above where it began, and below log Z as every bound must.

        The derivative of one run has heavy tails. Over few seeds the rare large ones decide the
        optimisation, and the compiler's rounding decides them; so there are many seeds, and steps
        that end at nothing. Both bounds are of runs that the optimisation has not seen.
        """
        start = self.filter(NetworkProposal.create(jax.random.key(0), 1, 1, 0.8))
        run = mpfjax.tuning.fit(
            jax.random.key(4), start, self.OBSERVATIONS,
            optax.adam(optax.cosine_decay_schedule(0.03, 60)), 60,
            parameters={"network": lambda filter: filter.moves[1].proposal.network},
            num_seeds=64, progress=False,
        )  # fmt: skip
        exact = grid_filter(self.MODEL, self.OBSERVATIONS, jnp.linspace(-4.0, 4.0, 801))
        keys = jax.random.split(jax.random.key(5), 1000)
        gaps, errors = [], []
        for filter in (start, run.filter):
            unseen = mpfjax.monte_carlo(keys, filter, self.OBSERVATIONS, lambda mixture: None)
            gap = np.asarray(exact.log_marginal_likelihood - unseen.log_marginal_likelihood)
            gaps.append(gap.mean())
            errors.append(gap.std() / np.sqrt(1000))
        assert gaps[1] > 4 * errors[1]
        assert gaps[1] + 4 * np.hypot(*errors) < 0.8 * gaps[0]

    def test_a_scale_that_is_not_positive_is_refused(self):
        with pytest.raises(ValueError, match=r"scale: .* is not positive"):
            NetworkProposal.create(jax.random.key(0), 1, 1, 0.0)
