"""How fast mpfjax is beside particles, blackjax and cuthbert, on the same jobs.

    python -m benchmarks.peers                        # whichever rivals are installed

A bootstrap filter with systematic resampling at every step, for all seeds; mean, effective sample
size and log-likelihood come out. Each library works in a process of its own, in the best way that
its pages document (`libraries`, `through_particles`); they take turns, so that what else the
machine does meets all alike. None is timed before its log-likelihoods and effective sample sizes
agree with mpfjax's, and with the exact log-likelihood. Into --out DIR go peers.json and peers.png.
"""

import importlib.util
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from scipy import stats

from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.harness import AtLeast2, Count, command
from benchmarks.peers.jobs import JOBS, Job, Quadratic
from benchmarks.peers.libraries import LIBRARIES, model_of
from benchmarks.peers.worker import process, run_once
from mpfjax.console import whole
from mpfjax.exact import grid_filter, kalman_filter

Run = Callable[[int], dict[str, Any]]
MOST_PARTICLES = {"quadratic": 1_000_000, "constant_velocity": 10_000}
LEVEL = 1e-5  # of each test: a hundred of them refuse one that is right once in a thousand runs
ROUNDING = 1e-4  # of float32 against float64, relative
MOST_SPREAD = 1.0  # nats; log-likelihoods that spread more are not close enough to normal


@command(particles=[64], seeds=10, repeats=2)
def main(
    *,
    particles: Sequence[AtLeast2] = (100, 1000, 10_000, 100_000),
    jobs: Sequence[Annotated[str, (*JOBS,)]] = (*JOBS,),
    seeds: Annotated[int, whole(3)] = 20,
    repeats: Count = 9,
    out: Path = Path("results/peers"),
) -> int:
    """All cells in turn, each written as it is finished; 1 where a library was refused.

    - `seeds`: runs of each filter, at once.
    - `repeats`: times that each cell is timed.
    """
    settings = harness.settings_of(locals())
    results: list[dict[str, Any]] = []
    for job in jobs:
        exact = exact_log_likelihood(JOBS[job])
        with ExitStack() as stack:
            pools = {name: stack.enter_context(process()) for name in chosen_libraries()}
            for size in sorted(particles):
                if size <= MOST_PARTICLES[job]:
                    runs = {
                        name: run_of(pool, name, job, size, seeds) for name, pool in pools.items()
                    }
                    cell = {"job": job, "particles": size}
                    results += [cell | entry for entry in time_cell(runs, exact, repeats)]
                harness.data(out / "peers.json", settings=settings, results=results)
    for job in jobs:
        print(as_tables(job, results), end="\n\n")
    harness.figures(out, peers=draw(results))
    print(f"results and figure: {out}/")
    return int(any(entry["refused"] for entry in results))


def chosen_libraries() -> list[str]:
    """The names of what runs, mpfjax first; says which rival is not installed."""
    specs = {name: importlib.util.find_spec(name.partition("_")[0]) for name in LIBRARIES}
    if missing := [name for name, spec in specs.items() if spec is None]:
        print(f"not installed, see docs/speed.md: {', '.join(missing)}", file=sys.stderr)
    return [name for name, spec in specs.items() if spec is not None]


def run_of(pool: ProcessPoolExecutor, name: str, job: str, size: int, seeds: int) -> Run:
    """A function of a seed: what a run in that process took, and what it found."""
    return lambda seed: pool.submit(run_once, name, job, size, seeds, seed).result()


def exact_log_likelihood(job: Job) -> float:
    """log p(y_1..y_t), by quadrature or by the Kalman filter."""
    model, observations = model_of(job), jnp.asarray(job.observations)
    if isinstance(job, Quadratic):
        run = grid_filter(model, observations, jnp.linspace(-4.0, 4.0, 1601))
    else:
        run = kalman_filter(model, observations)
    return float(run.log_marginal_likelihood)


# --- what is measured: whether a library gives mpfjax's answer, then its times, in turns ---------


def time_cell(libraries: Mapping[str, Run], exact: float, repeats: int) -> list[dict[str, Any]]:
    """One entry for each library: times in seconds, memory in MB above the imports'.

    The first run of each is checked and counts as its start; then they take turns in random
    order. One that is slow is timed less often.
    """
    runs_of: dict[str, list[dict[str, Any]]] = {name: [] for name in libraries}
    reasons: dict[str, str | None] = {}
    for name, run in libraries.items():
        try:
            runs_of[name].append(run(0))
            reasons[name] = disagreement(runs_of[name][0], runs_of["mpfjax"][0], exact)
        except Exception as error:  # the others go on without a library that fails
            if name == "mpfjax":
                raise
            reasons[name] = f"{type(error).__name__}: {error}"
        if reasons[name] is not None:
            print(f"{name} is not timed: {reasons[name]}", file=sys.stderr)
    timed = {
        name: lambda turn, name=name: runs_of[name].append(libraries[name](1 + turn))
        for name, reason in reasons.items()
        if reason is None
    }
    harness.turns(timed, repeats, warm_up=0, budget=20.0)
    entries: list[dict[str, Any]] = []
    for name, reason in reasons.items():
        entries.append({"library": name, "refused": reason, "median": None})
        if reason is None:
            entries[-1] |= of_runs(runs_of[name])
            entries[-1]["ratio"] = entries[-1]["median"] / entries[0]["median"]
    return entries


