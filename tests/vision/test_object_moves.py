"""Exclusion between objects, and pruning of hopeless hypotheses within one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpfjax import QuadraticModel, Step
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.regrouping.merge import Exclusion, Prune
from mpfjax.vision.boxes.colour_model import BoxState

NOW = Step(QuadraticModel(), np.float32(0.0))
BY_OBJECT = {
    "group": lambda states: states.reference,
    "features": lambda states: states.box[:, :2],
}
# Component, reference, x, mass: object 0 has two hypotheses, object 1 has one near the first.
ROWS = [(0, 0, 0.0, 0.2), (0, 0, 2.0, 0.2), (1, 0, 50.0, 0.1), (2, 1, 4.0, 0.3), (2, 1, 6.0, 0.2)]


def mixture_of(rows, num_components=4):
    component, reference, x, mass = (np.array(column) for column in zip(*rows, strict=True))
    box = np.stack([x, 0 * x, 0 * x + 1, 0 * x + 1], axis=1)
    return ParticleMixture(
        particles=BoxState(jnp.asarray(box, jnp.float32), jnp.asarray(reference, jnp.int32)),
        log_weights=jnp.log(jnp.asarray(mass, jnp.float32)),
        component_indicators=jnp.asarray(component, jnp.int32),
        ancestor_indices=jnp.arange(len(rows), dtype=jnp.int32),
        num_components=num_components,
    )


def test_exclusion_by_hand():
    mixture = mixture_of(ROWS)
    move = Exclusion(strength=2.0, radius=0.5, scale=(10.0, 5.0), **BY_OBJECT)
    moved = eqx.filter_jit(move)(jax.random.key(0), mixture, NOW)
    penalty = np.asarray(mixture.log_weights - moved.log_weights)
    # Object 0 stands at 1 with 4/5 of its mass and at 50 with 1/5; object 1 at 5, all of it.
    near = lambda a, b: np.exp(-(((a - b) / 10) ** 2) / (2 * 0.5**2))  # noqa: E731
    of_object_0 = [2 * near(x, 5.0) for x in (0.0, 2.0, 50.0)]
    of_object_1 = [2 * (0.8 * near(x, 1.0) + 0.2 * near(x, 50.0)) for x in (4.0, 6.0)]
    np.testing.assert_allclose(penalty, of_object_0 + of_object_1, atol=1e-5)


def test_hypotheses_of_one_object_do_not_exclude_each_other():
    mixture = mixture_of([(0, 0, 0.0, 0.5), (1, 0, 0.5, 0.5)])
    move = Exclusion(strength=3.0, radius=0.5, **BY_OBJECT)
    moved = eqx.filter_jit(move)(jax.random.key(0), mixture, NOW)
    np.testing.assert_array_equal(np.asarray(moved.log_weights), np.asarray(mixture.log_weights))


def test_pruning_compares_within_an_object_only():
    rows = [(0, 0, 0.0, 0.5), (1, 0, 9.0, 5e-4), (2, 0, 9.0, 4e-3), (3, 1, 5.0, 1e-4)]
    prune = Prune(least_share=2e-3, group=lambda states: states.reference)
    moved = prune(jax.random.key(0), mixture_of(rows), NOW)
    assert moved.active.tolist() == [True, False, True, True]
    kept = np.asarray(moved.log_weights)[[0, 2, 3]]
    np.testing.assert_allclose(kept, np.log([0.5, 4e-3, 1e-4]), rtol=1e-6)
