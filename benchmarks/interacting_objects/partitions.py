"""Independent and adaptive partitions, proposals of one joint filter that are close to clusters."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

import mpfjax


class ProposeInPartitions(mpfjax.AbstractPropagation):
    """Draw objects that are far from all others independently, and the others within their row.

    Independent partitions (Orton and Fitzgerald 2002): an object's points x^{jl}, one from each
    row l, are resampled by L_j alone, so that a row may get the point of another row. That takes
    its prediction to be independent of the other objects.

    Adaptive partitions (Kreucher, Kastella and Hero 2005): at each step this is done with objects
    that are far from all others. An object that is near another one keeps to its row. There it
    draws K points, and keeps one in proportion to L_j, and the row is weighed by the mean L_j. Two
    objects are near where ψ ≠ 1 between any two of their points, as in `PropagateInClusters`.

    Both weigh every row by ψ afterwards. They need rows of equal weight: put `Resample()` first.

    - `num_draws`: K; None takes every object to be far from all others.
    """

    num_draws: int | None = eqx.field(static=True, default=1)

    approximate = True  # objects far apart need not be independent

    def __call__(
        self, key: Key[Array, ""], mixture: mpfjax.ParticleMixture, now: mpfjax.Step
    ) -> mpfjax.ParticleMixture:
        """Propagate every object, and weigh the rows by what they see and by ψ."""
        model: Any = now.model
        if now.observation is None:
            return mixture.replace(particles=model.sample_transition(key, mixture.particles))
        num_draws = self.num_draws or 1
        keys = jax.random.split(key, 3 * model.num_objects).reshape(3, -1)
        objects = jnp.arange(model.num_objects, dtype=jnp.int32)
        observation = model.prepare_observation(now.observation)
        # The K points of a row stand side by side.
        repeated = jax.tree.map(lambda leaf: jnp.repeat(leaf, num_draws, axis=0), mixture.particles)

        def draw(key: Key[Array, ""], states: PyTree, j: Int[Array, ""]) -> tuple:
            points = model.sample_object_transition(key, states, j)
            log_likelihoods = model.object_log_likelihood(observation, points, j)
            return points, log_likelihoods.reshape(-1, num_draws)

        points, tables = jax.vmap(draw, in_axes=(0, 1, 0), out_axes=(1, 0))(
            keys[0], repeated, objects
        )
        near = jnp.zeros(len(objects), bool)
        if self.num_draws is not None:
            near = _near(model, jax.tree.map(lambda leaf: leaf[::num_draws], points))
        from_any = jax.vmap(_from_any_row)(keys[1], tables)
        from_own = jax.vmap(_from_own_row)(keys[2], tables)
        places, log_factors = (
            jnp.where(near[:, None], own, any_row)
            for own, any_row in zip(from_own, from_any, strict=True)
        )
        gather = jax.vmap(lambda leaf, rows: leaf[rows], in_axes=(1, 0), out_axes=1)
        particles = jax.tree.map(lambda leaf: gather(leaf, places), points)
        log_factors = jnp.sum(log_factors, axis=0)
        for i, j in _pairs(model):
            states = _states_of(particles, i, j)
            log_factors += model.interaction(*states)
        return mixture.replace(particles=particles).reweight(log_factors)


def _pairs(model: mpfjax.MultiObjectModel) -> list[tuple[int, int]]:
    """The pairs of objects that may interact."""
    num_objects = model.num_objects if model.interaction is not None else 0
    return [(i, j) for j in range(num_objects) for i in range(j)]


def _near(model: mpfjax.MultiObjectModel, points: PyTree) -> Bool[Array, " objects"]:
    """Which objects have a point that interacts with any point of another object."""
    near = jnp.zeros(model.num_objects, bool)
    for i, j in _pairs(model):
        states, others = _states_of(points, i, j)

        def meets(state: PyTree, others: PyTree = others) -> Bool[Array, ""]:
            repeat = lambda one, other: jnp.broadcast_to(one[None], other.shape)  # noqa: E731
            states = jax.tree.map(repeat, state, others)
            return jnp.any(model.interaction(states, others) != 0)  # pyright: ignore

        near = near.at[jnp.array([i, j])].max(jnp.any(jax.vmap(meets)(states)))
    return near


def _states_of(particles: PyTree, *objects: int) -> list[PyTree]:
    """The states of each of these objects."""
    return [jax.tree.map(lambda leaf, j=j: leaf[:, j], particles) for j in objects]


def _from_any_row(
    key: Key[Array, ""], table: Float[Array, "n draws"]
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Points resampled from the first of every row, and log of the mean weight for all."""
    num_rows, num_draws = table.shape
    first = table[:, 0]
    rows = jax.random.choice(key, num_rows, (num_rows,), p=jax.nn.softmax(first))
    return rows * num_draws, jnp.full_like(first, jax.nn.logsumexp(first) - jnp.log(num_rows))


def _from_own_row(
    key: Key[Array, ""], table: Float[Array, "n draws"]
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """A point of each row's own, and log of the mean weight of its points."""
    num_rows, num_draws = table.shape
    drawn = jax.random.categorical(key, table, axis=1)
    log_means = jax.nn.logsumexp(table, axis=1) - jnp.log(num_draws)
    return jnp.arange(num_rows, dtype=drawn.dtype) * num_draws + drawn, log_means


def adaptive_partitions(
    model: mpfjax.MultiObjectModel, num_particles: int, num_draws: int | None = 1
) -> mpfjax.Filter:
    """Objects near another one drawn in their rows, the others each on its own.

    Without `num_draws` every object is drawn on its own: independent partitions.
    """
    moves = [mpfjax.Resample(), ProposeInPartitions(num_draws)]
    return mpfjax.Filter(model, moves=moves, num_particles=num_particles)
