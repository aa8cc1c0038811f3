"""A number or a choice for each row of arrays, whatever axes their rows have.

In numpy: `np.where(chosen[:, None], new, old)`, with as many `None` as the arrays need.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree, Shaped


def along_rows(values: Shaped[Array, "*n"], rows: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
    """The values of each row with further axes of length one, as many as the rows have."""
    return jnp.expand_dims(values, tuple(range(values.ndim, rows.ndim)))


def select_rows(is_new: Bool[Array, "*n"], new: PyTree, old: PyTree) -> PyTree:
    """The `new` rows of every leaf where they are chosen, and the `old` ones elsewhere."""

    def select(new: Array, old: Array) -> Array:
        return jnp.where(along_rows(is_new, new), new, old)

    return jax.tree.map(select, new, old)
