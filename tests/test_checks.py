"""Every check names the argument and its value, and lets pass what it should."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax import checks

REFUSED = {
    "whole": (lambda **a: checks.check_whole(2, **a), (1, 2.0, 2.5, True, None, "3", jnp.array(3))),
    "positive": (checks.check_positive, (0, -1.0, np.nan, np.inf, True, None, "1", [1.0])),
    "not negative": (checks.check_not_negative, (-1e-9, np.nan, np.inf, False, None)),
    "finite": (checks.check_finite, (np.nan, -np.inf, 1j, None)),
    "share": (lambda **a: checks.check_share(0.5, **a), (-0.1, 0.6, np.nan, None, "0")),
    "inner share": (checks.check_inner_share, (0, 1, -0.1, np.nan, True, None, "0.5")),
    "shape": (
        lambda size: checks.check_shape("n 4", size=size),
        (None, 1.0, [[1, 2, 3, 4]], np.ones(4), np.ones((4, 3)), np.full((1, 4), "a"), jnp.ndarray),
    ),
    "rows": (
        lambda size: checks.to_rows(2, "size", size),
        (None, "a", 1.0, [1.0], np.ones((2, 3)), [[1.0, 2.0], [1.0]], np.ones((1, 2, 2))),
    ),
    "one of": (lambda **a: checks.check_one_of(("up", "down"), **a), ("left", None, 1, ["up"])),
    "flag": (checks.check_flag, (0, 1.0, None, "yes")),
    "callable": (lambda **a: checks.check_callable("a function", **a), (None, 3, int, "f")),
    "type": (lambda **a: checks.check_type(dict, "a dict", **a), (None, [], dict)),
    "array": (lambda size: checks.to_array("size")(size), (None, "a", {}, 1j, jax.random.key(0))),
    "positive array": (
        checks.check_positive_array,
        (jnp.zeros(2), jnp.array([]), jnp.array([1.0, jnp.nan]), jnp.array(jnp.inf)),
    ),
    "finite array": (checks.check_finite_array, (jnp.array([1.0, jnp.inf]), jnp.zeros((0, 2)))),
    "key": (
        lambda size: checks.check_key(size, "size"),
        (0, None, [1, 2], jax.random.PRNGKey(0), jax.random.split(jax.random.key(0))),
    ),
    "keys": (
        lambda size: checks.check_key(size, "size", batch=True),
        (0, None, jax.random.key(0), jax.random.split(jax.random.key(0), (2, 2))),
    ),
}
ACCEPTED = {
    "whole": (2, 3, np.int64(5)),
    "positive": (1, 0.5, np.float32(2.0)),
    "not negative": (0, 1.5),
    "finite": (-1.5, 0),
    "share": (0, 0.5, np.float64(0.25)),
    "inner share": (0.5, np.float32(0.1)),
    "shape": (np.ones((2, 4)), jnp.zeros((0, 4)), jax.ShapeDtypeStruct((3, 4), jnp.float32)),
    "rows": ([], [1.0, 2.0], [[1.0, 2.0]], np.zeros((3, 2))),
    "one of": ("up",),
    "flag": (True, False, np.bool_(True)),
    "callable": (len, lambda: None),
    "type": ({},),
    "array": (1, [1.0, 2.0], np.arange(3), True),
    "positive array": (jnp.ones(2), np.ones(3)),
    "finite array": (jnp.array([-1.0]),),
    "key": (jax.random.key(0),),
    "keys": (jax.random.split(jax.random.key(0), 1),),
}


@pytest.mark.parametrize(
    ("kind", "value"), [(kind, value) for kind, (_, values) in REFUSED.items() for value in values]
)
def test_what_will_not_do_is_named(kind, value):
    with pytest.raises(ValueError, match=r"^size: "):
        REFUSED[kind][0](size=value)


@pytest.mark.parametrize(
    ("kind", "value"), [(kind, value) for kind, values in ACCEPTED.items() for value in values]
)
def test_what_will_do_passes(kind, value):
    REFUSED[kind][0](size=value)


def test_what_is_not_given_is_not_checked():
    assert checks.given(size=None, other=0) == {"other": 0}


def test_whole_numbers_become_floating_point():
    assert checks.to_array("size")([1, 2]).dtype == jnp.float32
    assert checks.to_array("size", floating=False)([1, 2]).dtype == jnp.int32


def test_shapes_may_leave_axes_open():
    checks.check_shape("... 2", one=np.ones(2), two=np.ones((5, 3, 2)))
    checks.check_shape("", one=jnp.array(1.0))
    jax.jit(lambda value: checks.check_shape("n", size=value))(jnp.ones(3))
    with pytest.raises(ValueError, match=r"^size: shape \(3,\) is not \(..., 2\)"):
        checks.check_shape("... 2", size=np.ones(3))


def test_rows_are_copied_into_one_form():
    assert checks.to_rows(2, "size", []).shape == (0, 2)
    assert checks.to_rows(2, "size", [1, 2]).tolist() == [[1.0, 2.0]]


def test_traced_values_pass():
    jax.jit(lambda value: checks.check_positive_array(size=value))(jnp.array(-1.0))
