"""The log marginal likelihood of a filter as an objective of its parameters."""

from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Rule, kinds, warn
from mpfjax.filter import Filter
from mpfjax.models.base import require, with_inputs
from mpfjax.models.law import law_of, refuse_marginalised
from mpfjax.models.series import Series, as_series, series_of
from mpfjax.moves.base import AbstractProposal, all_of, check_keep_parents
from mpfjax.operations.logarithms import without_gradient
from mpfjax.running.results import FilterRun
from mpfjax.running.scan import scan
from mpfjax.smoothing.backward import log_transitions
from mpfjax.smoothing.trajectories import draw_trajectories, mixtures_of
from mpfjax.tuning.problem import Parameters, Place, Problem, Transforms, places_of, pose

_IS_UNBIASED = Rule(
    lambda value: isinstance(value, Filter) and not value.approximate,
    "a filter with an unbiased likelihood: none of its moves is approximate",
)
UnbiasedFilter = Annotated[Filter, _IS_UNBIASED]
Score = Literal["filter", "fisher"]
_BY_FISHER = 'score="fisher"'
_NUM_PATHS = 8  # of each run: then noise in which run is weighted how is as large as theirs


class LogEvidence(eqx.Module):
    """log Ẑ of a filter with one seed, for each sequence of observations."""

    groups: list[Series]  # sequences of one shape, stacked
    # Of every sequence, as they stand in the groups, its place in the caller's list.
    places: tuple[int, ...] = eqx.field(static=True, default=(0,))

    def __call__(self, key: Key[Array, ""], filter: Filter) -> Float[Array, " series"]:
        """log Ẑ of one run for each sequence."""
        return jnp.concatenate([run.log_marginal_likelihood for run in self.runs(key, filter)])

    def parts(self, size: int, rng: np.random.Generator | None = None) -> list["LogEvidence"]:
        """The evidence of all sequences in parts of one group and at most this size.

        The parts, and the sequences in them, are in the order of `rng`, or as they stand.
        """
        parts = []
        for group in self.groups:
            order = np.arange(group.length) if rng is None else rng.permutation(group.length)
            for rows in np.array_split(order, -(-group.length // size)):
                parts.append(type(self)([jax.tree.map(lambda leaf, at=rows: leaf[at], group)]))
        return parts if rng is None else [parts[k] for k in rng.permutation(len(parts))]

    def runs(self, key: Key[Array, ""], filter: Filter, whole: bool = False) -> list[FilterRun]:
        """The runs of each group, with all mixtures collected, or nothing."""
        collect = None if whole else lambda mixture: None

        def run(key: Key[Array, ""], series: Series) -> FilterRun:
            return scan(key, filter, series, collect)

        pairs = ((jax.random.fold_in(key, g), group) for g, group in enumerate(self.groups))
        return [jax.vmap(run)(jax.random.split(key, group.length), group) for key, group in pairs]


class LogJoint(eqx.Module):
    """log p(x_0, ..., x_t, y_1, ..., y_t | θ) of a trajectory and the observations there are."""

    series: Series

    def __call__(self, trajectory: PyTree, filter: Filter) -> Float[Array, ""]:
        """With the parameters of the filter's model."""
        model = law_of(filter.model).model
        start = jax.tree.map(lambda leaf: leaf[:1], trajectory)
        after = jax.tree.map(lambda leaf: leaf[1:], trajectory)

        def log_likelihood(observation: PyTree, inputs: PyTree, state: PyTree) -> Float[Array, ""]:
            one = jax.tree.map(lambda leaf: leaf[None], state)
            return law_of(with_inputs(model, inputs)).log_likelihood(observation, one)[0]

        rows, present = (self.series.observations, self.series.inputs, after), self.series.present
        if present is not None:
            # A missing step stands for the first that is there, whose derivative is a number.
            places = jnp.where(present, jnp.arange(len(present)), jnp.argmax(present))
            rows = jax.tree.map(lambda leaf: jnp.asarray(leaf)[places], rows)
        logs = jax.vmap(log_likelihood)(*rows)
        if present is not None:
            logs = jnp.where(present, logs, 0.0)
        steps = jnp.sum(log_transitions(model, trajectory, self.series.inputs))
        return model.log_initial(start)[0] + steps + jnp.sum(logs)


class FisherEvidence(LogEvidence):
    """log Ẑ of each sequence, whose derivatives estimate the score by Fisher's identity.

    ∇ log Z(θ) = E[∇ log p(x_0, ..., x_t, y_1, ..., y_t | θ) | y_1..y_t], over trajectories that are
    drawn backwards through the run, which is itself no function of θ here.
    """

    def __call__(self, key: Key[Array, ""], filter: Filter) -> Float[Array, " series"]:
        """log Ẑ of one run for each sequence."""
        fixed = without_gradient(filter)

        def log_joint(key: Key[Array, ""], run: FilterRun, series: Series) -> Float[Array, ""]:
            about = fixed.model, mixtures_of(run), series.inputs
            paths, _ = draw_trajectories(key, *about, _NUM_PATHS, "mcmc")
            return jnp.mean(jax.vmap(LogJoint(series), (0, None))(paths, filter))

        values, key_runs = [], jax.random.fold_in(key, len(self.groups))
        for g, runs in enumerate(self.runs(key_runs, fixed, whole=True)):
            group = self.groups[g]
            keys = jax.random.split(jax.random.fold_in(key, g), group.length)
            logs = jax.vmap(log_joint)(keys, runs, group)
            # The difference is zero, and has the derivative.
            values.append(runs.log_marginal_likelihood + (logs - jax.lax.stop_gradient(logs)))
        return jnp.concatenate(values)


def pose_evidence(
    filter: Filter,
    observations: PyTree,
    parameters: Parameters,
    transforms: Transforms,
    score: Score = "filter",
) -> Problem:
    """The problem of the log marginal likelihood; without `parameters`, in those of the model."""
    if score == "fisher":
        for density in ("log_transition", "log_initial"):
            require(filter.model, density, _BY_FISHER)
        refuse_marginalised(filter.model, _BY_FISHER)
        check_keep_parents("filter", filter.moves, _BY_FISHER)
    sequences = observations if isinstance(observations, list) else [observations]
    if not sequences:
        raise ValueError("observations: there are no sequences")
    groups: dict[str, list[tuple[int, Series]]] = {}
    for place, sequence in enumerate(sequences):
        series = as_series(sequence, filter.model)
        if score == "fisher" and series.present is not None and not np.any(series.present):
            what = f"sequence {place} has none, and its score is zero; omit it"
            raise ValueError(f'observations: {what}, or use score="filter"')
        kind = kinds((series.observations, series.inputs))
        groups.setdefault(kind, []).append((place, series))
    stacked, places = [], []
    for numbers, group in (zip(*pairs, strict=True) for pairs in groups.values()):
        if any(series.present is not None for series in group):
            group = [with_present(series) for series in group]
        stacked.append(jax.tree.map(lambda *leaves: jnp.stack(leaves), *group))
        places += numbers
    evidence = {"filter": LogEvidence, "fisher": FisherEvidence}[score]
    problem = pose(filter, evidence(stacked, tuple(places)), parameters, transforms)
    if score == "fisher" and len(names_but_proposals(problem)) < len(problem.tuned):
        raise ValueError('score: "fisher" has no derivative in parameters of a proposal')
    return problem


def one_sequence(observations: PyTree, model: Any) -> Series:
    """The data of one sequence; a `ValueError` for a list of several."""
    if isinstance(series_of(observations).observations, list):
        raise ValueError("observations: a list, of several sequences; jnp.asarray makes it one")
    return as_series(observations, model)


def names_but_proposals(problem: Problem) -> list[str]:
    """The tuned parameters that are none of a proposal's."""

    def is_proposal(node: Any) -> bool:
        return isinstance(node, AbstractProposal)

    nodes = jax.tree.leaves(places_of(problem.tree), is_leaf=is_proposal)
    places = jax.tree.leaves(list(filter(is_proposal, nodes)))
    return [name for name, index in problem.tuned if Place(index) not in places]


def warn_of_bias(caller: str, problem: Problem) -> None:
    """Warn where the derivatives of a filter are not the score of what is tuned.

    It does not warn for parameters of proposals, whose bound is maximised without the derivative of
    the resampling, nor for filters that never resample.
    """
    if isinstance(problem.objective, FisherEvidence):
        return
    names = names_but_proposals(problem)
    moves = [move for move in all_of(problem.tree.moves) if move.biases_score]
    if names and moves:
        what = f"{type(moves[0]).__name__} has no gradient, so that the score of {', '.join(names)}"
        what += ' is biased; build the filter with gradient="stop", or use score="fisher"'
        warn(f"{caller}: {what}", UserWarning)


def with_present(series: Series) -> Series:
    """The series that says of each step whether its observation is there."""
    if series.present is not None:
        return series
    return Series(series.observations, series.inputs, present=np.ones(series.length, bool))
