"""Backward regression of a twisted filter's ψ_t on the particles of a run."""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from mpfjax.filter import Filter
from mpfjax.lookahead.quadratics import LocalQuadratics
from mpfjax.lookahead.twisted import Twist
from mpfjax.models.base import with_inputs
from mpfjax.models.law import Law, law_of
from mpfjax.models.series import Series
from mpfjax.running.results import FilterRun, after_first, append_last

# The effective number of particles for each coefficient of a regression.
_PARTICLES_A_COEFFICIENT = 4
# In units in which features and noise have a variance of one.
_RIDGE = 1e-5
_LEAST_VARIANCE = 1e-5
# Bounds of the share of plain noise, which equals the error of the fit.
_LEAST_DEFENCE, _MOST_DEFENCE = 1e-3, 0.1
_HALVINGS = 16


@eqx.filter_jit
def fit_lookahead(
    key: Key[Array, ""], filter: Filter, twist: Twist, run: FilterRun, series: Series
) -> Twist:
    """ψ_T, ..., ψ_1 and that of x_0, from a run of `filter`, twisted by `twist`."""
    key_steps, key_initial = jax.random.split(key)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], after_first(run.initial, run.collected))
    used = jax.tree.map(lambda leaf: leaf[:-1], twist.steps)
    last = jax.tree.map(lambda leaf: leaf[-1], twist.steps)

    def back(after: LocalQuadratics, step: Any) -> tuple[LocalQuadratics, LocalQuadratics]:
        key, used, mixture, now = step
        law = law_of(with_inputs(filter.model, now.inputs))
        points = _draw_points(key, law, twist, after, step[1:])
        fitted = _fit_step(points, used)
        # ν with a mean of 1 over the filtering distribution, and its floor, δ of that mean.
        log_fitted = fitted.log_fitted(twist.features_of(mixture.particles))
        log_fitted = jnp.where(mixture.occupied, log_fitted, -jnp.inf)
        log_mean = jax.nn.logsumexp(mixture.log_weights + log_fitted)
        fitted = replace(
            fitted,
            constants=fitted.constants - log_mean,
            log_cap=fitted.log_cap - log_mean,
            log_floor=jnp.log(fitted.defence),
        )
        fitted = _if_finite(fitted, used)
        return fitted, fitted

    keys = jax.random.split(key_steps, series.length)
    first, fitted = jax.lax.scan(back, last, (keys, used, earlier, series), reverse=True)
    whole = append_last(fitted, last)
    initial = twist.initial
    if initial is not None:
        initial = _if_finite(_fit_initial(key_initial, filter, twist, initial, first), initial)
    return Twist(whole, initial, twist.features)


class _Points(NamedTuple):
    """The data of a regression of log ψ_t.

    - `features`: φ(x_{t-1}), (n, d). `noise`: ε, (n, j). `targets`: log L(y_t | x_t) ν_{t+1}(x_t).
    - `log_importance`: of a point, for p(x_{t-1}, ε | y_1..y_T).
    - `components`: the component of each x_{t-1}, (n, k), one of them 1.
    - `num_needed`: the sample size that a regression needs.
    """

    features: Float[Array, "n d"]
    noise: Float[Array, "n j"]
    targets: Float[Array, " n"]
    log_importance: Float[Array, " n"]
    components: Float[Array, "n k"]
    num_needed: int


