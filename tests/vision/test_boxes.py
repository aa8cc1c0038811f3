"""Boxes as text and in files, and what is said of those that are wrong."""

import numpy as np
import pytest

from mpfjax.vision.files.boxes import (
    boxes_of_frame,
    centred,
    check_boxes,
    parse_box,
    read_detections,
    read_tracks,
    top_left,
    write_tracks,
)


def test_a_box_is_read():
    np.testing.assert_array_equal(parse_box("1, 2.5,30,4e1"), [1, 2.5, 30, 40])


@pytest.mark.parametrize(
    "text", ["", "1,2,3", "1,2,3,4,5", "1,2,three,4", "1,2,nan,4", "1,2,inf,4"]
)
def test_a_box_that_does_not_parse_is_named(text):
    with pytest.raises(ValueError, match="--box: "):
        parse_box(text, "--box")


@pytest.mark.parametrize("box", [(10, 10, 0, 5), (10, 10, 5, -1), (10, 10, 0, 0)])
def test_a_box_of_no_area_is_named(box):
    with pytest.raises(ValueError, match=r"--box: 10,10,.* no area"):
        check_boxes(np.array([(1, 1, 5, 5), box], float), 100, 200, "--box")


@pytest.mark.parametrize(
    "box", [(200, 10, 9, 9), (-9, 10, 9, 9), (10, 100, 9, 9), (10, -9.5, 9, 9)]
)
def test_a_box_outside_the_first_frame_is_named(box):
    with pytest.raises(ValueError, match=r"boxes: .* outside the first frame, 200 x 100"):
        check_boxes(np.array([box], float), 100, 200)


def test_a_box_across_the_border_is_none_of_both():
    check_boxes(np.array([(-5, -5, 10, 10), (195, 95, 10, 10)], float), 100, 200)


def test_corners_and_centres():
    boxes = np.array([[10.0, 20, 4, 8]])
    np.testing.assert_array_equal(centred(boxes), [[12, 24, 4, 8]])
    np.testing.assert_array_equal(top_left(centred(boxes)), boxes)


def test_what_is_written_is_read(tmp_path):
    rows = np.array([[2.0, 1, 3.25, 4, 5, 6], [1, 7, -1.5, 2, 3, 4], [1, 2, 1, 2, 3, 4]])
    path = tmp_path / "tracks.txt"
    write_tracks(path, rows)
    lines = path.read_text().splitlines()
    assert lines[0] == "1,2,1.000,2.000,3.000,4.000,1,-1,-1,-1"
    np.testing.assert_array_equal(read_tracks(path), rows[[2, 1, 0]])
    assert list(boxes_of_frame(read_tracks(path), 1)) == [2, 7]


@pytest.mark.parametrize("extra", ["1", "1,-1", "1,-1,-1", "1,-1,-1,-1"])
def test_seven_to_ten_columns_are_read(tmp_path, extra):
    path = tmp_path / "gt.txt"
    path.write_text(f"1,3,10,20,30,40,{extra}\n\n")
    np.testing.assert_array_equal(read_tracks(path), [[1, 3, 10, 20, 30, 40]])


@pytest.mark.parametrize(
    "line",
    [
        "1,3,10,20,30,40",
        "1,3,10,20,30,40,1,-1,-1,-1,9",
        "1,3,ten,20,30,40,1",
        "1.5,3,10,20,30,40,1",
        "-1,3,10,20,30,40,1",
        "1,3,nan,20,30,40,1",
        "inf,3,10,20,30,40,1",
        "frame id x y w h",
    ],
)
def test_a_line_that_does_not_parse_is_named(tmp_path, line):
    path = tmp_path / "gt.txt"
    path.write_text(f"1,2,10,20,30,40,1,-1,-1,-1\n{line}\n")
    with pytest.raises(ValueError, match=r"gt\.txt, line 2: "):
        read_tracks(path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path, encoding):
    path = tmp_path / "det.txt"
    path.write_text("1,-1,10,20,30,40,.5\r\n2,-1,10,20,30,40,.5\r\n", encoding=encoding)
    np.testing.assert_array_equal(read_detections(path)[:, 0], [1, 2])


def test_an_empty_file_is_named(tmp_path):
    (tmp_path / "gt.txt").write_text("\n")
    with pytest.raises(ValueError, match=r"gt\.txt: holds no boxes"):
        read_tracks(tmp_path / "gt.txt")
