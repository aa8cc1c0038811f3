"""Smith and Gatica-Perez (2004), tables 1 to 4 and figures 4 and 8: does the order matter?

    python -m benchmarks.partitioned_sampling                  # tables 1 and 2, figure 4
    python -m benchmarks.partitioned_sampling --sequence DIR   # tables 3 and 4, figure 8
    python -m benchmarks.partitioned_sampling --sequence DIR --ids 4 3 5 --frames 1:63

A joint particle filter ("Non-PS"), partitioned sampling in every circular order, distributed
partitioned sampling with both reassemblies, and independent filters, all with the same model and
the same number of likelihoods a frame, 50 runs each. The synthetic sequence is rendered. In a
folder with img/ and gt.txt the first of --ids is the object that is occluded; the sequences named
in `STRETCHES` bring their own. Into --out DIR go partitioned_sampling.json, the figures, and an
animation of a PS run that fails beside a DPS run that recovers. Objects are counted from 1.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

import mpfjax
from benchmarks.partitioned_tables import (
    Rates,
    checks_of,
    measure,
    pool,
    print_tables,
    worst_order,
)
from mpfjax import plotting
from mpfjax.console import exit_status, fill_in, positive, seed, whole, write_json
from mpfjax.metrics.uniqueness import effective_dynamics, uniqueness
from mpfjax.mixture import ParticleMixture
from mpfjax.models.multi_object import MultiObjectModel
from mpfjax.vision import boxes as box_files
from mpfjax.vision import drawing, frames
from mpfjax.vision.distracter import distracter_scene
from mpfjax.vision.joint_colour import (
    PAPER_DEVIATIONS,
    joint_colour_model,
    object_boxes,
    with_lambda,
)

Order = tuple[int, ...] | None
# A new filter is one more line: name -> (model, number of particles, order) -> filter.
METHODS: dict[str, Callable[[MultiObjectModel, int, Order], mpfjax.Filter]] = {
    "joint": lambda model, n, _: mpfjax.particle_filter(model, n),
    "ps": lambda model, n, order: mpfjax.partitioned_sampling(model, n, order),
    "dps": lambda model, n, _: mpfjax.distributed_partitioned_sampling(model, n),
    "dps_evidence": lambda model, n, _: mpfjax.distributed_partitioned_sampling(
        model, n, reassembly="evidence"
    ),
    "independent": lambda model, n, _: mpfjax.independent_particle_filters(model, n),
    "clusters": lambda model, n, _: mpfjax.clustered_particle_filter(model, n),
}
ORDERED = ("ps",)

LAMBDAS, NUM_PARTICLES = [20.0, 30.0, 40.0, 50.0], 300
# Of the keys 0, 1 and 2 the one with which the exact posterior, a filter of object 1 alone with
# 20 000 particles, stays away from object 1 for some frames after the distracter has gone.
SCENE = 1
REAL_LAMBDAS, REAL_NUM_PARTICLES = [20.0], 200
PAPER_WIDTH = 360  # the frames in which a step deviates by two pixels
ANIMATION_RATE, MOST_DRAWN = 5.0, 100  # frames a second, particles


class Stretch(NamedTuple):
    """A part of a sequence in which one person is hidden and comes back."""

    ids: tuple[int, ...]
    frames: str
    occluded: int


STRETCHES = {
    "otb_jogging": [Stretch((1, 2), "1:120", 1)],
    "tud_campus": [Stretch((4, 3, 5), "1:63", 4)],
    "pets09_s2l1": [Stretch((9, 15, 19), "1:50", 9), Stretch((1, 2, 4, 3), "545:585", 3)],
}


class Scene(NamedTuple):
    """Frames, the objects in them, and what the filters know of both."""

    name: str
    stills: np.ndarray  # (t, h, w, 3)
    first: int  # the number of the first frame
    truth: np.ndarray  # (t, objects, 4), top-left corner first, NaN where there is none
    hard: int  # which object is distracted or occluded, from 0 on
    model: MultiObjectModel
    deviations: np.ndarray  # of a step in u and v

    @property
    def tables(self) -> tuple[str, str | None]:
        """The table of the hard object, and that of the others where the paper has one."""
        if self.name.startswith("synthetic"):
            return "2", "1"
        return ("4" if self.truth.shape[1] > 3 else "3"), None


class Kept(NamedTuple):
    """What is kept of every step of a run."""

    boxes: Any  # (objects, 4), of the mean state
    uniqueness: Any  # (objects,)
    dynamics: Any  # (objects, 2), variance of u and v over the particles
    centres: Any  # (n, objects, 2)


class Row(NamedTuple):
    """All runs of one filter at one λ."""

    lambda_: float
    method: str
    order: Order
    kept: Kept  # leading axes runs, t; of the centres only two runs, see `shown`
    shown: dict[bool, int | None]  # a run that recovers, and one that does not


# --- running ----------------------------------------------------------------------------------


def collector(model: MultiObjectModel) -> Callable[[ParticleMixture], Kept]:
    """What to keep of a mixture; one function for all of a scene's filters and λ."""

    def collect(mixture: ParticleMixture) -> Kept:
        boxes = object_boxes(model, mixture.particles)
        return Kept(
            mixture.average(boxes),
            uniqueness(mixture),
            effective_dynamics(mixture).box[:, :2],
            mixture.particles.box[:, :, :2],
        )

    return collect


