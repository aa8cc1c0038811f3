"""How often objects are detected, and detections are of objects: learned rates."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mpfjax.operations.floats import default_float
from mpfjax.operations.indexing import take
from mpfjax.vision.tracking.fates import KEPT, PRIOR, rising

_BINS = 10
_CENTRES = (np.arange(_BINS) + 0.5) / _BINS
_SLOPE = 0.15
_DETECTED = np.array([0.7, 0.9, 0.6, 0.45, 0.3, 0.2, 0.1])


class Rates(NamedTuple):
    found: Float[Array, " states"]
    missed: Float[Array, " states"]
    own: Float[Array, " bins"]
    other: Float[Array, " bins"]
    frames: Float[Array, ""]

    @classmethod
    def none(cls) -> "Rates":
        states = jnp.zeros(len(_DETECTED), default_float())
        bins = jnp.zeros(_BINS, default_float())
        return cls(states, states, bins, bins, jnp.zeros((), default_float()))

    def log_odds_detected(self, states: Int[Array, " m"]) -> Float[Array, " m"]:
        prior = jnp.asarray(_DETECTED, self.found.dtype)
        odds = jnp.log(self.found + PRIOR * prior) - jnp.log(self.missed + PRIOR * (1 - prior))
        return take(odds, states)

    def log_odds_own(self, bins: Int[Array, " d"], share: float) -> Float[Array, " d"]:
        centres = jnp.asarray(_CENTRES, self.own.dtype)
        prior = jax.nn.sigmoid((centres - share) / _SLOPE)
        number = self.own + self.other + PRIOR
        p = rising((self.own + PRIOR * prior) / number, number)
        return take(jax.scipy.special.logit(p), bins)

    @property
    def share_detected(self):
        found = jnp.sum(self.found[1:]) + PRIOR
        return found / (found + jnp.sum(self.missed[1:]) + 1.0)

    @property
    def number_detected(self) -> Float[Array, ""]:
        return jnp.maximum((jnp.sum(self.own) + PRIOR) / (self.frames + 1), 1.0)

    def after(self, states, alive, detected, bins, others, owned) -> "Rates":
        def by_state(which):
            return jnp.sum(jax.nn.one_hot(states, len(_DETECTED)) * which[:, None], axis=0)

        def by_bin(which):
            return jnp.sum(jax.nn.one_hot(bins, _BINS) * which[:, None], axis=0)

        return Rates(
            KEPT * self.found + by_state(alive & detected),
            KEPT * self.missed + by_state(alive & ~detected),
            KEPT * self.own + by_bin(owned),
            KEPT * self.other + by_bin(others),
            KEPT * self.frames + 1,
        )


def states_of(confirmed: Bool[Array, " m"], unseen: Int[Array, " m"]) -> Int[Array, " m"]:
    k = jnp.sum(unseen[:, None] >= jnp.array([1, 2, 4, 8, 16])[None], axis=1)
    return jnp.where(confirmed, 1 + k, 0).astype(jnp.int32)


def bins_of(shares: Float[Array, " d"]) -> Int[Array, " d"]:
    return jnp.clip((shares * _BINS).astype(jnp.int32), 0, _BINS - 1)
