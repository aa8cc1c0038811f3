"""Objects that appear and disappear: birth models, and sensors that miss objects among clutter."""

import abc
import math
from collections.abc import Callable, Iterable
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.arrays import FINITE, NOT_NEGATIVE, POSITIVE, Fitting, check_spacing, to_array
from mpfjax.checks import SHARES, is_series
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.clutter import PASSED_ON, ClutteredModel, number_of_each, number_or_function
from mpfjax.operations.matrices import total
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


def _as_sensors(sensors: Any) -> tuple[Any, ...]:
    sensors = tuple(sensors) if is_series(sensors) else (sensors,)
    for sensor in sensors:
        if not isinstance(sensor, ClutteredModel):
            raise ValueError(f"sensors: {sensor!r} is no ClutteredModel")
    return sensors


class TargetsModel(AbstractStateSpaceModel, Fitting):
    """An unknown number of objects that appear, move, disappear, and are detected among clutter.

    In each step an object survives with probability p_S(x_t), and moves by the object model; new
    objects appear as a Poisson process. Each sensor then detects each object with probability
    p_D(x), and reports one measurement of it, among clutter (the model of Mahler 2003, and of
    Williams 2015). A state is the state of one object. `bernoulli_filter` has a component for each.

    - `sensors`: a `ClutteredModel`, of one object's motion, one measurement of it, p_D and the
      clutter; or several, used in turn, of which the first defines the motion.
    - `birth`: the new objects of a step, a `UniformBirth` or another `AbstractBirth`.
    - `survival_probability`: p_S, a number in [0, 1], or a function of the states, (n,).
    - `initial_number`: the expected number of objects at t = 0, with states of the birth model.

    An observation is the same as for `ClutteredModel`, K rows of which those with a NaN are not
    measurements; with several sensors it is a tuple of these. A scan without measurements means
    that every object was missed; a step with all sensors off is a missing one, see `Series`, and a
    single one that is off has p_D = 0. u_t reaches the sensors, and the birth and p_S if they have
    a field `inputs`: a rate may depend on the time since the last scan. log L(y_t | x) assumes that
    x is the only object. A derivative at p_D = 1 is that of one scan: no particle of a missed
    object is left for later ones. Raises `ValueError` for numbers outside these ranges and other
    sensors.
    """

    sensors: tuple[ClutteredModel, ...] = eqx.field(converter=_as_sensors)
    birth: AbstractBirth
    survival_probability: (
        Annotated[Float[Array, ""], SHARES] | Callable[[PyTree], Float[Array, " n"]]
    ) = eqx.field(converter=number_or_function("survival_probability"), default=0.99)
    initial_number: Annotated[Float[Array, ""], NOT_NEGATIVE] = eqx.field(
        converter=to_array("initial_number"), default=0.0
    )

    handles_missing = True
    passes_inputs_to = ("sensors", "birth", "survival_probability")

    def check_moves(self, moves: Iterable[Any]) -> None:
        """Raise a `ValueError` for moves of which none weighs births and deaths, as `Associate`."""
        if not any(getattr(move, "weighs_targets", False) for move in moves):
            what = "model: a TargetsModel, whose births and deaths these moves would leave out"
            raise ValueError(f"{what}; it is for bernoulli_filter")

    def scans(self, observation: PyTree) -> tuple[PyTree, ...]:
        """The measurements of each sensor; a `ValueError` for another number of these."""
        if len(self.sensors) == 1:
            return (observation,)
        if not isinstance(observation, tuple | list) or len(observation) != len(self.sensors):
            each = f"a tuple of measurements for each of {len(self.sensors)} sensors"
            raise ValueError(f"observation: it is not {each}")
        return tuple(observation)

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """States of new objects."""
        return self.birth.sample(key, num_particles)

    def sample_transition(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """x_t of each object."""
        return self.sensors[0].sample_transition(key, states)

    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        """log L of the measurements relative to clutter alone, with x as the only object."""
        scans = zip(self.sensors, self.scans(observation), strict=True)
        return total([sensor.log_likelihood(scan, states) for sensor, scan in scans])

    def survival(self, states: PyTree) -> Float[Array, " n"]:
        """p_S of each state."""
        return number_of_each(self.sensors[0].object_model, self.survival_probability, states)

    def __getattr__(self, name: str) -> Any:
        # Only reached for names that the class lacks.
        if name in PASSED_ON and "initial" not in name:
            return getattr(self.sensors[0], name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
