"""The problem of tuning: leaves of a filter or model, and the objective to be maximised."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import check_type, shown
from mpfjax.filter import Filter, Start
from mpfjax.moves.objects.clusters import PropagateInClusters
from mpfjax.moves.objects.independent import PropagateIndependently
from mpfjax.moves.resampling.resample import Resample
from mpfjax.observations import Series, as_series
from mpfjax.proposals import AbstractProposal
from mpfjax.running.scan import scan
from mpfjax.tuning.transforms import AbstractTransform, Unconstrained

_DECLARED = "eqx.field(converter=jnp.asarray)"

Parameters = Mapping[str, Callable[[Any], PyTree]] | PyTree
Reals = dict[str, Array]
Objective = Callable[[Key[Array, ""], Any], Float[Array, ""]]


class Problem(eqx.Module):
    """An objective as a function of tuned leaves in unconstrained numbers, by name."""

    leaves: list[Any]
    transforms: dict[str, AbstractTransform]
    objective: Objective
    """of a seed and the tree that the leaves are of; its arrays are the data."""
    tuned: tuple[tuple[str, int], ...] = eqx.field(static=True)
    """the parameters' names, and where they are among the leaves."""
    structure: Any = eqx.field(static=True)

    @property
    def tree(self) -> Any:
        """The filter or model with its present parameters."""
        return jax.tree.unflatten(self.structure, self.leaves)

    def with_structure(self, structure: Any) -> "Problem":
        """The same leaves in a tree with other static fields."""
        return Problem(self.leaves, self.transforms, self.objective, self.tuned, structure)

    def start(self) -> Reals:
        """The present parameters; raises `ValueError` for one that cannot be tuned."""
        reals = {}
        for name, index in self.tuned:
            value, transform = self.leaves[index], self.transforms[name]
            if not transform.contains(np.asarray(value)):
                kind = type(transform).__name__
                raise ValueError(
                    f"parameters: {name} starts at {shown(value)}, outside {kind}'s domain"
                )
            # A strong type: an optimiser makes a weak one strong, and it would compile again.
            reals[name] = jax.lax.convert_element_type(transform.unconstrain(value), value.dtype)
        return reals

    def constrained(self, reals: Reals) -> dict[str, np.ndarray]:
        """The parameters on their own scale."""
        return {name: np.asarray(self.transforms[name].constrain(u)) for name, u in reals.items()}

    def at(self, reals: Reals) -> Any:
        """The filter or model with these parameters."""
        leaves = list(self.leaves)
        for name, index in self.tuned:
            leaves[index] = self.transforms[name].constrain(reals[name])
        return jax.tree.unflatten(self.structure, leaves)

    def value(self, reals: Reals, key: Key[Array, ""]) -> Float[Array, ""]:
        """The objective of one seed."""
        return self.objective(key, self.at(reals))


class LogEvidence(eqx.Module):
    """log Ẑ of a filter with one seed, summed over sequences of observations."""

    groups: list[tuple[PyTree, Array | None, PyTree]]
    """sequences of one shape, stacked: observations, which steps have one, and inputs."""

    def __call__(self, key: Key[Array, ""], filter: Filter) -> Float[Array, ""]:
        """One run for each sequence."""
        total = 0.0
        for g, (observations, present, inputs) in enumerate(self.groups):
            num_sequences = jax.tree.leaves(observations)[0].shape[0]
            keys = jax.random.split(jax.random.fold_in(key, g), num_sequences)
            run = lambda key, series: scan(Start(key), filter, series, _nothing)  # noqa: E731
            runs = jax.vmap(run)(keys, Series(observations, inputs, present))
            total += jnp.sum(runs.log_marginal_likelihood)
        return jnp.asarray(total)


@eqx.filter_jit
def scores(
    problem: Problem, reals: Reals, keys: Key[Array, " seeds"]
) -> tuple[Float[Array, " seeds"], Reals]:
    """The objective of each seed, and the gradient of their mean."""

    def mean(reals: Reals) -> tuple[Float[Array, ""], Float[Array, " seeds"]]:
        values = jax.vmap(lambda key: problem.value(reals, key))(keys)
        return jnp.mean(values), values

    gradient, values = jax.grad(mean, has_aux=True)(reals)
    return values, gradient


@eqx.filter_jit
def score_of_each(
    problem: Problem, reals: Reals, keys: Key[Array, " seeds"]
) -> Float[Array, "seeds d"]:
    """The gradient of each seed's objective, as `ravel_pytree` lays the parameters out."""
    gradient = jax.grad(problem.value)
    return jax.vmap(lambda key: ravel_pytree(gradient(reals, key))[0])(keys)


