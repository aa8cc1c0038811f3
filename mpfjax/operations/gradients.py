"""Values with a gradient that is not their own, or without one."""

import equinox as eqx
import jax
from jaxtyping import Array, Float, PyTree


@jax.custom_jvp
def add_gradient(
    values: Float[Array, " *shape"], source: Float[Array, " *shape"]
) -> Float[Array, " *shape"]:
    """`values`, to the bit, with the derivatives of `values + source`, of every order.

    Without differentiation, the source is not even computed.
    """
    del source
    return values


@add_gradient.defjvp
def _add_gradient_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return add_gradient(*primals), tangents[0] + tangents[1]


def without_gradient(tree: PyTree) -> PyTree:
    """The same values, all of them constants to a derivative."""
    return jax.tree.map(
        lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, tree
    )
