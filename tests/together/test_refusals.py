"""What a call refuses: by name, with the value, before anything compiles.

Annotations say what most arguments may be: all are tried here with values that will not do. What
depends on more than one argument, or shows only as a filter runs, stands in the table `REFUSED`.
"""

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
    Propagate,
    Resample,
    arrays,
    checks,
    exact,
    metrics,
    plotting,
    smoothing,
    tuning,
    vision,
)
from mpfjax.moves.initial import SelectInitial
from mpfjax.moves.objects.clusters import PropagateInClusters
from mpfjax.moves.objects.independent import PropagateIndependently
from mpfjax.moves.propagation.propagate import Predict, Reweight
from mpfjax.moves.regrouping.merge import Exclusion
from mpfjax.running.islands import IslandInteraction
from mpfjax.smoothing.variance import batch_estimate, log_marginal_likelihood_variance
from mpfjax.tuning.evidence import pose_evidence
from tests.marking import weekly
from tests.user_models import Batched, Drift, DriftOfOne, ScalarLinear

pytestmark = pytest.mark.usefixtures("as_installed")

KEY = jax.random.key(0)
MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
JOINT = mpfjax.MultiObjectModel(MODEL, 2, shared_observation=True)
FILTER = mpfjax.particle_filter(MODEL, 4)
MIXTURE = FILTER.init(KEY)
TWO, THREE = np.ones(2, np.float32), np.ones(3, np.float32)
HISTORY = mpfjax.run_filter(KEY, FILTER, TWO)
UNCOLLECTED = mpfjax.run_filter(KEY, FILTER, TWO, lambda mixture: None)
EYE, ZERO = np.eye(1), np.zeros(1)
LINEAR = {"A": EYE, "Q": EYE, "H": EYE, "R": EYE, "m0": ZERO, "P0": EYE}
PARTS = {"transition_matrix": EYE, "F": EYE, "Q": EYE, "H": EYE, "R": EYE, "m0": ZERO, "P0": EYE}
SWITCHING = mpfjax.SwitchingLinearGaussianModel(**PARTS)
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


def alike(arguments, *functions):
    return dict.fromkeys(functions, arguments)


