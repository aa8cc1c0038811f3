"""The numbers that command lines take: one that will not do is argparse's error, and exit 2."""

import argparse
import math
from collections.abc import Callable
from typing import Any


def whole(least: int = 1, most: int = 2**31 - 1) -> Callable[[str], int]:
    """The type of an option that is a whole number in this range, by default a count."""

    def read(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if not least <= number <= most:
            raise argparse.ArgumentTypeError(
                f"{text!r} is not a whole number from {least} to {most}"
            )
        return number

    return read


# JAX makes a key of the last 32 bits alone, so that larger seeds would be smaller ones.
seed = whole(0, 2**32 - 1)


def positive(text: str) -> float:
    """The type of an option that is a positive, finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive, finite number")
    return number


def fill_in(
    parser: argparse.ArgumentParser,
    options: argparse.Namespace,
    is_used: bool,
    why: str,
    /,
    **defaults: Any,
) -> None:
    """Give options that are None their defaults; one that was given and is not used is an error."""
    for name, default in defaults.items():
        if getattr(options, name) is None:
            setattr(options, name, default)
        elif not is_used:
            parser.error(f"argument --{name.replace('_', '-')}: does nothing {why}")
