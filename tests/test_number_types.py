"""Numbers of any type come out as the numbers that they are, or are refused by the argument's name.

JAX itself takes bytes of another order as they stand, halves whole numbers of 64 bits, forgets
masks, and lets unsigned numbers wrap around zero where they are subtracted.
"""

import array
import collections
import datetime
import decimal
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import metrics
from mpfjax.exact import grid_filter, kalman_filter, kalman_smoother
from mpfjax.smoothing import conditional_filter, smoothed_sums
from mpfjax.vision import Detections
from tests.marking import quick_of

pytestmark = pytest.mark.usefixtures("as_installed")


@pytest.fixture(autouse=True)
def types_are_promoted():
    """As they are where nobody asked for strictness."""
    with jax.numpy_dtype_promotion("standard"):
        yield


KEY = jax.random.key(0)
MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
FILTER = mpfjax.particle_filter(MODEL, 4)
MIXTURE = FILTER.init(KEY)
LINEAR = {"Q": [[0.3]], "H": [[1.0]], "R": [[0.4]], "m0": [0.5], "P0": [[1.0]]}
KNOWN = mpfjax.LinearGaussianModel(A=[[0.9]], **LINEAR)
OTHERS = jnp.array([[0.5, 7.0], [9.0, 2.5]])
BOX, BOXES = [[[[2.0, 0.0, 4.0, 4.0]]]], [[2.0, 3.0, 4.0, 5.0], [6.0, 1.0, 2.0, 2.0]]
ROWS = [[1.0, 1.0, 3.0, 2.0, 5.0, 5.0]]

# By name: a function, the argument that takes the numbers, and numbers. Differences of them are of
# either sign.
TAKEN = {
    "crps": (
        lambda values: metrics.crps(values, jnp.ones(3), jnp.asarray(2.5)), "values", [1, 2, 4]
    ),
    "crps, observed": (
        lambda values: metrics.crps(jnp.array([[1.0, 5.0]] * 2), jnp.ones((2, 2)), values),
        "observations", [2, 3],
    ),
    "crps, both": (
        lambda values: metrics.crps(values[1:], jnp.ones(2), values[0]),
        "values|observations", [5, 2, 4],
    ),
    "crps, weights": (
        lambda values: metrics.crps(jnp.array([1.0, 5.0]), values, jnp.asarray(2.5)),
        "weights", [1, 3],
    ),
    "ospa": (
        lambda values: metrics.ospa(values, OTHERS, cutoff=3.0), "estimates", [[1, 6], [0, 3]]
    ),
    "ospa, both": (
        lambda values: metrics.ospa(values[:1], values[1:], cutoff=30.0),
        "estimates", [[1, 6], [0, 3], [4, 4]],
    ),
    "gospa": (lambda values: metrics.gospa(OTHERS, values, cutoff=3.0), "truths", [[1, 6], [0, 3]]),
    "modes_represented": (
        lambda values: metrics.modes_represented(
            values, jnp.ones(3, bool), jnp.array([2.5, 9.0]), 0.7
        ),
        "positions", [1, 2, 4],
    ),
    "modes_represented, both": (
        lambda values: metrics.modes_represented(values, np.ones(3, bool), values[:1], 1.5),
        "positions|modes", [1, 2, 4],
    ),
    "tracking_quality": (
        lambda values: metrics.tracking_quality(values, jnp.array([[[1.0, 1, 4, 4]]])),
        "estimates", BOX,
    ),
    "multi_object_scores": (
        lambda values: list(metrics.multi_object_scores(values, ROWS).values()), "tracks", ROWS
    ),
    "log_score": (
        lambda values: metrics.log_score(MODEL, MIXTURE, values), "observation", 2
    ),
    "average": (MIXTURE.average, "values", [0, 100, 200, 255]),
    "component_averages": (MIXTURE.component_averages, "values", [0, 100, 200, 255]),
    "component_sums": (MIXTURE.component_sums, "values", [0, 100, 200, 255]),
    "LinearGaussianModel": (
        lambda values: mpfjax.LinearGaussianModel(A=values, **LINEAR).A, "A", [[2]]
    ),
    "RandomWalk": (lambda values: mpfjax.RandomWalk(values).deviations, "deviations", [1, 2]),
    "Detections": (
        lambda values: Detections(values, jnp.ones(2, bool), jnp.ones(2)), "boxes", BOXES
    ),
    "Detections.from_boxes": (lambda values: Detections.from_boxes(values, 3), "boxes", BOXES),
    "Detections.from_boxes, scores": (
        lambda values: Detections.from_boxes(BOXES, 3, values), "scores", [1, 3]
    ),
    "kalman_filter": (
        lambda values: kalman_filter(KNOWN, values), "observations", [[1], [2], [3]]
    ),
}  # fmt: skip
# Each type is another program to these.
RUN = {
    "run_filter": (
        lambda values: mpfjax.run_filter(KEY, FILTER, values, lambda mixture: None),
        "observations", [1, 2, 3],
    ),
    "step": (lambda values: FILTER.step(KEY, MIXTURE, values)[1], "observation", 2),
    "conditional_filter": (
        lambda values: conditional_filter(
            KEY, FILTER, jnp.ones(2), values, backward=False
        ).trajectory,
        "trajectory", [1, 2, 1],
    ),
    "smoothed_sums": (
        lambda values: smoothed_sums(KEY, FILTER, values, lambda x, y: y).sums,
        "observations", [1, 2, 3],
    ),
    "grid_filter": (
        lambda values: grid_filter(MODEL, values, jnp.linspace(-4.0, 4.0, 41)),
        "observations", [1, 2, 3],
    ),
    "kalman_smoother": (
        lambda values: kalman_smoother(KNOWN, values), "observations", [[1], [2], [3]]
    ),
}  # fmt: skip

