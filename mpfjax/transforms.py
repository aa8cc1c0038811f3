"""Filters made from filters, by changing their moves. They compose, also on chains of your own."""

import dataclasses
from collections.abc import Callable
from typing import Any

from mpfjax.checks import Count, InnerShare, checked
from mpfjax.filter import Filter
from mpfjax.lookahead.pilot import Lookahead, PilotLookahead
from mpfjax.moves.base import (
    AbstractMove,
    AbstractPropagation,
    AbstractPropagationOfEach,
    AbstractProposal,
    AbstractRegrouping,
    all_of,
    name_of,
)
from mpfjax.moves.every import Every
from mpfjax.moves.initial import SelectInitial, require_propagation
from mpfjax.moves.propagation.nested import PropagateNested
from mpfjax.moves.propagation.propagate import Propagate
from mpfjax.moves.resampling.auxiliary import AuxiliaryResample
from mpfjax.moves.resampling.line import HILBERT
from mpfjax.moves.resampling.resample import Resample
from mpfjax.moves.start.alarm import WatchStart
from mpfjax.moves.start.restart import Restart


@checked
def map_moves(filter: Filter, change: Callable[[Any], Any]) -> Filter:
    """The filter with `change(move)` in the place of each move.

    It reaches the moves that others hold first, as those of an `Every`, and the resampling within a
    `Partitioned`:

        map_moves(filter, lambda m: Resample("stratified") if isinstance(m, Resample) else m)
    """
    return _mapped(filter, AbstractMove, change, within=True)


def _mapped(filter: Filter, kind: Any, change: Callable[[Any], Any], within: bool) -> Filter:
    """The filter with its moves of this kind changed, also those within propagations or not."""

    def changed(move: AbstractMove) -> Any:
        enters = within or not isinstance(move, AbstractPropagation)
        move = move.map_inner(changed) if enters else move
        return change(move) if isinstance(move, kind) else move

    return filter.replace(
        moves=[changed(move) for move in filter.moves],
        initial_moves=[changed(move) for move in filter.initial_moves],
    )


def _map_kind(filter: Filter, kind: Any, change: Callable[[Any], Any]) -> Filter:
    """The same of the chain's own moves of this kind alone."""
    return _mapped(filter, kind, change, within=False)


def _require_resample(filter: Filter, what: str) -> None:
    """Raise a `ValueError` for a filter whose chain does not resample by a `Resample`."""
    if not any(isinstance(move, Resample) for move in all_of(filter.moves, within=False)):
        raise ValueError(f"filter: none of its moves is a Resample, {what}")


@checked
def with_resampling(filter: Filter, resample: Resample) -> Filter:
    """The filter with this `Resample` in the place of its own; look-aheads stay.

    Raises `ValueError` for anything but a `Resample`. Use it for other slots of components:
    `with_resampling(filter, Resample(allocation="equal"))`.
    """
    return _map_kind(filter, Resample, lambda move: resample)


@checked
def with_point_sets(filter: Filter) -> Filter:
    """The filter whose draws are randomised quasi-Monte Carlo: sequential quasi-Monte Carlo.

    Gerber and Chopin (2015). All noise is "rqmc", that of x_0 included (see `Propagate`), and the
    chain's own resamplings put particles in order along a Hilbert curve of their state, unless they
    have a `sort_by`. Raises `ValueError` for a model or proposal that is not made of noise. Use it
    where masses of modes and likelihoods must be accurate.
    """

    def in_order(move: Resample) -> Resample:
        return dataclasses.replace(move, sort_by=HILBERT) if move.sort_by is None else move

    ordered = _map_kind(filter, Resample, in_order)
    return _everywhere(ordered, "noise", "rqmc").replace(initial_noise="rqmc")


@checked
def with_score_gradient(filter: Filter) -> Filter:
    """The filter whose derivatives estimate the score, for tuning: gradient "stop" everywhere.

    Ścibior and Wood (2021); values are the same to the bit. It reaches the resampling inside of
    propagations too. Raises `ValueError` for a model without `log_transition`, and for moves of
    which derivatives do not see all that is drawn (`biases_score`).
    """
    changed = _everywhere(filter, "gradient", "stop")
    for move in all_of((*changed.initial_moves, *changed.moves)):
        if move.biases_score:
            raise ValueError(f"filter: derivatives do not see all that {name_of(move)} draws")
    return changed


