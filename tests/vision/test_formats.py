"""Files of other benchmarks and of labelling tools: each read rightly, or refused by name."""

import json

import numpy as np
import pytest

from mpfjax.metrics.tracking_scores import IGNORED_OBJECT, IGNORED_REGION, UNSCORED_OBJECT
from mpfjax.vision import read_detections, read_tracks, read_truth, write_tracks
from mpfjax.vision.files.boxes import check_boxes
from mpfjax.vision.files.sequences import SequenceInfo, read_sequence_info


def truth_of(folder, lines, name="gt.txt", **options):
    (folder / name).write_text("".join(f"{line}\n" for line in lines))
    return read_truth(folder / name, **options)


def ids(rows):
    return sorted(set(rows[:, 1].tolist()))


# --- what the eighth column means ----------------------------------------------------------

BOXES = ["10,10,20,40", "60,10,20,40", "110,10,20,40", "160,10,20,40"]


def rows_with(*lasts):
    return [
        f"{frame},{id},{box},{last}"
        for frame in (1, 2, 3)
        for id, (box, last) in enumerate(zip(BOXES, lasts, strict=True), 1)
    ]


CASES = {
    "MOT17: a pedestrian, a rider, a car, a pedestrian that does not count": (
        {"gt.txt": rows_with("1,1,1", "0,2,.8", "0,3,1", "0,1,.2")},
        ([1], {2: IGNORED_OBJECT, 3: UNSCORED_OBJECT, 4: UNSCORED_OBJECT})),
    "eight columns are somebody's classes": (
        {"gt.txt": rows_with("1,1", "1,2", "1,3", "0,1")}, ([1, 2, 3], {})),
    "eight columns of MOT16, by its name": (
        {"gt.txt": rows_with("1,1", "1,2", "1,3", "0,1"),
         "seqinfo.ini": ["[Sequence]", "NAME : MOT16-02"]},
        ([1], {2: IGNORED_OBJECT, 3: UNSCORED_OBJECT, 4: UNSCORED_OBJECT})),
    "classes beyond MOTChallenge's": (
        {"gt.txt": rows_with("1,1,1", "1,14,1", "1,3,1", "0,1,1")}, ([1, 2, 3], {})),
    "nine columns, whose last is no visibility": (
        {"gt.txt": rows_with("1,1,4", "1,2,1", "1,3,2", "0,1,3")}, ([1, 2, 3], {})),
    "VisDrone": (
        {"gt.txt": rows_with("1,4,0,2", "1,11,1,0", "0,0,0,0", "0,1,0,1")},
        ([1], dict.fromkeys((2, 3, 4), IGNORED_REGION))),
    "VisDrone: pedestrians and cars count alike": (
        {"gt.txt": rows_with("1,1,0,0", "1,4,0,0", "1,10,1,2", "0,0,0,0")},
        ([1, 2, 3], {4: IGNORED_REGION})),
    "MOT15: places in metres": (
        {"gt.txt": rows_with("1,3.5,1,0", "1,-2,0,0", "0,1,1,0", "1,1,1,0")}, ([1, 2, 4], {})),
    "CVAT: labels.txt names the classes": (
        {"gt.txt": rows_with("1,1,1.0", "1,2,1.0", "1,3,0.0", "0,1,1.0"),
         "labels.txt": ["cat", "dog", "person"]},
        ([1, 2, 3], {})),
    "CVAT: the classes of MOTChallenge": (
        {"gt.txt": rows_with("1,1,1.0", "1,2,1.0", "1,3,0.0", "0,1,1.0"),
         "labels.txt": [
             "pedestrian", "person on vehicle", "car", "bicycle", "motorbike",
             "non motorized vehicle", "static person", "distractor", "occluder",
             "occluder on the ground", "occluder full", "reflection"]},
        ([1], {2: IGNORED_OBJECT, 3: UNSCORED_OBJECT, 4: UNSCORED_OBJECT})),
    "UAVDT: out of view, occlusion and category": (
        {"M0203_gt_whole.txt": rows_with("1,1,1", "1,2,1", "2,3,1", "3,1,1"),
         "M0203_gt_ignore.txt": ["1,-1,300,10,50,50,1,-1,-1", "2,-1,300,10,50,50,1,-1,-1"]},
        ([1, 2, 3, 4], {-1: IGNORED_REGION})),
    "UAVDT: in view and occlusion": (
        {"M0203_gt.txt": rows_with("1,1,1", "1,2,1", "1,3,1", "1,-1,-1")}, ([1, 2, 3, 4], {})),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_eighth_column_is_read_for_what_the_files_say_that_it_is(tmp_path, name):
    files, (counted, ignored) = CASES[name]
    for file, lines in files.items():
        (tmp_path / file).write_text("\r\n".join(lines))
    truth = read_truth(tmp_path / next(iter(files)))
    assert ids(truth.objects) == counted
    assert len(truth.objects) == 3 * len(counted)
    places = {float(box.split(",")[0]): id for id, box in enumerate(BOXES, 1)}
    assert {places.get(row[2], -1): row[1] for row in truth.ignored} == ignored


FORMATS = {"motchallenge": [1, 4], "cvat": [1, 2, 4], "visdrone": [1, 2, 4], "uavdt": [1, 2, 3, 4]}


@pytest.mark.parametrize(("format", "counted"), FORMATS.items(), ids=FORMATS)
def test_the_format_may_be_said(tmp_path, format, counted):
    lines = rows_with("1,1", "1,2", "0,1", "1,1")
    assert ids(truth_of(tmp_path, lines, format=format).objects) == counted


def test_an_object_without_an_identity_is_refused_by_the_line(tmp_path):
    """CVAT writes -1 for shapes that are no tracks."""
    with pytest.raises(ValueError, match=r"gt\.txt, line 2: an object without an id"):
        truth_of(tmp_path, ["1,1,5,5,9,9,1,1,1", "1,-1,5,5,9,9,1,1,1"])
    assert len(truth_of(tmp_path, ["1,1,5,5,9,9,1", "1,-1,5,5,9,9,0"]).objects) == 1


# --- what a line may look like --------------------------------------------------------------

READERS = {
    "truth": lambda path: read_truth(path).objects,
    "tracks": read_tracks,
    "detections": lambda path: read_detections(path)[:, :6],
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    "text",
    [
        "1,7,10,20,30,40,1\n2,7,11,21,30,40,1\n",
        "1,7,10,20,30,40,1\r2,7,11,21,30,40,1",
        "\n\n1, 7, 10, 20, 30, 40, 1,\r\n\r\n2, 7, 11, 21, 30, 40, 1,\r\n",
        "1\t7\t10\t20\t30\t40\t1\n2\t7\t11\t21\t30\t40\t1\n",
        "1 7  10 20 30 40 1\n2 7  11 21 30 40 1\n",
        "1;7;10;20;30;40;1\n2;7;11;21;30;40;1\n",
        '"1","7","10","20","30","40","1"\n2,7,11,21,30,40,1\n',
        "frame,id,x,y,w,h,score\n1,7,10,20,30,40,1\n2,7,11,21,30,40,1\n",
        "\ufeffFrame;Track ID;bb_left;bb_top;bb_width;bb_height;Conf\n1;7;10;20;30;40;1\n"
        "2;7;11;21;30;40;1",
        '# frame_id, track_id, x, y, w, h, "not ignored", class_id\n1,7,10,20,30,40,1\n'
        "2,7,11,21,30,40,1",
        "<frame_index>,<target_id>,<bbox_left>,<bbox_top>,<bbox_width>,<bbox_height>,<score>\n"
        "1,7,10,20,30,40,1\n2,7,11,21,30,40,1\n",
        "% the street, on a Monday\n1,7,10,20,30,40,1\n// later\n2,7,11,21,30,40,1 # the same\n",
        "1.0,7.0,10,20,30,40,1\n2e0,7,11,21,30,40,1\n",
    ],
)
def test_separators_headers_and_comments_are_read(tmp_path, reader, text):
    path = tmp_path / "gt.txt"
    path.write_bytes(text.encode())
    expected = [[1, 7, 10, 20, 30, 40], [2, 7, 11, 21, 30, 40]]
    np.testing.assert_array_equal(READERS[reader](path), expected)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame,id,x1,y1,x2,y2,score\n1,7,10,20,30,40,1", "line 1: .* is not frame"),
        ("# frame,id,cx,cy,w,h,score\n1,7,10,20,30,40,1", "line 1: .* is not frame"),
        ("id,frame,x,y,w,h,score\n1,7,10,20,30,40,1", "line 1: .* is not frame"),
        ("1,7,1,1,3,4,1\nframe,id,x,y,w,h,score\n2,7,1,1,3,4,1", "line 2: 'frame,id.* is not"),
        ("0,7,1,1,3,4,1\n1,7,1,1,3,4,1", "line 1: .* is not frame"),
        ("1;7;10,5;20;30;40;1", "line 1: .* is not frame"),
        ("1,7,1,1,3,,1", "line 1: .* is not frame"),
        ("1,7,1,1,3,4,1\n1,3,ten,20,30,40,1", "line 2: .* is not frame"),
        ("1,7,1,1,3,4,1\n1,3,nan,20,30,40,1", "line 2: .* is not frame"),
        ("1,7,1,1,3,4,1\n1,3,10,20,30,40,1,-1,-1,-1,9", "line 2: .* is not frame"),
        ("frame,id,x,y,w,h,score\n", "holds no (boxes|detections)"),
    ],
)
def test_other_headers_and_frames_are_refused_by_the_line(tmp_path, reader, text, said):
    path = tmp_path / "gt.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"gt\.txt(:|,) ?{said}"):
        READERS[reader](path)


