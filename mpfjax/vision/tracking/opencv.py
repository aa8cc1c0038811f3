"""What OpenCV computes from pixels: boxes of what moves, and the motion of the camera."""

import importlib.util
from collections import deque
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mpfjax.arrays import to_rows
from mpfjax.checks import optional
from mpfjax.vision.files.frames import check_frame, of_one_kind
from mpfjax.vision.tracking.gaussian import CameraMotion

Box = tuple[int, int, int, int]


def reduce(frame: np.ndarray, factor: int) -> np.ndarray:
    """The means over squares of pixels, so many along each side."""
    cv2 = opencv()
    size = max(frame.shape[1] // factor, 1), max(frame.shape[0] // factor, 1)
    return cv2.resize(frame, size, interpolation=cv2.INTER_AREA)


def has_opencv() -> bool:
    """Whether OpenCV is installed."""
    return importlib.util.find_spec("cv2") is not None


def opencv() -> Any:
    """OpenCV, or an `ImportError` that says how to install it."""
    return optional("cv2", "opencv-python-headless")


# --- background subtraction ----------------------------------------------------------------------

# What OpenCV's mask holds where a pixel is foreground; a shadow has another value.
_FOREGROUND = 255
# The share of a pixel's history that is background, and the darkest shadow beside it.
_BACKGROUND_SHARE, _SHADOW_BRIGHTNESS = 0.6, 0.6
_HISTORY = 500  # frames
_THRESHOLD = 8.0  # standard deviations from a Gaussian within which a pixel belongs to it
_LEAST_AREA, _MOST_AREA = 0.0015, 0.3  # of a box, as shares of the frame's
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

    The background is forgotten over 500 frames. An object that stands still becomes background
    after about half as many, or earlier in a young video; ghosts, left where an object stood from
    the first frame on, vanish by the same rule. Boxes have at least .0015 and at most .3 of the
    frame's area. The constants suit people in front of a street camera. An instance serves one
    video, because
    it stores that video's background. Colour channels may come in any fixed order. Use it to start
    tracks. It is useless with a moving camera, for which every pixel is foreground.

    Raises `ImportError` if OpenCV is missing.
    """

    def __init__(self) -> None:
        self._cv2 = opencv()
        self._background = self._cv2.createBackgroundSubtractorMOG2(_HISTORY, _THRESHOLD**2, True)
        self._background.setBackgroundRatio(_BACKGROUND_SHARE)
        self._background.setShadowThreshold(_SHADOW_BRIGHTNESS)
        self._frames_seen, self._shape = 0, None
        self._sizes: deque[tuple[int, int]] = deque(maxlen=_REMEMBERED)  # heights and widths

    def detect(self, frame: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "k 4"]:
        """The boxes (x, y, w, h) in pixels of moving objects, with (x, y) the top-left corner.

        Boxes are inside the frame, ordered from left to right. The first frame has none. A frame
        updates the background; the fewer came before, the larger is its weight. Raises `ValueError`
        for a frame that is not (h, w, 3) of type uint8, or whose size differs from that of the
        previous frames.
        """
        # OpenCV's own schedule: a young background learns fast, so that an object that was
        # there in the first frame leaves no ghost.
        rate = 1 / min(2 * (self._frames_seen + 1), _HISTORY)
        foreground = self._subtract(frame, rate)
        self._frames_seen += 1
        if self._frames_seen == 1:
            return np.zeros((0, 4))
        boxes = np.array(self._blobs(foreground), float).reshape(-1, 4)
        shares = boxes[:, 2] * boxes[:, 3] / foreground.size
        boxes = boxes[(shares >= _LEAST_AREA) & (shares <= _MOST_AREA)]
        boxes = boxes[np.lexsort((boxes[:, 1], boxes[:, 0]))]
        return boxes * np.tile(np.divide(np.shape(frame)[1::-1], foreground.shape[::-1]), 2)

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
        return (self._background.apply(small, learningRate=rate) == _FOREGROUND).astype(np.uint8)

    def _blobs(self, foreground: np.ndarray) -> list[Box]:
        usual = _UNKNOWN_HEIGHT * len(foreground)
        if len(self._sizes) >= _ENOUGH:
            usual = float(np.median([height for height, _ in self._sizes]))
        gap = round(_LARGEST_GAP * usual)
        if gap > 0:
            # Vertically only: people who walk side by side must not be joined.
            line = np.ones((gap + 1, 1), np.uint8)
            foreground = self._cv2.morphologyEx(foreground, self._cv2.MORPH_CLOSE, line)
        _, labels, stats, _ = self._cv2.connectedComponentsWithStats(foreground, connectivity=8)
        # No part of a blob can be larger than the blob.
        large = [(n, *place[:4]) for n, place in enumerate(stats.tolist()) if n]
        large = [blob for blob in large if blob[3] * blob[4] >= _LEAST_AREA * foreground.size]
        # An object that is partly outside the frame does not show its shape.
        bottom, right = foreground.shape
        for _, x, y, w, h in large:
            if x > 0 and y > 0 and x + w < right and y + h < bottom:
                self._sizes.append((h, w))
        # A blob lower than this many widths may be several objects; 0 where this is unknown.
        widest, boxes = 0.0, []
        if len(self._sizes) >= _ENOUGH:
            widest = float(np.median([height / width for height, width in self._sizes]))
        for label, x, y, w, h in large:
            blob = labels[y : y + h, x : x + w] == label
            boxes += self._cut(blob, x, y, widest)
        return boxes

    def _cut(self, blob: Bool[np.ndarray, "h w"], x: int, y: int, widest: float) -> list[Box]:
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


# --- optical flow ---------------------------------------------------------------------------------

_WIDTH = 320  # of the reduced picture, about
_CORNERS = 200  # the most that are followed
_WEAKEST = 0.01  # of the strongest corner's strength
_APART = 1 / 50  # of the width, between corners
_WINDOW = (11, 11)
_ROUNDS, _STILL = 10, 0.03  # the most improvements on each level, and the step that ends them
_LEVELS = 4  # of the pyramid: a motion of 80 reduced pixels is followed
_OFF = 1.0  # reduced pixels within which a corner agrees with the motion
_FEWEST = 12  # corners that have to agree
_SMALLEST = 32  # the least side of a reduced picture


class OpticalFlow:
    """The motion of the camera between successive frames, from the pixels outside boxes.

    Each frame is reduced to a grey image about 320 pixels wide. Corners (Shi and Tomasi 1994) of
    the previous frame, outside its boxes, are followed by the pyramidal method of Lucas and Kanade
    (Bouguet 2001). The similarity with which most of them agree, within a pixel of the reduced
    image, is estimated by RANSAC and refined by least squares over these.

    The motion is unknown, and None, in the first frame, if fewer than 12 corners agree, and if they
    are not a majority of those that were followed: after a cut, or without texture. An instance
    serves one video. The same frames yield the same motions. Raises `ImportError` without OpenCV.
    Use it for the argument `motion` of `ObjectTracker.step`; `track` does so automatically.
    """

    def __init__(self) -> None:
        self._cv2 = opencv()
        self._before: np.ndarray | None = None
        self._boxes = np.zeros((0, 4))

    def __call__(self, frame: Any, boxes: Any = None) -> CameraMotion | None:
        """The motion since the frame before, in pixels of the frame.

        `frame` is (h, w, 3), (h, w, 1) or (h, w). `boxes`, rows (x, y, w, h) with (x, y) the
        top-left corner, are what may move on its own in this frame. After a frame of another size
        the motion is unknown. Raises `ValueError` for a frame that is no image of eight bits, and
        for boxes that are not rows of four numbers.
        """
        (frame,) = of_one_kind([frame], argument="frame")
        boxes = to_rows(4, "boxes", np.zeros((0, 4)) if boxes is None else boxes)
        factor = max(round(frame.shape[1] / _WIDTH), 1)
        # Grey first: OpenCV reduces one channel in a third of the time of three.
        grey = self._cv2.cvtColor(np.ascontiguousarray(frame), self._cv2.COLOR_RGB2GRAY)
        picture = reduce(grey, factor)
        before, self._before = self._before, picture
        left, self._boxes = self._boxes, boxes / factor
        if before is None or before.shape != picture.shape or min(picture.shape) < _SMALLEST:
            return None
        start, end = self._follow(before, picture, left)
        gaps = end[:, None] - self._boxes[None, :, :2]
        away = ~np.any(np.all((gaps >= 0) & (gaps <= self._boxes[None, :, 2:]), axis=2), axis=1)
        return self._fit(start[away], end[away], factor)

    def _follow(
        self, before: np.ndarray, picture: np.ndarray, boxes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Corners outside of the boxes, and where they are now."""
        cv2 = self._cv2
        free = np.full(before.shape, 255, np.uint8)
        low = np.maximum(np.floor(boxes[:, :2]), 0).astype(int)
        high = np.maximum(np.ceil(boxes[:, :2] + boxes[:, 2:]), 0).astype(int)
        for (left, top), (right, bottom) in zip(low, high, strict=True):
            free[top:bottom, left:right] = 0
        apart = _APART * before.shape[1]
        start = cv2.goodFeaturesToTrack(before, _CORNERS, _WEAKEST, apart, mask=free)
        if start is None or len(start) < _FEWEST:
            return np.zeros((0, 2)), np.zeros((0, 2))
        ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ROUNDS, _STILL)
        end, status, _ = cv2.calcOpticalFlowPyrLK(
            before, picture, start, None, winSize=_WINDOW, maxLevel=_LEVELS, criteria=ends
        )
        is_tracked = status[:, 0] == 1
        return start[is_tracked, 0], end[is_tracked, 0]

    def _fit(self, start: np.ndarray, end: np.ndarray, factor: int) -> CameraMotion | None:
        """The similarity between the corners, in pixels of the frame, if most agree with one."""
        if len(start) < _FEWEST:
            return None
        # The random numbers of OpenCV's RANSAC start alike in each call.
        matrix, agree = self._cv2.estimateAffinePartial2D(
            start, end, method=self._cv2.RANSAC, ransacReprojThreshold=_OFF
        )
        if matrix is None or agree.sum() < _FEWEST or 2 * agree.sum() <= len(start):
            return None
        # A reduced pixel's centre, (i + 1/2) factor, is not that of the first of its pixels.
        centre = (factor - 1) / 2
        shift = factor * matrix[:, 2] + centre - matrix[:, :2] @ [centre, centre]
        return CameraMotion(matrix[:, 0].astype(np.float32), shift.astype(np.float32))
