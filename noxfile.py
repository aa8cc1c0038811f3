"""The checks, each in an environment of its own: `nox -l` lists them, `nox -s wheel` runs one."""

import functools
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import nox
from packaging.requirements import Requirement

nox.needs_version = ">=2025.2.9"
nox.options.sessions = ["lint", "docs", "wheel", "tests"]

OLDEST = (3, 11)
# Tests that the lower bounds are not held to: of optional extras, other processes and benchmarks.
BEYOND = (
    "tests/benchmarks",
    "tests/vision",
    "tests/command",
    "tests/running/test_devices.py",
    "tests/project/test_documentation.py",
    "tests/test_plotting.py",
    "tests/running/test_studies.py",
)
TELL = (
    "import platform, sys, sysconfig;"
    "print(sys.version_info.releaselevel, sys.implementation.name,"
    " sysconfig.get_config_var('Py_GIL_DISABLED') or 0, platform.python_version(), sys.executable)"
)


@functools.cache
def interpreters() -> dict[tuple[int, int], str]:
    """The path of each released CPython here, by version: of the PATH and of pyenv.

    Each is started, as pyenv puts commands on the PATH for versions that it then refuses.
    """
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates = [shutil.which(f"python3.{OLDEST[1] + later}") for later in range(10)]
    candidates += [shutil.which("python3"), sys.executable]
    candidates += sorted(str(path) for path in pyenv.glob("3.*/bin/python"))
    found = {}
    for candidate in filter(None, dict.fromkeys(candidates)):
        told = subprocess.run([candidate, "-c", TELL], capture_output=True, text=True)
        if told.returncode == 0 and told.stdout.startswith("final cpython 0 "):
            _, _, _, number, path = told.stdout.strip().split(maxsplit=4)
            major, minor = (int(part) for part in number.split(".")[:2])
            found.setdefault((major, minor), path)
    return {version: found[version] for version in sorted(found) if version >= OLDEST}


OLDEST_PYTHON = interpreters().get(OLDEST, False)
NEWEST_PYTHON = interpreters()[max(interpreters())] if interpreters() else False


def start(session: nox.Session, needed: str) -> None:
    """Say which Python it is; fail where there is none."""
    if session.python is False:
        session.error(f"{needed} is needed, and is neither on the PATH nor in pyenv")
    session.run("python", "--version")


def whole_suite(session: nox.Session) -> None:
    """What `python -m pytest` runs, and what it leaves for .ci/run."""
    session.run("python", "-m", "pytest", *session.posargs)
    if not session.posargs:
        session.run("python", "-m", "pytest", "-m", "exactness or pages")


def build(session: nox.Session) -> tuple[Path, Path]:
    """A wheel and an sdist of the checkout."""
    folder = Path(session.create_tmp()).resolve() / "dist"
    shutil.rmtree(folder, ignore_errors=True)
    session.install("build")
    session.run("python", "-m", "build", "--outdir", str(folder))
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def lower_bounds(project: dict) -> list[str]:
    """`name==bound` for what the library and its core tests need."""
    wanted = project["dependencies"] + project["optional-dependencies"]["core-test"]
    pins = []
    for requirement in map(Requirement, wanted):
        (bound,) = (each.version for each in requirement.specifier if each.operator == ">=")
        pins.append(f"{requirement.name}=={bound}")
    return pins


@nox.session(python=sys.executable)
def tests(session: nox.Session) -> None:
    """The whole suite, on the Python that runs nox."""
    session.install("-e", ".[test]")
    whole_suite(session)


@nox.session(python=sys.executable)
def weekly(session: nox.Session) -> None:
    """Hostile calls, several processes, notebooks, the gallery, all benchmarks."""
    session.install("-e", ".[test]")
    session.run("python", "-m", "pytest", "-m", "weekly", *session.posargs)


@nox.session(python=sys.executable)
def bugs(session: nox.Session) -> None:
    """Tests fail on each of the bugs that are put into the code, one at a time."""
    session.install("-e", ".[test]")
    session.run("python", "-m", "tests.bugs", *session.posargs)


@nox.session(python=sys.executable)
def lint(session: nox.Session) -> None:
    """The linter, the formatter and the type checker, which has to see all extras."""
    session.install("-e", ".[test]")
    session.run("ruff", "check")
    session.run("ruff", "format", "--check")
    session.run("pyright")