# --- seqinfo.ini ----------------------------------------------------------------------------

INFO = SequenceInfo("MOT17-02", 30.0, 600, (1080, 1920))
LINES = "name=MOT17-02\nframeRate=30\nseqLength=600\nimWidth=1920\nimHeight=1080\n"


@pytest.mark.parametrize(
    "text",
    [
        f"[Sequence]\n{LINES}",
        f"[Sequence]\n{LINES.upper()}",
        f"[sequence]\r\n; of a street\r\n{LINES.lower()}".replace("mot", "MOT"),
        f"\ufeff[Sequence]\n{LINES}imExt=.jpg\nimDir=img1\nnote=100%\n",
        "[Sequence]\n" + LINES.replace("=", " : "),
        "[Sequence]\n" + LINES.replace("name", "  name").replace("frame", "\tframe"),
        "[Sequence]\n\n" + LINES.replace("600", "600.0") + "\n[More]\nauthor=somebody\n",
    ],
)
def test_the_metadata_of_a_sequence_are_read_however_they_are_written(tmp_path, text):
    (tmp_path / "seqinfo.ini").write_bytes(text.encode())
    assert read_sequence_info(tmp_path) == INFO


# --- boxes --------------------------------------------------------------------------------


def test_a_box_across_the_border_is_none_of_both():
    check_boxes(np.array([(-5, -5, 10, 10), (195, 95, 10, 10)], float), 100, 200)


