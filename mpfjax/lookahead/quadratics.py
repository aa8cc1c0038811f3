"""A look-ahead over many steps: a mixture of exponentials of quadratics, with heavy tails."""

import itertools
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from mpfjax.operations.matrices import Coordinates, coordinates, inner, log_total, transform

Index = Int[Array, ""]


class LocalQuadratics(eqx.Module):
    """ψ(x, ε) = c + Σ_k r_k(x) exp Q_k(x, ε), with its normaliser and its draws in closed form.

    x is the state before the move, represented by its features φ(x), (n, d), and ε the standard
    normal noise of the move, (n, j). Each expert k has a quadratic Q_k that is accurate around its
    own particles; r_k(x), from 0 to 1 with sum 1, measures how near x is to them. With ν_k(x) = ∫
    N(ε; 0, I) exp Q_k(x, ε) dε, the exponential of a quadratic in φ,

        ν(x) = ∫ N(ε; 0, I) ψ(x, ε) dε = c + Σ_k r_k(x) ν_k(x),
        q(ε | x) = Σ_k r_k ν_k / ν N(ε; m_k(x), F_k F_kᵀ) + c / ν N(ε; 0, I).

    Both have heavy tails. ν is never below c, and q is mixed with a share δ of N(0, I) (defensive
    importance sampling, Hesterberg 1995), so that no weight N(ε; 0, I) / q is above 1 / δ. Far from
    the particles that it was fitted to, a quadratic is unreliable: ν_k is at most a cap, and falls
    off with the distance.

    - `centres`, `whitening`, `log_shares`: of the experts' particles; z_k = whitening (φ - centre).
    - `constants`, `slopes`, `curvatures`: log ν_k as a quadratic in z_k.
    - `noise_means`, `noise_slopes`, `noise_factors`: m_k = mean + slope z_k, and F_k, triangular.
    - `noise_whitening`: F_k⁻¹, of which every step and particle has use.
    - `log_floor`, `log_cap`, `defence`: log c, the cap of log ν_k, and δ.
    """

    centres: Float[Array, "*t k d"]
    whitening: Float[Array, "*t k d d"]
    log_shares: Float[Array, "*t k"]
    constants: Float[Array, "*t k"]
    slopes: Float[Array, "*t k d"]
    curvatures: Float[Array, "*t k d d"]
    noise_means: Float[Array, "*t k j"]
    noise_slopes: Float[Array, "*t k j d"]
    noise_factors: Float[Array, "*t k j j"]
    noise_whitening: Float[Array, "*t k j j"]
    log_floor: Float[Array, "*t"]
    log_cap: Float[Array, "*t"]
    defence: Float[Array, "*t"]

    def log_normaliser(self, features: Float[Array, "n d"]) -> Float[Array, " n"]:
        """log ν."""
        return self._log_sum(self._log_parts(coordinates(features)))

    def log_fitted(self, features: Float[Array, "n d"]) -> Float[Array, " n"]:
        """log Σ_k r_k ν_k, without the constant c."""
        return log_total(self._log_parts(coordinates(features)))

    def draw(
        self, noise: Float[Array, "n j_and_1"], features: Float[Array, "n d"]
    ) -> tuple[Float[Array, "n j"], Float[Array, " n"]]:
        """ε ~ q(. | x) made of standard normal noise, and log N(ε; 0, I) / q(ε | x).

        The last column of the noise chooses the expert of ε, or none.
        """
        states = coordinates(features)
        *standard, chooser = coordinates(noise)
        log_parts = self._log_parts(states)
        log_sum = self._log_sum(log_parts)
        log_shares = [jnp.log1p(-self.defence) + log_part - log_sum for log_part in log_parts]
        undisturbed = self.defence + (1 - self.defence) * jnp.exp(self.log_floor - log_sum)

        def draw_of(k: Index) -> Coordinates:
            deviations = transform(self.noise_factors[k], standard, is_lower=True)
            return [
                mean + part for mean, part in zip(self._mean(k, states), deviations, strict=True)
            ]

        of_experts = zip(*self._each(draw_of), strict=True)
        uniform = jax.scipy.special.ndtr(chooser)
        upto = list(itertools.accumulate(jnp.exp(log_share) for log_share in log_shares))
        noises = standard
        for limit, of_expert in reversed(list(zip(upto, of_experts, strict=True))):
            noises = [
                jnp.where(uniform < limit, new, old)
                for new, old in zip(of_expert, noises, strict=True)
            ]
        norm = inner(noises, noises)

        def log_ratio_of(k: Index) -> Float[Array, " n"]:
            away = [x - mean for x, mean in zip(noises, self._mean(k, states), strict=True)]
            residuals = transform(self.noise_whitening[k], away, is_lower=True)
            log_volume = jnp.sum(jnp.log(jnp.diagonal(self.noise_whitening[k])))
            return 0.5 * (norm - inner(residuals, residuals)) + log_volume

        ratios = zip(log_shares, self._each(log_ratio_of), strict=True)
        log_ratios = [log_share + log_ratio for log_share, log_ratio in ratios]
        return jnp.stack(noises, axis=1), -log_total([*log_ratios, jnp.log(undisturbed)])

    def whitened(self, features: Float[Array, "n d"]) -> Float[Array, "k d n"]:
        """z_k of each particle, the particles last."""
        states = coordinates(features)
        return jnp.stack(self._each(partial(self._whitened, points=states)), axis=1)

    def log_near(self, features: Float[Array, "n d"]) -> Float[Array, "k n"]:
        """log r_k: by the Gaussians of the experts' particles."""
        states = coordinates(features)

        def log_density_of(k: Index) -> Float[Array, " n"]:
            z = self._whitened(k, states)
            return self.log_shares[k] - 0.5 * inner(z, z)

        log_densities = self._each(log_density_of)
        return log_densities - log_total(list(log_densities))[None]

    def _log_sum(self, log_parts: Coordinates) -> Float[Array, " n"]:
        """log ν of its parts."""
        return jnp.logaddexp(log_total(log_parts), self.log_floor)

    def _log_parts(self, points: Coordinates) -> Coordinates:
        """log r_k ν_k of each expert."""
        function = partial(self._log_density_and_normaliser, points=points)
        log_densities, log_normalisers = self._each(function)
        return list(log_densities - log_total(list(log_densities))[None] + log_normalisers)

    def _log_density_and_normaliser(
        self, k: Index, points: Coordinates
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """log r_k but for its sum over k, and log ν_k."""
        z = self._whitened(k, points)
        d, square = len(z), inner(z, z)
        # Three standard deviations above the mean of a χ² of d degrees of freedom.
        most = (d + 3 * (2 * d) ** 0.5) ** 0.5
        radius = jnp.sqrt(jnp.maximum(square, 1e-12))
        inwards = jnp.minimum(1.0, most / radius)
        within = [inwards * x for x in z]
        curved = transform(self.curvatures[k], within)
        bent = [self.slopes[k, i] + 0.5 * x for i, x in enumerate(curved)]
        log_normaliser = jnp.minimum(self.constants[k] + inner(bent, within), self.log_cap)
        beyond = jnp.maximum(radius - most, 0.0)
        return self.log_shares[k] - 0.5 * square, log_normaliser - 0.5 * beyond**2

    def _whitened(self, k: Index, points: Coordinates) -> Coordinates:
        """z_k."""
        centred = [x - self.centres[k, i] for i, x in enumerate(points)]
        return transform(self.whitening[k], centred, is_lower=True)

    def _mean(self, k: Index, points: Coordinates) -> Coordinates:
        """m_k(x)."""
        moved = transform(self.noise_slopes[k], self._whitened(k, points))
        return [self.noise_means[k, i] + x for i, x in enumerate(moved)]

    def _each(self, function: Callable[[Index], PyTree]) -> PyTree:
        """What the function gives for each expert, stacked.

        A loop keeps it. Written out, XLA would compute it again wherever it is used.
        """
        return jax.lax.map(function, jnp.arange(self.centres.shape[-2], dtype=jnp.int32))


def neutral(
    num_experts: int, num_features: int, num_noises: int, dtype: jnp.dtype
) -> LocalQuadratics:
    """ψ = 1: no information about later observations."""
    k, d, j = num_experts, num_features, num_noises

    def zeros(*shape: int) -> Array:
        return jnp.zeros(shape, dtype)

    identities = jnp.broadcast_to(jnp.eye(j, dtype=dtype), (k, j, j))
    return LocalQuadratics(
        zeros(k, d), zeros(k, d, d), zeros(k), zeros(k), zeros(k, d), zeros(k, d, d),
        zeros(k, j), zeros(k, j, d), identities, identities,
        log_floor=jnp.full((), -jnp.inf, dtype), log_cap=zeros(), defence=jnp.ones((), dtype),
    )  # fmt: skip
