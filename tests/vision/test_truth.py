"""What counts for nothing, beside TrackEval's own readers of MOTChallenge and KITTI."""

import contextlib
import io

import numpy as np
import pytest

from mpfjax.metrics import multi_object_scores
from mpfjax.vision import read_tracks, read_truth
from mpfjax.vision.files.boxes import write_tracks

NUM_FRAMES = 25
SCORES = ("HOTA", "DetA", "AssA", "MOTA", "MOTP", "IDF1", "id_switches", "false_positives")


def walking(rng, num, size=300.0):
    """Boxes (frames, num, 4) that walk, some of them over each other."""
    starts, steps = rng.uniform(0, size, (num, 2)), rng.normal(0, 3, (num, 2))
    places = starts[None] + np.arange(NUM_FRAMES)[:, None, None] * steps[None]
    sides = np.broadcast_to(rng.uniform(15, 60, (num, 2)) * [1, 1.5], (NUM_FRAMES, num, 2))
    return np.round(np.concatenate([places, sides], axis=2), 1)


def found(rng, boxes):
    """Rows of tracks that follow boxes with errors, and now and then change their owner."""
    rows = []
    for frame, here in enumerate(boxes, 1):
        owners = rng.permutation(len(here)) if rng.random() < 0.1 else np.arange(len(here))
        shaken = here + rng.normal(0, 0.12, here.shape) * np.tile(here[:, 2:], 2)
        shaken[:, 2:] = np.maximum(shaken[:, 2:], 1.0)
        rows += [[frame, owner + 1, *box] for owner, box in zip(owners, shaken, strict=True)]
        rows += [[frame, 100 + frame, *rng.uniform(0, 200, 2), *rng.uniform(10, 60, 2)]]
    return np.round(np.array(rows), 3)


def trackeval_scores(dataset, sequence, name):
    """What TrackEval says of a sequence that its own reader has read and cleaned."""
    metrics = pytest.importorskip("trackeval").metrics
    with contextlib.redirect_stdout(io.StringIO()):
        raw = dataset.get_raw_seq_data("ours", sequence)
        data = dataset.get_preprocessed_seq_data(raw, name)
        settings = {"THRESHOLD": 0.5, "PRINT_CONFIG": False}
        hota = metrics.HOTA().eval_sequence(data)
        clear = metrics.CLEAR(settings).eval_sequence(data)
        identity = metrics.Identity(settings).eval_sequence(data)
    means = {score: np.mean(hota[score]) for score in ("HOTA", "DetA", "AssA")}
    counts = {"id_switches": clear["IDSW"], "false_positives": clear["CLR_FP"]}
    return means | counts | {"MOTA": clear["MOTA"], "MOTP": clear["MOTP"], "IDF1": identity["IDF1"]}


def ours(tracks, truth):
    scores = multi_object_scores(
        tracks, truth.objects, ignored=truth.ignored, min_height=truth.min_height
    )
    return {name: scores[name] for name in SCORES}


@pytest.mark.parametrize("benchmark", ["MOT17", "MOT20", "MOT15"])
def test_scores_are_those_of_trackevals_reader_of_motchallenge(tmp_path, benchmark):
    datasets = pytest.importorskip("trackeval").datasets
    rng = np.random.default_rng(1)
    name = f"{benchmark}-01"
    folder = tmp_path / "gt" / name
    (folder / "gt").mkdir(parents=True)
    (folder / "seqinfo.ini").write_text(
        f"[Sequence]\nname={name}\nframeRate=25\nseqLength={NUM_FRAMES}\n"
    )
    # Eight pedestrians, one of whom does not count in every other frame, and one of each class.
    classes = [1] * 8 + list(range(2, 14))
    boxes = walking(rng, len(classes))
    # Nobody tracks the reflection of an occluder, but whoever tracks the occluder overlaps it.
    boxes[:, classes.index(12)] = boxes[:, classes.index(9)] + [2.0, 0, 0, 0]
    lines = []
    for frame, here in enumerate(boxes, 1):
        for id, (kind, box) in enumerate(zip(classes, here, strict=True), 1):
            flag = int(kind == 1 and not (id == 3 and frame % 2))
            last = f"{kind},0.5" if benchmark != "MOT15" else "-1,-1,-1"
            lines.append(f"{frame},{id},{','.join(map(str, box))},{flag},{last}\n")
    (folder / "gt" / "gt.txt").write_text("".join(lines))
    tracks = found(rng, boxes[:, : classes.index(12)])
    (tmp_path / "trackers" / "ours" / "data").mkdir(parents=True)
    write_tracks(tmp_path / "trackers" / "ours" / "data" / f"{name}.txt", tracks)
    dataset, truth = datasets.MotChallenge2DBox({
        "GT_FOLDER": str(tmp_path / "gt"), "TRACKERS_FOLDER": str(tmp_path / "trackers"),
        "BENCHMARK": benchmark, "SEQ_INFO": {name: NUM_FRAMES}, "SKIP_SPLIT_FOL": True,
        "PRINT_CONFIG": False,
    }), read_truth(folder)  # fmt: skip
    expected = trackeval_scores(dataset, name, "pedestrian")
    assert ours(tracks, truth) == pytest.approx({score: expected[score] for score in SCORES})
    if benchmark == "MOT15":
        assert len(truth.ignored) == 0
    else:
        every = multi_object_scores(tracks, read_tracks(folder / "gt" / "gt.txt"))
        assert abs(every["MOTA"] - expected["MOTA"]) > 0.02, "nothing was there to be ignored"


