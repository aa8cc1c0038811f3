"""Part c: a colour likelihood tuned on labelled frames, and judged on other frames."""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

import mpfjax
from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.coverage import covers
from benchmarks.likelihood_tuning.labelled_boxes import boxes_around, labelled_states
from benchmarks.likelihood_tuning.soft_colours import SoftColourModel
from benchmarks.scenes import boxes_over_time, football_scene
from mpfjax.metrics.tracking_quality import intersection_area
from mpfjax.tuning import LabelLikelihood, Positive, maximise
from mpfjax.tuning.labels import transition_candidates
from mpfjax.tuning.optimisation import TuningRun
from mpfjax.vision import read_frames, read_truth
from mpfjax.vision.boxes.colour_model import BoxState

SEQUENCES = ("rendered", "otb_jogging", "vot_basketball")
LAST_FRAME = {"rendered": 120, "otb_jogging": 307, "vot_basketball": 300}
FILTERS = ("pf", "mpf")
NUM_PARTICLES, MAX_COMPONENTS = 100, 5
NUM_BINS, NUM_POINTS, NUM_PARTS = 16, 8, 2
# Of the random walk, in widths and heights of the box, and of its scales.
STEPS = (0.25, 0.08, 0.01, 0.01)
# From the dynamics, over the neighbourhood, and on the label in other sizes, so many of each.
CANDIDATES, NEAR = 16, 0.2
FRAMES_A_STEP = 8
RATE = 0.03
KINDS = ("first", "last", "tuned")
LEGENDS = ("reference of the first frame", "of the last labelled frame", "tuned")


class Labelled(NamedTuple):
    """Consecutive frames with the true boxes of k objects, (x, y, w, h) of (t, k, 4)."""

    frames: np.ndarray
    boxes: np.ndarray


def read_labelled(name: str, seed: int) -> Labelled:
    """The scene, or the first frames of a sequence; `FileNotFoundError` where it is absent."""
    last = LAST_FRAME[name]
    if name == "rendered":
        scene = football_scene(jax.random.key(seed), last)
        frames, rows = scene.frames, scene.tracks
        ids = [id for id, kit in scene.kits.items() if kit == 0]
    else:
        folder = Path(os.environ.get("MPFJAX_DATA", "../shared/data")) / name
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: no such sequence")
        frames = np.stack(list(read_frames(folder, 1, last)))
        rows = read_truth(folder / "gt.txt").objects
        ids = sorted({int(id) for id in rows[rows[:, 0] <= last, 1]})
    return Labelled(frames, boxes_over_time(rows, ids, 1, last))


def untuned_model(labelled: Labelled, template: int) -> SoftColourModel:
    """References from the frame `template`, σ = 0.15 as in the paper; x_0 in the last frame."""

    def learn(frame: np.ndarray, boxes: np.ndarray) -> SoftColourModel:
        size = np.concatenate([boxes[:, 2:], np.ones_like(boxes[:, 2:])], axis=1)
        return SoftColourModel.from_frame(
            frame, boxes, num_bins=NUM_BINS, num_points=NUM_POINTS, num_parts=NUM_PARTS,
            deviations=size * np.array(STEPS),
        )  # fmt: skip

    looks = learn(labelled.frames[template], labelled.boxes[template]).reference_logits
    model = learn(labelled.frames[-1], labelled.boxes[-1])
    return eqx.tree_at(lambda m: m.reference_logits, model, looks)


