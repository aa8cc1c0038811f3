"""The benchmark of the camera's motion, on few frames of a small match."""

import json

import numpy as np
import pytest

from benchmarks import camera_motion
from benchmarks.tracking_by_detection import football
from mpfjax.vision.files.frames import write_image

pytest.importorskip("cv2", reason="OpenCV comes with the extra 'video', which 'test' brings")
pytest.importorskip("trackeval", reason="scores need the extra 'trackeval', which 'test' brings")


def test_a_panning_camera_and_a_folder_of_a_still_one(tmp_path, monkeypatch, capsys):
    """The pan is found to a tenth of it, and a picture that stands still is found to."""
    monkeypatch.setattr(football, "MATCHES", football.MATCHES[:1])
    frame = football.play(football.MATCHES[0], 0, 1).frames[0]
    folder = tmp_path / "still"
    (folder / "img").mkdir(parents=True)
    for number in range(1, 6):
        write_image(folder / "img" / f"{number:06d}.png", frame)
    rows = [f"{number},1,100,100,30,60,1,-1,-1,-1\n" for number in range(1, 6)]
    (folder / "gt.txt").write_text("".join(rows))
    out = tmp_path / "out"
    given = [folder, "--frames", 10, "--seeds", 1, "--out", out]
    assert camera_motion.main([str(argument) for argument in given]) == 0
    found = json.loads((out / "camera_motion.json").read_text())
    pan, still = found["found"]
    assert pan["known"] == still["known"] == 1
    assert pan["error"] < 0.1 * pan["moved"]
    assert still["moved"] < 1e-3
    assert [row["motion"] for row in found["tracked"]] == ["detections", "pixels"] * 2
    assert np.isfinite([row["HOTA"] for row in found["tracked"]]).all()
    assert "CPU ms" in capsys.readouterr().out
