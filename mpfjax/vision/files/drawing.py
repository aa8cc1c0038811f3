"""Drawing on RGB frames by Pillow: boxes with their numbers.

Coordinates are in pixels; the centre of the first pixel is at (0.5, 0.5). Drawings cover whole
pixels, which is a hundred times faster than smooth edges on a large frame.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

# Okabe and Ito's palette, in the order of use; people with colour blindness can tell it apart. In
# place of black, which numbers on a dark plate cannot have, there is a light green.
PALETTE = (
    (230, 159, 0), (86, 180, 233), (240, 228, 66), (204, 121, 167), (0, 114, 178),
    (213, 94, 0), (0, 158, 115), (255, 255, 255), (153, 153, 153), (170, 255, 195),
)  # fmt: skip


def canvas_of(frame: UInt8[np.ndarray, "h w 3"]) -> tuple[Any, Any]:
    """A copy of a frame as an image of Pillow, and what draws on it."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(frame)
    return image, ImageDraw.Draw(image)


def draw_box(draw: Any, box: Float[np.ndarray, "4"], number: int, thickness: int = 2) -> None:
    """Outline a box (x, y, w, h), (x, y) its top-left corner, in the colour of a number."""
    x, y, w, h = box.tolist()
    corners = (round(x), round(y), round(x + w), round(y + h))
    draw.rectangle(corners, outline=PALETTE[number % len(PALETTE)], width=thickness)


def with_tracks(
    frame: UInt8[np.ndarray, "h w 3"], rows: Float[np.ndarray, "k columns"]
) -> UInt8[np.ndarray, "h w 3"]:
    """A copy of a frame with the boxes of rows (frame, id, x, y, w, h, ...), their ids above.

    An id keeps its colour.
    """
    from PIL import ImageFont

    image, draw = canvas_of(frame)
    thickness = max(1, round(frame.shape[0] / 360))
    size = 8 + 4 * thickness
    font = ImageFont.load_default(size)
    for row in rows:
        number, box = int(row[1]), row[2:6]
        draw_box(draw, box, number, thickness)
        place = (max(box[0], 0), max(box[1], size + 4))
        draw.rectangle(draw.textbbox(place, str(number), font, anchor="lb"), fill=(40, 40, 40))
        draw.text(place, str(number), PALETTE[number % len(PALETTE)], font, anchor="lb")
    return np.asarray(image)
