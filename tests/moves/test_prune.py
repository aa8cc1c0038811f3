"""Pruning: what dies, what it costs, and what its slots are then for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import KMeans, ParticleMixture, Propagate, Prune, Resample

KEY = jax.random.key(0)


def mixture_of(*masses):
    """Three particles for each component, the mass shared equally."""
    each = jnp.repeat(jnp.log(jnp.asarray(masses) / 3), 3)
    labels = jnp.repeat(jnp.arange(len(masses), dtype=jnp.int32), 3)
    own = jnp.arange(len(labels), dtype=jnp.int32)
    return ParticleMixture(jnp.zeros(len(labels)), each, labels, own, len(masses))


@pytest.mark.parametrize("masses", [(0.9, 0.0999, 1e-4), (0.6, 0.1, 0.2, 0.0999, 1e-4, 1e-6)])
def test_only_what_is_below_the_share_of_the_heaviest_dies(masses):
    before = mixture_of(*masses)
    after = Prune(1e-3)(KEY, before)
    lives = np.array(masses) >= 1e-3 * max(masses)
    np.testing.assert_array_equal(after.active, lives)
    kept = lives[np.asarray(before.component_indicators)]
    np.testing.assert_array_equal(after.log_weights[kept], before.log_weights[kept])
    lost = 1 - float(jnp.exp(after.log_weights).sum())
    assert 0 < lost <= (len(masses) - 1) * 1e-3


def test_one_component_is_never_pruned():
    before = mixture_of(1.0)
    np.testing.assert_array_equal(Prune(0.9)(KEY, before).log_weights, before.log_weights)


def test_its_slots_go_to_the_others_and_the_evidence_keeps_its_bound():
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    observations = jnp.array([1.0, 1.1, 0.9, 1.0])

    def run(*more):
        moves = [Resample(), Propagate(model), *more]
        filter = mpfjax.Filter(model, moves, 400, 8, [KMeans(10, reseed=True)])
        return mpfjax.run_filter(jax.random.key(1), filter, observations, lambda m: m.active)

    plain, pruned = run(), run(Prune(1e-4))
    assert np.asarray(pruned.collected).sum() < np.asarray(plain.collected).sum()
    assert pruned.final.active.any()
    first = plain.log_likelihood_increments[0], pruned.log_likelihood_increments[0]
    assert 0 <= float(first[0] - first[1]) < 7 * 1e-4 + 1e-5


def test_it_is_declared_and_does_nothing_without_an_observation():
    before = mixture_of(0.9, 0.1 - 1e-5, 1e-5)
    assert Prune().approximate
    assert Prune(1e-3).predict(KEY, before) is before


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, float("nan")])
def test_a_share_that_will_not_do_is_named(share):
    with pytest.raises(ValueError, match="least_share"):
        Prune(share)
