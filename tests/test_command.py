"""The command: what it writes, and what it says of bad input."""

import subprocess
import sys

import numpy as np
import pytest

import mpfjax
from mpfjax import command
from mpfjax.command import loop as command_loop
from mpfjax.command.scoring import find_truth, scores_of
from mpfjax.metrics import multi_object_scores
from mpfjax.vision.files import frames as frame_files
from mpfjax.vision.files.boxes import read_tracks, write_tracks
from mpfjax.vision.files.frames import read_frames, write_image, write_video
from tests.examples import two_walkers
from tests.track_command import SMALL, run, summary_in

pytest.importorskip(
    "av", reason="reading and writing frames needs the extra 'video', which 'test' brings"
)
# Argparse's and other people's types are not what is tested here.
pytestmark = pytest.mark.usefixtures("as_installed")

NUM_FRAMES = 7
FIELDS = [
    "frames", "objects", "frames_without_room", "seconds", "frames_per_second", "peak_memory_mb"
]  # fmt: skip
SCORES = ["HOTA", "MOTA", "IDF1"]


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
        write_image(folder / "img" / f"{i:06d}.png", frame)
    write_tracks(folder / "gt.txt", rows)
    lines = [f"{f:.0f},-1,{x},{y},{w},{h},0.9,-1,-1,-1\n" for f, _, x, y, w, h in rows]
    (folder / "det.txt").write_text("".join(lines))
    return folder


@pytest.fixture(scope="module")
def finished(sequence, tmp_path_factory):
    out = tmp_path_factory.mktemp("finished")
    assert run(sequence, "--detections", sequence / "det.txt", "--out", out, *SMALL) == 0
    return out


def test_all_that_is_promised_is_written(finished):
    assert {path.name for path in finished.iterdir()} == {
        "tracks.txt", "tracking.mp4", "summary.json"
    }  # fmt: skip
    assert len(list(read_frames(finished / "tracking.mp4"))) == NUM_FRAMES
    summary = summary_in(finished)
    assert list(summary) == FIELDS + SCORES
    assert list(summary["seconds"]) == ["read", "detect", "track", "write"]
    assert summary["seconds"]["track"] > summary["seconds"]["detect"] >= 0
    assert summary["frames"] == NUM_FRAMES
    assert summary["frames_per_second"] > 0
    assert summary["peak_memory_mb"] > 50


def test_tracks_are_drawn_on_their_own_frames(sequence, finished):
    """Frames are read ahead of the tracks; each has a noise of its own, by which it is known."""
    stills = np.stack(list(read_frames(sequence))).astype(float)
    for number, drawn in enumerate(read_frames(finished / "tracking.mp4")):
        differences = np.abs(stills - drawn).mean(axis=(1, 2, 3))
        assert differences.argmin() == number


def test_the_summary_is_that_of_the_file(finished):
    rows, summary = read_tracks(finished / "tracks.txt"), summary_in(finished)
    scores = multi_object_scores(rows, two_walkers(NUM_FRAMES), (1, NUM_FRAMES))
    assert {name: summary[name] for name in SCORES} == pytest.approx(
        {name: scores[name] for name in SCORES}, abs=1e-4
    )
    assert summary["objects"] == len(np.unique(rows[:, 1])) == 2


def test_rows_are_of_what_was_known_when_the_frame_came(sequence, tmp_path):
    """A newcomer is believed in at second sight; only `--offline` goes back to the first."""
    rows = (sequence / "det.txt").read_text().splitlines(keepends=True)
    late = [row for k, row in enumerate(rows) if k < NUM_FRAMES or int(row.split(",")[0]) >= 3]
    (tmp_path / "late.txt").write_text("".join(late))
    found = {}
    for name, options in {"online": (), "offline": ("--offline",)}.items():
        assert run(sequence, "--detections", tmp_path / "late.txt", "--out", tmp_path / name,
                   *SMALL, "--no-video", *options) == 0  # fmt: skip
        found[name] = read_tracks(tmp_path / name / "tracks.txt")
        assert not (tmp_path / name / "tracking.mp4").exists()
    firsts = {
        name: [rows[rows[:, 1] == id, 0].min() for id in (1, 2)] for name, rows in found.items()
    }
    assert firsts == {"online": [1, 4], "offline": [1, 3]}
    was_known = (found["offline"][:, 1] == 1) | (found["offline"][:, 0] >= 4)
    np.testing.assert_array_equal(found["offline"][was_known], found["online"])


