"""The models that ship with the library: densities, draws, and the wrapper for one particle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from tests.precision import float64
from tests.user_models import Drift, DriftOfOne

QUADRATIC = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
LINEAR = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.3], [-0.2, 0.8]],
    Q=[[0.5, 0.1], [0.1, 0.4]],
    H=[[1.0, 0.5]],
    R=[[0.3]],
    m0=[0.5, -0.5],
    P0=[[1.0, 0.4], [0.4, 0.7]],
)


class TestQuadratic:
    def test_densities(self):
        states, previous = np.array([0.1, -1.0, 2.0]), np.array([0.3, -1.0, 1.0])
        arrays = jnp.asarray(states), jnp.asarray(previous)
        norm = scipy.stats.norm
        np.testing.assert_allclose(
            QUADRATIC.log_likelihood(jnp.array(0.8), arrays[0]),
            norm(states**2, 0.5).logpdf(0.8),
            rtol=1e-5,
        )
        np.testing.assert_allclose(
            QUADRATIC.log_transition(*arrays), norm(previous, 0.3).logpdf(states), rtol=1e-5
        )
        initial = QUADRATIC.log_initial(jnp.array([-2.1, 0.0, 1.9]))
        np.testing.assert_allclose(initial, [-np.inf, -np.log(4), -np.log(4)], rtol=1e-6)

    @pytest.mark.parametrize("draw", ["stratified", "independent"])
    def test_x0_is_uniform(self, draw):
        model = mpfjax.QuadraticModel(low=-1.0, high=3.0, initial_draw=draw)
        keys = jax.random.split(jax.random.key(0), 200)
        states = np.asarray(jax.vmap(lambda key: model.sample_initial(key, 20))(keys)).ravel()
        assert states.min() >= -1
        assert states.max() <= 3
        assert scipy.stats.kstest(states, scipy.stats.uniform(-1, 4).cdf).pvalue > 1e-3

    def test_the_random_walk_has_its_deviation(self):
        states = jnp.full(20_000, 1.5)
        steps = np.asarray(QUADRATIC.sample_transition(jax.random.key(1), states)) - 1.5
        assert abs(steps.mean()) < 4 * 0.3 / np.sqrt(20_000)
        assert abs(steps.std() - 0.3) < 4 * 0.3 / np.sqrt(40_000)

    @pytest.mark.usefixtures("as_installed")
    def test_bad_input_is_named(self):
        with pytest.raises(ValueError, match=r"high: 1.0 is not above low"):
            mpfjax.QuadraticModel(low=1.0, high=1.0)
        with pytest.raises(ValueError, match="initial_draw: 'sobol'"):
            mpfjax.QuadraticModel(initial_draw="sobol")
        with pytest.raises(ValueError, match="observation: shape"):
            QUADRATIC.log_likelihood(jnp.zeros(3), jnp.zeros(3))


class TestLinearGaussian:
    def test_densities(self):
        rng = np.random.default_rng(2)
        states, previous = rng.normal(size=(2, 5, 2))
        arrays = jnp.asarray(states), jnp.asarray(previous)
        normal = scipy.stats.multivariate_normal
        expected = [normal(np.asarray(LINEAR.H) @ x, LINEAR.R).logpdf([0.7]) for x in states]
        np.testing.assert_allclose(
            LINEAR.log_likelihood(jnp.array([0.7]), arrays[0]), expected, rtol=1e-4
        )
        expected = [
            normal(np.asarray(LINEAR.A) @ p, LINEAR.Q).logpdf(x)
            for x, p in zip(states, previous, strict=True)
        ]
        np.testing.assert_allclose(LINEAR.log_transition(*arrays), expected, rtol=1e-4)

    def test_draws_have_their_mean_and_covariance(self):
        n = 40_000
        initial = np.asarray(LINEAR.sample_initial(jax.random.key(3), n))
        assert np.abs(initial.mean(axis=0) - LINEAR.m0).max() < 4 / np.sqrt(n)
        np.testing.assert_allclose(np.cov(initial.T), LINEAR.P0, atol=0.03)
        start = jnp.broadcast_to(jnp.array([[1.0, 2.0]]), (n, 2))
        moved = np.asarray(LINEAR.sample_transition(jax.random.key(4), start))
        assert np.abs(moved.mean(axis=0) - np.array([1.6, 1.4])).max() < 4 / np.sqrt(n)
        np.testing.assert_allclose(np.cov(moved.T), LINEAR.Q, atol=0.02)

    @pytest.mark.parametrize("name", ["A", "Q", "H", "R", "m0", "P0"])
    def test_a_shape_that_does_not_fit_is_named(self, name):
        parts = {part: getattr(LINEAR, part) for part in ("A", "Q", "H", "R", "m0", "P0")}
        parts[name] = jnp.zeros((3, 3)) if name != "m0" else jnp.zeros(3)
        with pytest.raises(ValueError, match=": shape"):
            mpfjax.LinearGaussianModel(**parts)

    def test_an_observation_of_the_wrong_shape_is_named(self):
        with pytest.raises(ValueError, match=r"observation: shape \(2,\) is not \(1,\)"):
            LINEAR.log_likelihood(jnp.zeros(2), jnp.zeros((5, 2)))


class TestPerParticle:
    def test_has_the_densities_and_means_of_the_batched_model(self):
        batched, wrapped = Drift(), mpfjax.per_particle(DriftOfOne())
        states, previous = jax.random.normal(jax.random.key(5), (2, 6, 2))
        y = jnp.array(0.4)
        for one, other in (
            (batched.log_likelihood(y, states), wrapped.log_likelihood(y, states)),
            (batched.log_transition(states, previous), wrapped.log_transition(states, previous)),
            (batched.transition_mean(states), wrapped.transition_mean(states)),
            (batched.observation_mean(states), wrapped.observation_mean(states)[:, 0]),
            (batched.transition_covariance, wrapped.transition_covariance),
        ):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)

    def test_draws_each_particle_from_a_key_of_its_own(self):
        wrapped = mpfjax.per_particle(DriftOfOne())
        states = wrapped.sample_initial(jax.random.key(6), 5)
        assert states.shape == (5, 2)
        assert len(np.unique(np.asarray(states))) == 10
        moved = wrapped.sample_transition(jax.random.key(7), jnp.zeros((5, 2)))
        assert len(np.unique(np.asarray(moved))) == 10

    def test_passes_on_all_that_the_library_looks_for(self):
        class Full(DriftOfOne):
            def log_initial(self, state):
                return -0.5 * (state**2).sum()

            def with_history(self, state, previous_state):
                return jnp.concatenate([state[:1], previous_state[1:]])

            def prepare_observation(self, observation):
                return 2 * observation

        wrapped = mpfjax.per_particle(Full())
        states, previous = np.asarray(jax.random.normal(jax.random.key(5), (2, 6, 2)))
        expected = -0.5 * (states**2).sum(axis=1)
        np.testing.assert_allclose(wrapped.log_initial(states), expected, rtol=1e-5)
        expected = np.column_stack([states[:, 0], previous[:, 1]])
        np.testing.assert_array_equal(wrapped.with_history(states, previous), expected)
        assert wrapped.prepare_observation(jnp.ones(())) == 2

    def test_a_density_that_the_model_lacks_stays_lacking(self):
        class Bare:
            def sample_initial(self, key):
                return jax.random.normal(key)

            def sample_transition(self, key, state):
                return state + jax.random.normal(key)

            def log_likelihood(self, observation, state):
                return -((observation - state) ** 2)

        wrapped = mpfjax.per_particle(Bare())
        assert not hasattr(wrapped, "log_transition")
        with pytest.raises(ValueError, match="defines no transition_mean"):
            mpfjax.GaussNewtonProposal(wrapped)

    def test_a_missing_method_is_named(self):
        with pytest.raises(ValueError, match="model: object defines no sample_initial"):
            mpfjax.per_particle(object())


def test_models_follow_the_precision():
    with float64():
        model = mpfjax.QuadraticModel(0.3, 0.5)
        states = model.sample_initial(jax.random.key(8), 4)
        moved = model.sample_transition(jax.random.key(9), states)
        assert moved.dtype == np.float64
        assert model.log_likelihood(jnp.array(1.0), moved).dtype == np.float64


class TestModelsThatDrawWithAllOfJaxRandom:
    """Whatever takes a key takes those that a filter hands to its model."""

    class Counting(mpfjax.AbstractStateSpaceModel):
        """Counts that come and go; also mixes its key with one of its own."""

        def sample_initial(self, key, num_particles):
            return jax.random.poisson(key, 4.0, (num_particles,)).astype(jnp.float32)

        def sample_transition(self, key, states):
            own = jax.random.key(7)
            either = jnp.where(states.sum() > 0, key, own)
            both = jnp.concatenate([key[None], own[None]])
            arrivals = jax.random.poisson(either, 1.0, states.shape).astype(states.dtype)
            stay = jax.random.binomial(both[0], states, 0.8)
            return stay.astype(states.dtype) + arrivals

        def log_likelihood(self, observation, states):
            return -0.5 * (observation - states) ** 2

    @pytest.mark.thorough
    def test_in_every_kind_of_move(self):
        model = self.Counting()
        joint = mpfjax.MultiObjectModel(model, 2, shared_observation=True)
        for filter in (
            mpfjax.particle_filter(model, 20),
            mpfjax.mixture_particle_filter(model, 20, 2),
            mpfjax.partitioned_sampling(joint, 20),
            mpfjax.independent_particle_filters(joint, 20),
        ):
            run = mpfjax.run_filter(jax.random.key(1), filter, jnp.array([3.0, 5.0]))
            assert np.isfinite(run.log_marginal_likelihood)
