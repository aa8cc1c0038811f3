"""What the tracker learns, against exact filters, brute force and noises that are known."""

import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.vision import ObjectTracker
from mpfjax.vision.tracking.camera import CameraState
from mpfjax.vision.tracking.gaussian import Gaussian
from mpfjax.vision.tracking.lives import Coasting, Duplicates, Spans
from mpfjax.vision.tracking.noise import NoiseState
from mpfjax.vision.tracking.pairs import Pairs
from mpfjax.vision.tracking.scores import ScoreState

M = 4


def test_a_box_is_filtered_as_by_the_kalman_filter():
    """Along x and y of a box whose size is steady, with noises that are given."""
    rng, moments = np.random.default_rng(0), []
    seen = np.array([30.0, 60, 3, 3.5]) + rng.normal(0, 0.05, (6, 4)) * [1, 1, 0, 0]
    error, place, velocity, speed = (np.full((1, 4), x) for x in (0.3, 0.02, 0.005, 0.1))
    now = Gaussian.initial(seen[:1], error, speed)
    unit = now.unit
    for row in seen[1:]:
        now, _, _ = now.predict(place, velocity, unit, 1.0).update(row[None], error)
        moments.append(np.concatenate(now))
    for k in range(2):
        model = mpfjax.LinearGaussianModel(
            A=np.array([[1.0, 1], [0, 1]]), Q=np.diag(np.square([0.02, 0.005]) * unit[0, k] ** 2),
            H=np.array([[1.0, 0.0]]), R=np.array([[0.3**2]]),
            m0=np.array([seen[0, k], 0.0]), P0=np.diag([0.3**2, 0.1**2]),
        )  # fmt: skip
        run = kalman_filter(model, jnp.asarray(seen[1:, [k]]))
        covariances = np.asarray(run.covariances)[:, *np.triu_indices(2)]
        expected = np.concatenate([run.means, covariances], axis=1)
        np.testing.assert_allclose(np.stack(moments)[:, :, k], expected, rtol=1e-3, atol=1e-4)


def test_mixed_moments_are_those_of_the_mixture_of_both():
    a = Gaussian(*(np.full((1, 4), x) for x in (1.0, 2.0, 1.0, 0.5, 0.8)))
    b = Gaussian(*(np.full((1, 4), x) for x in (3.0, -1.0, 2.0, 0.1, 0.3)))
    mixed = [moment[0, 0] for moment in a.mix(b, np.full((1, 1), 0.3))]
    means, shares = np.array([[1.0, 2.0], [3.0, -1.0]]), np.array([0.3, 0.7])
    within = np.array([[[1.0, 0.5], [0.5, 0.8]], [[2.0, 0.1], [0.1, 0.3]]])
    off = means - shares @ means
    cov = np.einsum("k,kij->ij", shares, within + off[:, :, None] * off[:, None])
    np.testing.assert_allclose(mixed, [*(shares @ means), *cov[np.triu_indices(2)]], rtol=1e-5)


# --- noises --------------------------------------------------------------------------------

SIZE = np.array([50.0, 120])


def noises_after(centres, sizes=SIZE, rate=25):
    """The noises after boxes, (t, M, 2) their centres in units of their mean size."""
    tracker = ObjectTracker(M, frames_per_second=rate)
    sizes, state = np.broadcast_to(sizes, centres.shape), tracker.init()
    for boxes in np.concatenate([centres * SIZE - sizes / 2, sizes], axis=2):
        state, _ = tracker.step(None, state, None, boxes)
    return state.noise.noises


@pytest.mark.parametrize("error", [0.012, 0.04, 0.12])
def test_the_detectors_errors_are_learned_in_a_second(error):
    """Four objects that walk steadily, and detections that err by so much of a box."""
    rng, t = np.random.default_rng(0), np.arange(40)[:, None, None]
    pace, noise = rng.normal(0, 0.04, (M, 2)), rng.normal(0, error, (2, 40, M, 2))
    centres = 8 * np.arange(M)[:, None] + pace * t + noise[0]
    noises = noises_after(centres, SIZE * np.exp(noise[1]))
    assert (noises.errors < 2 * error).all()
    assert (noises.errors > error / 2).all()
    assert (noises.velocity < 0.01).all()  # nothing but the detector errs


