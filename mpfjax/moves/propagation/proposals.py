"""Proposals q(x_t | x_{t-1}, y_t) whose density is known."""

import abc
import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key

from mpfjax.arrays import POSITIVE, to_array
from mpfjax.checks import Count, Positive, checked
from mpfjax.models.base import require
from mpfjax.models.noise import noise_dtype
from mpfjax.moves.base import AbstractProposal, Step
from mpfjax.operations.matrices import cholesky, solve_lower
from mpfjax.operations.random import normal

States = Float[Array, "n ..."]


class _Gaussian(NamedTuple):
    """N(mean, F Fᵀ) of every particle."""

    means: Float[Array, "n d"]
    log_volumes: Float[Array, " n"]  # log |F|
    forth: Callable[[Array], Array]  # from z to F z
    back: Callable[[Array], Array]

    def log_density(self, noise: Float[Array, "n d"]) -> Float[Array, " n"]:
        """The log density of mean + F z, for the noise z."""
        log_unit = 0.5 * noise.shape[1] * math.log(2 * math.pi)
        return -0.5 * jnp.sum(noise**2, axis=1) - log_unit - self.log_volumes


class ProposalOfNoise(AbstractProposal):
    """A proposal whose draws are functions of standard normal noise."""

    @abc.abstractmethod
    def noise_dimension(self, previous_states: Any) -> int:
        """The number of normal numbers that a draw is made of."""

    @abc.abstractmethod
    def propose_from_noise(
        self, noise: Float[Array, "n k"], now: Step, previous_states: Any
    ) -> tuple[Any, Float[Array, " n"]]:
        """x_t from this noise, and log q of each."""

    def propose(
        self, key: Key[Array, ""], now: Step, previous_states: Any
    ) -> tuple[Any, Float[Array, " n"]]:
        """x_t of every particle, and log q of each."""
        number = jax.tree.leaves(previous_states)[0].shape[0]
        shape = (number, self.noise_dimension(previous_states))
        noise = normal(key, shape, noise_dtype(previous_states))
        return self.propose_from_noise(noise, now, previous_states)


class _GaussianProposal(ProposalOfNoise):
    """A proposal whose draw is made of as many normal numbers as the state has."""

    @abc.abstractmethod
    def _law(self, now: Step, previous_states: States) -> _Gaussian:
        """q of every particle."""

    def noise_dimension(self, previous_states: States) -> int:
        """d."""
        return math.prod(previous_states.shape[1:])

    def propose_from_noise(
        self, noise: Float[Array, "n d"], now: Step, previous_states: States
    ) -> tuple[States, Float[Array, " n"]]:
        """x_t from this noise, and log q of each."""
        law = self._law(now, previous_states)
        states = (law.means + law.forth(noise)).reshape(previous_states.shape)
        return states, law.log_density(noise)

    def log_density(self, now: Step, states: States, previous_states: States) -> Float[Array, " n"]:
        """log q(x_t | x_{t-1}, y_t) of every particle."""
        law = self._law(now, previous_states)
        return law.log_density(law.back(states.reshape(law.means.shape) - law.means))


# Width and depth of the network that `create` makes: enough to turn y_t into a shift.
_HIDDEN = 16, 2


class NetworkProposal(_GaussianProposal):
    """A Gaussian whose mean and standard deviations are computed by a network from x_{t-1} and y_t.

    q = N(x_{t-1} + s a, diag(s exp b)²), (a, b) = network(x_{t-1}, y_t), for each particle. The
    network is trained by the bound E[log Ẑ] <= log Z: the better q fits, the higher is E[log Ẑ].
    `tuning.fit` maximises it over the network's arrays (Maddison et al. 2017, FIVO). Use
    `gradient="none"`: as in that paper, it differentiates the draws and not the resampling. The
    filter is exact for any network.

    - `network`: a function of one vector, the flattened state followed by the flattened
      observation. It returns a vector of twice the state's size: a, then b. `create` makes such an
      `eqx.nn.MLP`.
    - `scale`: s, (d,) or a scalar, positive, in units of the state: about the length of a step.

    Raises `ValueError` for a scale that is not positive. Use it if the likelihood is narrow,
    `GaussNewtonProposal` is not applicable, and the same model runs often enough to repay the
    training.
    """

    network: Callable[[Float[Array, " k"]], Float[Array, " two_d"]]
    scale: Annotated[Float[Array, "*d"], POSITIVE] = eqx.field(converter=to_array("scale"))

    @classmethod
    @checked
    def create(
        cls,
        key: Key[Array, ""],
        state_size: Count,
        observation_size: Count,
        scale: float | Float[Array, " d"],
    ) -> "NetworkProposal":
        """An untrained proposal: a small network that draws approximately N(x_{t-1}, scale²)."""
        sizes = (state_size + observation_size, 2 * state_size)
        network = eqx.nn.MLP(*sizes, *_HIDDEN, jax.nn.tanh, key=key)
        last = jax.tree.map(lambda leaf: 0.1 * leaf, network.layers[-1])
        return cls(eqx.tree_at(lambda net: net.layers[-1], network, last), scale)

    def _law(self, now: Step, previous_states: States) -> _Gaussian:
        previous = previous_states.reshape(previous_states.shape[0], -1)
        observation = ravel_pytree(now.observation)[0].astype(previous.dtype)
        rows = jnp.broadcast_to(observation, (previous.shape[0], observation.shape[0]))
        outputs = jax.vmap(self.network)(jnp.concatenate([previous, rows], axis=1))
        shifts, log_widths = jnp.split(outputs, 2, axis=1)
        scale = jnp.broadcast_to(self.scale.astype(previous.dtype), previous.shape)
        deviations = scale * jnp.exp(log_widths)
        return _Gaussian(
            means=previous + scale * shifts,
            log_volumes=jnp.sum(jnp.log(deviations), axis=1),
            forth=lambda noise: deviations * noise,
            back=lambda gaps: gaps / deviations,
        )


