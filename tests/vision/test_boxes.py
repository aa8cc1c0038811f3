"""Boxes as text and in files, and what is said of those that are wrong."""

import csv
import json

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


def test_scores_and_classes_are_written_in_each_form(tmp_path):
    rows = np.array([[2.0, 1, 3.25, 4, 5, 6, 0.5, 0], [1, 7, -1.5, 2, 3, 4, 12.25, 3]])
    paths = {ending: tmp_path / f"tracks.{ending}" for ending in ("txt", "csv", "json")}
    for path in paths.values():
        write_tracks(path, rows)
    first = paths["txt"].read_text().splitlines()[0]
    assert first == "1,7,-1.500,2.000,3.000,4.000,12.25,3,-1,-1"
    np.testing.assert_array_equal(read_tracks(paths["txt"]), rows[::-1, :6])
    with paths["csv"].open(newline="") as file:
        table = list(csv.DictReader(file))
    assert list(table[0]) == ["frame", "id", "x", "y", "w", "h", "score", "class"]
    np.testing.assert_array_equal([[float(x) for x in row.values()] for row in table], rows[::-1])
    coco = json.loads(paths["json"].read_text())
    assert [image["id"] for image in coco["images"]] == [1, 2]
    assert [kind["id"] for kind in coco["categories"]] == [0, 3]
    assert coco["annotations"][0] == {
        "id": 1, "image_id": 1, "category_id": 3, "track_id": 7, "bbox": [-1.5, 2.0, 3.0, 4.0],
        "area": 12.0, "iscrowd": 0, "score": 12.25,
    }  # fmt: skip
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
