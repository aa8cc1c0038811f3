"""What everything asks of a model in a step, whether its particles are drawn as a whole or carry
moments: the next states, and their likelihood.
"""

import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import check_type, saying
from mpfjax.mixture import MarginalisedState
from mpfjax.models.base import check_log_density, check_moved, model_name
from mpfjax.models.conditionally_linear import (
    AbstractConditionallyLinearModel,
    emission_of,
    is_marginalised,
    is_mixed,
    latent_from_noise,
    latent_rows,
    observation_rows,
    predicted,
    predicted_gaussian,
    updated,
)
from mpfjax.models.noise import noise_dtype
from mpfjax.operations import gaussians
from mpfjax.operations.random import normal


def moved(key: Key[Array, ""], model: Any, states: PyTree) -> PyTree:
    """x_t of each particle by the model's own law, checked; of a latent, with x predicted."""
    if not is_marginalised(model):
        drawn = model.sample_transition(key, states)
        check_moved(drawn, states, model)
        return drawn
    states = _with_moments(model, states)
    if is_mixed(model):
        num_rows = latent_rows(model, states.latent).shape[0]
        noise = normal(key, (states.mean.shape[0], num_rows), noise_dtype(states))
        latent = latent_from_noise(model, noise, states)
    else:
        latent = model.sample_transition(key, states.latent)
    return predicted(model, latent, states)


def likelihoods(model: Any, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
    """log L(y_t | x_t) of each particle, checked; of a latent, with x integrated out."""
    return functools.reduce(jnp.add, seen(model, observation, states)[1])


def seen(
    model: Any, observation: PyTree, states: PyTree
) -> tuple[PyTree, list[Float[Array, " n"]]]:
    """The states, updated by y_t if they carry moments, and log L as its factors."""
    if not is_marginalised(model):
        return states, [own_likelihoods(model, observation, states)]
    states = _with_moments(model, states)
    log_factors = [own_likelihoods(model, observation, states.latent)]
    states, log_density = updated(model, observation, states)
    if log_density is not None:
        num_particles = states.mean.shape[0]
        log_factors.append(check_log_density(log_density, model, "emission", num_particles))
    return states, log_factors


def own_likelihoods(model: Any, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
    """The model's own `log_likelihood`, of a latent without what is seen of x, checked."""
    leaves = [f"{leaf.dtype}{list(leaf.shape)}" for leaf in jax.tree.leaves(observation)]
    of_what = f"{', '.join(leaves)} in {jax.tree.structure(observation)}"
    who = f"model: {model_name(model)}.log_likelihood"
    with saying(f"in {who}, of an observation (a step of the observations) that is {of_what}"):
        values = model.log_likelihood(observation, states)
    num_particles = jax.tree.leaves(states)[0].shape[0]
    return check_log_density(values, model, "log_likelihood", num_particles)


def log_predictive(
    model: Any, observation: PyTree, latent: PyTree, state: MarginalisedState
) -> Float[Array, " n"]:
    """log p(y_t | z_t, z, y_1..y_{t-1}) of each particle, what is seen of z_t included."""
    log_density = own_likelihoods(model, observation, latent)
    seen = emission_of(model, latent, state)
    if seen is None:
        return log_density
    law = predicted_gaussian(model, latent, state)
    rows = observation_rows(model, observation, seen, state.mean.dtype)
    return log_density + gaussians.update(law, rows, seen)[1]


def _with_moments(model: AbstractConditionallyLinearModel, states: PyTree) -> MarginalisedState:
    what = f"a MarginalisedState, as {model_name(model)} has, which is conditionally linear"
    check_type(MarginalisedState, what, states=states)
    return cast(MarginalisedState, states)
