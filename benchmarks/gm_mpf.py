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

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

import mpfjax
from mpfjax import plotting
from mpfjax.console import exit_status, format_table, seed, whole, write_json
from mpfjax.metrics.coverage import REACH
from mpfjax.mixture import ParticleMixture
from mpfjax.vision import boxes as box_files
from mpfjax.vision import drawing, frames
from mpfjax.vision.colour_model import BoxState, ColourModel
from mpfjax.vision.colours import HSVColours
from mpfjax.vision.histograms import integral_histogram
from mpfjax.vision.scenes import football_scene

NAMES = {"pf": "PF", "gpf": "GPF", "mpf": "MPF", "gm_mpf": "GM-MPF"}
PAPER_MILLISECONDS = {
    "pf": (1.68, 0.046), "gpf": (1.52, 0.028), "mpf": (1.82, 0.034), "gm_mpf": (1.75, 0.019)
}  # fmt: skip
DEFAULT_IDS, DEFAULT_FRAMES = [11, 13], "129:199"
MOMENTUM = 0.5
STEP_DEVIATIONS = (0.12, 0.04, 0.01, 0.01)  # a frame, in widths, heights, and shares of the size
SIGMA, NUM_PARTS = 0.1, 3
TIMED_PARTICLES, TIMED_FRAMES, WARM_UP = 1000, 50, 5
LAST_FRAMES, LEAST_SHARE = 10, 0.1
REFERENCE_PARTICLES, REFERENCE_RUNS = 5000, 4


class Targets(NamedTuple):
    """Frames and two targets in them."""

    name: str
    stills: np.ndarray  # (t, h, w, 3)
    first: int  # the number of the first frame
    truth: np.ndarray  # (t, 2, 4), centre and size of each target's true box


# --- the four filters -------------------------------------------------------------------------


def make_model(still: np.ndarray, boxes: np.ndarray) -> ColourModel:
    """HSV histograms and second-order dynamics for two boxes (x, y, w, h), top-left corner."""
    deviations = np.array(STEP_DEVIATIONS)[None] * np.concatenate(
        [boxes[:, 2:], np.ones_like(boxes[:, 2:])], axis=1
    )
    each = [mpfjax.Autoregression.with_momentum(MOMENTUM, jnp.asarray(row)) for row in deviations]
    return ColourModel.from_frame(
        still,
        boxes,
        colours=HSVColours(),
        sigma=SIGMA,
        num_parts=NUM_PARTS,
        weigh_colours=True,
        deviations=deviations,
        dynamics=jax.tree.map(lambda *leaves: jnp.stack(leaves), *each),
    )


def make_filter(name: str, model: ColourModel, num_particles: int) -> mpfjax.Filter:
    """One of {one component, two} x {resample, Gaussian regeneration}."""
    redraw = mpfjax.GaussianRegeneration(where=_motion) if "g" in name else mpfjax.Resample()
    moves = [redraw, mpfjax.Propagate(model)]
    if name in ("pf", "gpf"):
        return mpfjax.Filter(model, moves, num_particles)
    one_each = [
        mpfjax.KMeans(10, reseed=True, features=_reference),
        mpfjax.Merge(None, 0.5, features=_reference),
    ]
    return mpfjax.Filter(model, moves, num_particles, 2, one_each)


def _motion(states: BoxState) -> tuple[Array | None, ...]:
    return states.box, states.previous


def _reference(states: BoxState) -> Array:
    return states.reference[:, None].astype(states.box.dtype)


# --- what is measured -------------------------------------------------------------------------


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

    def __call__(self, mixture: ParticleMixture) -> Step:
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
    """Whether each run keeps both targets: in all of the last frames at least `LEAST_SHARE` of
    the particles stand for the target and lie on it.
    """
    gaps = np.abs(step.centres[:, :, None] - truth[None, :, :, None, :2])
    near = (gaps < np.array(REACH) * truth[None, :, :, None, 2:]).all(axis=-1)
    own = step.target[:, :, None] == np.arange(2)[None, None, :, None]
    return ((near & own).mean(axis=-1)[:, -LAST_FRAMES:] >= LEAST_SHARE).all(axis=(1, 2))


def study(
    targets: Targets,
    sizes: list[int],
    num_seeds: int,
    seed: int,
    show: Callable[[], Any],
    names: Iterable[str] = NAMES,
) -> dict[str, dict[int, Step]]:
    """Every filter at every number of particles, `num_seeds` runs of each under one vmap."""
    model = make_model(targets.stills[0], box_files.top_left(targets.truth[0]))
    keys = jax.random.split(jax.random.key(seed), num_seeds)
    stills = jnp.asarray(targets.stills)
    found: dict[str, dict[int, Step]] = {}
    for name in names:
        for size in sizes:
            run = mpfjax.monte_carlo(keys, make_filter(name, model, size), stills, Collect(model))
            found.setdefault(name, {})[size] = jax.tree.map(np.asarray, run.collected)
            show()
    return found


