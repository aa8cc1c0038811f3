"""The command: python -m mpfjax track SOURCE --out DIR, or mpfjax track SOURCE --out DIR."""

import importlib
import warnings

from mpfjax.command.arguments import parsers
from mpfjax.console import exit_status, say_warnings


def main(arguments: list[str] | None = None) -> int:
    """Run the command; bad input is one line on the error stream and exit status 2."""
    parser, track = parsers()
    options = parser.parse_args(arguments)
    # Imported only now: the help does not wait for JAX.
    loop = importlib.import_module("mpfjax.command.loop")
    loop.check_options(track, options)
    with warnings.catch_warnings():
        say_warnings(RuntimeWarning)
        return exit_status(lambda: loop.run(options), arguments)
