"""Rao-Blackwellised propagation against enumeration, Kalman filters and numpy."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, GroupBy, KMeans, PropagateRegimes, RegimeProposal, Resample, Step
from mpfjax.exact import kalman_filter, switching_filter
from mpfjax.moves.propagation.marginalised import children
from mpfjax.moves.propagation.propagate import Predict, Reweight
from tests.marking import quick_of, weekly
from tests.precision import float64
from tests.switching import MODEL, NUM_REGIMES, OBSERVATIONS, TRANSITIONS, moments, regimes, truth
from tests.unbiased import assert_unbiased

NUM_RUNS, NUM_PARTICLES = 1000, 30
KEY = jax.random.key(0)


def by_regime(state):
    return state.latent


def own(moves, num_components=1, num_particles=NUM_PARTICLES, initial_moves=()):
    return Filter(MODEL, moves, num_particles, num_components, initial_moves=initial_moves)


FILTERS = {
    "a component for each regime": lambda: own(
        [Resample(), mpfjax.PropagateMarginalised(), GroupBy(by_regime)], NUM_REGIMES,
        initial_moves=[GroupBy(by_regime)],
    ),
    "all children, by regime": lambda: own(
        [PropagateRegimes(GroupBy(by_regime))], NUM_REGIMES
    ),
    "all children": lambda: own([PropagateRegimes()]),
    "all children, in components": lambda: own(
        [PropagateRegimes(), KMeans(2)], 2, initial_moves=[KMeans(2, reseed=True)]
    ),
    "guided halves": lambda: own(
        [Resample(), Predict(RegimeProposal()), Reweight()]
    ),
    "fully adapted": lambda: mpfjax.auxiliary_particle_filter(
        MODEL, NUM_PARTICLES, RegimeProposal()
    ),
}  # fmt: skip
QUICK = list(FILTERS)[:2]


@cache
def runs(name):
    keys = jax.random.split(jax.random.key(1), NUM_RUNS)
    return jax.tree.map(
        np.asarray, mpfjax.monte_carlo(keys, FILTERS[name](), OBSERVATIONS, moments)
    )


def final_of(name):
    """The last mixture of one of the runs."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), runs(name).final)


@pytest.mark.exactness
@pytest.mark.parametrize("name", quick_of(FILTERS, QUICK, one_in=2))
def test_evidence_regimes_and_moments_are_unbiased(name):
    """E[Ẑ/Z] = 1 and E[Ẑ/Z φ̂] = E[φ | y] at every step, against all sequences of regimes."""
    run, exact = runs(name), truth()
    ratios = np.exp(np.cumsum(run.log_likelihood_increments, axis=1) - exact.log_evidence)
    assert_unbiased(ratios, loosest=0.1)
    for found, expected in zip(run.collected, exact[1:], strict=True):
        own = ratios.reshape(*ratios.shape, *[1] * (found.ndim - 2))
        assert_unbiased(own * found, expected, loosest=0.1)


LINEAR = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.5], [0.0, 0.8]], Q=[[0.2, 0.1], [0.1, 0.3]], H=[[1.0, 0.2], [0.3, 1.0]],
    R=[[0.5, 0.2], [0.2, 0.4]], m0=[0.3, -0.2], P0=[[1.0, 0.1], [0.1, 0.5]],
)  # fmt: skip
SERIES = jnp.array([[0.4, 1.0], [-0.3, 0.2], [1.3, 0.9], [0.7, -0.8]])
PARTS = (LINEAR.A, LINEAR.Q, LINEAR.H, LINEAR.R, LINEAR.m0, LINEAR.P0)
ONE_REGIME = mpfjax.SwitchingLinearGaussianModel(np.ones((1, 1)), *PARTS)
ONE = mpfjax.particle_filter(ONE_REGIME, 4)


@pytest.mark.exactness
def test_each_particle_is_a_kalman_filter_which_predicts_forecasts():
    run, exact = mpfjax.run_filter(KEY, ONE, SERIES), kalman_filter(LINEAR, SERIES)
    _, means, covariances = run.collected.particles
    for i in range(4):
        np.testing.assert_allclose(means[:, i], exact.means, atol=1e-5)
        np.testing.assert_allclose(covariances[:, i], exact.covariances, atol=1e-5)
    ahead = mpfjax.forecast(jax.random.key(1), ONE, run.final, 2).mixtures.particles
    mean, covariance = np.asarray(exact.means[-1]), np.asarray(exact.covariances[-1])
    for step in range(2):
        mean, covariance = LINEAR.A @ mean, LINEAR.A @ covariance @ LINEAR.A.T + LINEAR.Q
        np.testing.assert_allclose(ahead.mean[step, 0], mean, atol=1e-5)
        np.testing.assert_allclose(ahead.covariance[step, 0], covariance, atol=1e-5)


