"""A state that is redrawn given the last L observations: at step L of a run, or at an alarm.

The alarm is a cumulative sum of the evidence against all hypotheses (CUSUM, Page 1954).
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import CountOrZero, InnerShare
from mpfjax.memory import Memory
from mpfjax.mixture import BEGAN_ANEW, ParticleMixture, single_component
from mpfjax.models.series import Series
from mpfjax.moves.base import AbstractMove, AbstractRegrouping, Step, in_turn, name_of
from mpfjax.moves.initial import require_propagation
from mpfjax.moves.start.sampler import check_initial_density, sample_window, systematic_sample
from mpfjax.operations.islands import num_islands
from mpfjax.operations.logarithms import finite_or_zero, without_gradient
from mpfjax.operations.random import split
from mpfjax.operations.stored import cond_if_any, select_rows, take

# In the memory.
ALARM, RECENT = "alarm", "the last observations"
# Above it, all hypotheses are judged wrong.
THRESHOLD = 5.0


class Alarm(Memory):
    """The cumulative sum: after each step the filter is compared with the same draws of x_0.

    The sum is bounded, so that it ends soon after the hypotheses are right again, and so is the
    evidence of one step, of which an impossible one would otherwise count for ever.
    """

    total: Float[Array, ""]
    age: Int[Array, ""]
    """the steps since the sum was zero, the oldest that a restart goes back to."""
    log_evidence: Float[Array, ""]
    """log p(y_t | x_{t-1} ~ p_0), of a state that restarts."""

    def with_evidence(self, mixture: ParticleMixture, now: Step) -> "Alarm":
        """The alarm with the evidence of y_t for N draws of x_0."""
        now = without_gradient(now)
        key_initial, key_move = jax.random.split(jax.random.key(0))
        draws = now.initial_law.sample_initial(key_initial, mixture.num_particles)
        assert now.propagation is not None
        log_evidence = now.propagation(key_move, single_component(draws), now).log_mass
        return dataclasses.replace(self, log_evidence=log_evidence)

    def after_step(self, mixture: ParticleMixture, now: Step) -> tuple["Alarm", dict[str, PyTree]]:
        """Adds the evidence less the increment; zero where y_t is missing, or a start replaces x_t.

        At a start the increment is of all steps.
        """
        assert mixture.within is not None
        against = self.log_evidence - jax.lax.stop_gradient(mixture.within.log_increment)
        start = mixture.memory[RECENT].start if RECENT in mixture.memory else 0
        against = jnp.where(now.is_present & (mixture.t > start), against, 0.0)
        change = jnp.clip(jnp.nan_to_num(against), -2 * THRESHOLD, 2 * THRESHOLD)
        total = jnp.clip(self.total + change, 0.0, 2 * THRESHOLD)
        # A restart goes back to no step before another one.
        is_zero = (total == 0) | jnp.any(mixture.began_anew)
        alarm = Alarm(total, jnp.where(is_zero, 0, self.age + 1), self.log_evidence)
        return alarm, {"log_evidence_against_start": against, "alarm": total > THRESHOLD}


class RecentSteps(Memory):
    """The last L steps, the latest at the end, and how probable the filter found them.

    - `window`: their data; its leaves are None until the first step shows their shapes.
    - `log_increments`: the evidence of each, as a restart has to replace it.
    - `start`: the step of the run at which the state is drawn anew in any case; 0 for none.
    """

    window: Series
    log_increments: Float[Array, " steps"]
    start: int = eqx.field(static=True)

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

    def after_step(
        self, mixture: ParticleMixture, now: Step
    ) -> tuple["RecentSteps", dict[str, PyTree]]:
        """Reports the increments of a start at its end, and those that only a restart explains.

        The window has each step's own.
        """
        assert mixture.within is not None
        increment, is_start = mixture.within.log_increment, mixture.t == self.start
        is_last = is_start | (increment == -jnp.inf)
        last = jnp.where(is_last, self.log_increments[-1], increment)
        recent = dataclasses.replace(self, log_increments=self.log_increments.at[-1].set(last))
        increment = jnp.where(is_start, increment, jnp.where(mixture.t < self.start, 0.0, last))
        return recent, {"log_likelihood_increment": increment}

    def with_step(self, now: Step, log_increment: Float[Array, ""]) -> "RecentSteps":
        """The steps with one more, without the oldest; a missing observation is not present."""

        def push(rows: PyTree, row: PyTree) -> PyTree:
            if row is None:
                return jax.tree.map(partial(jnp.roll, shift=-1, axis=0), rows)
            rows = _room(row, self.log_increments.shape[0]) if rows is None else rows
            return jax.tree.map(lambda rows, row: jnp.roll(rows, -1, 0).at[-1].set(row), rows, row)

        observations = push(self.window.observations, now.observation)
        inputs = push(self.window.inputs, now.inputs)
        window = Series(observations, inputs, present=push(self.window.present, now.is_present))
        log_increments = push(self.log_increments, log_increment)
        return dataclasses.replace(self, window=window, log_increments=log_increments)


class Restart(AbstractMove):
    """Redraws the state given the last L observations, at step L or when the alarm is raised.

    `sample_window` draws N particles of p(x_t | y_{t-L+1}..y_t), for a state that started from the
    prior L steps ago, with its evidence. At step L of a run, the initialisation, they replace all
    particles. Before, the filter runs without change, and the increments are reported as zero; then
    their sum is the estimate of the sampler, so that Ẑ is unbiased.

    At a restart, the new particles are weighted by p times their evidence, the existing components
    by 1 - p times theirs for the same L observations, and each receive half of the slots. A restart
    happens if the alarm (`Alarm`) is raised and its sum was last zero at least L steps ago. So Ẑ is
    unbiased for a state that may restart at the steps to which an alarm refers, and at no others. A
    step in which no hypothesis has a positive likelihood contributes p times the evidence of a
    state that restarts in it. The filter's initial moves group the new particles.

    - `num_observations`: L; 0 for an alarm that changes no particles.
    - `at_start`: whether the filter is initialised at step L of a run.
    - `probability`: p; None never restarts.
    - `has_alarm`: whether the memory has an `Alarm`, which a restart needs.

    `with_initialisation`, `with_restarts` and `with_alarm` make filters with it. Raises
    `ValueError` in a filter of a model without a density of x_0 in floating point, of a
    conditionally linear model, and at a start for initial moves that do more than regroup; and for
    an alarm without a move that draws x_t of each particle.
    """

    num_observations: CountOrZero = eqx.field(static=True)
    at_start: bool = eqx.field(static=True)
    probability: InnerShare | None = eqx.field(static=True)
    has_alarm: bool = eqx.field(static=True)

    approximate = False
    keeps_mass = True
    biases_score = property(lambda self: self.num_observations > 0)
    # A state that began anew has no parent in the step before.
    keeps_parents = keeps_families = property(lambda self: self.num_observations == 0)

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model whose x_0 cannot be moved, or x_0 of another law."""
        if self.has_alarm:
            require_propagation(now, "draws of x_0 are compared")
        if self.num_observations:
            check_initial_density(now.model, "a state drawn anew from observations")
        moves = now.filter.initial_moves
        others = [move for move in moves if not isinstance(move, AbstractRegrouping)]
        if self.at_start and others:
            who = f"initial_moves: {name_of(others[0])} does more than regroup"
            raise ValueError(f"{who}, but with_initialisation replaces x_0")

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """The alarm before any observation, and room for L steps."""
        memory: dict[str, PyTree] = {}
        if self.has_alarm:
            memory[ALARM] = Alarm(jnp.zeros(()), jnp.zeros((), jnp.int32), jnp.zeros(()))
        if length := self.num_observations:
            room, present = partial(_room, length=length), jnp.zeros(length, bool)
            window = Series(room(now.observation), room(now.inputs), present=present)
            start = length if self.at_start else 0
            memory[RECENT] = RecentSteps(window, jnp.zeros(length), start)
        return memory

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """The mixture with the state drawn anew, where it is due."""
        memory = mixture.memory
        if self.has_alarm and now.is_present:
            memory = memory | {ALARM: memory[ALARM].with_evidence(mixture, now)}
        if not self.num_observations:
            return mixture.replace(memory=memory)
        if mixture.usable_slots is not None:
            raise ValueError("num_slots: with_initialisation and with_restarts need every slot")
        assert mixture.within is not None
        increment, is_due = mixture.within.log_increment, mixture.t == memory[RECENT].start
        if self.probability is not None and now.is_present:
            alarm: Alarm = memory[ALARM]
            is_due |= (alarm.total > THRESHOLD) & (alarm.age + 1 >= self.num_observations)
            # No hypothesis explains y_t but that the state restarted.
            log_restart = np.log(self.probability) + alarm.log_evidence
            increment = jnp.where(increment == -jnp.inf, log_restart, increment)
        recent = memory[RECENT].with_step(now, increment)
        mixture = mixture.replace(memory=memory | {RECENT: recent}).with_order(False)
        if not self.at_start and (self.probability is None or not now.is_present):
            return mixture
        renew = partial(self._renew, key, mixture, now, is_due)
        return cond_if_any(is_due, renew, lambda: mixture)

    def _renew(
        self, key: Key[Array, ""], old: ParticleMixture, now: Step, is_due: Bool[Array, ""]
    ) -> ParticleMixture:
        """The particles drawn anew: all at a start, and every other slot at a restart.

        At a restart, the existing ones have 1 - p of the weight, and the new ones p times the odds
        of the window's evidence. The new ones get label 0, until they are grouped.
        """
        key_sample, key_join, key_group = split(key, 3)
        recent: RecentSteps = old.memory[RECENT]
        n, p, is_start = old.num_particles, self.probability, old.t == recent.start
        num_old, slot = max(n // 2, 1), jnp.arange(n, dtype=jnp.int32)
        states, increments = sample_window(key_sample, now.initial_law.model, recent.window, n)
        # The evidence of each step by the old hypotheses, which the new ones replace.
        replaced = jnp.where(is_start, 0.0, finite_or_zero(recent.log_increments))
        log_odds = jnp.sum(increments - replaced)
        # They may be of any size, and are kept apart from the weights.
        log_scale = finite_or_zero(log_odds)
        log_new = jnp.where(is_start, 0.0, np.log(p or 1)) + log_odds - log_scale
        log_old = jnp.where(is_start, -jnp.inf, np.log1p(-(p or 0))) + old.log_mass - log_scale
        # New ones are as good as each other, old ones are drawn by their weights.
        is_new = is_start | (slot % 2 == 0)
        log_new -= jnp.log(jnp.sum(is_new, dtype=log_new.dtype)) + np.log(num_islands())
        log_weights = jnp.where(is_new, log_new, log_old - np.log(num_old))
        drawn = systematic_sample(key_join, old.log_weights, num_old)
        both = old.at(take(drawn, jnp.minimum(slot // 2, num_old - 1)))
        assert old.within is not None
        recent = dataclasses.replace(
            recent, log_increments=jnp.where(is_start, increments, replaced)
        )
        both = both.replace(
            particles=select_rows(is_new, states, both.particles),
            log_weights=log_weights.astype(old.log_weights.dtype),
            component_indicators=jnp.where(is_new, 0, both.component_indicators),
            ancestor_indices=jnp.where(is_new, BEGAN_ANEW, both.ancestor_indices),
            log_scale=log_scale,
            memory=old.memory | {RECENT: recent},
            within=dataclasses.replace(old.within, log_increment=replaced[-1]),
        )
        moved = both.with_resampled(both.active).normalised_within(old)
        moves = now.filter.initial_moves
        groupings = tuple(move for move in moves if isinstance(move, AbstractRegrouping))
        # Grouping, as of x_0, waits for no observation.
        moved = in_turn(key_group, groupings, moved, dataclasses.replace(now, is_initial=True))
        return jax.tree.map(partial(jnp.where, is_due), moved, old)


def _room(tree: PyTree, length: int) -> PyTree:
    """Zeros in the shape of so many trees."""
    return jax.tree.map(lambda leaf: jnp.zeros((length, *leaf.shape), leaf.dtype), tree)
