"""What all commands share: options from a signature, tables, times in turns, errors, processes.

A command is a function of keyword arguments, each with a type and a default:

    @command(seeds=3)
    def main(*, seeds: Count = 20, out: Path = Path("results/name")) -> None:
        \"\"\"What it does.

        - `seeds`: runs of each filter.
        \"\"\"

`python -m benchmarks.NAME` then takes --seeds and --out, with these lines as help and the module's
docstring as description. --quick is an option of every command: it sets those given to `command`,
which finish in seconds and show that the command runs, and writes to a folder of its own.
"""

import argparse
import contextlib
import inspect
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial, wraps
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import jax
import numpy as np
from tqdm import tqdm

import mpfjax
from mpfjax import console
from mpfjax.console import exit_status
from mpfjax.running.results import format_table
from mpfjax.running.storage import write_json, write_whole

ROOT = Path(__file__).resolve().parents[1]
Z_95 = 1.959963984540054

Count = Annotated[int, console.whole()]
AtLeast2 = Annotated[int, console.whole(2)]
Natural = Annotated[int, console.whole(0)]
Seed = Annotated[int, console.seed]
Positive = Annotated[float, console.positive]
Form = str | Callable[[Any], str]  # of a cell in a table, from what an entry holds
Folders = Annotated[Sequence[Path], "*"]


class _Help(argparse.RawDescriptionHelpFormatter, argparse.ArgumentDefaultsHelpFormatter):
    """The description as it stands, and the default of every option that has a help."""


# --- options ----------------------------------------------------------------------------------


def command(**quick: Any) -> Callable[[Callable[..., Any]], Callable[..., int]]:
    """Make a `main` of a function: it reads the options and calls the function with them.

    A type may be `Annotated` with what reads its text, such as `Count`, or with the names to choose
    from. A sequence takes one or more, one annotated with "*" any number, one with "append" one for
    each time that the option is given, a tuple as many as it has. An argument that is not for
    keywords alone has no flag. `quick`: the options that --quick sets; a function with an argument
    `quick` is told of it as well. `main` returns what the function does, or the status of an error:
    2 with one line for a `ValueError` or a missing file, 130 for an interruption.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., int]:
        @wraps(function)
        def main(arguments: Sequence[str] | None = None) -> int:
            parser = _parser(function)
            if parser.parse_args(arguments).quick:
                # Files of a full run stay.
                folder = parser.get_default("out")
                elsewhere = {"out": folder.with_name(f"{folder.name}-quick")} if folder else {}
                parser.set_defaults(**elsewhere | quick)
            values = vars(parser.parse_args(arguments))
            options = {name: values[name] for name in inspect.signature(function).parameters}
            results: list[Any] = []
            status = exit_status(lambda: results.append(function(**options)), arguments)
            return status or int(results[0] or 0)

        return main

    return decorate


def _parser(function: Callable[..., Any]) -> argparse.ArgumentParser:
    """A flag for each of the function's arguments."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {_module_of(function)}",
        description=sys.modules[function.__module__].__doc__,
        formatter_class=_Help,
    )
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        if name != "quick":
            has_flag = parameter.kind is inspect.Parameter.KEYWORD_ONLY
            flag = f"--{name.replace('_', '-')}" if has_flag else name
            parser.add_argument(flag, **_option(name, hints[name], parameter.default, function))
    parser.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
    return parser


def _module_of(function: Callable[..., Any]) -> str:
    """Its name, also where Python runs it as __main__."""
    spec = sys.modules[function.__module__].__spec__
    return (function.__module__ if spec is None else spec.name).removesuffix(".__main__")


