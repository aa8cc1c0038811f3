"""The command: python -m mpfjax track SOURCE --out DIR, or mpfjax track SOURCE --out DIR."""

import warnings

from mpfjax.command.arguments import parse_arguments
from mpfjax.command.loop import run
from mpfjax.console import exit_status, say_warnings


def main(arguments: list[str] | None = None) -> int:
    """Run the command; bad input is one line on the error stream and exit status 2."""
    options = parse_arguments(arguments)
    with warnings.catch_warnings():
        say_warnings(RuntimeWarning)
        return exit_status(lambda: run(options), arguments)
