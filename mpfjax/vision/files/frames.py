"""Frames in and out: folders of images and GIFs through imageio, video files through PyAV too."""

import contextlib
import functools
import math
import re
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import UInt8

from mpfjax.checks import check_positive, check_shape, check_type, check_whole, given
from mpfjax.vision.files.sequences import read_sequence_info

_IMAGES = (".jpg", ".jpeg", ".png", ".bmp")
# The folder of images in a sequence; MOTChallenge's is the second.
_INNER = ("img", "img1")
# In half to .7 of the time of the preset "fast" at rate 20, with the same quality to .1 dB, in
# files a tenth larger.
_X264 = ["-crf", "19", "-preset", "veryfast", "-x264-params", "rc-lookahead=30:subme=4"]


def read_frames(
    path: str | Path, first: int = 1, last: int | None = None
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Read frames `first` to `last`, both included and counted from 1, in RGB, one at a time.

    `path` is a video file, a folder of images in the natural order of their names (2.png before
    10.png), or a folder with such a folder `img` or `img1`. All frames of a video are read,
    whatever the time between them, rotated as the file says. A `RuntimeWarning` names those that
    are too damaged to be decoded. Raises `ImportError` if imageio or PyAV is missing,
    `FileNotFoundError` if `path` is, and `ValueError` with `path` if it cannot be read, has no
    frames, or has frames of different sizes, and for `first` and `last` that are no range.
    """
    check_type((str, Path), "a path", path=path)
    check_whole(first=first, **given(last=last))
    if first < 1 or (last is not None and last < first):
        raise ValueError(f"first, last: {first}, {last} is not a range of frames from 1 on")
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such video or folder of images")
    frames = _read_images(path, first, last) if path.is_dir() else _read_video(path, first, last)
    return _of_one_size(path, frames)


def parse_range(text: str | None, argument: str = "frames") -> tuple[int, int | None]:
    """A and B of "A:B", frames counted from 1; without B it is None, for the last frame.

    Raises `ValueError` naming `argument` for any other text.
    """
    if text is None:
        return 1, None
    a, colon, b = text.partition(":")
    try:
        first, last = int(a), int(b) if b else None
    except ValueError:
        first, last = 0, None
    if not colon or first < 1 or (last is not None and last < first):
        raise ValueError(f"{argument}: {text!r} is not A:B with 1 <= A <= B")
    return first, last


def num_images(path: str | Path) -> int:
    """How many frames a folder of images holds."""
    return len(_image_paths(Path(path)))


def frame_rate(path: str | Path) -> float | None:
    """Frames per second of a video file, or of a folder whose `seqinfo.ini` names a `frameRate`.

    The mean for a video whose rate varies; None where the rate is not given. Raises `ValueError`
    for a file that is no video.
    """
    check_type((str, Path), "a path", path=path)
    path = Path(path)
    if path.is_dir():
        return read_sequence_info(path, path.parent).frame_rate
    if path.suffix.lower() == ".gif":
        with _naming(path, "a video"):
            rate = _imageio().immeta(path, plugin="pillow").get("fps")
    else:
        with _opened(path) as (_, stream):
            rate = stream.average_rate or stream.guessed_rate
    return float(rate) if rate and 0 < rate < math.inf else None


def write_video(
    path: str | Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], frames_per_second: float = 10.0
) -> None:
    """Write RGB frames to an MP4 or, by the ending of `path`, a GIF that loops.

    Raises `ValueError` for another ending, a frame that is no RGB image and a rate that is not
    positive, `ImportError` where imageio is missing.
    """
    check_type(Iterable, "frames one after the other", frames=frames)
    with open_video(path, frames_per_second) as append:
        for frame in frames:
            append(frame)


@contextlib.contextmanager
def open_video(
    path: str | Path, frames_per_second: float = 10.0
) -> Iterator[Callable[[UInt8[np.ndarray, "h w 3"]], None]]:
    """A context that appends RGB frames to a new MP4 or GIF, complete however the block ends.

    Raises as `write_video` does. Use it where frames are made one at a time.
    """
    check_type((str, Path), "a path", path=path)
    check_positive(frames_per_second=frames_per_second)
    suffix = Path(path).suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"path: {path} ends in neither .mp4 nor .gif")
    _imageio()
    # Only the older interface takes one frame after the other, without keeping all of them.
    from imageio.v2 import get_writer

    if suffix == ".gif":
        writer = get_writer(path, mode="I", duration=1000 / frames_per_second, loop=0)
    else:
        writer = get_writer(
            path, fps=frames_per_second, quality=None, macro_block_size=1, output_params=_X264
        )

    def append(frame: np.ndarray) -> None:
        check_frame(frame, "frames")
        # Interrupted while it is fed, imageio kills the encoder, and the video is lost.
        with _uninterrupted():
            writer.append_data(_even(frame) if suffix == ".mp4" else frame)

    with writer:
        yield append


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Put off a Ctrl-C that comes within the block until its end."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python sends signals to the main thread alone
        return
    pending: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: pending.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
        if pending and before is not signal.SIG_IGN:
            signal.raise_signal(signal.SIGINT)


def check_frame(frame: Any, argument: str = "frame", *, eight_bits: bool = True) -> None:
    """Raise `ValueError` unless `frame` is a colour image (h, w, 3), by default of eight bits."""
    check_shape("...", **{argument: frame})
    if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
        raise ValueError(f"{argument}: {frame.shape} is not the shape (h, w, 3) of a colour image")
    if eight_bits and frame.dtype != np.uint8:
        raise ValueError(f"{argument}: {frame.dtype} is not uint8")


def of_one_kind(
    frames: Iterable[UInt8[np.ndarray, "..."]], first: int = 1
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The frames in RGB, also from grey ones; errors name frames by their number from `first` on.

    Raises `ValueError` at the first frame that is no image of eight bits, or of another size than
    the frames before it.
    """
    shape = None
    for number, frame in enumerate(frames, first):
        frame = np.asarray(frame)
        if frame.ndim == 2 or frame.shape[2:] == (1,):
            frame = np.repeat(frame.reshape(*frame.shape[:2], 1), 3, axis=2)
        check_frame(frame, "frames")
        shape = shape or frame.shape
        if frame.shape != shape:
            raise ValueError(
                f"frames: frame {number} is {frame.shape[1]} x {frame.shape[0]}, and those before"
                f" it {shape[1]} x {shape[0]}"
            )
        yield frame


def write_image(path: str | Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write one RGB image, its format chosen by the ending of `path`."""
    _imageio().imwrite(path, image)


def _even(frame: np.ndarray) -> np.ndarray:
    """Pad to an even height and width, which the pixel format of an MP4 needs."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _image_paths(folder: Path) -> list[Path]:
    folder = next((folder / name for name in _INNER if (folder / name).is_dir()), folder)
    # Other systems leave hidden companions of the images behind.
    shown = [path for path in folder.iterdir() if not path.name.startswith(".")]
    return sorted((path for path in shown if path.suffix.lower() in _IMAGES), key=_natural)


def _natural(path: Path) -> tuple[list[Any], str]:
    """A key for the natural order of names: numbers in them are compared as numbers."""
    parts = re.split(r"([0-9]+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def _read_images(folder: Path, first: int, last: int | None) -> Iterator[np.ndarray]:
    imageio, paths = _imageio(), _image_paths(folder)
    if first > len(paths):
        raise ValueError(f"{folder}: holds {len(paths)} images, frame {first} is not among them")
    for path in paths[first - 1 : last]:
        with _naming(path, "an image"):
            image = _rgb(imageio.imread(path))
        yield image


def _read_video(path: Path, first: int, last: int | None) -> Iterator[np.ndarray]:
    number = 0
    decoded = _decode_gif(path) if path.suffix.lower() == ".gif" else _decode_video(path)
    for number, image in enumerate(decoded, 1):
        if number >= first:
            with _naming(path, "a video"):
                frame = image()
            yield frame
        if number == last:
            decoded.close()
            return
    if number < first:
        raise ValueError(f"{path}: holds {number} frames, frame {first} is not among them")


def _decode_gif(path: Path) -> Generator[Callable[[], np.ndarray]]:
    """Functions that decode the frames of a GIF, one for each frame."""
    images = iter(_imageio().imiter(path, plugin="pillow"))
    while True:
        with _naming(path, "a video"):
            image = next(images, None)
        if image is None:
            return
        yield functools.partial(_rgb, image)


def _decode_video(path: Path) -> Generator[Callable[[], np.ndarray]]:
    """A function for each frame of a video that decodes it; unneeded ones are not called."""
    with _opened(path) as (container, stream):
        stream.thread_type = "AUTO"
        packets, any_frame, damaged = container.demux(stream), False, None
        while True:
            with _naming(path, "a video"):
                packet = next(packets, None)
            if packet is None:
                break
            try:
                frames = packet.decode()
            except (OSError, ValueError) as error:  # the library's error for a damaged packet
                damaged = damaged or error
                continue
            for frame in frames:
                any_frame = True
                yield functools.partial(_upright, frame)
        if damaged and not any_frame:
            raise ValueError(f"{path}: cannot be read as a video ({damaged})")
    if damaged:
        warnings.warn(
            f"{path}: some frames are damaged, and were left out", RuntimeWarning, stacklevel=2
        )


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A video file and its first stream of frames."""
    library = _av()
    with _naming(path, "a video"):
        container = library.open(str(path))
    with container:
        if not container.streams.video:
            raise ValueError(f"{path}: cannot be read as a video (it holds no frames)")
        yield container, container.streams.video[0]


def _upright(frame: Any) -> np.ndarray:
    """The pixels of a decoded frame, rotated by quarters and mirrored as its file says."""
    image = frame.to_ndarray(format="rgb24")
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return image
    # (x, y) moves to (a x + c y, b x + d y), up to a shift.
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].tolist()
    if abs(b) > abs(a):
        image, a, d = image.transpose(1, 0, 2), c, b
    return np.ascontiguousarray(image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


@contextlib.contextmanager
def _naming(path: Path, what: str) -> Iterator[None]:
    """Turn any exception of a library into a one-line error that this file cannot be read."""
    try:
        yield
    # For a damaged file decoders raise nearly anything, even SyntaxError and struct.error.
    except Exception as error:
        said = getattr(error, "strerror", None) or str(error).strip() or type(error).__name__
        raise ValueError(f"{path}: cannot be read as {what} ({said.splitlines()[0]})") from error


def _of_one_size(path: Path, frames: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for frame in frames:
        shape = shape or frame.shape
        if frame.shape != shape:
            raise ValueError(
                f"{path}: frames of different sizes, {shape[:2]} and {frame.shape[:2]}"
            )
        yield frame


def _rgb(image: np.ndarray) -> np.ndarray:
    """Three channels of eight bits, also from grey, a palette, or with transparency."""
    image = np.asarray(image)
    if image.ndim == 2:
        image = image[:, :, None]
    if image.shape[2] < 3:
        # Grey, perhaps with transparency behind it.
        image = np.repeat(image[:, :, :1], 3, axis=2)
    if image.dtype == np.uint16:
        image = image // 257
    elif image.dtype == bool:
        image = 255 * image.astype(np.uint8)
    return np.ascontiguousarray(image[:, :, :3]).astype(np.uint8)


def _imageio() -> ModuleType:
    try:
        import imageio.v3 as imageio
    except ImportError as error:
        raise ImportError(
            'imageio is needed to read and write video: pip install "imageio[ffmpeg]"'
        ) from error
    return imageio


def _av() -> ModuleType:
    try:
        import av
    except ImportError as error:
        raise ImportError("av is needed to read video: pip install av") from error
    return av
