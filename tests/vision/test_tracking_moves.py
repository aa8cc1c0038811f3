"""The moves of the object tracker, each against an oracle of its own: Kalman, scipy, numpy."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from mpfjax.mixture import ParticleMixture
from mpfjax.vision import Detections, HSVColours, SampledHistogram
from mpfjax.vision.tracking.appearance import LearnAppearance
from mpfjax.vision.tracking.assignment import Assign, _marginals_of_logs, marginals
from mpfjax.vision.tracking.births import Births, ShareMass
from mpfjax.vision.tracking.camera import FollowCamera
from mpfjax.vision.tracking.deaths import Deaths
from mpfjax.vision.tracking.fates import Fates
from mpfjax.vision.tracking.memory import Lives, Scores, mean_boxes
from mpfjax.vision.tracking.model import AssignedFrame, DetectedObjectModel, ObjectState
from mpfjax.vision.tracking.motion import PropagateObjects
from mpfjax.vision.tracking.noise import LearnNoise
from mpfjax.vision.tracking.observation import TrackedFrame, overlap
from mpfjax.vision.tracking.scores import RankScores
from tests.marking import thorough

KEY = jax.random.key(3)
M, P, D = 4, 10, 6
MODEL = DetectedObjectModel(
    [0.2, 0.1, 0.2, 0.12], [0.06, 0.03, 0.03, 0.015], [0.02, 0.01, 0.01, 0.01]
)


@eqx.filter_jit
def moved_by(move, key, mixture, observation):
    """The mixture after a move, as one program: one operation after the other compiles longer."""
    return move(key, mixture, observation)


# --- the exact step ------------------------------------------------------------------------------


def kalman(mean, cov, noise, detection, error, kept):
    """One coordinate's prediction and update by matrices: the moments, and log N(d; ...)."""
    step = np.array([[1, 1], [0, 1]])
    cov = step @ cov @ step.T + np.diag(np.square(noise))
    mean = step @ mean * [1, kept]
    total = cov[0, 0] + error**2
    gap = detection - mean[0]
    gain = cov[:, 0] / total
    log_z = -0.5 * gap**2 / total - 0.5 * np.log(total)
    return mean + gain * gap, cov - np.outer(gain, cov[0]), log_z


def step_by_hand(mixture, source, boxes, strong):
    """Kalman's posterior of every hypothesis along each coordinate, and its predictive density."""
    states, moments, log_z = mixture.particles, [], np.zeros(M * P)
    for i in range(M * P):
        size = np.exp(np.asarray(states.place[i, 2:], float))
        d = boxes[source[states.label[i]]]
        rows = []
        for k in range(4):
            unit, own = (size[k], d[2 + k]) if k < 2 else (1.0, 1.0)
            var, cov, var_velocity = np.asarray(states.spread[i, :, k], float)
            noise = unit * np.array([MODEL.place_noise[k], MODEL.velocity_noise[k]], float)
            error = own * float(MODEL.detection_deviations[k])
            error *= 1.0 if strong[source[states.label[i]]] else 1.35
            mean, after, z = kalman(
                np.array([states.place[i, k], states.velocity[i, k]], float),
                np.array([[var, cov], [cov, var_velocity]]),
                noise,
                d[k] if k < 2 else np.log(d[k]),
                error,
                1.0 if k < 2 else 0.9,
            )
            rows.append([*mean, after[0, 0], after[0, 1], after[1, 1]])
            log_z[i] += z
        moments.append(rows)
    return np.array(moments), log_z


