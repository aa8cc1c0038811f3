"""The problem of tuning: leaves of a filter or model, and the objective to be maximised."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import by_name, shown
from mpfjax.tuning.bijections import AbstractTransform, Unconstrained

_DECLARED = "eqx.field(converter=jnp.asarray)"

Parameters = Annotated[
    Mapping[str, Callable[[Any], PyTree]] | None,
    by_name(callable, 'functions, as {"r": lambda filter: filter.model.r}'),
]
Transforms = Annotated[
    Mapping[str, AbstractTransform] | None,
    by_name(lambda value: isinstance(value, AbstractTransform), "transforms, as Positive()"),
]
Reals = dict[str, Array]
Objective = Callable[..., Any]


class Problem(eqx.Module):
    """An objective as a function of tuned leaves in unconstrained numbers, by name."""

    leaves: list[Any]
    transforms: dict[str, AbstractTransform]
    # Of a seed and the tree that the leaves are of, a scalar, or one for each of several series,
    # which are added up; its arrays are the data.
    objective: Objective
    # The parameters' names, and where they are among the leaves.
    tuned: tuple[tuple[str, int], ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    @property
    def tree(self) -> Any:
        """The filter or model with its present parameters."""
        return jax.tree.unflatten(self.structure, self.leaves)

    @property
    def settings(self) -> dict[str, Any]:
        """All that has to be the same for a checkpoint to fit, by name."""
        leaves = jax.tree_util.tree_leaves_with_path(self.tree)
        places = {name: jax.tree_util.keystr(leaves[index][0]) for name, index in self.tuned}
        tree = "filter" if hasattr(self.tree, "moves") else "model"
        return {tree: self.tree, "parameters": places, "transforms": self.transforms}

    def start(self) -> Reals:
        """The present parameters; raises `ValueError` for one outside its domain."""
        present = {name: self.leaves[index] for name, index in self.tuned}
        return self.unconstrain(present, "parameters")

    def constrain(self, reals: Reals) -> dict[str, Array]:
        """The parameters on their own scale."""
        return {name: self.transforms[name].constrain(u) for name, u in reals.items()}

    def unconstrain(self, values: Any, whose: str) -> Reals:
        """u of values by name, which `whose` gave; a `ValueError` for others than the parameters.

        It is one as well for values outside their domains, unless they are traced.
        """
        names = sorted(values) if isinstance(values, Mapping) else shown(values)
        if names != sorted(self.transforms):
            raise ValueError(f"{whose}: it gave {names}, not values of {sorted(self.transforms)}")
        reals = {}
        for name, index in self.tuned:
            value, present = jnp.asarray(values[name]), self.leaves[index]
            if value.shape != jnp.shape(present):
                raise ValueError(f"{whose}: {name} of shape {value.shape}, not {present.shape}")
            # A strong type: an optimiser makes a weak one strong, and it would compile again.
            value = jax.lax.convert_element_type(value, present.dtype)
            reals[name] = self.transforms[name].unconstrain(value)
        self.require_inside(values, whose)
        return reals

    def require_inside(self, values: Mapping[str, Any], whose: str) -> None:
        """Raise a `ValueError` for values, or stacks of them, outside their domains."""
        for name, transform in self.transforms.items():
            value = values[name]
            if not isinstance(value, Tracer) and not transform.contains(np.asarray(value)):
                kind = type(transform).__name__
                raise ValueError(f"{whose}: {name}, {shown(value)}, is outside {kind}'s domain")

    def constrained_rows(self, reals: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Stacks of parameters, of any leading axes, on their own scale."""
        return jax.tree.map(np.asarray, self.constrain(jax.tree.map(jnp.asarray, reals)))

    def at(self, reals: Reals) -> Any:
        """The filter or model with these parameters."""
        return self.having(self.constrain(reals))

    def having(self, values: Mapping[str, Any]) -> Any:
        """The tree with these parameters, on their own scale."""
        leaves = list(self.leaves)
        for name, index in self.tuned:
            leaves[index] = values[name]
        return jax.tree.unflatten(self.structure, leaves)

    def value(self, key: Key[Array, ""], reals: Reals) -> Float[Array, ""]:
        """The objective of one seed."""
        return jnp.sum(self.objective(key, self.at(reals)))


