"""Gaussian regeneration: redraw each component from the Gaussian of its own moments."""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture, flatten_states, no_ancestors
from mpfjax.models.law import refuse_marginalised
from mpfjax.models.noise import draw_noise
from mpfjax.moves.base import AbstractResampling, Step
from mpfjax.moves.regrouping.features import origin, summarise
from mpfjax.moves.resampling.line import sorted_order
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.matrices import cholesky
from mpfjax.operations.random import split
from mpfjax.operations.segments import spread


class GaussianRegeneration(AbstractResampling):
    """Replace each component's particles by draws from N(μ_m, Σ_m), with its own moments.

    μ_m = Σ w_i x_i and Σ_m = Σ w_i (x_i - μ_m)(x_i - μ_m)ᵀ, over the particles of component m (Lin
    et al. 2012, eqs. 10 and 11; Kotecha and Djuric 2003 for one component). The component keeps its
    weight, which its new particles share equally. It is an approximation unless the component is
    Gaussian (`approximate` is true): any shape other than an ellipse is lost. Use it if components
    are unimodal and resampling would leave too few distinct particles.

    - `particles_per_component`: as for `Resample`.
    - `where`: selects the part of the state that is redrawn, such as `lambda state: state.box`. The
      rest (angles, bounded numbers or integers) is copied from resampled particles. None redraws
      the whole state.
    - `noise`: "independent"; or "stratified" or "rqmc", which distribute the draws of all slots, or
      of each component, evenly. With "rqmc", each component's draws are then ordered along a
      Hilbert curve, as `Propagate(noise="rqmc")` requires.

    With a singular Σ_m, draws stay in its plane; a component of one particle, or of copies of one,
    reproduces that particle. A draw has no single ancestor. Raises `ValueError` for an unknown
    noise or particles_per_component < 1.
    """

    particles_per_component: Count | None = eqx.field(static=True, default=None, kw_only=True)
    where: Callable[[PyTree], PyTree] | None = eqx.field(static=True, default=None, kw_only=True)
    noise: Literal["independent", "stratified", "rqmc"] = eqx.field(
        static=True, default="independent", kw_only=True
    )

    approximate = True
    """each component is replaced by a Gaussian."""

    # The draws are functions of moments, which are differentiated; a part that is copied is not.
    biases_score = property(lambda self: self.where is not None)
    keeps_parents = False
    """a draw of a Gaussian comes from all particles of its component."""

    orders_draws = True
    """with "rqmc" noise, for a propagation with such noise."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for too few slots, and for particles that carry moments."""
        if self.where is None:
            refuse_marginalised(now.model, "GaussianRegeneration", "take Resample")
        self._resample.check(now, num_particles, num_components)

    def resample(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The mixture with every active component redrawn."""
        key_noise, key_rest = split(key, 2)
        vacated = self._resample.resample(key_rest, mixture)
        chosen = mixture.particles if self.where is None else self.where(mixture.particles)
        states = self._draw(key_noise, chosen, mixture, vacated)
        if self.where is not None:
            states = eqx.tree_at(self.where, vacated.particles, states)
        redrawn = vacated.replace(particles=states, ancestor_indices=no_ancestors(vacated))
        mixture = redrawn.with_resampled_of(mixture)
        if self.noise != "rqmc" or not self.orders_draws:
            return mixture
        # The next noise is a point set over its slots.
        labels = mixture.component_indicators
        labels = jnp.where(mixture.occupied, labels, mixture.num_components)
        return mixture.at(sorted_order(mixture, labels)).with_order(True)

    @property
    def _resample(self) -> Resample:
        """Deals the slots anew; where the whole state is redrawn, nothing else is used of it."""
        return Resample(
            particles_per_component=self.particles_per_component,
            allocation="equal" if self.where is None else "variance",
        )

    def _correct(
        self, covariances: Float[Array, "m d d"], mixture: ParticleMixture
    ) -> Float[Array, "m d d"]:
        """Σ_m as they are drawn from; a subclass may correct them."""
        return covariances

    def _draw(
        self,
        key: Key[Array, ""],
        chosen: PyTree,
        mixture: ParticleMixture,
        vacated: ParticleMixture,
    ) -> PyTree:
        """Draws for the new slots, with the moments of `mixture`'s components."""
        for place, leaf in jax.tree_util.tree_leaves_with_path(chosen):
            if not jnp.issubdtype(leaf.dtype, jnp.floating):
                which = f"the state{jax.tree_util.keystr(place)} is {leaf.dtype}"
                raise ValueError(f"where: {which}, not floating point as a Gaussian is")
        states = jnp.where(mixture.occupied[:, None], flatten_states(chosen), 0.0)
        centre = origin(states, mixture)  # far from zero, rounding would lose the moments
        states = jnp.where(mixture.occupied[:, None], states - centre[None], 0.0)
        weights = mixture.component_weights.astype(states.dtype)
        moments = summarise(states, weights, mixture.component_indicators, mixture.num_components)
        covariances = self._correct(moments.covariances, mixture)
        factors = spread(cholesky(covariances), vacated.component_indicators)
        labels, num_components = vacated.component_indicators, mixture.num_components
        noise = draw_noise(key, self.noise, states.shape, states.dtype, labels, num_components)
        offsets = jnp.einsum("nij,nj->ni", factors, noise)
        means = spread(moments.means, vacated.component_indicators)
        unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], chosen))[1]
        return jax.vmap(unravel)(centre[None] + means + offsets)


class RegenerateObjects(GaussianRegeneration):
    """`GaussianRegeneration` for the many components of a `bernoulli_filter`.

    Σ_m is the unbiased estimate, that of the paper divided by 1 - Σ w_i². With fifty particles for
    each object, the paper's Σ_m shrinks by some percent in each step, so that the filter becomes
    overconfident. The allocation is "root": an object that exists receives some ten times as many
    slots as a false measurement, which begins one of 1e-4, and this still has enough for its
    moments. Draws of "rqmc" noise are not ordered, which would take as long as the draws.
    """

    orders_draws = False

    @property
    def _resample(self) -> Resample:
        return Resample(particles_per_component=self.particles_per_component, allocation="root")

    def _correct(
        self, covariances: Float[Array, "m d d"], mixture: ParticleMixture
    ) -> Float[Array, "m d d"]:
        sizes = jnp.maximum(mixture.component_effective_sample_sizes, 2.0)
        return covariances * (sizes / (sizes - 1)).astype(covariances.dtype)[:, None, None]
