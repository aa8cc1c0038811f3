"""The pictures of the gallery, each drawn by the code of its own page in docs/gallery/.

    python -m benchmarks.gallery [PAGE ...]

runs the Python blocks of the pages, such as `jumps`, from top to bottom, and says how many seconds
of processor time each takes. The last block of a page writes its picture. Into --out DIR go the
pictures, beside the pages by default.
"""

import argparse
import contextlib
import re
import sys
import time
from pathlib import Path

import matplotlib
import matplotlib.pyplot

from mpfjax.console import exit_status

PAGES = Path(__file__).resolve().parents[1] / "docs" / "gallery"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def main(arguments: list[str] | None = None) -> int:
    """Run the pages."""
    options = parse(arguments)
    return exit_status(lambda: run(options), arguments)


def names() -> list[str]:
    """The pages that have code."""
    pages = sorted(PAGES.glob("*.md"))
    return [page.stem for page in pages if BLOCK.search(page.read_text(encoding="utf-8"))]


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, or a message that names the one that cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gallery")
    parser.add_argument("pages", nargs="*", metavar="PAGE")
    parser.add_argument("--out", default=str(PAGES), metavar="DIR")
    options = parser.parse_args(arguments)
    for name in options.pages:
        if name not in names():
            parser.error(f"argument PAGE: {name!r} is none of {', '.join(names())}")
    return options


def run(options: argparse.Namespace) -> None:
    """Each page in a namespace of its own, with the folder of the pictures as working directory."""
    matplotlib.use("Agg")
    folder = Path(options.out)
    folder.mkdir(parents=True, exist_ok=True)
    for name in options.pages or names():
        begin = time.process_time()
        text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
        code = "\n".join(BLOCK.findall(text))
        with contextlib.chdir(folder):
            exec(compile(code, f"{name}.md", "exec"), {"__name__": name})
        matplotlib.pyplot.close("all")
        print(f"{name}: {time.process_time() - begin:.1f} s of processor time")


if __name__ == "__main__":
    sys.exit(main())