def averages(values: Float[Array, "seeds series"], pooled: bool) -> Float[Array, " series"]:
    """The mean over seeds, or if `pooled` the logarithm of the mean of the exponentials.

    The bias of that logarithm is c / K + O(1 / K²) for K seeds. The jackknife (Quenouille 1956),
    K times the logarithm minus K - 1 times its mean over the sets that lack one seed, removes c.
    A series of which one seed alone has any likelihood has no such sets: it is not corrected.
    """
    num_seeds = len(values)
    if not pooled or num_seeds == 1:
        return jnp.mean(values, axis=0)
    has_sets = jnp.sum(values > -jnp.inf, axis=0) > 1
    omitted = jnp.eye(num_seeds, dtype=bool)[:, :, None] & has_sets[None, None]
    others = logsumexp(jnp.where(omitted, -jnp.inf, values), axis=1) - jnp.log(num_seeds - 1.0)
    whole = logsumexp(values, axis=0) - jnp.log(float(num_seeds))
    correction = (num_seeds - 1) * (whole - jnp.mean(others, axis=0))
    return whole + jnp.where(has_sets, correction, 0.0)


@eqx.filter_jit
def scores(
    keys: Key[Array, " seeds"], problem: Problem, reals: Reals, pooled: bool
) -> tuple[Float[Array, "seeds series"], Reals]:
    """The objective of each seed and series, and the gradient of its `averages`' sum."""

    def average(reals: Reals) -> tuple[Float[Array, ""], Float[Array, "seeds series"]]:
        values = jax.vmap(lambda key: problem.objective(key, problem.at(reals)))(keys)
        values = values.reshape(len(keys), -1)
        return jnp.sum(averages(values, pooled)), values

    gradient, values = jax.grad(average, has_aux=True)(reals)
    return values, gradient


def pose(
    tree: PyTree, objective: Objective, parameters: Parameters, transforms: Transforms
) -> Problem:
    """The problem; a `ValueError` for arguments that do not make one."""
    leaves, structure = jax.tree.flatten(tree)
    tuned = _places_of(tree, parameters)
    if not tuned:
        raise ValueError(f"parameters: there are none; name floats, or declare them {_DECLARED}")
    for name, index in tuned.items():
        leaves[index] = _as_array(name, leaves[index])
    transforms = {} if transforms is None else transforms
    for name in transforms.keys() - tuned.keys():
        raise ValueError(f"transforms: {name} is not among the parameters, {sorted(tuned)}")
    transforms = {name: transforms.get(name, Unconstrained()) for name in tuned}
    return Problem(leaves, transforms, objective, tuple(tuned.items()), structure)


@dataclass(frozen=True)
class Place:
    """Stands for a leaf, by its place among all of them."""

    index: int


def places_of(tree: PyTree) -> PyTree:
    """The tree with a `Place` for each leaf."""
    leaves, structure = jax.tree.flatten(tree)
    return jax.tree.unflatten(structure, map(Place, range(len(leaves))))


def _as_array(name: str, value: Any) -> Array:
    """A parameter as an array; raises `ValueError` for one without a derivative."""
    if isinstance(value, float | jax.Array | np.ndarray | np.generic):
        array = jnp.asarray(value, float if isinstance(value, float) else None)
        if jnp.issubdtype(array.dtype, jnp.floating):
            return array
    raise ValueError(f"parameters: {name}, {shown(value)}, is no float; declare it {_DECLARED}")


def _places_of(tree: PyTree, parameters: Parameters) -> dict[str, int]:
    """Each parameter's name, and its place among the tree's leaves."""
    if parameters is None:
        parameters = {"": lambda tree: getattr(tree, "model", tree)}
    leaves, places = jax.tree.leaves(tree), places_of(tree)
    tuned: dict[str, int] = {}
    for name, where in parameters.items():
        for inner, index in _pick(name, where, places, leaves).items():
            if index in tuned.values():
                twice = next(other for other in tuned if tuned[other] == index)
                raise ValueError(f"parameters: {twice} and {inner} pick the same number")
            tuned[inner] = index
    return tuned


def _pick(name: str, where: Any, places: PyTree, leaves: list[Any]) -> dict[str, int]:
    """The leaves that one entry of the mapping selects: a leaf, or the arrays of a node."""
    try:
        picked = where(places)
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"parameters: {name} cannot be picked: {error}") from error
    picks = jax.tree_util.tree_leaves_with_path(picked)
    for _, place in picks:
        if not isinstance(place, Place):
            what = f"{name} picks {shown(place)}, a static field or a new value"
            raise ValueError(f"parameters: {what}; declare its field {_DECLARED}")
    if len(picks) > 1 or not name:  # a network has functions among its leaves
        picks = [pick for pick in picks if eqx.is_inexact_array(leaves[pick[1].index])]
    if not picks and name:
        raise ValueError(f"parameters: {name} picks no array")
    names = ((name + jax.tree_util.keystr(path)).removeprefix(".") for path, _ in picks)
    return dict(zip(names, (place.index for _, place in picks), strict=True))
