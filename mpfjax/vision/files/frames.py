"""Frames in and out: folders of images through Pillow, video files through PyAV."""

import contextlib
import heapq
import itertools
import math
import re
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from mpfjax.checks import Count, Positive, checked, optional, warn
from mpfjax.vision.files.sequences import read_sequence_info

_IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
# The folder of images in a sequence; MOTChallenge's is the second.
INNER = ("img", "img1")
_RATE = 25.0  # frames a second of a video that does not say it
_SOME = 20  # as many numbers are said
# In half to .7 of the time of the preset "fast" at rate 20, with the same quality to .1 dB, in
# files a tenth larger.
_X264 = {"crf": "19", "preset": "veryfast", "x264-params": "rc-lookahead=30:subme=4"}


@checked
def read_frames(
    path: str | Path,
    first: Count = 1,
    last: Count | None = None,
    *,
    times: list[float] | None = None,
) -> Iterator[Any]:
    """Read frames `first` to `last`, both included and counted from 1: arrays (h, w, 3), in RGB.

    `path` is a video file, a folder of images in the natural order of their names (2.png before
    10.png), or a folder with such a folder `img` or `img1`. All frames of a video are read, for any
    time between them; both are rotated as specified in the file. None stands for a frame that is
    too damaged to be decoded, so that later frames keep their numbers; a `RuntimeWarning` at the
    end reports the numbers and the count of these.

    `times`: a list to which the time of each frame of a video in seconds is appended, before the
    frame is yielded; always increasing, by the mean rate if the file does not specify it. It stays
    empty for images.

    Raises `ImportError` without PyAV for a video, `FileNotFoundError` if nothing exists, and
    `ValueError` with `path` if it cannot be read, has no frames, or has frames of different sizes,
    and for `first` and `last` that are not a range.
    """
    if last is not None and last < first:
        raise ValueError(f"first, last: {first}, {last} is not a range of frames from 1 on")
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"path: {path} does not exist")
    if path.is_dir():
        return of_one_kind(_read_images(path, first, last), first, str(path))
    return of_one_kind(_read_video(path, first, last, times), first, str(path))


def parse_range(text: str | None) -> tuple[int, int | None]:
    """A and B of the option --frames "A:B", counted from 1; without B it is None, for the last.

    Raises `ValueError` for any other text.
    """
    if text is None:
        return 1, None
    span = re.fullmatch(r"(\d+):(\d*)", text, re.ASCII)
    first, last = (int(span[1]), int(span[2]) if span[2] else None) if span else (0, None)
    if first < 1 or (last is not None and last < first):
        raise ValueError(f"--frames: {text!r} is not A:B with 1 <= A <= B")
    return first, last


def num_images(path: str | Path) -> int:
    """How many frames a folder of images holds."""
    return len(_image_paths(Path(path)))


def frame_rate(path: str | Path) -> float | None:
    """Frames per second of a video file, or of a folder whose `seqinfo.ini` names a `frameRate`.

    The mean for a video whose rate varies; None where the rate is not given. Raises `ValueError`
    for a file that is no video.
    """
    path = Path(path)
    if path.is_dir():
        return read_sequence_info(path, path.parent).frame_rate
    with _open(path) as (_, stream):
        rate = stream.average_rate or stream.guessed_rate
    return float(rate) if rate and 0 < rate < math.inf else None