def reference_estimates(targets: Targets, seed: int, names: Iterable[str]) -> dict[str, np.ndarray]:
    """E(x_t | y_1..y_t) as each filter has it with a great many particles, (t, 2 targets, 2).

    The distance from it is what more particles can mend; what is left of the distance from the
    true box is the model's, or the annotation's.
    """
    size, num_runs = REFERENCE_PARTICLES, REFERENCE_RUNS
    found = study(targets, [size], num_runs, seed + 1, lambda: None, names)
    return {name: by_size[size].estimates.mean(axis=0) for name, by_size in found.items()}


# --- time -------------------------------------------------------------------------------------


def time_filters(
    targets: Targets, seed: int, names: Iterable[str] = NAMES
) -> dict[str, list[float]]:
    """Milliseconds of each of 50 frames with 1000 particles, the filters in random order."""
    model = make_model(targets.stills[0], box_files.top_left(targets.truth[0]))
    filters = {name: make_filter(name, model, TIMED_PARTICLES) for name in names}
    stills = [jnp.asarray(still) for still in targets.stills]
    return time_steps(filters, stills, seed)


def time_steps(
    filters: dict[str, mpfjax.Filter], observations: list[Any], seed: int
) -> dict[str, list[float]]:
    """Milliseconds of `TIMED_FRAMES` steps of each filter after a warm-up, in shuffled order."""
    rng = np.random.default_rng(seed)
    key = jax.random.key(seed)
    mixtures = {name: filter.init(key) for name, filter in filters.items()}
    elapsed: dict[str, list[float]] = {name: [] for name in filters}
    for t in range(WARM_UP + TIMED_FRAMES):
        observation = observations[t % len(observations)]
        for name in rng.permutation(list(filters)).tolist():
            step_key = jax.block_until_ready(jax.random.fold_in(key, t))
            start = time.perf_counter()
            mixtures[name], _ = jax.block_until_ready(
                filters[name].step(step_key, mixtures[name], observation)
            )
            if t >= WARM_UP:
                elapsed[name].append(1000 * (time.perf_counter() - start))
    return elapsed


def time_quadratic(
    seed: int, names: Iterable[str] = NAMES, num_steps: int = 200
) -> dict[str, list[float]]:
    """Milliseconds a step where the likelihood costs next to nothing: the cost of the mixture.

    The filters of the literature as they are, with all their regrouping at every step; each of 50
    runs of `num_steps` steps is one scan, so that no time goes into calling it.
    """
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    observations = (2 * jnp.sin(2 * jnp.pi * jnp.arange(1.0, num_steps + 1) / 100)) ** 2
    n = TIMED_PARTICLES
    every = {
        "pf": mpfjax.particle_filter(model, n),
        "gpf": mpfjax.gaussian_particle_filter(model, n),
        "mpf": mpfjax.mixture_particle_filter(model, n, 2),
        "gm_mpf": mpfjax.gaussian_mixture_particle_filter(model, n, 2),
    }
    filters = {name: every[name] for name in names}
    rng = np.random.default_rng(seed)
    elapsed: dict[str, list[float]] = {name: [] for name in filters}
    for repeat in range(1 + TIMED_FRAMES):
        key = jax.block_until_ready(jax.random.key(repeat))
        for name in rng.permutation(list(filters)).tolist():
            start = time.perf_counter()
            run = mpfjax.run_filter(key, filters[name], observations, _nothing)
            jax.block_until_ready(run.log_marginal_likelihood)
            if repeat > 0:
                elapsed[name].append(1000 * (time.perf_counter() - start) / num_steps)
    return elapsed


def _nothing(mixture: ParticleMixture) -> None:
    """Collect nothing: one function, since a new one at every call would compile anew."""
    del mixture


