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

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

import mpfjax
from benchmarks.visual_tracking.detected import detect_all, make_mixtures, track_detected
from benchmarks.visual_tracking.pictures import NAMES, write_contact_sheet, write_video
from benchmarks.visual_tracking.scores import score, table, tracking_scores
from benchmarks.visual_tracking.source import Source, open_source
from mpfjax.console import exit_status, seed, whole, write_json
from mpfjax.vision.boxes.following import Snapshot, follow, track_rows
from mpfjax.vision.boxes.recipes import (
    MAX_COMPONENTS,
    PARTICLES_PER_COMPONENT,
    PARTICLES_PER_HYPOTHESIS,
    PRESETS,
    most_components,
)
from mpfjax.vision.files import boxes as box_files


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments, each checked as far as it can be without the frames."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.visual_tracking",
        description="Track several objects with the PF and the MPF (Vermaak et al. 2003, 5.2).",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--sequence", type=Path, metavar="DIR", help="img/ and, if any, gt.txt")
    where.add_argument("--video", type=Path, metavar="FILE", help="a video file")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--box", action="append", metavar="x,y,w,h", help="an object, in frame A")
    what.add_argument("--ids", type=whole(0), nargs="+", metavar="ID", help="objects of gt.txt")
    what.add_argument("--detect", action="store_true", help="find what moves; a still camera")
    parser.add_argument("--frames", metavar="A:B", help="frames A to B, counted from 1, both in")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="default")
    parser.add_argument("--out", type=Path, default=Path("results/visual_tracking"))
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--seeds", type=whole(), default=1, help="runs; scores are their means")
    parser.add_argument("--gif", action="store_true", help="an animated GIF in place of an MP4")
    options = parser.parse_args(arguments)
    if options.box is not None and options.sequence is None and options.video is None:
        parser.error(
            "argument --box: without --video FILE or --sequence DIR there is no frame to draw it"
            " in; add one, or leave --box out for the rendered scene"
        )
    return options


def run(options: argparse.Namespace) -> None:
    """Track with every filter, writing each one's results as soon as it has finished."""
    source = open_source(options)
    keys = jax.random.split(jax.random.key(options.seed), options.seeds)
    options.out.mkdir(parents=True, exist_ok=True)
    runs, source = (_detected_runs if options.detect else _drawn_runs)(options, source, keys)
    tracked: dict[str, list[Snapshot]] = {}
    results: list[dict[str, Any]] = []
    for name, (frames_of_run, rows_of_run) in runs.items():
        tracked[name], seconds = [], []
        try:
            with tqdm(total=source.num_frames, desc=NAMES[name], unit="frame", disable=None) as bar:
                for snapshot, elapsed in frames_of_run(bar):
                    tracked[name].append(snapshot)
                    seconds.append(elapsed)
        finally:
            # Also on the way out of an interrupted run.
            if tracked[name]:
                tracks = rows_of_run(tracked[name])
                result = score(
                    name,
                    tracks,
                    len(tracked[name]),
                    seconds,
                    source,
                    _by_object(name, options, tracked[name], source),
                )
                if options.detect:
                    result |= tracking_scores(tracks, source, len(tracked[name]))
                results.append(result)
                box_files.write_tracks(options.out / f"tracks_{name}.txt", tracks[0])
                _write_scores(options, source, len(tracked[name]), results)
    write_contact_sheet(options.out / "contact_sheet.png", source, tracked)
    write_video(options.out / f"tracking.{'gif' if options.gif else 'mp4'}", source, tracked)
    print(table(results))
    print(f"written to {options.out}")


def _drawn_runs(options, source: Source, keys: Array) -> tuple[dict[str, Any], Source]:
    """The filters of the preset, started at the given boxes."""
    first_frame = next(iter(source.read()))
    filters = PRESETS[options.preset](first_frame, source.boxes)
    return {name: _plain_run(filter, source, keys) for name, filter in filters.items()}, source


def _plain_run(filter: mpfjax.Filter, source: Source, keys: Array) -> tuple[Callable, Callable]:
    """What yields the frames of a filter's runs, and what makes tracks of them."""
    return (
        lambda bar: track(filter, keys, source, bar),
        lambda snapshots: [track_rows(snapshots, run, source.first) for run in range(len(keys))],
    )


def _by_object(
    name: str, options: argparse.Namespace, snapshots: list[Snapshot], source: Source
) -> list[np.ndarray] | None:
    """Each run's tracks with objects for ids, where components keep to their first box."""
    if name != "mpf" or options.preset != "objects" or options.detect:
        return None
    return [
        track_rows(snapshots, run, source.first, by_reference=True) for run in range(options.seeds)
    ]


def _detected_runs(options, source: Source, keys: Array) -> tuple[dict[str, Any], Source]:
    """The PF of the preset, started at the first detections, and the two mixtures."""
    detected = detect_all(source)
    first = next((t for t, boxes in enumerate(detected.boxes) if len(boxes)), None)
    if first is None:
        raise ValueError("--detect: nothing moves before a still camera in these frames")
    boxes = detected.boxes[first][:MAX_COMPONENTS]
    source = source._replace(boxes=boxes, num_frames=len(detected.boxes))
    still = next(frame for t, frame in enumerate(source.read()) if t == first)
    filter = PRESETS[options.preset](still, boxes)["pf"]
    runs: dict[str, Any] = {"pf": _plain_run(filter, source, keys)}
    for name, component in make_mixtures().items():
        runs[name] = track_detected(component, keys, source, detected)
    return runs, source


def track(
    filter: mpfjax.Filter, keys: Array, source: Source, bar: tqdm
) -> Iterator[tuple[Snapshot, float]]:
    """Each frame's snapshot, and the seconds since the frame was read."""
    handed_over = [0.0]

    def stills() -> Iterator[np.ndarray]:
        for still in source.read():
            handed_over[0] = time.perf_counter()
            yield still

    for snapshot in follow(filter, keys, stills()):
        bar.update()
        yield snapshot, time.perf_counter() - handed_over[0]


def _write_scores(options, source: Source, num_frames: int, results) -> None:
    components, particles = MAX_COMPONENTS, PARTICLES_PER_COMPONENT
    if options.preset == "objects" and not options.detect:
        components, particles = most_components(len(source.boxes)), PARTICLES_PER_HYPOTHESIS
    settings = {
        "source": source.name,
        "preset": options.preset,
        "detect": options.detect,
        "frames": [source.first, source.first + num_frames - 1],
        "boxes": source.boxes.tolist(),
        "ids": None if source.truth is None else np.unique(source.truth[:, 1]).astype(int).tolist(),
        "seed": options.seed,
        "seeds": options.seeds,
        "num_particles": particles * components,
        "max_components": components,
        "particles_per_component": particles,
    }
    write_json(options.out / "visual_tracking.json", {"settings": settings, "results": results})


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    return exit_status(lambda: run(parse_arguments(arguments)), arguments)


if __name__ == "__main__":
    sys.exit(main())