FILTERED = {"key": KEY, "filter": FILTER, "observations": TWO}
COLLECTED = FILTERED | {"collect": nothing}
MANY = {"keys": KEY[None], "observations": TWO}
GUIDE = mpfjax.GaussNewtonProposal()
SENSOR = {"object_model": MODEL, "detection_probability": 0.9, "clutter_density": 0.1}
BIRTH = {
    "rate": 1.0, "region": mpfjax.Box([0.0], [1.0]), "newborn": difference, "locate": difference,
}  # fmt: skip
TARGETS = {
    "sensors": mpfjax.ClutteredModel(**SENSOR), "birth": mpfjax.UniformBirth(**BIRTH)
}  # fmt: skip
# The arguments of a good call that have no default, or whose default leaves something out.
GOOD = {
    **alike({}, mpfjax.QuadraticModel, KMeans, mpfjax.Split, mpfjax.Prune, IslandInteraction,
            Propagate, Predict, Reweight, mpfjax.GaussNewtonProposal, mpfjax.RandomWalkMetropolis,
            mpfjax.RegimeProposal, mpfjax.PropagateRegimes, mpfjax.Partitioned,
            mpfjax.RandomPartition, PropagateIndependently, PropagateInClusters),
    **alike({"particles_per_component": 2}, Resample, mpfjax.GaussianRegeneration),
    **alike({"filter": FILTER}, mpfjax.with_lookahead, mpfjax.with_quasi_monte_carlo,
            mpfjax.with_score_gradient, mpfjax.with_initialisation, mpfjax.with_restarts,
            mpfjax.with_alarm),
    **alike({"filter": FILTER, "num_draws": 2}, mpfjax.with_initial_selection,
            mpfjax.with_proposals_per_particle),
    **alike({"model": MODEL, "num_particles": 4}, mpfjax.particle_filter,
            mpfjax.gaussian_particle_filter),
    **alike({"model": MODEL, "num_particles": 4, "max_components": 2},
            mpfjax.mixture_particle_filter, mpfjax.gaussian_mixture_particle_filter),
    **alike({"model": JOINT, "num_particles": 4}, mpfjax.partitioned_sampling,
            mpfjax.distributed_partitioned_sampling, mpfjax.independent_particle_filters,
            mpfjax.clustered_particle_filter),
    **alike({"strength": 1.0, "radius": 2.0}, mpfjax.PairwiseRepulsion, Exclusion),
    mpfjax.LinearGaussianModel: LINEAR,
    mpfjax.SwitchingLinearGaussianModel: PARTS,
    mpfjax.RandomWalk: {"deviations": [1.0, 2.0]},
    mpfjax.RandomWalkWithJumps: {
        "deviations": [1.0], "jump_deviations": [5.0], "jump_probability": 0.1},
    mpfjax.WalkWithVelocity: {
        "walk": mpfjax.RandomWalk([1.0]), "gain": 0.1, "initial_velocity": [0.5]},
    mpfjax.Autoregression: {"A1": EYE, "A2": EYE, "B": EYE, "mean": ZERO},
    mpfjax.MultiObjectModel: {"object_model": MODEL, "num_objects": 2},
    mpfjax.ClutteredModel: SENSOR,
    mpfjax.TargetsModel: TARGETS,
    mpfjax.UniformBirth: BIRTH,
    mpfjax.Box: {"low": [0.0], "high": [1.0]},
    mpfjax.Disc: {"centre": [0.0], "radius": 1.0},
    mpfjax.Associate: {
        "particles_per_birth": 2, "undetected_particles": 4, "resample": Resample()},
    mpfjax.bernoulli_filter: {
        "model": mpfjax.TargetsModel(**TARGETS), "num_particles": 500, "max_targets": 2},
    mpfjax.per_particle: {"model": DriftOfOne()},
    mpfjax.AuxiliaryResample: {"resample": Resample(), "lookahead": GUIDE},
    mpfjax.Merge: {"max_distance": 2.0},
    mpfjax.GroupBy: {"group": nothing},
    mpfjax.Every: {"every": 2, "moves": [KMeans(1)]},
    mpfjax.PropagateNested: {"propagate": Propagate(), "num_draws": 2},
    SelectInitial: {"num_draws": 2},
    mpfjax.with_eve_indices: {
        "filter": mpfjax.particle_filter(MODEL, 4, scheme="multinomial")},
    Filter: {"model": MODEL, "moves": [Propagate()], "num_particles": 4},
    mpfjax.with_resampling: {"filter": FILTER, "resample": Resample()},
    mpfjax.auxiliary_particle_filter: {"model": MODEL, "num_particles": 4, "lookahead": GUIDE},
    mpfjax.run_filter: COLLECTED,
    mpfjax.monte_carlo: MANY | {"filter": FILTER, "collect": nothing},
    mpfjax.run_islands: COLLECTED | {"num_islands": 2},
    mpfjax.Study: MANY | {"filters": {"pf": lambda num_particles: FILTER}, "num_particles": [4]},
    mpfjax.forecast: {"key": KEY, "filter": FILTER, "mixture": MIXTURE, "num_steps": 2},
    smoothing.sample_trajectories: {
        "key": KEY, "model": MODEL, "mixtures": HISTORY, "num_trajectories": 2},
    smoothing.smoothed_sums: FILTERED | {"function": difference},
    smoothing.conditional_filter: FILTERED | {"trajectory": THREE},
}  # fmt: skip
RUNNERS = tuple(list(GOOD)[-8:])
FRAME = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
BOXES = np.array([[5.0, 5, 10, 20], [20, 10, 10, 15]])
ROWS = np.array([[1.0, 1, 2, 2, 5, 5], [2, 1, 2, 2, 5, 5]])
SETS = {"estimates": np.ones((2, 2)), "truths": np.ones((3, 2)), "cutoff": 3.0}
TRACKER, POINTS = vision.ObjectTracker(2), vision.ObjectTracker(4, point_deviation=1.0)
# Those that boxes and frames come to, of which only the annotated arguments are tried.
WITH_BOXES = {
    **alike({}, vision.ObjectTracker, vision.RGBColours, vision.HSVColours,
            vision.BackgroundSubtraction),
    **alike({"frame": FRAME, "boxes": BOXES}, vision.ColourModel.from_frame,
            vision.joint_colour_model),
    vision.follow_boxes: {"frames": [FRAME], "boxes": BOXES},
    vision.track: {"frames": None, "detections": np.zeros((0, 7))},
    **alike(SETS, metrics.ospa, metrics.gospa),
    metrics.crps: {"values": np.ones(5), "weights": np.ones(5), "observations": np.ones(())},
    metrics.log_score: {"model": MODEL, "mixture": MIXTURE, "observation": 1.0},
    metrics.multi_object_scores: {"tracks": ROWS, "truth": ROWS},
}  # fmt: skip
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


