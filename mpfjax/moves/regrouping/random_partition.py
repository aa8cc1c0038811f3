"""Random partition: the particles dealt into sets of equal size."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key, PyTree

from mpfjax.checks import check_whole, given
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractRegrouping
from mpfjax.operations.prefix_sums import count_upto
from mpfjax.operations.random import bits
from mpfjax.operations.stored import take


class RandomPartition(AbstractRegrouping):
    """Deal the particles at random into sets of equal size, without replacement.

    Smith and Gatica-Perez (2004), section 4: C sets of N/C particles each; sizes differ by one if C
    does not divide N. Empty slots are dealt after the filled ones. The mass of a set is that of
    its particles (eq. 5), so the distribution does not change.

    - `num_sets`: C; None takes as many as the mixture has components.

    Raises `ValueError` for C < 1, or more sets than components. Use it where all components
    should stand for the same distribution, as when `Partitioned` gives each an order of its own.
    """

    num_sets: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_whole(**given(num_sets=self.num_sets))

    def regroup(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], dict[str, PyTree]]:
        """A random set for every particle."""
        n = mixture.num_particles
        num_sets = mixture.num_components if self.num_sets is None else self.num_sets
        if num_sets > mixture.num_components:
            raise ValueError(
                f"num_sets: {num_sets} is more than num_components, {mixture.num_components}"
            )
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
