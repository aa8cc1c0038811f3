"""Conditional SMC leaves the smoothing distribution as it is: few particles, any grouping."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, KMeans, Merge, Propagate, RandomPartition, Resample, Split
from mpfjax.moves.propagation.propagate import Predict, Reweight
from mpfjax.smoothing import conditional_filter
from tests.marking import quick_of
from tests.user_models import ScalarLinear

NUM_RUNS = 10_000
QUADRATIC = mpfjax.QuadraticModel(0.3, 0.4, -2.0, 2.0)
PRESENT = np.array([True, True, False, True, True])
EAGER = (Merge(2.0), Split(1.0, min_distance=0.1, min_share=0.0), KMeans(2))


def chain(*moves, n, m):
    return Filter(QUADRATIC, moves, n, m, initial_moves=[KMeans(2, reseed=True)])


CASES = {
    "guided, eager mixture, systematic": chain(
        Resample(), Propagate(mpfjax.GaussNewtonProposal(2)), *EAGER, n=8, m=3
    ),
    "many components, sorted, of fixed number": chain(
        Resample("stratified", particles_per_component=2, along_curve=True),
        Predict(), Reweight(), RandomPartition(), n=11, m=5,
    ),
    "looking ahead, adaptive": chain(
        mpfjax.AuxiliaryResample(
            Resample("stratified", ess_threshold=0.7), lambda y, x: -((y - x**2) ** 2)
        ),
        Propagate(), *EAGER, n=8, m=3,
    ),
    "resampled every second step": chain(
        mpfjax.Every(2, [Resample("stratified"), KMeans(2)]), Propagate(), n=8, m=3
    ),
}  # fmt: skip


def statistics(trajectories):
    """x_s, x_s², and x_{s-1} x_s: the last tells trajectories that jump between modes."""
    x = trajectories.astype(float)
    return np.concatenate([x, x**2, x[:, 1:] * x[:, :-1]], axis=1)


@pytest.mark.exactness
@pytest.mark.parametrize("name", quick_of(CASES, [], one_in=2))
def test_exact_draws_stay_exact_and_much_is_new(name):
    """The mean change of every moment is zero, within four standard errors.

    States that are drawn together with the observations are exact draws given these.
    """
    filter = CASES[name]

    @jax.jit
    @jax.vmap
    def one(key):
        key, own = jax.random.split(key)
        states, observations = mpfjax.simulate(key, QUADRATIC, len(PRESENT))
        series = mpfjax.Series(observations, present=PRESENT)
        return states, conditional_filter(own, filter, series, states)

    keys = jax.random.split(jax.random.key(1), NUM_RUNS)
    before, found = jax.tree.map(np.asarray, one(keys))
    change = statistics(found.trajectory) - statistics(before)
    error = change.std(axis=0) / np.sqrt(NUM_RUNS)
    assert (error < 0.1 * statistics(before).std(axis=0)).all()
    z = change.mean(axis=0) / error
    assert np.abs(z).max() < 4, z
    assert ((found.trajectory != before).mean(axis=0) > 0.25).all()
    # The given trajectory stands in its slots, each the ancestor of the next.
    collected, slots = found.run.collected, found.slots
    states = np.concatenate([found.run.initial.particles[:, None], collected.particles], axis=1)
    rows, times = np.indices(slots.shape)
    np.testing.assert_array_equal(states[rows, times, slots], before)
    assert found.possible.all()
    rows, times = np.indices(slots[:, 1:].shape)
    assert np.isfinite(collected.log_weights[rows, times, slots[:, 1:]]).all()
    ancestors = collected.ancestor_indices[rows, times, slots[:, 1:]]
    np.testing.assert_array_equal(ancestors, slots[:, :-1])


class Walled(ScalarLinear):
    """Steps below zero, and observations farther than one, are impossible."""

    def log_likelihood(self, observation, states):
        return jnp.where(jnp.abs(observation - states) < 1, 0.0, -jnp.inf)

    def log_transition(self, states, previous_states):
        return jnp.where(states >= previous_states, 0.0, -jnp.inf)


def call(trajectory):
    filter, path = mpfjax.particle_filter(Walled(), 6), jnp.asarray(trajectory, jnp.float32)
    return conditional_filter(jax.random.key(0), filter, np.ones(3, np.float32), path)


@pytest.mark.parametrize(
    ("trajectory", "index"),
    [
        ((0.5, 0.6, 0.4, 0.8), 2),  # a step back
        ((0.9, 1.5, 1.9, 2.5), 3),  # too far from y
    ],
)
def test_a_trajectory_of_density_zero_is_named(trajectory, index):
    with pytest.raises(ValueError, match=f"trajectory: .*zero or NaN at index {index}"):
        call(trajectory)
    if index == 2:
        assert np.isnan(jax.jit(call)(jnp.array(trajectory)).trajectory).all()
