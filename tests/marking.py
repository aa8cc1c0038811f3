"""Which cases of a test run always, which before anything is taken in, and which weekly."""

import itertools
from collections.abc import Iterable
from typing import Any

import pytest


def marked(mark: pytest.MarkDecorator, cases: Iterable[Any]) -> list[Any]:
    """The cases for `parametrize`, all with this mark."""
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=mark) for case in cases
    ]


def exactness(cases: Iterable[Any]) -> list[Any]:
    """The cases, marked: they compare with an exact answer, and take too long to run always."""
    return marked(pytest.mark.exactness, cases)


def weekly(cases: Iterable[Any]) -> list[Any]:
    """The cases, marked: they need many processes, programs or minutes."""
    return marked(pytest.mark.weekly, cases)


def quick_of(cases: Iterable[Any], always: Iterable[Any], one_in: int = 1) -> list[Any]:
    """All the cases: those of `always`, of the others one in so many as `exactness`, rest weekly.

    Those that are taken are spread over the cases: of a product of names, each name has some.
    """
    always, others = list(always), itertools.count()
    return [
        case if case in always else (weekly if next(others) % one_in else exactness)([case])[0]
        for case in cases
    ]