@pytest.mark.exactness
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
    public = {name for name in dir(mpfjax) if callable(getattr(mpfjax, name))}
    tried = {function.__name__ for function in GOOD}
    others = {name for name in public - tried if not name.startswith(("_", "Abstract"))}
    # Records of results, what takes no argument to check, what other tests are about, and another
    # name of `Propagate`.
    assert others == {
        "FilterRun", "Step", "StepInfo", "Series", "Checkpoint", "ParticleMixture", "Pool",
        "load_checkpoint", "save_checkpoint", "normal", "read_study", "run_study",
        "NetworkProposal", "enable_compilation_cache", "check_model", "simulate", "map_moves",
        "TargetEstimates", "estimate_targets", "track_table", "number_distribution",
        "ComponentTable", "component_table", "one_step_predictions", "PropagateMarginalised",
    }  # fmt: skip


def test_every_number_and_name_of_a_public_call_says_what_it_may_be():
    modules = (mpfjax, tuning, smoothing, vision, exact, metrics, plotting)
    named = [(module, name) for module in modules for name in dir(module)]
    values = [getattr(module, name) for module, name in named if not name.startswith("_")]
    public = [value for value in values if callable(value)]
    ours = [value for value in public if (value.__module__ or "").startswith("mpfjax.")]
    unsaid = {
        f"{function.__name__}({argument.name})"
        for function in [*ours, *GOOD]
        for argument in arguments_of(function)
        if argument.annotation in (int, float, str, int | None, float | None, str | None)
    }
    # What JAX makes itself, and a field of a result.
    assert unsaid == {"ParticleMixture(num_components)", "Tracks(number)"}


