"""Contact between objects: which objects meet, and the clusters that follow from it.

Two objects are in contact where log ψ ≠ 0 between any of their predicted points. A cluster is a set
of objects linked by contact, directly or through others, and is named by its first object.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from mpfjax.models.multi_object import MultiObjectModel


def coupled(
    model: MultiObjectModel, points: PyTree, labels: Int[Array, " objects"], may_split: bool
) -> Bool[Array, "objects objects"]:
    """Which objects have points between which ψ ≠ 1, over all pairs of their points.

    It is not computed within a cluster that can never split.
    """
    num_objects, interaction = model.num_objects, model.interaction
    if interaction is None:
        return jnp.zeros((num_objects, num_objects), bool)
    first, second = np.triu_indices(num_objects, 1)

    def touch(carry: None, pair: tuple) -> tuple[None, Bool[Array, ""]]:
        i, j = pair

        def look() -> Bool[Array, ""]:
            log_psi = over_pairs(interaction)(
                model.object_states(points, i), model.object_states(points, j)
            )
            return jnp.any(log_psi != 0)

        if may_split:
            return carry, look()
        return carry, jax.lax.cond(labels[i] == labels[j], lambda: jnp.zeros((), bool), look)

    pairs = (jnp.asarray(first, jnp.int32), jnp.asarray(second, jnp.int32))
    _, touches = jax.lax.scan(touch, None, pairs)
    half = jnp.zeros((num_objects, num_objects), bool).at[pairs].set(touches)
    return half | half.T


def together(labels: Int[Array, " objects"]) -> Bool[Array, "objects objects"]:
    """Which two objects are in one cluster."""
    return labels[:, None] == labels[None]


def alike(state: PyTree, others: PyTree) -> PyTree:
    """The same state repeated beside each of the other object's states."""
    return jax.tree.map(lambda a, b: jnp.broadcast_to(a[None], b.shape), state, others)


def over_pairs(
    function: Callable[[PyTree, PyTree], Float[Array, " n"]],
) -> Callable[[PyTree, PyTree], Float[Array, "n n"]]:
    """Turn a function of the states of equal rows into one of all pairs of rows."""
    of_one = lambda state, others: function(alike(state, others), others)  # noqa: E731
    return jax.vmap(of_one, in_axes=(0, None))
