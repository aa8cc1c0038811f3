"""What a mixture remembers from step to step, and how a memory follows the particles.

A mixture's `memory` is a dictionary. An entry may be any pytree, which the move of that name reads
and replaces itself. An entry that is a `Memory` also follows resampling and steps, so that neither
the moves nor the filter need to know it.
"""

from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Bool, Int, PyTree


class Offspring(NamedTuple):
    """How particles were redrawn: the parent of each slot, and how many each component drew."""

    parents: Int[Array, " n"]
    num_drawn: Int[Array, " m"]
    due: Bool[Array, " m"]
    reference: Int[Array, ""] | None
    """the slot of the reference particle's offspring; None without a reference particle."""


class Memory(eqx.Module):
    """An entry of a mixture's memory that follows the particles. By default it does nothing."""

    def reference_slot(self) -> Int[Array, ""] | None:
        """The slot of a particle that has an offspring whatever is drawn."""
        return None

    def at_start(self, mixture: Any) -> "Memory":
        """The memory of particles that have no past."""
        return self

    def after_resampling(self, before: Any, after: Any, offspring: Offspring) -> "Memory":
        """The memory after particles were redrawn."""
        return self

    def after_step(self, mixture: Any, now: Any) -> tuple["Memory", dict[str, PyTree]]:
        """The memory after a step, and what it changes in the report, by field of `StepInfo`."""
        return self, {}

    def check_run(self, num_steps: int) -> None:
        """Raise a `ValueError` for a run of fewer steps than the memory needs."""

    def check_past(self) -> None:
        """Raise a `ValueError` if some state has no past among the particles in any case."""


def memories_of(memory: dict[str, PyTree]) -> dict[str, Memory]:
    """The entries that follow the particles, by name."""
    return {name: entry for name, entry in memory.items() if isinstance(entry, Memory)}


def reference_slot(memory: dict[str, PyTree]) -> Int[Array, ""] | None:
    """The slot of the reference particle in the first memory that has one."""
    slots = [entry.reference_slot() for entry in memories_of(memory).values()]
    return next((slot for slot in slots if slot is not None), None)


def after_resampling(before: Any, after: Any, offspring: Offspring) -> Any:
    """The redrawn mixture, whose memories have followed."""
    for name, entry in memories_of(before.memory).items():
        entry = entry.after_resampling(before, after, offspring)
        after = after.replace(memory=after.memory | {name: entry})
    return after


def check_past(memory: dict[str, PyTree]) -> None:
    """Raise a `ValueError` for a memory by which a run cannot be smoothed."""
    for entry in memories_of(memory).values():
        entry.check_past()


def at_start(mixture: Any) -> Any:
    """The mixture, whose memories are those of particles without a past."""
    new = {name: entry.at_start(mixture) for name, entry in memories_of(mixture.memory).items()}
    return mixture.replace(memory=mixture.memory | new) if new else mixture


def after_step(mixture: Any, now: Any) -> tuple[Any, dict[str, PyTree]]:
    """The mixture with its memories after the step, and what they add to the step's report."""
    report: dict[str, PyTree] = {}
    for name, entry in memories_of(mixture.memory).items():
        entry, added = entry.after_step(mixture, now)
        mixture, report = mixture.replace(memory=mixture.memory | {name: entry}), report | added
    return mixture, report
