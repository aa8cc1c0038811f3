"""Distances between a set of estimates and a set of true objects: OSPA and GOSPA.

Both sets are arrays of fixed shape with a mask for the entries that exist, so `jax.jit` compiles
once and `jax.vmap` runs over the frames. Both distances pair estimates with objects at the least
total cost, with each entry in at most one pair, and add a cost for each entry without a partner.
"""

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mpfjax.checks import Positive, check_shape, checked, number, real_array

Exponent = Annotated[float, number(lambda p: 1 <= p < np.inf, "a finite number of at least 1")]
Alpha = Annotated[float, number(lambda alpha: 0 < alpha <= 2, "a number in (0, 2]")]


@jax.jit  # without it, every call outside of `jax.jit` would compile the search again
def _assign(costs: Float[Array, "a b"]) -> tuple[Array, Array]:
    from optax.assignment import hungarian_algorithm  # where it is used: all of optax comes with it

    return hungarian_algorithm(costs)


class OSPA(NamedTuple):
    """The result of `ospa`: distance^exponent = localisation + cardinality, a mean per object.

    - `distance`: the metric itself, in the unit of the base distance.
    - `localisation`: the sum of min(d, cutoff)^exponent over the pairs, by the larger number n.
    - `cardinality`: cutoff^exponent times the share of these n that have no partner.
    """

    distance: Float[Array, ""]
    localisation: Float[Array, ""]
    cardinality: Float[Array, ""]


class GOSPA(NamedTuple):
    """The result of `gospa`: distance^exponent = localisation + missed + false.

    - `distance`: the metric itself, in the unit of the base distance.
    - `localisation`: the sum of d^exponent over the estimates paired with an object.
    - `missed`: the cost of the objects without an estimate; where alpha is 2, it is their number
      times cutoff^exponent / 2.
    - `false`: the cost of the estimates without an object, in the same way.
    """

    distance: Float[Array, ""]
    localisation: Float[Array, ""]
    missed: Float[Array, ""]
    false: Float[Array, ""]


class _Pairing(NamedTuple):
    """The cheapest pairing, one entry a pair; distances in units of the cutoff, at most one."""

    distances: Float[Array, " s"]
    is_estimate: Bool[Array, " s"]
    is_truth: Bool[Array, " s"]

    @property
    def is_pair(self) -> Bool[Array, " s"]:
        """Which entries have both; the others are alone, or nothing at all."""
        return self.is_estimate & self.is_truth

    def distance(self, exponent: float, cost_alone: float) -> Float[Array, ""]:
        """(Σ d^exponent + cost_alone times the number alone)^(1 / exponent)."""
        distances, num_alone = self.distances, jnp.sum(self.is_estimate ^ self.is_truth)
        # Powers of shares of the largest neither underflow nor have an infinite derivative.
        largest = jnp.max(jnp.where(self.is_pair, distances, 0.0), initial=0.0)
        largest = jax.lax.stop_gradient(jnp.where(num_alone > 0, 1.0, largest))
        nothing = largest == 0
        unit = jnp.where(nothing, 1.0, largest)
        powers = jnp.where(self.is_pair, (distances / unit) ** exponent, 0.0)
        total = jnp.sum(powers) + cost_alone * num_alone.astype(unit.dtype)
        return jnp.where(nothing, 0.0, unit * jnp.where(nothing, 1.0, total) ** (1.0 / exponent))


def euclidean(estimates: Float[Array, "k d"], truths: Float[Array, "l d"]) -> Float[Array, "k l"]:
    """The Euclidean distance of every estimate from every true position."""
    squares = jnp.sum((estimates[:, None] - truths[None]) ** 2, axis=-1)
    coincide = squares == 0  # where the derivative of the root is not finite
    return jnp.where(coincide, 0.0, jnp.sqrt(jnp.where(coincide, 1.0, squares)))


