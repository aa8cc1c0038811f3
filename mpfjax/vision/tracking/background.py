"""Detection of moving objects by background subtraction, so that no box has to be drawn."""

from collections import deque

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mpfjax.checks import Count, Positive, checked
from mpfjax.vision.files.frames import check_frame
from mpfjax.vision.tracking.optical_flow import opencv, reduce

# What OpenCV's mask holds where a pixel is foreground; a shadow has another value.
_FOREGROUND = 255
# The share of a pixel's history that is background, and the darkest shadow beside it.
_BACKGROUND_SHARE, _SHADOW_BRIGHTNESS = 0.6, 0.6
# The height of gaps that are closed, as a share of the median height of the blobs so far.
_LARGEST_GAP = 0.1
# A frame with more is reduced before detection, by a whole number along both sides.
_MOST_PIXELS = 640 * 480
# How many blobs the median shape is taken over, and the fewest that it is taken over.
_REMEMBERED, _ENOUGH = 500, 20
# A part that is cut from a blob has at least this share of an object's usual width.
_NARROWEST = 2.4
# How high the outline may reach between two heads, as a share of the lower one's height.
_CUT_DEPTH = 0.9
# The height of an object before any was seen, as a share of the frame's.
_UNKNOWN_HEIGHT = 0.125


