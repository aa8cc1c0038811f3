"""The detections of a frame: boxes, and how sure the detector was of each."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mpfjax.checks import shown, to_rows, warn
from mpfjax.vision.files.boxes import centred
from mpfjax.vision.tracking.gaussian import places_of

# Why a detection cannot be tracked, in the order in which it is asked.
FAULTS: tuple[str, ...] = ("not finite", "of no area", "outside the frame")

_UNBOUNDED = (-np.inf, -np.inf, np.inf, np.inf)


class Detections(NamedTuple):
    """What a detector found in one frame, a row for each; what it does not say is None.

    - `boxes`: (k, 4), (x, y, w, h) with (x, y) the top-left corner, in pixels.
    - `scores`: (k,), how sure the detector was, on any scale, higher for surer.
    - `classes`: (k,), whole numbers from 1 on, and 0 for none.

    Boxes with a masked entry are no detections.
    """

    boxes: Float[np.ndarray, "k 4"]
    scores: Float[np.ndarray, " k"] | None = None
    classes: Int[np.ndarray, " k"] | None = None

    @classmethod
    def of(cls, found: Any, named: str) -> "Detections":
        """What users hand over: boxes, or the fields in a tuple, as (boxes, scores).

        Raises `ValueError` for boxes that are not rows of four numbers, for scores and classes that
        are not one number a box, and for classes that are not whole numbers from 0 on.
        """
        several = isinstance(found, tuple) and len(found) in range(2, len(cls._fields) + 1)
        given: tuple[Any, ...] = found if several or isinstance(found, cls) else (found,)
        rows = to_masked_rows(4, named, given[0])
        rest: list[Any] = []
        for each, values in zip(cls._fields[1:], given[1:], strict=False):
            if values is not None:
                values = np.ma.filled(np.ma.asarray(values, float), np.nan).reshape(-1)
                if len(values) != len(rows):
                    raise ValueError(f"{named}: {len(values)} {each} for {len(rows)} boxes")
            rest.append(values)
        made = cls(rows, *rest)
        if made.classes is None:
            return made
        if (made.classes % 1 != 0).any() or (made.classes < 0).any():
            raise ValueError(f"{named}: classes {shown(made.classes)} are no whole numbers from 0")
        return made._replace(classes=made.classes.astype(int))


class Found(NamedTuple):
    """The detections of a frame that can be tracked, the strongest first, equal ones by area.

    - `boxes`: (d, 4), centre and size in pixels; `scores`, `classes`: (d,), a class of 0 for none.
    - `rows`: (d,), the row of each in what the detector gave.
    - `extent`: left, top, right, bottom of the frame; infinite where not known.
    - `left_out`: (3,), how many cannot be tracked, by `FAULTS`; `told`: what to say of each.
    - `colours`: (d, bins), None without pixels.
    """

    boxes: Float[np.ndarray, "d 4"]
    scores: Float[np.ndarray, " d"]
    classes: Int[np.ndarray, " d"]
    rows: Int[np.ndarray, " d"]
    extent: Float[np.ndarray, "4"]
    left_out: Int[np.ndarray, "3"]
    told: tuple[str, ...]
    colours: Float[np.ndarray, "d bins"] | None = None

    @classmethod
    def of(cls, found: Detections, named: str, frame_size: tuple[int, int] | None) -> "Found":
        """Leave out what cannot be tracked, and count it."""
        rows, scores, classes = found
        boxes = np.asarray(rows, float)
        scores = np.ones(len(rows)) if scores is None else scores
        keep = ~np.ma.getmaskarray(rows).any(axis=1)
        extent = np.array(_UNBOUNDED)
        if frame_size is not None:
            extent = np.array([0, 0, frame_size[1], frame_size[0]], float)
        with np.errstate(invalid="ignore"):
            far = boxes[:, :2] + boxes[:, 2:]
            sound = (
                np.isfinite(boxes).all(axis=1) & np.isfinite(scores),
                (boxes[:, 2:] > 0).all(axis=1),
                ((far > extent[:2]) & (boxes[:, :2] < extent[2:])).all(axis=1),
            )
        left_out, told = np.zeros(len(FAULTS), int), []
        for i, (good, fault) in enumerate(zip(sound, FAULTS, strict=True)):
            wrong = np.flatnonzero(keep & ~good)
            left_out[i], keep = len(wrong), keep & good
            first = f"row {wrong[0]}, {shown(boxes[wrong[0]].tolist())}, is" if len(wrong) else ""
            told.append(f"{named}, {first} {fault}; left out, as all such are")
        rows = np.flatnonzero(keep)
        areas = boxes[rows, 2] * boxes[rows, 3]
        rows = rows[np.lexsort((rows, -areas, -scores[rows]))]
        classes = np.zeros(len(scores), int) if classes is None else classes
        kept = centred(boxes[rows]), scores[rows], classes[rows], rows
        return cls(*kept, extent, left_out, tuple(told))

    def at(self, chosen: np.ndarray | slice) -> "Found":
        """Some of them."""
        return self._replace(
            **{name: getattr(self, name)[chosen] for name in ("boxes", "scores", "classes", "rows")}
        )

    def warn_of_first(self, before: Int[np.ndarray, "3"]) -> None:
        """Warn of each fault that comes for the first time: so many came before."""
        for said, had, has in zip(self.told, before, self.left_out, strict=True):
            if has and not had:
                warn(said)

    @property
    def places(self) -> Float[np.ndarray, "d 4"]:
        """(x, y, log w, log h)."""
        return places_of(self.boxes)


def to_masked_rows(width: int, name: str, value: Any) -> np.ma.MaskedArray:
    """The argument as rows of `width` numbers, of which masked ones stay masked."""
    if isinstance(value, list | tuple) and any(map(np.ma.is_masked, value)):
        value = np.ma.array(value)
    mask: Any = False
    if isinstance(value, np.ma.MaskedArray):
        value, mask = value.data, np.ma.getmaskarray(value)
    rows = to_rows(width, name, value)
    return np.ma.array(rows, mask=np.broadcast_to(mask, rows.shape))