@checked
def write_video(
    path: str | Path,
    frames: Iterable[UInt8[np.ndarray, "h w 3"] | None],
    frames_per_second: Positive = 10.0,
) -> None:
    """Write RGB frames to an MP4 or, by the ending of `path`, a GIF that loops.

    None, a frame that could not be decoded, is written as the frame before it. The file is also
    complete if the frames end by an exception, and there is none before the first frame. Raises
    `ValueError` for another ending, frames that are not images of one size and a rate that is not
    positive, `ImportError` if PyAV is missing for an MP4.
    """
    stills = without_gaps(of_one_kind(frames))
    if Path(path).suffix.lower() == ".gif":
        from PIL import Image

        images = map(Image.fromarray, stills)
        duration = 1000 / frames_per_second
        next(images).save(path, save_all=True, append_images=images, duration=duration, loop=0)
        return
    if Path(path).suffix.lower() != ".mp4":
        raise ValueError(f"path: {path} ends in neither .mp4 nor .gif")
    library, rate = optional("av", "av"), Fraction(frames_per_second).limit_denominator(1001)
    first = next(stills, None)
    if first is None:
        return
    # The pixel format of an MP4 needs an even height and width.
    height, width, _ = first.shape
    margins = (0, height % 2), (0, width % 2), (0, 0)
    with library.open(_url(path), "w") as file:
        stream = file.add_stream("libx264", rate=rate, options=_X264)
        stream.height, stream.width = height + height % 2, width + width % 2
        stream.pix_fmt, stream.codec_context.thread_count = "yuv420p", 0  # one for each processor
        try:
            for still in itertools.chain([first], stills):
                image = np.pad(still, margins, mode="edge")
                file.mux(stream.encode(library.VideoFrame.from_ndarray(image, format="rgb24")))
        finally:
            file.mux(stream.encode())


def check_frame(frame: Any, argument: str = "frame") -> None:
    """Raise `ValueError` unless `frame` is a colour image (h, w, 3) of eight bits."""
    shape, dtype = getattr(frame, "shape", ()), getattr(frame, "dtype", None)
    if len(shape) != 3 or shape[2] != 3 or 0 in shape or dtype != np.uint8:
        raise ValueError(f"{argument}: {dtype}, {shape}, is no colour image, uint8 of (h, w, 3)")


def of_one_kind(
    frames: Iterable[UInt8[np.ndarray, "..."] | None], first: int = 1, argument: str = "frames"
) -> Iterator[Any]:
    """The frames in RGB, also from grey ones; errors name frames by their number from `first` on.

    None, for a frame that cannot be decoded, stays. Raises `ValueError` at the first frame that is
    no image of eight bits, or of another size than the frames before it.
    """
    shape = None
    for number, frame in enumerate(frames, first):
        if frame is None:
            yield None
            continue
        frame = np.asarray(frame)
        if frame.ndim == 2 or frame.shape[2:] == (1,):
            frame = np.repeat(frame.reshape(*frame.shape[:2], 1), 3, axis=2)
        check_frame(frame, argument)
        shape = shape or frame.shape
        if frame.shape != shape:
            raise ValueError(f"{argument}: {number} has the shape {frame.shape}, others {shape}")
        yield frame


def without_gaps(frames: Iterable[Any]) -> Iterator[Any]:
    """The frames with the one before it in the place of None, or the first of all after it."""
    latest, waiting = None, 0
    for frame in frames:
        latest, waiting = latest if frame is None else frame, waiting + 1
        while latest is not None and waiting:
            waiting -= 1
            yield latest


def _image_paths(folder: Path) -> list[Path]:
    folder = next((folder / name for name in INNER if (folder / name).is_dir()), folder)
    # Other systems leave hidden companions of the images behind.
    shown = [path for path in folder.iterdir() if not path.name.startswith(".")]
    return sorted((path for path in shown if path.suffix.lower() in _IMAGES), key=_natural)


