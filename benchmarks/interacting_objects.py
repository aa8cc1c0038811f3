"""Beyond partitioned sampling: joint filters of objects that are lost, distracted, or cross.

Random scenes with a likelihood that stands in for colour histograms, at the same number of
likelihood evaluations for every filter. `python -m benchmarks.interacting_objects`; `--help`
lists the options.
"""

import argparse
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key
from matplotlib.figure import Figure
from tqdm import tqdm

import mpfjax
from mpfjax.console import format_table, seed, whole, write_json
from mpfjax.metrics.tracking_quality import recovery_rate, track_state

# The scenes' constants, chosen once for all methods. Pixels and frames.
BOX = 20.0  # sides of every object's box
NUM_FRAMES = 32
MOMENTUM, DEVIATION = 0.5, 3.0  # AR2, as in the paper
SHARPNESS = 20.0  # λ
REACH = 8.0  # over which a box that is shifted stops looking like its object
UNLIKE = 0.2  # how much an object looks like one of another kind
REPULSION = 2 * SHARPNESS  # so that sharing a place never pays; none from a box's side on
LOST = slice(12, 22)  # unseen in these frames
JUMP = 42.0  # from where the lost object was last seen to where it comes back
DISTRACTED = slice(3, 9)  # the distracter covers object 0 in the first of these frames
LEAD = 6.0  # by which it leads away in a frame
LIKENESS = 0.8  # of object 0 to its own reference, which the distracter fits exactly
MISSED = 0.2  # the share of frames in which one of a pair is not seen
PASSING = (40.0, 9.0)  # where one of a pair comes from and how far off the middle line it passes
NUM_LAST = 3  # frames at the end in which who has recovered is tracked
RUNS_AT_ONCE = 20


class Scene(NamedTuple):
    """One random scene: where the objects are, and what is seen of them."""

    places: Float[Array, "t objects 2"]
    seen: dict[str, Array]  # every leaf (t, objects, ...)


class Setting(NamedTuple):
    """A kind of scene and what is asked of it."""

    title: str
    num_objects: int
    num_particles: int
    hard: tuple[int, ...]  # the objects that have to be tracked at the end
    make: Callable[[Key[Array, ""]], Scene]


class Blob(mpfjax.AbstractStateSpaceModel):
    """An object that moves by AR2 and is seen as a bump, among the bumps of others.

    The states are {"now": x_t, "before": x_{t-1}}, each (n, 2). log L = -λ d², where d² is one
    minus the largest a_k exp(-|x - o_k|² / 2s²) over the bumps k: it has no floor but λ, as a
    histogram distance has none but one.
    """

    start: Float[Array, "*objects 2"]
    before: Float[Array, "*objects 2"]

    def sample_initial(self, key, num_particles):
        shift = 2.0 * jax.random.normal(key, (num_particles, 2))
        return {"now": self.start[None] + shift, "before": self.before[None] + shift}

    def sample_transition(self, key, states):
        noise = DEVIATION * jax.random.normal(key, states["now"].shape)
        return {"now": expected(states) + noise, "before": states["now"]}

    def log_transition(self, states, previous_states):
        return -0.5 * squares(states["now"] - expected(previous_states)) / DEVIATION**2

    def with_history(self, states, previous_states):
        return {"now": states["now"], "before": previous_states["now"]}

    def log_likelihood(self, observation, states):
        bumps = jax.vmap(
            lambda place, height: (
                height * jnp.exp(-0.5 * squares(states["now"] - place[None]) / REACH**2)
            )
        )(observation["places"], observation["heights"])
        return -SHARPNESS * (1 - jnp.max(bumps, axis=0))


def expected(states: dict[str, Float[Array, "n 2"]]) -> Float[Array, "n 2"]:
    """x_{t-1} + 0.5 (x_{t-1} - x_{t-2})."""
    return states["now"] + MOMENTUM * (states["now"] - states["before"])