def pose(
    tree: PyTree,
    objective: Objective,
    parameters: Parameters,
    transforms: Mapping[str, AbstractTransform] | None,
) -> Problem:
    """The problem; a `ValueError` for arguments that do not make one."""
    leaves, structure = jax.tree.flatten(tree)
    tuned = _named_leaves(tree, parameters)
    if not tuned:
        raise ValueError(f"parameters: there is nothing to tune{_what_there_is(tree)}")
    for name, index in tuned.items():
        leaves[index] = _as_array(name, leaves[index])
    transforms = _checked_transforms(transforms)
    unknown = sorted(set(transforms) - set(tuned))
    if unknown:
        raise ValueError(f"transforms: {unknown} are not among the parameters, {sorted(tuned)}")
    return Problem(
        leaves=leaves,
        transforms={name: transforms.get(name, Unconstrained()) for name in tuned},
        objective=objective,
        tuned=tuple(tuned.items()),
        structure=structure,
    )


def pose_evidence(
    filter: Filter,
    observations: PyTree,
    parameters: Parameters,
    transforms: Mapping[str, AbstractTransform] | None,
    missing: str,
    inputs: PyTree = None,
) -> Problem:
    """The problem of the log marginal likelihood; without `parameters`, in those of the model."""
    check_type(Filter, "a filter", filter=filter)
    objective = LogEvidence(_groups(observations, inputs, missing, filter.model))
    return pose_filter(filter, objective, parameters, transforms)


def pose_filter(
    filter: Filter,
    objective: Callable[..., Any],
    parameters: Parameters,
    transforms: Mapping[str, AbstractTransform] | None,
) -> Problem:
    """The problem of any objective of a filter; without `parameters`, in those of its model."""
    check_type(Filter, "a filter", filter=filter)
    if parameters is None:
        fixed = jax.tree.map(lambda _: False, filter)
        of_model = jax.tree.map(eqx.is_inexact_array, filter.model)
        parameters = eqx.tree_at(lambda f: f.model, fixed, of_model)
    return pose(filter, objective, parameters, transforms)


def warn_of_bias(caller: str, problem: Problem) -> None:
    """Warn where the derivatives of a filter are not the score of what is tuned.

    It does not warn for parameters of proposals, whose bound is maximised without the derivative of
    the resampling, nor for filters that never resample.
    """
    filter = jax.tree.unflatten(problem.structure, map(_Place, range(len(problem.leaves))))
    of_proposals = {
        place.index
        for node in _nodes(filter, AbstractProposal)
        for place in jax.tree.leaves(node)
        if isinstance(place, _Place)
    }
    names = [name for name, index in problem.tuned if index not in of_proposals]
    if not names:
        return
    silent = [
        type(move).__name__
        for move in _nodes(filter, (PropagateInClusters, PropagateIndependently))
    ]
    plain = [
        move for move in _nodes(filter, Resample)
        if move.gradient == "none" and move.ess_threshold > 0
    ]  # fmt: skip
    if not silent and not plain:
        return
    use = (
        'build it with gradient="stop"' if plain
        else f"{silent[0]} has no other: take a filter that has, such as partitioned_sampling"
    )  # fmt: skip
    warnings.warn(
        f"{caller}: the filter's resampling has no gradient, so that the score of"
        f" {', '.join(names)} is biased, however many particles there are; {use}",
        stacklevel=3,
    )


def _nodes(tree: PyTree, kinds: type | tuple[type, ...]) -> list[Any]:
    """The nodes of some kinds, anywhere in a pytree."""
    is_one = lambda node: isinstance(node, kinds)  # noqa: E731
    return [node for node in jax.tree.leaves(tree, is_leaf=is_one) if is_one(node)]


@dataclass(frozen=True)
class _Place:
    """Stands for a leaf, by its place among all of them."""

    index: int


def _as_array(name: str, value: Any) -> Array:
    """A parameter as an array; raises `ValueError` for one without a derivative."""
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating):
        return value
    if isinstance(value, np.ndarray | np.generic) and np.issubdtype(value.dtype, np.floating):
        return jnp.asarray(value)
    if isinstance(value, float):
        return jnp.asarray(value, float)
    use = ""
    if isinstance(value, int) and not isinstance(value, bool):
        use = f"; give the model {float(value)}, or declare it {_DECLARED}"
    raise ValueError(f"parameters: {name} is {shown(value)}, no floating point number{use}")


def _what_there_is(tree: PyTree) -> str:
    """A hint at numbers that are not arrays, which can only be tuned by name."""
    names = _names(tree)
    numbers = [
        name for name, leaf in zip(names, jax.tree.leaves(tree), strict=True)
        if isinstance(leaf, float) and not name.startswith("_")
    ]  # fmt: skip
    if not numbers:
        return ""
    return (
        f"; {', '.join(numbers)} are Python floats, which are tuned where `parameters` names"
        f" them, or where their fields are declared {_DECLARED}"
    )


