"""The command with --detect: a drawn street before a still camera, and what may go wrong."""

import json

import jax
import numpy as np
import pytest
from PIL import Image
from tqdm import tqdm

from benchmarks.visual_tracking import __main__ as visual_tracking
from benchmarks.visual_tracking.detected import (
    Detected,
    detect_all,
    make_mixtures,
    track_detected,
)
from benchmarks.visual_tracking.source import Source
from mpfjax.vision.files.boxes import read_tracks, write_tracks
from mpfjax.vision.files.frames import read_frames, write_image, write_video

# Of one size in every test, so that nothing compiles twice.
HEIGHT, WIDTH, NUM = 72, 96, 30
BODY = (9, 24)


def walkers(t):
    """Two who are there from the first frame on, and one who walks in later, by their ids."""
    places = {1: (8 + 2 * t, 6), 2: (80 - 2 * t, 40)}
    return places | ({3: (2 * t - 22, 6)} if t >= 8 else {})


def street(people, num=NUM, seed=0):
    """Frames of a textured ground with a person at each place of `people(t)`."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform(90, 150, (HEIGHT, WIDTH, 3))
    shirts = {1: (200, 30, 40), 2: (30, 40, 200), 3: (20, 160, 30)}
    for t in range(num):
        frame = ground.copy()
        for id, (x, y) in people(t).items():
            w, h = BODY
            frame[y : y + h, max(x, 0) : max(x + w, 0)] = shirts[id]
        yield np.clip(frame + rng.normal(0, 2, frame.shape), 0, 255).astype(np.uint8)


def truth_of(people, num=NUM):
    """The boxes inside the frame, as a detector sees them."""
    rows = []
    for t in range(num):
        for id, (x, y) in people(t).items():
            left, right = max(x, 0), min(x + BODY[0], WIDTH)
            rows.append([t + 1, id, left, y, right - left, BODY[1]])
    return np.array([row for row in rows if row[4] > 0], float)


def sequence_of(folder, frames, truth=None):
    (folder / "img").mkdir(parents=True)
    for i, frame in enumerate(frames, 1):
        write_image(folder / "img" / f"{i:06d}.png", frame)
    if truth is not None:
        write_tracks(folder / "gt.txt", truth)
    return folder


def run(*arguments):
    return visual_tracking.main([str(argument) for argument in (*arguments, "--detect")])


def written(folder):
    results = json.loads((folder / "visual_tracking.json").read_text())
    tracks = {}
    for name in ("pf", "mpf", "gm_mpf"):
        path = folder / f"tracks_{name}.txt"
        tracks[name] = read_tracks(path) if path.read_text() else np.zeros((0, 6))
    return results, tracks


def overlap(box, other):
    low = np.maximum(box[:2], other[:2])
    high = np.minimum(box[:2] + box[2:], other[:2] + other[2:])
    common = np.prod(np.maximum(high - low, 0))
    return common / (np.prod(box[2:]) + np.prod(other[2:]) - common)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("street")
    return sequence_of(folder, street(walkers), truth_of(walkers))


@pytest.fixture(scope="module")
def finished(sequence, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert run("--sequence", sequence, "--out", out, "--preset", "paper") == 0
    return out


def test_all_three_filters_are_written_and_scored(finished):
    results, tracks = written(finished)
    assert results["settings"]["detect"] is True
    assert results["settings"]["frames"] == [1, NUM]
    assert [result["filter"] for result in results["results"]] == ["pf", "mpf", "gm_mpf"]
    names = {path.name for path in finished.iterdir()}
    assert names >= {"contact_sheet.png", "tracking.mp4"}
    assert len(list(read_frames(finished / "tracking.mp4"))) == NUM
    for result in results["results"]:
        assert result["ms_per_frame"] > 0
        assert {"HOTA", "MOTA", "IDF1"} <= set(result)
    for rows in tracks.values():
        pairs = rows[:, :2].tolist()
        assert len(set(map(tuple, pairs))) == len(pairs)


@pytest.mark.parametrize("name", ["mpf", "gm_mpf"])
def test_people_are_tracked_from_the_frames_they_appear_in(finished, name):
    """Those of the first frame as well, which knows no background yet; one identity each."""
    results, tracks = written(finished)
    truth, rows = truth_of(walkers), tracks[name]
    # By then the young background has taken the ghosts of the first frame in.
    for id, first in ((1, 17), (2, 17), (3, 17)):
        own = []
        for box in truth[(truth[:, 1] == id) & (truth[:, 0] >= first)]:
            there = rows[rows[:, 0] == box[0]]
            best = max(there, key=lambda row: overlap(row[2:], box[2:]))
            # The box of who walks in grows from a sliver, and the mean lags behind it.
            assert overlap(best[2:], box[2:]) > 0.35
            own.append(int(best[1]))
        assert len(set(own)) == 1, f"{id} is {own}"
    (score,) = [result for result in results["results"] if result["filter"] == name]
    if score["HOTA"] is not None:
        assert 0.3 < score["HOTA"] <= 1
        assert 0 < score["IDF1"] <= 1


def tracked(sequence, boxes_of_frames, truth=None):
    """The rows of the Gaussian mixture's tracker with these detections, and their source."""
    frames = list(read_frames(sequence))
    source = Source("street", lambda: frames, 1, NUM, np.zeros((0, 4)), truth, False)
    detected = Detected(boxes_of_frames, [0.0] * NUM)
    keys = jax.random.split(jax.random.key(0), 1)
    mixture = make_mixtures()["gm_mpf"]
    frames_of_run, rows_of_run = track_detected(mixture, keys, source, detected)
    with tqdm(disable=True) as bar:
        (rows,) = rows_of_run([snapshot for snapshot, _ in frames_of_run(bar)])
    return rows, source