def _natural(path: Path) -> tuple[list[Any], str]:
    """A key for the natural order of names: numbers in them are compared as numbers."""
    parts = re.split(r"([0-9]+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def read_image(path: Path, mode: str) -> UInt8[np.ndarray, "h w channels"]:
    """The pixels of an image, rotated as its file says, in a mode of Pillow, "RGB" or "RGBA".

    Images with 16 bits of grey are read as of eight. Raises `ValueError` for a file that cannot be
    read, and for numbers of more bits, or of floating point.
    """
    image_module, operations = optional("PIL.Image", "pillow"), optional("PIL.ImageOps", "pillow")
    with _naming(path, "an image"), image_module.open(path) as opened:
        image = operations.exif_transpose(opened)
        if image.mode.startswith("I"):
            numbers = np.asarray(image)
            if numbers.min() < 0 or numbers.max() > 65535:
                raise ValueError("its grey has more than 16 bits")
            image = image_module.fromarray((numbers // 257).astype(np.uint8))
        if image.mode == "F":
            raise ValueError("its grey is in floating point")
        return np.array(image.convert(mode))


def _read_images(folder: Path, first: int, last: int | None) -> Iterator[np.ndarray]:
    paths = _image_paths(folder)
    if first > len(paths):
        raise ValueError(f"{folder}: holds {len(paths)} images, frame {first} is not among them")
    for path in paths[first - 1 : last]:
        yield read_image(path, "RGB")


def _read_video(
    path: Path, first: int, last: int | None, times: list[float] | None
) -> Iterator[np.ndarray | None]:
    number, damaged, latest = 0, [], -math.inf
    step = 0.0 if times is None else 1 / (frame_rate(path) or _RATE)
    for number, frame in enumerate(itertools.islice(_decode(path), last), 1):
        if number < first:
            continue
        if times is not None:
            stamp = -math.inf if frame is None or frame.time is None else float(frame.time)
            latest = stamp if stamp > latest else max(latest, -step) + step
            times.append(latest)
        if frame is None:
            damaged.append(number)
            yield None
            continue
        with _naming(path, "a video"):
            image = _upright(frame)
        yield image
    if number < first:
        raise ValueError(f"{path}: holds {number} frames, frame {first} is not among them")
    if damaged:
        numbers = ", ".join(map(str, damaged[:_SOME])) + ", ..." * (len(damaged) > _SOME)
        warn(f"{path}: {len(damaged)} frames are too damaged to be decoded: {numbers}")


def _decode(path: Path) -> Iterator[Any]:
    """The frames of a video, their pixels not yet converted; None for each that is damaged.

    A frame comes later than its packet, and in another order. One that never comes is told by its
    time, which lies before that of a frame that has come. Where a file's times are not in order,
    None comes as soon as a packet cannot be decoded.
    """
    with _open(path) as (container, stream):
        stream.thread_type = "AUTO"
        packets, coming, latest, in_order = container.demux(stream), [], -math.inf, True
        # Sound files have packets without a frame as well, as before a first whole picture. Only
        # decoders of AV1 say nothing of damage.
        is_damaged = stream.codec_context.name == "libdav1d"
        while True:
            with _naming(path, "a video"):
                packet = next(packets, None)
            if packet is None:
                break
            if packet.size and not packet.is_discard:
                in_order &= packet.pts is not None
                heapq.heappush(coming, packet.pts or 0)
            try:
                frames = packet.decode()
            except (OSError, ValueError):  # the library's error for a damaged packet
                is_damaged, frames = True, []
                if not in_order:
                    yield None
            for frame in frames:
                in_order &= frame.pts is not None and frame.pts > latest
                while in_order and coming and coming[0] <= frame.pts:
                    if heapq.heappop(coming) < frame.pts and is_damaged:
                        yield None
                latest = frame.pts
                yield frame
        if is_damaged and in_order:
            yield from [None] * len(coming)


def _url(path: str | Path) -> str:
    """A path as FFmpeg reads it, to which the words before a colon are else a protocol."""
    return f"file:{path}"


@contextlib.contextmanager
def _open(path: Path) -> Iterator[tuple[Any, Any]]:
    """A video file and its first stream of frames."""
    library = optional("av", "av")
    with _naming(path, "a video"):
        container = library.open(_url(path))
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
        message = getattr(error, "strerror", None) or str(error).strip() or type(error).__name__
        raise ValueError(f"{path}: cannot be read as {what} ({message.splitlines()[0]})") from error
