"""How fast mpfjax is beside particles, blackjax and cuthbert, on the same jobs.

    python -m benchmarks.peers                        # whichever rivals are installed
    python -m benchmarks.peers --devices 2            # and mpfjax on two host devices

A bootstrap filter with systematic resampling at every step, for all seeds; mean, effective sample
size and log-likelihood come out. Each library works in a process of its own, in the best way that
its pages document (`libraries`, `through_particles`); they take turns, so that what else the
machine does meets all alike. None is timed before its log-likelihoods and effective sample sizes
agree with mpfjax's, and with the exact log-likelihood. Into --out DIR go peers.json and peers.png.
"""

import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from scipy import stats

from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.harness import AtLeast2, Count, Positive, command
from benchmarks.peers.jobs import JOBS, Job, Quadratic
from benchmarks.peers.libraries import LIBRARIES, model_of
from benchmarks.peers.worker import Worker, library_at_work, stop_all
from mpfjax.console import whole
from mpfjax.exact import grid_filter, kalman_filter

RIVALS = {  # and how each is installed
    # particles 0.4 asks for numpy below 2, works with 2, and would take JAX back to 0.7.
    "particles": "pip install joblib numba scikit-learn; pip install --no-deps particles",
    "blackjax": "pip install blackjax",
    "cuthbert": "pip install cuthbert",
}
ON_DEVICES = "mpfjax_devices"
MOST_PARTICLES = {"quadratic": 1_000_000, "constant_velocity": 10_000}
GRID = (-4.0, 4.0, 1601)
START_SECONDS = 120.0
LEVEL = 1e-5  # of each test: a hundred of them refuse one that is right once in a thousand runs
ROUNDING = 1e-4  # of float32 against float64, relative
MOST_SPREAD = 1.0  # nats; log-likelihoods that spread more are not close enough to normal
SLOW_SECONDS, FEWEST_REPEATS = 20.0, 3


@command(particles=[64], seeds=10, repeats=2)
def main(
    *,
    particles: Sequence[AtLeast2] = (100, 1000, 10_000, 100_000),
    jobs: Sequence[Annotated[str, (*JOBS,)]] = (*JOBS,),
    seeds: Annotated[int, whole(3)] = 20,
    repeats: Count = 9,
    skip: Sequence[Annotated[str, (*RIVALS,)]] = (),
    devices: Count = 1,
    time_limit: Positive = 600.0,
    out: Path = Path("results/peers"),
) -> int:
    """All cells in turn, each written as it is finished; 1 where a library was refused.

    - `seeds`: runs of each filter, at once.
    - `repeats`: times that each cell is timed.
    - `skip`: libraries.
    - `devices`: mpfjax on so many, beside on one.
    - `time_limit`: seconds, of one run.
    """
    settings = harness.settings_of(locals())
    results: list[dict[str, Any]] = []
    found: dict[str, Any] = {}
    for job in jobs:
        exact = exact_log_likelihood(JOBS[job])
        workers = {name: start(name, job, devices) for name in chosen_libraries(skip, devices)}
        try:
            for name, worker in list(workers.items()):
                found[name] = worker.answer(START_SECONDS)
                if "error" in found[name]:
                    drop(workers, name, found[name]["error"])
            for size in sorted(particles):
                if size <= MOST_PARTICLES[job]:
                    request = {"particles": size, "seeds": seeds}
                    cell = time_cell(workers, request, exact, repeats, time_limit)
                    results += [{"job": job, "particles": size} | entry for entry in cell]
                harness.data(
                    out / "peers.json", settings=settings, libraries=found, results=results
                )
        finally:
            stop_all(workers.values())
    labels = LIBRARIES | {ON_DEVICES: f"mpfjax, {devices} devices"}
    for job in jobs:
        print(as_tables(job, results, labels), end="\n\n")
    harness.figures(out, peers=draw(results, labels))
    print(f"results and figure: {out}/")
    return int(any(entry["refused"] for entry in results))


def chosen_libraries(skip: Sequence[str], num_devices: int) -> list[str]:
    """The names of what runs, mpfjax first; says which rival is not installed."""
    chosen = ["mpfjax"] + ([ON_DEVICES] if num_devices > 1 else [])
    for name, how in RIVALS.items():
        if name in skip:
            continue
        if importlib.util.find_spec(name) is None:
            print(f"{name} is not installed and left out: {how}", file=sys.stderr)
            continue
        chosen += ["particles", "particles_2"] if name == "particles" else [name]
    return chosen


def start(name: str, job: str, num_devices: int) -> Worker:
    """The process of a library; those of all start side by side."""
    if name == ON_DEVICES:
        return Worker(library_at_work, "mpfjax", job, num_devices)
    return Worker(library_at_work, name, job, 1 if name == "mpfjax" else None)


def exact_log_likelihood(job: Job) -> float:
    """log p(y_1..y_t), by quadrature or by the Kalman filter."""
    model, observations = model_of(job), jnp.asarray(job.observations)
    if isinstance(job, Quadratic):
        return float(grid_filter(model, observations, jnp.linspace(*GRID)).log_marginal_likelihood)
    return float(kalman_filter(model, observations).log_marginal_likelihood)


# --- what is measured: whether a library gives mpfjax's answer, then its times, in turns ---------


def drop(workers: dict[str, Worker], name: str, reason: str) -> None:
    """Go on without a library that failed; not without mpfjax."""
    workers.pop(name).stop()
    if name == "mpfjax":
        raise ValueError(f"mpfjax: {reason}")
    print(f"{name} failed and is left out from here on: {reason}", file=sys.stderr)


