"""Standard errors are the exact ones in any units, and say how well the seeds settle them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.tuning import standard_errors
from tests.marking import exactness
from tests.user_models import ScalarLinear

TRUTH = {"a": 0.8, "q": 0.6, "h": 1.0, "r": 0.5, "m": 0.5, "p": 0.3}
# The units of these numbers for states in thousands, and observations in thousandths.
UNITS = {"a": 1.0, "q": 1e3, "h": 1e-6, "r": 1e-3, "m": 1e3, "p": 1e3}
MODEL = ScalarLinear(**TRUTH)
OBSERVATIONS = mpfjax.simulate(jax.random.key(1), MODEL.in_matrices(), 40)[1][:, 0]


def picked(names):
    return {name: lambda filter, name=name: getattr(filter.model, name) for name in names}


def exact_errors(names):
    """Of the Kalman filter's likelihood, in units of one."""

    def log_evidence(values):
        numbers = TRUTH | dict(zip(names, values, strict=True))
        model = ScalarLinear(**numbers).in_matrices()
        return kalman_filter(model, OBSERVATIONS[:, None]).log_marginal_likelihood

    information = -jax.hessian(log_evidence)(jnp.array([TRUTH[name] for name in names]))
    assert np.linalg.eigvalsh(information)[0] > 0
    return np.sqrt(np.diag(np.linalg.inv(information)))


@pytest.mark.weekly
def test_numbers_of_very_different_units_have_their_exact_errors():
    """Standard errors from 1e-4 to 1e3, none of them by a transform."""
    names, model = ("a", "m", "r"), ScalarLinear(**{n: TRUTH[n] * UNITS[n] for n in TRUTH})
    found = standard_errors(
        jax.random.key(0), mpfjax.particle_filter(model, 200, gradient="stop"),
        1e-3 * OBSERVATIONS, parameters=picked(names), num_seeds=128,
    )  # fmt: skip
    ratios = np.array([found[name] / UNITS[name] for name in names]) / exact_errors(names)
    np.testing.assert_allclose(ratios, 1.0, atol=0.2)


@pytest.mark.exactness
def test_a_step_is_no_shorter_than_what_rounding_leaves():
    """A level of 1e4 standard deviations, in which a float has three digits left."""
    level = 1e4
    model = ScalarLinear(a=1.0, q=0.01, h=1.0, r=0.5, m=level, p=0.01)
    rows = jnp.asarray(level + 0.5 * np.random.default_rng(0).normal(size=40), jnp.float32)
    found = standard_errors(
        jax.random.key(0), mpfjax.particle_filter(model, 100, gradient="stop"), rows,
        parameters=picked("m"), num_seeds=32,
    )  # fmt: skip

    def log_evidence(m):
        # Of what lies above the level, for the sake of single precision.
        model = ScalarLinear(a=1.0, q=0.01, h=1.0, r=0.5, m=m, p=0.01).in_matrices()
        return kalman_filter(model, rows[:, None] - level).log_marginal_likelihood

    exact = float(-jax.hessian(log_evidence)(jnp.zeros(()))) ** -0.5
    assert found["m"] == pytest.approx(exact, rel=0.1)


@pytest.mark.parametrize("num_seeds", [1, *exactness([6])])
def test_too_few_seeds_are_said_to_be_too_few(num_seeds):
    """Eight particles and six seeds leave a quarter of them open; one seed tells nothing."""
    filter, options = mpfjax.particle_filter(MODEL, 8, gradient="stop"), {"num_seeds": num_seeds}
    with pytest.warns(UserWarning, match="the seeds leave them uncertain.*num_seeds"):
        standard_errors(jax.random.key(5), filter, OBSERVATIONS, parameters=picked("r"), **options)
