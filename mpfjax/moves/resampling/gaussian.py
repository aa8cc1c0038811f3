"""Gaussian regeneration: redraw each component from the Gaussian of its own moments."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import check_callable, check_one_of, check_positive, check_whole, given
from mpfjax.mixture import ParticleMixture, flatten_states, no_ancestors
from mpfjax.models.noise import NOISES, draw_noise, stratified_normal
from mpfjax.moves.base import AbstractResampling
from mpfjax.moves.regrouping.features import origin, summarise
from mpfjax.moves.resampling.allocation import allocate_slots, place_slots
from mpfjax.moves.resampling.ordering import sorted_order
from mpfjax.moves.resampling.resample import Resample
from mpfjax.operations.matrices import cholesky
from mpfjax.operations.random import split
from mpfjax.operations.segments import segment_argmax, spread
from mpfjax.operations.stored import take


class GaussianRegeneration(AbstractResampling):
    """Replace each component's particles by draws from N(μ_m, Σ_m), its own mean and covariance.

    μ_m = Σ w_i x_i and Σ_m = Σ w_i (x_i - μ_m)(x_i - μ_m)ᵀ, over the particles of component m (Lin
    et al. 2012, eqs. 10 and 11; Kotecha and Djuric 2003 for one component). The component keeps its
    mass, which its new particles share equally. It is an approximation unless the component is
    Gaussian (`approximate` is true): any shape other than an ellipse is lost. Use it where
    components are unimodal and resampling would leave too few distinct particles.

    - `particles_per_component`: as for `Resample`.
    - `where`: selects the part of the state that is redrawn, such as `lambda state: state.box`. The
      rest (angles, bounded or whole numbers) is copied from resampled particles. None redraws the
      whole state.
    - `inflation`: of the standard deviations; above 1 it compensates for the loss of spread.
    - `noise`: "independent"; or "stratified" or "rqmc", which spread the draws of all slots, or of
      each component, evenly. With "rqmc", each component's draws are then ordered along a Hilbert
      curve, as `Propagate(noise="rqmc")` needs them.

    With a singular Σ_m, draws stay in its plane; a component of one particle, or of copies of one,
    gives that particle again. With `where`, ancestors are the resampled particles; without it, the
    heaviest particle of the component. Raises `ValueError` for an inflation that is not positive,
    an unknown noise or particles_per_component < 1.
    """

    particles_per_component: int | None = eqx.field(static=True, default=None)
    where: Callable[[PyTree], PyTree] | None = eqx.field(static=True, default=None)
    inflation: float = eqx.field(static=True, default=1.0)
    noise: str = eqx.field(static=True, default="independent")

    def __check_init__(self) -> None:
        check_whole(**given(particles_per_component=self.particles_per_component))
        check_callable("a function that chooses from the state", **given(where=self.where))
        check_positive(inflation=self.inflation)
        check_one_of((*NOISES, "stratified"), noise=self.noise)

    @property
    def approximate(self) -> bool:
        """True: each component is replaced by a Gaussian."""
        return True

    @property
    def sorts(self) -> bool:
        """Whether the draws are put in order."""
        return self.noise == "rqmc"

    @property
    def keeps_parents(self) -> bool:
        """False: a draw of a Gaussian comes from all particles of its component."""
        return False

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Redraw every living component."""
        del observation
        key_noise, key_rest = split(key, 2)
        if self.where is None:
            vacated = self._vacated(mixture)
            drawn = self._draw(key_noise, mixture.particles, mixture, vacated)
            return self._in_line(vacated, drawn)
        resample = Resample(particles_per_component=self.particles_per_component)
        vacated = resample(key_rest, mixture)
        drawn = self._draw(key_noise, self.where(mixture.particles), mixture, vacated)
        return self._in_line(vacated, eqx.tree_at(self.where, vacated.particles, drawn))

    def _in_line(self, vacated: ParticleMixture, drawn: PyTree) -> ParticleMixture:
        """The mixture of these draws, ordered if the next noise is a point set over its slots."""
        mixture = vacated.replace(particles=drawn, ancestor_indices=no_ancestors(vacated))
        if self.noise != "rqmc":
            return mixture
        labels = mixture.component_indicators
        labels = jnp.where(mixture.occupied, labels, mixture.num_components)
        order = sorted_order(mixture, labels, self._redrawn)
        return mixture.replace(
            particles=jax.tree.map(lambda leaf: take(leaf, order), mixture.particles),
            log_weights=take(mixture.log_weights, order),
            component_indicators=take(mixture.component_indicators, order),
        )

    def _redrawn(self, particles: PyTree) -> Float[Array, "n d"]:
        """The part of the state that is redrawn, flattened."""
        return flatten_states(particles if self.where is None else self.where(particles))

    def _vacated(self, mixture: ParticleMixture) -> ParticleMixture:
        """The slots dealt anew, each holding its component's heaviest particle."""
        m, counts = mixture.num_components, mixture.component_counts
        targets = allocate_slots(
            jnp.zeros_like(counts), counts > 0, mixture.num_usable_slots,
            self.particles_per_component,
        )  # fmt: skip
        slots = place_slots(targets, mixture.num_particles)
        shares = jnp.maximum(targets, 1).astype(mixture.log_weights.dtype)
        log_weights = spread(mixture.log_mixture_weights - jnp.log(shares), slots.components)
        heaviest = segment_argmax(mixture.log_weights, mixture.component_indicators, m)
        parents = spread(heaviest, slots.components)
        return mixture.replace(
            particles=jax.tree.map(lambda leaf: take(leaf, parents), mixture.particles),
            log_weights=jnp.where(slots.filled, log_weights, -jnp.inf),
            component_indicators=slots.components,
        )

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
                raise ValueError(
                    f"where: the state{jax.tree_util.keystr(place)} is {leaf.dtype}, and no draw of"
                    " a Gaussian is; choose the leaves that are floating point"
                )
        states = jnp.where(mixture.occupied[:, None], flatten_states(chosen), 0.0)
        centre = origin(states, mixture)  # far from zero, rounding would lose the moments
        states = jnp.where(mixture.occupied[:, None], states - centre[None], 0.0)
        weights = mixture.component_weights.astype(states.dtype)
        moments = summarise(states, weights, mixture.component_indicators, mixture.num_components)
        factors = self.inflation * cholesky(moments.covariances)
        factors = spread(factors, vacated.component_indicators)
        shape = (states.shape[0], states.shape[1])
        if self.noise == "stratified":
            noise = stratified_normal(key, shape, states.dtype)
        else:
            labels, num_components = vacated.component_indicators, mixture.num_components
            noise = draw_noise(self.noise, key, shape, states.dtype, labels, num_components)
        offsets = jnp.einsum("nij,nj->ni", factors, noise)
        means = spread(moments.means, vacated.component_indicators)
        unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], chosen))[1]
        return jax.vmap(unravel)(centre[None] + means + offsets)
