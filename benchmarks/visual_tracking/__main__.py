"""Section 5.2 of Vermaak et al. (2003): the PF against the MPF on several look-alike objects.

    python -m benchmarks.visual_tracking                                  # a rendered scene
    python -m benchmarks.visual_tracking --sequence DIR --ids 2 3 4       # frames with gt.txt
    python -m benchmarks.visual_tracking --video FILE --box 10,20,30,60 --box 80,25,30,60
    python -m benchmarks.visual_tracking --sequence DIR --detect          # nobody draws a box

Both filters have the same model and the same particles at the start: 200 for the PF, at most 10
components of 20 for the MPF; with --preset objects twice as many particles, and from four objects
on more of both. Into --out DIR go an annotated video, a contact sheet as the paper's figure 3, the
tracks in MOTChallenge form, and the scores, null where there is no truth. With --detect, for a
camera that stands still, objects are found by background subtraction: the PF starts at those of the
first frame that has any, and in the MPF and the GM-MPF a component is born for every new one and
dies when its object is gone (Lin et al. 2012, section 5).
"""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

from benchmarks.coverage import coverage
from benchmarks.harness import Count, Natural, Seed, command, data, table
from benchmarks.visual_tracking.detected import follow_detected, make_mixtures, rows_of_tracks
from benchmarks.visual_tracking.following import Snapshot, follow, track_rows
from benchmarks.visual_tracking.pictures import NAMES, write_contact_sheet, write_video
from benchmarks.visual_tracking.source import Source, open_source
from mpfjax.console import check_outputs
from mpfjax.metrics import multi_object_scores
from mpfjax.vision import BackgroundSubtraction, write_tracks
from mpfjax.vision.boxes import recipes
from mpfjax.vision.files.frames import parse_range

OF_TRACKING = ("HOTA", "MOTA", "IDF1")
COLUMNS = {
    "filter": lambda result: NAMES[result["filter"]], "all covered": "{all_covered:.3g}",
    "on object": "{on_object:.3g}", "on another": "{on_other:.3g}", "id swaps": "{id_swaps:.3g}",
    "by object": "{object_swaps:.3g}", "ms a frame": "{ms_per_frame:.3g}",
}  # fmt: skip
# The frames of a filter's runs, and what makes tracks of them.
Runs = tuple[Iterator[Snapshot], Callable[..., list[np.ndarray]]]


@command(frames="1:4")
def main(
    *,
    sequence: Path | None = None,
    video: Path | None = None,
    box: Annotated[Sequence[str], "append"] = (),
    ids: Sequence[Natural] | None = None,
    detect: bool = False,
    frames: str | None = None,
    preset: Annotated[str, (*sorted(recipes.PRESETS),)] = "default",
    seed: Seed = 0,
    seeds: Count = 1,
    out: Path = Path("results/visual_tracking"),
) -> None:
    """Track with every filter, writing each one's results as soon as it has finished.

    - `sequence`: img/ and, if any, gt.txt.
    - `video`: a video file, in place of a sequence.
    - `box`: x,y,w,h, an object, in frame A.
    - `ids`: objects of gt.txt.
    - `detect`: find what moves, while the camera stands still.
    - `frames`: A:B, frames A to B, counted from 1, both in.
    - `seeds`: runs; scores are their means.
    """
    if sum(map(bool, (box, ids, detect))) > 1 or (sequence and video):
        raise ValueError("one of --sequence and --video, and of --box, --ids and --detect")
    span = parse_range(frames)
    if video is not None:
        check_outputs(out, ["tracking.mp4"], {"--video": video})
    source = open_source(sequence, video, span, seed, box, ids, detect)
    keys = jax.random.split(jax.random.key(seed), seeds)
    runs, source = (detected_runs if detect else drawn_runs)(preset, source, keys)
    settings = {
        "source": source.name, "preset": preset, "detect": detect, "seed": seed, "seeds": seeds,
        "boxes": source.boxes,
    }  # fmt: skip
    tracked: dict[str, list[Snapshot]] = {}
    results: list[dict[str, Any]] = []
    for name, (snapshots, rows) in runs.items():
        own, times = tracked.setdefault(name, []), [time.perf_counter()]
        bar = tqdm(snapshots, desc=NAMES[name], total=source.num_frames, unit="frame", disable=None)
        try:
            for snapshot in bar:
                own.append(snapshot)
                times.append(time.perf_counter())
        finally:
            # Also on the way out of an interrupted run.
            if own:
                span = source.first, source.first + len(own) - 1
                # Of the frames but the first, which compiles.
                ms = 1000 * float(np.median(np.diff(times[1:] if len(own) > 1 else times)))
                found = score(rows(own), span, source, detect)
                if preset == "objects" and name == "mpf" and not detect:
                    # Components keep to their first box, so that tracks have objects for ids.
                    of_objects = score(rows(own, by_reference=True), span, source, False)
                    found["object_swaps"] = of_objects["id_swaps"]
                results.append({"filter": name, "ms_per_frame": ms} | found)
                out.mkdir(parents=True, exist_ok=True)
                write_tracks(out / f"tracks_{name}.txt", rows(own)[0])
                data(out / "visual_tracking.json", settings=settings | {"frames": span},
                     results=results)  # fmt: skip
    write_contact_sheet(out / "contact_sheet.png", source, tracked)
    write_video(out / "tracking.mp4", source, tracked)
    print(table(COLUMNS | {each: f"{{{each}:.3g}}" for each in OF_TRACKING if detect}, results))
    print(f"written to {out}")


