"""The object tracker on tiny drawn frames: who is born, who lives on, who dies, and no leaks."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.vision import Detections, HSVColours, ObjectTracker
from mpfjax.vision.colour.sampled_histograms import SampledBoxes
from mpfjax.vision.tracking.appearance import LearnAppearance
from mpfjax.vision.tracking.assignment import Assign
from mpfjax.vision.tracking.births import Births, ShareMass
from mpfjax.vision.tracking.camera import FollowCamera
from mpfjax.vision.tracking.deaths import Deaths
from mpfjax.vision.tracking.motion import PropagateObjects
from mpfjax.vision.tracking.noise import LearnNoise
from mpfjax.vision.tracking.observation import TrackedFrame
from mpfjax.vision.tracking.scores import RankScores
from mpfjax.vision.tracking.tracker import object_model
from tests.marking import thorough

HEIGHT, WIDTH, ROOM = 48, 64, 6
M, P = 4, 24
SIZE = (6, 12)
COLOURS = HSVColours(4, 2, 2)
SHIRTS = [(220, 30, 30), (30, 30, 220), (30, 200, 30), (220, 200, 30), (200, 30, 200), (20,) * 3]
KEYS = jax.random.split(jax.random.key(0), 200)


def motion(states):
    return states.place, states.velocity


def tracker_of(resampling, patience=3):
    """The default chain with few particles, and a patience that tests can wait for."""
    model = object_model()
    moves = [
        RankScores(),
        FollowCamera(Assign(model)),
        Assign(model),
        resampling,
        PropagateObjects(model),
        Deaths(2, patience),
        Births(model, P),
        LearnNoise(model),
        LearnAppearance(COLOURS, 2, adaptation=0.05),
        ShareMass(),
    ]
    return ObjectTracker(M, P, colours=COLOURS, moves=moves)


# Shared by the tests, since every tracker of other settings compiles anew.
TRACKER = tracker_of(mpfjax.GaussianRegeneration(P, where=motion))
RESAMPLING = tracker_of(mpfjax.Resample(particles_per_component=P))


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


def detections(boxes, scores=None):
    scores = None if scores is None else np.asarray(scores, float)
    return Detections.from_boxes(np.asarray(boxes, float).reshape(-1, 4), ROOM, scores)


def run(corners_of_frames, chosen=TRACKER, seen=None, pixels=True, scores=None):
    """The tracks of each frame.

    `seen(t, corners)` says what is detected, all by default, and `scores(t)` how surely.
    """
    state, tracks = chosen.init(), []
    for t, corners in enumerate(corners_of_frames):
        found = boxes_at(corners) if seen is None else seen(t, corners)
        frame = jnp.asarray(draw(corners)) if pixels else None
        found = detections(found, None if scores is None else scores(t))
        state, track = chosen.step(KEYS[t], state, frame, found)
        tracks.append(jax.tree.map(np.asarray, track))
        assert_sound(state, tracks[-1])
    return tracks


def assert_sound(state, tracks):
    """Exactly P particles in each living component, none in a dead one, weights that sum to one."""
    lives, mixture = state.memory["lives"], state
    alive = np.asarray(lives.identities) > 0
    np.testing.assert_array_equal(mixture.component_counts, np.where(alive, P, 0))
    if alive.any():
        expected = np.where(alive, 1 / alive.sum(), 0)
        np.testing.assert_allclose(mixture.mixture_weights, expected, rtol=1e-4)
    filled = np.asarray(mixture.occupied)
    particles = mixture.particles
    np.testing.assert_array_equal(
        np.asarray(particles.label)[filled], np.asarray(mixture.component_indicators)[filled]
    )
    assert np.isfinite(np.asarray(particles.place)).all()
    identities = np.asarray(lives.identities)[alive]
    assert len(np.unique(identities)) == len(identities)
    assert identities.max(initial=0) <= int(lives.last_identity)
    np.testing.assert_array_equal(tracks.identities, lives.identities)
    assert not tracks.confirmed[~alive].any()
    assert (np.asarray(state.memory["assigned"])[~alive] == -1).all()
    assert np.isfinite(np.asarray(state.memory["references"])).all()
    for memory in (lives.seen, lives.unseen, state.memory["references"]):
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


@pytest.mark.thorough
def test_nothing_is_tracked_where_nothing_is_detected():
    for tracks in run([[]] * 4):
        assert living(tracks) == []
        assert believed(tracks) == []


def test_who_is_found_first_but_later_is_a_newcomer():
    tracks = run([[]] * 2 + [[(20, 20)]] * 2)
    assert [believed(each) for each in tracks] == [[], [], [], [1]]


@pytest.mark.parametrize("resampling", ["gaussian", *thorough(["resample"])])
def test_components_are_born_confirmed_and_keep_their_identities(resampling):
    """Two walk from the first frame on, a third comes later; every mean box stays on its own."""
    chosen = TRACKER if resampling == "gaussian" else RESAMPLING

    def corners(t):
        late = (30, 3) if t >= 5 else None
        return [(5 + t, 5), (50 - t, 30), late]

    tracks = run([corners(t) for t in range(12)], chosen)
    assert [living(each) for each in tracks] == [[1, 2]] * 5 + [[1, 2, 3]] * 7
    # Who is there at the start is believed in at once, and the newcomer in its second frame.
    assert [believed(each) for each in tracks] == [[1, 2]] * 6 + [[1, 2, 3]] * 6
    assert all((each.unseen == 0).all() for each in tracks)
    for t, each in enumerate(tracks[8:], 8):
        ids = [1, 2] if abs(box_of(each, 1)[0] - 8 - t) < 3 else [2, 1]
        for identity, corner in zip(ids, corners(t)[:2], strict=True):
            np.testing.assert_allclose(box_of(each, identity)[:2], centre_of(corner), atol=2)
            np.testing.assert_allclose(box_of(each, identity)[2:], SIZE, rtol=0.2)
    np.testing.assert_allclose(box_of(tracks[-1], 3)[:2], centre_of((30, 3)), atol=1.5)


def test_a_component_outlives_its_detections_for_as_long_as_its_patience():
    """Seen in frames 0 to 4; then its picture stays, and it dies in the frame after patience."""
    tracks = run([[(20, 20)]] * 10, seen=lambda t, c: boxes_at(c if t < 5 else []))
    assert [living(each) for each in tracks] == [[1]] * 8 + [[]] * 2
    assert [each.unseen.max() for each in tracks] == [0] * 5 + [1, 2, 3] + [0] * 2


def test_what_is_not_yet_believed_may_be_missed_once_and_no_identity_is_used_again():
    """Beside one who is there from the start."""

    def seen(t, corners):
        return boxes_at(corners if t in (1, 4, 6) else corners[:1])

    tracks = run([[(50, 5), (20, 20)]] * 7, seen=seen)
    expected = [[1], [1, 2], [1, 2], [1], [1, 3], [1, 3], [1, 3]]
    assert [living(each) for each in tracks] == expected
    assert [believed(each) for each in tracks] == [[1]] * 6 + [[1, 3]]


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


@pytest.mark.parametrize("resampling", ["gaussian", *thorough(["resample"])])
def test_nothing_leaks_over_many_random_frames(resampling):
    """Detections that come, go, jump, overlap, and lie outside; every frame is checked."""
    rng = np.random.default_rng(1)
    chosen = TRACKER if resampling == "gaussian" else RESAMPLING
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
    assert max(ever) == int(state.memory["lives"].last_identity) == len(ever)


def test_nothing_compiles_again_as_objects_come_and_go(monkeypatch):
    """Python runs a compiled step only to trace it for new shapes or settings."""
    run([[]])
    monkeypatch.setattr(Assign, "costs", lambda *_: pytest.fail("traced again"))
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


@pytest.mark.thorough
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


def test_what_it_looks_at_beforehand_is_all_that_it_sees_of_a_frame():
    whole, looked, corners = TRACKER.init(), TRACKER.init(), [(5, 5), (22, 30)]
    for t in range(4):
        frame = draw([(x + t, y) for x, y in corners])
        found = detections(boxes_at([(x + t, y) for x, y in corners]))
        seen = TRACKER.look(frame, found)
        assert sum(leaf.size for leaf in jax.tree.leaves(seen)) < 4 * ROOM * 18 * 8 * 3
        whole, _ = TRACKER.step(KEYS[t], whole, jnp.asarray(frame), found)
        looked, tracks = TRACKER.step(KEYS[t], looked, seen, found)
    np.testing.assert_array_equal(looked.memory["references"], whole.memory["references"])
    np.testing.assert_allclose(looked.particles.place, whole.particles.place, rtol=1e-5)
    assert tracks.shown.sum() == 2


def test_the_default_chain_looks_at_detections_alone():
    """The whole frame would compile anew for each size, and go to the program in each step."""
    default = mpfjax.vision.ObjectTracker(M)
    assert isinstance(default.look(draw([]), detections([])), SampledBoxes)


@pytest.mark.parametrize("options", [{"sigma": 0.2}, {"exact_colours": True}])
def test_where_more_is_needed_than_detections_show_it_looks_at_the_frame(options):
    chosen, frame = mpfjax.vision.ObjectTracker(M, P, **options), draw([])
    assert chosen.look(frame, detections([])) is frame


def test_references_are_learned_from_who_stands_alone():
    """Trousers that change their colour: 5% of what is new joins the reference in each frame."""
    state, learned = TRACKER.init(), []
    for t in range(6):
        frame = draw([(20, 20)])
        frame[26:32, 20:26] = (220, 30, 30) if t < 2 else (30, 200, 30)
        state, _ = TRACKER.step(KEYS[t], state, jnp.asarray(frame), detections([[20, 20, *SIZE]]))
        learned.append(np.asarray(state.memory["references"][0, :, 0]))
    red, green = 1, 3
    assert learned[1][:, green].max() == 0
    np.testing.assert_allclose(learned[-1].sum(axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(learned[-1][:, green], [0, 1 - 0.95**4], rtol=1e-4)
    np.testing.assert_allclose(learned[-1][:, red], [1, 0.95**4], rtol=1e-4)


def test_who_is_in_contact_teaches_nobody():
    """Two who walk into each other: once they overlap their references stay what they were."""
    state, references, both = TRACKER.init(), [], []
    rng = np.random.default_rng(0)
    for t in range(8):
        corners = [(10 + t, 20), (26 - t, 20)]
        # Every frame looks a little different, so that there is something to learn.
        frame = jnp.asarray(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
        state, tracks = TRACKER.step(KEYS[t], state, frame, detections(boxes_at(corners)))
        references.append(np.asarray(state.memory["references"]))
        both.append((np.asarray(tracks.unseen) == 0)[np.asarray(tracks.identities) > 0].sum())
    assert both == [2] * 8
    # They touch at t = 5, and overlap by a fifth at t = 6.
    assert not np.array_equal(references[5], references[4])
    np.testing.assert_array_equal(references[7], references[6])


def test_a_weak_detection_sustains_a_component_and_founds_none():
    """Two walk; the scores of one fall to a third of the other's, and it is not lost for that."""
    corners = [[(5 + t, 5), (50 - t, 30)] for t in range(10)]
    both = run(corners, scores=lambda t: [1.0, 1.0 if t < 4 else 0.35])
    assert all(living(each) == [1, 2] for each in both)
    assert all((each.unseen == 0).all() for each in both)
    late = run(
        corners,
        seen=lambda t, c: boxes_at(c[:1] if t < 4 else c),
        scores=lambda t: [1.0] if t < 4 else [1.0, 0.35],
    )
    assert all(living(each) == [1] for each in late)


