"""Estimates with standard errors from a batch of independent runs, for any kind of noise."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mpfjax.checks import check_callable, shown
from mpfjax.mixture import ParticleMixture
from mpfjax.operations.logarithms import log_sum_exp
from mpfjax.running.scan import FilterRun

# Standard errors from fewer runs are not reliable.
FEWEST_RUNS = 4


class BatchEstimate(NamedTuple):
    """Estimates from a batch of runs, with their standard errors."""

    value: Float[Array, " *shape"]
    error: Float[Array, " *shape"]
    """the standard error of `value`."""
    log_marginal_likelihood: Float[Array, ""]
    """log of the mean of Ẑ."""
    log_marginal_likelihood_error: Float[Array, ""]
    effective_runs: Float[Array, ""]
    """(Σ Ẑ)² / Σ Ẑ²: below about a third of the runs, errors are too small themselves."""


def batch_estimate(
    runs: FilterRun, quantity: Callable[[ParticleMixture], Float[Array, " *shape"]]
) -> BatchEstimate:
    """An expectation and log Z from B independent runs, each with its standard error.

    The runs are treated as one particle filter of B islands that do not interact: run b has the
    weight Ẑ_b, so that

        q = Σ_b Ẑ_b q_b / Σ_b Ẑ_b,   Ẑ = Σ_b Ẑ_b / B,

    and Ẑ is unbiased (Vergé et al. 2015). The errors are those of the jackknife over runs (Efron
    1982), (B - 1) / B Σ_b (q_(b) - mean of q_(.))², with q_(b) the estimate without run b. They
    need only independent runs, and hold for every scheme, noise and move. (`with_first_ancestors`
    needs multinomial draws.)

    - `runs`: what `monte_carlo` returned for B keys, four or more. Twelve to thirty of N / B
      particles each are a good choice. Take enough particles that log Ẑ of a single run has a
      standard deviation of about one or less. Otherwise a few runs have most of the weight; see
      `effective_runs`.
    - `quantity`: a function of one mixture, such as `lambda m: m.average(m.particles > 0)`. For a
      mass take the probability of a place or an event, since the labels of components differ
      between runs.

    Runs of zero likelihood have no weight. Raises `ValueError` for fewer runs, and for anything but
    a stack of runs. Use it to see whether a mass can be trusted.
    """
    check_callable("a function of a mixture", quantity=quantity)
    if not isinstance(runs, FilterRun) or runs.log_marginal_likelihood.ndim != 1:
        raise ValueError(f"runs: {_what(runs)} is not what monte_carlo returns for several keys")
    number = len(runs.log_marginal_likelihood)
    if number < FEWEST_RUNS:
        raise ValueError(f"runs: {number}; a standard error asks for {FEWEST_RUNS} at least")
    logs = runs.log_marginal_likelihood
    values = jax.vmap(quantity)(runs.final)
    # Each run is left out in turn; a difference of sums would be lost to rounding.
    stays = jnp.concatenate([jnp.ones((1, number), bool), ~jnp.eye(number, dtype=bool)])
    log_z, estimates = jax.vmap(lambda kept: _combined(jnp.where(kept, logs, -jnp.inf), values))(
        stays
    )
    log_z -= jnp.log(jnp.sum(stays, axis=1).astype(log_z.dtype))
    shares = jax.nn.softmax(logs)
    return BatchEstimate(
        value=estimates[0],
        error=_jackknife(estimates[1:]),
        log_marginal_likelihood=log_z[0],
        log_marginal_likelihood_error=_jackknife(log_z[1:]),
        effective_runs=1 / jnp.sum(shares**2),
    )


def _combined(
    logs: Float[Array, " b"], values: Float[Array, "b *shape"]
) -> tuple[Float[Array, ""], Float[Array, " *shape"]]:
    shares = jax.nn.softmax(logs).astype(values.dtype)
    return log_sum_exp(logs), jnp.tensordot(shares, values, axes=1)


def _jackknife(without: Float[Array, "b *shape"]) -> Float[Array, " *shape"]:
    number = without.shape[0]
    centred = without - jnp.mean(without, axis=0, keepdims=True)
    return jnp.sqrt((number - 1) / number * jnp.sum(centred**2, axis=0))


def _what(runs: Any) -> str:
    return "one run" if isinstance(runs, FilterRun) else shown(runs)
