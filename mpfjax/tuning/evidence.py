"""The log marginal likelihood of a filter as an objective of its parameters."""

from itertools import chain
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Rule, kinds, warn
from mpfjax.filter import Filter
from mpfjax.models.observations import Series, as_series, series_of
from mpfjax.moves.base import AbstractProposal, all_of
from mpfjax.running.results import FilterRun
from mpfjax.running.scan import scan
from mpfjax.tuning.problem import Parameters, Place, Problem, Transforms, placed, pose

UnbiasedFilter = Annotated[
    Filter,
    Rule(
        lambda value: isinstance(value, Filter) and not value.approximate,
        "a filter with an unbiased likelihood: none of its moves is approximate",
    ),
]


class LogEvidence(eqx.Module):
    """log Ẑ of a filter with one seed, for each sequence of observations."""

    groups: list[Series]  # sequences of one shape, stacked
    # Of every sequence, as they stand in the groups, its place in the caller's list.
    places: tuple[int, ...] = eqx.field(static=True, default=(0,))

    def __call__(self, key: Key[Array, ""], filter: Filter) -> Float[Array, " series"]:
        """log Ẑ of one run for each sequence."""
        runs = self.runs(key, filter)
        return jnp.concatenate([run.log_marginal_likelihood for run in runs])

    def parts(
        self, size: int, rng: np.random.Generator | None = None
    ) -> list[tuple[int, np.ndarray]]:
        """All sequences in parts of one group and at most this size: the group, and which of it.

        The parts, and the sequences in them, are in the order of `rng`, or as they stand.
        """
        parts = []
        for g, group in enumerate(self.groups):
            rows = np.arange(group.length) if rng is None else rng.permutation(group.length)
            parts += [(g, part) for part in np.array_split(rows, -(-group.length // size))]
        return parts if rng is None else [parts[k] for k in rng.permutation(len(parts))]

    def part(self, group: int, rows: np.ndarray) -> "LogEvidence":
        """That of some sequences of one group."""
        return LogEvidence([jax.tree.map(lambda leaf: leaf[rows], self.groups[group])])

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
    places: dict[str, list[int]] = {}
    for place, sequence in enumerate(sequences):
        series = as_series(sequence, filter.model)
        kind = kinds((series.observations, series.inputs))
        groups.setdefault(kind, []).append(series)
        places.setdefault(kind, []).append(place)
    stacked = []
    for group in groups.values():
        if any(series.present is not None for series in group):
            group = [with_present(series) for series in group]
        stacked.append(jax.tree.map(lambda *leaves: jnp.stack(leaves), *group))
    evidence = LogEvidence(stacked, tuple(chain.from_iterable(places.values())))
    return pose(filter, evidence, parameters, transforms)


def one_sequence(observations: PyTree, model: Any) -> Series:
    """The data of one sequence; a `ValueError` for a list of several."""
    if isinstance(series_of(observations).observations, list):
        raise ValueError("observations: a list, of several sequences; jnp.asarray makes it one")
    return as_series(observations, model)


def names_but_proposals(problem: Problem) -> list[str]:
    """The tuned parameters that are none of a proposal's."""

    def is_proposal(node: Any) -> bool:
        return isinstance(node, AbstractProposal)

    nodes = jax.tree.leaves(placed(problem.tree), is_leaf=is_proposal)
    places = jax.tree.leaves(list(filter(is_proposal, nodes)))
    return [name for name, index in problem.tuned if Place(index) not in places]


def warn_of_bias(caller: str, problem: Problem) -> None:
    """Warn where the derivatives of a filter are not the score of what is tuned.

    It does not warn for parameters of proposals, whose bound is maximised without the derivative of
    the resampling, nor for filters that never resample.
    """
    names = names_but_proposals(problem)
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
