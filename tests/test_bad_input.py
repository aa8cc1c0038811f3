"""Bad input to the core is an error that names the argument, before anything compiles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, KMeans, Merge, Propagate, Resample, Split
from mpfjax.moves.objects.exclusion import Exclusion
from mpfjax.moves.propagation.propagate import Predict
from mpfjax.running.islands import IslandInteraction
from tests.user_models import DriftOfOne, TrickyQuadraticModel, nothing_traced

MODEL = TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0)
FILTER = mpfjax.particle_filter(MODEL, 20)
KEY = jax.random.key(0)

pytestmark = pytest.mark.usefixtures("as_installed")


@pytest.fixture(autouse=True)
def nothing_is_traced():
    """No error here may wait for the model to be traced."""
    with nothing_traced():
        yield


@pytest.mark.parametrize("num_particles", [0, -3, 2.5])
def test_too_few_particles(num_particles):
    with pytest.raises(ValueError, match="num_particles: "):
        Filter(MODEL, [Propagate(MODEL)], num_particles)


@pytest.mark.parametrize("num_components", [0, -1])
def test_too_few_components(num_components):
    with pytest.raises(ValueError, match="num_components: "):
        Filter(MODEL, [Propagate(MODEL)], 10, num_components)


def test_fewer_particles_than_components():
    with pytest.raises(ValueError, match="num_particles: 3 is less than num_components, 4"):
        mpfjax.mixture_particle_filter(MODEL, 3, 4)


def test_fewer_slots_than_a_fixed_number_each_needs():
    filter = mpfjax.mixture_particle_filter(MODEL, 199, 10)
    with pytest.raises(ValueError, match="particles_per_component: 20 for each of 10"):
        mpfjax.with_resampling(filter, Resample(particles_per_component=20))


def test_no_moves():
    with pytest.raises(ValueError, match="moves: "):
        Filter(MODEL, [], 10)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda mixture: None, "None, no ParticleMixture"),
        (lambda mixture: (mixture, 0.0), "no ParticleMixture"),
        (
            lambda mixture: mixture.replace(particles={"x": mixture.particles}),
            "in PyTreeDef.*x.*, and was given",
        ),
        (
            lambda mixture: mixture.replace(particles=mixture.particles[:5]),
            r"float32\[5\] in .*, and was given float32\[10\]",
        ),
        (
            lambda mixture: mixture.replace(log_weights=mixture.log_weights.astype(jnp.float16)),
            "log_weights of float16",
        ),
    ],
)
def test_a_move_that_returns_no_such_mixture(change, named):
    def custom(key, mixture, observation):
        return change(mixture)

    class Custom(mpfjax.AbstractMove):
        def __call__(self, key, mixture, observation):
            return mixture

        def predict(self, key, mixture):
            return change(mixture)

    model = mpfjax.QuadraticModel()
    filter = Filter(model, [custom], 10)
    with pytest.raises(ValueError, match=f"(?s)moves: custom returned .*{named}"):
        filter.step(KEY, filter.init(KEY), jnp.zeros(()))
    with pytest.raises(ValueError, match=f"(?s)moves: custom returned .*{named}"):
        mpfjax.run_filter(KEY, filter, jnp.zeros(2))
    filter = Filter(model, [Custom()], 10)
    with pytest.raises(ValueError, match=f"(?s)moves: Custom returned .*{named}"):
        filter.predict(KEY, filter.init(KEY))


@pytest.mark.parametrize(
    "moves",
    [
        [Resample()],
        [Predict(MODEL)],
        [Resample(), Predict(MODEL), KMeans(), mpfjax.Prune()],
        [mpfjax.Every(2, [Resample(), Merge()]), Exclusion(), IslandInteraction()],
        [mpfjax.AuxiliaryResample(Resample(), lambda observation, states: -states)],
    ],
)
def test_a_chain_that_never_sees_an_observation(moves):
    """Its log Ẑ would be zero whatever is observed."""
    with pytest.raises(ValueError, match=r"moves: \w+.* never weigh the particles"):
        Filter(MODEL, moves, 10)


@pytest.mark.parametrize(
    ("move", "options", "name"),
    [
        (Resample, {"scheme": "optimal"}, "scheme"),
        (Resample, {"ess_threshold": 1.5}, "ess_threshold"),
        (Resample, {"ess_threshold": -0.1}, "ess_threshold"),
        (Resample, {"particles_per_component": 0}, "particles_per_component"),
        (KMeans, {"num_iterations": 0}, "num_iterations"),
        (KMeans, {"scale": 0.0}, "scale"),
        (KMeans, {"scale": [1.0, -1.0]}, "scale"),
        (Merge, {"max_deviations": None}, "max_deviations, max_distance"),
        (Merge, {"max_deviations": 0.0}, "max_deviations"),
        (Merge, {"max_distance": -1.0}, "max_distance"),
        (Merge, {"patience": 0}, "patience"),
        (Split, {"min_deviations": -1.0}, "min_deviations"),
        (Split, {"min_distance": -1.0}, "min_distance"),
        (Split, {"min_share": 0.6}, "min_share"),
        (Split, {"num_iterations": 0}, "num_iterations"),
    ],
)
def test_an_option_of_a_move_that_is_out_of_range(move, options, name):
    with pytest.raises(ValueError, match=f"{name}: "):
        move(**options)


def test_as_many_units_as_features():
    filter = mpfjax.mixture_particle_filter(MODEL, 20, 2, scale=[1.0, 2.0])
    with pytest.raises(ValueError, match="scale: 2 units for 1 features"):
        filter.init(KEY)


@pytest.mark.parametrize(
    ("observations", "message"),
    [
        (jnp.zeros((0,)), "observations: the leading axis t is empty"),
        (jnp.array(1.0), "observations: shapes"),
        ([0.0, 1.0], r"observations: shapes .* jnp.asarray\(observations\)"),
        ({"a": jnp.zeros(3), "b": jnp.zeros(4)}, "observations: shapes"),
        ({}, "observations: there are none"),
        (np.array([0.0, np.nan, 1.0]), "observations: NaN or infinite at index 1"),
        (np.array([0.0, 1.0, -np.inf]), "observations: NaN or infinite at index 2"),
        (np.array([0.0, 1j]), "observations: complex128 is complex"),
        (np.array([0.0, 1e300, 1.0]), r"observations: 1e\+300 is more than float32"),
        ({"a": np.array([[0.0, 1.0], [-1e39, 0.0]])}, r"observations: -1e\+39 is more"),
    ],
)
def test_observations_that_cannot_be_run(observations, message):
    with pytest.raises(ValueError, match=message):
        mpfjax.run_filter(KEY, FILTER, observations)
    with pytest.raises(ValueError, match=message):
        mpfjax.monte_carlo(jax.random.split(KEY, 2), FILTER, observations)


def test_an_unknown_way_with_missing_observations():
    with pytest.raises(ValueError, match="missing: 'ignore'"):
        mpfjax.run_filter(KEY, FILTER, jnp.zeros(3), missing="ignore")


def test_keys_that_are_not_one_each_run():
    with pytest.raises(ValueError, match="keys: shape"):
        mpfjax.monte_carlo(KEY, FILTER, jnp.zeros(3))
    with pytest.raises(ValueError, match="keys: shape"):
        mpfjax.monte_carlo(jax.random.split(KEY, 2)[:0], FILTER, jnp.zeros(3))


def scalar_model(**methods):
    """A model of a scalar with some of its methods replaced."""
    good = {
        "sample_initial": lambda self, key, n: jnp.zeros(n),
        "sample_transition": lambda self, key, states: states,
        "log_likelihood": lambda self, observation, states: -states,
    }
    return type("Wrong", (mpfjax.AbstractStateSpaceModel,), good | methods)()


class TestAModelThatIsNotOne:
    @pytest.mark.parametrize("states", [None, {}, [], 0.0, "x", {"a": 1.0}])
    def test_no_states(self, states):
        model = scalar_model(sample_initial=lambda self, key, n: states)
        with pytest.raises(ValueError, match=r"model: Wrong.sample_initial returned"):
            mpfjax.particle_filter(model, 10).init(KEY)

    @pytest.mark.parametrize(
        "moved",
        [
            lambda states: states.astype(jnp.int32),
            lambda states: states[:, None],
            lambda states: {"x": states},
            lambda states: None,
            lambda states: 0.0,
        ],
    )
    def test_states_that_change_type_or_structure(self, moved):
        model = scalar_model(sample_transition=lambda self, key, states: moved(states))
        with pytest.raises(ValueError, match=r"model: Wrong.sample_transition returned"):
            mpfjax.run_filter(KEY, mpfjax.particle_filter(model, 10), jnp.zeros(2))

    @pytest.mark.parametrize("values", [None, 0.0, [0.0] * 10, "x"])
    def test_a_likelihood_that_is_no_array(self, values):
        model = scalar_model(log_likelihood=lambda self, observation, states: values)
        with pytest.raises(ValueError, match=r"model: Wrong.log_likelihood returned"):
            mpfjax.run_filter(KEY, mpfjax.particle_filter(model, 10), jnp.zeros(2))

    def test_a_density_of_the_dynamics_that_is_not_one_number_each_particle(self):
        model = scalar_model(log_transition=lambda self, states, previous_states: jnp.zeros(3))
        filter = mpfjax.particle_filter(model, 10, gradient="stop")
        with pytest.raises(ValueError, match=r"model: Wrong.log_transition returned shape \(3,\)"):
            mpfjax.run_filter(KEY, filter, jnp.zeros(2))

    def test_a_model_of_one_particle_that_is_not_wrapped(self):
        with pytest.raises(ValueError, match=r"model: DriftOfOne.sample_initial.*per_particle"):
            mpfjax.particle_filter(DriftOfOne(), 10)

    def test_a_wrapped_model_is_named_by_its_own_class(self):
        class Wrong(DriftOfOne):
            def log_likelihood(self, observation, state):
                return jnp.zeros(2)

        filter = mpfjax.particle_filter(mpfjax.per_particle(Wrong()), 10)
        with pytest.raises(ValueError, match=r"model: Wrong.log_likelihood returned shape"):
            mpfjax.run_filter(KEY, filter, jnp.zeros(2))

    def test_a_class_in_place_of_a_model(self):
        with pytest.raises(ValueError, match=r"model: .* is a class; write QuadraticModel\("):
            mpfjax.particle_filter(mpfjax.QuadraticModel, 10)

    def test_an_error_within_the_likelihood_says_what_it_was_given(self):
        filter = mpfjax.particle_filter(mpfjax.QuadraticModel(), 10)
        with pytest.raises(TypeError) as caught:
            filter.step(KEY, filter.init(KEY), {"y": 1.0})
        assert any("log_likelihood" in note and "'y'" in note for note in caught.value.__notes__)

    def test_a_missing_method(self):
        class Half:
            def sample_initial(self, key, num_particles):
                return jnp.zeros(num_particles)

        with pytest.raises(ValueError, match="model: Half defines no sample_transition"):
            mpfjax.particle_filter(Half(), 10)

    def test_states_without_an_axis_of_particles(self):
        class Wrong(mpfjax.QuadraticModel):
            def sample_initial(self, key, num_particles):
                return jnp.zeros((3, num_particles))

        with pytest.raises(ValueError, match=r"model: Wrong.sample_initial returned a leaf"):
            mpfjax.particle_filter(Wrong(), 10).init(KEY)

    def test_a_likelihood_that_is_not_one_number_each_particle(self):
        class Wrong(mpfjax.QuadraticModel):
            def log_likelihood(self, observation, states):
                return jnp.zeros((states.shape[0], 1))

        with pytest.raises(ValueError, match=r"model: Wrong.log_likelihood returned shape \(10, 1"):
            mpfjax.run_filter(KEY, mpfjax.particle_filter(Wrong(), 10), jnp.zeros(3))


@pytest.mark.parametrize("make", [mpfjax.particle_filter, mpfjax.independent_particle_filters])
def test_a_complex_likelihood(make):
    class Wrong(mpfjax.QuadraticModel):
        def log_likelihood(self, observation, states):
            return -((observation - states).astype(jnp.complex64) ** 2)

    model, observations = Wrong(), jnp.zeros(3)
    if make is mpfjax.independent_particle_filters:
        model, observations = mpfjax.MultiObjectModel(model, 2), jnp.zeros((3, 2))
    with pytest.raises(ValueError, match=r"model: Wrong.log_likelihood returned complex values"):
        mpfjax.run_filter(KEY, make(model, 10), observations)


def test_a_complex_observation_of_one_step():
    mixture = FILTER.init(KEY)
    with pytest.raises(ValueError, match="observation: complex64 is complex"):
        FILTER.step(KEY, mixture, jnp.array(1j))


def test_a_gaussian_of_whole_numbers():
    class Switching(mpfjax.AbstractStateSpaceModel):
        def sample_initial(self, key, num_particles):
            return {"x": jnp.zeros(num_particles), "mode": jnp.ones(num_particles, jnp.int32)}

        def sample_transition(self, key, states):
            return states

        def log_likelihood(self, observation, states):
            return states["x"]

    filter = mpfjax.gaussian_particle_filter(Switching(), 10)
    with pytest.raises(ValueError, match=r"where: the state\['mode'\] is int32"):
        mpfjax.run_filter(KEY, filter, jnp.zeros(3))


def test_observations_of_the_wrong_shape():
    filter = mpfjax.particle_filter(mpfjax.QuadraticModel(), 10)
    with pytest.raises(ValueError, match=r"observation: shape \(2,\)"):
        mpfjax.run_filter(KEY, filter, jnp.zeros((3, 2)))
