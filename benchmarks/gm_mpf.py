"""Lin et al. (2012), figures 1 to 6 and table 1: PF, GPF, MPF and GM-MPF on two targets.

    python -m benchmarks.gm_mpf                       # pets09_s2l1, or a rendered scene
    python -m benchmarks.gm_mpf --sequence DIR --ids 3 5 --frames 1:80

All four have the same model and start from the same boxes: HSV histograms (eqs. 1 to 3) and
second-order dynamics (eq. 4); boxes are cut into three bands and colours weighed against the
surround, as the paper does not, since a whole box's histogram loses small pedestrians to the
pavement whatever the filter. Those with one component hold both targets in it; the mixtures have
one component for each target, which never meet but in their weights, as the paper's intervals.
Into --out DIR go gm_mpf.json and the figures.
"""

import os
from collections.abc import Callable, Iterable, Sequence
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
from mpfjax.vision.colour.bins import HSVColours
from mpfjax.vision.colour.histograms import integral_histogram
from mpfjax.vision.files import boxes as box_files
from mpfjax.vision.files import drawing, frames

NAMES = {"pf": "PF", "gpf": "GPF", "mpf": "MPF", "gm_mpf": "GM-MPF"}
MOMENTUM = 0.5
STEP_DEVIATIONS = (0.12, 0.04, 0.01, 0.01)  # a frame, in widths, heights, and shares of the size
SIGMA, NUM_PARTS = 0.1, 3
DEFAULT_IDS, DEFAULT_FRAMES = (11, 13), "129:199"
TIMED_PARTICLES, TIMED_FRAMES, WARM_UP = 1000, 50, 5
# Of the filter that errors are measured from.
REFERENCE_PARTICLES, REFERENCE_RUNS = 5000, 4
LAST_FRAMES, LEAST_SHARE = 10, 0.1
PAPER_MILLISECONDS = {
    "pf": (1.68, 0.046), "gpf": (1.52, 0.028), "mpf": (1.82, 0.034), "gm_mpf": (1.75, 0.019)
}  # fmt: skip


@command(frames="129:140", particles=[20], seeds=2)
def main(
    *,
    sequence: Path | None = None,
    ids: tuple[Natural, Natural] | None = None,
    frames: str | None = None,
    filters: Sequence[Annotated[str, (*NAMES,)]] = (*NAMES,),
    particles: Sequence[AtLeast2] = (100, 200, 300),
    seeds: Count = 20,
    seed: Seed = 0,
    out: Path = Path("results/gm_mpf"),
) -> None:
    """The times, then the study; results are written as soon as they are there.

    - `sequence`: a folder with img/ and gt.txt.
    - `ids`: two objects of gt.txt.
    - `frames`: A:B, frames A to B, counted from 1, both in.
    """
    targets = open_targets(sequence, ids, frames, seed)
    # In the order of the table, the PF first: the others are measured against it.
    names = [name for name in NAMES if name in filters]
    timing, cheap = time_filters(targets, seed, names), time_quadratic(seed, names)
    parts = profile(targets, seed)
    print(f"time with colour histograms, {TIMED_PARTICLES} particles (table 1)")
    print(timing_table(timing, paper=True))
    print(f"\ntime on the quadratic model, {TIMED_PARTICLES} particles")
    print(timing_table(cheap, paper=False))
    print("\nwhere the time of one frame goes")
    columns = {"part": "{part}", "ms": "{ms:.3f}"}
    print(harness.table(columns, [{"part": k, "ms": v} for k, v in parts.items()]))
    content: dict[str, Any] = {
        "settings": harness.settings_of({
            "source": targets.name, "seeds": seeds, "seed": seed,
            "frames": [targets.first, targets.first + len(targets.stills) - 1],
            "timed_particles": TIMED_PARTICLES, "timed_frames": TIMED_FRAMES,
        }),
        "timing": {name: times.mean() for name, times in timing.items()},
        "timing_std": {name: times.std() for name, times in timing.items()},
        "timing_quadratic": {name: times.mean() for name, times in cheap.items()},
        "profile": parts,
    }  # fmt: skip
    harness.data(out / "gm_mpf.json", **content)
    found = study(targets, particles, seeds, seed, names)
    mixtures = [name for name in names if name in ("mpf", "gm_mpf")]
    references = reference_estimates(targets, seed, mixtures)
    fewest = {name: steps[particles[0]] for name, steps in found.items()}
    by_size = {name: errors_by_size(steps, targets.truth) for name, steps in found.items()}
    own = {name: errors_by_size(found[name], truth) for name, truth in references.items()}
    content |= {
        "rmse": _of_each(by_size, lambda errors: errors.mean(axis=0)),
        "rmse_std": _of_each(by_size, lambda errors: errors.std(axis=0)),
        "monte_carlo_error": _of_each(own, lambda errors: errors.mean(axis=0)),
        "n_eff": {name: step.effective_sample_size.mean(axis=0) for name, step in fewest.items()},
        "both_held": {name: held(step, targets.truth).mean() for name, step in fewest.items()},
    }
    harness.data(out / "gm_mpf.json", **content)
    print(f"\ntwo targets of {targets.name}, {seeds} seeds")
    print(study_table(found, by_size, own, targets))
    curves = {NAMES[name]: step.effective_sample_size for name, step in fewest.items()}
    harness.figures(
        out, dpi=130, particle_migration=draw_migration(fewest, targets),
        effective_sample_size=plotting.draw_curves(  # figures 3 and 4
            curves, targets.first, xlabel="frame", ylabel=r"effective sample size $N_{eff}$",
            title=f"eq. 14, N = {particles[0]}, mean ± std over seeds",
        ),
        rmse=draw_errors(by_size, own),
    )  # fmt: skip
    print(f"written to {out}")


