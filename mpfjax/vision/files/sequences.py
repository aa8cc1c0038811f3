"""The metadata of a sequence's folder: its `seqinfo.ini`, and its files of detections."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

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
    """Read the `seqinfo.ini` in the first of these folders that has one."""
    path = next((folder / _INFO for folder in folders if (folder / _INFO).is_file()), None)
    if path is None:
        return SequenceInfo()
    text = path.read_text(encoding="utf-8", errors="replace")
    rate, length, height, width = (
        _number(text, key) for key in ("frameRate", "seqLength", "imHeight", "imWidth")
    )
    return SequenceInfo(
        name=_value(text, "name", r"\S+"),
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


def _number(text: str, key: str) -> float | None:
    found = _value(text, key, r"\d+(?:\.\d+)?")
    return float(found) or None if found else None


def _value(text: str, key: str, pattern: str) -> str | None:
    found = re.search(rf"^{key}\s*=\s*({pattern})\s*$", text, re.MULTILINE)
    return found[1] if found else None