def squares(vectors: Float[Array, "n 2"]) -> Float[Array, " n"]:
    """|v|² of every row, written out."""
    return vectors[:, 0] ** 2 + vectors[:, 1] ** 2


def place_of(states: dict[str, Float[Array, "n 2"]]) -> Float[Array, "n 2"]:
    """Where an object is, for the repulsion."""
    return states["now"]


# Scenes


def wander(key: Key[Array, ""], starts: Float[Array, "objects 2"]) -> Float[Array, "t objects 2"]:
    """Paths that the model itself might have drawn; frame 0 is x_0."""
    noise = DEVIATION * jax.random.normal(key, (NUM_FRAMES, *starts.shape))

    def move(states, noise):
        now, before = states
        return (now + MOMENTUM * (now - before) + noise, now), now

    return jax.lax.scan(move, (starts, starts), noise)[1]


def grid(num_objects: int, spacing: float) -> Float[Array, "objects 2"]:
    """Places in rows of four."""
    index = np.arange(num_objects)
    return jnp.asarray(spacing * np.stack([index % 4, index // 4], axis=1), jnp.float32)


def jump(key: Key[Array, ""], path: Float[Array, "t 2"]) -> Float[Array, "t 2"]:
    """The path of an object that is displaced, in any direction, while nobody sees it."""
    angle = jax.random.uniform(key, (), maxval=2 * jnp.pi)
    away = JUMP * jnp.array([jnp.cos(angle), jnp.sin(angle)])
    last, back = LOST.start - 1, LOST.stop
    share = jnp.clip((jnp.arange(float(NUM_FRAMES)) - last) / (back - last), 0.0, 1.0)
    hidden = path[last][None] + share[:, None] * away[None]
    after = path[last] + away - path[back]
    moved = jnp.where((jnp.arange(float(NUM_FRAMES)) >= back)[:, None], path + after[None], hidden)
    return jnp.where((jnp.arange(float(NUM_FRAMES)) <= last)[:, None], path, moved)


def cross(key: Key[Array, ""], centre: Float[Array, "2"]) -> Float[Array, "t 2 2"]:
    """Two objects that come from two sides, linger side by side, and pass each other."""
    key_angle, key_noise = jax.random.split(key)
    angle = jax.random.uniform(key_angle, (), maxval=2 * jnp.pi)
    u = (jnp.arange(float(NUM_FRAMES)) - (NUM_FRAMES - 1) / 2) / ((NUM_FRAMES - 1) / 2)
    along, aside = PASSING[0] * u**3, jnp.full(NUM_FRAMES, PASSING[1])
    turned = jnp.stack(
        [
            jnp.cos(angle) * along - jnp.sin(angle) * aside,
            jnp.sin(angle) * along + jnp.cos(angle) * aside,
        ],
        axis=1,
    )
    noise = 0.5 * jax.random.normal(key_noise, (NUM_FRAMES, 2, 2))
    return centre[None, None] + jnp.stack([turned, -turned], axis=1) + noise


def look(
    places: Float[Array, "t objects 2"],
    visible: Bool[Array, "t objects"],
    alike: Float[np.ndarray, "objects objects"],
    distracter: Float[Array, "t 2"] | None = None,
) -> Scene:
    """What each object's likelihood sees: the bumps of all that look like it, and how much."""
    num_objects = places.shape[1]
    heights = jnp.where(visible[:, None, :], jnp.asarray(alike, jnp.float32)[None], 0.0)
    there = jnp.zeros((NUM_FRAMES, num_objects, 1))
    extra = jnp.zeros((NUM_FRAMES, 1, 2))
    if distracter is not None:
        heights = heights.at[:, 0, 0].multiply(LIKENESS)
        there = there.at[DISTRACTED, 0].set(1.0)
        extra = distracter[:, None]
    bumps = jnp.concatenate([places, extra], axis=1)
    seen = {
        "places": jnp.broadcast_to(bumps[:, None], (NUM_FRAMES, num_objects, *bumps.shape[1:])),
        "heights": jnp.concatenate([heights, there], axis=2),
    }
    return Scene(places, seen)


def kinds(*groups: int) -> Float[np.ndarray, "objects objects"]:
    """How much objects look alike, of groups of these sizes."""
    labels = np.repeat(np.arange(len(groups)), groups)
    return np.where(labels[:, None] == labels[None], 1.0, UNLIKE)


def everything_visible(num_objects: int) -> Bool[Array, "t objects"]:
    return jnp.ones((NUM_FRAMES, num_objects), bool)


def missed(key: Key[Array, ""], num_objects: int) -> Bool[Array, "t objects"]:
    """Who is seen when, with detections that fail now and then, but for the first frames."""
    visible = jax.random.bernoulli(key, 1 - MISSED, (NUM_FRAMES, num_objects))
    return visible | (jnp.arange(float(NUM_FRAMES)) < 3)[:, None]


def lost_object(key: Key[Array, ""]) -> Scene:
    key_paths, key_jump = jax.random.split(key)
    places = wander(key_paths, grid(4, 120.0))
    places = places.at[:, 3].set(jump(key_jump, places[:, 3]))
    return look(places, everything_visible(4).at[LOST, 3].set(False), kinds(1, 1, 1, 1))


def distracted_object(key: Key[Array, ""]) -> Scene:
    key_paths, key_angle = jax.random.split(key)
    places = wander(key_paths, grid(7, 120.0))
    angle = jax.random.uniform(key_angle, (), maxval=2 * jnp.pi)
    away = LEAD * (jnp.arange(float(NUM_FRAMES)) - DISTRACTED.start)
    direction = jnp.array([jnp.cos(angle), jnp.sin(angle)])
    distracter = places[DISTRACTED.start, 0][None] + away[:, None] * direction[None]
    visible = everything_visible(7).at[DISTRACTED.start, 0].set(False)
    return look(places, visible, kinds(*[1] * 7), distracter)


def crossing_pairs(key: Key[Array, ""]) -> Scene:
    keys = jax.random.split(key, 3)
    centres = jnp.array([[0.0, 0.0], [200.0, 0.0]])
    places = jnp.concatenate([cross(keys[i], centres[i]) for i in range(2)], axis=1)
    return look(places, missed(keys[2], 4), kinds(4))


def pair_and_lost(key: Key[Array, ""]) -> Scene:
    keys = jax.random.split(key, 4)
    pair = cross(keys[0], jnp.zeros(2))
    others = wander(keys[1], jnp.array([[200.0, 0.0], [0.0, 200.0]]))
    others = others.at[:, 1].set(jump(keys[2], others[:, 1]))
    places = jnp.concatenate([pair, others], axis=1)
    visible = missed(keys[3], 4).at[:, 2:].set(True).at[LOST, 3].set(False)
    return look(places, visible, kinds(2, 1, 1))


SCENES = {
    "a": Setting("one of four unseen, and back elsewhere", 4, 200, (3,), lost_object),
    "b": Setting("one of seven led away by a distracter", 7, 300, (0,), distracted_object),
    "c": Setting("two pairs of look-alikes cross", 4, 200, (0, 1, 2, 3), crossing_pairs),
    "d": Setting("one pair, one easy, one unseen", 4, 200, (0, 1, 2, 3), pair_and_lost),
    "e": Setting("as c, with half the particles", 4, 100, (0, 1, 2, 3), crossing_pairs),
}


# Filters


def dps(reassembly: str) -> Callable[..., mpfjax.Filter]:
    return lambda model, n: mpfjax.distributed_partitioned_sampling(model, n, None, reassembly)


def crossing(model: mpfjax.MultiObjectModel, num_particles: int) -> mpfjax.Filter:
    """Shared-proposal crossing of all objects in one cluster."""
    return mpfjax.clustered_particle_filter(model, num_particles, start="together")


def splitting(model: mpfjax.MultiObjectModel, num_particles: int) -> mpfjax.Filter:
    """Clusters that part after five steps without contact, an approximation."""
    return mpfjax.clustered_particle_filter(model, num_particles, split_after=5)


METHODS: dict[str, tuple[str, Callable[..., mpfjax.Filter]]] = {
    "joint": ("joint PF", mpfjax.particle_filter),
    "ps": ("PS", mpfjax.partitioned_sampling),
    "dps_prior": ("DPS, prior", dps("prior")),
    "dps_evidence": ("DPS, evidence", dps("evidence")),
    "independent": ("independent", mpfjax.independent_particle_filters),
    "crossing": ("one cluster", crossing),
    "clusters": ("clusters", mpfjax.clustered_particle_filter),
    "splitting": ("clusters that split", splitting),
}
ONE_BY_ONE = ("crossing", "clusters", "splitting")
ESTIMATES = ("median", "mean")


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
        blobs = Blob(scene.places[0], 2 * scene.places[0] - scene.places[1])
        repulsion = mpfjax.PairwiseRepulsion(REPULSION, BOX, place_of)
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


def run_method(method: str, setting: Setting, num_runs: int, seed: int) -> dict[str, np.ndarray]:
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


# Results


def summarise(tracked: Bool[np.ndarray, "orders runs t objects"], setting: Setting) -> list[float]:
    """The recovery rate of the objects in question, all at once, for each order."""
    together = jnp.asarray(tracked[..., list(setting.hard)].all(axis=-1))
    return [float(recovery_rate(states, num_last=NUM_LAST)) for states in together]


def wilson(rate: float, num_runs: int) -> list[float]:
    """The 95% interval of a rate (Wilson 1927)."""
    z = 1.96
    middle = (rate + z**2 / (2 * num_runs)) / (1 + z**2 / num_runs)
    half = z * np.sqrt(rate * (1 - rate) / num_runs + z**2 / (4 * num_runs**2))
    half /= 1 + z**2 / num_runs
    return [float(max(middle - half, 0.0)), float(min(middle + half, 1.0))]


def entries(
    scene: str, method: str, tracked: dict[str, np.ndarray], num_runs: int
) -> list[dict[str, Any]]:
    """The lines of the results that a method makes of a scene; PS its best and its mean order."""
    setting, label = SCENES[scene], METHODS[method][0]
    rates = {name: summarise(tracked[name], setting) for name in ESTIMATES}
    if method != "ps":
        return [entry(scene, method, label, {k: v[0] for k, v in rates.items()}, num_runs, rates)]
    best = {name: max(values) for name, values in rates.items()}
    mean = {name: float(np.mean(values)) for name, values in rates.items()}
    num = setting.num_objects * num_runs
    return [
        entry(scene, "ps_best", "PS, best order", best, num_runs, rates),
        entry(scene, "ps_mean", "PS, mean of orders", mean, num, rates),
    ]


def entry(
    scene: str,
    method: str,
    label: str,
    rates: dict[str, float],
    num_runs: int,
    by_order: dict[str, list[float]],
) -> dict[str, Any]:
    return {
        "scene": scene,
        "method": method,
        "label": label,
        "runs": num_runs,
        "recovery": {
            name: {"rate": rate, "interval": wilson(rate, num_runs), "by_order": by_order[name]}
            for name, rate in rates.items()
        },
    }


def as_table(results: list[dict[str, Any]], estimate: str) -> str:
    """Methods by scenes, each rate with its interval."""
    scenes = list(dict.fromkeys(line["scene"] for line in results))
    labels = list(dict.fromkeys(line["label"] for line in results))
    cells = {(line["label"], line["scene"]): line["recovery"][estimate] for line in results}

    def text(cell: dict[str, Any]) -> str:
        low, high = cell["interval"]
        return f"{cell['rate']:.3f} [{low:.2f}, {high:.2f}]"

    rows = [[label, *(text(cells[label, scene]) for scene in scenes)] for label in labels]
    return format_table([f"recovery, {estimate}", *scenes], rows)


def draw(results: list[dict[str, Any]]) -> Figure:
    """A panel for each scene: every method's rate and interval, by both estimates."""
    scenes = list(dict.fromkeys(line["scene"] for line in results))
    figure = Figure(figsize=(3.0 * len(scenes) + 1.5, 3.6), layout="constrained")
    panels = figure.subplots(1, len(scenes), sharey=True, squeeze=False)[0]
    for panel, scene in zip(panels, scenes, strict=True):
        lines = [line for line in results if line["scene"] == scene]
        for estimate, shift, colour in (("median", -0.13, "C0"), ("mean", 0.13, "C1")):
            cells = [line["recovery"][estimate] for line in lines]
            rates = np.array([cell["rate"] for cell in cells])
            ends = np.array([cell["interval"] for cell in cells])
            at = np.arange(len(lines)) + shift
            panel.hlines(at, ends[:, 0], ends[:, 1], colors=colour, linewidth=2)
            panel.plot(rates, at, "o", color=colour, markersize=4, label=estimate)
        panel.set_title(f"{scene}: {SCENES[scene].title}", fontsize=8)
        panel.set_xlim(-0.03, 1.03)
        panel.grid(axis="x", alpha=0.3)
        panel.set_yticks(range(len(lines)), [line["label"] for line in lines])
        panel.set_xlabel("recovery rate")
    panels[0].invert_yaxis()
    panels[-1].legend(fontsize=8, loc="lower left")
    return figure


# Running


def main(arguments: list[str] | None = None) -> int:
    """Run the study, print its tables, and write its results and figure."""
    options = parse(arguments)
    out = Path(options.out)
    cells = [(scene, method) for scene in options.scenes for method in options.methods]
    results: list[dict[str, Any]] = []
    with ThreadPoolExecutor(max_workers=2) as pool:  # one compiles while another runs
        futures = [
            pool.submit(run_method, method, SCENES[scene], options.runs, options.seed)
            for scene, method in cells
        ]
        try:
            for (scene, method), future in zip(
                cells, tqdm(futures, disable=not sys.stderr.isatty(), unit="cell"), strict=True
            ):
                results += entries(scene, method, future.result(), options.runs)
                content = {"settings": settings_of(options), "results": results}
                write_json(out / "interacting_objects.json", content)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            print(f"interrupted: {len(results)} lines are in {out}", file=sys.stderr)
            return 130
    for estimate in ESTIMATES:
        print(as_table(results, estimate), end="\n\n")
    for scene in options.scenes:
        print(f"{scene}: {SCENES[scene].title}; N = {SCENES[scene].num_particles}")
    draw(results).savefig(out / "interacting_objects.png", dpi=150)
    print(f"results and figure: {out}/")
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.interacting_objects")
    parser.add_argument("--runs", type=whole(), default=200, help="random scenes, one run in each")
    parser.add_argument("--seed", type=seed, default=0, help="of the scenes and the runs")
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--out", default="results/interacting_objects", metavar="DIR")
    return parser.parse_args(arguments)


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """Everything that a second run needs to be the same."""
    return {
        "runs": options.runs,
        "seed": options.seed,
        "particles": {scene: SCENES[scene].num_particles for scene in options.scenes},
        "box": BOX,
        "frames": NUM_FRAMES,
        "momentum": MOMENTUM,
        "deviation": DEVIATION,
        "lambda": SHARPNESS,
        "reach": REACH,
        "unlike": UNLIKE,
        "repulsion": REPULSION,
        "lost": [LOST.start, LOST.stop],
        "jump": JUMP,
        "distracted": [DISTRACTED.start, DISTRACTED.stop],
        "lead": LEAD,
        "likeness": LIKENESS,
        "missed": MISSED,
        "passing": list(PASSING),
        "last_frames": NUM_LAST,
        "jax": jax.__version__,
        "mpfjax": mpfjax.__version__,
    }


if __name__ == "__main__":
    sys.exit(main())
