"""Trajectories against the exact smoothing distributions: Gaussian, and on a grid."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.smoothing import sample_trajectories, trace_ancestors
from tests.marking import quick_of
from tests.smoothing.exact_smoothers import gaussian_smoother, grid_smoother

NUM_PARTICLES, NUM_RUNS, NUM_TRAJECTORIES = 60, 1500, 4
ONE = mpfjax.LinearGaussianModel(A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]])
TWO = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.5], [0.0, 0.8]], Q=[[0.2, 0.0], [0.0, 0.3]], H=[[1.0, 0.0]], R=[[0.5]],
    m0=[0.0, 0.3], P0=[[1.0, 0.2], [0.2, 0.5]],
)  # fmt: skip
SEEN = np.array([[0.8], [np.nan], [0.1], [-0.4], [0.9]], np.float32)
OBJECTS = mpfjax.MultiObjectModel(ONE, 2)
OF_OBJECTS = np.stack([SEEN, -SEEN], axis=1)
FILTERS = {
    "pf": (mpfjax.particle_filter(ONE, NUM_PARTICLES), SEEN),
    "two dimensions": (mpfjax.particle_filter(TWO, NUM_PARTICLES, ess_threshold=0.5), SEEN),
    "mpf": (mpfjax.mixture_particle_filter(ONE, NUM_PARTICLES, 3), SEEN),
    "ps": (mpfjax.partitioned_sampling(OBJECTS, NUM_PARTICLES), OF_OBJECTS),
    "dps": (
        mpfjax.distributed_partitioned_sampling(OBJECTS, NUM_PARTICLES, reassembly="evidence"),
        OF_OBJECTS,
    ),
}
METHODS = {"exact": {}, "mcmc": {"method": "mcmc", "num_steps": 8}}


def run(key, filter, observations):
    return mpfjax.run_filter(key, filter, observations, missing="skip")


@cache
def sampled(name):
    """The evidence of each of many runs, and the trajectories that each method draws from it."""
    filter, observations = FILTERS[name]

    def one(key):
        key_run, *keys = jax.random.split(key, 1 + len(METHODS))
        found = run(key_run, filter, jnp.asarray(observations))
        drawn = {
            method: sample_trajectories(key, filter.model, found, NUM_TRAJECTORIES, **options)
            for key, (method, options) in zip(keys, METHODS.items(), strict=True)
        }
        genealogy = trace_ancestors(found)
        weights = found.final.weights
        return found.log_marginal_likelihood, drawn, (genealogy.trajectories, weights)

    keys = jax.random.split(jax.random.key(0), NUM_RUNS)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(keys))


def exact_moments(name):
    """E[x_s], E[x_s²], and E[x_{s-1} x_s] of the first coordinate, for s = 0, ..., t."""
    filter, observations = FILTERS[name]
    if isinstance(filter.model, mpfjax.MultiObjectModel):
        model, observations = ONE, observations[:, 0]
    else:
        model = filter.model
    means, covariance = gaussian_smoother(model, observations)
    d = means.shape[1]
    first, covariance = means[:, 0], covariance[::d, ::d]
    pairs = np.diagonal(covariance, 1) + first[:-1] * first[1:]
    return first, np.diagonal(covariance) + first**2, pairs


def moments(trajectories):
    """Those of the drawn trajectories (runs, k, t + 1), means over k."""
    x = trajectories.reshape(*trajectories.shape[:3], -1)[..., 0]
    return x.mean(1), (x**2).mean(1), (x[..., :-1] * x[..., 1:]).mean(1)


def assert_near(ratios, estimates, expected):
    """Times Ẑ/Z the estimates are unbiased: within four standard errors."""
    weighed = ratios[:, None] * (estimates - expected)
    z = weighed.mean(0) / (weighed.std(0) / np.sqrt(len(weighed)))
    assert np.abs(z).max() < 4, z


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", quick_of(FILTERS, ("two dimensions", "mpf", "dps")))
def test_moments_and_pairs_are_the_exact_ones(name, method):
    log_evidence, drawn, _ = sampled(name)
    ratios = np.exp(log_evidence - log_evidence.max())
    ratios /= ratios.mean()
    assert ratios.std() < 1.5  # or they would prove nothing
    for estimates, expected in zip(moments(drawn[method]), exact_moments(name), strict=True):
        assert_near(ratios, estimates, expected)


@pytest.mark.parametrize("name", ["pf", "mpf"])
def test_the_genealogy_has_the_exact_moments_too(name):
    log_evidence, _, (trajectories, weights) = sampled(name)
    ratios = np.exp(log_evidence - log_evidence.max())
    ratios /= ratios.mean()
    x = trajectories[..., 0]
    estimates = np.einsum("rn,rnt->rt", weights, x)
    assert_near(ratios, estimates, exact_moments(name)[0])


QUADRATIC = mpfjax.QuadraticModel(0.3, 0.4, -2.0, 2.0)
SQUARES = np.array([1.2, 0.8, 1.5, 1.0], np.float32)
GRID = np.linspace(-4.0, 4.0, 401)


@cache
def grid_truth():
    points = jnp.asarray(GRID, jnp.float32)
    log_initial = np.where(np.abs(GRID) <= 2, 0.0, -np.inf)
    log_transition = -0.5 * ((GRID[None] - GRID[:, None]) / 0.3) ** 2
    log_likelihoods = np.array(
        [np.asarray(QUADRATIC.log_likelihood(jnp.asarray(y), points), float) for y in SQUARES]
    )
    return grid_smoother(log_initial, log_transition, log_likelihoods)


def test_two_modes_are_smoothed_as_on_the_grid():
    """Moments of x_s, and E[x_{s-1} x_s], which tells trajectories that change sides."""
    filter = mpfjax.mixture_particle_filter(QUADRATIC, 80, 2)

    @jax.jit
    @jax.vmap
    def one(key):
        key_run, key_back = jax.random.split(key)
        found = mpfjax.run_filter(key_run, filter, jnp.asarray(SQUARES))
        drawn = sample_trajectories(key_back, QUADRATIC, found, 4)
        return found.log_marginal_likelihood, drawn

    log_evidence, drawn = map(np.asarray, one(jax.random.split(jax.random.key(3), 1000)))
    ratios = np.exp(log_evidence - log_evidence.max())
    ratios /= ratios.mean()
    smoothed, pairs = grid_truth()
    first, second, products = moments(drawn)
    assert_near(ratios, first, smoothed @ GRID)
    assert_near(ratios, second, smoothed @ GRID**2)
    assert_near(ratios, products, np.einsum("sij,i,j->s", pairs, GRID, GRID))


def test_trajectories_of_one_component_stay_with_its_mode():
    """With little noise the modes are apart from the second step on, and nobody changes sides."""
    sharp = mpfjax.QuadraticModel(0.1, 0.1, -2.0, 2.0)
    filter = mpfjax.mixture_particle_filter(sharp, 100, 2)
    found = mpfjax.run_filter(jax.random.key(1), filter, jnp.full(6, 1.5))
    means = np.asarray(found.final.component_means())
    assert np.sign(means).sum() == 0
    for m in np.flatnonzero(found.final.active).tolist():
        drawn = np.asarray(
            sample_trajectories(jax.random.key(m), QUADRATIC, found, 50, component=m)
        )
        assert drawn.shape == (50, 7)
        assert (np.sign(drawn[:, -1]) == np.sign(means[m])).mean() > 0.9


def test_the_mixtures_alone_give_trajectories_without_x_0():
    filter = mpfjax.particle_filter(QUADRATIC, 50)
    found = mpfjax.run_filter(jax.random.key(1), filter, jnp.asarray(SQUARES))
    drawn = sample_trajectories(jax.random.key(2), QUADRATIC, found.collected, 7)
    assert drawn.shape == (7, len(SQUARES))
    states = np.asarray(found.collected.particles)
    for t in range(len(SQUARES)):
        assert np.isin(np.asarray(drawn)[:, t], states[t]).all()


def test_rows_that_do_not_fit_together_are_drawn_in_turn(monkeypatch):
    """The same indices whether all densities are held at once or a few."""
    filter = mpfjax.particle_filter(QUADRATIC, 50)
    found = mpfjax.run_filter(jax.random.key(1), filter, jnp.asarray(SQUARES))
    together = sample_trajectories(jax.random.key(2), QUADRATIC, found, 9)
    monkeypatch.setattr(mpfjax.smoothing.backward, "MOST_DENSITIES", 100)
    in_turn = sample_trajectories(jax.random.key(2), QUADRATIC, found, 9 + 0 * len(SQUARES))
    np.testing.assert_array_equal(together, in_turn)


class TestGenealogy:
    def test_indices_and_states_are_those_of_a_loop(self):
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


class NoTransition(mpfjax.AbstractStateSpaceModel):
    def sample_initial(self, key, num_particles):
        return jnp.zeros(num_particles)

    def sample_transition(self, key, states):
        return states

    def log_likelihood(self, observation, states):
        return -((observation - states) ** 2)


@pytest.mark.usefixtures("as_installed")
class TestBadInput:
    @pytest.fixture(scope="class")
    @staticmethod
    def found():
        filter = mpfjax.mixture_particle_filter(QUADRATIC, 30, 5)
        return mpfjax.run_filter(jax.random.key(1), filter, jnp.full(3, 1.5))

    @pytest.mark.parametrize(
        ("options", "named"),
        [
            ({"key": 0}, "key"),
            ({"model": None}, "model"),
            ({"model": NoTransition()}, "NoTransition defines no log_transition"),
            ({"mixtures": None}, "mixtures"),
            ({"num_trajectories": 0}, "num_trajectories: 0"),
            ({"num_trajectories": 1.5}, "num_trajectories: 1.5"),
            ({"component": 5}, "component: 5 is not one of 5"),
            ({"component": -1}, "component: -1"),
            ({"method": "best"}, "method: 'best'"),
            ({"num_steps": 3}, "num_steps: 3"),
            ({"num_steps": 0, "method": "mcmc"}, "num_steps: 0"),
        ],
    )
    def test_is_named(self, found, options, named):
        arguments = {
            "key": jax.random.key(0), "model": QUADRATIC, "mixtures": found, "num_trajectories": 3
        }  # fmt: skip
        with pytest.raises(ValueError, match=named):
            sample_trajectories(**arguments | options)

    def test_a_dead_component_is_named(self, found):
        dead = int(np.flatnonzero(~np.asarray(found.final.active))[0])
        with pytest.raises(ValueError, match=f"component: {dead} is dead"):
            sample_trajectories(jax.random.key(0), QUADRATIC, found, 3, component=dead)

    def test_what_was_collected_as_something_else_is_named(self, found):
        means = mpfjax.run_filter(
            jax.random.key(1), mpfjax.particle_filter(QUADRATIC, 30), jnp.full(3, 1.5),
            lambda mixture: mixture.mean(),
        )  # fmt: skip
        for run in (means, found.final):
            with pytest.raises(ValueError, match="mixtures"):
                trace_ancestors(run)

    def test_a_step_that_no_particle_can_have_taken_is_an_error(self, found):
        """The mixtures of one run before those of another, far away."""
        far = jax.tree.map(lambda leaf: leaf + 1e4, found.collected.particles)
        mixtures = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), found.collected)
        mixtures = eqx.tree_at(
            lambda mixtures: mixtures.particles,
            mixtures,
            jnp.concatenate([found.collected.particles, far]),
        )
        for options in ({}, {"method": "mcmc"}):
            with pytest.raises(RuntimeError, match="log_transition is -inf"):
                sample_trajectories(jax.random.key(0), Bounded(), mixtures, 3, **options)


class Bounded(NoTransition):
    """Steps of more than one are impossible."""

    def log_transition(self, states, previous_states):
        return jnp.where(jnp.abs(states - previous_states) > 1e3, -jnp.inf, 0.0)


def test_one_step_and_a_run_without_observations():
    filter = mpfjax.particle_filter(QUADRATIC, 20)
    for observations in (jnp.array([1.0]), jnp.full(3, jnp.nan)):
        found = mpfjax.run_filter(jax.random.key(1), filter, observations, missing="skip")
        drawn = sample_trajectories(jax.random.key(2), QUADRATIC, found, 5)
        assert drawn.shape == (5, len(observations) + 1)
        assert np.isfinite(drawn).all()