@pytest.mark.exactness
@pytest.mark.parametrize("missing", ["error", "skip"])
def test_an_entry_that_is_missing_is_left_out_and_a_step_without_any_is_predicted(missing):
    gaps = SERIES.at[1, 0].set(jnp.nan).at[2].set(jnp.nan)
    run = mpfjax.run_filter(KEY, ONE, gaps, lambda m: m.mean(), missing=missing)
    exact = kalman_filter(LINEAR, mpfjax.Series.skipping(gaps))
    for found, expected in (
        (run.collected.mean, exact.means),
        (run.collected.covariance, exact.covariances),
        (run.log_likelihood_increments, exact.log_likelihood_increments),
    ):
        np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.exactness
def test_moments_of_a_mixture_are_those_of_its_gaussians():
    mixture = final_of("a component for each regime")
    state, weights = mixture.particles, np.asarray(mixture.weights, float)
    means, covariances = np.asarray(state.mean, float), np.asarray(state.covariance, float)

    def assert_are_of(mean, covariance, chosen):
        w = np.where(chosen, weights, 0) / weights[chosen].sum()
        gaps = means - w @ means
        spread = covariances + gaps[:, :, None] * gaps[:, None, :]
        np.testing.assert_allclose(mean, w @ means, atol=1e-5)
        np.testing.assert_allclose(covariance, np.einsum("n,nde->de", w, spread), atol=1e-5)

    whole = mixture.mean()
    assert_are_of(whole.mean, whole.covariance, np.ones(NUM_PARTICLES, bool))
    components, flattened = mixture.component_means(), mixture.component_covariances()
    for m in range(NUM_REGIMES):
        chosen = np.asarray(mixture.component_indicators) == m
        assert_are_of(components.mean[m], components.covariance[m], chosen)
        assert_are_of(components.mean[m], flattened[m][1:, 1:], chosen)
        np.testing.assert_allclose(flattened[m][0], 0, atol=1e-5)  # one regime: it has no variance


@pytest.mark.exactness
def test_thousands_of_steps_in_float32_leave_covariances_positive_and_log_z_as_in_float64():
    """Q of rank 2 in 4 dimensions, and R a millionth of the variance of what is seen."""
    matrix = 0.9 * np.eye(4) + 0.9 * np.eye(4, k=2)
    push = np.vstack([0.5 * np.eye(2), np.eye(2)])
    parts = [matrix, 1e-4 * push @ push.T, np.eye(2, 4), 1e-8 * np.eye(2), np.zeros(4), np.eye(4)]
    rng, state, series = np.random.default_rng(0), np.zeros(4), []
    for _ in range(3_000):
        state = matrix @ state + 1e-2 * push @ rng.normal(size=2)
        series.append(state[:2] + 1e-4 * rng.normal(size=2))
    series = np.array(series, np.float32)
    filter = mpfjax.particle_filter(mpfjax.SwitchingLinearGaussianModel(np.ones((1, 1)), *parts), 1)

    def collect(mixture):
        return mixture.particles.covariance[0]

    run = mpfjax.run_filter(KEY, filter, jnp.asarray(series), collect)
    assert np.linalg.eigvalsh(np.asarray(run.collected, float)).min() > 0
    with float64():
        rounded = [np.asarray(part, np.float32).astype(float) for part in parts]
        linear = mpfjax.LinearGaussianModel(*rounded)
        exact = np.asarray(kalman_filter(linear, series.astype(float)).log_likelihood_increments)
    gaps = np.asarray(run.log_likelihood_increments) - exact
    assert np.abs(gaps.reshape(30, 100).sum(axis=1)).max() < 0.01


@pytest.mark.exactness
def test_with_the_optimal_proposal_all_weights_are_equal():
    filter = FILTERS["fully adapted"]()
    run = mpfjax.run_filter(KEY, filter, OBSERVATIONS, lambda mixture: mixture.log_weights)
    np.testing.assert_allclose(run.collected, -np.log(NUM_PARTICLES), atol=1e-4)


