"""Monte Carlo studies over filters, numbers of particles and settings; they can be interrupted."""

import hashlib
import itertools
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree
from tqdm import tqdm

from mpfjax.checks import check_callable, check_key, check_type, check_whole, given, shown
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.observations import as_series, check_series
from mpfjax.running.run import monte_carlo
from mpfjax.running.scan import FilterRun
from mpfjax.running.storage.descriptions import describe, differences, fingerprint, named
from mpfjax.running.storage.files import as_path, load_arrays, write_arrays, write_whole

Values = Sequence[Any] | np.ndarray | Array

_MANIFEST = "study.json"
_CELL = "cell"
_TAKEN = ("filter", "num_particles", _CELL)
# Names as `_cells` makes them; none of them leads out of the folder.
_CELL_FILE = re.compile(r"\d+-[\w.+-]*\.npz")


def log_evidence(run: FilterRun) -> dict[str, Array]:
    """log Ẑ of each seed: what a `Study` measures by default."""
    return {"log_marginal_likelihood": run.log_marginal_likelihood}


def nothing(mixture: ParticleMixture) -> None:
    """Collect nothing, the default of a `Study`."""
    del mixture


@dataclass(frozen=True, eq=False)
class Study:
    """A grid of filters x N x settings. Each cell is the Monte Carlo runs of one filter.

    Raises `ValueError` for an argument of another kind, an axis that is empty or has a value twice,
    numbers of particles that are not whole, a setting that is not a number or a string, a function
    that returns no filter, and what `monte_carlo` raises it for.
    """

    filters: Mapping[str, Callable[..., Filter]]
    """by name: functions of N, and of the settings by name, that build a filter."""
    num_particles: Values
    keys: Key[Array, " seeds"]
    """one for each run of a cell; the same in all cells."""
    observations: PyTree
    """y_1..y_t, one data set for all; every leaf has a leading axis t."""
    settings: Mapping[str, Values] = field(default_factory=dict)
    """by name: the values of each setting, numbers or strings. All combinations are run."""
    measure: Callable[[FilterRun], Mapping[str, Any]] = log_evidence
    """arrays by name from a cell's runs, each with the leading axis of seeds."""
    collect: Callable[[ParticleMixture], PyTree] | None = nothing
    """as for `run_filter`, for `measure` to use; None keeps all of every mixture."""
    missing: str = "error"
    """as for `run_filter`."""
    inputs: PyTree = None
    """u_1..u_t, as for `run_filter`; the same in all cells."""

    def __post_init__(self) -> None:
        check_type(Mapping, "functions by name, {name: function}", filters=self.filters)
        check_type(Mapping, "values by name, {name: [value, ...]}", settings=self.settings)
        for name, function in self.filters.items():
            if not callable(function):
                raise ValueError(
                    f"filters: {shown(function)}, for {name!r}, is no function that builds a filter"
                )
        for name in self.settings:
            check_type(str, "the name of a setting", settings=name)
        check_callable("a function of a cell's runs", measure=self.measure)
        check_callable("a function of a mixture", **given(collect=self.collect))
        check_key(self.keys, "keys", batch=True)
        taken = [name for name in self.settings if name in _TAKEN]
        if taken:
            raise ValueError(f"settings: {taken[0]!r} is what a cell has a name for already")
        for name, values in _axes(self).items():
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{_argument(name)}: {values} is empty or has the same twice")
        for number in _axes(self)["num_particles"]:
            check_whole(num_particles=number)
        check_series(self.observations, self.missing)


def run_study(
    study: Study,
    directory: str | os.PathLike[str],
    *,
    seeds_at_once: int | None = None,
    cells_at_once: int = 1,
    slots: int | None = None,
) -> list[dict[str, Any]]:
    """Run every cell of a study, and go on where an earlier call was interrupted or killed.

    Each cell is written to a file of its own in `directory` as soon as it is finished, so only
    unfinished cells can be lost. Returns one dict for each cell: its `filter`, `num_particles`,
    settings and measured arrays. On a terminal a bar shows the time left.

        circle = lambda num_particles, noise: mpfjax.mixture_particle_filter(
            Circle(noise), num_particles, max_components=4)
        study = mpfjax.Study({"mpf": circle}, [50, 200, 800], jax.random.split(key, 100),
                             observations, settings={"noise": [0.1, 0.3]})
        results = mpfjax.run_study(study, "results/circle")

    - `seeds_at_once`: how many seeds share one `vmap`; None is all. Set it if memory is short.
    - `cells_at_once`: with 2, one cell compiles while another runs; a kill may lose both. Several
      processes must work on the same cell, and so run one cell at a time.
    - `slots`: the length of the particle arrays, as for `monte_carlo`, in all cells with at most
      so many particles. A filter then compiles once for all these N. Use it for small filters,
      where the study spends more time on compiling than on running. A filter that fills every
      slot, such as `independent_particle_filters`, raises an error.

    Raises `ValueError` before anything runs: for an argument of another kind, for the `directory`
    of another study, naming what differs, and for files in it that are cut off. Delete such files,
    and only their cells run again. Raises `OSError` if a cell cannot be written, for example on a
    full disk; finished cells stay. Filters are compared by their structure and numbers, `measure`
    and `collect` only by their names: use a new directory after you change their code. Several
    processes share one directory, which the first one writes. Use it where a loop over
    `monte_carlo` would take long.
    """
    check_type(Study, "a Study", study=study)
    check_whole(**given(seeds_at_once=seeds_at_once, slots=slots))
    check_whole(cells_at_once=cells_at_once)
    directory = _as_directory(directory)
    cells = _cells(study)
    manifest = _claim(directory, study, cells)
    results = _finished(directory, manifest)
    pending = [cell for cell in cells if cell.file not in results]
    if jax.process_count() > 1:
        cells_at_once = 1

    def finish(cell: _Cell) -> str:
        try:
            measured = _measure(study, cell, seeds_at_once, slots)
        except Exception as error:
            error.add_note(f"in the cell {cell.description}")
            raise
        if jax.process_index() == 0:
            write_arrays(directory / cell.file, measured | {_CELL: _mark(manifest, cell.file)})
        results[cell.file] = measured
        return cell.file

    with tqdm(total=len(cells), initial=len(results), unit="cell", disable=None) as bar:
        for _ in _in_turn(finish, pending, cells_at_once):
            bar.update()
    return [cell.description | results[cell.file] for cell in cells]


