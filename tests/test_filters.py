"""The runners, and the filters of the literature against references of their own."""

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import mpfjax
from mpfjax import Filter, Resample
from mpfjax.exact import grid_filter, kalman_filter
from mpfjax.moves.resampling.ancestors import SCHEMES
from tests.marking import quick_of, thorough
from tests.precision import float64
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

QUADRATIC = TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0)
OBSERVATIONS = jnp.array([1.5, 1.0, 0.4, 0.9])
LINEAR_1D = mpfjax.LinearGaussianModel(
    A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.2]], m0=[0.5], P0=[[1.0]]
)
LINEAR_2D = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.5], [-0.1, 0.9]],
    Q=[[0.2, 0.05], [0.05, 0.1]],
    H=[[1.0, 0.0], [0.5, 1.0]],
    R=[[0.3, 0.1], [0.1, 0.2]],
    m0=[0.5, -0.5],
    P0=[[1.0, 0.3], [0.3, 0.5]],
)


def mean(mixture):
    return mixture.mean()


def assert_same(run, other, **tolerance):
    """Every leaf of two runs is the same, to the bit where no tolerance is given."""
    chex.assert_trees_all_close(run, other, **(tolerance or {"rtol": 0, "atol": 0}))


class TestAgainstReferences:
    def test_one_component_is_the_particle_filter_to_the_bit(self):
        plain, key = CHAINS["pf"](QUADRATIC), jax.random.key(0)
        mixture = mpfjax.mixture_particle_filter(QUADRATIC, plain.num_particles, 1, regroup_every=1)
        assert_same(
            mpfjax.run_filter(key, plain, OBSERVATIONS),
            mpfjax.run_filter(key, mixture, OBSERVATIONS),
        )

    def test_agrees_with_a_bootstrap_filter_by_hand(self):
        """Log evidence and means of a plain numpy filter, within what N = 4000 allows."""
        rng, runs = np.random.default_rng(1), 40
        by_hand = np.array([bootstrap_by_hand(rng, 4000) for _ in range(runs)])
        keys = jax.random.split(jax.random.key(1), runs)
        filter = mpfjax.particle_filter(LINEAR_1D, 4000)
        run = mpfjax.monte_carlo(keys, filter, OBSERVATIONS[:, None], mean)
        ours = np.column_stack([run.log_marginal_likelihood, run.collected[:, :, 0]])
        spread = np.sqrt((by_hand.var(axis=0) + ours.var(axis=0)) / runs)
        assert (np.abs(by_hand.mean(axis=0) - ours.mean(axis=0)) < 4 * spread).all()

    @pytest.mark.parametrize(
        ("kind", "model"),
        [("mpf", LINEAR_1D), *thorough([("guided pf", LINEAR_2D)])],
        ids=["mpf in 1d", "guided pf in 2d"],
    )
    def test_agrees_with_the_kalman_filter(self, kind, model):
        """Filtering means, and the evidence, at N = 2000 over 50 runs."""
        if kind == "mpf":
            filter = mpfjax.mixture_particle_filter(model, 2000, 3)
        else:
            proposal = mpfjax.GaussNewtonProposal(model)
            filter = mpfjax.particle_filter(model, 2000, proposal=proposal)
        observations = jnp.stack([OBSERVATIONS, -OBSERVATIONS], axis=1)[:, : model.H.shape[0]]
        exact = kalman_filter(model, observations)
        keys = jax.random.split(jax.random.key(2), 50)
        run = mpfjax.monte_carlo(keys, filter, observations, mean)
        means = np.asarray(run.collected)
        standard_error = means.std(axis=0) / np.sqrt(50)
        assert (standard_error < 0.01).all()
        assert (np.abs(means.mean(axis=0) - exact.means) < 4 * standard_error + 1e-3).all()
        ratios = np.exp(run.log_marginal_likelihood - exact.log_marginal_likelihood)
        assert abs(ratios.mean() - 1) < 4 * ratios.std() / np.sqrt(50)


