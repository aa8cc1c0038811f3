"""Gaussian regeneration redraws each component with its own moments, and keeps its mass."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import GaussianRegeneration
from mpfjax.exact import kalman_filter
from mpfjax.mixture import ParticleMixture
from mpfjax.vision.boxes.colour_model import BoxState
from tests.marking import thorough

NUM_DRAWS = 2000


def a_mixture(num_particles=30, num_components=4):
    """Two ordinary components, one of a single particle, and a dead one; some slots empty."""
    keys = jax.random.split(jax.random.key(0), 2)
    labels = jnp.where(jnp.arange(num_particles) % 3 == 0, 2, 0).at[5].set(1)
    spread = jnp.array([[1.0, 0.4], [0.0, 0.5]])
    particles = 3.0 * labels[:, None] + jax.random.normal(keys[0], (num_particles, 2)) @ spread
    log_weights = jax.nn.log_softmax(jax.random.normal(keys[1], (num_particles,)))
    log_weights = jax.nn.log_softmax(log_weights.at[7].set(-jnp.inf))
    ancestors = jnp.arange(num_particles)
    return ParticleMixture(particles, log_weights, labels, ancestors, num_components)


def draw_many(move, mixture, num_draws=NUM_DRAWS):
    keys = jax.random.split(jax.random.key(1), num_draws)
    return jax.jit(jax.vmap(lambda key: move(key, mixture)))(keys)


@pytest.mark.parametrize("noise", ["independent", "stratified"])
def test_draws_have_the_moments_of_their_component(noise):
    mixture = a_mixture()
    after = draw_many(GaussianRegeneration(noise=noise), mixture)
    means = np.asarray(mixture.component_means())
    covariances = np.asarray(mixture.component_covariances())
    for m in (0, 2):
        members = np.asarray(after.component_indicators[0]) == m
        draws = np.asarray(after.particles)[:, members]
        one_each = draws[:, 0]  # independent over keys, whatever the noise within a draw
        np.testing.assert_array_less(
            np.abs(one_each.mean(0) - means[m]), 4 * one_each.std(0) / NUM_DRAWS**0.5
        )
        centred = one_each - means[m]
        products = centred[:, :, None] * centred[:, None, :]
        np.testing.assert_array_less(
            np.abs(products.mean(0) - covariances[m]), 4 * products.std(0) / NUM_DRAWS**0.5
        )


def test_every_component_keeps_its_mass_and_the_slots_are_dealt_equally():
    mixture = a_mixture()
    after = eqx.filter_jit(GaussianRegeneration())(jax.random.key(0), mixture)
    np.testing.assert_allclose(after.mixture_weights, mixture.mixture_weights, rtol=1e-5)
    np.testing.assert_array_equal(after.component_counts, [10, 10, 10, 0])
    np.testing.assert_array_equal(after.ancestor_indices, -1)


def test_a_fixed_number_leaves_the_other_slots_empty():
    after = eqx.filter_jit(GaussianRegeneration(particles_per_component=4))(
        jax.random.key(0), a_mixture()
    )
    np.testing.assert_array_equal(after.component_counts, [4, 4, 4, 0])
    assert np.isfinite(after.particles).all()


def test_a_component_of_one_particle_stays_where_it_is():
    mixture = a_mixture()
    after = eqx.filter_jit(GaussianRegeneration())(jax.random.key(3), mixture)
    alone = np.asarray(after.particles)[np.asarray(after.component_indicators) == 1]
    np.testing.assert_array_equal(alone, np.broadcast_to(mixture.particles[5], alone.shape))


def test_a_singular_covariance_draws_within_its_plane():
    mixture = a_mixture()
    flat = mixture.replace(particles=mixture.particles[:, :1] * jnp.array([[1.0, 2.0]]))
    after = draw_many(GaussianRegeneration(), flat, 50)
    np.testing.assert_allclose(after.particles[..., 1], 2 * after.particles[..., 0], atol=1e-4)


def motion(states):
    return states.box, states.previous


def box_states(spread):
    """Three components of ten boxes with the boxes before them, in pixels and units of a box.

    One varies by `spread`, one holds copies of a single state, one has all its weight on one.
    """
    labels = np.repeat(np.arange(3), 10)
    centre = np.array([300.0, 200, 1, 1])
    noise = np.random.default_rng(0).normal(size=(2, 30, 4)) * spread
    noise[:, labels == 1] = 0
    box, previous = (jnp.asarray(centre + part, jnp.float32) for part in noise)
    states = BoxState(box, jnp.asarray(labels, jnp.int32), previous)
    log_weights = np.full(30, -np.log(30.0), np.float32)
    log_weights[21:30] = -np.inf
    log_weights[20] = -np.log(3.0)
    indices = jnp.arange(30, dtype=jnp.int32)
    return ParticleMixture(states, jnp.asarray(log_weights), states.reference, indices, 4)


def test_box_states_of_second_order_keep_the_spread_of_every_coordinate():
    """A size's variance is a hundred-millionth of its place's, and must not be lost beside it."""
    mixture = box_states(np.array([60.0, 40, 0.02, 0.01]))
    move = GaussianRegeneration(10, where=motion)
    after = draw_many(move, mixture, 400)
    both = np.concatenate([mixture.particles.box[:10], mixture.particles.previous[:10]], axis=1)
    draws = np.concatenate([after.particles.box, after.particles.previous], axis=2)[:, :10]
    draws = draws.reshape(-1, 8).astype(float)
    expected = np.cov(both.T.astype(float), bias=True)
    found = np.cov(draws.T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(found - expected) < 5 * scale * np.sqrt(2 / len(draws)) + 0.01 * scale).all()


@pytest.mark.thorough
def test_identical_boxes_and_a_box_of_all_the_weight_are_drawn_again():
    mixture = box_states(np.array([5.0, 5, 0.02, 0.02]))
    after = eqx.filter_jit(GaussianRegeneration(10, where=motion))(jax.random.key(0), mixture)
    np.testing.assert_array_equal(after.component_counts, [10, 10, 10, 0])
    np.testing.assert_array_equal(after.particles.reference, after.component_indicators)
    for labels, kept in ((1, 10), (2, 20)):
        own = np.asarray(after.component_indicators) == labels
        for name in ("box", "previous"):
            drawn = np.asarray(getattr(after.particles, name))[own]
            np.testing.assert_allclose(
                drawn, np.tile(getattr(mixture.particles, name)[kept], (10, 1)), rtol=1e-6
            )


@pytest.mark.thorough
def test_a_box_that_always_moves_alike_is_drawn_within_that_plane():
    """The box before is this one, shifted: a singular covariance of the pair."""
    mixture = box_states(np.array([5.0, 5, 0.02, 0.02]))
    states = mixture.particles
    shifted = states.box - jnp.array([[3.0, 1.0, 0.0, 0.0]])
    states = BoxState(states.box, states.reference, shifted)
    move = GaussianRegeneration(10, where=motion)
    after = move(jax.random.key(0), mixture.replace(particles=states)).particles
    moved = np.asarray(after.box - after.previous)
    np.testing.assert_allclose(moved, np.tile([3.0, 1, 0, 0], (30, 1)), atol=1e-2)
    assert np.asarray(after.box)[:10].std(axis=0).min() > 0.005


@pytest.mark.thorough
def test_where_leaves_the_rest_to_resampling():
    mixture = a_mixture()
    states = {"box": mixture.particles, "kind": mixture.component_indicators * 10}
    move = GaussianRegeneration(where=lambda states: states["box"])
    after = move(jax.random.key(0), mixture.replace(particles=states))
    np.testing.assert_array_equal(after.particles["kind"], 10 * after.component_indicators)
    assert len(np.unique(after.particles["box"][:, 0])) == 21  # two redrawn tens, and one stayed


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"inflation": 0.0}, "inflation"),
        ({"noise": "pink"}, "noise"),
        ({"particles_per_component": 0}, "particles_per_component"),
    ],
)
def test_bad_options_are_named(options, named):
    with pytest.raises(ValueError, match=named):
        GaussianRegeneration(**options)


def test_the_predictive_gaussian_is_another_sample_of_the_same():
    """Redrawn once more between prediction and weighing, the particles are nobody's offspring."""
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    filters = [
        mpfjax.gaussian_particle_filter(model, 50, importance=importance)
        for importance in ("propagated", "predictive_gaussian")
    ]
    start = filters[0].init(jax.random.key(0))
    ends = [filter.step(jax.random.key(1), start, jnp.array(1.0))[0] for filter in filters]
    assert len(filters[1].moves) == 4
    assert not np.intersect1d(ends[0].particles, ends[1].particles).size


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"importance": "prior"}, "importance: 'prior'"),
        ({"importance": "predictive_gaussian", "proposal": True}, "importance: .* no proposal"),
    ],
)
def test_misread_importance_is_named(options, named):
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    if "proposal" in options:
        options = options | {"proposal": mpfjax.GaussNewtonProposal(model)}
    with pytest.raises(ValueError, match=named):
        mpfjax.gaussian_mixture_particle_filter(model, 50, 2, **options)


