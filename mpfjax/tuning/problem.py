"""What is tuned: some leaves of a filter or model, and the objective that they are to maximise."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.filters import Filter, present_steps, scan_filter
from mpfjax.tuning.transforms import AbstractTransform, Unconstrained

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

    def start(self) -> Reals:
        """The parameters as they are; raises `ValueError` for one that cannot be tuned."""
        reals = {}
        for name, index in self.tuned:
            value, transform = self.leaves[index], self.transforms[name]
            if not eqx.is_inexact_array(value):
                raise ValueError(f"parameters: {name} is {value!r}, no floating point array")
            if not transform.contains(np.asarray(value)):
                kind = type(transform).__name__
                raise ValueError(f"parameters: {name} starts at {value}, outside {kind}'s domain")
            # A strong type: a weak one would compile anew once an optimiser has made it strong.
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

    groups: list[tuple[PyTree, Array | None]]
    """sequences of one shape, stacked: observations, and which steps have one."""

    def __call__(self, key: Key[Array, ""], filter: Filter) -> Float[Array, ""]:
        """One run for each sequence."""
        total = 0.0
        for g, (observations, present) in enumerate(self.groups):
            num_sequences = jax.tree.leaves(observations)[0].shape[0]
            keys = jax.random.split(jax.random.fold_in(key, g), num_sequences)
            run = lambda key, y, here: scan_filter(key, filter, y, here, _nothing)  # noqa: E731
            axes = (0, 0, None if present is None else 0)
            runs = jax.vmap(run, in_axes=axes)(keys, observations, present)
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
    """The problem, with a `ValueError` for arguments that make none."""
    leaves, structure = jax.tree.flatten(tree)
    tuned = _named_leaves(tree, parameters)
    if not tuned:
        raise ValueError("parameters: there is nothing to tune")
    transforms = dict(transforms or {})
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
) -> Problem:
    """The problem of the log marginal likelihood; without `parameters`, in those of the model."""
    if parameters is None:
        fixed = jax.tree.map(lambda _: False, filter)
        of_model = jax.tree.map(eqx.is_inexact_array, filter.model)
        parameters = eqx.tree_at(lambda f: f.model, fixed, of_model)
    return pose(filter, LogEvidence(_groups(observations, missing)), parameters, transforms)


@dataclass(frozen=True)
class _Place:
    """Stands for a leaf, by its place among all of them."""

    index: int


def _named_leaves(tree: PyTree, parameters: Parameters) -> dict[str, int]:
    """Each parameter's name, and where it is among the tree's leaves."""
    leaves, structure = jax.tree.flatten(tree)
    places = jax.tree.unflatten(structure, map(_Place, range(len(leaves))))
    if isinstance(parameters, Mapping):
        chosen = [_chosen(name, where, places, leaves) for name, where in parameters.items()]
        return {name: index for named in chosen for name, index in named.items()}
    if parameters is None:
        parameters = jax.tree.map(eqx.is_inexact_array, tree)
    spec = jax.tree.leaves(jax.tree.broadcast(parameters, tree))
    if len(spec) != len(leaves) or not all(isinstance(is_tuned, bool) for is_tuned in spec):
        raise ValueError("parameters: the filter spec is no pytree of booleans like the filter")
    names = [
        jax.tree_util.keystr(path).removeprefix(".model.").removeprefix(".")
        for path, _ in jax.tree_util.tree_leaves_with_path(places)
    ]
    return {names[i]: i for i, is_tuned in enumerate(spec) if is_tuned}


def _chosen(name: str, where: Any, places: PyTree, leaves: list[Any]) -> dict[str, int]:
    """What one entry of the mapping stands for: a leaf, or the arrays of a node."""
    if not callable(where):
        raise ValueError(f"parameters: {name} is {where!r}, no function that picks from it")
    found = jax.tree_util.tree_leaves_with_path(where(places))
    for _, place in found:
        if not isinstance(place, _Place):
            raise ValueError(f"parameters: {name} picks {place!r}, which is no leaf")
    if len(found) > 1:  # a network has functions among its leaves
        found = [
            (path, place) for path, place in found if eqx.is_inexact_array(leaves[place.index])
        ]
    if not found:
        raise ValueError(f"parameters: {name} picks no array")
    return {name + jax.tree_util.keystr(path): place.index for path, place in found}


def _groups(observations: PyTree, missing: str) -> list[tuple[PyTree, Array | None]]:
    sequences = observations if isinstance(observations, list) else [observations]
    if not sequences:
        raise ValueError("observations: there are no sequences")
    by_shape: dict[Any, list[tuple[PyTree, Any]]] = {}
    for sequence in sequences:
        present = present_steps(sequence, missing)
        shapes = jax.tree.map(lambda leaf: (jnp.shape(leaf), jnp.result_type(leaf).name), sequence)
        by_shape.setdefault(str(shapes), []).append((sequence, present))
    return [_stacked(group) for group in by_shape.values()]


def _stacked(group: list[tuple[PyTree, Any]]) -> tuple[PyTree, Array | None]:
    sequences, present = zip(*group, strict=True)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *sequences)
    if all(here is None for here in present):
        return stacked, None
    length = jax.tree.leaves(stacked)[0].shape[1]
    full = jnp.ones(length, bool)
    return stacked, jnp.stack([full if here is None else here for here in present])


def _nothing(mixture: Any) -> None:
    del mixture