def true_boxes(until=NUM):
    truth = truth_of(walkers)
    return [truth[(truth[:, 0] == t) & (t <= until)][:, 2:] for t in range(1, NUM + 1)]


@pytest.mark.thorough
def test_rows_are_of_believed_objects_and_end_with_the_last_guess(sequence):
    rows, _ = tracked(sequence, true_boxes(until=15))
    # The third comes into the frame as a box that grows too fast to be followed at once.
    assert len(set(rows[:, 1])) == 3
    for identity, first in ((1, 1), (2, 1)):
        own = rows[rows[:, 1] == identity]
        np.testing.assert_array_equal(own[:, 0], np.arange(first, 15 + 2 + 1))


@pytest.mark.thorough
def test_detections_outside_the_image_are_nobody(sequence):
    """What a worse detector might say: nothing comes of it, inside the frame or out."""
    outside = np.array([[WIDTH + 5.0, 10, 9, 24], [-40, 10, 9, 24], [10, HEIGHT + 1, 9, 24]])
    inside, _ = tracked(sequence, true_boxes())
    rows, _ = tracked(sequence, [np.concatenate([boxes, outside]) for boxes in true_boxes()])
    np.testing.assert_allclose(rows, inside, atol=0.01)
    centres = rows[:, 2:4] + rows[:, 4:] / 2
    assert ((centres > 0) & (centres < [WIDTH, HEIGHT])).all()


@pytest.mark.thorough
def test_a_grey_video_is_tracked_by_its_values(tmp_path):
    """Images of one channel in a folder: the colour models see three equal ones."""
    folder = sequence_of(tmp_path, ())
    for i, frame in enumerate(street(walkers), 1):
        Image.fromarray(frame[:, :, 0]).save(folder / "img" / f"{i:06d}.png")
    source = Source("grey", lambda: read_frames(folder), 1, NUM, np.zeros((0, 4)), None, False)
    rows, _ = tracked(folder, detect_all(source).boxes)
    assert np.isfinite(rows).all()
    assert len(np.unique(rows[:, 0])) > NUM / 2


def test_who_is_seen_once_only_is_not_believed(sequence):
    """Detections in the last frame alone: there is no track, and no score is lost over that."""
    truth = truth_of(walkers)
    rows, source = tracked(sequence, [np.zeros((0, 4))] * (NUM - 1) + true_boxes()[-1:], truth)
    assert rows.shape == (0, 6)
    result = visual_tracking.score("gm_mpf", [rows], NUM, [0.1] * NUM, source)
    assert result["all_covered"] == 0
    scores = visual_tracking.tracking_scores([rows], source, NUM)
    assert scores["HOTA"] in (None, 0)


# --- nothing to track: an error before anything compiles ---------------------------------------


@pytest.fixture
def untracked(monkeypatch):
    for name in ("track", "track_detected"):
        monkeypatch.setattr(visual_tracking, name, lambda *_: pytest.fail("it went on to track"))


@pytest.mark.parametrize("case", ["one frame", "an empty street", "people who never move"])
def test_nothing_that_moves_is_an_error(untracked, tmp_path, capsys, case):
    people, num = {
        "one frame": (walkers, 1),
        "an empty street": (lambda t: {}, 8),
        "people who never move": (lambda t: walkers(0), 8),
    }[case]
    folder = sequence_of(tmp_path / "still", street(people, num))
    assert run("--sequence", folder, "--out", tmp_path / "out") == 2
    assert "--detect: nothing moves before a still camera" in capsys.readouterr().err


def test_a_video_of_one_frame_is_the_same_error(untracked, tmp_path, capsys):
    write_video(tmp_path / "one.mp4", street(walkers, 1))
    assert run("--video", tmp_path / "one.mp4", "--out", tmp_path / "out") == 2
    assert "--detect: nothing moves before a still camera" in capsys.readouterr().err


def test_frames_of_changing_size_are_named(untracked, tmp_path, capsys):
    frames = list(street(walkers, 8))
    folder = sequence_of(tmp_path / "cut", [*frames[:5], *(frame[:50] for frame in frames[5:])])
    assert run("--sequence", folder, "--out", tmp_path / "out") == 2
    assert "frame 6 is 96 x 50, and those before it 96 x 72" in capsys.readouterr().err