def _draw_points(
    key: Key[Array, ""], law: Law, twist: Twist, after: LocalQuadratics, step: tuple
) -> _Points:
    """Draw every particle with equal frequency, so that none is lost, with noise from q_t."""
    used, mixture, now = step
    num_experts, dimension = used.centres.shape
    num_noises = law.noise_dimension(mixture.particles)
    num_coefficients = _num_coefficients(dimension + num_noises)
    needed = _PARTICLES_A_COEFFICIENT * num_coefficients
    copies = -(-2 * needed * num_experts // mixture.num_particles)
    repeated = mixture.repeat(copies)
    states, log_weights = repeated.particles, repeated.log_weights
    features = twist.features_of(states)
    shape = (len(log_weights), num_noises + 1)
    noise, log_ratio = used.draw(jax.random.normal(key, shape, features.dtype), features)
    unseen = law.complete(law.make(noise, states), states)
    moved, log_factors = law.see(now.observations, unseen)
    log_likelihoods = sum(log_factors[1:], log_factors[0])
    if (present := now.present) is not None:
        log_likelihoods = jnp.where(present, log_likelihoods, 0.0)
        moved = jax.tree.map(lambda new, old: jnp.where(present, new, old), moved, unseen)
    targets = log_likelihoods + after.log_fitted(twist.features_of(moved))
    is_number = jnp.isfinite(targets)
    targets = jnp.where(is_number, targets, jnp.min(jnp.where(is_number, targets, jnp.inf)))
    log_importance = jnp.where(is_number, targets + log_ratio + log_weights, -jnp.inf)
    components = jax.nn.one_hot(repeated.component_indicators, num_experts, dtype=features.dtype)
    return _Points(
        features, noise, targets.astype(features.dtype), log_importance.astype(features.dtype),
        components, needed * copies,
    )  # fmt: skip


def _fit_step(points: _Points, used: LocalQuadratics) -> LocalQuadratics:
    """An expert for each component: first its region, then its quadratic."""
    weights = _tempered(points.log_importance, points.components, points.num_needed)
    means, factors = _moments(points.features, weights)
    inverses = _inverses(factors)
    alive = jnp.sum(weights, axis=0) > 0
    log_volumes = jnp.sum(jnp.log(jnp.diagonal(inverses, axis1=1, axis2=2)), axis=1)
    log_shares = jnp.where(alive, log_volumes, -jnp.inf)
    located = replace(used, centres=means, whitening=inverses, log_shares=log_shares)
    near = jnp.exp(located.log_near(points.features)).T
    weights = _tempered(points.log_importance, near, points.num_needed)
    weights = weights / jnp.maximum(jnp.sum(weights, axis=0), 1e-30)[None]

    def fit(of_expert: tuple[Array, Array]) -> tuple[dict[str, Array], Array]:
        quadratic, square_error = _fit_quadratic(*of_expert, points.noise, points.targets)
        return _integrate_noise(*quadratic, points.noise.shape[1]), square_error

    whitened = jnp.swapaxes(located.whitened(points.features), 1, 2)
    experts, errors = jax.lax.map(fit, (weights.T, whitened))
    square_error = jnp.sum(jnp.where(alive, errors, 0.0)) / _count(alive, points.targets.dtype)
    return replace(
        located,
        **experts,
        noise_whitening=_inverses(experts["noise_factors"]),
        log_cap=jnp.max(points.targets),
        defence=jnp.clip(square_error, _LEAST_DEFENCE, _MOST_DEFENCE),
    )


def _fit_initial(
    key: Key[Array, ""], filter: Filter, twist: Twist, used: LocalQuadratics, first: LocalQuadratics
) -> LocalQuadratics:
    """A Gaussian mixture in the noise of x_0: the moments near each expert of ψ_1."""
    num_experts, dimension = used.noise_means.shape
    needed = _PARTICLES_A_COEFFICIENT * _num_coefficients(dimension)
    size = 4 * max(filter.num_particles, needed * num_experts)
    key_used, key_fitted = jax.random.split(key)

    def draw(key: Key[Array, ""], psi: LocalQuadratics) -> tuple[Array, Array, Array]:
        standard = jax.random.normal(key, (size, dimension + 1), used.slopes.dtype)
        noise, log_ratio = psi.draw(standard, jnp.zeros_like(standard[:, :1]))
        features = twist.features_of(law_of(filter.model).make_initial(noise))
        return noise, features, first.log_fitted(features) + log_ratio

    noise, features, log_importance = draw(key_used, used)
    near = jnp.exp(first.log_near(features)).T
    weights = _tempered(log_importance, near, needed)
    means, factors = _moments(noise, weights)
    shares = jax.nn.softmax(log_importance) @ near
    alive = (jnp.sum(weights, axis=0) > 0) & (first.log_shares > -jnp.inf)
    # Half of the draws are shared equally by all experts, so that no mode is lost.
    shares = jnp.where(alive, 0.5 * shares + 0.5 / _count(alive, shares.dtype), 0.0)
    fitted = replace(
        used,
        log_shares=jnp.log(shares),
        noise_means=means,
        noise_factors=factors,
        noise_whitening=_inverses(factors),
        defence=jnp.full_like(used.defence, _MOST_DEFENCE),
    )
    log_weights = draw(key_fitted, fitted)[2]
    log_sum, log_squares = (jax.nn.logsumexp(power * log_weights) for power in (1, 2))
    square_error = size * jnp.exp(log_squares - 2 * log_sum) - 1
    return replace(fitted, defence=jnp.clip(square_error, _LEAST_DEFENCE, _MOST_DEFENCE))


def _tempered(
    log_importance: Float[Array, " n"], members: Float[Array, "n k"], num_needed: float
) -> Float[Array, "n k"]:
    """w_i^α of each expert's members, with the largest α up to 1 with a large enough sample."""
    is_member = (members > 0) & (log_importance > -jnp.inf)[:, None]
    logs = jnp.where(is_member, log_importance[:, None], -jnp.inf)
    most = jnp.max(logs, axis=0)
    logs = jnp.where(is_member, logs - jnp.where(most > -jnp.inf, most, 0.0)[None], 0.0)
    members = jnp.where(is_member, members, 0.0)

    def size(powers: Float[Array, " k"]) -> Float[Array, " k"]:
        values = jnp.exp(powers[None] * logs)
        squares = jnp.sum(members * values**2, axis=0)
        return jnp.sum(members * values, axis=0) ** 2 / jnp.maximum(squares, 1e-30)

    low, high = jnp.zeros_like(most), jnp.ones_like(most)
    goal = jnp.minimum(num_needed, 0.5 * size(low))

    def bisect(_: Any, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = 0.5 * (low + high)
        enough = size(middle) >= goal
        return jnp.where(enough, middle, low), jnp.where(enough, high, middle)

    tempered, _ = jax.lax.fori_loop(0, _HALVINGS, bisect, (low, high))
    return members * jnp.exp(jnp.where(size(high) >= goal, 1.0, tempered)[None] * logs)


def _moments(
    values: Float[Array, "n d"], weights: Float[Array, "n k"]
) -> tuple[Float[Array, "k d"], Float[Array, "k d d"]]:
    """The mean and the Cholesky factor of the covariance by each column of weights."""
    total = jnp.sum(weights, axis=0)
    weights = weights / jnp.where(total > 0, total, 1.0)[None]
    spread = jnp.std(values, axis=0)
    unit = jnp.where(spread > 0, spread, 1.0)

    def moments(column: Float[Array, " n"]) -> tuple[Array, Array]:
        mean = column @ values
        scaled = (values - mean[None]) / unit[None]
        covariance = (scaled * column[:, None]).T @ scaled
        return mean, unit[:, None] * _factor(covariance)

    return jax.vmap(moments)(weights.T)


def _fit_quadratic(
    weights: Float[Array, " n"],
    whitened: Float[Array, "n d"],
    noise: Float[Array, "n j"],
    targets: Float[Array, " n"],
) -> tuple[tuple[Array, Array, Array], Array]:
    """a, b and H of the quadratic a + bᵀz + zᵀHz / 2 in z = (features, ε), H not positive.

    Also the mean square error of its fit.
    """
    values = jnp.concatenate([whitened, noise], axis=1)
    size, dtype = values.shape[1], values.dtype
    mean = weights @ values
    centred = values - mean[None]
    inverse = _inverses(_factor((centred * weights[:, None]).T @ centred)[None])[0]
    standard = centred @ inverse.T
    # These functions of independent normal numbers are orthogonal.
    rows, columns = jnp.triu_indices(size)
    is_square, root = rows == columns, jnp.sqrt(2.0).astype(dtype)
    products = standard[:, rows] * standard[:, columns]
    products = jnp.where(is_square[None], (products - 1) / root, products)
    design = jnp.concatenate([jnp.ones_like(products[:, :1]), standard, products], axis=1)
    level = weights @ targets
    weighted = design * weights[:, None]
    normal, right = weighted.T @ design, weighted.T @ (targets - level)
    ridge = jnp.eye(len(right), dtype=dtype)
    rough = jnp.linalg.solve(normal + _RIDGE * ridge, right)
    # The better the fit and the larger the sample, the less it is regularised.
    noisy = weights @ (targets - level - design @ rough) ** 2 * jnp.sum(weights**2)
    penalty = _RIDGE * ridge + noisy * ridge.at[0, 0].set(0.0)
    coefficients = jnp.linalg.solve(normal + penalty, right)
    slope, upper = coefficients[1 : 1 + size], coefficients[1 + size :]
    upper = jnp.where(is_square, root * upper, upper)
    hessian = jnp.zeros((size, size), dtype).at[rows, columns].set(upper)
    values_, vectors = jnp.linalg.eigh(hessian + jnp.triu(hessian, 1).T)
    hessian = (vectors * jnp.minimum(values_, 0.0)[None]) @ vectors.T
    constant = level + coefficients[0] - 0.5 * jnp.trace(hessian)
    curvature = 0.5 * jnp.sum((standard @ hessian) * standard, axis=1)
    residuals = targets - constant - standard @ slope - curvature
    constant = constant + weights @ residuals
    square_error = weights @ residuals**2 - (weights @ residuals) ** 2
    hessian, slope = inverse.T @ hessian @ inverse, inverse.T @ slope
    constant = constant - slope @ mean + 0.5 * mean @ hessian @ mean
    return (constant, slope - hessian @ mean, hessian), square_error


def _integrate_noise(
    constant: Float[Array, ""],
    slope: Float[Array, " z"],
    hessian: Float[Array, "z z"],
    num_noises: int,
) -> dict[str, Array]:
    """The fields of an expert: the quadratic with N(ε; 0, I), and integrated over ε."""
    d = len(slope) - num_noises
    of_noise, mixed = hessian[d:, d:], hessian[:d, d:]
    precision = jnp.eye(len(of_noise), dtype=hessian.dtype) - of_noise
    values, vectors = jnp.linalg.eigh(precision)
    # At least its value without ψ, up to rounding.
    values = jnp.maximum(values, 1.0)
    covariance = (vectors / values[None]) @ vectors.T
    mean, gain = covariance @ slope[d:], covariance @ mixed.T
    return {
        "constants": constant + 0.5 * slope[d:] @ mean - 0.5 * jnp.sum(jnp.log(values)),
        "slopes": slope[:d] + mixed @ mean,
        "curvatures": hessian[:d, :d] + mixed @ gain,
        "noise_means": mean,
        "noise_slopes": gain,
        "noise_factors": jnp.linalg.cholesky(covariance),
    }


def _if_finite(psi: LocalQuadratics, before: LocalQuadratics) -> LocalQuadratics:
    """ψ, or the earlier ψ where the fit has a NaN."""
    broken = jnp.any(jnp.stack([jnp.any(jnp.isnan(leaf)) for leaf in jax.tree.leaves(psi)]))
    return jax.tree.map(lambda new, old: jnp.where(broken, old, new), psi, before)


def _num_coefficients(dimension: int) -> int:
    """The number of coefficients of a quadratic."""
    return 1 + dimension + dimension * (dimension + 1) // 2


def _count(alive: Bool[Array, " k"], dtype: Any) -> Float[Array, ""]:
    return jnp.maximum(jnp.sum(alive.astype(dtype)), 1.0)


def _factor(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    size = len(covariance)
    return jnp.linalg.cholesky(covariance + _LEAST_VARIANCE * jnp.eye(size, dtype=covariance.dtype))


def _inverses(factors: Float[Array, "k d d"]) -> Float[Array, "k d d"]:
    identity = jnp.broadcast_to(jnp.eye(factors.shape[1], dtype=factors.dtype), factors.shape)
    return jax.scipy.linalg.solve_triangular(factors, identity, lower=True)
