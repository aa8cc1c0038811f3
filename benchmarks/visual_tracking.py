"""Section 5.2 of Vermaak et al. (2003): the PF against the MPF on several look-alike objects.

    python -m benchmarks.visual_tracking                                  # a rendered scene
    python -m benchmarks.visual_tracking --sequence DIR --ids 2 3 4       # frames with gt.txt
    python -m benchmarks.visual_tracking --video FILE --box 10,20,30,60 --box 80,25,30,60
    python -m benchmarks.visual_tracking --sequence DIR --detect          # nobody draws a box

Both filters have the same model and the same particles at the start: 200 for the PF, at most 10
components of 20 for the MPF. Into --out DIR go an annotated video, a contact sheet as the paper's
figure 3, the tracks in MOTChallenge form, and the scores, null where there is no truth. With
--detect, for a camera that stands still, objects are found by background subtraction: the PF
starts at those of the first frame that has any, and in the MPF and the GM-MPF a component is born
for every new one and dies when its object is gone (Lin et al. 2012, section 5).
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

import mpfjax
from benchmarks.arguments import seed, whole
from benchmarks.detected_tracking import detect_all, make_trackers, track_detected
from benchmarks.results import exit_status, format_table, write_json
from benchmarks.tracking_pictures import (
    NAMES,
    Snapshot,
    Source,
    write_contact_sheet,
    write_video,
)
from mpfjax.metrics import multi_object_scores
from mpfjax.metrics.coverage import coverage, covers
from mpfjax.vision import boxes as box_files
from mpfjax.vision import frames
from mpfjax.vision.colour_model import BoxState, ColourModel
from mpfjax.vision.colours import RGBColours
from mpfjax.vision.object_moves import ObjectExclusion, PruneHypotheses
from mpfjax.vision.scenes import football_scene

NUM_PARTICLES, MAX_COMPONENTS, PARTICLES_PER_COMPONENT = 200, 10, 20


# --- the presets --------------------------------------------------------------------------


def paper_filters(frame: np.ndarray, boxes: np.ndarray) -> dict[str, mpfjax.Filter]:
    """The model with the paper's parameters; the rest of the MPF in units of the mean box."""
    model = ColourModel.from_frame(frame, boxes, sigma=0.15, deviations=None, share_reference=True)
    where: dict[str, Any] = {"features": _centre, "scale": boxes[:, 2:].mean(axis=0)}
    mixture = mpfjax.mixture_particle_filter(
        model,
        NUM_PARTICLES,
        MAX_COMPONENTS,
        particles_per_component=PARTICLES_PER_COMPONENT,
        merge=mpfjax.Merge(None, 0.5, **where),
        split=mpfjax.Split(4.0, 0.5, min_share=0.15, **where),
        kmeans=mpfjax.KMeans(5, **where),
    )
    return {"pf": mpfjax.particle_filter(model, NUM_PARTICLES), "mpf": mixture}


def default_filters(frame: np.ndarray, boxes: np.ndarray) -> dict[str, mpfjax.Filter]:
    """The recipe that covers most on real video: any component may come to stand for any object.

    A particle is compared with one of the given boxes, and now and then with another, and takes a
    long step now and then; components exclude each other, part where they straddle two places,
    and merge only after ten frames on the same one.
    """
    size = boxes[:, 2:].mean(axis=0)
    steps = _steps(boxes)
    model = _own_references(
        frame,
        boxes,
        colours=RGBColours(16),
        sigma=0.2,
        num_parts=8,
        contrast=0.25,
        switch_probability=0.05,
        dynamics=mpfjax.RandomWalkWithJumps(steps, steps * np.array([6.0, 6.0, 1.0, 1.0]), 0.05),
    )
    where: dict[str, Any] = {"features": _centre, "scale": size}
    moves = [
        mpfjax.Exclusion(strength=4.0, radius=0.5, **where),
        mpfjax.Merge(None, 0.25, patience=10, **where),
        mpfjax.Split(4.0, 0.5, min_share=0.15, **where),
    ]
    return _started_at_the_boxes(model, moves, size)


