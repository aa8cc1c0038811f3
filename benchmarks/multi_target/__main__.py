"""An unknown number of objects among clutter: `bernoulli_filter` beside a Gaussian mixture PHD.

    python -m benchmarks.multi_target

Scenes of 60 to 100 scans: twelve objects on straight lines among 60 false plots, after Vo and Vo.
They come from known spots, or from anywhere, then also such that no two are nearer than 57 m, or
seen by two radars whose p_D falls with the range. Ten objects turn, in range and bearing; two cross
or part; four meet (Williams 2015); and the linear scene of Xia et al. (2017), with their motion,
births and score, beside whose figures it stands in the guide. Where all is linear and objects may
appear anywhere, `--peers` adds Stone Soup's JPDA with belief propagation, at up to minutes a run.

Twelve are also seen by two sensors with a field of view each, and five go in a convoy. A Gaussian
Poisson multi-Bernoulli filter is the same recursion in closed form. A Kalman filter that is told
which plots are whose shows the error of the plots alone.

`distance` is the mean of OSPA, and for the published scene of GOSPA, both of order 1; `number`
is the mean of |number told - true one|, the median of its distribution here and the expected one,
rounded, of GM-PHD; `switches` are those of a run, `ms a scan` the median of the runs after the
first, in CPU time.

Into --out DIR go multi_target.json and multi_target.png, the first run of the first scene.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import cycle, product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks import harness
from benchmarks.harness import AtLeast2, Count, command
from benchmarks.multi_target import gaussian_pmb, gm_phd, known, stone_soup
from benchmarks.multi_target.scenes import PLACE, SCENES, Scene, drawn, model_of, told

CELLS = {
    "distance": "{distance:.3g} ± {distance_error:.1g}",
    "of GM-PHD's": "{share:.2f}",
    "number": "{number:.2f} ± {number_error:.2f}",
    "switches": "{switches:.1f}",
    "ms a scan": "{ms:.1f}",
}
OURS, PMB, PHD = "bernoulli_filter", "Gaussian PMB", "GM-PHD"
KNOWN, JPDA = "known plots", "JPDA"


class Found(NamedTuple):
    """What a filter tells at each step."""

    places: np.ndarray  # (t, m, 2)
    is_told: np.ndarray  # (t, m)
    numbers: np.ndarray  # of objects
    labels: np.ndarray = np.zeros(0)  # none of a rival
    expected: np.ndarray = np.zeros(0)
    existence: np.ndarray = np.zeros(0)


Run = Callable[[int, tuple[np.ndarray, ...]], Found]


@command(seeds=2, steps=10, particles_per_target=20, scenes=["known spots"])
def main(
    *,
    scenes: Sequence[Annotated[str, (*SCENES,)]] = (*SCENES,),
    seeds: AtLeast2 = 20,
    steps: Count = 100,
    particles_per_target: Count = 150,
    peers: bool = False,
    out: Path = Path("results/multi_target"),
) -> None:
    """Scene by scene.

    - `particles_per_target`: of 24 that may exist; where objects appear anywhere, a third of it of
      12 more than a scan has plots.
    - `peers`: Stone Soup's JPDA too.
    """
    settings, rows = harness.settings_of(locals()), []
    for name in scenes:
        scene = SCENES[name]
        data = [drawn(scene, seed, steps) for seed in range(seeds)]
        filters = {
            OURS: _ours(scene, particles_per_target),
            PMB: _of(lambda _, scans, scene=scene: gaussian_pmb.followed(scene, scans)),
            PHD: _of(lambda _, scans, scene=scene: gm_phd.followed(scene, scans)),
            KNOWN: _of(lambda seed, _, scene=scene: known.followed(scene, seed, steps)),
        }
        if peers and stone_soup.applies(scene):
            filters[JPDA] = _of(lambda _, scans, scene=scene: stone_soup.followed(scene, scans))
        for label, run in filters.items():
            scores = []
            for seed, (truth, scans) in enumerate(data):
                start = time.process_time()
                found = run(seed, scans)
                spent = (time.process_time() - start) / len(truth) * 1e3
                scores.append([*_scores(scene, found, truth), spent])
                if seed == 0 and label == OURS and name == scenes[0]:
                    harness.figures(out, multi_target=_picture(truth, scans[0], found))
            rows.append({"scene": name, "filter": label} | _means(np.array(scores)))
        phd = next(row["distance"] for row in rows[-len(filters) :] if row["filter"] == PHD)
        for row in rows[-len(filters) :]:
            row["share"] = row["distance"] / phd
        harness.data(out / "multi_target.json", settings=settings, rows=rows)
        print(f"\n{harness.table(None, rows)}", flush=True)
    for title, cell in CELLS.items():
        print(f"\n{harness.pivot(title, rows, '{scene}', '{filter}', cell)}")
    print(f"written to {out}")


def _ours(scene: Scene, each: int) -> Run:
    anywhere = scene.spots is None
    most, each = (scene.room + 12, max(each // 3, 1)) if anywhere else (24, each)
    filter = mpfjax.bernoulli_filter(model_of(scene), 400 + most * each, most)

    def run(seed: int, scans: tuple[np.ndarray, ...]) -> Found:
        given = [jnp.asarray(plots, jnp.float32) for plots in scans]
        observations = tuple(given) if len(given) > 1 else given[0]
        run = mpfjax.run_filter(
            jax.random.key(seed), filter, observations, collect=mpfjax.estimate_targets
        )
        told = jax.tree.map(np.asarray, run.collected)
        rest = (told.labels, told.expected_number, told.existence)
        return Found(told.means[..., PLACE], told.existence > 0.5, told.number, *rest)

    return run


def _of(follow: Callable) -> Run:
    """The same of another one, whose objects have no labels."""

    def run(seed: int, scans: tuple[np.ndarray, ...]) -> Found:
        places, numbers = zip(*follow(seed, scans), strict=True)
        most = max(1, *map(len, places))
        padded = np.stack([np.pad(each, ((0, most - len(each)), (0, 0))) for each in places])
        told = np.arange(most) < np.array([len(each) for each in places])[:, None]
        return Found(padded, told, np.array(numbers))

    return run


def _scores(scene: Scene, found: Found, truth: np.ndarray) -> tuple[float, float, float]:
    """Distance, error of the number, and switches; NaN without labels."""
    there, is_there = told(truth)

    metric = partial(getattr(mpfjax.metrics, scene.score), cutoff=scene.cutoff, exponent=1.0)
    steps = zip(found.places, there, found.is_told, is_there, strict=True)
    distances = [metric(places[a], true[b]).distance for places, true, a, b in steps]
    distance = np.mean(distances)
    error, switches = np.mean(np.abs(found.numbers - is_there.sum(axis=1))), np.nan
    if found.labels.size:
        shown = np.where(found.is_told[..., None], found.places, np.nan)
        true = np.where(is_there[..., None], there, np.nan)
        switches = mpfjax.metrics.track_switches(shown, found.labels, true, cutoff=scene.cutoff)
    return float(distance), float(error), switches


def _means(scores: np.ndarray) -> dict[str, float | None]:
    """Over the runs, and their standard errors."""
    distance, number, switches, ms = scores.T
    row = {"switches": switches.mean(), "ms": np.median(ms[1:])}
    for name, values in (("distance", distance), ("number", number)):
        row[name], row[f"{name}_error"] = harness.mean_and_error(values)
    return {name: float(value) if np.isfinite(value) else None for name, value in row.items()}


def _picture(truth: np.ndarray, plots: np.ndarray, found: Found) -> Any:
    """Tracks through the plots, and the number over time."""
    from matplotlib.figure import Figure

    from mpfjax.plotting import COLOURS

    figure = Figure((10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    marks: Any = {"color": "0.7", "markersize": 1, "zorder": 0, "label": "measurements"}
    left.plot(*plots.reshape(-1, 2).T, ".", **marks)
    there, is_there = told(truth)
    for k in range(there.shape[1]):
        path = there[is_there[:, k], k].T
        left.plot(*path, color="k", linewidth=0.8, zorder=3, label=None if k else "true path")
    labels, steps = np.unique(found.labels[found.is_told]), np.arange(1, len(truth) + 1)
    # More labels than colours: the next ones are hollow.
    styles = cycle(product(("full", "none"), COLOURS))
    for k, (label, (filling, colour)) in enumerate(zip(labels, styles, strict=False)):
        own = found.is_told & (found.labels == label)
        style: Any = {"color": colour, "fillstyle": filling, "ms": 3, "mew": 0.6}
        left.plot(*found.places[own].T, "o", **style, label=None if k else "tracks, by label")
    left.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3, frameon=False, markerscale=3)
    left.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")

    shares = np.cumsum(jax.vmap(mpfjax.number_distribution)(jnp.asarray(found.existence)), axis=1)
    low, high = ((shares < q).sum(axis=1) for q in (0.1, 0.9))
    right.fill_between(steps, low, high, color=COLOURS[0], alpha=0.3, linewidth=0, step="mid")
    right.step(steps, is_there.sum(axis=1), color="k", where="mid", label="true")
    right.plot(steps, found.expected, color=COLOURS[0], label="expected, 10 to 90%")
    right.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2, frameon=False)
    right.set(xlabel="scan", ylabel="number of objects", ylim=(0, None))
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
