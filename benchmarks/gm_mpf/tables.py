"""Table 1 of the paper beside ours, and the errors of every filter."""

import numpy as np

from benchmarks.gm_mpf import sizes
from benchmarks.gm_mpf.filters import NAMES
from benchmarks.gm_mpf.runs import Step, errors, held, summary
from benchmarks.gm_mpf.targets import Targets
from mpfjax.console import format_table

PAPER_MILLISECONDS = {
    "pf": (1.68, 0.046), "gpf": (1.52, 0.028), "mpf": (1.82, 0.034), "gm_mpf": (1.75, 0.019)
}  # fmt: skip


def timing_table(elapsed: dict[str, list[float]], paper: bool) -> str:
    """Mean and standard deviation of each filter, and its ratio to the first, the PF."""
    mean = {name: float(np.mean(times)) for name, times in elapsed.items()}
    first = next(iter(elapsed))
    rows = []
    for name, times in elapsed.items():
        row = [NAMES[name], f"{mean[name]:.3f} ± {np.std(times):.3f}"]
        row.append(f"{mean[name] / mean[first]:.3f}")
        row.append(f"{np.median(times) / np.median(elapsed[first]):.3f}")
        if paper:
            row.append("{:.2f} ± {:.3f}".format(*PAPER_MILLISECONDS[name]))
            row.append(f"{PAPER_MILLISECONDS[name][0] / PAPER_MILLISECONDS[first][0]:.3f}")
        rows.append(row)
    header = ["filter", "ms a frame", "ratio of means", "of medians"]
    return format_table(header + (["paper's ms", "paper's ratio"] if paper else []), rows)


def study_table(
    found: dict[str, dict[int, Step]], targets: Targets, references: dict[str, np.ndarray]
) -> str:
    """RMSE of each target and what of it is Monte Carlo error, who holds both, and mean N_eff."""
    rows = []
    for name, by_size in found.items():
        for size, step in by_size.items():
            means, stds = summary(step, targets)
            own = ["", ""]
            if name in references:
                own = [f"{e:.2f}" for e in errors(step.estimates, references[name]).mean((0, 1))]
            rows.append(
                [
                    f"{NAMES[name]}, N = {size}",
                    *(f"{m:.2f} ± {s:.2f}" for m, s in zip(means, stds, strict=True)),
                    *own,
                    f"{held(step, targets.truth).mean():.2f}",
                    f"{step.effective_sample_size.mean():.1f}",
                ]
            )
    far = f"from N = {sizes.REFERENCE_PARTICLES}"
    header = [
        "filter", "RMSE 1 [px]", "RMSE 2 [px]", f"1 {far}", f"2 {far}", "both held", "N_eff"
    ]  # fmt: skip
    return format_table(header, rows)