def objects_filters(frame: np.ndarray, boxes: np.ndarray) -> dict[str, mpfjax.Filter]:
    """The recipe with the fewest strays and swaps: every component keeps to its object.

    Every particle carries which box it was started from and is compared with that one alone, so
    that the components of an object are rival hypotheses about it: only those merge, a component
    splits where they part, and those that came to nothing are pruned. Objects exclude each other.
    """
    size = boxes[:, 2:].mean(axis=0)
    model = _own_references(frame, boxes, sigma=0.15, num_parts=5, contrast=0.25)
    apart = _apart(size)
    moves = [
        ObjectExclusion(strength=3.0, radius=0.5, scale=(float(size[0]), float(size[1]))),
        mpfjax.Merge(None, 0.25, patience=10, **apart),
        PruneHypotheses(least_share=1e-6),
        mpfjax.Split(4.0, 0.5, min_share=0.15, **apart),
    ]
    return _started_at_the_boxes(model, moves, size)


def _own_references(frame: np.ndarray, boxes: np.ndarray, **options: Any) -> ColourModel:
    return ColourModel.from_frame(
        frame, boxes, deviations=_steps(boxes), weigh_colours=True, **options
    )


def _steps(boxes: np.ndarray) -> np.ndarray:
    """Deviations of the random walk: 0.4 widths and 0.08 heights of each box, sizes hardly any."""
    still = np.full(len(boxes), 0.01)
    return np.stack([0.4 * boxes[:, 2], 0.08 * boxes[:, 3], still, still], axis=1)


def _started_at_the_boxes(
    model: ColourModel, moves: list[mpfjax.AbstractMove], size: np.ndarray
) -> dict[str, mpfjax.Filter]:
    """Both filters; the mixture starts with one component for each box."""
    mixture = mpfjax.Filter(
        model,
        moves=[
            mpfjax.Resample(particles_per_component=PARTICLES_PER_COMPONENT),
            mpfjax.Propagate(model),
            *moves,
        ],
        num_particles=NUM_PARTICLES,
        num_components=MAX_COMPONENTS,
        initial_moves=[
            mpfjax.KMeans(10, reseed=True, **_apart(size)),
            mpfjax.Merge(None, 0.5, features=_reference),
        ],
    )
    return {"pf": mpfjax.particle_filter(model, NUM_PARTICLES), "mpf": mixture}


def _apart(size: np.ndarray) -> dict[str, Any]:
    """Features by which particles of different references are never near each other."""
    return {"features": _centre_and_reference, "scale": (*size, 1e-5)}


PRESETS = {
    "default": default_filters,
    "objects": objects_filters,
    "paper": paper_filters,
}


def _centre(states: BoxState) -> Array:
    return states.box[:, :2]


def _reference(states: BoxState) -> Array:
    return states.reference[:, None].astype(states.box.dtype)


def _centre_and_reference(states: BoxState) -> Array:
    return jnp.concatenate([_centre(states), _reference(states)], axis=1)


# --- tracking ---------------------------------------------------------------------------------


def track(
    filter: mpfjax.Filter, keys: Array, stills: Iterable[np.ndarray], bar: tqdm
) -> Iterator[tuple[Snapshot, float]]:
    """Run a filter online, once for each key, and yield each frame's snapshot and seconds."""
    mixtures = jax.vmap(filter.init)(keys)
    for t, still in enumerate(stills):
        start = time.perf_counter()
        step = jnp.asarray(t)  # an array, since a new Python number would compile anew
        mixtures, snapshot = _advance(filter, keys, step, mixtures, jnp.asarray(still))
        snapshot = jax.tree.map(np.asarray, snapshot)
        bar.update()
        yield snapshot, time.perf_counter() - start


@eqx.filter_jit
def _advance(filter, keys, t, mixtures, frame):
    def step(key, mixture):
        mixture, _ = filter.step(jax.random.fold_in(key, t), mixture, frame)
        places = filter.model.boxes(mixture.particles)
        labels = jnp.where(mixture.occupied, mixture.component_indicators, -1)
        means = mixture.component_averages(places)
        return mixture, Snapshot(means, mixture.active, places[:, :2], labels)

    # The frame is not mapped over, so that its histogram is built once for all runs.
    return jax.vmap(step)(keys, mixtures)


