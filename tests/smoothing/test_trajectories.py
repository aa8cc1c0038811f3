"""Trajectories of one component, of mixtures alone, genealogies, and bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_smoother
from mpfjax.smoothing import (
    sample_trajectories,
    smoothed_sums,
    trace_ancestors,
    with_first_ancestors,
)

QUADRATIC = mpfjax.QuadraticModel(0.3, 0.4, -2.0, 2.0)
SQUARES = np.array([1.2, 0.8, 1.5, 1.0], np.float32)


@pytest.mark.thorough
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


OBJECTS = mpfjax.MultiObjectModel(
    mpfjax.LinearGaussianModel(A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.0], P0=[[1.0]]), 2
)
SEEN = jnp.array([[[0.8], [-0.5]], [[1.3], [-0.2]], [[0.9], [0.3]]])
NO_PARENTS = {
    "objects": (OBJECTS, mpfjax.independent_particle_filters(OBJECTS, 2000), SEEN),
    "clusters": (OBJECTS, mpfjax.clustered_particle_filter(OBJECTS, 50), SEEN),
    "Gaussian": (QUADRATIC, mpfjax.gaussian_particle_filter(QUADRATIC, 50), jnp.full(3, 1.5)),
}


class TestParticlesWithoutOneParent:
    """Each object comes from a particle of its own: what follows ancestors refuses them."""

    @pytest.mark.parametrize("name", NO_PARENTS)
    def test_is_said_by_name(self, name):
        model, filter, observations = NO_PARENTS[name]
        run = mpfjax.run_filter(jax.random.key(0), filter, observations)
        assert (run.collected.ancestor_indices == -1).all()
        key, sum_of_all = jax.random.key(1), lambda before, states: states.sum(axis=1)
        for follow, named in (
            (lambda run: trace_ancestors(run), "trace_ancestors follows"),
            (lambda run: sample_trajectories(key, model, run, 9, method="mcmc"), "method 'mcmc'"),
        ):
            with pytest.raises(ValueError, match=f"mixtures: .*{named}"):
                follow(run)
            with pytest.raises(RuntimeError, match=named):
                jax.block_until_ready(jax.jit(follow)(run))
        with pytest.raises(ValueError, match=r"leaves no particle one parent.* smoothed_sums"):
            smoothed_sums(key, filter, observations, sum_of_all, method="mcmc")
        with pytest.raises(ValueError, match=r"leaves no particle one parent.* with_first"):
            with_first_ancestors(filter)

    def test_what_follows_none_is_right(self):
        """Backward sampling by all weights, against each object's Kalman smoother."""
        model, filter, observations = NO_PARENTS["objects"]
        run = mpfjax.run_filter(jax.random.key(0), filter, observations)
        drawn = sample_trajectories(jax.random.key(1), model, run, 2000)
        sums = smoothed_sums(jax.random.key(0), filter, observations, lambda x, _: x[..., 0]).sums
        for j in range(2):
            exact = kalman_smoother(OBJECTS.object_model, observations[:, j]).means[:, 0]
            np.testing.assert_allclose(drawn[:, :, j, 0].mean(axis=0), exact, atol=0.12)
            assert float(sums[-1, j]) == pytest.approx(float(exact[:3].sum()), abs=0.2)


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
