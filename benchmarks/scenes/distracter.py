"""The synthetic sequence of Smith and Gatica-Perez (2004), 3.2: seven objects and a distracter."""

from typing import Annotated, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.checks import NotNegative, checked, whole

_HEIGHT, _WIDTH = 288, 360
_FIRST_DEVIATION, _STEP_DEVIATION, _MOMENTUM = 4.0, 3.0, 0.5  # of object 1, of the others, of all
_STARTS = np.array(
    [[180, 144], [60, 58], [180, 52], [300, 58], [60, 230], [180, 236], [300, 230]], float
)
_MARGIN = 8.0  # the least gap between objects and to the border
_APPEARS, _VANISHES = 3, 9  # the frame in which the distracter appears, and the first without it
# The gap between object 1 and the distracter in its last frame, and the least at the end.
_CLEAR, _CLEAR_AT_THE_END = (4.0, 12.0), 12.0
_TRIES, _AT_A_TIME = 20_000, 500
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
        """The frame and box from which the template of object 1 is learned: the distracter's."""
        return self.frames[_APPEARS - 1], self.distracter[_APPEARS - 1]


class NoPath(ValueError):
    """No path was found with these arguments and this key; with another key there may be one."""


@checked
def distracter_scene(
    key: Key[Array, ""],
    num_frames: Annotated[int, whole(9)] = 25,
    *,
    size: tuple[int, int] = (24, 24),
    speed: NotNegative = 0.0,
) -> DistracterScene:
    """Render seven objects on noise, and a distracter that lures the tracker of the first away.

    Smith and Gatica-Perez (2004), section 3.2 and figures 2 and 3. The paper says: 25 frames of 360
    x 288 pixels; a background of noise; objects that move by x_t = x_{t-1} + 0.5 (x_{t-1} -
    x_{t-2}) + 3 ω_t in both directions and do not change in size; a distracter similar to object 1,
    from which object 1's histogram is learned (`template`), which appears over object 1 in frame 3,
    leads the tracker astray, and is gone in frame 9; and that object 1 is the quicker one. The rest
    is our choice, made so that tables 1 and 2 are reproduced: colours, places and sizes; that the
    distracter stands still while object 1 walks away, by 4 ω_t in place of 3 ω_t; and that object 1
    is clear of it by 4 to 12 pixels in frame 8 and by 12 in the last frame. Paths are drawn again
    where two would meet or one would leave the frame. The same key gives the same scene.

    - `num_frames`: t, from 9 on.
    - `size`: width and height of every object, in pixels.
    - `speed`: of the distracter, in pixels a frame, in the direction opposite to object 1.

    Raises `NoPath` where 20 000 tries find no path. Use it to see how a filter copes with a
    look-alike that leads it away.
    """
    sides = np.array(size, float)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    others = _draw_others(rng, num_frames, sides)
    first, bait = _draw_first(rng, others, sides, speed)
    centres = np.concatenate([first[:, None], others, bait[:, None]], axis=1)
    corners = np.round(centres - sides / 2)
    boxes = np.concatenate([corners, np.broadcast_to(sides, corners.shape)], axis=-1)
    boxes, distracter = boxes[:, :-1], boxes[:, -1]
    number = np.arange(1, num_frames + 1)
    distracter[(number < _APPEARS) | (number >= _VANISHES)] = np.nan
    patches = [_patch(rng, looks, sides.astype(int)) for looks in _LOOKS]
    frames = []
    for t in range(num_frames):
        grain = rng.integers(0, 256, (_HEIGHT, _WIDTH, 1), dtype=np.uint8)
        frame = np.broadcast_to(grain, (_HEIGHT, _WIDTH, 3)).copy()
        for box, patch in zip([*boxes[t], distracter[t]], patches, strict=True):
            if np.all(np.isfinite(box)):
                x, y, w, h = box.astype(int)
                frame[y : y + h, x : x + w] = patch
        frames.append(frame)
    return DistracterScene(np.stack(frames), boxes, distracter)


