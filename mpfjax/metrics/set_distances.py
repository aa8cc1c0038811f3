"""Distances between a set of estimates and a set of true objects: OSPA and GOSPA.

Both distances pair estimates with objects at the least total cost, with each entry in at most one
pair, and add a cost for each entry without a partner.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mpfjax.arrays import to_rows
from mpfjax.checks import Positive, checked, number

Exponent = Annotated[float, number(lambda p: 1 <= p < np.inf, "a finite number of at least 1")]


class OSPA(NamedTuple):
    """The result of `ospa`: distance^exponent = localisation + cardinality, a mean per object.

    - `distance`: the metric itself, in the unit of the positions.
    - `localisation`: the sum of min(d, cutoff)^exponent over the pairs, divided by the larger
      number n.
    - `cardinality`: cutoff^exponent times the fraction of these n that have no partner.
    """

    distance: float
    localisation: float
    cardinality: float


class GOSPA(NamedTuple):
    """The result of `gospa`: distance^exponent = localisation + missed + false.

    - `distance`: the metric itself, in the unit of the positions.
    - `localisation`: the sum of d^exponent over the estimates paired with an object.
    - `missed`: the cost of the objects without an estimate: their number times
      cutoff^exponent / 2.
    - `false`: the cost of the estimates without an object, in the same way.
    """

    distance: float
    localisation: float
    missed: float
    false: float


@checked
def ospa(
    estimates: Float[np.ndarray, "k d"],
    truths: Float[np.ndarray, "l d"],
    *,
    cutoff: Positive,
    exponent: Exponent = 2.0,
) -> OSPA:
    """The optimal sub-pattern assignment distance, with its parts: localisation and cardinality.

    Schuhmacher, Vo and Vo (2008): for m <= n entries in the two sets, the minimum over pairings of
    ((sum_i min(d_i, c)^p + c^p (n - m)) / n)^(1/p), with c the `cutoff` in the unit of the
    positions and p the `exponent`. It is 0 for two empty sets and c if one is empty. A NaN makes
    the distance NaN if the other set is not empty. By NumPy and SciPy, in float64.

    Raises `ValueError` for sets that are not arrays, a cutoff that is not positive and finite, and
    an exponent below 1 or infinite. Use it for an error per object; `gospa` reports how many
    objects were missed.
    """
    costs, num_estimates, num_truths = _pair(estimates, truths, cutoff, exponent)
    size, num_alone = max(num_estimates, num_truths, 1), abs(num_estimates - num_truths)
    localised, alone, unit = np.sum(costs) / size, num_alone / size, cutoff**exponent
    distance = cutoff * (localised + alone) ** (1 / exponent)
    return OSPA(float(distance), float(unit * localised), unit * alone)


@checked
def gospa(
    estimates: Float[np.ndarray, "k d"],
    truths: Float[np.ndarray, "l d"],
    *,
    cutoff: Positive,
    exponent: Exponent = 2.0,
) -> GOSPA:
    """The generalised OSPA distance, with its parts: localisation, misses and false estimates.

    Rahmathullah, García-Fernández and Svensson (2017), eq. 1 with alpha 2, for which each miss and
    each false estimate has the same cost: for m <= n entries in the two sets, the minimum over
    pairings of (sum_i min(d_i, c)^p + (c^p / 2) (n - m))^(1/p), with c the `cutoff` in the unit of
    the positions and p the `exponent`. The parts are those of their Proposition 1: two entries
    paired at the cutoff or beyond are one miss and one false estimate, at c^p / 2 each. Two empty
    sets are at distance 0. Numbers and NaN are treated as in `ospa`.

    Raises `ValueError` as `ospa` does. Use it to score trackers that may lose objects or report
    false ones.
    """
    costs, num_estimates, num_truths = _pair(estimates, truths, cutoff, exponent)
    near, unit = costs[~(costs >= 1)], cutoff**exponent
    missed, false = ((number - len(near)) / 2 for number in (num_truths, num_estimates))
    localised = np.sum(near)
    distance = cutoff * (localised + missed + false) ** (1 / exponent)
    return GOSPA(float(distance), float(unit * localised), unit * missed, unit * false)


def _pair(
    estimates: Any, truths: Any, cutoff: float, exponent: float
) -> tuple[Float[np.ndarray, " s"], int, int]:
    """(d / cutoff)^exponent of the cheapest pairing, each at most one; both numbers."""
    estimates = to_rows(None, "estimates", estimates)
    truths = to_rows(estimates.shape[1], "truths", truths)
    costs = np.minimum(cdist(estimates, truths) / cutoff, 1.0) ** exponent
    if np.isnan(costs).any():
        return np.full(min(costs.shape), np.nan), *costs.shape
    return costs[linear_sum_assignment(costs)], *costs.shape


@checked
def track_switches(
    estimates: Float[np.ndarray, "t m d"],
    labels: Int[np.ndarray, "t m"],
    truths: Float[np.ndarray, "t k d"],
    *,
    cutoff: Positive,
) -> int:
    """The number of times that an object is followed by a track with another label than before.

    In each step estimates and true objects are paired at the least total distance, below the
    `cutoff`. Rows with a NaN are ignored. A track that is lost and recovered under a new label
    counts, too; a step without a pair does not. Raises `ValueError` for a cutoff that is not
    positive and finite.
    """
    last, switches = np.full(truths.shape[1], -1), 0
    for here, names, there in zip(*map(np.asarray, (estimates, labels, truths)), strict=True):
        gaps = np.linalg.norm(here[:, None] - there[None], axis=-1)
        costs = np.where(gaps < cutoff, gaps, 2 * cutoff)  # where there is none it is NaN, not less
        rows, columns = linear_sum_assignment(costs)
        is_pair = costs[rows, columns] < cutoff
        rows, columns = rows[is_pair], columns[is_pair]
        switches += int(np.sum((last[columns] >= 0) & (last[columns] != names[rows])))
        last[columns] = names[rows]
    return switches