class BackgroundSubtraction:
    """Boxes of moving objects for a static camera: an adaptive Gaussian mixture per pixel.

    Lin et al. (2012), section 5, detect their targets in this way; the mixture is OpenCV's MOG2
    (Zivkovic 2004). Pixels that fit none of the background's Gaussians and are not shadow form
    blobs. Gaps in the height of a blob are closed. A blob too wide for one object is cut where its
    outline dips, as between two heads. Blobs outside the limits of size and shape are dropped. The
    usual shape is estimated from the video unless it is specified, under the assumption that most
    blobs are single objects. Two objects one behind the other remain one blob, and an object that
    stands still long enough becomes background.

    - `history`: frames over which the background is forgotten. An object that stands still becomes
      background after about half as many, or earlier in a young video; ghosts, left where an object
      stood from the first frame on, vanish by the same rule.
    - `threshold`: how many standard deviations from a Gaussian a pixel still belongs to it.
    - `area`: minimum and maximum area of a box, as fractions of the frame's.

    Defaults are tuned on people in front of a street camera. An instance serves one video, because
    it stores that video's background. Colour channels may come in any fixed order. Use it to start
    tracks. It is useless with a moving camera, for which every pixel is foreground.

    Raises `ValueError` for a setting outside its range, `ImportError` if OpenCV is missing.
    """

    @checked
    def __init__(
        self,
        *,
        history: Count = 500,
        threshold: Positive = 8.0,
        area: tuple[float, float] = (0.0015, 0.3),
    ) -> None:
        if not 0 <= area[0] < area[1] <= 1:
            raise ValueError(f"area: {area} is not a range within [0, 1]")
        self._cv2 = opencv()
        self.history, self.area = history, area
        self._background = self._cv2.createBackgroundSubtractorMOG2(history, threshold**2, True)
        self._background.setBackgroundRatio(_BACKGROUND_SHARE)
        self._background.setShadowThreshold(_SHADOW_BRIGHTNESS)
        self._frames_seen, self._shape = 0, None
        self._aspects: deque[float] = deque(maxlen=_REMEMBERED)
        self._heights: deque[int] = deque(maxlen=_REMEMBERED)

    def detect(self, frame: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "k 4"]:
        """The boxes (x, y, w, h) in pixels of moving objects, with (x, y) the top-left corner.

        Boxes are inside the frame, ordered from left to right. The first frame has none. A frame
        updates the background; the fewer came before, the larger is its weight. Raises `ValueError`
        for a frame that is not (h, w, 3) of type uint8, or whose size differs from that of the
        previous frames.
        """
        # OpenCV's own schedule: a young background learns fast, so that an object that was
        # there in the first frame leaves no ghost.
        rate = 1 / min(2 * (self._frames_seen + 1), self.history)
        foreground = self._subtract(frame, rate)
        self._frames_seen += 1
        if self._frames_seen == 1:
            return np.zeros((0, 4))
        boxes = np.array(self._blobs(foreground), float).reshape(-1, 4)
        shares = boxes[:, 2] * boxes[:, 3] / foreground.size
        boxes = boxes[(shares >= self.area[0]) & (shares <= self.area[1])]
        boxes = boxes[np.lexsort((boxes[:, 1], boxes[:, 0]))]
        scale = np.divide(np.shape(frame)[1::-1], foreground.shape[::-1])
        return boxes * np.tile(scale, 2)

    def _subtract(self, frame: np.ndarray, rate: float) -> np.ndarray:
        """1 where a pixel is foreground; the frame joins the background with weight `rate`."""
        frame = np.asarray(frame)
        check_frame(frame)
        # OpenCV would silently start a new background.
        if self._shape is not None and frame.shape != self._shape:
            raise ValueError(f"frame: {frame.shape} is not the shape before it, {self._shape}")
        self._shape = frame.shape
        factor = int(np.ceil(np.sqrt(frame[..., 0].size / _MOST_PIXELS)))
        small = reduce(np.ascontiguousarray(frame), factor)
        mask = self._background.apply(small, learningRate=rate)
        return (mask == _FOREGROUND).astype(np.uint8)

    def _blobs(self, foreground: np.ndarray) -> list[tuple[int, int, int, int]]:
        has_heights = len(self._heights) >= _ENOUGH
        usual = np.median(self._heights) if has_heights else _UNKNOWN_HEIGHT * len(foreground)
        gap = round(_LARGEST_GAP * float(usual))
        if gap > 0:
            # Vertically only: people who walk side by side must not be joined.
            line = np.ones((gap + 1, 1), np.uint8)
            foreground = self._cv2.morphologyEx(foreground, self._cv2.MORPH_CLOSE, line)
        _, labels, stats, _ = self._cv2.connectedComponentsWithStats(foreground, connectivity=8)
        boxes = []
        # No part of a blob can be larger than the blob.
        least = self.area[0] * foreground.size
        large = [(n, *place[:4]) for n, place in enumerate(stats.tolist()) if n]
        large = [blob for blob in large if blob[3] * blob[4] >= least]
        # An object that is partly outside the frame does not show its shape.
        bottom, right = foreground.shape
        for _, x, y, w, h in large:
            if x > 0 and y > 0 and x + w < right and y + h < bottom:
                self._aspects.append(h / w)
                self._heights.append(h)
        # A blob lower than this many widths may be several objects; 0 where this is unknown.
        has_aspects = len(self._aspects) >= _ENOUGH
        widest = float(np.median(self._aspects)) if has_aspects else 0.0
        for label, x, y, w, h in large:
            blob = labels[y : y + h, x : x + w] == label
            boxes += self._cut(blob, x, y, widest)
        return boxes

    def _cut(
        self, blob: Bool[np.ndarray, "h w"], x: int, y: int, widest: float
    ) -> list[tuple[int, int, int, int]]:
        """The boxes of the objects side by side in a blob, whose array begins at (x, y)."""
        rows, columns = (np.flatnonzero(blob.any(axis=axis)) for axis in (1, 0))
        if len(rows) == 0:
            return []
        x, y = x + int(columns[0]), y + int(rows[0])
        blob = blob[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        height, width = blob.shape
        most = _NARROWEST * widest
        narrowest = max(int(np.ceil(height / most)), 1) if most > 0 else width
        if height >= widest * width or width <= 2 * narrowest:
            return [(x, y, width, height)]
        # How high the blob reaches in each column. It dips between two heads, but not between
        # the legs of one person.
        outline = np.where(blob.any(axis=0), height - blob.argmax(axis=0), 0)
        outline = np.convolve(np.pad(outline, 1, mode="edge"), np.full(3, 1 / 3), "valid")
        left = np.maximum.accumulate(outline)
        right = np.maximum.accumulate(outline[::-1])[::-1]
        depths = outline / np.maximum(np.minimum(left, right), 1)
        cut = narrowest + int(np.argmin(depths[narrowest : width - narrowest]))
        if depths[cut] > _CUT_DEPTH:
            return [(x, y, width, height)]
        parts = (blob[:, :cut], x), (blob[:, cut:], x + cut)
        return [box for part, left in parts for box in self._cut(part, left, y, widest)]