def _checked_transforms(
    transforms: Mapping[str, AbstractTransform] | None,
) -> dict[str, AbstractTransform]:
    if transforms is None:
        return {}
    check_type(Mapping, "a mapping from names to transforms", transforms=transforms)
    for name, transform in transforms.items():
        check_type(AbstractTransform, "a transform", **{f"transforms[{name!r}]": transform})
    return dict(transforms)


def _names(tree: PyTree) -> list[str]:
    """The name of each leaf where the user gave none."""
    return [
        jax.tree_util.keystr(path).removeprefix(".model.").removeprefix(".")
        for path, _ in jax.tree_util.tree_leaves_with_path(tree)
    ]


def _named_leaves(tree: PyTree, parameters: Parameters) -> dict[str, int]:
    """Each parameter's name, and its places among the tree's leaves."""
    leaves, structure = jax.tree.flatten(tree)
    places = jax.tree.unflatten(structure, map(_Place, range(len(leaves))))
    if isinstance(parameters, Mapping):
        chosen: dict[str, int] = {}
        for name, where in parameters.items():
            check_type(str, "a name", parameters=name)
            for inner, index in _chosen(name, where, places, leaves).items():
                if index in chosen.values():
                    twice = next(other for other in chosen if chosen[other] == index)
                    raise ValueError(f"parameters: {twice} and {inner} pick the same number")
                chosen[inner] = index
        return chosen
    if parameters is None:
        parameters = jax.tree.map(eqx.is_inexact_array, tree)
    try:
        spec = jax.tree.leaves(jax.tree.broadcast(parameters, tree))
    except (ValueError, TypeError):
        spec = []
    if len(spec) != len(leaves) or not all(isinstance(is_tuned, bool) for is_tuned in spec):
        raise ValueError(
            f"parameters: {shown(parameters)} is neither a mapping from names to functions, such"
            ' as {"r": lambda filter: filter.model.r}, nor a filter spec, a pytree of booleans like'
            " the filter"
        )
    names = _names(tree)
    return {names[i]: i for i, is_tuned in enumerate(spec) if is_tuned}


def _chosen(name: str, where: Any, places: PyTree, leaves: list[Any]) -> dict[str, int]:
    """The leaves that one entry of the mapping selects: a leaf, or the arrays of a node."""
    if not callable(where):
        raise ValueError(f"parameters: {name} is {shown(where)}, no function that picks from it")
    try:
        picked = where(places)
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"parameters: {name} cannot be picked: {error}") from error
    found = jax.tree_util.tree_leaves_with_path(picked)
    for _, place in found:
        if not isinstance(place, _Place):
            raise ValueError(
                f"parameters: {name} picks {shown(place)}, which is no leaf but a static field, or"
                f" made from others; a field can be tuned where it is declared {_DECLARED}, without"
                " static=True"
            )
    if len(found) > 1:  # a network has functions among its leaves
        found = [
            (path, place) for path, place in found if eqx.is_inexact_array(leaves[place.index])
        ]
    if not found:
        raise ValueError(f"parameters: {name} picks no array")
    return {name + jax.tree_util.keystr(path): place.index for path, place in found}


def _groups(
    observations: PyTree, inputs: PyTree, missing: str, model: Any
) -> list[tuple[PyTree, Array | None, PyTree]]:
    several = isinstance(observations, list)
    sequences = observations if several else [observations]
    given = inputs if several and inputs is not None else [inputs] * len(sequences)
    if not isinstance(given, list) or len(given) != len(sequences):
        raise ValueError(f"inputs: there must be a list of {len(sequences)}, as of observations")
    if not sequences:
        raise ValueError("observations: there are no sequences")
    by_shape: dict[Any, list[Series]] = {}
    for sequence, own in zip(sequences, given, strict=True):
        series = as_series(sequence, own, missing, model)
        kind = lambda leaf: (jnp.shape(leaf), jnp.result_type(leaf).name)  # noqa: E731
        shapes = jax.tree.map(kind, (series.observations, series.inputs))
        by_shape.setdefault(str(shapes), []).append(series)
    return [_stacked(group) for group in by_shape.values()]


def _stacked(group: list[Series]) -> tuple[PyTree, Array | None, PyTree]:
    stack = lambda *leaves: jnp.stack(leaves)  # noqa: E731
    stacked = jax.tree.map(stack, *[series.observations for series in group])
    inputs = jax.tree.map(stack, *[series.inputs for series in group])
    if all(series.present is None for series in group):
        return stacked, None, inputs
    full = jnp.ones(group[0].length, bool)
    present = [full if series.present is None else series.present for series in group]
    return stacked, jnp.stack(present), inputs


def _nothing(mixture: Any) -> None:
    del mixture