def test_what_the_detector_hardly_believes_sustains_nobody():
    corners = [[(5 + t, 5), (50 - t, 30)] for t in range(8)]
    tracks = run(corners, scores=lambda t: [1.0, 1.0 if t < 4 else 0.1])
    assert [int(each.unseen.max()) for each in tracks] == [0] * 4 + [1, 2, 3, 0]
    assert living(tracks[-1]) == [1]


def test_scores_of_any_scale_are_the_same():
    """Times 90, as some detectors score: thresholds come from the scores themselves."""
    corners = [[(5 + t, 5), (50 - t, 30)] for t in range(6)]
    scores = np.random.default_rng(0).uniform(0.1, 1, (6, 2))
    once = run(corners, scores=lambda t: scores[t])
    again = run(corners, scores=lambda t: 90 * scores[t])
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a.identities, b.identities)
        np.testing.assert_array_equal(a.unseen, b.unseen)


def test_without_pixels_detections_are_tracked_alone():
    """Who walks out of the region where detections ever were is gone."""

    def corners(t):
        return [(5 + 3 * t, 5), (50 - t, 30)]

    tracks = run([corners(t) for t in range(8)], pixels=False)
    assert all(living(each) == [1, 2] for each in tracks)
    for identity in (1, 2):
        places = [box_of(each, identity)[:2] for each in tracks]
        own = min(corners(0), key=lambda c: abs(centre_of(c) - places[0]).sum())
        which = corners(0).index(own)
        np.testing.assert_allclose(places[-1], centre_of(corners(7)[which]), atol=2.5)
    gone = run(
        [[(20 - 3 * t, 5), (50 - t, 30)] for t in range(10)],
        pixels=False,
        seen=lambda t, c: boxes_at(c if t < 6 else c[1:]),
    )
    assert len(living(gone[-1])) == 1


