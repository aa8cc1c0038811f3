"""Distinct hypotheses and their spread, by hand and as in the paper's figure 4."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from benchmarks.partitioned_sampling.effective_dynamics import effective_dynamics
from mpfjax.metrics import uniqueness
from tests.examples import make_mixture

NUM_OBJECTS, NUM_PARTICLES, VARIANCE = 7, 300, 4.0


def test_uniqueness_counts_what_differs_in_any_part_of_an_objects_state():
    box = np.zeros((6, 3, 2))
    box[:, 0] = np.arange(12).reshape(6, 2)
    box[:, 1, 1] = [1, 2, 1, 2, 1, 9]
    age = jnp.array([[0, 0, 5]] * 5 + [[0, 0, 6]])
    mixture = make_mixture(box, [0, 1, 2, 3, 4, -np.inf], np.zeros(6), 1)
    boxes = uniqueness(mixture)
    np.testing.assert_allclose(boxes, [5 / 6, 2 / 6, 1 / 6], rtol=1e-6)
    both = uniqueness(mixture.replace(particles=(mixture.particles, age)))
    np.testing.assert_allclose(both, boxes, rtol=1e-6)
    five_slots = mixture.replace(usable_slots=jnp.array(5, jnp.int32))
    np.testing.assert_allclose(uniqueness(five_slots), boxes * 6 / 5, rtol=1e-6)
    full = mixture.replace(particles=(mixture.particles, age), log_weights=jnp.zeros(6))
    np.testing.assert_allclose(uniqueness(full), [1.0, 3 / 6, 2 / 6], rtol=1e-6)


def test_uniqueness_counts_as_numpy_does():
    rng = np.random.default_rng(0)
    states = rng.integers(0, 4, (200, 4, 3)).astype(float)
    mixture = make_mixture(states, np.zeros(200), np.zeros(200), 1)
    expected = [len(np.unique(states[:, j], axis=0)) / 200 for j in range(4)]
    np.testing.assert_allclose(jax.jit(uniqueness)(mixture), expected, rtol=1e-6)


def test_effective_dynamics_is_the_variance_over_filled_slots_whatever_their_weights():
    rng = np.random.default_rng(1)
    states = rng.normal(size=(50, 3, 2))
    log_weights = np.where(np.arange(50) < 10, -np.inf, rng.normal(size=50))
    mixture = make_mixture(states, log_weights, np.zeros(50), 1)
    spread = effective_dynamics(mixture.replace(particles={"x": mixture.particles}))
    np.testing.assert_allclose(spread["x"], states[10:].var(axis=0), rtol=1e-5)


def test_effective_dynamics_of_whole_numbers():
    labels = np.random.default_rng(2).integers(0, 5, (40, 3))
    mixture = make_mixture(labels.astype(float), np.zeros(40), np.zeros(40), 1)
    mixture = mixture.replace(particles=jnp.asarray(labels, jnp.int32))
    np.testing.assert_allclose(effective_dynamics(mixture), labels.var(axis=0), rtol=1e-5)


@pytest.mark.thorough
class TestFigure4:
    """Seven objects that walk with a deviation of 2 and are seen to half a unit, N = 300."""

    MODEL = mpfjax.MultiObjectModel(
        mpfjax.LinearGaussianModel(
            jnp.eye(2), VARIANCE * jnp.eye(2), jnp.eye(2), 0.25 * jnp.eye(2),
            jnp.zeros(2), VARIANCE * jnp.eye(2),
        ),
        NUM_OBJECTS,
    )  # fmt: skip

    @staticmethod
    def observations():
        key_x, key_y = jax.random.split(jax.random.key(0))
        steps = jnp.sqrt(VARIANCE) * jax.random.normal(key_x, (10, NUM_OBJECTS, 2))
        return jnp.cumsum(steps, axis=0) + 0.5 * jax.random.normal(key_y, steps.shape)

    def over_runs(self, filter):
        """Mean uniqueness, and effective dynamics over the noise, of every object."""
        keys = jax.random.split(jax.random.key(1), 10)
        run = mpfjax.monte_carlo(
            keys,
            filter,
            self.observations(),
            lambda mixture: (uniqueness(mixture), effective_dynamics(mixture)),
        )
        shares, spreads = jax.tree.map(np.asarray, run.collected)
        return shares.mean(axis=(0, 1)), spreads.mean(axis=(0, 1, 3)) / VARIANCE

    def test_partitioned_sampling_impoverishes_the_first_objects_of_its_order(self):
        order = (2, 3, 4, 5, 6, 0, 1)
        filter = mpfjax.partitioned_sampling(self.MODEL, NUM_PARTICLES, order)
        shares, spreads = self.over_runs(filter)
        by_stage = shares[list(order)]
        assert (np.diff(by_stage) > 0).all()
        assert by_stage[0] < 0.05
        np.testing.assert_allclose(by_stage[-1], 1.0, rtol=1e-6)
        assert spreads[list(order)][0] < 0.2
        assert spreads[list(order)][-1] > 0.9

    @pytest.mark.thorough
    def test_dps_shares_it_out_equally(self):
        filter = mpfjax.distributed_partitioned_sampling(self.MODEL, NUM_PARTICLES)
        shares, spreads = self.over_runs(filter)
        assert shares.min() > 0.5 * shares.max()
        assert shares.min() > 0.1
        assert spreads.min() > 0.5 * spreads.max()
