"""What is refused, or warned of, where two mechanisms meet: all other cells of the matrix are right.

A rule holds for the cells that are in all of its sets; None is every name. A filter counts by the
recipe, the transforms and the moves that it is made of.
"""

from typing import NamedTuple

from tests.matrix.data import FOR
from tests.matrix.filters import FILTERS, MOVES, RECIPES, TRANSFORMS, parts
from tests.matrix.models import FORMS

Names = frozenset[str] | None


class Rule(NamedTuple):
    """What an error, or a warning, of these cells says."""

    says: str
    """a regular expression that is in the message."""
    why: str
    """for the page of the documentation."""
    forms: Names = None
    filters: Names = None
    """it is made of one of these."""
    together: Names = None
    """it is made of all of these."""
    data: Names = None
    questions: Names = None
    warns: bool = False

    def holds(self, form, data, filter, question):
        """Whether the cell is among those of the rule."""
        made = parts(filter)
        return (
            (self.forms is None or form in self.forms)
            and (self.filters is None or bool(self.filters & made))
            and (self.together is None or self.together <= made)
            and (self.data is None or data in self.data)
            and (self.questions is None or question in self.questions)
        )


def these(*names: str) -> frozenset[str]:
    return frozenset(names)


def but(all_names, *names: str) -> frozenset[str]:
    return frozenset(all_names) - set(names)


LINEAR = these("conditionally linear", "mixed", "switching")
OF_OBJECTS = these(
    "partitioned", "distributed", "distributed, evidence", "independent", "clustered"
)
GAUSSIAN = these("Gaussian", "Gaussian, predictive", "Gaussian mixture")
METROPOLIS = these("RandomWalkMetropolis", "MetropolisAdjustedLangevin")
WHOLE_STATE = GAUSSIAN | METROPOLIS | these("look-ahead", "PropagateTempered")
OF_NOISE = these("point sets", "look-ahead", "PropagateTempered")
BACKWARD = these("trajectories", "trajectories, mcmc", "sums", "sums, mcmc", "conditional filter")
RULES = (
    Rule("is not a MultiObjectModel|independent copies", "filters of several objects need a `MultiObjectModel`",
         forms=but(FORMS, "one of several"), filters=OF_OBJECTS),
    Rule("is not a TargetsModel", "`bernoulli_filter` needs a `TargetsModel`",
         forms=but(FORMS, "targets"), filters=these("Bernoulli")),
    Rule("transition_mean|observation_mean", "`GaussNewtonProposal` needs means and covariances of the model",
         forms=but(FORMS, "made of noise", "per particle", "inputs", "matrices by step", "periodic"),
         filters=these("guided", "auxiliary")),
    Rule("transition_from_noise", "point sets, `PilotLookahead` and tempering need `transition_from_noise`",
         forms=these("three methods", "whole numbers"), filters=OF_NOISE),
    Rule("log_transition", "gradient \"stop\", Metropolis moves and backward sampling need `log_transition`",
         forms=these("three methods"), filters=METROPOLIS | these("score")),
    Rule("log_transition", "", forms=these("three methods"), questions=BACKWARD | these("score", "Gibbs")),
    Rule("conditionally linear", "moves and smoothers that need a state drawn as a whole refuse a conditionally linear model",
         forms=LINEAR, filters=WHOLE_STATE),
    Rule("conditionally linear|by 'exact'", "", forms=LINEAR,
         questions=these("trajectories, mcmc", "sums", "sums, mcmc", "conditional filter", "Gibbs", "Gibbs, draw")),
    Rule("all_transitions|AbstractConditionallyLinear", "`PropagateRegimes` needs finitely many latents",
         forms=but(FORMS, "switching"), filters=these("PropagateRegimes")),
    Rule("floating point", "a Gaussian has no whole numbers", forms=these("whole numbers", "tree"), filters=GAUSSIAN | these("initially Gaussian")),
    Rule("which draw is kept", "`with_proposals_per_particle` has no score", together=these("two draws", "score")),
    Rule("scheme|noise|families|Eve|SelectInitial", "Eve indices need independent multinomial draws and no choice of x_0",
         together=these("families", "point sets")),
    Rule("nearly all weight|hardly any draw|degenerate", "a prior 100 000 standard deviations of the likelihood wide is warned of",
         data=these("wide prior"), forms=but(FORMS, *LINEAR), warns=True),
)  # fmt: skip
# Rewritten at this moment: taken in with what they rest on.
AFTER_START = these("start", "restarts")


def rules_of(form, data, filter, question):
    """The rules of a cell; it is right if there is none."""
    return [rule for rule in RULES if rule.holds(form, data, filter, question)]


__all__ = ["AFTER_START", "FILTERS", "FOR", "MOVES", "RECIPES", "RULES", "TRANSFORMS", "rules_of"]
