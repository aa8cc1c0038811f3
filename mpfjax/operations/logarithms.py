"""Weights in logarithms: sums and shares that neither overflow nor lose their gradient.

In numpy: `np.log(np.sum(np.exp(x)))` and `np.exp(x) / np.sum(np.exp(x))`. Here the largest value is
subtracted first, and -inf everywhere is a case of its own. A weight that is too small to count
becomes zero, since a CPU takes a hundred times as long for subnormal numbers. What these and others
need of floating point types, maxima and gradients stands here too.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact, PyTree, Shaped


def as_inexact(values: Shaped[Array, "*shape"]) -> Inexact[Array, "*shape"]:
    """The numbers in floating point, in which whole numbers and booleans can be averaged."""
    is_inexact = jnp.issubdtype(values.dtype, jnp.inexact)
    return values if is_inexact else values.astype(default_float())


def default_float() -> jnp.dtype:
    """The floating point type of new arrays: float32, or float64 where JAX is set to it."""
    return jnp.result_type(float)


@jax.custom_jvp
def add_gradient(
    values: Float[Array, " *shape"], source: Float[Array, " *shape"]
) -> Float[Array, " *shape"]:
    """`values`, to the bit, with the derivatives of `values + source`, of every order.

    Without differentiation, the source is not even computed.
    """
    return values


@add_gradient.defjvp
def _add_gradient_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return add_gradient(*primals), tangents[0] + tangents[1]


def without_gradient(tree: PyTree) -> PyTree:
    """The tree's values as constants to a derivative."""
    return jax.tree.map(
        lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, tree
    )


def exp(log_values: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """e to these powers; zero where it is too small to count beside 1, even squared or summed.

    Weights a little above zero would lead to subnormal numbers, and arithmetic on these takes a
    hundred times as long.
    """
    info = jnp.finfo(log_values.dtype)
    smallest = math.log(info.tiny) - math.log(info.eps)
    return jnp.where(log_values < smallest, 0.0, jnp.exp(log_values))  # NaN stays


def scaled_exp(log_values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """exp of the values divided by the largest exp, and the logarithm of the largest.

    Everything that is derived from weights starts here, so XLA computes it once.
    """
    log_scale = finite_max(log_values)
    return exp(log_values - log_scale), log_scale


def finite_max(log_values: Float[Array, " n"]) -> Float[Array, ""]:
    """What to subtract from logarithms: the largest, or 0 if that is infinite or NaN.

    A derivative treats it as a constant.
    """
    most = jnp.max(jax.lax.stop_gradient(log_values), initial=-jnp.inf)
    return jnp.where(jnp.isfinite(most), most, 0.0)


def log_sum_exp(log_values: Float[Array, " n"]) -> Float[Array, ""]:
    """log Σ exp, -inf where every entry is -inf, with a gradient that is finite there too."""
    values, log_scale = scaled_exp(log_values)
    return log_or_nothing(jnp.sum(values)) + log_scale


def softmax(log_values: Float[Array, " n"]) -> Float[Array, " n"]:
    """exp of the values as shares of their sum, all zero where every entry is -inf."""
    values, _ = scaled_exp(log_values)
    total = jnp.sum(values)
    shares = values / jnp.where(total == 0, 1.0, total)
    # Without a gradient at -inf, where that of later operations may not be finite.
    return jnp.where(log_values == -jnp.inf, 0.0, shares)


def finite_or_zero(largest: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """What to subtract from a logarithm: the value itself, or 0 if that is infinite or NaN."""
    return jnp.where(jnp.isfinite(largest), largest, 0.0)


def log_or_nothing(total: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """log with a gradient of zero at zero, where it is -inf; NaN stays NaN."""
    empty = total == 0
    return jnp.where(empty, -jnp.inf, jnp.log(jnp.where(empty, 1.0, total)))