def tune(key: Array, model: SoftColourModel, labelled: Labelled, num_steps: int) -> TuningRun:
    """λ, the bandwidth and the references, by the conditional likelihood of the labels."""
    key_drawn, key_around, key_near, key_refined = jax.random.split(key, 4)
    states = labelled_states(model, labelled.boxes)
    present = jax.tree.map(lambda leaf: leaf[1:], states)
    rivals = jax.tree.map(
        lambda *leaves: jnp.concatenate(leaves, axis=2),
        transition_candidates(key_drawn, model, states, CANDIDATES),
        boxes_around(key_around, model, present, CANDIDATES),
        boxes_around(key_near, model, present, CANDIDATES, reach=NEAR),
    )
    frames = jnp.asarray(labelled.frames[1:])
    objective = LabelLikelihood(frames, present, rivals, min(FRAMES_A_STEP, len(frames)))
    parameters = {
        "lambda": lambda m: m.lambda_,
        "bandwidth": lambda m: m.bandwidth,
        "references": lambda m: m.reference_logits,
    }
    return maximise(
        key_refined, objective, model, optax.adam(optax.cosine_decay_schedule(RATE, num_steps)),
        num_steps, parameters=parameters,
        transforms={"lambda": Positive(), "bandwidth": Positive()}, progress=False,
    )  # fmt: skip


def filters_of(size: np.ndarray) -> dict[str, Callable[[SoftColourModel], mpfjax.Filter]]:
    """Both filters of one object, as functions of its model."""
    where: dict[str, Any] = {"features": centre, "scale": tuple(size.tolist())}

    def mixture(model: SoftColourModel) -> mpfjax.Filter:
        regroup = [
            mpfjax.Merge(None, 0.5, **where),
            mpfjax.Split(4.0, 0.5, min_share=0.15, **where),
            mpfjax.KMeans(5, **where),
        ]
        return mpfjax.mixture_particle_filter(
            model, NUM_PARTICLES, MAX_COMPONENTS, regroup=regroup, **where
        )

    return {"pf": lambda model: mpfjax.particle_filter(model, NUM_PARTICLES), "mpf": mixture}


def centre(states: BoxState) -> Array:
    """What boxes are grouped by."""
    return states.box[:, :2]


@eqx.filter_jit
def follow(
    build: Callable[[SoftColourModel], mpfjax.Filter],
    model: SoftColourModel,
    keys: Array,
    frames: Array,
) -> Array:
    """The heaviest component's mean box in every frame, (runs, t, k, 4), each object on its own."""

    def of_one(model: SoftColourModel, key: Array) -> Array:
        model = jax.tree.map(lambda leaf: leaf if leaf.ndim == 0 else leaf[None], model)

        def place(mixture: mpfjax.ParticleMixture) -> Array:
            means = mixture.component_averages(model.boxes(mixture.particles))
            mean = means[jnp.argmax(mixture.log_mixture_weights)]
            return jnp.concatenate([mean[:2] - 0.5 * mean[2:], mean[2:]])

        return mpfjax.run_filter(key, build(model), frames, place).collected

    per_object = jax.tree.map(lambda leaf: None if leaf.ndim == 0 else 0, model)
    k = model.reference_boxes.shape[0]
    of_all = eqx.filter_vmap(of_one, in_axes=(per_object, 0), out_axes=1)
    return jax.lax.map(lambda key: of_all(model, jax.random.split(key, k)), keys)


