"""Partitioned sampling and DPS against exact filters, and their bookkeeping by hand."""

import itertools
from functools import cache

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import MultiObjectModel, PairwiseRepulsion, Partitioned, Resample
from mpfjax.exact import kalman_filter
from mpfjax.moves.objects.partitioned import circular_orders
from tests.examples import make_mixture, stack, walker
from tests.marking import thorough
from tests.user_models import TrickyQuadraticModel, nothing_traced

KEY = jax.random.key(0)


OBJECTS = [walker(0.0, 0.5), walker(1.0, 0.8), walker(-1.0, 1.0)]
OBSERVATIONS = jnp.array(
    [[[0.5], [0.2], [-1.5]], [[1.0], [-0.3], [0.5]], [[1.2], [0.9], [-0.2]]]
)  # fmt: skip
ORDERS = jnp.array(list(itertools.permutations(range(3))), jnp.int32)
APART = MultiObjectModel(stack(OBJECTS), 3)
NUM_RUNS = 1000


@eqx.filter_jit
def apply(move, mixture, observation):
    return move(KEY, mixture, observation)


@eqx.filter_jit
def estimates(keys, filter, observations):
    """log Ẑ and the means at the end, of a run for each key."""

    def run(key):
        run = mpfjax.run_filter(key, filter, observations, lambda mixture: mixture.mean())
        return run.log_marginal_likelihood, run.collected[-1][:, 0]

    return jax.vmap(run)(keys)


def assert_unbiased(log_estimates, means, log_evidence, exact_means):
    """E[Ẑ/Z] = 1 and E[Ẑ/Z x̂] = E[x | y] within 4 standard errors, over the last axis."""
    ratios = np.exp(np.asarray(log_estimates, float) - log_evidence)
    scale = 1 / np.sqrt(ratios.shape[-1])
    error = ratios.std(axis=-1) * scale
    assert (error < 0.05).all()
    assert (np.abs(ratios.mean(axis=-1) - 1) < 4 * error).all()
    weighted = ratios[..., None] * np.asarray(means)
    z = (weighted.mean(axis=-2) - exact_means) / (weighted.std(axis=-2) * scale)
    assert np.abs(z).max() < 4


class TestAgainstKalmanFilters:
    @staticmethod
    @cache
    def truth():
        runs = [kalman_filter(model, OBSERVATIONS[:, j]) for j, model in enumerate(OBJECTS)]
        log_evidence = sum(float(run.log_marginal_likelihood) for run in runs)
        return log_evidence, np.array([run.means[-1, 0] for run in runs])

    @pytest.mark.thorough
    def test_every_order_is_unbiased(self):
        keys = jax.random.split(jax.random.key(1), NUM_RUNS)

        @jax.vmap
        def in_order(order):
            filter = mpfjax.partitioned_sampling(APART, 60, order)
            return estimates(keys, filter, OBSERVATIONS)

        log_estimates, means = in_order(ORDERS)
        assert_unbiased(log_estimates, means, *self.truth())

    @pytest.mark.thorough
    def test_dps_that_keeps_the_evidence_is_unbiased_with_adaptive_resampling(self):
        filter = mpfjax.distributed_partitioned_sampling(
            APART, 60, ORDERS[:4], "evidence", ess_threshold=0.5
        )
        assert filter.num_components == 4
        assert not filter.approximate
        keys = jax.random.split(jax.random.key(2), NUM_RUNS)
        assert_unbiased(*estimates(keys, filter, OBSERVATIONS), *self.truth())