def bootstrap_by_hand(rng, n):
    """Multinomial bootstrap filter on LINEAR_1D: log evidence and the filtering means."""
    x, log_evidence, means = 0.5 + rng.normal(size=n), 0.0, []
    weights = np.full(n, 1 / n)
    for y in np.asarray(OBSERVATIONS, float):
        x = rng.choice(x, n, p=weights)
        x = 0.9 * x + np.sqrt(0.3) * rng.normal(size=n)
        likelihood = np.exp(-0.5 * (y - x) ** 2 / 0.2) / np.sqrt(2 * np.pi * 0.2)
        log_evidence += np.log(likelihood.mean())
        weights = likelihood / likelihood.sum()
        means.append(weights @ x)
    return [log_evidence, *means]


class TestRunners:
    @pytest.mark.thorough
    def test_without_jit_the_run_is_the_same(self):
        filter, key = CHAINS["kmeans only"](QUADRATIC), jax.random.key(4)
        compiled = mpfjax.run_filter(key, filter, OBSERVATIONS[:2])
        with jax.disable_jit():
            plain = mpfjax.run_filter(key, filter, OBSERVATIONS[:2])
        assert_same(plain, compiled, rtol=1e-3, atol=1e-4)

    def test_monte_carlo_is_run_filter_for_each_key(self):
        filter = CHAINS["pf"](QUADRATIC)
        keys = jax.random.split(jax.random.key(5), 3)
        together = mpfjax.monte_carlo(keys, filter, OBSERVATIONS)
        for k in range(3):
            alone = mpfjax.run_filter(keys[k], filter, OBSERVATIONS)
            one = jax.tree.map(lambda leaf, k=k: leaf[k], together)
            assert_same(alone, one, rtol=1e-3, atol=1e-4)

    def test_in_float64_every_array_is_float64_and_the_evidence_agrees(self):
        grid = jnp.linspace(-5.0, 5.0, 1001)
        exact = float(grid_filter(QUADRATIC, OBSERVATIONS, grid).log_marginal_likelihood)
        with float64():
            filter = CHAINS["patient merge"](TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0))
            observations = jnp.asarray(np.asarray(OBSERVATIONS), jnp.float64)
            run = mpfjax.run_filter(jax.random.key(6), filter, observations)
            arrays = [leaf for leaf in jax.tree.leaves(run) if eqx.is_inexact_array(leaf)]
            assert {leaf.dtype for leaf in arrays} == {np.dtype("float64")}
            assert float(run.log_marginal_likelihood) == pytest.approx(exact, abs=0.7)

    def test_collect_decides_what_is_kept(self):
        filter = CHAINS["pf"](QUADRATIC)
        whole = mpfjax.run_filter(jax.random.key(7), filter, OBSERVATIONS)
        means = mpfjax.run_filter(jax.random.key(7), filter, OBSERVATIONS, mean)
        assert whole.collected.particles.shape == (4, 48)
        np.testing.assert_allclose(
            jax.vmap(mean)(whole.collected), means.collected, rtol=1e-4, atol=1e-6
        )
        last = jax.tree.map(lambda leaf: leaf[-1], whole.collected)
        assert_same(last, whole.final)

    def test_observations_may_be_any_pytree(self):
        class TwoViews(mpfjax.QuadraticModel):
            def log_likelihood(self, observation, states):
                square = super().log_likelihood(observation["square"], states)
                return jnp.where(observation["seen"], square, 0.0)

        filter = mpfjax.particle_filter(TwoViews(0.3, 0.5, -2.0, 2.0), 48)
        seen = jnp.array([True, False, True, True])
        run = mpfjax.run_filter(
            jax.random.key(8), filter, {"square": OBSERVATIONS, "seen": seen}, mean
        )
        np.testing.assert_allclose(run.log_likelihood_increments[1], 0.0, atol=1e-6)
        assert np.isfinite(run.log_marginal_likelihood)

    def test_resampling_is_reported_where_it_happens(self):
        filter = mpfjax.particle_filter(QUADRATIC, 48, ess_threshold=0.5)
        run = mpfjax.run_filter(jax.random.key(9), filter, jnp.tile(OBSERVATIONS, 3))
        assert run.resampled.shape == (12, 1)
        assert 0 < run.resampled.sum() < 12
        assert not run.resampled[0]
        for t in range(1, 12):
            before = jax.tree.map(lambda leaf, t=t: leaf[t - 1], run.collected)
            assert run.resampled[t, 0] == (float(before.effective_sample_size) < 24)
            moved = np.asarray(run.collected.ancestor_indices[t]) != np.arange(48)
            assert moved.any() == bool(run.resampled[t, 0])


