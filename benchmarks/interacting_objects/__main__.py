"""Beyond partitioned sampling: joint filters of objects that are lost, distracted, or cross.

Random scenes with a likelihood that stands in for colour histograms, at the same number of
likelihood evaluations for every filter. `python -m benchmarks.interacting_objects`; `--help`
lists the options.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from matplotlib.figure import Figure

import mpfjax
from benchmarks import harness
from benchmarks.harness import Count, command
from benchmarks.interacting_objects import scenes as made
from benchmarks.interacting_objects.partitions import adaptive_partitions, independent_partitions
from benchmarks.interacting_objects.scenes import BOX, NUM_FRAMES, SCENES, SHARPNESS, Scene
from mpfjax.metrics.tracking_quality import recovery_rate, track_state

REPULSION = 2 * SHARPNESS  # so that sharing a place never pays; none from a box's side on
RUNS_AT_ONCE = 20


def dps(reassembly: str) -> Callable[..., mpfjax.Filter]:
    return lambda model, n: mpfjax.distributed_partitioned_sampling(model, n, None, reassembly)


def crossing(model: mpfjax.MultiObjectModel, num_particles: int) -> mpfjax.Filter:
    """Shared-proposal crossing of all objects in one cluster."""
    return mpfjax.clustered_particle_filter(model, num_particles, start="together")


def splitting(model: mpfjax.MultiObjectModel, num_particles: int) -> mpfjax.Filter:
    """Clusters that part after five steps without contact, an approximation."""
    return mpfjax.clustered_particle_filter(model, num_particles, split_after=5)


def adaptive_with_draws(model: mpfjax.MultiObjectModel, num_particles: int) -> mpfjax.Filter:
    """Adaptive partitions with five points in each row, so up to five times the likelihoods."""
    return adaptive_partitions(model, num_particles, num_draws=5)


METHODS: dict[str, tuple[str, Callable[..., mpfjax.Filter]]] = {
    "joint": ("joint PF", mpfjax.particle_filter),
    "ps": ("PS", mpfjax.partitioned_sampling),
    "dps_prior": ("DPS, prior", dps("prior")),
    "dps_evidence": ("DPS, evidence", dps("evidence")),
    "independent": ("independent", mpfjax.independent_particle_filters),
    "independent_partitions": ("independent partitions", independent_partitions),
    "adaptive": ("adaptive partitions", adaptive_partitions),
    "adaptive_draws": ("adaptive partitions, K = 5", adaptive_with_draws),
    "crossing": ("one cluster", crossing),
    "clusters": ("clusters", mpfjax.clustered_particle_filter),
    "splitting": ("clusters that split", splitting),
}
ONE_BY_ONE = ("crossing", "clusters", "splitting")
ESTIMATES = ("median", "mean")
NUM_LAST = 3  # frames at the end in which who has recovered is tracked


@command(runs=2, scenes=["e"], methods=["ps", "independent"])
def main(
    *,
    runs: Count = 200,
    seed: harness.Seed = 0,
    scenes: Sequence[Annotated[str, (*SCENES,)]] = (*SCENES,),
    methods: Sequence[Annotated[str, (*METHODS,)]] = (*METHODS,),
    out: Path = Path("results/interacting_objects"),
) -> None:
    """Run the study, print its tables, and write its results and figure.

    - `runs`: random scenes, one run in each.
    - `seed`: of the scenes and the runs.
    """
    settings = harness.settings_of(locals())
    results: list[dict[str, Any]] = []
    with ThreadPoolExecutor(max_workers=2) as pool:  # one compiles while another runs
        futures = {
            (scene, method): pool.submit(run_method, method, SCENES[scene], runs, seed)
            for scene in scenes
            for method in methods
        }
        try:
            for scene, method in harness.grid("cell", scenes, methods):
                results += entries(scene, method, futures[scene, method].result(), runs)
                harness.data(out / "interacting_objects.json", settings=settings, results=results)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    for estimate in ESTIMATES:
        print(as_table(results, estimate), end="\n\n")
    for scene in scenes:
        print(f"{scene}: {SCENES[scene].title}; N = {SCENES[scene].num_particles}")
    harness.figures(out, interacting_objects=draw(results))
    print(f"results and figure: {out}/")


@eqx.filter_jit
def run_all(
    make: Callable[..., mpfjax.Filter],
    num_particles: int,
    keys: Key[Array, " runs"],
    scenes: Scene,
    orders: Array | None,
    runs_at_once: int | None,
) -> dict[str, Float[Array, "runs t objects 2"]]:
    """The estimates of one run of the filter in each scene."""

    def run(inputs: tuple) -> dict[str, Float[Array, "t objects 2"]]:
        key, scene, order = inputs
        num_objects = scene.places.shape[1]
        blobs = made.Blob(scene.places[0], 2 * scene.places[0] - scene.places[1])
        repulsion = mpfjax.PairwiseRepulsion(REPULSION, BOX, made.place_of)
        model = mpfjax.MultiObjectModel(blobs, num_objects, repulsion, per_object=True)
        filter = make(model, num_particles) if order is None else make(model, num_particles, order)
        seen = jax.tree.map(lambda leaf: leaf[1:], scene.seen)
        return mpfjax.run_filter(key, filter, seen, estimates).collected

    return jax.lax.map(run, (keys, scenes, orders), batch_size=runs_at_once)


def estimates(mixture: mpfjax.ParticleMixture) -> dict[str, Float[Array, "objects 2"]]:
    """The mean and the component-wise median of the particles."""
    places = mixture.particles["now"]
    order = jnp.argsort(places, axis=0)
    upto = jnp.cumsum(mixture.weights[order], axis=0)
    middle = jnp.sum(upto < 0.5, axis=0, keepdims=True)
    ranked = jnp.take_along_axis(places, order, axis=0)
    median = jnp.take_along_axis(ranked, jnp.minimum(middle, len(places) - 1), axis=0)[0]
    return {"mean": mixture.average(places), "median": median}


def run_method(
    method: str, setting: made.Setting, num_runs: int, seed: int
) -> dict[str, np.ndarray]:
    """Whether each object is tracked, by each estimate: (orders, runs, t, objects)."""
    key_scenes, key_runs = jax.random.split(jax.random.key(seed))
    scenes = jax.vmap(setting.make)(jax.random.split(key_scenes, num_runs))
    keys = jax.random.split(key_runs, num_runs)
    num_orders, orders = 1, None
    if method == "ps":
        num_orders = setting.num_objects
        shifts = jnp.arange(num_orders)[:, None] + jnp.arange(num_orders)[None]
        orders = jnp.repeat(shifts.astype(jnp.int32) % num_orders, num_runs, axis=0)
        scenes = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * num_orders), scenes)
        keys = jnp.concatenate([keys] * num_orders)
    # What a cluster filter need not do it skips, but not for many runs side by side.
    runs_at_once = None if method in ONE_BY_ONE else RUNS_AT_ONCE
    make = METHODS[method][1]
    found = run_all(make, setting.num_particles, keys, scenes, orders, runs_at_once)
    truth = boxes(scenes.places[:, 1:])
    shape = (num_orders, num_runs, NUM_FRAMES - 1, setting.num_objects)
    return {
        name: np.asarray(track_state(boxes(found[name]), truth)).reshape(shape)
        for name in ESTIMATES
    }


def boxes(centres: Float[Array, "*batch 2"]) -> Float[Array, "*batch 4"]:
    """(x, y, w, h), the top-left corner first."""
    return jnp.concatenate([centres - BOX / 2, jnp.full_like(centres, BOX)], axis=-1)


# --- recovery rates with their intervals ---------------------------------------------------------


def entries(
    scene: str, method: str, tracked: dict[str, np.ndarray], num_runs: int
) -> list[dict[str, Any]]:
    """The lines of the results that a method makes of a scene; PS its best and its mean order.

    A line has the recovery rate of the objects in question, all at once.
    """
    setting, label = SCENES[scene], METHODS[method][0]
    by_order = {}
    for name in ESTIMATES:  # of orders, runs, t, objects
        together = jnp.asarray(tracked[name][..., list(setting.hard)].all(axis=-1))
        by_order[name] = [float(recovery_rate(states, num_last=NUM_LAST)) for states in together]

    def line(method: str, label: str, summary: Callable, num: int) -> dict[str, Any]:
        recovery = {
            name: {"rate": float(summary(rates)), "by_order": rates,
                   "interval": harness.wilson(float(summary(rates)), num, z=1.96)}
            for name, rates in by_order.items()
        }  # fmt: skip
        head = {"scene": scene, "method": method, "label": label, "runs": num}
        return head | {"recovery": recovery}

    if method != "ps":
        return [line(method, label, max, num_runs)]
    return [
        line("ps_best", "PS, best order", max, num_runs),
        line("ps_mean", "PS, mean of orders", np.mean, setting.num_objects * num_runs),
    ]


def as_table(results: list[dict[str, Any]], estimate: str) -> str:
    """Methods by scenes, each rate with its interval."""

    def cell(line: dict[str, Any]) -> str:
        low, high = line["recovery"][estimate]["interval"]
        return f"{line['recovery'][estimate]['rate']:.3f} [{low:.2f}, {high:.2f}]"

    return harness.pivot(f"recovery, {estimate}", results, "{label}", "{scene}", cell)


def draw(results: list[dict[str, Any]]) -> Figure:
    """A panel for each scene: every method's rate and interval, by both estimates."""
    scenes = list(dict.fromkeys(line["scene"] for line in results))
    columns = min(len(scenes), 3)
    num_rows = -(-len(scenes) // columns)
    figure = Figure(figsize=(2.3 * columns + 1.8, 3.7 * num_rows), layout="constrained")
    panels = figure.subplots(num_rows, columns, sharey=True, squeeze=False).ravel()
    for panel in panels[len(scenes) :]:
        panel.set_axis_off()
    for panel, scene in zip(panels, scenes, strict=False):
        lines = [line for line in results if line["scene"] == scene]
        for estimate, shift, colour in (("median", -0.13, "C0"), ("mean", 0.13, "C1")):
            cells = [line["recovery"][estimate] for line in lines]
            rates = np.array([cell["rate"] for cell in cells])
            ends = np.array([cell["interval"] for cell in cells])
            at = np.arange(len(lines)) + shift
            panel.hlines(at, ends[:, 0], ends[:, 1], colors=colour, linewidth=2)
            panel.plot(rates, at, "o", color=colour, markersize=4, label=estimate)
        panel.set_title(fill(f"{scene}: {SCENES[scene].title}", 28), fontsize=9)
        panel.set_xlim(-0.03, 1.03)
        panel.grid(axis="x", alpha=0.3)
        panel.set_yticks(range(len(lines)), [line["label"] for line in lines])
        panel.set_xlabel("recovery rate")
    panels[0].invert_yaxis()
    panels[0].legend(fontsize=8, loc="lower left")
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
