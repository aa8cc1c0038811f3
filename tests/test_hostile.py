"""Hostile arguments, generated: a call works, or its error names the argument.

One or two arguments of a good call are replaced by whatever the generator comes up with. What is
built in spite of it, draws and weighs finite numbers. `pytest -m weekly` runs a hundred thousand.
"""

import array
import collections
import datetime
import decimal
import fractions
import functools
import inspect
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import mpfjax
from mpfjax.lookahead.pilot import PilotLookahead
from mpfjax.models.dynamics import AbstractDynamics
from mpfjax.moves.initial import SelectInitial
from mpfjax.moves.objects.clusters import PropagateInClusters
from mpfjax.moves.objects.exclusion import Exclusion
from mpfjax.moves.objects.independent import PropagateIndependently
from mpfjax.moves.propagation.propagate import Predict, Reweight
from mpfjax.running.islands import IslandInteraction
from mpfjax.smoothing.variance import log_marginal_likelihood_variance, mixture_weight_errors

pytestmark = pytest.mark.usefixtures("as_installed")

KEY = jax.random.key(0)
MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
JOINT = mpfjax.MultiObjectModel(MODEL, 2, shared_observation=True)
FILTER = mpfjax.particle_filter(MODEL, 4)
MIXTURE = FILTER.init(KEY)
HISTORY = mpfjax.run_filter(KEY, FILTER, np.ones(2, np.float32))
INDEPENDENT = mpfjax.particle_filter(MODEL, 4, scheme="multinomial")
TRACED = mpfjax.smoothing.with_first_ancestors(INDEPENDENT).init(KEY)
EYE = np.eye(1)
SWITCHING = mpfjax.SwitchingLinearGaussianModel(EYE, EYE, EYE, EYE, EYE, np.zeros(1), EYE)


def nothing(mixture):
    return None


def difference(previous_states, states):
    return states - previous_states


