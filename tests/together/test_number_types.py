"""Numbers of any type come out as the numbers that they are, or are refused by the argument's name.

JAX itself takes bytes of another order as they stand, halves whole numbers of 64 bits, forgets
masks, and lets unsigned numbers wrap around zero where they are subtracted.
"""

import datetime

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import metrics
from mpfjax.arrays import to_array
from mpfjax.checks import as_numbers
from mpfjax.exact import kalman_filter
from mpfjax.models.series import check_differences
from mpfjax.vision import Detections

pytestmark = pytest.mark.usefixtures("as_installed")
KINDS = (">f8", ">f4", "f2", "u1", ">u2", "i2", ">i4", "u8", "i8")
KNOWN = mpfjax.LinearGaussianModel([[0.9]], [[0.3]], [[1.0]], [[0.4]], [0.5], [[1.0]])
FILTER = mpfjax.particle_filter(KNOWN, 4)
MIXTURE = FILTER.init(jax.random.key(0))
OTHERS = np.array([[0.5, 7.0], [9.0, 2.5]])


@pytest.fixture(autouse=True)
def types_are_promoted():
    """As they are where nobody asked for strictness."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.mark.parametrize("kind", KINDS)
def test_each_type_keeps_its_numbers(kind):
    numbers = np.array([0, 1, 100, 250]).astype(kind)
    assert [float(x) for x in to_array("x")(numbers)] == [0, 1, 100, 250]
    assert [float(x) for x in jnp.asarray(as_numbers("x", numbers))] == [0, 1, 100, 250]


@pytest.mark.parametrize(
    "value",
    [
        np.array([2**40]), np.array([2**40], "u8"), np.array([1e300]), np.array([1 + 1j]),
        np.array([1, 2], "m8[s]"), np.array([1, 2], "M8[s]"), datetime.timedelta(1),
        np.array([1.0], np.longdouble),
        np.ma.masked_array([1, 2], [True, False]), np.array(["a"]), None,
    ],
)  # fmt: skip
def test_what_would_change_is_refused(value):
    with pytest.raises(ValueError, match=r"^x: "):
        as_numbers("x", value)


SECONDS = 1.7e9 + np.arange(400.0)
LOST = {
    "Unix times": SECONDS,
    "Unix times in whole numbers": SECONDS.astype(int),
    "of JAX": jnp.asarray(SECONDS, jnp.float32),
    "milliseconds": (1000 * SECONDS).astype(int),
    "nanoseconds": 1e9 * SECONDS,
    "three times": SECONDS[:3, None],
    "Julian dates": 2460000.5 + np.arange(40) / 24,
    "modified Julian dates": 60000.0 + np.arange(40) / 1440,
    "UTM metres": np.stack([np.arange(40.0), 5.6e6 + np.random.default_rng(0).normal(size=40)], 1),
    "indices": 2**24 + np.arange(5.0),
    "degrees of longitude": 8.4 + 1e-6 * np.cumsum(np.random.default_rng(0).normal(size=50)),
}


@pytest.mark.parametrize("name", LOST)
def test_differences_that_float32_loses_are_refused_where_arrays_enter(name):
    numbers, one = LOST[name], [[1.0]]
    walk = mpfjax.LinearGaussianModel(one, one, one, one, [0.0], one, B=one)
    key, filter, zeros = jax.random.key(0), mpfjax.particle_filter(walk, 4), np.zeros(len(numbers))
    match = r"^{}: float32 cannot tell numbers near .*subtract in numpy before.*jax_enable_x64"
    for call in (
        lambda: mpfjax.run_filter(key, filter, numbers),
        lambda: kalman_filter(walk, numbers),
        lambda: mpfjax.monte_carlo(jax.random.split(key, 2), filter, mpfjax.Series(numbers)),
    ):
        with pytest.raises(ValueError, match=match.format("observations")):
            call()
    with pytest.raises(ValueError, match=match.format("inputs")):
        mpfjax.run_filter(key, filter, zeros, inputs=numbers)


@pytest.mark.parametrize(
    "numbers",
    [
        np.diff(SECONDS + 1e-3), np.full(9, 0.1), np.full(9, 1.7e9), 300 + OTHERS[0],
        1e4 + np.random.default_rng(0).normal(size=99), np.arange(1000), 1e8 * np.arange(9.0),
        2**20 + np.arange(9), np.array([1.0, 1.0 + 1e-9]), np.array([1.7e9]),
        np.random.default_rng(0).integers(0, 2**31, 9), np.diff(1e6 + 0.1 * np.arange(50)),
        0.01 * np.cumsum(np.random.default_rng(0).normal(size=50)),
        5 + np.random.default_rng(0).normal(size=10**5), np.array([np.nan, np.inf, 1.7e9, 1.7e9]),
    ],
)  # fmt: skip
def test_what_float32_holds_well_enough_is_taken(numbers):
    check_differences("x", numbers)


# By name: a function and numbers, whose differences are of either sign.
TAKEN = {
    "crps": (lambda x: metrics.crps(x[1:], jnp.ones(2), x[0]), [5, 2, 4]),
    "ospa": (lambda x: metrics.ospa(x, OTHERS, cutoff=3.0), [[1, 6], [0, 3]]),
    "gospa": (lambda x: metrics.gospa(OTHERS, x, cutoff=3.0), [[1, 6], [0, 3]]),
    "expectation": (MIXTURE.expectation, [0, 100, 200, 255]),
    "Detections": (
        lambda x: np.asarray(Detections.of(x, "boxes", 4).boxes),
        [[2.0, 3.0, 4.0, 5.0], [6.0, 1.0, 2.0, 2.0]],
    ),
    "kalman_filter": (lambda x: kalman_filter(KNOWN, x), [[1], [2], [3]]),
    "step": (lambda x: FILTER.step(jax.random.key(0), MIXTURE, x)[1], [2]),
}  # fmt: skip


@pytest.mark.exactness
@pytest.mark.parametrize("name", TAKEN)
def test_what_takes_numbers_takes_small_whole_ones_and_other_bytes(name):
    function, numbers = TAKEN[name]
    expected = function(np.array(numbers, np.float32))
    for kind in ("u1", ">f4"):
        found = function(np.array(numbers).astype(kind))
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5)
