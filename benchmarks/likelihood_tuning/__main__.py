"""Which gradients of a filter's likelihood can be trusted, and what `fit` learns with them.

The tasks that PyDPF's examples publish, stochastic volatility and a linear-Gaussian model of 25
dimensions, against exact scores and maxima. Run with `python -m benchmarks.likelihood_tuning`;
`--help` lists the options.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from benchmarks import harness
from benchmarks.harness import Count, Seed, command
from benchmarks.likelihood_tuning import many_dimensions, volatility

PARTS = ("gradients", "shifts", "learned", "coverage", "many_dimensions")


@command(runs=10, series=4, data_sets=1, steps=2, dimensions=9, methods=["pooled"])
def main(
    *,
    parts: Sequence[Annotated[str, (*PARTS,)]] = PARTS,
    runs: Count = 200,
    methods: Sequence[Annotated[str, (*volatility.METHODS,)]] = (*volatility.METHODS,),
    series: Count = 250,
    data_sets: Count = 10,
    steps: Count = volatility.NUM_STEPS,
    dimensions: Count = 25,
    seed: Seed = 0,
    out: Path = Path("results/likelihood_tuning"),
) -> None:
    """Part by part; what is finished is written.

    - `parts`: gradients, the shift of the maximum, learned parameters and coverage of their
      intervals for stochastic volatility; the filters in many dimensions.
    - `runs`: seeds for each estimator.
    - `methods`: of `fit`, on stochastic volatility.
    - `series`: of each data set of stochastic volatility; a fifth of it for coverage.
    - `steps`: of `fit` on each of the `data_sets`.
    - `dimensions`: of the linear-Gaussian model.
    """
    settings = harness.settings_of(locals())
    tables = {
        "gradients": lambda: volatility.gradients(methods, runs, seed),
        "shifts": lambda: volatility.shifts(methods, series, max(runs // 5, 2), seed),
        "learned": lambda: volatility.learned(methods, series, data_sets, steps, seed),
        "coverage": lambda: volatility.coverage(
            methods, max(series // 5, 1), data_sets, steps, seed
        ),
        "many_dimensions": lambda: many_dimensions.errors(dimensions, runs // 10, seed),
    }
    for part in parts:
        title, table, entries = tables[part]()
        harness.data(out / f"{part}.json", settings=settings, results=entries)
        print(f"{title}\n{table}\n")
    print(f"results: {out}/")


if __name__ == "__main__":
    raise SystemExit(main())
