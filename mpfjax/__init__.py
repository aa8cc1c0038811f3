"""mpfjax: particle filters that keep many hypotheses alive, in JAX."""

import ast as _ast
import importlib as _importlib
import pathlib as _pathlib
from typing import Any as _Any

# The one place that says it: pyproject.toml reads it from here.
__version__ = "0.2.0"


def _homes() -> dict[str, tuple[str, str]]:
    """The module and the name there of each public name: the imports of `__init__.pyi`.

    A name is imported when it is first asked for. So a first filter waits for no tracker and no
    optimiser, and the help of a command not for JAX.
    """
    stub = _pathlib.Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    imports = [node for node in _ast.parse(stub).body if isinstance(node, _ast.ImportFrom)]
    return {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in imports
        for alias in node.names
    }


_HOMES = _homes()
# Former names, which warn until the next minor version.
_FORMER = {
    "Targets": "TargetEstimates",
    "keep_programs": "enable_compilation_cache",
    "targets": "estimate_targets",
    "with_point_sets": "with_quasi_monte_carlo",
    "with_selected_start": "with_initial_selection",
    "with_start": "with_initialisation",
}


def __getattr__(name: str) -> _Any:
    if name in _FORMER:
        checks = _importlib.import_module(f"{__name__}.checks")
        return checks.of_former_name(__name__, _FORMER, name)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, original = _HOMES[name]
    if module == __name__:
        return _importlib.import_module(f"{module}.{original}")
    value = globals()[name] = getattr(_importlib.import_module(module), original)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
