"""Imports inside mpfjax go one way, only plotting draws, and every benchmark is a command."""

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "mpfjax"
BENCHMARKS = PACKAGE.parent / "benchmarks"
OF_ALL_COMMANDS = {
    "__init__.py",
    "__pycache__",
    "harness.py",
    "figures.py",
    "scenes",
    "coverage.py",
}

# From the ground up: each part may import from those above it here, and from itself.
ORDER = (
    "checks",
    "operations",
    "mixture",
    "models",
    "proposals",
    "moves",
    "observations",
    "chain",
    "filter",
    "running",
    "lookahead",
    "transforms",
    "filters",
    "smoothing",
    "console",
    "exact",
    "metrics",
    "vision",
    "tuning",
    "plotting",
    "command",
    "__main__",
)
# Inside the folders that hold several floors: files, and folders.
FLOORS = {
    "operations": (
        "logarithms", "stored", "matrices", "gaussians", "islands", "compiling", "random",
        "prefix_sums", "segments", "sorting",
    ),
    "moves": (
        "base", "eve_indices", "conditional", "every", "regrouping", "resampling", "propagation",
        "metropolis", "objects", "initial",
    ),
    "vision": ("files", "colour", "tracking", "boxes"),
    "lookahead": ("quadratics", "pilot", "twisted", "regression", "learned"),
    "running": (
        "storage", "long_runs", "devices", "scan", "run", "islands",
        "studies",
    ),
}  # fmt: skip
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


def assert_goes_upward_inside(path, module):
    """Within these folders a file imports from its own floor and from those listed before it."""
    own = [part.removesuffix(".py") for part in path.relative_to(PACKAGE).parts]
    _, part, *rest = module.split(".")
    if part == own[0] and part in FLOORS and own[1] != "__init__":
        floors = FLOORS[part]
        assert rest, f"{path} imports the folder it is in"
        assert floors.index(rest[0]) <= floors.index(own[1]), f"{path} imports {module} from below"


@pytest.mark.parametrize("path", FILES, ids=name)
def test_imports_go_upward(path):
    own = ORDER.index(part_of(path))
    for module in imported_modules(path):
        if module.split(".")[0] == "mpfjax":
            assert module != "mpfjax", f"{path} imports the package itself"
            part = module.split(".")[1]
            assert part in ORDER, f"{path} imports {module}, which has no place in the layout"
            assert ORDER.index(part) <= own, f"{path} imports {module} from further down"
            assert_goes_upward_inside(path, module)


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


def test_every_file_of_a_folder_of_several_floors_has_one():
    for folder, floors in FLOORS.items():
        found = {
            path.relative_to(PACKAGE / folder).parts[0] for path in FILES if part_of(path) == folder
        }
        assert {name.removesuffix(".py") for name in found} - {"__init__"} == set(floors)


@pytest.mark.parametrize("path", FILES, ids=name)
def test_no_file_is_longer_than_a_visitor_reads(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


@pytest.mark.parametrize(
    "path",
    [
        path
        for path in sorted(BENCHMARKS.iterdir())
        if path.suffix in ("", ".py") and path.name not in OF_ALL_COMMANDS
    ],
    ids=lambda path: path.name,
)
def test_everything_in_benchmarks_is_a_command(path):
    """A module, or a folder, that `python -m benchmarks.NAME` runs."""
    command = path / "__main__.py" if path.is_dir() else path
    assert command.suffix == ".py"
    tree = ast.parse(command.read_text(encoding="utf-8"))
    assert "main" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert ast.unparse(tree.body[-1]).startswith("if __name__ == '__main__'")
    assert f"python -m benchmarks.{path.stem}" in ast.get_docstring(tree)


WALKS = (PACKAGE.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
WALKS = WALKS.split("\nWalks,")[1].split("\n## ")[0]


@pytest.mark.parametrize("walk", WALKS.split("\n- ")[1:], ids=lambda walk: walk.split("?")[0])
def test_every_walk_ends_at_a_file_that_is_there(walk):
    """And what it names as a function is defined in the file that it names with it."""
    names = re.findall(r"`([^`]+)`", walk)
    commands = [name.split()[-1] for name in names if name.startswith("python -m ")]
    paths = [name for name in names if "/" in name]
    paths += [command.replace(".", "/") for command in commands]
    assert paths
    for path in paths:
        assert (PACKAGE.parent / path).exists(), path
    for name, path in re.findall(r"`(\w+)` in `([^`]+\.py)`", walk):
        text = (PACKAGE.parent / path).read_text(encoding="utf-8")
        assert re.search(rf"^def {name}\b", text, re.MULTILINE), f"{name} is not in {path}"