def overlaps(estimates: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Intersection over union of boxes, (runs, t, k)."""
    common = np.asarray(intersection_area(jnp.asarray(estimates), jnp.asarray(truth[None])), float)
    union = np.prod(estimates[..., 2:], axis=-1) + np.prod(truth[None, ..., 2:], axis=-1) - common
    return common / union


def covered(estimates: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Whether each box covers its object, (runs, t, k)."""
    pairs = [
        [covers(boxes, true).diagonal() for boxes, true in zip(run, truth, strict=True)]
        for run in estimates
    ]
    return np.array(pairs, float)


def run_labels(
    sequences: Sequence[str], runs: int, steps: int, seed: int, settings: dict[str, Any], out: Path
) -> None:
    """Tune and judge on every sequence that there is."""
    results: list[dict[str, Any]] = []
    panels: list[tuple[str, dict[str, np.ndarray], int]] = []
    for (name,) in harness.grid("sequence", sequences):
        try:
            labelled = read_labelled(name, seed)
        except FileNotFoundError as error:
            print(f"{name} left out: {error}", file=sys.stderr)
            continue
        entries, curves, first = judge(name, labelled, runs, steps, seed)
        results += entries
        named: dict[str, np.ndarray] = dict(
            zip(LEGENDS, (curves[kind] for kind in KINDS), strict=True)
        )
        panels.append((f"{name}, {FILTERS[-1].upper()}", named, first))
        harness.data(out / "labels.json", settings=settings, results=results)
    if not results:
        raise FileNotFoundError("--sequences: none of them is there")
    rows = [
        entry | {"measure": measure, **entry[measure]}
        for entry in results
        for measure in ("coverage", "overlap")
    ]
    columns: dict[str, Any] = {"sequence": "{sequence}", "filter": "{filter}", "": "{measure}"}
    titles = ("first frame's", "last frame's", "tuned")
    for title, kind in zip(titles, KINDS, strict=True):
        columns[title] = f"{{{kind}[0]:.3f}} ± {{{kind}[1]:.3f}}"
    for kind in ("first", "last"):
        columns[f"than {kind}"] = lambda row, kind=kind: verdict(*row[f"gain_over_{kind}"])
    print(harness.table(columns, rows))
    print("References of the first and of the last labelled frame, and tuned from the first;")
    print("held-out frames, mean ± standard error over runs; better or worse by two of them.")
    harness.figures(out, overlaps=plotting.draw_overlaps(panels))


def judge(
    name: str, labelled: Labelled, runs: int, steps: int, seed: int
) -> tuple[list[dict[str, Any]], dict[str, np.ndarray], int]:
    """Entries of the results, the MPF's overlap over frames, and the first held-out frame."""
    half = len(labelled.frames) // 2
    seen = Labelled(labelled.frames[:half], labelled.boxes[:half])
    key_tuning, key_runs = jax.random.split(jax.random.key(seed))
    first, last = untuned_model(seen, 0), untuned_model(seen, -1)
    run = tune(key_tuning, first, seen, steps)
    models = dict(zip(KINDS, (first, last, run.model), strict=True))
    frames, truth = jnp.asarray(labelled.frames[half:]), labelled.boxes[half:]
    keys = jax.random.split(key_runs, runs)
    builders = filters_of(seen.boxes[-1, :, 2:].mean(axis=0))
    optimisation = {
        "lambda": [float(first.lambda_), float(run.model.lambda_)],
        "bandwidth": [float(first.bandwidth), float(run.model.bandwidth)],
        "label_log_posterior": run.history["value"].round(4).tolist(),
        "references": {
            kind: np.asarray(model.references, float).round(4).tolist()
            for kind, model in models.items()
        },
    }
    entries: list[dict[str, Any]] = []
    curves: dict[str, np.ndarray] = {}
    for filter in FILTERS:
        scores = {}
        for kind, model in models.items():
            estimates = np.asarray(follow(builders[filter], model, keys, frames), float)
            overlap = overlaps(estimates, truth)
            scores[kind] = {"coverage": covered(estimates, truth), "overlap": overlap}
            curves[kind] = overlap.mean(axis=2)
        entry = {"sequence": name, "filter": filter, "first_frame": half + 1}
        entry |= compare_scores(scores)
        entry["overlap_by_frame"] = {
            kind: values.mean(axis=0).round(4).tolist() for kind, values in curves.items()
        }
        entries.append(entry | optimisation)
    return entries, curves, half + 1


def compare_scores(scores: dict[str, dict[str, np.ndarray]]) -> dict[str, Any]:
    """Means over runs with their standard errors, and those of the gains, run by run."""
    compared: dict[str, Any] = {}
    for measure in ("coverage", "overlap"):
        means = {kind: scores[kind][measure].mean(axis=(1, 2)) for kind in KINDS}
        for kind in ("first", "last"):
            means[f"gain_over_{kind}"] = means["tuned"] - means[kind]
        compared[measure] = {kind: harness.mean_and_error(values) for kind, values in means.items()}
    return compared


def verdict(gain: float, error: float) -> str:
    """Whether a gain is more than twice its standard error."""
    if abs(gain) <= 2 * error:
        return "no difference"
    return "better" if gain > 0 else "worse"
