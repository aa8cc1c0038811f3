"""Quantiles of the standard normal, in operations that XLA runs on vectors on a CPU."""

import math
from collections.abc import Iterable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Giles (2010), "Approximating the erfinv function", table 5, highest power first: erf⁻¹(x) / x as
# a polynomial in w - 2.5 where w = -log(1 - x²) is below 5, and in √w - 3 beyond.
_CENTRE = np.array([
    2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087,
    -0.00125372503, -0.00417768164, 0.246640727, 1.50140941,
], np.float32)  # fmt: skip
_TAIL = np.array([
    -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773,
    -0.0076224613, 0.00943887047, 1.00167406, 2.83297682,
], np.float32)  # fmt: skip
# Moshier's Cephes library, logf: (log(1 + f) - f + f²/2) / f³ for 1 + f in [√½, √2].
_LOGARITHM = np.array([
    7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
    -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
], np.float32)  # fmt: skip
_ROOT_OF_HALF = 0x3F3504F3
_FRACTION = 0x7FFFFF


def normal_quantile(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """√2 erf⁻¹(x) for x in (-1, 1): the quantile of (1 + x) / 2 of the standard normal.

    `jax.lax.erf_inv` has the same polynomials. XLA compiles its logarithm to a call per number, so
    that a filter's run takes up to 40% longer where vectors are wide.
    """
    if values.dtype != jnp.float32:
        return math.sqrt(2) * jax.lax.erf_inv(values)
    exponent = -_log((1 - values) * (1 + values))
    is_central = exponent < 5
    powers = jnp.where(is_central, exponent - 2.5, jnp.sqrt(exponent) - 3.0)
    coefficients = map(partial(jnp.where, is_central), _CENTRE, _TAIL)
    return np.float32(math.sqrt(2)) * _polynomial(coefficients, powers) * values


def _log(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The logarithm of positive float32 numbers, in operations that run on vectors."""
    # Shifted so that the exponent's bits count from √½.
    bits = jax.lax.bitcast_convert_type(values, jnp.int32) - _ROOT_OF_HALF
    exponent = (bits >> 23).astype(jnp.float32)
    mantissa = jax.lax.bitcast_convert_type((bits & _FRACTION) + _ROOT_OF_HALF, jnp.float32)
    f = mantissa - 1
    series = _polynomial(_LOGARITHM, f)
    return exponent * np.float32(math.log(2)) + (f + f * f * (f * series - 0.5))


def _polynomial(coefficients: Iterable[Any], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The polynomial; the coefficient of the highest power comes first."""
    highest, *others = coefficients
    value = highest
    for coefficient in others:
        value = value * x + coefficient
    return value
