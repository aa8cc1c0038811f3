"""Tests of log densities against draws: which draw comes from which state, and by how much."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

# Of a right model, sums are as improbable as this once in a million keys.
_LEAST_CHANCE = 1e-6
# A mean of f/q is off by this many standard errors and this share, from so many draws in effect.
_MOST_ERRORS, _LEAST_EXCESS, _FEWEST = 7.0, 0.1, 100
_CENTRES, _WIDTHS, _NEAREST = 16, (0.85, 0.6, 0.4), (0.75, 0.25, 0.0625)


def origin_faults(
    logs: Float[np.ndarray, "f s s"], parents: list[Float[np.ndarray, "f s"]], name: str, x: str
) -> Iterator[str]:
    """Faults of a conditional log density, of each draw given its own state and its siblings'.

    If the density is right but for a factor of the draw alone, draw i comes from the state j of its
    family with the probability p_ij = exp logs_ij / Σ_k exp logs_ik. So the expectation of a value
    v_ii at the true origins is Σ_j p_ij v_ij, whatever v is: here the log density, and each number
    of the state and its square, since a spread may depend on the size of a number alone.
    """
    if np.isnan(logs).any() or not np.isfinite(np.diagonal(logs, axis1=1, axis2=2)).all():
        yield "is NaN, or infinite at a draw of {0}"
        return
    shares = np.exp(logs - logs.max(axis=2, keepdims=True))
    shares /= shares.sum(axis=2, keepdims=True)
    values = [(name, np.where(shares > 0, logs, 0.0))]
    for each in parents:
        columns = {x: each, f"({x})²": (each - each.mean()) ** 2}
        values += [(k, np.broadcast_to(v[:, None], logs.shape)) for k, v in columns.items()]
    for what, of_siblings in values:
        of_parent = np.diagonal(of_siblings, axis1=1, axis2=2)
        relative = of_siblings - np.sum(shares * of_siblings, axis=2, keepdims=True)
        excess = np.diagonal(relative, axis1=1, axis2=2).sum()
        deviation = np.sqrt(np.sum(shares * relative**2))
        beyond = abs(excess) - 1e-3 * of_parent.size * of_parent.std()
        log_chance = _log_chance(np.sign(excess) * relative, shares, beyond, deviation)
        if log_chance < np.log(_LEAST_CHANCE):
            mean, error = excess / of_parent.size, deviation / of_parent.size
            yield (
                f"is not the log density of {{0}}: averaged over the {x} that the draws come from,"
                f" {what} differs by {mean:+.2g} ± {error:.2g} from what the density predicts; is"
                " it a density in place of its logarithm, a variance in place of a standard"
                f" deviation, or is a factor that depends on {x} missing?"
            )


def _log_chance(values: np.ndarray, shares: np.ndarray, excess: float, deviation: float) -> float:
    """log of the most that a sum of values drawn by the shares is at least as large, by Chernoff.

    The bound holds for what seldom happens too, where a sum is far from normal.
    """
    if excess <= 4 * deviation:
        return 0.0
    if deviation == 0:
        return -np.inf
    slopes = np.geomspace(1e-4, 1e2, 41) / deviation
    bounds = [logsumexp(k * values, axis=2, b=shares).sum() for k in slopes]
    return float(np.min(np.asarray(bounds) - slopes * excess))


def density_faults(columns: list[np.ndarray], log_densities: np.ndarray) -> Iterator[str]:
    """Faults of a log density q at draws, of which `columns` has each number.

    For a density f, the mean of f/q over draws of q is the mass of f where q > 0: never above one,
    and one for some f that are narrow enough. The f are normal, each fitted to the draws near one
    of them, and f/q is averaged over other draws. What is discrete is held at its most frequent
    value. Nothing is said of draws on a curve or a surface, whose density may be in any measure.
    """
    if np.isnan(log_densities).any() or not np.isfinite(log_densities).all():
        yield "is NaN or infinite at a draw"
        return
    chosen, rows = _continuous_part(columns)
    if chosen is None:
        return
    is_fitted = np.arange(len(chosen)) % 2 == 0
    others = ~is_fitted
    logs = _local_normals(rows[chosen & is_fitted], rows[others]) if rows.shape[1] else [0.0]
    # No overflow: what is improbable to this degree is a fault at once.
    exponents = [np.where(chosen[others], each - log_densities[others], -np.inf) for each in logs]
    ratios = np.exp(np.minimum(exponents, 80.0)).reshape(-1, others.sum())
    effective = ratios.sum(axis=1) ** 2 / np.maximum(np.sum(ratios**2, axis=1), 1e-300)
    ratios = ratios[effective >= _FEWEST]
    means, errors = ratios.mean(axis=1), ratios.std(axis=1) / np.sqrt(ratios.shape[1])
    is_above = means - 1 > np.maximum(_LEAST_EXCESS * means, _MOST_ERRORS * errors)
    is_below = 1 - means > np.maximum(_LEAST_EXCESS, 0.6 * _MOST_ERRORS * errors)
    if is_above.any() or (means.size and is_below.all()):
        k = np.argmax((means - 1) / errors if is_above.any() else means)
        yield (
            "is not the log density of {0}: the mean of f / density over draws should be 1, and is"
            f" {means[k]:.2g} ± {errors[k]:.2g} for a normal density f; is it a density in place of"
            " its logarithm, or is a normalising constant or a Jacobian missing?"
        )


def _continuous_part(
    columns: list[np.ndarray],
) -> tuple[np.ndarray | None, Float[np.ndarray, "n d"]]:
    """Which draws have the most frequent values of what is discrete, and the other columns.

    None for the first where too few have, or where nothing is random.
    """
    n = len(columns[0])
    random = [column for column in columns if np.ptp(column) > 1e-6 * np.abs(column).max()]
    discrete = [column for column in random if np.unique(column).size < 0.9 * n]
    chosen = np.ones(n, bool)
    if discrete:
        table = np.stack(discrete, 1)
        _, which, counts = np.unique(table, axis=0, return_inverse=True, return_counts=True)
        chosen = which.ravel() == np.argmax(counts)
    if not random or chosen.sum() < 2 * _FEWEST:
        return None, np.zeros((n, 0))
    free = [each for each in random if not any(each is other for other in discrete)]
    free = [each for each in free if np.ptp(each[chosen]) > 1e-6 * np.abs(each).max()]
    return chosen, np.stack(free, 1) if free else np.zeros((n, 0))


def _local_normals(
    rows: Float[np.ndarray, "k d"], others: Float[np.ndarray, "n d"]
) -> Iterator[Float[np.ndarray, " n"]]:
    """log densities at the others of normals that are fitted to rows near each other."""
    centre, d = np.median(rows, axis=0), rows.shape[1]
    scale = np.diff(np.quantile(rows, [0.25, 0.75], axis=0), axis=0)[0]
    scale = np.where(scale > 0, scale, rows.std(axis=0))
    white, whitened = (rows - centre) / scale, (others - centre) / scale
    values, vectors = np.linalg.eigh(np.cov(np.clip(white, -5, 5).T).reshape(d, d))
    if values[0] < 1e-6 * values[-1]:
        return
    turn = vectors / np.sqrt(values)
    log_volume = np.log(scale).sum() + 0.5 * np.log(values).sum()
    white, whitened = white @ turn, whitened @ turn
    order = np.argsort(((white[None] - white[:_CENTRES, None]) ** 2).sum(axis=2), axis=1)
    # On a curve or a surface the draws next to each other are flat.
    close = np.stack([np.linalg.eigvalsh(_moments(white[row[: 10 * d]])[1]) for row in order])
    if np.median(close[:, 0] / close[:, -1]) < 0.01:
        return
    for share in _NEAREST:
        number = int(share * len(rows))
        for row in order if number >= 20 * d else ():
            mean, covariance = _moments(white[row[:number]])
            root = np.linalg.cholesky(covariance)
            squares = np.sum(np.linalg.solve(root, (whitened - mean).T) ** 2, axis=0)
            log_root = np.log(np.diagonal(root)).sum() + log_volume + 0.5 * d * np.log(2 * np.pi)
            for width in _WIDTHS:
                yield -0.5 * squares / width**2 - log_root - d * np.log(width)


def _moments(rows: Float[np.ndarray, "k d"]) -> tuple[np.ndarray, np.ndarray]:
    return rows.mean(axis=0), np.cov(rows.T).reshape(rows.shape[1], -1)
