"""Wherever two mechanisms meet, the number is right or the call is refused.

A row is a form of the model and a filter, whose cells share programs; `table.py` says which of them
are not right. A sample of the rows runs before every landing, all of them weekly.
"""

import re
import warnings

import pytest

from tests.marking import quick_of, weekly
from tests.matrix.data import FOR
from tests.matrix.filters import FILTERS, MOVES, PAIRS, RECIPES, SINGLE, parts
from tests.matrix.models import FORMS
from tests.matrix.page import PAGE, page
from tests.matrix.questions import OF_RUNS, OTHERS, QUESTIONS, Row
from tests.matrix.table import LINEAR, rules_of

SINGLES = [*RECIPES, *SINGLE, *MOVES]
OF_PARAMETERS = ("Fisher", "Gibbs", "Metropolis", "SMC²")
GAPS = ("complete", "NaN", "present")


def outcome(row, form, data, filter, question):
    """What is amiss with the cell; None where it is as the table says."""
    rules = rules_of(form, data, filter, question)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            QUESTIONS[question](row, data)
            said = None
        except ValueError as error:
            said = str(error)
        except AssertionError as error:
            said = error
    if not rules:
        return said
    warned = " ".join(str(warning.message) for warning in caught)
    for rule in rules:
        text = warned if rule.warns else said
        if isinstance(text, str) and re.search(rule.says, text):
            return None
    return f"not refused as the table says: {said}; {warned}"


def check(form, filter, cells):
    row, amiss = Row(form, filter), {}
    for data, question in cells:
        if question in OF_PARAMETERS and row.form.offset is None:
            continue
        if question == "genealogy" and form in LINEAR:  # of latents alone, which do nothing
            continue
        if (said := outcome(row, form, data, filter, question)) is not None:
            amiss[data, question] = " ".join(str(said).split())[:300]
    assert not amiss, "\n".join(f"{cell}: {said}" for cell, said in amiss.items())


def cells(datas, questions):
    return [(data, question) for data in datas for question in questions]


@pytest.mark.parametrize("form", quick_of(FORMS, ["made of noise"], one_in=1))
def test_data(form):
    """All data, by a particle filter."""
    check(form, "particle", cells(FOR[FORMS[form].data], OF_RUNS))


ROWS = [(form, filter) for filter in SINGLES for form in FORMS]


@pytest.mark.parametrize(("form", "filter"), quick_of(ROWS, [], one_in=20))
def test_filters(form, filter):
    """Every recipe, transform and class of move, of every form."""
    check(form, filter, cells(GAPS, OF_RUNS))


OF_PAIRS = [(form, pair) for pair in PAIRS for form in ("inputs", "conditionally linear")]


# Compiling a start takes half a minute.
SLOW = {"start", "restarts"}
WEEKLY = [(form, pair) for form, pair in OF_PAIRS if SLOW & parts(pair)]
OTHER_PAIRS = [cell for cell in OF_PAIRS if cell not in WEEKLY]


@pytest.mark.parametrize(("form", "pair"), [*quick_of(OTHER_PAIRS, [], one_in=20), *weekly(WEEKLY)])
def test_pairs_of_transforms(form, pair):
    """In either order."""
    check(form, pair, cells(GAPS, OF_RUNS))


ASKED = [(form, question) for form in FORMS for question in OTHERS]


@pytest.mark.parametrize(("form", "question"), quick_of(ASKED, [], one_in=12))
def test_questions_of_forms(form, question):
    """Every question of every form, also where something is missing."""
    check(form, "particle", cells(GAPS, [question]))


SMOOTHERS = ("trajectories", "trajectories, mcmc", "sums", "sums, mcmc", "fixed lag", "genealogy")


@pytest.mark.parametrize("question", quick_of(SMOOTHERS, [], one_in=3))
def test_smoothers_after_a_step_without_likelihood(question):
    check("made of noise", "particle", cells(("zero likelihood",), [question]))


TAKEN = ("inputs", "one of several", "targets", "switching")
OF_FILTERS = [(filter, question) for question in OTHERS for filter in SINGLES]


@pytest.mark.parametrize(("filter", "question"), quick_of(OF_FILTERS, [], one_in=40))
def test_questions_of_filters(filter, question):
    """Every question of every filter, of the first form that it takes."""
    form = next(form for form in TAKEN if not rules_of(form, "complete", filter, "log Z"))
    check(form, filter, cells(("NaN",), [question]))


def test_every_filter_has_a_form():
    assert set(FILTERS) == {*SINGLES, *PAIRS}


def test_the_page_of_the_documentation_is_that_of_the_table():
    assert PAGE.read_text(encoding="utf-8") == page(), "python -m tests.matrix.page writes it"