@pytest.mark.thorough
def test_some_frames_of_a_video_without_colours_or_truth(sequence, tmp_path):
    video = tmp_path / "video.mp4"
    write_video(video, read_frames(sequence), 12.5)
    assert frame_files.frame_rate(video) == 12.5
    out = tmp_path / "out"
    assert run(video, "--detections", sequence / "det.txt", "--out", out, *SMALL,
               "--frames", "2:6", "--no-colour") == 0  # fmt: skip
    summary = summary_in(out)
    assert list(summary) == FIELDS
    assert summary["frames"] == 5
    assert set(read_tracks(out / "tracks.txt")[:, 0]) <= set(range(2, 7))
    assert frame_files.frame_rate(out / "tracking.mp4") == 12.5


def test_an_interrupt_leaves_what_was_done(sequence, tmp_path, monkeypatch, capsys):
    read = frame_files.read_frames

    def interrupted(path, first, last):
        for number, frame in enumerate(read(path, first, last), first):
            if number == 5:
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr(frame_files, "read_frames", interrupted)
    assert run(sequence, "--detections", sequence / "det.txt", "--out", tmp_path, *SMALL) == 130
    assert "interrupted" in capsys.readouterr().err
    assert summary_in(tmp_path)["frames"] == 4
    assert read_tracks(tmp_path / "tracks.txt")[-1, 0] == 4
    monkeypatch.undo()
    assert len(list(read_frames(tmp_path / "tracking.mp4"))) == 4


def test_an_interrupt_before_the_first_frame_leaves_an_older_runs_files(
    sequence, tmp_path, monkeypatch
):
    older = {name: f"older {name}" for name in ("tracks.txt", "summary.json", "tracking.mp4")}
    for name, text in older.items():
        (tmp_path / name).write_text(text)

    def interrupted(*_, **__):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(command_loop, "track", interrupted)
    assert run(sequence, "--detections", sequence / "det.txt", "--out", tmp_path, *SMALL) == 130
    assert {name: (tmp_path / name).read_text() for name in older} == older