def filters(
    scene: Scene, lambda_: float, num_particles: int, methods: Iterable[str]
) -> dict[tuple[str, Order], mpfjax.Filter]:
    """Every filter at one λ, PS once for each circular order."""
    model = with_lambda(scene.model, lambda_)
    num_objects = model.num_objects
    circular = [tuple(np.roll(np.arange(num_objects), -s).tolist()) for s in range(num_objects)]
    return {
        (name, order): METHODS[name](model, num_particles, order)
        for name in methods
        for order in (circular if name in ORDERED else [None])
    }


def study(
    scene: Scene,
    lambdas: list[float],
    num_particles: int,
    methods: Sequence[str],
    num_runs: int,
    seed: int,
) -> Iterator[Row]:
    """All runs of every filter at every λ, a row's under one vmap."""
    stills, collect = jnp.asarray(scene.stills), collector(scene.model)
    for lambda_ in lambdas:
        made = filters(scene, lambda_, num_particles, methods)
        for number, ((method, order), filter) in enumerate(made.items()):
            keys = row_keys(seed, lambda_, number, num_runs)
            run = mpfjax.monte_carlo(keys, filter, stills, collect)
            kept = jax.tree.map(np.asarray, run.collected)
            yield _reduced(Row(lambda_, method, order, kept, {}), scene)


def row_keys(seed: int, lambda_: float, number: int, num_runs: int) -> Array:
    """Keys of one row's runs: no two rows have any in common, whatever other λ there are."""
    key = jax.random.fold_in(jax.random.key(seed), round(1000 * lambda_))
    return jax.random.split(jax.random.fold_in(key, number), num_runs)


def _reduced(row: Row, scene: Scene) -> Row:
    """The particles of one run that recovers and of one that does not, and no others'."""
    recovered = measure(row.kept.boxes[:, :, [scene.hard]], scene.truth[:, [scene.hard]]).recovered
    shown = {
        wanted: next((k for k, found in enumerate(recovered[:, 0]) if found == wanted), None)
        for wanted in (True, False)
    }
    runs = [0 if k is None else k for k in shown.values()]
    return row._replace(kept=row.kept._replace(centres=row.kept.centres[runs]), shown=shown)


# --- what is written --------------------------------------------------------------------------


def table_row(row: Row, rates: Rates) -> dict[str, Any]:
    """One entry of a table of the JSON file."""
    order = None if row.order is None else [j + 1 for j in row.order]
    return {"lambda": row.lambda_, "method": row.method, "order": order} | rates.as_dict()


def content_of(scene: Scene, rows: list[Row]) -> dict[str, Any]:
    """The tables, their summaries over orders, and figure 4 or 8, as they go into the file."""
    hard_table, easy_table = scene.tables
    objects = {hard_table: [scene.hard]}
    if easy_table is not None:
        objects[easy_table] = [j for j in range(scene.truth.shape[1]) if j != scene.hard]
    tables: dict[str, Any] = {}
    summary: dict[str, Any] = {}
    for table, chosen in sorted(objects.items()):
        rates = [measure(row.kept.boxes[:, :, chosen], scene.truth[:, chosen]) for row in rows]
        tables[table] = [table_row(*pair) for pair in zip(rows, rates, strict=True)]
        summary[table] = [
            {"lambda": lambda_, "method": method} | entry
            for lambda_ in dict.fromkeys(row.lambda_ for row in rows)
            for method in ORDERED
            for entry in _over_orders(rows, rates, lambda_, method)
        ]
    least = rows[0].lambda_
    first = [row for row in rows if row.lambda_ == least]
    content = {
        "tables": tables,
        "summary": summary,
        "uniqueness": {label(row): _mean(row.kept.uniqueness) for row in first},
        "effective_dynamics": {
            label(row): {
                name: _mean(row.kept.dynamics[..., axis] / scene.deviations[axis] ** 2)
                for axis, name in enumerate("uv")
            }
            for row in first
        },
    }
    return content | {"checks": checks_of(content)}


