"""Independent objects: a small particle filter for each, in one mixture."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.checks import check_one_of
from mpfjax.mixture import ParticleMixture, no_ancestors, single_component
from mpfjax.models.multi_object import MultiObjectModel, require_multi_object
from mpfjax.moves.base import AbstractPropagation
from mpfjax.moves.resampling.allocation import require_equal_rows
from mpfjax.moves.resampling.ancestors import SCHEMES
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.random import split


class PropagateIndependently(AbstractPropagation):
    """Propagate, weigh and resample each object on its own, as if there were no other.

    For every object j: x_t^j ~ D, weights L(y_t | x_t^j), resampled by these weights alone.
    Objects that do not interact are independent given the observations, so the product of their
    N-particle clouds is the joint cloud, with Ẑ = Π_j Ẑ_j. Particle i holds the i-th particle
    of every object: it is one of N^J combinations of equal weight. It has no single ancestor, and
    -1 for its index.

    The move needs particles of equal weight, as x_0 has and as it returns them; the chain needs no
    other resampling. It ignores an interaction of the model, and `approximate` is then true.
    Raises `ValueError` for a mixture of several components, a model of one object, and an unknown
    scheme.
    """

    model: MultiObjectModel
    scheme: str = eqx.field(static=True, default="systematic")

    def __check_init__(self) -> None:
        require_multi_object(self.model, "PropagateIndependently")
        check_one_of(SCHEMES, scheme=self.scheme)

    @property
    def approximate(self) -> bool:
        """Whether the model has an interaction, which this move ignores."""
        return self.model.interaction is not None

    biases_score = True
    keeps_parents = False
    """each object of a particle has a parent of its own."""

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """One step of every object's filter."""
        require_equal_rows(mixture, "PropagateIndependently")
        num_objects = self.model.num_objects
        # The objects' keys are those of the joint draw, so that one object is a plain filter.
        keys = split(key, 2 * num_objects)
        seen = self.model.prepare_observation(observation)

        def step(
            key: Key[Array, ""], key_resample: Key[Array, ""], states: PyTree, j: Int[Array, ""]
        ) -> tuple[PyTree, Float[Array, ""]]:
            states = self.model.sample_object_transition(key, states, j)
            log_likelihood = self.model.object_log_likelihood(seen, states, j)
            cloud = single_component(states).weighed(log_likelihood)
            drawn = Resample(self.scheme)(key_resample, cloud).particles
            # An object whose particles all have zero likelihood moves by its dynamics alone.
            has_mass = cloud.log_mass > -jnp.inf
            pick = lambda new, old: jnp.where(has_mass, new, old)  # noqa: E731
            return jax.tree.map(pick, drawn, states), cloud.log_mass

        particles, log_growths = jax.vmap(step, in_axes=(0, 0, 1, 0), out_axes=(1, 0))(
            keys[:num_objects],
            keys[num_objects:],
            mixture.particles,
            jnp.arange(num_objects, dtype=jnp.int32),
        )
        moved = mixture.replace(particles=particles, ancestor_indices=no_ancestors(mixture))
        return moved.weighed(jnp.sum(log_growths)[None])

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Draw x_t ~ D(. | x_{t-1}) of all objects."""
        return mixture.replace(particles=self.model.sample_transition(key, mixture.particles))
