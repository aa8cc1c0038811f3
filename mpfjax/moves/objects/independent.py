"""Independent objects: a separate particle filter for each, in one mixture."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.checks import check
from mpfjax.mixture import ParticleMixture, no_ancestors, single_component
from mpfjax.models.base import model_name
from mpfjax.models.multi_object import MultiObjectModel
from mpfjax.moves.base import AbstractPropagation, Step
from mpfjax.moves.propagation.propagate import predict
from mpfjax.moves.resampling.allocation import require_equal_rows
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.logarithms import default_float
from mpfjax.operations.random import split
from mpfjax.operations.stored import take


class AbstractPropagationByObject(AbstractPropagation):
    """A propagation in which every object of a particle has a parent of its own."""

    keeps_parents = False
    biases_score = True

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model of one object."""
        check(MultiObjectModel, model=now.model)


class PropagateIndependently(AbstractPropagationByObject):
    """Propagate, weight and resample each object separately, ignoring the other objects.

    For every object j: x_t^j ~ D, weights L(y_t | x_t^j), resampled by these weights alone. Objects
    that do not interact are independent given the observations, so the product of their N-particle
    sets is the joint set, with Ẑ = Π_j Ẑ_j. Particle i contains the i-th particle of every object:
    it is one of N^J combinations of equal weight. It has no single ancestor, and the index -1.

    The move requires particles of equal weight, which x_0 has and which it returns; the chain needs
    no other resampling. It refuses a model with an interaction, unless `ignores_interaction`, which
    is `approximate`. Raises `ValueError` for a mixture of several components, and a model of one
    object.
    """

    ignores_interaction: bool = eqx.field(static=True, default=False, kw_only=True)

    @property
    def approximate(self) -> bool:
        """Whether it may ignore an interaction of the model."""
        return self.ignores_interaction

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model of one object, or with an interaction."""
        super().check(now, num_particles, num_components)
        if now.model.interaction is not None and not self.ignores_interaction:  # pyright: ignore
            what = "has an interaction, which PropagateIndependently ignores; say so"
            raise ValueError(f"ignores_interaction: {model_name(now.model)} {what}")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """One step of every object's filter; where y_t is missing, a prediction."""
        model = now.model
        if now.is_missing:
            return predict(key, now.law, mixture, "none", "independent")
        require_equal_rows(mixture, "PropagateIndependently")
        num_objects = model.num_objects
        # The objects' keys are those of the joint draw, so that one object is a plain filter.
        keys = split(key, 2 * num_objects)
        points, log_likelihoods = move_objects(
            model, keys[:num_objects], mixture.particles, now.observation
        )
        rows, log_growths = draw_rows(keys[num_objects:], log_likelihoods)
        # An object whose particles all have zero likelihood moves by its dynamics alone.
        identity = jnp.arange(rows.shape[1], dtype=rows.dtype)[None]
        rows = jnp.where((log_growths > -jnp.inf)[:, None], rows, identity)
        moved = mixture.replace(
            particles=rows_of_each(points, rows), ancestor_indices=no_ancestors(mixture)
        )
        return moved.reweight(jnp.sum(log_growths)[None])


def move_objects(
    model: MultiObjectModel, keys: Key[Array, " objects"], states: PyTree, observation: PyTree
) -> tuple[PyTree, Float[Array, "objects n"]]:
    """x_t of every object of every row, and the logarithms of their likelihoods."""
    observation = model.prepare_observation(observation)

    def move(key: Key[Array, ""], states: PyTree, j: Int[Array, ""]) -> tuple:
        points = model.sample_object_transition(key, states, j)
        return points, model.object_log_likelihood(observation, points, j).astype(default_float())

    objects = jnp.arange(model.num_objects, dtype=jnp.int32)
    return jax.vmap(move, in_axes=(0, 1, 0), out_axes=(1, 0))(keys, states, objects)


def draw_rows(
    keys: Key[Array, " objects"], log_weights: Float[Array, "objects n"]
) -> tuple[Int[Array, "objects n"], Float[Array, " objects"]]:
    """The rows that each object is resampled from, and log of its mean weight."""

    def draw(key: Key[Array, ""], log_weights: Float[Array, " n"]) -> tuple:
        cloud = single_component(log_weights).reweight(log_weights)
        return Resample().resample(key, cloud).ancestor_indices, cloud.log_mass

    return jax.vmap(draw)(keys, log_weights)


def rows_of_each(states: PyTree, rows: Int[Array, "objects n"]) -> PyTree:
    """Every object's states, from rows chosen for each object."""
    gather = jax.vmap(take, in_axes=(1, 0), out_axes=1)
    return jax.tree.map(lambda leaf: gather(leaf, rows), states)
