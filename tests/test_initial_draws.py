"""A filter that chooses x_0 among K N draws by the first observation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.moves.initial import START, trusted
from tests.marking import thorough

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


def make(num_draws, num_particles=100, model=None, **options):
    return mpfjax.particle_filter(
        Wide() if model is None else model, num_particles, initial_draws=num_draws, **options
    )


def nothing(mixture):
    del mixture


@pytest.fixture(scope="module")
def runs():
    """500 runs for one draw of x_0 a particle, and for eight."""
    keys = jax.random.split(KEY, 500)
    return {k: mpfjax.monte_carlo(keys, make(k), OBSERVATIONS, nothing) for k in (1, 8)}


def test_a_wide_prior_is_covered_as_by_more_particles(runs):
    exact, _ = Wide().kalman()
    errors = {k: np.sqrt(np.mean((run.log_marginal_likelihood - exact) ** 2))
              for k, run in runs.items()}  # fmt: skip
    assert errors[8] < 0.6 * errors[1], errors


def test_evidence_and_moments_stay_unbiased(runs):
    log_z, mean = Wide().kalman()
    ratios = np.exp(np.asarray(runs[8].log_marginal_likelihood, np.float64) - log_z)
    ends = ratios * np.asarray(jax.vmap(lambda mixture: mixture.mean())(runs[8].final))
    for found, exact in ((ratios, 1.0), (ends, mean)):
        assert abs(found.mean() - exact) < 4 * found.std(ddof=1) / np.sqrt(len(found))


def test_the_chosen_particles_represent_the_prior(runs):
    initial, log_mass = runs[8].initial, runs[8].initial.memory[START].log_mass
    np.testing.assert_allclose(jax.vmap(lambda m: m.weights.sum())(initial), 1.0, atol=1e-5)
    # More of them are near the observation than of plain draws, and weigh less.
    near = np.abs(initial.particles - 3.0) < 0.5
    assert near.mean() > 5 * np.mean(np.abs(runs[1].initial.particles - 3.0) < 0.5)
    weights = np.asarray(jax.vmap(lambda m: m.weights)(initial)) * np.exp(log_mass)[:, None]
    for function, exact in ((near, 0.01325), (initial.particles > 0, 0.5), (weights > 0, 1.0)):
        found = np.sum(weights * np.asarray(function), axis=1)
        assert abs(found.mean() - exact) < 4 * found.std(ddof=1) / np.sqrt(len(found)) + 1e-4


@pytest.mark.parametrize("noise", ["rqmc", *thorough(["stratified"])])
def test_particles_descend_from_those_of_the_run(noise):
    """Without noise in the dynamics x_1 is x_0 of its ancestor, where the run says it was."""
    model = mpfjax.LinearGaussianModel(
        np.eye(2), 1e-12 * np.eye(2), np.eye(2), np.eye(2), np.zeros(2), np.eye(2)
    )
    filter = mpfjax.mixture_particle_filter(model, 40, 3, noise=noise)
    run = mpfjax.run_filter(KEY, filter, np.ones((2, 2), np.float32))
    first = jax.tree.map(lambda leaf: leaf[0], run.collected)
    assert len(np.unique(first.ancestor_indices)) == 40  # no particle of x_0 is resampled
    parents = np.asarray(run.initial.particles)[first.ancestor_indices]
    np.testing.assert_allclose(first.particles, parents, atol=1e-4)
    assert not np.any(run.resampled[0])
    assert np.any(run.resampled[1])


def test_online_steps_draw_the_same():
    filter = mpfjax.mixture_particle_filter(Wide(), 50, 3)
    run = mpfjax.run_filter(KEY, filter, OBSERVATIONS, nothing)
    key_initial, key_steps = jax.random.split(KEY)
    mixture, total = filter.init(key_initial), 0.0
    for key, observation in zip(jax.random.split(key_steps, 3), OBSERVATIONS, strict=True):
        mixture, info = filter.step(key, mixture, observation)
        total += float(info.log_likelihood_increment)
    assert total == pytest.approx(float(run.log_marginal_likelihood), abs=1e-4)
    np.testing.assert_array_equal(mixture.particles, run.final.particles)


@pytest.mark.parametrize("compiled", [False, True])
def test_what_replaced_x_0_is_what_the_first_step_goes_on_from(compiled):
    """Particles near 500, which neither the prior nor the observation speaks for."""
    filter = mpfjax.mixture_particle_filter(Wide(), 50, 3)
    init = jax.jit(filter.init) if compiled else filter.init
    mixture = init(KEY)
    own = mixture.replace(particles=500 + mixture.particles / 1000)
    moved, _ = filter.step(KEY, own, OBSERVATIONS[0])
    assert np.all(np.asarray(moved.particles) > 490)
    one = mixture.replace(particles=mixture.particles.at[7].add(1e-3))
    few = mixture.replace(component_indicators=0 * mixture.component_indicators)
    for changed in (one, few):
        moved, _ = filter.step(KEY, changed, OBSERVATIONS[0])
        assert not moved.memory[START].is_prior
        away = np.abs(np.asarray(moved.particles)[:, None] - np.asarray(changed.particles)[None])
        assert np.max(np.min(away, axis=1)) < 2.0  # all descend from those that were given
    chosen, _ = filter.step(KEY, mixture, OBSERVATIONS[0])
    away = np.abs(np.asarray(chosen.particles)[:, None] - np.asarray(mixture.particles)[None])
    assert np.max(np.min(away, axis=1)) > 2.0


def test_a_first_step_without_an_observation_keeps_plain_draws():
    gap = OBSERVATIONS.copy()
    gap[0] = np.nan
    run, plain = (mpfjax.run_filter(KEY, make(k), gap, missing="skip") for k in (4, 1))
    np.testing.assert_array_equal(run.collected.particles, plain.collected.particles)
    np.testing.assert_array_equal(run.log_likelihood_increments, plain.log_likelihood_increments)
    predicted, _ = make(4).predict(KEY, make(4).init(KEY))
    same, _ = make(1).predict(KEY, make(1).init(KEY))
    moved, _ = make(4).step(KEY, predicted, OBSERVATIONS[1])
    expected, _ = make(1).step(KEY, same, OBSERVATIONS[1])
    np.testing.assert_array_equal(moved.particles, expected.particles)


def test_with_slots_the_draws_are_the_same():
    keys = jax.random.split(KEY, 2)
    filter = mpfjax.mixture_particle_filter(mpfjax.QuadraticModel(), 30, 2)
    plain = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, nothing)
    in_slots = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, nothing, slots=48)
    np.testing.assert_allclose(
        in_slots.log_marginal_likelihood, plain.log_marginal_likelihood, rtol=1e-4
    )
    np.testing.assert_allclose(
        in_slots.initial.particles[:, :30], plain.initial.particles, rtol=1e-5
    )


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


def test_what_cannot_choose_is_refused():
    joint = mpfjax.MultiObjectModel(mpfjax.QuadraticModel(), 2)
    partitioned = [mpfjax.Resample(), mpfjax.Partitioned(joint)]
    with pytest.raises(ValueError, match="initial_draws: x_0 is chosen where Propagate"):
        mpfjax.Filter(joint, partitioned, 10, initial_draws=2)
    with pytest.raises(ValueError, match="initial_draws"):
        make(0)