@pytest.mark.thorough
@pytest.mark.parametrize("importance", ["predictive_gaussian", *thorough(["propagated"])])
@pytest.mark.parametrize("max_components", [3, *thorough([1])])
def test_moments_are_the_kalman_filters(max_components, importance):
    """On a linear-Gaussian model one component is exact, and any number close to it."""
    model = mpfjax.LinearGaussianModel(
        A=0.9 * jnp.eye(2), Q=jnp.array([[0.6, 0.1], [0.1, 0.6]]), H=jnp.ones((1, 2)),
        R=0.3 * jnp.eye(1), m0=jnp.zeros(2), P0=jnp.eye(2),
    )  # fmt: skip
    observations = jnp.array([[0.3], [1.2], [-0.5], [2.0], [0.1]])
    exact = kalman_filter(model, observations)
    if max_components == 1:
        filter = mpfjax.gaussian_particle_filter(model, 2000, importance=importance)
    else:
        filter = mpfjax.gaussian_mixture_particle_filter(
            model, 2000, max_components, importance=importance
        )

    def collect(mixture):
        centred = mixture.particles - mixture.mean()[None]
        return mixture.mean(), mixture.average(centred[:, :, None] * centred[:, None])

    keys = jax.random.split(jax.random.key(0), 100)
    run = mpfjax.monte_carlo(keys, filter, observations, collect)
    # Cut into three, a Gaussian's parts are not Gaussian: a bias of a few hundredths is theirs.
    slack = 0.0 if max_components == 1 else 0.03
    truth = (np.asarray(exact.means), np.asarray(exact.covariances))
    for estimate, expected in zip(run.collected, truth, strict=True):
        found = np.asarray(estimate)
        bound = 4 * found.std(0) / 10 + slack
        np.testing.assert_array_less(np.abs(found.mean(0) - expected), bound)


@pytest.mark.thorough
def test_only_the_mixture_keeps_both_modes():
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    times = jnp.arange(1.0, 61.0)
    observations = (2 * jnp.sin(2 * jnp.pi * times / 100)) ** 2
    keys = jax.random.split(jax.random.key(0), 40)

    def sides(mixture):
        return jnp.stack([mixture.particles > 0.3, mixture.particles < -0.3]).any(axis=1)

    def share(filter):
        both = mpfjax.monte_carlo(keys, filter, observations, sides).collected.all(axis=-1)
        return float(both[:, 15:35].mean())

    regeneration = GaussianRegeneration(noise="stratified")
    assert share(mpfjax.gaussian_particle_filter(model, 100, regeneration=regeneration)) < 0.3
    mixture = mpfjax.gaussian_mixture_particle_filter(model, 100, 2, regeneration=regeneration)
    assert share(mixture) > 0.95
