"""Imports go one way, injected bugs find their lines; what pip and citing software read."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import mpfjax
from tests.bugs import BUGS, file_with

PACKAGE = Path(__file__).resolve().parents[2] / "mpfjax"
# From the ground up: each part may import from those above it here, and from itself.
ORDER = """
    checks arrays operations memory mixture models moves report filter running
    lookahead transforms filters trial smoothing console exact metrics vision robots tuning
    plotting command __main__
"""
# Inside the folders that hold several floors: files, and folders.
FLOORS = {
    "operations": "logarithms islands stored matrices compiling random prefix_sums segments",
    "moves": """
        base conditional every regrouping resampling propagation metropolis
        objects initial start
    """,
    "vision": "files colour tracking boxes",
    "lookahead": "quadratics pilot twisted regression learned",
    "robots": "maps motion sensors localisation pose",
    "running": "storage long_runs devices results scan diagnosis run islands studies",
}
FILES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def floor(name, floors):
    """How high it stands; an error where it has no place."""
    return floors.split().index(name)


def imported_modules(path):
    """The full name of every module that a file imports, inside functions as well."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import on line {node.lineno}"
            for name in (f"{node.module}.{alias.name}" for alias in node.names):
                file = PACKAGE.parent / f"{name.replace('.', '/')}.py"
                yield name if node.module == "mpfjax" or file.exists() else node.module


def test_imports_go_upward():
    """Every part has a place in the order, and so has every file of a folder of several floors."""
    for path in FILES:
        place = [part.removesuffix(".py") for part in path.relative_to(PACKAGE).parts]
        own = floor(place[0], ORDER)
        for module in imported_modules(path):
            root, *there = module.split(".")
            assert root not in ("tests", "benchmarks"), f"{path} imports {module}"
            assert root != "matplotlib" or place[0] == "plotting", f"{path} imports {module}"
            if root == "mpfjax":
                assert there, f"{path} imports the package itself"
                assert floor(there[0], ORDER) <= own, f"{path} imports {module} from further down"
                if there[0] == place[0] in FLOORS and place[1] != "__init__":
                    assert len(there) > 1, f"{path} imports the folder it is in"
                    inner, floors = floor(place[1], FLOORS[place[0]]), FLOORS[place[0]]
                    assert floor(there[1], floors) <= inner, f"{path} imports {module} from below"


def test_each_bug_finds_the_line_that_it_replaces():
    for name, bug in BUGS.items():
        assert file_with(bug.line, PACKAGE) is not None, name


# All that a reader opens to follow a step of a plain particle filter.
CORE = """
    checks filter memory mixture report
    models/base models/law models/noise models/observations
    moves/base moves/propagation/propagate
    moves/resampling/allocation moves/resampling/ancestors moves/resampling/line
    moves/resampling/resample moves/resampling/sorting
    operations/compiling operations/islands operations/logarithms operations/prefix_sums
    operations/random operations/segments operations/stored
"""


def test_a_plain_step_is_in_the_core_alone():
    """The files that it imports are those of the core, and the core imports no others."""
    names = CORE.split()
    reached, waiting = set(), ["filter", "moves/propagation/propagate", "moves/resampling/resample"]
    while waiting:
        name = waiting.pop()
        reached.add(name)
        modules = imported_modules(PACKAGE / f"{name}.py")
        paths = [module.split(".")[1:] for module in modules if module.startswith("mpfjax.")]
        # `from mpfjax.models import gaussians` imports a file of a folder.
        files = {"/".join(path) for path in paths if (PACKAGE / "/".join(path)).suffix == ""}
        waiting += [
            file for file in files if (PACKAGE / f"{file}.py").exists() and file not in reached
        ]
    assert sorted(reached) == sorted(names)


ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# What a first filter does not need.
LATER = {"optax", "chex", "matplotlib", "scipy", "mpfjax.tuning", "mpfjax.metrics", "mpfjax.vision"}


def test_the_citation_agrees_with_the_package():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    fields = dict(re.findall(r"^([\w-]+): +\"?(.*?)\"?$", citation, re.MULTILINE))
    assert fields["version"] == mpfjax.__version__
    assert (fields["title"], fields["license"]) == (PROJECT["name"], PROJECT["license"])


def test_requirements_have_lower_bounds_and_errors_name_extras():
    """What an error says to install is what an extra brings."""
    extras = [asked for extra in PROJECT["optional-dependencies"].values() for asked in extra]
    for requirement in extras + PROJECT["dependencies"]:
        assert ">=" in requirement or requirement.startswith("mpfjax["), requirement
    known = {re.split(r"[>=<;]", asked)[0].strip() for asked in extras}
    code = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "mpfjax").rglob("*.py"))
    hints = re.findall(r'optional\("\w+", "(.+?)"\)', code)
    assert set(hints) >= {"trackeval"}
    assert set(hints) <= known


@pytest.mark.exactness
def test_the_import_brings_what_a_first_filter_needs_and_the_rest_later():
    """In a new process, as a user's: without the tests' conftest."""
    code = (
        "import mpfjax, sys; assert 'jax' not in sys.modules\n"
        "mpfjax.particle_filter; print(*sys.modules)\n"
        "for name in ('exact', 'metrics', 'tuning'):\n"
        "    assert name in dir(mpfjax) and getattr(mpfjax, name).__name__ == f'mpfjax.{name}'\n"
        "try: mpfjax.tunning\n"
        "except AttributeError as error: print('no attribute', error)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    brought, refused = done.stdout.splitlines()
    assert not LATER & set(brought.split())
    assert refused.endswith("module 'mpfjax' has no attribute 'tunning'")