def drawn_runs(
    preset: str, source: Source, keys: Array, still: np.ndarray | None = None
) -> tuple[dict[str, Runs], Source]:
    """The filters of the preset, started at the given boxes of a frame, by default the first."""
    still = next(iter(source.read())) if still is None else still
    filters = recipes.PRESETS[preset](still, source.boxes)

    def rows(shots: list[Snapshot], **how: bool) -> list[np.ndarray]:
        return [track_rows(shots, run, first=source.first, **how) for run in range(len(keys))]

    runs = {name: (follow(keys, each, source.read()), rows) for name, each in filters.items()}
    return runs, source


def detected_runs(preset: str, source: Source, keys: Array) -> tuple[dict[str, Runs], Source]:
    """The PF of the preset, started at the first detections, and the two mixtures."""
    detector = BackgroundSubtraction()
    found = ((still, detector.detect(still)) for still in source.read())
    still, boxes = next((pair for pair in found if len(pair[1])), (None, None))
    if still is None or boxes is None:
        raise ValueError("--detect: nothing moves in these frames while the camera stands still")
    source = source._replace(boxes=boxes[: recipes.MAX_COMPONENTS])
    runs = {"pf": drawn_runs(preset, source, keys, still)[0]["pf"]}
    for name, filter in make_mixtures().items():
        kept: list[Any] = []
        rows = partial(rows_of_tracks, kept, source.first, len(keys))
        runs[name] = follow_detected(filter, keys, source.read(), kept), rows
    return runs, source


def score(
    tracks: list[np.ndarray], span: tuple[int, int], source: Source, detect: bool
) -> dict[str, Any]:
    """Coverage, and HOTA and its like with --detect; null where there is no truth.

    Means over the runs' tracks.
    """
    measures = ["all_covered", "id_swaps", "on_object", "on_other"]
    result: dict[str, Any] = dict.fromkeys([*measures, "object_swaps", *OF_TRACKING])
    truth = np.zeros((0, 6)) if source.truth is None else source.truth
    truth = truth[truth[:, 0] <= span[1]]
    if not len(truth):
        return result
    scores = [coverage(rows, truth, source.others)._asdict() for rows in tracks]
    for measure in measures if source.all_labelled else measures[:2]:
        result[measure] = float(np.mean([each[measure] for each in scores]))
    truth = truth[truth[:, 0] >= span[0]]
    try:
        found = [multi_object_scores(rows, truth) for rows in tracks if detect]
    except ImportError as error:
        print(f"no HOTA, MOTA and IDF1: {error}", file=sys.stderr)
        found = []
    return result | {name: float(np.mean([each[name] for each in found]))
                     for name in OF_TRACKING if found}  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