BySize = dict[str, dict[int, np.ndarray]]  # of each filter and number of particles


def _of_each(values: BySize, measure: Callable[[Any], Any]) -> dict[str, Any]:
    """A measure of every filter and number of particles."""
    return {
        name: {str(size): measure(value) for size, value in by_size.items()}
        for name, by_size in values.items()
    }


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

    The folder of sequences is the one that MPFJAX_DATA names, or ../shared/data.
    """
    if sequence is None:
        data = Path(os.environ.get("MPFJAX_DATA", "../shared/data")) / "pets09_s2l1"
        if not data.is_dir():
            return _rendered(ids, span, seed)
        sequence = data
        ids = DEFAULT_IDS if ids is None else ids
        span = DEFAULT_FRAMES if span is None else span
    first, last = frames.parse_range(span, "--frames")
    rows = read_truth(sequence / "gt.txt").objects
    if ids is None:
        ids = sorted(box_files.boxes_of_frame(rows, first))[:2]
    stills = np.stack(list(frames.read_frames(sequence, first, last)))
    return _with_truth(str(sequence.name), stills, first, rows, ids)


def _rendered(ids: Sequence[int] | None, span: str | None, seed: int) -> Targets:
    """Two players of one team, who change places before a camera that stands still."""
    first, last = frames.parse_range(span, "--frames")
    scene = football_scene(jax.random.key(seed), last or 80, num_players=2, still_camera=True)
    stills = scene.frames[first - 1 :]
    return _with_truth("rendered scene", stills, first, scene.tracks, ids or (1, 2))


def _with_truth(
    name: str, stills: np.ndarray, first: int, rows: np.ndarray, ids: Sequence[int]
) -> Targets:
    boxes = boxes_over_time(rows, ids, first, len(stills))
    for t, target in np.argwhere(np.isnan(boxes).any(axis=2)):
        raise ValueError(f"--ids: object {ids[target]} has no box in frame {first + t}")
    truth = box_files.centred(boxes.reshape(-1, 4)).reshape(boxes.shape)
    return Targets(name, stills, first, truth)


def make_model(targets: Targets) -> ColourModel:
    """HSV histograms and second-order dynamics for the two boxes of the first frame."""
    still, boxes = targets.stills[0], box_files.top_left(targets.truth[0])
    deviations = np.array(STEP_DEVIATIONS)[None] * np.concatenate(
        [boxes[:, 2:], np.ones_like(boxes[:, 2:])], axis=1
    )
    each = [mpfjax.Autoregression.with_momentum(MOMENTUM, jnp.asarray(row)) for row in deviations]
    dynamics = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    return ColourModel.from_frame(
        still, boxes, colours=HSVColours(), sigma=SIGMA, num_parts=NUM_PARTS, weigh_colours=True,
        deviations=deviations, dynamics=dynamics,
    )  # fmt: skip


def make_filter(name: str, model: ColourModel, num_particles: int) -> mpfjax.Filter:
    """One of {one component, two} x {resample, Gaussian regeneration}."""
    redraw = mpfjax.GaussianRegeneration(where=motion) if "g" in name else mpfjax.Resample()
    moves = [redraw, mpfjax.Propagate(model)]
    if name in ("pf", "gpf"):
        return mpfjax.Filter(model, moves, num_particles)
    one_each = [
        mpfjax.KMeans(10, reseed=True, features=_reference),
        mpfjax.Merge(None, 0.5, features=_reference),
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
        means = mixture.component_averages(self.model.boxes(mixture.particles))[:, :2]
        owners = mixture.component_averages(mixture.particles.reference.astype(means.dtype))
        swapped = (mixture.num_components == 2) & (owners[0] > owners[-1])
        ends = jnp.stack([means[0], means[-1]])
        return Step(
            jnp.where(swapped, ends[::-1], ends),
            jnp.sum(mixture.component_effective_sample_sizes),
            mixture.particles.box[:, :2],
            mixture.particles.reference,
        )


def errors(estimates: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The distance in pixels of each estimate (..., t, 2 targets, 2) from its target's centre."""
    return np.linalg.norm(estimates - truth[:, :, :2], axis=-1)


