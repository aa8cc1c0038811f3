"""A look-ahead over many steps: a mixture of exponentials of quadratics, with heavy tails."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mpfjax.operations.matrices import row_sums


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
    log_floor: Float[Array, "*t"]
    log_cap: Float[Array, "*t"]
    defence: Float[Array, "*t"]

    def log_normaliser(self, features: Float[Array, "n d"]) -> Float[Array, " n"]:
        """log ν."""
        return jnp.logaddexp(self.log_fitted(features), self.log_floor)

    def log_fitted(self, features: Float[Array, "n d"]) -> Float[Array, " n"]:
        """log Σ_k r_k ν_k, without the constant c."""
        return jax.nn.logsumexp(self._log_parts(self.whitened(features)), axis=1)

    def draw(
        self, noise: Float[Array, "n j_and_1"], features: Float[Array, "n d"]
    ) -> tuple[Float[Array, "n j"], Float[Array, " n"]]:
        """ε ~ q(. | x) made of standard normal noise, and log N(ε; 0, I) / q(ε | x).

        The last column of the noise chooses the expert of ε, or none.
        """
        noise, chooser = noise[:, :-1], noise[:, -1]
        whitened = self.whitened(features)
        log_parts = self._log_parts(whitened)
        log_total = jnp.logaddexp(jax.nn.logsumexp(log_parts, axis=1), self.log_floor)
        log_shares = jnp.log1p(-self.defence) + log_parts - log_total[:, None]
        undisturbed = self.defence + (1 - self.defence) * jnp.exp(self.log_floor - log_total)
        upto = jnp.cumsum(jnp.exp(log_shares), axis=1)
        chosen = jnp.sum(jax.scipy.special.ndtr(chooser)[:, None] >= upto, axis=1, dtype=jnp.int32)
        means = self.noise_means[None] + jnp.einsum("kjd,nkd->nkj", self.noise_slopes, whitened)
        of_experts = means + jnp.einsum("kij,nj->nki", self.noise_factors, noise)
        is_chosen = chosen[:, None] == jnp.arange(means.shape[1], dtype=jnp.int32)[None]
        drawn = jnp.sum(jnp.where(is_chosen[:, :, None], of_experts, 0.0), axis=1)
        drawn = jnp.where(jnp.any(is_chosen, axis=1)[:, None], drawn, noise)
        identity = jnp.eye(noise.shape[1], dtype=noise.dtype)
        inverses = jax.scipy.linalg.solve_triangular(
            self.noise_factors, jnp.broadcast_to(identity, self.noise_factors.shape), lower=True
        )
        residuals = jnp.einsum("kij,nkj->nki", inverses, drawn[:, None] - means)
        log_volumes = jnp.sum(jnp.log(jnp.diagonal(inverses, axis1=1, axis2=2)), axis=1)
        log_ratios = 0.5 * (row_sums(drawn**2)[:, None] - jnp.sum(residuals**2, axis=2))
        log_ratios = log_shares + log_ratios + log_volumes[None]
        log_ratio = jnp.logaddexp(jax.nn.logsumexp(log_ratios, axis=1), jnp.log(undisturbed))
        return drawn, -log_ratio

    def whitened(self, features: Float[Array, "n d"]) -> Float[Array, "n k d"]:
        """z_k of each particle."""
        centred = features[:, None] - self.centres[None]
        return jnp.einsum("kij,nkj->nki", self.whitening, centred)

    def log_near(self, whitened: Float[Array, "n k d"]) -> Float[Array, "n k"]:
        """log r_k: by the Gaussians of the experts' particles."""
        log_near = self.log_shares[None] - 0.5 * jnp.sum(whitened**2, axis=2)
        return log_near - jax.nn.logsumexp(log_near, axis=1, keepdims=True)

    def _log_parts(self, whitened: Float[Array, "n k d"]) -> Float[Array, "n k"]:
        """log r_k ν_k."""
        d = whitened.shape[2]
        # Three standard deviations above the mean of a χ² of d degrees of freedom.
        most = (d + 3 * (2 * d) ** 0.5) ** 0.5
        radius = jnp.sqrt(jnp.maximum(jnp.sum(whitened**2, axis=2), 1e-12))
        within = whitened * jnp.minimum(1.0, most / radius)[:, :, None]
        log_normalisers = self.constants[None] + jnp.einsum("nkd,kd->nk", within, self.slopes)
        curved = jnp.einsum("nkd,kde->nke", within, self.curvatures)
        log_normalisers = log_normalisers + 0.5 * jnp.sum(curved * within, axis=2)
        log_normalisers = jnp.minimum(log_normalisers, self.log_cap)
        beyond = jnp.maximum(radius - most, 0.0)
        return self.log_near(whitened) + log_normalisers - 0.5 * beyond**2


def neutral(
    num_experts: int, num_features: int, num_noises: int, dtype: jnp.dtype
) -> LocalQuadratics:
    """ψ = 1: no information about later observations."""
    k, d, j = num_experts, num_features, num_noises
    zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
    return LocalQuadratics(
        zeros(k, d), zeros(k, d, d), zeros(k), zeros(k), zeros(k, d), zeros(k, d, d),
        zeros(k, j), zeros(k, j, d), jnp.broadcast_to(jnp.eye(j, dtype=dtype), (k, j, j)),
        log_floor=jnp.full((), -jnp.inf, dtype), log_cap=zeros(), defence=jnp.ones((), dtype),
    )  # fmt: skip
