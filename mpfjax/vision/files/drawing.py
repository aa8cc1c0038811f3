"""Drawing on RGB frames: strokes, boxes, points and numbers, with smooth edges.

Every function draws in place on a float frame with values in [0, 255], and clips at the frame's
border. Coordinates are in pixels; the centre of the first pixel is at (0.5, 0.5).
"""

import functools
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, UInt8

# Okabe and Ito's palette, in the order of use; people with colour blindness can tell it apart. In
# place of black, which numbers on a dark plate cannot have, there is a light green.
PALETTE = np.array(
    [
        [230, 159, 0], [86, 180, 233], [240, 228, 66], [204, 121, 167], [0, 114, 178],
        [213, 94, 0], [0, 158, 115], [255, 255, 255], [153, 153, 153], [170, 255, 195],
    ],
    dtype=float,
)  # fmt: skip

# Five rows of three bits for each digit, a row in an octal figure.
_DIGITS = ("75557", "26227", "71747", "71717", "55711", "74717", "74757", "71122", "75757", "75717")

# The share of the brightness that remains under the plate of a number.
_DARKENED = (np.arange(256) - 0.6 * np.arange(256)).astype(np.uint8)


def draw_stroke(
    frame: Float[np.ndarray, "h w 3"],
    start: tuple[float, float],
    end: tuple[float, float],
    radius: float,
    colour: Float[np.ndarray, "3"],
    opacity: float = 1.0,
) -> None:
    """Draw a line of half-width `radius` with round ends; a dot where the ends coincide."""
    (x0, y0), (x1, y1) = start, end
    reach = radius + 1
    found = window(frame, min(x0, x1) - reach, min(y0, y1) - reach,
                     max(x0, x1) + reach, max(y0, y1) + reach)  # fmt: skip
    if found is None:
        return
    part, x, y = found
    dx, dy = x1 - x0, y1 - y0
    along = ((x - x0) * dx + (y - y0) * dy) / max(dx * dx + dy * dy, 1e-9)
    along = np.clip(along, 0, 1)
    distance = np.hypot(x - x0 - along * dx, y - y0 - along * dy)
    blend(part, np.clip(radius + 0.5 - distance, 0, 1) * opacity, colour)


def draw_box(
    frame: Float[np.ndarray, "h w 3"],
    box: Float[np.ndarray, "4"],
    colour: Float[np.ndarray, "3"],
    thickness: float = 1.5,
) -> None:
    """Outline a box (x, y, w, h), (x, y) its top-left corner."""
    x, y, w, h = (float(value) for value in box)
    corners = [(x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y)]
    for start, end in pairwise(corners):
        draw_stroke(frame, start, end, thickness / 2, colour)


def draw_points(
    frame: Float[np.ndarray, "h w 3"],
    points: Float[np.ndarray, "n 2"],
    colours: Float[np.ndarray, "n 3"],
    radius: float = 1.5,
) -> None:
    """Draw a dot at each (x, y), with a dark rim so that it is visible on any background."""
    for (x, y), colour in zip(points.tolist(), colours, strict=True):
        draw_stroke(frame, (x, y), (x, y), radius + 0.7, np.zeros(3), opacity=0.5)
        draw_stroke(frame, (x, y), (x, y), radius, colour)


@functools.lru_cache(maxsize=4096)
def _plate(number: int, size: int) -> Bool[np.ndarray, "height width"]:
    """The plate of a number, and where its digits are; cached, since ids come in every frame."""
    rows = [" ".join(f"{int(_DIGITS[int(d)][i]):03b}" for d in str(number)) for i in range(5)]
    dots = np.array([[character == "1" for character in row] for row in rows])
    plate = np.pad(np.kron(dots, np.ones((size, size), bool)), 2)
    plate.setflags(write=False)
    return plate


def with_tracks(
    frame: UInt8[np.ndarray, "h w 3"], rows: Float[np.ndarray, "k 6"]
) -> UInt8[np.ndarray, "h w 3"]:
    """A copy of a frame with the boxes of rows (frame, id, x, y, w, h), and their ids above.

    An id keeps its colour. Lines are whole pixels wide, which is a hundred times quicker than
    smooth ones on a large frame.
    """
    canvas = frame.copy()
    palette = PALETTE.astype(np.uint8)
    thickness = max(1, round(frame.shape[0] / 360))
    size = 1 + thickness
    for _, id, x, y, w, h in rows.tolist():
        colour = palette[int(id) % len(palette)]
        left, top, right, bottom = (round(edge) for edge in (x, y, x + w, y + h))
        for x0, y0, x1, y1 in (
            (left, top, right, top + thickness), (left, bottom - thickness, right, bottom),
            (left, top, left + thickness, bottom), (right - thickness, top, right, bottom),
        ):  # fmt: skip
            canvas[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = colour
        plate = _plate(int(id), size)
        above, start = max(top - 5 * size - 4, 0), max(left, 0)
        label = canvas[above : above + plate.shape[0], start : start + plate.shape[1]]
        label[:] = _DARKENED[label]
        label[plate[: label.shape[0], : label.shape[1]]] = colour
    return canvas


def window(
    frame: np.ndarray, left: float, top: float, right: float, bottom: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The part of the frame between these edges, and the centres of its pixels."""
    height, width, _ = frame.shape
    if not np.all(np.isfinite([left, top, right, bottom])):
        return None
    x0, x1 = int(max(np.floor(left), 0)), int(min(np.ceil(right), width))
    y0, y1 = int(max(np.floor(top), 0)), int(min(np.ceil(bottom), height))
    if x0 >= x1 or y0 >= y1:
        return None
    return frame[y0:y1, x0:x1], np.arange(x0, x1)[None] + 0.5, np.arange(y0, y1)[:, None] + 0.5


def blend(part: np.ndarray, opacity: np.ndarray, colour: np.ndarray) -> None:
    """Colour pixels, each by its opacity."""
    part += opacity[:, :, None] * (np.asarray(colour, float) - part)