def time_cell(
    workers: dict[str, Worker], request: dict[str, int], exact: float, repeats: int, limit: float
) -> list[dict[str, Any]]:
    """One entry for each library: times in seconds, memory in bytes above the imports'.

    The first run of each is checked and counts as its start; then they take turns in random
    order. One that is slow is timed less often.
    """
    order, runs = np.random.default_rng(0), {name: [] for name in workers}
    reasons: dict[str, str | None] = {}
    for turn in range(1 + repeats):
        for name in list(workers) if turn == 0 else order.permutation(list(workers)).tolist():
            own = [found["seconds"] for found in runs[name][1:]]
            slow = sum(own) > SLOW_SECONDS and len(own) >= FEWEST_REPEATS
            if slow or reasons.get(name) is not None:
                continue
            found = workers[name].run(limit, **request, seed=turn)
            if "error" in found:
                drop(workers, name, found["error"])
                continue
            runs[name].append(found)
            if turn == 0:
                reasons[name] = disagreement(found, runs["mpfjax"][0], exact)
                if reasons[name] is not None:
                    size = request["particles"]
                    print(f"N = {size}: {name} is not timed: {reasons[name]}", file=sys.stderr)
    entries: list[dict[str, Any]] = []
    for name, reason in reasons.items():
        first, *others = runs[name]
        seconds = [found["seconds"] for found in others]
        median = float(np.median(seconds)) if seconds else None
        base = entries[0]["median"] if entries else median
        entries.append({
            "library": name, "refused": reason, "seconds": seconds, "median": median,
            "ratio": None if median is None or base is None else median / base,
            "start": None if median is None else max(first["seconds"] - median, 0.0),
            # What particles' other processes take is not seen from the first.
            "memory": None if name == "particles_2" else max(r["memory"] for r in runs[name]),
            "log_likelihood_mean": float(np.mean(first["log_likelihoods"])),
            "log_likelihood_std": float(np.std(first["log_likelihoods"])),
            "effective_sample_size": float(np.mean(first["effective_sample_sizes"])),
        })  # fmt: skip
    return entries


def disagreement(
    found: Mapping[str, Any], reference: Mapping[str, Any], exact: float
) -> str | None:
    """Why these are not results of the same filter, or None.

    Welch's test of log-likelihoods and of effective sample sizes against the reference's. And, as
    E[Ẑ] = Z, log Ẑ + s²/2 against the exact log Z, where log Ẑ spreads little enough to be close
    to normal.
    """
    for what in ("log_likelihoods", "effective_sample_sizes"):
        ours, others = np.array(found[what]), np.array(reference[what])
        if not np.isfinite(ours).all():
            return f"{what.replace('_', ' ')} that are not finite"
        gap = abs(ours.mean() - others.mean())
        if gap <= ROUNDING * max(1.0, abs(others.mean())):
            continue
        test: Any = stats.ttest_ind(ours, others, equal_var=False)
        if test.pvalue < LEVEL:
            return f"mean {what.replace('_', ' ')} {ours.mean():.6g}, not {others.mean():.6g}"
    estimates = np.array(found["log_likelihoods"])
    number, variance = len(estimates), estimates.var(ddof=1)
    if variance > MOST_SPREAD**2:
        return None
    gap = abs(estimates.mean() + variance / 2 - exact)
    error = np.sqrt(variance / number + variance**2 / (2 * (number - 1)))
    limit = stats.t.isf(LEVEL / 2, number - 1) * error + ROUNDING * max(1.0, abs(exact))
    return f"log-likelihood {estimates.mean():.6g}, exactly {exact:.6g}" if gap > limit else None


# --- tables and picture -------------------------------------------------------------------------


def as_tables(job: str, results: list[dict[str, Any]], labels: Mapping[str, str]) -> str:
    """Times with their ratios to mpfjax's, and below them starts and memory."""
    own = [entry | {"label": labels[entry["library"]]} for entry in results if entry["job"] == job]
    forms = {"median [ms], ratio": _time, "start [s], memory [MB]": _start}
    tables = [
        harness.pivot(title, own, "{label}", "N = {particles}", form)
        for title, form in forms.items()
    ]
    return "\n\n".join([JOBS[job].title, *tables])


def _time(entry: Mapping[str, Any]) -> str:
    if entry["refused"]:
        return "refused"
    return f"{1000 * entry['median']:.4g} {entry['ratio']:6.2f}"


def _start(entry: Mapping[str, Any]) -> str:
    memory = "-" if entry["memory"] is None else f"{entry['memory'] / 1e6:.0f}"
    return f"{entry['start']:.1f} {memory:>5}"


def draw(results: list[dict[str, Any]], labels: Mapping[str, str]) -> Any:
    """Time against N, a panel for each job and a line for each library; particles' faster mode."""
    panels = []
    for name in dict.fromkeys(entry["job"] for entry in results):
        lines: dict[str, dict[float, float]] = {}
        for entry in results:
            if entry["job"] == name and entry["median"] is not None:
                # The two modes have one line.
                library = entry["library"].removesuffix("_2")
                label = "particles" if library == "particles" else labels[library]
                line, size = lines.setdefault(label, {}), entry["particles"]
                line[size] = min(1000 * entry["median"], line.get(size, np.inf))
        title = f"{JOBS[name].title}, {JOBS[name].num_steps} steps"
        points = {label: list(line.items()) for label, line in lines.items()}
        axes = "number of particles $N$", "time of all runs [ms]"
        panels.append(plotting.Panel(title, *axes, points))
    return plotting.draw_panels([panels])


if __name__ == "__main__":
    raise SystemExit(main())
