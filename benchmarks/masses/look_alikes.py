"""Two players of one team, seen by a camera: which of the two is it that was pointed at?

The colour model of section 5.2 knows the colours of their kit and starts on both. It follows one
object; which of the two, nothing in the picture says but the small differences of their looks.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from benchmarks.scenes import football_scene
from mpfjax import RandomWalk
from mpfjax.vision.boxes.colour_model import ColourModel
from mpfjax.vision.colour.bins import RGBColours
from mpfjax.vision.files.boxes import boxes_of_frame

_DEVIATIONS = np.array([3.0, 2.0, 0.03, 0.03])
_SIGMA = 0.5


class LookAlikes:
    """The rendered scene, the model of an object in it, and who is where in its last frame."""

    def __init__(self, num_steps: int, seed: int) -> None:
        scene = football_scene(jax.random.key(seed), num_steps + 1, num_players=2, num_opponents=3)
        first = boxes_of_frame(scene.tracks, 1)
        self.model = ColourModel.from_frame(
            scene.frames[0],
            np.stack([first[1], first[2]]),
            colours=RGBColours(8),
            sigma=_SIGMA,
            dynamics=RandomWalk(jnp.asarray(_DEVIATIONS, jnp.float32)),
            deviations=_DEVIATIONS,
            num_parts=2,
            share_reference=True,
        )
        self.observations = scene.frames[1:]
        last = boxes_of_frame(scene.tracks, num_steps + 1)
        boxes = np.stack([last[1], last[2]])
        self.centres = jnp.asarray(boxes[:, :2] + boxes[:, 2:] / 2, jnp.float32)

    def nearest(self, states: PyTree) -> Array:
        """Which of the two is nearer in the last frame."""
        offsets = states.box[:, None, :2] - self.centres[None]
        return jnp.argmin(jnp.sum(offsets**2, axis=2), axis=1).astype(jnp.int32)


def place(states: PyTree) -> Array:
    """The centre in pixels, in which components are grouped."""
    return states.box[:, :2]
