"""What is refused or warned of where mechanisms meet: all other cells of the matrix are right.

A rule holds for the cells that are in all of its sets; None is every name. A filter counts by the
recipe, the transforms and the moves that it is made of.
"""

from typing import NamedTuple

from tests.matrix.filters import FILTERS, parts
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
WITH_MEANS = these("made of noise", "per particle", "inputs", "matrices by step", "periodic")
OF_OBJECTS = these(
    "partitioned", "distributed", "distributed, evidence", "independent", "clustered"
)
GAUSSIAN = these("Gaussian", "Gaussian, predictive", "Gaussian mixture", "initially Gaussian")
METROPOLIS = these("RandomWalkMetropolis", "Metropolis beside stop")
OF_NOISE = these("point sets", "look-ahead")
# What asks for the density of a step.
OF_DENSITY = these("trajectories", "trajectories, mcmc", "sums", "sums, mcmc", "fixed lag",
                   "score", "Gibbs", "Fisher", "conditional filter")  # fmt: skip
OF_STATES = these("trajectories, mcmc", "sums", "sums, mcmc", "fixed lag",
                  "conditional filter", "Gibbs", "Fisher")  # fmt: skip
OF_PARENTS = these("genealogy", "trajectories, mcmc", "sums, mcmc", "Fisher")
OF_PATHS = these("conditional filter", "Gibbs")
UNBIASED = these("Metropolis", "SMC²")
JOINT = these("independent", "clustered")
APPROXIMATE = GAUSSIAN | these("distributed", "Bernoulli", "Prune", "Exclusion", "own function",
                               "initially own function")  # fmt: skip
# Draws of these are not seen by derivatives.
BEGUN = these("start", "restarts")
UNSEEN = JOINT | BEGUN | these("two draws", "PropagateNested", "Prune", "Exclusion",
                       "own function", "initially own function")  # fmt: skip
