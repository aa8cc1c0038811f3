"""What a filter is given and hands over; that it is right is in `test_chains.py`."""

from typing import Any

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import mpfjax
from mpfjax import Filter, Propagate, Resample
from mpfjax.exact import kalman_filter
from tests.registry import CHAINS
from tests.user_models import (
    BLINDED,
    BROKEN,
    DRIFT_AS_LINEAR_GAUSSIAN,
    Drift,
    DriftOfOne,
    TrickyQuadraticModel,
    TwoSensors,
    nothing_traced,
)

KEY = jax.random.key(0)
QUADRATIC = TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0)
OBSERVATIONS = jnp.array([1.5, 1.0, 0.4, 0.9])
LINEAR = mpfjax.LinearGaussianModel(
    A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.2]], m0=[0.5], P0=[[1.0]]
)
PF = CHAINS["pf"](QUADRATIC)


def mean(mixture):
    return mixture.mean()


def assert_mean(estimates, expected, slack=0.0):
    """The mean of independent estimates is within four standard errors of this."""
    estimates = np.asarray(estimates, float)
    error = 4 * estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    assert (np.abs(estimates.mean(axis=0) - expected) < error + slack).all()


def test_one_component_is_the_particle_filter_to_the_bit():
    mixture = mpfjax.mixture_particle_filter(QUADRATIC, PF.num_particles, 1, regroup_every=1)
    runs = [mpfjax.run_filter(KEY, filter, OBSERVATIONS) for filter in (PF, mixture)]
    chex.assert_trees_all_equal(*runs)


def test_a_start_is_what_its_parts_give_one_after_the_other():
    """To the last digit: the draws of x_0 are not part of the program that groups them."""
    filter = mpfjax.mixture_particle_filter(mpfjax.QuadraticModel(), 60, max_components=3)
    chex.assert_trees_all_equal(filter.init(KEY), filter._init(KEY))


def test_collect_decides_what_is_kept():
    whole = mpfjax.run_filter(KEY, PF, OBSERVATIONS)
    means = mpfjax.run_filter(KEY, PF, OBSERVATIONS, mean)
    found = jax.vmap(mean)(whole.collected)
    np.testing.assert_allclose(found, means.collected, rtol=1e-4, atol=1e-6)
    last = jax.tree.map(lambda leaf: leaf[-1], whole.collected)
    chex.assert_trees_all_equal(last, whole.final)


def test_three_methods_are_enough_for_any_pytree_of_states_and_observations():
    class Minimal(mpfjax.AbstractStateSpaceModel):
        def sample_initial(self, key, num_particles):
            return {"x": jax.random.normal(key, (num_particles,))}

        def sample_transition(self, key, states):
            return {"x": states["x"] + jax.random.normal(key, states["x"].shape)}

        def log_likelihood(self, observation, states):
            return jnp.where(observation["seen"], -0.5 * (observation["y"] - states["x"]) ** 2, 0.0)

    filter = Filter(Minimal(), [Resample(), Propagate(Minimal())], 30, 3)
    seen = {"y": OBSERVATIONS, "seen": jnp.array([True, False, True, True])}
    run = mpfjax.run_filter(KEY, filter, seen, mean)
    assert run.collected["x"].shape == (4,)
    np.testing.assert_allclose(run.log_likelihood_increments[1], 0.0, atol=1e-6)
    assert np.isfinite(run.log_marginal_likelihood)


def test_a_move_may_be_any_function():
    def temper(key, mixture, observation):
        return mixture.replace(log_weights=mixture.log_weights - 0.5)

    plain = Filter(QUADRATIC, [Resample(), Propagate(QUADRATIC)], 48)
    custom = plain.replace(moves=[*plain.moves, temper])
    assert custom.approximate
    ours, theirs = (mpfjax.run_filter(KEY, f, OBSERVATIONS) for f in (custom, plain))
    expected = theirs.log_likelihood_increments - 0.5
    np.testing.assert_allclose(ours.log_likelihood_increments, expected, rtol=1e-5)
    with pytest.raises(ValueError, match=r"moves: .* does not define predict"):
        custom.predict(KEY, custom.init(KEY))


def test_the_mass_of_a_mixture_given_by_hand_counts_once_whatever_moves_leave_the_weights():
    """A move that returns the weights that it was given is not normalised again."""

    def learns(key, mixture, observation):
        return mixture

    for moves in ([Propagate(QUADRATIC), learns, Resample()], [learns, Propagate(QUADRATIC)]):
        filter = Filter(QUADRATIC, moves, 50)
        given = filter.init(KEY)
        heavier = given.replace(log_weights=given.log_weights + 3)
        (_, info), (mixture, shifted) = (filter.step(KEY, m, 2.0) for m in (given, heavier))
        increments = info.log_likelihood_increment, shifted.log_likelihood_increment
        np.testing.assert_allclose(increments[0] + 3, increments[1], rtol=1e-5)
        np.testing.assert_allclose(mixture.log_mass, 0, atol=1e-5)