class TestMissing:
    HOLED = OBSERVATIONS.at[2].set(jnp.nan)

    def test_a_nan_observation_is_an_error_that_names_its_index(self):
        filter = CHAINS["mpf"](QUADRATIC)
        for bad in (jnp.nan, jnp.inf):
            with pytest.raises(ValueError, match="observations: NaN or infinite at index 2"):
                mpfjax.run_filter(jax.random.key(0), filter, OBSERVATIONS.at[2].set(bad))
        with pytest.raises(ValueError, match="index 2"):
            mpfjax.monte_carlo(jax.random.split(jax.random.key(0), 2), filter, self.HOLED)

    def test_skipping_is_predicting(self):
        filter, key = CHAINS["pf"](QUADRATIC), jax.random.key(10)
        run = mpfjax.run_filter(key, filter, self.HOLED, missing="skip")
        key_initial, key_steps = jax.random.split(key)
        mixture, keys = filter.init(key_initial), jax.random.split(key_steps, 4)
        increments = []
        for t in range(4):
            if t == 2:
                mixture, info = filter.predict(keys[t], mixture)
            else:
                mixture, info = filter.step(keys[t], mixture, self.HOLED[t])
            increments.append(float(info.log_likelihood_increment))
        np.testing.assert_allclose(run.log_likelihood_increments, increments, rtol=1e-3)
        assert run.log_likelihood_increments[2] == 0.0
        np.testing.assert_allclose(run.final.particles, mixture.particles, rtol=1e-3, atol=1e-4)
        assert not run.resampled[2].any()

    def test_skipping_with_nothing_missing_changes_nothing(self):
        filter, key = CHAINS["pf"](QUADRATIC), jax.random.key(11)
        assert_same(
            mpfjax.run_filter(key, filter, OBSERVATIONS, missing="skip"),
            mpfjax.run_filter(key, filter, OBSERVATIONS),
        )

    def test_skipping_agrees_with_the_kalman_filter_of_two_steps(self):
        """Seeing nothing at step 2 is one step of twice the dynamics."""
        observations = jnp.array([[1.0], [jnp.nan], [0.3]])
        keys = jax.random.split(jax.random.key(12), 200)
        filter = mpfjax.particle_filter(LINEAR_1D, 500)
        run = mpfjax.monte_carlo(keys, filter, observations, missing="skip")
        first = kalman_filter(LINEAR_1D, observations[:1])
        skipped = mpfjax.LinearGaussianModel(
            A=[[0.81]], Q=[[0.3 * 1.81]], H=[[1.0]], R=[[0.2]],
            m0=first.means[0], P0=first.covariances[0],
        )  # fmt: skip
        exact = first.log_marginal_likelihood + (
            kalman_filter(skipped, observations[2:]).log_marginal_likelihood
        )
        ratios = np.exp(run.log_marginal_likelihood - exact)
        assert abs(ratios.mean() - 1) < 4 * ratios.std() / np.sqrt(200)


# Every scheme, alone and with each Markov move, and with components that share the slots.
IN_SLOTS = {
    **{scheme: ([Resample(scheme)], 1) for scheme in SCHEMES},
    **{f"{scheme}, adaptive, mixture": ([Resample(scheme, 0.7)], 3) for scheme in SCHEMES},
    "random walk": ([Resample()], 1),
    "langevin": ([Resample("stratified")], 1),
    "langevin, mixture": ([Resample("ssp")], 3),
}


