"""Figures 1 and 2 of Vermaak et al. (2003), section 5.1: who keeps both modes, and with how many
particles. Run with `python -m benchmarks.score_vs_particles`; `--help` lists the options.
"""

import argparse
import functools
import shutil
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import mpfjax
from benchmarks import figures as plotting
from mpfjax.console import exit_status, format_table, seed, whole, write_figure, write_json
from mpfjax.exact import grid_filter
from mpfjax.metrics import mass_above, modes_represented

PERIOD = 100
AMPLITUDE = 2.0
NUM_STEPS = 100
RADIUS = 0.3
SIGMA = 0.1
LOW, HIGH = -2.5, 2.5
GRID = (-4.0, 4.0, 1601)
TYPICAL_NUM_PARTICLES = 100
SEEDS_AT_ONCE = 100
MOST_SHARED_SLOTS = 1000

LABELS = {
    "pf": "particle filter",
    "mpf": "mixture particle filter",
    "guided_mpf": "guided mixture particle filter",
    "gpf": "Gaussian particle filter",
    "gm_mpf": "Gaussian mixture particle filter",
}
OF_THE_PAPER = ["pf", "mpf", "guided_mpf"]
OF_PARTICLES = ("positions", "occupied", "component_indicators")


def main(arguments: list[str] | None = None) -> int:
    """Run the study, print its table, and write its results and figures."""
    options = parse(arguments)
    return exit_status(lambda: run(options), arguments)


