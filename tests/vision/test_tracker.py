"""The object tracker on tiny drawn frames: who is born, who lives on, who dies, and no leaks."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import mpfjax
from mpfjax.vision import Detections, HSVColours, ObjectTracker, integral_histogram, tracker
from mpfjax.vision.tracker import GATE, IMPOSSIBLE

HEIGHT, WIDTH, ROOM = 48, 64, 6
M, P = 4, 10
SIZE = (6, 12)
COLOURS = HSVColours(4, 2, 2)
SHIRTS = [(220, 30, 30), (30, 30, 220), (30, 200, 30), (220, 200, 30), (200, 30, 200), (20,) * 3]
KEYS = jax.random.split(jax.random.key(0), 200)


def tracker_of(rejuvenation="gaussian", **options):
    if rejuvenation == "resample":
        options["rejuvenation"] = mpfjax.Resample(particles_per_component=P)
    defaults = {"colours": COLOURS, "num_parts": 2, "confirmation": 2, "patience": 3}
    defaults |= {"crowding": 3}
    return ObjectTracker(M, P, **defaults | options)


# Shared by the tests, since every tracker of other settings compiles anew.
TRACKER, RESAMPLING = tracker_of(), tracker_of("resample")


def draw(corners):
    """A frame with a person in a shirt of its own at each corner that is not None."""
    frame = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    for (w, h), corner, shirt in zip([SIZE] * len(corners), corners, SHIRTS, strict=False):
        if corner is not None:
            x, y = (max(int(c), 0) for c in corner)
            frame[y : max(int(corner[1]) + h, 0), x : max(int(corner[0]) + w, 0)] = shirt
    return frame


def boxes_at(corners):
    rows = [[*corner, *SIZE] for corner in corners if corner is not None]
    return np.array(rows, float).reshape(-1, 4)


def detections(boxes, room=ROOM):
    return Detections.from_boxes(np.asarray(boxes, float).reshape(-1, 4), room)


def run(corners_of_frames, chosen=TRACKER, seen=None):
    """The tracks of each frame. `seen(t, corners)` says what is detected, all by default."""
    state, tracks = chosen.init(), []
    for t, corners in enumerate(corners_of_frames):
        found = boxes_at(corners) if seen is None else seen(t, corners)
        frame = jnp.asarray(draw(corners))
        state, track = chosen.step(KEYS[t], state, frame, detections(found))
        tracks.append(jax.tree.map(np.asarray, track))
        assert_sound(state, tracks[-1])
    return tracks


def assert_sound(state, tracks):
    """Exactly P particles in each living component, none in a dead one, weights that sum to one."""
    alive = np.asarray(state.identities) > 0
    mixture = state.mixture
    np.testing.assert_array_equal(mixture.component_counts, np.where(alive, P, 0))
    if alive.any():
        expected = np.where(alive, 1 / alive.sum(), 0)
        np.testing.assert_allclose(mixture.mixture_weights, expected, rtol=1e-4)
    filled = np.asarray(mixture.occupied)
    particles = mixture.particles
    np.testing.assert_array_equal(
        np.asarray(particles.reference)[filled], np.asarray(mixture.component_indicators)[filled]
    )
    assert np.isfinite(np.asarray(particles.box)).all()
    assert np.isfinite(np.asarray(state.colour.references)).all()
    identities = np.asarray(state.identities)[alive]
    assert len(np.unique(identities)) == len(identities)
    assert identities.max(initial=0) <= int(state.last_identity)
    np.testing.assert_array_equal(tracks.identities, state.identities)
    assert not tracks.confirmed[~alive].any()
    for memory in (state.seen, state.unseen, state.crowded):
        assert not np.asarray(memory)[~alive].any()


def living(tracks):
    return sorted(tracks.identities[tracks.identities > 0].tolist())


def believed(tracks):
    return sorted(tracks.identities[tracks.confirmed].tolist())


def box_of(tracks, identity):
    (m,) = np.flatnonzero(tracks.identities == identity)
    return tracks.boxes[m]


def centre_of(corner):
    return np.array(corner) + np.array(SIZE) / 2


def test_nothing_is_tracked_where_nothing_is_detected():
    for tracks in run([[]] * 4):
        assert living(tracks) == []
        assert believed(tracks) == []


@pytest.mark.parametrize("rejuvenation", ["gaussian", "resample"])
def test_components_are_born_confirmed_and_keep_their_identities(rejuvenation):
    """Two walk from the first frame on, a third comes later; every mean box stays on its own."""
    chosen = TRACKER if rejuvenation == "gaussian" else RESAMPLING

    def corners(t):
        late = (30, 3) if t >= 5 else None
        return [(5 + t, 5), (50 - t, 30), late]

    tracks = run([corners(t) for t in range(12)], chosen)
    assert [living(each) for each in tracks] == [[1, 2]] * 5 + [[1, 2, 3]] * 7
    assert [believed(each) for each in tracks] == [[]] + [[1, 2]] * 5 + [[1, 2, 3]] * 6
    assert all((each.unseen == 0).all() for each in tracks)
    for t, each in enumerate(tracks[2:], 2):
        ids = [1, 2] if abs(box_of(each, 1)[0] - 8 - t) < 3 else [2, 1]
        for identity, corner in zip(ids, corners(t)[:2], strict=True):
            np.testing.assert_allclose(box_of(each, identity)[:2], centre_of(corner), atol=1.5)
            np.testing.assert_allclose(box_of(each, identity)[2:], SIZE, rtol=0.2)
    np.testing.assert_allclose(box_of(tracks[-1], 3)[:2], centre_of((30, 3)), atol=1.5)


def test_a_component_outlives_its_detections_for_as_long_as_its_patience():
    """Seen in frames 0 to 4; then its picture stays, and it dies in the frame after patience."""
    tracks = run([[(20, 20)]] * 10, seen=lambda t, c: boxes_at(c if t < 5 else []))
    assert [living(each) for each in tracks] == [[1]] * 8 + [[]] * 2
    assert [each.unseen.max() for each in tracks] == [0] * 5 + [1, 2, 3] + [0] * 2


def test_what_is_not_yet_believed_dies_at_once_and_its_identity_is_not_used_again():
    def seen(t, corners):
        return boxes_at(corners if t in (0, 2, 4, 5) else [])

    tracks = run([[(20, 20)]] * 6, seen=seen)
    assert [living(each) for each in tracks] == [[1], [], [2], [], [3], [3]]
    assert [believed(each) for each in tracks] == [[]] * 5 + [[3]]


def test_a_detection_after_a_gap_is_the_same_object():
    tracks = run(
        [[(20 + t, 20)] for t in range(9)], seen=lambda t, c: boxes_at(c if t != 5 else [])
    )
    assert {tuple(living(each)) for each in tracks} == {(1,)}
    assert [int(each.unseen.max()) for each in tracks] == [0] * 5 + [1] + [0] * 3


def test_who_leaves_the_frame_dies_with_it():
    """The detections go on outside, as those of no detector would: they found nobody either."""
    tracks = run([[(50 + 2 * t, 20)] for t in range(12)])
    assert living(tracks[3]) == [1]
    assert living(tracks[-1]) == []
    assert max(each.identities.max() for each in tracks) == 1


def test_a_detection_outside_the_frame_founds_nothing():
    outside = [[WIDTH + 3, 10, 6, 12], [-20, 10, 6, 12], [10, -40, 6, 12], [10, 200, 6, 12]]
    in_part = [WIDTH - 5, 20, 8, 12]
    for tracks in run([[]] * 3, seen=lambda t, c: np.array([*outside, in_part], float)):
        assert living(tracks) == [1]
        assert box_of(tracks, 1)[0] < WIDTH


def test_of_two_on_one_object_the_younger_dies_of_crowding():
    """Two detections walk into each other and are one place from frame 7 on."""
    tracks = run([[(10, 20), (max(24 - 2 * t, 10), 20)] for t in range(24)])
    lives = [living(each) for each in tracks]
    assert lives[:4] == [[1, 2]] * 4
    assert lives[-1] == [1]
    assert {identity for life in lives for identity in life} == {1, 2}


def test_a_full_house_takes_no_more_and_the_next_free_place_is_filled():
    corners = [(2, 2), (14, 2), (26, 2), (38, 2), (50, 2), (2, 30)]

    def seen(t, given):
        return boxes_at(given if t < 3 else given[1:])

    tracks = run([corners] * 3 + [[None, *corners[1:]]] * 6, seen=seen)
    for each in tracks[:3]:
        assert living(each) == [1, 2, 3, 4]
    # The first of six is gone: after its patience another detection gets its place.
    assert living(tracks[-1]) == [2, 3, 4, 5]


def test_a_detection_that_a_living_component_covers_founds_no_other():
    tracks = run(
        [[(20, 20)]] * 4,
        seen=lambda t, c: boxes_at(c) if t == 0 else np.array([[20, 20, 6, 12], [20, 20, 6, 11.5]]),
    )
    assert all(living(each) == [1] for each in tracks)


def test_a_first_frame_full_of_people_is_a_full_house():
    """Of more detections than rows `from_boxes` keeps some, and the tracker fills its room."""
    rng = np.random.default_rng(0)
    people = np.concatenate([rng.uniform(0, 40, (30, 2)), np.tile(SIZE, (30, 1))], axis=1)
    for tracks in run([[]] * 2, seen=lambda t, c: people):
        assert len(living(tracks)) == M


@pytest.mark.parametrize("rejuvenation", ["gaussian", "resample"])
def test_nothing_leaks_over_many_random_frames(rejuvenation):
    """Detections that come, go, jump, overlap, and lie outside; every frame is checked."""
    rng = np.random.default_rng(1)
    chosen = TRACKER if rejuvenation == "gaussian" else RESAMPLING
    state, ever, gone = chosen.init(), set(), set()
    for t in range(120):
        k = rng.integers(0, ROOM + 3)
        boxes = np.concatenate([rng.uniform(-10, 60, (k, 2)), rng.uniform(2, 20, (k, 2))], axis=1)
        if t % 7 in (0, 1, 2):
            boxes = np.concatenate([boxes[:2], boxes_at([(20, 20), (40 + t % 7, 5)])])
        frame = jnp.asarray(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
        state, tracks = chosen.step(KEYS[t], state, frame, detections(boxes))
        assert_sound(state, tracks)
        now = set(living(jax.tree.map(np.asarray, tracks)))
        assert not now & gone
        gone |= ever - now
        ever |= now
    assert len(ever) > 20
    assert max(ever) == int(state.last_identity) == len(ever)


def test_nothing_compiles_again_as_objects_come_and_go(monkeypatch):
    """Python runs a compiled step only to trace it for new shapes or settings."""
    run([[]])
    monkeypatch.setattr(tracker, "integral_histogram", lambda *_: pytest.fail("traced again"))
    run([[], [(5, 5)], [(5, 5), (20, 20)], [], [(30, 5)]] + [[]] * 5)


def test_a_run_is_the_same_again_and_other_under_another_key():
    frames = [[(5 + t, 5), (50 - t, 30)] for t in range(4)]
    once, again = run(frames), run(frames)
    np.testing.assert_array_equal(once[-1].boxes, again[-1].boxes)


def test_greyscale_frames_are_tracked_by_their_values():
    """Three equal channels, as a grey video is read: all colours fall into the bins of value."""
    state = TRACKER.init()
    for t in range(6):
        grey = np.repeat(draw([(10 + t, 10)]).max(axis=2, keepdims=True), 3, axis=2)
        state, tracks = TRACKER.step(
            KEYS[t], state, jnp.asarray(grey), detections(boxes_at([(10 + t, 10)]))
        )
        assert_sound(state, jax.tree.map(np.asarray, tracks))
    np.testing.assert_allclose(box_of(tracks, 1)[:2], centre_of((15, 10)), atol=1.5)


def test_frames_may_change_their_size_between_two_steps():
    """Each size compiles; components live on in pixels, and those outside the new frame die."""
    state = TRACKER.init()
    both = detections(boxes_at([(5, 5), (50, 30)]))
    for t in range(3):
        state, _ = TRACKER.step(KEYS[t], state, jnp.asarray(draw([(5, 5), (50, 30)])), both)
    small = jnp.asarray(draw([(5, 5), (50, 30)])[:30, :40])
    state, tracks = TRACKER.step(KEYS[3], state, small, both)
    assert_sound(state, jax.tree.map(np.asarray, tracks))
    (m,) = np.flatnonzero(tracks.identities)
    np.testing.assert_allclose(tracks.boxes[m, :2], centre_of((5, 5)), atol=1.5)


@pytest.mark.parametrize(
    ("frame", "said"),
    [
        (np.zeros((20, 30), np.uint8), r"frame: \(20, 30\) is not the shape"),
        (np.zeros((20, 30, 1), np.uint8), r"frame: \(20, 30, 1\) is not the shape"),
        (np.zeros((20, 30, 3), np.float32), "frame: float32 is not uint8"),
    ],
)
def test_a_frame_without_colours_is_named(as_installed, frame, said):
    with pytest.raises(ValueError, match=said):
        TRACKER.step(KEYS[0], TRACKER.init(), jnp.asarray(frame), detections([]))


def test_the_assignment_is_scipys():
    """Three components and four detections near them, and one that is near nobody."""
    corners = [(10, 10), (17, 10), (40, 20)]
    state = TRACKER.init()
    frame = jnp.asarray(draw(corners))
    for t in range(3):
        state, tracks = TRACKER.step(KEYS[t], state, frame, detections(boxes_at(corners)))
    shifted = [
        [13.2, 10, 6, 12],
        [16.5, 11, 7, 12],
        [41, 19, 6, 13],
        [11, 9.5, 5, 12],
        [20, 35, 6, 9],
    ]
    found, table = detections(shifted), integral_histogram(frame, COLOURS)
    own, taken = jax.jit(lambda *a: TRACKER._assigned(*a))(state, found, table)

    boxes, seen = np.asarray(tracks.boxes, float), np.asarray(found.boxes, float)
    cost = np.full((M, ROOM), IMPOSSIBLE)
    for m in range(M):
        for d in range(ROOM):
            gap = np.r_[
                (seen[d, :2] - boxes[m, :2]) / np.maximum(boxes[m, 2:], 1e-3),
                np.log(seen[d, 2:] / np.maximum(boxes[m, 2:], 1e-3)),
            ] / np.array(GATE)
            if tracks.identities[m] > 0 and found.valid[d] and (gap**2).sum() < 1:
                counts = np.asarray(table.counts(found.boxes[d][None], 2))[0, :, 0]
                shares = counts / counts.sum(axis=1, keepdims=True)
                references = np.asarray(state.colour.references[m, :, 0])
                unlike = (1 - np.sqrt(shares * references).sum(axis=1)).mean()
                cost[m, d] = (gap**2).sum() + unlike
    pairs = [(m, d) for m, d in zip(*linear_sum_assignment(cost), strict=True) if cost[m, d] < 10]
    assert len(pairs) == 3
    assert ((cost < 10).sum(axis=1) > 1).any()
    np.testing.assert_array_equal(np.flatnonzero(own.valid), sorted(m for m, _ in pairs))
    np.testing.assert_array_equal(np.flatnonzero(taken), sorted(d for _, d in pairs))
    for m, d in pairs:
        np.testing.assert_allclose(own.boxes[m], seen[d], rtol=1e-6)


def test_references_are_learned_from_who_stands_alone():
    """A shirt that changes its colour: 5% of what is new joins the reference in each frame."""
    state, learned = TRACKER.init(), []
    for t in range(6):
        frame = draw([(20, 20)])
        frame[20:32, 20:26] = (220, 30, 30) if t < 2 else (30, 200, 30)
        state, _ = TRACKER.step(KEYS[t], state, jnp.asarray(frame), detections([[20, 20, *SIZE]]))
        learned.append(np.asarray(state.colour.references[0, :, 0]))
    red, green = 1, 3
    assert learned[1][:, green].max() == 0
    np.testing.assert_allclose(learned[-1].sum(axis=1), 1, rtol=1e-5)
    # The mean box may stand half a pixel off and see some of the background.
    np.testing.assert_allclose(learned[-1][:, green], 1 - 0.95**4, rtol=0.25)
    assert (learned[-1][:, red] < learned[1][:, red]).all()


def test_large_objects_are_counted_wide(monkeypatch):
    """16 bits would count nothing of 65 536 pixels or more."""
    asked = []

    def counted(frame, colours, wide_counts):
        asked.append(wide_counts)
        return integral_histogram(frame, colours, wide_counts)

    monkeypatch.setattr(tracker, "integral_histogram", counted)
    wide, frame = tracker_of(wide_counts=True), jnp.asarray(draw([]))
    eqx.filter_eval_shape(wide.step, KEYS[0], wide.init(), frame, detections([]))
    assert asked == [True]
    assert wide.init().colour.wide_counts


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_objects", 0),
        ("particles_per_object", 0),
        ("num_parts", 0),
        ("confirmation", 0),
        ("patience", 0),
        ("crowding", -1),
        ("patience", 2.5),
        ("sigma", 0.0),
        ("sigma", float("nan")),
        ("sigma", float("inf")),
        ("momentum", -0.1),
        ("momentum", 1.1),
        ("adaptation", 1.0),
        ("adaptation", -0.1),
        ("step_deviations", (0.1, 0.1, 0.1)),
        ("step_deviations", (0.1, 0.1, 0.1, 0.0)),
        ("detection_deviations", (0.1, 0.1, 0.1, -1.0)),
        ("detection_deviations", (0.1, 0.1, 0.1, float("inf"))),
    ],
)
def test_a_bad_setting_is_named(as_installed, name, value):
    with pytest.raises(ValueError, match=f"^{name}: ") as caught:
        ObjectTracker(**{name: value})
    assert str(value) in str(caught.value)


@pytest.mark.parametrize(
    ("rejuvenation", "said"),
    [
        (mpfjax.Resample(), "particles_per_component, None, is not .* 50"),
        (mpfjax.Resample(particles_per_component=20), "particles_per_component, 20, is not .* 50"),
        (mpfjax.GaussianRegeneration(50), "where is None"),
    ],
)
def test_a_rejuvenation_that_would_leave_no_room_is_named(rejuvenation, said):
    with pytest.raises(ValueError, match=f"^rejuvenation: .*{said}"):
        ObjectTracker(rejuvenation=rejuvenation)
