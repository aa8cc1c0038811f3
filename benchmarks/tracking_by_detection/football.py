"""Rendered football with simulated detections: a video that no tracker here was made for.

Players of two teams that look alike, at 12 frames a second, before a camera that pans. A detector
is simulated that errs as real ones do: it misses players, above all those behind others, its boxes
are off by some hundredths of their sides, and it finds some that are none, less surely.
"""

from typing import NamedTuple

import jax
import numpy as np

from benchmarks.scenes import cover
from benchmarks.scenes.football import Scene, football_scene

FRAMES_PER_SECOND = 12.0
NUM_FRAMES = 120
MISSES = 0.1  # of players that nobody hides
HIDDEN = 0.6  # who is covered by more than this share is not found
FALSE_ONES = 0.35  # in a frame, on average
ERROR = 0.04  # of a box, in its widths and heights


class Match(NamedTuple):
    """How many play, and how large the picture is."""

    name: str
    players_of_a_team: int
    height: int
    width: int


MATCHES = (Match("football", 4, 288, 512), Match("football_20", 10, 1080, 1920))


def play(match: Match, seed: int, num_frames: int = NUM_FRAMES) -> Scene:
    """The rendered video, with the true boxes of those whose centre is in the picture."""
    _, players, height, width = match
    scene = football_scene(
        jax.random.key(seed), num_frames, num_players=players, num_opponents=players,
        height=height, width=width,
    )  # fmt: skip
    centres = scene.tracks[:, 2:4] + scene.tracks[:, 4:] / 2
    inside = ((centres >= 0) & (centres < [width, height])).all(axis=1)
    return scene._replace(tracks=scene.tracks[inside])


def detect(match: Match, truth: np.ndarray, seed: int) -> np.ndarray:
    """Rows (frame, -1, x, y, w, h, score) of the simulated detector."""
    rng = np.random.default_rng(seed)
    rows = []
    for frame in np.unique(truth[:, 0]):
        boxes = truth[truth[:, 0] == frame, 2:]
        hidden = cover(boxes, np.broadcast_to(boxes, (len(boxes), *boxes.shape))).max(axis=1)
        found = boxes[(rng.random(len(boxes)) >= MISSES) & (hidden <= HIDDEN)]
        found = found + rng.normal(0, ERROR, found.shape) * np.tile(found[:, 2:], 2)
        number = rng.poisson(FALSE_ONES)
        size = boxes[rng.integers(len(boxes), size=number), 2:]
        corners = rng.uniform(0, 1, (number, 2)) * ([match.width, match.height] - size)
        both = np.concatenate([found, np.column_stack([corners, size])])
        scores = np.concatenate([rng.beta(8, 2, len(found)), rng.beta(4, 4, number)])
        rows.append(np.column_stack([np.full(len(both), frame), -np.ones(len(both)), both, scores]))
    return np.concatenate(rows)
