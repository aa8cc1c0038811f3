"""Smith and Gatica-Perez (2004), tables 1 to 4 and figures 4 and 8: does the order matter?

    python -m benchmarks.partitioned_sampling                  # tables 1 and 2, figure 4
    python -m benchmarks.partitioned_sampling --scene 9        # of one key, kept or not
    python -m benchmarks.partitioned_sampling --keys 100:107   # of the scenes among these keys
    python -m benchmarks.partitioned_sampling --sensitivity    # what both tables hang on
    python -m benchmarks.partitioned_sampling --sequence DIR [DIR ...]     # tables 3 and 4
    python -m benchmarks.partitioned_sampling --sequence DIR --ids 4 3 5 --frames 1:63

A joint particle filter ("Non-PS"), partitioned sampling in every circular order and in a sample of
others, distributed partitioned sampling with both reassemblies, independent filters and clusters,
all with the same model and the same number of likelihoods a frame, 50 runs each. Synthetic scenes
are rendered from the keys 0, 1, 2, ..., and kept where the posterior of object 1, by 20 000
particles on it alone, leaves it and is back at frame 11 or later. In folders with img/ and gt.txt,
the events are those in which an object is hidden by another and comes out elsewhere; or the first
of --ids is the hidden one. Into --out DIR go partitioned_sampling.json, the figures, and an
animation of a PS run that fails beside a DPS run that recovers. Objects are counted from 1.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.partitioned_sampling.command import run
from benchmarks.partitioned_sampling.study import METHODS
from mpfjax.console import exit_status, fill_in, positive, seed, whole

NUM_SCENES, NUM_RUNS = 8, 50
LAMBDAS, NUM_PARTICLES = [20.0, 30.0, 40.0, 50.0], 300
REAL_LAMBDAS, REAL_NUM_PARTICLES = [20.0], 200


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The arguments, each checked as far as it can be without the frames."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.partitioned_sampling",
        description="Joint PF, PS, DPS and independent filters (Smith and Gatica-Perez 2004).",
    )
    where = parser.add_argument_group("synthetic scenes")
    where.add_argument(
        "--scenes", type=whole(), metavar="S", help=f"how many; default: {NUM_SCENES}"
    )
    where.add_argument("--scene", type=seed, metavar="K", help="this key alone, kept or not")
    where.add_argument(
        "--keys", type=_key_range, metavar="A:B", help="the scenes among the keys A to B"
    )
    where.add_argument(
        "--sensitivity", action="store_true", help="size, speed and momentum; at λ = 20"
    )
    real = parser.add_argument_group("real sequences")
    real.add_argument(
        "--sequence", type=Path, nargs="+", metavar="DIR", help="folders with img/ and gt.txt"
    )
    real.add_argument("--event", type=whole(), metavar="K", help="only the K-th event")
    real.add_argument(
        "--ids", type=whole(0), nargs="+", metavar="ID", help="of gt.txt, the hidden one first"
    )
    real.add_argument("--frames", metavar="A:B", help="frames A to B, counted from 1, both in")
    parser.add_argument("--runs", type=whole(), default=NUM_RUNS, help="of each filter and scene")
    parser.add_argument(
        "--particles", type=whole(), metavar="N",
        help=f"default: {NUM_PARTICLES} on synthetic scenes, or {REAL_NUM_PARTICLES}",
    )  # fmt: skip
    parser.add_argument(
        "--lambdas", type=positive, nargs="+", metavar="λ", help="default: 20 30 40 50, or 20"
    )
    parser.add_argument(
        "--methods", nargs="+", choices=list(METHODS), metavar="NAME",
        help=f"of {', '.join(METHODS)}; default: all",
    )  # fmt: skip
    parser.add_argument("--seed", type=seed, default=0, help="of the filters")
    parser.add_argument("--out", type=Path, default=Path("results/partitioned_sampling"))
    options = parser.parse_args(arguments)
    real_frames, chosen = bool(options.sequence), bool(options.ids or options.frames)
    if not real_frames and chosen:
        parser.error("--ids, --frames: without --sequence there is nothing to choose")
    if chosen and len(options.sequence) > 1:
        parser.error("--ids, --frames: of one --sequence, not of several")
    picked = [f"--{name}" for name in ("scene", "keys", "sensitivity") if _given(options, name)]
    if len(picked) > 1:
        parser.error(f"{picked[0]}: not with {picked[1]}")
    if options.sensitivity:
        fill_in(parser, options, False, "with --sensitivity, which is at λ = 20", lambdas=[])
        fill_in(parser, options, False, "with --sensitivity, which has its own", methods=[])
    fill_in(parser, options, real_frames and not chosen, "without events of a --sequence", event=0)
    fill_in(parser, options, not real_frames, "with --sequence", scene=-1, keys=())
    one_choice = real_frames or options.scene >= 0 or bool(options.keys)
    fill_in(
        parser, options, not one_choice, "with --sequence, --scene or --keys", scenes=NUM_SCENES
    )
    if real_frames and options.sensitivity:
        parser.error("--sensitivity: not with --sequence")
    options.lambdas = options.lambdas or (REAL_LAMBDAS if real_frames else LAMBDAS)
    options.methods = options.methods or list(METHODS)
    options.lambdas = list(dict.fromkeys(options.lambdas))
    options.methods = list(dict.fromkeys(options.methods))
    if options.particles is None:
        options.particles = REAL_NUM_PARTICLES if real_frames else NUM_PARTICLES
    return options


def _given(options: argparse.Namespace, name: str) -> bool:
    return getattr(options, name) not in (None, False)


def _key_range(text: str) -> range:
    first, colon, last = text.partition(":")
    low, high = seed(first), seed(last) if colon else -1
    if high < low:
        raise argparse.ArgumentTypeError(f"{text!r} is not A:B with A no more than B")
    return range(low, high + 1)


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; bad input is one line on the error stream and exit status 2."""
    return exit_status(lambda: run(parse_arguments(arguments)), arguments)


if __name__ == "__main__":
    sys.exit(main())