RULES = (
    Rule("MultiObjectModel", "filters of several objects are for a `MultiObjectModel`",
         forms=but(FORMS, "one of several"), filters=OF_OBJECTS),
    Rule("TargetsModel", "`bernoulli_filter` is for a `TargetsModel`",
         forms=but(FORMS, "targets"), filters=these("Bernoulli")),
    Rule("TargetsModel", "a `TargetsModel` is for `bernoulli_filter`",
         forms=these("targets"), filters=but(FILTERS, "Bernoulli")),
    Rule("transition_mean|observation_mean",
         "`GaussNewtonProposal` needs the model's means and covariances",
         forms=but(FORMS, *WITH_MEANS), filters=these("guided", "auxiliary")),
    Rule("transition_from_noise",
         "point sets and `PilotLookahead` need `transition_from_noise`",
         forms=these("three methods", "whole numbers"), filters=OF_NOISE),
    Rule("log_transition",
         'gradient "stop", Metropolis moves and backward sampling need `log_transition`',
         forms=these("three methods"), filters=METROPOLIS | these("score")),
    Rule("log_transition", "", forms=these("three methods"), questions=OF_DENSITY),
    Rule("all_transitions|AbstractConditionallyLinear",
         "`PropagateRegimes` needs a latent with finitely many values",
         forms=but(FORMS, "switching"), filters=these("PropagateRegimes")),
    Rule("conditionally linear",
         "Gaussian filters, `PilotLookahead`, Metropolis moves, PaRIS and conditional SMC do not "
         "support conditionally linear models, whose states are only partly sampled",
         forms=LINEAR, filters=GAUSSIAN | METROPOLIS | these("look-ahead")),
    Rule("conditionally linear|by 'exact'|no log_transition", "",
         forms=LINEAR, questions=OF_STATES),
    Rule("floating point", "Gaussian filters do not model whole numbers: exclude them by `where`",
         forms=these("tree", "whole numbers"), filters=GAUSSIAN),
    Rule("floating point", "Metropolis moves do not move whole numbers, and need other parts",
         forms=these("whole numbers"), filters=METROPOLIS),
    Rule("which draw is kept|derivatives do not see",
         "`with_score_gradient` refuses moves whose random choices derivatives ignore "
         "(`biases_score`): several proposals per particle, filters of separate objects",
         together=these("two draws", "score")),
    Rule("derivatives do not see", "",
         filters=these("with start > score", "with restarts > score")),
    Rule("log_initial|initial_from_noise|density|conditionally linear",
         "`with_initialisation` and `with_restarts` need a density of x_0 and a state that is "
         "sampled entirely, in floating point",
         forms=LINEAR | these("three methods", "one of several", "targets", "whole numbers"),
         filters=BEGUN),
    Rule("more than regroup", "", filters=these("with start > selected start")),
    Rule("draws in a way|one parent|more than regroup", "",
         filters=these("with start > families", "with restarts > families",
                       "with families > start", "with families > restarts")),
    Rule("which draw is kept|derivatives do not see", "", filters=UNSEEN, questions=these("score")),
    Rule("initial_noise|noise of|scheme of|draws in a way",
         "standard errors from one run (`with_eve_indices`) assume independent draws: no point "
         "sets, schemes other than multinomial, several proposals, or selection of x_0",
         together=these("families", "point sets")),
    Rule("scheme of", "", filters=these("with families > stratified")),
    Rule("draws in a way", "", filters=these("with families > selected start")),
    Rule("single|one parent|ancestors",
         "genealogies and the method \"mcmc\" of smoothers need single ancestors: no Gaussian "
         "regeneration and no filters of separate objects",
         filters=(GAUSSIAN | JOINT | these("Bernoulli")) - these("initially Gaussian"),
         questions=OF_PARENTS),
    Rule("cannot keep a trajectory|cannot be smoothed|independent|one Propagate|approximate",
         "conditional SMC and particle Gibbs support only `Resample`, `Propagate` and regrouping",
         filters=GAUSSIAN | OF_OBJECTS | METROPOLIS | BEGUN
         | these("point sets", "two draws", "families", "alarm", "PropagateNested", "Bernoulli",
                 "PropagateRegimes", "own function", "initially own function", "Prune",
                 "Exclusion"),
         questions=OF_PATHS),
    Rule("log_initial", '`particle_gibbs` and `score="fisher"` need a density of x_0, which a '
         "`MultiObjectModel` has not", forms=these("one of several"),
         questions=these("Gibbs", "Fisher")),
    Rule("unbiased likelihood",
         "`metropolis_hastings` and `smc2` refuse filters that are `approximate`",
         filters=APPROXIMATE, questions=UNBIASED),
    Rule("cannot be smoothed", "a run with an initialisation is not smoothed: its state is redrawn",
         filters=these("start"),
         questions=these("trajectories", "trajectories, mcmc", "sums", "sums, mcmc", "fixed lag",
                         "genealogy")),
    Rule("no particle one parent", "",
         filters=BEGUN | these("IslandInteraction"), questions=these("sums, mcmc", "Fisher")),
    Rule("slots", "filters of separate objects, `bernoulli_filter`, `with_initialisation` and "
         "`with_restarts` need every slot",
         filters=JOINT | BEGUN | these("Bernoulli"), questions=these("slots")),
    Rule("islands", "`run_islands` does not support `bernoulli_filter`",
         filters=these("Bernoulli"), questions=these("islands")),
    Rule("nearly all weight|hardly any draw|degenerate",
         "a prior that is 100 000 times broader than the likelihood causes a warning; a "
         "conditionally linear model is exact",
         data=these("wide prior"), forms=but(FORMS, *LINEAR), warns=True),
)  # fmt: skip


def rules_of(form, data, filter, question):
    """The rules of a cell; it is right if there is none."""
    return [rule for rule in RULES if rule.holds(form, data, filter, question)]