@pytest.mark.parametrize("doubt", [0.0, 0.3])
def test_a_step_is_kalmans_where_the_detection_is_its_own(doubt):
    """Each hypothesis is followed by hand, and the share that follows is (1 - doubt) Z_i / Z."""
    mixture, frame = tracked()
    source = np.array([0, 1, 2, 4])
    memory = mixture.memory | {
        "assigned": jnp.asarray(source, jnp.int32),
        "doubts": jnp.full(M, doubt),
    }
    boxes = np.asarray(frame.detections.boxes, float)
    expected, log_z = step_by_hand(mixture, source, boxes, [True, False, True, True, True, False])
    moved = moved_by(PropagateObjects(MODEL), KEY, mixture.replace(memory=memory), frame)
    occupied = np.asarray(mixture.occupied)
    got = np.stack(moved.particles.gaussian, axis=2)
    follows = np.abs(got - expected).max(axis=(1, 2)) < 1e-2
    weights = np.asarray(mixture.component_weights, float)
    for m in range(3):
        own = np.asarray(mixture.component_indicators) == m
        z = np.exp(log_z[own] - log_z[own].max())
        factors = (1 - doubt) * z / (weights[own] @ z) + doubt
        after = weights[own] * factors / (weights[own] @ factors)
        np.testing.assert_allclose(np.asarray(moved.component_weights)[own], after, atol=1e-4)
    if doubt == 0:
        np.testing.assert_allclose(got[occupied], expected[occupied], rtol=2e-3, atol=2e-3)
    else:
        stays = MODEL.predicted(mixture.particles, MODEL.noises).gaussian
        left = np.abs(got - np.stack(stays, axis=2)).max(axis=(1, 2)) < 1e-5
        assert (follows | left)[occupied].all()
        assert follows[occupied].any()
        assert left[occupied].any()


def test_matched_moments_are_those_of_both_branches():
    """By second moments of Kalman's posterior and the prediction; no random number is drawn."""
    mixture, frame = tracked()
    source, doubt = np.array([0, 1, 2, 4]), 0.3
    memory = mixture.memory | {
        "assigned": jnp.asarray(source, jnp.int32),
        "doubts": jnp.full(M, doubt),
    }
    mixture = mixture.replace(memory=memory)
    boxes = np.asarray(frame.detections.boxes, float)
    followed, log_z = step_by_hand(mixture, source, boxes, [True, False, True, True, True, False])
    stays = np.stack(MODEL.predicted(mixture.particles, MODEL.noises).gaussian, axis=2)
    match = PropagateObjects(MODEL, matched=True)
    got = np.stack(moved_by(match, KEY, mixture, frame).particles.gaussian, axis=2)
    again = np.stack(moved_by(match, jax.random.key(8), mixture, frame).particles.gaussian, axis=2)
    np.testing.assert_array_equal(got, again)
    weights = np.asarray(mixture.component_weights, float)
    for m in range(3):
        own = np.asarray(mixture.component_indicators) == m
        z = np.exp(log_z[own] - log_z[own].max())
        odds = (1 - doubt) * z / (weights[own] @ z)
        share = (odds / (odds + doubt))[:, None]

        def moments(branches):
            x, v, var_x, cov, var_v = np.moveaxis(branches, 2, 0)
            return np.stack([x, v, var_x + x * x, cov + x * v, var_v + v * v], axis=2)

        both = share[..., None] * moments(followed[own])
        both = both + (1 - share[..., None]) * moments(stays[own])
        np.testing.assert_allclose(moments(got[own].astype(float)), both, rtol=2e-3, atol=2e-3)


def test_colours_are_looked_at_where_a_place_is_drawn():
    """The places that were drawn and what is left of velocities have the moments from before."""
    mixture, frame = tracked()
    model = DetectedObjectModel(sigma=0.3)
    some = jax.tree.map(lambda leaf: jnp.repeat(leaf[:1], 20_000, axis=0), mixture.particles)
    nobody = jnp.zeros(M, bool)
    assigned = AssignedFrame(
        frame.detections, nobody, jnp.zeros(M), frame.pixels,
        mixture.memory["references"],
    )  # fmt: skip
    drawn, log_likelihood = eqx.filter_jit(model.seen)(KEY, assigned, some)
    before = [np.asarray(moment[0]) for moment in some.gaussian]
    np.testing.assert_allclose(np.var(drawn.place, axis=0), before[2], rtol=0.05)
    total = np.var(drawn.velocity, axis=0) + np.mean(drawn.gaussian.var_velocity, axis=0)
    np.testing.assert_allclose(total, before[4], rtol=0.05)
    assert np.unique(log_likelihood).size > 100
    assert (np.asarray(log_likelihood) <= 0).all()