def _over_orders(
    rows: list[Row], rates: list[Rates], lambda_: float, method: str
) -> Iterator[dict[str, Any]]:
    """The mean over the orders of a method, and the order that recovers least."""
    own = [
        (row, found)
        for row, found in zip(rows, rates, strict=True)
        if (row.lambda_, row.method) == (lambda_, method)
    ]
    if own:
        yield {"order": "mean"} | pool([found for _, found in own]).as_dict()
        row, found = own[worst_order([found for _, found in own])]
        yield {"order": "worst", "worst": [j + 1 for j in row.order or ()]} | found.as_dict()


def label(row: Row) -> str:
    """The name of a row: "ps 2,3,1", "dps"."""
    return row.method + ("" if row.order is None else " " + _arrows(row.order, ","))


def _arrows(order: tuple[int, ...], between: str) -> str:
    return between.join(str(j + 1) for j in order)


def _mean(values: np.ndarray) -> list[float]:
    """Over runs and steps."""
    return [float(value) for value in values.mean(axis=(0, 1))]


# --- pictures ---------------------------------------------------------------------------------

TITLES = {
    "joint": "joint PF (Non-PS)",
    "ps": "PS",
    "dps": "DPS",
    "dps_evidence": "DPS, evidence",
    "independent": "independent filters",
    "clusters": "clusters that merge on contact",
}


def title(method: str, order: Order) -> str:
    """What a picture calls a filter."""
    name = TITLES.get(method, method)
    return name if order is None else f"{name} {{{_arrows(order, '→')}}}"


def draw_impoverishment(scene: Scene, rows: list[Row], content: dict[str, Any]) -> Any:
    """Figures 4 and 8: uniqueness and effective dynamics of each object, in per cent.

    Of the orders only those with the hard object first and last.
    """
    hard, chosen = scene.hard, {}
    for row in rows:
        if row.lambda_ != rows[0].lambda_:
            continue
        if row.order is not None and hard not in (row.order[0], row.order[-1]):
            continue
        dynamics = content["effective_dynamics"][label(row)]
        chosen[title(row.method, row.order)] = [
            100 * np.array(content["uniqueness"][label(row)]),
            100 * np.array(dynamics["u"]),
            100 * np.array(dynamics["v"]),
        ]
    names = ["uniqueness U/N [%]", "effective dynamics in u [%]", "effective dynamics in v [%]"]
    return plotting.draw_object_bars(chosen, names)


def draw_recovery(scene: Scene, content: dict[str, Any]) -> Any:
    """The hard object's recovery rate of every filter against λ."""
    table = scene.tables[0]
    entries = [row for row in content["tables"][table] if row["order"] is None]
    entries += content["summary"][table]
    lines: dict[str, list[tuple[float, float, float, float]]] = {}
    for entry in entries:
        name = str(TITLES.get(entry["method"], entry["method"]))
        name += {None: "", "mean": ", mean of orders", "worst": ", worst order"}[entry["order"]]
        low, high = entry["recovery_interval"]
        lines.setdefault(name, []).append((entry["lambda"], entry["recovery"], low, high))
    return plotting.draw_rates(
        lines, xlabel=r"$\lambda$", ylabel="recovery rate",
        title=f"object {scene.hard + 1} of {scene.name}, 95% intervals",
    )  # fmt: skip


def pair_of_runs(rows: list[Row]) -> list[tuple[str, Kept]]:
    """A PS run that fails and a DPS run that recovers, by the first λ that has both.

    Where there is no such pair, any run takes the place.
    """

    def first(method: str, recovers: bool) -> tuple[str, Kept] | None:
        own = [row for row in rows if row.method == method]
        having = [row for row in own if row.shown[recovers] is not None]
        if not own:
            return None
        row = (having or own)[0]
        run = row.shown[recovers] if having else 0
        outcome = "recovers" if recovers == bool(having) else "fails"
        which = 0 if recovers else 1
        kept = jax.tree.map(lambda leaf: leaf[run], row.kept._replace(centres=None))
        name = f"{title(method, row.order)} {outcome}"
        return name, kept._replace(centres=row.kept.centres[which])

    found = [first("ps", False), first("dps", True)]
    return [entry for entry in found if entry is not None]


