"""Distances between a set of estimates and a set of true objects: OSPA and GOSPA.

Both sets are arrays of fixed shape with a mask for the entries that exist, so `jax.jit` compiles
once and `jax.vmap` runs over the frames. Both distances pair estimates with objects at the least
total cost, with each entry in at most one pair, and add a cost for each entry without a partner.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mpfjax.checks import check_callable, check_finite, check_positive, check_shape, real_arrays


@jax.jit  # without it, every call outside of `jax.jit` would compile the search again
def _assign(costs: Float[Array, "a b"]) -> tuple[Array, Array]:
    from optax.assignment import hungarian_algorithm  # where it is used: all of optax comes with it

    return hungarian_algorithm(costs)


class GOSPA(NamedTuple):
    """The result of `gospa`: distance^order = localisation + missed + false.

    - `distance`: the metric itself, in the unit of the base distance.
    - `localisation`: the sum of d^order over the estimates paired with an object.
    - `missed`: the cost of the objects without an estimate; where alpha is 2, it is their number
      times cutoff^order / 2.
    - `false`: the cost of the estimates without an object, in the same way.
    """

    distance: Float[Array, ""]
    localisation: Float[Array, ""]
    missed: Float[Array, ""]
    false: Float[Array, ""]


class _Pairing(NamedTuple):
    """The cheapest pairing; costs are in units of cutoff^order, one entry a pair."""

    costs: Float[Array, " s"]
    is_estimate: Bool[Array, " s"]
    is_truth: Bool[Array, " s"]


def euclidean(estimates: Float[Array, "k d"], truths: Float[Array, "l d"]) -> Float[Array, "k l"]:
    """The Euclidean distance of every estimate from every true position."""
    return jnp.sqrt(jnp.sum((estimates[:, None] - truths[None]) ** 2, axis=-1))


def ospa(
    estimates: Float[Array, "k d"],
    truths: Float[Array, "l d"],
    *,
    cutoff: float,
    order: float = 2.0,
    estimate_mask: Bool[Array, " k"] | None = None,
    truth_mask: Bool[Array, " l"] | None = None,
    base_distance: Callable[[Array, Array], Array] = euclidean,
) -> Float[Array, ""]:
    """The optimal sub-pattern assignment distance between estimates and true positions.

    Schuhmacher, Vo and Vo (2008): for m <= n entries in the two sets, the least over
    pairings of ((sum_i min(d_i, c)^p + c^p (n - m)) / n)^(1/p), with c the `cutoff` in the unit
    of `base_distance` (pixels) and p the `order`. It is 0 for two empty sets and c where one is
    empty. `cutoff` and `order` are Python numbers. Entries that a mask leaves out may hold
    anything; a NaN in one that counts makes the distance NaN where the other set is not empty.

    Raises `ValueError` for sets that are no arrays, masks of another length, a cutoff that is not
    positive and finite, and an order below 1 or infinite. Use it for an error per object;
    `gospa` says how many objects were missed.
    """
    estimates, truths = _checked_sets(estimates, truths, estimate_mask, truth_mask)
    _check_numbers(cutoff, order, base_distance)
    pairing = _cheapest_pairing(
        base_distance(estimates, truths) / cutoff, estimate_mask, truth_mask, order, 1.0
    )
    size = jnp.maximum(jnp.sum(pairing.is_estimate), jnp.sum(pairing.is_truth))
    total = jnp.sum(pairing.costs)
    return cutoff * (total / jnp.maximum(size, 1).astype(total.dtype)) ** (1.0 / order)


def gospa(
    estimates: Float[Array, "k d"],
    truths: Float[Array, "l d"],
    *,
    cutoff: float,
    order: float = 2.0,
    alpha: float = 2.0,
    estimate_mask: Bool[Array, " k"] | None = None,
    truth_mask: Bool[Array, " l"] | None = None,
    base_distance: Callable[[Array, Array], Array] = euclidean,
) -> GOSPA:
    """The generalised OSPA distance, with its parts: localisation, misses and false estimates.

    Rahmathullah, García-Fernández and Svensson (2017), eq. 1: for m <= n entries in the two sets,
    the least over pairings of (sum_i min(d_i, c)^p + (c^p / alpha) (n - m))^(1/p), with c the
    `cutoff` in the unit of `base_distance` (pixels) and p the `order`. The parts are those of
    their Proposition 1: two entries paired at the cutoff or beyond are one miss and one false
    estimate, at c^p / 2 each. With alpha below 2 the parts still add up, but an entry left over
    costs c^p / alpha. Two empty sets are at distance 0. Numbers, masks and NaN are as in `ospa`.

    Raises `ValueError` as `ospa` does, and for an alpha outside (0, 2]. Use it to score trackers
    that may lose objects or invent them, with alpha at 2.
    """
    estimates, truths = _checked_sets(estimates, truths, estimate_mask, truth_mask)
    _check_numbers(cutoff, order, base_distance)
    check_positive(alpha=alpha)
    if alpha > 2:
        raise ValueError(f"alpha: {alpha} is not in (0, 2]")
    pairing = _cheapest_pairing(
        base_distance(estimates, truths) / cutoff, estimate_mask, truth_mask, order, 1.0 / alpha
    )
    costs, is_estimate, is_truth = pairing
    near = is_estimate & is_truth & ~(costs >= 1.0)
    localisation = jnp.sum(jnp.where(near, costs, 0.0))
    apart = jnp.where(is_estimate & is_truth, costs / 2.0, costs)
    missed = jnp.sum(jnp.where(is_truth & ~near, apart, 0.0))
    false = jnp.sum(jnp.where(is_estimate & ~near, apart, 0.0))
    scale = cutoff**order
    return GOSPA(
        distance=cutoff * jnp.sum(costs) ** (1.0 / order),
        localisation=scale * localisation,
        missed=scale * missed,
        false=scale * false,
    )


def _cheapest_pairing(
    distances: Float[Array, "k l"],
    estimate_mask: Bool[Array, " k"] | None,
    truth_mask: Bool[Array, " l"] | None,
    order: float,
    cost_alone: float,
) -> _Pairing:
    """Pair all entries, in a square matrix in which those that are not there cost nothing.

    A pair of entries that exist costs at most 1. To leave both without a partner costs at least 1,
    since alpha is at most 2. So the cheapest pairing leaves as few entries alone as possible.
    """
    num_estimates, num_truths = distances.shape
    size = max(num_estimates, num_truths)
    rows, columns = (0, size - num_estimates), (0, size - num_truths)
    is_estimate = jnp.pad(_all_unless_given(estimate_mask, num_estimates), rows)
    is_truth = jnp.pad(_all_unless_given(truth_mask, num_truths), columns)
    capped = jnp.pad(jnp.minimum(distances, 1.0) ** order, (rows, columns))
    alone = jnp.where(is_estimate[:, None] ^ is_truth[None], cost_alone, 0.0)
    costs = jnp.where(is_estimate[:, None] & is_truth[None], capped, alone.astype(capped.dtype))
    # The search for the pairing would not end on a NaN, so it never sees one.
    costs = jnp.where(jnp.any(jnp.isnan(costs)), jnp.nan, costs)
    # It works in the default precision, and under strict promotion it converts nothing itself.
    i, j = _assign(jnp.nan_to_num(costs).astype(float))
    return _Pairing(costs[i, j], is_estimate[i], is_truth[j])


def _all_unless_given(mask: Bool[Array, " k"] | None, size: int) -> Bool[Array, " k"]:
    return jnp.ones(size, bool) if mask is None else mask


def _checked_sets(
    estimates: Any, truths: Any, estimate_mask: Any, truth_mask: Any
) -> tuple[Float[Array, "k d"], Float[Array, "l d"]]:
    """The two sets in floating point; a `ValueError` for what is none, and for other masks."""
    sets = {"estimate": ("estimates", estimates), "truth": ("truths", truths)}
    masks = {"estimate": estimate_mask, "truth": truth_mask}
    for kind, (name, entries) in sets.items():
        check_shape("number d", **{name: entries})
        mask = masks[kind]
        if mask is not None:
            check_shape("number", **{f"{kind}_mask": mask})
            if mask.shape != entries.shape[:1] or mask.dtype != bool:
                raise ValueError(
                    f"{kind}_mask: {mask.dtype}{mask.shape} is no mask of {entries.shape[0]} {name}"
                )
    estimates = real_arrays("number d", estimates=estimates)
    return estimates, real_arrays("number d", truths=truths)


def _check_numbers(cutoff: float, order: float, base_distance: Any) -> None:
    check_positive(cutoff=cutoff)
    check_finite(order=order)
    if order < 1:
        raise ValueError(f"order: {order} is less than 1")
    check_callable("a function of two sets", base_distance=base_distance)
