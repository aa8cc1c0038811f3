"""Boxes as text and in files, and what is said of those that are wrong."""

import numpy as np
import pytest

from mpfjax.vision.files.boxes import (
    check_boxes,
    read_detections,
    read_tracks,
    write_tracks,
)


def test_a_box_across_the_border_is_none_of_both():
    check_boxes(np.array([(-5, -5, 10, 10), (195, 95, 10, 10)], float), 100, 200)


def test_what_is_written_is_read(tmp_path):
    rows = np.array([[2.0, 1, 3.25, 4, 5, 6], [1, 7, -1.5, 2, 3, 4], [1, 2, 1, 2, 3, 4]])
    path = tmp_path / "tracks.txt"
    write_tracks(path, rows)
    lines = path.read_text().splitlines()
    assert lines[0] == "1,2,1.000,2.000,3.000,4.000,1,-1,-1,-1"
    np.testing.assert_array_equal(read_tracks(path), rows[[2, 1, 0]])


@pytest.mark.parametrize(
    "line",
    [
        "1,3,10,20,30,40",
        "1,3,10,20,30,40,1,-1,-1,-1,9",
        "1,3,ten,20,30,40,1",
        "-1,3,10,20,30,40,1",
        "1,3,nan,20,30,40,1",
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
