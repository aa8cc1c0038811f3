"""What arguments of each kind may not be, for tests of one wrong argument at a time."""

import numpy as np
import pytest

NAN, INFINITY = float("nan"), float("inf")
NOTHING = (None, "x", object(), int)
NO_NUMBERS = (*NOTHING, [1, 2], np.zeros(0), np.zeros((0, 4)))

REFUSED = {
    "count": (*NO_NUMBERS, 0, -1, 2.5, 2.0, NAN, INFINITY, True),
    "number": (*NO_NUMBERS, -1, 2.5, 2.0, NAN, INFINITY, True),
    "positive": (*NO_NUMBERS, 0, -1.0, NAN, INFINITY, True),
    "scalar": (*NO_NUMBERS, 0, -1.0, NAN, INFINITY),
    "not negative": (*NO_NUMBERS, -1.0, NAN, INFINITY, True),
    "finite": (*NO_NUMBERS, NAN, INFINITY, True),
    "share": (*NO_NUMBERS, -0.1, 1.1, NAN, INFINITY, True),
    "inner share": (*NO_NUMBERS, -0.1, 0, 1, NAN, INFINITY, True),
    "flag": (*NO_NUMBERS, 0, 1.0, NAN),
    "key": (*NO_NUMBERS, 0, 2.5, NAN, np.zeros(2, np.uint32)),
    "kind": (*NO_NUMBERS, 0, 2.5, NAN, True),
    "path": (None, 3, NAN, True, [1, 2], object(), int, b"bytes"),
    "array": (*NOTHING, [1, 2], 2.5, NAN, True),
    "rows": (*NOTHING, [1, 2], 2.5, NAN, True, np.full((2, 6), np.nan)[:, :3], [[None] * 6]),
    "four": (*NO_NUMBERS, 2.5, NAN, [1, 2, 3, NAN], [1, 1, 1, 0.0], [1, 1, 1, INFINITY]),
    "range": (*NOTHING, 2.5, NAN, [1], [3, 2], [NAN, 1], [0.1, INFINITY], [1, 2, 3], np.zeros(0)),
}
OPTIONAL = {f"{kind}?": [v for v in REFUSED[kind] if v is not None] for kind in REFUSED}


def refused(table):
    """(function, its good arguments, a name, a value that will not do), one argument at a time.

    `table`: by name, a function, its good arguments, and the kinds of those that are checked.
    """
    return [
        pytest.param(function, good, name, value, id=f"{title}-{name}-{i}")
        for title, (function, good, kinds) in table.items()
        for name, kind in kinds.items()
        for i, value in enumerate((REFUSED | OPTIONAL)[kind])
    ]


def assert_named(function, good, name, value):
    """A good call with one argument that will not do is an error that begins with its name."""
    with pytest.raises(ValueError, match=rf"^{name}: "):
        function(**good | {name: value})