numbers = st.one_of(st.integers(-3, 6), st.floats(width=32), st.floats())
values = st.one_of(
    st.sampled_from(BAD),
    numbers,
    st.lists(numbers, max_size=3),
    st.lists(st.lists(st.floats(-2, 2), min_size=1, max_size=2), max_size=2),
    st.lists(numbers, max_size=3).map(np.array),
)
UNHURRIED = settings(
    deadline=None, database=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
BUILDERS = [function for function in GOOD if function not in RUNNERS and arguments_of(function)]


@st.composite
def calls(draw, functions):
    """A function, the arguments of a call, and the names of those that are hostile."""
    function = draw(st.sampled_from(functions))
    names = sorted(parameter.name for parameter in arguments_of(function))
    changed = draw(st.lists(st.sampled_from(names), min_size=1, max_size=2, unique=True))
    return function, GOOD[function] | {name: draw(values) for name in changed}, changed


@pytest.mark.exactness
@pytest.mark.parametrize(
    ("functions", "number"), [(BUILDERS, 500), (RUNNERS, 60), *weekly([(BUILDERS, 5_000)])]
)
def test_calls_work_or_name_the_argument(functions, number):
    @settings(UNHURRIED, max_examples=number)
    @given(calls(functions))
    def check(call):
        function, arguments, changed = call
        try:
            function(**arguments)
        except (ValueError, TypeError, RuntimeError) as error:
            message = "\n".join([str(error), *getattr(error, "__notes__", [])])
            # A broken density is found as the filter runs.
            changed += ["observation", "density"] * isinstance(error, RuntimeError)
            names = [*changed, *(ALSO.get(argument, argument) for argument in changed)]
            assert any(re.search(rf"\b{name}\b", message) for name in names), (function, message)

    check()


def changed(kind, **attributes):
    """A model of this kind, of which a subclass of the user's has other methods."""
    fields = PARTS if kind is type(SWITCHING) else {}
    return type("Changed", (kind,), attributes)(**fields)


def run(filter, observations=TWO, **options):
    return mpfjax.run_filter(KEY, filter, observations, **options)


def run_of(model, observations=TWO, **options):
    return run(mpfjax.particle_filter(model, 10, **options), observations)


def tracked(detections, frames=(FRAME, FRAME), **options):
    return list(vision.track(frames, detections, TRACKER, use_colours=False, **options))


def paths(run=HISTORY, model=MODEL, **options):
    filter = mpfjax.particle_filter(model, 4)
    return smoothing.sample_trajectories(KEY, filter, run, 2, **options)


def around(filter=FILTER, trajectory=THREE):
    return smoothing.conditional_filter(KEY, filter, TWO, trajectory)


SCALAR = ScalarLinear()
OF_SCALAR = mpfjax.particle_filter(SCALAR, 4)
ASCENT = optax.sgd(0.1)
PROPOSING = mpfjax.particle_filter(MODEL, 4, proposal=mpfjax.NetworkProposal.create(KEY, 1, 1, 0.8))
OF_A = {"parameters": {"a": lambda filter: filter.model.a}, "progress": False}


def chain(**options):
    options = {"log_prior": lambda parameters: 0.0} | OF_A | options
    return tuning.metropolis_hastings(KEY, OF_SCALAR, TWO, 4, **options)


def climb(**options):
    return tuning.fit(KEY, OF_SCALAR, TWO, ASCENT, 2, **OF_A | options)


# By room: words of the message, and the call.
REFUSED = (
    # filters and moves
    ("moves: .* never weigh the particles", lambda: Filter(MODEL, [Resample(), Predict()], 4)),
    ("scale: 2 units for 1 features",
     lambda: mpfjax.mixture_particle_filter(MODEL, 20, 2, scale=[1.0, 2.0]).init(KEY)),
    ("group: groups have no effect",
     lambda: Resample(particles_per_component=2, group=nothing)),
    ("moves: (?s:.*) neither regroups, resamples nor",
     lambda: mpfjax.Every(2, [KMeans(), Propagate()])),
    ("moves: two of them use the memory 'every 2: KMeans', as Every", lambda: FILTER.replace(
        moves=[*FILTER.moves, *(mpfjax.Every(2, [KMeans(k)]) for k in (1, 2))])),
    ("group: it returned",
     lambda: mpfjax.GroupBy(lambda x: jnp.zeros(2, int)).regroup(KEY, MIXTURE)),
    ("importance: .* draws from no proposal", lambda: mpfjax.gaussian_particle_filter(
        MODEL, 5, importance="predictive_gaussian", proposal=GUIDE)),
    ("num_slots: 3 is not at least N, 4",
     lambda: mpfjax.monte_carlo(KEY[None], FILTER, TWO, num_slots=3)),
    ("2 steps, fewer than num_observations of with_initialisation, 3", lambda: run(
        mpfjax.with_initialisation(FILTER, 3))),
    ("ClutteredModel.* sample_observation",
     lambda: mpfjax.simulate(KEY, mpfjax.ClutteredModel(**SENSOR), 2)),
    # observations
    (r"observations: shapes .* jnp.asarray\(observations\)", lambda: run(FILTER, [0.0, 1.0])),
    (r"observation: shape \(2,\)", lambda: run(FILTER, jnp.zeros((3, 2)))),
    ("observations: NaN .* index 1", lambda: run(
        FILTER, mpfjax.Series(np.array([1.0, NAN, 2.0]), present=np.arange(3) != 2))),
    ("observations: a Series itself", lambda: run(FILTER, mpfjax.Series(TWO, TWO), inputs=TWO)),
    (r"num_particles: 13 of an island.* 2 islands", lambda: mpfjax.run_islands(
        KEY, Filter(MODEL, [IslandInteraction(), Propagate()], 13), TWO, num_islands=2)),
    # what a model's methods return
    ("model: DriftOfOne.sample_initial.*per_particle",
     lambda: mpfjax.particle_filter(DriftOfOne(), 10)),
    *(
        (f"model: Changed.{method}.* (returned|leading axis)",
         lambda method=method, v=value: run_of(changed(Batched, **{method: lambda *given: v})))
        for method, value in (
            ("sample_initial", jnp.zeros((3, 10))), ("sample_transition", jnp.zeros(10, int)),
            ("sample_transition", jnp.zeros((10, 1))), ("log_likelihood", jnp.zeros((10, 1))),
            ("log_likelihood", jnp.zeros(10, complex)),
        )
    ),
    (r"model: Changed.log_transition returned .*, \(10,\)",
     lambda: run_of(changed(Batched, log_transition=lambda *given: THREE), gradient="stop")),
    *(
        (f"model: Changed.{method} returned",
         lambda method=method, v=value: run_of(
             changed(type(SWITCHING), **{method: lambda *given: v}), np.ones((2, 1))))
        for method, value in (
            ("dynamics", (EYE[0], ZERO, EYE)), ("dynamics", (EYE, TWO, EYE)),
            ("emission", (EYE, ZERO, ZERO)), ("initial_moments", (ZERO, np.ones((1, 2)))),
        )
    ),
    # how models' arrays fit together, and exact answers
    (r"Q: shape \(2, 2\) is not \(d, d\)",
     lambda: mpfjax.LinearGaussianModel(**LINEAR | {"Q": np.eye(2)})),
    ("(?s)transition_matrix: .* rows that sum to one",
     lambda: mpfjax.SwitchingLinearGaussianModel(**PARTS | {"transition_matrix": 0.6 * EYE})),
    *(
        ("(?s)R: .* is not a covariance", lambda kind=kind, R=R: kind(
            **(LINEAR if kind is mpfjax.LinearGaussianModel else PARTS)
            | {"H": np.ones((2, 1)), "R": R}))
        for kind in (mpfjax.LinearGaussianModel, mpfjax.SwitchingLinearGaussianModel)
        for R in ([[1, 0.5], [0, 1]], [[1, 2], [2, 1]])
    ),
    ("high: 1.0 is not above low", lambda: mpfjax.QuadraticModel(low=1.0, high=1.0)),
    *(
        ("grid: ", lambda grid=grid: exact.grid_filter(MODEL, TWO, grid))
        for grid in (np.linspace(5, -5, 101), np.geomspace(0.01, 5, 101), np.zeros(9), np.zeros(1))
    ),
    (r"observations: shape \(2,\) is not \(t, 1\)",
     lambda: exact.kalman_filter(mpfjax.LinearGaussianModel(**LINEAR), TWO)),
    # summaries, figures and scores
    (r"mixture: a stack of 4 mixtures .* jax\.vmap",
     lambda: jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), MIXTURE).mean()),
    ("collect: the run did not collect its mixtures", lambda: UNCOLLECTED.mean()),
    ("run: it has not the mixtures", lambda: plotting.draw_weights(UNCOLLECTED)),
    ("index: 9 of a state of", lambda: plotting.draw_components(HISTORY, 9)),
    ("weights: shape", lambda: metrics.crps(np.ones((2, 3)), np.ones((2, 4)), TWO)),
    (r"observations: shape \(3,\) is not \(2\)",
     lambda: metrics.crps(np.ones((2, 3)), np.ones((2, 3)), THREE)),
    ("tracks: id 1 has more than one box in frame 1",
     lambda: metrics.multi_object_scores(ROWS[[0, 1, 0]], ROWS)),
    # frames, boxes and detections
    *(
        ("boxes: .* have no area in the first frame, 50 x 40",
         lambda box=box: vision.ColourModel.from_frame(FRAME, [box]))
        for box in ([5, 5, 0, 5], [NAN, 5, 9, 9], [-9, 10, 9, 9])
    ),
    ("frame: ", lambda: vision.ColourModel.from_frame(FRAME.astype(float), BOXES)),
    ("templates: 2 is none of the 2 objects",
     lambda: vision.joint_colour_model(FRAME, BOXES, templates={2: (FRAME, BOXES[0])})),
    *(
        (f"detections: frame 1: {words}", lambda found=found: tracked(lambda frame: found))
        for words, found in (
            (r"shape \(2, 3\)", np.ones((2, 3))), ("1 scores for 2", (BOXES, [1.0])),
            ("1 classes for 2", (BOXES, None, [1])),
            ("classes .* whole numbers from 0", (BOXES, None, [-1, 1])),
        )
    ),
    ("detections: frame 1", lambda: POINTS.step(None, POINTS.init(), None, np.zeros((3, 4)))),
    ("frame,id,x,y,score", lambda: next(vision.track(None, np.ones((3, 9)), POINTS))),
    ("detections: end before the frames do, at frame 2", lambda: tracked([BOXES])),
    ("min_score: .* no scores", lambda: tracked([BOXES] * 2, min_score=0.5)),
    ("frames: None; .* 'pixels'", lambda: vision.track(None, ROWS, camera_motion="pixels")),
    (r"frames: 2 has the shape \(30, 50, 3\)",
     lambda: tracked([BOXES] * 2, [FRAME, FRAME[:30]])),
    (r"rows: .* is not frame,id", lambda: vision.write_tracks("/nowhere", [[0, 1, 5, 5, 9, 9]])),
    # studies
    (r"num_particles: \[8, 8\] are no numbers or strings, each there once",
     lambda: mpfjax.Study(**GOOD[mpfjax.Study] | {"num_particles": [8, 8]})),
    ("settings: 'filter' is a name",
     lambda: mpfjax.Study(**GOOD[mpfjax.Study] | {"settings": {"filter": [1]}})),
    # propagation, several objects, look-ahead
    ("inherits its transition_from_noise, which noise='rqmc' needs",
     lambda: Filter(changed(Drift, sample_transition=lambda self, key, x: x),
                    [Propagate(noise="rqmc")], 4)),
    *(
        (f"a model, but {kind.__name__} stores none; the filter has its own",
         lambda kind=kind: kind(MODEL))
        for kind in (Propagate, mpfjax.Partitioned, mpfjax.GaussNewtonProposal, SelectInitial)
    ),
    ("propagate: gradient 'stop'",
     lambda: mpfjax.PropagateNested(Propagate(gradient="stop"), 2)),
    ("comes before any propagation: there is no x_t yet",
     lambda: run(Filter(MODEL, [mpfjax.RandomWalkMetropolis(), Propagate()], 4))),
    ("IslandInteraction leaves no particle one parent", lambda: Filter(MODEL, [Propagate(),
        mpfjax.Every(2, [IslandInteraction()]), mpfjax.RandomWalkMetropolis()], 4)),
    ("object_model: .* is conditionally linear",
     lambda: mpfjax.ClutteredModel(SWITCHING, 0.9, 0.1)),
    ("object_model: not every array",
     lambda: mpfjax.MultiObjectModel(mpfjax.LinearGaussianModel(**LINEAR), 3, per_object=True)),
    (r"observation: shape \(2,\) has no leading axis",
     lambda: mpfjax.MultiObjectModel(MODEL, 3).log_likelihood(TWO, jnp.ones((4, 3)))),
    ("orders: ", lambda: mpfjax.partitioned_sampling(JOINT, 10, (0, 0))),
    ("orders: 2 of them, for 1 components",
     lambda: run(Filter(JOINT, [mpfjax.Partitioned([(0, 1), (1, 0)])], 4))),
    ("mixture: 2 components, not one",
     lambda: run(Filter(JOINT, [PropagateIndependently()], 4, 2))),
    ("filter: .*cannot look ahead", lambda: smoothing.learn_lookahead(
        KEY, Filter(MODEL, [mpfjax.GaussianRegeneration(), Propagate()], 4), TWO)),
    # smoothing
    ("observations: .3. steps", lambda: paths(
        run_of(SWITCHING, TWO[:, None]), SWITCHING, observations=THREE[:, None])),
    ("mixtures: not those of a whole run", lambda: paths(HISTORY.final)),
    (r"mixtures: \[ParticleMixture\(particles=f32\[4\], .* is not", lambda: paths([MIXTURE])),
    (r"q: 90 is not in \[0, 1\]", lambda: MIXTURE.quantile(MIXTURE.particles, 90)),
    (r"trajectory: float32\[4\] is not float32\[3\]", lambda: around(trajectory=np.ones(4))),
    ("filter: .*one Propagate or Predict", lambda: around(Filter(MODEL, [Reweight()], 4))),
    (r"function: shape \(\) has no leading axis",
     lambda: smoothing.smoothed_sums(**FILTERED, function=lambda previous, states: states.sum())),
    ("filter: .* is approximate or draws in a way of its own", lambda:
        mpfjax.with_eve_indices(mpfjax.distributed_partitioned_sampling(JOINT, 4))),
    (r"filter: scheme of \w+ is '", lambda: mpfjax.with_eve_indices(OF_SCALAR)),
    ("run: its filter stores no Eve", lambda: log_marginal_likelihood_variance(HISTORY)),
    ("runs: 1; a standard error requires at least 4", lambda: batch_estimate(HISTORY, nothing)),
    # tuning
    (r"num_samples: 800 .* num_moves \+ 1 = 6; use 798 or 804", lambda: tuning.smc2(
        KEY, OF_SCALAR, TWO, 800, sample_prior=nothing, log_prior=nothing, **OF_A)),
    (r"proposal_deviations: those of \['b'\]", lambda: chain(proposal_deviations={"b": 1.0})),
    ("log_prior: -inf at the start", lambda: chain(log_prior=lambda p: 0 * p["a"] - jnp.inf)),
    (r"sample_prior: a of shape \(2,\)", lambda: chain(sample_prior=lambda key: {"a": TWO})),
    ("log_prior: .* is no floating", lambda: chain(log_prior=lambda p: jnp.ones(2) * p["a"])),
    ("parameters: the value does not depend on h",
     lambda: tuning.maximise(KEY, SCALAR, lambda key, model: model.a, ASCENT, 2)),
    ("transforms: b is not among", lambda: climb(transforms={"b": tuning.Positive()})),
    ("parameters: a, 0.9, is outside Interval",
     lambda: climb(transforms={"a": tuning.Interval(2.0, 3.0)})),
    ('score: "fisher" has no derivative in .* proposal', lambda: pose_evidence(
        PROPOSING, TWO, {"w": lambda filter: filter.moves[1].proposal.network}, None, "fisher")),
    ("observations: sequence 1 has none", lambda: pose_evidence(
        FILTER, [TWO, mpfjax.Series.skipping(NAN * TWO)], None, None, "fisher")),
    *(
        (f"models: .*{named}", lambda models=models: tuning.compare_evidence(models))
        for named, models in (
            ("are not two", {"a": [1.0, 2.0]}), ("b has", {"a": [1.0, 2.0], "b": [1.0, NAN]}),
            ("b has .* not two finite", {"a": [1.0, 2.0], "b": [1.0]}),
        )
    ),
    ("parameters: x and y pick the same",
     lambda: climb(parameters=dict.fromkeys("xy", lambda filter: filter.model.a))),
)  # fmt: skip


