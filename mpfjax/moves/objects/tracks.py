"""Summaries of a filter of an unknown number of objects: tracks, and the number of objects."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from mpfjax.checks import shown, warn
from mpfjax.mixture import ParticleMixture, flatten_states
from mpfjax.moves.objects.bernoulli import TARGETS

# A track is told where its object is more probable than not.
_LEAST_EXISTENCE = 0.5


class TargetEstimates(NamedTuple):
    """The objects of one step, with an entry for each component that may represent one.

    - `labels`: of each object, from 1 on, 0 if there is none.
    - `existence`: the existence probability, zero if there is no object.
    - `means`, `covariances`: of its state; in the form of the state, NaN if there is none, and (M,
      d, d) for the flattened state.
    - `number`: the median of the number of objects, which minimises the mean absolute error.
    - `expected_number`: of all objects, of which `undetected` have not been revealed yet.
    - `crowded_out`: the expected number of objects for which there was no component in this step.
    """

    labels: Int[Array, " m"]
    existence: Float[Array, " m"]
    means: PyTree
    covariances: Float[Array, "m d d"]
    number: Int[Array, ""]
    expected_number: Float[Array, ""]
    undetected: Float[Array, ""]
    crowded_out: Float[Array, ""]


def estimate_targets(mixture: ParticleMixture) -> TargetEstimates:
    """The objects of a `bernoulli_filter`, for `collect=estimate_targets` or one mixture.

    Raises `ValueError` for a mixture of another filter. Use it with `number_distribution`, and with
    `track_table` for a table of a whole run.
    """
    if TARGETS not in mixture.memory:
        raise ValueError("mixture: it is not from a bernoulli_filter")
    memory = mixture.memory[TARGETS]
    existence = memory["number"] * mixture.mixture_weights
    of_each = jnp.minimum(existence[1:], 1.0)
    return TargetEstimates(
        labels=memory["labels"][1:],
        existence=of_each,
        means=jax.tree.map(lambda leaf: leaf[1:], mixture.component_means()),
        covariances=mixture.component_covariances()[1:],
        number=jnp.sum(jnp.cumsum(number_distribution(of_each)) < 0.5),
        expected_number=memory["number"],
        undetected=existence[0],
        crowded_out=memory["crowded_out"],
    )


def number_distribution(existence: Float[Array, " m"]) -> Float[Array, " n"]:
    """P(0), ..., P(M) objects, each of which exists with its own probability.

    The distribution of a sum of independent events, Poisson-binomial. Undetected objects are a
    Poisson number in addition, with mean `undetected`.
    """

    def with_one_more(shares: Float[Array, " n"], r: Float[Array, ""]) -> tuple:
        return (1 - r) * shares + r * jnp.roll(shares, 1).at[0].set(0.0), None

    none = jnp.zeros(existence.shape[0] + 1, existence.dtype).at[0].set(1.0)
    return jax.lax.scan(with_one_more, none, existence)[0]


def track_table(run: Any) -> dict[str, np.ndarray]:
    """The tracks of a run as columns: `pandas.DataFrame(track_table(run))`.

    - `run`: the `FilterRun` of a `bernoulli_filter` that collected its mixtures or
      `estimate_targets`, or what it collected, with a leading axis of steps.

    A track has a row for each step in which its object exists with a probability of at least one
    half. The columns are `step`, from 1 on, `label`, `existence`, and `mean_k` and `deviation_k` of
    each component of the state. Warns if objects were crowded out, with the first such step. Raises
    `ValueError` for a run that collected anything else.
    """
    run = getattr(run, "collected", run)
    run = jax.vmap(estimate_targets)(run) if isinstance(run, ParticleMixture) else run
    if not isinstance(run, TargetEstimates):
        raise ValueError(f"run: it collected {shown(run)}; use collect=mpfjax.estimate_targets")
    lost = np.asarray(run.crowded_out)
    if len(steps := np.flatnonzero(lost >= _LEAST_EXISTENCE)):
        at = f"at step {steps[0] + 1} for {lost[steps[0]]:.1f} objects"
        warn(f"max_targets: there was no room {at}; they are not distinguished")
    existence, labels = np.asarray(run.existence), np.asarray(run.labels)
    steps, places = np.nonzero((existence >= _LEAST_EXISTENCE) & (labels > 0))
    flat = jax.vmap(flatten_states)(run.means)
    means = np.asarray(flat)[steps, places]
    variances = np.diagonal(np.asarray(run.covariances), axis1=2, axis2=3)[steps, places]
    columns: dict[str, np.ndarray] = {"step": steps + 1, "label": labels[steps, places]}
    columns["existence"] = existence[steps, places]
    for k in range(means.shape[1]):
        columns |= {f"mean_{k}": means[:, k], f"deviation_{k}": np.sqrt(variances[:, k])}
    return columns
