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
from mpfjax.mixture import BEGAN_ANEW, ParticleMixture
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
from mpfjax.operations.stored import cond_if_any, select_rows, take

# In the memory.
RECENT = "the last observations"
# Of the slots, the hypotheses before a restart and the new ones have at least this part each.
LEAST_PART = 1 / 16


class RecentSteps(Memory):
    """The last L steps, the latest at the end, and how probable the filter found them.

    - `window`: their data; its leaves are None until the first step shows their shapes.
    - `log_increments`: the evidence of each, as a restart has to replace it.
    - `is_impossible`: which had no likelihood under any hypothesis.
    - `age`: the steps since the alarm's sum was zero, the oldest that a restart goes back to.
    - `alarm`: None where nothing restarts.
    - `is_rushed`: whether some sample of a window was poor.
    - `report`: what the last step adds to its report.
    """

    window: Window
    log_increments: Float[Array, " steps"]
    is_impossible: Bool[Array, " steps"]
    age: Int[Array, ""]
    is_rushed: Bool[Array, ""]
    alarm: Alarm | None
    report: dict[str, Array]
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

    def after_step(
        self, mixture: ParticleMixture, now: Step
    ) -> tuple["RecentSteps", dict[str, PyTree]]:
        """What the move found in this step."""
        return self, self.report

    def with_step(self, now: Step, log_increment: Float[Array, ""]) -> "RecentSteps":
        """The steps with one more, without the oldest; a missing observation is not present."""
        length = self.log_increments.shape[0]
        observations, inputs, present = (
            old if new is None else _push(old, new, length)
            for old, new in zip(
                self.window, (now.observation, now.inputs, now.is_present), strict=True
            )
        )
        if not now.is_present:
            observations = jax.tree.map(partial(jnp.roll, shift=-1, axis=0), observations)
        return dataclasses.replace(
            self,
            window=Window(observations, inputs, present),
            log_increments=_push(self.log_increments, log_increment, length),
            is_impossible=_push(self.is_impossible, log_increment == -jnp.inf, length),
        )

    def with_report(
        self,
        mixture: ParticleMixture,
        now: Step,
        log_evidence: Float[Array, ""],
        increment: Float[Array, ""],
    ) -> "RecentSteps":
        """The memory after a step with this increment, and this evidence of one from x_0."""
        # At a start, the increment is of all steps, but the evidence of each is in the memory.
        last = jnp.where(mixture.t == self.start, self.log_increments[-1], increment)
        is_early = mixture.t < self.start
        is_degenerate = (self.is_impossible[-1] | (increment == -jnp.inf)) & ~is_early
        alarm, age, report = self.alarm, self.age, {"degenerate": is_degenerate}
        if alarm is not None:
            against = log_evidence - last if now.is_present else jnp.zeros_like(last)
            # Before, the hypotheses are those that the start replaces.
            alarm = alarm.heard(jnp.where(mixture.t > self.start, against, 0.0))
            age = jnp.where(alarm.total > 0, age + 1, 0)
            report |= {"log_evidence_against_start": against, "alarm": alarm.rings}
        log_increments = self.log_increments.at[-1].set(last)
        return dataclasses.replace(
            self, log_increments=log_increments, age=age, alarm=alarm, report=report
        )


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
    - `num_particles`: draws of x_0 of the alarm; 0 for a start without an alarm.

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
    weighs = True
    keeps_mass = True
    keeps_parents = False
    """a state that began anew has no parent in the step before."""
    keeps_families = False
    biases_score = True
    """derivatives do not see the sampler."""
    # A trajectory cannot be kept where the state begins anew.
    around = AbstractMove.around

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model whose x_0 cannot be moved, and too few particles."""
        super().check(now, num_particles, num_components)
        check_initial_density(now.model, "a state drawn anew from observations")
        least = least_slots(num_particles)
        if self.num_particles:
            require_propagation(now, "draws of x_0 are compared")
        if self.probability is not None and num_components > least:
            which = f"of which {least} may be all of the slots of {num_components} components"
            raise ValueError(f"num_particles: {num_particles}, {which}")

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """Room for L steps."""
        length, no, zero = self.num_observations, jnp.zeros((), bool), jnp.zeros(())
        room = partial(_room, length=length)
        alarm, report = None, {"degenerate": no}
        if self.num_particles:
            alarm = Alarm(zero, self.num_particles)
            report |= {"log_evidence_against_start": zero, "alarm": no}
        recent = RecentSteps(
            window=Window(room(now.observation), room(now.inputs), room(no)),
            log_increments=room(jnp.zeros((), default_float())),
            is_impossible=room(no),
            age=jnp.zeros((), jnp.int32),
            is_rushed=no,
            alarm=alarm,
            report=report,
            start=length if self.at_start else 0,
        )
        return super().initial_memory(now, num_components) | {RECENT: recent}

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture with the state drawn anew, where it is due, and the increment of the step."""
        if mixture.usable_slots is not None:
            raise ValueError("num_slots: with_initialisation and with_restarts need every slot")
        increment = _increment(mixture)
        recent = mixture.memory[RECENT].with_step(now, increment)
        is_due, log_evidence = mixture.t == recent.start, jnp.zeros_like(increment)
        if recent.alarm is not None and now.is_present:
            log_evidence = recent.alarm.log_evidence(now)
            if (p := self.probability) is not None:
                # No hypothesis explains y_t but that the state began anew.
                increment = jnp.where(recent.is_impossible[-1], np.log(p) + log_evidence, increment)
                is_late = recent.age + 1 >= self.num_observations
                is_due |= recent.alarm.rings & is_late & (mixture.t > recent.start)
        mixture = _with_recent(mixture.with_order(False), recent, increment)
        if self.at_start or (self.probability is not None and now.is_present):
            mixture = cond_if_any(
                is_due, partial(self._renew, key, mixture, now, is_due), lambda: mixture
            )
        recent, increment = mixture.memory[RECENT], _increment(mixture)
        recent = recent.with_report(mixture, now, log_evidence, increment)
        return _with_recent(mixture, recent, jnp.where(mixture.t < recent.start, 0.0, increment))

    def _renew(
        self, key: Key[Array, ""], old: ParticleMixture, now: Step, is_due: Bool[Array, ""]
    ) -> ParticleMixture:
        """The particles drawn anew, all at a start, and at a restart beside those that there are.

        At a restart, the existing ones have 1 - p of the weight, and the new ones p times the odds
        of the window's evidence. Each are resampled to their slots; the new ones get label 0, until
        they are grouped.
        """
        key_sample, key_join, key_group = split(key, 3)
        recent: RecentSteps = old.memory[RECENT]
        n, p, is_start = old.num_particles, self.probability, old.t == recent.start
        log_p, log_rest = (0.0, -np.inf) if p is None else (np.log(p), np.log1p(-p))
        model = now.model if now.initial_model is None else now.initial_model
        sample = sample_window(key_sample, model, recent.window, n)
        # The evidence of each step by the old hypotheses, or where it is zero, by the new ones.
        is_possible = recent.log_increments > -jnp.inf
        old_increments = jnp.where(
            is_possible, recent.log_increments, finite_or_zero(sample.log_increments)
        )
        old_increments = jnp.where(is_start, 0.0, old_increments)
        log_odds = jnp.sum(sample.log_increments - old_increments)
        # At a start its evidence may be of any size, and is kept apart from the weights.
        log_scale = jnp.where(is_start, log_odds - np.log(num_islands()), 0.0)
        log_new = jnp.where(is_start, 0.0, log_p + log_odds - np.log(num_islands()))
        is_lost = is_start | jnp.any(recent.is_impossible)
        log_old = old.log_mass + jnp.where(is_lost, -jnp.inf, log_rest)
        # In proportion to both over all islands.
        share = jax.nn.sigmoid(_over_all_islands(log_new) - _over_all_islands(log_old))
        least = least_slots(n)
        number = jnp.clip(jnp.round(jnp.nan_to_num(share, nan=0.5) * n), least, n - least)
        number = jnp.where(is_start, n, number.astype(jnp.int32))
        # New ones are as good as each other, old ones are drawn by their weights.
        slot, num_old = jnp.arange(n, dtype=jnp.int32), n - number
        is_new, place = slot >= num_old, jnp.clip((slot - num_old) * n // number, 0, n - 1)
        new = jax.tree.map(lambda leaf: take(leaf, place), sample.states)
        both = old.at(systematic_sample(key_join, old.log_weights, num_old))
        log_weights = jnp.where(is_new, log_new - jnp.log(number), log_old - jnp.log(num_old))
        both = both.with_resampled(both.active).replace(
            particles=select_rows(is_new, new, both.particles),
            log_weights=log_weights.astype(old.log_weights.dtype),
            component_indicators=jnp.where(is_new, 0, both.component_indicators),
            ancestor_indices=jnp.where(is_new, BEGAN_ANEW, both.ancestor_indices),
            log_scale=log_scale,
        )
        moved, log_growth = both.normalised(old)
        recent = dataclasses.replace(
            recent,
            log_increments=jnp.where(is_start, sample.log_increments, old_increments),
            is_impossible=jnp.zeros_like(recent.is_impossible),
            age=jnp.full_like(recent.age, -1),
            is_rushed=recent.is_rushed | sample.is_rushed,
        )
        moved = _with_recent(moved, recent, old_increments[-1] + log_growth)
        # Grouping, as of x_0, waits for no observation.
        moved = in_turn(key_group, self.grouping, moved, dataclasses.replace(now, is_initial=True))
        return jax.tree.map(partial(jnp.where, is_due), moved, old)


def _increment(mixture: ParticleMixture) -> Float[Array, ""]:
    """What the step has added to log Ẑ so far."""
    assert mixture.within is not None
    return mixture.within.log_increment


def _with_recent(
    mixture: ParticleMixture, recent: RecentSteps, increment: Float[Array, ""]
) -> ParticleMixture:
    """The mixture of a step with this increment so far, and these last steps."""
    assert mixture.within is not None
    within = dataclasses.replace(mixture.within, log_increment=increment)
    return mixture.replace(memory=mixture.memory | {RECENT: recent}, within=within)


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
