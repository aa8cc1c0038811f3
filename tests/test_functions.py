"""Functions written in place: which are the same, and that a run with the same compiles nothing."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.operations.functions import interned
from tests.user_models import TrickyQuadraticModel, nothing_traced

threshold = 0.0
table = {"threshold": 0.0}
CENTRE = jnp.array([1.0, 2.0])


def lowest(x):
    return x - threshold


def written_in(make, values):
    """What `make` writes for each value, interned."""
    return [interned(make(value)) for value in values]


@pytest.mark.parametrize(
    ("make", "same"),
    [
        (lambda _: lambda x: x + 1, True),
        (lambda _: lambda x: jnp.mean(x) + math.pi, True),
        (lambda _: lambda x: x - CENTRE, True),
        (lambda _: lambda x: lowest(x), True),
        (lambda _: lambda x: (lambda y: (y, threshold))(x), True),
        (lambda k: lambda x: x + k, False),
        (lambda k: lambda x, y=k: x + y, False),
        (lambda k: lambda x, *, y=k: x + y, False),
        (lambda k: lambda x: (lambda: x + k)(), False),
        (lambda _: lambda x: x + table["threshold"], False),
        (lambda _: lambda x: undefined(x), True),
    ],
)
def test_of_two_written_at_one_place(make, same):
    first, second = written_in(make, (1, 2))
    assert (first is second) == same


@pytest.mark.parametrize("pair", [(0.0, -0.0), (1, 1.0), (1, True), ("a", b"a")])
def test_values_that_only_look_alike_are_others(pair):
    first, second = written_in(lambda k: lambda x: (x, k), pair)
    assert first is not second


@pytest.mark.parametrize("value", [math.nan, np.float32(1.5), (1, (2.0, "a")), None, jnp.sum, len])
def test_values_that_are_the_same(value):
    first, second = written_in(lambda k: lambda x: (x, k), (value, value))
    assert first is second


@pytest.mark.parametrize("value", [[1], np.ones(1), mpfjax.QuadraticModel(), object()])
def test_with_what_may_change_it_is_itself(value):
    for make in (lambda k: lambda x: (x, k), lambda k: lambda x, y=k: (x, y)):
        first, second = written_in(make, (value, value))
        assert first is not second


def test_a_global_that_has_changed_makes_another(monkeypatch):
    def write(_):
        return lambda x: lowest(x)

    (first,) = written_in(write, (0,))
    monkeypatch.setattr("tests.test_functions.threshold", 1.0)
    (second,) = written_in(write, (0,))
    assert (first(0.0), second(0.0)) == (-1.0, -1.0)
    assert first is not second


def test_one_whose_variables_have_changed_since_is_not_given_for_another():
    def written(value):
        def change(new):
            nonlocal value
            value = new

        return (lambda x: x + value), change

    first, change = written(1)
    assert interned(first) is first
    change(5)
    second, _ = written(1)
    assert interned(second)(0) == 1


def test_what_is_no_plain_function_is_itself():
    def marked(x):
        return x

    marked.unit = "pixels"
    for given in (None, "hilbert", len, jnp.sum, mpfjax.PilotLookahead, marked):
        assert interned(given) is given


def test_one_that_calls_itself_ends():
    def countdown(x):
        return x if x == 0 else countdown(x - 1)

    assert interned(countdown)(3) == 0


def runs_with(features):
    """The probability of x > `threshold` after each step, by functions that are written anew."""
    filter = mpfjax.mixture_particle_filter(
        TrickyQuadraticModel(), 40, 2, features=features, sort_by=lambda states: states
    )
    return mpfjax.run_filter(
        jax.random.key(0), filter, jnp.ones(4), lambda m: m.average(m.particles > threshold)
    ).collected


def test_a_run_with_functions_that_are_written_anew_compiles_nothing(monkeypatch):
    def square():
        return lambda states: states**2

    positive = runs_with(square())
    with nothing_traced():
        np.testing.assert_array_equal(runs_with(square()), positive)
    monkeypatch.setattr("tests.test_functions.threshold", 100.0)
    np.testing.assert_array_equal(runs_with(square()), 0.0)
    assert np.all(positive > 0)