# By name: what is called, and the arguments of a good call.
BUILT = {
    "QuadraticModel": (
        mpfjax.QuadraticModel,
        {"sigma_x": 0.3, "sigma_y": 0.5, "low": -2.0, "high": 2.0, "initial_draw": "stratified"},
    ),
    "LinearGaussianModel": (
        mpfjax.LinearGaussianModel,
        {"A": EYE, "Q": EYE, "H": EYE, "R": EYE, "m0": np.zeros(1), "P0": EYE},
    ),
    "RandomWalk": (mpfjax.RandomWalk, {"deviations": [1.0, 2.0]}),
    "RandomWalkWithJumps": (
        mpfjax.RandomWalkWithJumps,
        {"deviations": [1.0], "jump_deviations": [5.0], "jump_probability": 0.1},
    ),
    "WalkWithVelocity": (
        mpfjax.WalkWithVelocity,
        {"walk": mpfjax.RandomWalk([1.0]), "gain": 0.1, "initial_velocity": [0.5]},
    ),
    "Autoregression": (
        mpfjax.Autoregression, {"A1": EYE, "A2": EYE, "B": EYE, "mean": np.zeros(1)}
    ),
    "Autoregression.with_momentum": (
        mpfjax.Autoregression.with_momentum, {"momentum": 0.5, "deviations": [1.0, 2.0]}
    ),
    "PairwiseRepulsion": (
        mpfjax.PairwiseRepulsion,
        {"strength": 1.0, "radius": 2.0, "position": None, "compact": True},
    ),
    "MultiObjectModel": (
        mpfjax.MultiObjectModel,
        {"object_model": MODEL, "num_objects": 2, "interaction": None,
         "shared_observation": True, "per_object": False},
    ),
    "per_particle": (mpfjax.per_particle, {"model": MODEL}),
    "NetworkProposal.create": (
        mpfjax.NetworkProposal.create,
        {"key": KEY, "state_size": 1, "observation_size": 1, "scale": 0.3, "width": 2, "depth": 1},
    ),
    "GaussNewtonProposal": (
        mpfjax.GaussNewtonProposal,
        {"model": MODEL, "num_iterations": 2, "inflation": 1.1},
    ),
    "Resample": (
        mpfjax.Resample,
        {"scheme": "systematic", "ess_threshold": 0.5, "particles_per_component": 2,
         "allocation": "equal", "share_by": None, "sort_by": None, "gradient": "none"},
    ),
    "AuxiliaryResample": (
        mpfjax.AuxiliaryResample,
        {"resample": mpfjax.Resample(), "lookahead": mpfjax.GaussNewtonProposal(MODEL)},
    ),
    "PilotLookahead": (PilotLookahead, {"model": MODEL}),
    "GaussianRegeneration": (
        mpfjax.GaussianRegeneration,
        {"particles_per_component": 2, "where": None, "inflation": 1.0, "noise": "independent"},
    ),
    "KMeans": (
        mpfjax.KMeans, {"num_iterations": 2, "reseed": False, "features": None, "scale": 1.0}
    ),
    "Merge": (
        mpfjax.Merge,
        {"max_deviations": 1.0, "max_distance": 2.0, "patience": 1, "features": None, "scale": 1.0},
    ),
    "Split": (
        mpfjax.Split,
        {"min_deviations": 4.0, "min_distance": 0.0, "min_share": 0.1, "num_iterations": 2,
         "features": None, "scale": 1.0},
    ),
    "RandomPartition": (mpfjax.RandomPartition, {"num_sets": 2}),
    "GroupBy": (mpfjax.GroupBy, {"function": nothing}),
    "Exclusion": (
        Exclusion, {"strength": 1.0, "radius": 0.5, "features": None, "scale": 1.0}
    ),
    "Every": (mpfjax.Every, {"num_steps": 2, "moves": [mpfjax.KMeans(1)]}),
    "Prune": (mpfjax.Prune, {"least_share": 1e-3}),
    "IslandInteraction": (IslandInteraction, {"threshold": 0.5}),
    "Propagate": (
        mpfjax.Propagate, {"model": MODEL, "proposal": None, "gradient": "none", "noise": "rqmc"}
    ),
    "Predict": (Predict, {"model": MODEL, "gradient": "none", "noise": "rqmc"}),
    "PropagateMarginalised": (
        mpfjax.PropagateMarginalised,
        {"model": SWITCHING, "proposal": None, "gradient": "none", "noise": "rqmc"},
    ),
    "RegimeProposal": (mpfjax.RegimeProposal, {"model": SWITCHING}),
    "PropagateRegimes": (mpfjax.PropagateRegimes, {"model": SWITCHING, "group": None}),
    "SwitchingLinearGaussianModel": (
        mpfjax.SwitchingLinearGaussianModel,
        {"transition_matrix": EYE, "F": EYE, "Q": EYE, "H": EYE, "R": EYE, "m0": np.zeros(1),
         "P0": EYE, "b": None, "c": np.zeros(1), "initial_probabilities": np.ones(1)},
    ),
    "Reweight": (Reweight, {"model": MODEL, "exponent": 0.5}),
    **{
        move.__name__: (
            move,
            {"model": MODEL, "num_steps": 2, "least_step": 0.1, "exponent": 0.5,
             "gradient": "none"},
        )
        for move in (mpfjax.RandomWalkMetropolis, mpfjax.MetropolisAdjustedLangevin)
    },
    "PropagateNested": (
        mpfjax.PropagateNested, {"propagate": mpfjax.Propagate(MODEL), "num_draws": 2}
    ),
    "PropagateTempered": (
        mpfjax.PropagateTempered,
        {"model": MODEL, "resample": mpfjax.Resample(), "exponents": (0.1, 1.0), "num_moves": 1,
         "least_step": 0.05},
    ),
    "Partitioned": (
        mpfjax.Partitioned,
        {"model": JOINT, "orders": None, "resample": None, "reassembly": "prior"},
    ),
    "PropagateIndependently": (
        PropagateIndependently, {"model": JOINT, "scheme": "systematic"}
    ),
    "PropagateInClusters": (
        PropagateInClusters,
        {"model": JOINT, "start": "apart", "split_after": None, "scheme": "systematic"},
    ),
    "Filter": (
        mpfjax.Filter,
        {"model": MODEL, "moves": [mpfjax.Propagate(MODEL)], "num_particles": 4,
         "num_components": 1, "initial_moves": (), "initial_noise": "rqmc"},
    ),
    "SelectInitial": (
        SelectInitial,
        {"propagation": mpfjax.Propagate(MODEL), "num_draws": 2, "noise": "rqmc"},
    ),
    "with_selected_start": (mpfjax.with_selected_start, {"filter": FILTER, "num_draws": 2}),
    "with_proposals_per_particle": (
        mpfjax.with_proposals_per_particle, {"filter": FILTER, "num_draws": 2}
    ),
    "with_lookahead": (mpfjax.with_lookahead, {"filter": FILTER, "lookahead": None}),
    "with_point_sets": (mpfjax.with_point_sets, {"filter": FILTER}),
    "with_score_gradient": (mpfjax.with_score_gradient, {"filter": FILTER}),
    "with_resampling": (
        mpfjax.with_resampling, {"filter": FILTER, "resample": mpfjax.Resample()}
    ),
    "particle_filter": (
        mpfjax.particle_filter,
        {"model": MODEL, "num_particles": 4, "proposal": None, "scheme": "systematic",
         "ess_threshold": 1.0, "sort_by": None, "noise": "rqmc", "gradient": "none"},
    ),
    "auxiliary_particle_filter": (
        mpfjax.auxiliary_particle_filter,
        {"model": MODEL, "num_particles": 4, "lookahead": mpfjax.GaussNewtonProposal(MODEL),
         "proposal": None, "scheme": "ssp", "ess_threshold": 1.0, "sort_by": None},
    ),
    "mixture_particle_filter": (
        mpfjax.mixture_particle_filter,
        {"model": MODEL, "num_particles": 4, "max_components": 2, "proposal": None,
         "scheme": "systematic", "ess_threshold": 1.0, "noise": "rqmc", "gradient": "none",
         "features": None, "scale": 1.0, "regroup": None, "regroup_every": 1},
    ),
    "gaussian_particle_filter": (
        mpfjax.gaussian_particle_filter,
        {"model": MODEL, "num_particles": 4, "proposal": None, "regeneration": None,
         "importance": "propagated"},
    ),
    "gaussian_mixture_particle_filter": (
        mpfjax.gaussian_mixture_particle_filter,
        {"model": MODEL, "num_particles": 4, "max_components": 2, "proposal": None,
         "regeneration": None, "importance": "propagated", "features": None, "scale": 1.0,
         "regroup": None, "regroup_every": 1},
    ),
    "partitioned_sampling": (
        mpfjax.partitioned_sampling,
        {"model": JOINT, "num_particles": 4, "order": None, "scheme": "systematic",
         "ess_threshold": 1.0},
    ),
    "distributed_partitioned_sampling": (
        mpfjax.distributed_partitioned_sampling,
        {"model": JOINT, "num_particles": 4, "orders": None, "reassembly": "prior",
         "scheme": "systematic", "ess_threshold": 1.0},
    ),
    "independent_particle_filters": (
        mpfjax.independent_particle_filters,
        {"model": JOINT, "num_particles": 4, "scheme": "systematic"},
    ),
    "clustered_particle_filter": (
        mpfjax.clustered_particle_filter,
        {"model": JOINT, "num_particles": 4, "start": "apart", "split_after": None,
         "scheme": "systematic"},
    ),
    "Study": (
        mpfjax.Study,
        {"filters": {"pf": lambda num_particles: FILTER}, "num_particles": [4],
         "keys": KEY[None], "observations": np.zeros(2), "settings": {}, "collect": nothing},
    ),
}  # fmt: skip
RUN = {
    "run_filter": (
        mpfjax.run_filter,
        {"key": KEY, "filter": FILTER, "observations": np.ones(2, np.float32),
         "collect": nothing, "missing": "error"},
    ),
    "monte_carlo": (
        mpfjax.monte_carlo,
        {"keys": KEY[None], "filter": FILTER, "observations": np.ones(2, np.float32),
         "collect": nothing, "missing": "error", "devices": None, "slots": None},
    ),
    "run_islands": (
        mpfjax.run_islands,
        {"key": KEY, "filter": FILTER, "observations": np.ones(2, np.float32),
         "collect": nothing, "num_islands": 2, "devices": None},
    ),
    "step": (
        lambda key, mixture, observation: FILTER.step(key, mixture, observation),
        {"key": KEY, "mixture": MIXTURE, "observation": np.float32(1.0)},
    ),
    "predict": (
        lambda key, mixture: FILTER.predict(key, mixture), {"key": KEY, "mixture": MIXTURE}
    ),
    "init": (FILTER.init, {"key": KEY}),
    "forecast": (
        mpfjax.forecast,
        {"key": KEY, "filter": FILTER, "mixture": MIXTURE, "num_steps": 2,
         "simulate_observation": None},
    ),
    "sample_trajectories": (
        mpfjax.smoothing.sample_trajectories,
        {"key": KEY, "model": MODEL, "mixtures": HISTORY, "num_trajectories": 2,
         "component": None, "method": "exact", "num_steps": None},
    ),
    "conditional_filter": (
        mpfjax.smoothing.conditional_filter,
        {"key": KEY, "filter": FILTER, "observations": np.ones(2, np.float32),
         "trajectory": np.ones(3, np.float32), "backward": True},
    ),
    "smoothed_sums": (
        mpfjax.smoothing.smoothed_sums,
        {"key": KEY, "filter": FILTER, "observations": np.ones(2, np.float32),
         "function": difference, "lag": None, "method": "exact", "num_draws": 2},
    ),
    "trace_ancestors": (mpfjax.smoothing.trace_ancestors, {"mixtures": HISTORY}),
    "with_first_ancestors": (mpfjax.smoothing.with_first_ancestors, {"filter": INDEPENDENT}),
    "mixture_weight_errors": (mixture_weight_errors, {"run": TRACED}),
    "log_marginal_likelihood_variance": (
        log_marginal_likelihood_variance, {"run": TRACED}
    ),
}  # fmt: skip
# What an argument is called further down.
ALSO = {"max_components": "num_components", "order": "orders", "object_model": "model"}
SPECIAL = (
    None, True, False, 0, 1, 2, -1, 10**30, 0.5, 2.5, float("nan"), float("inf"), -float("inf"),
    1e300, 1e-320, "", "systematic", "none", b"x", 1j, object(), int, len, nothing, [], (), {},
    [1.0], [[1.0]], [1, [2]], {"a": 1.0}, np.float32(0.5), np.int64(2), np.bool_(True),
    np.array([]), np.zeros((2, 0)), np.array([np.nan]), np.array("a"), np.array([None]),
    np.array([1.0, 2.0], ">f8"), np.array([1, 2], ">i4"), np.array([1.0, 2.0], np.longdouble),
    np.longdouble(0.5), np.array([1, 2], np.uint8), np.array([2**40, 1]), np.array([1 + 1j, 2]),
    np.ma.masked_array([1.0, 2.0], [True, False]), np.array([1, 2], "m8[s]"),
    np.timedelta64(2, "s"), datetime.timedelta(seconds=2), array.array("d", [1.0, 2.0]),
    collections.deque([1.0, 2.0]), decimal.Decimal("0.5"), fractions.Fraction(1, 2),
    jnp.array(0.5), jnp.array(2), jnp.zeros((2, 2)), KEY, KEY[None], jax.random.PRNGKey(0),
    MODEL, JOINT, FILTER, MIXTURE, mpfjax.QuadraticModel, mpfjax.Resample(), mpfjax.KMeans(1),
    mpfjax.Merge(), mpfjax.GaussNewtonProposal(MODEL), mpfjax.RandomWalk([1.0]),
)  # fmt: skip
numbers = st.one_of(st.integers(-3, 6), st.floats(width=32), st.floats())
values = st.one_of(
    st.sampled_from(SPECIAL),
    st.sampled_from(SPECIAL),
    numbers,
    st.lists(numbers, max_size=3),
    st.lists(st.lists(st.floats(-2, 2), min_size=1, max_size=2), max_size=2),
    st.text(max_size=3),
    st.lists(numbers, max_size=3).map(np.array),
)