def read_study(directory: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The finished cells of a study, as `run_study` returns them.

    It does not need the `Study`, and works while the study runs. Raises `FileNotFoundError` for a
    directory without a study, and `ValueError` for files in it that are cut off, damaged or from
    another study.
    """
    directory = _as_directory(directory)
    manifest = _read_manifest(directory / _MANIFEST)
    results = _finished(directory, manifest)
    cells = manifest["cells"]
    return [cells[file]["is"] | results[file] for file in cells if file in results]


@dataclass(frozen=True)
class _Cell:
    """One filter at one size under one combination of settings."""

    file: str
    description: dict[str, Any]
    filter: Filter


def _cells(study: Study) -> list[_Cell]:
    """All cells with their filters, built at once: a filter that cannot be built raises first."""
    axes = _axes(study)
    # Settings are outermost: neighbours, which may compile at once, are then different programs.
    outermost_first = [*study.settings, "num_particles", "filter"]
    cells = []
    for index, values in enumerate(itertools.product(*(axes[k] for k in outermost_first))):
        value_of = dict(zip(outermost_first, values, strict=True))
        description = {name: value_of[name] for name in axes}
        name, num_particles = description["filter"], description["num_particles"]
        settings = {name: description[name] for name in study.settings}
        filter = study.filters[name](num_particles, **settings)
        if not isinstance(filter, Filter):
            raise ValueError(f"filters: {name} made {filter!r}, no Filter")
        as_series(study.observations, study.inputs, study.missing, filter.model)
        words = [name, f"N{num_particles}", *(f"{k}_{v}" for k, v in settings.items())]
        stem = re.sub(r"[^\w.+-]+", "_", "-".join([f"{index:04d}", *words]))[:100]
        cells.append(_Cell(f"{stem}.npz", description, filter))
    return cells


def _axes(study: Study) -> dict[str, list[Any]]:
    """The values along each axis of the grid, the filters' names first."""
    axes: dict[str, Any] = {
        "filter": list(study.filters),
        "num_particles": study.num_particles,
        **study.settings,
    }
    for name, values in axes.items():
        # A string is a sequence as well, of its letters.
        is_array = isinstance(values, np.ndarray | jax.Array) and values.ndim > 0
        if isinstance(values, str | bytes) or not (is_array or isinstance(values, Sequence)):
            raise ValueError(f"{_argument(name)}: {shown(values)} are no values, [value, ...]")
    return {name: [_plain(name, value) for value in values] for name, values in axes.items()}


def _argument(axis: str) -> str:
    """The argument of `Study` that sets an axis."""
    return {"filter": "filters", "num_particles": "num_particles"}.get(axis, f"settings: {axis}")


def _plain(name: str, value: Any) -> Any:
    """A value of an axis in a form that JSON can hold."""
    is_array = isinstance(value, np.generic | np.ndarray | jax.Array)
    if is_array and value.ndim == 0 and not jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = value.item()
    if value is not None and not isinstance(value, str | int | float | bool):
        raise ValueError(
            f"{name}: {value!r} is no number or string; name it, and let the filter's function"
            " look it up"
        )
    return value


def _manifest(study: Study, cells: list[_Cell]) -> dict[str, Any]:
    """All that identifies the study of a directory, in a form that JSON can hold."""
    manifest = {
        "axes": _axes(study),
        "keys": _summary(study.keys),
        "observations": _summary(study.observations),
        "measure": named(study.measure),
        "collect": named(study.collect),
        "missing": study.missing,
        **({} if study.inputs is None else {"inputs": _summary(study.inputs)}),
        "cells": {
            cell.file: {"is": cell.description, "filter": fingerprint(cell.filter)}
            for cell in cells
        },
    }
    return json.loads(json.dumps(manifest))


def _summary(tree: PyTree) -> str:
    shapes = ", ".join(f"{place} {kind}".strip() for place, kind in describe(tree).items())
    return f"{shapes} ({fingerprint(tree)[:16]})"


def _claim(directory: Path, study: Study, cells: list[_Cell]) -> dict[str, Any]:
    """The manifest of this study, written into its directory unless it is there already."""
    manifest, path = _manifest(study, cells), directory / _MANIFEST
    if path.exists():
        there = _read_manifest(path)
        # As text, in which a NaN is equal to itself.
        if json.dumps(there, sort_keys=True) != json.dumps(manifest, sort_keys=True):
            raise ValueError(
                f"directory: {directory} holds another study ({_difference(there, manifest)});"
                " take another directory, or delete that one"
            )
    elif jax.process_index() == 0:
        content = json.dumps(manifest, indent=1) + "\n"
        write_whole(path, lambda file: file.write(content.encode()))
    return manifest


def _difference(there: dict[str, Any], here: dict[str, Any]) -> str:
    """What differs, by name; the filters' inside where nothing else does."""
    there, here = there.copy(), here.copy()
    cells, own = there.pop("cells"), here.pop("cells")
    there |= there.pop("axes")
    here |= here.pop("axes")
    if there != here:
        return differences(there, here)
    other = [file for file in own if cells.get(file) != own[file]]
    return f"the filters of {len(other)} cells have other moves or numbers, first {other[0]}"


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: cut off, damaged or no study ({error})") from error
    axes, cells = (_mapping(manifest, name) for name in ("axes", "cells"))
    if not axes or not cells:
        raise ValueError(f"{path}: damaged or no study, for it has no axes or no cells")
    for file, cell in cells.items():
        if not _CELL_FILE.fullmatch(file):
            raise ValueError(f"{path}: damaged or no study, for {file!r} is no name of a cell")
        if _mapping(cell, "is").keys() != axes.keys() or not isinstance(cell.get("filter"), str):
            raise ValueError(f"{path}: damaged or no study, for {file!r} is {shown(cell)}")
    return manifest


def _mapping(content: Any, name: str) -> dict[str, Any]:
    """The mapping in JSON by this name; empty if it is something else."""
    found = content.get(name) if isinstance(content, dict) else None
    return found if isinstance(found, dict) else {}


def _as_directory(directory: str | os.PathLike[str]) -> Path:
    path = as_path(directory, "directory")
    if path.exists() and not path.is_dir():
        raise ValueError(f"directory: {path} is a file")
    return path


def _mark(manifest: dict[str, Any], file: str) -> np.ndarray:
    """The text that identifies the study and the cell of a file."""
    digest = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
    return np.array(json.dumps({"study": digest} | manifest["cells"][file]["is"]))


def _finished(directory: Path, manifest: dict[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """The measured arrays of the cells that are there, by file."""
    # An error, not a warning and a second run: if one file is damaged, others may be as well.
    results, faults = {}, []
    for file in manifest["cells"]:
        path = directory / file
        if not path.exists():
            continue
        try:
            arrays = load_arrays(path)
        except ValueError as error:
            faults.append(str(error))
            continue
        if str(arrays.pop(_CELL, None)) != str(_mark(manifest, file)):
            faults.append(f"{path}: results of another study or cell")
        results[file] = arrays
    if faults:
        raise ValueError("; ".join([*faults, "delete these, and only their cells are run again"]))
    return results


def _measure(
    study: Study, cell: _Cell, seeds_at_once: int | None, slots: int | None
) -> dict[str, np.ndarray]:
    """All seeds of one cell, a bounded number of them at once."""
    if slots is not None and cell.filter.num_particles > slots:
        slots = None
    num_seeds = study.keys.shape[0]
    size = num_seeds if seeds_at_once is None else min(seeds_at_once, num_seeds)
    parts = []
    for start in range(0, num_seeds, size):
        # The last batch is filled up, so that it does not compile again.
        batch = study.keys[np.clip(np.arange(start, start + size), 0, num_seeds - 1)]
        run = monte_carlo(
            batch,
            cell.filter,
            study.observations,
            study.collect,
            inputs=study.inputs,
            missing=study.missing,
            slots=slots,
        )
        measured = {name: np.asarray(array) for name, array in study.measure(run).items()}
        for name, array in measured.items():
            if name in cell.description or name in _TAKEN:
                raise ValueError(f"measure: {name!r} is what a cell is described by")
            if array.shape[:1] != (size,):
                raise ValueError(f"measure: {name}'s shape, {array.shape}, has no axis of seeds")
        parts.append(measured)
    return {name: np.concatenate([part[name] for part in parts])[:num_seeds] for name in parts[0]}


def _in_turn(finish: Callable[[_Cell], str], cells: list[_Cell], at_once: int) -> Iterator[str]:
    """Finish the cells, several at once; an error ends it after the cells that are running."""
    if at_once == 1:
        yield from map(finish, cells)
        return
    pool = ThreadPoolExecutor(at_once)
    try:
        for future in as_completed([pool.submit(finish, cell) for cell in cells]):
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)