@pytest.mark.exactness
@pytest.mark.parametrize(("words", "call"), REFUSED, ids=[words[:40] for words, _ in REFUSED])
def test_what_is_refused_for_another_reason(words, call):
    with pytest.raises(ValueError, match=words):
        call()


# What a first user writes by mistake, and what the message and its notes say.
MISTAKEN = (
    ("max_componets", lambda: mpfjax.mixture_particle_filter(MODEL, 20, max_componets=2)),
    ("m0", lambda: mpfjax.LinearGaussianModel(EYE, EYE, EYE, EYE)),
    (r"key: Filter\(.* is not one typed key, as jax.random.key\(0\)",
     lambda: mpfjax.run_filter(FILTER, TWO)),
    (r"key: key<fry>\[3\] is not one typed key",
     lambda: mpfjax.run_filter(jax.random.split(KEY, 3), FILTER, TWO)),
    (r"keys: key<fry>\[\] is not a row of .* jax.random.split\(",
     lambda: mpfjax.monte_carlo(KEY, FILTER, TWO)),
    (r"keys: key<fry>\[3\] is not a row of different typed keys",
     lambda: mpfjax.monte_carlo(jnp.stack([KEY] * 3), FILTER, TWO)),
    (r"key: \[0 0\] is not one typed key",
     lambda: mpfjax.run_filter(jax.random.PRNGKey(0), FILTER, TWO)),
    ("model: Still defines no sample_transition, nor transition_from_noise",
     lambda: mpfjax.particle_filter(Still(), 4)),
    ("model: Plain defines no sample_initial, which a filter needs; is sample_prior meant",
     lambda: mpfjax.particle_filter(Plain(), 4)),
    ("model: a Filter is no model, but has one", lambda: mpfjax.particle_filter(FILTER, 4)),
    (r"features: shape \(3,\) is not \(20, ...\)", lambda: run(mpfjax.mixture_particle_filter(
        MODEL, 20, 2, features=lambda states: states[:3]))),
    (r"features: \(f32\[20\], .* is no array of numbers", lambda: run(
        mpfjax.mixture_particle_filter(MODEL, 20, 2, features=lambda states: (states, states)))),
    (r"has no attribute.* place.*\nfeatures, called with the particles",
     lambda: run(mpfjax.mixture_particle_filter(MODEL, 20, 2, features=lambda x: x.place))),
    (r"model: QuadraticModel.log_likelihood, given .* in a list; jnp.asarray\(observations\) is",
     lambda: run(FILTER, [TWO, TWO, TWO])),
    (r"observation: shape \(2,\) is not \(1\)\nmodel: LinearGaussianModel.log_likelihood",
     lambda: run_of(mpfjax.LinearGaussianModel(**LINEAR), np.ones((3, 2)))),
    (r"observations: NaN or infinite at index 1 of the leading axis; if it is missing,",
     lambda: smoothing.smoothed_sums(KEY, FILTER, np.array([1.0, NAN]), difference)),
    (r"(?s)model: Changed.log_likelihood, given the observation {'y': f32\[\]}",
     lambda: run_of(changed(Batched), {"y": TWO})),
    ("(?s)boolean.*\nmodel: Changed.log_transition",
     lambda: paths(HISTORY, changed(Batched, log_transition=signed_density))),
)  # fmt: skip


