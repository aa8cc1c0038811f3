"""Figures 1 and 2 of Vermaak et al. (2003), section 5.1: who keeps both modes, and with how many
particles. Run with `python -m benchmarks.score_vs_particles`; `--help` lists the options.
"""

import functools
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import mpfjax
from benchmarks import figures as plotting
from benchmarks.harness import AtLeast2, Count, Seed, command, data, figures, settings_of, table
from mpfjax.exact import grid_filter

PERIOD = 100
AMPLITUDE = 2.0
NUM_STEPS = 100
RADIUS = 0.3
SIGMA = 0.1
LOW, HIGH = -2.5, 2.5
GRID = (-4.0, 4.0, 1601)
TYPICAL_NUM_PARTICLES = 100
MOST_SHARED_SLOTS = 1000

LABELS = {
    "pf": "particle filter",
    "mpf": "mixture particle filter",
    "guided_mpf": "guided mixture particle filter",
    "gpf": "Gaussian particle filter",
    "gm_mpf": "Gaussian mixture particle filter",
}
OF_THE_PAPER = ("pf", "mpf", "guided_mpf")
COLUMNS = {
    "filter": lambda entry: LABELS[entry["filter"]],
    "N": "{particles}",
    "score": lambda entry: f"{np.mean(entry['scores']):.3f} ± {np.std(entry['scores']):.3f}",
    "runs with score 1": lambda entry: f"{np.mean(np.array(entry['scores']) == 1):.3f}",
    "mixture weight": "{weight_mean:.2f} ± {weight_std:.2f}",
    "probability error": "{mode_mass_error:.3f}",
}
OF_PARTICLES = ("positions", "occupied", "component_indicators")


@command(seeds=3, particles=[20, 40], filters=list(LABELS))
def main(
    *,
    seeds: Count = 20,
    particles: Sequence[AtLeast2] = (20, 50, 100, 200, 500, 1000),
    filters: Sequence[Annotated[str, (*LABELS,)]] = OF_THE_PAPER,
    components: Count = 2,
    regroup_every: Count = 1,
    out: Path = Path("results/score_vs_particles"),
    resume: bool = False,
    seed: Seed = 0,
    data_seed: Seed = 2,
) -> None:
    """Run the study, print its table, and write its results and figures.

    - `seeds`: runs of each filter at each size.
    - `components`: the most that a mixture has.
    - `regroup_every`: steps, not at every one.
    - `resume`: take over what an interrupted run has finished.
    - `seed`: of all the runs.
    - `data_seed`: of the noise in the one data set; how hard it is differs much from draw to draw.
    """
    settings = settings_of(locals())
    model = mpfjax.QuadraticModel(SIGMA, SIGMA, LOW, HIGH)
    truth, observations = simulate(data_seed)
    exact_mass = np.asarray(grid_filter(model, observations, jnp.linspace(*GRID)).mass_above(0.0))
    typical_size = min(particles, key=lambda n: abs(n - TYPICAL_NUM_PARTICLES))
    small = [n for n in particles if n <= MOST_SHARED_SLOTS]
    mixture = {
        "max_components": components,
        "regroup_every": regroup_every,
        "regroup": [mpfjax.Merge(), mpfjax.Split(), mpfjax.KMeans()],
    }
    study = mpfjax.Study(
        filters={name: functools.partial(build, name, model, mixture) for name in filters},
        num_particles=list(dict.fromkeys(particles)),
        keys=jax.random.split(jax.random.fold_in(jax.random.key(seed), 1), seeds),
        observations=observations,
        measure=functools.partial(measure, truth, typical_size),
        collect=collect,
    )
    unfinished = out / "unfinished"
    # All small filters run in as many slots.
    slots = max(small) if len(small) > 1 else None
    cells = mpfjax.run_study(study, unfinished, resume=resume, num_slots=slots)
    results = [summarise(cell, exact_mass) for cell in cells]
    data(out / "score_vs_particles.json", settings=settings, results=results)
    print(table(COLUMNS, sorted(results, key=lambda entry: list(LABELS).index(entry["filter"]))))
    typical = {
        cell["filter"]: typical_run(cell) for cell in cells if cell["num_particles"] == typical_size
    }
    series = np.asarray(truth), np.asarray(observations)
    figures(
        out,
        typical_run=plotting.draw_typical_run(typical, *series, LABELS),
        score_vs_particles=plotting.draw_scores(results, LABELS),
    )
    # The next run is to show what the code does then, not what it did now.
    shutil.rmtree(unfinished)
    print(f"results and figures: {out}/")


