"""Floating point types: the default one, and the one in which whole numbers are averaged."""

import jax.numpy as jnp
from jaxtyping import Array, Inexact, Shaped


def as_inexact(values: Shaped[Array, "*shape"]) -> Inexact[Array, "*shape"]:
    """The same numbers in floating point, in which whole numbers and booleans can be averaged."""
    is_inexact = jnp.issubdtype(values.dtype, jnp.inexact)
    return values if is_inexact else values.astype(default_float())


def default_float() -> jnp.dtype:
    """The floating point type of new arrays: float32, or float64 where JAX is set to it."""
    return jnp.result_type(float)
