"""Grouping by labels: each value of the user's own label is a component."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree

from mpfjax.checks import check_callable, saying, shown
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping


class GroupBy(AbstractRegrouping):
    """Group the particles by a label that they have: a regime, a room, a hypothesis.

    A particle with label m is in component m. The labels do not change the weights, so the
    distribution stays the same (Vermaak et al. 2003, section 4). With `Resample`, each label keeps
    particles even while it is improbable. For regimes this is the IMM particle filter (Blom and
    Bloem 2007).

    - `function`: gives the label of each particle: whole numbers (n,), in [0, M), where M is the
      filter's `num_components`. A function of the particles, as `lambda states: states["room"]`.

    A label outside [0, M) of a filled slot is a RuntimeError that names the move. Raises
    `ValueError` for anything but a function, and for a function that does not return whole numbers
    (n,). Use it where you know what the modes are, and `KMeans`, `Merge` and `Split` where you do
    not.
    """

    function: Callable[[PyTree], Int[Array, " n"]] = eqx.field(static=True)

    def __check_init__(self) -> None:
        check_callable("a function of the particles", function=self.function)

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Regroup the particles, also where there is one component: labels are then all zero."""
        del observation
        indicators, _ = self.regroup(key, mixture)
        return mixture.replace(component_indicators=indicators)

    def regroup(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], dict[str, PyTree]]:
        """The label of every particle; that of an empty slot is moved into [0, M)."""
        del key
        with saying("in function, of GroupBy, which is called with the particles"):
            labels: Any = self.function(mixture.particles)
        check_labels(labels, mixture.num_particles)
        num_labels = mixture.num_components
        outside = mixture.occupied & ((labels < 0) | (labels >= num_labels))
        inside = jnp.clip(labels, 0, num_labels - 1).astype(jnp.int32)
        message = (
            f"GroupBy: function gave a label outside [0, {num_labels}), the filter's num_components"
        )
        return eqx.error_if(inside, jnp.any(outside), message), mixture.memory


def check_labels(labels: Any, num_particles: int) -> None:
    """Raise a `ValueError` for labels that are not one whole number a particle."""
    if not isinstance(labels, jax.Array | np.ndarray):
        raise ValueError(f"function: it returned {shown(labels)}, no array of whole numbers")
    if labels.shape != (num_particles,) or not jnp.issubdtype(labels.dtype, jnp.integer):
        raise ValueError(
            f"function: it returned {labels.dtype}{list(labels.shape)}, not one whole number a"
            f" particle, ({num_particles},)"
        )
