"""Transforms are bijections between a domain and all real numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.tuning import Interval, Positive, Simplex
from mpfjax.tuning.bijections import Unconstrained

INSIDE = {
    "positive": (Positive(), [0.01, 1.0, 300.0]),
    "interval": (Interval(-1.0, 3.0), [-0.9, 0.0, 2.5]),
    "simplex": (Simplex(), [[0.2, 0.3, 0.5], [0.001, 0.9, 0.099]]),
    "unconstrained": (Unconstrained(), [-5.0, 0.0, 7.0]),
}


@pytest.mark.parametrize("name", INSIDE)
def test_there_and_back(name):
    transform, values = INSIDE[name]
    assert transform.contains(np.array(values))
    reals = transform.unconstrain(jnp.array(values))
    assert np.isfinite(reals).all()
    np.testing.assert_allclose(transform.constrain(reals), values, rtol=1e-5)
    for shift in (-3.0, 3.0):
        assert transform.contains(np.asarray(transform.constrain(reals + shift)))


FAR = (18.0, -18.0, 88.0, -88.0, 104.0, -104.0, 1e4, -1e4)


@pytest.mark.parametrize(
    "transform",
    [Positive(), Interval(0.0, 1.0), Interval(-1.0, 0.0), Interval(2.0, 3.7), Simplex()],
    ids=str,
)
def test_numbers_far_from_zero_are_parameters_inside(transform):
    """Also where float32 rounds exp and the logistic function to the ends of the domain."""
    reals = jnp.array(FAR).reshape(-1, 1)
    if isinstance(transform, Simplex):
        reals = jnp.concatenate([reals, jnp.zeros_like(reals)], axis=1)
    values = transform.constrain(reals)
    for row, value in zip(reals, np.asarray(values), strict=True):
        assert transform.contains(value), (row, value)
        assert np.isfinite(transform.unconstrain(jnp.asarray(value))).all()
        assert np.isfinite(transform.log_jacobian(row))
    slopes = jax.grad(lambda u: jnp.sum(transform.constrain(u) / values))(reals)
    assert np.isfinite(slopes).all()


@pytest.mark.parametrize("shift", [150.0, -150.0, 2e3])
def test_the_jacobian_far_from_zero_is_that_of_more_digits(shift):
    logits = np.array([shift, 0.0, 0.0])
    of_simplex = np.sum(logits - np.logaddexp.reduce(logits))
    found = Simplex().log_jacobian(jnp.asarray(logits[:2]))
    np.testing.assert_allclose(found, of_simplex, rtol=1e-6)
    of_interval = np.log(4.0) - np.logaddexp(0, shift) - np.logaddexp(0, -shift)
    found = Interval(-1.0, 3.0).log_jacobian(jnp.array(shift))
    np.testing.assert_allclose(found, of_interval, rtol=1e-6)


@pytest.mark.parametrize("name", INSIDE)
def test_the_jacobian_is_that_of_automatic_differentiation(name):
    transform, values = INSIDE[name]
    reals = transform.unconstrain(jnp.array(values)) + 0.3
    jacobian = np.asarray(jax.jacfwd(transform.constrain)(reals), float)
    # Of probabilities, those that are free: the last is one minus the rest.
    free = jacobian[..., : reals.shape[-1], :, :] if reals.ndim == 2 else jacobian
    expected = np.linalg.slogdet(free.reshape(reals.size, reals.size))[1]
    assert float(transform.log_jacobian(reals)) == pytest.approx(expected, rel=1e-3, abs=1e-4)


OUTSIDE = {
    Positive(): ([1.0, 0.0], [np.inf], [np.nan], np.float32([1e-42])),
    Interval(0.0, 1.0): ([0.5, 1.0], [np.nan]),
    Simplex(): ([0.5, 0.4], [1.0, 0.0], 1.0),
    Unconstrained(): ([np.inf],),
}


@pytest.mark.parametrize("transform", OUTSIDE, ids=str)
def test_what_lies_outside_is_known(transform):
    for value in OUTSIDE[transform]:
        assert not transform.contains(np.array(value)), value
