"""The data of the matrix: the same observations, given, missing and shifted in every way."""

from typing import Any, NamedTuple

import numpy as np

from mpfjax import Series
from tests.matrix.law import Law, kalman
from tests.matrix.models import BLIND, FORMS

Y = np.array([0.6, -0.7, 1.2, 0.4])
OF_STEPS = np.array([2.2, 1.1, 3.3, 2.6])
U = np.array([1.0, -1.0, 0.5, 0.0])
GAP = 1  # the index of what is missing
PLACEHOLDER = 1e6


class Case(NamedTuple):
    """A model, its data, and the exact answer."""

    model: Any
    series: Series
    law: Law
    y: np.ndarray
    """NaN where nothing is seen."""
    u: np.ndarray
    answer: Any


# Of a form: the data of a class of one's own, and of others.
FOR = {
    "own": ("complete", "NaN", "present", "handles_missing", "shift up", "shift down",
            "small units", "large units", "zero likelihood", "wide prior"),
    "parts": ("complete", "NaN", "present", "shift up", "shift down", "small units",
              "large units", "zero likelihood", "wide prior"),
    "plain": ("complete", "NaN", "present", "small units", "large units", "wide prior"),
    # A constant left out of a density would count as clutter.
    "sets": ("complete", "NaN", "present", "small units", "large units", "zero likelihood",
             "wide prior"),
    "targets": ("complete", "NaN", "present"),
    "whole": ("complete", "NaN", "present", "handles_missing", "shift up", "shift down",
              "zero likelihood"),
}  # fmt: skip
NAMES = FOR["own"]
_LAWS = {
    "shift up": Law(shift=1e6),
    "shift down": Law(shift=-1e6),
    "small units": Law().in_units(1e-3),
    "large units": Law().in_units(1e3),
    "wide prior": Law(p0=5e4, m0=0.0),
}
_MISSING = ("NaN", "present", "handles_missing", "zero likelihood")


def case(form_name: str, name: str) -> Case:
    """The model and the data of this name."""
    form, law = FORMS[form_name], _LAWS.get(name, Law())
    unit = {"small units": 1e-3, "large units": 1e3}.get(name, 1.0)
    seen = unit * (OF_STEPS if form.data == "whole" else Y)
    u = U if form.inputs else np.zeros(len(Y))
    truth = np.where((np.arange(len(Y)) == GAP) & (name in _MISSING), np.nan, seen)
    fill = {"present": PLACEHOLDER, "zero likelihood": BLIND}.get(name, np.nan)
    y = np.where(np.isnan(truth), fill, seen).astype(np.float32)
    y = y[:, None] if form.rows else y
    inputs = form.inputs(law, u) if form.inputs else None
    if name == "present":
        series = Series(y, inputs, present=~np.isnan(truth))
    elif name == "NaN":
        series = Series.skipping(y, inputs)
    else:
        series = Series(y, inputs)
    model = form.make(law, handles_missing=True) if name == "handles_missing" else form.make(law)
    return Case(model, series, law, truth, u, form.answer(law, truth, u))


__all__ = ["FOR", "NAMES", "Case", "case", "kalman"]