@nox.session(python=sys.executable)
def docs(session: nox.Session) -> None:
    """The site, with warnings as errors, to site/index.html; it asks nothing of the network."""
    session.install("-e", ".[docs]")
    doctrees = Path(session.create_tmp()).resolve() / "doctrees"
    session.run(
        "sphinx-build", "--fail-on-warning", "--keep-going", "--fresh-env",
        "--doctree-dir", str(doctrees), "docs", "site",
    )  # fmt: skip


@nox.session(python=OLDEST_PYTHON)
def lowest(session: nox.Session) -> None:
    """What needs no extra, from an unpacked sdist, on Python 3.11 with the lower bounds."""
    start(session, "Python 3.11")
    _, sdist = build(session)
    with tarfile.open(sdist) as archive:
        archive.extractall(sdist.parent, filter="data")
    source = sdist.parent / sdist.name.removesuffix(".tar.gz")
    project = tomllib.loads((source / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    constraints = sdist.parent / "lowest.txt"
    constraints.write_text("\n".join(lower_bounds(project)) + "\n", encoding="utf-8")
    session.log("with " + ", ".join(lower_bounds(project)))
    session.install("--constraint", str(constraints), "--editable", f"{source}[core-test]")
    session.chdir(source)
    left_out = [f"--ignore-glob={source / path}" for path in BEYOND]
    session.run("python", "-m", "pytest", *(session.posargs or left_out))


@nox.session(python=NEWEST_PYTHON)
def newest(session: nox.Session) -> None:
    """The whole suite, on the newest Python here and the newest of all that it depends on."""
    start(session, f"Python 3.{OLDEST[1]} or newer")
    session.install("--upgrade", "--upgrade-strategy", "eager", "-e", ".[test]")
    tell = (
        "import jax, platform; print('Python', platform.python_version(), 'JAX', jax.__version__)"
    )
    session.run("python", "-c", tell)
    whole_suite(session)


@nox.session(python=sys.executable)
def wheel(session: nox.Session) -> None:
    """The wheel holds mpfjax alone; in an empty environment README's first filter runs, from the
    wheel and from a clone beside the script.
    """
    wheel, sdist = build(session)
    session.install("twine")
    session.run("twine", "check", "--strict", str(wheel), str(sdist))

    version = wheel.name.split("-")[1]
    held = zipfile.ZipFile(wheel).namelist()
    print(*held, sep="\n")
    apart = [n for n in held if not n.startswith(("mpfjax/", f"mpfjax-{version}.dist-info/"))]
    if apart:
        session.error(f"the wheel would install, beside mpfjax: {apart}")
    missing = {str(path) for path in Path("mpfjax").rglob("*.py")} | {"mpfjax/py.typed"}
    if missing := missing - set(held):
        session.error(f"the wheel lacks {sorted(missing)}")
    if Path(".git").exists():
        tracked = session.run("git", "ls-files", external=True, silent=True) or ""
        with tarfile.open(sdist) as archive:
            packed = {name.partition("/")[2] for name in archive.getnames()}
        if missing := {name for name in tracked.splitlines() if Path(name).exists()} - packed:
            session.error(f"the sdist lacks {sorted(missing)}")

    empty = wheel.parent / "empty"
    session.run("python", "-m", "venv", str(empty))
    python = str(empty / ("Scripts" if os.name == "nt" else "bin") / "python")
    session.run(python, "-m", "pip", "install", "--quiet", str(wheel), external=True)
    session.run(python, "-m", "pip", "check", external=True)
    readme = Path("README.md").read_text(encoding="utf-8")
    first = re.search(r"^```python\n(.*?)^```", readme, re.DOTALL | re.MULTILINE)
    if first is None:
        session.error("README.md has no block of Python")
    (wheel.parent / "first.py").write_text(
        first[1] + "\nassert 'site-packages' in mpfjax.__file__, mpfjax.__file__\n",
        encoding="utf-8",
    )
    session.chdir(wheel.parent)
    session.run(python, "first.py", external=True)

    # As README begins: from a clone, whose folder is called mpfjax, with the script beside it.
    clone = wheel.parent / "beside" / "mpfjax"
    with tarfile.open(sdist) as archive:
        archive.extractall(clone.parent, filter="data")
    (clone.parent / sdist.name.removesuffix(".tar.gz")).rename(clone)
    session.run(python, "-m", "pip", "install", "-q", "--no-deps", "-e", str(clone), external=True)
    beside = clone.parent / "first.py"
    beside.write_text(f"{first[1]}\nassert mpfjax.__file__.startswith({str(clone)!r})\n", "utf-8")
    session.run(python, str(beside), external=True)
