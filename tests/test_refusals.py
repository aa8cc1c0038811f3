"""What a call refuses: by name, with the value, before anything compiles.

Annotations say what most arguments may be: all are tried here with values that will not do. What
depends on more than one argument, or shows only as a filter runs, stands in the table `REFUSED`.
"""

import collections
import functools
import inspect
import re
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import mpfjax
from mpfjax import (
    Filter,
    KMeans,
    Merge,
    Propagate,
    Resample,
    checks,
    metrics,
    smoothing,
    tuning,
    vision,
)
from mpfjax.moves.initial import SelectInitial
from mpfjax.moves.objects.clusters import PropagateInClusters
from mpfjax.moves.objects.exclusion import Exclusion
from mpfjax.moves.objects.independent import PropagateIndependently
from mpfjax.moves.propagation.propagate import Predict, Reweight
from mpfjax.running.islands import IslandInteraction
from mpfjax.smoothing.variance import batch_estimate, log_marginal_likelihood_variance
from mpfjax.tuning.labels import transition_candidates
from mpfjax.vision.boxes.following import Snapshot
from tests.user_models import Batched, Drift, DriftOfOne, ScalarLinear

pytestmark = pytest.mark.usefixtures("as_installed")

KEY = jax.random.key(0)
MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
JOINT = mpfjax.MultiObjectModel(MODEL, 2, shared_observation=True)
FILTER = mpfjax.particle_filter(MODEL, 4)
MIXTURE = FILTER.init(KEY)
TWO, THREE = np.ones(2, np.float32), np.ones(3, np.float32)
HISTORY = mpfjax.run_filter(KEY, FILTER, TWO)
EYE, ZERO = np.eye(1), np.zeros(1)
LINEAR = {"A": EYE, "Q": EYE, "H": EYE, "R": EYE, "m0": ZERO, "P0": EYE}
SWITCHING = mpfjax.SwitchingLinearGaussianModel(EYE, EYE, EYE, EYE, EYE, ZERO, EYE)
NAN, INFINITY = float("nan"), float("inf")
BAD = (
    None, True, 0, 1, 2, -1, 2**40, 0.5, 2.5, NAN, INFINITY, -0.1, "", "systematic", "x", b"x", 1j,
    object(), int, len, [], {}, [1.0], [[1.0]], [-1.0], np.zeros(0), np.array([np.nan, 1.0]),
    np.array(["a"]), np.array([1 + 1j, 2]), np.array([1, 2], "m8[s]"), np.zeros((2, 2)),
    np.ma.masked_array([1.0, 2.0], [True, False]), jnp.array(0.5), jnp.array(2), KEY, KEY[None],
    jax.random.PRNGKey(0), MODEL, JOINT, FILTER, MIXTURE, mpfjax.QuadraticModel, Resample(),
)  # fmt: skip


def nothing(mixture):
    return None


def difference(previous_states, states):
    return states - previous_states


