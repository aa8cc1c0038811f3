"""Dynamics of a vector: random walks, with jumps or a velocity, and second-order autoregression."""

import abc
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from mpfjax.arrays import FINITE, NOT_NEGATIVE, POSITIVE, Fitting, to_array, to_numbers
from mpfjax.checks import SHARES, InnerShare
from mpfjax.models.gaussians import log_normal
from mpfjax.operations.matrices import cholesky, row_sums, solve_lower
from mpfjax.operations.random import fast_key, normal, split

Rows = Float[Array, "n d"]
Deviations = Annotated[Float[Array, "*n d"], POSITIVE]


class AbstractDynamics(Fitting):
    """D(x_t | x_{t-1}, x_{t-2}) of a vector: a part of a model, not a model itself.

    A class defines the `expected` x_t and the distribution of the step from there to x_t. There is
    one set of parameters for all particles, or one for each, along a leading axis. If `order`, the
    number of past values on which x_t depends, is 2, the state of a model also contains the past of
    x_t: x_{t-1}, or the value of `remembered`, which is then `previous` in the next step.
    """

    order = 1

    @property
    def is_shared(self) -> bool:
        """Whether there is one set of parameters for all particles."""
        return len(self.shape) == 1

    @property
    def noise_dimension(self) -> int:
        """k, the number of standard normal numbers from which x_t is computed."""
        return self.shape[-1]

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, ...]:
        """(d,), or (n, d) if each particle has its own parameters."""

    @abc.abstractmethod
    def expected(self, current: Rows, previous: Rows | None) -> Rows:
        """The value from which x_t steps, given x_{t-1}, and x_{t-2} if the order is 2."""

    @abc.abstractmethod
    def step(self, noise: Float[Array, "n k"]) -> Rows:
        """The step of each row, a function of standard normal noise."""

    @abc.abstractmethod
    def log_step(self, steps: Rows) -> Float[Array, " n"]:
        """The log-density of a step."""

    def sample_step(self, key: Key[Array, ""], num_rows: int, dtype: jnp.dtype) -> Rows:
        """Steps from new noise."""
        return self.step(normal(key, (num_rows, self.noise_dimension), dtype))

    def from_noise(
        self, noise: Float[Array, "n k"], current: Rows, previous: Rows | None = None
    ) -> Rows:
        """x_t given x_{t-1}, and x_{t-2} if the order is 2, from standard normal noise."""
        return self.expected(current, previous) + self.step(noise)

    def sample(self, key: Key[Array, ""], current: Rows, previous: Rows | None = None) -> Rows:
        """x_t given x_{t-1}, and x_{t-2} where the order is 2."""
        return self.expected(current, previous) + self.sample_step(key, len(current), current.dtype)

    def log_density(
        self, following: Rows, current: Rows, previous: Rows | None = None
    ) -> Float[Array, " n"]:
        """log D(x_t | x_{t-1}, x_{t-2}), with x_t in `following`."""
        return self.log_step(following - self.expected(current, previous))

    def remembered(self, following: Rows, current: Rows, previous: Rows | None) -> Rows | None:
        """The past of x_t, in `following`: x_{t-1} where the order is 2, and None where it is 1."""
        return current if self.order == 2 else None

    def initial_past(self, key: Key[Array, ""], current: Rows) -> Rows | None:
        """The past of x_0: x_0 itself where the order is 2, which then stands still."""
        return current if self.order == 2 else None