class Still(mpfjax.AbstractStateSpaceModel):
    def sample_initial(self, key, num_particles):
        return jnp.zeros(num_particles)

    def log_likelihood(self, observation, states):
        return -((observation - states) ** 2)


class Plain:
    def sample_prior(self, key, num_particles):
        return jnp.zeros(num_particles)


def signed_density(self, states, previous_states):
    return states if states[0] > 0 else -states


@pytest.mark.parametrize(("words", "call"), MISTAKEN, ids=[words[:40] for words, _ in MISTAKEN])
def test_a_mistake_is_named(words, call):
    with pytest.raises((ValueError, TypeError, AttributeError)) as caught:
        call()
    said = "\n".join([str(caught.value), *getattr(caught.value, "__notes__", [])])
    assert re.search(words, said), said


def test_arrays_become_those_of_jax():
    assert arrays.to_array("size")([1, 2]).dtype == jnp.float32
    assert arrays.to_array("size", floating=False)([1, 2]).dtype == jnp.int32
    for value in ("a", {}, 1j, KEY, np.ma.masked_array([1.0], [True])):
        with pytest.raises(ValueError, match=r"^size: "):
            arrays.to_array("size")(value)


@pytest.mark.exactness
def test_traced_values_pass():
    @checks.checked
    def call(size: Annotated[jax.Array, arrays.POSITIVE]):
        return size

    eqx.filter_jit(call)(jnp.array(-1.0))
    with pytest.raises(ValueError, match=r"^size: "):
        call(jnp.array(-1.0))