def _option(name: str, hint: Any, default: Any, function: Callable[..., Any]) -> dict[str, Any]:
    """What argparse is told of an option."""
    settings: dict[str, Any] = {"default": default}
    lines = re.search(
        rf"^ *- `{name}`: (.*?)(?=\n *- `|\n\n|\Z)", function.__doc__ or "", re.S | re.M
    )
    if lines:
        settings["help"] = " ".join(lines[1].split()).replace("%", "%%")
    if type(None) in get_args(hint):
        (hint,) = (kind for kind in get_args(hint) if kind is not type(None))
    if hint is bool:
        negated = argparse.BooleanOptionalAction if default else "store_true"
        return settings | {"action": negated}
    metadata = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
    if "*" in metadata:
        settings["nargs"], hint = "*", get_args(hint)[0]
    if "append" in metadata:
        return settings | {"action": "append", "metavar": "TEXT", "default": list(default)}
    if get_origin(hint) in (Sequence, tuple):
        kinds = get_args(hint)
        settings.setdefault("nargs", len(kinds) if get_origin(hint) is tuple else "+")
        hint = kinds[0]
    if get_origin(hint) is Literal:
        return settings | {"choices": get_args(hint)}
    settings["type"] = hint
    if get_origin(hint) is Annotated:
        settings["type"], how = get_args(hint)
        settings |= {"type": how} if callable(how) else {"choices": list(how)}
    if "choices" not in settings:
        settings["metavar"] = {Path: "DIR", str: "TEXT"}.get(settings["type"], "N")
    return settings


# --- runs -------------------------------------------------------------------------------------


def grid(unit: str, *axes: Iterable[Any]) -> Iterable[tuple[Any, ...]]:
    """All combinations, the last axis fastest, with a bar of progress on a terminal."""
    return tqdm(list(product(*axes)), unit=unit, disable=None)


def turns(
    runs: Mapping[Any, Callable[[int], Any]],
    repeats: int,
    *,
    clock: Callable[[], float] = time.perf_counter,
    warm_up: int = 1,
    budget: float = np.inf,
) -> dict[Any, np.ndarray]:
    """Seconds of each run in each turn: what slows the machine meets all that run in a turn.

    In a turn all run once, in random order, each called with the number of the turn; the first
    `warm_up` turns, which compile, do not count. A run that has taken more than `budget` seconds
    in three turns sits out the others. Processor time is by `clock=time.process_time`.
    """
    times: dict[Any, list[float]] = {name: [] for name in runs}
    names, order = list(runs), np.random.default_rng(0)
    for turn in range(warm_up + repeats):
        for index in order.permutation(len(names)).tolist():
            name = names[index]
            if np.sum(times[name]) > budget and len(times[name]) >= 3:
                continue
            start = clock()
            jax.block_until_ready(runs[name](turn))
            if turn >= warm_up:
                times[name].append(clock() - start)
    return {name: np.array(seconds) for name, seconds in times.items()}


def ratio(seconds: np.ndarray, of: np.ndarray) -> float:
    """The median of the turns' ratios."""
    number = min(len(seconds), len(of))
    return float(np.median(seconds[:number] / of[:number]))


def nothing(mixture: mpfjax.ParticleMixture) -> None:
    """What is collected where nothing is: one function, since a new one would compile anew."""
    del mixture


class Spent(NamedTuple):
    """Seconds of a process, and its peak memory in MB."""

    cpu: float
    wall: float
    memory: float


# A process of its own starts the one that is measured, whose use of time and memory is then that of
# all children.
_MEASURE = """
import json, resource, subprocess, sys, time
began = time.perf_counter()
code = subprocess.run([sys.executable, *sys.argv[1:]]).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
wall = time.perf_counter() - began
memory = used.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
print(json.dumps({"cpu": used.ru_utime + used.ru_stime, "wall": wall, "memory": memory}))
sys.exit(code)
"""


def in_process(*arguments: str, root: Path = ROOT, **environment: str) -> tuple[Spent, list[str]]:
    """What a fresh Python took with these arguments in a checkout, and the lines that it printed.

    Raises `ValueError` with its last line where it failed.
    """
    ended = subprocess.run(
        [sys.executable, "-c", _MEASURE, *arguments],
        cwd=root, env=os.environ | {"PYTHONPATH": str(root)} | environment,
        capture_output=True, text=True,
    )  # fmt: skip
    if ended.returncode != 0:
        last = ended.stderr.strip().splitlines()[-1:]
        raise ValueError(f"{arguments[-1]}: its process ended with {ended.returncode}: {last}")
    *lines, measured = ended.stdout.splitlines()
    return Spent(**json.loads(measured)), lines


