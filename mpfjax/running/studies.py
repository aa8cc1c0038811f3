"""Monte Carlo studies over filters, numbers of particles and settings, which can be interrupted."""

import importlib
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key, PyTree
from tqdm import tqdm

from mpfjax.checks import Checked, Count, by_name, check, checked, shown
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.models.series import as_series, check_series
from mpfjax.operations.logarithms import default_float
from mpfjax.running import storage
from mpfjax.running.results import FilterRun
from mpfjax.running.run import monte_carlo

Values = Sequence[Any] | np.ndarray | Array
Row = dict[str, Any]

_STUDY = "study"
_TAKEN = {"filter", "num_particles", "file", "description", _STUDY}
_CELL_FILE = re.compile(r"(\d+)-[\w.+-]*\.npz")  # as `_cells` names them


def log_evidence(run: FilterRun) -> dict[str, Array]:
    """log Ẑ of each seed: what a `Study` measures by default."""
    return {"log_marginal_likelihood": run.log_marginal_likelihood}


def nothing(mixture: ParticleMixture) -> None:
    """Collect nothing, the default of a `Study`."""


class Study(Checked):
    """A grid of filters x N x settings, in which each cell is the Monte Carlo runs of one filter.

    Raises `ValueError` for an argument of another kind, an axis that is empty or has a value twice,
    numbers of particles that are not integers, a setting that is not a number or a string, a
    function that does not return a filter, and as `monte_carlo` does.
    """

    filters: Annotated[Mapping[str, Callable[..., Filter]], by_name(callable, "functions of N")]
    """by name: functions of N, and of the settings by name, that build a filter."""
    num_particles: Values
    keys: Key[Array, " seeds"]
    """one for each run of a cell; the same in all cells."""
    observations: PyTree
    """y_1..y_t, one data set for all, or a `Series`."""
    settings: Annotated[Mapping[str, Values], by_name(np.iterable, "values")] = field(
        default_factory=dict, kw_only=True
    )
    """by name: the values of each setting, numbers or strings. All combinations are run."""
    measure: Callable[[FilterRun], Mapping[str, Any]] = field(default=log_evidence, kw_only=True)
    """arrays by name from a cell's runs, each with the leading axis of seeds."""
    collect: Callable[[ParticleMixture], PyTree] | None = field(default=nothing, kw_only=True)
    """as for `run_filter`, for `measure` to use; None keeps all of every mixture."""

    def __check_init__(self) -> None:
        super().__check_init__()
        for name in self.settings.keys() & _TAKEN:
            raise ValueError(f"settings: {name!r} is a name that a cell has already")
        for number in _axes(self)["num_particles"]:
            check(Count, num_particles=number)
        check_series(self.observations)


@checked
def run_study(
    study: Study,
    directory: storage.FilePath,
    *,
    resume: bool = False,
    num_slots: Count | None = None,
) -> list[Row]:
    """Run every cell of a study; with `resume`, continue where it was interrupted or killed.

    Each cell is written to a separate file in `directory` as soon as it is finished, so only
    unfinished cells can be lost. Returns one dict for each cell: its `filter`, `num_particles`,
    settings and measured arrays. On a terminal a bar shows the remaining time.

        circle = lambda num_particles, noise: mpfjax.mixture_particle_filter(
            Circle(noise), num_particles, max_components=4)
        study = mpfjax.Study({"mpf": circle}, [50, 200, 800], jax.random.split(key, 100),
                             observations, settings={"noise": [0.1, 0.3]})
        results = mpfjax.run_study(study, "results/circle")

    - `resume`: reuse the finished cells in `directory`, and print how many these are. They belong
      to this study if names (of filters, `measure` and `collect`), sizes, settings, keys, data and
      versions are the same. The code of functions cannot be compared: use a new directory after you
      change it. False refuses a directory with cells.
    - `num_slots`: the length of the particle arrays, as for `monte_carlo`, in all cells with at
      most so many particles. A filter then compiles once for all these N. Use it for small filters,
      if the study spends more time on compiling than on running. A filter that fills every slot,
      such as `independent_particle_filters`, raises an error.

    Raises `ValueError` before anything runs: for an argument of another kind, for a `directory`
    with cells, and with `resume` for the directory of another study, naming the difference, and for
    truncated files in it. Delete such files, and only their cells run again. Raises `OSError` if a
    cell cannot be written, for example on a full disk; finished cells remain. Use it if a loop over
    `monte_carlo` would take long.
    """
    directory = Path(directory)
    cells, identity = _cells(study), _identity(study)
    if (files := _cell_files(directory)) and not resume:
        raise ValueError(f"directory: {directory} holds {len(files)} cells; resume=True continues")
    results = _read_cells(directory, identity)
    pending = [cell for cell in cells if cell.file not in results]
    if results:
        print(f"{directory}: {len(results)} cells taken over, {len(pending)} to run")

    with tqdm(total=len(cells), initial=len(results), unit="cell", disable=None) as bar:
        for cell in pending:
            try:
                measured = _measure(study, cell, num_slots)
            except Exception as error:
                error.add_note(f"in the cell {cell.description}")
                raise
            described_by = {_STUDY: identity} | cell.description
            storage.write_described(directory / cell.file, measured, described_by)
            results[cell.file] = cell.description | measured
            bar.update()
    return [results[cell.file] for cell in cells]


