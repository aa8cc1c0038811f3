"""The metadata of a sequence's folder: its `seqinfo.ini`, and its files of detections."""

import configparser
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mpfjax.checks import shown
from mpfjax.vision.files.boxes import read_text

_INFO = "seqinfo.ini"


class SequenceInfo(NamedTuple):
    """The contents of a MOTChallenge `seqinfo.ini`; None for missing entries.

    - `name`: of the sequence; `frame_rate`: frames a second; `length`: the number of frames.
    - `size`: height and width of a frame, in pixels.
    """

    name: str | None = None
    frame_rate: float | None = None
    length: int | None = None
    size: tuple[int, int] | None = None


def read_sequence_info(*folders: Path) -> SequenceInfo:
    """Read the `seqinfo.ini` in the first of these folders that has one.

    Keys may have any case. Raises `ValueError` with the file and the key for what is no number.
    """
    path = next((folder / _INFO for folder in folders if (folder / _INFO).is_file()), None)
    if path is None:
        return SequenceInfo()
    parser = configparser.ConfigParser(
        interpolation=None, strict=False, allow_no_value=True, inline_comment_prefixes=("#", ";")
    )
    parser.optionxform = lambda optionstr: re.sub(r"[\W_]", "", optionstr.lower())
    # Keys before the first section, and indented ones, are keys too.
    lines = ["[Sequence]", *(line.strip() for line in read_text(path).splitlines())]
    try:
        parser.read_string("\n".join(lines))
    except configparser.Error as error:
        raise ValueError(f"{path}: {error}") from error
    values = {key: value for name in parser.sections() for key, value in parser.items(name)}
    rate, length, height, width = (
        _number(path, key, values.get(key.lower()))
        for key in ("frameRate", "seqLength", "imHeight", "imWidth")
    )
    return SequenceInfo(
        name=values.get("name") or None,
        frame_rate=rate,
        length=None if length is None else int(length),
        size=None if height is None or width is None else (int(height), int(width)),
    )


def detection_files(folder: Path) -> list[Path]:
    """The files of detections of a sequence: det*.txt in its folder, and in `det` there."""
    return sorted(folder.glob("det*.txt")) + sorted(folder.glob("det/det*.txt"))


def sequence_of(detections: Path) -> Path | None:
    """The folder of the sequence to which a file of detections belongs, by its path, or None."""
    folders = Path(detections).absolute().parents[:2]
    return next((folder for folder in folders if _is_among(detections, folder)), None)


def last_frame(info: SequenceInfo, *rows: np.ndarray) -> int:
    """The number of the last frame where there are no images: as given, or the last of any rows."""
    if info.length is not None:
        return info.length
    return int(max((found[:, 0].max() for found in rows if len(found)), default=0))


def _is_among(file: Path, folder: Path) -> bool:
    return file.absolute() in detection_files(folder)


def _number(path: Path, key: str, value: str | None) -> float | None:
    """A positive number, None where there is none."""
    try:
        number = float(value or 0)
    except ValueError:
        raise ValueError(f"{path}: {key}: {shown(value)} is not a number") from None
    return number if 0 < number < np.inf else None
