"""Long runs: a loop with a checkpoint file and a progress bar, which ends at Ctrl-C or an error."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree
from tqdm import tqdm

from mpfjax.checks import Checked, Count, warn
from mpfjax.running import storage


class Checkpoint(Checked):
    """The file from which a long run continues: `fit`, `maximise`, and the samplers of parameters.

    - `path`: a .npz file, without pickles. If it exists, the same call continues from it, with the
      result of an uninterrupted run, to the bit. The call may ask for more steps or observations.
    - `every`: after how many steps it is written. It is also written when the run ends, fails or is
      interrupted. If the writing itself is interrupted, the old file remains.

    A file of a run with another filter, other data or other numbers is refused. The code of
    functions, such as a prior or an optimiser, is not compared: use a new file after you change it.

    Raises `ValueError` for an `every` below one.
    """

    path: storage.FilePath
    every: Count = 50


class State(NamedTuple):
    """All that a long run goes on from, and that its file holds."""

    step: int
    carry: PyTree  # what the next step needs
    rows: PyTree  # what is kept of the steps so far: arrays of numpy with a leading axis


Advance = Callable[[int, int, PyTree], tuple[int, PyTree, PyTree]]
"""From a step and what was carried, by some steps, at most to a last one; with their new rows."""


class Broken(Exception):
    """A run cannot go on: what it met in words, as "the likelihood was nan"."""


@dataclass(frozen=True)
class LongRun:
    """A run of the public function `caller`, up to a last step.

    `settings` are all numbers, arrays, modules and names that have to be the same for a file to be
    of this run, up to a step. The code of functions is not compared.
    """

    caller: str
    last: int
    checkpoint: Checkpoint | None
    progress: bool
    settings: Callable[[int], Mapping[str, Any]]

    def go(self, start: State, advance: Advance) -> tuple[State, str | None]:
        """The state after all steps, and why there are fewer, if there are.

        The run goes on from its file if there is one, unless the start has steps behind it. Ctrl-C,
        and what is `Broken`, end it with a warning and the steps before; without any row, Ctrl-C is
        raised, and what is broken at the start is a RuntimeError.
        """
        state = start if start.step else self._load(start) or start
        every = self.last if self.checkpoint is None else self.checkpoint.every
        pieces, last_save, stopped = [state.rows], state.step, None
        bar = tqdm(total=self.last, initial=state.step, disable=not self.progress, unit="step")
        try:
            while state.step < self.last:
                last = min(self.last, (state.step // every + 1) * every)
                step, carry, rows = advance(state.step, last, state.carry)
                bar.update(step - state.step)
                state, pieces = State(step, carry, None), [*pieces, rows]
                if step % every == 0:
                    pieces, last_save = [self._save(state, pieces)], step
        except Broken as error:
            if not state.step:
                raise RuntimeError(f"{self.caller}: {error} at the start") from error
            stopped = f"{error} at step {state.step}"
        except KeyboardInterrupt:
            if not any(map(len, jax.tree.leaves(pieces))):
                raise
            stopped = f"interrupted at step {state.step} of {self.last}"
        finally:
            bar.close()
            if state.step > last_save:
                pieces = [self._save(state, pieces)]
        if stopped is not None:
            warn(f"{self.caller}: {stopped}; its result is of the steps before", UserWarning)
        return state._replace(rows=_concatenate(pieces)), stopped

    def _identity(self, step: int) -> dict[str, str]:
        """What the file of this run holds of it, up to a step, as text."""
        return {"caller": self.caller} | storage.describe_parts(**self.settings(step))

    def _save(self, state: State, pieces: list[PyTree]) -> PyTree:
        """All rows in one piece, written to the file with the state."""
        rows = _concatenate(pieces)
        if self.checkpoint is not None:
            arrays = storage.arrays_of({"carry": state.carry, "rows": rows})
            notes = {"step": state.step, "identity": self._identity(state.step)}
            storage.write_described(self.checkpoint.path, arrays, notes)
        return rows

    def _load(self, like: State) -> State | None:
        """The state that the file holds, None without a file; a `ValueError` for another run's."""
        if self.checkpoint is None or not Path(self.checkpoint.path).exists():
            return None
        path = self.checkpoint.path
        arrays, notes = storage.read_described(path)
        step, other = notes.get("step", 0), notes.get("identity", {})
        identity = self._identity(step)
        if other != identity:
            difference = storage.differences(other, identity)
            raise ValueError(f"checkpoint: {path} is of another {self.caller}: {difference}")
        state = storage.tree_of_arrays(path, arrays, {"carry": like.carry, "rows": like.rows})
        return State(step, state["carry"], state["rows"])


def _concatenate(pieces: list[PyTree]) -> PyTree:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)
