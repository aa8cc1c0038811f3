"""Families of draws; that they are unbiased in every chain is in `tests/test_chains.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import GaussNewtonProposal, Propagate, PropagateNested
from mpfjax.exact import grid_filter
from mpfjax.moves.propagation.propagate import Reweight
from tests.examples import make_mixture
from tests.marking import thorough

MODEL = mpfjax.QuadraticModel(0.5, 0.1, -2.0, 2.0)
SEEN = jnp.array([1.0, 1.4, 0.9, 0.6, 1.1])


class Marked(mpfjax.AbstractStateSpaceModel):
    """A state that is one of few numbers, and the likelihood of each."""

    likelihoods: jax.Array

    @property
    def noise_dimension(self):
        return 1

    def sample_initial(self, key, num_particles):
        return jnp.zeros(num_particles, jnp.int32)

    def transition_from_noise(self, noise, states):
        del states
        share = jax.scipy.special.ndtr(noise[:, 0])
        return jnp.clip((share * len(self.likelihoods)).astype(jnp.int32), 0, 3)

    def log_likelihood(self, observation, states):
        return jnp.log(self.likelihoods[states]) + 0 * observation


@pytest.mark.thorough
@pytest.mark.parametrize("noise", ["rqmc", *thorough(["independent"])])
def test_weights_are_means_and_draws_are_kept_by_theirs(noise):
    """E[weight of those that keep a value] is its likelihood, for every value, one of them zero."""
    likelihoods = jnp.array([0.0, 1.0, 2.0, 5.0])
    move = PropagateNested(Propagate(Marked(likelihoods), noise=noise), 5)
    mixture = make_mixture(np.zeros(6), np.zeros(6), [0, 0, 1, 1, 1, 2], 3)
    mixture = mixture.replace(particles=jnp.zeros(6, jnp.int32))

    @jax.vmap
    def masses(key):
        moved = move(key, mixture, jnp.float32(0))
        weights = jnp.exp(moved.log_weights + moved.log_scale)
        return jnp.sum(weights[:, None] * jax.nn.one_hot(moved.particles, 4), axis=0)

    found = np.asarray(masses(jax.random.split(jax.random.key(0), 4000)), float)
    error = found.std(axis=0) / np.sqrt(len(found))
    assert (np.abs(found.mean(axis=0) - np.asarray(likelihoods) / 4) <= 4 * error).all()
    assert found[:, 0].max() == 0


def test_each_particle_keeps_one_of_its_own_draws():
    still = mpfjax.QuadraticModel(1e-4, 0.5, -2.0, 2.0)
    filter = mpfjax.mixture_particle_filter(still, 30, 3)
    filter = mpfjax.with_proposals_per_particle(filter, 4)
    before = filter.init(jax.random.key(0))
    after, _ = filter.step(jax.random.key(1), before, SEEN[0])
    parents = np.asarray(before.particles)[np.asarray(after.ancestor_indices)]
    np.testing.assert_allclose(after.particles, parents, atol=1e-3)


def test_the_evidence_varies_less_than_with_one_draw():
    exact = grid_filter(MODEL, SEEN, jnp.linspace(-5.0, 5.0, 2001)).log_marginal_likelihood
    errors = {}
    for num_draws in (1, 8):
        filter = mpfjax.particle_filter(MODEL, 40)
        filter = mpfjax.with_proposals_per_particle(filter, num_draws)
        keys = jax.random.split(jax.random.key(0), 300)
        run = mpfjax.monte_carlo(keys, filter, SEEN, lambda mixture: None)
        errors[num_draws] = np.asarray(run.log_marginal_likelihood, float) - float(exact)
    assert errors[8].std() < 0.6 * errors[1].std()


def test_one_draw_of_a_family_weighs_what_a_plain_draw_weighs():
    move = PropagateNested(Propagate(MODEL, GaussNewtonProposal(MODEL)), 1)
    mixture = make_mixture(np.linspace(-1, 1, 8), np.arange(8) / 8, np.arange(8) % 2, 2)
    moved = eqx.filter_jit(move)(jax.random.key(0), mixture, SEEN[0])
    assert moved.particles.shape == (8,)
    assert float(moved.log_mass) < np.inf
    assert np.isfinite(np.asarray(moved.log_weights)).all()


def test_an_empty_slot_and_a_hopeless_family_stay_without_weight():
    likelihoods = jnp.array([0.0, 0.0, 0.0, 0.0])
    move = PropagateNested(Propagate(Marked(likelihoods)), 3)
    mixture = make_mixture(np.zeros(4), [0.0, -np.inf, 0.0, 0.0], [0, 0, 1, 1], 2)
    marked = mixture.replace(particles=jnp.zeros(4, jnp.int32))
    moved = eqx.filter_jit(move)(jax.random.key(0), marked, jnp.float32(0))
    assert (np.asarray(moved.log_weights) == -np.inf).all()
    move = PropagateNested(Propagate(MODEL), 3)
    moved = eqx.filter_jit(move)(jax.random.key(0), mixture, SEEN[0])
    assert list(np.asarray(moved.occupied)) == [True, False, True, True]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"propagate": Propagate(MODEL), "num_draws": 0}, "num_draws"),
        ({"propagate": Propagate(MODEL), "num_draws": 1.5}, "num_draws"),
        ({"propagate": Propagate(MODEL, gradient="stop")}, "stop"),
        ({"propagate": Reweight(MODEL)}, "propagate"),
    ],
)
def test_what_will_not_do_is_named(as_installed, arguments, message):
    with pytest.raises(ValueError, match=message):
        PropagateNested(**arguments)


def test_no_trajectory_can_be_kept_among_families():
    filter = mpfjax.with_proposals_per_particle(mpfjax.particle_filter(MODEL, 10), 2)
    trajectory = jnp.zeros(len(SEEN) + 1)
    with pytest.raises(ValueError, match="Propagate"):
        mpfjax.smoothing.conditional_filter(jax.random.key(0), filter, SEEN, trajectory)
