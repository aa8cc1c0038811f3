"""What a run of a filter is worth: coverage, HOTA and their like, and time."""

import sys
from typing import Any

import numpy as np

from benchmarks.coverage import coverage
from benchmarks.visual_tracking.pictures import NAMES
from benchmarks.visual_tracking.source import Source
from mpfjax.metrics import multi_object_scores

OF_TRACKING = ("HOTA", "MOTA", "IDF1")
COLUMNS = {
    "filter": lambda result: NAMES[result["filter"]], "all covered": "{all_covered:.3g}",
    "on object": "{on_object:.3g}", "on another": "{on_other:.3g}", "id swaps": "{id_swaps:.3g}",
    "by object": "{object_swaps:.3g}", "ms a frame": "{ms_per_frame:.3g}",
}  # fmt: skip


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
    measures = ("all_covered", "per_object", "on_object", "on_other", "id_swaps", "object_swaps")
    result: dict[str, Any] = {"filter": name} | dict.fromkeys(measures)
    # Of the frames but the first, which compiles.
    result["ms_per_frame"] = 1000 * float(np.median(seconds[1:] or seconds))
    truth = source.truth
    if truth is not None:
        truth = truth[truth[:, 0] < source.first + num_frames]
    if truth is None or len(truth) == 0:
        return result
    scores = [coverage(rows, truth, source.others) for rows in tracks]
    seen = ("all_covered", "id_swaps", *(("on_object", "on_other") if source.all_labelled else ()))
    result |= {measure: mean([getattr(each, measure) for each in scores]) for measure in seen}
    result["per_object"] = {
        str(id): mean([each.per_object[id] for each in scores]) for id in scores[0].per_object
    }
    if by_object is not None:
        result["object_swaps"] = mean([coverage(rows, truth).id_swaps for rows in by_object])
    return result


def mean(values: list[float]) -> float:
    """Over runs."""
    return float(np.mean(values))


def tracking_scores(tracks: list[np.ndarray], source: Source, num_frames: int) -> dict[str, Any]:
    """HOTA, MOTA and IDF1, means over the runs; null without a truth or without TrackEval."""
    span = (source.first, source.first + num_frames - 1)
    if source.truth is None or not np.any(source.truth[:, 0] <= span[1]):
        return dict.fromkeys(OF_TRACKING)
    try:
        scores = [multi_object_scores(rows, source.truth, span) for rows in tracks]
    except ImportError as error:
        print(f"no HOTA, MOTA and IDF1: {error}", file=sys.stderr)
        return dict.fromkeys(OF_TRACKING)
    return {name: mean([score[name] for score in scores]) for name in OF_TRACKING}