def test_an_interrupt_ends_the_commands_own_process_at_once():
    """Past JAX's cleaning up, which a trace that was broken off can bring down."""
    code = (
        "import atexit; from mpfjax.console import exit_status\n"
        "def interrupted(): raise KeyboardInterrupt\n"
        "atexit.register(print, 'cleaned up')\n"
        "print(exit_status(interrupted, [])); print(exit_status(interrupted, None))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (130, "130\n")
    assert ended.stderr.count("interrupted") == 2


@pytest.mark.parametrize("spoil", ["cut short", "another size"])
def test_frames_that_cannot_be_read_on_leave_what_was_done(sequence, tmp_path, capsys, spoil):
    (tmp_path / "img").mkdir()
    for path in sorted((sequence / "img").iterdir()):
        (tmp_path / "img" / path.name).write_bytes(path.read_bytes())
    fifth = tmp_path / "img" / "000005.png"
    if spoil == "cut short":
        fifth.write_bytes(fifth.read_bytes()[:2000])
    else:
        write_image(fifth, np.zeros((40, 64, 3), np.uint8))
    out = tmp_path / "out"
    assert run(tmp_path, "--detections", sequence / "det.txt", "--out", out, *SMALL) == 2
    error = capsys.readouterr().err
    assert ("000005.png" if spoil == "cut short" else "frame 5 is 64 x 40") in error
    assert summary_in(out)["frames"] == 4
    assert read_tracks(out / "tracks.txt")[-1, 0] == 4


def test_the_cameras_motion_from_pixels_needs_opencv(sequence, tmp_path, capsys, monkeypatch):
    """By default the command goes on without it; an explicit request is one line."""
    monkeypatch.setitem(sys.modules, "cv2", None)
    given = [sequence, "--detections", sequence / "det.txt", *SMALL, "--no-video"]
    assert run(*given, "--out", tmp_path / "out", "--camera-motion", "pixels") == 2
    assert "pip install opencv-python-headless" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    tracks = []
    for name, asked in (("default", ()), ("asked", ("--camera-motion", "detections"))):
        assert run(*given, "--out", tmp_path / name, *asked) == 0
        tracks.append((tmp_path / name / "tracks.txt").read_text())
    assert tracks[0] == tracks[1]


def test_what_moves_is_detected(sequence, tmp_path):
    pytest.importorskip("cv2", reason="detecting needs the extra 'video', which 'test' brings")
    assert run(sequence, "--detect", "--out", tmp_path, *SMALL, "--no-video") == 0
    assert summary_in(tmp_path)["seconds"]["detect"] > 0


def test_warnings_are_a_line_each(sequence, tmp_path, capsys):
    rows = (
        sequence / "det.txt"
    ).read_text() + "3,-1,500,5,5,5,0.9,-1,-1,-1\n99,-1,5,5,5,5,1,-1,-1,-1\n"
    (tmp_path / "det.txt").write_text(rows)
    out = tmp_path / "out"
    assert run(sequence, "--detections", tmp_path / "det.txt", "--out", out, *SMALL) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert len(lines) == 2
    assert "frame 3 has boxes outside the frame, 64 x 48" in lines[0]
    assert "1 lie in frames after the last, 7" in lines[1]


def test_only_a_folder_of_images_has_a_truth_of_its_own(sequence, tmp_path):
    video, images = tmp_path / "video.mp4", tmp_path / "street"
    images.mkdir()
    video.write_bytes(b"")
    write_tracks(tmp_path / "gt.txt", two_walkers(3))
    assert find_truth(video, None, 1, None) is None
    assert find_truth(images, None, 1, None) is None
    assert len(find_truth(video, tmp_path / "gt.txt", 2, None).objects) == 4
    for folder in (sequence, sequence / "img"):
        assert len(find_truth(folder, None, 1, 3).objects) == 6
    with pytest.raises(ValueError, match=r"--truth: .*gone\.txt is neither"):
        find_truth(video, tmp_path / "gone.txt", 1, None)
    with pytest.raises(ValueError, match=r"--truth: .*gt\.txt has no box in these frames"):
        find_truth(video, tmp_path / "gt.txt", 4, 9)


@pytest.mark.parametrize("text", ["", "1,1,2,3\n", "\x00\x01"])
def test_a_truth_that_cannot_be_read_is_a_warning(tmp_path, text):
    (tmp_path / "gt.txt").write_text(text)
    with pytest.warns(RuntimeWarning, match=r"no HOTA, MOTA and IDF1: .*gt\.txt"):
        assert find_truth(tmp_path, None, 1, None) is None


def test_a_truth_that_cannot_be_scored_with_ends_no_run(tmp_path, capsys):
    """An object with two boxes in one frame."""
    rows = two_walkers(2)
    write_tracks(tmp_path / "gt.txt", np.vstack([rows, rows[:1]]))
    truth = find_truth(tmp_path, None, 1, None)
    assert scores_of(rows, truth, 1, 2, None) == {}
    assert "no HOTA, MOTA and IDF1: truth: id 1 has more than one box" in capsys.readouterr().err


def test_drawn_boxes_are_scored_against_those_whom_they_were_drawn_around(tmp_path, capsys):
    rows = two_walkers(3)
    write_tracks(tmp_path / "gt.txt", rows)
    truth = find_truth(tmp_path, None, 1, None)
    second = rows[rows[:, 1] == 2]
    tracked = second.copy()
    tracked[:, 1] = 1  # the one track is that of the first box
    perfect = dict.fromkeys(SCORES, 1.0)
    assert scores_of(tracked, truth, 1, 3, second[:1, 2:]) == perfect
    assert not capsys.readouterr().err
    # A second box, around nobody, and its track do not count.
    drawn = np.vstack([[40.0, 0, 5, 5], second[0, 2:]])
    tracked = np.vstack([tracked, tracked])
    tracked[:3, 1], tracked[3:, 2] = 2, 0.0
    assert scores_of(tracked, truth, 1, 3, drawn) == perfect
    assert "scored: 1 of 2 boxes" in capsys.readouterr().err
    assert scores_of(tracked, truth, 1, 3, drawn[:1]) == {}


def nothing_tracked(*_, **__):
    pytest.fail("it went on to track")


DETECTIONS = ["--detections", "DET"]


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("not allowed with argument", ["--detections", "DET", "--detect"]),
        ("one of the arguments --detections --detect --box is required", []),
        ("--detections: nowhere.txt is not a file", ["--detections", "nowhere.txt"]),
        ("--box: '1,2,3' is not four numbers", ["--box", "1,2,3"]),
        ("--box: 1,2,0,4 has no area", ["--box", "1,2,0,4"]),
        ("--box: 100,2,4,4 lies outside the first frame, 64 x 48", ["--box", "100,2,4,4"]),
        # argparse takes what begins with a minus sign for an option.
        ("--box: -9,2,4,4 lies outside the first frame, 64 x 48", ["--box", "-9,2,4,4"]),
        ("argument --box: expected one argument", ["--box", "--offline"]),
        ("--min-score: not allowed with --detect", ["--detect", "--min-score", "1"]),
        (
            "--camera-motion: not allowed with --box",
            ["--box", "1,2,4,4", "--camera-motion", "pixels"],
        ),
        (
            "--camera-motion pixels: not allowed with --detect",
            ["--detect", "--camera-motion", "pixels"],
        ),
        ("invalid choice: 'flow'", [*DETECTIONS, "--camera-motion", "flow"]),
        ("--frames: '7' is not A:B", [*DETECTIONS, "--frames", "7"]),
        ("holds 7 images, and no frame 9", [*DETECTIONS, "--frames", "9:12"]),
        ("unrecognized arguments: --filter mpf", [*DETECTIONS, "--filter", "mpf"]),
        ("'nan' is not a finite number", [*DETECTIONS, "--min-score", "nan"]),
        ("'0' is not a whole number from 1 to 1024", [*DETECTIONS, "--max-objects", "0"]),
        ("'0' is not a positive, finite number", [*DETECTIONS, "--fps", "0"]),
        ("'-1' is not a whole number", [*DETECTIONS, "--seed", "-1"]),
    ],
)
def test_bad_arguments_are_named_before_anything_is_written(
    sequence, tmp_path, capsys, monkeypatch, message, arguments
):
    monkeypatch.setattr(command_loop, "_track", nothing_tracked)
    arguments = [sequence / "det.txt" if argument == "DET" else argument for argument in arguments]
    assert run(sequence, "--out", tmp_path / "out", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [[], ["--detect"], ["--camera-motion", "pixels"]])
