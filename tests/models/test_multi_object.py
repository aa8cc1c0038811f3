"""The joint model of several objects, against its objects one by one and against scipy."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax import MultiObjectModel, PairwiseRepulsion
from tests.examples import stack
from tests.user_models import Batched, Drift

KEY = jax.random.key(0)
NUM_OBJECTS = 3


def linear_gaussian(mean, noise):
    return mpfjax.LinearGaussianModel(
        A=[[0.9, 0.1], [0.0, 0.8]], Q=0.3 * jnp.eye(2), H=[[1.0, 0.5]], R=[[noise]],
        m0=[mean, -mean], P0=jnp.eye(2),
    )  # fmt: skip


OBJECTS = [linear_gaussian(m, r) for m, r in ((0.0, 0.5), (3.0, 0.8), (-4.0, 1.5))]
REPULSION = PairwiseRepulsion(2.0, 4.0)
MODEL = MultiObjectModel(stack(OBJECTS), NUM_OBJECTS, REPULSION)
STATES = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3, 2)), jnp.float32)
OBSERVATION = jnp.array([[0.3], [-1.0], [2.0]])
OWN = jnp.array([2, 0, 1, 1, 0], jnp.int32)  # an object of each particle


class TestDensities:
    @pytest.mark.exactness
    def test_objects_are_independent_though_their_draws_stand_in_line(self):
        """The quadratic model's x_0 are stratified, and come in ascending order."""
        states = MultiObjectModel(mpfjax.QuadraticModel(), 3).sample_initial(KEY, 4000)
        np.testing.assert_allclose(np.corrcoef(states.T), np.eye(3), atol=5 / np.sqrt(4000))

    @pytest.mark.exactness
    def test_log_likelihood_is_the_sum_over_objects_and_pairs(self):
        expected = np.zeros(5)
        for j, model in enumerate(OBJECTS):
            means = np.asarray(STATES[:, j] @ model.H.T)[:, 0]
            scale = np.sqrt(float(model.R[0, 0]))
            expected += scipy.stats.norm.logpdf(float(OBSERVATION[j, 0]), means, scale)
        for i, j in itertools.combinations(range(NUM_OBJECTS), 2):
            squares = np.sum(np.asarray(STATES[:, i] - STATES[:, j]) ** 2, axis=1) / 16
            expected -= 2.0 * np.maximum(1 - squares, 0) ** 2
        actual = MODEL.log_likelihood(OBSERVATION, STATES)
        np.testing.assert_allclose(actual, expected, rtol=1e-5)

    @pytest.mark.exactness
    def test_log_transition_is_the_sum_over_objects(self):
        expected = sum(
            model.log_transition(STATES[:, j] + 1, STATES[:, j]) for j, model in enumerate(OBJECTS)
        )
        np.testing.assert_allclose(MODEL.log_transition(STATES + 1, STATES), expected, rtol=1e-5)
        assert not hasattr(MultiObjectModel(Batched(), 2), "log_transition")


class TestOneObjectAtATime:
    """An object of its own of each particle; exact filters test one of all particles."""

    @pytest.mark.exactness
    @pytest.mark.parametrize(
        ("object_model", "shared_observation"), [(stack(OBJECTS), False), (OBJECTS[0], True)]
    )
    def test_densities(self, object_model, shared_observation):
        model = MultiObjectModel(object_model, NUM_OBJECTS, shared_observation=shared_observation)
        observation, of = OBSERVATION[0] if shared_observation else OBSERVATION, OWN
        chosen = model.object_states(STATES, of)
        likelihoods = model.object_log_likelihood(observation, chosen, of)
        transitions = model.object_log_transition(chosen + 0.1, chosen, of)
        for i, j in enumerate(of.tolist()):
            single = OBJECTS[j] if model.per_object else OBJECTS[0]
            seen, state = observation if shared_observation else observation[j], chosen[i][None]
            expected = single.log_likelihood(seen, state)[0]
            np.testing.assert_allclose(likelihoods[i], expected, rtol=1e-5)
            expected = single.log_transition(state + 0.1, state)[0]
            np.testing.assert_allclose(transitions[i], expected, rtol=1e-5)

    @pytest.mark.exactness
    def test_draws_follow_each_particles_own_object(self):
        """With next to no noise the draw is A_j x."""
        quiet = [
            eqx.tree_at(lambda m: (m.A, m.Q), model, (float(j) * jnp.eye(2), 1e-12 * jnp.eye(2)))
            for j, model in enumerate(OBJECTS)
        ]
        model = MultiObjectModel(stack(quiet), NUM_OBJECTS)
        chosen = model.object_states(STATES, OWN)
        moved = model.sample_object_transition(KEY, chosen, OWN)
        np.testing.assert_allclose(moved, OWN[:, None].astype(chosen.dtype) * chosen, atol=1e-4)


def test_a_shared_observation_is_prepared_once_for_all_objects():
    calls = []

    class Image(Drift):
        def prepare_observation(self, observation):
            calls.append(observation.shape)
            return observation.sum()

    model = MultiObjectModel(Image(), 3, shared_observation=True)
    values = model.log_likelihood(jnp.full((4, 6), 0.01), STATES)
    assert calls == [(4, 6)]
    expected = sum(Drift().log_likelihood(0.24, STATES[:, j]) for j in range(3))
    np.testing.assert_allclose(values, expected, rtol=1e-5)


class TestWhetherParametersAreEachObjectsOwn:
    @pytest.mark.exactness
    def test_is_found_out(self):
        assert MODEL.per_object
        assert not MultiObjectModel(OBJECTS[0], 3).per_object
        # Two dimensions and two objects: every array has a leading axis of two.
        square = mpfjax.LinearGaussianModel(*[jnp.eye(2)] * 4, jnp.zeros(2), jnp.eye(2))
        assert not MultiObjectModel(square, 2).per_object
        assert MultiObjectModel(square, 2, per_object=True).per_object  # if it is said
        assert MultiObjectModel(stack([square, square]), 2).per_object
        assert not MultiObjectModel(Drift(), 3).per_object
        assert MultiObjectModel(stack([OBJECTS[0]]), 1).per_object
        deviations = jnp.array([0.1, 0.2, 0.3])
        scalars = eqx.filter_vmap(mpfjax.QuadraticModel)(deviations, deviations)
        assert MultiObjectModel(scalars, 3).per_object


@pytest.mark.parametrize(
    ("features", "squares"),
    [(None, [0, 1, 25, 2500]), (lambda states: states["box"][:, 0], [0, 1, 9, 900])],
)
def test_repulsion_of_positions_and_its_gradient_on_the_same_spot(features, squares):
    repulsion = PairwiseRepulsion(2.0, 4.0, features)
    states = {"box": jnp.array([[0.0, 0.0], [1.0, 0.0], [3.0, 4.0], [30.0, 40.0]])}

    def potentials(states):
        return repulsion(states, jax.tree.map(jnp.zeros_like, states))

    expected = -2 * np.maximum(1 - np.array(squares) / 16, 0) ** 2
    np.testing.assert_allclose(potentials(states), expected, rtol=1e-5)
    slope = jax.grad(lambda states: potentials(states).sum())(states)["box"]
    np.testing.assert_array_equal(slope[0], 0.0)
