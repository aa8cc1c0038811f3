"""The linear-Gaussian model, whose filtering distribution the Kalman filter gives exactly."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import check_finite_array, check_shape, to_array
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.operations.matrices import cholesky, row_sums, solve_lower
from mpfjax.operations.random import normal

_IN_TIME = ("A", "Q", "H", "R", "B", "inputs")


def _if_given(name: str) -> Callable[[Any], Array | None]:
    """A converter of an argument that may be None."""
    return lambda value: None if value is None else to_array(name)(value)


class LinearGaussianModel(AbstractStateSpaceModel):
    """x_t = A x_{t-1} + B u_t + N(0, Q), y_t = H x_t + N(0, R), x_0 ~ N(m0, P0).

    - `A`, `Q`: (d, d); `H`: (p, d); `R`: (p, p); `m0`: (d,); `P0`: (d, d). R is positive definite;
      P0 and Q may be singular, but x_0 or x_t then has no density. States have shape (n, d),
      observations (p,).
    - `B`: (d, k), the control matrix, for inputs u_t, (k,). None leaves B u_t out.

    Inputs are u_t alone, or a dict of the fields that change in time by their names, such as
    {"A": ..., "Q": ..., "inputs": ...}: each is that field at step t. So the matrices of a
    continuous-time system at irregular times are inputs too.

    Raises `ValueError` for shapes that do not fit together. Use it to compare a filter
    with the Kalman filter, or where the system is linear.
    """

    A: Float[Array, "d d"] = eqx.field(converter=to_array("A"))
    Q: Float[Array, "d d"] = eqx.field(converter=to_array("Q"))
    H: Float[Array, "p d"] = eqx.field(converter=to_array("H"))
    R: Float[Array, "p p"] = eqx.field(converter=to_array("R"))
    m0: Float[Array, " d"] = eqx.field(converter=to_array("m0"))
    P0: Float[Array, "d d"] = eqx.field(converter=to_array("P0"))
    B: Float[Array, "d k"] | None = eqx.field(converter=_if_given("B"), default=None)
    inputs: Float[Array, " k"] | None = eqx.field(converter=_if_given("inputs"), default=None)

    def __check_init__(self) -> None:
        d = self.m0.shape[-1] if self.m0.ndim == 1 else None
        p = self.H.shape[0] if self.H.ndim == 2 else None
        expected = {
            "m0": (d,), "A": (d, d), "Q": (d, d), "P0": (d, d), "H": (p, d), "R": (p, p)
        }  # fmt: skip
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(
                    f"{name}: shape {getattr(self, name).shape} is not {shape}, for m0 of shape"
                    f" {self.m0.shape} and H of shape {self.H.shape}"
                )
            check_finite_array(**{name: getattr(self, name)})
        if self.B is not None:
            if self.B.ndim != 2 or self.B.shape[0] != d:
                raise ValueError(f"B: shape {self.B.shape} is not ({d}, k), for m0 of shape ({d},)")
            check_finite_array(B=self.B)

        if self.inputs is not None:
            shape = None if self.B is None else self.B.shape[1:]
            if self.inputs.shape != shape:
                raise ValueError(
                    f"inputs: shape {self.inputs.shape} of u_t, where B is"
                    f" {None if self.B is None else f'of shape {self.B.shape}'}"
                )

    def with_inputs(self, inputs: PyTree) -> "LinearGaussianModel":
        """The model at step t: u_t, (k,), or a dict of the fields that change in time."""
        fields = inputs if isinstance(inputs, dict) else {"inputs": inputs}
        unknown = sorted(set(fields) - set(_IN_TIME))
        if unknown:
            raise ValueError(f"inputs: {unknown} are not among {list(_IN_TIME)}")
        return dataclasses.replace(self, **fields)

    @property
    def control(self) -> Float[Array, " d"] | None:
        """B u_t; None where there is no B, or no u_t."""
        return None if self.B is None or self.inputs is None else self.B @ self.inputs

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n d"]:
        """x_0 ~ N(m0, P0)."""
        return self.initial_from_noise(
            normal(key, (num_particles, self.initial_noise_dimension), self.m0.dtype)
        )

    @property
    def initial_noise_dimension(self) -> int:
        """d."""
        return self.m0.shape[0]

    def initial_from_noise(self, noise: Float[Array, "n d"]) -> Float[Array, "n d"]:
        """x_0 ~ N(m0, P0)."""
        return self.m0[None] + noise @ _root(self.P0).T

    @property
    def noise_dimension(self) -> int:
        """d."""
        return self.m0.shape[0]

    def transition_from_noise(
        self, noise: Float[Array, "n d"], states: Float[Array, "n d"]
    ) -> Float[Array, "n d"]:
        """x_t ~ N(A x_{t-1} + B u_t, Q)."""
        check_shape(f"n {self.noise_dimension}", noise=noise)
        return self.transition_mean(states) + noise @ _root(self.Q).T

    def log_likelihood(
        self, observation: Float[Array, " p"], states: Float[Array, "n d"]
    ) -> Float[Array, " n"]:
        """log N(y_t; H x_t, R)."""
        if jnp.shape(observation) != (self.H.shape[0],):
            raise ValueError(
                f"observation: shape {jnp.shape(observation)} is not ({self.H.shape[0]},),"
                " the rows of H"
            )
        return _log_normal(observation[None] - self.observation_mean(states), self.R)

    def sample_observation(
        self, key: Key[Array, ""], states: Float[Array, "n d"]
    ) -> Float[Array, "n p"]:
        """y_t ~ N(H x_t, R) of every state."""
        noise = normal(key, (len(states), self.R.shape[0]), self.R.dtype)
        return self.observation_mean(states) + noise @ _root(self.R).T

    def log_transition(
        self, states: Float[Array, "n d"], previous_states: Float[Array, "n d"]
    ) -> Float[Array, " n"]:
        """log N(x_t; A x_{t-1} + B u_t, Q)."""
        return _log_normal(states - self.transition_mean(previous_states), self.Q)

    def log_initial(self, states: Float[Array, "n d"]) -> Float[Array, " n"]:
        """log N(x_0; m0, P0)."""
        return _log_normal(states - self.m0[None], self.P0)

    def transition_mean(self, states: Float[Array, "n d"]) -> Float[Array, "n d"]:
        """A x_{t-1} + B u_t."""
        mean = states @ self.A.T
        return mean if self.control is None else mean + self.control[None]

    def observation_mean(self, states: Float[Array, "n d"]) -> Float[Array, "n p"]:
        """H x_t."""
        return states @ self.H.T

    @property
    def transition_covariance(self) -> Float[Array, "d d"]:
        """Q."""
        return self.Q

    @property
    def observation_covariance(self) -> Float[Array, "p p"]:
        """R."""
        return self.R


def _root(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """A lower triangular L with L Lᵀ = covariance, which may be singular."""
    is_definite = jnp.all(jnp.isfinite(jnp.linalg.cholesky(jax.lax.stop_gradient(covariance))))
    semidefinite = lambda matrix: cholesky(matrix[None])[0]  # noqa: E731
    return jax.lax.cond(is_definite, jnp.linalg.cholesky, semidefinite, covariance)


def _log_normal(
    residuals: Float[Array, "n d"], covariance: Float[Array, "d d"]
) -> Float[Array, " n"]:
    factor = jnp.linalg.cholesky(covariance)
    # The columns of the factor's inverse: one small solve, whatever the number of particles.
    whitening = solve_lower(factor[None], jnp.eye(len(factor), dtype=factor.dtype))
    log_scale = jnp.sum(jnp.log(jnp.diagonal(factor)))
    return (
        -0.5 * row_sums((residuals @ whitening) ** 2)
        - log_scale
        - 0.5 * covariance.shape[0] * jnp.log(2 * jnp.pi)
    )
