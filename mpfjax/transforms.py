"""Transforms of filters, which change their moves; they compose, on any chain of moves."""

import dataclasses
from collections.abc import Callable
from typing import Any

from mpfjax.checks import Count, InnerShare, checked
from mpfjax.filter import Filter
from mpfjax.lookahead.pilot import Lookahead, PilotLookahead
from mpfjax.moves import base
from mpfjax.moves.initial import SelectInitial, require_propagation
from mpfjax.moves.propagation.nested import PropagateNested
from mpfjax.moves.propagation.propagate import Propagate
from mpfjax.moves.resampling.auxiliary import AuxiliaryResample
from mpfjax.moves.resampling.resample import Resample
from mpfjax.moves.start.restart import Restart


@checked
def map_moves(filter: Filter, change: Callable[[Any], Any]) -> Filter:
    """The filter in which `change(move)` replaces each move.

    Moves inside other moves are changed first, such as those of an `Every`, and the resampling
    within a `Partitioned`:

        map_moves(filter, lambda m: Resample("stratified") if isinstance(m, Resample) else m)
    """
    return _change(filter, base.AbstractMove, change, within=True)


def _change(
    filter: Filter, kind: Any, change: Callable[[Any], Any], within: bool = False
) -> Filter:
    """The filter with its moves of this kind changed, also those within propagations or not."""

    def visit(move: base.AbstractMove) -> Any:
        enters = within or not isinstance(move, base.AbstractPropagation)
        move = move.map_inner(visit) if enters else move
        return change(move) if isinstance(move, kind) else move

    return filter.replace(
        moves=[visit(move) for move in filter.moves],
        initial_moves=[visit(move) for move in filter.initial_moves],
    )


@checked
def with_resampling(filter: Filter, resample: Resample) -> Filter:
    """The filter with this `Resample` instead of the existing one; look-aheads are retained.

    Raises `ValueError` for anything but a `Resample`. Use it to change the allocation of particles
    to components: `with_resampling(filter, Resample(allocation="equal"))`.
    """
    return _change(filter, Resample, lambda move: resample)


@checked
def with_quasi_monte_carlo(filter: Filter) -> Filter:
    """The filter with randomised quasi-Monte Carlo draws: sequential quasi-Monte Carlo.

    Gerber and Chopin (2015). All noise is "rqmc", including the noise of x_0 (see `Propagate`), and
    the resamplings of the chain sort the particles along a Hilbert curve of their state. Raises
    `ValueError` for a model or proposal that is not reparameterised. Use it if mixture weights and
    likelihoods must be accurate.
    """
    ordered = _change(filter, Resample, lambda move: dataclasses.replace(move, along_curve=True))
    return _everywhere(ordered, "noise", "rqmc").replace(initial_noise="rqmc")


@checked
def with_score_gradient(filter: Filter) -> Filter:
    """The filter whose derivatives estimate the score, for tuning: gradient "stop" in all moves.

    Ścibior and Wood (2021); values are identical to the bit. The resampling inside propagations is
    included. Raises `ValueError` for a model without `log_transition`, and for moves whose random
    choices derivatives ignore (`biases_score`).
    """
    changed = _everywhere(filter, "gradient", "stop")
    for move in base.all_of((*changed.initial_moves, *changed.moves)):
        if move.biases_score:
            raise ValueError(f"filter: derivatives do not see all that {base.name_of(move)} draws")
    return changed


@checked
def with_proposals_per_particle(filter: Filter, num_draws: Count) -> Filter:
    """The filter in which each particle draws K values of x_t and retains one: `PropagateNested`.

    `num_draws` is K; with 1, each particle draws once, as usual. Raises `ValueError` for K < 1, and
    for a filter without `Propagate`. Use it if the likelihood is narrow and cheap, with four to
    sixteen draws.
    """
    require_propagation(filter._now(), "each particle draws")

    def nested(move: Any) -> base.AbstractPropagationOfEach:
        plain = move.propagate if isinstance(move, PropagateNested) else move
        return plain if num_draws == 1 else PropagateNested(plain, num_draws)

    return _change(filter, base.AbstractPropagationOfEach, nested)


@checked
def with_lookahead(filter: Filter, lookahead: Lookahead | None = None) -> Filter:
    """The filter that resamples by its weights times a look-ahead ν to y_t: `AuxiliaryResample`.

    `lookahead` is the argument of that move; None is the filter's proposal if it has a
    `log_normaliser`, and otherwise a `PilotLookahead`, which uses only the model. A look-ahead that
    is a proposal also draws x_t if the filter has no other proposal. Raises `ValueError` for a
    filter without `Resample`.
    """
    plain = _change(filter, AuxiliaryResample, lambda move: move.resample)
    look = _lookahead_of(plain) if lookahead is None else lookahead
    if not any(isinstance(move, Resample) for move in base.all_of(plain.moves, within=False)):
        raise ValueError("filter: none of its moves is a Resample, which could look ahead")

    def guided(move: Propagate) -> Propagate:
        return dataclasses.replace(move, proposal=look) if move.proposal is None else move

    ahead = _change(plain, Resample, lambda move: AuxiliaryResample(move, look))
    is_proposal = isinstance(look, base.AbstractProposal)
    return _change(ahead, Propagate, guided) if is_proposal else ahead


