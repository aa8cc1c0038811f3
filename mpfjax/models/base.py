"""The interface of a state-space model, and the wrapper for models of one particle."""

import abc
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import shown
from mpfjax.generator import split


class AbstractStateSpaceModel(eqx.Module):
    """A Markov state x_t seen through observations y_t, all methods batched over particles.

    p(x_0), D(x_t | x_{t-1}) and L(y_t | x_t) of Vermaak et al. (2003), section 2. x_0 is the
    prior, before any observation; the first observation is y_1. States are any pytree whose
    leaves have a leading axis n of particles, and one key serves all n of them, which is several
    times faster than a key for each. Whoever thinks in one particle writes for one and wraps the
    model with `per_particle`.

    A model may also define `log_transition(states, previous_states)`, log D of each particle,
    shape (n,). Guided proposals need it; the bootstrap proposal does not.
    """

    @abc.abstractmethod
    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """Draw x_0 for `num_particles` particles: every leaf has shape (n, ...)."""

    @abc.abstractmethod
    def sample_transition(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """Draw x_t ~ D(. | x_{t-1}) for every particle."""

    @abc.abstractmethod
    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        """log L(y_t | x_t) of every particle, up to a constant shared by all of them."""


@runtime_checkable
class HasTransitionDensity(Protocol):
    """A model that can evaluate its own dynamics, log D(x_t | x_{t-1})."""

    def log_transition(self, states: Any, previous_states: Any) -> Float[Array, " n"]:
        """log D(x_t | x_{t-1}) of every particle."""
        ...


def require(model: Any, method: str, needed_by: str) -> None:
    """Raise a `ValueError` where `model` lacks `method`, before anything compiles."""
    if not callable(getattr(model, method, None)):
        raise ValueError(
            f"model: {type(model).__name__} defines no {method}, which {needed_by} needs"
        )


def check_log_density(
    values: Any, model: Any, method: str, num_particles: int
) -> Float[Array, " n"]:
    """What a density of the model returned; a `ValueError` unless it is one real number each."""
    who = f"model: {type(model).__name__}.{method} returned"
    if not isinstance(values, jax.Array | np.ndarray):
        raise ValueError(
            f"{who} {shown(values)}, not one value a particle, an array of shape ({num_particles},)"
        )
    if values.shape != (num_particles,):
        raise ValueError(
            f"{who} shape {values.shape}, not one value a particle, ({num_particles},)"
        )
    if jnp.issubdtype(values.dtype, jnp.complexfloating):
        raise ValueError(f"{who} complex values ({values.dtype}); a log-density is real")
    return jnp.asarray(values)


def require_positive(**parameters: Any) -> None:
    """Raise a `ValueError` for a parameter that is known not to be positive."""
    for name, value in parameters.items():
        if not isinstance(value, Tracer) and not np.all(np.asarray(value) > 0):
            raise ValueError(f"{name}: {value} is not positive")


# What the library looks for in a model beside the three methods: functions of one particle, and
# what all particles share.
_BATCHED = ("log_transition", "log_initial", "with_history", "transition_mean", "observation_mean")
_SHARED = ("transition_covariance", "observation_covariance", "prepare_observation")


class _PerParticleModel(AbstractStateSpaceModel):
    """A model of one particle, mapped over all of them with a key for each."""

    model: Any

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        return jax.vmap(self.model.sample_initial)(split(key, num_particles))

    def sample_transition(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        num_particles = jax.tree.leaves(states)[0].shape[0]
        return jax.vmap(self.model.sample_transition)(split(key, num_particles), states)

    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        return jax.vmap(self.model.log_likelihood, in_axes=(None, 0))(observation, states)

    def __getattr__(self, name: str) -> Any:
        # Only reached for names that the class lacks: the densities and means that a proposal
        # looks for are there exactly when the wrapped model has them.
        model = self.__dict__.get("model")
        if name in _BATCHED and hasattr(model, name):
            return jax.vmap(getattr(model, name))
        if name in _SHARED and hasattr(model, name):
            return getattr(model, name)
        raise AttributeError(f"{type(model).__name__} (per_particle) has no attribute {name!r}")


def per_particle(model: Any) -> AbstractStateSpaceModel:
    """Make a batched model of one that is written for a single particle.

    `model` has `sample_initial(key)`, `sample_transition(key, state)` and
    `log_likelihood(observation, state)`, each for one particle. What else the library looks for
    in a model is passed on where it is there: `log_transition(state, previous_state)`,
    `log_initial(state)`, `with_history(state, previous_state)`, `transition_mean(state)` and
    `observation_mean(state)`, of one particle as well; `transition_covariance`,
    `observation_covariance` and `prepare_observation(observation)`, as they are. Use it for a first
    version of a model: a key for each particle makes the draws four to five times slower than a
    batched one.

    Raises `ValueError` where one of the three methods is missing.
    """
    for method in ("sample_initial", "sample_transition", "log_likelihood"):
        require(model, method, "per_particle")
    return _PerParticleModel(model)
