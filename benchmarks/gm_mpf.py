"""Lin et al. (2012), figures 1 and 2, and table 1: PF, GPF, MPF and GM-MPF on two targets.

    python -m benchmarks.gm_mpf                       # pets09_s2l1, or a rendered scene
    python -m benchmarks.gm_mpf --sequence DIR --ids 3 5 --frames 1:80

All four have the same model and start from the same boxes: HSV histograms (eqs. 1 to 3) and
second-order dynamics (eq. 4); boxes are cut into three bands and colours weighed against the
surround, as the paper does not, since a whole box's histogram loses small pedestrians to the
pavement whatever the filter. Those with one component hold both targets in it; the mixtures have
one component for each target, which never meet but in their weights, as the paper's intervals.
Into --out DIR go gm_mpf.json and particle_migration.png.
"""

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import mpfjax
from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.coverage import REACH
from benchmarks.harness import AtLeast2, Count, Natural, Seed, command
from benchmarks.scenes import boxes_over_time, football_scene
from mpfjax.vision import read_truth
from mpfjax.vision.boxes.colour_model import BoxState, ColourModel
from mpfjax.vision.colour import HSVColours
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files import drawing, frames

NAMES = {"pf": "PF", "gpf": "GPF", "mpf": "MPF", "gm_mpf": "GM-MPF"}
TIMED_PARTICLES, WARM_UP = 1000, 5
TIMES = {
    "filter": "{name}", "ms a frame": "{mean:.3f} ± {std:.3f}",
    "ratio of means": "{of_means:.3f}", "of medians": "{of_medians:.3f}",
}  # fmt: skip
COLUMNS = {
    "filter": "{name}, N = {particles}",
    "RMSE 1 [px]": "{rmse[0]:.2f} ± {rmse_std[0]:.2f}",
    "RMSE 2 [px]": "{rmse[1]:.2f} ± {rmse_std[1]:.2f}",
    "1 from the reference": "{monte_carlo_error[0]:.2f}",
    "2 from the reference": "{monte_carlo_error[1]:.2f}",
    "both held": "{both_held:.2f}",
    "N_eff": "{n_eff:.1f}",
}


@command(frames="129:140", particles=[20], seeds=2, timed=5, reference=200)
def main(
    *,
    sequence: Path | None = None,
    ids: tuple[Natural, Natural] | None = None,
    frames: str | None = None,
    filters: Sequence[Annotated[str, (*NAMES,)]] = (*NAMES,),
    particles: Sequence[AtLeast2] = (100, 200, 300),
    seeds: Count = 20,
    timed: Count = 50,
    reference: AtLeast2 = 5000,
    seed: Seed = 0,
    out: Path = Path("results/gm_mpf"),
) -> None:
    """The times, then the study; results are written as soon as they are there.

    - `sequence`: a folder with img/ and gt.txt.
    - `ids`: two objects of gt.txt.
    - `frames`: A:B, frames A to B, counted from 1, both in.
    - `timed`: steps of each filter.
    - `reference`: particles, in four runs, of the filter that errors are measured from.
    """
    targets = open_targets(sequence, ids, frames, seed)
    # In the order of the table, the PF first: the others are measured against it.
    names = [name for name in NAMES if name in filters]
    last = targets.first + len(targets.stills) - 1
    settings = harness.settings_of(
        {"source": targets.name, "seeds": seeds, "seed": seed, "frames": [targets.first, last]}
    )
    timing = times_of(filters_in_turns(targets, seed, names, timed), timed)
    print(f"time with colour histograms, {TIMED_PARTICLES} particles (table 1)")
    print(harness.table(TIMES, timing))
    # What each mixture has with a great many particles, E(x_t | y_1..y_t), (t, 2 targets, 2): the
    # distance from it is what more particles can mend, and the rest of the distance from the true
    # box is the model's, or the annotation's.
    limits = {name: run_filter(name, reference, targets, seed + 1, 4).estimates.mean(axis=0)
           for name in names if name in ("mpf", "gm_mpf")}  # fmt: skip
    results: list[dict[str, Any]] = []
    steps: dict[str, Step] = {}
    for name, size in harness.grid("study", names, particles):
        step = run_filter(name, size, targets, seed, seeds)
        steps.setdefault(name, step)
        # Section 5: the mean over frames of the distance between the estimate and the target.
        errors = errors_of(step.estimates, targets.truth[:, :, :2])
        results.append({
            "filter": name, "name": NAMES[name], "particles": size, "rmse": errors.mean(axis=0),
            "rmse_std": errors.std(axis=0), "both_held": held(step, targets.truth).mean(),
            "n_eff": step.effective_sample_size.mean(),
        })  # fmt: skip
        if name in limits:
            errors = errors_of(step.estimates, limits[name])
            results[-1]["monte_carlo_error"] = errors.mean(axis=0)
        content = {"timing": timing, "results": results}
        harness.data(out / "gm_mpf.json", settings=settings, **content)
    print(f"\ntwo targets of {targets.name}, {seeds} seeds; the reference has N = {reference}")
    print(harness.table(COLUMNS, results))
    harness.figures(out, dpi=130, particle_migration=draw_migration(steps, targets))
    print(f"written to {out}")


