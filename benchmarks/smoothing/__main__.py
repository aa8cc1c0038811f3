"""Smoothing, for one filter and for mixtures: modes, posteriors.

    python -m benchmarks.smoothing                     # both parts
    python -m benchmarks.smoothing --parts modes --seeds 50

- modes: the smoothed mass of one of two modes of equal mass, by PF and MPF.
- posteriors: σ_x and σ_y of the quadratic model by PMMH, particle Gibbs and SMC², beside the grid
  filter's; effective samples a second.

Into --out DIR go smoothing.json and posteriors.png.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpfjax
from benchmarks import harness
from benchmarks.harness import AtLeast2, Count, Seed, command
from benchmarks.peers.jobs import Quadratic
from benchmarks.smoothing import posteriors
from mpfjax.console import whole
from mpfjax.smoothing import sample_trajectories, trace_ancestors

NUM_TRAJECTORIES = 1000
# A mode counts as lost by a seed if its smoothed mass is below this at any time 0, ..., T.
LOST = 0.01


@command(steps=8, mode_particles=20, seeds=3, posterior_steps=20, posterior_particles=20)
def main(
    *,
    parts: Sequence[Literal["modes", "posteriors"]] = ("modes", "posteriors"),
    steps: AtLeast2 = 100,
    mode_particles: AtLeast2 = 200,
    seeds: Count = 200,
    posterior_particles: AtLeast2 = 100,
    posterior_steps: Annotated[int, whole(20)] = 2000,
    seed: Seed = 0,
    out: Path = Path("results/smoothing"),
) -> None:
    """Part by part; what is finished is written.

    - `steps`: T.
    - `seeds`: of modes.
    - `posterior_steps`: of each chain.
    """
    content: dict[str, Any] = {"settings": harness.settings_of(locals())}
    job = Quadratic(steps, seed)

    def finish(part: str, entries: list[dict[str, Any]], title: str, columns: Any = None) -> None:
        content[part] = entries
        harness.data(out / "smoothing.json", **content)
        print(f"\n{title}\n{harness.table(columns, entries)}")

    if "modes" in parts:
        title = f"mass of one of two modes, N = {mode_particles}, {seeds} seeds"
        title += f"\nlost by a seed: a mode whose smoothed mass is below {LOST:.0%} at some time"
        finish("modes", modes(job, mode_particles, seeds, seed), title)
    if "posteriors" in parts:
        truth = posteriors.exact(job)
        draws = posteriors.measure(job, posterior_particles, posterior_steps, seed)
        title = f"posterior of two parameters, N = {posterior_particles}, "
        title += f"chains of {posterior_steps} steps"
        finish("posteriors", posteriors.summary(truth, draws), title, posteriors.COLUMNS)
        harness.figures(out, dpi=130, posteriors=posteriors.picture(truth, draws))
    print(f"written to {out}")


# --- two modes of equal mass, smoothed: which methods keep both, at every time ----------------
# The quadratic model does not see the sign of the state, so that the smoothed mass of the positive
# mode is one half at every time, exactly.


def _guided(model: mpfjax.AbstractStateSpaceModel, num_particles: int) -> mpfjax.Filter:
    proposal = mpfjax.GaussNewtonProposal()
    return mpfjax.mixture_particle_filter(model, num_particles, 2, proposal=proposal, noise="rqmc")


FILTERS: dict[str, Callable[[mpfjax.AbstractStateSpaceModel, int], mpfjax.Filter]] = {
    "PF": mpfjax.particle_filter,
    "MPF": lambda model, num_particles: mpfjax.mixture_particle_filter(model, num_particles, 2),
    "guided MPF": _guided,
}


def modes(job: Quadratic, num_particles: int, seeds: int, seed: int) -> list[dict[str, Any]]:
    """For each filter and method, the error of a mode's mass, and how many seeds lost a mode."""
    model = mpfjax.QuadraticModel(job.sigma_x, job.sigma_y, job.low, job.high)
    observations = jnp.asarray(job.observations)
    keys = jax.random.split(jax.random.key(seed), seeds)
    entries = []
    for name, make in FILTERS.items():
        estimates = _smoothed(keys, make(model, num_particles), observations)
        for method, masses in zip(("genealogy", "backward sampling"), estimates, strict=True):
            values = np.asarray(masses)
            lost = np.minimum(values, 1 - values) < LOST
            errors = np.sqrt(np.mean((values - 0.5) ** 2, axis=0))
            entries.append({
                "filter and smoother": f"{name}, {method}", "RMS error": float(errors.mean()),
                "at its worst": float(errors.max()),
                "a mode lost": float(lost.any(axis=1).mean()),
                "lost at time 0": float(lost[:, 0].mean()),
            })  # fmt: skip
    return entries


@eqx.filter_jit
def _smoothed(keys: Any, filter: mpfjax.Filter, observations: Any) -> Any:
    def one(key: Any) -> tuple[Any, Any]:
        key_run, key_back = jax.random.split(key)
        run = mpfjax.run_filter(key_run, filter, observations)
        traced = run.final.expectation(trace_ancestors(run).trajectories > 0)
        paths = sample_trajectories(key_back, filter, run, NUM_TRAJECTORIES)
        return traced, jnp.mean(paths > 0, axis=0)

    return jax.lax.map(one, keys, batch_size=min(10, len(keys)))


if __name__ == "__main__":
    raise SystemExit(main())
