"""What pip, citing software and type checkers read: noxfile.py tests what takes an installation."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import mpfjax

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
