"""Filters made from filters, by changing their moves."""

from mpfjax.checks import check_type, check_whole
from mpfjax.filter import Filter
from mpfjax.moves.initial import SelectInitial
from mpfjax.moves.propagation.marginalised import PropagateMarginalised
from mpfjax.moves.propagation.nested import PropagateNested
from mpfjax.moves.propagation.propagate import Propagate


def with_selected_start(filter: Filter, num_draws: int) -> Filter:
    """The filter whose x_0 is chosen by y_1 among K N draws: a `SelectInitial` moves it first.

    `num_draws` is K; with one, x_0 is a plain draw again. The look at y_1 is that of the filter's
    own propagation. Raises `ValueError` for K < 1, and for a filter without a `Propagate`,
    `PropagateMarginalised` or `PropagateNested`. Use it where the prior is wide beside the
    likelihood; `mixture_particle_filter` does so with four draws.
    """
    check_type(Filter, "a Filter", filter=filter)
    check_whole(num_draws=num_draws)
    others = [move for move in filter.initial_moves if not isinstance(move, SelectInitial)]
    if num_draws == 1:
        return filter.replace(initial_moves=others)
    kinds = (Propagate, PropagateMarginalised, PropagateNested)
    looks = [move for move in filter.moves if isinstance(move, kinds)]
    if not looks:
        raise ValueError(
            "filter: x_0 is chosen where Propagate, PropagateMarginalised or PropagateNested"
            " propagates, and none of its moves is one"
        )
    select = SelectInitial(looks[0], num_draws, filter.initial_noise)
    return filter.replace(initial_moves=[select, *others])