def _lookahead_of(filter: Filter) -> Lookahead:
    """The look-ahead of the proposal by which the filter draws x_t, or of the model alone."""
    proposals: list[Any] = [getattr(move, "proposal", None) for move in base.all_of(filter.moves)]
    lookaheads = [proposal for proposal in proposals if hasattr(proposal, "log_normaliser")]
    return lookaheads[0] if lookaheads else PilotLookahead()


@checked
def with_initial_selection(filter: Filter, num_draws: Count = 4) -> Filter:
    """The filter whose x_0 is selected by y_1 from K N draws, by an initial move `SelectInitial`.

    `num_draws` is K; with 1, x_0 is a plain draw. The filter's propagation determines how y_1 is
    predicted. Raises `ValueError` for K < 1, and for a filter without a `Propagate` or
    `PropagateNested`. Use it if the prior is somewhat broader than the likelihood; if it is far
    broader, use `with_initialisation`.
    """
    others = [move for move in filter.initial_moves if not isinstance(move, SelectInitial)]
    select = [SelectInitial(num_draws)] if num_draws > 1 else []
    return filter.replace(initial_moves=[*select, *others])


@checked
def with_initialisation(filter: Filter, num_observations: Count = 8) -> Filter:
    """The filter whose state is redrawn at step L by a tempered sampler given y_1..y_L.

    Before step L the filter runs without change, and its increments are reported as zero; at step L
    the particles are draws of p(x_L | y_1..y_L), and the increment is log p(y_1..y_L), so that Ẑ is
    unbiased. See `Restart`. It takes as long as some 800 steps of a standard filter if the prior is
    diffuse, and little if it is not. Smoothing and derivatives of these steps are refused. Raises
    `ValueError` for a model without `log_initial`, a density of all components of the state, whose
    x_0 is not made of noise either, for a conditionally linear model, and in a run of fewer than L
    steps. Use it if the prior is very diffuse, such as for a pose in a building: few draws of x_0
    are then near a mode, and chance decides its weight. `num_observations` is L: as many as
    distinguish the modes. It is also the number for restarts.
    """
    plain = with_initial_selection(filter, 1)
    return _with_restart(plain, num_observations=num_observations, at_start=True)


@checked
def with_restarts(
    filter: Filter, *, probability: InnerShare = 1e-3, num_observations: Count = 8
) -> Filter:
    """The filter that recovers a state that restarts from the prior, when an alarm is raised.

    The alarm is the one of `with_alarm`. If its cumulative sum has been positive for L steps or
    more, a sample of p(x_t | the last L observations) is added to the hypotheses, weighted by its
    evidence and p. This step takes as long as the initialisation by `with_initialisation`. A state
    that restarts is recovered L steps later at the earliest.
    `Restart` describes the model for which Ẑ is unbiased. For a filter with restarts, its settings
    are changed. Raises `ValueError` for a model that `with_initialisation` refuses. Use it if all
    hypotheses may be wrong: a robot that is carried away, a lost target.

    - `probability`: p, the probability of a restart L steps ago, when the alarm is raised.
    - `num_observations`: L: as many as distinguish the modes. It is also the number for
      `with_initialisation`.
    """
    settings = {"num_observations": num_observations, "probability": probability}
    return _with_restart(filter, **settings, has_alarm=True)


@checked
def with_alarm(filter: Filter) -> Filter:
    """The filter that detects when all its hypotheses seem wrong: `FilterRun.alarm`.

    At each step the increment is compared with the evidence for a state that restarts from the
    prior. It is estimated from N draws of x_0, the same at each step, which take as long as the
    filter's own. After `with_initialisation` the alarm begins at step L + 1. Use it if a lost
    target must be noticed.
    """
    return _with_restart(filter, has_alarm=True)


def _with_restart(filter: Filter, **settings: Any) -> Filter:
    """The filter whose `Restart`, after the last move that changes weights, has these settings."""
    if not any(isinstance(move, Restart) for move in filter.moves):
        places = [t for t, move in enumerate(filter.moves) if not move.keeps_mass]
        place = 1 + max(places, default=-1)
        restart = Restart(0, at_start=False, probability=None, has_alarm=False)
        filter = filter.replace(moves=[*filter.moves[:place], restart, *filter.moves[place:]])
    return _change(filter, Restart, lambda move: dataclasses.replace(move, **settings))


def _everywhere(filter: Filter, field: str, value: str) -> Filter:
    """The filter with another value of a field in all moves that have it, also inner ones."""

    def set_field(node: Any) -> Any:
        if not isinstance(node, base.AbstractMove) or field not in node.__dataclass_fields__:
            return node
        return dataclasses.replace(node, **{field: value})

    return map_moves(filter, set_field)
