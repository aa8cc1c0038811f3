"""A start by the first observations, and restarts, which are starts by the last ones."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from mpfjax.checks import Count, InnerShare
from mpfjax.mixture import ParticleMixture, no_ancestors, single_component
from mpfjax.moves.alarm import SURPRISE, over_all_islands
from mpfjax.moves.base import (
    AbstractMove,
    AbstractWrapper,
    Moves,
    Step,
    as_moves,
    in_turn,
    is_missing,
)
from mpfjax.moves.resampling.resample import Resample
from mpfjax.moves.start.window import (
    Paths,
    Window,
    check_start,
    first_paths,
    inputs_of,
    observe,
    with_derivatives,
)
from mpfjax.operations.islands import num_islands
from mpfjax.operations.logarithms import add_gradient, default_float, log_sum_exp
from mpfjax.operations.random import split
from mpfjax.operations.stored import cond_if_any

START = "the last observations"
# What a step without any likelihood counts, so that differences are numbers.
LEAST_GROWTH = -1e4
LEAST_PART = 1 / 16


class Begin(AbstractMove):
    """The initial move of a `Start`: room for the last observations, and paths for the first ones.

    Without y_1, whose shapes it needs, it does nothing: x_0 are plain draws, and nothing restarts.
    """

    num_observations: Count = eqx.field(static=True)
    at_first: bool = eqx.field(static=True, default=True)

    weighs = False
    keeps_mass = True

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture that remembers."""
        if now.observation is None:
            return mixture
        length = self.num_observations

        def room(leaf: Array) -> Array:
            return jnp.zeros((length, *jnp.shape(leaf)), jnp.asarray(leaf).dtype)

        observations, inputs = jax.tree.map(room, (now.observation, inputs_of(now.model)))
        memory = {
            "window": Window(observations, inputs, jnp.zeros(length, bool)),
            "growths": jnp.zeros(length, mixture.log_weights.dtype),
            "age": jnp.zeros((), jnp.int32),
            "paths": first_paths(key, now.model, mixture.num_particles, length),
            "taken": jnp.asarray(0 if self.at_first else length, jnp.int32),
            "score": jnp.zeros((), default_float()),
        }
        return mixture.replace(memory=mixture.memory | {START: memory})


