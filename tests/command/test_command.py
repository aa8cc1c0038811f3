"""The command: what it writes, with pixels and without, and what it says of bad input."""

import json
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from mpfjax import command
from mpfjax.command import loop as command_loop
from mpfjax.command.loop import scores_of
from mpfjax.command.source import find_truth
from mpfjax.metrics import multi_object_scores
from mpfjax.vision.files import frames as frame_files
from mpfjax.vision.files.boxes import read_tracks, write_tracks
from mpfjax.vision.files.frames import read_frames, write_video
from mpfjax.vision.tracking.adapters import Rows
from tests.examples import two_walkers

pytest.importorskip(
    "av", reason="reading and writing frames needs the extra 'video', which 'test' brings"
)
# Argparse's and other people's types are not what is tested here.
pytestmark = pytest.mark.usefixtures("as_installed")

NUM_FRAMES = 7
SMALL = ("--max-objects", 3)
SCORES = ["HOTA", "MOTA", "IDF1"]


def run(*arguments, name="track"):
    try:
        return command.main([name, *map(str, arguments)])
    except SystemExit as stopped:  # argparse's way out
        return stopped.code


def summary_in(folder):
    return json.loads((folder / "summary.json").read_text())


def detected():
    """Rows of two who walk, as a detector gives them."""
    frames, _, *boxes = two_walkers(NUM_FRAMES).T
    return np.column_stack([frames, 0 * frames - 1, *boxes, 0 * frames + 0.9])


