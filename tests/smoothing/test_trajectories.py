"""Trajectories, of a component and of mixtures alone, genealogies, few paths, and sums online."""

import warnings
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax import forecast
from mpfjax.exact import kalman_filter
from mpfjax.smoothing import (
    FixedLagSmoother,
    backward,
    sample_trajectories,
    smoothed_sums,
    trace_ancestors,
)
from tests.marking import weekly
from tests.user_models import Batched, DriftOfOne, ScalarLinear

QUADRATIC = mpfjax.QuadraticModel(0.3, 0.4, -2.0, 2.0)
SQUARES = np.array([1.2, 0.8, 1.5, 1.0], np.float32)


@pytest.mark.exactness
def test_trajectories_of_one_component_stay_with_its_mode():
    """With little noise the modes are apart from the second step on, and nobody changes sides."""
    sharp = mpfjax.QuadraticModel(0.1, 0.1, -2.0, 2.0)
    filter = mpfjax.mixture_particle_filter(sharp, 100, 2)
    run = mpfjax.run_filter(jax.random.key(1), filter, jnp.full(6, 1.5))
    means = np.asarray(run.final.component_means())
    assert np.sign(means).sum() == 0
    for m in range(2):
        drawn = sample_trajectories(jax.random.key(m), filter, run, 50, component=m)
        assert (np.sign(drawn[:, -1]) == np.sign(means[m])).mean() > 0.9
    with pytest.raises(ValueError, match=r"component: 2 is empty at the last step"):
        sample_trajectories(jax.random.key(0), filter, run, 50, component=2)


@pytest.mark.exactness
def test_the_mixtures_alone_give_trajectories_without_x_0():
    filter = mpfjax.particle_filter(QUADRATIC, 50)
    found = mpfjax.run_filter(jax.random.key(1), filter, jnp.asarray(SQUARES))
    drawn = sample_trajectories(jax.random.key(2), filter, found.collected, 7)
    assert drawn.shape == (7, len(SQUARES))
    states = np.asarray(found.collected.particles)
    for t in range(len(SQUARES)):
        assert np.isin(np.asarray(drawn)[:, t], states[t]).all()


def test_rows_that_do_not_fit_together_are_drawn_in_turn(monkeypatch):
    """The same indices whether all densities are held at once or a few."""
    mixture = mpfjax.particle_filter(QUADRATIC, 50).init(jax.random.key(1))
    futures = jnp.linspace(-2.0, 2.0, 9)

    def drawn():
        log_kernel = backward.log_kernel_from(QUADRATIC, mixture)

        def draw(key):
            return backward.draw_exactly(key, log_kernel, futures, mixture)

        return jax.jit(draw)(jax.random.key(2))

    together = drawn()
    monkeypatch.setattr(backward, "MOST_DENSITIES", 100)
    np.testing.assert_array_equal(together, drawn())


@pytest.mark.exactness
def test_a_genealogy_is_that_of_a_loop():
    filter = mpfjax.mixture_particle_filter(QUADRATIC, 40, 3)
    found = mpfjax.run_filter(jax.random.key(4), filter, jnp.asarray(SQUARES))
    genealogy = jax.tree.map(np.asarray, trace_ancestors(found))
    ancestors = np.asarray(found.collected.ancestor_indices)
    states = np.concatenate([found.initial.particles[None], found.collected.particles])
    labels = np.asarray(found.final.component_indicators)
    occupied = np.asarray(found.final.occupied)
    indices = np.arange(40)
    for t in range(len(SQUARES), -1, -1):
        np.testing.assert_array_equal(genealogy.indices[t], indices)
        np.testing.assert_array_equal(genealogy.trajectories[:, t], states[t, indices])
        for m in range(3):
            own = occupied & (labels == m)
            share = len(set(indices[own])) / max(own.sum(), 1)
            assert genealogy.share_apart[m, t] == pytest.approx(share)
        if t:
            indices = ancestors[t - 1][indices]


