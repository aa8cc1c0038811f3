"""Libraries that only some parts of mpfjax need."""

import importlib
import types


def optional(module: str, package: str) -> types.ModuleType:
    """The module of an extra, or an `ImportError` that says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{module} is missing: pip install {package}") from error
