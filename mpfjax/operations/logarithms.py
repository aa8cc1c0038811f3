"""Weights in logarithms: sums and shares that neither overflow nor lose their gradient.

In numpy: `np.log(np.sum(np.exp(x)))` and `np.exp(x) / np.sum(np.exp(x))`. The largest is taken off
first, -inf for all is a case of its own, and a weight too small to count becomes zero, since a CPU
takes a hundred times as long over subnormal numbers.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def exp(log_values: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """e to these powers, zero where it is too small to count beside 1, squares and sums included.

    Arithmetic on subnormal numbers, which weights a little above zero would lead to, takes a
    hundred times as long.
    """
    info = jnp.finfo(log_values.dtype)
    smallest = math.log(info.tiny) - math.log(info.eps)
    return jnp.where(log_values < smallest, 0.0, jnp.exp(log_values))  # NaN stays


def scaled_exp(log_values: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """exp of the values over the largest exp of them, and the logarithm of that one.

    All that is derived from weights starts from these, which XLA then computes once.
    """
    log_scale = finite_max(log_values)
    return exp(log_values - log_scale), log_scale


def finite_max(log_values: Float[Array, " n"]) -> Float[Array, ""]:
    """What logarithms may be reduced by: the largest, or 0 where that is infinite or NaN.

    It is a constant to a derivative.
    """
    return finite_or_zero(jnp.max(jax.lax.stop_gradient(log_values), initial=-jnp.inf))


def log_sum_exp(log_values: Float[Array, " n"]) -> Float[Array, ""]:
    """log Σ exp, -inf where every entry is -inf, with a gradient that is finite there too."""
    log_total, log_scale = scaled_log_sum_exp(log_values)
    return log_total + log_scale


def scaled_log_sum_exp(
    log_values: Float[Array, " n"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """log Σ exp in two parts: that of the values over the largest, and the largest.

    Of logarithms beyond a million or so the sum of both would keep little of the first.
    """
    values, log_scale = scaled_exp(log_values)
    return log_or_nothing(jnp.sum(values)), log_scale


def softmax(log_values: Float[Array, " n"]) -> Float[Array, " n"]:
    """exp of the values as shares of their sum, all zero where every entry is -inf."""
    values, _ = scaled_exp(log_values)
    total = jnp.sum(values)
    shares = values / jnp.where(total == 0, 1.0, total)
    return masked_shares(log_values, shares)


def finite_or_zero(largest: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """What may be taken off a logarithm: the largest, or nothing where that is infinite or NaN."""
    return jnp.where(jnp.isfinite(largest), largest, 0.0)


def masked_shares(log_values: Float[Array, " n"], shares: Float[Array, " n"]) -> Float[Array, " n"]:
    """The shares, with no gradient at -inf, where what uses them may have none that is finite."""
    return jnp.where(log_values == -jnp.inf, 0.0, shares)


def log_or_nothing(total: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """log, -inf at zero with a gradient of zero; NaN comes out as NaN."""
    empty = total == 0
    return jnp.where(empty, -jnp.inf, jnp.log(jnp.where(empty, 1.0, total)))
