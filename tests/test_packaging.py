"""What pip, citing software and type checkers read: noxfile.py tests what takes an installation."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import mpfjax

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
# What a first filter does not need.
LATER = {"optax", "chex", "matplotlib", "scipy", "mpfjax.tuning", "mpfjax.metrics", "mpfjax.exact"}


def run_python(code):
    """What a new process prints that runs it, as a user's would: without the tests' conftest."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_the_version_stands_in_one_place():
    assert "version" not in PYPROJECT["project"]
    assert PYPROJECT["project"]["dynamic"] == ["version"]
    assert PYPROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "mpfjax.__version__"}


def test_the_citation_agrees_with_the_package():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    fields = dict(re.findall(r"^([\w-]+): +\"?(.*?)\"?$", citation, re.MULTILINE))
    assert fields["version"] == mpfjax.__version__
    assert fields["title"] == PYPROJECT["project"]["name"]
    assert fields["license"] == PYPROJECT["project"]["license"]


def test_what_errors_say_to_install_is_among_the_extras():
    """mpfjax itself is on no registry: a hint that names it installs nothing, or something else."""
    known = {
        re.split(r"[>=<;]", asked)[0].strip()
        for extra in PYPROJECT["project"]["optional-dependencies"].values()
        for asked in extra
    }
    hints = [
        (path.name, hint)
        for path in sorted((ROOT / "mpfjax").rglob("*.py"))
        for hint in re.findall(r"pip install (.+?)['\"]*\)?(?: from error)?$",
                               path.read_text(encoding="utf-8"), re.MULTILINE)
    ]  # fmt: skip
    assert hints
    for name, hint in hints:
        assert {package.strip("'\"") for package in hint.split()} <= known, (name, hint)


def test_type_checkers_are_told_that_there_are_types():
    assert (ROOT / "mpfjax" / "py.typed").is_file()
    assert "py.typed" in PYPROJECT["tool"]["setuptools"]["package-data"]["mpfjax"]


def test_only_mpfjax_is_installed():
    assert PYPROJECT["tool"]["setuptools"]["packages"]["find"]["include"] == ["mpfjax", "mpfjax.*"]


def test_every_requirement_has_a_lower_bound():
    extras = PYPROJECT["project"]["optional-dependencies"].values()
    for requirement in sum(extras, PYPROJECT["project"]["dependencies"]):
        assert ">=" in requirement or requirement.startswith("mpfjax["), requirement


def test_the_import_brings_nothing_that_a_first_filter_does_not_need():
    brought = run_python("import mpfjax, sys; print(*sys.modules)")
    assert not LATER & set(brought)


@pytest.mark.parametrize("name", ["exact", "metrics", "tuning"])
def test_what_is_imported_later_is_an_attribute_all_the_same(name):
    code = f"import mpfjax; print('{name}' in dir(mpfjax), mpfjax.{name}.__name__)"
    assert run_python(code) == ["True", f"mpfjax.{name}"]


def test_an_attribute_that_is_not_there_is_an_error():
    name = "tunning"
    with pytest.raises(AttributeError, match="module 'mpfjax' has no attribute 'tunning'"):
        getattr(mpfjax, name)