def test_of_more_than_there_is_room_for_the_strongest_are_tracked_and_it_is_said():
    corners = [(2, 2), (14, 2), (26, 2), (38, 2), (50, 2), (2, 30)]
    scores = [0.9, 0.8, 1.0, 0.6, 0.95, 0.85]
    tracks = run([corners] * 2, scores=lambda t: scores)
    assert all(each.full for each in tracks)
    centres = sorted(box[0] for box in tracks[-1].boxes)
    np.testing.assert_allclose(centres, [5, 5, 29, 53], atol=2)
    assert not run([corners[:4]])[-1].full


def test_corner_boxes_are_the_boxes():
    tracks = jax.tree.map(jnp.asarray, run([[(20, 20)]] * 3)[-1])
    (m,) = np.flatnonzero(tracks.identities)
    np.testing.assert_allclose(
        tracks.corner_boxes[m, :2] + tracks.boxes[m, 2:] / 2, tracks.boxes[m, :2], rtol=1e-6
    )
    np.testing.assert_array_equal(tracks.shown, tracks.confirmed)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_objects", 0),
        ("particles_per_object", 0),
        ("frames_per_second", 0.0),
        ("frames_per_second", float("nan")),
        ("sigma", 0.0),
        ("sigma", float("inf")),
        ("exact_colours", 2),
        ("strong_score", float("nan")),
        ("weak_score", float("inf")),
        ("colours", "red"),
        ("moves", 3),
        ("moves", (3,)),
    ],
)
def test_a_bad_setting_is_named(as_installed, name, value):
    with pytest.raises(ValueError, match=f"^{name}: "):
        ObjectTracker(**{name: value})