@pytest.mark.parametrize("source", ["nowhere.mp4", "nowhere.txt", "nowhere"])
def test_a_source_that_is_not_there_is_named_whatever_else_is_asked(
    tmp_path, capsys, source, options
):
    assert run(tmp_path / source, "--out", tmp_path / "out", *options) == 2
    assert f"{source}: no such file or folder" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["words", "words.mp4", "words.dat"])
def test_text_that_is_no_video_is_named(tmp_path, capsys, name):
    (tmp_path / name).write_text("1,-1,10,20,30,40,1\n2,-1,11,20,30,40,1\n")
    assert run(tmp_path / name, "--out", tmp_path / "out") == 2
    assert f"{name} is text, and no video" in capsys.readouterr().err
    assert run(tmp_path / name, "--out", tmp_path / "out", "--detect") == 2
    assert f"{name}: cannot be read as a video" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("source", "options", "named"),
    [
        ("out/tracking.mp4", ["--detect"], "tracking.mp4 is the file of SOURCE"),
        ("other.mp4", ["--detect"], "tracking.mp4 is the file of SOURCE"),
        ("img", ["--detections", "out/tracks.txt"], "tracks.txt is the file of --detections"),
        ("img", ["--detect", "--truth", "out/tracks.txt"], "tracks.txt is the file of --truth"),
    ],
)
def test_what_is_read_is_not_written_over(tmp_path, capsys, monkeypatch, source, options, named):
    monkeypatch.chdir(tmp_path)
    for folder in ("out", "img"):
        (tmp_path / folder).mkdir()
    write_image(tmp_path / "img" / "1.png", np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "out" / "tracking.mp4").write_bytes(b"a video")
    (tmp_path / "out" / "tracks.txt").write_text("1,1,2,2,5,5,1\n")
    (tmp_path / "other.mp4").symlink_to("out/tracking.mp4")
    assert run(source, "--out", "out", *options) == 2
    assert named in capsys.readouterr().err
    assert (tmp_path / "out" / "tracks.txt").read_text() == "1,1,2,2,5,5,1\n"