def of_runs(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """What the runs of a library took, of which the first one compiles, and what they found."""
    first, *others = runs
    seconds = [run["seconds"] for run in others]
    median = float(np.median(seconds))
    return {
        "version": first["version"], "seconds": seconds, "median": median,
        "start": max(first["seconds"] - median, 0.0), "memory": max(r["memory"] for r in runs),
        "log_likelihood_mean": float(np.mean(first["log_likelihoods"])),
        "log_likelihood_std": float(np.std(first["log_likelihoods"])),
        "effective_sample_size": float(np.mean(first["effective_sample_sizes"])),
    }  # fmt: skip


def disagreement(
    answer: Mapping[str, Any], reference: Mapping[str, Any], exact: float
) -> str | None:
    """Why these are not results of the same filter, or None.

    Welch's test of log-likelihoods and of effective sample sizes against the reference's. And, as
    E[Ẑ] = Z, log Ẑ + s²/2 against the exact log Z, where log Ẑ spreads little enough to be close
    to normal.
    """
    for what in ("log_likelihoods", "effective_sample_sizes"):
        ours, others = np.array(answer[what]), np.array(reference[what])
        if not np.isfinite(ours).all():
            return f"{what.replace('_', ' ')} that are not finite"
        gap = abs(ours.mean() - others.mean())
        if gap <= ROUNDING * max(1.0, abs(others.mean())):
            continue
        test: Any = stats.ttest_ind(ours, others, equal_var=False)
        if test.pvalue < LEVEL:
            return f"mean {what.replace('_', ' ')} {ours.mean():.6g}, not {others.mean():.6g}"
    estimates = np.array(answer["log_likelihoods"])
    number, variance = len(estimates), estimates.var(ddof=1)
    if variance > MOST_SPREAD**2:
        return None
    gap = abs(estimates.mean() + variance / 2 - exact)
    error = np.sqrt(variance / number + variance**2 / (2 * (number - 1)))
    limit = stats.t.isf(LEVEL / 2, number - 1) * error + ROUNDING * max(1.0, abs(exact))
    return f"log-likelihood {estimates.mean():.6g}, exactly {exact:.6g}" if gap > limit else None


# --- tables and picture -------------------------------------------------------------------------


def as_tables(job: str, results: list[dict[str, Any]]) -> str:
    """Times with their ratios to mpfjax's, and below them starts and memory."""
    rows = [entry for entry in results if entry["job"] == job]
    forms = {"median [ms], ratio": _time, "start [s], memory [MB]": _start}
    name = lambda entry: LIBRARIES[entry["library"]]  # noqa: E731
    tables = [
        harness.pivot(title, rows, name, "N = {particles}", form) for title, form in forms.items()
    ]
    return "\n\n".join([JOBS[job].title, *tables])


def _time(entry: Mapping[str, Any]) -> str:
    if entry["refused"]:
        return "refused"
    return f"{1000 * entry['median']:.4g} {entry['ratio']:6.2f}"


def _start(entry: Mapping[str, Any]) -> str:
    # What particles' other processes take is not seen from the first.
    is_seen = entry["library"] != "particles_2"
    return f"{entry['start']:.1f} " + (f"{entry['memory']:5.0f}" if is_seen else "    -")


def draw(results: list[dict[str, Any]]) -> Any:
    """Time against N, a panel for each job and a line for each library."""
    panels = []
    for job in dict.fromkeys(entry["job"] for entry in results):
        rows = [e for e in results if e["job"] == job and e["median"] is not None]
        # The median of the repeats, and where the middle half of them lies.
        quartiles = [lambda e, q=q: 1000 * np.quantile(e["seconds"], q) for q in (0.5, 0.25, 0.75)]
        name = lambda e: LIBRARIES[e["library"]]  # noqa: E731
        lines = plotting.lines_of(rows, name, "particles", *quartiles)
        title = f"{JOBS[job].title}, {JOBS[job].num_steps} steps"
        axes = "number of particles $N$", "time of all runs (ms)"
        panels.append(plotting.Panel(title, *axes, lines))
    return plotting.draw_panels([panels])


if __name__ == "__main__":
    raise SystemExit(main())
