"""The frames and the two targets in them: a sequence, or a rendered scene."""

import argparse
import os
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.scenes.football import football_scene
from mpfjax.vision import read_truth
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files import frames

DEFAULT_IDS, DEFAULT_FRAMES = [11, 13], "129:199"


class Targets(NamedTuple):
    """Frames and two targets in them."""

    name: str
    stills: np.ndarray  # (t, h, w, 3)
    first: int  # the number of the first frame
    truth: np.ndarray  # (t, 2, 4), centre and size of each target's true box


def open_targets(options: argparse.Namespace) -> Targets:
    """The sequence asked for, or pets09_s2l1, or a rendered scene where there is no data.

    The folder of sequences is the one that MPFJAX_DATA names, or ../shared/data.
    """
    sequence, ids, span = options.sequence, options.ids, options.frames
    if sequence is None:
        data = Path(os.environ.get("MPFJAX_DATA", "../shared/data")) / "pets09_s2l1"
        if not data.is_dir():
            return _rendered(options)
        sequence = data
        ids = DEFAULT_IDS if ids is None else ids
        span = DEFAULT_FRAMES if span is None else span
    first, last = frames.parse_range(span, "--frames")
    rows = read_truth(sequence / "gt.txt").objects
    if ids is None:
        ids = sorted(box_files.boxes_of_frame(rows, first))[:2]
    stills = np.stack(list(frames.read_frames(sequence, first, last)))
    return _with_truth(str(sequence.name), stills, first, rows, ids)


def _rendered(options: argparse.Namespace) -> Targets:
    """Two players of one team, who change places before a camera that stands still."""
    first, last = frames.parse_range(options.frames, "--frames")
    key = jax.random.key(options.seed)
    scene = football_scene(key, last or 80, num_players=2, still_camera=True)
    ids = [1, 2] if options.ids is None else options.ids
    return _with_truth("rendered scene", scene.frames[first - 1 :], first, scene.tracks, ids)


def _with_truth(
    name: str, stills: np.ndarray, first: int, rows: np.ndarray, ids: list[int]
) -> Targets:
    truth = np.zeros((len(stills), 2, 4))
    for target, id in enumerate(ids):
        own = {int(row[0]): row[2:] for row in rows[rows[:, 1] == id]}
        for t in range(len(stills)):
            if first + t not in own:
                raise ValueError(f"--ids: object {id} has no box in frame {first + t}")
            truth[t, target] = box_files.centred(own[first + t][None])[0]
    return Targets(name, stills, first, truth)