def held(step: Step, truth: np.ndarray) -> np.ndarray:
    """Whether each run keeps both targets: in all of the last frames the particles that stand for
    a target and lie on it are at least `LEAST_SHARE` of its equal share, which is half of all.
    """
    gaps = np.abs(step.centres[:, :, None] - truth[None, :, :, None, :2])
    near = (gaps < np.array(REACH) * truth[None, :, :, None, 2:]).all(axis=-1)
    own = step.target[:, :, None] == np.arange(2)[None, None, :, None]
    shares = 2 * (near & own).mean(axis=-1)
    return (shares[:, -LAST_FRAMES:] >= LEAST_SHARE).all(axis=(1, 2))


def study(
    targets: Targets, sizes: Sequence[int], num_seeds: int, seed: int, names: Iterable[str]
) -> dict[str, dict[int, Step]]:
    """Every filter at every number of particles, `num_seeds` runs of each under one vmap."""
    model = make_model(targets)
    keys = jax.random.split(jax.random.key(seed), num_seeds)
    stills = jnp.asarray(targets.stills)
    found: dict[str, dict[int, Step]] = {}
    for name, size in harness.grid("study", names, sizes):
        run = mpfjax.monte_carlo(keys, make_filter(name, model, size), stills, Collect(model))
        found.setdefault(name, {})[size] = jax.tree.map(np.asarray, run.collected)
    return found