class TestWithInteraction:
    """Two objects on a line that repel each other, against quadrature on a grid of both."""

    MODEL = MultiObjectModel(stack(OBJECTS[:2]), 2, PairwiseRepulsion(3.0, 1.5))
    SEEN = OBSERVATIONS[:, :2]

    @classmethod
    @cache
    def truth(cls):
        grid = np.linspace(-6, 7, 521)
        cell = grid[1] - grid[0]

        def normal(x, variance):
            return np.exp(-0.5 * x**2 / variance) / np.sqrt(2 * np.pi * variance)

        squares = ((grid[:, None] - grid[None]) / 1.5) ** 2
        psi = np.exp(-3.0 * np.maximum(1 - squares, 0) ** 2)
        density = np.outer(normal(grid, 1.0), normal(grid - 1.0, 1.0))
        transition = normal(grid[:, None] - 0.9 * grid[None], 0.4) * cell
        log_evidence = 0.0
        for first, second in np.asarray(cls.SEEN)[..., 0]:
            density = transition @ density @ transition.T
            likelihood = np.outer(normal(first - grid, 0.5), normal(second - grid, 0.8))
            density = density * likelihood * psi
            mass = density.sum() * cell**2
            log_evidence += np.log(mass)
            density = density / mass
        means = [grid @ density.sum(axis=1 - j) * cell**2 for j in (0, 1)]
        return log_evidence, np.array(means)

    @pytest.mark.thorough
    def test_ps_and_dps_are_unbiased(self):
        filters = [
            mpfjax.partitioned_sampling(self.MODEL, 80, (1, 0)),
            mpfjax.distributed_partitioned_sampling(self.MODEL, 80, reassembly="evidence"),
        ]
        keys = jax.random.split(jax.random.key(3), NUM_RUNS)
        for filter in filters:
            assert_unbiased(*estimates(keys, filter, self.SEEN), *self.truth())

    def test_independent_filters_cannot_see_it_and_say_so(self):
        filter = mpfjax.independent_particle_filters(self.MODEL, 80)
        assert filter.approximate
        assert not mpfjax.independent_particle_filters(APART, 80).approximate


REPELLING = MultiObjectModel(stack(OBJECTS), 3, PairwiseRepulsion(2.0, 2.0))


class TestWeights:
    @pytest.mark.parametrize("orders", [None, *thorough([((2, 0, 1),), "random"])], ids=str)
    def test_without_resampling_they_are_those_of_the_joint_state(self, orders):
        """Every likelihood and every pair counts once, in any order and component."""
        components = 1 if orders == (2, 0, 1) else 2
        rng = np.random.default_rng(0)
        log_weights = np.where(np.arange(40) % 7 == 0, -np.inf, rng.normal(size=40))
        states = rng.normal(size=(40, 3, 1))
        labels = rng.integers(0, components, 40)
        mixture = make_mixture(states, log_weights, labels, components)
        between = Resample(ess_threshold=0.0, allocation="equal")
        move = Partitioned(REPELLING, orders, resample=between)
        moved = apply(move, mixture, OBSERVATIONS[0])
        before = mixture.log_weights[moved.ancestor_indices]
        expected = before + REPELLING.log_likelihood(OBSERVATIONS[0], moved.particles)
        filled = np.asarray(moved.occupied)
        found = moved.log_weights + moved.log_scale
        np.testing.assert_allclose(found[filled], expected[filled], rtol=1e-5)
        parents = np.asarray(moved.ancestor_indices)[filled]
        assert sorted(parents) == sorted(np.flatnonzero(log_weights > -np.inf))
        np.testing.assert_array_equal(moved.component_indicators[filled], labels[parents])
        assert not np.array_equal(moved.particles, mixture.particles)

    def test_one_object_is_a_plain_particle_filter_draw_for_draw(self):
        model = MultiObjectModel(walker(), 1)
        plain = mpfjax.run_filter(KEY, mpfjax.particle_filter(model, 30), OBSERVATIONS[:, :1])
        filter = mpfjax.partitioned_sampling(model, 30)
        run = mpfjax.run_filter(KEY, filter, OBSERVATIONS[:, :1])
        np.testing.assert_array_equal(run.final.particles, plain.final.particles)
        np.testing.assert_allclose(run.final.log_weights, plain.final.log_weights, rtol=1e-6)

    def test_relabelling_objects_and_order_relabels_the_result(self):
        relabelled = jnp.array([2, 0, 1])  # new object k is old object relabelled[k]
        order, new_order = (1, 2, 0), (2, 0, 1)
        assert [int(relabelled[k]) for k in new_order] == list(order)
        other = MultiObjectModel(stack([OBJECTS[j] for j in relabelled]), 3, REPELLING.interaction)
        filter = mpfjax.partitioned_sampling(REPELLING, 50, order)
        renamed = mpfjax.partitioned_sampling(other, 50, new_order)
        mixture = filter.init(KEY)
        twin = mixture.replace(particles=mixture.particles[:, relabelled])
        for t, observation in enumerate(OBSERVATIONS):
            key = jax.random.key(t)
            mixture, info = filter.step(key, mixture, observation)
            twin, twin_info = renamed.step(key, twin, observation[relabelled])
            np.testing.assert_allclose(twin.particles, mixture.particles[:, relabelled], rtol=1e-5)
            np.testing.assert_allclose(
                info.log_likelihood_increment, twin_info.log_likelihood_increment, rtol=1e-4
            )


