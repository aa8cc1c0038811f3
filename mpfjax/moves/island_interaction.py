"""Interaction of islands: particles are dealt anew where the islands' masses have become uneven."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key, PyTree

from mpfjax.checks import check_share
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.islands import deal_to_islands, num_islands, over_islands
from mpfjax.operations.logarithms import softmax


class IslandInteraction(AbstractMove):
    """Deal every island's particles to all islands where their masses have become uneven.

    It is for `run_islands`; elsewhere there is one island, and it does nothing. An island resamples
    within itself and keeps its mass. After some time a few islands hold all the mass, and the
    computations of the others are wasted. The effective number of islands is (Σ π_g)² / Σ π_g²,
    where π_g is the mass of island g. Where it falls below `threshold` times the number of islands
    G, particle i of every island goes to island i mod G, with its joint weight, component label and
    ancestor. All islands then hold nearly the same mass. The move is exact: the whole mixture has
    the same particles, in other places (Whiteley, Lee and Heine 2016, show when islands should
    interact).

    - `threshold`: in [0, 1]; 0 never exchanges.

    No other move sends particles between devices. This one sends all of them at once, but only in
    the steps that need it. Put it before `Resample`, which then spreads the heavy particles over
    the slots of all islands. In a mixture, put it before the moves that regroup, since components
    of the same label become one. Raises `ValueError` for a threshold out of range, and where G does
    not divide the number of slots of an island.
    """

    threshold: float = eqx.field(static=True, default=0.5)

    def __check_init__(self) -> None:
        check_share(threshold=self.threshold)

    weighs = False
    keeps_mass = True
    """the observation changes no weight."""

    keeps_parents = False
    """those of a particle that was dealt to an island are on another one."""

    def around(self, reference: Any) -> "IslandInteraction":
        """The move itself: on the one island of conditional SMC it does nothing."""
        del reference
        return self

    def is_due(self, mixture: ParticleMixture) -> Bool[Array, ""]:
        """Whether the masses of the islands are uneven enough; the result is the same on each."""
        log_masses = over_islands(mixture.log_mass)
        return 1 / jnp.sum(softmax(log_masses) ** 2) < self.threshold * num_islands()

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Deal the particles if it is due."""
        del key, observation
        if num_islands() == 1:
            return mixture
        if mixture.num_particles % num_islands():
            raise ValueError(
                f"num_particles: {mixture.num_particles} of an island cannot be dealt evenly to"
                f" {num_islands()} islands, as IslandInteraction does"
            )
        return jax.lax.cond(
            self.is_due(mixture), lambda: mixture.map_slots(deal_to_islands), lambda: mixture
        )