def write_detections(path, *rows):
    np.savetxt(path, np.concatenate(rows), delimiter=",", fmt="%.9g")
    return path


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A folder of frames in which a red and a blue box walk, with gt.txt and det.txt."""
    folder = tmp_path_factory.mktemp("sequence")
    frames = np.random.default_rng(0).integers(90, 130, (NUM_FRAMES, 48, 64, 3), dtype=np.uint8)
    rows = two_walkers(NUM_FRAMES)
    for frame, id, x, y, w, h in rows.astype(int):
        frames[frame - 1, y : y + h, x : x + w] = (220, 10, 10) if id == 1 else (10, 10, 220)
    (folder / "img").mkdir()
    for i, frame in enumerate(frames, 1):
        Image.fromarray(frame).save(folder / "img" / f"{i:06d}.png")
    write_tracks(folder / "gt.txt", rows)
    write_detections(folder / "det.txt", detected())
    return folder


@pytest.fixture
def given(sequence):
    """The arguments of a run on them, but for the folder of what it writes."""
    return [sequence, "--detections", sequence / "det.txt", *SMALL]


def test_all_that_is_promised_is_written(sequence, given, tmp_path):
    assert run(*given, "--out", tmp_path) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "tracks.txt", "tracking.mp4", "summary.json"
    }  # fmt: skip
    rows, summary = read_tracks(tmp_path / "tracks.txt"), summary_in(tmp_path)
    assert list(summary) == [
        "frames", "objects", "frames_without_room", "seconds", "frames_per_second",
        "peak_memory_mb", *SCORES,
    ]  # fmt: skip
    assert (summary["frames"], summary["frames_without_room"]) == (NUM_FRAMES, 0)
    assert summary["frames_per_second"] * summary["seconds"] == pytest.approx(NUM_FRAMES, 0.01)
    assert summary["peak_memory_mb"] > 50
    assert summary["objects"] == len(np.unique(rows[:, 1])) == 2
    scores = multi_object_scores(rows, two_walkers(NUM_FRAMES))
    assert [summary[name] for name in SCORES] == pytest.approx([scores[n] for n in SCORES], 1e-4)
    # Frames are read ahead of the tracks; each has a noise of its own, by which it is known.
    stills = np.stack(list(read_frames(sequence))).astype(float)
    drawn = np.stack(list(read_frames(tmp_path / "tracking.mp4")))
    differences = np.abs(stills[None] - drawn[:, None]).mean(axis=(2, 3, 4))
    np.testing.assert_array_equal(differences.argmin(axis=1), np.arange(NUM_FRAMES))


def test_rows_are_of_what_was_known_when_the_frame_came(sequence, tmp_path):
    """A newcomer is confirmed at its second detection; `--offline` goes back to the first."""
    rows = detected()
    late = write_detections(tmp_path / "late.txt", rows[:NUM_FRAMES], rows[rows[:, 0] >= 3][5:])
    given, found = (sequence, "--detections", late, "--no-video", *SMALL), []
    for option in ((), ("--offline",)):
        assert run(*given, "--out", tmp_path / "out", *option) == 0
        assert not (tmp_path / "out" / "tracking.mp4").exists()
        found.append(read_tracks(tmp_path / "out" / "tracks.txt"))
    firsts = [[rows[rows[:, 1] == id, 0].min() for id in (1, 2)] for rows in found]
    assert firsts == [[1, 4], [1, 3]]
    was_known = (found[1][:, 1] == 1) | (found[1][:, 0] >= 4)
    np.testing.assert_array_equal(found[1][was_known], found[0])


def test_some_frames_of_a_video_without_colours_or_truth(sequence, tmp_path):
    video, out = tmp_path / "video.mp4", tmp_path / "out"
    write_video(video, read_frames(sequence), 12.5)
    assert run(video, "--detections", sequence / "det.txt", "--out", out, *SMALL,
               "--frames", "2:6", "--no-colour") == 0  # fmt: skip
    summary = summary_in(out)
    assert "HOTA" not in summary
    assert summary["frames"] == 5
    assert set(read_tracks(out / "tracks.txt")[:, 0]) <= set(range(2, 7))
    assert frame_files.frame_rate(out / "tracking.mp4") == 12.5


def change_frames(monkeypatch, change):
    """Let the command read `change(number, frame)` in the place of each frame."""

    def read(path, first, last, **times):
        for number, frame in enumerate(read_frames(path, first, last, **times), first):
            yield change(number, frame)

    monkeypatch.setattr(frame_files, "read_frames", read)


def assert_written(folder, num_frames):
    assert summary_in(folder)["frames"] == num_frames
    assert len(list(read_frames(folder / "tracking.mp4"))) == num_frames
    assert read_tracks(folder / "tracks.txt")[-1, 0] == num_frames


def test_frames_that_cannot_be_decoded_are_in_all_that_is_written(given, tmp_path, monkeypatch):
    change_frames(monkeypatch, lambda number, frame: None if number in (3, 4) else frame)
    assert run(*given, "--out", tmp_path) == 0
    assert_written(tmp_path, NUM_FRAMES)


def test_an_interrupt_leaves_what_was_done(given, tmp_path, monkeypatch, capsys):
    """Before the first frame, also the files of an older run."""

    def interrupted(number, frame):
        if number == 5:
            raise KeyboardInterrupt
        return frame

    change_frames(monkeypatch, interrupted)
    assert run(*given, "--out", tmp_path) == 130
    assert "interrupted" in capsys.readouterr().err
    assert_written(tmp_path, 4)

    def at_once(*_, **__):
        raise KeyboardInterrupt
        yield

    older = {path: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(command_loop, "track", at_once)
    assert run(*given, "--out", tmp_path) == 130
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == older


@pytest.mark.exactness
def test_an_interrupt_ends_the_commands_own_process_at_once():
    """Past JAX's cleaning up, which a trace that was broken off can bring down."""
    code = """
import atexit
from mpfjax.console import exit_status
def interrupted(): raise KeyboardInterrupt
atexit.register(print, "cleaned up")
print(exit_status(interrupted, [])); print(exit_status(interrupted, None))"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (130, "130\n")
    assert ended.stderr.count("interrupted") == 2


def test_what_moves_is_detected(sequence, tmp_path):
    pytest.importorskip("cv2", reason="detecting needs the extra 'video', which 'test' brings")
    assert run(sequence, "--detect", "--out", tmp_path, *SMALL, "--no-video") == 0
    assert summary_in(tmp_path)["frames"] == NUM_FRAMES


def test_warnings_are_a_line_each(sequence, tmp_path, capsys):
    others = [[3, -1, 500, 5, 5, 5, 0.9], [99, -1, 5, 5, 5, 5, 1]]
    rows = write_detections(tmp_path / "det.txt", detected(), others)
    assert run(sequence, "--detections", rows, "--out", tmp_path / "out", *SMALL) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert len(lines) == 2
    assert "detections: frame 3, row 2, " in lines[0]
    assert "1 lie in frames after the last, 7" in lines[1]


# --- the truth -----------------------------------------------------------------------------------


def test_only_a_folder_of_images_has_a_truth_of_its_own(sequence, tmp_path):
    video, truth = tmp_path / "video.mp4", tmp_path / "gt.txt"
    (tmp_path / "street").mkdir()
    video.write_bytes(b"")
    write_tracks(truth, two_walkers(3))
    assert not any(find_truth(path, None, 1, None) for path in (video, tmp_path / "street"))
    assert len(find_truth(video, truth, 2, None).objects) == 4
    for folder in (sequence, sequence / "img"):
        assert len(find_truth(folder, None, 1, 3).objects) == 6
    with pytest.raises(ValueError, match=r"--truth: .*gt\.txt has no box in these frames"):
        find_truth(video, truth, 4, 9)


def test_a_truth_that_will_not_do_ends_no_run(tmp_path, capsys):
    """It cannot be read, or an object has two boxes in one frame."""
    (tmp_path / "gt.txt").write_text("1,1,2,3\n")
    with pytest.warns(RuntimeWarning, match=r"no HOTA, MOTA and IDF1: .*gt\.txt"):
        assert find_truth(tmp_path, None, 1, None) is None
    rows = two_walkers(2)
    write_tracks(tmp_path / "gt.txt", np.vstack([rows, rows[:1]]))
    assert scores_of(rows, find_truth(tmp_path, None, 1, None), 1, 2) == {}
    assert "no HOTA, MOTA and IDF1: truth: id 1 has more than one box" in capsys.readouterr().err


# --- bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("not allowed with argument", ["--detections", "DET", "--detect"]),
        ("one of the arguments --detections --detect --box is required", []),
        ("--detections: nowhere.txt: no such file", ["--detections", "nowhere.txt"]),
        ("--box: '1,2,3' is not four numbers", ["--box", "1,2,3"]),
        ("--box: [[1.0, 2.0, 0.0, 4.0]] have no area", ["--box", "1,2,0,4"]),
        # argparse takes what begins with a minus sign for an option.
        ("--box: [[-9.0, 2.0, 4.0, 4.0]] have no area in the first", ["--box", "-9,2,4,4"]),
        ("--min-score: not allowed with --detect", ["--detect", "--min-score", "1"]),
        ("--offline: not allowed with --box", ["--box", "1,2,4,4", "--offline"]),
        ("--camera-motion pixels: not allowed", ["--detect", "--camera-motion", "pixels"]),
        ("--frames: '7' is not A:B", ["--detections", "DET", "--frames", "7"]),
        ("holds 7 images, frame 9 is not", ["--detections", "DET", "--frames", "9:12"]),
        ("'nan' is not a finite number", ["--min-score", "nan"]),
        ("'0' is not a whole number from 1 to 1024", ["--max-objects", "0"]),
        ("--detect: ", ["ALONE", "--detect"]),
        ("--camera-motion pixels: ", ["ALONE", "--camera-motion", "pixels"]),
        ("holds 9 frames, and no frame 12", ["ALONE", "--frames", "12:"]),
    ],
)
def test_bad_arguments_are_named_before_anything_is_written(
    sequence, alone, tmp_path, capsys, monkeypatch, message, arguments
):
    monkeypatch.setattr(command_loop, "_track", None)
    source = alone if "ALONE" in arguments else sequence
    paths = {"DET": [sequence / "det.txt"], "ALONE": []}  # a folder of detections alone
    arguments = [each for argument in arguments for each in paths.get(argument, [argument])]
    assert run(source, "--out", tmp_path / "out", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("source", "options", "named"),
    [
        ("nowhere", [], "nowhere: no such file or folder"),
        ("broken.mp4", ["--detect"], "broken.mp4: cannot be read as a video"),
        ("empty", ["--detect"], "empty"),
        ("img", ["--detections", "short.txt"], "short.txt, line 2: '1,-1,nan,5,5,5,1'"),
        ("img", ["--detections", "picture.txt"], "picture.txt, line "),
        ("img", ["--detections", "out/tracks.txt", "--min-score", "1"], "min_score: "),
        ("other.mp4", ["--detect"], "tracking.mp4 is the file of SOURCE"),
        ("img", ["--detections", "out/tracks.txt"], "tracks.txt is the file of --detections"),
        ("img", ["--detect", "--truth", "out/tracks.txt"], "tracks.txt is the file of --truth"),
        ("img", ["--detect", "--out", "other.mp4"], "other.mp4 is no folder"),
        ("img", ["--detect", "--out", "taken"], "taken/summary.json is no file"),
    ],
)
def test_files_that_will_not_do_are_named_in_a_line_and_not_written_over(
    tmp_path, capsys, monkeypatch, source, options, named
):
    monkeypatch.chdir(tmp_path)
    for folder in ("out", "img", "empty", "taken/summary.json"):
        (tmp_path / folder).mkdir(parents=True)
    if "--out" in options:  # before the work
        monkeypatch.setattr(command_loop, "_track", None)
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "img" / "1.png")
    (tmp_path / "out" / "tracking.mp4").write_bytes(b"a video")
    (tmp_path / "out" / "tracks.txt").write_text("1,1,2,2,5,5\n")
    (tmp_path / "other.mp4").symlink_to("out/tracking.mp4")
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    (tmp_path / "short.txt").write_text("1,-1,5,5,5,5,1\n1,-1,nan,5,5,5,1\n")
    (tmp_path / "picture.txt").write_bytes(b"\x89PNG\r\n\x1a\n\x00\x00" + bytes(range(256)))
    out = "elsewhere" if "min_score" in named else "out"
    assert run(source, "--out", out, *options) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert named in line
    assert line.isprintable()
    assert (tmp_path / "out" / "tracks.txt").read_text() == "1,1,2,2,5,5\n"


# --- detections alone ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A folder without images, whose last two frames have no detection, and one box far outside."""
    folder = tmp_path_factory.mktemp("alone")
    write_detections(folder / "det.txt", detected(), [[3, -1, 500, 5, 8, 14, 0.9]])
    write_tracks(folder / "gt.txt", two_walkers(NUM_FRAMES))
    info = "[Sequence]\nframeRate=25\nseqLength=9\nimWidth=64\nimHeight=48\n"
    (folder / "seqinfo.ini").write_text(info)
    return folder