class TestSlots:
    """A filter of N particles among more slots has the law that it has in N slots."""

    @pytest.mark.parametrize(
        "name", quick_of(IN_SLOTS, ["residual", "ssp, adaptive, mixture", "langevin"])
    )
    def test_that_stay_empty_leave_evidence_and_moments_unbiased(self, name):
        """E[Ẑ/Z] = 1 and E[Ẑ/Z φ̂] = E[φ | y] for N = 50 in 200 slots, against a grid."""
        model = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
        resample, m = IN_SLOTS[name]
        markov = [mpfjax.RandomWalkMetropolis(model)] if "walk" in name else []
        if "langevin" in name:
            markov = [mpfjax.MetropolisAdjustedLangevin(model)]
        moves = [*resample, mpfjax.Propagate(model), *markov, *[mpfjax.KMeans()] * (m > 1)]
        filter = Filter(
            model, moves, 50, m, initial_moves=[mpfjax.KMeans(3, reseed=True)] * (m > 1)
        )
        keys = jax.random.split(jax.random.key(20), 1000)

        def collect(mixture):
            states = mixture.particles
            return mixture.average(states), mixture.average(states**2), mixture.occupied

        run = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, collect, slots=200)
        exact = grid_filter(model, OBSERVATIONS, jnp.linspace(-5.0, 5.0, 1001))
        ratios = np.exp(
            np.cumsum(np.asarray(run.log_likelihood_increments), axis=1)
            - np.cumsum(np.asarray(exact.log_likelihood_increments))
        )
        *found, occupied = map(np.asarray, run.collected)
        assert not occupied[..., 50:].any()
        first, second = np.asarray(exact.means), np.asarray(exact.variances + exact.means**2)
        for values, expected in ((1.0, 1.0), *zip(found, (first, second), strict=True)):
            error = (ratios * values).std(axis=0) / np.sqrt(len(keys))
            assert (error < 0.05).all()
            assert (np.abs((ratios * values).mean(axis=0) - expected) < 4 * error).all()

    def test_are_one_program_whatever_the_number_of_particles(self):
        keys = jax.random.split(jax.random.key(21), 3)

        def evidence(num_particles):
            model = TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0)
            filter = mpfjax.mixture_particle_filter(model, num_particles, 2)
            filter = mpfjax.with_selected_start(filter, 1)
            run = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, mean, slots=61)
            return run.log_marginal_likelihood

        evidence(20)
        with nothing_traced():
            others = [evidence(n) for n in (33, 61)]
        assert np.isfinite(others).all()

    def test_fewer_than_particles_are_an_error(self):
        keys = jax.random.split(jax.random.key(22), 2)
        with pytest.raises(ValueError, match=r"slots: 47 is .* N, 48"):
            mpfjax.monte_carlo(keys, CHAINS["pf"](QUADRATIC), OBSERVATIONS, slots=47)

    @pytest.mark.parametrize("chain", ["independent filters", "clusters"])
    def test_are_an_error_for_moves_that_fill_them_all(self, chain):
        keys = jax.random.split(jax.random.key(23), 2)
        with pytest.raises(ValueError, match=r"slots: Propagate\w+ fills every slot"):
            mpfjax.monte_carlo(keys, CHAINS[chain](QUADRATIC), OBSERVATIONS, slots=60)


class TestBrokenLikelihoods:
    def test_a_run_goes_on_after_a_step_of_zero_likelihood(self):
        filter = CHAINS["kmeans only"](QUADRATIC)
        blinded = OBSERVATIONS.at[1].set(BLINDED)
        run = mpfjax.run_filter(jax.random.key(13), filter, blinded)
        assert run.log_marginal_likelihood == -jnp.inf
        np.testing.assert_array_equal(run.degenerate, [False, True, False, False])
        increments = np.asarray(run.log_likelihood_increments)
        assert increments[1] == -np.inf
        assert np.isfinite(np.delete(increments, 1)).all()
        for leaf in jax.tree.leaves(run):
            assert not np.isnan(leaf).any()

    def test_a_nan_density_is_an_error_that_names_the_step(self):
        filter = CHAINS["pf"](QUADRATIC)
        broken = OBSERVATIONS.at[2].set(BROKEN)
        with pytest.raises(RuntimeError, match=r"model: .* at index 2"):
            mpfjax.run_filter(jax.random.key(14), filter, broken)
        with pytest.raises(RuntimeError, match=r"model: .* at index 2"):
            mpfjax.monte_carlo(jax.random.split(jax.random.key(14), 2), filter, broken)


