"""The moves of the object tracker, each against an oracle of its own: Kalman, scipy, numpy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import mpfjax
from mpfjax.mixture import ParticleMixture
from mpfjax.vision import Detections, HSVColours, SampledHistogram
from mpfjax.vision.tracking.assignment import Assign, marginals
from mpfjax.vision.tracking.births import Found, ShareMass
from mpfjax.vision.tracking.colours import LearnColours
from mpfjax.vision.tracking.contact import ShareDetections
from mpfjax.vision.tracking.deaths import Bury
from mpfjax.vision.tracking.memory import Lives, Scores
from mpfjax.vision.tracking.model import AssignedFrame, DetectedObjectModel, ObjectState
from mpfjax.vision.tracking.motion import PropagateObjects
from mpfjax.vision.tracking.observation import TrackedFrame, overlap
from mpfjax.vision.tracking.proposal import DetectionProposal
from mpfjax.vision.tracking.scores import RankScores
from tests.marking import thorough

POSITION, VELOCITY, SIZE = np.array([0.4, 0.3]), np.array([0.3, 0.2]), np.array([1e-4, 1e-4])
ERRORS = np.array([0.5, 0.6, 0.3, 0.3])
KEY = jax.random.key(3)


def model_of(miss=1e-9):
    return DetectedObjectModel(POSITION, VELOCITY, SIZE, ERRORS, miss=miss)


# --- the exact step: E[Ẑ / Z] = 1 ---------------------------------------------------------------


def seen_at(x, y):
    """One detection of one pixel by one, so that lengths in boxes are lengths in pixels."""
    boxes = jnp.asarray([[x, y, 1.0, 1.0]], jnp.float32)
    return TrackedFrame(Detections(boxes, jnp.array([True]), jnp.ones(1)), None)


def start(num_particles):
    """One object at the origin, at rest and of one pixel by one, whose detection is the first."""
    n = num_particles
    zero = jnp.zeros(())
    return ParticleMixture(
        particles=ObjectState(jnp.zeros((n, 4)), jnp.zeros((n, 2)), jnp.zeros(n, jnp.int32)),
        log_weights=jnp.full(n, -np.log(n), jnp.float32),
        component_indicators=jnp.zeros(n, jnp.int32),
        ancestor_indices=jnp.arange(n, dtype=jnp.int32),
        num_components=1,
        memory={
            "assigned": jnp.zeros(1, jnp.int32),
            "doubts": jnp.zeros(1),
            "references": jnp.zeros((1, 1, 1, 2)),
            "scores": Scores(jnp.zeros(4), jnp.zeros((), jnp.int32), zero, zero),
        },
    )


def kalman_likelihood(detections, informative):
    """Π over informative steps of ∫ N(x; prediction) exp(-½ (d - x)² / r²) dx, along both axes."""
    likelihood = 1.0
    for axis in range(2):
        q, v, r = POSITION[axis] ** 2, VELOCITY[axis] ** 2, ERRORS[axis] ** 2
        mean, cov = np.zeros(2), np.zeros((2, 2))
        step, noise = np.array([[1, 1], [0, 1]]), np.array([[q + v, v], [v, v]])
        for detection, counts in zip(detections[:, axis], informative, strict=True):
            mean, cov = step @ mean, step @ cov @ step.T + noise
            if counts:
                total = cov[0, 0] + r
                gap = detection - mean[0]
                likelihood *= np.sqrt(r / total) * np.exp(-0.5 * gap**2 / total)
                gain = cov[:, 0] / total
                mean, cov = mean + gain * gap, cov - np.outer(gain, cov[0])
    # Sizes hardly move, and are seen as they are.
    return likelihood


@pytest.mark.parametrize("miss", [0.2, *thorough([1e-9])])
def test_the_marginal_likelihood_is_unbiased(miss):
    """Against Kalman filters, summed over which detections were of something else."""
    detections = np.array([[0.5, -0.2], [1.6, 0.3], [1.9, 1.4], [3.8, 1.0]])
    exact = sum(
        kalman_likelihood(detections, informative) * miss ** (4 - sum(informative))
        for informative in itertools.product([0, 1], repeat=4)
    )
    model = model_of(miss)
    moves = [mpfjax.Resample(), PropagateObjects(model)]
    filter = mpfjax.Filter(model, moves, 64)
    frames = [seen_at(*place) for place in detections]

    def log_likelihood(key):
        mixture, total = start(64), jnp.zeros(())
        for step_key, frame in zip(jax.random.split(key, 4), frames, strict=True):
            mixture, info = filter.step(step_key, mixture, frame)
            total += info.log_likelihood_increment
        return total

    estimates = jax.jit(jax.vmap(log_likelihood))(jax.random.split(KEY, 400))
    ratios = np.exp(np.asarray(estimates, float)) / exact
    error = ratios.std() / np.sqrt(len(ratios))
    assert error < 0.03
    assert abs(ratios.mean() - 1) < 4 * error


def states_of(num):
    rng = np.random.default_rng(1)
    place = np.c_[rng.normal(0, 2, (num, 2)), rng.normal(2, 0.2, (num, 2))]
    velocity = rng.normal(0, 1, (num, 2))
    label = np.arange(num, dtype=np.int32) % 2
    return ObjectState(
        jnp.asarray(place, jnp.float32), jnp.asarray(velocity, jnp.float32), jnp.asarray(label)
    )


def frame_of_two():
    """Object 0 has a detection, which is weak, and object 1 has none."""
    found = Detections(
        jnp.asarray([[1.0, 2.0, 7.0, 8.0]] * 2, jnp.float32), jnp.array([True, False]), jnp.ones(2)
    )
    first, nobody = jnp.array([True, False]), jnp.array([False, False])
    doubts = jnp.array([0.02, 0.0])
    return AssignedFrame(found, first, nobody, nobody, doubts, None, jnp.zeros((2, 1, 1, 2)))


def test_the_proposal_is_optimal():
    """L D / q is the same whatever is drawn: that is what makes it the best."""
    model, previous, frame = model_of(0.05), states_of(6), frame_of_two()
    proposal = DetectionProposal(model)

    @jax.jit
    @jax.vmap
    def log_weights(key):
        states, log_density = proposal.propose(key, frame, previous)
        return (
            model.log_likelihood(frame, states)
            + model.log_transition(states, previous)
            - log_density
        )

    values = np.asarray(log_weights(jax.random.split(KEY, 50)))
    np.testing.assert_allclose(values, np.broadcast_to(values[:1], values.shape), atol=2e-3)
    # Who has no detection is weighed by nothing.
    np.testing.assert_allclose(values[:, 1::2], 0, atol=2e-3)


def test_draws_have_the_moments_of_the_density():
    """Place and velocity of the dynamics: shared shocks make them correlated."""
    model, previous = model_of(), states_of(1)
    many = jax.tree.map(lambda leaf: jnp.repeat(leaf, 40_000, axis=0), previous)
    drawn = model.sample_transition(KEY, many)
    unit = np.exp(np.asarray(previous.place[0, 2:]))
    sample = np.c_[np.asarray(drawn.place[:, :2]), np.asarray(drawn.velocity)] / np.r_[unit, unit]
    expected = np.zeros((4, 4))
    for axis in range(2):
        q, v = POSITION[axis] ** 2, VELOCITY[axis] ** 2
        expected[axis, axis] = q + v
        expected[axis, axis + 2] = expected[axis + 2, axis] = expected[axis + 2, axis + 2] = v
    np.testing.assert_allclose(np.cov(sample.T), expected, atol=0.006)


# --- what leaves the particles alone ------------------------------------------------------------

COLOURS = HSVColours(4, 2, 2)
M, P, D = 4, 10, 6


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
        jnp.array([9, 5, 1, 0], jnp.int32),
        jnp.array([0, 2, 0, 0], jnp.int32),
        jnp.array([True, True, False, False]),
        jnp.asarray(False),
        jnp.asarray(True),
    )
    weak, strong = jnp.asarray(0.2, jnp.float32), jnp.asarray(0.5, jnp.float32)
    mixture = ParticleMixture(
        particles=ObjectState(
            jnp.asarray(place, jnp.float32),
            jnp.asarray(rng.normal(0, 0.3, (M * P, 2)), jnp.float32),
            jnp.asarray(label),
        ),
        log_weights=jnp.asarray(log_weights, jnp.float32),
        component_indicators=jnp.asarray(label),
        ancestor_indices=jnp.arange(M * P, dtype=jnp.int32),
        num_components=M,
        memory={
            "scores": Scores(jnp.zeros(512), jnp.zeros((), jnp.int32), weak, strong),
            "lives": lives,
            "assigned": jnp.array([0, -1, 2, -1], jnp.int32),
            "shared": jnp.full(M, -1, jnp.int32),
            "hidden": jnp.zeros(M, jnp.int32),
            "references": jnp.asarray(references, jnp.float32),
            "extent": jnp.array([0, 0, 80, 60], jnp.float32),
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


MODEL = DetectedObjectModel([0.06, 0.03], [0.02, 0.01], [0.03, 0.015], [0.2, 0.1, 0.2, 0.12])
QUIET = {"scores": RankScores(), "assign": Assign(MODEL), "learn": LearnColours(COLOURS, 2)}
CHANGES = {"scores": ["scores"], "assign": ["assigned"], "learn": ["references"]}


@pytest.mark.parametrize("name", QUIET)
def test_what_only_remembers_leaves_the_distribution_as_it_is(name):
    mixture, frame = tracked()
    moved = QUIET[name](KEY, mixture, frame)
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
        ShareDetections(MODEL),
        Bury(),
        Found(MODEL, P),
        LearnColours(COLOURS),
        ShareMass(),
    ]
    assert all(move.approximate for move in approximate)
    assert not PropagateObjects(MODEL).approximate
    assert not RankScores().approximate


def test_the_assignment_is_scipys():
    """Costs from moments by hand, and the pairs that scipy picks."""
    mixture, frame = tracked()
    costs = np.asarray(Assign(MODEL).costs(mixture, frame), float)
    weights = np.asarray(mixture.component_weights, float)
    place, velocity = np.asarray(mixture.particles.place, float), mixture.particles.velocity
    moved = place.copy()
    moved[:, :2] += np.asarray(velocity)
    sizes = np.exp(place[:, 2:])
    noise = np.c_[sizes * np.hypot([0.06, 0.03], [0.02, 0.01]), np.tile([0.03, 0.015], (M * P, 1))]
    boxes = np.asarray(frame.detections.boxes, float)
    assert isinstance(frame.pixels, SampledHistogram)
    seen = np.asarray(frame.pixels.counts(frame.detections.boxes, 2), float)
    seen /= np.maximum(seen.sum(axis=3, keepdims=True), 1)
    expected = np.full((M, D), np.inf)
    for m in range(3):
        own = np.asarray(mixture.component_indicators) == m
        mean = weights[own] @ moved[own]
        variance = weights[own] @ ((moved[own] - mean) ** 2 + noise[own] ** 2)
        errors = (np.r_[np.exp(mean[2:]), 1, 1] * np.array([0.2, 0.1, 0.2, 0.12])) ** 2
        for d in range(5):
            gap = np.r_[boxes[d, :2], np.log(boxes[d, 2:])] - mean
            cost = (gap**2 / (variance + errors)).sum() + np.log(1 + variance / errors).sum()
            if m < 2:
                reference = np.asarray(mixture.memory["references"][m], float)
                cost += 28 * np.mean(1 - np.sqrt(reference * seen[d]).sum(axis=2))
            cost += 10 * (d == 1) + 8 * (m == 2)
            expected[m, d] = cost if cost < 20 else np.inf
    possible = np.isfinite(expected)
    assert 3 < possible.sum() < 10
    np.testing.assert_array_equal(costs < 1e4, possible)
    np.testing.assert_allclose(costs[possible], expected[possible], rtol=2e-3)
    rows, columns = linear_sum_assignment(np.where(possible, expected, 1e4))
    source = np.full(M, -1)
    for m, d in zip(rows, columns, strict=True):
        source[m] = d if possible[m, d] else -1
    assigned = Assign(MODEL)(KEY, mixture, frame).memory["assigned"]
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


def test_doubts_weigh_a_detection_by_its_marginal():
    """Prediction and likelihood with the floor have the odds (1 - p) : p of the two, by hand."""
    mixture, frame = tracked()
    move = Assign(MODEL)
    moved = move(KEY, mixture, frame)
    source = np.asarray(moved.memory["assigned"])
    doubts = np.asarray(moved.memory["doubts"], float)
    costs = np.asarray(move.costs(mixture, frame), float)
    odds = np.where(costs < 1e4, np.exp((20.0 - costs) / 4), 0)
    probability = brute_force(odds)
    nobody_known = mixture.memory | {"references": 0 * mixture.memory["references"]}
    colourless = mixture.replace(memory=nobody_known)
    quiet = np.asarray(
        Assign(MODEL, 1e3, weak_cost=0, doubt_cost=0).costs(colourless, frame), float
    )
    assert (source[:3] >= 0).all()
    for m in range(3):
        z, p = np.exp(-0.5 * quiet[m, source[m]]), probability[m, source[m]]
        np.testing.assert_allclose(doubts[m], z * (1 - p) / p, rtol=0.2, atol=1e-6)
    assert doubts[3] == 0


# --- contact ------------------------------------------------------------------------------------


def shared_by(source, boxes, confirmed=(True, True, True), unseen=(0, 0, 0)):
    """Who shares which detection: objects at (20, 20), (24, 21), (60, 40), about 7 x 12 pixels."""
    mixture, frame = tracked()
    place = mixture.particles.place.at[P : 2 * P, :2].add(jnp.array([-4.0, 0.0]))
    lives = mixture.memory["lives"]._replace(
        confirmed=jnp.array([*confirmed, False]), unseen=jnp.array([*unseen, 0], jnp.int32)
    )
    move = ShareDetections(MODEL, 0.7, 2)
    assigned = jnp.array([*source, -1], jnp.int32)
    memory = mixture.memory | move.initial_memory(M) | {"lives": lives, "assigned": assigned}
    still = ObjectState(place, 0 * mixture.particles.velocity, mixture.particles.label)
    mixture = mixture.replace(particles=still, memory=memory)
    padded = np.ones((D, 4), np.float32)
    padded[: len(boxes)] = boxes
    found = Detections(jnp.asarray(padded), jnp.arange(D) < len(boxes), jnp.ones(D))
    rows = []
    for _ in range(3):
        mixture = move(KEY, mixture, frame._replace(detections=found))
        rows.append(np.asarray(mixture.memory["shared"]).tolist())
    np.testing.assert_array_equal(mixture.particles.place, place)
    return rows


BOTH, FIRST, FAR = [22, 20, 14, 14], [20, 20, 7, 12], [60, 40, 8, 13]


@pytest.mark.parametrize(
    ("source", "boxes", "options", "expected"),
    [
        # The first's detection covers the second, and not a third that is far from it.
        ((0, -1, -1), [BOTH], {}, [-1, 0, -1, -1]),
        ((0, -1, 1), [BOTH, FAR], {}, [-1, 0, -1, -1]),
        # One that covers half of it hides nobody, nor does a component that nobody believes in.
        ((0, -1, -1), [FIRST], {}, [-1] * 4),
        ((0, -1, -1), [BOTH], {"confirmed": (False, True, True)}, [-1] * 4),
        # Nor is anybody hidden who has been lost for long, or whom nobody believes in.
        ((0, -1, -1), [BOTH], {"unseen": (0, 9, 0)}, [-1] * 4),
        ((0, -1, -1), [BOTH], {"confirmed": (True, False, True)}, [-1] * 4),
        # One that is nobody's hides nobody.
        ((-1, -1, -1), [BOTH], {}, [-1] * 4),
    ],
)  # fmt: skip
def test_who_is_hidden_shares_the_detection_of_who_hides_it(source, boxes, options, expected):
    """For two frames at the most, here."""
    assert shared_by(source, boxes, **options) == [expected, expected, [-1] * 4]


# --- scores, births, deaths, masses -------------------------------------------------------------


def ranked(frames):
    """The thresholds after frames of scores, through one compiled step of room for four."""
    move, mixture = RankScores(0.5, 0.25), tracked()[0]
    step = jax.jit(lambda mixture, found: move(KEY, mixture, TrackedFrame(found, None)))
    mixture = mixture.replace(memory=mixture.memory | move.initial_memory(M))
    for scores in frames:
        valid = np.arange(4) < len(scores)
        padded = np.r_[scores, np.full(4 - len(scores), 99.0)]
        found = Detections(jnp.ones((4, 4)), jnp.asarray(valid), jnp.asarray(padded, jnp.float32))
        mixture = step(mixture, found)
    memory = mixture.memory["scores"]
    return float(memory.weak), float(memory.strong)


@pytest.mark.parametrize("lowest", [0.0, -40.0])
def test_thresholds_are_shares_of_a_sure_score(lowest):
    """The 0.9 quantile of the last 512 scores; older ones are forgotten."""
    rng = np.random.default_rng(2)
    frames = [list(rng.uniform(lowest, 80, rng.integers(0, 5))) for _ in range(400)]
    recent = [score for scores in frames for score in scores][-512:]
    sure, low = np.quantile(recent, 0.9, method="higher"), min(0.0, min(recent))
    weak, strong = ranked(frames)
    np.testing.assert_allclose(strong, low + 0.5 * (sure - low), rtol=1e-5)
    np.testing.assert_allclose(weak, low + 0.25 * (sure - low), rtol=1e-5)


@pytest.mark.parametrize("score", [1.0, 0.0, -3.0, 1e-20])
def test_equal_scores_are_all_strong(score):
    weak, strong = ranked([[score] * 3] * 4)
    assert weak <= strong <= np.float32(score)


def test_given_thresholds_are_kept():
    found = tracked()[1].detections
    moved = RankScores(strong_score=7.0, weak_score=2.0)(
        KEY, tracked()[0], TrackedFrame(found, None)
    )
    assert (float(moved.memory["scores"].weak), float(moved.memory["scores"].strong)) == (2, 7)


def test_who_founds_is_strong_and_nobodys_and_no_double():
    """Detection 3 is a double of a component's, 1 is weak, 0 and 2 are taken; 4 founds."""
    mixture, frame = tracked()
    move = Found(MODEL, P, 0.4)
    np.testing.assert_array_equal(move.founding(mixture, frame), [0, 0, 0, 0, 1, 0])
    moved = move(KEY, mixture, frame)
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
    moved = Bury(2, 2)(KEY, mixture, frame)
    # The second has been unseen for a third frame; the third is confirmed by its second.
    np.testing.assert_array_equal(moved.active, [True, False, True, False])
    np.testing.assert_array_equal(moved.memory["lives"].confirmed, [True, True, True, False])
    kept = Bury(2, 3)(KEY, mixture, frame)
    np.testing.assert_array_equal(kept.log_weights, mixture.log_weights)


