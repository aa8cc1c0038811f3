"""The command on detections alone: what it takes, what it says of it, and what it cannot take."""

import numpy as np
import pytest

from mpfjax.vision.files.boxes import read_tracks, write_tracks
from mpfjax.vision.tracking.adapters import Rows
from mpfjax.vision.tracking.track import online_rows, track
from mpfjax.vision.tracking.tracker import ObjectTracker
from tests.examples import two_walkers
from tests.marking import thorough
from tests.track_command import SMALL, run, summary_in

pytestmark = pytest.mark.usefixtures("as_installed")

NUM_FRAMES, LENGTH = 7, 9


def detected(num_frames=NUM_FRAMES, score=0.9):
    """Rows of two who walk, as a detector gives them."""
    rows = two_walkers(num_frames)
    return np.column_stack(
        [rows[:, 0], -np.ones(len(rows)), rows[:, 2:], np.full(len(rows), score)]
    )


def still_objects(number, num_frames):
    """Rows of objects that stand in a line, so many a frame."""
    one = np.column_stack([np.full(number, -1), np.arange(number) * 20, np.full(number, 5)])
    one = np.column_stack([one, np.full((number, 2), [10, 20]), np.ones(number)])
    return np.concatenate([np.insert(one, 0, t, axis=1) for t in range(1, num_frames + 1)])