def run(options: argparse.Namespace) -> None:
    """All of it; with --resume, a run that was broken off goes on where it was."""
    out = Path(options.out)
    model = mpfjax.QuadraticModel(SIGMA, SIGMA, LOW, HIGH)
    truth, observations = simulate(options.data_seed)
    exact_mass = np.asarray(grid_filter(model, observations, jnp.linspace(*GRID)).mass_above(0.0))

    def write(cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
        results = [
            summarise(cell["filter"], cell["num_particles"], cell, exact_mass) for cell in cells
        ]
        content = {"settings": settings_of(options), "results": results}
        write_json(out / "score_vs_particles.json", content)
        return results

    unfinished = out / "unfinished"
    study = study_of(options, model, truth, observations)
    try:
        # One cell compiles while the one before it runs.
        cells = mpfjax.run_study(
            study,
            unfinished,
            resume=options.resume,
            seeds_at_once=SEEDS_AT_ONCE,
            cells_at_once=2,
            slots=shared_slots(options.particles),
        )
    except KeyboardInterrupt:
        write(mpfjax.read_study(unfinished))
        raise
    results = write(cells)
    print(as_table(results))
    typical = {
        cell["filter"]: typical_run(cell)
        for cell in cells
        if cell["num_particles"] == typical_size(options.particles)
    }
    figures = {
        "typical_run": plotting.draw_typical_run(
            typical, np.asarray(truth), np.asarray(observations), LABELS
        ),
        "score_vs_particles": plotting.draw_scores(results, LABELS),
    }
    for stem, figure in figures.items():
        write_figure(out / f"{stem}.png", figure, dpi=150)
    # The next run is to show what the code does then, not what it did now.
    shutil.rmtree(unfinished)
    print(f"results and figures: {out}/")


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.score_vs_particles")
    parser.add_argument(
        "--seeds", type=whole(), default=20, help="runs of each filter at each size"
    )
    parser.add_argument(
        "--particles", type=whole(2), nargs="+", default=[20, 50, 100, 200, 500, 1000], metavar="N"
    )
    parser.add_argument("--filters", nargs="+", choices=list(LABELS), default=OF_THE_PAPER)
    parser.add_argument(
        "--components", type=whole(), default=2, metavar="M", help="the most that a mixture has"
    )
    parser.add_argument(
        "--regroup-every", type=whole(), default=1, metavar="K", help="steps, not at every one"
    )
    parser.add_argument("--out", default="results/score_vs_particles", metavar="DIR")
    parser.add_argument(
        "--resume", action="store_true", help="take over what an interrupted run has finished"
    )
    parser.add_argument("--seed", type=seed, default=0, help="of all the runs")
    parser.add_argument(
        "--data-seed",
        type=seed,
        default=2,
        help="of the noise in the one data set; how hard it is differs much from draw to draw",
    )
    return parser.parse_args(arguments)


def simulate(seed: int) -> tuple[Float[Array, " t"], Float[Array, " t"]]:
    """The true state, a sinusoid that the model did not draw, and y_1..y_t, one set for all."""
    times = jnp.arange(1.0, NUM_STEPS + 1)
    truth = AMPLITUDE * jnp.sin(2 * jnp.pi * times / PERIOD)
    noise = jax.random.normal(jax.random.fold_in(jax.random.key(seed), 0), truth.shape)
    return truth, truth**2 + SIGMA * noise


def build(
    name: str,
    model: mpfjax.QuadraticModel,
    mixture: dict[str, Any],
    num_particles: int,
) -> mpfjax.Filter:
    """The filter of that name; `mixture` are the options of those that are mixtures.

    Components have equal numbers of particles, and x_0 is drawn once, as in the paper.
    """
    if name == "pf":
        return mpfjax.particle_filter(model, num_particles)
    regeneration = mpfjax.GaussianRegeneration(noise="stratified")
    if name == "gpf":
        return mpfjax.gaussian_particle_filter(model, num_particles, regeneration=regeneration)
    if name == "gm_mpf":
        return mpfjax.gaussian_mixture_particle_filter(
            model, num_particles, regeneration=regeneration, **mixture
        )
    proposal = mpfjax.GaussNewtonProposal(model) if name == "guided_mpf" else None
    filter = mpfjax.mixture_particle_filter(model, num_particles, proposal=proposal, **mixture)
    filter = mpfjax.with_resampling(filter, mpfjax.Resample(allocation="equal"))
    filter = mpfjax.with_selected_start(filter, 1)
    return mpfjax.with_point_sets(filter) if name == "guided_mpf" else filter


def collect(mixture: mpfjax.ParticleMixture) -> dict[str, Array]:
    """What the scores and figures are computed from, after each step."""
    return {
        "positions": mixture.particles,
        "occupied": mixture.occupied,
        "component_indicators": mixture.component_indicators,
        "weight": mixture.mixture_weights[0],
        "components": jnp.sum(mixture.active.astype(jnp.int32)),
        "mass_above": mass_above(mixture, 0.0),
    }


def study_of(
    options: argparse.Namespace,
    model: mpfjax.QuadraticModel,
    truth: Float[Array, " t"],
    observations: Float[Array, " t"],
) -> mpfjax.Study:
    """All seeds of every filter at every size; particles are kept at the size of figure 1 only."""

    def measure(run: mpfjax.FilterRun) -> dict[str, Array]:
        particles = {k: run.collected[k] for k in OF_PARTICLES}
        kept = {k: values for k, values in run.collected.items() if k not in OF_PARTICLES}
        kept["both"] = both_represented(particles["positions"], particles["occupied"], truth)
        size = num_particles(run.final)
        if size == typical_size(options.particles):
            kept |= {k: values[..., :size] for k, values in particles.items()}
        return kept

    mixture: dict[str, Any] = {
        "max_components": options.components,
        "regroup_every": options.regroup_every,
        # As the tables were made.
        "regroup": [mpfjax.Merge(), mpfjax.Split(), mpfjax.KMeans()],
    }
    return mpfjax.Study(
        filters={name: functools.partial(build, name, model, mixture) for name in options.filters},
        num_particles=list(dict.fromkeys(options.particles)),
        keys=jax.random.split(jax.random.fold_in(jax.random.key(options.seed), 1), options.seeds),
        observations=observations,
        measure=measure,
        collect=collect,
    )


@jax.jit
def both_represented(
    positions: Float[Array, "s t n"], occupied: Bool[Array, "s t n"], truth: Float[Array, " t"]
) -> Bool[Array, "s t"]:
    """Whether both modes, at x*_t and -x*_t, are represented, at every step of every run."""
    modes = jnp.broadcast_to(jnp.stack([truth, -truth], axis=1)[None], (*positions.shape[:2], 2))
    return modes_represented(positions, occupied, modes, RADIUS).all(axis=-1)


def summarise(
    name: str, num_particles: int, runs: dict[str, np.ndarray], exact_mass: np.ndarray
) -> dict[str, Any]:
    """One entry of the results: scores, component one's weight, and the error of the modes' mass.

    The weight is taken over the steps at which a second component lives, where there are any: a
    merged mixture has a weight of one whatever the filter does.
    """
    two = runs["components"] > 1
    weights = runs["weight"][two] if two.any() else runs["weight"].ravel()
    error = runs["mass_above"] - exact_mass[None]
    return {
        "filter": name,
        "particles": num_particles,
        "scores": [float(score) for score in runs["both"].mean(axis=1)],
        "weight_mean": float(weights.mean()),
        "weight_std": float(weights.std()),
        "mode_mass_error": float(np.sqrt((error**2).mean())),
    }


def num_particles(runs: mpfjax.ParticleMixture) -> int:
    """N of these runs, which may have more slots."""
    usable = runs.usable_slots
    return runs.log_weights.shape[-1] if usable is None else int(usable[0])


def shared_slots(sizes: list[int]) -> int | None:
    """In how many slots all small filters run, so that their sizes need not compile one by one."""
    small = [n for n in sizes if n <= MOST_SHARED_SLOTS]
    return max(small) if len(small) > 1 else None


def typical_size(sizes: list[int]) -> int:
    """The size of figure 1, or the one nearest to it."""
    return min(sizes, key=lambda n: abs(n - TYPICAL_NUM_PARTICLES))


def typical_run(runs: dict[str, np.ndarray]) -> "plotting.ParticleHistory":
    """The particles of the run whose score is the median one."""
    scores = runs["both"].mean(axis=1)
    index = int(np.argsort(scores, kind="stable")[(len(scores) - 1) // 2])
    return plotting.ParticleHistory(
        positions=runs["positions"][index],
        occupied=runs["occupied"][index],
        component_indicators=runs["component_indicators"][index],
        score=float(scores[index]),
    )


def as_table(results: list[dict[str, Any]]) -> str:
    """The results in a table for the terminal."""
    rows = [
        [
            LABELS[entry["filter"]],
            str(entry["particles"]),
            f"{np.mean(entry['scores']):.3f} ± {np.std(entry['scores']):.3f}",
            f"{np.mean(np.array(entry['scores']) == 1):.3f}",
            f"{entry['weight_mean']:.2f} ± {entry['weight_std']:.2f}",
            f"{entry['mode_mass_error']:.3f}",
        ]
        for entry in sorted(results, key=lambda entry: list(LABELS).index(entry["filter"]))
    ]
    header = ["filter", "N", "score", "runs with score 1", "weight of one", "mode mass error"]
    return format_table(header, rows)


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """Everything that a second run needs to be the same."""
    return {
        "steps": NUM_STEPS,
        "amplitude": AMPLITUDE,
        "period": PERIOD,
        "sigma_x": SIGMA,
        "sigma_y": SIGMA,
        "initial": [LOW, HIGH],
        "radius": RADIUS,
        "max_components": options.components,
        "regroup_every": options.regroup_every,
        "seeds": options.seeds,
        "particles": options.particles,
        "filters": options.filters,
        "seed": options.seed,
        "data_seed": options.data_seed,
        "jax": jax.__version__,
        "mpfjax": mpfjax.__version__,
    }


if __name__ == "__main__":
    sys.exit(main())
