"""A state that is redrawn given the last L observations: at step L of a run, or at an alarm."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import Count, CountOrZero, InnerShare
from mpfjax.memory import Memory
from mpfjax.mixture import BEGAN_ANEW, ParticleMixture, single_component
from mpfjax.moves.base import AbstractMove, AbstractWrapper, Moves, Step, as_moves, in_turn
from mpfjax.moves.initial import require_propagation
from mpfjax.moves.start.alarm import Alarm
from mpfjax.moves.start.sampler import (
    Window,
    check_initial_density,
    sample_window,
    systematic_sample,
)
from mpfjax.operations.islands import num_islands, over_islands
from mpfjax.operations.logarithms import default_float, finite_or_zero, log_sum_exp
from mpfjax.operations.random import split
from mpfjax.operations.rows import select_rows
from mpfjax.operations.stored import cond_if_any

# In the memory.
RECENT = "the last observations"
# Of the slots, the hypotheses before a restart and the new ones have at least this part each.
LEAST_PART = 1 / 16


class RecentSteps(Memory):
    """The last L steps, the latest at the end, and how probable the filter found them.

    - `window`: their data; its leaves are None until the first step shows their shapes.
    - `log_increments`: the evidence of each, as a restart has to replace it.
    - `is_impossible`: which had no likelihood under any hypothesis.
    - `log_evidence`: what the step adds to log Ẑ if the state has been drawn anew in it.
    - `is_renewed`: whether it has.
    - `age`: the steps since the alarm's sum was zero, the oldest that a restart goes back to.
    - `alarm`: None where nothing restarts.
    - `is_rushed`: whether some sample of a window was poor.
    """

    window: Window
    log_increments: Float[Array, " steps"]
    is_impossible: Bool[Array, " steps"]
    log_evidence: Float[Array, ""]
    is_renewed: Bool[Array, ""]
    age: Int[Array, ""]
    is_rushed: Bool[Array, ""]
    alarm: Alarm | None
    probability: float = eqx.field(static=True)
    start: int = eqx.field(static=True)
    """the step of the run at which the state is drawn anew in any case; 0 for none."""

    def check_run(self, num_steps: int) -> None:
        """Raise a `ValueError` for a run that ends before its start."""
        if num_steps < self.start:
            which = f"fewer than num_observations of with_initialisation, {self.start}"
            raise ValueError(f"observations: {num_steps} steps, {which}")

    def check_past(self) -> None:
        """Raise a `ValueError` if the state is drawn anew at a step of every run."""
        if self.start:
            reason = f"with_initialisation draws the state anew at step {self.start}"
            raise ValueError(f"filter: {reason}, so that a run cannot be smoothed")

    def warning(self) -> str:
        """Where the powers of a likelihood ran out."""
        sampler = "the sampler of with_initialisation and with_restarts"
        message = f"the likelihood is too narrow for {sampler}, which ran out of powers"
        return message if np.any(self.is_rushed) else ""

    def with_step(self, now: Step) -> "RecentSteps":
        """The steps with one more, without the oldest; a missing observation is not present."""
        is_present = jnp.asarray(now.is_present)
        data = Window(now.observation, now.inputs, is_present)
        observations, inputs, present = (
            old if new is None else _push(old, new, self.log_increments.shape[0])
            for old, new in zip(self.window, data, strict=True)
        )
        if not now.is_present:
            observations = jax.tree.map(partial(jnp.roll, shift=-1, axis=0), observations)
        return dataclasses.replace(
            self,
            window=Window(observations, inputs, present),
            log_increments=jnp.roll(self.log_increments, -1),
            is_impossible=jnp.roll(self.is_impossible, -1).at[-1].set(False),
            is_renewed=jnp.zeros((), bool),
        )

    def after_step(
        self, mixture: ParticleMixture, now: Step
    ) -> tuple["RecentSteps", dict[str, PyTree]]:
        """Reports the evidence of a state drawn anew, and none before the first such step."""
        assert mixture.within is not None
        increment, additions = mixture.within.log_increment, {}
        is_impossible = (increment == -jnp.inf) & ~self.is_renewed
        against = jnp.zeros_like(increment)
        if self.alarm is not None and now.is_present:
            against = self.alarm.log_evidence(now)
            # No hypothesis explains y_t but that the state began anew.
            increment = jnp.where(is_impossible, np.log(self.probability) + against, increment)
        increment = jnp.where(self.is_renewed, self.log_evidence, increment)
        # At a start it is known of each step.
        last = increment
        if self.start:
            last = jnp.where(mixture.t == self.start, self.log_increments[-1], increment)
        alarm, age = self.alarm, self.age
        if alarm is not None:
            against = jnp.where(now.is_present, against - jax.lax.stop_gradient(last), 0.0)
            alarm = alarm.heard(against)
            alarm = Alarm(jnp.where(mixture.t > self.start, alarm.total, 0.0), alarm.num_particles)
            age = jnp.where(self.is_renewed, -1, age)
            age = jnp.where(alarm.total > 0, age + 1, 0).astype(jnp.int32)
            additions |= {"log_evidence_against_start": against, "alarm": alarm.rings}
        is_early = mixture.t < self.start
        reported = jnp.where(is_early, 0.0, increment)
        is_degenerate = (is_impossible | (reported == -jnp.inf)) & ~is_early
        additions |= {"log_likelihood_increment": reported, "degenerate": is_degenerate}
        new = dataclasses.replace(
            self,
            log_increments=self.log_increments.at[-1].set(jax.lax.stop_gradient(last)),
            is_impossible=self.is_impossible.at[-1].set(is_impossible),
            age=age,
            alarm=alarm,
        )
        return new, additions


class Restart(AbstractWrapper):
    """Redraws the state given the last L observations, at step L or when the alarm is raised.

    `sample_window` draws N particles of p(x_t | y_{t-L+1}..y_t), for a state that started from the
    prior L steps ago, with its evidence. At step L of a run, the initialisation, they replace all
    particles. Before, the filter runs without change, and the increments are reported as zero; then
    their sum is the estimate of the sampler, so that Ẑ is unbiased.

    At a restart, the new particles are weighted by p times their evidence, the existing components
    by 1 - p times theirs for the same L observations. Each receives slots in proportion to its
    weight, but at least a sixteenth. A restart happens if the alarm (`Alarm`) is raised and its sum
    was last zero at least L steps ago. So Ẑ is unbiased for a state that may restart at the steps
    to which an alarm refers, and at no others. A step in which no hypothesis has a positive
    likelihood contributes p times the evidence of a state that restarts in it, until a restart
    replaces this value.

    - `grouping`: moves that group the new particles; usually the initial moves.
    - `num_observations`: L.
    - `at_start`: whether the filter is initialised at step L of a run.
    - `probability`: p; None never restarts.
    - `num_particles`: draws of x_0 of the alarm.

    `with_initialisation` and `with_restarts` make filters with it. Raises `ValueError` in a filter
    of a model without a density of x_0 in floating point, of a conditionally linear model, and for
    fewer slots than components at a restart.
    """

    grouping: Moves = eqx.field(converter=lambda moves: as_moves(moves, "grouping"))
    num_observations: Count = eqx.field(static=True, default=8)
    at_start: bool = eqx.field(static=True, default=False)
    probability: InnerShare | None = eqx.field(static=True, default=None)
    num_particles: CountOrZero = eqx.field(static=True, default=0)

    holds = ("grouping",)
    approximate = False
    weighs = True
    keeps_mass = True
    keeps_parents = False
    """a state that began anew has no parent in the step before."""
    keeps_families = False
    biases_score = True
    """derivatives do not see the sampler."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model whose x_0 cannot be moved, and too few particles."""
        super().check(now, num_particles, num_components)
        check_initial_density(now.model, "a state drawn anew from observations")
        least = least_slots(num_particles)
        if self.probability is not None:
            require_propagation(now, "draws of x_0 are compared")
            if num_components > least:
                which = f"of which {least} may be all of the slots of {num_components} components"
                raise ValueError(f"num_particles: {num_particles}, {which}")

    def around(self, reference: Any) -> AbstractMove:
        """Raise a `ValueError`: a trajectory cannot be kept where the state begins anew."""
        raise ValueError("filter: with_initialisation and with_restarts cannot keep a trajectory")

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """Room for L steps."""
        length = self.num_observations
        room = partial(_room, length=length)
        window = Window(room(now.observation), room(now.inputs), jnp.zeros(length, bool))
        has_alarm = self.probability is not None
        recent = RecentSteps(
            window=window,
            log_increments=jnp.zeros(length, default_float()),
            is_impossible=jnp.zeros(length, bool),
            log_evidence=jnp.zeros((), default_float()),
            is_renewed=jnp.zeros((), bool),
            age=jnp.zeros((), jnp.int32),
            is_rushed=jnp.zeros((), bool),
            alarm=Alarm(jnp.zeros(()), self.num_particles) if has_alarm else None,
            probability=self.probability or 0.0,
            start=length if self.at_start else 0,
        )
        return super().initial_memory(now, num_components) | {RECENT: recent}

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture with the state drawn anew, where it is due."""
        if mixture.usable_slots is not None:
            raise ValueError("num_slots: with_initialisation and with_restarts need every slot")
        recent = mixture.memory[RECENT].with_step(now)
        mixture = mixture.replace(memory=mixture.memory | {RECENT: recent}).with_order(False)
        is_due = is_start = jnp.asarray(self.at_start) & (mixture.t == self.num_observations)
        if recent.alarm is not None and now.is_present:
            is_late = recent.age + 1 >= self.num_observations
            is_due |= recent.alarm.rings & is_late & (mixture.t > recent.start)
        elif not self.at_start:
            return mixture

        def renew() -> ParticleMixture:
            new = self._renew(key, mixture, now, is_start)
            return jax.tree.map(lambda new, old: jnp.where(is_due, new, old), new, mixture)

        return cond_if_any(is_due, renew, lambda: mixture)

    def _renew(
        self, key: Key[Array, ""], mixture: ParticleMixture, now: Step, is_start: Bool[Array, ""]
    ) -> ParticleMixture:
        """The mixture of the particles drawn anew, and at a restart of those that there are."""
        key_sample, key_join, key_group = split(key, 3)
        recent: RecentSteps = mixture.memory[RECENT]
        n, model = mixture.num_particles, now.model
        if now.initial_model is not None:
            model = now.initial_model
        sample = sample_window(key_sample, model, recent.window, n)
        alone = single_component(sample.states, mixture.num_components).replace(
            ancestor_indices=jnp.full(n, BEGAN_ANEW, jnp.int32), memory=mixture.memory, t=mixture.t,
            within=mixture.within, waits=mixture.waits,
        )  # fmt: skip
        log_z = jnp.sum(sample.log_increments)
        start = alone.replace(log_scale=log_z - np.log(num_islands()))
        log_increments = sample.log_increments
        moved, log_old_increment = start, jnp.zeros_like(log_z)
        if self.probability is not None:
            assert mixture.within is not None
            growth = jax.lax.stop_gradient(mixture.within.log_increment)
            # The evidence of each step by the old hypotheses, or where it is zero, by the new ones.
            old_increments = recent.log_increments.at[-1].set(growth)
            old_increments = jnp.where(
                old_increments > -jnp.inf, old_increments, finite_or_zero(sample.log_increments)
            )
            is_impossible = jnp.any(recent.is_impossible) | (growth == -jnp.inf)
            log_odds = jnp.sum(sample.log_increments - old_increments)
            both = self._join(key_join, mixture, alone, log_odds, is_impossible)
            moved = jax.tree.map(partial(jnp.where, is_start), start, both)
            log_old_increment = jnp.where(is_start, 0.0, old_increments[-1])
            log_increments = jnp.where(is_start, sample.log_increments, old_increments)
        moved, log_growth = moved.normalised(mixture)
        recent = dataclasses.replace(
            recent,
            log_increments=log_increments,
            is_impossible=jnp.zeros_like(recent.is_impossible),
            log_evidence=log_old_increment + log_growth,
            is_renewed=jnp.ones((), bool),
            is_rushed=recent.is_rushed | sample.is_rushed,
        )
        moved = moved.replace(memory=moved.memory | {RECENT: recent})
        # Grouping, as of x_0, waits for no observation.
        return in_turn(key_group, self.grouping, moved, dataclasses.replace(now, is_initial=True))

    def _join(
        self,
        key: Key[Array, ""],
        old: ParticleMixture,
        new: ParticleMixture,
        log_odds: Float[Array, ""],
        is_impossible: Bool[Array, ""],
    ) -> ParticleMixture:
        """The hypotheses with 1 - p of the weight, and the new ones with p times their odds.

        Each are resampled to their slots; the new ones get label 0, until they are grouped.
        """
        n, p = old.num_particles, self.probability or 0.0
        log_old = old.log_mass + jnp.where(is_impossible, -jnp.inf, np.log1p(-p))
        log_new = np.log(p) + log_odds - np.log(num_islands())
        # In proportion to both over all islands.
        share = jax.nn.sigmoid(_over_all_islands(log_new) - _over_all_islands(log_old))
        least = least_slots(n)
        number = jnp.clip(jnp.round(jnp.nan_to_num(share, nan=0.5) * n), least, n - least)
        number = number.astype(jnp.int32)
        # New ones are as good as each other, old ones are drawn by their weights.
        slot, num_old = jnp.arange(n, dtype=jnp.int32), n - number
        is_new = slot >= num_old
        new = new.at(jnp.minimum((slot - num_old) * n // number, n - 1))
        old = old.at(systematic_sample(key, old.log_weights, num_old))
        log_weights = jnp.where(is_new, log_new - jnp.log(number), log_old - jnp.log(num_old))
        particles = select_rows(is_new, new.particles, old.particles)
        return old.with_resampled(old.active).replace(
            particles=particles,
            log_weights=log_weights.astype(old.log_weights.dtype),
            component_indicators=jnp.where(is_new, 0, old.component_indicators),
            ancestor_indices=jnp.where(is_new, BEGAN_ANEW, old.ancestor_indices),
        )


def least_slots(num_particles: int) -> int:
    """Of the hypotheses before a restart, and of the new ones: at least a part."""
    return max(1, round(LEAST_PART * num_particles))


def _over_all_islands(log_value: Float[Array, ""]) -> Float[Array, ""]:
    """The logarithm of the sum over all islands of what each has."""
    return log_value if num_islands() == 1 else log_sum_exp(over_islands(log_value))


def _room(tree: PyTree, length: int) -> PyTree:
    """Zeros in the shape of so many trees."""

    def zeros(leaf: Any) -> Array:
        leaf = jnp.asarray(leaf)
        return jnp.zeros((length, *leaf.shape), leaf.dtype)

    return jax.tree.map(zeros, tree)


def _push(old: PyTree, new: PyTree, length: int) -> PyTree:
    """The rows with a new one at the end, without the first."""
    rows = _room(new, length) if old is None else old
    return jax.tree.map(
        lambda leaves, leaf: jnp.roll(leaves, -1, axis=0).at[-1].set(leaf.astype(leaves.dtype)),
        rows, jax.tree.map(jnp.asarray, new),
    )  # fmt: skip
