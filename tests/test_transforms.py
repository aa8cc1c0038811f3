"""Filters from filters: they compose, reach every move that they are about, and keep the model."""

import chex
import jax
import numpy as np
import pytest

import mpfjax
from mpfjax.lookahead.pilot import PilotLookahead

KEY, GUIDE = jax.random.key(0), mpfjax.GaussNewtonProposal()
MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
OBSERVATIONS = np.array([1.5, 1.0, 0.4], np.float32)


def final(filter):
    return mpfjax.run_filter(KEY, filter, OBSERVATIONS).final


@pytest.mark.exactness
def test_the_keywords_of_recipes_are_transforms():
    plain = mpfjax.particle_filter(MODEL, 32)
    for keywords, transform in (
        ({"noise": "rqmc"}, mpfjax.with_quasi_monte_carlo),
        ({"gradient": "stop"}, mpfjax.with_score_gradient),
    ):
        recipe = mpfjax.particle_filter(MODEL, 32, **keywords)
        chex.assert_trees_all_equal(final(recipe), final(transform(plain)))
    for filter in (plain, mpfjax.particle_filter(MODEL, 32, proposal=GUIDE)):
        scored = mpfjax.with_score_gradient(filter)  # which changes derivatives alone
        chex.assert_trees_all_equal(final(scored), final(filter))


def test_the_score_gradient_reaches_the_resampling_inside_of_moves():
    joint = mpfjax.MultiObjectModel(MODEL, 2, shared_observation=True)
    filter = mpfjax.with_score_gradient(mpfjax.partitioned_sampling(joint, 16))
    resample, partitioned = filter.moves
    assert (resample.gradient, partitioned.resample.gradient) == ("stop", "stop")


def test_point_sets_sort_the_chains_own_resampling_alone():
    filter = mpfjax.with_quasi_monte_carlo(
        mpfjax.auxiliary_particle_filter(MODEL, 16, PilotLookahead())
    )
    assert filter.moves[0].resample.along_curve


@pytest.mark.exactness
def test_a_look_ahead_and_proposals_are_put_on_and_taken_off():
    plain = mpfjax.particle_filter(MODEL, 16)
    ahead = mpfjax.with_lookahead(plain, GUIDE)
    assert isinstance(ahead.moves[0], mpfjax.AuxiliaryResample)
    assert isinstance(ahead.moves[1].proposal, mpfjax.GaussNewtonProposal)
    assert isinstance(mpfjax.with_lookahead(plain).moves[0].lookahead, PilotLookahead)
    guided = mpfjax.particle_filter(MODEL, 16, proposal=GUIDE)
    chex.assert_trees_all_equal(final(mpfjax.with_lookahead(guided)), final(ahead))
    several = mpfjax.with_proposals_per_particle(plain, 4)
    assert isinstance(several.moves[1], mpfjax.PropagateNested)
    assert mpfjax.with_proposals_per_particle(several, 8).moves[1].num_draws == 8
    assert isinstance(mpfjax.with_proposals_per_particle(several, 1).moves[1], mpfjax.Propagate)
    chex.assert_trees_all_equal(final(mpfjax.with_initial_selection(plain, 1)), final(plain))


@pytest.mark.exactness
def test_a_filter_is_replaced_by_its_own_arguments():
    other = mpfjax.QuadraticModel(0.1, 0.5, -2.0, 2.0)
    filter = mpfjax.with_initial_selection(mpfjax.mixture_particle_filter(MODEL, 32, 2), 3)
    changed = filter.replace(model=other, num_particles=50)
    assert changed.num_particles == 50
    assert changed.model is other
    assert changed.initial_moves[0].num_draws == 3
    assert not any(isinstance(held, type(other)) for held in vars(changed.moves[1]).values())
