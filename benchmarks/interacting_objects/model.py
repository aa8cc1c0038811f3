"""An object that moves by AR2 and is seen as a bump among the bumps of others."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

import mpfjax

# The scenes' constants, chosen once for all methods. Pixels and frames.
BOX = 20.0  # sides of every object's box
MOMENTUM, DEVIATION = 0.5, 3.0  # AR2, as in the paper
SHARPNESS = 20.0  # λ
REACH = 8.0  # over which a box that is shifted stops looking like its object


class Blob(mpfjax.AbstractStateSpaceModel):
    """An object that moves by AR2 and is seen as a bump, among the bumps of others.

    The states are {"now": x_t, "before": x_{t-1}}, each (n, 2). log L = -λ d², where d² is one
    minus the largest a_k exp(-|x - o_k|² / 2s²) over the bumps k: it has no floor but λ, as a
    histogram distance has none but one.
    """

    start: Float[Array, "*objects 2"]
    before: Float[Array, "*objects 2"]

    def sample_initial(self, key, num_particles):
        shift = 2.0 * jax.random.normal(key, (num_particles, 2))
        return {"now": self.start[None] + shift, "before": self.before[None] + shift}

    def sample_transition(self, key, states):
        noise = DEVIATION * jax.random.normal(key, states["now"].shape)
        return {"now": expected(states) + noise, "before": states["now"]}

    def log_transition(self, states, previous_states):
        return -0.5 * squares(states["now"] - expected(previous_states)) / DEVIATION**2

    def with_history(self, states, previous_states):
        return {"now": states["now"], "before": previous_states["now"]}

    def log_likelihood(self, observation, states):
        bumps = jax.vmap(
            lambda place, height: (
                height * jnp.exp(-0.5 * squares(states["now"] - place[None]) / REACH**2)
            )
        )(observation["places"], observation["heights"])
        return -SHARPNESS * (1 - jnp.max(bumps, axis=0))


def expected(states: dict[str, Float[Array, "n 2"]]) -> Float[Array, "n 2"]:
    """x_{t-1} + 0.5 (x_{t-1} - x_{t-2})."""
    return states["now"] + MOMENTUM * (states["now"] - states["before"])


def squares(vectors: Float[Array, "n 2"]) -> Float[Array, " n"]:
    """|v|² of every row, written out."""
    return vectors[:, 0] ** 2 + vectors[:, 1] ** 2


def place_of(states: dict[str, Float[Array, "n 2"]]) -> Float[Array, "n 2"]:
    """Where an object is, for the repulsion."""
    return states["now"]