def test_resampling_is_reported_where_it_happens():
    filter = mpfjax.particle_filter(QUADRATIC, 48, ess_threshold=0.5)
    run = mpfjax.run_filter(KEY, filter, jnp.tile(OBSERVATIONS, 3))
    sizes = jax.vmap(lambda mixture: mixture.effective_sample_size)(run.collected)
    due = np.concatenate([[False], np.asarray(sizes)[:-1] < 24])
    assert 0 < due.sum() < 12
    np.testing.assert_array_equal(run.resampled[:, 0], due)
    moved = (np.asarray(run.collected.ancestor_indices) != np.arange(48)).any(axis=1)
    np.testing.assert_array_equal(moved, due)


def test_skipping_agrees_with_the_kalman_filter_of_two_steps():
    """Seeing nothing at step 2 is one step of twice the dynamics."""
    observations = jnp.array([[1.0], [jnp.nan], [0.3]])
    filter = mpfjax.particle_filter(LINEAR, 500)
    keys = jax.random.split(KEY, 400)
    run = mpfjax.monte_carlo(keys, filter, observations, mean, missing="skip")
    first = kalman_filter(LINEAR, observations[:1])
    twice = mpfjax.LinearGaussianModel(
        A=[[0.81]], Q=[[0.3 * 1.81]], H=[[1.0]], R=[[0.2]],
        m0=first.means[0], P0=first.covariances[0],
    )  # fmt: skip
    last = kalman_filter(twice, observations[2:])
    exact = first.log_marginal_likelihood + last.log_marginal_likelihood
    ratios = np.exp(np.asarray(run.log_marginal_likelihood, float) - float(exact))
    assert_mean(ratios, 1.0)
    assert_mean(ratios[:, None] * np.asarray(run.collected)[:, -1], last.means[-1])
    assert (run.log_likelihood_increments[:, 1] == 0).all()
    assert not run.resampled[:, 1].any()


def test_one_of_two_sensors_may_be_missing():
    """Against a Kalman filter that sees what is there."""
    observations = np.array([[1.0, np.nan], [np.nan, 0.3], [0.4, 0.1]])
    filter = mpfjax.particle_filter(TwoSensors(), 1000)
    run = mpfjax.monte_carlo(jax.random.split(KEY, 200), filter, observations, mean)
    m, P, A, Q = (
        np.asarray(getattr(DRIFT_AS_LINEAR_GAUSSIAN, name), float)
        for name in ("m0", "P0", "A", "Q")
    )
    log_evidence = 0.0
    for y in observations:
        m, P = A @ m, A @ P @ A.T + Q
        H = np.eye(2)[~np.isnan(y)]
        S = H @ P @ H.T + 0.49 * np.eye(len(H))
        gain, residual = P @ H.T @ np.linalg.inv(S), y[~np.isnan(y)] - H @ m
        log_evidence += multivariate_normal(np.zeros(len(H)), S).logpdf(residual)
        m, P = m + gain @ residual, P - gain @ H @ P
    ratios = np.exp(np.asarray(run.log_marginal_likelihood, float) - log_evidence)
    assert_mean(ratios, 1.0)
    assert_mean(ratios[:, None] * np.asarray(run.collected)[:, -1], m)
    with pytest.raises(ValueError, match="observations: infinite at index 1"):
        mpfjax.run_filter(KEY, filter, np.array([[0.0, np.nan], [np.inf, 0.0]]))


def test_broken_and_impossible_densities_within_a_run():
    filter, keys = CHAINS["kmeans only"](QUADRATIC), jax.random.split(KEY, 2)
    run = mpfjax.run_filter(KEY, filter, OBSERVATIONS.at[1].set(BLINDED))
    assert run.log_marginal_likelihood == -jnp.inf
    np.testing.assert_array_equal(run.degenerate, [False, True, False, False])
    np.testing.assert_array_equal(np.isfinite(run.log_likelihood_increments), ~run.degenerate)
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(run))
    broken = OBSERVATIONS.at[2].set(BROKEN)
    for runner, key in ((mpfjax.run_filter, KEY), (mpfjax.monte_carlo, keys)):
        with pytest.raises(RuntimeError, match=r"model: .* at index 2"):
            runner(key, filter, broken)