@checked
def ospa(
    estimates: Float[Array, "k d"],
    truths: Float[Array, "l d"],
    *,
    cutoff: Positive,
    exponent: Exponent = 2.0,
    estimate_mask: Bool[Array, " k"] | None = None,
    truth_mask: Bool[Array, " l"] | None = None,
    base_distance: Callable[[Array, Array], Array] = euclidean,
) -> OSPA:
    """The optimal sub-pattern assignment distance, with its parts: localisation and cardinality.

    Schuhmacher, Vo and Vo (2008): for m <= n entries in the two sets, the least over
    pairings of ((sum_i min(d_i, c)^p + c^p (n - m)) / n)^(1/p), with c the `cutoff` in the unit
    of `base_distance` (pixels) and p the `exponent`. It is 0 for two empty sets and c where one is
    empty. `cutoff` and `exponent` are Python numbers. Entries that a mask leaves out may hold
    anything; a NaN in one that counts makes the distance NaN where the other set is not empty.

    Raises `ValueError` for sets that are no arrays, masks of another length, a cutoff that is not
    positive and finite, and an exponent below 1 or infinite. Use it for an error per object;
    `gospa` says how many objects were missed.
    """
    pairing = _paired(estimates, truths, cutoff, exponent, estimate_mask, truth_mask, base_distance)
    size = jnp.maximum(jnp.sum(pairing.is_estimate), jnp.sum(pairing.is_truth))
    size = jnp.maximum(size, 1).astype(pairing.distances.dtype)
    powers = jnp.where(pairing.is_pair, (cutoff * pairing.distances) ** exponent, 0.0)
    share = jnp.sum(pairing.is_estimate ^ pairing.is_truth, dtype=powers.dtype) / size
    return OSPA(
        distance=cutoff * pairing.distance(exponent, 1.0) / size ** (1.0 / exponent),
        localisation=jnp.sum(powers) / size,
        cardinality=_times(share, cutoff, exponent),
    )


@checked
def gospa(
    estimates: Float[Array, "k d"],
    truths: Float[Array, "l d"],
    *,
    cutoff: Positive,
    exponent: Exponent = 2.0,
    alpha: Alpha = 2.0,
    estimate_mask: Bool[Array, " k"] | None = None,
    truth_mask: Bool[Array, " l"] | None = None,
    base_distance: Callable[[Array, Array], Array] = euclidean,
) -> GOSPA:
    """The generalised OSPA distance, with its parts: localisation, misses and false estimates.

    Rahmathullah, García-Fernández and Svensson (2017), eq. 1: for m <= n entries in the two sets,
    the least over pairings of (sum_i min(d_i, c)^p + (c^p / alpha) (n - m))^(1/p), with c the
    `cutoff` in the unit of `base_distance` (pixels) and p the `exponent`. The parts are those of
    their Proposition 1: two entries paired at the cutoff or beyond are one miss and one false
    estimate, at c^p / 2 each. With alpha below 2 the parts still add up, but an entry left over
    costs c^p / alpha. Two empty sets are at distance 0. Numbers, masks and NaN are as in `ospa`.

    Raises `ValueError` as `ospa` does, and for an alpha outside (0, 2]. Use it to score trackers
    that may lose objects or invent them, with alpha at 2.
    """
    pairing = _paired(estimates, truths, cutoff, exponent, estimate_mask, truth_mask, base_distance)
    near = pairing.is_pair & ~(pairing.distances >= 1.0)
    localisation = jnp.sum(jnp.where(near, (cutoff * pairing.distances) ** exponent, 0.0))

    def cost(is_there: Bool[Array, " s"]) -> Float[Array, ""]:
        shares = jnp.where(pairing.is_pair, 0.5, 1.0 / alpha)
        share = jnp.sum(jnp.where(is_there & ~near, shares, 0.0), dtype=localisation.dtype)
        return _times(share, cutoff, exponent)

    return GOSPA(
        distance=cutoff * pairing.distance(exponent, 1.0 / alpha),
        localisation=localisation,
        missed=cost(pairing.is_truth),
        false=cost(pairing.is_estimate),
    )


