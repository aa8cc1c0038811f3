"""The command of section 5.2: what it writes, and what it says of bad input."""

import json

import jax
import numpy as np
import pytest

from benchmarks.coverage import coverage
from benchmarks.scenes.football import football_scene
from benchmarks.visual_tracking import __main__ as visual_tracking
from mpfjax.vision.files.boxes import read_tracks, write_tracks
from mpfjax.vision.files.frames import read_frames, write_image, write_video
from tests.marking import thorough

pytest.importorskip("av", reason="reading and writing frames needs the extra 'video'")

FIELDS = [
    "filter", "all_covered", "per_object", "on_object", "on_other", "id_swaps", "object_swaps",
    "ms_per_frame",
]  # fmt: skip


def run(*arguments):
    return visual_tracking.main([str(argument) for argument in arguments])


def results_in(folder):
    return json.loads((folder / "visual_tracking.json").read_text())


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Eight small frames of the rendered scene as a folder with img/ and gt.txt."""
    folder = tmp_path_factory.mktemp("sequence")
    scene = football_scene(jax.random.key(1), 8, height=96, width=160)
    (folder / "img").mkdir()
    for i, frame in enumerate(scene.frames, 1):
        write_image(folder / "img" / f"{i:06d}.png", frame)
    write_tracks(folder / "gt.txt", scene.tracks)
    return folder


@pytest.fixture(scope="module", params=["default", *thorough(["objects", "paper"])])
def finished(request, sequence, tmp_path_factory):
    out = tmp_path_factory.mktemp(request.param)
    arguments = ["--sequence", sequence, "--ids", 1, 2, 3, "--frames", "3:8"]
    assert run(*arguments, "--preset", request.param, "--out", out) == 0
    return out


def test_all_that_the_issue_names_is_written(finished):
    names = {path.name for path in finished.iterdir()}
    assert names >= {"contact_sheet.png", "tracking.mp4", "visual_tracking.json"}
    assert names >= {"tracks_pf.txt", "tracks_mpf.txt"}
    assert len(list(read_frames(finished / "tracking.mp4"))) == 6
    results = results_in(finished)["results"]
    assert [result["filter"] for result in results] == ["pf", "mpf"]
    assert all(list(result) == FIELDS for result in results)


def test_the_settings_say_how_many_particles_there_are(finished):
    settings = results_in(finished)["settings"]
    expected = 400 if settings["preset"] == "objects" else 200
    assert (settings["num_particles"], settings["max_components"]) == (expected, 10)


def test_the_scores_are_those_of_the_tracks(finished, sequence):
    truth = read_tracks(sequence / "gt.txt")
    truth = truth[truth[:, 0] >= 3]
    is_started = np.isin(truth[:, 1], [1, 2, 3])
    truth, others = truth[is_started], truth[~is_started]
    settings = results_in(finished)["settings"]
    for result in results_in(finished)["results"]:
        expected = coverage(read_tracks(finished / f"tracks_{result['filter']}.txt"), truth, others)
        assert result["on_other"] == pytest.approx(expected.on_other)
        assert result["all_covered"] == pytest.approx(expected.all_covered)
        assert result["on_object"] == pytest.approx(expected.on_object)
        assert result["id_swaps"] == expected.id_swaps
        if settings["preset"] == "objects" and result["filter"] == "mpf":
            assert 0 <= result["object_swaps"] <= result["id_swaps"]
        else:
            assert result["object_swaps"] is None
        per_object = {str(id): share for id, share in expected.per_object.items()}
        assert result["per_object"] == pytest.approx(per_object)
        assert result["ms_per_frame"] > 0


def test_tracks_hold_one_box_a_component_and_frame(finished):
    pf, mpf = (read_tracks(finished / f"tracks_{name}.txt") for name in ("pf", "mpf"))
    assert pf[:, :2].tolist() == [[frame, 1] for frame in range(3, 9)]
    pairs = mpf[:, :2].tolist()
    assert len(set(map(tuple, pairs))) == len(pairs)
    counts = np.unique(mpf[:, 0], return_counts=True)
    assert counts[0].tolist() == list(range(3, 9))
    assert (counts[1] <= 10).all()


@pytest.mark.thorough
def test_without_a_truth_the_scores_are_null_and_the_rest_is_written(sequence, tmp_path):
    video = tmp_path / "video.mp4"
    write_video(video, read_frames(sequence))
    x, y, w, h = read_tracks(sequence / "gt.txt")[0, 2:]
    out = tmp_path / "out"
    assert run("--video", video, "--box", f"{x},{y},{w},{h}", "--frames", "1:4", "--out", out,
               "--seeds", 2, "--gif") == 0  # fmt: skip
    for result in results_in(out)["results"]:
        assert [result[field] for field in FIELDS[1:7]] == [None] * 6
        assert result["ms_per_frame"] > 0
    assert {path.name for path in out.iterdir()} >= {"contact_sheet.png", "tracking.gif"}
    assert len(read_tracks(out / "tracks_pf.txt")) == 4


@pytest.mark.thorough
def test_an_interrupted_run_leaves_what_it_finished(sequence, tmp_path, monkeypatch):
    track = visual_tracking.track

    def interrupted(filter, *rest):
        for i, step in enumerate(track(filter, *rest)):
            if filter.num_components > 1 and i == 2:
                raise KeyboardInterrupt
            yield step

    monkeypatch.setattr(visual_tracking, "track", interrupted)
    assert run("--sequence", sequence, "--frames", "1:5", "--out", tmp_path) == 130
    results = results_in(tmp_path)["results"]
    assert [result["filter"] for result in results] == ["pf", "mpf"]
    assert read_tracks(tmp_path / "tracks_pf.txt")[-1, 0] == 5
    assert read_tracks(tmp_path / "tracks_mpf.txt")[-1, 0] == 2


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("--box: '1,2,3' is not four numbers", ["--box", "1,2,3"]),
        ("--box: 10,10,0,5 has no area", ["--box", "10,10,0,5"]),
        ("--box: 900,10,9,9 lies outside", ["--box", "900,10,9,9"]),
        ("--ids: gt.txt has no box of [77] in frame 1", ["--ids", "1", "77"]),
        ("--frames: '9' is not A:B", ["--frames", "9"]),
        ("--frames: '0:4' is not A:B", ["--frames", "0:4"]),
        ("--frames: '5:4' is not A:B", ["--frames", "5:4"]),
        ("frame 40 is not among them", ["--frames", "40:50"]),
    ],
)
def test_bad_input_is_named_before_anything_compiles(
    sequence, tmp_path, capsys, monkeypatch, message, arguments
):
    monkeypatch.setattr(visual_tracking, "track", lambda *_: pytest.fail("it went on to track"))
    assert run("--sequence", sequence, "--out", tmp_path / "out", *arguments) != 0
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_truth_that_does_not_parse_is_named_with_its_line(tmp_path, capsys):
    (tmp_path / "img").mkdir()
    write_image(tmp_path / "img" / "1.png", np.zeros((20, 20, 3), np.uint8))
    (tmp_path / "gt.txt").write_text("1,1,2,2,9,9,1\n1,2,oops,2,9,9,1\n")
    assert run("--sequence", tmp_path) == 2
    assert "gt.txt, line 2" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--video", "--sequence"])
def test_a_missing_source_is_named(tmp_path, capsys, option):
    assert run(option, tmp_path / "gone", "--box", "1,1,5,5") == 2
    assert f"{option}: " in capsys.readouterr().err


def test_an_unreadable_video_is_named(tmp_path, capsys):
    (tmp_path / "broken.mp4").write_bytes(b"not a video")
    assert run("--video", tmp_path / "broken.mp4", "--box", "1,1,5,5") == 2
    assert "broken.mp4: cannot be read as a video" in capsys.readouterr().err


@pytest.mark.thorough
def test_the_mixture_keeps_more_pedestrians_than_the_particle_filter(data, tmp_path):
    """Three pedestrians in PETS 2009, 40 frames without a crossing."""
    folder = data / "pets09_s2l1"
    if not folder.is_dir():
        pytest.skip(f"no sequence at {folder}")
    assert run("--sequence", folder, "--frames", "1:25", "--out", tmp_path) == 0
    pf, mpf = results_in(tmp_path)["results"]
    assert mpf["all_covered"] >= 0.9
    assert pf["all_covered"] <= 0.5
    assert mpf["on_object"] >= 0.8