BIG = 2**40
FLOATS = {name: lambda x, name=name: x.astype(name) for name in (">f8", ">f4", "longdouble", "f2")}
WHOLE = {
    name: lambda x, name=name: x.astype(name) for name in ("u1", ">u2", "i2", ">i4", "u8", "i8")
}
BEYOND = {
    "int64 beyond 32 bits": lambda x: x.astype(np.int64) + BIG,
    "uint64 beyond 32 bits": lambda x: x.astype(np.uint64) + np.uint64(BIG),
}
NO_NUMBERS = {
    "complex": lambda x: x + 1j,
    "timedelta64": lambda x: x.astype("m8[s]"),
    "datetime64": lambda x: x.astype("M8[s]"),
    "masked": lambda x: np.ma.masked_array(x, mask=np.arange(x.size).reshape(x.shape) == 0),
    "timedelta": lambda x: np.vectorize(lambda v: datetime.timedelta(seconds=v), [object])(x),
    "decimal": lambda x: np.vectorize(decimal.Decimal, [object])(x),
}
# Those in which a complex average is an average as any other.
# Whose masked rows are none.
MAY_BE_MASKED = ("Detections.from_boxes",)
MAY_BE_COMPLEX = ("average", "component_averages", "component_sums")


def outcome(function, argument, numbers):
    """Numbers of what was found, or None where the argument was refused by its name."""
    try:
        found = function(numbers)
    except ValueError as error:
        if not str(error).startswith(tuple(f"{name}: " for name in argument.split("|"))):
            raise
        return None
    return np.concatenate([np.ravel(leaf).astype(complex) for leaf in jax.tree.leaves(found)])


@functools.cache
def expected(name, shift=0.0):
    function, argument, numbers = (TAKEN | RUN)[name]
    return outcome(function, argument, jnp.asarray(np.asarray(numbers, np.float32) + shift))


KINDS = FLOATS | WHOLE | NO_NUMBERS | BEYOND
CASES = [(name, kind) for name in TAKEN | RUN for kind in KINDS]
# One of each kind, and of what runs a filter those that share its program.
QUICK = [(name, kind) for name in TAKEN for kind in ("u1", "masked")]
QUICK += [("crps", kind) for kind in (">f4", "complex", *BEYOND)]
QUICK += [(name, kind) for name in ("run_filter", "step") for kind in (">f4", "timedelta")]


@pytest.mark.parametrize(("name", "kind"), quick_of(CASES, QUICK))
def test_numbers_are_what_they_are_or_refused(name, kind):
    function, argument, numbers = (TAKEN | RUN)[name]
    given = KINDS[kind](np.asarray(numbers, float))
    found = outcome(function, argument, given)
    if kind in NO_NUMBERS:
        taken = {"complex": MAY_BE_COMPLEX, "masked": MAY_BE_MASKED}.get(kind, ())
        if kind == "decimal" and found is not None:
            np.testing.assert_allclose(found, expected(name), rtol=1e-5)
        else:
            assert (found is not None) == (name in taken)
        return
    if kind in BEYOND:
        exact = expected(name, np.float32(BIG))
        if found is not None:
            np.testing.assert_allclose(found, exact, rtol=1e-5)
        return
    np.testing.assert_allclose(found, expected(name), rtol=1e-2 if kind == "f2" else 1e-5)


def test_observations_in_other_containers():
    """What numpy makes an array of is one; a list is so many arrays."""
    good = mpfjax.run_filter(KEY, FILTER, np.array([1.0, 2.0, 3.0], np.float32), lambda m: None)
    for numbers in (array.array("d", [1.0, 2.0, 3.0]), collections.deque([1.0, 2.0, 3.0])):
        if jax.tree.leaves(numbers) == [1.0, 2.0, 3.0]:  # as JAX may see a deque
            continue
        run = mpfjax.run_filter(KEY, FILTER, numbers, lambda m: None)
        assert run.log_marginal_likelihood == good.log_marginal_likelihood
    with pytest.raises(ValueError, match=r"jnp.asarray\(observations\) is one"):
        mpfjax.run_filter(KEY, FILTER, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match=r"observation: .*timedelta.* is no array of numbers"):
        FILTER.step(KEY, MIXTURE, datetime.timedelta(seconds=2))