@pytest.mark.exactness
@pytest.mark.parametrize(("turn", "rate", "least"), [(0.03, 25, 0.01), (0.35, 5, 0.15)])
def test_who_moves_at_random_is_not_taken_for_a_bad_detector(turn, rate, least):
    """At a low rate a velocity may change by a third of a box."""
    turns = np.random.default_rng(0).normal(0, turn, (50, M, 2))
    centres = np.cumsum(np.cumsum(turns, axis=0), axis=0) + 100 * np.arange(M)[:, None]
    noises = noises_after(centres, rate=rate)
    assert (noises.velocity[:2] > least).all()
    assert (noises.errors[:2] < 0.04).all()
    assert (noises.velocity[2:] < 0.6 * least).all()


def test_of_many_objects_the_eldest_tell_the_noises_and_others_follow_when_they_end():
    rng, speed = np.random.default_rng(0), np.full(4, 0.1)
    places = rng.uniform(1, 3, (300, 4))
    state = NoiseState.initial(25.0, 4).renew(np.zeros(0, bool), places, speed)
    assert state.followed.tolist() == [True] * 128 + [False] * 172
    state = state.renew(np.arange(300) % 2 == 0, places[:100] + 5, speed)
    assert state.followed.tolist() == [True] * 64 + [False] * 86 + [True] * 64 + [False] * 36
    assert len(state.moments.place) == 128
    # Detections are those of the objects that are followed, wherever they are among all.
    columns = np.full(250, -1)
    columns[[3, 100, 160]] = 0, 1, 2
    seen = np.stack([places[6], places[200], places[10] + 5]) + 0.01
    before = state.moments.place.copy()
    after = state.after(columns, seen, np.ones(250, bool), Gaussian.none(4)).moments.place
    assert np.flatnonzero((after != before).any(axis=(1, 2))).tolist() == [3, 74]


# --- the camera ----------------------------------------------------------------------------


def test_a_shift_of_all_is_the_cameras_and_that_of_one_is_its_own():
    camera, gaps = CameraState(np.full(2, 0.5), np.full(2, 0.5), 30.0), np.tile([0.7, 0.0], (5, 1))
    gaps[2, 1] += 3.0
    _, shift = camera.after(gaps, np.full((5, 2), 1e-4), 0 * gaps, False, np.ones(2))
    np.testing.assert_allclose(shift, [0.7, 0.0], atol=0.02)


# --- scores, coasting, duplicates --------------------------------------------------------------


def scored(frames, lasting=50):
    """The state after frames of (places of boxes of 10 x 10, scores), the strongest first."""
    state = ScoreState.initial(4, lasting)
    for places, scores in frames:
        boxes = np.array([[*place, 10, 10] for place in places], float)
        apart = Pairs.of(np.eye(len(boxes)), np.eye(len(boxes)) > 0)
        state = state.after(boxes, np.asarray(scores, float), apart, state.boxes, 1.0, 2.0)
    return state


def test_scores_of_chains_that_become_sure_are_strong_and_of_those_that_end_are_not():
    """One that comes nearer, with rising scores; and flashes at ever other places."""
    rng = np.random.default_rng(0)
    near = [[((5, 5),), [0.3 + 0.7 * (t % 40) / 40]] for t in range(120)]
    assert float(scored(near).strong) < 0.4
    flashes = [[((5, 5), tuple(rng.uniform(100, 900, 2))), [1.0, 0.7]] for t in range(120)]
    assert float(scored(flashes).strong) > 0.7
    far = [[((5, 5), (300, 300)), [1.0, 0.3]] for t in range(120)]
    assert float(scored(far, lasting=1000).strong) == pytest.approx(0.5, abs=0.05)
    assert float(scored(far, lasting=50).strong) < 0.35
    # Each of eleven that pass, nine tenths of a box a frame, has rising scores; or they are
    # flashes: at places where no chain has a second one.
    passing = [[((5, 5), (400, 9 * (t % 11))), [1.0, 0.2 + 0.08 * (t % 11)]] for t in range(121)]
    assert float(scored(passing).strong) < 0.45
    lone = [[((5, 5), (400, 90 * (t % 11))), [1.0, 0.2 + 0.06 * (t % 11)]] for t in range(121)]
    assert float(scored(lone).strong) > 0.7