def _draw_others(rng: np.random.Generator, num_frames: int, sides: np.ndarray) -> np.ndarray:
    """(t, 6, 2): centres of objects 2 to 7, which keep inside the frame and apart."""
    for _ in range(_TRIES // _AT_A_TIME):
        paths = _walks(rng, _STARTS[1:], _STEP_DEVIATION, num_frames)
        free = _is_free(paths, sides)
        if free.any():
            return paths[np.argmax(free)]
    raise NoPath("num_frames, size: objects met or left the image in every try")


def _draw_first(
    rng: np.random.Generator, others: np.ndarray, sides: np.ndarray, speed: float
) -> tuple[np.ndarray, np.ndarray]:
    """(t, 2) each: the centres of object 1, and of the distracter that it leaves behind."""
    num_frames, last = len(others), _VANISHES - 2
    for _ in range(_TRIES // _AT_A_TIME):
        first = _walks(rng, _STARTS[:1], _FIRST_DEVIATION, num_frames)
        bait = _lure(first, speed)
        gaps = np.max(np.abs(bait - first)[:, :, 0] - sides, axis=-1)
        parted = (gaps[:, last] >= _CLEAR[0]) & (gaps[:, last] <= _CLEAR[1])
        parted &= gaps[:, -1] >= _CLEAR_AT_THE_END
        crowd = np.broadcast_to(others, (len(first), *others.shape))
        walks, lures = (np.concatenate([crowd, path], axis=2) for path in (first, bait))
        fits = parted & _is_free(walks, sides) & _is_free(lures, sides)
        if fits.any():
            chosen = np.argmax(fits)
            return first[chosen, :, 0], bait[chosen, :, 0]
    raise NoPath(
        "speed, num_frames: in no try is object 1 clear of the distracter by"
        f" {_CLEAR[0]:g} to {_CLEAR[1]:g} pixels in frame 8, and all keep inside and apart"
    )


def _walks(
    rng: np.random.Generator, starts: np.ndarray, deviation: float, num_frames: int
) -> np.ndarray:
    """(tries, t, objects, 2): many second-order autoregressions from rest."""
    position = previous = np.broadcast_to(starts, (_AT_A_TIME, *starts.shape))
    path = []
    for _ in range(num_frames):
        noise = deviation * rng.standard_normal(position.shape)
        moved = position + _MOMENTUM * (position - previous) + noise
        position, previous = moved, position
        path.append(position)
    return np.stack(path, axis=1)


def _lure(paths: np.ndarray, speed: float) -> np.ndarray:
    """(tries, t, 1, 2): places of distracters, which start at object 1 and move away from it."""
    appears = paths[:, _APPEARS - 1]
    ahead = paths[:, _VANISHES - 2] - appears
    away = -speed * ahead / np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), 1e-9)
    steps = np.clip(np.arange(1, paths.shape[1] + 1), _APPEARS, _VANISHES - 1) - _APPEARS
    return appears[:, None] + steps[None, :, None, None] * away[:, None]


def _is_free(centres: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """(tries,): whether objects at (tries, t, objects, 2) keep inside the frame and apart."""
    room = sides / 2 + _MARGIN
    inside = (centres > room) & (centres < np.array([_WIDTH, _HEIGHT]) - room)
    first, second = np.triu_indices(centres.shape[2], 1)
    gaps = np.abs(centres[:, :, first] - centres[:, :, second]) - sides - _MARGIN
    return inside.all(axis=(1, 2, 3)) & (gaps.max(axis=-1) > 0).all(axis=(1, 2))


def _patch(rng: np.random.Generator, looks: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """A figure of one object: a third of head, a half of body, the rest feet, all with grain."""
    width, height = sides
    part = np.searchsorted([1 / 3, 5 / 6], (np.arange(height) + 0.5) / height)
    patch = np.broadcast_to(looks[part][:, None], (height, width, 3))
    noise = _GRAIN * rng.standard_normal((height, width, 3))
    return np.clip(patch + noise, 0, 255).astype(np.uint8)