def profile(targets: Targets, seed: int) -> dict[str, float]:
    """Median milliseconds of each part of a step on its own, with 1000 particles."""
    model = make_model(targets.stills[0], box_files.top_left(targets.truth[0]))
    still = jnp.asarray(targets.stills[0])
    table = integral_histogram(still, model.colours)
    mixture = make_filter("mpf", model, TIMED_PARTICLES).init(jax.random.key(seed))
    key = jax.random.key(seed + 1)
    redraw = mpfjax.GaussianRegeneration(where=_motion)
    parts: dict[str, Callable[[], Any]] = {
        "integral histogram of the frame": eqx.Partial(
            eqx.filter_jit(integral_histogram), still, model.colours
        ),
        "likelihood of all boxes": eqx.Partial(
            eqx.filter_jit(model.log_likelihood), table, mixture.particles
        ),
        "dynamics": eqx.Partial(eqx.filter_jit(model.sample_transition), key, mixture.particles),
        "resampling, two components": eqx.Partial(eqx.filter_jit(mpfjax.Resample()), key, mixture),
        "Gaussian regeneration, two components": eqx.Partial(eqx.filter_jit(redraw), key, mixture),
    }
    elapsed: dict[str, list[float]] = {name: [] for name in parts}
    for repeat in range(WARM_UP + TIMED_FRAMES):
        for name, part in parts.items():
            start = time.perf_counter()
            jax.block_until_ready(part())
            if repeat >= WARM_UP:
                elapsed[name].append(1000 * (time.perf_counter() - start))
    return {name: float(np.median(times)) for name, times in elapsed.items()}


# --- tables and pictures ----------------------------------------------------------------------


def timing_table(elapsed: dict[str, list[float]], paper: bool) -> str:
    """Mean and standard deviation of each filter, and its ratio to the first, the PF."""
    mean = {name: float(np.mean(times)) for name, times in elapsed.items()}
    first = next(iter(elapsed))
    rows = []
    for name, times in elapsed.items():
        row = [NAMES[name], f"{mean[name]:.3f} ± {np.std(times):.3f}"]
        row.append(f"{mean[name] / mean[first]:.3f}")
        row.append(f"{np.median(times) / np.median(elapsed[first]):.3f}")
        if paper:
            row.append("{:.2f} ± {:.3f}".format(*PAPER_MILLISECONDS[name]))
            row.append(f"{PAPER_MILLISECONDS[name][0] / PAPER_MILLISECONDS[first][0]:.3f}")
        rows.append(row)
    header = ["filter", "ms a frame", "ratio of means", "of medians"]
    return format_table(header + (["paper's ms", "paper's ratio"] if paper else []), rows)


def study_table(
    found: dict[str, dict[int, Step]], targets: Targets, references: dict[str, np.ndarray]
) -> str:
    """RMSE of each target and what of it is Monte Carlo error, who holds both, and mean N_eff."""
    rows = []
    for name, by_size in found.items():
        for size, step in by_size.items():
            means, stds = _summary(step, targets)
            own = ["", ""]
            if name in references:
                own = [f"{e:.2f}" for e in errors(step.estimates, references[name]).mean((0, 1))]
            rows.append(
                [
                    f"{NAMES[name]}, N = {size}",
                    *(f"{m:.2f} ± {s:.2f}" for m, s in zip(means, stds, strict=True)),
                    *own,
                    f"{held(step, targets.truth).mean():.2f}",
                    f"{step.effective_sample_size.mean():.1f}",
                ]
            )
    far = f"from N = {REFERENCE_PARTICLES}"
    header = [
        "filter", "RMSE 1 [px]", "RMSE 2 [px]", f"1 {far}", f"2 {far}", "both held", "N_eff"
    ]  # fmt: skip
    return format_table(header, rows)


def _summary(step: Step, targets: Targets) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation over seeds of each target's RMSE as section 5 defines it: the
    mean over frames of the distance between the estimate and the target.
    """
    by_seed = errors(step.estimates, targets.truth).mean(axis=1)
    return by_seed.mean(axis=0), by_seed.std(axis=0)


def draw_migration(found: dict[str, dict[int, Step]], size: int, targets: Targets) -> Any:
    """Figures 1 and 2: where the particles of one run are, coloured by the target they stand for.

    Four frames, among them the first, the one in which the targets are closest, and the last,
    cropped to where both are.
    """
    gaps = np.linalg.norm(targets.truth[:, 0, :2] - targets.truth[:, 1, :2], axis=1)
    closest, last = int(np.argmin(gaps)), len(gaps) - 1
    middle = closest // 2 if 2 * closest > last else (closest + last) // 2
    chosen = sorted({0, middle, closest, last})
    crop = _region(targets)
    height = crop[0].stop - crop[0].start
    zoom = max(1, round(360 / height))
    rows = []
    for name in (name for name in ("pf", "mpf", "gm_mpf") if name in found):
        step = found[name][size]
        pictures = [
            _annotated(targets.stills[t], step.centres[0, t], step.target[0, t], zoom, crop)
            for t in chosen
        ]
        rows.append((NAMES[name], pictures))
    titles = [f"frame {targets.first + t}" for t in chosen]
    return plotting.draw_contact_sheet(rows, titles)


def _annotated(
    still: np.ndarray, centres: np.ndarray, target: np.ndarray, zoom: int, crop: tuple
) -> np.ndarray:
    canvas = still[crop].repeat(zoom, axis=0).repeat(zoom, axis=1).astype(float)
    corner = np.array([crop[1].start, crop[0].start], float)
    drawing.draw_points(canvas, zoom * (centres - corner), drawing.PALETTE[target], 0.9 * zoom)
    return np.clip(canvas, 0, 255).astype(np.uint8)


def _region(targets: Targets) -> tuple[slice, slice]:
    """The rows and columns that the targets pass through, with a box's room around."""
    centres, size = targets.truth[:, :, :2], targets.truth[:, :, 2:].max(axis=(0, 1))
    low = np.maximum(centres.min(axis=(0, 1)) - 1.2 * size, 0).astype(int)
    high = (centres.max(axis=(0, 1)) + 1.2 * size).astype(int)
    height, width = targets.stills.shape[1:3]
    return slice(low[1], min(high[1], height)), slice(low[0], min(high[0], width))