@pytest.mark.parametrize("observations", [[np.nan] * 3, [1.0]], ids=["nothing seen", "one step"])
def test_smoothers_of_no_observation_and_of_one_step(observations):
    filter, key = mpfjax.particle_filter(QUADRATIC, 20), jax.random.key(1)
    series = mpfjax.Series.skipping(np.float32(observations))
    run = mpfjax.run_filter(key, filter, series)
    for found in (
        trace_ancestors(run).trajectories,
        *(sample_trajectories(key, filter, run, 4, method=name) for name in ("exact", "mcmc")),
        smoothed_sums(key, filter, series, lambda before, now: before * now).sums,
    ):
        assert np.isfinite(found).all()


class Bounded(Batched):
    """Steps of more than a thousand are impossible."""

    def log_transition(self, states, previous_states):
        return jnp.where(jnp.abs(states - previous_states) > 1e3, -jnp.inf, 0.0)


@pytest.mark.exactness
@pytest.mark.parametrize("method", ["exact", "mcmc"])
def test_a_step_that_no_particle_can_have_taken_is_an_error(method):
    """The mixtures of one run before those of another, far away."""
    run = mpfjax.run_filter(jax.random.key(1), mpfjax.particle_filter(QUADRATIC, 30), SQUARES)
    far = run.collected.particles + 1e4
    apart = [run.collected, eqx.tree_at(lambda found: found.particles, run.collected, far)]
    mixtures = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *apart)
    filter = mpfjax.particle_filter(Bounded(), 30)
    with pytest.raises(RuntimeError, match="log_transition is -inf"):
        sample_trajectories(jax.random.key(0), filter, mixtures, 3, method=method)


class Odometer(mpfjax.AbstractStateSpaceModel):
    """The state of two times; x_t - x_{t-1} is seen."""

    def sample_initial(self, key, num_particles):
        now = jax.random.normal(key, (num_particles,))
        return {"now": now, "before": now}

    def sample_transition(self, key, states):
        noise = 0.5 * jax.random.normal(key, states["now"].shape)
        return {"now": 0.9 * states["now"] + noise, "before": states["now"]}

    def log_transition(self, states, previous_states):
        density = norm.logpdf(states["now"], 0.9 * previous_states["now"], 0.5)
        return jnp.where(states["before"] == previous_states["now"], density, -jnp.inf)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, states["now"] - states["before"], 0.3)


def test_a_delta_is_warned_of_with_the_share_of_distinct_trajectories():
    steps = np.random.default_rng(0).normal(0, 0.5, 30).astype(np.float32)
    filter = mpfjax.particle_filter(Odometer(), 200)
    run = mpfjax.run_filter(jax.random.key(0), filter, steps)
    with pytest.warns(RuntimeWarning, match="backward weights degenerate") as caught:
        paths = sample_trajectories(jax.random.key(1), filter, run, 200)
    num_distinct = len(np.unique(paths["now"][:, 0]))
    assert caught[0].filename == __file__
    assert num_distinct < 20
    share = f"a share of {num_distinct / 200:.2g}"
    assert f"{num_distinct} of the 200 trajectories are distinct, {share}" in str(caught[0].message)


@pytest.mark.exactness
def test_few_states_that_have_many_pasts_are_no_reason():
    """Every particle starts at 0, and few fit what is seen at first."""
    model = ScalarLinear(a=1.0, q=1.0, r=0.02, m=0.0, p=0.0)
    observations = np.cumsum(np.random.default_rng(1).normal(size=20)).astype(np.float32)
    filter = mpfjax.particle_filter(model, 300)
    run = mpfjax.run_filter(jax.random.key(0), filter, observations)
    with warnings.catch_warnings(action="error", category=RuntimeWarning):
        paths = sample_trajectories(jax.random.key(1), filter, run, 1000)
    assert min(len(np.unique(column)) for column in np.asarray(paths).T[1:]) < 20


def test_no_lag_is_filtering_and_counts_are_averaged():
    """An event has the variance p (1 - p)."""
    filter = mpfjax.particle_filter(QUADRATIC, 50, ess_threshold=0.5)
    smoother = FixedLagSmoother(filter, lambda before, after: after > 1, 0)
    window = smoother.init(filter.init(jax.random.key(4)))
    for key, seen in zip(jax.random.split(jax.random.key(5), 4), SQUARES, strict=True):
        window, (found,), _ = smoother.step(key, window, seen)
        moved = window.mixture
        np.testing.assert_allclose(found, moved.expectation(moved.particles > 1), rtol=1e-5)
        np.testing.assert_allclose(smoother.variances(window), [found * (1 - found)], atol=1e-5)


