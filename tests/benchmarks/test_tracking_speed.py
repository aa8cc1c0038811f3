"""The video on which the tracker is timed, and one round of the quickest way."""

import json

import numpy as np
import pytest

from benchmarks import tracking_speed
from benchmarks.tracking_speed import CROWD, LARGE, SMALL, WAYS, Street, Way
from mpfjax.vision.tracking.background import BackgroundSubtraction


@pytest.mark.parametrize("street", [Street(*SMALL), Street(*LARGE, CROWD)])
def test_objects_stay_in_the_frame_and_apart_and_move(street):
    boxes = np.stack([street.boxes(t) for t in range(0, 200, 5)])
    low, high = boxes[..., :2], boxes[..., :2] + boxes[..., 2:]
    assert (low >= 0).all()
    assert (high <= [street.background.shape[1], street.background.shape[0]]).all()
    for i in range(len(street.centres)):
        others = np.arange(len(street.centres)) != i
        met = (low[:, [i]] < high[:, others]) & (low[:, others] < high[:, [i]])
        assert not met.all(axis=-1).any()
    assert (np.ptp(low, axis=0) > 3).all()


def test_the_detector_finds_them():
    pytest.importorskip("cv2", reason="OpenCV comes with the extra 'video', which 'test' brings")
    street, detector = Street(*SMALL), BackgroundSubtraction()
    for t in range(12):
        found = detector.detect(street.frame(t))
    centres = found[:, :2] + found[:, 2:] / 2
    true = street.boxes(11)
    gaps = np.abs(centres[None] - (true[:, :2] + true[:, 2:] / 2)[:, None]) / street.box
    assert (gaps.max(axis=2).min(axis=1) < 0.5).sum() >= 0.8 * len(street.centres)


@pytest.mark.thorough
def test_a_round_is_timed_in_a_process_of_its_own(tmp_path, monkeypatch, capsys):
    alone = WAYS[3]
    assert (alone.size, alone.room) == (None, 40)
    monkeypatch.setattr(tracking_speed, "WAYS", (alone, alone._replace(name="again")))
    monkeypatch.setattr(tracking_speed, "in_turns", _once(tracking_speed.in_turns, alone))
    options = ["--frames", "2", "--rounds", "2", "--out", str(tmp_path)]
    assert tracking_speed.main(options) == 0
    row = json.loads((tmp_path / "tracking_speed.json").read_text())["rows"][0]
    assert row["objects"] == alone.num_objects
    assert row["detect_ms"] == 0 < row["track_ms"]
    assert row["frames_per_second"] >= row["median_frames_per_second"] > 0
    assert 50 < row["peak_memory_mb"] < 600
    assert "no pixels" in capsys.readouterr().out


def _once(in_turns, way):
    """Compiling takes seconds: one process stands for both ways."""

    def of_one(ways, *sizes):
        return dict.fromkeys(ways, in_turns((way,), *sizes)[way])

    return of_one


def test_a_process_that_ends_is_named():
    broken = Way("no frame", (0, 0))
    with pytest.raises(ValueError, match="no frame: its process ended before its time"):
        tracking_speed.in_turns((broken,), 1, 1)