# --- what is learned of the noises and of the camera ----------------------------------------------


def followed(places, moves, num_frames, boxes_of_frame):
    """The memory after frames in which each of `places` has its own detection."""
    mixture, frame = tracked()
    memory = mixture.memory
    for move in moves:
        memory = memory | move.initial_memory(M)
    lives = memory["lives"]._replace(
        identities=jnp.arange(1, M + 1, dtype=jnp.int32), confirmed=jnp.ones(M, bool),
        seen=jnp.full(M, 9, jnp.int32),
    )  # fmt: skip
    memory |= {"lives": lives, "assigned": jnp.arange(M, dtype=jnp.int32)}
    mixture = mixture.replace(memory=memory)

    @jax.jit
    def step(mixture, boxes):
        found = Detections(boxes, jnp.ones(M, bool), jnp.ones(M))
        for move in moves:
            mixture = move(KEY, mixture, TrackedFrame(found, None))
        return mixture

    del frame, places
    for t in range(num_frames):
        mixture = step(mixture, jnp.asarray(boxes_of_frame(t), jnp.float32))
    return mixture


@pytest.mark.parametrize("error", [0.012, *thorough([0.04, 0.12])])
def test_the_detectors_errors_are_learned_in_a_second(error):
    """Four objects that walk steadily, and detections that err by so much of a box."""
    rng = np.random.default_rng(0)
    start, pace = rng.uniform(100, 900, (M, 2)), rng.normal(0, 3, (M, 2))

    def boxes(t):
        noise = rng.normal(0, error, (M, 4))
        size = np.array([50.0, 120]) * np.exp(noise[:, 2:])
        return np.c_[start + pace * t + noise[:, :2] * [50, 120], size]

    noises = followed(None, [LearnNoise(MODEL)], 40, boxes).memory["noises"]
    assert (np.asarray(noises.errors) < 2 * error).all()
    assert (np.asarray(noises.errors) > error / 2).all()
    # Nothing but the detector errs.
    assert (np.asarray(noises.velocity) < 0.006).all()


def test_who_moves_at_random_is_not_taken_for_a_bad_detector():
    rng = np.random.default_rng(0)
    paths = 500 + np.cumsum(np.cumsum(rng.normal(0, 0.03, (50, M, 2)), axis=0), axis=0) * [50, 120]
    size = np.tile([50.0, 120], (M, 1))
    noises = followed(None, [LearnNoise(MODEL)], 50, lambda t: np.c_[paths[t], size]).memory[
        "noises"
    ]
    assert (np.asarray(noises.velocity)[:2] > 0.01).all()
    assert (np.asarray(noises.errors)[:2] < 0.04).all()
    assert (np.asarray(noises.velocity)[2:] < 0.006).all()


def test_the_speed_of_newborn_objects_is_the_scale_of_those_before():
    """Four objects whose first detections come anew in every frame, as often as it takes."""
    move, (mixture, frame) = LearnNoise(MODEL, first=9), tracked()
    boxes = np.asarray(frame.detections.boxes)[:M]
    noises = followed(None, [move], 300, lambda t: boxes).memory["noises"]
    moments, unit = mixture.particles.gaussian, np.ones((M, 4))
    unit[:, :2] = np.exp(np.asarray(mixture.component_averages(moments.place))[:, 2:])
    squares = mixture.component_averages(moments.velocity**2 + moments.var_velocity)
    squares = np.asarray(squares, float) / unit**2
    # One in 50 is forgotten; the prior counts as four.
    number = M / (1 - (1 - 1 / 50) ** M)
    prior = expected = np.asarray(MODEL.start_velocity, float) ** 2
    for _ in range(1000):
        trust = (move.freedom + 1) / (move.freedom + squares / expected)
        expected = (4 * prior + number * np.mean(trust * squares, axis=0)) / (4 + number)
    np.testing.assert_allclose(np.asarray(noises.start_velocity) ** 2, expected, rtol=0.01)


def _little(spread):
    return 1e-4 * spread


