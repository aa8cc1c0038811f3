"""Every: other moves, at every k-th step only."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key, PyTree

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove, as_moves, initial_memory, name_of, without_dead
from mpfjax.operations.random import split


def _of_moves(together: Callable[..., bool], name: str) -> Any:
    found = lambda self: together(getattr(move, name) for move in self.moves)  # noqa: E731
    return property(found, doc=f"Whether it is so of {together.__name__} of the moves.")


class Every(AbstractMove):
    """Run other moves at the steps k, 2k, 3k, ..., and none at the steps between.

    Vermaak et al. (2003), section 4, regroup "from time to time". Regrouping is exact at any time,
    and need not be done at every step. The step's number is kept in the mixture's memory, so that a
    run that continues from a checkpoint equals a run without interruption. The number does not
    depend on the run: under `vmap` over seeds the steps between cost nothing. A missing observation
    does not count as a step, since nothing is regrouped or resampled there.

    - `num_steps`: k, from 1 on.
    - `moves`: regrouping and resampling moves, in order.

    Raises `ValueError` for k < 1, no moves, and a move of another kind: without a propagation at
    every step the state would not move. Use it where regrouping is a large part of the time.
    """

    num_steps: Count = eqx.field(static=True)
    moves: tuple[Any, ...] = eqx.field(converter=lambda moves: as_moves(moves, "moves"))

    def __check_init__(self) -> None:
        others = [name_of(move) for move in self.moves if not move.keeps_mass]
        if others or not self.moves:
            which = "neither regroups, resamples nor moves by a Markov kernel"
            raise ValueError(f"moves: {', '.join(others) or 'none'} {which}")

    weighs = False
    keeps_mass = True
    # What is so of any of the moves, and what is so of all.
    approximate = _of_moves(any, "approximate")
    needs_parents = _of_moves(any, "needs_parents")
    keeps_parents = _of_moves(all, "keeps_parents")
    keeps_families = _of_moves(all, "keeps_families")

    @property
    def inner(self) -> tuple[AbstractMove, ...]:
        """The moves."""
        return self.moves

    def map_inner(self, change: Callable[[Any], Any]) -> "Every":
        """The same with other moves."""
        return Every(self.num_steps, [change(move) for move in self.moves])

    def around(self, reference: Any) -> "Every":
        """The moves around the trajectory, at the same steps."""
        return self.map_inner(lambda move: move.around(reference))

    @property
    def name(self) -> str:
        """The name under which the number of the step is kept."""
        return f"every {self.num_steps}: {', '.join(type(move).__name__ for move in self.moves)}"

    @property
    def own_memory(self) -> frozenset[str]:
        """The number of the step; that of the moves is their own."""
        return frozenset({self.name})

    def would_resample(
        self, mixture: ParticleMixture, observation: PyTree = None
    ) -> Bool[Array, " m"]:
        """Which components of `mixture` the moves would resample now."""
        due = jnp.stack([move.would_resample(mixture, observation) for move in self.moves])
        return jnp.any(due, axis=0) & self._runs(mixture)

    def __call__(
        self,
        key: Key[Array, ""],
        mixture: ParticleMixture,
        observation: PyTree = None,
        after: Callable[[ParticleMixture], ParticleMixture] | None = None,
    ) -> ParticleMixture:
        """Run the moves if this is a k-th step.

        A filter calls `after` after each of its moves: moves with memory forget dead components,
        whose labels the next move may use again.
        """
        own = lambda moved: moved.replace(memory=self.forget(moved.memory, ~moved.active))  # noqa: E731
        after = own if after is None else after
        runs, steps = self._runs(mixture), self._steps(mixture) + 1
        counted = mixture.memory | {self.name: {"steps": steps % self.num_steps}}
        mixture = mixture.replace(memory=counted)

        def run() -> ParticleMixture:
            moved = mixture
            for move_key, move in zip(split(key, len(self.moves)), self.moves, strict=True):
                moved = after(move(move_key, moved, observation))
            return moved.replace(in_order=False)  # it is so at every k-th step alone

        if not all(move.regroups for move in self.moves):
            return jax.lax.cond(runs, run, lambda: mixture)

        # Only what they may change goes through the condition, which copies its operands.
        def regroup() -> tuple[Array, dict[str, PyTree]]:
            moved = run()
            return moved.component_indicators, moved.memory

        indicators, memory = jax.lax.cond(
            runs, regroup, lambda: (mixture.component_indicators, mixture.memory)
        )
        return mixture.replace(component_indicators=indicators, memory=memory)

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """The number of steps since the moves last ran, and the moves' own memory."""
        own = {self.name: {"steps": jnp.zeros((), jnp.int32)}}
        return own | initial_memory(self.moves, num_components)

    def forget(self, memory: dict[str, PyTree], dead: Bool[Array, " m"]) -> dict[str, PyTree]:
        """The memory without the moves' memory of dead components."""
        return without_dead(self.moves, memory, dead)

    def _steps(self, mixture: ParticleMixture) -> Int[Array, ""]:
        return mixture.memory[self.name]["steps"]

    def _runs(self, mixture: ParticleMixture) -> Bool[Array, ""]:
        return self._steps(mixture) == self.num_steps - 1