def write_detections(path, rows):
    np.savetxt(path, rows, delimiter=",", fmt="%g")
    return path


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A folder without images, whose last two frames have no detection, and one box far outside."""
    folder = tmp_path_factory.mktemp("alone")
    outside = [[3, -1, 500, 5, 8, 14, 0.9]]
    write_detections(folder / "det.txt", np.concatenate([detected(), outside]))
    write_tracks(folder / "gt.txt", two_walkers(NUM_FRAMES))
    (folder / "seqinfo.ini").write_text(
        f"[Sequence]\nframeRate=25\nseqLength={LENGTH}\nimWidth=64\nimHeight=48\n"
    )
    return folder


def test_a_folder_of_detections_is_tracked_and_scored_without_pixels(sequence, tmp_path, capsys):
    pytest.importorskip("trackeval", reason="scoring needs the extra 'trackeval', of 'test'")
    assert run(sequence, "--out", tmp_path, *SMALL) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"tracks.txt", "summary.json"}
    summary = summary_in(tmp_path)
    assert (summary["frames"], summary["objects"]) == (LENGTH, 2)
    assert summary["frames_without_room"] == 0
    assert summary["HOTA"] > 0.7
    assert summary["IDF1"] > 0.8
    assert "frame 3 has boxes outside the frame, 64 x 48" in capsys.readouterr().err
    # A file of its own folder knows as much, and one that lies elsewhere the detections alone.
    assert run(sequence / "det.txt", "--out", tmp_path / "file", *SMALL) == 0
    assert summary_in(tmp_path / "file")["HOTA"] == summary["HOTA"]
    alone = write_detections(tmp_path / "walk.txt", detected())
    assert run(alone, "--out", tmp_path / "alone", *SMALL) == 0
    assert summary_in(tmp_path / "alone")["frames"] == NUM_FRAMES
    assert "HOTA" not in summary_in(tmp_path / "alone")
    found = [read_tracks(folder / "tracks.txt") for folder in (tmp_path, tmp_path / "alone")]
    np.testing.assert_array_equal(found[0][found[0][:, 0] <= NUM_FRAMES], found[1])


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("--detect: ", ["--detect"]),
        ("--box: ", ["--box", "1,2,3,4"]),
        ("--camera-motion pixels: ", ["--camera-motion", "pixels"]),
        ("holds 9 frames, and no frame 12", ["--frames", "12:"]),
    ],
)
def test_what_needs_pixels_is_named(sequence, tmp_path, capsys, message, arguments):
    assert run(sequence, "--out", tmp_path / "out", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_of_several_files_of_detections_one_has_to_be_named(tmp_path, capsys):
    for name in ("det_acf.txt", "det_frcnn.txt"):
        write_detections(tmp_path / name, detected())
    assert run(tmp_path, "--out", tmp_path / "out") == 2
    assert "holds 2 files of detections" in capsys.readouterr().err
    chosen = ["--detections", tmp_path / "det_acf.txt"]
    assert run(tmp_path, *chosen, "--out", tmp_path / "out", *SMALL) == 0
    assert run(tmp_path / "det_acf.txt", *chosen, "--out", tmp_path / "out") == 2
    assert "--detections: not allowed where SOURCE" in capsys.readouterr().err


def test_frames_with_more_objects_than_room_are_counted(tmp_path, capsys):
    path = write_detections(tmp_path / "crowd.txt", still_objects(5, 4))
    assert run(path, "--out", tmp_path, *SMALL) == 0
    assert summary_in(tmp_path)["frames_without_room"] == 4
    assert "frame 1 has more objects than the 3" in capsys.readouterr().err


def without_a_number(rows):
    rows[3, 4] = np.nan
    return rows


@pytest.mark.parametrize(
    ("spoil", "line", "row"),
    [
        (lambda rows: rows - np.eye(7)[0], "line 1: lies in frame 0", "row 0, .* from 1 on"),
        (without_a_number, "line 4: '", r"row 3, .* is not finite"),
    ],
    ids=["frames from 0", "NaN"],
)
def test_rows_that_will_not_do_are_named_with_their_line(tmp_path, capsys, spoil, line, row):
    rows = spoil(detected()[:6])
    path = write_detections(tmp_path / "bad.txt", rows)
    assert run(path, "--out", tmp_path / "out") == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert f"{path}, {line}" in said
    with pytest.raises(ValueError, match=f"detections: {row}"):
        track(None, rows)


@pytest.mark.parametrize("num_frames", [1, NUM_FRAMES])
@pytest.mark.parametrize("score", [0.0, -2.0, *thorough([0.3])])
def test_equal_scores_and_a_single_frame_are_tracked(tmp_path, num_frames, score):
    rows = detected(num_frames, score)
    path = write_detections(tmp_path / "rows.txt", rows)
    assert run(path, "--out", tmp_path, *SMALL) == 0
    expected = two_walkers(num_frames)
    by_command = read_tracks(tmp_path / "tracks.txt")
    tracked = track(None, rows, ObjectTracker(3))
    direct = np.concatenate([online_rows(t, tracks) for t, tracks in enumerate(tracked, 1)])
    for found in (by_command, direct):
        assert len(found) == len(expected)
        assert len(np.unique(found[:, 1])) == 2


def test_room_follows_what_a_file_holds():
    assert Rows(still_objects(150, 3)).most_objects() >= 200


@pytest.mark.thorough
def test_of_a_hundred_and_fifty_each_keeps_its_name():
    rows = still_objects(150, 10)
    wandering = np.random.default_rng(0).normal(0, 0.3, (len(rows), 2))
    rows[:, 2:4] += wandering
    kept = list(track(None, rows))
    assert not any(tracks.full for tracks in kept)
    for tracks in kept:
        shown = tracks.identities[tracks.shown]
        assert sorted(shown.tolist()) == list(range(1, 151))
    first, last = (
        dict(zip(tracks.identities.tolist(), tracks.boxes[:, 0].tolist(), strict=True))
        for tracks in (kept[0], kept[-1])
    )
    assert all(abs(first[name] - last[name]) < 5 for name in range(1, 151))


@pytest.mark.thorough
@pytest.mark.parametrize("rate", [1, 240])
def test_any_frame_rate_is_tracked(tmp_path, rate):
    path = write_detections(tmp_path / "walk.txt", detected(20))
    assert run(path, "--fps", rate, "--out", tmp_path, *SMALL) == 0
    found = read_tracks(tmp_path / "tracks.txt")
    assert set(found[:, 1]) == {1, 2}
    assert len(found) == 40


@pytest.mark.thorough
def test_three_thousand_in_a_frame_are_said_to_be_too_many(tmp_path, capsys):
    """And those who were there before keep their names."""
    burst = still_objects(3000, 1)
    burst[:, 0], burst[:, 3] = 10, 100  # below where the two walk
    path = write_detections(tmp_path / "burst.txt", np.concatenate([detected(20), burst]))
    assert run(path, "--out", tmp_path) == 0
    assert 1 <= summary_in(tmp_path)["frames_without_room"] <= 3
    assert "frame 10 has 3002, more than the" in capsys.readouterr().err
    found = read_tracks(tmp_path / "tracks.txt")
    assert len(found[found[:, 1] <= 2]) == 40
