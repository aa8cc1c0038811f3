"""The checkpoint of an optimisation or of chains: their state, and a description of their run."""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import PyTree

from mpfjax.checks import check_type, check_whole, given
from mpfjax.running.storage.descriptions import contents_of, differences, fingerprint
from mpfjax.running.storage.files import as_path, load_arrays, read_description, write_arrays
from mpfjax.running.storage.states import arrays_of, filled

_NOTES = "notes"
Notes = dict[str, Any]
"""what is no array: the step, and whatever else says how to read the arrays."""


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint file of the public function `caller`, which continues from it if it exists.

    `identity` describes all that has to be the same for this run, up to a step.
    """

    path: Path
    caller: str
    identity: Callable[[int], Mapping[str, str]]

    def save(self, step: int, state: PyTree, **notes: Any) -> None:
        """Write the whole state after a step, with notes about it."""
        notes |= {"caller": self.caller, "identity": dict(self.identity(step)), "step": int(step)}
        write_arrays(self.path, arrays_of(state) | {_NOTES: np.array(json.dumps(notes))})

    def load(self, like: Callable[[Notes], PyTree]) -> tuple[Notes, PyTree]:
        """The notes and the state; `like` makes a state of the same structure from the notes.

        Raises `ValueError` for the file of another run, and for an incomplete one.
        """
        arrays = load_arrays(self.path)
        notes = self._notes(arrays)
        found, own = notes["identity"], dict(self.identity(notes["step"]))
        if found != own:
            raise ValueError(
                f"checkpoint: {self.path} is of another {self.caller}: {differences(found, own)}"
            )
        try:
            return notes, filled(self.path, arrays, like(notes))
        except ValueError as error:
            raise ValueError(f"checkpoint: {error}") from error

    def _notes(self, arrays: Mapping[str, np.ndarray]) -> Notes:
        try:
            notes = read_description(self.path, arrays, _NOTES)
            is_own = notes["caller"] == self.caller and notes["step"] >= 0
        except (KeyError, TypeError, ValueError):
            is_own, notes = False, {}
        if not is_own or not isinstance(notes.get("identity"), dict):
            raise ValueError(f"checkpoint: {self.path} is no checkpoint of {self.caller}")
        return notes


def check_checkpoint(checkpoint: Any, checkpoint_every: Any, checkpoint_name: Any) -> None:
    """The three arguments by which a function writes a file, before anything compiles."""
    check_whole(1, checkpoint_every=checkpoint_every)
    check_type(str, "a name", **given(checkpoint_name=checkpoint_name))
    check_type((str, os.PathLike), "the path of a file", **given(checkpoint=checkpoint))
    if checkpoint is not None and as_path(checkpoint, "checkpoint").is_dir():
        raise ValueError(f"checkpoint: {checkpoint} is a directory, not a file")


def identity_of(
    name: str | None, settings: Mapping[str, Any], code: Mapping[str, Any]
) -> dict[str, str]:
    """All that has to be the same for a file to belong to this run, as text.

    `settings` are texts, numbers, arrays and modules, and always compared. `code` are functions and
    optimisers: all that they hold is compared, or only the name that the user gave.
    """
    told = {part: held for part, held in settings.items() if isinstance(held, str)}
    rest = {part: held for part, held in settings.items() if part not in told}
    if name is not None:
        prints = {part: fingerprint(held)[:16] for part, held in rest.items()}
        return {"checkpoint_name": name} | told | prints
    for part, held in {**rest, **code}.items():
        told |= contents_of(part, held)
    return told