def annotate(scene: Scene, kept: Kept, t: int) -> np.ndarray:
    """A frame with the particles and mean boxes of one run; the hard object's true box in white."""
    canvas, palette = scene.stills[t].astype(float), drawing.PALETTE
    for j in range(scene.truth.shape[1]):
        centres = kept.centres[t, :: 1 + kept.centres.shape[1] // MOST_DRAWN, j]
        drawing.draw_points(canvas, centres, np.broadcast_to(palette[j], (len(centres), 3)), 1.2)
    drawing.draw_box(canvas, scene.truth[t, scene.hard], np.full(3, 255.0), 1.5)
    for j in range(scene.truth.shape[1]):
        drawing.draw_box(canvas, kept.boxes[t, j], palette[j], 2.0)
    return np.clip(canvas, 0, 255).astype(np.uint8)


def write_pictures(out: Path, scene: Scene, rows: list[Row], content: dict[str, Any]) -> None:
    """All figures of one scene, and the animation."""
    draw_impoverishment(scene, rows, content).savefig(out / "uniqueness.png", dpi=110)
    draw_recovery(scene, content).savefig(out / "recovery.png", dpi=110)
    runs = pair_of_runs(rows)
    if not runs:
        return
    shown = np.linspace(2, len(scene.stills) - 1, 4).round().astype(int).clip(0)
    sheet = [(name, [annotate(scene, kept, t) for t in shown]) for name, kept in runs]
    titles = [f"frame {scene.first + t}" for t in shown]
    plotting.draw_contact_sheet(sheet, titles).savefig(out / "contact_sheet.png", dpi=90)
    between = np.full((scene.stills.shape[1], 4, 3), 255, np.uint8)
    frames.write_video(
        out / "recovery.gif",
        (
            np.concatenate(
                [part for _, kept in runs for part in (annotate(scene, kept, t), between)][:-1],
                axis=1,
            )
            for t in range(len(scene.stills))
        ),
        ANIMATION_RATE,
    )


# --- the command line -------------------------------------------------------------------------


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments, each checked as far as it can be without the frames."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.partitioned_sampling",
        description="Joint PF, PS, DPS and independent filters (Smith and Gatica-Perez 2004).",
    )
    parser.add_argument("--sequence", type=Path, metavar="DIR", help="img/ and gt.txt")
    parser.add_argument(
        "--ids",
        type=whole(0),
        nargs="+",
        metavar="ID",
        help="objects of gt.txt, the occluded one first",
    )
    parser.add_argument("--frames", metavar="A:B", help="frames A to B, counted from 1, both in")
    parser.add_argument(
        "--stretch",
        type=whole(),
        metavar="K",
        help="which of the sequence's own in STRETCHES; default: 1",
    )
    parser.add_argument("--runs", type=whole(), default=50)
    parser.add_argument(
        "--particles",
        type=whole(),
        metavar="N",
        help="default: 300 on the synthetic sequence, or 200",
    )
    parser.add_argument(
        "--lambdas", type=positive, nargs="+", metavar="λ", help="default: 20 30 40 50, or 20"
    )
    parser.add_argument(
        "--methods", nargs="+", choices=list(METHODS), metavar="NAME", default=list(METHODS),
        help=f"of {', '.join(METHODS)}; default: all",
    )  # fmt: skip
    parser.add_argument("--seed", type=seed, default=0, help="of the filters")
    parser.add_argument(
        "--scene", type=seed, help=f"key of the synthetic sequence; default: {SCENE}"
    )
    parser.add_argument("--out", type=Path, default=Path("results/partitioned_sampling"))
    options = parser.parse_args(arguments)
    real = options.sequence is not None
    options.lambdas = options.lambdas or (REAL_LAMBDAS if real else LAMBDAS)
    if options.particles is None:
        options.particles = REAL_NUM_PARTICLES if real else NUM_PARTICLES
    chosen = bool(options.ids or options.frames)
    if not real and chosen:
        parser.error("--ids, --frames: without --sequence there is nothing to choose")
    has_stretches = real and options.sequence.name in STRETCHES and not chosen
    why = "but with a --sequence in STRETCHES and without --ids and --frames"
    fill_in(parser, options, has_stretches, why, stretch=1)
    fill_in(parser, options, not real, "with --sequence", scene=SCENE)
    return options


