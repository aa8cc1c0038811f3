"""The references themselves, against computations that share nothing with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax import Series
from mpfjax.exact import grid_filter, kalman_filter, kalman_smoother
from tests import switching
from tests.marking import thorough
from tests.user_models import ScalarLinear

OBSERVATIONS = np.array([[0.4, -0.2], [1.0, 0.3], [0.1, 0.8]])
MODEL = {
    "A": np.array([[1.0, 0.5], [-0.2, 0.9]]),
    "Q": np.array([[0.3, 0.1], [0.1, 0.2]]),
    "H": np.array([[1.0, 0.0], [0.5, 1.0]]),
    "R": np.array([[0.3, 0.1], [0.1, 0.4]]),
    "m0": np.array([0.5, -1.0]),
    "P0": np.array([[1.0, 0.2], [0.2, 0.5]]),
}
SCALAR = {"A": [[0.8]], "Q": [[0.2]], "H": [[1.5]], "R": [[0.3]], "m0": [0.4], "P0": [[0.6]]}


def joint_gaussian(A, Q, H, R, m0, P0, length, with_first=False):
    """Mean and covariance of (x_1..x_T, y_1..y_T), from the definition of the model.

    `with_first` has x_0 before them.
    """
    A, Q, H, R, m0, P0 = (np.asarray(part, float) for part in (A, Q, H, R, m0, P0))
    d, p = len(m0), len(H)
    # (x_0, w_1..w_T, v_1..v_T), independent, to (x_1..x_T, y_1..y_T).
    source = scipy.linalg.block_diag(P0, *[Q] * length, *[R] * length)
    matrix = np.zeros((length * (d + p), len(source)))
    for t in range(length):
        rows = slice(t * d, (t + 1) * d)
        for s in range(t + 2):
            matrix[rows, s * d : (s + 1) * d] = np.linalg.matrix_power(A, t + 1 - s if s else t + 1)
        seen = slice(length * d + t * p, length * d + (t + 1) * p)
        matrix[seen] = H @ matrix[rows]
        noise = d * (length + 1) + t * p
        matrix[seen, noise : noise + p] = np.eye(p)
    if with_first:
        matrix = np.concatenate([np.eye(d, len(source)), matrix])
    mean = matrix[:, :d] @ m0
    return mean, matrix @ source @ matrix.T


@pytest.mark.parametrize("parts", [MODEL, SCALAR], ids=["2d", "1d"])
def test_kalman_filter_conditions_the_joint_gaussian(parts):
    d, p = len(parts["m0"]), len(parts["H"])
    observations = OBSERVATIONS[:, :p]
    run = kalman_filter(mpfjax.LinearGaussianModel(**parts), jnp.asarray(observations))
    mean, covariance = joint_gaussian(**parts, length=3)
    seen = mean[3 * d :], covariance[3 * d :, 3 * d :]
    expected = scipy.stats.multivariate_normal(*seen).logpdf(observations.ravel())
    np.testing.assert_allclose(run.log_marginal_likelihood, expected, rtol=1e-4)
    np.testing.assert_allclose(run.log_likelihood_increments.sum(), expected, rtol=1e-4)
    for t in range(3):
        x, y = slice(t * d, (t + 1) * d), slice(3 * d, 3 * d + (t + 1) * p)
        gain = covariance[x, y] @ np.linalg.inv(covariance[y, y])
        residual = observations.ravel()[: (t + 1) * p] - mean[y]
        np.testing.assert_allclose(run.means[t], mean[x] + gain @ residual, rtol=1e-3, atol=1e-4)
        posterior = covariance[x, x] - gain @ covariance[y, x]
        np.testing.assert_allclose(run.covariances[t], posterior, rtol=1e-3, atol=1e-4)


NAN = np.nan
GAPS = np.array([[0.4, NAN], [NAN, NAN], [0.1, 0.8], [NAN, -0.5]])


@pytest.mark.parametrize(
    ("parts", "observations"),
    [(MODEL, GAPS), *thorough([(MODEL, OBSERVATIONS), (SCALAR, GAPS[:, :1]), (MODEL, GAPS[1:2])])],
)
def test_kalman_smoother_conditions_the_joint_gaussian(parts, observations):
    """Whatever is missing: means, covariances, those of neighbours, and the evidence."""
    d, length = len(parts["m0"]), len(observations)
    model, seen = mpfjax.LinearGaussianModel(**parts), jnp.asarray(observations)
    run = kalman_smoother(model, Series.skipping(seen))
    filtered = kalman_filter(model, Series.skipping(seen))
    mean, covariance = joint_gaussian(**parts, length=length, with_first=True)
    states, seen = d * (length + 1), np.flatnonzero(~np.isnan(observations.ravel()))
    y = states + seen
    gain = covariance[:states, y] @ np.linalg.inv(covariance[np.ix_(y, y)])
    residual = observations.ravel()[seen] - mean[y]
    means = (mean[:states] + gain @ residual).reshape(-1, d)
    joint = covariance[:states, :states] - gain @ covariance[y, :states]
    blocks = joint.reshape(length + 1, d, length + 1, d)
    np.testing.assert_allclose(run.means, means, rtol=1e-3, atol=1e-4)
    for s in range(length + 1):
        np.testing.assert_allclose(run.covariances[s], blocks[s, :, s], rtol=1e-3, atol=1e-4)
    for s in range(length):
        lagged = run.lagged_covariances[s]
        np.testing.assert_allclose(lagged, blocks[s + 1, :, s], rtol=1e-3, atol=1e-4)
    evidence = 0.0
    if len(seen):
        evidence = scipy.stats.multivariate_normal(mean[y], covariance[np.ix_(y, y)]).logpdf(
            observations.ravel()[seen]
        )
    np.testing.assert_allclose(run.log_marginal_likelihood, evidence, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(filtered.log_marginal_likelihood, evidence, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(filtered.means[-1], means[-1], rtol=1e-3, atol=1e-4)


ROTATED = np.array([[0.8, -0.6], [0.6, 0.8]])
WALK = np.array([[1.0, 0.5], [0.0, 0.9]])


@pytest.mark.parametrize("rotation", [np.eye(2), ROTATED])
@pytest.mark.parametrize(
    ("Q", "P0"),
    [
        (np.diag([0.0, 0.3]), np.zeros((2, 2))),
        *thorough([(np.zeros((2, 2)), np.diag([0.0, 4.0])), (np.zeros((2, 2)), np.zeros((2, 2)))]),
    ],
)
def test_what_is_known_for_sure_has_no_nan(rotation, Q, P0):
    """x_0 that is known, and a speed alone that is pushed, in any coordinates."""

    def turned(matrix):
        return rotation @ matrix @ rotation.T

    parts = {
        "A": turned(WALK), "Q": turned(Q), "H": np.array([[1.0, 0.0]]) @ rotation.T,
        "R": [[0.2]], "m0": rotation @ [0.1, 0.2], "P0": turned(P0),
    }  # fmt: skip
    y = OBSERVATIONS[:, :1]
    model = mpfjax.LinearGaussianModel(**parts)
    run = kalman_smoother(model, jnp.asarray(y))
    drawn = mpfjax.run_filter(jax.random.key(0), mpfjax.particle_filter(model, 4000), y)
    assert abs(drawn.log_marginal_likelihood - run.log_marginal_likelihood) < 0.1
    mean, covariance = joint_gaussian(**parts, length=3, with_first=True)
    gain = covariance[:8, 8:] @ np.linalg.inv(covariance[8:, 8:])
    means = mean[:8] + gain @ (y[:, 0] - mean[8:])
    blocks = (covariance[:8, :8] - gain @ covariance[8:, :8]).reshape(4, 2, 4, 2)
    np.testing.assert_allclose(run.means.ravel(), means, rtol=1e-3, atol=1e-4)
    for s in range(4):
        np.testing.assert_allclose(run.covariances[s], blocks[s, :, s], rtol=1e-3, atol=1e-4)
    for s in range(3):
        lagged = run.lagged_covariances[s]
        np.testing.assert_allclose(lagged, blocks[s + 1, :, s], rtol=1e-3, atol=1e-4)


@pytest.mark.thorough
def test_kalman_smoother_of_several_series_at_once_and_its_derivative():
    model, batch = mpfjax.LinearGaussianModel(**MODEL), np.stack([OBSERVATIONS, -OBSERVATIONS])
    together = jax.vmap(lambda rows: kalman_smoother(model, rows))(jnp.asarray(batch))
    for one, rows in enumerate(batch):
        alone = kalman_smoother(model, jnp.asarray(rows)).means
        np.testing.assert_allclose(together.means[one], alone, rtol=1e-5, atol=1e-6)

    def first(rows):
        return kalman_smoother(model, Series.skipping(rows)).means[0, 0]

    slope = jax.jit(jax.grad(first))(jnp.asarray(GAPS))
    assert np.isfinite(slope).all()
    step = 0.1 * np.eye(8)[4].reshape(4, 2)
    expected = (first(jnp.asarray(GAPS + step)) - first(jnp.asarray(GAPS - step))) / 0.2
    np.testing.assert_allclose(slope[2, 0], expected, rtol=1e-3)


def test_grid_filter_agrees_with_the_kalman_filter():
    model = mpfjax.LinearGaussianModel(**SCALAR)
    observations = jnp.asarray(OBSERVATIONS[:, :1])
    grid = jnp.linspace(-8.0, 8.0, 1601)
    log_initial = jnp.asarray(scipy.stats.norm(0.4, np.sqrt(0.6)).logpdf(grid), jnp.float32)
    run = grid_filter(model, observations, grid, log_initial, state_shape=(1,))
    exact = kalman_filter(model, observations)
    increments = exact.log_likelihood_increments
    np.testing.assert_allclose(run.log_likelihood_increments, increments, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(run.means, exact.means[:, 0], atol=1e-3)
    np.testing.assert_allclose(run.variances, exact.covariances[:, 0, 0], atol=1e-3)
    expected = scipy.stats.norm(exact.means[:, 0], np.sqrt(exact.covariances[:, 0, 0])).sf(0.3)
    np.testing.assert_allclose(run.mass_above(0.3), expected, atol=1e-3)


def on_a_grid(parts, observations, grid, **options):
    """The grid filter of a scalar linear-Gaussian model."""
    law = scipy.stats.norm(parts["m0"][0], np.sqrt(parts["P0"][0][0]))
    log_initial = jnp.asarray(law.logpdf(np.asarray(grid, float)), jnp.float32)
    model = mpfjax.LinearGaussianModel(**parts)
    return grid_filter(model, observations, grid, log_initial, state_shape=(1,), **options)


@pytest.mark.parametrize("num_points", [201, *thorough([1001]), 3001])
def test_a_finer_grid_is_no_worse(num_points):
    """Neighbouring points differ by a rounded number, which would count t times."""
    seen = jnp.asarray(np.random.default_rng(0).normal(0.0, 1.2, (30, 1)), jnp.float32)
    run = on_a_grid(SCALAR, seen, jnp.linspace(-8.0, 8.0, num_points))
    exact = kalman_filter(mpfjax.LinearGaussianModel(**SCALAR), seen)
    assert abs(run.log_marginal_likelihood - exact.log_marginal_likelihood) < 5e-5
    np.testing.assert_allclose(run.means, exact.means[:, 0], atol=1e-5)


@pytest.mark.parametrize("ends", [[298.5, 301.5], *thorough([[298.3, 301.9]])])
def test_far_from_zero_the_moments_are_as_good(ends):
    parts = SCALAR | {"A": [[1.0]], "H": [[1.0]], "Q": [[0.01]], "R": [[0.02]]}
    parts |= {"m0": [300.0], "P0": [[0.05]]}
    seen = jnp.asarray([[300.1], [299.8], [299.9]], jnp.float32)
    run = on_a_grid(parts, seen, jnp.linspace(*ends, 1601))
    exact = kalman_filter(mpfjax.LinearGaussianModel(**parts), seen)
    np.testing.assert_allclose(run.variances, exact.covariances[:, 0, 0], rtol=2e-3)
    np.testing.assert_allclose(run.means, exact.means[:, 0], atol=1e-4)
    np.testing.assert_allclose(run.mass_above(300.0), scipy.stats.norm.sf(
        300.0, exact.means[:, 0], np.sqrt(exact.covariances[:, 0, 0])
    ), atol=2e-3)  # fmt: skip
    increments = exact.log_likelihood_increments
    np.testing.assert_allclose(run.log_likelihood_increments, increments, atol=1e-3)


def test_a_missing_observation_is_skipped_on_a_grid_too():
    seen, grid = jnp.asarray([[0.4], [NAN], [0.1], [1.0]]), jnp.linspace(-6.0, 6.0, 301)
    run = on_a_grid(SCALAR, Series.skipping(seen), grid)
    exact = kalman_filter(mpfjax.LinearGaussianModel(**SCALAR), Series.skipping(seen))
    increments = exact.log_likelihood_increments
    np.testing.assert_allclose(run.log_likelihood_increments, increments, atol=1e-5)
    np.testing.assert_allclose(run.variances, exact.covariances[:, 0, 0], atol=1e-5)
    with pytest.raises(ValueError, match="observations: NaN or infinite at index 1"):
        on_a_grid(SCALAR, seen, grid)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    "grid",
    [
        np.linspace(5.0, -5.0, 101), np.geomspace(0.01, 5.0, 101), np.zeros(9),
        np.append(np.linspace(-5.0, 5.0, 101), 5.05), np.array([0.0, np.inf]),
    ],
)  # fmt: skip
def test_a_grid_that_is_not_even_is_refused(grid):
    with pytest.raises(ValueError, match="grid: "):
        on_a_grid(SCALAR, jnp.zeros((2, 1)), grid)


def test_grid_filter_agrees_with_quadrature_on_the_quadratic_model():
    """Two steps of eqs. 1 and 2 by sums in numpy, in double precision."""
    grid = np.linspace(-5, 5, 2001)
    cell, normal = grid[1] - grid[0], scipy.stats.norm.pdf
    density = np.where(np.abs(grid) <= 2, 0.25, 0.0)
    density /= density.sum() * cell
    log_evidence = 0.0
    for y in (1.2, 0.7):
        predicted = normal(grid[:, None], grid[None], 0.3) @ density * cell
        joint = predicted * normal(y, grid**2, 0.5)
        evidence = joint.sum() * cell
        density, log_evidence = joint / evidence, log_evidence + np.log(evidence)
    model = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
    run = grid_filter(model, jnp.array([1.2, 0.7]), jnp.asarray(grid))
    np.testing.assert_allclose(run.log_marginal_likelihood, log_evidence, rtol=1e-4)
    np.testing.assert_allclose(run.probabilities[-1] / cell, density, atol=1e-3)


def test_the_modes_of_the_quadratic_model_have_equal_mass():
    model = mpfjax.QuadraticModel(0.1, 0.1)
    observations = (2 * jnp.sin(jnp.arange(1.0, 30.0) / 8)) ** 2
    run = grid_filter(model, observations, jnp.linspace(-4.0, 4.0, 801))
    np.testing.assert_allclose(run.mass_above(0.0), 0.5, atol=1e-4)


def test_both_are_differentiable():
    def by_kalman(variance):
        parts = {name: jnp.asarray(part) for name, part in SCALAR.items()}
        model = mpfjax.LinearGaussianModel(**(parts | {"R": variance.reshape(1, 1)}))
        return kalman_filter(model, jnp.asarray(OBSERVATIONS[:, :1])).log_marginal_likelihood

    step = 1e-2
    slope = (by_kalman(jnp.array(0.3 + step)) - by_kalman(jnp.array(0.3 - step))) / (2 * step)
    np.testing.assert_allclose(jax.grad(by_kalman)(jnp.array(0.3)), slope, rtol=1e-2)

    def by_grid(sigma):
        model = mpfjax.QuadraticModel(0.3, sigma, -2.0, 2.0)
        grid = jnp.linspace(-4.0, 4.0, 401)
        return grid_filter(model, jnp.array([1.2, 0.7]), grid).log_marginal_likelihood

    slope = (by_grid(jnp.array(0.5 + step)) - by_grid(jnp.array(0.5 - step))) / (2 * step)
    np.testing.assert_allclose(jax.grad(by_grid)(jnp.array(0.5)), slope, rtol=1e-2)


@pytest.mark.usefixtures("as_installed")
def test_bad_input_is_named():
    model = mpfjax.LinearGaussianModel(**MODEL)
    with pytest.raises(ValueError, match=r"observations: shape \(3, 1\) is not \(t, 2\)"):
        kalman_filter(model, jnp.zeros((3, 1)))
    for exact in (kalman_filter, kalman_smoother):
        with pytest.raises(ValueError, match="observations: NaN or infinite at index 1"):
            exact(model, GAPS[[2, 1]])
        with pytest.raises(ValueError, match="observations: infinite at index 0"):
            exact(model, Series.skipping(np.full((1, 2), np.inf)))
        with pytest.raises(ValueError, match=r"model: QuadraticModel.* is not a LinearGaussian"):
            exact(mpfjax.QuadraticModel(), GAPS)
    with pytest.raises(ValueError, match="grid: shape"):
        grid_filter(mpfjax.QuadraticModel(), jnp.zeros(2), jnp.zeros(1))
    with pytest.raises(ValueError, match=r"log_initial: shape \(8,\) is not \(9\)"):
        grid_filter(ScalarLinear(), jnp.zeros(2), jnp.linspace(-1.0, 1.0, 9), jnp.zeros(8))
    with pytest.raises(ValueError, match=r"Switching.* conditionally linear, and grid_filter"):
        grid_filter(switching.MODEL, jnp.zeros((2, 1)), jnp.linspace(-1.0, 1.0, 9))
    with pytest.raises(ValueError, match="model: ScalarLinear defines no log_initial"):
        grid_filter(ScalarLinear(), jnp.zeros(2), jnp.linspace(-1.0, 1.0, 9))
