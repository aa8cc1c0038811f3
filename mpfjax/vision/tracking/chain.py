"""What a tracker's own chain of moves has to hold, checked before anything is tracked."""

from collections.abc import Sequence

from mpfjax.moves.base import AbstractMove
from mpfjax.vision.tracking.appearance import LearnAppearance
from mpfjax.vision.tracking.assignment import Assign
from mpfjax.vision.tracking.births import Births
from mpfjax.vision.tracking.camera import FollowCamera
from mpfjax.vision.tracking.deaths import Deaths
from mpfjax.vision.tracking.memory import ASSIGNED, DOUBTS, EXTENT, LIVES, REFERENCES, SCORES
from mpfjax.vision.tracking.motion import PropagateObjects
from mpfjax.vision.tracking.noise import LearnNoise
from mpfjax.vision.tracking.occlusion import ShareDetections

# What each kind of move reads of the memory of others, and whose memory each is.
_READS = {
    Assign: {SCORES, LIVES},
    ShareDetections: {ASSIGNED, LIVES},
    PropagateObjects: {ASSIGNED, DOUBTS, SCORES},
    Deaths: {ASSIGNED, SCORES},
    Births: {ASSIGNED, LIVES, SCORES, EXTENT},
    LearnAppearance: {ASSIGNED, LIVES},
    FollowCamera: {LIVES, SCORES},
    LearnNoise: {ASSIGNED, LIVES, SCORES},
}
_KEPT_BY = {
    SCORES: "RankScores",
    ASSIGNED: "Assign",
    DOUBTS: "Assign",
    LIVES: "Deaths",
    EXTENT: "Deaths",
    REFERENCES: "LearnAppearance",
}


def check_chain(moves: Sequence[AbstractMove]) -> None:
    """Raise `ValueError` for moves that share one memory, or of which one needs another's."""
    kept = [name for move in moves for name in move.initial_memory(1)]
    for name in sorted({name for name in kept if kept.count(name) > 1}):
        kinds = [type(move).__name__ for move in moves if name in move.initial_memory(1)]
        raise ValueError(f"moves: {' and '.join(kinds)} would share one memory, {name!r}")
    if LIVES not in kept:
        raise ValueError("moves: a tracker needs Deaths, which says who lives")
    for move in moves:
        for kind, names in _READS.items():
            for name in sorted(names - set(kept)) if isinstance(move, kind) else ():
                raise ValueError(f"moves: {kind.__name__} needs {_KEPT_BY[name]}, in any place")
        weighs = isinstance(move, PropagateObjects) and move.model.sigma is not None
        if weighs and REFERENCES not in kept:
            raise ValueError(
                "moves: PropagateObjects weighs by colours (sigma) and needs LearnAppearance"
            )
