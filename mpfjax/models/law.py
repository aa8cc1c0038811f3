"""The law of a model: the only place where a model is called and its results are checked."""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.models import base
from mpfjax.models.noise import draw_noise
from mpfjax.operations.logarithms import default_float


@dataclass(frozen=True)
class Law:
    """p(x_0), D(x_t | x_{t-1}) and L(y_t | x_t) of a model, with every returned array checked.

    `draws` are the random part of the states: the states themselves here; the latent z_t where the
    particles carry moments of the rest (`MarginalisedLaw`, which such a model names in its
    attribute `_law`).
    """

    model: Any

    is_whole = True
    """whether the whole state is random, and no part of it carries moments."""
    has_density = False
    """whether log D is known whatever methods the model has."""

    @property
    def is_of_noise(self) -> bool:
        """Whether x_t can be made of noise."""
        return base.is_made_of_noise(self.model)

    def part(self, states: PyTree) -> PyTree:
        """The random part of the states."""
        return states

    def complete(self, draws: PyTree, states: PyTree) -> PyTree:
        """x_t with this random part, from x_{t-1}."""
        return draws

    def start(self, draws: PyTree) -> PyTree:
        """x_0 with this random part."""
        return draws

    def sample_initial(self, key: Key[Array, ""], size: int, noise: str = "independent") -> PyTree:
        """x_0 of so many particles, made of this noise if the model has `initial_from_noise`."""
        if noise == "independent" or not base.is_made_of_noise(self.model, "initial"):
            draws = self.model.sample_initial(key, size)
            base.check_states(draws, self.model, "sample_initial", size)
            return self.start(draws)
        shape = (size, self.model.initial_noise_dimension)
        return self.make_initial(draw_noise(key, noise, shape, default_float()))

    def make_initial(self, noise: Float[Array, "n k"]) -> PyTree:
        """x_0 of each particle, made of this standard normal noise."""
        draws = self.model.initial_from_noise(noise)
        base.check_states(draws, self.model, "initial_from_noise", noise.shape[0])
        return self.start(draws)

    def log_initial(self, states: PyTree) -> Float[Array, " n"]:
        """log p(x_0) of each particle."""
        return self._log_density("log_initial", states)

    def move(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """x_t of each particle, from x_{t-1}."""
        return self.complete(self.draw(key, states), states)

    def draw(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """The random part of x_t."""
        before = self.part(states)
        with base.asking(self.model, "sample_transition"):
            draws = self.model.sample_transition(key, before)
        base.check_moved(draws, before, self.model)
        return draws

    def make(self, noise: Float[Array, "n k"], states: PyTree) -> PyTree:
        """The random part of x_t, made of this standard normal noise."""
        before = self.part(states)
        with base.asking(self.model, "transition_from_noise", "of noise_dimension", noise):
            draws = self.model.transition_from_noise(noise, before)
        base.check_moved(draws, before, self.model, "transition_from_noise")
        return draws

    def noise_dimension(self, states: PyTree) -> int:
        """k, the dimension of the noise of one x_t."""
        return self.model.noise_dimension

    def log_transition(self, draws: PyTree, states: PyTree) -> Float[Array, " n"]:
        """log D of the random part of x_t, given x_{t-1}."""
        return self._log_density("log_transition", draws, self.part(states))

    def _log_density(self, method: str, draws: PyTree, *previous: PyTree) -> Float[Array, " n"]:
        with base.asking(self.model, method):
            values = getattr(self.model, method)(draws, *previous)
        return base.real_each(values, jax.tree.leaves(draws)[0].shape[0], self.model, method)

    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        """log L(y_t | x_t) of each particle; with x integrated out where it has moments."""
        return functools.reduce(jnp.add, self.see(observation, states)[1])

    def log_likelihood_of_draws(self, observation: PyTree, draws: PyTree) -> Float[Array, " n"]:
        """log L of what depends on the random part alone: the model's own `log_likelihood`."""
        hint = " (one number of each array in a list; jnp.asarray(observations) is one array)"
        name = "the observation" + hint * isinstance(observation, list)
        with base.asking(self.model, "log_likelihood", name, observation):
            values = self.model.log_likelihood(observation, draws)
        number = jax.tree.leaves(draws)[0].shape[0]
        return base.real_each(values, number, self.model, "log_likelihood")

    def see(self, observation: PyTree, states: PyTree) -> tuple[PyTree, list[Float[Array, " n"]]]:
        """The states updated by y_t, and the factors of log L(y_t | x_t) of each particle."""
        return states, [self.log_likelihood_of_draws(observation, states)]

    def observe(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """y_t of each particle, drawn by the model's `sample_observation`."""
        with base.asking(self.model, "sample_observation"):
            observations = self.model.sample_observation(key, states)
        number = jax.tree.leaves(states)[0].shape[0]
        base.check_states(observations, self.model, "sample_observation", number)
        return observations


def law_of(model: Any) -> Law:
    """The law of this model."""
    return getattr(model, "_law", Law)(model)


def refuse_marginalised(
    model: Any, needed_by: str, instead: str = "take Propagate", name: str = "model"
) -> None:
    """Raise a `ValueError` for a model that is not propagated as a whole."""
    if not law_of(model).is_whole:
        who = f"{name}: {base.model_name(model)} is conditionally linear"
        raise ValueError(f"{who}, and {needed_by} needs states drawn as a whole; {instead}")