class TestOrders:
    def test_circular_orders_start_one_further_each(self):
        expected = [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 1, 2]]
        assert circular_orders(4, 3).tolist() == expected

    @pytest.mark.thorough
    def test_the_object_moved_last_keeps_every_hypothesis(self):
        """It tells which order each component took."""
        mixture = mpfjax.particle_filter(APART, 90).init(KEY)
        labels = jnp.repeat(jnp.arange(3, dtype=jnp.int32), 30)
        mixture = mixture.replace(component_indicators=labels, num_components=3)

        def moved_last(orders):
            moved = apply(Partitioned(APART, orders), mixture, OBSERVATIONS[0])
            particles, labels = np.asarray(moved.particles), np.asarray(moved.component_indicators)
            return [
                [j for j in range(3) if len(np.unique(particles[labels == c, j])) == 30]
                for c in range(3)
            ]

        assert moved_last("circular") == [[2], [0], [1]]
        assert moved_last([(0, 2, 1), (0, 1, 2), (2, 1, 0)]) == [[1], [2], [0]]

    def test_random_orders_are_all_drawn(self):
        move = Partitioned(APART, "random")
        orders = jax.vmap(lambda key: move._orders(key, 2))(jax.random.split(KEY, 3000))
        kinds, counts = np.unique(np.asarray(orders).reshape(-1, 3), axis=0, return_counts=True)
        assert kinds.tolist() == ORDERS.tolist()
        assert np.abs(counts - 1000).max() < 4 * np.sqrt(6000 / 6 * 5 / 6)

    @pytest.mark.usefixtures("as_installed")
    def test_bad_orders(self):
        with pytest.raises(ValueError, match=r"order: \(0, 0, 1\) is no permutation"):
            mpfjax.partitioned_sampling(APART, 10, (0, 0, 1))
        for order in ((0, 1), (0, 1, 2, 3), (1, 2, 3), (0.5, 1.0, 2.0), (), "circular"):
            with pytest.raises(ValueError, match="order: "):
                mpfjax.partitioned_sampling(APART, 10, order)
        with pytest.raises(ValueError, match="order: 2 orders where there is one component"):
            mpfjax.partitioned_sampling(APART, 10, [(0, 1, 2), (2, 1, 0)])
        with pytest.raises(ValueError, match=r"orders: .* is no permutation"):
            mpfjax.distributed_partitioned_sampling(APART, 10, [(0, 1, 2), (2, 1, 1)])
        with pytest.raises(ValueError, match=r"orders: .* is no permutation"):
            mpfjax.distributed_partitioned_sampling(APART, 10, [(0, 1, 2), (2, 1)])
        with pytest.raises(ValueError, match="orders: 'alphabetic' is neither"):
            mpfjax.distributed_partitioned_sampling(APART, 10, "alphabetic")
        two = Partitioned(APART, [(0, 1, 2), (2, 1, 0)])
        mixture = mpfjax.particle_filter(APART, 10).init(KEY)
        with pytest.raises(ValueError, match="orders: 2 of them, for 1 components"):
            apply(two, mixture, OBSERVATIONS[0])

    @pytest.mark.usefixtures("as_installed")
    def test_other_bad_input(self):
        with pytest.raises(ValueError, match="num_particles: 2 is less than num_components, 3"):
            mpfjax.distributed_partitioned_sampling(APART, 2)
        with pytest.raises(ValueError, match="reassembly: 'posterior'"):
            mpfjax.distributed_partitioned_sampling(APART, 10, reassembly="posterior")
        with pytest.raises(ValueError, match="scheme: 'optimal'"):
            mpfjax.partitioned_sampling(APART, 10, scheme="optimal")
        for named in (
            mpfjax.partitioned_sampling,
            mpfjax.distributed_partitioned_sampling,
            mpfjax.independent_particle_filters,
        ):
            with pytest.raises(
                ValueError, match=r"(?s)model: LinearGaussianModel.*is not a MultiObject"
            ):
                named(walker(), 10)