@pytest.mark.parametrize(("seen", "believed"), [(1, False), (6, False), (7, True)])
def test_who_stands_behind_another_is_believed_in_later(seen, believed):
    """The third component, before the first: seen alone once, it has to be seen eight times."""
    mixture, frame = tracked()
    third = np.arange(M * P) // P == 2
    place = mixture.particles.place.at[third, :2].set(jnp.array([22.0, 20.0]))
    lives = mixture.memory["lives"]._replace(seen=jnp.array([9, 5, seen, 0], jnp.int32))
    mixture = mixture.replace(
        particles=ObjectState(place, mixture.particles.velocity, mixture.particles.label),
        memory=mixture.memory | {"lives": lives},
    )
    after = Bury(2, 20, 8, 0.4)(KEY, mixture, frame).memory["lives"]
    np.testing.assert_array_equal(after.confirmed, [True, True, believed, False])
    np.testing.assert_array_equal(after.alone[2], 1)
    # To nobody it is a rival where others do not count as contact.
    apart = Bury(2, 20, 8, 3.0)(KEY, mixture, frame).memory["lives"]
    np.testing.assert_array_equal(apart.confirmed, [True, True, True, False])


def test_masses_are_shared_and_weights_within_components_kept():
    mixture, frame = tracked()
    moved = ShareMass()(KEY, mixture, frame)
    np.testing.assert_allclose(moved.mixture_weights, [1 / 3, 1 / 3, 1 / 3, 0], rtol=1e-5)
    np.testing.assert_allclose(moved.component_weights, mixture.component_weights, rtol=1e-4)


def test_overlap_is_that_of_the_metrics():
    from mpfjax.metrics.tracking_scores import overlap as counted
    from mpfjax.vision.boxes import top_left

    rng = np.random.default_rng(4)
    a, b = rng.uniform(1, 20, (2, 7, 4))
    expected = counted(top_left(a), top_left(b))
    np.testing.assert_allclose(
        overlap(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32)), expected, atol=1e-5
    )
