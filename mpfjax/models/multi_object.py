"""The joint state of several objects: independent dynamics and likelihoods, and interaction."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.arrays import POSITIVE, Fitting, to_array
from mpfjax.checks import Checked, Count, check_one_each
from mpfjax.mixture import flatten_states
from mpfjax.models import base
from mpfjax.models.law import Law, refuse_marginalised
from mpfjax.operations.matrices import row_sums
from mpfjax.operations.random import split
from mpfjax.operations.stored import select_rows

# A number of particles that is hardly ever the length of a parameter's axis.
_TRIAL = 1_000_003


class MultiObjectModel(base.AbstractStateSpaceModel, Checked):
    """x_t = (x_t^1, ..., x_t^J): J objects, each with its own dynamics and likelihood.

    Smith and Gatica-Perez (2004), section 2: D is a product over the objects, and so is L(y_t |
    x_t) = Π_j L(y_t | x_t^j). An interaction adds the factor Π_{i<j} ψ(x_t^i, x_t^j) to every step,
    a Markov random field (Khan, Balch and Dellaert 2004). It is part of L, so that Ẑ estimates the
    same number with every filter. A step without an observation has neither L nor ψ.

    - `object_model`: one model for all objects, or one whose arrays all have a leading object axis,
      such as `jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)`.
    - `num_objects`: J.
    - `interaction`: log ψ of the states of two objects, `(states, other_states) -> (n,)`,
      symmetric; such as `PairwiseRepulsion`.
    - `shared_observation`: with False, object j observes `observation[j]`, every leaf indexed by j.
      With True, all objects observe the whole observation, such as an image. If `object_model` then
      has a method `prepare_observation(observation)`, it is called once in each step, for all
      particles and objects, and its result is passed to `log_likelihood`.
    - `per_object`: whether the arrays have an object axis. With None they have one if the model
      cannot be sampled without it, which is traced and not computed.

    Particles have leaves (n, J, ...). Raises `ValueError` for J < 1, an object model that lacks a
    method or the object axis, and one that is conditionally linear. Use it if objects interact or
    share particles; without interaction `independent_particle_filters` is better.
    """

    object_model: base.AbstractStateSpaceModel
    num_objects: Count = eqx.field(static=True)
    interaction: Callable[[PyTree, PyTree], Float[Array, " n"]] | None = None
    shared_observation: bool = eqx.field(static=True, default=False)
    per_object: bool | None = eqx.field(static=True, default=None, kw_only=True)

    def __post_init__(self) -> None:
        self.__check_init__()
        model, number = self.object_model, int(self.num_objects)
        refuse_marginalised(model, "MultiObjectModel", "give each a filter", "object_model")
        if self.per_object is None:
            self.per_object = _finds_object_axis(model, number)
        elif self.per_object and not _has_axis(model, number):
            raise ValueError(f"object_model: not every array has a leading axis of {number}")
        self.num_objects = number

    @property
    def handles_missing(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the object model handles missing values."""
        return getattr(self.object_model, "handles_missing", False)

    def with_inputs(self, inputs: PyTree) -> "MultiObjectModel":
        """The model whose objects all have the inputs u_t."""
        give = partial(base.with_inputs, inputs=inputs)
        if self.per_object:
            give = eqx.filter_vmap(give, in_axes=eqx.if_array(0), axis_size=self.num_objects)
        return base.replace_fields(self, object_model=give(self.object_model))

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """x_0 of every object, independent: every leaf (n, J, ...)."""
        keys = split(key, 2 * self.num_objects).reshape(2, self.num_objects)

        def draw(key: Key[Array, ""], key_order: Key[Array, ""], j: Int[Array, ""]) -> PyTree:
            states = self.object_at(j).sample_initial(key, num_particles)
            if self.num_objects == 1:
                return states
            # Stratified draws may come in order. Put side by side in that order, the objects would
            # not be independent.
            order = jax.random.permutation(key_order, num_particles)
            return jax.tree.map(lambda leaf: leaf[order], states)

        return jax.vmap(draw, out_axes=1)(keys[0], keys[1], self._indices)

    def sample_transition(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """x_t of every object, independent of each other given x_{t-1}."""
        return self._of_each("sample_transition", (0, 1), split(key, self.num_objects), states)

    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        """Σ_j log L(y_t | x_t^j) + Σ_{i<j} log ψ(x_t^i, x_t^j)."""
        observation = self.prepare_observation(observation)
        weigh = partial(self.object_log_likelihood, observation)
        total = jnp.sum(jax.vmap(weigh, in_axes=(1, 0))(states, self._indices), axis=0)
        if self.interaction is None or self.num_objects == 1:
            return total
        pairs = [
            jax.tree.map(lambda leaf, of=of: leaf[:, of], states)
            for of in np.triu_indices(self.num_objects, 1)
        ]
        potentials = jax.vmap(self.interaction, in_axes=1, out_axes=1)(*pairs)
        return total + jnp.sum(potentials, axis=1).astype(total.dtype)

    def __getattr__(self, name: str) -> Any:
        # Only reached for names that the class lacks: the joint density is there if the objects'.
        if name == "log_transition" and hasattr(self.object_model, name):
            return self._log_transition
        is_of_noise = name in ("transition_from_noise", "noise_dimension")
        if is_of_noise and base.is_made_of_noise(self.object_model):
            return getattr(self, f"_{name}")
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def _of_each(self, method: str, axes: tuple[int, ...], *arguments: PyTree) -> PyTree:
        """What a method of each object's model gives, (n, J, ...), from its part of the arguments.

        `axes` are those of the objects.
        """
        of_one = jax.vmap(partial(self._ask, method), in_axes=(0, *axes), out_axes=1)
        return of_one(self._indices, *arguments)

    @property
    def _noise_dimension(self) -> int:
        return self.num_objects * self.object_at(0).noise_dimension

    def _transition_from_noise(self, noise: Float[Array, "n k"], states: PyTree) -> PyTree:
        """x_t of every object, from its own columns of the noise."""
        noise = noise.reshape(noise.shape[0], self.num_objects, -1)
        return self._of_each("transition_from_noise", (1, 1), noise, states)

    def _log_transition(self, states: PyTree, previous_states: PyTree) -> Float[Array, " n"]:
        """Σ_j log D(x_t^j | x_{t-1}^j)."""
        return jnp.sum(self._of_each("log_transition", (1, 1), states, previous_states), axis=1)

    # One object at a time. `objects` is the same object for all particles, (), or one of its
    # own for each, (n,); `states` are those of that object, leaves (n, ...).

    def object_at(self, index: int | Int[Array, "*n"]) -> Any:
        """The model of one object, or of all if they share it."""
        if not self.per_object:
            return self.object_model
        return jax.tree.map(
            lambda leaf: leaf[index] if _is_array(leaf) else leaf, self.object_model
        )

    def object_states(self, particles: PyTree, objects: Int[Array, "*n"]) -> PyTree:
        """The states of one object of each particle: every leaf (n, ...)."""
        if objects.ndim == 0:
            pick = partial(jax.lax.dynamic_index_in_dim, index=objects, axis=1, keepdims=False)
            return jax.tree.map(pick, particles)
        rows = jnp.arange(objects.shape[0], dtype=jnp.int32)
        return jax.tree.map(
            lambda leaf: leaf.at[rows, objects].get(mode="promise_in_bounds"), particles
        )

    def replace_object(
        self, particles: PyTree, objects: Int[Array, "*n"], states: PyTree
    ) -> PyTree:
        """The particles in which one object has these states."""
        num_particles = jax.tree.leaves(particles)[0].shape[0]
        objects = jnp.broadcast_to(objects, (num_particles,))
        is_object = objects[:, None] == self._indices[None]
        return select_rows(is_object, jax.tree.map(lambda leaf: leaf[:, None], states), particles)

    def sample_object_transition(
        self, key: Key[Array, ""], states: PyTree, objects: Int[Array, "*n"]
    ) -> PyTree:
        """x_t of one object of each particle."""
        if not self.per_object or objects.ndim == 0:
            return self.object_at(objects).sample_transition(key, states)

        def draw(j: Int[Array, ""], states: PyTree, keys: Key[Array, "1"]) -> PyTree:
            return self.object_at(j).sample_transition(keys[0], states)

        return _one_by_one(draw, objects, states, split(key, objects.shape[0]))

    def prepare_observation(self, observation: PyTree) -> PyTree:
        """The argument of the objects' likelihoods: y_t, or the object model's function of it."""
        if not self.shared_observation:
            check_one_each(self.num_objects, "objects", observation=observation)
            return observation
        prepare = getattr(self.object_at(0), "prepare_observation", None)
        return observation if prepare is None else prepare(observation)

    def object_log_likelihood(
        self, observation: PyTree, states: PyTree, objects: Int[Array, "*n"]
    ) -> Float[Array, " n"]:
        """log L(y_t | x_t^j) of one object of each particle; y_t as prepared."""

        def weigh(j: Int[Array, "*n"], states: PyTree) -> Any:
            of_object = observation
            if not self.shared_observation:
                of_object = jax.tree.map(lambda leaf: leaf[j], observation)
            return self.object_at(j).log_likelihood(of_object, states)

        differ = objects.ndim > 0 and (self.per_object or not self.shared_observation)
        values = _one_by_one(weigh, objects, states) if differ else weigh(objects, states)
        num_particles = jax.tree.leaves(states)[0].shape[0]
        return base.real_each(values, num_particles, self.object_model, "log_likelihood")

    def object_log_transition(
        self, states: PyTree, previous_states: PyTree, objects: Int[Array, "*n"]
    ) -> Float[Array, " n"]:
        """log D(x_t^j | x_{t-1}^j) of one object of each particle."""
        return self._ask("log_transition", objects, states, previous_states)

    def object_with_history(
        self, states: PyTree, previous_states: PyTree, objects: Int[Array, "*n"]
    ) -> PyTree:
        """The states of one object of each particle, with the past of these previous states."""
        if not hasattr(self.object_model, "with_history"):
            return states
        return self._ask("with_history", objects, states, previous_states)

    def _ask(self, method: str, objects: Int[Array, "*n"], *states: PyTree) -> PyTree:
        """What a method of the objects' models says of one object of each particle."""

        def ask(j: Int[Array, "*n"], *states: PyTree) -> PyTree:
            return getattr(self.object_at(j), method)(*states)

        differ = objects.ndim > 0 and self.per_object
        return _one_by_one(ask, objects, *states) if differ else ask(objects, *states)

    @property
    def _indices(self) -> Int[Array, " objects"]:
        return jnp.arange(self.num_objects, dtype=jnp.int32)


class PairwiseRepulsion(Fitting):
    """log ψ(x_i, x_j) = -strength · k(|p_i - p_j| / radius), p the positions of two objects.

    The pairwise Markov random field of Khan, Balch and Dellaert (2004), for objects that cannot
    share a position, with k(r) = (1 - r²)² for r < 1 and 0 beyond. ψ is symmetric, exactly 1 if the
    objects are further apart than the radius, so that a filter can detect that they do not touch,
    and smooth: it has a gradient everywhere, even if the objects are at the same point.

    - `strength`: -log ψ of two objects at the same point, in nats; positive.
    - `radius`: in the unit of the positions; positive.
    - `features`: maps the states of one object, leading axis n, to (n, k) or (n,); None uses the
      whole state.

    Called with the states of two objects, it returns (n,). Raises `ValueError` for a strength or
    radius that is not positive. Use it if similar objects cross and must not be tracked as one.
    """

    strength: Annotated[Float[Array, ""], POSITIVE] = eqx.field(converter=to_array("strength"))
    radius: Annotated[Float[Array, ""], POSITIVE] = eqx.field(converter=to_array("radius"))
    features: Callable[[PyTree], Array] | None = eqx.field(static=True, default=None)

    def __call__(self, states: PyTree, other_states: PyTree) -> Float[Array, " n"]:
        """log ψ of each row of the states with the same row of the other states."""
        gaps = self._positions(states) - self._positions(other_states)
        squares = row_sums((gaps / self.radius.astype(gaps.dtype)) ** 2)
        return -self.strength.astype(gaps.dtype) * jnp.maximum(1 - squares, 0.0) ** 2

    def _positions(self, states: PyTree) -> Float[Array, "n k"]:
        return flatten_states(states if self.features is None else self.features(states))


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray)


def _one_by_one(
    function: Callable[..., PyTree], objects: Int[Array, " n"], *states: PyTree
) -> PyTree:
    """A function of an object and states of n particles, called for each particle alone."""

    def of_one(j: Int[Array, ""], *states: PyTree) -> PyTree:
        values = function(j, *jax.tree.map(lambda leaf: leaf[None], states))
        return jax.tree.map(lambda leaf: leaf[0], values)

    return jax.vmap(of_one)(objects, *states)


def _has_axis(model: Any, num_objects: int) -> bool:
    """Whether the model has arrays, and all of them a leading axis of this length."""
    shapes = [leaf.shape[:1] for leaf in jax.tree.leaves(model) if _is_array(leaf)]
    return bool(shapes) and all(shape == (num_objects,) for shape in shapes)


def _finds_object_axis(model: Any, num_objects: int) -> bool:
    """Whether the arrays have an object axis, because as one model for all it cannot be drawn."""

    def draw() -> PyTree:
        law, key = Law(model), jax.random.key(0)
        return law.draw(key, law.sample_initial(key, _TRIAL))

    try:
        eqx.filter_eval_shape(draw)
    except Exception:
        return _has_axis(model, num_objects)
    return False
