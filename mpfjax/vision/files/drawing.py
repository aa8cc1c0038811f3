"""Drawing on RGB frames: boxes, points and numbers, in place, clipped at the frame's border.

Coordinates are in pixels; the centre of the first pixel is at (0.5, 0.5). What is drawn covers
whole pixels, which is a hundred times quicker than smooth edges on a large frame.
"""

import functools

import numpy as np
from jaxtyping import Bool, Float, Num, UInt8

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


def draw_box(
    frame: Num[np.ndarray, "h w 3"],
    box: Float[np.ndarray, "4"],
    colour: Num[np.ndarray, "3"],
    thickness: int = 2,
) -> None:
    """Outline a box (x, y, w, h), (x, y) its top-left corner."""
    x, y, w, h = (float(value) for value in box)
    left, top, right, bottom = (round(edge) for edge in (x, y, x + w, y + h))
    for x0, y0, x1, y1 in (
        (left, top, right, top + thickness), (left, bottom - thickness, right, bottom),
        (left, top, left + thickness, bottom), (right - thickness, top, right, bottom),
    ):  # fmt: skip
        frame[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = colour


def draw_points(
    frame: Num[np.ndarray, "h w 3"],
    points: Float[np.ndarray, "n 2"],
    colours: Num[np.ndarray, "n 3"],
    radius: float = 1.5,
) -> None:
    """Draw a dot at each (x, y), with a dark rim so that it is visible on any background."""
    for (x, y), colour in zip(points.tolist(), colours, strict=True):
        for reach, ink in ((radius + 1, 0), (radius, colour)):
            edges = (max(round(edge), 0) for edge in (x - reach, x + reach, y - reach, y + reach))
            left, right, top, bottom = edges
            frame[top:bottom, left:right] = ink


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

    An id keeps its colour.
    """
    canvas = frame.copy()
    palette = PALETTE.astype(np.uint8)
    thickness = max(1, round(frame.shape[0] / 360))
    size = 1 + thickness
    for _, id, x, y, w, h in rows.tolist():
        colour = palette[int(id) % len(palette)]
        draw_box(canvas, np.array([x, y, w, h]), colour, thickness)
        plate = _plate(int(id), size)
        above, start = max(round(y) - 5 * size - 4, 0), max(round(x), 0)
        label = canvas[above : above + plate.shape[0], start : start + plate.shape[1]]
        label[:] = _DARKENED[label]
        label[plate[: label.shape[0], : label.shape[1]]] = colour
    return canvas