class GaussNewtonProposal(_GaussianProposal):
    """A Gaussian fitted by Gauss-Newton to L(y_t | x_t) D(x_t | x_{t-1}), for each particle.

    For models with additive Gaussian noise, x_t = f(x_{t-1}) + N(0, Q), y_t = h(x_t) + N(0, R).
    Each iteration linearises h at the current point, with its Jacobian H by JAX, and solves for the
    mean of the resulting Gaussian, whose precision is Λ = Q⁻¹ + Hᵀ R⁻¹ H (Doucet, Godsill and
    Andrieu 2000, section II.D, local linearisation). The draw is from N(mean, inflation² Λ⁻¹). An
    inflation above one keeps the weights bounded if the Gaussian is narrower than the target,
    without loss of exactness, because the weights correct for it.

    The model must define `transition_mean`, `observation_mean`, `transition_covariance`, (d, d),
    and `observation_covariance`, (p, p). States are one array, (n,) or (n, d); Q is invertible.

    Raises `ValueError` for no iterations, or an inflation that is not positive, and in a filter of
    a model without these means. Use it if most bootstrap particles miss the likelihood.
    """

    num_iterations: Count = eqx.field(static=True, default=4)
    inflation: Positive = eqx.field(static=True, default=1.1)

    def check(self, now: Step) -> None:
        """Raise a `ValueError` for a model without the means."""
        for mean in ("transition_mean", "observation_mean"):
            require(now.model, mean, "GaussNewtonProposal")

    def _law(self, now: Step, previous_states: States) -> _Gaussian:
        means, factors = self._fit(now, previous_states)
        log_scale = means.shape[1] * math.log(self.inflation)
        return _Gaussian(
            means,
            log_volumes=log_scale - _log_diagonal(factors),
            forth=lambda noise: self.inflation * _solve_transposed(factors, noise),
            back=lambda gaps: jnp.einsum("nij,ni->nj", factors, gaps) / self.inflation,
        )

    def log_normaliser(self, now: Step, previous_states: States) -> Float[Array, " n"]:
        """log p(y_t | x_{t-1}) of every particle by the fitted Gaussian, shape (n,).

        Laplace's approximation of log ∫ L D dx_t: log L + log D at the mean, and the volume
        (2π)^(d/2) |Λ|^(-1/2) around it. It is exact if h is linear, as in a `LinearGaussianModel`.
        It does not depend on the inflation. Use it as the look-ahead of `AuxiliaryResample`.
        """
        means, factors = self._fit(now, previous_states)
        states = means.reshape(previous_states.shape)
        log_densities = now.law.log_likelihood(now.observation, states)
        log_densities += now.law.log_transition(states, previous_states)
        return log_densities + 0.5 * means.shape[1] * math.log(2 * math.pi) - _log_diagonal(factors)

    def _fit(
        self, now: Step, previous_states: States
    ) -> tuple[Float[Array, "n d"], Float[Array, "n d d"]]:
        """The means of q, and the Cholesky factors of the precisions Λ."""
        model = now.model
        prior, state_shape = model.transition_mean(previous_states), previous_states.shape[1:]
        prior = prior.reshape(len(prior), -1)
        target = jnp.atleast_1d(now.observation).astype(prior.dtype)
        prior_precision = _inverse(jnp.atleast_2d(model.transition_covariance)).astype(prior.dtype)
        precision_y = _inverse(jnp.atleast_2d(model.observation_covariance)).astype(prior.dtype)

        def observe(state: Float[Array, " d"]) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
            value = model.observation_mean(state.reshape(1, *state_shape)).reshape(-1)
            return value, value

        linearise = jax.vmap(jax.jacfwd(observe, has_aux=True))
        means = prior
        for _ in range(self.num_iterations):
            jacobians, values = linearise(means)
            gains = jnp.einsum("npd,pq->ndq", jacobians, precision_y)
            precisions = prior_precision[None] + jnp.einsum("ndq,nqe->nde", gains, jacobians)
            residuals = target[None] - values + jnp.einsum("npd,nd->np", jacobians, means)
            information = prior @ prior_precision + jnp.einsum("ndq,nq->nd", gains, residuals)
            factors = cholesky(precisions)
            means = _solve_transposed(factors, solve_lower(factors, information))
        return means, factors


def _log_diagonal(factors: Float[Array, "n d d"]) -> Float[Array, " n"]:
    """log |F|."""
    return jnp.sum(jnp.log(jnp.diagonal(factors, axis1=1, axis2=2)), axis=1)


def _solve_transposed(
    factors: Float[Array, "n d d"], vectors: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """F⁻ᵀ v, by backward substitution: mirrored, the upper triangle is a lower one."""
    mirrored = jnp.swapaxes(factors, 1, 2)[:, ::-1, ::-1]
    return solve_lower(mirrored, vectors[:, ::-1])[:, ::-1]


def _inverse(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    return 1 / covariance if covariance.shape == (1, 1) else jnp.linalg.inv(covariance)