def simulate(seed: int) -> tuple[Float[Array, " t"], Float[Array, " t"]]:
    """The true state, a sinusoid that the model did not draw, and y_1..y_t, one set for all."""
    times = jnp.arange(1.0, NUM_STEPS + 1)
    truth = AMPLITUDE * jnp.sin(2 * jnp.pi * times / PERIOD)
    noise = jax.random.normal(jax.random.fold_in(jax.random.key(seed), 0), truth.shape)
    return truth, truth**2 + SIGMA * noise


def build(
    name: str, model: mpfjax.QuadraticModel, mixture: dict[str, Any], num_particles: int
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
    proposal = mpfjax.GaussNewtonProposal() if name == "guided_mpf" else None
    filter = mpfjax.mixture_particle_filter(model, num_particles, proposal=proposal, **mixture)
    filter = mpfjax.with_resampling(filter, mpfjax.Resample(allocation="equal"))
    filter = mpfjax.with_initial_selection(filter, 1)
    return mpfjax.with_quasi_monte_carlo(filter) if name == "guided_mpf" else filter


def collect(mixture: mpfjax.ParticleMixture) -> dict[str, Array]:
    """What the scores and figures are computed from, after each step."""
    return {
        "positions": mixture.particles,
        "occupied": mixture.occupied,
        "component_indicators": mixture.component_indicators,
        "weight": mixture.mixture_weights[0],
        "components": jnp.sum(mixture.active.astype(jnp.int32)),
        "mass_above": mixture.expectation(mixture.particles > 0),
    }


def measure(
    truth: Float[Array, " t"], typical_size: int, run: mpfjax.FilterRun
) -> dict[str, Array]:
    """What is kept of the runs of a cell; particles at the size of figure 1 only."""
    particles = {k: run.collected[k] for k in OF_PARTICLES}
    values_of = {k: values for k, values in run.collected.items() if k not in OF_PARTICLES}
    values_of["both"] = both_represented(particles["positions"], particles["occupied"], truth)
    usable = run.final.usable_slots  # N, where there are more slots
    size = run.final.log_weights.shape[-1] if usable is None else int(usable[0])
    if size == typical_size:
        values_of |= {k: values[..., :size] for k, values in particles.items()}
    return values_of


@jax.jit
def both_represented(
    positions: Float[Array, "s t n"], occupied: Bool[Array, "s t n"], truth: Float[Array, " t"]
) -> Bool[Array, "s t"]:
    """Whether both modes, at x*_t and -x*_t, are represented, at every step of every run."""
    near = jnp.abs(positions[:, :, None] - jnp.stack([truth, -truth], 1)[None, ..., None]) < RADIUS
    return (near & occupied[:, :, None]).any(axis=-1).all(axis=-1)


def summarise(runs: dict[str, Any], exact_mass: np.ndarray) -> dict[str, Any]:
    """One entry of the results: scores, component one's weight, and the error of the modes' mass.

    The weight is taken over the steps at which a second component lives, where there are any: a
    merged mixture has a weight of one whatever the filter does.
    """
    two = runs["components"] > 1
    weights = runs["weight"][two] if two.any() else runs["weight"].ravel()
    error = runs["mass_above"] - exact_mass[None]
    return {
        "filter": runs["filter"],
        "particles": runs["num_particles"],
        "scores": [float(score) for score in runs["both"].mean(axis=1)],
        "weight_mean": float(weights.mean()),
        "weight_std": float(weights.std()),
        "mass_mean": float(runs["mass_above"].mean()),
        "mass_std": float(runs["mass_above"].std()),
        "mode_mass_error": float(np.sqrt((error**2).mean())),
    }


def typical_run(runs: dict[str, np.ndarray]) -> dict[str, Any]:
    """The particles of the run whose score is the median one."""
    scores = runs["both"].mean(axis=1)
    index = int(np.argsort(scores, kind="stable")[(len(scores) - 1) // 2])
    return {"score": scores[index]} | {name: runs[name][index] for name in OF_PARTICLES}


if __name__ == "__main__":
    raise SystemExit(main())