# --- targets, models and filters ----------------------------------------------------------------


class Targets(NamedTuple):
    """Frames and two targets in them."""

    name: str
    stills: np.ndarray  # (t, h, w, 3)
    first: int  # the number of the first frame
    truth: np.ndarray  # (t, 2, 4), centre and size of each target's true box


def open_targets(
    sequence: Path | None, ids: Sequence[int] | None, span: str | None, seed: int
) -> Targets:
    """The sequence asked for, or pets09_s2l1, or a rendered scene where there is no data.

    The folder of sequences is the one that MPFJAX_DATA names, or ../shared/data. In the rendered
    scene two players of a team change places before a camera that stands still.
    """
    data = Path(os.environ.get("MPFJAX_DATA", "../shared/data")) / "pets09_s2l1"
    if sequence is None and data.is_dir():
        sequence, ids, span = data, ids or (11, 13), span or "129:199"
    first, last = frames.parse_range(span)
    if sequence is None:
        scene = football_scene(jax.random.key(seed), last or 80, num_players=2, still_camera=True)
        name, rows, stills = "rendered scene", scene.tracks, scene.frames[first - 1 :]
    else:
        name, rows = sequence.name, read_truth(sequence / "gt.txt").objects
        stills = np.stack(list(frames.read_frames(sequence, first, last)))
    ids = ids or sorted({int(row[1]) for row in rows if row[0] == first})[:2]
    boxes = boxes_over_time(rows, ids, first, len(stills))
    for t, target in np.argwhere(np.isnan(boxes).any(axis=2)):
        raise ValueError(f"--ids: object {ids[target]} has no box in frame {first + t}")
    truth = box_files.to_centre(boxes.reshape(-1, 4)).reshape(boxes.shape)
    return Targets(name, stills, first, truth)


def make_model(targets: Targets) -> ColourModel:
    """HSV histograms and second-order dynamics for the two boxes of the first frame.

    A step deviates by shares of the boxes' widths and heights, and of the sizes' scales.
    """
    still, boxes = targets.stills[0], box_files.top_left(targets.truth[0])
    deviations = np.array([[0.12, 0.04, 0.01, 0.01]]) * np.concatenate(
        [boxes[:, 2:], np.ones_like(boxes[:, 2:])], axis=1
    )
    each = [mpfjax.Autoregression.with_momentum(0.5, jnp.asarray(row)) for row in deviations]
    dynamics = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return ColourModel.from_frame(
        still, boxes, colours=HSVColours(), sigma=0.1, num_parts=3, weigh_colours=True,
        deviations=deviations, dynamics=dynamics,
    )  # fmt: skip


def make_filter(name: str, model: ColourModel, num_particles: int) -> mpfjax.Filter:
    """One of {one component, two} x {resample, Gaussian regeneration}."""
    redraw = mpfjax.GaussianRegeneration(where=motion) if "g" in name else mpfjax.Resample()
    moves = [redraw, mpfjax.Propagate()]
    if name in ("pf", "gpf"):
        return mpfjax.Filter(model, moves, num_particles)
    one_each = [
        mpfjax.KMeans(10, reseed=True, features=_reference),
        mpfjax.Merge(None, max_distance=0.5, features=_reference),
    ]
    return mpfjax.Filter(model, moves, num_particles, 2, one_each)


def motion(states: BoxState) -> tuple[Array | None, ...]:
    return states.box, states.previous


def _reference(states: BoxState) -> Array:
    return states.reference[:, None].astype(states.box.dtype)


# --- what is kept of every run, and what is measured of it --------------------------------------


class Step(NamedTuple):
    """What is kept of each frame of a run."""

    estimates: Any  # (2, 2), the centre of the component that stands for each target
    effective_sample_size: Any  # eq. 14, summed over the components
    centres: Any  # (n, 2), of the particles' boxes
    target: Any  # (n,), the reference of each particle


class Collect(eqx.Module):
    """Reduces a mixture to a `Step`: a target's component is the one that its particles started.

    A filter of one component has the same estimate of both targets.
    """

    model: ColourModel

    def __call__(self, mixture: mpfjax.ParticleMixture) -> Step:
        """What is kept of one frame."""
        means = mixture.component_expectations(self.model.boxes(mixture.particles))[:, :2]
        owners = mixture.component_expectations(mixture.particles.reference.astype(means.dtype))
        swapped = (mixture.num_components == 2) & (owners[0] > owners[-1])
        ends = jnp.stack([means[0], means[-1]])
        return Step(
            jnp.where(swapped, ends[::-1], ends),
            jnp.sum(mixture.component_effective_sample_sizes),
            mixture.particles.box[:, :2],
            mixture.particles.reference,
        )