@pytest.mark.exactness
def test_optimal_resampling_keeps_heavy_children_and_none_twice():
    filter = FILTERS["all children"]()
    start = mpfjax.run_filter(KEY, filter, OBSERVATIONS[:4], lambda mixture: None).final
    step = jax.jit(jax.vmap(lambda key: filter.step(key, start, OBSERVATIONS[4])[0]))
    after = jax.tree.map(np.asarray, step(jax.random.split(KEY, 2000)))
    child = after.ancestor_indices * NUM_REGIMES + after.particles.latent
    assert all(len(set(row)) == NUM_PARTICLES for row in child)
    # The children's own weights, and the threshold by trying all numbers of heavy ones.
    _, _, log_factors = children(Step(MODEL, OBSERVATIONS[4]), start.particles)
    weights = np.exp(np.asarray(start.log_weights[None] + log_factors, float)).T.ravel()
    weights /= weights.sum()
    falling = np.sort(weights)[::-1]
    for num_heavy in range(NUM_PARTICLES):
        threshold = falling[num_heavy:].sum() / (NUM_PARTICLES - num_heavy)
        if falling[num_heavy] < threshold:
            break
    kept = np.zeros((2000, len(weights)))
    np.put_along_axis(kept, child, np.exp(after.log_weights), axis=1)
    heavy = weights >= threshold
    assert 0 < heavy.sum() < NUM_PARTICLES
    np.testing.assert_allclose(kept[:, heavy], np.tile(weights[heavy], (2000, 1)), rtol=1e-3)
    light = kept[:, ~heavy]
    np.testing.assert_allclose(light[light > 0], threshold, rtol=1e-3)
    error = 4.5 * light.std(axis=0) / np.sqrt(2000) + 4 * threshold / 2000
    assert (np.abs(light.mean(axis=0) - weights[~heavy]) <= error).all()


@pytest.mark.exactness
@pytest.mark.parametrize(
    "name", ["all children, by regime", *weekly(["all children, in components"])]
)
def test_no_child_is_kept_twice_and_every_component_keeps_its_mass(name):
    """Wherever the children stand, and whether y is there or not; unseen regimes move by T."""
    start, move = final_of(name), FILTERS[name]().moves[0]
    keys = jax.random.split(KEY, 400)
    start = start.replace(ancestor_indices=jnp.arange(NUM_PARTICLES, dtype=jnp.int32))
    seen = jax.jit(jax.vmap(lambda key: move(key, start, Step(MODEL, OBSERVATIONS[3]))))(keys)
    unseen = jax.jit(jax.vmap(lambda key: move(key, start, Step(MODEL, None))))(keys)
    for after in jax.tree.map(np.asarray, (seen, unseen)):
        child = after.ancestor_indices * NUM_REGIMES + after.particles.latent
        filled = after.log_weights > -np.inf
        assert all(len(set(c[f])) == f.sum() for c, f in zip(child, filled, strict=True))
        labels = after.component_indicators[:, :, None] == np.arange(start.num_components)
        masses = (np.exp(after.log_weights)[:, :, None] * labels).sum(axis=1)
        np.testing.assert_allclose(masses, np.tile(masses[:1], (len(keys), 1)), rtol=1e-4)
    np.testing.assert_allclose(masses.sum(axis=1), 1, rtol=1e-4)
    after = np.asarray(jax.vmap(regimes)(unseen))
    error = after.std(axis=0) / np.sqrt(len(keys))
    assert (np.abs(after.mean(axis=0) - regimes(start) @ TRANSITIONS) <= 4 * error + 1e-4).all()


@pytest.mark.exactness
def test_more_slots_than_children_stay_empty():
    """Copies would have the moments that they copy: with every child, the filter is exact."""
    filter = own([PropagateRegimes()], num_particles=NUM_REGIMES**4)
    every = filter.init(KEY)
    one = every.particles._replace(latent=jnp.zeros_like(every.particles.latent))
    first = jnp.arange(filter.num_particles) == 0
    start = every.replace(particles=one, log_weights=jnp.where(first, 0.0, -jnp.inf))
    probabilities = jnp.asarray([1.0, 0, 0])
    known = eqx.tree_at(lambda model: model.initial_probabilities, MODEL, probabilities)
    exact = switching_filter(known, OBSERVATIONS[:4])
    for step, key in enumerate(jax.random.split(KEY, 4)):
        start, info = filter.step(key, start, OBSERVATIONS[step])
        assert int(start.occupied.sum()) == NUM_REGIMES ** (step + 1)
        np.testing.assert_allclose(
            info.log_likelihood_increment, exact.log_likelihood_increments[step], rtol=1e-4
        )
