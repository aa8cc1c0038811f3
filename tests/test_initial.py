"""x_0 chosen among K N draws by the first observation: an ordinary initial move."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.moves.initial import SelectInitial, trusted
from mpfjax.smoothing import conditional_filter, with_first_ancestors

KEY = jax.random.key(0)
OBSERVATIONS = np.array([3.0, 3.3, 3.1], np.float32)


class Wide(mpfjax.AbstractStateSpaceModel):
    """x_0 from N(0, wide²), then a random walk, seen with a small error; states are numbers."""

    wide: float = eqx.field(static=True, default=30.0)
    step: float = eqx.field(static=True, default=0.3)

    def sample_initial(self, key, num_particles):
        return self.wide * jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        return states + self.step * jax.random.normal(key, states.shape)

    def log_transition(self, states, previous_states):
        return jax.scipy.stats.norm.logpdf(states, previous_states, self.step)

    def log_likelihood(self, observation, states):
        return jax.scipy.stats.norm.logpdf(observation, states, 0.3)

    def kalman(self):
        """log Z and the mean of x_t at the end."""
        mean, variance, log_z = 0.0, self.wide**2, 0.0
        for observation in OBSERVATIONS:
            variance += self.step**2
            total = variance + 0.3**2
            gap = observation - mean
            log_z -= 0.5 * (gap**2 / total + np.log(2 * np.pi * total))
            mean, variance = mean + variance / total * gap, variance * 0.3**2 / total
        return log_z, mean


def make(num_draws, num_particles=100, **options):
    plain = mpfjax.particle_filter(Wide(), num_particles, **options)
    return mpfjax.with_selected_start(plain, num_draws)


def is_near(ratios, exact=1.0):
    """Whether the mean of independent estimates is within four standard errors of what it is of."""
    ratios = np.asarray(ratios, np.float64)
    return abs(ratios.mean() - exact) < 4 * ratios.std(ddof=1) / np.sqrt(len(ratios))


def nothing(mixture):
    del mixture


@pytest.fixture(scope="module")
def runs():
    """500 runs for one draw of x_0 a particle, and for eight."""
    keys = jax.random.split(KEY, 500)
    return {k: mpfjax.monte_carlo(keys, make(k), OBSERVATIONS, nothing) for k in (1, 8)}


def test_evidence_and_moments_stay_unbiased_and_vary_less(runs):
    log_z, mean = Wide().kalman()
    errors = {k: np.mean((run.log_marginal_likelihood - log_z) ** 2) for k, run in runs.items()}
    assert errors[8] < 0.36 * errors[1], errors
    ratios = np.exp(np.asarray(runs[8].log_marginal_likelihood, np.float64) - log_z)
    assert is_near(ratios)
    assert is_near(
        ratios * np.asarray(jax.vmap(lambda mixture: mixture.mean())(runs[8].final)), mean
    )


def test_the_chosen_particles_represent_the_prior(runs):
    initial = runs[8].initial
    np.testing.assert_allclose(jax.vmap(lambda m: m.weights.sum())(initial), 1.0, atol=1e-5)
    # More of them are near the observation than of plain draws, and weigh less.
    near = np.abs(initial.particles - 3.0) < 0.5
    assert near.mean() > 5 * np.mean(np.abs(runs[1].initial.particles - 3.0) < 0.5)
    weights = np.asarray(jax.vmap(lambda m: m.weights)(initial))
    weights = weights * np.exp(initial.log_scale)[:, None]
    for function, exact in ((near, 0.01325), (initial.particles > 0, 0.5), (weights > 0, 1.0)):
        assert is_near(np.sum(weights * np.asarray(function), axis=1), exact)


def test_particles_descend_from_those_of_the_run():
    """Without noise in the dynamics x_1 is x_0 of its ancestor, where the run says it was."""
    model = mpfjax.LinearGaussianModel(
        np.eye(2), 1e-12 * np.eye(2), np.eye(2), np.eye(2), np.zeros(2), np.eye(2)
    )
    filter = mpfjax.with_point_sets(mpfjax.mixture_particle_filter(model, 40, 3))
    run = mpfjax.run_filter(KEY, filter, np.ones((2, 2), np.float32))
    first = jax.tree.map(lambda leaf: leaf[0], run.collected)
    assert len(np.unique(first.ancestor_indices)) == 40  # no particle of x_0 is resampled
    parents = np.asarray(run.initial.particles)[first.ancestor_indices]
    np.testing.assert_allclose(first.particles, parents, atol=1e-4)
    assert not np.any(run.resampled[0])
    assert np.any(run.resampled[1])


def test_without_an_observation_it_does_nothing():
    gap = OBSERVATIONS.copy()
    gap[0] = np.nan
    run, plain = (mpfjax.run_filter(KEY, make(k), gap, missing="skip") for k in (4, 1))
    np.testing.assert_array_equal(run.initial.log_weights, plain.initial.log_weights)
    assert run.initial.log_scale == 0


def test_what_a_chain_weighs_before_it_propagates_counts():
    """x_0 is seen once more, with an error of 2, by a move at the head of the chain."""

    def tilt(key, mixture, observation):
        log_factors = jax.scipy.stats.norm.logpdf(observation, mixture.particles, 2.0)
        return mixture.weighed(log_factors)

    model, observation = Wide(wide=3.0), 1.5
    propagate = mpfjax.Propagate(model)
    filter = mpfjax.Filter(
        model, [tilt, mpfjax.Resample(), propagate], 200,
        initial_moves=[SelectInitial(propagate, 8)],
    )  # fmt: skip
    keys = jax.random.split(KEY, 400)
    found = mpfjax.monte_carlo(keys, filter, np.array([observation], np.float32), nothing)
    # Both observations are normal given x_0 of variance 9.
    covariance = np.array([[9 + 4, 9], [9, 9 + 0.09 + 0.09]])
    seen = np.full(2, observation)
    log_z = -0.5 * (seen @ np.linalg.solve(covariance, seen) + np.linalg.slogdet(covariance)[1])
    log_z -= np.log(2 * np.pi)
    assert is_near(np.exp(np.asarray(found.log_marginal_likelihood, np.float64) - log_z))


def test_on_islands_the_masses_of_their_choices_count():
    def run(key):
        return mpfjax.run_islands(key, make(8, 50), OBSERVATIONS, nothing, num_islands=2)

    found = jax.jit(jax.vmap(run))(jax.random.split(KEY, 300)).log_marginal_likelihood
    assert is_near(np.exp(np.asarray(found, np.float64) - Wide().kalman()[0]))


def test_where_x_0_must_be_a_plain_draw_it_is_one():
    trajectory = np.full(4, 3.0, np.float32)
    found = conditional_filter(KEY, make(8), OBSERVATIONS, trajectory)
    same = conditional_filter(KEY, make(1), OBSERVATIONS, trajectory)
    np.testing.assert_array_equal(found.trajectory, same.trajectory)
    chosen = make(8, scheme="multinomial")
    assert not with_first_ancestors(chosen).looks_at_first


def expected_trust(values):
    """By numpy: the linear predictor of E[L | x_0] from the mean of two draws."""
    ratios = values / values.mean()
    gaps = ratios - 1
    r = max(np.mean(gaps[:, 0] * gaps[:, 1]) / np.mean(gaps**2), 0.0)
    return 1 + min(2 * r / (1 + r), 0.75) * gaps.mean(axis=1)


def test_likelihoods_are_trusted_by_what_two_draws_have_in_common():
    rng = np.random.default_rng(1)
    own = rng.gamma(2.0, size=(4000, 1))
    noisy = own * rng.gamma(0.5, 2.0, size=(4000, 2))
    everywhere = jnp.ones(4000)
    found = np.asarray(trusted(jnp.log(noisy.T), everywhere))
    np.testing.assert_allclose(found, expected_trust(noisy), rtol=1e-3)
    # Where x_0 says nothing the chances are nearly equal; where it says all they have their bound.
    nothing_said = trusted(jnp.log(rng.gamma(2.0, size=(2, 4000))), everywhere)
    assert np.std(nothing_said) < 0.05
    all_said = trusted(jnp.log(np.repeat(own, 2, axis=1).T), everywhere)
    np.testing.assert_allclose(all_said, 0.25 + 0.75 * own[:, 0] / own.mean(), rtol=1e-4)


def test_impossible_and_empty_particles():
    log_factors = jnp.array([[0.0, -jnp.inf, jnp.nan, 5.0], [0.0, -jnp.inf, 0.0, 5.0]])
    found = np.asarray(trusted(log_factors, jnp.array([1.0, 1.0, 1.0, 0.0])))
    assert np.all(np.isfinite(found))
    assert found[0] > 1 > found[1] >= 0.25
    np.testing.assert_array_equal(trusted(jnp.full((2, 3), -jnp.inf), jnp.ones(3)), 1.0)