@checked
def with_proposals_per_particle(filter: Filter, num_draws: Count) -> Filter:
    """The filter in which each particle draws K of x_t and keeps one: `PropagateNested`.

    `num_draws` is K; with one, each particle draws once again. Raises `ValueError` for K < 1, and
    for a filter without `Propagate`. Use it where the likelihood is narrow and cheap, with four to
    sixteen draws.
    """
    require_propagation(filter._now(), "each particle draws")

    def nested(move: Any) -> AbstractPropagationOfEach:
        plain = move.propagate if isinstance(move, PropagateNested) else move
        return plain if num_draws == 1 else PropagateNested(plain, num_draws)

    return _map_kind(filter, AbstractPropagationOfEach, nested)


@checked
def with_lookahead(filter: Filter, lookahead: Lookahead | None = None) -> Filter:
    """The filter that resamples by its weights times a look-ahead ν to y_t: `AuxiliaryResample`.

    `lookahead` is that of the move; None is the filter's own proposal where that has a
    `log_normaliser`, and else a `PilotLookahead`, which takes the model alone. One that is a
    proposal also draws x_t, where the filter has no other. Raises `ValueError` for a filter
    without `Resample`.
    """
    plain = _map_kind(filter, AuxiliaryResample, lambda move: move.resample)
    look = _own_lookahead(plain) if lookahead is None else lookahead
    _require_resample(plain, "which could look ahead")

    def guided(move: Propagate) -> Propagate:
        return dataclasses.replace(move, proposal=look) if move.proposal is None else move

    ahead = _map_kind(plain, Resample, lambda move: AuxiliaryResample(move, look))
    return _map_kind(ahead, Propagate, guided) if isinstance(look, AbstractProposal) else ahead


def _own_lookahead(filter: Filter) -> Lookahead:
    """The look-ahead of the proposal by which the filter draws x_t, or of the model alone."""
    proposals: list[Any] = [getattr(move, "proposal", None) for move in all_of(filter.moves)]
    known = [proposal for proposal in proposals if hasattr(proposal, "log_normaliser")]
    return known[0] if known else PilotLookahead()


@checked
def with_selected_start(filter: Filter, num_draws: Count = 4) -> Filter:
    """The filter whose x_0 is chosen by y_1 among K N draws: a `SelectInitial` moves it first.

    `num_draws` is K; with one, x_0 is a plain draw again. The look at y_1 is that of the filter's
    own propagation. Raises `ValueError` for K < 1, and for a filter without a `Propagate` or
    `PropagateNested`. Use it where the prior is somewhat wide beside the likelihood; where it is
    very wide, `with_start`.
    """
    others = [move for move in filter.initial_moves if not isinstance(move, SelectInitial)]
    if num_draws > 1 and any(move.at_start for move in _restarts(filter)):
        raise ValueError("filter: its x_0 is chosen by more observations than y_1, by with_start")
    if num_draws == 1:
        return filter.replace(initial_moves=others)
    select = SelectInitial(num_draws, filter.initial_noise)
    return filter.replace(initial_moves=[select, *others])


