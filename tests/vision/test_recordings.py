"""Bars on recordings of real scenes, where they are there: scores of TrackEval, in hundredths."""

import itertools

import numpy as np
import pytest

from mpfjax.metrics import multi_object_scores
from mpfjax.vision import ObjectTracker, read_detections, read_truth, track
from mpfjax.vision.files.sequences import last_frame, read_sequence_info
from mpfjax.vision.tracking.adapters import Rows
from mpfjax.vision.tracking.track import online_rows
from tests.marking import quick_of

pytestmark = pytest.mark.real_data


def scores_of(folder):
    rows, truth = read_detections(folder / "det.txt"), read_truth(folder / "gt.txt")
    info = read_sequence_info(folder)
    last = last_frame(info, rows, truth.objects)
    found = Rows(rows)
    tracker = ObjectTracker(found.most_objects(), frames_per_second=info.frame_rate)
    first = int(found.frames[0])
    frames = itertools.repeat(None, last - first + 1)
    tracked = track(frames, found, tracker, first=first, frame_size=info.size)
    rows = np.concatenate([online_rows(tracks) for tracks in tracked])
    away = {"ignored": truth.ignored, "min_height": truth.min_height}
    found = multi_object_scores(rows, truth.objects, **away)
    return 100 * found["HOTA"], 100 * found["IDF1"], found["id_switches"]


# Half a point below what was measured in November 2026, and the best peer is far below.
BARS = {
    "tud_stadtmitte": (54.5, 79.5, 15),
    "kitti_0017_ped": (49.5, 77.5, 9),
    "kitti_0013_ped": (51.0, 79.5, 4),
    "kitti_0015_ped": (43.0, 68.0, 12),
    "kitti_0008_car": (63.5, 83.5, 4),
    "kitti_0005_car_5hz": (63.0, 77.5, 14),
    "bev_0010": (74.0, 86.5, 4),
    "kitti_0001_car": (75.0, 88.5, 4),
    "mot17_09v": (68.5, 80.5, 22),
    "mot17_05v": (62.5, 78.5, 32),
    "mot17_11v": (68.0, 79.5, 9),
    "mot17_02v": (45.0, 53.5, 105),
    "dance_0014_sim": (38.0, 44.5, 110),
    "hockey_1_sim": (86.5, 94.0, 5),
}
"""HOTA and IDF1 at least, identity switches at most."""


@pytest.mark.filterwarnings("ignore:detections")
@pytest.mark.parametrize("name", quick_of(BARS, list(BARS)[:2], one_in=6))
def test_the_scores_of_a_recording_are_what_they_were(name, data):
    hota, idf1, switches = scores_of(data / "tracks" / name)
    least_hota, least_idf1, most = BARS[name]
    assert hota >= least_hota
    assert idf1 >= least_idf1
    assert switches <= most
