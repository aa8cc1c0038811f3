"""Arguments of the metrics that will not do are errors that name them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import metrics
from mpfjax.metrics.tracking_scores import remove_ignored
from tests.examples import make_mixture
from tests.refused import assert_named, refused

ROWS = np.array([[1.0, 1, 2, 2, 5, 5], [2, 1, 2, 2, 5, 5]])
MIXTURE = make_mixture([0.1, 0.9], [0.0, 1.0], [0, 0], 1)
SETS = {"estimates": jnp.ones((2, 2)), "truths": jnp.ones((3, 2)), "cutoff": 3.0}
OF_SETS = {"estimates": "array", "truths": "array", "cutoff": "positive", "order": "positive",
           "estimate_mask": "array?", "truth_mask": "array?", "base_distance": "kind"}  # fmt: skip
IN_A_PLANE = MIXTURE.replace(particles=jnp.ones((2, 2)))
MODES = {
    "positions": jnp.ones(5),
    "occupied": jnp.ones(5, bool),
    "modes": jnp.ones(2),
    "radius": 0.3,
}

TABLE = {
    "modes_represented": (
        metrics.modes_represented,
        MODES,
        {"positions": "array", "occupied": "array", "modes": "array", "radius": "positive"},
    ),
    "mass_above": (
        metrics.mass_above,
        {"mixture": MIXTURE, "threshold": 0.5},
        {"mixture": "kind"},
    ),
    "crps": (
        metrics.crps,
        {"values": jnp.ones(5), "weights": jnp.ones(5), "observations": jnp.ones(())},
        {"values": "array", "weights": "array", "observations": "array"},
    ),
    "log_score": (
        metrics.log_score,
        {
            "model": mpfjax.QuadraticModel(),
            "mixture": MIXTURE.replace(particles=jnp.ones(2)),
            "observation": 1.0,
        },
        {"model": "kind", "mixture": "kind"},
    ),
    "ospa": (metrics.ospa, SETS, OF_SETS),
    "gospa": (metrics.gospa, SETS, OF_SETS | {"alpha": "positive"}),
    "tracking_quality": (
        metrics.tracking_quality,
        {"estimates": jnp.ones((2, 3, 1, 4)), "truth": jnp.ones((3, 1, 4))},
        {"estimates": "array", "truth": "array", "num_last": "count"},
    ),
    "multi_object_scores": (
        metrics.multi_object_scores,
        {"tracks": ROWS, "truth": ROWS, "frames": (1, 2)},
        {"tracks": "rows", "truth": "rows", "ignored": "rows?", "min_height": "not negative"},
    ),
    "remove_ignored": (
        remove_ignored,
        {"tracks": ROWS, "truth": ROWS, "ignored": ROWS},
        {"tracks": "rows", "truth": "rows", "ignored": "rows", "min_height": "not negative"},
    ),
    "uniqueness": (metrics.uniqueness, {"mixture": MIXTURE}, {"mixture": "kind"}),
}


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(("function", "good", "name", "value"), refused(TABLE))
def test_what_will_not_do_is_named(function, good, name, value):
    assert_named(function, good, name, value)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("function", "good", "name", "value"),
    [
        (metrics.ospa, SETS, "estimate_mask", jnp.ones(3, bool)),
        (metrics.ospa, SETS, "truth_mask", jnp.ones(3)),
        (metrics.gospa, SETS, "alpha", 2.5),
        (metrics.gospa, SETS, "order", 0.5),
        (metrics.modes_represented, MODES, "occupied", jnp.ones(4, bool)),
        (metrics.modes_represented, MODES, "modes", jnp.ones((2, 2))),
        (metrics.tracking_quality, TABLE["tracking_quality"][1], "truth", jnp.ones((2, 1, 4))),
        (metrics.mass_above, {"threshold": 0.0}, "mixture", IN_A_PLANE),
        (metrics.uniqueness, {}, "mixture", MIXTURE),
        (metrics.multi_object_scores, {"tracks": ROWS, "truth": ROWS}, "frames", (3, 2)),
    ],
)  # fmt: skip
def test_what_does_not_go_with_the_rest_is_named(function, good, name, value):
    assert_named(function, good, name, value)


@pytest.mark.usefixtures("as_installed")
def test_traced_numbers_pass():
    """A radius or a threshold may be an argument of the caller's program."""
    assert jax.jit(lambda radius: metrics.modes_represented(**MODES | {"radius": radius}))(
        0.3
    ).all()
    above = jax.jit(lambda threshold: metrics.mass_above(MIXTURE, threshold))(0.5)
    np.testing.assert_allclose(above, metrics.mass_above(MIXTURE, 0.5), rtol=1e-6)
