"""The documentation holds: its code runs, its commands exist, the API pages are complete."""

import importlib.util
import inspect
import re
import sys
from pathlib import Path

import jax
import pytest
from sybil import Sybil
from sybil.parsers.markdown import PythonCodeBlockParser, SkipParser

import mpfjax
from tests.marking import quick_of

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md"]
PAGES += sorted(path for path in DOCS.rglob("*.md") if "notebooks" not in path.parts)
NAMES = [str(page.relative_to(REPOSITORY)) for page in PAGES]
COMMAND = re.compile(r"python -m (benchmarks\.[a-z_]+|mpfjax\b)((?: [^\n`|#]*)?)")
WITH_CODE = [page for page in PAGES if "```python" in page.read_text(encoding="utf-8")]
# The others are run where the thorough tests are.
QUICK_PAGES = [page for page in WITH_CODE if page.stem in ("README",)]

sybil = Sybil(parsers=[PythonCodeBlockParser(), SkipParser()], path=str(REPOSITORY))


def stem(page: Path) -> str:
    """The name of a page without its ending."""
    return page.stem


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize("page", quick_of(WITH_CODE, QUICK_PAGES), ids=stem)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch):
    """All blocks of a page in their order, as a reader runs them: without the tests' strictness."""
    document = sybil.parse(page)
    if page.parent.name == "gallery":  # there the code draws the page's picture
        monkeypatch.chdir(tmp_path)
    examples = list(document.examples())
    assert examples
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        for example in examples:
            example.evaluate()
    if page.parent.name == "gallery":
        assert [path.name for path in tmp_path.iterdir()] == [f"{page.stem}.png"]
        assert (page.parent / f"{page.stem}.png").exists()


@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/start.md"])
def test_the_first_lines_keep_programs(page):
    example = next(iter(sybil.parse(REPOSITORY / page).examples()))
    assert "mpfjax.keep_programs()" in example.parsed.splitlines()[2]


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_the_commands_of_a_page_exist(page):
    """Each module, and each option that a command gives it."""
    for name, arguments in COMMAND.findall(page.read_text(encoding="utf-8")):
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


def test_readme_is_short_and_keeps_its_two_commands():
    lines = (REPOSITORY / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    assert "    python -m pip install -e . && python -m benchmarks.score_vs_particles" in lines
    assert '    python -m pip install -e ".[test]" && python -m pytest' in lines


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_pictures_and_pages_that_a_page_links_to_exist(page):
    """Links to files; Sphinx checks those between pages too, but not README's."""
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", text):
        target = (page.parent / link).resolve()
        shown = REPOSITORY / "notebooks" / target.name  # copied into docs/ as the site is built
        assert target.exists() or shown.exists(), link


def test_every_public_name_is_on_an_api_page():
    sys.path.insert(0, str(DOCS / "_ext"))
    try:
        api = importlib.import_module("api_names")
    finally:
        sys.path.remove(str(DOCS / "_ext"))
    text = "".join(path.read_text(encoding="utf-8") for path in (DOCS / "api").glob("*.md"))
    shown = re.findall(r"^\.\. auto(?:class|function|data):: (\S+)", text, re.MULTILINE)
    assert len(shown) == len(set(shown)), "a name stands on two pages"
    names = api.public_names()
    # Pages also show what functions return, under the names of their files.
    assert set(names.values()) <= {names.get(name, name) for name in shown}


@pytest.mark.parametrize(
    ("page", "words"),
    [
        ("model.md", "## Known inputs"),
        ("extending.md", "### A move with memory"),
        ("index.md", "## How to cite"),
        ("filters.md", "## How many components (M)"),
        ("filters.md", "If there are more modes than M"),
        ("tuning.md", "**`num_samples`**"),
    ],
    ids=lambda value: value.strip("#*` "),
)
def test_a_new_reader_is_two_clicks_away(page, words):
    """From the index, by the links of its text and of one page after it."""
    assert words in (DOCS / page).read_text(encoding="utf-8")
    reached = {"index.md"}
    for _click in range(2):
        texts = [(DOCS / name).read_text(encoding="utf-8") for name in reached]
        links = {link for text in texts for link in re.findall(r"\]\(([a-z_]+\.md)", text)}
        reached |= {link for link in links if (DOCS / link).exists()}
    assert page in reached


def test_the_step_that_is_shown_is_the_one_that_runs():
    readme = (DOCS.parent / "README.md").read_text("utf-8")
    shown = re.search(r"^def _step\(.*?^```", readme, re.M | re.S)
    lines = inspect.getsource(mpfjax.Filter._step).splitlines()
    body = lines[next(k for k, line in enumerate(lines) if line.endswith('predicts."""')) + 1 :]
    assert [line.strip() for line in shown[0].splitlines()[1:-1]] == [line.strip() for line in body]
