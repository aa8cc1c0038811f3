"""The documentation holds: its code runs, its commands exist, the API pages are complete."""

import importlib.util
import json
import re
from pathlib import Path

import jax
import pytest
from sybil import Sybil
from sybil.parsers.markdown import PythonCodeBlockParser, SkipParser

from tests.marking import marked, weekly

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS = REPOSITORY / "docs"
README, CONTRIBUTING = REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md"
PAGES = [README, CONTRIBUTING, *sorted(DOCS.rglob("*.md"))]
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES if "notebooks" not in page.parts}
WITH_CODE = [page for page in TEXTS if page != README and "```python" in TEXTS[page]]
GALLERY = [page for page in WITH_CODE if page.parent.name == "gallery"]
LONG = [page for page in WITH_CODE if page.stem in ("smoothing", "tuning")]
GUIDES = [page for page in WITH_CODE if page.parent.name != "gallery" and page not in LONG]
NOTEBOOKS = sorted((REPOSITORY / "notebooks").glob("*.ipynb"))
# What the test puts in the place of a notebook's sizes, so that it takes seconds: each stands once.
SMALLER = {
    "01": [("50, 1000, 2000", "2, 100, 4")],
    "02": [("NUM_RUNS = 60, 10", "NUM_RUNS = 5, 2")],
    "03": [
        ("jax.random.key(0), 200)", "jax.random.key(0), 2)"),
        ("for name in filters:", 'for name in ("GPF", "GM-MPF"):'),
        ("num_frames = 80", "num_frames = 4"),
        ("for name in box_filters:", 'for name in ("MPF", "GM-MPF"):'),
        ("np.arange(1, 121)", "np.arange(1, 13)"),
    ],
    "04": [("20, 300, 25", "2, 30, 10")],
    "05": [
        ("200, 100, 24", "4, 3, 6"),
        ("num_seeds=64", "num_seeds=8"),
        ("for start in starts]", "for start in starts[:1]]"),
        ("guided, observations, 600,", "guided, observations, 10,"),
        ("num_frames = 40", "num_frames = 6"),
        ("np.geomspace(0.04, 0.8, 12)", "np.geomspace(0.04, 0.8, 4)"),
    ],
    "06": [
        ("50, 100, 400", "3, 10, 20"),
        ("jax.random.split(key, 400)", "jax.random.split(key, 10)"),
    ],
    "07": [
        ("NUM_STEPS = 50, 60", "NUM_STEPS = 3, 12"),
        ("rao_blackwellised(10_000)", "rao_blackwellised(200)"),
        ("num_paths = 500", "num_paths = 50"),
        ("= 2000, Navigation()", "= 500, Navigation()"),
    ],
    "08": [("5000, 16, 0.3", "1000, 2, 1.5")],
}
COMMAND = re.compile(r"python -m (benchmarks\.[a-z_]+|mpfjax\b)((?: [^\n`|#]*)?)")

sybil = Sybil(parsers=[PythonCodeBlockParser(), SkipParser()], path=str(REPOSITORY))


def stem(page: Path) -> str:
    """The name of a page without its ending."""
    return page.stem


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    "page", [README, *marked(pytest.mark.pages, GUIDES), *weekly([*LONG, *GALLERY])], ids=stem
)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch):
    """All blocks of a page in their order, as a reader runs them: without the tests' strictness."""
    examples = list(sybil.parse(page).examples())
    assert examples
    monkeypatch.chdir(tmp_path)  # the gallery draws its pictures there
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        for example in examples:
            example.evaluate()
    if page in GALLERY:
        assert [path.name for path in tmp_path.iterdir()] == [f"{page.stem}.png"]


@pytest.mark.weekly
@pytest.mark.parametrize("path", NOTEBOOKS, ids=stem)
def test_a_notebook_runs_with_smaller_sizes(path):
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for size, smaller in SMALLER[path.stem[:2]]:
        (cell,) = [cell for cell in cells if size in cell.source]
        assert cell.source.count(size) == 1, size
        cell.source = cell.source.replace(size, smaller)
    resources = {"metadata": {"path": path.parent}}
    NotebookClient(notebook, timeout=240, kernel_name="python3", resources=resources).execute()


def test_notebooks_hold_their_outputs_and_use_the_library_alone():
    for path in NOTEBOOKS:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        outputs = [output for cell in cells for output in cell.get("outputs", ())]
        assert any("image/png" in output.get("data", {}) for output in outputs), path
        assert not any(output["output_type"] == "error" for output in outputs), path
        code = [cell["source"] for cell in cells if cell["cell_type"] == "code"]  # lists of lines
        assert max(map(len, code)) <= 25, path
        assert "benchmarks" not in str(code), path


@pytest.mark.parametrize("page", TEXTS, ids=stem)
def test_commands_and_files_that_a_page_names_exist(page):
    """Each module, each option that a command gives it, each link to a file."""
    for name, arguments in COMMAND.findall(TEXTS[page]):
        module = importlib.util.find_spec(name if name != "mpfjax" else "mpfjax.__main__")
        assert module is not None, name
        place = Path(module.origin)
        is_folder = place.name in ("__init__.py", "__main__.py")
        sources = place.parent.rglob("*.py") if is_folder else [place]
        text = "".join(source.read_text(encoding="utf-8") for source in sources)
        for option in re.findall(r"(?<=\s)--[a-z-]+", arguments):
            argument = option.removeprefix("--").removeprefix("no-").replace("-", "_")
            is_there = f'"{option}"' in text or re.search(rf"^    {argument}: ", text, re.MULTILINE)
            assert is_there, f"{name} {option}"
    for link in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", TEXTS[page]):
        target = (page.parent / link).resolve()
        shown = REPOSITORY / "notebooks" / target.name  # copied into docs/ as the site is built
        assert target.exists() or shown.exists(), link


def test_walks_end_at_files_that_are_there():
    """And what one names as a function is defined in the file that it names with it."""
    walks = TEXTS[CONTRIBUTING].split("\nWalks,")[1].split("\n## ")[0]
    for path in re.findall(r"`(\w+/[^`]*)`", walks):
        assert (REPOSITORY / path).exists(), path
    for name, path in re.findall(r"`(\w+)` in `([^`]+\.py)`", walks):
        assert re.search(rf"^ *def {name}\b", (REPOSITORY / path).read_text("utf-8"), re.M), name


def test_every_public_name_is_on_an_api_page(monkeypatch):
    monkeypatch.syspath_prepend(DOCS / "_ext")
    names = importlib.import_module("api_names").public_names()
    entry = re.compile(r"^\.\. auto(?:class|function|data):: (\S+)", re.MULTILINE)
    pages = {page: entry.findall(TEXTS[page]) for page in TEXTS if DOCS / "api" in page.parents}
    assert max(map(len, pages.values())) <= 12, "a page is too long to read"
    shown = [name for page in pages.values() for name in page]
    assert len(shown) == len(set(shown)), "a name stands on two pages"
    # Pages also show what functions return, under the names of their files.
    assert set(names.values()) <= {names.get(name, name) for name in shown}