@pytest.mark.parametrize(
    ("resampling", "said"),
    [
        (mpfjax.Resample(), "particles_per_component, None, is not .* 16"),
        (mpfjax.Resample(particles_per_component=20), "particles_per_component, 20, is not .* 16"),
        (mpfjax.GaussianRegeneration(16), "where is None"),
    ],
)
def test_a_rejuvenation_that_would_leave_no_room_is_named(resampling, said):
    with pytest.raises(ValueError, match=f"^resampling: .*{said}"):
        ObjectTracker(particles_per_object=16, resampling=resampling)


def chain_without(*kinds):
    return [move for move in TRACKER.moves if not isinstance(move, kinds)]


@pytest.mark.parametrize("sees", [True, False])
def test_a_chain_that_learns_no_colours_runs_with_pixels_and_without(sees):
    tracker = ObjectTracker(M, P, moves=chain_without(LearnAppearance))
    pixels = np.zeros((40, 60, 3), np.uint8) if sees else None
    found = Detections.from_boxes(np.array([[5.0, 5, 10, 20]]), 8)
    state, _ = eqx.filter_eval_shape(tracker.step, KEYS[0], tracker.init(), pixels, found)
    assert "references" not in state.memory


def test_the_bins_are_those_that_the_chain_learns(as_installed):
    assert ObjectTracker(M, P, moves=TRACKER.moves).colours == COLOURS
    with pytest.raises(ValueError, match=r"^colours: .* are not those of LearnAppearance"):
        ObjectTracker(M, P, moves=TRACKER.moves, colours=HSVColours(4, 2, 3))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sigma", 0.3),
        ("strong_score", 0.5),
        ("weak_score", 0.1),
        ("frames_per_second", 25.0),
        ("resampling", mpfjax.Resample(particles_per_component=P)),
    ],
)
def test_a_setting_that_a_chain_of_moves_has_itself_is_refused_beside_it(name, value):
    with pytest.raises(ValueError, match=rf"^{name}: [\s\S]* is given beside moves"):
        ObjectTracker(M, P, moves=TRACKER.moves, **{name: value})