# The arguments of a good call that have no default, or whose default leaves something out.
GOOD = {
    mpfjax.QuadraticModel: {},
    mpfjax.LinearGaussianModel: LINEAR,
    mpfjax.RandomWalk: {"deviations": [1.0, 2.0]},
    mpfjax.RandomWalkWithJumps: {
        "deviations": [1.0], "jump_deviations": [5.0], "jump_probability": 0.1
    },
    mpfjax.WalkWithVelocity: {
        "walk": mpfjax.RandomWalk([1.0]), "gain": 0.1, "initial_velocity": [0.5]
    },
    mpfjax.Autoregression: {"A1": EYE, "A2": EYE, "B": EYE, "mean": ZERO},
    mpfjax.PairwiseRepulsion: {"strength": 1.0, "radius": 2.0},
    mpfjax.MultiObjectModel: {"object_model": MODEL, "num_objects": 2},
    mpfjax.SwitchingLinearGaussianModel: {
        "transition_matrix": EYE, "F": EYE, "Q": EYE, "H": EYE, "R": EYE, "m0": ZERO, "P0": EYE
    },
    mpfjax.per_particle: {"model": DriftOfOne()},
    mpfjax.GaussNewtonProposal: {"model": MODEL},
    mpfjax.RegimeProposal: {"model": SWITCHING},
    Resample: {"particles_per_component": 2},
    mpfjax.AuxiliaryResample: {
        "resample": Resample(), "lookahead": mpfjax.GaussNewtonProposal(MODEL)
    },
    mpfjax.GaussianRegeneration: {"particles_per_component": 2},
    KMeans: {}, Merge: {"max_distance": 2.0}, mpfjax.Split: {},
    mpfjax.RandomPartition: {"num_sets": 2},
    mpfjax.GroupBy: {"function": nothing},
    mpfjax.Prune: {},
    Exclusion: {"strength": 1.0, "radius": 0.5},
    mpfjax.Every: {"num_steps": 2, "moves": [KMeans(1)]},
    IslandInteraction: {},
    Propagate: {"model": MODEL}, Predict: {"model": MODEL}, Reweight: {"model": MODEL},
    mpfjax.PropagateMarginalised: {"model": SWITCHING},
    mpfjax.PropagateRegimes: {"model": SWITCHING},
    mpfjax.RandomWalkMetropolis: {"model": MODEL},
    mpfjax.MetropolisAdjustedLangevin: {"model": MODEL},
    mpfjax.PropagateNested: {"propagate": Propagate(MODEL), "num_draws": 2},
    mpfjax.PropagateTempered: {"model": MODEL, "resample": Resample(), "exponents": (0.1, 1.0)},
    mpfjax.Partitioned: {"model": JOINT},
    PropagateIndependently: {"model": JOINT},
    PropagateInClusters: {"model": JOINT},
    SelectInitial: {"propagation": Propagate(MODEL), "num_draws": 2},
    Filter: {"model": MODEL, "moves": [Propagate(MODEL)], "num_particles": 4},
    mpfjax.with_selected_start: {"filter": FILTER, "num_draws": 2},
    mpfjax.with_proposals_per_particle: {"filter": FILTER, "num_draws": 2},
    mpfjax.with_lookahead: {"filter": FILTER},
    mpfjax.with_point_sets: {"filter": FILTER},
    mpfjax.with_score_gradient: {"filter": FILTER},
    mpfjax.with_resampling: {"filter": FILTER, "resample": Resample()},
    mpfjax.particle_filter: {"model": MODEL, "num_particles": 4},
    mpfjax.auxiliary_particle_filter: {
        "model": MODEL, "num_particles": 4, "lookahead": mpfjax.GaussNewtonProposal(MODEL)
    },
    mpfjax.mixture_particle_filter: {"model": MODEL, "num_particles": 4, "max_components": 2},
    mpfjax.gaussian_particle_filter: {"model": MODEL, "num_particles": 4},
    mpfjax.gaussian_mixture_particle_filter: {
        "model": MODEL, "num_particles": 4, "max_components": 2
    },
    mpfjax.partitioned_sampling: {"model": JOINT, "num_particles": 4},
    mpfjax.distributed_partitioned_sampling: {"model": JOINT, "num_particles": 4},
    mpfjax.independent_particle_filters: {"model": JOINT, "num_particles": 4},
    mpfjax.clustered_particle_filter: {"model": JOINT, "num_particles": 4},
    mpfjax.run_filter: {"key": KEY, "filter": FILTER, "observations": TWO, "collect": nothing},
    mpfjax.monte_carlo: {
        "keys": KEY[None], "filter": FILTER, "observations": TWO, "collect": nothing
    },
    mpfjax.run_islands: {
        "key": KEY, "filter": FILTER, "observations": TWO, "collect": nothing, "num_islands": 2
    },
    mpfjax.Study: {
        "filters": {"pf": lambda num_particles: FILTER}, "num_particles": [4], "keys": KEY[None],
        "observations": TWO,
    },
    mpfjax.forecast: {"key": KEY, "filter": FILTER, "mixture": MIXTURE, "num_steps": 2},
    smoothing.sample_trajectories: {
        "key": KEY, "model": MODEL, "mixtures": HISTORY, "num_trajectories": 2
    },
    smoothing.smoothed_sums: {
        "key": KEY, "filter": FILTER, "observations": TWO, "function": difference
    },
    smoothing.conditional_filter: {
        "key": KEY, "filter": FILTER, "observations": TWO,
        "trajectory": np.ones(3, np.float32),
    },
}  # fmt: skip
RUNNERS = tuple(list(GOOD)[-7:])
FRAME = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
BOXES = np.array([[5.0, 5, 10, 20], [20, 10, 10, 15]])
ROWS = np.array([[1.0, 1, 2, 2, 5, 5], [2, 1, 2, 2, 5, 5]])
SETS = {"estimates": np.ones((2, 2)), "truths": np.ones((3, 2)), "cutoff": 3.0}
TRACKER = vision.ObjectTracker(2)
# Those that boxes and frames come to, of which only the annotated arguments are tried.
WITH_BOXES = {
    vision.ObjectTracker: {},
    vision.RGBColours: {},
    vision.HSVColours: {},
    vision.BackgroundSubtraction: {},
    vision.ColourModel.from_frame: {"frame": FRAME, "boxes": BOXES},
    vision.joint_colour_model: {"frame": FRAME, "boxes": BOXES},
    vision.follow_boxes: {"frames": [FRAME], "boxes": BOXES},
    vision.track: {"frames": None, "detections": np.zeros((0, 7))},
    metrics.ospa: SETS,
    metrics.gospa: SETS,
    metrics.crps: {"values": np.ones(5), "weights": np.ones(5), "observations": np.ones(())},
    metrics.modes_represented: {
        "positions": np.ones(5),
        "occupied": np.ones(5, bool),
        "modes": TWO,
        "radius": 0.3,
    },
    metrics.mass_above: {"mixture": MIXTURE, "threshold": 0.5},
    metrics.log_score: {"model": MODEL, "mixture": MIXTURE, "observation": 1.0},
    metrics.tracking_quality: {"estimates": np.ones((2, 3, 1, 4)), "truth": np.ones((3, 1, 4))},
    metrics.multi_object_scores: {"tracks": ROWS, "truth": ROWS},
}
# What an argument is called further down.
ALSO = {"max_components": "num_components", "order": "orders", "object_model": "model"}


def arguments_of(function):
    """By name, the parameters of a call, without those of insiders."""
    parameters = inspect.signature(function).parameters.values()
    return [parameter for parameter in parameters if not parameter.name.startswith("_")]


NUMBERS = (
    (checks.Count, (0, -1, 2.5, 2.0, True, None, "3", 2**31, jnp.array(3)), (1, np.int64(5))),
    (checks.Positive, (0, -1.0, NAN, INFINITY, True, None, "1", [1.0]), (1, np.float32(2.0))),
    (checks.NotNegative, (-1e-9, NAN, INFINITY, False, None), (0, 1.5)),
    (checks.Finite, (NAN, -INFINITY, 1j, None), (-1.5, 0)),
    (Annotated[float, checks.share(0.5)], (-0.1, 0.6, NAN, None, "0"), (0, np.float64(0.25))),
    (checks.InnerShare, (0, 1, -0.1, NAN, True, None), (0.5, np.float32(0.1))),
    (checks.Exponent, (0, 1.1, NAN, None), (0.5, 1)),
    (bool, (0, 1.0, None, "yes"), (True, np.bool_(False))),
    (checks.Count | None, (0, "3"), (None, 2)),
)


@pytest.mark.parametrize(("kind", "refused", "accepted"), NUMBERS)
def test_a_rule_refuses_and_lets_pass(kind, refused, accepted):
    @checks.checked
    def call(size: kind):
        return size

    for value in refused:
        with pytest.raises(ValueError, match=r"^size: "):
            call(value)
    assert [call(value) for value in accepted] == list(accepted)


def refusals(function):
    """(name, value) for each value of `BAD` that the annotation of an argument rules out."""
    for name, rule in checks._rules(function).items():
        for value in BAD if not name.startswith("_") else ():
            try:
                rule.check(value, name)
            except ValueError:
                yield name, value


@pytest.mark.parametrize("function", GOOD | WITH_BOXES, ids=lambda function: function.__name__)
def test_what_an_annotation_rules_out_is_refused_by_name(function):
    good = (GOOD | WITH_BOXES)[function]
    assert function(**good) is not None
    defaults = {parameter.name: parameter.default for parameter in arguments_of(function)}
    for name, value in refusals(function):
        if name in defaults and value is not defaults[name]:
            with pytest.raises(ValueError, match=rf"^{name}: "):
                function(**good | {name: value})