@pytest.mark.parametrize("outlier", [0.0, 60.0])
def test_what_all_have_in_common_is_the_cameras(outlier):
    """All are found a tenth of a box to the right, and one of them perhaps far below."""
    mixture, _ = tracked()
    camera = FollowCamera(Assign(DetectedObjectModel()))
    mixture = eqx.tree_at(lambda mixture: mixture.particles.spread, mixture, replace_fn=_little)
    lives = mixture.memory["lives"]._replace(confirmed=jnp.array([True] * 3 + [False]))
    mixture = mixture.replace(memory=mixture.memory | camera.initial_memory(M) | {"lives": lives})
    boxes = np.asarray(mean_boxes(mixture)) + np.array([0.7, 0, 0, 0])
    boxes[:, :2] += np.asarray(mixture.component_averages(mixture.particles.velocity))[:, :2]
    boxes[2, 1] += outlier / 20
    boxes[3] = [500, 500, 7, 12]
    found = Detections(jnp.asarray(boxes, jnp.float32), jnp.ones(M, bool), jnp.ones(M))
    shifts = []
    for _ in range(30):
        moved = moved_by(camera, KEY, mixture, TrackedFrame(found, None))
        shifts.append(np.asarray(moved.memory["camera"].shift))
        mixture = mixture.replace(memory=moved.memory)
        np.testing.assert_allclose(
            moved.particles.place[:, :2] - mixture.particles.place[:, :2],
            np.broadcast_to(shifts[-1], (M * P, 2)),
            atol=1e-4,
        )
    assert abs(shifts[0][0]) < 0.4  # nobody shakes a camera as long as nobody has
    np.testing.assert_allclose(shifts[-1], [0.7, 0.0], atol=0.25)


# --- what leaves the particles alone ------------------------------------------------------------

COLOURS = HSVColours(4, 2, 2)


# Variances of place, covariances, and variances of velocity.
SPREAD = np.array([[1.0, 2.0, 0.01, 0.02], [0.2, 0.3, 0.001, 0.002], [0.1, 0.2, 0.0005, 0.001]])


def tracked(seed=0):
    """A mixture of three objects with a memory, one component dead, and a frame of detections."""
    rng = np.random.default_rng(seed)
    centres = np.array([[20.0, 20], [28, 21], [60, 40], [0, 0]])
    label = np.repeat(np.arange(M), P).astype(np.int32)
    place = np.c_[centres[label], np.full((M * P, 2), [2.0, 2.5])]
    place += rng.normal(0, [1, 1, 0.05, 0.05], (M * P, 4))
    weights = np.where(label < 3, rng.uniform(0.5, 1, M * P), 0)
    with np.errstate(divide="ignore"):
        log_weights = np.log(weights / weights.sum())
    references = rng.uniform(0, 1, (M, 2, 1, COLOURS.num_bins))
    references[2:] = 0
    references /= np.maximum(references.sum(axis=3, keepdims=True), 1e-9)
    lives = Lives(
        jnp.array([3, 5, 6, 0], jnp.int32),
        jnp.asarray(6, jnp.int32),
        jnp.array([9, 5, 1, 0], jnp.int32),
        jnp.array([0, 2, 0, 0], jnp.int32),
        jnp.array([0, 2, 0, 0], jnp.int32),
        jnp.array([True, True, False, False]),
        jnp.array([True, True, False, False]),
        jnp.asarray(False),
        jnp.asarray(True),
    )
    weak, strong = jnp.asarray(0.2, jnp.float32), jnp.asarray(0.5, jnp.float32)
    mixture = ParticleMixture(
        particles=ObjectState(
            jnp.asarray(place, jnp.float32),
            jnp.asarray(rng.normal(0, [0.3, 0.3, 0.01, 0.01], (M * P, 4)), jnp.float32),
            jnp.asarray(SPREAD * rng.uniform(0.5, 1, (M * P, 1, 1)), jnp.float32),
            jnp.asarray(label),
        ),
        log_weights=jnp.asarray(log_weights, jnp.float32),
        component_indicators=jnp.asarray(label),
        ancestor_indices=jnp.arange(M * P, dtype=jnp.int32),
        num_components=M,
        memory={
            "scores": Scores(jnp.zeros(512), jnp.zeros((), jnp.int32), weak, strong),
            "fates": Fates.none(M),
            "lives": lives,
            "assigned": jnp.array([0, -1, 2, -1], jnp.int32),
            "doubts": jnp.zeros(M),
            "references": jnp.asarray(references, jnp.float32),
        },
    )
    boxes = [[20.5, 20, 7, 12], [27, 22, 8, 12], [59, 41, 7, 13], [21, 19, 7, 11], [70, 10, 7, 12]]
    found = Detections(
        jnp.asarray([*boxes, [1, 1, 1, 1]], jnp.float32),
        jnp.array([True] * 5 + [False]),
        jnp.asarray([0.9, 0.3, 0.8, 0.7, 0.95, 0.0], jnp.float32),
    )
    pixels = SampledHistogram(
        jnp.asarray(rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)), COLOURS
    )
    return mixture, TrackedFrame(found, pixels)


