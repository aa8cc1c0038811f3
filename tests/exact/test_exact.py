"""The references themselves, against computations that share nothing with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax import Series
from mpfjax.exact import grid_filter, kalman_filter, kalman_smoother
from tests.precision import float64

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


def joint_gaussian(m0, P0, steps):
    """Mean and covariance of (x_0..x_T, y_1..y_T), of a model with its own parts at each step."""
    # All of them as sums of the independent x_0, w_1..w_T, v_1..v_T.
    sources = [P0, *(step["Q"] for step in steps), *(step["R"] for step in steps)]
    ends = np.cumsum([len(source) for source in sources])
    first, *noises = np.split(np.eye(ends[-1]), ends[:-1])
    states, means, seen, seen_means = [first], [np.asarray(m0)], [], []
    for t, step in enumerate(steps):
        states.append(step["A"] @ states[-1] + noises[t])
        means.append(step["A"] @ means[-1] + step.get("b", 0.0))
        seen.append(step["H"] @ states[-1] + noises[len(steps) + t])
        seen_means.append(step["H"] @ means[-1])
    matrix = np.concatenate(states + seen)
    covariance = matrix @ scipy.linalg.block_diag(*sources) @ matrix.T
    return np.concatenate(means + seen_means), covariance


NAN = np.nan
GAPS = np.array([[0.4, NAN], [NAN, NAN], [0.1, 0.8], [NAN, -0.5]])
FIRST_ALONE = np.array([[0.4, NAN], [1.0, NAN], [0.1, NAN], [0.3, NAN]])
ROTATION = np.array([[0.8, -0.6], [0.6, 0.8]])


def turned(matrix):
    return ROTATION @ np.asarray(matrix, float) @ ROTATION.T


# x_0 that is known, and a speed alone that is pushed; or nothing that is.
SURE = MODEL | {"A": turned([[1.0, 0.5], [0.0, 0.9]]), "P0": np.zeros((2, 2))}
PUSHED, STILL = SURE | {"Q": turned(np.diag([0.0, 0.3]))}, SURE | {"Q": np.zeros((2, 2))}


@pytest.mark.parametrize(
    ("parts", "observations"),
    [
        (MODEL, np.concatenate([OBSERVATIONS, [[0.2, -0.4]]])), (MODEL, GAPS),
        (PUSHED, FIRST_ALONE), (STILL, FIRST_ALONE),
    ],
)  # fmt: skip
def test_kalman_filter_and_smoother_condition_the_joint_gaussian(parts, observations):
    """Whatever is missing or known for sure: moments and the evidence."""
    model, length = mpfjax.LinearGaussianModel(**parts), len(observations)
    run = kalman_smoother(model, Series.skipping(observations))
    filtered = kalman_filter(model, Series.skipping(observations))
    mean, covariance = joint_gaussian(parts["m0"], parts["P0"], [parts] * length)
    states, y = 2 * (length + 1), observations.ravel()
    evidence = [0.0]
    for t in range(1, length + 1):
        seen = np.flatnonzero(~np.isnan(y[: 2 * t]))
        rows = states + seen
        gain = covariance[:states, rows] @ np.linalg.inv(covariance[np.ix_(rows, rows)])
        means = (mean[:states] + gain @ (y[seen] - mean[rows])).reshape(-1, 2)
        joint = covariance[:states, :states] - gain @ covariance[rows, :states]
        blocks = joint.reshape(length + 1, 2, length + 1, 2).swapaxes(1, 2)
        np.testing.assert_allclose(filtered.means[t - 1], means[t], rtol=1e-3, atol=1e-4)
        found = filtered.covariances[t - 1]
        np.testing.assert_allclose(found, blocks[t, t], rtol=1e-3, atol=1e-4)
        of_seen = scipy.stats.multivariate_normal(mean[rows], covariance[np.ix_(rows, rows)])
        evidence.append(of_seen.logpdf(y[seen]))
    increments = filtered.log_likelihood_increments
    np.testing.assert_allclose(increments, np.diff(evidence), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(run.log_marginal_likelihood, evidence[-1], rtol=1e-4)
    np.testing.assert_allclose(run.means, means, rtol=1e-3, atol=1e-4)
    time = np.arange(length + 1)
    np.testing.assert_allclose(run.covariances, blocks[time, time], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("reference", [kalman_filter, kalman_smoother])
def test_a_missing_number_is_no_error_to_jax_debug_nans(reference):
    model = mpfjax.LinearGaussianModel(**MODEL)
    plain = reference(model, Series.skipping(GAPS))
    with jax.debug_nans(True):
        debugged = reference(model, Series.skipping(GAPS))
    assert debugged.log_marginal_likelihood == plain.log_marginal_likelihood


@pytest.mark.exactness
def test_kalman_smoother_of_several_series_at_once_and_its_derivative():
    model, gaps = mpfjax.LinearGaussianModel(**MODEL), jnp.asarray(GAPS)

    def means(rows):
        return kalman_smoother(model, Series.skipping(rows)).means

    together = jax.vmap(means)(jnp.stack([gaps, -gaps]))
    np.testing.assert_allclose(together[1], means(-gaps), rtol=1e-5, atol=1e-6)
    slope = jax.grad(lambda rows: means(rows)[0, 0])(gaps)
    assert np.isfinite(slope).all()
    step = 0.1 * np.eye(8)[4].reshape(4, 2)
    expected = (means(gaps + step)[0, 0] - means(gaps - step)[0, 0]) / 0.2
    np.testing.assert_allclose(slope[2, 0], expected, rtol=1e-3)


# Of a constant velocity: as it stands, and in coordinates that both are seen.
SPEED = {"A": [[1.0, 1.0], [0.0, 1.0]], "Q": [[0.0025, 0.005], [0.005, 0.01]], "H": [[1.0, 0.0]]}
MIXED = np.array([[-1.25, -0.25], [-1.25, 0.25]])
SPEEDS = {
    "axes": SPEED,
    "mixed": {
        "A": MIXED @ SPEED["A"] @ np.linalg.inv(MIXED), "H": SPEED["H"] @ np.linalg.inv(MIXED),
        "Q": MIXED @ SPEED["Q"] @ MIXED.T + 1e-6 * np.eye(2),
    },
}  # fmt: skip


@pytest.mark.exactness
@pytest.mark.parametrize("ratio", [1e8, 1e13])
@pytest.mark.parametrize("name", SPEEDS)
def test_a_diffuse_prior_leaves_the_kalman_filter_and_smoother_exact(name, ratio):
    """R = 1e-4, and all that is known of x_0 comes from y: in float32, up to P_0 / R = 1e13.

    The answers are those of float64, which has the digits.
    """
    diffuse = {"R": [[1e-4]], "m0": np.zeros(2), "P0": 1e-4 * ratio * np.eye(2)}
    parts, seen = SPEEDS[name] | diffuse, [[3.01], [4.52], [6.03], [7.41], [8.96], [10.53]]
    parts = {k: np.asarray(part, np.float32).astype(float) for k, part in parts.items()}

    def answers():
        def log_evidence(R):
            model = mpfjax.LinearGaussianModel(**(parts | {"R": R}))
            return kalman_smoother(model, np.float32(seen)).log_marginal_likelihood

        model = mpfjax.LinearGaussianModel(**parts)
        runs = kalman_smoother(model, np.float32(seen)), kalman_filter(model, np.float32(seen))
        return *runs, jax.grad(log_evidence)(jnp.asarray(parts["R"]))

    run, filtered, slope = answers()
    with float64():
        exact, _, exact_slope = answers()
    deviations = np.sqrt(np.diagonal(exact.covariances, axis1=1, axis2=2))
    scale = deviations[:, :, None] * deviations[:, None]
    for found in (run, filtered):
        evidence = exact.log_marginal_likelihood
        np.testing.assert_allclose(found.log_marginal_likelihood, evidence, atol=0.01)
    gaps = run.means - np.asarray(exact.means)
    np.testing.assert_allclose(gaps / deviations, 0.0, atol=0.02)
    gaps = run.covariances - np.asarray(exact.covariances)
    np.testing.assert_allclose(gaps / scale, 0.0, atol=1e-3)
    gaps = filtered.means[-1] - np.asarray(exact.means[-1])
    np.testing.assert_allclose(gaps / deviations[-1], 0.0, atol=0.02)
    np.testing.assert_allclose(slope, exact_slope, rtol=1e-2)


FAR = {
    "A": [[1.0]], "Q": [[0.01]], "H": [[1.0]], "R": [[0.02]], "m0": [300.0], "P0": [[0.05]],
}  # fmt: skip


@pytest.mark.parametrize(
    ("parts", "seen", "ends"),
    [
        (SCALAR, [0.4, NAN, 0.1, 1.0], (-8.0, 8.0)),
        (FAR, [300.1, 299.8, NAN, 299.9], (298.3, 301.9)),
    ],
    ids=["around zero", "far from zero"],
)
def test_grid_filter_agrees_with_the_kalman_filter(parts, seen, ends):
    """With a missing observation, and where the grid's numbers have few digits left."""
    model, grid = mpfjax.LinearGaussianModel(**parts), jnp.linspace(*ends, 1601)
    data = Series.skipping(jnp.asarray(seen, jnp.float32)[:, None])
    (m0,) = parts["m0"]
    run = grid_filter(model, data, grid)
    exact = kalman_filter(model, data)
    mean, variance = np.asarray(exact.means[:, 0]), np.asarray(exact.covariances[:, 0, 0])
    is_far = m0 == 300
    increments = exact.log_likelihood_increments
    atol = 1e-3 if is_far else 1e-5
    np.testing.assert_allclose(run.log_likelihood_increments, increments, atol=atol)
    np.testing.assert_allclose(run.means, mean, atol=1e-4 if is_far else 1e-5)
    np.testing.assert_allclose(run.variances, variance, rtol=2e-3 if is_far else 1e-4)
    above = scipy.stats.norm.sf(m0, mean, np.sqrt(variance))
    np.testing.assert_allclose(run.mass_above(m0), above, atol=2e-3)


@pytest.mark.exactness
def test_the_grid_filter_is_differentiable():
    def log_evidence(sigma):
        model, grid = mpfjax.QuadraticModel(0.3, sigma, -2.0, 2.0), jnp.linspace(-4.0, 4.0, 401)
        return grid_filter(model, jnp.array([1.2, 0.7]), grid).log_marginal_likelihood

    below, above = (log_evidence(jnp.array(0.5 + step)) for step in (-0.01, 0.01))
    slope = jax.grad(log_evidence)(jnp.array(0.5))
    np.testing.assert_allclose(slope, (above - below) / 0.02, rtol=1e-2)