def test_every_public_call_is_tried():
    public = {name for name, value in vars(mpfjax).items() if callable(value)}
    tried = {function.__name__ for function in GOOD}
    others = {name for name in public - tried if not name.startswith(("_", "Abstract"))}
    # Records of results, what takes no argument to check, and what other tests are about.
    assert others == {
        "FilterRun", "StepInfo", "Series", "Checkpoint", "ParticleMixture", "Pool",
        "load_checkpoint", "save_checkpoint", "normal", "read_study", "run_study",
        "NetworkProposal", "keep_programs", "check_model", "map_moves",
    }  # fmt: skip


numbers = st.one_of(st.integers(-3, 6), st.floats(width=32), st.floats())
values = st.one_of(
    st.sampled_from(BAD),
    numbers,
    st.lists(numbers, max_size=3),
    st.lists(st.lists(st.floats(-2, 2), min_size=1, max_size=2), max_size=2),
    st.lists(numbers, max_size=3).map(np.array),
)
BUILDERS = [function for function in GOOD if function not in RUNNERS]


@st.composite
def calls(draw, functions):
    """A function, the arguments of a call, and the names of those that are hostile."""
    function = draw(st.sampled_from(functions))
    names = sorted(parameter.name for parameter in arguments_of(function))
    changed = draw(st.lists(st.sampled_from(names), min_size=1, max_size=2, unique=True))
    return function, GOOD[function] | {name: draw(values) for name in changed}, changed


def works_or_is_named(function, arguments, changed):
    """Whether the call works; where it does not, the error names one of the changed arguments."""
    try:
        function(**arguments)
        return True
    except (ValueError, TypeError) as error:
        message = "\n".join([str(error), *getattr(error, "__notes__", [])])
    except RuntimeError as error:  # broken densities, which are found as the filter runs
        message = str(error)
        changed = [*changed, "observation", "density"]
    names = {name for argument in changed for name in (argument, ALSO.get(argument, argument))}
    assert any(re.search(rf"\b{name}\b", message) for name in names), (
        f"{function.__name__} {changed}: {message}"
    )
    return False