def weighing_by_colours():
    model = object_model(sigma=0.3)
    return [
        PropagateObjects(model) if isinstance(move, PropagateObjects) else move
        for move in chain_without(LearnAppearance)
    ]


@pytest.mark.parametrize(
    ("moves", "said"),
    [
        (
            [*TRACKER.moves, LearnAppearance(COLOURS)],
            "LearnAppearance and LearnAppearance would share",
        ),
        ([RankScores(), *TRACKER.moves], "RankScores and RankScores would share one memory"),
        (chain_without(Deaths), "(?s:.*) lacks Deaths"),
        (chain_without(Assign), "PropagateObjects reads the memory '(assigned|doubts).*'"),
        (chain_without(RankScores), "FollowCamera reads the memory 'scores'"),
        (weighing_by_colours(), "PropagateObjects reads the memory 'references'"),
    ],
)
def test_a_chain_that_cannot_run_is_refused(moves, said):
    with pytest.raises(ValueError, match=f"^moves: {said}"):
        ObjectTracker(M, P, moves=moves)


def test_the_tracker_is_a_filter_that_starts_empty():
    """`run_filter` tracks who comes, goes until nobody is left, and who comes again."""
    corners = [[], [(5, 5)], [(6, 5), (40, 20)], [(7, 5), (41, 20)], [], [], [], [], [], [(30, 9)]]
    found = [detections(boxes_at(places)) for places in corners]
    observations = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(TrackedFrame(f) for f in found)
    )

    def names(mixture):
        return mixture.memory["lives"].identities, mixture.log_mass

    run = mpfjax.run_filter(KEYS[0], TRACKER.filter, observations, names)
    state, alive = TRACKER.init(), []
    for t, seen in enumerate(found):
        state, tracks = TRACKER.step(KEYS[t], state, None, seen)
        alive.append(np.asarray(tracks.identities))
    identities, log_masses = run.collected
    np.testing.assert_array_equal(identities, alive)
    somebody = (np.asarray(alive) > 0).any(axis=1)
    np.testing.assert_array_equal(somebody, [0, 1, 1, 1, 1, 1, 1, 0, 0, 1])
    np.testing.assert_allclose(np.exp(log_masses), somebody, atol=1e-5)
    assert np.isfinite(run.log_likelihood_increments).all()