QUIET = {
    "scores": RankScores(),
    "assign": Assign(MODEL, 10.0),
    "learn": LearnAppearance(COLOURS, 2),
}
CHANGES = {"scores": ["scores", "fates"], "assign": ["assigned", "doubts"], "learn": ["references"]}


@pytest.mark.parametrize("name", QUIET)
def test_what_only_remembers_leaves_the_distribution_as_it_is(name):
    mixture, frame = tracked()
    moved = moved_by(QUIET[name], KEY, mixture, frame)
    for before, after in zip(
        jax.tree.leaves(mixture.replace(memory={})),
        jax.tree.leaves(moved.replace(memory={})),
        strict=True,
    ):
        np.testing.assert_array_equal(before, after)
    changed = [
        name
        for name, kept in mixture.memory.items()
        if not all(jax.tree.leaves(jax.tree.map(np.array_equal, kept, moved.memory[name])))
    ]
    assert changed == CHANGES[name]


def test_what_decides_is_approximate_and_what_follows_is_not():
    approximate = [
        Assign(MODEL),
        Deaths(),
        Births(MODEL, P),
        LearnAppearance(COLOURS),
        ShareMass(),
    ]
    assert all(move.approximate for move in approximate)
    assert not PropagateObjects(MODEL).approximate
    assert not RankScores().approximate


GATE = 10.0


def test_the_assignment_is_scipys():
    """Costs from moments by hand, and the pairs that scipy picks."""
    mixture, frame = tracked()
    costs = np.asarray(eqx.filter_jit(Assign(MODEL, GATE).costs)(mixture, frame), float)
    weights = np.asarray(mixture.component_weights, float)
    states = mixture.particles
    place, spread = np.asarray(states.place, float), np.asarray(states.spread, float)
    moved = place + np.asarray(states.velocity)
    noise = np.asarray(MODEL.place_noise) * np.c_[np.exp(place[:, 2:]), np.ones((M * P, 2))]
    variances = spread[:, 0] + 2 * spread[:, 1] + spread[:, 2] + noise**2
    boxes = np.asarray(frame.detections.boxes, float)
    assert isinstance(frame.pixels, SampledHistogram)
    seen = np.asarray(frame.pixels.counts(frame.detections.boxes, 2), float)
    seen /= np.maximum(seen.sum(axis=3, keepdims=True), 1)
    expected = np.full((M, D), np.inf)
    for m in range(3):
        own = np.asarray(mixture.component_indicators) == m
        mean = weights[own] @ moved[own]
        variance = weights[own] @ ((moved[own] - mean) ** 2 + variances[own])
        unit = np.r_[np.exp(mean[2:]), 1, 1]
        total = variance + (unit * np.array([0.2, 0.1, 0.2, 0.12])) ** 2
        for d in range(5):
            gap = np.r_[boxes[d, :2], np.log(boxes[d, 2:])] - mean
            cost = 8 * np.log1p((gap**2 / total).sum() / 4) + np.log(total / unit**2).sum()
            if m < 2:
                reference = np.asarray(mixture.memory["references"][m], float)
                cost += 14 * (np.mean(1 - np.sqrt(reference * seen[d]).sum(axis=2)) - 0.25)
            cost += 8 * (d == 1) + 2 * (m == 2)
            expected[m, d] = cost if cost < GATE else np.inf
    possible = np.isfinite(expected)
    assert 3 < possible.sum() < 10
    np.testing.assert_array_equal(costs < 1e4, possible)
    np.testing.assert_allclose(costs[possible], expected[possible], rtol=2e-3)
    # "None" costs the gate: to give one component a detection is never to take a dearer one.
    none = np.where(np.eye(M, dtype=bool), GATE, 1e4)
    rows, columns = linear_sum_assignment(np.c_[np.where(possible, expected, 1e4), none])
    source = np.full(M, -1)
    source[rows] = np.where(columns < D, columns, -1)
    assigned = moved_by(Assign(MODEL, GATE), KEY, mixture, frame).memory["assigned"]
    np.testing.assert_array_equal(assigned, source)
    assert (source >= 0).sum() == 3