class TestUsersModel:
    """The batched form runs through every chain in `test_chains.py`."""

    @pytest.mark.parametrize("chain", ["guided pf", *thorough(["kmeans only"])])
    def test_written_for_one_particle_it_agrees_with_the_kalman_filter(self, chain):
        filter = CHAINS[chain](mpfjax.per_particle(DriftOfOne()))
        keys = jax.random.split(jax.random.key(15), 2000)
        run = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, mean)
        exact = kalman_filter(DRIFT_AS_LINEAR_GAUSSIAN, OBSERVATIONS[:, None])
        evidence = np.cumsum(np.asarray(run.log_likelihood_increments), axis=1)
        ratios = np.exp(evidence - np.cumsum(np.asarray(exact.log_likelihood_increments)))
        for estimates, truth in (
            (ratios, 1.0),
            (ratios[..., None] * np.asarray(run.collected), np.asarray(exact.means)),
        ):
            standard_error = estimates.std(axis=0) / np.sqrt(2000)
            assert (np.abs(estimates.mean(axis=0) - truth) < 4 * standard_error).all()

    def test_three_methods_are_enough_for_a_bootstrap_filter(self):
        class Minimal(mpfjax.AbstractStateSpaceModel):
            def sample_initial(self, key, num_particles):
                return {"x": jax.random.normal(key, (num_particles,))}

            def sample_transition(self, key, states):
                return {"x": states["x"] + jax.random.normal(key, states["x"].shape)}

            def log_likelihood(self, observation, states):
                return -0.5 * (observation - states["x"]) ** 2

        filter = mpfjax.Filter(Minimal(), [mpfjax.Resample(), mpfjax.Propagate(Minimal())], 30, 3)
        run = mpfjax.run_filter(jax.random.key(16), filter, OBSERVATIONS, mean)
        assert run.collected["x"].shape == (4,)
        assert np.isfinite(run.log_marginal_likelihood)

    def test_a_move_may_be_any_function(self):
        def temper(key, mixture, observation):
            return mixture.replace(log_weights=mixture.log_weights - 0.5)

        propagate = mpfjax.Propagate(QUADRATIC)
        plain = mpfjax.Filter(QUADRATIC, [mpfjax.Resample(), propagate], 48)
        custom = mpfjax.Filter(QUADRATIC, [mpfjax.Resample(), propagate, temper], 48)
        assert custom.approximate
        key = jax.random.key(17)
        np.testing.assert_allclose(
            mpfjax.run_filter(key, custom, OBSERVATIONS).log_likelihood_increments,
            mpfjax.run_filter(key, plain, OBSERVATIONS).log_likelihood_increments - 0.5,
            rtol=1e-5,
        )
        with pytest.raises(ValueError, match=r"moves: .* does not define predict"):
            custom.predict(key, custom.init(key))


class TestGroupsOfRuns:
    def test_each_run_is_that_of_its_key(self, monkeypatch):
        keys = jax.random.split(jax.random.key(20), 6)
        filter = mpfjax.particle_filter(mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0), 32)
        together = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, mean)
        monkeypatch.setattr(mpfjax.running.run, "_IN_CACHE", 100)
        monkeypatch.setattr(mpfjax.running.run, "_IN_NEAR_CACHE", 80)
        assert mpfjax.running.run._group_size(6, filter) == 2
        in_groups = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, lambda mixture: mean(mixture))
        assert_same(in_groups, together, rtol=1e-5)

    @pytest.mark.parametrize(
        ("num_runs", "num_particles", "num_components", "size"),
        [
            (10, 5_000, 1, 10),
            (20, 10_000, 1, 2),
            (20, 10_000, 2, 2),
            (50, 2_000, 2, 10),
            (50, 2_000, 99, 10),
            (11, 100_000, 1, 1),
            (1, 10**7, 1, 1),
        ],
    )
    def test_sizes_divide_and_fit(self, num_runs, num_particles, num_components, size):
        model = mpfjax.QuadraticModel()
        filter = mpfjax.mixture_particle_filter(model, num_particles, num_components)
        assert mpfjax.running.run._group_size(num_runs, filter) == size