def track_rows(snapshots: list[Snapshot], run: int, first: int) -> np.ndarray:
    """Rows (frame, id, x, y, w, h) of one run: an id for each life of each component."""
    rows, alive, next_id = [], {}, 1
    for frame, snapshot in enumerate(snapshots, first):
        for m, (mean, active) in enumerate(
            zip(snapshot.means[run], snapshot.active[run], strict=True)
        ):
            if not active:
                alive.pop(m, None)
                continue
            if m not in alive:
                alive[m], next_id = next_id, next_id + 1
            rows.append([frame, alive[m], *box_files.top_left(mean[None])[0]])
    # Rounded as the file is, so that scores from the file are the scores.
    return np.round(np.array(rows).reshape(-1, 6), 3)


def score(
    name: str, tracks: list[np.ndarray], num_frames: int, seconds: list[float], source: Source
) -> dict[str, Any]:
    """One entry of the results: means over the runs' tracks, null where there is no truth."""
    result = {"filter": name, "all_covered": None, "per_object": None, "on_object": None}
    result |= {"id_swaps": None, "ms_per_frame": _milliseconds(seconds)}
    truth = source.truth
    if truth is not None:
        truth = truth[truth[:, 0] < source.first + num_frames]
    if truth is None or len(truth) == 0:
        return result
    scores = [coverage(rows, truth) for rows in tracks]
    result["all_covered"] = _mean([s.all_covered for s in scores])
    result["per_object"] = {
        str(id): _mean([s.per_object[id] for s in scores]) for id in scores[0].per_object
    }
    result["id_swaps"] = _mean([s.id_swaps for s in scores])
    if source.all_labelled:
        result["on_object"] = _mean([s.on_object for s in scores])
    return result


def _mean(values: list[float]) -> float:
    return float(np.mean(values))


def _milliseconds(seconds: list[float]) -> float:
    """The median over the frames but the first, which compiles."""
    return 1000 * float(np.median(seconds[1:] or seconds))


# --- the command line -------------------------------------------------------------------------


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


def open_source(options: argparse.Namespace) -> Source:
    """The frames and the objects, or a `ValueError` that names the argument."""
    first, last = frames.parse_range(options.frames, "--frames")
    if options.sequence is None and options.video is None:
        return _rendered(options, first, last)
    path = options.sequence or options.video
    name = "--sequence" if options.sequence else "--video"
    if options.sequence is not None and not path.is_dir():
        raise ValueError(f"--sequence: {path} is not a folder")
    if options.video is not None and not path.is_file():
        raise ValueError(f"--video: {path} is not a file")
    still = next(frames.read_frames(path, first, first), None)
    if still is None:
        raise ValueError(f"{name}: {path} has no frame {first}")
    count = None
    if options.sequence is not None:
        count = min(last or 10**9, frames.num_images(path)) - first + 1
    elif last is not None:
        count = last - first + 1
    truth_path = path / "gt.txt"
    rows = box_files.read_tracks(truth_path) if truth_path.is_file() else None
    read = lambda: frames.read_frames(path, first, last)  # noqa: E731
    return _with_objects(options, str(path), read, first, last, count, rows, still)


def _rendered(options: argparse.Namespace, first: int, last: int | None) -> Source:
    num_frames = last or max(first + 119, 120)
    key = jax.random.key(options.seed)
    scene = football_scene(key, num_frames, still_camera=options.detect)
    stills = scene.frames[first - 1 :]
    if options.ids is None:
        options.ids = [id for id, kit in scene.kits.items() if kit == 0]
    return _with_objects(
        options, "rendered scene", lambda: stills, first, last, len(stills), scene.tracks, stills[0]
    )