def errors_of(estimates: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The mean distance in pixels of each run's estimates (runs, t, 2, 2) from (t, 2, 2)."""
    return np.linalg.norm(estimates - truth, axis=-1).mean(axis=1)


def held(step: Step, truth: np.ndarray) -> np.ndarray:
    """Whether each run keeps both targets: in each of the last ten frames the particles that stand
    for a target and lie on it are at least a tenth of its equal share, which is half of all.
    """
    gaps = np.abs(step.centres[:, :, None] - truth[None, :, :, None, :2])
    near = (gaps < np.array(REACH) * truth[None, :, :, None, 2:]).all(axis=-1)
    is_target = step.target[:, :, None] == np.arange(2)[None, None, :, None]
    shares = 2 * (near & is_target).mean(axis=-1)
    return (shares[:, -10:] >= 0.1).all(axis=(1, 2))


def run_filter(name: str, size: int, targets: Targets, seed: int, num_seeds: int) -> Step:
    """What is kept of the runs of a filter, all under one vmap."""
    model, keys = make_model(targets), jax.random.split(jax.random.key(seed), num_seeds)
    filter, stills = make_filter(name, model, size), jnp.asarray(targets.stills)
    run = mpfjax.monte_carlo(keys, filter, stills, Collect(model))
    return jax.tree.map(np.asarray, run.collected)


# --- times of the filters, in turns --------------------------------------------------------------


def filters_in_turns(
    targets: Targets, seed: int, names: Sequence[str], timed: int
) -> dict[str, Callable[[int], Any]]:
    """A step of each filter with 1000 particles, on the next frame in each turn."""
    model, key = make_model(targets), jax.random.key(seed)
    filters = {NAMES[name]: make_filter(name, model, TIMED_PARTICLES) for name in names}
    stills = [jnp.asarray(still) for still in targets.stills]
    mixtures = {name: filter.init(key) for name, filter in filters.items()}
    keys = jax.block_until_ready(jax.random.split(key, WARM_UP + timed))

    def advance(name: str, turn: int) -> Any:
        still = stills[turn % len(stills)]
        mixtures[name], _ = filters[name].step(keys[turn], mixtures[name], still)
        return mixtures[name]

    return {name: partial(advance, name) for name in filters}


def times_of(runs: dict[str, Callable[[int], Any]], timed: int) -> list[dict[str, Any]]:
    """Milliseconds of each run, taken in turns, and ratios to the first."""
    times_by_name = harness.turns(runs, timed, warm_up=WARM_UP)
    first = next(iter(times_by_name.values()))
    return [
        {
            "name": name, "mean": 1000 * times.mean(), "std": 1000 * times.std(),
            "median": 1000 * float(np.median(times)), "of_means": times.mean() / first.mean(),
            "of_medians": np.median(times) / np.median(first),
        }
        for name, times in times_by_name.items()
    ]  # fmt: skip


# --- figures ------------------------------------------------------------------------------------


def draw_migration(fewest: dict[str, Step], targets: Targets) -> Any:
    """Figures 1 and 2: where the particles of one run are, in the colour of their target.

    Four frames, among them the first, the one in which the targets are closest, and the last,
    cropped to where both are.
    """
    gaps = np.linalg.norm(targets.truth[:, 0, :2] - targets.truth[:, 1, :2], axis=1)
    closest, last = int(np.argmin(gaps)), len(gaps) - 1
    middle = closest // 2 if 2 * closest > last else (closest + last) // 2
    chosen = sorted({0, middle, closest, last})
    boxes = targets.truth.reshape(-1, 4)
    crop = plotting.region(boxes[:, :2], boxes[:, 2:], targets.stills.shape[1:])
    columns = [
        (NAMES[name], [_annotated(targets.stills[t], step, t, crop) for t in chosen])
        for name, step in fewest.items()
        if name != "gpf"
    ]
    titles = [f"frame {targets.first + t}" for t in chosen]
    legend = {f"particles of target {k + 1}": k for k in (0, 1)}
    return plotting.draw_contact_sheet(columns, titles, legend)


def _annotated(still: np.ndarray, step: Step, t: int, crop: tuple[slice, slice]) -> np.ndarray:
    zoom = max(1, round(360 / (crop[0].stop - crop[0].start)))
    image, draw = drawing.canvas_of(still[crop].repeat(zoom, axis=0).repeat(zoom, axis=1))
    corner = np.array([crop[1].start, crop[0].start], float)
    places = zoom * (step.centres[0, t] - corner)
    plotting.draw_points(draw, places, step.target[0, t], 0.5 * zoom)
    return np.asarray(image)


if __name__ == "__main__":
    raise SystemExit(main())