def draw_effective_sample_sizes(found: dict[str, dict[int, Step]], size: int, first: int) -> Any:
    """Figures 3 and 4: N_eff of eq. 14 in every frame, mean and spread over the seeds."""
    curves = {NAMES[name]: by_size[size].effective_sample_size for name, by_size in found.items()}
    return plotting.draw_curves(
        curves, first, xlabel="frame", ylabel=r"effective sample size $N_{eff}$",
        title=f"eq. 14, N = {size}, mean ± std over seeds",
    )  # fmt: skip


def draw_errors(
    found: dict[str, dict[int, Step]], targets: Targets, references: dict[str, np.ndarray]
) -> Any:
    """Figures 5 and 6: each target's error against the number of particles.

    Below, what of it is the Monte Carlo error of the mixtures.
    """
    lines = {name: _errors_by_size(by_size, targets.truth) for name, by_size in found.items()}
    own = {name: _errors_by_size(found[name], truth) for name, truth in references.items()}
    panels = [
        (
            f"target {target + 1}, from {what}",
            {
                NAMES[name]: {size: error[:, target] for size, error in by_size.items()}
                for name, by_size in those.items()
            },
        )
        for what, those in (
            ("the true box", lines),
            (f"the estimate with N = {REFERENCE_PARTICLES}", own),
        )
        for target in (0, 1)
    ]
    return plotting.draw_errors_by_size(panels, "RMSE [pixels], mean ± s.e.")


def _errors_by_size(by_size: dict[int, Step], truth: np.ndarray) -> dict[int, np.ndarray]:
    """The error of each run and target, (seeds, 2), averaged over frames."""
    return {size: errors(step.estimates, truth).mean(axis=1) for size, step in by_size.items()}


# --- the command line -------------------------------------------------------------------------


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments, each checked as far as it can be without the frames."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gm_mpf",
        description="PF, GPF, MPF and GM-MPF on two targets (Lin et al. 2012, figures and table).",
    )
    parser.add_argument("--sequence", type=Path, metavar="DIR", help="img/ and gt.txt")
    parser.add_argument("--ids", type=whole(0), nargs=2, metavar="ID", help="two objects of gt.txt")
    parser.add_argument("--frames", metavar="A:B", help="frames A to B, counted from 1, both in")
    parser.add_argument("--filters", nargs="+", choices=list(NAMES), default=list(NAMES))
    parser.add_argument(
        "--particles", type=whole(2), nargs="+", default=[100, 200, 300], metavar="N"
    )
    parser.add_argument("--seeds", type=whole(), default=20)
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--out", type=Path, default=Path("results/gm_mpf"))
    return parser.parse_args(arguments)


def open_targets(options: argparse.Namespace) -> Targets:
    """The sequence asked for, or pets09_s2l1, or a rendered scene where there is no data.

    The folder of sequences is the one that MPFJAX_DATA names, or ../shared/data.
    """
    sequence, ids, span = options.sequence, options.ids, options.frames
    if sequence is None:
        data = Path(os.environ.get("MPFJAX_DATA", "../shared/data")) / "pets09_s2l1"
        if not data.is_dir():
            return _rendered(options)
        sequence = data
        ids = DEFAULT_IDS if ids is None else ids
        span = DEFAULT_FRAMES if span is None else span
    first, last = frames.parse_range(span, "--frames")
    rows = box_files.read_tracks(sequence / "gt.txt")
    if ids is None:
        ids = sorted(box_files.boxes_of_frame(rows, first))[:2]
    stills = np.stack(list(frames.read_frames(sequence, first, last)))
    return _with_truth(str(sequence.name), stills, first, rows, ids)


