"""Maps between a parameter's domain and unconstrained coordinates, in which optimisers step."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mpfjax.checks import Checked, Finite


class AbstractTransform(Checked):
    """A smooth bijection between the domain of a parameter and all real numbers."""

    @abc.abstractmethod
    def constrain(self, reals: Float[Array, "..."]) -> Float[Array, "..."]:
        """The parameter, or a stack of them, inside its domain for any real numbers."""

    @abc.abstractmethod
    def unconstrain(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The real numbers that correspond to this parameter."""

    @abc.abstractmethod
    def contains(self, value: Float[np.ndarray, "..."]) -> bool:
        """Whether every entry is inside the domain."""

    @abc.abstractmethod
    def log_jacobian(self, reals: Float[Array, "..."]) -> Float[Array, ""]:
        """log |det ∂x/∂u|, which converts a density of x into one of u."""


class Unconstrained(AbstractTransform):
    """The parameter as it is."""

    def constrain(self, reals: Float[Array, "..."]) -> Float[Array, "..."]:
        """The argument itself."""
        return reals

    def unconstrain(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The argument itself."""
        return value

    def contains(self, value: Float[np.ndarray, "..."]) -> bool:
        """Whether it is finite."""
        return bool(np.isfinite(value).all())

    def log_jacobian(self, reals: Float[Array, "..."]) -> Float[Array, ""]:
        """0."""
        return jnp.zeros((), reals.dtype)


class Positive(AbstractTransform):
    """exp: for scales; a step of the optimiser is then a relative change."""

    def constrain(self, reals: Float[Array, "..."]) -> Float[Array, "..."]:
        """exp u, between the smallest normal number and the largest number."""
        limits = jnp.finfo(reals.dtype)
        # One step inside, so that rounding does not leave the range.
        ends = np.log([float(limits.tiny), float(limits.max)]).astype(reals.dtype)
        first, last = np.nextafter(ends, ends[::-1])
        return jnp.exp(jnp.clip(reals, first, last))

    def unconstrain(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """log x."""
        return jnp.log(value)

    def contains(self, value: Float[np.ndarray, "..."]) -> bool:
        """Whether all entries are positive and finite, and none subnormal, which is zero to XLA."""
        least = np.finfo(value.dtype).tiny if np.issubdtype(value.dtype, np.floating) else 1
        return bool((np.isfinite(value) & (value >= least)).all())

    def log_jacobian(self, reals: Float[Array, "..."]) -> Float[Array, ""]:
        """The sum of u."""
        return jnp.sum(reals)


class Interval(AbstractTransform):
    """low + (high - low) sigmoid(u): for correlations, rates and single probabilities.

    Raises `ValueError` for an empty interval, and for ends that are not finite numbers.
    """

    low: Finite = eqx.field(static=True)
    high: Finite = eqx.field(static=True)

    def __check_init__(self) -> None:
        super().__check_init__()
        if not self.low < self.high:
            raise ValueError(f"high: {self.high} is not above low, {self.low}")

    def constrain(self, reals: Float[Array, "..."]) -> Float[Array, "..."]:
        """Between the ends, and never rounded to one of them."""
        inside = self.low + (self.high - self.low) * jax.nn.sigmoid(reals)
        # To the first and last number between the ends that is neither an end nor subnormal.
        low, high = np.asarray([self.low, self.high], inside.dtype)
        tiny = np.finfo(inside.dtype).tiny
        first, last = np.nextafter(low, high), np.nextafter(high, low)
        return jnp.clip(inside, first if low != 0 else tiny, last if high != 0 else -tiny)

    def unconstrain(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The logit of the relative position between the ends."""
        return jnp.log(value - self.low) - jnp.log(self.high - value)

    def contains(self, value: Float[np.ndarray, "..."]) -> bool:
        """Whether all entries are strictly between the ends."""
        return bool(((value > self.low) & (value < self.high)).all())

    def log_jacobian(self, reals: Float[Array, "..."]) -> Float[Array, ""]:
        """The sum of log((high - low) sigmoid(u) sigmoid(-u))."""
        slopes = jax.nn.log_sigmoid(reals) + jax.nn.log_sigmoid(-reals)
        return jnp.sum(slopes + jnp.log(jnp.asarray(self.high - self.low, reals.dtype)))


class Simplex(AbstractTransform):
    """Softmax along the last axis: for probabilities, and histograms, that sum to one.

    The last logit is fixed at zero, so that k probabilities are k - 1 real numbers.
    """

    def constrain(self, reals: Float[Array, "..."]) -> Float[Array, "..."]:
        """Positive entries that sum to one, none less than the least normal number."""
        shares = jax.nn.softmax(_with_last(reals), axis=-1)
        return jnp.maximum(shares, jnp.finfo(shares.dtype).tiny)

    def unconstrain(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Logits relative to the last entry's."""
        logits = jnp.log(value)
        return logits[..., :-1] - logits[..., -1:]

    def contains(self, value: Float[np.ndarray, "..."]) -> bool:
        """Whether all entries are positive and sum to one along the last axis."""
        if np.ndim(value) == 0:
            return False
        return bool((value > 0).all() and np.allclose(np.sum(value, axis=-1), 1.0, atol=1e-4))

    def log_jacobian(self, reals: Float[Array, "..."]) -> Float[Array, ""]:
        """The sum of all log probabilities: of the first k - 1 entries in the logits."""
        return jnp.sum(jax.nn.log_softmax(_with_last(reals), axis=-1))


def _with_last(reals: Float[Array, "... k"]) -> Float[Array, "... k1"]:
    """All logits, the last one zero."""
    last = jnp.zeros((*reals.shape[:-1], 1), reals.dtype)
    return jnp.concatenate([reals, last], axis=-1)
