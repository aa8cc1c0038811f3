"""States and observations over the posterior of the parameters: of the past, and to come."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, checked
from mpfjax.models.base import require, with_inputs
from mpfjax.models.law import law_of, refuse_marginalised
from mpfjax.models.series import Series, steps_ahead, steps_of_inputs
from mpfjax.moves.base import check_keep_parents
from mpfjax.operations.compiling import jit_on_wide_vectors
from mpfjax.smoothing.backward import draw
from mpfjax.smoothing.conditional import shape_of_trajectory
from mpfjax.smoothing.trajectories import draw_trajectory
from mpfjax.tuning.evidence import LogEvidence
from mpfjax.tuning.mcmc import GibbsPosterior, Posterior
from mpfjax.tuning.sequential import SequentialPosterior

Chains = Posterior | GibbsPosterior | SequentialPosterior

_TOGETHER = 64  # of the draws that share a program's step
_MOST_BYTES = 2**27  # of the mixtures of runs that are held at once
_METHOD = "posterior_trajectories"


class PosteriorTrajectories(NamedTuple):
    """Draws of parameters and states given y_1..y_t, all of equal weight."""

    parameters: dict[str, np.ndarray]
    """by name, on their own scale: shape (chains, draws, ...)."""
    states: PyTree
    """x_0, ..., x_t, leaves (chains, draws, t + 1, ...)."""
    observations: PyTree
    """what could have been observed as well, given these states: leaves (chains, draws, t, ...).
    None of a model without `sample_observation`."""
    observed: Series
    """y_1, ..., y_t, as the sampler was given them."""


class Predictive(NamedTuple):
    """Draws of future states and observations, all of equal weight."""

    states: PyTree
    """x_{t+1}, ..., x_{t+k}, leaves (chains, draws, k, ...)."""
    observations: PyTree
    """y_{t+1}, ..., y_{t+k}, leaves (chains, draws, k, ...)."""


@checked
def posterior_trajectories(
    key: Key[Array, ""], posterior: Chains, num_trajectories: Count | None = None
) -> PosteriorTrajectories:
    """Draw x_0, ..., x_t and new observations given y_1..y_t, with the parameters integrated out.

    For each draw of θ there is one trajectory from p(x_0, ..., x_t | y_1..y_t, θ), and for each
    state x_s one observation from p(y_s | x_s, θ): quantiles over draws are bands of the past
    states, and of observations that could have been made (a posterior predictive check).

    - for `metropolis_hastings`, the run whose Ẑ was accepted is repeated with its key, once for all
      draws that share it, and yields one trajectory. The pair has the posterior distribution as
      exactly as θ alone, for any N (Andrieu, Doucet and Holenstein 2010, section 2.4.2);
    - for `particle_gibbs`, its trajectories;
    - for `smc2`, a new filter over all observations is run for each sample, with the weight of its
      Ẑ over the Ẑ of the sample (Chopin, Jacob and Papaspiliopoulos 2013, section 3.6): correct as
      the number of samples grows. The draws are one chain, resampled by these weights.

    Trajectories are drawn by backward sampling, or for a model without `log_transition` from the
    genealogy.

    - `num_trajectories`: how many of each chain, evenly spaced; None is one for each draw of θ. A
      few hundred are enough for bands, and each requires a run of the filter.

    Raises `ValueError` for a posterior of several sequences, and a conditionally linear model. Use
    it for the past with its uncertainty; `sample_trajectories` is for known parameters, and
    `posterior_predictive` for the future.
    """
    key_paths, key_observations = jax.random.split(key)
    states = states_of(key_paths, posterior, num_trajectories, whole=True)
    (problem, series, values, paths), replicates = states, None
    if callable(getattr(problem.tree.model, "sample_observation", None)):
        keys = jax.random.split(key_observations, jax.tree.leaves(paths)[0].shape[:2])
        replicates = _in_numpy(_observe(problem, series.inputs, keys, values, paths))
    return PosteriorTrajectories(values, paths, replicates, series)


@checked
def posterior_predictive(
    key: Key[Array, ""],
    posterior: Chains,
    num_steps: Count,
    *,
    num_trajectories: Count | None = None,
    inputs: PyTree = None,
) -> Predictive:
    """Draw the next k states and observations, with parameters and states integrated out.

    For each draw of θ there is one of x_t given θ, then the model's own steps and observations:

        p(y_{t+1}, ..., y_{t+k} | y_1..y_t)
            = ∫ p(θ, x_t | y_1..y_t) p(x_{t+1}, y_{t+1}, ..., x_{t+k}, y_{t+k} | θ, x_t).

    The pair (θ, x_t) has the posterior distribution as exactly as θ alone, for any N:

    - for `metropolis_hastings`, x_t is a particle of the run whose Ẑ was accepted (Andrieu, Doucet
      and Holenstein 2010, section 2.4.2), which is repeated with its key, once for all draws that
      share it;
    - for `particle_gibbs`, the end of the trajectory;
    - for `smc2`, a particle of the sample's own filter. There are as many draws as samples, as one
      chain, resampled by their weights.

    - `num_trajectories`, as for `posterior_trajectories`: a few hundred of each chain are enough
      for bands, and for `metropolis_hastings` each requires a run of the filter.
    - `inputs`: u_{t+1}, ..., u_{t+k}, as for `run_filter`.

    Raises `ValueError` for a model without `sample_observation(key, states)`, and for a posterior
    of several sequences. Use it for forecasts that include all
    uncertainty; `forecast` is for known parameters, and `posterior_trajectories` for the past.
    """
    problem: Any = posterior.problem
    model = problem.tree.model
    require(model, "sample_observation", "posterior_predictive")
    inputs = steps_of_inputs(inputs, num_steps, model, "steps")
    key_ends, key_steps = jax.random.split(key)
    problem, _, values, ends = states_of(key_ends, posterior, num_trajectories, whole=False)
    keys = jax.random.split(key_steps, jax.tree.leaves(ends)[0].shape[:2])
    return Predictive(*_in_numpy(_predict(problem, keys, values, ends, num_steps, inputs)))


def states_of(
    key: Key[Array, ""], posterior: Any, number: int | None, whole: bool
) -> tuple[Any, Series, dict[str, np.ndarray], PyTree]:
    """The problem, its data, parameters, and a trajectory or x_t for each: (chains, draws, ...)."""
    problem, values = posterior.problem, posterior.parameters
    if isinstance(posterior, GibbsPosterior):
        paths = posterior.trajectories
        paths = paths if whole else jax.tree.map(lambda leaf: leaf[:, :, -1], paths)
        return problem, problem.objective.series, *_thin((values, paths), number)
    if isinstance(posterior, SequentialPosterior):
        series, mixtures, log_likelihoods = posterior.filters
        evidence = LogEvidence([jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], series)])
        if not whole:
            values, mixtures = _thin(posterior.resampled((values, mixtures)), number)
            keys = jax.random.split(key, mixtures.log_weights.shape[:2])
            return problem, series, values, _in_numpy(_of_mixtures(keys, mixtures))
        keys = jax.random.split(key, (2, len(log_likelihoods)))
        paths, new = _run_again(problem, evidence, (keys[0], values, keys[1]), whole)
        gains = np.where(np.isfinite(log_likelihoods), new - log_likelihoods, -np.inf)
        log_weights = posterior.log_weights + gains
        log_weights -= np.logaddexp.reduce(log_weights)
        posterior = replace(posterior, log_weights=log_weights)
        return problem, series, *_thin(posterior.resampled((values, paths)), number)
    evidence = problem.objective
    if [group.length for group in evidence.groups] != [1]:
        raise ValueError("posterior: it is given several sequences, each with its own states")
    series = jax.tree.map(lambda leaf: leaf[0], evidence.groups[0])
    values, key_data = _thin((values, posterior.key_data), number)
    # Steps that were rejected have the run of the step before, and its trajectory.
    flat, shape = _in_one_row(key_data), key_data.shape[:2]
    _, first, place = np.unique(flat, axis=0, return_index=True, return_inverse=True)
    rows = _rows_of(jax.tree.map(_in_one_row, values), first)
    keys = jax.random.wrap_key_data(jnp.asarray(flat[first]), impl=jax.random.key_impl(key))
    rows = jax.random.split(key, len(first)), rows, keys
    paths, _ = _run_again(problem, evidence, rows, whole)
    return problem, series, values, _rows_of(paths, place.reshape(shape))


def _in_numpy(tree: PyTree) -> PyTree:
    """The tree in arrays of numpy."""
    return jax.tree.map(np.asarray, tree)


def _rows_of(rows: PyTree, places: np.ndarray) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[places], rows)


def _in_one_row(leaf: Any) -> Any:
    """All chains one after the other."""
    return leaf.reshape(-1, *leaf.shape[2:])


def _thin(rows: PyTree, number: int | None) -> PyTree:
    """So many draws of each chain, evenly spaced, or all where there are no more."""
    length = jax.tree.leaves(rows)[0].shape[1]
    if number is None or number >= length:
        return rows
    places = (np.arange(number) + 1) * length // number - 1
    return jax.tree.map(lambda leaf: leaf[:, places], rows)


def _run_again(
    problem: Any, evidence: LogEvidence, rows: tuple[Any, Any, Any], whole: bool
) -> tuple[PyTree, Float[np.ndarray, " rows"]]:
    """What one state, or trajectory, of each filter's run is, and its log Ẑ.

    Rows are a key, parameters, and the key of the run.
    """
    filter, size = problem.tree, _TOGETHER
    if whole:
        refuse_marginalised(filter.model, _METHOD, "sample_trajectories takes it")
        if not callable(getattr(filter.model, "log_transition", None)):
            check_keep_parents("posterior", filter.moves, f"{_METHOD} without log_transition")
        length = jax.tree.leaves(evidence.groups[0].observations)[0].shape[1] + 1
        path = jax.tree.leaves(shape_of_trajectory(filter.model, length))
        each = sum(leaf.size * leaf.dtype.itemsize for leaf in path) + 16 * length
        size = int(np.clip(_MOST_BYTES // (each * filter.num_particles), 1, _TOGETHER))
    # Whole batches, so that one program does for any number of rows: compiling takes the time.
    number = rows[0].shape[0]
    batches = (np.arange(first, first + size) % number for first in range(0, number, size))
    runs = (_runs_again(problem, evidence, _rows_of(rows, batch), whole) for batch in batches)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:number], *map(_in_numpy, runs))


@jit_on_wide_vectors
def _runs_again(problem, evidence, rows, whole):
    (group,) = evidence.groups
    inputs = jax.tree.map(lambda leaf: leaf[0], group.inputs)

    def one(row: tuple[Array, PyTree, Array]) -> tuple[PyTree, Array]:
        key, values, key_run = row
        filter = problem.having(values)
        (runs,) = evidence.runs(key_run, filter, whole)
        run = jax.tree.map(lambda leaf: leaf[0], runs)
        if not whole:
            return _one_of(key, run.final), run.log_marginal_likelihood
        return draw_trajectory(key, filter.model, run, inputs), run.log_marginal_likelihood

    return jax.vmap(one)(rows)


@partial(jit_on_wide_vectors, soon=True)
def _of_mixtures(keys, mixtures):
    return jax.vmap(jax.vmap(_one_of))(keys, mixtures)


def _one_of(key: Key[Array, ""], mixture: Any) -> PyTree:
    """A particle by its weight."""
    (place,) = draw(key, (1,), mixture.log_weights)
    return jax.tree.map(lambda leaf: leaf[place], mixture.particles)


@partial(jit_on_wide_vectors, soon=True)
def _observe(problem, inputs, keys, values, paths):
    def one(key: Array, values: PyTree, path: PyTree) -> PyTree:
        model = problem.having(values).model
        after = jax.tree.map(lambda leaf: leaf[1:], path)
        keys = jax.random.split(key, jax.tree.leaves(after)[0].shape[0])

        def observe(key: Array, now: PyTree, state: PyTree) -> PyTree:
            alone = jax.tree.map(lambda leaf: leaf[None], state)
            observation = law_of(with_inputs(model, now)).observe(key, alone)
            return jax.tree.map(lambda leaf: leaf[0], observation)

        return jax.vmap(observe)(keys, inputs, after)

    return jax.vmap(jax.vmap(one))(keys, values, paths)


# Compiling takes nearly all of the time.
@partial(jit_on_wide_vectors, soon=True)
def _predict(problem, keys, values, ends, num_steps, inputs):
    def one(key: Array, values: PyTree, end: PyTree) -> tuple[PyTree, PyTree]:
        state = jax.tree.map(lambda leaf: leaf[None], end)
        return steps_ahead(key, problem.having(values).model, state, num_steps, inputs)

    return jax.vmap(jax.vmap(one))(keys, values, ends)