class HalfBlind(mpfjax.QuadraticModel):
    """An object that can only be seen right of y; -inf elsewhere."""

    def log_likelihood(self, observation, states):
        return jnp.where(states > observation, -states, -jnp.inf)


class TestWhatDies:
    MODEL = MultiObjectModel(HalfBlind(0.1, 0.1, -1.0, 1.0), 2, shared_observation=True)

    def mixture(self, places):
        """Three components of ten particles, with both objects at the component's place."""
        labels = np.repeat(np.arange(3), 10)
        states = np.asarray(places, float)[labels][:, None] * np.ones((1, 2))
        return make_mixture(states, 0.1 * np.arange(30), labels, 3)

    @pytest.mark.parametrize("reassembly", ["evidence", "prior"])
    def test_a_component_that_an_object_kills_leaves_its_slots_to_the_others(self, reassembly):
        move = Partitioned(self.MODEL, "circular", reassembly=reassembly)
        before = self.mixture([5.0, -5.0, 4.0])
        after = apply(move, before, jnp.array(0.0))
        assert after.active.tolist() == [True, False, True]
        assert after.component_counts.tolist() == [15, 0, 15]
        assert not np.isnan(after.log_weights).any()
        assert (np.asarray(after.particles) > 3).all()
        if reassembly == "prior":
            shares = np.array(before.mixture_weights) * [1, 0, 1]
            expected = shares / shares.sum()
            masses = after.mixture_weights / after.mixture_weights.sum()
            np.testing.assert_allclose(masses, expected, rtol=1e-5)

    @pytest.mark.parametrize("reassembly", ["evidence", "prior"])
    def test_where_all_is_lost_the_particles_follow_their_dynamics(self, reassembly):
        move = Partitioned(self.MODEL, "circular", reassembly=reassembly)
        before = self.mixture([5.0, -5.0, 4.0])
        after = apply(move, before, jnp.array(50.0))
        assert float(after.log_mass) == -np.inf
        np.testing.assert_array_equal(after.component_indicators, before.component_indicators)
        np.testing.assert_allclose(after.particles, before.particles, atol=0.6)
        filter = mpfjax.Filter(self.MODEL, [move], 30, 3)
        stepped, info = filter.step(KEY, before, jnp.array(50.0))
        assert bool(info.degenerate)
        np.testing.assert_allclose(stepped.log_weights, before.log_weights, rtol=1e-5)
        np.testing.assert_allclose(stepped.particles, before.particles, atol=0.6)

    def test_a_density_that_is_broken_for_all_particles_is_an_error(self):
        class Broken(mpfjax.QuadraticModel):
            def log_likelihood(self, observation, states):
                return jnp.full(states.shape, observation)

        model = MultiObjectModel(Broken(0.1, 0.1, -1.0, 1.0), 2)
        mixture = mpfjax.particle_filter(model, 10).init(KEY)
        moved = apply(Partitioned(model), mixture, jnp.array([jnp.nan, -jnp.inf]))
        assert np.isnan(moved.log_weights).all()

    def test_two_objects_on_the_same_spot(self):
        model = MultiObjectModel(walker(), 2, PairwiseRepulsion(2.0, 1.0))
        mixture = mpfjax.particle_filter(model, 20).init(KEY)
        mixture = mixture.replace(particles=jnp.zeros_like(mixture.particles))
        after = apply(Partitioned(model), mixture, jnp.zeros((2, 1)))
        assert np.isfinite(after.log_weights).all()


