"""Our trackers beside others: what is written, what is missing, and the threshold of scores."""

import json
import sys

import numpy as np
import pytest

from benchmarks.tracking_by_detection import __main__ as benchmark
from benchmarks.tracking_by_detection import football
from benchmarks.tracking_by_detection.peers import Peer, peers
from mpfjax.vision.files.boxes import write_tracks
from mpfjax.vision.files.frames import write_image
from tests.examples import two_walkers

pytest.importorskip("av", reason="reading frames needs the extra 'video', which 'test' brings")
pytest.importorskip("trackeval", reason="scoring needs the extra 'trackeval', which 'test' brings")

COLUMNS = [
    "tracker", "sequence", "detections", "HOTA", "MOTA", "IDF1", "id_switches", "frames_per_second"
]  # fmt: skip
NUM_FRAMES = 6


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A sequence of noise with the true boxes as detections, once with scores and once without."""
    folder = tmp_path_factory.mktemp("sequences") / "walks"
    (folder / "img1").mkdir(parents=True)
    (folder / "det").mkdir()
    frames = np.random.default_rng(0).integers(0, 255, (NUM_FRAMES, 48, 64, 3), dtype=np.uint8)
    for i, frame in enumerate(frames, 1):
        write_image(folder / "img1" / f"{i:06d}.png", frame)
    rows = two_walkers(NUM_FRAMES)
    write_tracks(folder / "gt.txt", rows)
    lines = [f"{f:.0f},-1,{x},{y},{w},{h}" for f, _, x, y, w, h in rows]
    scored = [f"{line},{0.9 - 0.01 * i}\n" for i, line in enumerate(lines)]
    # Weak detections of nothing, which the same minimal score leaves out.
    scored += [f"{f},-1,40,5,8,14,0.1\n" for f in range(1, NUM_FRAMES + 1)]
    (folder / "det" / "det.txt").write_text("".join(scored))
    return folder


def perfect(frames_per_second):
    """A peer that names boxes by where they are, and weak ones otherwise."""

    def step(boxes, scores):
        ids = np.where(scores < 0.5 * scores.max(), 3, np.where(boxes[:, 1] < 20, 1, 2))
        return np.column_stack([ids, boxes])

    return step


@pytest.mark.thorough
def test_one_row_for_each_tracker_and_setting(sequence, tmp_path, monkeypatch, capsys):
    others = [Peer("Other", setting, perfect) for setting in ("defaults", "advised")]
    monkeypatch.setattr(benchmark, "peers", lambda: others)
    out = ["--out", str(tmp_path), "--seeds", "1", "--frames", "1:4", "--no-colour"]
    assert benchmark.main([str(sequence), *out]) == 0
    content = json.loads((tmp_path / "tracking_by_detection.json").read_text())
    assert list(content) == ["rows"]
    assert all(list(row) == COLUMNS for row in content["rows"])
    names = [row["tracker"] for row in content["rows"]]
    assert names == [
        "mpfjax", "Other, defaults", "Other, advised",
        "mpfjax, score >= 0.81", "Other, defaults, score >= 0.81",
    ]  # fmt: skip
    by_name = {row["tracker"]: row for row in content["rows"]}
    assert {row["sequence"] for row in content["rows"]} == {"walks"}
    assert by_name["Other, defaults, score >= 0.81"]["HOTA"] == 1
    assert by_name["Other, defaults, score >= 0.81"]["id_switches"] == 0
    assert by_name["Other, defaults"]["MOTA"] < 1, "weak detections were left out unasked"
    assert by_name["mpfjax, score >= 0.81"]["HOTA"] > 0.5
    assert all(row["frames_per_second"] > 0 for row in content["rows"])
    printed = capsys.readouterr().out.splitlines()
    assert printed[2].startswith("Other, defaults, score")


def test_what_is_not_installed_is_said_with_how_to_get_it(monkeypatch, capsys):
    for name in ("trackers", "supervision", "norfair"):
        monkeypatch.setitem(sys.modules, name, None)
    assert peers() == []
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "pip install trackers filterpy trackeval" in lines[0]
    assert "norfair" in lines[1]


@pytest.mark.parametrize("package", ["trackers", "norfair"])
def test_peers_follow_two_walkers(package):
    pytest.importorskip(
        package,
        reason="peers come with the extra 'peers', not with 'test': their version caps clash",
    )
    rows = two_walkers(NUM_FRAMES)
    tried = [peer for peer in peers() if (peer.name == "norfair") == (package == "norfair")]
    assert {peer.setting for peer in tried} == {"defaults", "advised"}
    for peer in tried:
        step = peer.make(10.0)
        # norfair starts late, at half of the hits that it counts to.
        for _ in range(10):
            tracked = step(rows[rows[:, 0] == 3][:, 2:6], np.full(2, 0.9))
        assert len(tracked) == len(set(tracked[:, 0])) == 2
        places = tracked[np.argsort(tracked[:, 2]), 1:]
        np.testing.assert_allclose(places, rows[rows[:, 0] == 3][:, 2:6], atol=1)


def test_the_threshold_parts_two_groups_of_scores():
    random = np.random.default_rng(0)
    scores = np.concatenate([random.normal(0.2, 0.05, 300), random.normal(0.8, 0.05, 100)])
    threshold = benchmark.otsu(random.permutation(scores))
    assert np.mean((scores >= threshold) == (np.arange(400) >= 300)) > 0.99
    assert benchmark.otsu(np.array([0.5])) == 0.5


def test_the_simulated_detector_errs_as_it_says():
    match = football.MATCHES[0]
    # So far apart that nobody hides another, but for the second of each frame.
    corners = np.array([[10, 10], [102, 5], [100, 10], [200, 10], [300, 10]])
    rows = [[t, i, *corner, 20, 50] for t in range(1, 1001) for i, corner in enumerate(corners, 1)]
    truth = np.array(rows, float)
    found = football.detect(match, truth, 0)
    gaps = np.abs(found[:, None, 2:6] - np.concatenate([corners, np.tile([20, 50], (5, 1))], 1))
    near = np.all(gaps <= 6 * football.ERROR * np.array([20, 50, 20, 50]), axis=2)
    hits = near.sum(axis=0) / 1000
    assert hits[[0, 3, 4]] == pytest.approx(1 - football.MISSES, abs=0.04)
    true_ones = near[:, [0, 3, 4]].any(axis=1)
    offsets = found[near[:, 0], 2] - 10
    assert offsets.std() == pytest.approx(football.ERROR * 20, rel=0.1)
    assert len(found) / 1000 == pytest.approx(4 * 0.9 + football.FALSE_ONES, abs=0.1)
    assert found[true_ones, 6].mean() == pytest.approx(0.8, abs=0.02)
    assert not (football._hidden(np.array([[0, 0, 9, 9], [50, 50, 9, 9.0]])) > 0).any()


def test_a_scene_is_a_sequence(tmp_path, monkeypatch):
    small = football.Match("small", 2, 96, 160)
    monkeypatch.setattr(football, "MATCHES", (small,))
    options = ["--scene", "football", "--frames", "2:4"]
    (sequence,) = benchmark.open_sequences(benchmark.parse_arguments(options))
    assert len(list(sequence.stills())) == 3
    assert set(sequence.truth.objects[:, 0]) == {2, 3, 4} >= set(sequence.rows[:, 0])
    assert (sequence.name, sequence.detections) == ("small", "simulated")


@pytest.mark.parametrize("arguments", [[], ["folder", "--scene", "football"]])
def test_a_folder_or_a_scene_is_needed_and_not_both(arguments, capsys):
    with pytest.raises(SystemExit):
        benchmark.parse_arguments(arguments)
    assert "one of DIR and --scene is needed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("message", "missing"),
    [("and no gt.txt", "gt.txt"), ("0 files det", "det")],
)
def test_what_a_sequence_lacks_is_said(sequence, tmp_path, capsys, message, missing):
    for part in ("gt.txt", "det", "img1"):
        if part != missing:
            (tmp_path / part).symlink_to(sequence / part)
    assert benchmark.main([str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert benchmark.main([str(tmp_path / "gone"), "--out", str(tmp_path / "out")]) == 2
    assert "gone is not a folder" in capsys.readouterr().err


def test_a_sequence_without_images_is_tracked_by_its_detections(sequence, tmp_path):
    for part in ("gt.txt", "det"):
        (tmp_path / part).symlink_to(sequence / part)
    options = benchmark.parse_arguments([str(tmp_path), "--frames", "2:"])
    (opened,) = benchmark.open_sequences(options)
    assert opened.stills() is None
    assert opened.first == 2
    assert opened.last == int(max(opened.rows[:, 0].max(), opened.truth.objects[:, 0].max()))


def test_means_are_of_those_that_ran_on_all_sequences():
    scores = {"HOTA": 0.5, "MOTA": 0.5, "IDF1": 0.5, "id_switches": 2}
    rows = [{"tracker": "a", **scores}, {"tracker": "b", **scores}]
    rows.append({"tracker": "b", **scores, "HOTA": 0.7})
    assert benchmark.means(rows, 2).splitlines()[-1].split() == [
        "b",
        "0.600",
        "0.500",
        "0.500",
        "2.0",
    ]
