"""Potentials between pairs of objects: a Markov random field that keeps them apart."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mpfjax.checks import (
    check_callable,
    check_flag,
    check_positive_array,
    check_scalars,
    given,
    to_array,
)
from mpfjax.mixture import flatten_states
from mpfjax.operations.matrices import row_sums


class PairwiseRepulsion(eqx.Module):
    """log ψ(x_i, x_j) = -strength · k(|p_i - p_j| / radius), p the positions of two objects.

    The pairwise Markov random field of Khan, Balch and Dellaert (2004), for objects that cannot
    share a place. ψ is symmetric, 1 where the objects are far apart, and smooth: it has a gradient
    everywhere, even where the objects are at the same point.

    - `strength`: -log ψ of two objects at the same point, in nats; positive.
    - `radius`: in the unit of the positions; positive. With `compact`, k(r) = (1 - r²)² inside the
      radius and exactly 0 outside it. Without it, k(r) = exp(-r²/2), which is positive everywhere.
    - `position`: maps the states of one object, leading axis n, to (n, k) or (n,); None takes
      the whole state.

    Called with the states of two objects, it gives (n,). Raises `ValueError` for a strength or
    radius that is not positive. Use it where look-alikes cross and must not be tracked as one.
    With the compact form a filter can tell that objects do not touch.
    """

    strength: Float[Array, ""] = eqx.field(converter=to_array("strength"))
    radius: Float[Array, ""] = eqx.field(converter=to_array("radius"))
    position: Callable[[PyTree], Array] | None = eqx.field(static=True, default=None)
    compact: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        check_positive_array(strength=self.strength, radius=self.radius)
        check_scalars(strength=self.strength, radius=self.radius)
        check_callable("a function of the states", **given(position=self.position))
        check_flag(compact=self.compact)

    def __call__(self, states: PyTree, other_states: PyTree) -> Float[Array, " n"]:
        """log ψ of each row of the states with the same row of the other states."""
        gaps = self._positions(states) - self._positions(other_states)
        squares = row_sums((gaps / self.radius.astype(gaps.dtype)) ** 2)
        nearness = jnp.maximum(1 - squares, 0.0) ** 2 if self.compact else jnp.exp(-squares / 2)
        return -self.strength.astype(gaps.dtype) * nearness

    def _positions(self, states: PyTree) -> Float[Array, "n k"]:
        if self.position is None:
            return flatten_states(states)
        positions = self.position(states)
        return positions.reshape(positions.shape[0], -1)