class TestReassembly:
    def test_prior_returns_each_component_to_its_mass_and_keeps_all_else(self):
        rng = np.random.default_rng(0)
        labels = rng.integers(0, 3, 40)
        before = make_mixture(rng.normal(size=(40, 3, 1)), rng.normal(size=40), labels, 3)
        prior, evidence = (
            apply(Partitioned(APART, "circular", reassembly=name), before, OBSERVATIONS[0])
            for name in ("prior", "evidence")
        )
        masses = prior.mixture_weights / prior.mixture_weights.sum()
        np.testing.assert_allclose(masses, before.mixture_weights, rtol=1e-5)
        masses = evidence.mixture_weights / evidence.mixture_weights.sum()
        assert np.abs(masses - before.mixture_weights).max() > 0.03
        np.testing.assert_allclose(prior.log_mass, evidence.log_mass, rtol=1e-5)
        np.testing.assert_array_equal(prior.particles, evidence.particles)
        np.testing.assert_allclose(
            prior.log_component_weights, evidence.log_component_weights, rtol=1e-4, atol=1e-5
        )

    def test_only_prior_is_approximate(self):
        named = mpfjax.distributed_partitioned_sampling
        assert named(APART, 30).approximate
        assert not named(APART, 30, reassembly="evidence").approximate


class TestGradient:
    @pytest.mark.thorough
    def test_is_that_of_finite_differences_where_nothing_is_resampled(self):
        """Of the objects' parameters and of the interaction's, through every stage."""

        def log_evidence(strength, scale):
            model = eqx.tree_at(
                lambda m: m.object_model.R, REPELLING, replace_fn=lambda r: scale * r
            )
            model = eqx.tree_at(lambda m: m.interaction.strength, model, strength)
            filter = mpfjax.partitioned_sampling(model, 40, (1, 0, 2), ess_threshold=0.0)
            return mpfjax.run_filter(KEY, filter, OBSERVATIONS).log_marginal_likelihood

        point = (jnp.array(2.0), jnp.array(1.0))
        evaluate = jax.jit(jax.value_and_grad(log_evidence, (0, 1)))
        gradient = evaluate(*point)[1]
        for i in (0, 1):
            step = [0.02 * float(i == k) for k in (0, 1)]
            up, _ = evaluate(*[p + s for p, s in zip(point, step, strict=True)])
            down, _ = evaluate(*[p - s for p, s in zip(point, step, strict=True)])
            np.testing.assert_allclose(gradient[i], (up - down) / 0.04, rtol=0.02)

    @pytest.mark.thorough
    def test_is_finite_through_dps(self):
        filter = mpfjax.distributed_partitioned_sampling(REPELLING, 30)

        @eqx.filter_jit
        @eqx.filter_grad
        def slope(filter):
            return mpfjax.run_filter(KEY, filter, OBSERVATIONS).log_marginal_likelihood

        leaves = jax.tree.leaves(slope(filter))
        assert leaves
        chex.assert_tree_all_finite(leaves)
        assert any((np.asarray(leaf) != 0).any() for leaf in leaves)


def test_another_order_compiles_nothing():
    model = MultiObjectModel(TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0), 3)
    seen = jnp.array([1.0, 0.5, 0.2])
    first = mpfjax.partitioned_sampling(model, 20, ORDERS[0])
    first.step(KEY, first.init(KEY), seen)
    for order in ORDERS[1:]:
        filter = mpfjax.partitioned_sampling(model, 20, order)
        mixture = filter.init(KEY)
        with nothing_traced():
            filter.step(KEY, mixture, seen)
