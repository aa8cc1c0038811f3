"""Groupings that are not clusters: all particles in one group, random sets, and given labels."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key, PyTree

from mpfjax.checks import saying, shown
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping, Regrouped, Step
from mpfjax.operations.prefix_sums import count_upto
from mpfjax.operations.random import bits
from mpfjax.operations.stored import take


class Pool(AbstractRegrouping):
    """Move all particles to component 0, so that the mixture is one particle set.

    The left-hand side of eq. 3 of Smith and Gatica-Perez (2004), read from right to left. Use it
    before a `Resample` in which the components should compete. Exact: only labels change.
    """

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """Component 0 for every particle."""
        return jnp.zeros_like(mixture.component_indicators), mixture.memory


class RandomPartition(AbstractRegrouping):
    """Divide the particles at random into sets of equal size, without replacement.

    Smith and Gatica-Perez (2004), section 4: C sets of N/C particles each; sizes differ by one if C
    does not divide N. Empty slots are assigned after the occupied ones. The weight of a set is the
    sum of its particles' weights (eq. 5), so the distribution does not change.

    C is the number of components. Use it if all components should represent the same distribution,
    as when `Partitioned` assigns a different order to each.
    """

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """A random set for every particle."""
        n, num_sets = mixture.num_particles, mixture.num_components
        # Sets are dealt in turn and then sorted into a random order. Each is a word: the set in the
        # lowest bits, random bits above it. Words of empty slots come after all others.
        width = (num_sets - 1).bit_length()
        occupied, index = mixture.occupied, jnp.arange(n, dtype=jnp.int32)
        num_filled = jnp.sum(occupied, dtype=jnp.int32)
        noise = bits(key, (n,)) >> (width + 1) << width
        is_last = (index >= num_filled).astype(jnp.uint32) << 31
        words = jax.lax.sort(is_last | noise | (index % num_sets).astype(jnp.uint32))
        dealt = (words & jnp.uint32((1 << width) - 1)).astype(jnp.int32)
        filled_before = count_upto(occupied, n) - occupied.astype(jnp.int32)
        turn = jnp.where(occupied, filled_before, num_filled + index - filled_before)
        return take(dealt, turn), mixture.memory


class GroupBy(AbstractRegrouping):
    """Group the particles by a label that is part of their state: a regime, a room, a hypothesis.

    A particle with label m is in component m. The labels do not change the weights, so the
    distribution does not change (Vermaak et al. 2003, section 4). With `Resample`, each label
    retains particles even while it is improbable. For regimes this is the IMM particle filter (Blom
    and Bloem 2007).

    - `group`: a function of the particles that returns their labels, (n,), such as `lambda states:
      states["room"]`: integers in [0, M), where M is the filter's `num_components`, or True and
      False for 1 and 0.

    A label outside [0, M) of an occupied slot breaks the run, which raises a RuntimeError. Raises
    `ValueError` for anything but a function, and for one that does not return such labels. Use it
    if the modes are known, and `KMeans`, `Merge` and `Split` if they are not.
    """

    group: Callable[[PyTree], Int[Array, " n"] | Bool[Array, " n"]] = eqx.field(static=True)

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Regroup the particles, also where there is one component: labels are then all zero."""
        if now.is_missing:
            return mixture
        return self.with_indicators(mixture, *self.regroup(key, mixture))

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """The label of every particle."""
        with saying("group of GroupBy", "called with the particles"):
            labels = self.group(mixture.particles)
        n, dtype = mixture.num_particles, getattr(labels, "dtype", float)
        if dtype == jnp.bool_:
            labels, dtype = labels.astype(jnp.int32), jnp.int32
        if jnp.shape(labels) != (n,) or not jnp.issubdtype(dtype, jnp.integer):
            what = f"not one whole number a particle, ({n},)"
            raise ValueError(f"group: it returned {shown(labels)}, {what}")
        return labels.astype(jnp.int32), mixture.memory