@pytest.mark.exactness
@pytest.mark.parametrize("method", ["exact", *weekly(["mcmc"])])
def test_variances_are_about_the_mean_however_far_from_zero(method):
    """As those of a Kalman smoother, where E[x²] - E[x]² is rounding alone."""
    noise = np.random.default_rng(0).normal(size=(2, 12))
    walk = np.cumsum(0.02 * noise[0])[:, None]
    near, far = (
        mpfjax.LinearGaussianModel([[1.0]], [[4e-4]], [[1.0]], [[9e-4]], [place], [[9e-4]])
        for place in (0.0, 20.0)
    )
    seen = (walk + 0.03 * noise[1][:, None]).astype(np.float32)

    def moments(model, place):
        """The terms at the end, and their variances."""
        filter = mpfjax.particle_filter(model, 300)
        smoother = FixedLagSmoother(filter, lambda x, y: {"x": y, "xx": y**2}, 11, method)
        window = smoother.init(filter.init(jax.random.key(0)))
        for key, y in zip(jax.random.split(jax.random.key(1), 12), seen + place, strict=True):
            window, terms, _ = smoother.step(key, window, y)
        return terms, smoother.variances(window)["x"]

    (terms, at_zero), (_, away) = moments(near, 0.0), moments(far, 20.0)
    np.testing.assert_allclose(at_zero, terms["xx"] - terms["x"] ** 2, rtol=1e-3)
    exact = mpfjax.exact.kalman_smoother(near, seen).covariances[-12:, 0]
    np.testing.assert_allclose(away, exact, rtol=0.35)
    np.testing.assert_allclose(np.mean(away / exact), 1, atol=0.1)


LINEAR = mpfjax.LinearGaussianModel(
    A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]]
)
SEEN = jnp.array([[0.8], [0.1], [1.5]])


class ObservedDrift(DriftOfOne):
    """With draws of its observations."""

    def sample_observation(self, key, state):
        return state[0] + jax.random.normal(key)


def test_a_wrapped_models_observations_are_drawn_one_by_one():
    """Of one particle, as all methods of such a model are, each with noise of its own."""
    filter = mpfjax.particle_filter(mpfjax.per_particle(ObservedDrift()), 400)
    mixture = filter.init(jax.random.key(0))
    ahead = forecast(jax.random.key(1), filter, mixture, 2)
    noise = ahead.observations - ahead.mixtures.particles[..., 0]
    assert noise.shape == (2, 400)
    np.testing.assert_allclose(noise.std(axis=1), 1.0, atol=4 / np.sqrt(2 * 400))


@pytest.mark.exactness
def test_predicted_observations_are_the_kalman_filters():
    """Before each is seen, of particles of unequal weights; states are asked in the matrix."""
    filter = mpfjax.particle_filter(LINEAR, 20_000)
    run = mpfjax.run_filter(jax.random.key(1), filter, SEEN)
    ahead = mpfjax.one_step_predictions(jax.random.key(2), filter, run)
    exact = kalman_filter(LINEAR, SEEN)
    before = jnp.concatenate([jnp.array([0.5]), exact.means[:-1, 0]])
    spread = 0.81 * jnp.concatenate([jnp.ones(1), exact.covariances[:-1, 0, 0]]) + 0.3 + 0.4
    moments = jax.vmap(lambda mixture, y: (mixture.expectation(y)[0], mixture.variance(y)[0]))
    mean, variance = moments(ahead.mixtures, ahead.observations)
    size = run.effective_sample_size.min()
    assert np.all(np.abs(mean - 0.9 * before) < 4 * np.sqrt(spread / size))
    np.testing.assert_allclose(variance, spread, rtol=4 * np.sqrt(2 / size))
    with pytest.raises(ValueError, match="run: it has not the mixtures of one run"):
        mpfjax.one_step_predictions(jax.random.key(2), filter, replace(run, collected=None))