class TestGradients:
    def test_of_the_log_evidence_is_finite(self):
        filter = CHAINS["guided pf"](mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0))
        gradient = eqx.filter_jit(eqx.filter_grad(log_evidence))(filter, OBSERVATIONS)
        chex.assert_tree_all_finite(gradient)
        assert gradient.model.sigma_y != 0

    def test_is_finite_with_dead_components_and_a_step_of_zero_likelihood_left_out(self):
        def evidence_of_the_rest(filter, observations):
            run = mpfjax.run_filter(jax.random.key(18), filter, observations, mean)
            increments = run.log_likelihood_increments
            alive = jnp.exp(run.final.log_mixture_weights) > 0
            return jnp.sum(jnp.where(run.degenerate, 0.0, increments)), alive

        filter = CHAINS["patient merge"](QUADRATIC)
        blinded = OBSERVATIONS.at[1].set(BLINDED)
        differentiate = eqx.filter_jit(eqx.filter_grad(evidence_of_the_rest, has_aux=True))
        gradient, alive = differentiate(filter, blinded)
        assert not alive.all()
        chex.assert_tree_all_finite(gradient)

    def test_is_that_of_the_exact_evidence_without_resampling(self):
        """Weights alone are differentiable without bias; N is large enough to see it."""
        filter = mpfjax.Filter(LINEAR_1D, [mpfjax.Propagate(LINEAR_1D)], 200_000)
        one = jnp.array([[1.4]])
        gradient = eqx.filter_grad(log_evidence)(filter, one).model
        exact = eqx.filter_grad(lambda m: kalman_filter(m, one).log_marginal_likelihood)(LINEAR_1D)
        np.testing.assert_allclose(gradient.R, exact.R, rtol=0.05, atol=0.01)
        np.testing.assert_allclose(gradient.m0, exact.m0, rtol=0.05, atol=0.01)
        np.testing.assert_allclose(gradient.A, exact.A, rtol=0.05, atol=0.01)

    @pytest.mark.thorough
    def test_is_passed_on_by_what_is_collected(self):
        key = jax.random.key(19)
        filter = mpfjax.particle_filter(mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0), 16)

        def collected(scale):
            def collect(mixture):
                return scale * mixture.mean()

            return jnp.sum(mpfjax.run_filter(key, filter, OBSERVATIONS, collect).collected)

        np.testing.assert_allclose(jax.grad(collected)(1.0), collected(1.0), rtol=1e-5)
        np.testing.assert_allclose(jax.jit(collected)(1.0), collected(1.0), rtol=1e-5)

    def test_there_is_one_copy_of_the_models_parameters(self):
        for chain, build in CHAINS.items():
            model = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
            # What a gradient sees: an order of objects is a leaf too, but of integers.
            parameters = jax.tree.leaves(eqx.filter(build(model), eqx.is_inexact_array))
            assert len(parameters) == len(jax.tree.leaves(model)) == 2, chain

    def test_changing_the_filters_model_changes_its_moves(self):
        filter = CHAINS["guided mpf"](mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0))
        wider = eqx.tree_at(lambda f: f.model.sigma_x, filter, jnp.array(0.7))
        propagate = next(move for move in wider.moves if isinstance(move, mpfjax.Propagate))
        assert float(propagate.model.sigma_x) == pytest.approx(0.7)
        assert float(propagate.proposal.model.sigma_x) == pytest.approx(0.7)


def log_evidence(filter, observations):
    run = mpfjax.run_filter(jax.random.key(18), filter, observations, mean)
    return run.log_marginal_likelihood


WALKS_TRACED = []


