"""What everything asks of a model in a step, whether its particles are drawn as a whole or carry
moments: the next states, and their likelihood.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.mixture import MarginalisedState
from mpfjax.models import gaussians
from mpfjax.models.base import asking, check_moved, real_each
from mpfjax.models.conditionally_linear import (
    emission_of,
    is_marginalised,
    is_mixed,
    latent_from_noise,
    latent_rows,
    log_latent_density,
    observation_rows,
    predicted,
    predicted_gaussian,
    updated,
)
from mpfjax.models.noise import noise_dtype
from mpfjax.operations.random import normal


def moved(key: Key[Array, ""], model: Any, states: PyTree) -> PyTree:
    """x_t of each particle by the model's own law, checked; of a latent, with x predicted."""
    return completed(model, drawn(key, model, states), states)


def drawn(key: Key[Array, ""], model: Any, states: PyTree) -> PyTree:
    """What is drawn at random of x_t: all of it, or z_t where the rest has moments."""
    before = drawn_part(model, states)
    if is_mixed(model):
        noise = normal(key, before.shape, noise_dtype(states))
        return latent_from_noise(model, noise, states)
    with asking(model, "sample_transition"):
        draws = model.sample_transition(key, before)
    check_moved(draws, before, model)
    return draws


def made_of(model: Any, noise: Float[Array, "n k"], states: PyTree) -> PyTree:
    """The same, made of this noise."""
    before = drawn_part(model, states)
    if is_mixed(model):
        return latent_from_noise(model, noise, states)
    with asking(model, "transition_from_noise", "of noise_dimension", noise):
        draws = model.transition_from_noise(noise, before)
    check_moved(draws, before, model, "transition_from_noise")
    return draws


def noise_dimension(model: Any, states: PyTree) -> int:
    """k, the number of standard normal numbers that it is made of by the model's own law."""
    if is_mixed(model):
        return latent_rows(model, states.latent).shape[0]
    return model.noise_dimension


def drawn_part(model: Any, states: PyTree) -> PyTree:
    """The part of the particles that is drawn, of x_{t-1} or of x_t."""
    return states.latent if is_marginalised(model) else states


def completed(model: Any, draws: PyTree, states: PyTree) -> PyTree:
    """x_t with what was drawn of it, the moments of the rest predicted from those of x_{t-1}."""
    return predicted(model, draws, states) if is_marginalised(model) else draws


def log_transition(model: Any, draws: PyTree, states: PyTree) -> Float[Array, " n"]:
    """log D of what was drawn of x_t, given x_{t-1}, checked."""
    if is_mixed(model):
        return log_latent_density(model, draws, states)
    with asking(model, "log_transition"):
        values = model.log_transition(draws, drawn_part(model, states))
    num_particles = jax.tree.leaves(draws)[0].shape[0]
    return real_each(values, num_particles, model, "log_transition")


def likelihoods(model: Any, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
    """log L(y_t | x_t) of each particle, checked; of a latent, with x integrated out."""
    return functools.reduce(jnp.add, seen(model, observation, states)[1])


def seen(
    model: Any, observation: PyTree, states: PyTree
) -> tuple[PyTree, list[Float[Array, " n"]]]:
    """The states, updated by y_t if they carry moments, and log L as its factors."""
    if not is_marginalised(model):
        return states, [own_likelihoods(model, observation, states)]
    log_factors = [own_likelihoods(model, observation, states.latent)]
    states, log_density = updated(model, observation, states)
    if log_density is not None:
        num_particles = states.mean.shape[0]
        log_factors.append(real_each(log_density, num_particles, model, "emission"))
    return states, log_factors


def own_likelihoods(model: Any, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
    """The model's own `log_likelihood`, of a latent without what is seen of x, checked."""
    is_list = isinstance(observation, list)
    hint = " (one number of each array in a list; jnp.asarray(observations) is one array)" * is_list
    with asking(model, "log_likelihood", f"the observation{hint}", observation):
        values = model.log_likelihood(observation, states)
    num_particles = jax.tree.leaves(states)[0].shape[0]
    return real_each(values, num_particles, model, "log_likelihood")


def log_predictive(
    model: Any, observation: PyTree, latent: PyTree, state: MarginalisedState
) -> Float[Array, " n"]:
    """log p(y_t | z_t, z, y_1..y_{t-1}) of each particle, what is seen of z_t included."""
    log_density = own_likelihoods(model, observation, latent)
    emission = emission_of(model, latent, state)
    if emission is None:
        return log_density
    law = predicted_gaussian(model, latent, state)
    rows = observation_rows(model, observation, emission, state.mean.dtype)
    return log_density + gaussians.update(law, rows, emission)[1]
