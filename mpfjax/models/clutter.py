"""An object in clutter: sets of measurements of which at most one is caused by the object."""

from collections.abc import Callable
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PyTree

from mpfjax.arrays import POSITIVE, Fitting, to_array
from mpfjax.checks import SHARES
from mpfjax.models.base import AbstractStateSpaceModel, is_made_of_noise, over_particles
from mpfjax.models.law import law_of, refuse_marginalised
from mpfjax.operations.logarithms import default_float, log_or_nothing
from mpfjax.operations.stored import on_platform

# What the object's model has beside its three methods and its likelihood of one measurement.
PASSED_ON = (
    "log_transition", "log_initial", "with_history", "initial_from_noise", "transition_from_noise",
    "initial_noise_dimension", "noise_dimension", "transition_mean", "transition_covariance",
    "periods",
)  # fmt: skip


def number_or_function(name: str) -> Callable[[Any], Any]:
    """A converter of the argument of this name: numbers to an array, a function as it is."""
    numbers = to_array(name)
    return lambda value: value if callable(value) else numbers(value)


class ClutteredModel(AbstractStateSpaceModel, Fitting):
    """An object that a sensor may miss, in clutter, such as the plots of a radar.

    y_t is a set of measurements y_1, ..., y_k. With probability p_D the object is detected, and one
    of the measurements is caused by it, with density N(y | x) by `object_model`. The others are a
    Poisson process of density λ(y). Summed over all associations, as in the filter of Bar-Shalom
    and Tse (1975),

        L(y_1, ..., y_k | x) = (1 - p_D) + p_D Σ_j N(y_j | x) / λ(y_j).

    This is the density of the set over its density as clutter alone, exp(-∫λ) Π_j λ(y_j), which
    does not depend on x. So log Ẑ estimates the log odds of an object against clutter alone; log
    p(y_1..y_t) is larger by Σ_t (Σ_j log λ(y_j) - ∫λ), which matters if λ is a parameter.

    - `object_model`: its `log_likelihood`, of one measurement, must be the log of a normalised
      density of y; an omitted constant would count as clutter.
    - `detection_probability`: p_D, a number in [0, 1], or a function of the states, (n,), for a
      sensor with a limited field of view.
    - `clutter_density`: λ, the expected number of false measurements per step and unit of the
      measurement space. A positive number, or a function of one measurement.

    u_t reaches the object model, and functions with a field `inputs`, as an `eqx.Module` may have:
    p_D of a sensor that moves, or 0 while it is off.

    Each observation has room for K measurements, leaves (K, ...): rows with a NaN are not
    measurements, and a step without any means that the object was missed. A step in which the
    sensor was off is a missing one, see `Series`. All other properties are those of the object
    model, except for what concerns a single measurement: there is no `observation_mean`, and so no
    `GaussNewtonProposal`. Raises `ValueError` for numbers outside these ranges, and for a
    conditionally linear model: sample regimes with the state, and `GroupBy` them. Use it for one
    object with false alarms. Two objects would claim the same measurement; for several objects use
    `TargetsModel`.
    """

    object_model: AbstractStateSpaceModel
    detection_probability: (
        Annotated[Float[Array, ""], SHARES] | Callable[[PyTree], Float[Array, " n"]]
    ) = eqx.field(converter=number_or_function("detection_probability"))
    clutter_density: (
        Annotated[Float[Array, ""], POSITIVE] | Callable[[PyTree], Float[Array, ""]]
    ) = eqx.field(converter=number_or_function("clutter_density"))

    handles_missing = True
    passes_inputs_to = ("object_model", "detection_probability", "clutter_density")

    def __check_init__(self) -> None:
        super().__check_init__()
        instead, name = "draw its regimes as part of the state", "object_model"
        refuse_marginalised(self.object_model, "ClutteredModel", instead, name)

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """x_0 of the object."""
        return self.object_model.sample_initial(key, num_particles)

    def sample_transition(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """x_t of the object."""
        return self.object_model.sample_transition(key, states)

    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        """log L of the measurements, relative to clutter alone."""
        odds, p = self.log_odds(observation, states), self.detection(states)
        # Chances of 0 and 1 have no logarithm, but the likelihood has a derivative there.
        largest = jax.lax.stop_gradient(jnp.maximum(jnp.max(odds, axis=1, initial=0.0), 0.0))
        missed = (1 - p) * jnp.exp(-largest)
        detected = p * jnp.sum(jnp.exp(odds - largest[:, None]), axis=1)
        return largest + log_or_nothing(missed + detected)

    def log_odds(self, observation: PyTree, states: PyTree) -> Float[Array, "n k"]:
        """log N(y_j | x) / λ(y_j) of each state and each measurement, -inf for an empty row."""
        density = self.clutter_density

        def of_one(measurement: PyTree) -> Float[Array, " n"]:
            false = density(measurement) if callable(density) else density
            values = law_of(self.object_model).log_likelihood_of_draws(measurement, states)
            return values - jnp.log(false).astype(values.dtype)

        # On a CPU, each fills the vectors by itself.
        odds = on_platform(
            fill_missing(observation),
            cpu=lambda rows: jax.lax.map(of_one, rows).T,
            default=jax.vmap(of_one, out_axes=1),
        )
        return jnp.where(measurement_mask(observation)[None], odds, -jnp.inf)

    def detection(self, states: PyTree) -> Float[Array, " n"]:
        """p_D of each state."""
        return number_of_each(self.object_model, self.detection_probability, states)

    def __getattr__(self, name: str) -> Any:
        # Only reached for names that the class lacks.
        model, is_of_noise = self.__dict__.get("object_model"), "noise" in name
        state = "initial" if name.startswith("initial") else "transition"
        if name in PASSED_ON and (not is_of_noise or is_made_of_noise(model, state)):
            return getattr(model, name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")


def number_of_each(model: Any, number: Any, states: PyTree) -> Float[Array, " n"]:
    """A number of each state of the model, or the function of the states, in its own terms."""
    values = over_particles(model, number)(states) if callable(number) else number
    return jnp.broadcast_to(values, jax.tree.leaves(states)[0].shape[:1]).astype(default_float())


def measurement_mask(observation: PyTree) -> Bool[Array, " k"]:
    """Which rows are measurements: those without a NaN."""
    leaves = map(jnp.isnan, jax.tree.leaves(observation))
    return ~jnp.any(jnp.stack([leaf.any(tuple(range(1, leaf.ndim))) for leaf in leaves]), axis=0)


def fill_missing(observation: PyTree) -> PyTree:
    """The rows with a number that no logarithm turns into one that is not finite in place of NaN.

    Nor is its gradient.
    """
    return jax.tree.map(
        lambda leaf: jnp.where(jnp.isnan(leaf), jnp.ones_like(leaf), leaf), observation
    )