class Start(AbstractWrapper):
    """In the first steps a tempered sampler of x_0 and noise, and again where the alarm rings.

    After y_t, t up to L, the particles represent p(x_t | y_1..y_t), equally weighted in each
    island, and are grouped as x_0 is. They come from no single ones of the step before, since their
    past has moved too. Derivatives of the increments are the score, by Fisher's identity. Then the
    moves of the chain follow.

    Given a probability p, it is a restart too. The alarm is the cumulative sum of what speaks
    against all hypotheses, as `WatchStart` tells it. Where it is above 5, and was last zero at
    least L steps ago, the sampler draws a state that began anew L steps ago, by the observations
    since. Its mass is p Ẑ of these, that of the hypotheses there are 1 - p times theirs. Each gets
    slots by its mass, a sixteenth at least. So the evidence is unbiased for a state that may begin
    anew where an alarm sends one back, and nowhere else.

    - `moves`: the chain's, up to the last that does more than regroup.
    - `grouping`: of the particles of the sampler; usually the initial moves.
    - `num_observations`: L.
    - `probability`: p; None never restarts.

    `with_start` and `with_restarts` make filters with it.
    """

    moves: Moves = eqx.field(converter=lambda moves: as_moves(moves, "moves"))
    grouping: Moves = eqx.field(converter=lambda moves: as_moves(moves, "grouping"))
    num_observations: Count = eqx.field(static=True, default=8)
    probability: InnerShare | None = eqx.field(static=True, default=None)

    holds = ("moves", "grouping")
    weighs = True
    keeps_mass = False
    keeps_parents = False
    """their past moves too."""
    keeps_families = False

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model whose x_0 cannot be moved, and too few particles."""
        super().check(now, num_particles, num_components)
        check_start(now.model, "a start by observations moves x_0")
        least = least_slots(num_particles)
        if self.probability is not None and num_components > least:
            which = f"of which {least} may be all of the slots of {num_components} components"
            raise ValueError(f"num_particles: {num_particles}, {which}")

    def around(self, reference: Any) -> AbstractMove:
        """Raise a `ValueError`: no trajectory can be kept where all of it moves."""
        who = "filter: a start by observations, as with restarts,"
        raise ValueError(f"{who} cannot keep a trajectory")

    def _is_first(self, mixture: ParticleMixture) -> Array:
        return mixture.memory[START]["taken"] < self.num_observations

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture after the observation."""
        if mixture.usable_slots is not None:
            raise ValueError("slots: a start by observations needs every slot")
        key_moves, key_start = split(key, 2)

        def as_ever() -> ParticleMixture:
            return in_turn(key_moves, self.moves, mixture, now)

        if START not in mixture.memory:
            return as_ever()
        # Runs of one `vmap` may be at different steps, and each kind of step runs if any needs it.
        is_first, same = self._is_first(mixture), mixture.with_order(False)
        later = cond_if_any(~is_first, as_ever, lambda: same)
        own = mixture.memory[START]
        age, is_due = own["age"], jnp.zeros((), bool)
        if self.probability is not None:
            # The steps since the sum was zero, of which the oldest may be the first of a new state.
            age = jnp.where(mixture.memory[SURPRISE].total > 0, age + 1, 1)
            if not is_missing(now):
                is_due = mixture.memory[SURPRISE].rings & (age >= self.num_observations) & ~is_first
            age = jnp.where(is_due, 0, age).astype(jnp.int32)
        window = with_step(own["window"], own["taken"], now)
        own = own | {"window": window, "age": age}
        later = later.replace(memory=later.memory | {START: own})
        begins = is_first | is_due

        def begun() -> ParticleMixture:
            anew = self._begun(key_start, mixture, later, now, is_due)
            return jax.tree.map(lambda new, old: jnp.where(begins, new, old), anew, later)

        moved = cond_if_any(begins, begun, lambda: later)
        growth = jnp.maximum(over_all_islands(moved.log_mass), LEAST_GROWTH)
        growths = jnp.append(own["growths"][1:], growth)
        own = moved.memory[START] | {"growths": growths}
        return moved.replace(memory=moved.memory | {START: own})

    def _begun(
        self,
        key: Key[Array, ""],
        before: ParticleMixture,
        later: ParticleMixture,
        now: Step,
        is_restart: Array,
    ) -> ParticleMixture:
        """The particles of the sampler; at a restart beside those that there are after the step."""
        own, n, length = later.memory[START], before.num_particles, self.num_observations
        key_paths, key_seen, key_joined, key_group = split(key, 4)
        window, paths = own["window"], own["paths"]
        if self.probability is not None:
            new = first_paths(key_paths, now.model, n, length)
            paths = jax.tree.map(partial(jnp.where, is_restart), new, paths)
        # Within the window also where the result is not taken.
        first = jnp.where(is_restart, 0, jnp.minimum(own["taken"], length - 1))
        last = jnp.where(is_restart, length, first + 1)

        def see(s: Array, carry: tuple[Paths, Array]) -> tuple[Paths, Array]:
            paths, log_mean = carry
            key = jax.random.fold_in(key_seen, s)
            paths, more = observe(key, now.model, window, paths, s + 1, n)
            return paths, log_mean + more

        paths, log_mean = jax.lax.fori_loop(first, last, see, (paths, jnp.zeros_like(own["score"])))
        cloud = jax.tree.map(lambda leaf: leaf[:n], paths)
        states, log_target = with_derivatives(now.model, window, cloud, last)
        log_weights = add_gradient(jnp.full(n, -np.log(n), log_target.dtype), log_target)
        anew = before.replace(
            particles=states,
            log_weights=log_weights + log_sum_exp(before.log_weights),
            log_scale=before.log_scale + (log_mean - own["score"]),
            ancestor_indices=no_ancestors(before),
        )
        if self.probability is not None:
            alone = single_component(states).replace(log_weights=log_weights, log_scale=log_mean)
            old = later.replace(memory=before.memory)
            both = self._joined(key_joined, old, alone, jnp.sum(own["growths"][1:]))
            anew = jax.tree.map(partial(jnp.where, is_restart), both, anew)
        # Derivatives of the next increment are those beyond this one.
        score = add_gradient(jnp.zeros_like(log_mean), jnp.mean(log_target))
        own = own | {"paths": paths, "taken": last, "score": score}
        anew = anew.replace(memory=later.memory | {START: own})
        # Regrouping x_0 waits for no observation.
        return in_turn(key_group, self.grouping, anew, dataclasses.replace(now, is_initial=True))

    def _joined(
        self,
        key: Key[Array, ""],
        old: ParticleMixture,
        new: ParticleMixture,
        growth: Float[Array, ""],
    ) -> ParticleMixture:
        """The hypotheses that there are, and those of a state that began anew.

        The evidence for the former grew by this in the steps before; it is no part of this step's.
        """
        key_old, key_new = split(key, 2)
        n, p, m = old.num_particles, self.probability or 0.0, old.num_components
        old = old.replace(log_scale=old.log_scale + np.log1p(-p))
        new = new.replace(log_scale=new.log_scale + np.log(p) - growth)
        log_odds = over_all_islands(new.log_mass) - over_all_islands(old.log_mass)
        share, least = jax.nn.sigmoid(log_odds - np.log(num_islands())), least_slots(n)
        number = jnp.clip(jnp.round(share * n).astype(jnp.int32), least, n - least)
        old, new = old.replace(usable_slots=n - number), new.replace(usable_slots=number)
        redraw = Resample(gradient="stop").resample
        old, new = redraw(key_old, old), redraw(key_new, new)
        new = new.replace(ancestor_indices=no_ancestors(new), num_components=m)
        return old.joined(new).replace(usable_slots=None)


def least_slots(num_particles: int) -> int:
    """Of the hypotheses before a restart, and of the new ones: at least a part."""
    return max(1, round(LEAST_PART * num_particles))


def with_step(window: Window, taken: Array, now: Step) -> Window:
    """The window with this step after those taken, or at the end, without the oldest.

    An observation that is missing is not present there.
    """
    length = window.present.shape[0]

    def put(leaves: Array, leaf: Any) -> Array:
        room = jnp.append(leaves, leaves[:1], axis=0)
        filled = room.at[taken].set(jnp.asarray(leaf, leaves.dtype))
        return jax.lax.dynamic_slice_in_dim(filled, (taken == length).astype(int), length)

    observation = now.observation
    if is_missing(now):
        observation = jax.tree.map(lambda leaves: leaves[0], window.observations)
    new = Window(observation, inputs_of(now.model), ~jnp.asarray(is_missing(now)))
    return jax.tree.map(put, window, new)