def test_what_an_empty_street_leaves_does_not_become_sure():
    """An object of score 6 is there for three seconds; then false detections alone, of up to 2."""
    rng = np.random.default_rng(0)
    there = [[((5, 5), tuple(rng.uniform(100, 900, 2))), [6.0, 1.0]] for _ in range(75)]
    empty = [[rng.uniform(100, 900, (2, 2)), rng.uniform(0, 2, 2)] for _ in range(250)]
    assert float(scored([*there, *empty]).strong) > 2


def test_predictions_are_shown_for_as_long_as_they_were_right():
    """At 25 frames a second: a tenth of one before anything is known."""
    spans, coasting, ten = Spans.at(25.0, None), Coasting(), np.full(3, 10.0)
    assert coasting.longest(spans) == 2
    all_three, none = np.ones(3, bool), np.zeros(3, bool)
    right = wrong = coasting
    for _ in range(20):
        right = right.after(ten, all_three, none, spans)
        wrong = wrong.after(ten, none, all_three, spans)
        assert right.longest(spans) >= 5
        assert wrong.longest(spans) == 0
    ended = coasting.after(ten + 1, none, all_three, spans)
    assert ended.wrong.sum() == 3 * 11
    assert not ended.wrong[9:].any()  # of 20 bins for 25 frames


def test_who_never_leaves_a_neighbour_before_it_ends_is_a_double():
    """Others that began beside an older one decide: most of them ended there, or went away."""
    shares, seen = np.array([[1.0, 0.4], [0.4, 1.0]]), np.ones(2, bool)
    together, apart = Pairs.of(shares, shares > 0), Pairs.of(shares, shares > 0.5)
    one = Pairs.of(shares[:1, :1], seen[None, :1])

    def many(overlaps_before_the_end, ends):
        duplicates, lives_on = Duplicates(), np.zeros(0, bool)
        for name in range(2, 14):
            names = np.array([1, name])
            duplicates = duplicates.after(names, lives_on, seen, together)
            assert duplicates.elders.tolist() == [0, 1]
            begun = duplicates
            duplicates = duplicates.after(names, seen, seen, overlaps_before_the_end)
            if ends:
                lone = np.array([True, False])
                duplicates = duplicates.after(names[:1], lone, seen[:1], one)
                lives_on = seen[:1]
        return begun

    assert many(together, ends=True).doubtful.tolist() == [False, True]
    assert not many(apart, ends=True).doubtful.any()


def test_pairs_of_the_cameras_motion_do_not_widen_with_its_deviation():
    """A camera believed to shake by half a box tells nothing by detections that fit no object."""
    tracker = ObjectTracker(8, frames_per_second=10)
    boxes = np.array([[100.0 * k, 50.0, 40.0, 80.0] for k in range(4)])
    state = tracker.init()
    for _ in range(8):
        state, tracks = tracker.step(None, state, None, boxes)
    assert tracks.shown.all()
    believed = state.camera._replace(deviations=np.full(2, 0.45), left=np.full(2, 0.45))
    away = np.array([[24.0, 0, 0, 0], [-24.0, 0, 0, 0], [0, 48.0, 0, 0], [0, -48.0, 0, 0]])
    after, _ = tracker.step(None, state._replace(camera=believed), None, boxes + away)
    np.testing.assert_array_equal(after.camera.deviations, believed.deviations)