# --- errors -----------------------------------------------------------------------------------


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """The mean over runs, and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def rms_and_error(squares: np.ndarray) -> tuple[float, float]:
    """The root of the mean of squared errors over runs, and its standard error."""
    root, (_, error) = float(np.sqrt(squares.mean())), mean_and_error(squares)
    return root, error / max(2 * root, 1e-12)


def worse(losses: np.ndarray, others: np.ndarray) -> float:
    """By how many standard errors of the paired differences the losses are larger than others."""
    mean, error = mean_and_error(losses - others)
    return mean / error if error > 0 else 0.0


def wilson(share: float, num_trials: int, z: float = Z_95) -> list[float]:
    """Wilson's interval of a probability, by default of 95%, from the share that came true."""
    middle = share + z**2 / (2 * num_trials)
    reach = z * np.sqrt(share * (1 - share) / num_trials + z**2 / (4 * num_trials**2))
    scale = 1 + z**2 / num_trials
    return [float(max((middle - reach) / scale, 0)), float(min((middle + reach) / scale, 1))]


# --- what comes out ---------------------------------------------------------------------------


def table(columns: Mapping[str, Any] | None, entries: Sequence[Mapping[str, Any]]) -> str:
    """A table in plain text, a line for each entry.

    A column is a format string of the entry's values, such as "{rms:.3f} ± {error:.3f}", or a
    function of the entry; where a value is None or missing, it is a dash. Without columns, each
    value stands under its name, numbers with three digits.
    """

    columns = columns or {name: partial(_shown, name) for name in dict.fromkeys(entries[0])}
    rows = [[_cell(form, entry) for form in columns.values()] for entry in entries]
    return format_table(list(columns), rows)


def pivot(
    title: str, entries: Sequence[Mapping[str, Any]], row: Form, column: Form, cell: Form
) -> str:
    """A table with a line for each `row` of the entries, and a column for each of their `column`.

    All three are as the columns of `table`; where there is no such entry, there is a dash.
    """
    by_row: dict[str, dict[str, str]] = {}
    for entry in entries:
        by_row.setdefault(_cell(row, entry), {})[_cell(column, entry)] = _cell(cell, entry)
    names = dict.fromkeys(_cell(column, entry) for entry in entries)
    rows = [[name, *(cells.get(each, "-") for each in names)] for name, cells in by_row.items()]
    return format_table([title, *names], rows)


def _shown(name: str, entry: Mapping[str, Any]) -> str:
    value = entry[name]
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _cell(form: Form, entry: Mapping[str, Any]) -> str:
    try:
        return form(entry) if callable(form) else form.format_map(entry)
    except (KeyError, TypeError):
        return "-"


def settings_of(options: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """What a second run needs to be the same, and the machine."""
    settings = {name: value for name, value in options.items() if name not in ("out", "resume")}
    return settings | more | {
        "jax": jax.__version__, "mpfjax": mpfjax.__version__, "numpy": np.__version__,
        "python": platform.python_version(), "machine": platform.machine(),
        "processors": os.cpu_count(),
    }  # fmt: skip


def data(path: Path, **content: Any) -> None:
    """Write a JSON file whole, also of arrays and paths."""
    write_json(path, _plain(content))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Collection) and not isinstance(value, str):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, Path) else value


def write_figure(path: Path, figure: Any, dpi: int = 150) -> None:
    """Write a matplotlib figure as PNG, for pages, and beside it as PDF, for print."""
    layout = figure.get_layout_engine()
    for kind in ("png", "pdf"):
        draw = partial(figure.savefig, format=kind, dpi=dpi)
        write_whole(path.with_suffix(f".{kind}"), draw)
        # The second picture has the places of the first: finding them takes as long as drawing.
        figure.set_layout_engine("none")
    figure.set_layout_engine(layout)


def figures(out: Path, dpi: int = 150, **drawn: Any) -> None:
    """Write each figure under its name, as PNG and PDF."""
    for name, figure in drawn.items():
        write_figure(out / f"{name}.png", figure, dpi=dpi)


class Clock:
    """The seconds that went into each part of the work."""

    def __init__(self, *parts: str) -> None:
        self.seconds = dict.fromkeys(parts, 0.0)

    @contextlib.contextmanager
    def of(self, part: str) -> Iterator[None]:
        """Count the time in the block for this part, and for no part around it."""
        start, before = time.perf_counter(), sum(self.seconds.values())
        try:
            yield
        finally:
            within = sum(self.seconds.values()) - before
            self.seconds[part] += time.perf_counter() - start - within

    def over(self, part: str, items: Iterable[Any]) -> Iterator[Any]:
        """Yield the items, and count the time that each takes to arrive for this part."""
        iterator, end = iter(items), object()
        while True:
            with self.of(part):
                item = next(iterator, end)
            if item is end:
                return
            yield item
