"""Birth models: how many new objects appear in a step, where, and with which states."""

import abc
import math
from collections.abc import Callable
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.arrays import FINITE, POSITIVE, Fitting, check_spacing, to_array
from mpfjax.operations.random import normal, split, uniform

Rate = Annotated[Float[Array, ""], POSITIVE]


class AbstractBirth(eqx.Module):
    """The Poisson process of new objects in a step: `rate` of them, each with x ~ b.

    A subclass has `rate`, a positive number, `sample`, and `propose`, by which the particles of a
    new object are drawn from a measurement.
    """

    rate: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def sample(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """Draw states of new objects, x ~ b."""

    @abc.abstractmethod
    def propose(
        self, key: Key[Array, ""], measurement: PyTree, num_particles: int, sensor: int
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """States of new objects that may have caused a measurement, and log b(x) / q(x)."""


class Box(Fitting):
    """A region between two corners, in any number of dimensions."""

    low: Annotated[Float[Array, " d"], FINITE] = eqx.field(converter=to_array("low"))
    high: Annotated[Float[Array, " d"], FINITE] = eqx.field(converter=to_array("high"))

    def __check_init__(self) -> None:
        super().__check_init__()
        if not isinstance(self.high, Tracer) and not isinstance(self.low, Tracer):
            check_spacing("high", self.high, np.subtract(self.high, self.low), "the box has")

    def sample(self, key: Key[Array, ""], num_places: int) -> Float[Array, "n d"]:
        """Draw positions uniformly."""
        shares = uniform(key, (num_places, self.low.shape[0]), self.low.dtype)
        return self.low[None] + shares * (self.high - self.low)[None]

    def log_density(self, places: Float[Array, "n d"]) -> Float[Array, " n"]:
        """log of one over the volume, -inf outside."""
        inside = jnp.all((places >= self.low[None]) & (places <= self.high[None]), axis=1)
        return jnp.where(inside, -jnp.sum(jnp.log(self.high - self.low)), -jnp.inf)


class Disc(Fitting):
    """A region around a centre: a disc in two dimensions, a ball in three."""

    centre: Annotated[Float[Array, " d"], FINITE] = eqx.field(converter=to_array("centre"))
    radius: Annotated[Float[Array, ""], POSITIVE] = eqx.field(converter=to_array("radius"))

    def __check_init__(self) -> None:
        super().__check_init__()
        check_spacing("centre", self.centre, self.radius, "the radius is")

    def sample(self, key: Key[Array, ""], num_places: int) -> Float[Array, "n d"]:
        """Draw positions uniformly."""
        key_way, key_far = split(key, 2)
        d, dtype = self.centre.shape[0], self.centre.dtype
        ways = normal(key_way, (num_places, d), dtype)
        far = self.radius * uniform(key_far, (num_places, 1), dtype) ** (1 / d)
        return self.centre[None] + far * ways / jnp.linalg.norm(ways, axis=1, keepdims=True)

    def log_density(self, places: Float[Array, "n d"]) -> Float[Array, " n"]:
        """log of one over the volume, -inf outside."""
        d = self.centre.shape[0]
        inside = jnp.linalg.norm(places - self.centre[None], axis=1) <= self.radius
        log_unit = 0.5 * d * math.log(math.pi) - gammaln(0.5 * d + 1.0)
        return jnp.where(inside, -log_unit - d * jnp.log(self.radius), -jnp.inf)


class UniformBirth(AbstractBirth, Fitting):
    """New objects that are uniform in a region.

    - `rate`: the expected number per step.
    - `region`: a `Box` or a `Disc` of positions.
    - `newborn`: a function `(key, places) -> states` of new objects at these positions, (n, d); it
      draws the rest of the state, such as a velocity.
    - `locate`: a function `(key, measurement, n) -> (places, log_density)`, which draws positions
      that may have caused a measurement, with the log of their density, (n,); one function per
      sensor if there are several.

    Raises `ValueError` for a rate that is not positive. Use it if objects may appear anywhere.
    """

    rate: Rate = eqx.field(converter=to_array("rate"))
    region: Box | Disc
    newborn: Callable[[Key[Array, ""], Array], PyTree]
    locate: Callable[..., tuple] | tuple[Callable[..., tuple], ...]

    def sample(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """States in the region."""
        key_place, key_rest = split(key, 2)
        return self.newborn(key_rest, self.region.sample(key_place, num_particles))

    def propose(
        self, key: Key[Array, ""], measurement: PyTree, num_particles: int, sensor: int
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """States at places drawn by `locate`."""
        locate = self.locate[sensor] if isinstance(self.locate, tuple) else self.locate
        key_place, key_rest = jax.random.split(key)
        places, log_density = locate(key_place, measurement, num_particles)
        return self.newborn(key_rest, places), self.region.log_density(places) - log_density
