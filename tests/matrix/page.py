"""The page "what works with what", from the table: `python -m tests.matrix.page` writes it."""

from pathlib import Path

from tests.matrix.filters import MOVES, PAIRS, RECIPES, TRANSFORMS, parts
from tests.matrix.models import FORMS
from tests.matrix.questions import QUESTIONS
from tests.matrix.table import AFTER_START, APPROXIMATE, RULES, UNSEEN, rules_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "compatibility.md"
TEXT = """# What works with what

One linear Gaussian law, whose exact answers a Kalman filter gives in float64, is written in
every form in which a model can be written. The tests put every form, every kind of data, every
filter and every question together (`tests/matrix/`). Each number is within four standard errors
of the exact one, or the call is refused with a `ValueError`, or a warning says that the number
cannot be trusted. This page is made from the table of the tests, by `python -m
tests.matrix.page`.

- Models: {forms}.
- Data: complete; missing by NaN, by `present=` with absurd placeholders, or left to the model
  (`handles_missing`); each log-likelihood a million higher or lower; units a thousand times as
  large or small; a step of zero likelihood; a very diffuse prior.
- Filters: {recipes}; all transforms and all pairs of transforms; {moves}.
- Questions: {questions}.

## What is refused

{refused}

Of a model that has nothing but the three methods, {bare} are refused. Of conditionally linear
models, {linear}.

## Pairs of transforms

All pairs of {transforms} work in either order, except {pairs}.

## What a filter says of itself

- `filter.approximate`: {approximate}. $\\log \\hat{{Z}}$ of all others is that of an unbiased
  estimate.
- A move's `biases_score`: {unseen}, besides any resampling without `with_score_gradient`.
  Derivatives of $\\log \\hat{{Z}}$ are an unbiased estimate of the score with all others.

Both are true of a move of your own unless its class says otherwise.
"""


def listed(names) -> str:
    return ", ".join(sorted(names, key=str.lower))


def refused_of(form: str) -> list[str]:
    """The questions that a particle filter of this form refuses."""
    return [name for name in QUESTIONS if rules_of(form, "complete", "particle", name)]


def page() -> str:
    """The text of the page."""
    pairs = [name for name in PAIRS if rules_of("inputs", "complete", name, "log Z")]
    pairs = [name.removeprefix("with ") for name in pairs if not AFTER_START & parts(name)]
    return TEXT.format(
        forms=", ".join(FORMS),
        recipes=", ".join(RECIPES),
        moves=", ".join(f"`{name}`" for name in MOVES if " " not in name),
        questions=", ".join(QUESTIONS),
        refused="\n".join(f"- {rule.why[0].upper()}{rule.why[1:]}." for rule in RULES if rule.why),
        bare=listed(refused_of("three methods")),
        linear=listed(refused_of("conditionally linear")),
        transforms=", ".join(TRANSFORMS),
        pairs=", ".join(f"*{name}*" for name in pairs),
        approximate=listed(APPROXIMATE),
        unseen=listed(UNSEEN),
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