def reference_estimates(targets: Targets, seed: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """E(x_t | y_1..y_t) as each filter has it with a great many particles, (t, 2 targets, 2).

    The distance from it is what more particles can mend; what is left of the distance from the
    true box is the model's, or the annotation's.
    """
    found = study(targets, [REFERENCE_PARTICLES], REFERENCE_RUNS, seed + 1, names)
    return {name: steps[REFERENCE_PARTICLES].estimates.mean(0) for name, steps in found.items()}


def errors_by_size(by_size: dict[int, Step], truth: np.ndarray) -> dict[int, np.ndarray]:
    """Each target's RMSE in each run, (seeds, 2), as section 5 defines it: the mean over frames of
    the distance between the estimate and the target.
    """
    return {size: errors(step.estimates, truth).mean(axis=1) for size, step in by_size.items()}


# --- times: the filters in turns, and the parts of a step on their own --------------------------


def time_filters(targets: Targets, seed: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Milliseconds of each of 50 frames with 1000 particles."""
    model, key = make_model(targets), jax.random.key(seed)
    filters = {name: make_filter(name, model, TIMED_PARTICLES) for name in names}
    stills = [jnp.asarray(still) for still in targets.stills]
    mixtures = {name: filter.init(key) for name, filter in filters.items()}
    keys = jax.block_until_ready(jax.random.split(key, WARM_UP + TIMED_FRAMES))

    def advance(name: str, turn: int) -> Any:
        still = stills[turn % len(stills)]
        mixtures[name], _ = filters[name].step(keys[turn], mixtures[name], still)
        return mixtures[name]

    return _milliseconds({name: lambda turn, n=name: advance(n, turn) for name in names})


def time_quadratic(seed: int, names: Iterable[str], num_steps: int = 200) -> dict[str, np.ndarray]:
    """Milliseconds a step where the likelihood costs next to nothing: the cost of the mixture.

    The filters of the literature as they are, with all their regrouping at every step; each of 50
    runs of `num_steps` steps is one scan, so that no time goes into calling it.
    """
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    observations = (2 * jnp.sin(2 * jnp.pi * jnp.arange(1.0, num_steps + 1) / 100)) ** 2
    n = TIMED_PARTICLES
    grouping = [mpfjax.Merge(), mpfjax.Split(), mpfjax.KMeans()]
    every = {
        "pf": mpfjax.particle_filter(model, n),
        "gpf": mpfjax.gaussian_particle_filter(model, n),
        "mpf": mpfjax.mixture_particle_filter(model, n, 2, regroup=grouping, regroup_every=1),
        "gm_mpf": mpfjax.gaussian_mixture_particle_filter(model, n, 2),
    }

    def run(filter: mpfjax.Filter, turn: int) -> Array:
        key = jax.random.key(seed + turn)
        found = mpfjax.run_filter(key, filter, observations, harness.nothing)
        return found.log_marginal_likelihood

    taken = _milliseconds({name: lambda turn, f=every[name]: run(f, turn) for name in names})
    return {name: times / num_steps for name, times in taken.items()}


def profile(targets: Targets, seed: int) -> dict[str, float]:
    """Median milliseconds of each part of a step on its own, with 1000 particles."""
    model, still = make_model(targets), jnp.asarray(targets.stills[0])
    table = integral_histogram(still, model.colours)
    mixture = make_filter("mpf", model, TIMED_PARTICLES).init(jax.random.key(seed))
    key, states = jax.random.key(seed + 1), mixture.particles
    redraw = mpfjax.GaussianRegeneration(where=motion)
    parts: dict[str, tuple[Callable[..., Any], Any, Any]] = {
        "integral histogram of the frame": (integral_histogram, still, model.colours),
        "likelihood of all boxes": (model.log_likelihood, table, states),
        "dynamics": (model.sample_transition, key, states),
        "resampling, two components": (mpfjax.Resample(), key, mixture),
        "Gaussian regeneration, two components": (redraw, key, mixture),
    }
    programs = {name: eqx.filter_jit(part) for name, (part, *_) in parts.items()}
    runs = {name: lambda _, name=name: programs[name](*parts[name][1:]) for name in parts}
    return {name: float(np.median(times)) for name, times in _milliseconds(runs).items()}


def _milliseconds(runs: dict[str, Callable[[int], Any]]) -> dict[str, np.ndarray]:
    taken = harness.turns(runs, TIMED_FRAMES, warm_up=WARM_UP)
    return {name: 1000 * seconds for name, seconds in taken.items()}


# --- tables and figures -------------------------------------------------------------------------


def timing_table(elapsed: dict[str, np.ndarray], paper: bool) -> str:
    """Mean and standard deviation of each filter, and its ratio to the first, the PF."""
    first = next(iter(elapsed))
    rows = [
        {
            "filter": NAMES[name], "mean": times.mean(), "std": times.std(),
            "of_means": times.mean() / elapsed[first].mean(),
            "of_medians": np.median(times) / np.median(elapsed[first]),
            "paper": "{:.2f} ± {:.3f}".format(*PAPER_MILLISECONDS[name]),
            "of_paper": PAPER_MILLISECONDS[name][0] / PAPER_MILLISECONDS[first][0],
        }
        for name, times in elapsed.items()
    ]  # fmt: skip
    columns = {
        "filter": "{filter}", "ms a frame": "{mean:.3f} ± {std:.3f}",
        "ratio of means": "{of_means:.3f}", "of medians": "{of_medians:.3f}",
    }  # fmt: skip
    if paper:
        columns |= {"paper's ms": "{paper}", "paper's ratio": "{of_paper:.3f}"}
    return harness.table(columns, rows)


def study_table(
    found: dict[str, dict[int, Step]], by_size: BySize, own: BySize, targets: Targets
) -> str:
    """RMSE of each target and what of it is Monte Carlo error, who holds both, and mean N_eff."""
    rows = []
    for name, steps in found.items():
        for size, step in steps.items():
            error = by_size[name][size]
            row: dict[str, Any] = {
                "filter": f"{NAMES[name]}, N = {size}", "mean": error.mean(axis=0),
                "std": error.std(axis=0), "held": held(step, targets.truth).mean(),
                "n_eff": step.effective_sample_size.mean(),
            }  # fmt: skip
            if name in own:
                row["own"] = own[name][size].mean(axis=0)
            rows.append(row)
    columns = {"filter": "{filter}"}
    columns |= {f"RMSE {k + 1} [px]": f"{{mean[{k}]:.2f}} ± {{std[{k}]:.2f}}" for k in (0, 1)}
    columns |= {f"{k + 1} from N = {REFERENCE_PARTICLES}": f"{{own[{k}]:.2f}}" for k in (0, 1)}
    return harness.table(columns | {"both held": "{held:.2f}", "N_eff": "{n_eff:.1f}"}, rows)


def draw_migration(fewest: dict[str, Step], targets: Targets) -> Any:
    """Figures 1 and 2: where the particles of one run are, coloured by the target they stand for.

    Four frames, among them the first, the one in which the targets are closest, and the last,
    cropped to where both are.
    """
    gaps = np.linalg.norm(targets.truth[:, 0, :2] - targets.truth[:, 1, :2], axis=1)
    closest, last = int(np.argmin(gaps)), len(gaps) - 1
    middle = closest // 2 if 2 * closest > last else (closest + last) // 2
    chosen = sorted({0, middle, closest, last})
    crop = _region(targets)
    rows = [
        (NAMES[name], [_annotated(targets.stills[t], step, t, crop) for t in chosen])
        for name, step in fewest.items()
        if name != "gpf"
    ]
    titles = [f"frame {targets.first + t}" for t in chosen]
    return plotting.draw_contact_sheet(rows, titles)


def _annotated(still: np.ndarray, step: Step, t: int, crop: tuple[slice, slice]) -> np.ndarray:
    zoom = max(1, round(360 / (crop[0].stop - crop[0].start)))
    canvas = still[crop].repeat(zoom, axis=0).repeat(zoom, axis=1).astype(float)
    corner = np.array([crop[1].start, crop[0].start], float)
    places, colours = zoom * (step.centres[0, t] - corner), drawing.PALETTE[step.target[0, t]]
    drawing.draw_points(canvas, places, colours, 0.9 * zoom)
    return np.clip(canvas, 0, 255).astype(np.uint8)


def _region(targets: Targets) -> tuple[slice, slice]:
    """The rows and columns that the targets pass through, with a box's room around."""
    centres, size = targets.truth[:, :, :2], targets.truth[:, :, 2:].max(axis=(0, 1))
    low = np.maximum(centres.min(axis=(0, 1)) - 1.2 * size, 0).astype(int)
    high = (centres.max(axis=(0, 1)) + 1.2 * size).astype(int)
    height, width = targets.stills.shape[1:3]
    return slice(low[1], min(high[1], height)), slice(low[0], min(high[0], width))


def draw_errors(by_size: BySize, own: BySize) -> Any:
    """Figures 5 and 6: each target's error against the number of particles.

    Below, what of it is the Monte Carlo error of the mixtures.
    """
    panels = [
        (
            f"target {target + 1}, from {what}",
            {
                NAMES[name]: {size: error[:, target] for size, error in sizes.items()}
                for name, sizes in errors.items()
            },
        )
        for what, errors in (
            ("the true box", by_size),
            (f"the estimate with N = {REFERENCE_PARTICLES}", own),
        )
        for target in (0, 1)
    ]
    return plotting.draw_errors_by_size(panels, "RMSE [pixels], mean ± s.e.")


if __name__ == "__main__":
    raise SystemExit(main())
