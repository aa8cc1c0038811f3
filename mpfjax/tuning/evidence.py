"""The log marginal likelihood of a filter as an objective of its parameters."""

from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Rule, kinds, warn
from mpfjax.filter import Filter
from mpfjax.models.observations import Series, as_series, gathered
from mpfjax.moves.base import AbstractProposal, all_of
from mpfjax.running.scan import FilterRun, scan
from mpfjax.tuning.problem import Parameters, Place, Problem, Transforms, placed, pose

UnbiasedFilter = Annotated[
    Filter,
    Rule(
        lambda value: isinstance(value, Filter) and not value.approximate,
        "a filter with an unbiased likelihood: none of its moves is approximate",
    ),
]


class LogEvidence(eqx.Module):
    """log Ẑ of a filter with one seed, summed over sequences of observations."""

    groups: list[Series]  # sequences of one shape, stacked

    def __call__(self, key: Key[Array, ""], filter: Filter) -> Float[Array, ""]:
        """The sum over one run for each sequence."""
        runs = self.runs(key, filter)
        return jnp.asarray(sum(jnp.sum(run.log_marginal_likelihood) for run in runs))

    def runs(self, key: Key[Array, ""], filter: Filter, whole: bool = False) -> list[FilterRun]:
        """The runs of each group, with all mixtures collected, or nothing."""
        collect = None if whole else lambda mixture: None

        def run(key: Key[Array, ""], series: Series) -> FilterRun:
            return scan(key, filter, series, collect)

        return [
            jax.vmap(run)(jax.random.split(jax.random.fold_in(key, g), group.length), group)
            for g, group in enumerate(self.groups)
        ]


def pose_evidence(
    filter: Filter, observations: PyTree, parameters: Parameters, transforms: Transforms
) -> Problem:
    """The problem of the log marginal likelihood; without `parameters`, in those of the model."""
    sequences = observations if isinstance(observations, list) else [observations]
    if not sequences:
        raise ValueError("observations: there are no sequences")
    groups: dict[str, list[Series]] = {}
    for sequence in sequences:
        series = as_series(sequence, filter.model)
        groups.setdefault(kinds((series.observations, series.inputs)), []).append(series)
    stacked = []
    for group in groups.values():
        if any(series.present is not None for series in group):
            group = [with_present(series) for series in group]
        stacked.append(jax.tree.map(lambda *leaves: jnp.stack(leaves), *group))
    return pose(filter, LogEvidence(stacked), parameters, transforms)


def one_sequence(observations: PyTree, model: Any) -> Series:
    """The data of one sequence; a `ValueError` for a list of several."""
    if isinstance(gathered(observations).observations, list):
        raise ValueError("observations: a list, of several sequences; jnp.asarray makes it one")
    return as_series(observations, model)


def warn_of_bias(caller: str, problem: Problem) -> None:
    """Warn where the derivatives of a filter are not the score of what is tuned.

    It does not warn for parameters of proposals, whose bound is maximised without the derivative of
    the resampling, nor for filters that never resample.
    """

    def is_proposal(node: Any) -> bool:
        return isinstance(node, AbstractProposal)

    nodes = jax.tree.leaves(placed(problem.tree), is_leaf=is_proposal)
    places = jax.tree.leaves(list(filter(is_proposal, nodes)))
    names = [name for name, index in problem.tuned if Place(index) not in places]
    moves = [move for move in all_of(problem.tree.moves) if move.biases_score]
    if names and moves:
        said = f"{caller}: {type(moves[0]).__name__} has no gradient, so that the score of"
        said += f' {", ".join(names)} is biased; build the filter with gradient="stop"'
        warn(said, UserWarning)


def with_present(series: Series) -> Series:
    """The series that says of each step whether its observation is there."""
    if series.present is not None:
        return series
    return Series(series.observations, series.inputs, present=np.ones(series.length, bool))
