"""The dynamics of a vector from frame to frame: random walk, second-order autoregression."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from mpfjax.checks import (
    check_finite_array,
    check_positive_array,
    check_rows,
    check_scalars,
    check_shape,
    to_array,
)
from mpfjax.operations.matrices import cholesky, row_sums, solve_lower
from mpfjax.operations.random import normal


class AbstractDynamics(eqx.Module):
    """D(x_t | x_{t-1}, x_{t-2}) of a vector: a part of a model, not a model itself.

    There is one set of parameters for all particles, or one for each, along a leading axis. If
    `order` is 2, a model keeps the past of x_t in its state too: x_{t-1}, or the value of
    `remembered`, which is then `previous` in the next step.
    """

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """How many past values x_t depends on, 1 or 2."""

    @property
    @abc.abstractmethod
    def is_shared(self) -> bool:
        """Whether there is one set of parameters for all particles."""

    @property
    @abc.abstractmethod
    def noise_dimension(self) -> int:
        """k, how many standard normal numbers x_t is made of."""

    @abc.abstractmethod
    def from_noise(
        self,
        noise: Float[Array, "n k"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, "n d"]:
        """x_t given x_{t-1}, and x_{t-2} where the order is 2, made of standard normal noise."""

    def sample(
        self,
        key: Key[Array, ""],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, "n d"]:
        """x_t given x_{t-1}, and x_{t-2} where the order is 2: `from_noise` of fresh noise."""
        shape = (current.shape[0], self.noise_dimension)
        return self.from_noise(normal(key, shape, current.dtype), current, previous)

    @abc.abstractmethod
    def log_density(
        self,
        following: Float[Array, "n d"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, " n"]:
        """log D(x_t | x_{t-1}, x_{t-2}), with x_t in `following`."""

    @abc.abstractmethod
    def moments(
        self, current: Float[Array, "n d"], previous: Float[Array, "n d"] | None = None
    ) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
        """Mean and standard deviation of every coordinate of x_t."""

    def remembered(
        self,
        following: Float[Array, "n d"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None,
    ) -> Float[Array, "n d"] | None:
        """The past of x_t, in `following`: x_{t-1} where the order is 2, and None where it is 1."""
        del following, previous
        return current if self.order == 2 else None

    def initial_past(
        self, key: Key[Array, ""], current: Float[Array, "n d"]
    ) -> Float[Array, "n d"] | None:
        """The past of x_0: x_0 itself where the order is 2, which then stands still."""
        del key
        return current if self.order == 2 else None


class AbstractRandomWalk(AbstractDynamics):
    """Dynamics whose expected x_t is x_{t-1}, with steps of given `deviations`."""

    deviations: eqx.AbstractVar[Float[Array, "*n d"]]

    @property
    def order(self) -> int:
        """1."""
        return 1

    @property
    def is_shared(self) -> bool:
        """Whether `deviations` is one row for all."""
        return self.deviations.ndim == 1


class RandomWalk(AbstractRandomWalk):
    """x_t = x_{t-1} + diag(deviations) ω_t, ω_t ~ N(0, I).

    Vermaak et al. (2003), section 5.2. `deviations`: (d,), or (n, d) with a row for each
    particle, in units of the state a frame. Raises `ValueError` where one is not positive. Use
    it where the last motion says little about the next.
    """

    deviations: Float[Array, "*n d"] = eqx.field(converter=to_array("deviations"))

    def __check_init__(self) -> None:
        check_positive_array(deviations=self.deviations)
        check_rows(deviations=self.deviations)

    @property
    def noise_dimension(self) -> int:
        """d."""
        return self.deviations.shape[-1]

    def from_noise(
        self,
        noise: Float[Array, "n d"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, "n d"]:
        """x_{t-1} plus noise."""
        del previous
        check_shape(f"n {current.shape[1]}", noise=noise)
        return current + jnp.broadcast_to(self.deviations, current.shape) * noise

    def log_density(
        self,
        following: Float[Array, "n d"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, " n"]:
        """log N(x_t; x_{t-1}, diag(deviations²))."""
        del previous
        deviations = jnp.broadcast_to(self.deviations, current.shape)
        noise = (following - current) / deviations
        return _log_standard_normal(noise) - row_sums(jnp.log(deviations))

    def moments(
        self, current: Float[Array, "n d"], previous: Float[Array, "n d"] | None = None
    ) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
        """x_{t-1}, and `deviations`."""
        del previous
        return current, jnp.broadcast_to(self.deviations, current.shape)


class Autoregression(AbstractDynamics):
    """x_t - x̄ = A1 (x_{t-1} - x̄) + A2 (x_{t-2} - x̄) + B ω_t, ω_t ~ N(0, I).

    Lin et al. (2012), eq. 4. The state returns to x̄. With A1 + A2 = I, as in `with_momentum`, x̄
    cancels, and the state returns nowhere.

    - `A1`, `A2`, `B`: (d, d); `mean`: x̄, (d,); or each with a leading axis, a set for each
      particle. `log_density` needs an invertible B.

    Raises `ValueError` for shapes that do not fit together. Use it for objects whose speed and
    direction last over several frames.
    """

    A1: Float[Array, "*n d d"] = eqx.field(converter=to_array("A1"))
    A2: Float[Array, "*n d d"] = eqx.field(converter=to_array("A2"))
    B: Float[Array, "*n d d"] = eqx.field(converter=to_array("B"))
    mean: Float[Array, "*n d"] = eqx.field(converter=to_array("mean"))

    def __check_init__(self) -> None:
        check_rows(mean=self.mean)
        check_finite_array(mean=self.mean)
        expected = (*self.mean.shape, self.mean.shape[-1])
        for name in ("A1", "A2", "B"):
            if getattr(self, name).shape != expected:
                raise ValueError(
                    f"{name}: shape {getattr(self, name).shape} is not {expected},"
                    f" for a mean of shape {self.mean.shape}"
                )
            check_finite_array(**{name: getattr(self, name)})

    @classmethod
    def with_momentum(cls, momentum: float, deviations: Float[Array, "*n d"]) -> "Autoregression":
        """x_t = x_{t-1} + momentum (x_{t-1} - x_{t-2}) + diag(deviations) ω_t.

        Momentum 1 is constant velocity, 0 the random walk; Smith and Gatica-Perez (2004) have 0.5.
        `deviations` are one row for all, or a row for each particle or box, as in `RandomWalk`.
        """
        kept = to_array("momentum")(momentum)
        check_scalars(momentum=kept)
        check_finite_array(momentum=kept)
        deviations = to_array("deviations")(deviations)
        check_positive_array(deviations=deviations)
        check_rows(deviations=deviations)
        d = deviations.shape[-1]
        eye = jnp.broadcast_to(jnp.eye(d, dtype=deviations.dtype), (*deviations.shape, d))
        zero = jnp.zeros_like(deviations)
        return cls((1 + kept) * eye, -kept * eye, deviations[..., None] * eye, zero)

    @property
    def order(self) -> int:
        """2."""
        return 2

    @property
    def is_shared(self) -> bool:
        """Whether there is one set of matrices for all."""
        return self.mean.ndim == 1

    @property
    def noise_dimension(self) -> int:
        """d."""
        return self.mean.shape[-1]

    def from_noise(
        self,
        noise: Float[Array, "n d"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, "n d"]:
        """The expected x_t plus B ω_t."""
        check_shape(f"n {current.shape[1]}", noise=noise)
        return self.moments(current, previous)[0] + _times(self.B, noise)

    def log_density(
        self,
        following: Float[Array, "n d"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, " n"]:
        """log N(x_t; the expected x_t, B Bᵀ)."""
        residuals = following - self.moments(current, previous)[0]
        B = self.B[None] if self.is_shared else self.B
        factors = cholesky(jnp.sum(B[:, :, None] * B[:, None], axis=3))
        log_volume = jnp.sum(jnp.log(jnp.diagonal(factors, axis1=1, axis2=2)), axis=1)
        return _log_standard_normal(solve_lower(factors, residuals)) - log_volume

    def moments(
        self, current: Float[Array, "n d"], previous: Float[Array, "n d"] | None = None
    ) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
        """x̄ + A1 (x_{t-1} - x̄) + A2 (x_{t-2} - x̄), and the roots of the diagonal of B Bᵀ."""
        if previous is None:
            raise ValueError("previous: an Autoregression needs x_{t-2}")
        mean = jnp.broadcast_to(self.mean, current.shape)
        expected = mean + _times(self.A1, current - mean) + _times(self.A2, previous - mean)
        deviations = jnp.sqrt(jnp.sum(self.B**2, axis=-1))
        return expected, jnp.broadcast_to(deviations, current.shape)


def _times(matrices: Float[Array, "*n d d"], vectors: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """A x of every row, as sums, which XLA fuses; it does not fuse many tiny matrix products."""
    if matrices.ndim == 2:
        return vectors @ matrices.T
    return jnp.sum(matrices * vectors[:, None, :], axis=2)


def _log_standard_normal(noise: Float[Array, "n d"]) -> Float[Array, " n"]:
    return row_sums(-0.5 * noise**2 - 0.5 * jnp.log(2 * jnp.pi))