@checked
def with_start(filter: Filter, num_observations: Count = 8) -> Filter:
    """The filter whose state is drawn anew at step L, by a tempered sampler on y_1..y_L.

    Before step L the filter runs as it is, and its increments are reported as zero; at step L the
    particles are draws of p(x_L | y_1..y_L), and the increment is log p(y_1..y_L), so that Ẑ is
    unbiased. See `Restart`. It costs as much as some 800 steps of a plain filter where the prior is
    diffuse, little where it is not. Smoothing and derivatives of these steps are refused. Raises
    `ValueError` for a model without `log_initial`, a density in all coordinates of the state, whose
    x_0 is not made of noise either, for a conditionally linear model, and in a run of fewer than L
    steps. Use it where the prior is very diffuse, as of a pose in a building: few draws of x_0 are
    near a mode then, and chance decides its weight.
    `num_observations` is L: as many as tell the modes apart, also of restarts.
    """
    if any(move.at_start for move in _restarts(filter)):
        raise ValueError("filter: it has a start by its first observations already")
    initial = [move for move in filter.initial_moves if not isinstance(move, SelectInitial)]
    if not all(map(_regroups, initial)):
        what = "its initial moves do more than regroup, and a start replaces x_0"
        raise ValueError(f"filter: {what}")
    filter = filter.replace(initial_moves=initial)
    return _with_restart(filter, num_observations=num_observations, at_start=True)


@checked
def with_restarts(
    filter: Filter, *, probability: InnerShare = 1e-3, num_observations: Count = 8
) -> Filter:
    """The filter that finds a state again which begins anew, by a restart where the alarm rings.

    The alarm is that of `with_alarm`, of N draws if there is none yet. Where its sum has been above
    zero for L steps or more, a sample of p(x_t | the last L observations) is joined to the
    hypotheses by its evidence and p. That step costs as much as a start. A state that begins anew
    is found L steps later at the earliest. See `Restart` for what Ẑ is unbiased for. It changes the
    settings of a filter with restarts. Raises `ValueError` for a model that `with_start` refuses.
    Use it where all hypotheses may be wrong: a robot that is carried away, a lost target.

    - `probability`: p, of having begun anew L steps ago, where the alarm rings.
    - `num_observations`: L: as many as tell the modes apart, also of a start.
    """
    alarms = [move for move in filter.moves if isinstance(move, WatchStart)]
    alarms += [move for move in _restarts(filter) if move.probability is not None]
    num_particles = [*(move.num_particles for move in alarms), filter.num_particles][0]
    others = [move for move in filter.moves if not isinstance(move, WatchStart)]
    filter = filter.replace(moves=others)
    return _with_restart(
        filter,
        num_observations=num_observations,
        probability=probability,
        num_particles=num_particles,
    )


def _restarts(filter: Filter) -> list[Restart]:
    return [move for move in filter.moves if isinstance(move, Restart)]


def _with_restart(filter: Filter, **settings: Any) -> Filter:
    """The filter whose `Restart` has these settings, after the last move that does not regroup."""
    if _restarts(filter):
        return _map_kind(filter, Restart, lambda move: dataclasses.replace(move, **settings))
    place = 1 + max(t for t, move in enumerate(filter.moves) if not _regroups(move))
    grouping = [move for move in filter.initial_moves if _regroups(move)]
    restart = Restart(grouping, **settings)
    return filter.replace(moves=[*filter.moves[:place], restart, *filter.moves[place:]])


def _regroups(move: AbstractMove) -> bool:
    """Whether it changes no particles, and at most regroups them."""
    if isinstance(move, Every):
        return all(map(_regroups, move.moves))
    return isinstance(move, AbstractRegrouping | WatchStart)


@checked
def with_alarm(filter: Filter, num_particles: Count = 4096) -> Filter:
    """The filter that says when all its hypotheses seem wrong: `FilterRun.surprised`.

    At each step the increment is compared with the evidence for a state that begins anew:
    `num_particles` draws of x_0, the same at each step, cost as much as so many particles. Use it
    where a lost target must be noticed.
    """
    if any(move.probability is not None for move in _restarts(filter)):
        return _map_kind(
            filter, Restart, lambda move: dataclasses.replace(move, num_particles=num_particles)
        )
    others = [move for move in filter.moves if not isinstance(move, WatchStart)]
    return filter.replace(moves=[*others, WatchStart(num_particles)])


def _everywhere(filter: Filter, field: str, value: str) -> Filter:
    """The filter with another value of a field in all moves that have it, also within others."""

    def replaced(node: Any) -> Any:
        if not isinstance(node, AbstractMove) or field not in node.__dataclass_fields__:
            return node
        return dataclasses.replace(node, **{field: value})

    return map_moves(filter, replaced)
