"""A random walk that sometimes takes a long step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from mpfjax.checks import check_inner_share, check_positive_array, check_rows, check_shape, to_array
from mpfjax.models.dynamics import AbstractRandomWalk, RandomWalk
from mpfjax.operations.random import fast_key, normal, split_once


class RandomWalkWithJumps(AbstractRandomWalk):
    """x_t = x_{t-1} + diag(s) ω_t, ω_t ~ N(0, I); s is long with a small probability.

    The contaminated normal of Tukey (1960) as dynamics: (1 - p) N(x_{t-1}, diag(deviations²))
    + p N(x_{t-1}, diag(jump_deviations²)). A few particles jump. They find an object again that
    was hidden for some frames, or that the filter lost to a look-alike. The recursion stays exact.

    - `deviations`, `jump_deviations`: standard deviations of an ordinary and of a long step, (d,),
      or (n, d) with a row for each particle, in units of the state per frame.
    - `jump_probability`: p.

    Raises `ValueError` for a deviation that is not positive, for deviations of different shapes,
    and for a probability outside (0, 1). Use it where objects vanish and come back elsewhere.
    """

    deviations: Float[Array, "*n d"] = eqx.field(converter=to_array("deviations"))
    jump_deviations: Float[Array, "*n d"] = eqx.field(converter=to_array("jump_deviations"))
    jump_probability: float = eqx.field(static=True, default=0.03)

    def __check_init__(self) -> None:
        check_positive_array(deviations=self.deviations, jump_deviations=self.jump_deviations)
        check_rows(deviations=self.deviations)
        if self.jump_deviations.shape != self.deviations.shape:
            raise ValueError(
                f"jump_deviations: shape {self.jump_deviations.shape} is not that of deviations,"
                f" {self.deviations.shape}"
            )
        check_inner_share(jump_probability=self.jump_probability)

    @property
    def noise_dimension(self) -> int:
        """d, and one number that decides which particles jump."""
        return self.deviations.shape[-1] + 1

    def from_noise(
        self,
        noise: Float[Array, "n k"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, "n d"]:
        """x_{t-1} plus a step, long for the particles that jump."""
        del previous
        check_shape(f"n {current.shape[1] + 1}", noise=noise)
        jumps = jax.scipy.special.ndtr(noise[:, -1:]) < self.jump_probability
        return self._moved(jumps, noise[:, :-1], current)

    def sample(
        self,
        key: Key[Array, ""],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, "n d"]:
        """The same, from keys of their own for the jumps and the steps."""
        del previous
        key_noise, key_jump = split_once(key, 2)
        # In one row, which is drawn fast; the numbers are those of n rows.
        jumps = jax.random.bernoulli(fast_key(key_jump), self.jump_probability, current.shape[:1])
        return self._moved(jumps[:, None], normal(key_noise, current.shape, current.dtype), current)

    def _moved(
        self, jumps: Bool[Array, "n 1"], noise: Float[Array, "n d"], current: Float[Array, "n d"]
    ) -> Float[Array, "n d"]:
        steps = jnp.where(
            jumps,
            jnp.broadcast_to(self.jump_deviations, current.shape),
            jnp.broadcast_to(self.deviations, current.shape),
        )
        return current + steps * noise

    def log_density(
        self,
        following: Float[Array, "n d"],
        current: Float[Array, "n d"],
        previous: Float[Array, "n d"] | None = None,
    ) -> Float[Array, " n"]:
        """log of the mixture of the two normal densities."""
        del previous
        stays = RandomWalk(self.deviations).log_density(following, current)
        jumps = RandomWalk(self.jump_deviations).log_density(following, current)
        log_odds = jnp.log(jnp.array([1 - self.jump_probability, self.jump_probability]))
        log_odds = log_odds.astype(stays.dtype)
        return jnp.logaddexp(log_odds[0] + stays, log_odds[1] + jumps)

    def moments(
        self, current: Float[Array, "n d"], previous: Float[Array, "n d"] | None = None
    ) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
        """x_{t-1}, and the deviation of short and long steps together."""
        del previous
        p = self.jump_probability
        variances = (1 - p) * self.deviations**2 + p * self.jump_deviations**2
        return current, jnp.broadcast_to(jnp.sqrt(variances), current.shape)
