"""What a run of a filter is worth: coverage, HOTA and their like, and time."""

import sys
from typing import Any

import numpy as np

from benchmarks.coverage import coverage
from benchmarks.visual_tracking.pictures import NAMES
from benchmarks.visual_tracking.source import Source
from mpfjax.console import format_table
from mpfjax.metrics import multi_object_scores


def score(
    name: str,
    tracks: list[np.ndarray],
    num_frames: int,
    seconds: list[float],
    source: Source,
    by_object: list[np.ndarray] | None = None,
) -> dict[str, Any]:
    """One entry of the results: means over the runs' tracks, null where there is no truth.

    `by_object` are the same tracks with whom they are hypotheses about as their ids.
    """
    result = {"filter": name, "all_covered": None, "per_object": None, "on_object": None}
    result |= {"on_other": None, "id_swaps": None, "object_swaps": None}
    result |= {"ms_per_frame": _milliseconds(seconds)}
    truth = source.truth
    if truth is not None:
        truth = truth[truth[:, 0] < source.first + num_frames]
    if truth is None or len(truth) == 0:
        return result
    scores = [coverage(rows, truth, source.others) for rows in tracks]
    result["all_covered"] = _mean([s.all_covered for s in scores])
    result["per_object"] = {
        str(id): _mean([s.per_object[id] for s in scores]) for id in scores[0].per_object
    }
    result["id_swaps"] = _mean([s.id_swaps for s in scores])
    if by_object is not None:
        result["object_swaps"] = _mean([coverage(rows, truth).id_swaps for rows in by_object])
    if source.all_labelled:
        result["on_object"] = _mean([s.on_object for s in scores])
        result["on_other"] = _mean([s.on_other for s in scores])
    return result


def _mean(values: list[float]) -> float:
    return float(np.mean(values))


def _milliseconds(seconds: list[float]) -> float:
    """The median over the frames but the first, which compiles."""
    return 1000 * float(np.median(seconds[1:] or seconds))


def tracking_scores(tracks: list[np.ndarray], source: Source, num_frames: int) -> dict[str, Any]:
    """HOTA, MOTA and IDF1, means over the runs; null without a truth or without TrackEval."""
    names = ("HOTA", "MOTA", "IDF1")
    span = (source.first, source.first + num_frames - 1)
    if source.truth is None or not np.any(source.truth[:, 0] <= span[1]):
        return dict.fromkeys(names)
    try:
        scores = [multi_object_scores(rows, source.truth, span) for rows in tracks]
    except ImportError as error:
        print(f"no HOTA, MOTA and IDF1: {error}", file=sys.stderr)
        return dict.fromkeys(names)
    return {name: _mean([score[name] for score in scores]) for name in names}


def table(results: list[dict[str, Any]]) -> str:
    """The results as text."""
    columns = {
        "all_covered": "all covered",
        "on_object": "on object",
        "on_other": "on another",
        "id_swaps": "id swaps",
        "object_swaps": "by object",
        "ms_per_frame": "ms a frame",
    }
    columns |= {name: name for name in ("HOTA", "MOTA", "IDF1") if name in results[-1]}
    rows = []
    for result in results:
        cells = [result.get(name) for name in columns]
        rows.append(
            [NAMES[result["filter"]], *("-" if cell is None else f"{cell:.3g}" for cell in cells)]
        )
    return format_table(["filter", *columns.values()], rows)
