"""Filters whose noise is a point set over slot and noise: how exact, and on what states."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.vision.boxes.colour_model import ColourModel
from tests.examples import make_mixture
from tests.user_models import DRIFT_AS_LINEAR_GAUSSIAN, Drift

KEY = jax.random.key(0)
OBSERVATIONS = jnp.linspace(-1.0, 1.5, 10)
QUADRATIC = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)


@cache
def log_evidence(noise, num_particles):
    """log Ẑ of many runs, less log Z."""
    model = DRIFT_AS_LINEAR_GAUSSIAN
    filter = mpfjax.particle_filter(model, num_particles, noise=noise)
    keys = jax.random.split(KEY, 400)
    run = mpfjax.monte_carlo(keys, filter, OBSERVATIONS[:, None], lambda mixture: None)
    exact = kalman_filter(model, OBSERVATIONS[:, None]).log_marginal_likelihood
    return np.asarray(run.log_marginal_likelihood - exact, float)


@pytest.mark.thorough
def test_the_error_of_the_evidence_falls_faster_than_that_of_independent_noise():
    """Sobol points in the plane, particles along a Hilbert curve; 400 runs give sd to 3.5%."""
    few, many = 64, 512
    of_noise = {
        noise: [log_evidence(noise, n).std() for n in (few, many)]
        for noise in ("independent", "rqmc")
    }
    # An error of 5% in each ratio; it is 0.47 at N = 512.
    assert of_noise["rqmc"][1] < 0.6 * of_noise["independent"][1], of_noise
    # With independent noise it would be 1 / √8, which is 0.35; it is 0.25.
    assert of_noise["rqmc"][1] < 0.31 * of_noise["rqmc"][0], of_noise


@eqx.filter_jit
def resampled(mixture, sort_by):
    return mpfjax.Resample(sort_by=sort_by)(KEY, mixture)


class Switching(mpfjax.AbstractStateSpaceModel):
    """A place beside a mode that is no float: the mode says which way it drifts."""

    noise_dimension = 2

    def sample_initial(self, key, num_particles):
        modes = jnp.arange(num_particles, dtype=jnp.int32) % 2
        return {"mode": modes, "place": jax.random.normal(key, (num_particles, 2))}

    def transition_from_noise(self, noise, states):
        drift = jnp.where(states["mode"] == 0, 0.3, -0.3)
        return {"mode": states["mode"], "place": states["place"] + drift[:, None] + 0.2 * noise}

    def log_likelihood(self, observation, states):
        return -0.5 * jnp.sum((observation[None] - states["place"]) ** 2, axis=1)


@pytest.mark.thorough
def test_of_a_mode_beside_a_place_the_place_is_sorted_and_the_mode_goes_along():
    filter = mpfjax.mixture_particle_filter(
        Switching(), 64, 3, noise="rqmc", features=lambda states: states["place"]
    )
    mixture = filter.init(KEY)
    before = jax.tree.map(np.asarray, mixture.particles)
    moved = resampled(mixture, "hilbert")
    for name, leaf in moved.particles.items():
        np.testing.assert_array_equal(leaf, before[name][moved.ancestor_indices])
    run = mpfjax.run_filter(KEY, filter, jnp.zeros((5, 2)))
    assert np.isfinite(run.log_marginal_likelihood)


@pytest.mark.parametrize("sort_by", ["hilbert", lambda x: x, lambda x: x[:, 0] ** 3])
def test_particles_of_a_component_stand_near_their_neighbours(sort_by):
    """The way through all particles in turn is far shorter than in the order that they had."""
    rng = np.random.default_rng(0)
    states, labels = rng.normal(size=(400, 2)), rng.integers(0, 3, 400)
    states += 50 * labels[:, None]
    mixture = make_mixture(states, np.zeros(400), labels, 3)

    def way(mixture):
        x = np.asarray(mixture.particles)
        x = x[:, :1] if callable(sort_by) and sort_by(mixture.particles).ndim == 1 else x
        within = np.diff(mixture.component_indicators) == 0
        return np.linalg.norm(np.diff(x, axis=0), axis=1)[within].sum()

    plain, sorted_ = (resampled(mixture, by) for by in (None, sort_by))
    assert way(sorted_) < 0.3 * way(plain)
    assert (np.diff(sorted_.component_indicators) >= 0).all()


def test_standardised_coordinates_make_units_immaterial():
    rng = np.random.default_rng(1)
    states, labels = rng.normal(size=(200, 3)), rng.integers(0, 6, 200)
    ancestors = [
        resampled(make_mixture(states * unit, np.zeros(200), labels, 6), "hilbert").ancestor_indices
        for unit in (1.0, np.array([2.0**-9, 1.0, 2.0**12]))
    ]
    np.testing.assert_array_equal(*ancestors)


@pytest.mark.usefixtures("as_installed")
class TestWhatGoesWrongEasily:
    def test_components_of_one_particle_and_all_particles_at_one_point(self):
        model = Drift()
        propagate = eqx.filter_jit(mpfjax.Propagate(model, noise="rqmc"))
        labels = np.array([0, 1, 2, 3, 4, 4, 4, 4, 4, 4])
        for states in (np.ones((10, 2)), np.arange(20.0).reshape(10, 2)):
            mixture = make_mixture(states, np.zeros(10), labels, 5)
            moved = propagate(KEY, resampled(mixture, "hilbert"), jnp.array(0.5))
            assert np.isfinite(moved.particles).all()
            assert len(np.unique(moved.particles[:, 0])) == 10

    def test_a_filter_of_one_particle(self):
        filter = mpfjax.particle_filter(Drift(), 1, noise="rqmc")
        run = mpfjax.run_filter(KEY, filter, OBSERVATIONS)
        assert np.isfinite(run.log_marginal_likelihood)

    def test_noise_of_another_dimension(self):
        class Wide(Drift):
            noise_dimension = 3

        filter = mpfjax.particle_filter(Wide(), 8, noise="rqmc")
        with pytest.raises((TypeError, ValueError)) as caught:
            mpfjax.run_filter(KEY, filter, OBSERVATIONS)
        notes = "\n".join(caught.value.__notes__)
        assert "Wide.transition_from_noise, of noise of shape (8, 3)" in notes
        for call in (
            lambda noise: QUADRATIC.transition_from_noise(noise, jnp.zeros(4)),
            lambda noise: mpfjax.RandomWalk([1.0, 2.0]).from_noise(noise, jnp.zeros((4, 2))),
        ):
            with pytest.raises(ValueError, match="noise: shape"):
                call(jnp.zeros((4, 3)))

    @pytest.mark.parametrize("dimension", [0, -1, 2.0, 65, None])
    def test_a_noise_dimension_that_is_none(self, dimension):
        class Odd(Drift):
            noise_dimension = dimension

        with pytest.raises(ValueError, match="noise_dimension"):
            mpfjax.Propagate(Odd(), noise="rqmc")

    def test_a_model_that_is_not_made_of_noise(self):
        class Plain(mpfjax.AbstractStateSpaceModel):
            def sample_initial(self, key, num_particles):
                return jnp.zeros(num_particles)

            def log_likelihood(self, observation, states):
                return -states

        with pytest.raises(ValueError, match="model: Plain defines no sample_transition, nor"):
            mpfjax.particle_filter(Plain(), 8)

        class Own(Plain):
            def sample_transition(self, key, states):
                return states

        with pytest.raises(ValueError, match="model: Own defines no transition_from_noise"):
            mpfjax.particle_filter(Own(), 8, noise="rqmc")

        class Overridden(mpfjax.QuadraticModel):
            def sample_transition(self, key, states):
                return states

        for model in (Overridden(), mpfjax.MultiObjectModel(Overridden(), 2)):
            with pytest.raises(ValueError, match=r"model: .* transition_from_noise"):
                mpfjax.Propagate(model, noise="rqmc")

    def test_a_proposal_that_is_not_made_of_noise(self):
        class Plain(mpfjax.AbstractProposal):
            def propose(self, key, observation, previous_states):
                return previous_states, jnp.zeros(len(previous_states))

        with pytest.raises(ValueError, match="proposal: Plain defines no propose_from_noise"):
            mpfjax.Propagate(QUADRATIC, Plain(), noise="rqmc")

    def test_states_that_cannot_be_sorted(self):
        class Wide(Drift):
            def sample_initial(self, key, num_particles):
                return jnp.zeros((num_particles, 9))

        with pytest.raises(ValueError, match="sort_by: 9 coordinates"):
            mpfjax.run_filter(KEY, mpfjax.particle_filter(Wide(), 8, noise="rqmc"), OBSERVATIONS)
        whole = make_mixture(np.zeros(4), np.zeros(4), np.zeros(4, int), 1)
        whole = whole.replace(particles=jnp.arange(4))
        with pytest.raises(ValueError, match=r"sort_by: .hilbert.* has none"):
            eqx.filter_jit(mpfjax.Resample(sort_by="hilbert"))(KEY, whole)
        eqx.filter_jit(mpfjax.Resample(sort_by=lambda states: states))(KEY, whole)
        for wrong in (lambda states: states[:2], lambda states: 1.0, lambda states: None):
            with pytest.raises(ValueError, match="sort_by: it returned"):
                eqx.filter_jit(mpfjax.Resample(sort_by=wrong))(KEY, whole)
        with pytest.raises(ValueError, match="sort_by: 'hilbart'"):
            mpfjax.Resample(sort_by="hilbart")

    def test_a_conditional_filter_keeps_no_trajectory_among_point_sets(self):
        filter = mpfjax.particle_filter(QUADRATIC, 8, noise="rqmc")
        with pytest.raises(ValueError, match=r"filter: .* not noise='rqmc'"):
            mpfjax.smoothing.conditional_filter(KEY, filter, jnp.ones(2), jnp.ones(3))


@pytest.mark.thorough
def test_without_an_observation_the_noise_is_a_point_set_as_well():
    filter = mpfjax.particle_filter(QUADRATIC, 512, noise="rqmc")
    mixture = filter.init(KEY)
    start = filter.step(KEY, mixture, jnp.array(1.0))[0].replace(particles=jnp.zeros(512))
    spreads = [np.std(filter.predict(key, start)[0].particles) for key in jax.random.split(KEY, 8)]
    assert np.std(spreads) < 0.01 * np.mean(spreads)


class WalkOfOne:
    """A model of one particle that is made of noise, and draws nothing itself."""

    noise_dimension = 2

    def sample_initial(self, key):
        return jax.random.normal(key, (2,))

    def transition_from_noise(self, noise, state):
        return state + 0.5 * noise

    def log_likelihood(self, observation, state):
        return -0.5 * jnp.sum((observation - state) ** 2)


@pytest.mark.parametrize("noise", ["independent", "rqmc"])
def test_models_of_one_particle_are_made_of_noise_as_well(noise):
    model = mpfjax.per_particle(WalkOfOne())
    states = jnp.zeros((1024, 2))
    moved = model.transition_from_noise(jnp.ones((1024, 2)), states)
    np.testing.assert_allclose(moved, 0.5)
    filter = mpfjax.particle_filter(model, 1024, noise=noise)
    mixture = filter.init(KEY).replace(particles=states)
    moved = filter.predict(KEY, mixture)[0].particles
    np.testing.assert_allclose(np.std(moved, axis=0), 0.5, atol=0.05)


ROWS = jnp.tile(jnp.array([[1.0, -2.0]]), (20_000, 1))
DYNAMICS = {
    "walk": mpfjax.RandomWalk([1.0, 2.0]),
    "jumps": mpfjax.RandomWalkWithJumps([1.0, 2.0], [9.0, 8.0], 0.2),
    "velocity": mpfjax.WalkWithVelocity(mpfjax.RandomWalk([1.0, 2.0]), 0.3),
    "momentum": mpfjax.Autoregression.with_momentum(0.5, jnp.array([1.0, 2.0])),
}


@pytest.mark.parametrize("name", DYNAMICS)
def test_dynamics_made_of_noise_have_the_law_that_they_draw_from(name):
    dynamics = DYNAMICS[name]
    noise = jax.random.normal(KEY, (len(ROWS), dynamics.noise_dimension))
    made = np.asarray(dynamics.from_noise(noise, ROWS, 0.5 * ROWS))
    drawn = np.asarray(dynamics.sample(jax.random.key(1), ROWS, 0.5 * ROWS))
    quantiles = [np.quantile(x, np.linspace(0.1, 0.9, 9), axis=0) for x in (made, drawn)]
    np.testing.assert_allclose(*quantiles, atol=0.2)
    np.testing.assert_allclose(made.std(axis=0), drawn.std(axis=0), rtol=0.04)


def test_boxes_made_of_noise_switch_as_often_and_to_all_references():
    boxes = np.array([[10.0, 10.0, 6.0, 8.0], [20.0, 12.0, 6.0, 8.0], [5.0, 5.0, 6.0, 8.0]])
    frame = np.random.default_rng(0).integers(0, 256, (32, 40, 3), dtype=np.uint8)
    model = ColourModel.from_frame(frame, boxes, switch_probability=0.3)
    states = model.sample_initial(KEY, 30_000)
    noise = jax.random.normal(jax.random.key(1), (30_000, model.noise_dimension))
    for moved in (
        model.transition_from_noise(noise, states),
        model.sample_transition(jax.random.key(2), states),
    ):
        shares = np.bincount(np.asarray(moved.reference)[np.asarray(states.reference) == 0])
        np.testing.assert_allclose(shares / shares.sum(), [0.8, 0.1, 0.1], atol=0.015)


class OneSided(mpfjax.QuadraticModel):
    """A subclass that draws another x_0, and inherits how the old one was made of noise."""

    def sample_initial(self, key, num_particles):
        return jnp.full(num_particles, 1.5) + 0 * super().sample_initial(key, num_particles)


def test_an_x_0_of_another_law_is_not_replaced_by_an_inherited_one():
    filter = mpfjax.particle_filter(OneSided(0.3, 0.5), 20, noise="rqmc")
    np.testing.assert_array_equal(filter.init(jax.random.key(0)).particles, 1.5)


def test_x_0_is_spread_over_a_range_as_evenly_as_a_point_set():
    model = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0, "independent")
    start = mpfjax.particle_filter(model, 100, noise="rqmc").init(jax.random.key(0))
    assert np.diff(np.sort(start.particles)).max() < 4 * 4.0 / 100
