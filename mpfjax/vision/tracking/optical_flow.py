"""The camera's motion from pixels: corners of the static background, followed by OpenCV."""

import importlib.util
from typing import Any

import numpy as np

from mpfjax.arrays import (
    to_rows,
)
from mpfjax.checks import optional
from mpfjax.vision.files.frames import of_one_kind
from mpfjax.vision.tracking.gaussian import CameraMotion

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

    The motion is unknown in the first frame, if fewer than 12 corners agree, and if they are not a
    majority of those that were followed: after a cut, or without texture. An instance serves one
    video. The same frames yield the same motions. Raises `ImportError` without OpenCV. Use it for
    the argument `motion` of `ObjectTracker.step`; `track` does so automatically.
    """

    def __init__(self) -> None:
        self._cv2 = opencv()
        self._before: np.ndarray | None = None
        self._boxes = np.zeros((0, 4))

    def __call__(self, frame: Any, boxes: Any = None) -> CameraMotion:
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
            return CameraMotion.unknown()
        start, end = self._follow(before, picture, left)
        gaps = end[:, None] - self._boxes[None, :, :2]
        within = (gaps >= 0) & (gaps <= self._boxes[None, :, 2:])
        away = ~np.any(within.all(axis=2), axis=1)
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

    def _fit(self, start: np.ndarray, end: np.ndarray, factor: int) -> CameraMotion:
        """The similarity between the corners, in pixels of the frame, if most agree with one."""
        if len(start) < _FEWEST:
            return CameraMotion.unknown()
        # The random numbers of OpenCV's RANSAC start alike in each call.
        matrix, agree = self._cv2.estimateAffinePartial2D(
            start, end, method=self._cv2.RANSAC, ransacReprojThreshold=_OFF
        )
        if matrix is None or agree.sum() < _FEWEST or 2 * agree.sum() <= len(start):
            return CameraMotion.unknown()
        # A reduced pixel's centre, (i + 1/2) factor, is not that of the first of its pixels.
        centre = (factor - 1) / 2
        shift = factor * matrix[:, 2] + centre - matrix[:, :2] @ [centre, centre]
        return CameraMotion(
            matrix[:, 0].astype(np.float32), shift.astype(np.float32), np.asarray(True)
        )


def reduce(frame: np.ndarray, factor: int) -> np.ndarray:
    """The means over squares of pixels, so many along each side."""
    if factor == 1:
        return frame
    cv2 = opencv()
    size = max(frame.shape[1] // factor, 1), max(frame.shape[0] // factor, 1)
    return cv2.resize(frame, size, interpolation=cv2.INTER_AREA)


def has_opencv() -> bool:
    """Whether OpenCV is installed."""
    return importlib.util.find_spec("cv2") is not None


def opencv() -> Any:
    """OpenCV, or an `ImportError` that says how to install it."""
    return optional("cv2", "opencv-python-headless")
