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

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

import mpfjax
from benchmarks.harness import Count, Natural, Seed, command, data, table
from benchmarks.visual_tracking.detected import detect_all, make_mixtures, track_detected
from benchmarks.visual_tracking.pictures import NAMES, write_contact_sheet, write_video
from benchmarks.visual_tracking.scores import COLUMNS, OF_TRACKING, score, tracking_scores
from benchmarks.visual_tracking.source import Asked, Source, read_source, rendered_source
from mpfjax.console import refuse_overwriting
from mpfjax.vision import write_tracks
from mpfjax.vision.boxes import recipes
from mpfjax.vision.boxes.following import Snapshot, follow, track_rows
from mpfjax.vision.files.frames import parse_range


class Runs(NamedTuple):
    """What yields the frames of a filter's runs with their seconds, and what makes tracks of them.

    - `by_object`: tracks with objects for ids, where components keep to their first box.
    """

    frames: Callable[[tqdm], Iterator[tuple[Snapshot, float]]]
    rows: Callable[[list[Snapshot]], list[np.ndarray]]
    by_object: Callable[[list[Snapshot]], list[np.ndarray]] | None = None


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
    gif: bool = False,
    out: Path = Path("results/visual_tracking"),
) -> None:
    """Track with every filter, writing each one's results as soon as it has finished.

    - `sequence`: img/ and, if any, gt.txt.
    - `video`: a video file, in place of a sequence.
    - `box`: x,y,w,h, an object, in frame A.
    - `ids`: objects of gt.txt.
    - `detect`: find what moves; a still camera.
    - `frames`: A:B, frames A to B, counted from 1, both in.
    - `seeds`: runs; scores are their means.
    - `gif`: an animated GIF in place of an MP4.
    """
    if sum(map(bool, (box, ids, detect))) > 1 or (sequence and video):
        raise ValueError("one of --sequence and --video, and of --box, --ids and --detect")
    span, asked = parse_range(frames, "--frames"), Asked(box, ids, detect)
    paths = {"--sequence": sequence, "--video": video}
    source = None
    for name, path in paths.items():
        if path is not None:
            if not (path.is_dir() if name == "--sequence" else path.is_file()):
                kind = "folder" if name == "--sequence" else "file"
                raise ValueError(f"{name}: {path} is not a {kind}")
            refuse_overwriting(out, ["tracking.mp4", "tracking.gif"], {name: path})
            source = read_source(path, name, span, asked)
    if source is None:
        if box:
            raise ValueError(
                "--box: without --video FILE or --sequence DIR there is no frame to draw it in;"
                " add one, or leave --box out for the rendered scene"
            )
        source = rendered_source(span, seed, asked)
    keys = jax.random.split(jax.random.key(seed), seeds)
    runs, source = (detected_runs if detect else drawn_runs)(preset, source, keys)
    settings = {
        "source": source.name, "preset": preset, "detect": detect, "seed": seed, "seeds": seeds
    }  # fmt: skip
    settings |= sizes(preset if not detect else "detect", source)
    tracked: dict[str, list[Snapshot]] = {}
    results: list[dict[str, Any]] = []
    for name, own in runs.items():
        tracked[name], seconds = [], []
        try:
            with tqdm(total=source.num_frames, desc=NAMES[name], unit="frame", disable=None) as bar:
                for snapshot, elapsed in own.frames(bar):
                    tracked[name].append(snapshot)
                    seconds.append(elapsed)
        finally:
            # Also on the way out of an interrupted run.
            if number := len(tracked[name]):
                tracks = own.rows(tracked[name])
                by_object = None if own.by_object is None else own.by_object(tracked[name])
                results.append(score(name, tracks, number, seconds, source, by_object))
                if detect:
                    results[-1] |= tracking_scores(tracks, source, number)
                out.mkdir(parents=True, exist_ok=True)
                write_tracks(out / f"tracks_{name}.txt", tracks[0])
                settings["frames"] = [source.first, source.first + number - 1]
                data(out / "visual_tracking.json", settings=settings, results=results)
    write_contact_sheet(out / "contact_sheet.png", source, tracked)
    write_video(out / f"tracking.{'gif' if gif else 'mp4'}", source, tracked)
    more = OF_TRACKING if detect else ()
    print(table(COLUMNS | {each: f"{{{each}:.3g}}" for each in more}, results))
    print(f"written to {out}")


def sizes(preset: str, source: Source) -> dict[str, Any]:
    """What the settings say of the objects and the particles."""
    components, particles = recipes.MAX_COMPONENTS, recipes.PARTICLES_PER_COMPONENT
    if preset == "objects":
        components = recipes.most_components(len(source.boxes))
        particles = recipes.PARTICLES_PER_HYPOTHESIS
    ids = None if source.truth is None else np.unique(source.truth[:, 1]).astype(int)
    return {
        "boxes": source.boxes, "ids": ids, "num_particles": particles * components,
        "max_components": components, "particles_per_component": particles,
    }  # fmt: skip


def drawn_runs(preset: str, source: Source, keys: Array) -> tuple[dict[str, Runs], Source]:
    """The filters of the preset, started at the given boxes."""
    filters = recipes.PRESETS[preset](next(iter(source.read())), source.boxes)
    runs = {name: plain_runs(filter, source, keys) for name, filter in filters.items()}
    if preset == "objects":
        by_object = lambda shots: rows_of(shots, source, keys, by_reference=True)  # noqa: E731
        runs["mpf"] = runs["mpf"]._replace(by_object=by_object)
    return runs, source


def plain_runs(filter: mpfjax.Filter, source: Source, keys: Array) -> Runs:
    """Those of a filter of boxes."""
    return Runs(
        lambda bar: track(filter, keys, source, bar), lambda shots: rows_of(shots, source, keys)
    )


def rows_of(shots: list[Snapshot], source: Source, keys: Array, **how: bool) -> list[np.ndarray]:
    """The tracks of each run."""
    return [track_rows(shots, run, source.first, **how) for run in range(len(keys))]


def detected_runs(preset: str, source: Source, keys: Array) -> tuple[dict[str, Runs], Source]:
    """The PF of the preset, started at the first detections, and the two mixtures."""
    detected = detect_all(source)
    first = next((t for t, boxes in enumerate(detected.boxes) if len(boxes)), None)
    if first is None:
        raise ValueError("--detect: nothing moves before a still camera in these frames")
    boxes = detected.boxes[first][: recipes.MAX_COMPONENTS]
    source = source._replace(boxes=boxes, num_frames=len(detected.boxes))
    still = next(frame for t, frame in enumerate(source.read()) if t == first)
    runs = {"pf": plain_runs(recipes.PRESETS[preset](still, boxes)["pf"], source, keys)}
    for name, component in make_mixtures().items():
        runs[name] = Runs(*track_detected(component, keys, source, detected))
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


if __name__ == "__main__":
    raise SystemExit(main())
