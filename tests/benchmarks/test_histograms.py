"""Nothing is timed before both ways count the same."""

import importlib.util
import json

import numpy as np
import pytest

from benchmarks import histograms

OPENCV = importlib.util.find_spec("cv2") is not None
SMALL = ["--size", "70", "50", "--repeats", "2"]


@pytest.mark.skipif(not OPENCV, reason="OpenCV comes with the extra 'video', which 'test' brings")
class TestBesideOpenCV:
    def test_both_are_timed(self, tmp_path, capsys):
        assert histograms.main([*SMALL, "--boxes", "3", "9", "--out", str(tmp_path)]) == 0
        results = json.loads((tmp_path / "histograms.json").read_text())["results"]
        assert [found["boxes"] for found in results] == [3, 9]
        assert all(len(found[name]) == 2 for found in results for name in ("integral", "opencv"))
        assert "ratio" in capsys.readouterr().out

    def test_a_pixel_too_many_is_refused(self, tmp_path, capsys, monkeypatch):
        by_opencv = histograms.by_opencv

        def one_more(*arguments):
            return lambda: by_opencv(*arguments)() + 1

        monkeypatch.setattr(histograms, "by_opencv", one_more)
        assert histograms.main([*SMALL, "--boxes", "3", "--out", str(tmp_path)]) == 2
        assert "differ" in capsys.readouterr().err

    def test_boxes_are_counted_one_by_one(self):
        frame = np.zeros((50, 70, 3), np.uint8)
        frame[10:20, 30:40] = 255
        boxes = np.array([[35.0, 15.0, 20.0, 20.0], [0.0, 0.0, 20.0, 10.0]], np.float32)
        counts = histograms.by_opencv(frame, boxes)()
        assert counts[0, :, -1].tolist() == [100] * 3
        assert counts[0, :, 0].tolist() == [300] * 3
        assert counts[1, :, 0].tolist() == [50] * 3


@pytest.mark.parametrize("option", ["--boxes", "--repeats"])
def test_none_is_too_few(option, capsys):
    with pytest.raises(SystemExit):
        histograms.main([option, "0"])
    assert f"{option}: '0'" in capsys.readouterr().err