@st.composite
def calls(draw, table):
    """A function's name, the arguments of a call, and the names of those that are hostile."""
    name = draw(st.sampled_from(sorted(table)))
    good = table[name][1]
    changed = draw(st.lists(st.sampled_from(sorted(good)), min_size=1, max_size=2, unique=True))
    return name, good | {argument: draw(values) for argument in changed}, changed


def outcome(function, arguments, changed):
    """What was made of it, or "named" for an error that names what is wrong."""
    try:
        return function(**arguments)
    except (ValueError, TypeError) as error:
        message = "\n".join([str(error), *getattr(error, "__notes__", [])])
    except RuntimeError as error:  # broken densities, which are found as the filter runs
        message = str(error)
        assert re.search("observation|density", message), message
        return "named"
    names = {name for argument in changed for name in (argument, ALSO.get(argument, argument))}
    assert any(re.search(rf"\b{name}\b", message) for name in names), (
        f"{changed} = {[arguments[name] for name in changed]!r}: {message}"
    )
    return "named"


def assert_finite(tree):
    for leaf in jax.tree.leaves(tree):
        if eqx.is_inexact_array(leaf):
            assert np.isfinite(leaf).all(), tree


def is_moderate(tree):
    """Whether no number of the input leads to rounding or overflow by itself."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree) if eqx.is_inexact_array(leaf)]
    sizes = np.concatenate([np.abs(leaf).ravel() for leaf in leaves] or [np.ones(1)])
    return bool(((sizes == 0) | ((sizes > 1e-3) & (sizes < 1e3))).all())


def assert_sound(made):
    """What was built draws finite numbers, if its own are moderate."""
    if not is_moderate(made):
        return
    if isinstance(made, mpfjax.QuadraticModel):
        if max(abs(made.low), abs(made.high)) < 1e3:
            states = made.sample_initial(KEY, 4)
            assert_finite((states, made.log_transition(states, states)))
    elif isinstance(made, AbstractDynamics) and made.is_shared:
        rows = jnp.ones((4, jax.tree.leaves(made)[0].shape[-1]))
        assert_finite(made.sample(KEY, rows, rows))
    elif isinstance(made, mpfjax.PairwiseRepulsion) and made.position is None:
        assert_finite(made(jnp.ones((4, 2)), jnp.zeros((4, 2))))


def check_built(call):
    name, arguments, changed = call
    made = outcome(BUILT[name][0], arguments, changed)
    if isinstance(made, str):
        return made
    assert_sound(made)
    return "works"


unhurried = functools.partial(
    settings,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def test_every_public_constructor_and_runner_is_tried():
    public = {
        name
        for name, value in vars(mpfjax).items()
        if inspect.isclass(value) or inspect.isfunction(value)
    }
    tried = {name.split(".")[0] for name in (*BUILT, *RUN)}
    others = {name for name in public - tried if not name.startswith(("Abstract", "_"))}
    # Records of results, what takes no argument to check, and what other tests are about.
    assert others == {
        "FilterRun", "StepInfo", "Series", "Checkpoint", "ParticleMixture", "Pool",
        "load_checkpoint", "save_checkpoint", "normal", "read_study", "run_study",
        "NetworkProposal", "keep_programs", "check_model", "map_moves",
    } - tried  # fmt: skip


@pytest.mark.parametrize("table", [BUILT, RUN], ids=["constructors", "runners"])
def test_the_good_calls_work(table):
    for name, (function, arguments) in table.items():
        assert function(**arguments) is not None, name


@unhurried(max_examples=1000)
@given(calls(BUILT))
def test_constructors_work_or_name_the_argument(call):
    check_built(call)


@unhurried(max_examples=150)
@given(calls(RUN))
def test_runners_work_or_name_the_argument(call):
    name, arguments, changed = call
    outcome(RUN[name][0], arguments, changed)


@pytest.mark.weekly
def test_a_hundred_thousand_constructors():
    found = collections.Counter()

    @unhurried(max_examples=100_000)
    @given(calls(BUILT))
    def check(call):
        found[check_built(call)] += 1

    check()
    print(dict(found))
