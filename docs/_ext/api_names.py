"""The public names of mpfjax: what the API pages show, and what code in pages links to."""

import importlib
from functools import cache
from typing import Any

MODULES = (
    "vision",
    "tuning",
    "metrics",
    "exact",
    "plotting",
    "smoothing",
    "robots",
    "mpfjax",
)  # the top last


@cache
def public_names() -> dict[str, str]:
    """The full name of everything public, by its name with and without the module's.

    What the top has from one of the other modules is shown once, there.
    """
    found: dict[str, str] = {}
    shown: dict[int, str] = {}
    for name in MODULES:
        full = name if name == "mpfjax" else f"mpfjax.{name}"
        module = importlib.import_module(full)
        for each in _public_in(module):
            target = shown.setdefault(id(getattr(module, each)), f"{full}.{each}")
            found[f"{full}.{each}"] = found[f"{name}.{each}"] = target
            found.setdefault(each, target)
    return found


def _public_in(module: Any) -> list[str]:
    """The classes and functions that a module offers: what it defines, or hands on."""
    is_package = hasattr(module, "__path__")
    return [
        name
        for name in dir(module)
        for value in [getattr(module, name)]
        if not name.startswith("_")
        and callable(value)
        and getattr(value, "__module__", "").startswith("mpfjax.")
        and (is_package or value.__module__ == module.__name__)
    ]