class RandomWalk(AbstractDynamics):
    """x_t = x_{t-1} + diag(deviations) ω_t, ω_t ~ N(0, I).

    Vermaak et al. (2003), section 5.2. `deviations`: (d,), or (n, d) with a row for each
    particle, in units of the state a frame. Raises `ValueError` where one is not positive. Use
    it where the last motion says little about the next.
    """

    deviations: Deviations = eqx.field(converter=to_array("deviations"))

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of `deviations`."""
        return self.deviations.shape

    def expected(self, current: Rows, previous: Rows | None) -> Rows:
        """x_{t-1}."""
        return current

    def step(self, noise: Float[Array, "n k"]) -> Rows:
        """The noise in units of `deviations`."""
        return jnp.broadcast_to(self.deviations, noise.shape) * noise

    def log_step(self, steps: Rows) -> Float[Array, " n"]:
        """log N(step; 0, diag(deviations²))."""
        return _log_normal(steps, self.deviations)


class RandomWalkWithJumps(RandomWalk):
    """x_t = x_{t-1} + diag(s) ω_t, ω_t ~ N(0, I), where s is large with a small probability.

    The contaminated normal distribution of Tukey (1960) as dynamics: (1 - p) N(x_{t-1},
    diag(deviations²)) + p N(x_{t-1}, diag(jump_deviations²)). A few particles jump, and recover an
    object that was hidden for some frames, or that the filter lost to a similar object. The
    recursion remains exact.

    - `deviations`, `jump_deviations`: standard deviations of an ordinary and of a long step, (d,),
      or (n, d) with a row for each particle, in units of the state per frame.
    - `jump_probability`: p.

    Raises `ValueError` for a deviation that is not positive, for deviations of different shapes,
    and for a probability outside (0, 1). Use it if objects disappear and reappear elsewhere.
    """

    jump_deviations: Deviations = eqx.field(converter=to_array("jump_deviations"))
    jump_probability: InnerShare = eqx.field(static=True)

    @property
    def noise_dimension(self) -> int:
        """d, and one number that decides which particles jump."""
        return self.deviations.shape[-1] + 1

    def step(self, noise: Float[Array, "n k"]) -> Rows:
        """A step, long for the particles that jump."""
        jumps = jax.scipy.special.ndtr(noise[:, -1:]) < self.jump_probability
        return self._step(jumps, noise[:, :-1])

    def sample_step(self, key: Key[Array, ""], num_rows: int, dtype: jnp.dtype) -> Rows:
        """Steps whose lengths and directions are drawn from separate keys."""
        key_noise, key_jump = split(key, 2)
        # In one row, which is drawn fast; the numbers are those of n rows.
        jumps = jax.random.bernoulli(fast_key(key_jump), self.jump_probability, (num_rows,))
        noise = normal(key_noise, (num_rows, self.deviations.shape[-1]), dtype)
        return self._step(jumps[:, None], noise)

    def _step(self, jumps: Bool[Array, "n 1"], noise: Rows) -> Rows:
        short, long = self.deviations, self.jump_deviations
        both = jnp.broadcast_to(long, noise.shape), jnp.broadcast_to(short, noise.shape)
        return jnp.where(jumps, *both) * noise

    def log_step(self, steps: Rows) -> Float[Array, " n"]:
        """log of the mixture of the two normal densities."""
        short, long = _log_normal(steps, self.deviations), _log_normal(steps, self.jump_deviations)
        log_odds = jnp.log(jnp.array([1 - self.jump_probability, self.jump_probability]))
        log_odds = log_odds.astype(short.dtype)
        return jnp.logaddexp(log_odds[0] + short, log_odds[1] + long)


class WalkWithVelocity(AbstractDynamics):
    """x_t = x_{t-1} + v_{t-1} + e_t and v_t = v_{t-1} + gain · e_t, with e_t a step of `walk`.

    The local linear trend in innovations form: Holt's smoothing as a model (Hyndman, Koehler, Ord
    and Snyder 2008, chapter 3, with α = 1). v is the steady-state Kalman mean of a velocity that is
    itself a random walk, so that a particle carries its velocity without sampling it. With a gain
    of 0, v never changes; with 1, it is the last displacement.

    A model that stores the past stores x_t - v_t: the position of x_{t-1} if it had moved at this
    velocity (`remembered`).

    - `walk`: the noise of x_t, a `RandomWalk` or `RandomWalkWithJumps`.
    - `gain`: in [0, 1], a number or one per coordinate. v averages over about 1 / gain steps.
    - `initial_velocity`: standard deviations of v_0 about 0, in the shape of the walk's deviations,
      in units of the state per frame.

    Raises `ValueError` for a gain outside [0, 1] and a negative deviation. Use it if objects keep
    their velocity: similar objects that cross retain their identities, and a hidden object moves
    on.
    """

    order = 2

    walk: RandomWalk
    gain: Annotated[tuple[float, ...], SHARES] = eqx.field(
        static=True, converter=to_numbers("gain")
    )
    initial_velocity: Annotated[Float[Array, "*n d"], NOT_NEGATIVE] = eqx.field(
        converter=to_array("initial_velocity")
    )

    @property
    def noise_dimension(self) -> int:
        """The noise dimension of the walk."""
        return self.walk.noise_dimension

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the walk."""
        return self.walk.shape

    def expected(self, current: Rows, previous: Any) -> Rows:
        """x_{t-1} + v_{t-1}."""
        return 2 * current - previous

    def step(self, noise: Float[Array, "n k"]) -> Rows:
        """A step of the walk."""
        return self.walk.step(noise)

    def log_step(self, steps: Rows) -> Float[Array, " n"]:
        """The log-density of a step of the walk."""
        return self.walk.log_step(steps)

    def sample_step(self, key: Key[Array, ""], num_rows: int, dtype: jnp.dtype) -> Rows:
        """A step, as the walk draws it."""
        return self.walk.sample_step(key, num_rows, dtype)

    def remembered(self, following: Rows, current: Rows, previous: Rows | None) -> Rows:
        """x_t - v_t, with v_t = v_{t-1} + gain · (x_t - x_{t-1} - v_{t-1})."""
        expected = self.expected(current, previous)
        gain = jnp.asarray(self.gain, current.dtype)[None]
        return following - (expected - current) - gain * (following - expected)

    def initial_past(self, key: Key[Array, ""], current: Rows) -> Rows:
        """x_0 - v_0, with v_0 ~ N(0, diag(initial_velocity²))."""
        deviations = jnp.broadcast_to(self.initial_velocity, current.shape)
        return current - deviations * normal(key, current.shape, current.dtype)


