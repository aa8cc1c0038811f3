"""What a filter is given and hands over; that it is right is in `test_chains.py`."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, Propagate, Resample
from tests.registry import CHAINS
from tests.user_models import (
    BLINDED,
    BROKEN,
    Drift,
    DriftOfOne,
    TrickyQuadraticModel,
    nothing_traced,
)

KEY = jax.random.key(0)
QUADRATIC = TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0)
OBSERVATIONS = jnp.array([1.5, 1.0, 0.4, 0.9])
PF = CHAINS["pf"](QUADRATIC)


def mean(mixture):
    return mixture.mean()


@pytest.mark.exactness
def test_the_mass_of_a_mixture_given_by_hand_counts_once_whatever_moves_leave_the_weights():
    """A move that returns the weights that it was given is not normalised again."""

    def learns(key, mixture, now):
        return mixture

    for moves in ([Propagate(), learns, Resample()], [learns, Propagate()]):
        filter = Filter(QUADRATIC, moves, 50)
        given = filter.init(KEY)
        heavier = given.replace(log_weights=given.log_weights + 3)
        (_, info), (mixture, shifted) = (filter.step(KEY, m, 2.0) for m in (given, heavier))
        increments = info.log_likelihood_increment, shifted.log_likelihood_increment
        np.testing.assert_allclose(increments[0] + 3, increments[1], rtol=1e-5)
        np.testing.assert_allclose(mixture.log_mass, 0, atol=1e-5)


@pytest.mark.exactness
def test_resampling_is_reported_where_it_happens():
    filter = mpfjax.particle_filter(QUADRATIC, 48, ess_threshold=0.5)
    run = mpfjax.run_filter(KEY, filter, jnp.tile(OBSERVATIONS, 3))
    sizes = jax.vmap(lambda mixture: mixture.effective_sample_size)(run.collected)
    due = np.concatenate([[False], np.asarray(sizes)[:-1] < 24])
    assert 0 < due.sum() < 12
    np.testing.assert_array_equal(run.resampled[:, 0], due)
    moved = (np.asarray(run.collected.ancestor_indices) != np.arange(48)).any(axis=1)
    np.testing.assert_array_equal(moved, due)


@pytest.mark.exactness
def test_broken_and_impossible_densities_within_a_run():
    """One step without any likelihood leaves no NaN; what else it is, the matrix asks."""
    filter, keys = CHAINS["kmeans only"](QUADRATIC), jax.random.split(KEY, 2)
    run = mpfjax.run_filter(KEY, filter, OBSERVATIONS.at[1].set(BLINDED))
    np.testing.assert_array_equal(run.degenerate, [False, True, False, False])
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(run))
    broken = OBSERVATIONS.at[2].set(BROKEN)
    for runner, key in ((mpfjax.run_filter, KEY), (mpfjax.monte_carlo, keys)):
        with pytest.raises(RuntimeError, match=r"model: .* at index 2"):
            runner(key, filter, broken)


@pytest.mark.exactness
def test_there_is_one_copy_of_the_models_parameters():
    for chain, build in CHAINS.items():
        model = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
        # What a gradient sees: an order of objects is a leaf too, but of integers.
        parameters = jax.tree.leaves(eqx.filter(build(model), eqx.is_inexact_array))
        assert len(parameters) == len(jax.tree.leaves(model)) == 2, chain


WALKS_TRACED = []


class Walk(mpfjax.AbstractStateSpaceModel):
    """Parameters that are Python floats, as a first version of a model has them."""

    phi: Any
    sigma: Any

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        WALKS_TRACED.append(states)
        return self.phi * states + self.sigma * jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        return -0.5 * (observation - states) ** 2


class Branching(Walk):
    """Python asks for the value of one of them."""

    def sample_transition(self, key, states):
        noise = self.sigma * jax.random.normal(key, states.shape)
        return noise if self.phi == 0 else self.phi * states + noise


RUNNERS = {
    "run_filter": lambda filter: mpfjax.run_filter(KEY, filter, OBSERVATIONS[:2]),
    "monte_carlo": lambda filter: mpfjax.monte_carlo(KEY[None], filter, OBSERVATIONS[:2]),
    "step": lambda filter: filter.step(KEY, filter.init(KEY), 2.0)[0],
}


@pytest.mark.exactness
@pytest.mark.parametrize("run", RUNNERS.values(), ids=RUNNERS)
def test_floats_of_a_model_are_no_constants_of_the_program(run):
    found = [run(mpfjax.particle_filter(Walk(0.5, 0.3), 10))]
    before = len(WALKS_TRACED)
    found += [run(mpfjax.particle_filter(Walk(phi, 0.3), 10)) for phi in (0.9, 0.95)]
    assert len(WALKS_TRACED) == before
    assert len({float(jax.tree.leaves(each)[0].sum()) for each in found}) == 3


@pytest.mark.exactness
def test_floats_that_python_asks_for_stay_python_floats():
    for phi in (0.0, 0.9):
        filter = mpfjax.particle_filter(Branching(phi, 0.3), 10)
        assert np.isfinite(mpfjax.run_filter(KEY, filter, OBSERVATIONS).log_marginal_likelihood)


UNIT = 1.0


def by_globals():
    return lambda mixture: globals()["UNIT"] * mixture.mean()


@pytest.mark.exactness
def test_functions_are_the_same_if_they_are_the_same_object(monkeypatch):
    """One text written twice sees what it names each time; one object compiles once."""

    def means(collect):
        return mpfjax.run_filter(KEY, PF, OBSERVATIONS, collect).collected

    collect = by_globals()
    first = means(collect)
    monkeypatch.setitem(globals(), "UNIT", 1000.0)
    np.testing.assert_allclose(means(by_globals()), 1000 * first, rtol=1e-5)
    with nothing_traced():
        means(collect)


@pytest.mark.parametrize("make", ["mixture_particle_filter", "gaussian_mixture_particle_filter"])
def test_features_and_scale_are_given_once(make):
    def first(states):
        return states[:, 0]

    filter = getattr(mpfjax, make)(Drift(), 20, 2, features=first, scale=3.0, regroup_every=1)
    regrouping = [m for m in (*filter.moves, *filter.initial_moves) if hasattr(m, "features")]
    assert [(m.features, m.scale) for m in regrouping] == [(first, (3.0,))] * 4
    own = mpfjax.KMeans(2, features=lambda states: states[:, 1])
    filter = mpfjax.mixture_particle_filter(Drift(), 20, 2, regroup=[own], regroup_every=1)
    assert own in filter.moves
    of_one = getattr(mpfjax, make)(
        mpfjax.per_particle(DriftOfOne()), 20, 2, features=lambda state: state[0]
    )
    features = of_one.initial_moves[-1].features
    np.testing.assert_array_equal(features(jnp.eye(2)), [1.0, 0.0])


class Heading(mpfjax.AbstractStateSpaceModel):
    """An angle near ±π."""

    periods = 2 * np.pi

    def sample_initial(self, key, num_particles):
        return self.sample_transition(key, jnp.full(num_particles, jnp.pi))

    def sample_transition(self, key, states):
        moved = states + 0.1 * jax.random.normal(key, states.shape)
        return (moved + jnp.pi) % (2 * jnp.pi) - jnp.pi

    def log_likelihood(self, observation, states):
        return -0.5 * ((observation - jnp.sin(states)) / 0.1) ** 2


@pytest.mark.exactness
def test_mixtures_know_the_periods_of_their_model():
    series = mpfjax.Series.skipping(np.array([0.0, np.nan, 0.05, 0.0]))
    plain = mpfjax.mixture_particle_filter(Heading(), 60, 3)
    filters = plain, mpfjax.particle_filter(Heading(), 60)
    runs = [mpfjax.run_filter(KEY, each, series, mean) for each in filters]
    runs.append(mpfjax.run_islands(KEY, plain, series, mean, num_islands=2))
    for run in runs:
        assert all(abs(each.mean()) > 2.8 for each in (run.initial, run.final))
    # An island's part of the mean is a sum, and that of the whole mixture their sum.
    collected = [runs[0].collected, runs[1].collected, runs[2].collected.sum(axis=1)]
    assert all(np.all(np.abs(means) > 2.8) for means in collected)


@pytest.mark.exactness
def test_a_dead_component_has_no_mean_and_hides_nothing():
    mixture = mpfjax.mixture_particle_filter(Heading(), 60, 3).init(KEY)
    mixture = mixture.replace(component_indicators=jnp.ones(60, jnp.int32))
    means = mixture.component_means()
    np.testing.assert_array_equal(np.isnan(means), [True, False, True])

    def alive(particles):
        means = mixture.replace(particles=particles).component_means()
        return jnp.sum(means[1]) + jnp.nansum(means)

    assert np.all(np.isfinite(jax.grad(alive)(mixture.particles)))