def brute_force(odds):
    """The marginals, by summing over all assignments."""
    m, d = odds.shape
    total, pairs = 0.0, np.zeros((m, d))
    for columns in itertools.product(range(-1, d), repeat=m):
        taken = [column for column in columns if column >= 0]
        if len(set(taken)) == len(taken):
            chosen = [(row, column) for row, column in enumerate(columns) if column >= 0]
            weight = np.prod([odds[pair] for pair in chosen]) if chosen else 1.0
            total += weight
            for pair in chosen:
                pairs[pair] += weight
    return pairs / total


@pytest.mark.parametrize(("loops", "bound"), [(False, 1e-5), (True, 0.15)])
def test_the_marginals_are_those_of_all_assignments(loops, bound):
    """Exact where the pairs form no loop, and else off by .03 on average."""
    rng = np.random.default_rng(7)
    compute, gaps = jax.jit(marginals), []
    for _ in range(20):
        log_odds = rng.normal(1, 2, (3, 4))
        if not loops:  # a chain: row 0 with columns 0 and 1, row 1 with 1 and 2, row 2 with 2 and 3
            log_odds[np.abs(np.arange(4)[None] - np.arange(3)[:, None] - 0.5) > 0.5] = -np.inf
        expected = brute_force(np.exp(log_odds))
        gaps.append(np.abs(np.asarray(compute(jnp.asarray(log_odds))) - expected))
    assert np.max(gaps) < bound
    assert np.mean(gaps) < bound / 5