def read_study(directory: storage.FilePath) -> list[Row]:
    """The finished cells of a study, as `run_study` returns them.

    It does not need the `Study`, and works while the study runs. Raises `FileNotFoundError` if the
    directory does not exist, and `ValueError` for files in it that are truncated, damaged or from
    different studies.
    """
    return list(_read_cells(Path(directory).resolve(strict=True)).values())


class _Cell(NamedTuple):
    """One filter at one size under one combination of settings."""

    file: str
    description: dict[str, Any]
    filter: Filter


def _cells(study: Study) -> list[_Cell]:
    """All cells with their filters, built at once: a filter that cannot be built raises first."""
    axes = _axes(study)
    outermost_first = [*study.settings, "num_particles", "filter"]
    cells = []
    for index, values in enumerate(itertools.product(*(axes[k] for k in outermost_first))):
        value_of = dict(zip(outermost_first, values, strict=True))
        description = {name: value_of[name] for name in axes}
        name, num_particles = description["filter"], description["num_particles"]
        settings = {name: description[name] for name in study.settings}
        filter = study.filters[name](num_particles, **settings)
        check(Filter, **{f"filters: {name}": filter})
        as_series(study.observations, filter.model)
        words = [name, f"N{num_particles}", *(f"{k}_{v}" for k, v in settings.items())]
        stem = re.sub(r"[^\w.+-]+", "_", "-".join([f"{index:04d}", *words]))[:100]
        cells.append(_Cell(f"{stem}.npz", description, filter))
    return cells


def _axes(study: Study) -> dict[str, list[Any]]:
    """The values along each axis of the grid, the filters' names first, as JSON can hold them."""
    axes = {"num_particles": study.num_particles, **study.settings}
    others = {name: _as_list(name, values) for name, values in axes.items()}
    return {"filter": _as_list("filters", list(study.filters))} | others


def _as_list(name: str, values: Any) -> list[Any]:
    """The values along one axis; a `ValueError` for what is no list of numbers and strings."""
    each = [] if isinstance(values, str) or not np.iterable(values) else values
    plain = [value.item() if getattr(value, "shape", None) == () else value for value in each]
    simple = {value for value in plain if isinstance(value, str | int | float | None)}
    if not plain or len(simple) < len(plain):
        raise ValueError(f"{name}: {shown(values)} are no numbers or strings, each there once")
    return plain


def _identity(study: Study) -> dict[str, str]:
    """All that has to be the same for a cell to be of this study, as text."""
    package = importlib.import_module(__name__.partition(".")[0])
    versions = f"mpfjax {package.__version__}, jax {jax.__version__}, {default_float()}"
    functions = {name: storage.stable_name(getattr(study, name)) for name in ("measure", "collect")}
    axes = {name: str(values) for name, values in _axes(study).items()}
    data = storage.describe_parts(keys=study.keys, observations=study.observations)
    return axes | data | functions | {"versions": versions}


def _cell_files(directory: Path) -> list[Path]:
    """The files of finished cells, in the order of the cells."""
    matches = [(_CELL_FILE.fullmatch(path.name), path) for path in directory.glob("*.npz")]
    return [path for _, path in sorted((int(name[1]), path) for name, path in matches if name)]


def _read_cells(directory: Path, identity: dict[str, str] | None = None) -> dict[str, Row]:
    """The finished cells by their files: described, and with what was measured.

    They are all of one study, that of the first where none is given.
    """
    # An error, not a warning and a second run: if one file is damaged, others may be as well.
    results = {}
    for path in _cell_files(directory):
        arrays, description = storage.read_described(path)
        other = dict(description.pop(_STUDY, {}))
        identity = identity or other
        if other != identity:
            what = f"of another study ({storage.differences(other, identity)})"
            raise ValueError(f"directory: {path}: {what}; delete it, and only its cell runs again")
        results[path.name] = description | arrays
    return results


def _measure(study: Study, cell: _Cell, num_slots: int | None) -> dict[str, np.ndarray]:
    """What is measured of all seeds of one cell."""
    filter, keys = cell.filter, study.keys
    if num_slots is not None and filter.num_particles > num_slots:
        num_slots = None
    run = monte_carlo(keys, filter, study.observations, study.collect, num_slots=num_slots)
    measured = {name: np.asarray(array) for name, array in study.measure(run).items()}
    for name, array in measured.items():
        if name in cell.description or name in _TAKEN or array.shape[:1] != keys.shape:
            what = f"{name} of shape {array.shape}"
            raise ValueError(f"measure: {what} is of a cell, or has no axis of {len(keys)} seeds")
    return measured
