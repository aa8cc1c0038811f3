"""The mixtures of a run, from x_0 to x_t, in the form that all smoothers take."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from mpfjax.checks import shown
from mpfjax.mixture import ParticleMixture
from mpfjax.running.scan import FilterRun

_NEEDED = "a FilterRun of run_filter(..., collect=None), or the mixtures that it collected"


def mixtures_of(run: Any) -> ParticleMixture:
    """The stacked mixtures of a run; with those of a whole `FilterRun` x_0 comes first.

    Raises `ValueError` for anything but a stack of mixtures, and for a stack of several runs.
    """
    initial, mixtures = None, run
    if isinstance(run, FilterRun):
        initial, mixtures = run.initial, run.collected
    if not isinstance(mixtures, ParticleMixture):
        raise ValueError(f"mixtures: {shown(mixtures)} is not {_NEEDED}")
    if mixtures.log_weights.ndim != 2:
        raise ValueError(
            f"mixtures: weights of shape {mixtures.log_weights.shape} are not those of one run, "
            "(t, n); jax.vmap over the leading axis of several runs"
        )
    # Smoothing does not use the moves' memory, whose leaves may not stack.
    mixtures = jax.vmap(lambda mixture: mixture.replace(memory={}))(mixtures)
    if initial is None:
        return mixtures
    initial = initial.replace(memory={})
    return jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None].astype(rest.dtype), rest]),
        initial,
        mixtures,
    )


def with_parents(mixtures: ParticleMixture, needed_by: str) -> ParticleMixture:
    """The mixtures; an error where a particle comes from no single one of the step before."""
    is_orphan = (mixtures.ancestor_indices < 0) & (mixtures.log_weights > -jnp.inf)
    found = jnp.any(is_orphan[1:])
    message = (
        f"mixtures: {needed_by} follows ancestors, and some particles have none, or more than one"
        " (index -1), as after PropagateIndependently; sample_trajectories with method 'exact' does"
        " without"
    )
    if isinstance(found, Tracer):
        return eqx.error_if(mixtures, found, message)
    if found:
        raise ValueError(message)
    return mixtures
