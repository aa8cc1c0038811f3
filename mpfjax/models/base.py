"""The interface of a state-space model, and the wrapper for models of one particle."""

import abc
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Key, PyTree


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


def require_positive(**parameters: Any) -> None:
    """Raise a `ValueError` for a parameter that is known not to be positive."""
    for name, value in parameters.items():
        if not isinstance(value, Tracer) and not np.all(np.asarray(value) > 0):
            raise ValueError(f"{name}: {value} is not positive")


class _PerParticleModel(AbstractStateSpaceModel):
    """A model of one particle, mapped over all of them with a key for each."""

    model: Any

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        return jax.vmap(self.model.sample_initial)(jax.random.split(key, num_particles))

    def sample_transition(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        num_particles = jax.tree.leaves(states)[0].shape[0]
        return jax.vmap(self.model.sample_transition)(jax.random.split(key, num_particles), states)

    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        return jax.vmap(self.model.log_likelihood, in_axes=(None, 0))(observation, states)

    def __getattr__(self, name: str) -> Any:
        # Only reached for names that the class lacks: the densities and means that a proposal
        # looks for are there exactly when the wrapped model has them.
        batched_over = {"log_transition": 2, "transition_mean": 1, "observation_mean": 1}
        if name in batched_over:
            return jax.vmap(getattr(self.model, name))
        if name in ("transition_covariance", "observation_covariance"):
            return getattr(self.model, name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")


def per_particle(model: Any) -> AbstractStateSpaceModel:
    """Make a batched model of one that is written for a single particle.

    `model` has `sample_initial(key)`, `sample_transition(key, state)` and
    `log_likelihood(observation, state)`, and where a proposal needs it
    `log_transition(state, previous_state)`, each for one particle. Use it for a first version of
    a model: a key for each particle makes the draws four to five times slower than a batched one.

    Raises `ValueError` where one of the three methods is missing.
    """
    for method in ("sample_initial", "sample_transition", "log_likelihood"):
        require(model, method, "per_particle")
    return _PerParticleModel(model)