def _rendered(options: argparse.Namespace) -> Targets:
    """Two players of one team, who change places before a camera that stands still."""
    first, last = frames.parse_range(options.frames, "--frames")
    key = jax.random.key(options.seed)
    scene = football_scene(key, last or 80, num_players=2, still_camera=True)
    ids = [1, 2] if options.ids is None else options.ids
    return _with_truth("rendered scene", scene.frames[first - 1 :], first, scene.tracks, ids)


def _with_truth(
    name: str, stills: np.ndarray, first: int, rows: np.ndarray, ids: list[int]
) -> Targets:
    truth = np.zeros((len(stills), 2, 4))
    for target, id in enumerate(ids):
        own = {int(row[0]): row[2:] for row in rows[rows[:, 1] == id]}
        for t in range(len(stills)):
            if first + t not in own:
                raise ValueError(f"--ids: object {id} has no box in frame {first + t}")
            truth[t, target] = box_files.centred(own[first + t][None])[0]
    return Targets(name, stills, first, truth)


def run(options: argparse.Namespace) -> None:
    """The study, then the times; results are written as soon as they are there."""
    targets = open_targets(options)
    options.out.mkdir(parents=True, exist_ok=True)
    settings = {
        "source": targets.name,
        "frames": [targets.first, targets.first + len(targets.stills) - 1],
        "seeds": options.seeds,
        "seed": options.seed,
        "timed_particles": TIMED_PARTICLES,
        "timed_frames": TIMED_FRAMES,
    }
    # In the order of the table, the PF first: the others are measured against it.
    names = [name for name in NAMES if name in options.filters]
    timing = time_filters(targets, options.seed, names)
    cheap = time_quadratic(options.seed, names)
    parts = profile(targets, options.seed)
    print(f"time with colour histograms, {TIMED_PARTICLES} particles (table 1)")
    print(timing_table(timing, paper=True))
    print(f"\ntime on the quadratic model, {TIMED_PARTICLES} particles")
    print(timing_table(cheap, paper=False))
    print("\nwhere the time of one frame goes")
    print(format_table(["part", "ms"], [[k, f"{v:.3f}"] for k, v in parts.items()]))
    content: dict[str, Any] = {
        "settings": settings,
        "timing": {name: float(np.mean(times)) for name, times in timing.items()},
        "timing_std": {name: float(np.std(times)) for name, times in timing.items()},
        "timing_quadratic": {name: float(np.mean(times)) for name, times in cheap.items()},
        "profile": parts,
    }
    write_json(options.out / "gm_mpf.json", content)
    with tqdm(total=len(names) * len(options.particles), unit="study", disable=None) as bar:
        found = study(targets, options.particles, options.seeds, options.seed, bar.update, names)
    mixtures = [name for name in names if name in ("mpf", "gm_mpf")]
    references = reference_estimates(targets, options.seed, mixtures)
    least = options.particles[0]
    content |= {
        "rmse": _by_size(found, lambda step: _summary(step, targets)[0].tolist()),
        "rmse_std": _by_size(found, lambda step: _summary(step, targets)[1].tolist()),
        "monte_carlo_error": {
            name: {
                str(size): error.mean(axis=0).tolist()
                for size, error in _errors_by_size(found[name], truth).items()
            }
            for name, truth in references.items()
        },
        "n_eff": {
            name: by_size[least].effective_sample_size.mean(axis=0).tolist()
            for name, by_size in found.items()
        },
        "both_held": {
            name: float(held(by_size[least], targets.truth).mean())
            for name, by_size in found.items()
        },
    }
    write_json(options.out / "gm_mpf.json", content)
    print(f"\ntwo targets of {targets.name}, {options.seeds} seeds")
    print(study_table(found, targets, references))
    figures = {
        "particle_migration": draw_migration(found, least, targets),
        "effective_sample_size": draw_effective_sample_sizes(found, least, targets.first),
        "rmse": draw_errors(found, targets, references),
    }
    for name, figure in figures.items():
        figure.savefig(options.out / f"{name}.png", dpi=130)
    print(f"written to {options.out}")


def _by_size(
    found: dict[str, dict[int, Step]], measure: Callable[[Step], list[float]]
) -> dict[str, dict[str, list[float]]]:
    return {
        name: {str(size): measure(step) for size, step in by_size.items()}
        for name, by_size in found.items()
    }


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    return exit_status(lambda: run(parse_arguments(arguments)))


if __name__ == "__main__":
    sys.exit(main())