def test_scores_and_classes_are_written_in_each_form(tmp_path):
    rows = np.array([[2.0, 1, 3.25, 4, 5, 6, 0.5, 0], [1, 7, -1.5, 2, 3, 4, 12.25, 3]])
    paths = {ending: tmp_path / f"tracks.{ending}" for ending in ("txt", "csv", "json")}
    for path in paths.values():
        write_tracks(path, rows)
    first = paths["txt"].read_text().splitlines()[0]
    assert first == "1,7,-1.500,2.000,3.000,4.000,12.25,3,-1,-1"
    np.testing.assert_array_equal(read_tracks(paths["txt"]), rows[::-1, :6])
    assert paths["csv"].read_text().startswith("frame,id,x,y,w,h,score,class\n")
    table = np.loadtxt(paths["csv"], delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table, rows[::-1])
    coco = json.loads(paths["json"].read_text())
    assert [image["id"] for image in coco["images"]] == [1, 2]
    assert [kind["id"] for kind in coco["categories"]] == [0, 3]
    assert coco["annotations"][0] == {
        "id": 1, "image_id": 1, "category_id": 3, "track_id": 7, "bbox": [-1.5, 2.0, 3.0, 4.0],
        "area": 12.0, "iscrowd": 0, "score": 12.25,
    }  # fmt: skip
    write_tracks(paths["txt"], rows[:, :6])
    lines = paths["txt"].read_text().splitlines()
    assert lines[1] == "2,1,3.250,4.000,5.000,6.000,1,-1,-1,-1"
    with pytest.raises(ValueError, match=r"rows: .* is not frame"):
        write_tracks(paths["csv"], np.array([[1.0, 1, 5, 5, 9, 9, 1, -1]]))


def test_the_eighth_column_is_a_class_for_who_says_so(tmp_path):
    path = tmp_path / "det.txt"
    path.write_text("1,-1,10,20,30,40,.9,2\n1,-1,50,20,30,40,.8,0\n")
    assert read_detections(path).shape == (2, 7)
    assert read_detections(path, with_classes=True)[:, 7].tolist() == [2, 0]
    path.write_text("1,-1,10,20,30,40,.9,2.5\n")
    with pytest.raises(ValueError, match=r"line 1: .*class"):
        read_detections(path, with_classes=True)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path, encoding):
    path = tmp_path / "det.txt"
    path.write_text("1,-1,10,20,30,40,.5\r\n2,-1,10,20,30,40,.5\r\n", encoding=encoding)
    np.testing.assert_array_equal(read_detections(path)[:, 0], [1, 2])