class Autoregression(AbstractDynamics):
    """x_t - x̄ = A1 (x_{t-1} - x̄) + A2 (x_{t-2} - x̄) + B ω_t, ω_t ~ N(0, I).

    Lin et al. (2012), eq. 4. The state reverts to x̄. With A1 + A2 = I, as in `with_momentum`, x̄
    cancels, and the state does not revert.

    - `A1`, `A2`, `B`: (d, d); `mean`: x̄, (d,); or each with a leading axis, one set for each
      particle. `log_density` requires an invertible B.

    Raises `ValueError` for shapes that do not agree. Use it for objects whose speed and direction
    persist over several frames.
    """

    order = 2

    A1: Annotated[Float[Array, "*n d d"], FINITE] = eqx.field(converter=to_array("A1"))
    A2: Annotated[Float[Array, "*n d d"], FINITE] = eqx.field(converter=to_array("A2"))
    B: Annotated[Float[Array, "*n d d"], FINITE] = eqx.field(converter=to_array("B"))
    mean: Annotated[Float[Array, "*n d"], FINITE] = eqx.field(converter=to_array("mean"))

    @classmethod
    def with_momentum(cls, momentum: float, deviations: Float[Array, "*n d"]) -> "Autoregression":
        """x_t = x_{t-1} + momentum (x_{t-1} - x_{t-2}) + diag(deviations) ω_t.

        Momentum 1 is constant velocity, 0 the random walk; Smith and Gatica-Perez (2004) use 0.5.
        `deviations` are one row for all, or a row for each particle or box, as in `RandomWalk`.
        """
        momentum = to_array("momentum")(momentum)
        deviations = RandomWalk(deviations).deviations
        d = deviations.shape[-1]
        eye = jnp.broadcast_to(jnp.eye(d, dtype=deviations.dtype), (*deviations.shape, d))
        zero = jnp.zeros_like(deviations)
        return cls((1 + momentum) * eye, -momentum * eye, deviations[..., None] * eye, zero)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the mean."""
        return self.mean.shape

    def expected(self, current: Rows, previous: Any) -> Rows:
        """x̄ + A1 (x_{t-1} - x̄) + A2 (x_{t-2} - x̄)."""
        mean = jnp.broadcast_to(self.mean, current.shape)
        return mean + _times(self.A1, current - mean) + _times(self.A2, previous - mean)

    def step(self, noise: Float[Array, "n k"]) -> Rows:
        """B ω_t."""
        return _times(self.B, noise)

    def log_step(self, steps: Rows) -> Float[Array, " n"]:
        """log N(step; 0, B Bᵀ)."""
        B = self.B[None] if self.is_shared else self.B
        factors = cholesky(jnp.sum(B[:, :, None] * B[:, None], axis=3))
        log_volume = jnp.sum(jnp.log(jnp.diagonal(factors, axis1=1, axis2=2)), axis=1)
        return row_sums(log_normal(solve_lower(factors, steps), 1.0)) - log_volume


def _times(matrices: Float[Array, "*n d d"], vectors: Rows) -> Rows:
    """A x of every row, as sums, which XLA fuses; it does not fuse many tiny matrix products."""
    if matrices.ndim == 2:
        return vectors @ matrices.T
    return jnp.sum(matrices * vectors[:, None, :], axis=2)


def _log_normal(steps: Rows, deviations: Float[Array, "*n d"]) -> Float[Array, " n"]:
    return row_sums(log_normal(steps, jnp.broadcast_to(deviations, steps.shape)))