def _times(share: Float[Array, ""], cutoff: float, exponent: float) -> Float[Array, ""]:
    """share cutoff^exponent, also where the power is no number in the share's precision."""
    with np.errstate(over="ignore"):
        scale = jnp.asarray(np.float64(cutoff) ** exponent, share.dtype)
    return jnp.where(share > 0, scale, 0.0) * share


# Costs below this share of the largest are lost in the sums of the search.
_FINE = 1e-3


def _paired(
    estimates: Any, truths: Any, cutoff: float, exponent: float,
    estimate_mask: Any, truth_mask: Any, base_distance: Callable[[Array, Array], Array],
) -> _Pairing:  # fmt: skip
    """The cheapest pairing of the two sets; a `ValueError` for sets that will not do.

    It pairs as many entries as possible, in a square matrix whose other entries are not there. The
    search is repeated with the largest distance that it found below the cutoff as the unit, in
    which the powers of those that compete are numbers that it can add. An entry alone, or one of
    more than all of these together, costs `most`: how much more makes no difference.
    """
    estimates = real_array("number d", "estimates", estimates)
    truths = real_array("number d", "truths", truths)
    size = max(len(estimates), len(truths))
    rows, columns = (0, size - len(estimates)), (0, size - len(truths))
    is_estimate = jnp.pad(_mask("estimate_mask", estimate_mask, len(estimates)), rows)
    is_truth = jnp.pad(_mask("truth_mask", truth_mask, len(truths)), columns)
    distances = base_distance(estimates, truths) / cutoff
    is_pair, is_alone = is_estimate[:, None] & is_truth[None], is_estimate[:, None] ^ is_truth[None]
    capped = jnp.where(is_pair, jnp.pad(jnp.minimum(distances, 1.0), (rows, columns)), 0.0)
    # The search for the pairing would not end on a NaN, so it never sees one.
    known, most = jax.lax.stop_gradient(jnp.nan_to_num(capped)), size + 1.0

    def search(unit: Float[Array, ""]) -> tuple[Array, Array, Array, Array]:
        costs = jnp.minimum((known / unit) ** exponent, most)
        costs = jnp.where(is_alone, most, costs)
        # It works in the default precision, and under strict promotion it converts nothing itself.
        i, j = _assign(costs.astype(float))
        found = known[i, j]
        return unit, jnp.max(jnp.where(found < 1.0, found, 0.0), initial=0.0), i, j

    def is_coarse(found: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        unit, largest, _, _ = found
        return (largest > 0) & ((largest / unit) ** exponent < _FINE)

    first = search(jnp.ones((), known.dtype))
    _, _, i, j = jax.lax.while_loop(is_coarse, lambda found: search(found[1]), first)
    capped = jnp.where(jnp.any(jnp.isnan(capped)), jnp.nan, capped)
    return _Pairing(capped[i, j], is_estimate[i], is_truth[j])


def _mask(name: str, mask: Any, size: int) -> Bool[Array, " k"]:
    if mask is None:
        return jnp.ones(size, bool)
    check_shape(f"{size}", **{name: mask})
    return jnp.asarray(mask, bool)


@checked
def track_switches(
    estimates: Float[np.ndarray, "t m d"],
    labels: Int[np.ndarray, "t m"],
    truths: Float[np.ndarray, "t k d"],
    *,
    cutoff: Positive,
) -> int:
    """How often a true object is followed by a track of another label than before.

    In each step estimates and true objects are paired at the least total distance, nearer than the
    `cutoff`. Rows with a NaN are none. A track that is lost and found again under a new label
    counts, too; a step without a pair does not. Raises `ValueError` for a cutoff that is not
    positive and finite.
    """
    from scipy.optimize import linear_sum_assignment

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
