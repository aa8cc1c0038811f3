"""Gaussian regeneration of objects of which most may not exist, from few particles each."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mpfjax.mixture import ParticleMixture
from mpfjax.moves.resampling.allocation import allocate_slots
from mpfjax.moves.resampling.gaussian import GaussianRegeneration
from mpfjax.moves.resampling.line import Line
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.logarithms import scaled_exp

_POWER = 0.25  # of a component's weight, by which it receives slots


class _ByRoot(Resample):
    """Slots in proportion to the fourth root of the weights.

    An object that exists receives some ten times as many as a false measurement, which begins one
    of 1e-4, and this still has enough for its moments.
    """

    def deal(
        self, mixture: ParticleMixture, line: Line, due: Bool[Array, " m"]
    ) -> Int[Array, " m"]:
        """How many slots each component receives."""
        demands, _ = scaled_exp(jnp.where(due, _POWER * line.log_masses, -jnp.inf))
        unchanged = jnp.zeros_like(due, jnp.int32)
        each = self.particles_per_component
        return allocate_slots(unchanged, due, mixture.num_usable_slots, each, demands)


class RegenerateObjects(GaussianRegeneration):
    """`GaussianRegeneration` for the many components of a `bernoulli_filter`.

    Σ_m is the unbiased estimate, that of the paper divided by 1 - Σ w_i². With fifty particles for
    each object, the paper's Σ_m shrinks by some percent in each step, so that the filter becomes
    overconfident. Components receive slots in proportion to the fourth root of their weight.
    """

    @property
    def _resample(self) -> Resample:
        return _ByRoot(particles_per_component=self.particles_per_component)

    def _correct(
        self, covariances: Float[Array, "m d d"], mixture: ParticleMixture
    ) -> Float[Array, "m d d"]:
        sizes = jnp.maximum(mixture.component_effective_sample_sizes, 2.0)
        return covariances * (sizes / (sizes - 1)).astype(covariances.dtype)[:, None, None]