class TestWhatAUserHandsIt:
    """Python's own numbers, features given once, observations in part."""

    class Walk(mpfjax.AbstractStateSpaceModel):
        """Parameters that are Python floats, as a first version of a model has them."""

        phi: float
        sigma: float

        def sample_initial(self, key, num_particles):
            WALKS_TRACED.append(num_particles)
            return jax.random.normal(key, (num_particles,))

        def sample_transition(self, key, states):
            return self.phi * states + self.sigma * jax.random.normal(key, states.shape)

        def log_likelihood(self, observation, states):
            return -0.5 * (observation - states) ** 2

    class Branching(Walk):
        """Python asks for the value of one of them."""

        def sample_transition(self, key, states):
            noise = self.sigma * jax.random.normal(key, states.shape)
            return noise if self.phi == 0 else self.phi * states + noise

    @pytest.mark.parametrize("run", ["run_filter", "monte_carlo", "step"])
    def test_floats_of_a_model_are_no_constants_of_the_program(self, run):
        found, traced = [], []
        for phi in (0.5, 0.9, 0.95):
            filter = mpfjax.particle_filter(self.Walk(phi, 0.3), 10)
            key, observations = jax.random.key(0), jnp.array([1.0, 2.0])
            before = len(WALKS_TRACED)
            if run == "step":
                mixture = filter.init(key)
                before = len(WALKS_TRACED)
                found.append(filter.step(key, mixture, 2.0)[1].log_likelihood_increment)
            elif run == "run_filter":
                found.append(mpfjax.run_filter(key, filter, observations).log_marginal_likelihood)
            else:
                runs = mpfjax.monte_carlo(key[None], filter, observations)
                found.append(runs.log_marginal_likelihood[0])
            traced.append(len(WALKS_TRACED) - before)
        assert traced[1:] == [0, 0]
        assert len(set(map(float, found))) == 3

    def test_floats_that_python_asks_for_stay_python_floats(self):
        for phi in (0.0, 0.9):
            filter = mpfjax.particle_filter(self.Branching(phi, 0.3), 10)
            run = mpfjax.run_filter(jax.random.key(0), filter, np.array([1.0, 2.0]))
            assert np.isfinite(run.log_marginal_likelihood)

    @pytest.mark.parametrize(
        "make", ["mixture_particle_filter", "gaussian_mixture_particle_filter"]
    )
    def test_features_and_scale_are_given_once(self, make):
        def first(states):
            return states[:, 0]

        filter = getattr(mpfjax, make)(Drift(), 20, 2, features=first, scale=3.0, regroup_every=1)
        regrouping = [m for m in (*filter.moves, *filter._initial_moves) if hasattr(m, "features")]
        assert len(regrouping) == 4
        for move in regrouping:
            assert move.features is first
            assert move.scale == (3.0,)
        own = mpfjax.KMeans(2, features=lambda states: states[:, 1])
        filter = getattr(mpfjax, make)(Drift(), 20, 2, regroup=[own], regroup_every=1)
        assert own in filter.moves

    @pytest.mark.thorough
    def test_features_of_a_wrapped_model_are_of_one_particle(self):
        options = {"num_particles": 20, "max_components": 2, "scale": 0.5}
        one = mpfjax.mixture_particle_filter(
            mpfjax.per_particle(DriftOfOne()), features=lambda state: state[0], **options
        )
        many = mpfjax.mixture_particle_filter(
            mpfjax.per_particle(DriftOfOne()),
            features=lambda state: state[0],
            regroup=[
                mpfjax.Merge(features=lambda states: states[:, 0], scale=0.5),
                mpfjax.Split(features=lambda states: states[:, 0], scale=0.5),
                mpfjax.KMeans(2, features=lambda states: states[:, 0], scale=0.5),
            ],
            **options,
        )
        runs = [mpfjax.run_filter(jax.random.key(2), f, jnp.zeros(3)) for f in (one, many)]
        labels = [run.final.component_indicators for run in runs]
        np.testing.assert_array_equal(*labels)

    @pytest.mark.thorough
    def test_one_of_two_sensors_may_be_missing(self):
        """Against the Kalman filter, whose missing sensor has a variance of 10⁸."""
        observations = np.array([[1.0, np.nan], [np.nan, 0.3], [0.4, 0.1], [np.nan, np.nan]])
        filter = mpfjax.particle_filter(TwoSensors(), 4000)
        keys = jax.random.split(jax.random.key(3), 200)
        runs = {
            missing: mpfjax.monte_carlo(
                keys, filter, observations, lambda m: m.mean(), missing=missing
            )
            for missing in ("error", "skip")
        }
        mean, log_evidence = DRIFT_AS_LINEAR_GAUSSIAN.m0, 0.0
        covariance = DRIFT_AS_LINEAR_GAUSSIAN.P0
        A, Q = (np.asarray(getattr(DRIFT_AS_LINEAR_GAUSSIAN, name), float) for name in "AQ")
        for y in observations:
            mean, covariance = A @ mean, A @ covariance @ A.T + Q
            seen = np.flatnonzero(~np.isnan(y))
            if seen.size:
                H = np.eye(2)[seen]
                S = H @ covariance @ H.T + 0.49 * np.eye(seen.size)
                gain = covariance @ H.T @ np.linalg.inv(S)
                residual = y[seen] - H @ mean
                log_evidence += multivariate_normal(np.zeros(seen.size), S).logpdf(residual)
                mean, covariance = mean + gain @ residual, covariance - gain @ H @ covariance
        for run in runs.values():
            ratios = np.exp(np.asarray(run.log_marginal_likelihood) - log_evidence)
            assert abs(ratios.mean() - 1) < 4 * ratios.std() / np.sqrt(len(ratios))
            last = np.asarray(run.collected)[:, -1]
            error = np.abs(last.mean(axis=0) - mean)
            assert (error < 4 * last.std(axis=0) / np.sqrt(len(last)) + 1e-3).all()
        assert float(runs["skip"].log_likelihood_increments[0, -1]) == 0.0

    def test_infinity_is_no_missing_number(self):
        filter = mpfjax.particle_filter(TwoSensors(), 10)
        with pytest.raises(ValueError, match="observations: infinite at index 1"):
            mpfjax.run_filter(jax.random.key(0), filter, np.array([[0.0, np.nan], [np.inf, 0.0]]))
        mixture = filter.init(jax.random.key(0))
        _, info = filter.step(jax.random.key(1), mixture, np.array([0.0, np.nan]))
        assert np.isfinite(info.log_likelihood_increment)
        with pytest.raises(RuntimeError, match="observation: infinite"):
            filter.step(jax.random.key(1), mixture, np.array([np.inf, np.nan]))