@pytest.mark.parametrize("kind", ["car", "pedestrian"])
def test_scores_are_those_of_trackevals_reader_of_kitti(tmp_path, kind):
    """Other kinds, the hidden and the cut off; regions that nobody labelled; low boxes."""
    datasets = pytest.importorskip("trackeval").datasets
    rng = np.random.default_rng(2)
    other = {"car": "Van", "pedestrian": "Person"}[kind]
    names = [kind.capitalize()] * 9 + [other] * 4
    boxes = walking(rng, len(names))
    regions = np.column_stack([rng.uniform(0, 300, (3, 2)), rng.uniform(40, 90, (3, 2))])
    label, objects, ignored = [], [], []

    def line(frame, id, name, truncated, occluded, box):
        corners = " ".join(f"{v:.3f}" for v in (*box[:2], *(box[:2] + box[2:])))
        return f"{frame - 1} {id} {name} {truncated} {occluded} -10 {corners} 1 1 1 1 1 1 1"

    for frame, here in enumerate(boxes, 1):
        for id, (name, box) in enumerate(zip(names, here, strict=True), 1):
            truncated, occluded = int(id == 2 and frame > 9), 3 if id == 4 and frame % 3 else 0
            label.append(line(frame, id, name, truncated, occluded, box) + "\n")
            counts = name != other and not truncated and not occluded
            (objects if counts else ignored).append([frame, id if counts else 1, *box])
        for box in regions:
            label.append(line(frame, -1, "DontCare", -1, -1, box) + "\n")
            ignored.append([frame, 2, *box])
    tracks = found(rng, boxes)
    rows = [(int(frame), int(id), kind, -1, -1, np.array(box)) for frame, id, *box in tracks]
    result = [line(*row) + " 0.9\n" for row in rows]
    folder, results = tmp_path / "gt", tmp_path / "trackers" / "ours" / "data"
    (folder / "label_02").mkdir(parents=True)
    results.mkdir(parents=True)
    (folder / "label_02" / "0000.txt").write_text("".join(label))
    (folder / "evaluate_tracking.seqmap.training").write_text(f"0000 empty 0 {NUM_FRAMES}\n" * 2)
    (results / "0000.txt").write_text("".join(result))
    dataset = datasets.Kitti2DBox({
        "GT_FOLDER": str(folder), "TRACKERS_FOLDER": str(tmp_path / "trackers"),
        "CLASSES_TO_EVAL": [kind], "PRINT_CONFIG": False,
    })  # fmt: skip
    # The same as our own files have it.
    own = tmp_path / "kitti_0000"
    own.mkdir()
    write_tracks(own / "gt.txt", np.array(objects))
    np.savetxt(own / "ignore.txt", np.array(ignored), "%.9g", ",")
    truth = read_truth(own)
    assert truth.min_height == 25
    expected = trackeval_scores(dataset, "0000", kind)
    assert ours(tracks, truth) == pytest.approx({score: expected[score] for score in SCORES})
    for part in ({"ignored": truth.ignored[truth.ignored[:, 1] == 1]}, {"min_height": 0.0}):
        without = ours(tracks, truth._replace(**part))
        assert without["false_positives"] > expected["false_positives"]


def test_a_truth_is_found_in_its_folder_and_cut_to_frames(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds neither gt\.txt"):
        read_truth(tmp_path)
    (tmp_path / "gt").mkdir()
    (tmp_path / "gt" / "gt.txt").write_text("1,1,5,5,9,9,1\n2,1,5,5,9,9,1\n2,2,5,5,9,9,0\n")
    (tmp_path / "gt" / "ignore.txt").write_text("1,2,0,0,9,9\n\n2,1,0,0,9,9\n")
    truth = read_truth(tmp_path)
    np.testing.assert_array_equal(truth.objects[:, :2], [[1, 1], [2, 1]])
    later = truth.between(2)
    np.testing.assert_array_equal(later.objects[:, :2], [[2, 1]])
    np.testing.assert_array_equal(later.ignored, [[2, 1, 0, 0, 9, 9]])
