"""Delayed measurements: the steps since then are repeated, with their own keys."""

from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Checked, Count, CountOrZero, checked
from mpfjax.filter import Filter
from mpfjax.mixture import ParticleMixture
from mpfjax.report import StepInfo


class PastStep(NamedTuple):
    """What a step was made of; `observation` is None where it was missing."""

    key: Any
    mixture: ParticleMixture  # before the step
    observation: PyTree
    inputs: PyTree


class History(NamedTuple):
    """The present mixture, and the last steps, the latest at the end."""

    mixture: ParticleMixture
    steps: tuple[PastStep, ...] = ()


class Replay(Checked):
    """Steps of a filter that can be repeated when a delayed measurement arrives.

    A delayed y_s precedes all that was observed since. The mixture before step s is stored with the
    keys and observations of the steps from s on, and they are repeated with y_s in its place. So
    the result is, to the bit, that of a filter that received y_s in time. It takes as long as the
    steps since then.

    - `lag`: L, how many steps are stored, each with its mixture.

    A selection of x_0 by y_1 is not repeated. Raises `ValueError` for L < 1. Use it online, if
    sensors have delays: a camera frame that took longer than the odometry after it.
    """

    filter: Filter
    lag: Count = eqx.field(static=True)

    @checked
    def init(self, mixture: ParticleMixture) -> History:
        """The history that starts at this mixture, from `filter.init` or from any later step."""
        return History(mixture)

    @checked
    def step(
        self,
        key: Key[Array, ""],
        history: History,
        observation: PyTree = None,
        *,
        inputs: PyTree = None,
    ) -> tuple[History, StepInfo]:
        """The history after y_t, None if it is missing or has not arrived yet, and the report."""
        past = PastStep(key, history.mixture, observation, inputs)
        mixture, info = self._take(past)
        return History(mixture, (*history.steps, past)[-self.lag :]), info

    @checked
    def late(
        self, history: History, observation: PyTree, steps_ago: CountOrZero
    ) -> tuple[History, list[StepInfo]]:
        """The history with y_{t - steps_ago} in its place, and the reports of the later steps.

        `observation` contains everything observed in that step, and replaces what was known of it:
        if one of two sensors is late, both (a model with `handles_missing` then receives NaN in the
        step without it). Raises `ValueError` for a step that is no longer stored.
        """
        if steps_ago >= len(history.steps):
            raise ValueError(f"steps_ago: {steps_ago}, and {len(history.steps)} steps are stored")
        place = len(history.steps) - 1 - steps_ago
        steps, infos = list(history.steps), []
        steps[place] = steps[place]._replace(observation=observation)
        mixture = steps[place].mixture
        for t in range(place, len(steps)):
            steps[t] = steps[t]._replace(mixture=mixture)
            mixture, info = self._take(steps[t])
            infos.append(info)
        return History(mixture, tuple(steps)), infos

    def _take(self, past: PastStep) -> tuple[ParticleMixture, StepInfo]:
        """The step itself."""
        key, mixture, observation, inputs = past
        if observation is None:
            return self.filter.predict(key, mixture, inputs=inputs)
        return self.filter.step(key, mixture, observation, inputs=inputs)
