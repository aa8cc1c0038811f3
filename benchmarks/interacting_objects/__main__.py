"""Beyond partitioned sampling: joint filters of objects that are lost, distracted, or cross.

Random scenes with a likelihood that stands in for colour histograms, at the same number of
likelihood evaluations for every filter. `python -m benchmarks.interacting_objects`; `--help`
lists the options.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import mpfjax
from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.harness import Count, command
from benchmarks.interacting_objects import scenes as made
from benchmarks.interacting_objects.partitions import adaptive_partitions as adaptive
from benchmarks.interacting_objects.scenes import BOX, NUM_FRAMES, SCENES, SHARPNESS, Scene
from benchmarks.tracking_quality import recovery_rate, track_state
from mpfjax.moves.objects.clusters import PropagateInClusters

REPULSION = 2 * SHARPNESS  # so that sharing a place never pays; none from a box's side on
RUNS_AT_ONCE = 20
NUM_LAST = 3  # frames at the end in which who has recovered is tracked


def one_cluster(model: mpfjax.MultiObjectModel, num_particles: int) -> mpfjax.Filter:
    """The filter of clusters, with all objects in one from the start."""
    return mpfjax.Filter(model, [PropagateInClusters("together")], num_particles)


dps = mpfjax.distributed_partitioned_sampling
METHODS: dict[str, tuple[str, Callable[..., mpfjax.Filter]]] = {
    "joint": ("joint PF", mpfjax.particle_filter),
    "ps": ("PS, mean of orders", mpfjax.partitioned_sampling),
    "dps_prior": ("DPS, prior", partial(dps, reassembly="prior")),
    "dps_evidence": ("DPS, evidence", partial(dps, reassembly="evidence")),
    "independent": ("independent", mpfjax.independent_particle_filters),
    "independent_partitions": ("independent partitions", partial(adaptive, num_draws=None)),
    "adaptive": ("adaptive partitions", adaptive),
    # Five points in each row, so up to five times the likelihoods.
    "adaptive_draws": ("adaptive partitions, K = 5", partial(adaptive, num_draws=5)),
    "crossing": ("one cluster", one_cluster),
    "clusters": ("clusters", mpfjax.clustered_particle_filter),
}
ONE_BY_ONE = ("crossing", "clusters")


@command(runs=2, scenes=["e"], methods=["ps", "independent"])
def main(
    *,
    runs: Count = 200,
    seed: harness.Seed = 0,
    scenes: Sequence[Annotated[str, (*SCENES,)]] = (*SCENES,),
    methods: Sequence[Annotated[str, (*METHODS,)]] = (*METHODS,),
    out: Path = Path("results/interacting_objects"),
) -> None:
    """Run the study, print its table, and write its results and figure.

    - `runs`: random scenes, one run in each.
    - `seed`: of the scenes and the runs.
    """
    settings = harness.settings_of(locals())
    results: list[dict[str, Any]] = []
    for scene, method in harness.grid("cell", scenes, methods):
        results.append(entry(scene, method, run_method(method, SCENES[scene], runs, seed)))
        harness.data(out / "interacting_objects.json", settings=settings, results=results)
    cell = "{rate:.3f} [{interval[0]:.2f}, {interval[1]:.2f}]"
    print(harness.pivot("recovery, median", results, "{label}", "{scene}", cell), end="\n\n")
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
) -> Float[Array, "runs t objects 2"]:
    """The medians of one run of the filter in each scene."""

    def run(inputs: tuple) -> Float[Array, "t objects 2"]:
        key, scene, order = inputs
        num_objects = scene.places.shape[1]
        blobs = made.Blob(scene.places[0], 2 * scene.places[0] - scene.places[1])
        repulsion = mpfjax.PairwiseRepulsion(REPULSION, BOX, made.place_of)
        model = mpfjax.MultiObjectModel(blobs, num_objects, repulsion, per_object=True)
        filter = make(model, num_particles) if order is None else make(model, num_particles, order)
        measurements = jax.tree.map(lambda leaf: leaf[1:], scene.seen)
        return mpfjax.run_filter(key, filter, measurements, median).collected

    return jax.lax.map(run, (keys, scenes, orders), batch_size=runs_at_once)


def median(mixture: mpfjax.ParticleMixture) -> Float[Array, "objects 2"]:
    """The component-wise median of the particles."""
    places = mixture.particles["now"]
    order = jnp.argsort(places, axis=0)
    upto = jnp.cumsum(mixture.weights[order], axis=0)
    middle = jnp.sum(upto < 0.5, axis=0, keepdims=True)
    ranked = jnp.take_along_axis(places, order, axis=0)
    return jnp.take_along_axis(ranked, jnp.minimum(middle, len(places) - 1), axis=0)[0]


def run_method(method: str, setting: made.Setting, num_runs: int, seed: int) -> np.ndarray:
    """Whether the median of each object is on it: (orders, runs, t, objects)."""
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
    medians = run_all(make, setting.num_particles, keys, scenes, orders, runs_at_once)
    tracked = track_state(boxes(medians), boxes(scenes.places[:, 1:]))
    return np.asarray(tracked).reshape(num_orders, num_runs, NUM_FRAMES - 1, setting.num_objects)


def boxes(centres: Float[Array, "*batch 2"]) -> Float[Array, "*batch 4"]:
    """(x, y, w, h), the top-left corner first."""
    return jnp.concatenate([centres - BOX / 2, jnp.full_like(centres, BOX)], axis=-1)


# --- recovery rates with their intervals ---------------------------------------------------------


def entry(scene: str, method: str, tracked: np.ndarray) -> dict[str, Any]:
    """The line of the results that a method makes of a scene, of PS the mean of its orders.

    It has the recovery rate of the objects in question, all at once. The interval counts
    scenes, not orders, since runs of one scene depend on each other.
    """
    together = jnp.asarray(tracked[..., list(SCENES[scene].hard)].all(axis=-1))
    by_order = [float(recovery_rate(states, num_last=NUM_LAST)) for states in together]
    rate, num_runs = float(np.mean(by_order)), together.shape[1]
    return {
        "scene": scene, "method": method, "label": METHODS[method][0], "runs": num_runs,
        "rate": rate, "interval": harness.wilson(rate, num_runs, z=1.96), "by_order": by_order,
    }  # fmt: skip


def draw(results: list[dict[str, Any]]) -> Any:
    """A panel for each scene: every method's rate and interval."""

    def panel(scene: str) -> plotting.Panel:
        lines_of_scene = [line for line in results if line["scene"] == scene]
        ends = (lambda line, i=i: line["interval"][i] for i in (0, 1))
        label = "fraction of {runs} runs, 95% interval".format_map
        lines = plotting.lines_of(lines_of_scene, label, "label", "rate", *ends)
        return plotting.Panel(
            f"{scene}: {SCENES[scene].title}", "recovery", "", lines, (-0.05, 1.05)
        )

    return plotting.draw_dots([[panel(s) for s in dict.fromkeys(e["scene"] for e in results)]], 1.5)


if __name__ == "__main__":
    raise SystemExit(main())