def test_a_start_is_what_its_parts_give_one_after_the_other():
    """To the last digit: the draws of x_0 are not part of the program that groups them."""
    filter = mpfjax.mixture_particle_filter(mpfjax.QuadraticModel(), 60, max_components=3)
    keys = jax.random.split(jax.random.key(0), 3)
    for key in keys:
        chex.assert_trees_all_equal(filter.init(key), filter._init(key))


def test_the_mass_of_a_mixture_given_by_hand_counts_once_whatever_moves_leave_the_weights():
    """A move that returns the weights that it was given is not normalised again."""
    model, key = mpfjax.QuadraticModel(), jax.random.key(0)

    def learns(key, mixture, observation):
        return mixture

    only = mpfjax.Filter(model, [mpfjax.Propagate(model), learns, mpfjax.Resample()], 50)
    before = mpfjax.Filter(model, [learns, mpfjax.Propagate(model), learns], 50)
    for filter in (only, before, mpfjax.Filter(model, [learns], 50)):
        given = filter.init(key)
        heavier = given.replace(log_weights=given.log_weights + 3)
        (_, info), (mixture, shifted) = (filter.step(key, m, 2.0) for m in (given, heavier))
        increments = info.log_likelihood_increment, shifted.log_likelihood_increment
        np.testing.assert_allclose(increments[0] + 3, increments[1], rtol=1e-5)
        np.testing.assert_allclose(mixture.log_mass, 0, atol=1e-5)


@pytest.mark.parametrize("num_components", [64, *thorough([2, 4, 12, 256])])
def test_any_number_of_components_compiles_alone_in_runs_and_differentiated(num_components):
    observations = jnp.array([1.5, 0.4])

    def runs(sigma):
        model = mpfjax.QuadraticModel(sigma, 0.5, -2.0, 2.0)
        filter = mpfjax.mixture_particle_filter(model, 512, max_components=num_components)
        keys = jax.random.split(jax.random.key(0), 8)
        found = mpfjax.monte_carlo(keys, filter, observations).log_marginal_likelihood
        return jnp.mean(found), found

    (_, many), slope = jax.jit(jax.value_and_grad(runs, has_aux=True))(0.3)
    model = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
    filter = mpfjax.mixture_particle_filter(model, 512, max_components=num_components)
    key = jax.random.split(jax.random.key(0), 8)[3]
    one = mpfjax.run_filter(key, filter, observations).log_marginal_likelihood
    assert jnp.isfinite(slope)
    np.testing.assert_allclose(many[3], one, rtol=1e-3)