def test_marginals_of_large_odds_are_no_overflow():
    """As a low temperature makes them: the better pairing of two is certain, by any scale."""
    log_odds = jnp.array([[400.0, 350.0, -jnp.inf], [380.0, 300.0, -jnp.inf], [-900.0, 20.0, 19.0]])
    found = np.asarray(jax.jit(marginals)(log_odds))
    logs = jnp.asarray(np.random.default_rng(7).normal(1, 2, (3, 3)))
    np.testing.assert_allclose(_marginals_of_logs(logs), marginals(logs), atol=1e-5)
    # 350 + 380 beats 400 + 300, and the third row goes to the third column.
    np.testing.assert_allclose(found, [[0, 1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-4)


def test_how_far_off_the_marginals_are_is_as_said():
    """The worst case of the docstring, and no worse one among two by two with log odds up to 5."""
    compute = jax.jit(jax.vmap(marginals))
    worst = np.array([[4.94, 4.3], [4.35, 4.26]])
    grid = np.array(list(itertools.product([-1.0, 2.0, 4.0, 5.0], repeat=4))).reshape(-1, 2, 2)
    problems = np.concatenate([worst[None], grid])
    found = np.asarray(compute(jnp.asarray(problems)))
    exact = np.array([brute_force(np.exp(log_odds)) for log_odds in problems])
    assert found[0, 0, 0] == pytest.approx(0.88, abs=0.005)
    assert exact[0, 0, 0] == pytest.approx(0.63, abs=0.005)
    gaps = np.abs(found - exact)
    assert 0.2 < gaps.max() < 0.3
    surer = np.abs(found - 0.5) > np.abs(exact - 0.5)
    assert surer[gaps > 0.05].all()


def test_doubts_are_what_the_marginals_leave():
    """By summing over all assignments."""
    mixture, frame = tracked()
    move = Assign(MODEL, GATE)
    moved = moved_by(move, KEY, mixture, frame)
    source = np.asarray(moved.memory["assigned"])
    costs = np.asarray(eqx.filter_jit(move.costs)(mixture, frame), float)
    probability = brute_force(np.where(costs < 1e4, np.exp((GATE - costs) / 4), 0))
    assert (source[:3] >= 0).all()
    for m in range(3):
        np.testing.assert_allclose(
            moved.memory["doubts"][m], 1 - probability[m, source[m]], atol=0.1
        )
    assert moved.memory["doubts"][3] == 0


def test_no_detection_costs_the_gate():
    """Of two components and two detections, one pair is rather made than two dear ones."""
    mixture, frame = tracked()
    chosen = {}
    for cost in (4.0, 12.0):
        move = Priced(MODEL, GATE, prices=((0.0, cost), (cost, 25.0)))
        chosen[cost] = np.asarray(move(KEY, mixture, frame).memory["assigned"])[:2].tolist()
    assert chosen == {4.0: [1, 0], 12.0: [0, -1]}


class Priced(Assign):
    """Costs that a test chooses."""

    prices: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=())

    def costs(self, mixture, observation, slack=None):
        del observation, slack
        costs = np.full((mixture.num_components, D), 1e4, np.float32)
        costs[:2, :2] = self.prices
        return jnp.asarray(np.where(costs < self.gate, costs, 1e4))


# --- scores, births, deaths, masses -------------------------------------------------------------


def ranked(frames):
    """The thresholds after frames of scores, through one compiled step of room for four."""
    move, mixture = RankScores(0.5, 0.25), tracked()[0]
    step = jax.jit(lambda mixture, found: move(KEY, mixture, TrackedFrame(found, None)))
    mixture = mixture.replace(memory=mixture.memory | move.initial_memory(M))
    for number, scores in enumerate(frames):
        valid = np.arange(4) < len(scores)
        padded = np.r_[scores, np.full(4 - len(scores), 99.0)]
        boxes = jnp.ones((4, 4)).at[:, 0].set(2.0 * np.arange(4) + 8 * number)
        found = Detections(boxes, jnp.asarray(valid), jnp.asarray(padded, jnp.float32))
        mixture = step(mixture, found)
    memory = mixture.memory["scores"]
    return float(memory.weak), float(memory.strong)


@pytest.mark.parametrize("lowest", [0.0, -40.0])
def test_thresholds_are_shares_of_a_sure_score(lowest):
    """The 0.9 quantile of the last 512 scores; older ones are forgotten. None lasts here."""
    rng = np.random.default_rng(2)
    frames = [list(rng.uniform(lowest, 80, rng.integers(0, 5))) for _ in range(400)]
    recent = [score for scores in frames for score in scores][-512:]
    sure, low = np.quantile(recent, 0.9, method="higher"), min(0.0, min(recent))
    weak, strong = ranked(frames)
    np.testing.assert_allclose(weak, low + 0.25 * (sure - low), rtol=1e-5)
    assert low + 0.5 * (sure - low) < strong <= low + 0.9 * (sure - low)
    np.testing.assert_allclose(ranked([[80.0]]), [20, 40], rtol=1e-5)


@pytest.mark.parametrize("score", [1.0, 0.0, -3.0, 1e-20])
def test_equal_scores_are_all_strong(score):
    weak, strong = ranked([[score] * 3] * 4)
    assert weak <= strong <= np.float32(score)


def test_given_thresholds_are_kept():
    found = tracked()[1].detections
    move = RankScores(strong_score=7.0, weak_score=2.0)
    moved = moved_by(move, KEY, tracked()[0], TrackedFrame(found, None))
    assert (float(moved.memory["scores"].weak), float(moved.memory["scores"].strong)) == (2, 7)


def test_who_founds_is_strong_and_nobodys_and_no_double():
    """Detection 3 is a double of a component's, 1 is weak, 0 and 2 are taken; 4 founds."""
    mixture, frame = tracked()
    move = Births(MODEL, P, 0.4)
    np.testing.assert_array_equal(move.founding(mixture, frame), [0, 0, 0, 0, 1, 0])
    moved = moved_by(move, KEY, mixture, frame)
    lives = moved.memory["lives"]
    np.testing.assert_array_equal(lives.identities, [3, 5, 6, 7])
    assert int(lives.last_identity) == 7
    assert not lives.full
    np.testing.assert_array_equal(moved.memory["assigned"], [0, -1, 2, 4])
    born = np.asarray(moved.component_indicators) == 3
    assert born.sum() == P
    np.testing.assert_allclose(
        np.asarray(moved.particles.place)[born].mean(0)[:2], [70, 10], atol=2
    )
    twice = frame._replace(
        detections=Detections(
            frame.detections.boxes.at[5].set(jnp.array([71.0, 10, 7, 12])),
            jnp.ones(D, bool),
            frame.detections.scores.at[5].set(0.9),
        )
    )
    np.testing.assert_array_equal(move.founding(mixture, twice), [0, 0, 0, 0, 1, 0])


def test_who_is_gone_is_emptied():
    mixture, frame = tracked()
    moved = moved_by(Deaths(2, 2), KEY, mixture, frame)
    # The second has been unseen for a third frame; the third is confirmed by its second.
    np.testing.assert_array_equal(moved.active, [True, False, True, False])
    np.testing.assert_array_equal(moved.memory["lives"].confirmed, [True, True, True, False])
    kept = moved_by(Deaths(2, 3), KEY, mixture, frame)
    np.testing.assert_array_equal(kept.log_weights, mixture.log_weights)
    # Believed in at once, as in a first frame, and seen no more: waited for while there is room.
    lives = mixture.memory["lives"]
    for full in (False, True):
        once = lives._replace(seen=jnp.ones_like(lives.seen), full=jnp.asarray(full))
        memory = mixture.memory | {"lives": once}
        gone = Deaths(2, 3, longest_guess=1)(KEY, mixture.replace(memory=memory), frame)
        np.testing.assert_array_equal(gone.active, [True, not full, True, False])


@pytest.mark.parametrize(
    ("patience", "full", "stays"), [(1, False, 1), (1, True, 0), (0, False, 0)]
)
def test_who_is_not_confirmed_may_be_missed_where_there_is_room(patience, full, stays):
    """The third has one strong detection before this frame, and none in it."""
    mixture, frame = tracked()
    lives = mixture.memory["lives"]._replace(full=jnp.asarray(full))
    assigned = mixture.memory["assigned"].at[2].set(-1)
    mixture = mixture.replace(memory=mixture.memory | {"lives": lives, "assigned": assigned})
    move = Deaths(2, 20, tentative_patience=patience)
    moved = moved_by(move, KEY, mixture, frame)
    np.testing.assert_array_equal(moved.active, [True, True, stays, False])
    assert not moved.memory["lives"].confirmed[2]
    np.testing.assert_array_equal(
        moved_by(move, KEY, moved, frame).active, [True, True, False, False]
    )


def test_masses_are_shared_and_weights_within_components_kept():
    mixture, frame = tracked()
    moved = moved_by(ShareMass(), KEY, mixture, frame)
    np.testing.assert_allclose(moved.mixture_weights, [1 / 3, 1 / 3, 1 / 3, 0], rtol=1e-5)
    np.testing.assert_allclose(moved.component_weights, mixture.component_weights, rtol=1e-4)


def test_overlap_is_that_of_the_metrics():
    from mpfjax.metrics.tracking_scores import overlap as counted
    from mpfjax.vision.files.boxes import top_left

    rng = np.random.default_rng(4)
    a, b = rng.uniform(1, 20, (2, 7, 4))
    expected = counted(top_left(a), top_left(b))
    np.testing.assert_allclose(
        overlap(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32)), expected, atol=1e-5
    )
