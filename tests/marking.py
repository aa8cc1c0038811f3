"""Which cases of a test run always, and which only where all are asked for."""

from collections.abc import Iterable
from typing import Any

import pytest


def thorough(cases: Iterable[Any]) -> list[Any]:
    """The cases for `parametrize`, marked: they test the same behaviour as others, differently.

    `python -m pytest` leaves them out, `python -m pytest -m thorough` runs them alone; what is
    taken in has passed both.
    """
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.thorough)
        for case in cases
    ]


def quick_of(cases: Iterable[Any], always: Iterable[Any]) -> list[Any]:
    """All the cases, those that are not among `always` marked as thorough."""
    always = list(always)
    return [case if case in always else thorough([case])[0] for case in cases]
