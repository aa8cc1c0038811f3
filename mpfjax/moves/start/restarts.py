"""Restarts: where all hypotheses seem wrong, a start by the last observations beside them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key, PyTree

from mpfjax.checks import Count, InnerShare
from mpfjax.mixture import ParticleMixture, no_ancestors, single_component
from mpfjax.moves.alarm import SURPRISE, is_alarmed, over_all_islands
from mpfjax.moves.base import AbstractMove, AbstractWrapper, Moves, Step, is_missing
from mpfjax.moves.resampling.resample import Resample
from mpfjax.moves.start.start import empty_window, in_turn, with_step
from mpfjax.moves.start.window import Window, check_start, window_start
from mpfjax.operations.random import split, uniform
from mpfjax.operations.stored import cond_if_any

RECENT = "the last observations"
# What a step without any likelihood counts, so that differences are numbers.
LEAST_GROWTH = -1e4
# The least part of the slots that the new or the old hypotheses have.
LEAST_PART = 1 / 16


class BeginRecent(AbstractMove):
    """The initial move of a `Restart`: room for the last observations.

    Without y_1, whose shapes it needs, it does nothing, and nothing ever restarts.
    """

    num_observations: Count = eqx.field(static=True)

    weighs = False
    keeps_mass = True

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture that remembers."""
        del key
        if is_missing(now):
            return mixture
        memory = {
            "window": empty_window(now, self.num_observations),
            "growths": jnp.zeros(self.num_observations),
            "age": jnp.zeros((), jnp.int32),
        }
        return mixture.replace(memory=mixture.memory | {RECENT: memory})


class Restart(AbstractWrapper):
    """Where the alarm rings, join a start by the last L observations to the hypotheses.

    The alarm is the cumulative sum of what speaks against all hypotheses, as `WatchStart` tells it.
    Once it is above 5 and at least L steps have passed since it was last zero, `window_start` draws
    N particles for a state that began anew L steps ago, with probability p. Their mass is p Ẑ of
    these observations, that of the hypotheses there are 1 - p times theirs. Each gets slots by its
    mass, a sixteenth at least, and all are grouped as x_0 is. The alarm is then quiet again.

    - `moves`: the chain's, up to the last that does more than regroup.
    - `grouping`: of the particles after a restart; usually the initial moves.
    - `probability`: p.
    - `num_observations`: L.

    `with_restarts` makes a filter with it.
    """

    moves: Moves
    grouping: Moves
    probability: InnerShare = eqx.field(static=True, default=1e-3)
    num_observations: Count = eqx.field(static=True, default=8)

    holds = ("moves", "grouping")
    weighs = True
    keeps_mass = False
    keeps_parents = False
    """the past of a state that began anew is not among the mixtures before."""
    keeps_families = False

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model whose x_0 cannot be moved, and too few particles."""
        super().check(now, num_particles, num_components)
        check_start(now.model, "a restart by the last observations moves x_0")
        if num_components > (least := round(LEAST_PART * num_particles)):
            which = f"of which {least} may be all of the slots of {num_components} components"
            raise ValueError(f"num_particles: {num_particles}, {which}")

    def around(self, reference: Any) -> AbstractMove:
        """Raise a `ValueError`: a trajectory that is kept would have to begin anew."""
        del reference
        raise ValueError("filter: restarts cannot keep a trajectory, as Resample and Propagate can")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture after this step, and before it a restart where that is due."""
        if mixture.usable_slots is not None:
            raise ValueError("slots: restarts by the last observations need every slot")
        key_restart, key_moves = split(key, 2)
        if RECENT not in mixture.memory:
            return in_turn(key_moves, self.moves, mixture, now)
        own = mixture.memory[RECENT]
        # The steps since the sum was zero, of which the oldest may be the first of a new state.
        age = jnp.where(mixture.memory[SURPRISE] > 0, own["age"] + 1, 0).astype(jnp.int32)
        is_due = is_alarmed(mixture) & (age >= self.num_observations)
        joined = cond_if_any(
            is_due, lambda: self._joined(key_restart, mixture, own, now, is_due), lambda: mixture
        )
        moved = in_turn(key_moves, self.moves, joined, now)
        growth = over_all_islands(moved.log_mass) - over_all_islands(joined.log_mass)
        growth = jnp.maximum(jax.lax.stop_gradient(growth), LEAST_GROWTH)
        recent = {
            "window": with_step(_without_oldest(own["window"]), jnp.int32(-1), now),
            "growths": jnp.append(own["growths"][1:], growth),
            "age": jnp.where(is_due, 0, age),
        }
        quiet = {SURPRISE: jnp.where(is_due, 0.0, mixture.memory[SURPRISE])}
        return moved.replace(memory=moved.memory | {RECENT: recent} | quiet)

    def _joined(
        self,
        key: Key[Array, ""],
        mixture: ParticleMixture,
        own: dict[str, PyTree],
        now: Step,
        is_due: Bool[Array, ""],
    ) -> ParticleMixture:
        """The hypotheses and those of a state that began anew, or the former where it is not due."""
        key_start, key_drawn, key_chosen, key_group = split(key, 4)
        n = mixture.num_particles
        paths, log_means = window_start(key_start, now.model, own["window"], n)
        log_new = jnp.log(self.probability) + jnp.sum(log_means - own["growths"])
        log_old = jnp.log1p(-self.probability)
        share = jax.nn.sigmoid(over_all_islands(log_new) - log_old)
        least = round(LEAST_PART * n)
        number = jnp.clip(jnp.round(share * n).astype(jnp.int32), least, n - least)
        survivors = Resample().resample(key_drawn, mixture.replace(usable_slots=n - number))
        # Each with the same chance, and any of them stand for all: they are in order along a curve.
        slots, dtype = jnp.arange(n) < number, log_new.dtype
        places = (jnp.arange(n).astype(dtype) + uniform(key_chosen, (), dtype)) * n
        places = jnp.minimum((places / number.astype(dtype)).astype(jnp.int32), n - 1)
        anew = single_component(paths.states, mixture.num_components)
        anew = anew.at(places).replace(usable_slots=number)
        log_share = -jnp.log(number.astype(anew.log_weights.dtype))
        anew = anew.replace(log_weights=jnp.where(slots, log_share, -jnp.inf))
        old, new = survivors.weighed(log_old[None]), anew.weighed(log_new[None])
        joined = old.joined(new.replace(ancestor_indices=no_ancestors(new)))
        joined = in_turn(key_group, self.grouping, joined.replace(usable_slots=None), None)
        return jax.tree.map(lambda new, old: jnp.where(is_due, new, old), joined, mixture)


def _without_oldest(window: Window) -> Window:
    return jax.tree.map(lambda leaf: jnp.roll(leaf, -1, axis=0), window)