def open_scene(options: argparse.Namespace) -> Scene:
    """The synthetic sequence, or a stretch of a real one."""
    if options.sequence is None:
        return synthetic_scene(options.scene)
    named = STRETCHES.get(options.sequence.name, [])
    if named and not (options.ids or options.frames):
        if options.stretch > len(named):
            raise ValueError(f"--stretch: {options.stretch} of {len(named)}")
        return real_scene(options.sequence, named[options.stretch - 1])
    ids = tuple(dict.fromkeys(options.ids or ()))
    return real_scene(options.sequence, Stretch(ids, options.frames or "1:", ids[0] if ids else 0))


def synthetic_scene(key: int) -> Scene:
    """The seven objects of section 3.2 and their distracter."""
    scene = distracter_scene(jax.random.key(key))
    model = joint_colour_model(scene.frames[0], scene.boxes[0], templates={0: scene.template})
    name = "synthetic sequence" + ("" if key == SCENE else f" of key {key}")
    return Scene(name, scene.frames, 1, scene.boxes, 0, model, np.array(PAPER_DEVIATIONS[:2]))


def real_scene(folder: Path, stretch: Stretch) -> Scene:
    """A stretch of a sequence with a gt.txt; steps deviate in proportion to the frame's width."""
    first, last = frames.parse_range(stretch.frames, "--frames")
    if not folder.is_dir():
        raise ValueError(f"--sequence: {folder} is not a folder")
    stills = np.stack(list(frames.read_frames(folder, first, last)))
    rows = box_files.read_tracks(folder / "gt.txt")
    started = box_files.boxes_of_frame(rows, first)
    ids = stretch.ids or tuple(sorted(started))
    missing = [id for id in ids if id not in started]
    if missing or not ids:
        raise ValueError(f"--ids: gt.txt has no box of {missing or 'any object'} in frame {first}")
    truth = np.full((len(stills), len(ids), 4), np.nan)
    for t in range(len(stills)):
        own = box_files.boxes_of_frame(rows, first + t)
        for j, id in enumerate(ids):
            truth[t, j] = own.get(id, np.nan)
    deviations = np.array(PAPER_DEVIATIONS)
    deviations[:2] *= stills.shape[2] / PAPER_WIDTH
    model = joint_colour_model(stills[0], truth[0], deviations=tuple(deviations.tolist()))
    span = f"{first}-{first + len(stills) - 1}"
    name = f"{folder.name}, objects {', '.join(map(str, ids))}, frames {span}"
    hard = ids.index(stretch.occluded) if stretch.occluded in ids else 0
    return Scene(name, stills, first, truth, hard, model, deviations[:2])


def run(options: argparse.Namespace) -> None:
    """All tables of one scene; what is there is written after every row."""
    scene = open_scene(options)
    which = (options.particles, options.methods)
    # Numbers that do not fit come to light here, before anything compiles.
    num_rows = len(options.lambdas) * len(filters(scene, options.lambdas[0], *which))
    settings: dict[str, Any] = {
        "source": scene.name,
        "frames": [scene.first, scene.first + len(scene.stills) - 1],
        "hard_object": scene.hard + 1,
        "orders": "objects in the order in which they move, counted from 1",
        "num_particles": options.particles,
        "runs": options.runs,
        "seed": options.seed,
        "scene": options.scene,
    }
    path = options.out / "partitioned_sampling.json"
    rows: list[Row] = []
    started = time.perf_counter()
    with tqdm(total=num_rows, desc=scene.name, unit="row", disable=None) as bar:
        for row in study(scene, options.lambdas, *which, options.runs, options.seed):
            rows.append(row)
            settings["seconds"] = round(time.perf_counter() - started, 1)
            content = content_of(scene, rows)
            write_json(path, {"settings": settings} | content)
            bar.update()
    print_tables(scene.name, scene.hard, scene.truth.shape[1], content)
    write_pictures(options.out, scene, rows, content)
    print(f"{settings['seconds']} s; written to {options.out}")


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    return exit_status(lambda: run(parse_arguments(arguments)))


if __name__ == "__main__":
    sys.exit(main())