unhurried = functools.partial(
    settings,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@unhurried(max_examples=500)
@given(calls(BUILDERS))
def test_constructors_work_or_name_the_argument(call):
    works_or_is_named(*call)


@unhurried(max_examples=60)
@given(calls(RUNNERS))
def test_runners_work_or_name_the_argument(call):
    works_or_is_named(*call)


@pytest.mark.weekly
def test_a_hundred_thousand_constructors():
    found = collections.Counter()

    @unhurried(max_examples=100_000)
    @given(calls(BUILDERS))
    def check(call):
        found[works_or_is_named(*call)] += 1

    check()
    print(dict(found))


def wrong(**methods):
    """A model of a scalar with some of its methods replaced."""
    good = {
        "sample_initial": lambda self, key, n: jnp.zeros(n),
        "sample_transition": lambda self, key, states: states,
        "log_likelihood": lambda self, observation, states: -states,
    }
    return type("Wrong", (mpfjax.AbstractStateSpaceModel,), good | methods)()


def run(filter, observations=TWO, **options):
    return mpfjax.run_filter(KEY, filter, observations, **options)


def run_of(model, observations=TWO, **options):
    return run(mpfjax.particle_filter(model, 10, **options), observations)


class Plain(mpfjax.AbstractProposal):
    """A proposal that is not made of noise."""

    def propose(self, key, observation, previous_states):
        return previous_states, jnp.zeros(len(previous_states))


class Nothing(mpfjax.AbstractStateSpaceModel):
    """A model that cannot move its states."""

    def sample_initial(self, key, num_particles):
        return jnp.zeros(num_particles)

    def log_likelihood(self, observation, states):
        return -states


class Nine(Drift):
    """Nine coordinates are more than a Hilbert curve goes through."""

    def sample_initial(self, key, num_particles):
        return jnp.zeros((num_particles, 9))


class Parts(mpfjax.AbstractConditionallyLinearModel):
    """One of its parts may be wrong; its latent has no density, and is not made of noise."""

    F: np.ndarray = eqx.field(default_factory=lambda: EYE)
    b: np.ndarray = eqx.field(default_factory=lambda: ZERO)
    R: np.ndarray = eqx.field(default_factory=lambda: EYE)
    P0: np.ndarray = eqx.field(default_factory=lambda: EYE)

    def sample_initial(self, key, num_particles):
        return jnp.zeros(num_particles)

    def sample_transition(self, key, latent):
        return latent

    def initial_moments(self, latent):
        return jnp.zeros(1), self.P0

    def dynamics(self, latent, previous_latent):
        return self.F, self.b, EYE

    def emission(self, latent):
        return EYE, ZERO, self.R


def changed(kind, name, value=lambda self, key, states: states):
    """A model of this kind, of which a subclass of the user's has another attribute."""
    return type("Changed", (kind,), {name: value})()


def odd(dimension):
    return changed(Drift, "noise_dimension", dimension)


def conditional(filter):
    return smoothing.conditional_filter(KEY, filter, TWO, np.ones(3, np.float32))


def after(change):
    """A run of a filter with a move of the user's that does this to the mixture."""
    return run(Filter(MODEL, [Propagate(MODEL), lambda key, m, y: change(m)], 4))


DETECTIONS = vision.Detections.from_boxes(BOXES, 2)


def tracked(detections, frames=(FRAME, FRAME), **options):
    return list(vision.track(frames, detections, TRACKER, use_colours=False, **options))


# By room: words of the message, and the call.
REFUSED = (
    # filters and moves
    ("num_particles: 3 is less than num_components, 4",
     lambda: mpfjax.mixture_particle_filter(MODEL, 3, 4)),
    ("particles_per_component: 20 for each of 10",
     lambda: mpfjax.with_resampling(
         mpfjax.mixture_particle_filter(MODEL, 199, 10), Resample(particles_per_component=20))),
    ("moves: ", lambda: Filter(MODEL, [], 10)),
    *(
        (r"moves: \w+.* never weigh the particles", lambda moves=moves: Filter(MODEL, moves, 10))
        for moves in ([Resample()], [Resample(), Predict(MODEL), KMeans(), mpfjax.Prune()])
    ),
    ("max_deviations, max_distance: ", lambda: Merge(None)),
    ("scale: 2 units for 1 features",
     lambda: mpfjax.mixture_particle_filter(MODEL, 20, 2, scale=[1.0, 2.0]).init(KEY)),
    ("share_by: groups have no effect",
     lambda: Resample(particles_per_component=2, share_by=nothing)),
    ("moves: there must be at least one", lambda: mpfjax.Every(2, [])),
    ("moves: .* is not a list of moves", lambda: mpfjax.Every(2, KMeans())),
    ("moves: (?s:.*) neither regroups, resamples nor",
     lambda: mpfjax.Every(2, [KMeans(), Propagate(MODEL)])),
    ("moves: the memory 'every 2: KMeans' is kept by 2",
     lambda: FILTER.replace(
         moves=[*FILTER.moves, *(mpfjax.Every(2, [KMeans(k)]) for k in (1, 2))])),
    *(
        ("function: it returned", lambda f=function: mpfjax.GroupBy(f)(KEY, MIXTURE))
        for function in (lambda states: states, lambda states: jnp.zeros(2, jnp.int32), len)
    ),
    ("num_sets: 7 is more than num_components",
     lambda: mpfjax.RandomPartition(7).regroup(KEY, MIXTURE)),
    *(
        (words, lambda v=value: mpfjax.AuxiliaryResample(Resample(), lambda y, states: v)(
            KEY, MIXTURE, 1.0))
        for words, value in (
            ("lookahead: it returned 3.0", 3.0), (r"lookahead: .* shape \(2,\)", jnp.zeros(2)))
    ),
    ("lookahead: None", lambda: mpfjax.auxiliary_particle_filter(MODEL, 20, None)),
    ("importance: .* draws from no proposal",
     lambda: mpfjax.gaussian_particle_filter(
         MODEL, 5, importance="predictive_gaussian", proposal=mpfjax.GaussNewtonProposal(MODEL))),
    *(
        (words, lambda c=change: c(mpfjax.independent_particle_filters(JOINT, 8)))
        for words, change in (
            ("filter: none of its moves is a Resample", mpfjax.with_lookahead),
            ("filter: x_0 is chosen where", lambda f: mpfjax.with_selected_start(f, 2)),
            ("filter: each particle draws where",
             lambda f: mpfjax.with_proposals_per_particle(f, 2)),
            (r"slots: Propagate\w+ fills every slot",
             lambda f: mpfjax.monte_carlo(KEY[None], f, TWO, slots=60)),
        )
    ),
    (r"slots: 3 is .* N, 4", lambda: mpfjax.monte_carlo(KEY[None], FILTER, TWO, slots=3)),
    ("(?s)moves: .* returned None, no ParticleMixture", lambda: after(lambda m: None)),
    ("(?s)moves: .* in PyTreeDef.*x.*, and was given",
     lambda: after(lambda m: m.replace(particles={"x": m.particles}))),
    ("(?s)moves: .* log_weights of float16",
     lambda: after(lambda m: m.replace(log_weights=m.log_weights.astype(jnp.float16)))),
    # observations
    ("observations: the leading axis t is empty", lambda: run(FILTER, jnp.zeros((0,)))),
    (r"observations: shapes .* jnp.asarray\(observations\)", lambda: run(FILTER, [0.0, 1.0])),
    ("observations: shapes", lambda: run(FILTER, {"a": jnp.zeros(3), "b": jnp.zeros(4)})),
    ("observations: there are none", lambda: run(FILTER, {})),
    ("observations: NaN or infinite at index 1", lambda: run(FILTER, np.array([0.0, NAN, 1.0]))),
    ("observations: complex128 is complex", lambda: run(FILTER, np.array([0.0, 1j]))),
    (r"observations: 1e\+300 is more than float32", lambda: run(FILTER, np.array([0.0, 1e300]))),
    ("missing: 'ignore'", lambda: run(FILTER, missing="ignore")),
    (r"observation: shape \(2,\)", lambda: run(FILTER, jnp.zeros((3, 2)))),
    ("observation: complex64 is complex", lambda: FILTER.step(KEY, MIXTURE, jnp.array(1j))),
    # models
    ("model: .* is a class; write QuadraticModel",
     lambda: mpfjax.particle_filter(mpfjax.QuadraticModel, 10)),
    ("model: DriftOfOne.sample_initial.*per_particle",
     lambda: mpfjax.particle_filter(DriftOfOne(), 10)),
    *(
        ("model: Wrong.sample_initial returned",
         lambda s=states: run_of(wrong(sample_initial=lambda self, key, n: s)))
        for states in (None, {}, 0.0, jnp.zeros((3, 10)))
    ),
    *(
        ("model: Wrong.sample_transition returned",
         lambda f=moved: run_of(wrong(sample_transition=lambda self, key, states: f(states))))
        for moved in (jnp.int32, lambda states: states[:, None], lambda states: {"x": states})
    ),
    *(
        ("model: Wrong.log_likelihood returned",
         lambda v=values: run_of(wrong(log_likelihood=lambda self, y, states: v)))
        for values in (None, 0.0, jnp.zeros((10, 1)), jnp.zeros(10, jnp.complex64))
    ),
    (r"model: Wrong.log_transition returned shape \(3,\)",
     lambda: run_of(
         wrong(log_transition=lambda self, states, previous: jnp.zeros(3)), gradient="stop")),
    # how models' arrays fit together, and exact answers
    (r"Q: shape \(2, 2\) is not \(d, d\)",
     lambda: mpfjax.LinearGaussianModel(**LINEAR | {"Q": np.eye(2)})),
    ("b: shape", lambda: mpfjax.SwitchingLinearGaussianModel(*[EYE] * 5, ZERO, EYE, b=np.ones(2))),
    ("transition_matrix: .* do not sum to one",
     lambda: mpfjax.SwitchingLinearGaussianModel(0.6 * EYE, *[EYE] * 4, ZERO, EYE)),
    *(
        (f"(?s)Q: .* {what}",
         lambda Q=Q: mpfjax.SwitchingLinearGaussianModel(
             EYE, np.eye(2), Q, np.eye(2), np.eye(2), np.zeros(2), np.eye(2)))
        for Q, what in (
            ([[1, 0.5], [0, 1]], "not symmetric"), ([[1, 2], [2, 1]], "negative eigenvalue"))
    ),
    ("A2: shape", lambda: mpfjax.Autoregression(EYE, np.eye(2), EYE, ZERO)),
    ("jump_deviations: shape", lambda: mpfjax.RandomWalkWithJumps([1.0], [[5.0]])),
    ("initial_velocity: shape",
     lambda: mpfjax.WalkWithVelocity(mpfjax.RandomWalk([1.0]), 0.1, [1.0, 1.0])),
    ("gain: .* is not one or 1",
     lambda: mpfjax.WalkWithVelocity(mpfjax.RandomWalk([1.0]), [0.1] * 3)),
    ("high: 1.0 is not above low", lambda: mpfjax.QuadraticModel(low=1.0, high=1.0)),
    ("interaction: .* cannot be simulated",
     lambda: mpfjax.MultiObjectModel(MODEL, 2, difference).simulate(KEY, 2)),
    (r"observations: shape \(2,\) is not \(t, 1\)",
     lambda: mpfjax.exact.kalman_filter(mpfjax.LinearGaussianModel(**LINEAR), TWO)),
    ("model: .* is not a LinearGaussianModel", lambda: mpfjax.exact.kalman_smoother(MODEL, TWO)),
    ("log_initial: shape",
     lambda: mpfjax.exact.grid_filter(MODEL, TWO, np.linspace(-1, 1, 9), TWO)),
    ("model: Switching.* conditionally linear",
     lambda: mpfjax.exact.grid_filter(SWITCHING, TWO[:, None], np.linspace(-1, 1, 9))),
    # scores
    ("estimate_mask: shape", lambda: metrics.ospa(**SETS, estimate_mask=np.ones(3, bool))),
    ("weights: shape", lambda: metrics.crps(np.ones((2, 3)), np.ones((2, 4)), TWO)),
    (r"observations: shape \(3,\) is not \(2,\)",
     lambda: metrics.crps(np.ones((2, 3)), np.ones((2, 3)), np.ones(3))),
    ("occupied: shape", lambda: metrics.modes_represented(np.ones(5), np.ones(4, bool), TWO, 0.3)),
    ("mixture: particles of shapes",
     lambda: metrics.mass_above(MIXTURE.replace(particles=jnp.ones((4, 2))), 0.5)),
    ("mixture: particles of shapes", lambda: metrics.uniqueness(MIXTURE)),
    ("truth: shape",
     lambda: metrics.tracking_quality(np.ones((2, 3, 1, 4)), np.ones((2, 1, 4)))),
    ("truth: there are no true boxes", lambda: metrics.multi_object_scores(ROWS, ROWS, (5, 9))),
    ("frames: 2, the last",
     lambda: metrics.multi_object_scores(ROWS, ROWS, (3, 2))),
    ("tracks: id 1 has more than one box in frame 1",
     lambda: metrics.multi_object_scores(ROWS[[0, 1, 0]], ROWS)),
    ("truth: holds numbers that are not finite",
     lambda: metrics.multi_object_scores(ROWS, ROWS + INFINITY)),
    ("track_states: shape",
     lambda: metrics.tracking_quality(np.ones((0, 3, 1, 4)), np.ones((3, 1, 4)))),
    # frames, boxes and detections
    *(
        ("boxes: .*" + words, lambda boxes=boxes: vision.ColourModel.from_frame(FRAME, boxes))
        for words, boxes in (
            ("there are none", []), ("no area", [[5, 5, 0, 5]]), ("not finite", [[NAN, 5, 9, 9]]),
            ("outside the first frame, 50 x 40", [[-9, 10, 9, 9]]), ("no rows of 4", [[1, 2, 3]]),
        )
    ),
    *(
        ("frame: ", lambda frame=frame: vision.ColourModel.from_frame(frame, BOXES))
        for frame in (None, FRAME[:, :, 0], FRAME[:0], FRAME.astype(float), FRAME[:, :, :1])
    ),
    ("deviations: ", lambda: vision.joint_colour_model(FRAME, BOXES, deviations=(0.0, 1, 1, 1))),
    ("dynamics: parameters for",
     lambda: vision.ColourModel.from_frame(
         FRAME, BOXES, dynamics=mpfjax.RandomWalk(np.ones((3, 4))))),
    ("templates: 2 is none of the 2 objects",
     lambda: vision.joint_colour_model(FRAME, BOXES, templates={2: (FRAME, BOXES[0])})),
    ("templates: of object 0",
     lambda: vision.joint_colour_model(FRAME, BOXES, templates={0: (None, BOXES[0])})),
    ("detections: ", lambda: TRACKER.step(None, TRACKER.init(), None, BOXES)),
    ("state: ", lambda: TRACKER.step(None, None, None, DETECTIONS)),
    ("frame: float", lambda: TRACKER.look(FRAME.astype(float), DETECTIONS)),
    ("boxes: shape", lambda: vision.Detections.from_boxes(BOXES[0], 2)),
    ("boxes: .* no area", lambda: vision.Detections.from_boxes(BOXES * 0, 2)),
    ("boxes: .*float32.*origin", lambda: vision.Detections.from_boxes([[5e6, 5e6, 0.6, 1.8]], 2)),
    ("scores: shape", lambda: vision.Detections.from_boxes(BOXES, 2, np.ones(3))),
    ("labels: .*whole numbers from 0",
     lambda: vision.Detections.from_boxes(BOXES, 2, labels=np.array([-1, 1]))),
    *(
        (f"detections: {words}", lambda found=found: tracked(lambda frame: found))
        for words, found in (
            ("frame 1: .* not finite", [[1.0, NAN, 3, 4]]), ("frame 1: None is no array", None),
            ("frame 1: scores .* not finite", (BOXES, [NAN, 1])), ("frame 1: float64", [[1.0, 2]]),
            ("frame 1: 1 scores for 2", (BOXES, [1.0])), ("frame 1: 'boxes'", "boxes"),
            ("frame 1: scores .* masked", (BOXES, np.ma.masked_array([1.0, 2], [True, False]))),
        )
    ),
    ("detections: end before the frames do, at frame 2", lambda: tracked([BOXES])),
    ("detections: row 1, .* is not finite", lambda: tracked(ROWS * [[1], [NAN]])),
    ("detections: 3 is neither", lambda: tracked(3)),
    ("detections: shape", lambda: tracked(ROWS[:, :5])),
    ("a detector needs frames", lambda: vision.track(None, len)),
    ("min_score: .* no scores", lambda: tracked([BOXES] * 2, min_score=0.5)),
    ("camera_motion: 'pixels' needs", lambda: vision.track(None, ROWS, camera_motion="pixels")),
    ("frames: frame 2 is 50 x 30", lambda: tracked([BOXES] * 2, [FRAME, FRAME[:30]])),
    ("frames: float64 is not uint8", lambda: tracked([BOXES], [FRAME.astype(float)])),
    ("by_reference: ", lambda: vision.track_rows([Snapshot(0, 0, 0, 0)], by_reference=True)),
    ("area: .* is not a range", lambda: vision.BackgroundSubtraction(area=(0.2, 0.1))),
    ("frames: there are none", lambda: vision.BackgroundSubtraction().learn([])),
    (r"rows: .* is not frame,id", lambda: vision.write_tracks("/nowhere", [[0, 1, 5, 5, 9, 9]])),
    ("first, last: 4, 2", lambda: vision.read_frames(".", 4, 2)),
    ("path: .* ends in neither", lambda: vision.write_video("/nowhere/a.avi", [FRAME])),
    ("format: 'coco'", lambda: vision.read_truth("/nowhere", format="coco")),
    # runs and studies
    ("slots: 3 is no whole number of at least N, 4",
     lambda: mpfjax.monte_carlo(KEY[None], FILTER, TWO, slots=3)),
    *(
        (words, lambda changes=changes: mpfjax.Study(**GOOD[mpfjax.Study] | changes))
        for words, changes in (
            ("filters: pf: Filter", {"filters": {"pf": FILTER}}),
            ("num_particles: 8 are no values", {"num_particles": 8}),
            (r"num_particles: \[8, 8\] is empty or has the same", {"num_particles": [8, 8]}),
            ("num_particles: 8.5 is not a whole number", {"num_particles": [8.5]}),
            ("settings: 'filter' is a name", {"settings": {"filter": [1]}}),
            ("noise: .* no number or string; name it", {"settings": {"noise": [ZERO]}}),
        )
    ),
    # propagation, several objects, look-ahead
    *(
        (words, lambda model=model, options=options: Propagate(model, **options))
        for model, options, words in (
            (wrong(), {"gradient": "stop"}, "Wrong defines no log_transition, which gradient="),
            (wrong(), {"noise": "rqmc"}, "model: Wrong defines no transition_from_noise"),
            (wrong(), {"proposal": Plain()}, "Wrong defines no log_transition, which proposal"),
            (MODEL, {"proposal": Plain(), "noise": "rqmc"}, "Plain defines no propose_from_noise"),
            *((odd(d), {"noise": "rqmc"}, "noise_dimension") for d in (0, 2.0, 65, None)),
        )
    ),
    ("inherits its transition_from_noise, which noise='rqmc' needs",
     lambda: Propagate(changed(mpfjax.QuadraticModel, "sample_transition"), noise="rqmc")),
    ("model: Nothing defines no sample_transition, nor transition_from_noise",
     lambda: mpfjax.particle_filter(Nothing(), 8)),
    ("sort_by: 9 coordinates", lambda: run(mpfjax.particle_filter(Nine(), 8, noise="rqmc"))),
    ("model: Wrong defines no transition_mean", lambda: mpfjax.GaussNewtonProposal(wrong())),
    ("propagate: gradient 'stop'",
     lambda: mpfjax.PropagateNested(Propagate(MODEL, gradient="stop"))),
    ("filter: PropagateNested cannot keep a trajectory",
     lambda: conditional(mpfjax.with_proposals_per_particle(FILTER, 2))),
    ("filter: .* not noise='rqmc'", lambda: conditional(mpfjax.with_point_sets(FILTER))),
    *(
        ("exponents: .* do not rise", lambda e=e: mpfjax.PropagateTempered(MODEL, exponents=e))
        for e in ((0.5, 0.2, 1.0), (0.1, 0.5), (), (NAN, 1.0), (0.0, 1.0))
    ),
    ("resample: sort_by", lambda: mpfjax.PropagateTempered(MODEL, Resample(sort_by="hilbert"))),
    ("transition_from_noise, which PropagateTempered", lambda: mpfjax.PropagateTempered(wrong())),
    ("comes before any propagation: there is no x_t yet",
     lambda: run(Filter(MODEL, [mpfjax.RandomWalkMetropolis(MODEL), Propagate(MODEL)], 4))),
    *(
        (f"{type(between).__name__} leaves no particle one parent", lambda between=between: Filter(
            MODEL, [Propagate(MODEL), mpfjax.Every(2, [between]),
                    mpfjax.RandomWalkMetropolis(MODEL)], 4))
        for between in (IslandInteraction(), mpfjax.GaussianRegeneration())
    ),
    *(
        ("model: .* is conditionally linear", lambda make=make: make(SWITCHING))
        for make in (
            mpfjax.PropagateTempered, lambda model: Reweight(model, 0.5),
            lambda model: mpfjax.MultiObjectModel(model, 2),
            lambda model: mpfjax.gaussian_particle_filter(model, 10),
        )
    ),
    ("Parts defines no all_transitions", lambda: mpfjax.PropagateRegimes(Parts())),
    ("Parts defines no log_transition",
     lambda: mpfjax.PropagateMarginalised(Parts(), gradient="stop")),
    (r"observation: shape \(2,\)", lambda: run_of(Parts(), observations=np.ones((2, 2)))),
    *(
        (f"model: Parts.{method} returned", lambda own=own: run_of(Parts(**own)))
        for method, own in (
            ("dynamics", {"F": EYE[0]}), ("dynamics", {"b": np.zeros(2)}),
            ("emission", {"R": ZERO}),
            ("initial_moments", {"P0": np.ones((1, 2))}),
        )
    ),
    *(
        ("order: ", lambda order=order: mpfjax.partitioned_sampling(JOINT, 10, order))
        for order in ((0, 0), (0,), (1, 2), (0.5, 1.0), (), "circular", [(0, 1), (1, 0)])
    ),
    *(
        ("orders: ", lambda o=o: mpfjax.distributed_partitioned_sampling(JOINT, 10, o))
        for o in ([(0, 1), (1, 1)], [(0, 1), (1,)], "alphabetic")
    ),
    ("orders: 2 of them, for 1 components",
     lambda: run(Filter(JOINT, [mpfjax.Partitioned(JOINT, [(0, 1), (1, 0)])], 4))),
    ("num_particles: 1 is less than num_components, 2",
     lambda: mpfjax.distributed_partitioned_sampling(JOINT, 1)),
    *(
        ("mixture: 2 components, not one",
         lambda move=move: run(Filter(JOINT, [move(JOINT)], 4, 2)))
        for move in (PropagateInClusters, PropagateIndependently)
    ),
    ("Wrong defines no log_transition, which PropagateInClusters",
     lambda: mpfjax.clustered_particle_filter(
         mpfjax.MultiObjectModel(wrong(), 2, mpfjax.PairwiseRepulsion(1.0, 1.0)), 4)),
    ("Wrong defines no log_transition, which gradient=",
     lambda: run(mpfjax.with_score_gradient(mpfjax.partitioned_sampling(
         mpfjax.MultiObjectModel(wrong(), 2, shared_observation=True), 4)))),
    ("transition_from_noise, which PilotLookahead needs",
     lambda: mpfjax.with_lookahead(mpfjax.particle_filter(wrong(), 4))),
    *(
        (f"filter: .*{words}", lambda moves=moves: smoothing.learn_lookahead(
            KEY, Filter(MODEL, moves, 4), TWO))
        for words, moves in (
            ("cannot look ahead", [mpfjax.GaussianRegeneration(), Propagate(MODEL)]),
            ("cannot look ahead", [Resample(), Predict(MODEL), Reweight(MODEL)]),
            ("its moves need one Resample", [Propagate(MODEL)]),
        )
    ),
)  # fmt: skip


SCALAR = ScalarLinear()
OF_SCALAR = mpfjax.particle_filter(SCALAR, 4)
GAUSSIAN = mpfjax.gaussian_particle_filter(SCALAR, 4)
ONE_OF_TWO = mpfjax.run_filter(KEY, Filter(MODEL, [Propagate(MODEL)], 4, 2), TWO)
OF_SWITCHING = mpfjax.particle_filter(SWITCHING, 4)
RUN_OF_SWITCHING = mpfjax.run_filter(KEY, OF_SWITCHING, TWO[:, None])


def paths(run=HISTORY, model=MODEL, **options):
    return smoothing.sample_trajectories(KEY, model, run, 2, **options)


def around(filter=FILTER, trajectory=THREE, observations=TWO):
    return smoothing.conditional_filter(KEY, filter, observations, trajectory)


def sums(function=difference, filter=FILTER, observations=TWO):
    return smoothing.smoothed_sums(KEY, filter, observations, function)


REFUSED += (
    # smoothing
    ("observations: a conditionally linear", lambda: paths(RUN_OF_SWITCHING, SWITCHING)),
    ("observations: a conditionally linear", lambda: paths(observations=TWO)),
    ("observations: .3. steps",
     lambda: paths(RUN_OF_SWITCHING, SWITCHING, observations=np.ones((3, 1), np.float32))),
    ("component: 2 is not one of 2", lambda: paths(ONE_OF_TWO, component=2)),
    ("component: 1 is dead", lambda: paths(ONE_OF_TWO, component=1)),
    ("num_steps: 3 does nothing", lambda: paths(num_steps=3)),
    ("Batched defines no log_transition", lambda: paths(model=Batched())),
    ("mixtures: these are not all", lambda: paths(HISTORY.final)),
    ("mixtures: these are not all",
     lambda: smoothing.trace_ancestors(run(FILTER, collect=lambda mixture: mixture.mean()))),
    (r"trajectory: float32\[4\] .* is not float32\[3\]", lambda: around(trajectory=np.ones(4))),
    ("trajectory: .* is not", lambda: around(trajectory={"x": np.ones(3)})),
    ("trajectory: complex128 is complex", lambda: around(trajectory=np.ones(3, complex))),
    ("Batched defines no log_transition", lambda: around(mpfjax.particle_filter(Batched(), 4))),
    ("filter: .*not noise='rqmc'",
     lambda: around(Filter(SCALAR, [Resample(), Propagate(SCALAR, noise="rqmc")], 4))),
    ("filter: .*one Propagate or Predict", lambda: around(Filter(MODEL, [Reweight(MODEL)], 4))),
    ("filter: Partitioned cannot keep", lambda: around(mpfjax.partitioned_sampling(JOINT, 4))),
    ("filter: GaussianRegeneration cannot keep", lambda: around(GAUSSIAN)),
    ("conditionally linear, and conditional_filter", lambda: around(OF_SWITCHING)),
    ("conditionally linear, and smoothed_sums", lambda: sums(filter=OF_SWITCHING)),
    ("conditionally linear, and particle_gibbs",
     lambda: tuning.particle_gibbs(KEY, OF_SWITCHING, TWO[:, None], 2, log_prior=flat)),
    *(
        ("filter: .* is approximate or draws in a way of its own",
         lambda filter=filter: smoothing.with_first_ancestors(filter))
        for filter in (
            mpfjax.distributed_partitioned_sampling(JOINT, 4),
            Filter(MODEL, [Propagate(MODEL), lambda key, mixture, y: mixture], 4),
        )
    ),
    *(
        (r"filter: (scheme|noise|initial_noise) of \w+ is '",
         lambda filter=filter: smoothing.with_first_ancestors(filter))
        for filter in (
            OF_SCALAR, mpfjax.particle_filter(SCALAR, 4, scheme="multinomial", noise="rqmc"),
            Filter(SCALAR, [mpfjax.Every(2, [Resample("stratified")]), Propagate(SCALAR)], 4),
        )
    ),
    ("run: its filter keeps no first ancestors",
     lambda: log_marginal_likelihood_variance(HISTORY)),
    ("runs: 1; a standard error asks for 4", lambda: batch_estimate(HISTORY, nothing)),
    *(
        ("function: it returned", lambda function=function: sums(function))
        for function in (lambda x, y: x[:3], lambda x, y: y.sum(), lambda x, y: ())
    ),
    ("simulate_observation: it returned",
     lambda: mpfjax.forecast(KEY, FILTER, MIXTURE, 2, simulate_observation=lambda k, x: x[:3])),
)  # fmt: skip


ASCENT = optax.sgd(0.1)


class Bare(eqx.Module):
    a: float = 0.5


def flat(parameters):
    return sum(0.0 * value for value in parameters.values())


def draw_one(key, trajectory, observations, model):
    return {"a": 1.0}


OF_A = {"parameters": {"a": lambda filter: filter.model.a}, "progress": False}
LABELS = (TWO, TWO[:, None], TWO[:, None, None])


def chain(filter=OF_SCALAR, **options):
    options = {"log_prior": flat} | OF_A | options
    return tuning.metropolis_hastings(KEY, filter, TWO, 4, **options)


def gibbs(draw=draw_one, observations=TWO, **options):
    return tuning.particle_gibbs(KEY, OF_SCALAR, observations, 4, draw=draw, **OF_A | options)


def cloud(drawn=0.5, num_samples=6, filter=OF_SCALAR, **options):
    options = {"log_prior": flat, "sample_prior": lambda key: {"a": drawn}} | OF_A | options
    return tuning.smc2(KEY, filter, TWO, num_samples, **options)


def climb(optimizer=ASCENT, observations=TWO, **options):
    filter = mpfjax.particle_filter(SCALAR, 4, gradient="stop")
    return tuning.fit(KEY, filter, observations, optimizer, 2, **OF_A | options)


def maximised(objective, model=SCALAR):
    return tuning.maximise(KEY, objective, model, ASCENT, 2)


REFUSED += (
    # tuning
    *(
        ("filter: an approximate one", lambda call=call: call(filter=GAUSSIAN))
        for call in (chain, cloud)
    ),
    ("filter: an approximate one", lambda: tuning.log_density(GAUSSIAN, TWO, log_prior=flat)),
    ("thinning: 9 is more than num_steps, 4", lambda: chain(thinning=9)),
    ("burn_in: -1", lambda: chain(burn_in=-1)),
    ("checkpoint: 'fit.npz' is not a Checkpoint", lambda: chain(checkpoint="fit.npz")),
    ("proposal_deviations: a: 0.0", lambda: chain(proposal_deviations=0.0)),
    (r"proposal_deviations: those of \['b'\]", lambda: chain(proposal_deviations={"b": 1.0})),
    ("log_prior: -inf at the start", lambda: chain(log_prior=lambda p: 0 * p["a"] - jnp.inf)),
    ("log_prior: nan at a draw of sample_prior",
     lambda: cloud(log_prior=lambda p: p["a"] * jnp.nan)),
    ("log_prior: None at the start", lambda: chain(log_prior=lambda p: None)),
    ("log_prior: .* is no floating", lambda: chain(log_prior=lambda p: jnp.ones(2) * p["a"])),
    (r"sample_prior: it gave \['b'\]", lambda: cloud(sample_prior=lambda key: {"b": 1.0})),
    (r"sample_prior: a of shape \(2,\)", lambda: cloud(jnp.zeros(2))),
    ("sample_prior: a, .* is outside Positive",
     lambda: cloud(-1.0, transforms={"a": tuning.Positive()})),
    (r"num_samples: 10 is no multiple of num_moves \+ 1, 6", lambda: cloud(num_samples=10)),
    ("draw, log_prior: .*exactly one", lambda: gibbs(log_prior=flat)),
    ("ScalarLinear defines no log_initial", lambda: gibbs(None, log_prior=flat)),
    (r"draw: it gave \['b'\], no values by", lambda: gibbs(lambda *given: {"b": 1.0})),
    (r"draw: a of shape \(2,\)", lambda: gibbs(lambda *given: {"a": jnp.zeros(2)})),
    ("observations: a list is several", lambda: gibbs(observations=[1.0, 2.0])),
    ("observations: there are no sequences", lambda: climb(observations=[])),
    ("optimizer: 0.1 has no update", lambda: climb(0.1)),
    ("optimizer: ", lambda: climb(optax.adam)),
    ("objective: it returns None", lambda: maximised(lambda key, model: None)),
    ("does not depend on idle", lambda: maximised(lambda key, model: model.a, Idle())),
    ("transforms: b is not among", lambda: climb(transforms={"b": tuning.Positive()})),
    (r"transforms\['a'\]: .* is not a transform",
     lambda: climb(transforms={"a": tuning.Positive})),
    ("parameters: a, 0.9, is outside Interval",
     lambda: climb(transforms={"a": tuning.Interval(2.0, 3.0)})),
    ("high: 1.0 is not above low", lambda: tuning.Interval(2.0, 1.0)),
    ("parameters: .* is not a mapping", lambda: climb(parameters=lambda filter: filter.model.a)),
    ("parameters: there is nothing", lambda: climb(parameters={})),
    ("parameters: there is nothing", lambda: maximised(lambda key, model: model.a, Bare())),
    ("parameters: x cannot be picked", lambda: climb(parameters={"x": lambda f: f.model.rho})),
    ("parameters: x picks 4, which is no leaf",
     lambda: climb(parameters={"x": lambda f: f.num_particles})),
    ("parameters: x and y pick the same",
     lambda: climb(parameters=dict.fromkeys("xy", lambda f: f.model.a))),
    ("parameters: order is 3, no floating",
     lambda: tuning.maximise(
         KEY, lambda key, model: model.a, Idle(), ASCENT, 2,
         parameters={"order": lambda model: model.order})),
    ("(?s)labels: .* has no leading axes", lambda: tuning.LabelLikelihood(TWO, TWO, TWO)),
    ("observations: ", lambda: tuning.LabelLikelihood(TWO, np.ones((3, 1)), LABELS[2])),
    ("num_frames: 5 is not between", lambda: tuning.LabelLikelihood(*LABELS, 5)),
    ("labels: 1 frames leave none",
     lambda: transition_candidates(KEY, MODEL, TWO[:1, None], 2)),
)  # fmt: skip


class Idle(eqx.Module):
    a: jax.Array = eqx.field(converter=jnp.asarray, default=0.5)
    idle: jax.Array = eqx.field(converter=jnp.asarray, default=1.0)
    order: int = 3


@pytest.mark.parametrize(("words", "call"), REFUSED, ids=[words[:40] for words, _ in REFUSED])
def test_what_is_refused_for_another_reason(words, call):
    with pytest.raises(ValueError, match=words):
        call()


def test_an_error_within_the_likelihood_says_what_it_was_given():
    with pytest.raises(TypeError) as caught:
        FILTER.step(KEY, MIXTURE, {"y": 1.0})
    assert any("log_likelihood" in note and "'y'" in note for note in caught.value.__notes__)


def test_arrays_become_those_of_jax():
    assert checks.to_array("size")([1, 2]).dtype == jnp.float32
    assert checks.to_array("size", floating=False)([1, 2]).dtype == jnp.int32
    for value in (None, "a", {}, 1j, KEY, np.ma.masked_array([1.0], [True])):
        with pytest.raises(ValueError, match=r"^size: "):
            checks.to_array("size")(value)


def test_traced_values_pass():
    @checks.checked
    def call(size: Annotated[jax.Array, checks.POSITIVE]):
        return size

    eqx.filter_jit(call)(jnp.array(-1.0))
    with pytest.raises(ValueError, match=r"^size: "):
        call(jnp.array(-1.0))
