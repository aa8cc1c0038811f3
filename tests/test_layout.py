"""Imports inside mpfjax go one way, and only plotting draws."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "mpfjax"

# From the ground up: each part may import from those above it here, and from itself.
ORDER = (
    "checks",
    "operations",
    "devices",
    "generator",
    "storage",
    "console",
    "mixture",
    "models",
    "proposals",
    "moves",
    "filters",
    "islands",
    "studies",
    "exact",
    "metrics",
    "vision",
    "tuning",
    "plotting",
    "command",
    "__main__",
)
FILES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def part_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_modules(path):
    """The full name of every module that a file imports, inside functions as well."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import on line {node.lineno}"
            if node.module == "mpfjax":
                yield from (f"mpfjax.{alias.name}" for alias in node.names)
            else:
                yield node.module


def name(path):
    return str(path.relative_to(PACKAGE))


@pytest.mark.parametrize("path", FILES, ids=name)
def test_imports_go_upward(path):
    own = ORDER.index(part_of(path))
    for module in imported_modules(path):
        if module.split(".")[0] == "mpfjax":
            assert module != "mpfjax", f"{path} imports the package itself"
            part = module.split(".")[1]
            assert part in ORDER, f"{path} imports {module}, which has no place in the layout"
            assert ORDER.index(part) <= own, f"{path} imports {module} from further down"


@pytest.mark.parametrize("path", FILES, ids=name)
def test_only_plotting_imports_matplotlib(path):
    if part_of(path) != "plotting":
        assert not any(module.startswith("matplotlib") for module in imported_modules(path))


@pytest.mark.parametrize("path", FILES, ids=name)
def test_the_library_imports_neither_its_tests_nor_its_benchmarks(path):
    roots = {module.split(".")[0] for module in imported_modules(path)}
    assert not roots & {"tests", "benchmarks"}


def test_every_part_of_the_package_has_a_place_in_the_layout():
    assert {part_of(path) for path in FILES} <= set(ORDER)