def _with_objects(options, name, read, first, last, count, rows, still) -> Source:
    """Settle which objects are started where, and which are scored."""
    if rows is not None:
        rows = rows[(rows[:, 0] >= first) & (rows[:, 0] <= (last or np.inf))]
    if options.detect:
        return Source(name, read, first, count, np.zeros((0, 4)), rows, rows is not None)
    started = {} if rows is None else box_files.boxes_of_frame(rows, first)
    if options.box is not None:
        boxes = np.stack([box_files.parse_box(text, "--box") for text in options.box])
        ids = [id for id, box in started.items() if covers(boxes, box[None]).any()]
        argument = "--box"
    else:
        ids, argument = _chosen_ids(options, started, rows, first), "--ids"
        boxes = np.stack([started[id] for id in ids])
    if len(boxes) > MAX_COMPONENTS:
        raise ValueError(f"{argument}: {len(boxes)} objects are more than {MAX_COMPONENTS}")
    box_files.check_boxes(boxes, still.shape[0], still.shape[1], argument)
    truth = rows[np.isin(rows[:, 1], ids)] if rows is not None and ids else None
    return Source(name, read, first, count, boxes, truth, len(ids) == len(boxes))


def _chosen_ids(options, started: dict, rows: np.ndarray | None, first: int) -> list[int]:
    if rows is None:
        raise ValueError("--box: without a gt.txt every object needs its box in the first frame")
    ids = sorted(started) if options.ids is None else list(dict.fromkeys(options.ids))
    missing = [id for id in ids if id not in started]
    if missing or not ids:
        raise ValueError(f"--ids: gt.txt has no box of {missing or 'any object'} in frame {first}")
    return ids


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
                result = score(name, tracks, len(tracked[name]), seconds, source)
                if options.detect:
                    result |= _tracking_scores(tracks, source, len(tracked[name]))
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
        lambda bar: track(filter, keys, source.read(), bar),
        lambda snapshots: [track_rows(snapshots, run, source.first) for run in range(len(keys))],
    )


def _detected_runs(options, source: Source, keys: Array) -> tuple[dict[str, Any], Source]:
    """The PF of the preset, started at the first detections, and the two trackers."""
    detected = detect_all(source)
    first = next((t for t, boxes in enumerate(detected.boxes) if len(boxes)), None)
    if first is None:
        raise ValueError("--detect: nothing moves before a still camera in these frames")
    boxes = detected.boxes[first][:MAX_COMPONENTS]
    source = source._replace(boxes=boxes, num_frames=len(detected.boxes))
    still = next(frame for t, frame in enumerate(source.read()) if t == first)
    filter = PRESETS[options.preset](still, boxes)["pf"]
    runs: dict[str, Any] = {"pf": _plain_run(filter, source, keys)}
    for name, tracker in make_trackers(detected).items():
        runs[name] = track_detected(tracker, keys, source, detected)
    return runs, source


def _tracking_scores(tracks: list[np.ndarray], source: Source, num_frames: int) -> dict[str, Any]:
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


def _write_scores(options, source: Source, num_frames: int, results) -> None:
    settings = {
        "source": source.name,
        "preset": options.preset,
        "detect": options.detect,
        "frames": [source.first, source.first + num_frames - 1],
        "boxes": source.boxes.tolist(),
        "ids": None if source.truth is None else np.unique(source.truth[:, 1]).astype(int).tolist(),
        "seed": options.seed,
        "seeds": options.seeds,
        "num_particles": NUM_PARTICLES,
        "max_components": MAX_COMPONENTS,
        "particles_per_component": PARTICLES_PER_COMPONENT,
    }
    write_json(options.out / "visual_tracking.json", {"settings": settings, "results": results})


def table(results: list[dict[str, Any]]) -> str:
    """The results as text."""
    columns = {
        "all_covered": "all covered",
        "on_object": "on object",
        "id_swaps": "id swaps",
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


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    # Writing a video starts an encoder, whose fork and exec JAX's threads do not touch.
    warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called")
    return exit_status(lambda: run(parse_arguments(arguments)))


if __name__ == "__main__":
    sys.exit(main())
