"""The command `track` within the process of the tests, and what it wrote."""

import json

from mpfjax import command

SMALL = ("--max-objects", 3)


def run(*arguments):
    try:
        return command.main(["track", *map(str, arguments)])
    except SystemExit as stopped:  # argparse's way out
        return stopped.code


def summary_in(folder):
    return json.loads((folder / "summary.json").read_text())