def test_the_version_is_said(capsys):
    with pytest.raises(SystemExit) as stopped:
        command.main(["--version"])
    assert stopped.value.code == 0
    assert capsys.readouterr().out == f"mpfjax {mpfjax.__version__}\n"


@pytest.mark.parametrize(
    "content",
    [b"\x89PNG\r\n\x1a\n\x00\x00", b"\x00" * 50, bytes(range(256)) * 4],
    ids=["a picture", "zeros", "all bytes"],
)
def test_detections_that_are_no_text_are_named_in_one_line(sequence, tmp_path, capsys, content):
    (tmp_path / "det.txt").write_bytes(content)
    out = tmp_path / "out"
    assert run(sequence, "--detections", tmp_path / "det.txt", "--out", out) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "det.txt, line " in line
    assert len(line) < 500
    assert line.isprintable()


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ("line 2: '1,-1,nan,5,5,5,1'", "1,-1,5,5,5,5,1\n1,-1,nan,5,5,5,1\n"),
        ("line 1: '1,-1,5,5,5'", "1,-1,5,5,5\n"),
        ("line 1: '1.5,-1,5,5,5,5,1'", "1.5,-1,5,5,5,5,1\n"),
        ("line 3: has a score, or none, unlike", "1,-1,5,5,5,5\n\n1,-1,5,5,5,5,1\n"),
        ("det.txt: holds no detections", "\n"),
        ("--min-score: ", "1,-1,5,5,5,5\n"),
    ],
)
def test_bad_detections_are_named_with_their_line(
    sequence, tmp_path, capsys, monkeypatch, message, text
):
    monkeypatch.setattr(command_loop, "_track", nothing_tracked)
    (tmp_path / "det.txt").write_text(text)
    least = ["--min-score", 1] if "--min-score" in message else []
    out = tmp_path / "out"
    assert run(sequence, "--detections", tmp_path / "det.txt", "--out", out, *least) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("source", ["gone.mp4", "empty", "broken.mp4"])
def test_a_source_without_frames_is_named(sequence, tmp_path, capsys, source):
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    detections = ["--detections", sequence / "det.txt"]
    assert run(tmp_path / source, *detections, "--out", tmp_path / "out") == 2
    assert source in capsys.readouterr().err


def test_frame_rates_are_read_where_they_stand(tmp_path):
    (tmp_path / "img1").mkdir()
    write_image(tmp_path / "img1" / "000001.jpg", np.zeros((4, 4, 3), np.uint8))
    assert frame_files.frame_rate(tmp_path) is None
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nname=one\nframeRate=14\n")
    assert frame_files.frame_rate(tmp_path) == frame_files.frame_rate(tmp_path / "img1") == 14
    assert frame_files.num_images(tmp_path) == 1
