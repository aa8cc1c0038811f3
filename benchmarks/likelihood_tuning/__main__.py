"""Which gradients of a filter's likelihood can be trusted, and tuning by those that can.

Part a: bias, spread and time of every gradient estimator against exact scores. Part b: σ_x and
σ_y of the quadratic model tuned from random starts, against the exact maximum. Part c: a colour
likelihood tuned on labelled frames, and trackers with and without it on held-out ones. Run with
`python -m benchmarks.likelihood_tuning`; `--help` lists the options.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax

import mpfjax
from benchmarks.likelihood_tuning.labels import CLIMB_STEPS as LABEL_STEPS
from benchmarks.likelihood_tuning.labels import SEQUENCES, run_labels
from benchmarks.likelihood_tuning.scores import ESTIMATORS, FILTERS, MODELS, run_scores
from benchmarks.likelihood_tuning.starts import (
    CLIMB_STEPS,
    CURVATURE_SEEDS,
    RATE,
    STARTS,
    TUNED_PARTICLES,
    TUNED_SEEDS,
    run_starts,
)
from mpfjax.console import fill_in, seed, whole


def main(arguments: list[str] | None = None) -> int:
    """Run the parts that were asked for, print their tables, write their results and figures."""
    options = parse(arguments)
    out = Path(options.out)
    try:
        if "a" in options.parts:
            run_scores(options, settings_of(options), out)
        if "b" in options.parts:
            run_starts(options, settings_of(options), out)
        if "c" in options.parts:
            run_labels(options, out)
    except FileNotFoundError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted: what was finished is in {out}", file=sys.stderr)
        return 130
    print(f"results: {out}/")
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.likelihood_tuning")
    parser.add_argument("--parts", nargs="+", choices=("a", "b", "c"), default=["a", "b", "c"])
    parser.add_argument("--runs", type=whole(), help="a: seeds for each estimator; default: 200")
    parser.add_argument(
        "--particles", type=whole(2), nargs="+", metavar="N", help="a; default: 100 1000"
    )
    parser.add_argument("--estimators", nargs="+", choices=list(ESTIMATORS), help="a; default: all")
    parser.add_argument("--models", nargs="+", choices=list(MODELS), help="a; default: all")
    parser.add_argument("--filters", nargs="+", choices=FILTERS, help="a; default: all")
    parser.add_argument("--starts", type=whole(), help="b: random starts; default: 20")
    parser.add_argument(
        "--steps", type=whole(), help=f"b: of each optimisation; default: {CLIMB_STEPS}"
    )
    parser.add_argument("--sequences", nargs="+", choices=SEQUENCES, help="c; default: all")
    parser.add_argument("--label-runs", type=whole(2), help="c: seeds of each filter; default: 6")
    parser.add_argument(
        "--label-steps", type=whole(), help=f"c: of each optimisation; default: {LABEL_STEPS}"
    )
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--out", default="results/likelihood_tuning", metavar="DIR")
    options = parser.parse_args(arguments)
    defaults: dict[str, dict[str, Any]] = {
        "a": {
            "runs": 200,
            "particles": [100, 1000],
            "estimators": list(ESTIMATORS),
            "models": list(MODELS),
            "filters": FILTERS,
        },
        "b": {"starts": 20, "steps": CLIMB_STEPS},
        "c": {"sequences": SEQUENCES, "label_runs": 6, "label_steps": LABEL_STEPS},
    }
    for part, own in defaults.items():
        fill_in(parser, options, part in options.parts, f"without part {part}", **own)
    return options


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """Everything that a second run needs to be the same."""
    return {
        "runs": options.runs,
        "particles": options.particles,
        "starts": options.starts,
        "steps": options.steps,
        "seed": options.seed,
        "tuned_particles": TUNED_PARTICLES,
        "tuned_seeds": TUNED_SEEDS,
        "curvature_seeds": CURVATURE_SEEDS,
        "rate": RATE,
        "start_range": STARTS,
        "jax": jax.__version__,
        "mpfjax": mpfjax.__version__,
    }


if __name__ == "__main__":
    sys.exit(main())