def test_a_folder_of_detections_is_tracked_and_scored_without_pixels(alone, tmp_path, capsys):
    pytest.importorskip("trackeval", reason="scoring needs the extra 'trackeval', of 'test'")
    # A file of its own folder knows as much, and one that lies elsewhere the detections alone.
    walk = write_detections(tmp_path / "walk.txt", detected())
    sources = {"folder": alone, "file": alone / "det.txt", "walk": walk}
    for name, source in sources.items():
        assert run(source, "--out", tmp_path / name, *SMALL) == 0
    assert "detections: frame 3, row 2, " in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "folder").iterdir()} == {"tracks.txt", "summary.json"}
    folder, file, bare = (summary_in(tmp_path / name) for name in sources)
    assert (folder["frames"], folder["objects"], folder["frames_without_room"]) == (9, 2, 0)
    assert folder["HOTA"] == file["HOTA"] > 0.7
    assert bare["frames"] == NUM_FRAMES
    assert "HOTA" not in bare
    found = [read_tracks(tmp_path / name / "tracks.txt") for name in ("folder", "walk")]
    np.testing.assert_array_equal(found[0][found[0][:, 0] <= NUM_FRAMES], found[1])


@pytest.mark.parametrize(("options", "names"), [((), 2), (("--lost-seconds", 2), 1)])
def test_classes_scores_and_seconds_go_through_to_what_is_written(tmp_path, options, names):
    """Two boxes of two classes; the second is away for a second and a half."""
    rows = np.tile(np.c_[two_walkers(1), [0.5, 0.75], [1, 2]], (40, 1))
    rows[:, 0] = np.repeat(np.arange(1, 41), 2)
    away = (rows[:, 7] == 2) & (rows[:, 0] > 10) & (rows[:, 0] <= 25)
    found = write_detections(tmp_path / "found.txt", rows[~away])
    given = found, "--classes", "--format", "csv", "--fps", 10
    assert run(*given, "--out", tmp_path, *options) == 0
    written = np.loadtxt(tmp_path / "tracks.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(written[:, 6], written[:, 7] / 4 + 0.25)
    assert len(np.unique(written[written[:, 7] == 2, 1])) == names


def test_points_are_tracked_and_written_without_a_size(tmp_path, capsys):
    """Two that cross at 30 deviations; the score and the class of each point go with it."""
    rng, rows = np.random.default_rng(0), []
    for t in range(1, 31):
        for step, y, score, kind in ((9, 0, 0.75, 1), (-9, 60, 0.5, 2)):
            place = np.array([100 + step * (t - 15), y]) + 2 * rng.standard_normal(2)
            rows.append([t, -1, *place, score, kind])
    rows = np.array(rows)
    found, points = write_detections(tmp_path / "plots.txt", rows), ("--point-deviation", 2)
    assert run(found, *points, "--fps", 1, "--offline", "--out", tmp_path / "out") == 0
    written = np.loadtxt(tmp_path / "out" / "tracks.txt", delimiter=",")
    np.testing.assert_array_equal(written[:, [4, 5]], np.zeros((60, 2)))
    np.testing.assert_array_equal(written[:, [6, 7, 1]], rows[:, [4, 5, 5]])
    assert np.abs(written[:, 2:4] - rows[:, 2:4]).max() < 8
    assert run(found, *points, "--truth", found, "--out", tmp_path / "out") == 2
    assert "--truth: not allowed with --point-deviation" in capsys.readouterr().err


def test_frames_with_more_objects_than_room_are_counted(tmp_path, capsys):
    rows = np.array([[t, -1, 20 * i, 5, 10, 20, 1] for t in range(1, 5) for i in range(150)], float)
    assert Rows(rows).most_objects() >= 200
    path = write_detections(tmp_path / "crowd.txt", rows[rows[:, 2] < 100])
    assert run(path, "--out", tmp_path, *SMALL) == 0
    assert summary_in(tmp_path)["frames_without_room"] == 4
    assert "frame 1 has more objects than the 3" in capsys.readouterr().err
