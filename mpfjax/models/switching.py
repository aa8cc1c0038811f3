"""The switching linear-Gaussian model: K linear systems, and a Markov chain that chooses one."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Key

from mpfjax.checks import (
    check_covariance_array,
    check_finite_array,
    check_not_negative_array,
    check_shape,
    shown,
    to_array,
)
from mpfjax.models.conditionally_linear import AbstractConditionallyLinearModel
from mpfjax.operations.logarithms import log_or_nothing
from mpfjax.operations.random import uniform
from mpfjax.operations.segments import spread

# Sums of probabilities may differ from one by this much, for rounding.
_ROUNDING = 1e-4


def _optional(name: str) -> Any:
    convert = to_array(name)
    return lambda value: None if value is None else convert(value)


class SwitchingLinearGaussianModel(AbstractConditionallyLinearModel):
    """A Markov chain of K regimes z_t, and a linear-Gaussian system for each of them.

        P(z_t = j | z_{t-1} = i) = Π_ij,    x_0 ~ N(m0, P0),
        x_t = F[z_t] x_{t-1} + b[z_t] + N(0, Q[z_t]),    y_t = H[z_t] x_t + c[z_t] + N(0, R[z_t])

    A jump Markov linear system, or switching state-space model. The latent is the regime, whole
    numbers (n,). `exact.switching_filter` is exact for a short series.

    - `transition_matrix`: Π, (K, K), each row sums to one.
    - `F`, `Q`: (d, d), or (K, d, d) with one for each regime; `H`: (p, d) or (K, p, d); `R`: (p, p)
      or (K, p, p). Q and R are positive semidefinite.
    - `m0`: (d,) or (K, d), and `P0`: (d, d) or (K, d, d), by z_0.
    - `b`, `c`: (d,) or (K, d), and (p,) or (K, p); None is zero.
    - `initial_probabilities`: of z_0, (K,); None makes all equal.

    Raises `ValueError` for shapes that do not fit together, for rows that are no probabilities, and
    for Q, R or P0 that is no covariance.
    Use it for manoeuvring targets, and for regimes of a time series.
    """

    transition_matrix: Float[Array, "k k"] = eqx.field(converter=to_array("transition_matrix"))
    F: Float[Array, "*k d d"] = eqx.field(converter=to_array("F"))
    Q: Float[Array, "*k d d"] = eqx.field(converter=to_array("Q"))
    H: Float[Array, "*k p d"] = eqx.field(converter=to_array("H"))
    R: Float[Array, "*k p p"] = eqx.field(converter=to_array("R"))
    m0: Float[Array, "*k d"] = eqx.field(converter=to_array("m0"))
    P0: Float[Array, "*k d d"] = eqx.field(converter=to_array("P0"))
    b: Float[Array, "*k d"] | None = eqx.field(converter=_optional("b"), default=None)
    c: Float[Array, "*k p"] | None = eqx.field(converter=_optional("c"), default=None)
    initial_probabilities: Float[Array, " k"] | None = eqx.field(
        converter=_optional("initial_probabilities"), default=None
    )

    def __check_init__(self) -> None:
        k = self.transition_matrix.shape[-1] if self.transition_matrix.ndim == 2 else 0
        d = self.m0.shape[-1] if self.m0.ndim else 0
        p = self.H.shape[-2] if self.H.ndim > 1 else 0
        check_shape(f"{k} {k}", transition_matrix=self.transition_matrix)
        shapes = {
            "F": (d, d), "Q": (d, d), "H": (p, d), "R": (p, p), "m0": (d,), "P0": (d, d),
            "b": (d,), "c": (p,),
        }  # fmt: skip
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array is None:
                continue
            if array.shape not in (shape, (k, *shape)):
                raise ValueError(
                    f"{name}: shape {array.shape} is neither {shape} nor {(k, *shape)}, for"
                    f" {k} regimes, m0 of shape {self.m0.shape} and H of shape {self.H.shape}"
                )
            check = check_covariance_array if name in ("Q", "R", "P0") else check_finite_array
            check(**{name: array})
        _check_probabilities(transition_matrix=self.transition_matrix)
        if self.initial_probabilities is not None:
            check_shape(f"{k}", initial_probabilities=self.initial_probabilities)
            _check_probabilities(initial_probabilities=self.initial_probabilities)

    @property
    def num_regimes(self) -> int:
        """K."""
        return self.transition_matrix.shape[0]

    @property
    def probabilities_at_start(self) -> Float[Array, " k"]:
        """P(z_0)."""
        if self.initial_probabilities is not None:
            return self.initial_probabilities
        k = self.num_regimes
        return jnp.full(k, 1 / k, self.transition_matrix.dtype)

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Int[Array, " n"]:
        """z_0 by its probabilities."""
        shares = uniform(key, (num_particles,), self.transition_matrix.dtype)
        return self._initial(shares)

    @property
    def initial_noise_dimension(self) -> int:
        """1."""
        return 1

    def initial_from_noise(self, noise: Float[Array, "n 1"]) -> Int[Array, " n"]:
        """z_0 of standard normal numbers."""
        return self._initial(jax.scipy.special.ndtr(noise[:, 0]))

    def initial_moments(
        self, latent: Int[Array, " n"]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """m0 and P0."""
        return self._of(latent, self.m0, 1), self._of(latent, self.P0, 2)

    def sample_transition(self, key: Key[Array, ""], latent: Int[Array, " n"]) -> Int[Array, " n"]:
        """z_t by the row of z_{t-1}."""
        shares = uniform(key, latent.shape, self.transition_matrix.dtype)
        return self._next(shares, latent)

    @property
    def noise_dimension(self) -> int:
        """1."""
        return 1

    def transition_from_noise(
        self, noise: Float[Array, "n 1"], latent: Int[Array, " n"]
    ) -> Int[Array, " n"]:
        """z_t of standard normal numbers."""
        check_shape("n 1", noise=noise)
        return self._next(jax.scipy.special.ndtr(noise[:, 0]), latent)

    def log_transition(
        self, latent: Int[Array, " n"], previous_latent: Int[Array, " n"]
    ) -> Float[Array, " n"]:
        """log Π of the two regimes."""
        k = self.num_regimes
        return spread(log_or_nothing(self.transition_matrix).ravel(), previous_latent * k + latent)

    def log_initial(self, latent: Int[Array, " n"]) -> Float[Array, " n"]:
        """log P(z_0)."""
        return spread(log_or_nothing(self.probabilities_at_start), latent)

    def all_transitions(
        self, latent: Int[Array, " n"]
    ) -> list[tuple[Int[Array, " n"], Float[Array, " n"]]]:
        """Every regime, with log of its probability after z_{t-1}."""
        log_matrix = log_or_nothing(self.transition_matrix)
        return [
            (jnp.full_like(latent, j), spread(log_matrix[:, j], latent))
            for j in range(self.num_regimes)
        ]

    def dynamics(
        self, latent: Int[Array, " n"], previous_latent: Int[Array, " n"]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
        """F, b and Q of the regime z_t."""
        del previous_latent
        b = jnp.zeros(self.m0.shape[-1], self.m0.dtype) if self.b is None else self.b
        return self._of(latent, self.F, 2), self._of(latent, b, 1), self._of(latent, self.Q, 2)

    def emission(
        self, latent: Int[Array, " n"]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
        """H, c and R of the regime z_t."""
        c = jnp.zeros(self.H.shape[-2], self.H.dtype) if self.c is None else self.c
        return self._of(latent, self.H, 2), self._of(latent, c, 1), self._of(latent, self.R, 2)

    def _of(self, latent: Int[Array, " n"], values: Array, rank: int) -> Float[Array, "..."]:
        """The parameter of each particle's regime; one that all regimes share, unchanged."""
        return values if values.ndim == rank else spread(values, latent)

    def _initial(self, shares: Float[Array, " n"]) -> Int[Array, " n"]:
        bounds = jnp.cumsum(self.probabilities_at_start)[:-1]
        return jnp.sum(shares[:, None] >= bounds[None], axis=1, dtype=jnp.int32)

    def _next(self, shares: Float[Array, " n"], latent: Int[Array, " n"]) -> Int[Array, " n"]:
        """The regime whose interval of the row's cumulative probabilities holds each number."""
        bounds = jnp.cumsum(self.transition_matrix, axis=1)
        drawn = jnp.zeros_like(latent)
        for j in range(self.num_regimes - 1):
            drawn = drawn + (shares >= spread(bounds[:, j], latent)).astype(latent.dtype)
        return drawn


def _check_probabilities(**arguments: Array) -> None:
    """Each argument has numbers from 0 on that sum to one along the last axis."""
    for name, array in arguments.items():
        check_not_negative_array(**{name: array})
        if isinstance(array, Tracer | jax.ShapeDtypeStruct):
            continue
        if np.abs(np.sum(np.asarray(array, float), axis=-1) - 1).max() > _ROUNDING:
            raise ValueError(f"{name}: {shown(array)} has rows that do not sum to one")
