"""What posteriors print: a table of their parameters, with diagnostics of chains."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from mpfjax.running.results import format_table

Row = dict[str, float]
_QUANTILES = (0.05, 0.5, 0.95)
_MOST_ROWS = 30


def split_r_hat(chains: Float[np.ndarray, "chains draws"]) -> float:
    """The potential scale reduction of half chains (Gelman et al. 2013, section 11.4).

    It is NaN for fewer than four draws, and where nothing moved.
    """
    halves = _halves(chains)
    if halves.shape[1] < 2:
        return np.nan
    within, total = _variances(halves)
    return float(np.sqrt(total / within)) if within > 0 else np.nan


def effective_sample_size(chains: Float[np.ndarray, "chains draws"]) -> float:
    """How many independent draws have the same error of the mean.

    From the autocorrelations of half chains, up to where the sum of two of them is negative
    (Geyer 1992), as in Vehtari et al. (2021, section 3.2). NaN as for `split_r_hat`.
    """
    halves = _halves(chains)
    number, length = halves.shape
    if length < 2:
        return np.nan
    within, total = _variances(halves)
    if not within > 0:
        return np.nan
    centred = halves - halves.mean(axis=1, keepdims=True)
    spectrum = np.abs(np.fft.rfft(centred, 2 * length)) ** 2
    covariances = np.fft.irfft(spectrum)[:, :length].mean(axis=0) / length
    correlations = 1 - (within - covariances * length / (length - 1)) / total
    correlations[0] = 1.0
    pairs = correlations[: length // 2 * 2].reshape(-1, 2).sum(axis=1)
    last = int(np.argmax(pairs < 0)) if (pairs < 0).any() else len(pairs)
    time = 2 * np.minimum.accumulate(pairs[:last]).sum() - 1
    # Antithetic chains can be better than independent draws, and the estimate of how much is bad.
    return float(number * length / max(time, 1 / np.log10(number * length)))


def row_of(values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"] | None = None) -> Row:
    """Mean, standard deviation and quantiles of draws, by name."""
    order = np.argsort(values)
    weights = np.ones(len(values)) if weights is None else weights
    shares = weights / weights.sum()
    mean = shares @ values
    # The middle of each draw's step in the distribution function.
    places = np.cumsum(shares[order]) - shares[order] / 2
    row = {"mean": mean, "deviation": np.sqrt(shares @ (values - mean) ** 2)}
    quantiles = np.interp(_QUANTILES, places, values[order])
    row |= {f"{100 * q:g}%": x for q, x in zip(_QUANTILES, quantiles, strict=True)}
    return {name: float(value) for name, value in row.items()}


def numbers_of(parameters: Mapping[str, np.ndarray], num_axes: int) -> dict[str, np.ndarray]:
    """Every number of the parameters by name, as a[0, 1], over the first axes alone."""
    numbers = {}
    for name, values in parameters.items():
        for index in np.ndindex(values.shape[num_axes:]):
            label = f"{name}{list(index)}" if index else name
            numbers[label] = np.asarray(values[(..., *index)], float)
    return numbers


def table(heading: str, rows: Mapping[str, Row]) -> str:
    """The rows below a heading, with a line that counts those left out."""
    shown = dict(list(rows.items())[:_MOST_ROWS])
    columns = list(next(iter(shown.values())))
    lines = [[name, *(f"{row[column]:.4g}" for column in columns)] for name, row in shown.items()]
    rest = [f"and {len(rows) - len(shown)} numbers more"] if len(rows) > len(shown) else []
    return "\n".join([heading, format_table(["", *columns], lines), *rest])


def _halves(chains: Float[np.ndarray, "chains draws"]) -> Float[np.ndarray, "halves half"]:
    """The first and the last half of each chain."""
    length = chains.shape[1] // 2
    return np.concatenate([chains[:, :length], chains[:, chains.shape[1] - length :]])


def _variances(halves: Float[np.ndarray, "halves draws"]) -> tuple[float, float]:
    """The variance within chains, and that of all draws together."""
    within = halves.var(axis=1, ddof=1).mean()
    length = halves.shape[1]
    return within, (length - 1) / length * within + halves.mean(axis=1).var(ddof=1)
