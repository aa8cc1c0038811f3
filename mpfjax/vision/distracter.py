"""The synthetic sequence of Smith and Gatica-Perez (2004), section 3.2: seven objects, one bait."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.checks import check_key, check_whole

_HEIGHT, _WIDTH = 288, 360
_SIZE = np.array([32.0, 40.0])  # of every object, width and height
_STEP_DEVIATION, _MOMENTUM = 3.0, 0.5
_STARTS = np.array(
    [[180, 144], [60, 58], [180, 52], [300, 58], [60, 230], [180, 236], [300, 230]], float
)
_MARGIN = 8.0  # what objects keep free between each other and to the border
# The distracter is over object 1 in its first frame, leads away at this speed, and is gone.
_APPEARS, _VANISHES, _SPEED = 3, 9, 6.0
# Head, body and feet of each object; those of the distracter come last.
_LOOKS = np.array(
    [
        [[214, 158, 46], [176, 42, 52], [52, 66, 150]],
        [[40, 130, 60], [222, 208, 70], [40, 130, 60]],
        [[236, 236, 232], [46, 84, 196], [30, 30, 36]],
        [[124, 52, 150], [124, 52, 150], [232, 150, 190]],
        [[40, 160, 170], [236, 236, 232], [196, 90, 30]],
        [[30, 30, 36], [96, 196, 74], [30, 60, 120]],
        [[232, 120, 40], [30, 30, 36], [232, 120, 40]],
        [[214, 158, 46], [206, 92, 40], [150, 40, 96]],
    ],
    float,
)
_GRAIN = 14.0


class DistracterScene(NamedTuple):
    """A rendered video and the truth about it; boxes are (x, y, w, h), top-left corner first.

    - `frames`: RGB, shape (t, h, w, 3).
    - `boxes`: of the seven objects, whether or not they are covered, (t, 7, 4) in pixels.
    - `distracter`: its box, (t, 4), NaN in the frames without it.
    """

    frames: UInt8[np.ndarray, "t h w 3"]
    boxes: Float[np.ndarray, "t 7 4"]
    distracter: Float[np.ndarray, "t 4"]

    @property
    def template(self) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "4"]]:
        """The frame and box from which the looks of object 1 are learned: the distracter's."""
        return self.frames[_APPEARS - 1], self.distracter[_APPEARS - 1]


def distracter_scene(key: Key[Array, ""], num_frames: int = 25) -> DistracterScene:
    """Render seven objects on noise, and a distracter that lures the tracker of the first away.

    Smith and Gatica-Perez (2004), section 3.2 and figures 2 and 3: 360 x 288 pixels; objects
    move by x_t = x_{t-1} + 0.5 (x_{t-1} - x_{t-2}) + 3 ω_t in both directions, drawn again where
    two would meet or one would leave the frame, and do not change in size. The distracter has
    object 1's head and a body of warmer colours. It lies over object 1 in frame 3, moves from
    there at 6 pixels a frame against the way that object 1 takes, and is last seen in frame 8,
    where paths are drawn again unless it is clear of object 1; object 1's histogram is learned
    from it (`template`). The paper prints none of the looks, places and speeds. Ours were chosen
    by how the frames look, the speed so that the exact posterior of object 1 goes along with the
    distracter. The same key gives the same scene.

    Raises `ValueError` for fewer frames than the three up to the distracter.
    """
    check_key(key)
    check_whole(_APPEARS, num_frames=num_frames)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    corners = np.round(_paths(rng, num_frames) - _SIZE / 2)
    corners, bait = corners[:, :-1], corners[:, -1]
    boxes = np.concatenate([corners, np.broadcast_to(_SIZE, corners.shape)], axis=-1)
    distracter = np.concatenate([bait, np.broadcast_to(_SIZE, bait.shape)], axis=-1)
    number = np.arange(1, num_frames + 1)
    distracter[(number < _APPEARS) | (number >= _VANISHES)] = np.nan
    patches = [_patch(rng, looks) for looks in _LOOKS]
    frames = []
    for t in range(num_frames):
        frame = rng.integers(0, 256, (_HEIGHT, _WIDTH, 3), dtype=np.uint8)
        for box, patch in zip([*boxes[t], distracter[t]], patches, strict=True):
            if np.all(np.isfinite(box)):
                x, y, w, h = box.astype(int)
                frame[y : y + h, x : x + w] = patch
        frames.append(frame)
    return DistracterScene(np.stack(frames), boxes, distracter)


def _paths(rng: np.random.Generator, num_frames: int) -> np.ndarray:
    """(t, objects and distracter, 2): centres that keep inside the frame and apart."""
    while True:
        paths = [_STARTS, _STARTS]
        for _ in range(num_frames):
            noise = _STEP_DEVIATION * rng.standard_normal(_STARTS.shape)
            paths.append(paths[-1] + _MOMENTUM * (paths[-1] - paths[-2]) + noise)
        centres = np.stack(paths[2:])
        bait = _lure(centres[:, 0])
        others = np.concatenate([centres[:, 1:], bait[:, None]], axis=1)
        seen_last = slice(_VANISHES - 2, _VANISHES - 1)
        parted = np.all(np.max(np.abs(bait - centres[:, 0])[seen_last] - _SIZE, axis=1) > 0)
        if _is_free(centres) and _is_free(others) and parted:
            return np.concatenate([centres, bait[:, None]], axis=1)


def _lure(path: np.ndarray) -> np.ndarray:
    """Where the distracter is: from an object's place straight away from where it goes."""
    last = min(_VANISHES - 2, len(path) - 1)
    ahead = path[last] - path[_APPEARS - 1]
    away = -_SPEED * ahead / max(np.linalg.norm(ahead), 1e-9)
    steps = np.clip(np.arange(1, len(path) + 1), _APPEARS, _VANISHES - 1) - _APPEARS
    return path[_APPEARS - 1] + steps[:, None] * away


def _is_free(centres: np.ndarray) -> bool:
    room = _SIZE / 2 + _MARGIN
    inside = (centres > room) & (centres < np.array([_WIDTH, _HEIGHT]) - room)
    gaps = np.abs(centres[:, :, None] - centres[:, None]) - _SIZE - _MARGIN
    first, second = np.triu_indices(centres.shape[1], 1)
    apart = np.max(gaps, axis=-1)[:, first, second] > 0
    return bool(inside.all() and apart.all())


def _patch(rng: np.random.Generator, looks: np.ndarray) -> np.ndarray:
    """A figure of one object: a third of head, a half of body, the rest feet, all with grain."""
    width, height = _SIZE.astype(int)
    part = np.searchsorted([1 / 3, 5 / 6], (np.arange(height) + 0.5) / height)
    patch = np.broadcast_to(looks[part][:, None], (height, width, 3))
    noise = _GRAIN * rng.standard_normal((height, width, 3))
    return np.clip(patch + noise, 0, 255).astype(np.uint8)