def test_slots_are_one_program_whatever_the_number_of_particles():
    def evidence(num_particles):
        model = TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0)
        filter = mpfjax.mixture_particle_filter(model, num_particles, 2)
        filter = mpfjax.with_selected_start(filter, 1)
        keys = jax.random.split(KEY, 3)
        run = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, mean, slots=61)
        return run.log_marginal_likelihood

    evidence(20)
    with nothing_traced():
        assert np.isfinite([evidence(n) for n in (33, 61)]).all()


def test_in_groups_each_run_is_that_of_its_key(monkeypatch):
    keys = jax.random.split(KEY, 6)
    filter = mpfjax.particle_filter(mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0), 32)
    together = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, mean)
    monkeypatch.setattr(mpfjax.running.run, "_IN_CACHE", 100)
    monkeypatch.setattr(mpfjax.running.run, "_IN_NEAR_CACHE", 80)
    assert mpfjax.running.run._group_size(6, filter) == 2
    in_groups = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, lambda mixture: mean(mixture))
    chex.assert_trees_all_close(in_groups, together, rtol=1e-5)


class TestGradients:
    def test_is_finite_with_dead_components_and_a_step_of_zero_likelihood_left_out(self):
        def evidence_of_the_rest(filter, observations):
            run = mpfjax.run_filter(KEY, filter, observations, mean)
            increments = run.log_likelihood_increments
            alive = jnp.exp(run.final.log_mixture_weights) > 0
            return jnp.sum(jnp.where(run.degenerate, 0.0, increments)), alive

        differentiate = eqx.filter_jit(eqx.filter_grad(evidence_of_the_rest, has_aux=True))
        filter = CHAINS["patient merge"](QUADRATIC)
        gradient, alive = differentiate(filter, OBSERVATIONS.at[1].set(BLINDED))
        assert not alive.all()
        chex.assert_tree_all_finite(gradient)

    def test_is_that_of_the_exact_evidence_without_resampling(self):
        """Weights alone are differentiable without bias; N is large enough to see it."""
        one = jnp.array([[1.4]])
        found, exact = (
            eqx.filter_grad(evidence)(LINEAR)
            for evidence in (
                lambda model: (
                    mpfjax.run_filter(
                        KEY, Filter(model, [Propagate(model)], 200_000), one, mean
                    ).log_marginal_likelihood
                ),
                lambda model: kalman_filter(model, one).log_marginal_likelihood,
            )
        )
        for name in ("R", "m0", "A"):
            expected = getattr(exact, name)
            np.testing.assert_allclose(getattr(found, name), expected, rtol=0.05, atol=0.01)

    def test_there_is_one_copy_of_the_models_parameters(self):
        for chain, build in CHAINS.items():
            model = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
            # What a gradient sees: an order of objects is a leaf too, but of integers.
            parameters = jax.tree.leaves(eqx.filter(build(model), eqx.is_inexact_array))
            assert len(parameters) == len(jax.tree.leaves(model)) == 2, chain

    def test_changing_the_filters_model_changes_its_moves(self):
        filter = CHAINS["guided mpf"](mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0))
        wider = eqx.tree_at(lambda f: f.model.sigma_x, filter, jnp.array(0.7))
        propagate = next(move for move in wider.moves if isinstance(move, Propagate))
        for held in (propagate.model, propagate.proposal.model):
            assert float(held.sigma_x) == pytest.approx(0.7)


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


@pytest.mark.parametrize("run", RUNNERS.values(), ids=RUNNERS)
def test_floats_of_a_model_are_no_constants_of_the_program(run):
    found = [run(mpfjax.particle_filter(Walk(0.5, 0.3), 10))]
    before = len(WALKS_TRACED)
    found += [run(mpfjax.particle_filter(Walk(phi, 0.3), 10)) for phi in (0.9, 0.95)]
    assert len(WALKS_TRACED) == before
    assert len({float(jax.tree.leaves(each)[0].sum()) for each in found}) == 3


def test_floats_that_python_asks_for_stay_python_floats():
    for phi in (0.0, 0.9):
        filter = mpfjax.particle_filter(Branching(phi, 0.3), 10)
        assert np.isfinite(mpfjax.run_filter(KEY, filter, OBSERVATIONS).log_marginal_likelihood)


UNIT = 1.0


def by_globals():
    return lambda mixture: globals()["UNIT"] * mixture.mean()


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
    filter = getattr(mpfjax, make)(Drift(), 20, 2, regroup=[own], regroup_every=1)
    assert own in filter.moves
    of_one = getattr(mpfjax, make)(
        mpfjax.per_particle(DriftOfOne()), 20, 2, features=lambda state: state[0]
    )
    features = of_one.initial_moves[-1].features
    np.testing.assert_array_equal(features(jnp.eye(2)), [1.0, 0.0])
