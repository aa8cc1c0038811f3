"""What every benchmark does with its results and errors: write them at once, and whole."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpfjax.storage import write_whole


def write_json(path: Path, content: Any) -> None:
    """Write `content` so that an interruption leaves the old file or the new one, never half."""
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))


def format_table(header: list[str], rows: list[list[str]]) -> str:
    """A table in plain text, columns aligned to the right but for the first."""
    widths = [max(len(line[i]) for line in [header, *rows]) for i in range(len(header))]

    def format_line(cells: list[str]) -> str:
        first, *rest = (
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        return "  ".join([first, *rest])

    rule = "  ".join("-" * width for width in widths)
    return "\n".join([format_line(header), rule, *map(format_line, rows)])


def exit_status(run: Callable[[], None]) -> int:
    """Run a benchmark: bad input is one line on the error stream and 2, an interruption 130."""
    try:
        run()
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; what was finished is written", file=sys.stderr)
        return 130
    return 0
