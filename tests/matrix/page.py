"""The page "what works with what", from the table: `python -m tests.matrix.page` writes it."""

from pathlib import Path

from tests.matrix.filters import MOVES, PAIRS, RECIPES, TRANSFORMS
from tests.matrix.models import FORMS
from tests.matrix.questions import QUESTIONS
from tests.matrix.table import APPROXIMATE, RULES, UNSEEN, rules_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "compatibility.md"
TEXT = """# What works with what

This page is for readers who combine a model, a kind of data, a filter and a question, and want to
know which combinations are supported. The tests combine all of them for one linear Gaussian model,
whose exact solution is known from a Kalman filter in float64, in every form in which a model can
be written (`tests/matrix/`): each number is within four standard errors of the exact one, or the
call is refused with a `ValueError`, or a warning says that the number cannot be trusted.

- Models: {forms}.
- Data: complete; missing by NaN, by `present=` with absurd placeholders, or left to the model
  (`handles_missing`); log-likelihoods shifted by a million; units a thousand times larger or
  smaller; a step of zero likelihood; a very diffuse prior.
- Filters: {recipes}; all transforms and all pairs of transforms; {moves}.
- Questions: {questions}.

## What is refused

{refused}

For models that define only the three methods, {bare} are refused; for conditionally linear
models, {linear}.

## Pairs of transforms

All pairs of {transforms} can be applied in either order, except {pairs}.

## Properties that a filter declares

- `filter.approximate` is true for {approximate}. For all others $\\hat{{Z}}$ is unbiased.
- `biases_score` of a move is true for {unseen}, and for any resampling without
  `with_score_gradient`. Derivatives are an estimate of the score for all others.

Both are true for your own moves unless their classes declare otherwise.

The page is generated from the table of the tests by `python -m tests.matrix.page`.
"""


def listed(names) -> str:
    return ", ".join(sorted(names, key=str.lower))


def refused_of(form: str) -> list[str]:
    """The questions that a particle filter of this form refuses."""
    return [name for name in QUESTIONS if rules_of(form, "complete", "particle", name)]


def page() -> str:
    """The text of the page."""
    pairs = [name for name in PAIRS if rules_of("inputs", "complete", name, "log Z")]
    pairs = [name.removeprefix("with ") for name in pairs]
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
