"""Online smoothing of sums over a trajectory: PaRIS, and fixed-lag smoothing."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree

from mpfjax.checks import Checked, CountOrZero, check_one_each, checked, saying
from mpfjax.filter import Filter
from mpfjax.memory import check_past
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import over_particles, require, with_inputs
from mpfjax.models.law import refuse_marginalised
from mpfjax.models.observations import one_input, one_observation
from mpfjax.models.series import as_series
from mpfjax.moves.base import check_keep_parents
from mpfjax.operations.compiling import is_traced, jit_with_floats_traced
from mpfjax.operations.logarithms import as_inexact
from mpfjax.operations.random import split
from mpfjax.report import StepInfo
from mpfjax.running.diagnosis import sound
from mpfjax.running.results import FilterRun
from mpfjax.running.scan import first_mixture, report_of, run_of, step_or_predict
from mpfjax.smoothing import backward
from mpfjax.smoothing.trajectories import NO_PAST

# Particles drawn for each particle's past. With one, few distinct particles of early times are
# left, as in a genealogy; two are enough (Olsson and Westerborn 2017).
_DRAWS = 2


class SmoothedSums(eqx.Module):
    """Smoothed expectations of a sum over the trajectory, at each step.

    - `sums`: leaves (t, ...), at step s the estimate of E[Σ_{r <= s} h(x_{r-1}, x_r) | y_1..y_s].
    - `run`: the `FilterRun`, with nothing collected.
    """

    sums: PyTree
    run: FilterRun


@checked
def smoothed_sums(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    function: Callable[[PyTree, PyTree], PyTree],
    *,
    method: Literal["exact", "mcmc"] = "exact",
) -> SmoothedSums:
    """E[Σ_t h(x_{t-1}, x_t) | y], online: PaRIS, in memory that does not grow with t.

    Olsson and Westerborn (2017): each particle i of step t carries τ_t^i, the expected sum over the
    trajectories that end in it. Two particles J of step t - 1 are drawn by the backward kernel,
    W_{t-1}^J D(x_t^i | x_{t-1}^J), and τ_t^i is the mean of τ_{t-1}^J + h(x_{t-1}^J, x_t^i) over
    them. The estimate is Σ_i W_t^i τ_t^i. W are joint weights, so this holds for a mixture too: a
    particle may have an ancestor in another component. Times Ẑ, it is unbiased if Ẑ is. The
    filter's run equals `run_filter` with the same key; a run in which a state restarts is an error.

    - `function`: h. Its arguments are x_{t-1} and x_t of n particles, leaves (n, ...), and it
      returns values for each, leaves (n, ...); of one particle if the model is wrapped by
      `per_particle`.
    - `method`: "exact" weights all N particles, O(N²) per step. "mcmc" (Dau and Chopin 2023) starts
      at the ancestor and continues by steps of independent Metropolis-Hastings, O(N), and is as
      accurate.
    - `observations`: arrays, or a `Series`.

    Raises `ValueError` for a model without `log_transition`, values that are not one per particle,
    "mcmc" if a move leaves no single ancestors, and as `run_filter` does; a RuntimeError if no
    particle can have moved to the next. Use it for the sums that scores and EM require, and for
    series that are too long to store; `FixedLagSmoother` estimates the terms. `sample_trajectories`
    requires the mixtures of all steps, and serves every function at once.
    """
    series = as_series(observations, filter.model)
    sums = _smooth(key, FixedLagSmoother(filter, function, 0, method), series)
    sums = eqx.tree_at(lambda sums: sums.run, sums, sound(sums.run))
    _check_sums(sums.sums)
    return sums


@jit_with_floats_traced
def _smooth(key, smoother, series):
    # The first two are those of `run_filter`.
    key_initial, key_steps, key_backward = split(key, 3)
    length, filter = series.length, smoother.filter
    initial = first_mixture(key_initial, filter, series)
    check_past(initial.memory)
    # One row, of the sums so far.
    terms = smoother._no_terms(initial.particles)

    def advance(carry: tuple[ParticleMixture, "Terms"], step: PyTree) -> Any:
        mixture, terms = carry
        step_key, draw_key, now = step
        moved, info = step_or_predict(filter, step_key, mixture, now)
        terms, values = smoother._of_pasts(draw_key, now.inputs, mixture, moved, terms)
        means = jax.tree.map(lambda old, new: old + new[None], terms.means, values.means)
        sums = jax.tree.map(lambda leaf: moved.expectation(leaf[0]), means)
        return (moved, terms._replace(means=means)), (sums, report_of(info))

    steps = jax.random.split(key_steps, length), jax.random.split(key_backward, length), series
    (final, _), (sums, reports) = jax.lax.scan(advance, (initial, terms), steps)
    return SmoothedSums(sums, run_of(initial, final, None, reports))


class Terms(NamedTuple):
    """Moments of h(x_{r-1}, x_r) given x_t and y_1..y_t: its mean, and its variance about it.

    By particle they have leaves (any, n, ...). The means vary among particles too.
    """

    means: PyTree
    variances: PyTree


class Window(NamedTuple):
    """The state of a fixed-lag smoother."""

    mixture: ParticleMixture
    """the filter's, at t."""
    terms: Terms
    """of each particle, for r of the last L + 1 steps: leaves (L + 1, n, ...), term r in row
    (r - 1) mod (L + 1)."""
    num_steps: Int[Array, ""]
    """t, from the start on."""


class FixedLagSmoother(Checked):
    """E[h(x_{r-1}, x_r) | y_1..y_t] for r = t - L, ..., t, online.

    `smoothed_sums` one step at a time (PaRIS: Olsson and Westerborn 2017), together with its
    filter. Memory is the size of h for L + 1 mixtures, for any t. Shapes are fixed, so that `step`
    compiles once and works within `jax.jit` and `jax.lax.scan`.

    - `filter`: one whose model has `log_transition`.
    - `function`: h of x_{t-1} and x_t of n particles, as for `smoothed_sums`; `lambda before, now:
      now` estimates the states themselves, an indicator the probability of its event.
    - `lag`: L. The longer, the less information of later observations is lost. A lag beyond the
      memory of the dynamics only adds noise.
    - `method`: as for `smoothed_sums`; "mcmc" is O(N) per step, "exact" O(N²).

    Raises `ValueError` as `smoothed_sums` does. Use it for estimates that may be slightly delayed,
    such as a position on a map; `smoothed_sums` is for a series that is available as a whole.
    """

    filter: Filter
    function: Callable[[PyTree, PyTree], PyTree]
    lag: CountOrZero = eqx.field(static=True)
    method: Literal["exact", "mcmc"] = eqx.field(static=True, default="exact")

    def __check_init__(self) -> None:
        super().__check_init__()
        user = "FixedLagSmoother or smoothed_sums"
        refuse_marginalised(self.filter.model, user, "take sample_trajectories")
        require(self.filter.model, "log_transition", user)
        if self.method == "mcmc":
            check_keep_parents("filter", self.filter.moves, f"{user} with method 'mcmc'")

    def init(self, mixture: ParticleMixture) -> Window:
        """The initial window: at the mixture of `Filter.init`, or at any later one."""
        check_past(mixture.memory)
        return Window(mixture, self._no_terms(mixture.particles), jnp.zeros((), jnp.int32))

    @checked
    def step(
        self, key: Key[Array, ""], window: Window, observation: PyTree, *, inputs: PyTree = None
    ) -> tuple[Window, PyTree, StepInfo]:
        """The next window, the estimates of r = t - L, ..., t, and the filter's report.

        Estimates have leaves (L + 1, ...): the first is final, the last is the filter's. They are
        NaN for r < 1, for which there is no term. `observation` is y_t, None if it is missing;
        `inputs` are u_t.
        """
        key_step, key_draws = jax.random.split(key)
        if observation is not None:
            observation = one_observation(observation, self.filter.model)
        moved, info = self.filter._run(key_step, window.mixture, observation, inputs)
        inputs = one_input(inputs, self.filter.model)
        window, estimates = _advance(self, key_draws, window, moved, inputs)
        _check_sums(jax.tree.map(lambda leaf: leaf[-1], estimates))
        return window, estimates, info

    def variances(self, window: Window) -> PyTree:
        """Var[h(x_{r-1}, x_r) | y_1..y_t] for the r of the estimates, of each entry separately.

        It is computed about the mean, because E[h²] - E[h]² would be only rounding error if h is
        far from zero.
        """
        return _estimates(self, window).variances

    def _no_terms(self, states: PyTree) -> Terms:
        """Zeros for the terms of the first steps, of which there are none: (L + 1, n, ...)."""
        values, rows = jax.eval_shape(self._of_states, states, states), (self.lag + 1,)
        terms = jax.tree.map(lambda leaf: jnp.zeros(rows + leaf.shape, leaf.dtype), values)
        return Terms(terms, jax.tree.map(jnp.real, terms))

    def _of_pasts(
        self,
        key: Key[Array, ""],
        inputs: PyTree,
        mixture: ParticleMixture,
        moved: ParticleMixture,
        terms: Terms,
    ) -> tuple[Terms, Terms]:
        """Terms of the particles at t - 1, over the pasts of those at t; and h of the step.

        Leaves of the first are (any, n, ...) as they were, of the second (n, ...).
        """
        model = with_inputs(self.filter.model, inputs)
        states, needed, start = moved.particles, moved.occupied, moved.ancestor_indices
        if self.method == "exact":
            log_kernel = backward.log_kernel_from(model, mixture)
            indices = backward.draw_exactly(key, log_kernel, states, mixture, _DRAWS, needed)
        else:
            key_proposed, key_walk = split(key, 2)
            proposed = backward.draw(key_proposed, start.shape, mixture.log_weights)
            later = backward.walk(key_walk, model, states, mixture, start, proposed, needed)
            indices = jnp.stack([start, later], axis=1)  # the start counts as a draw
        places = jnp.where((moved.began_anew & needed)[:, None], -1, indices).reshape(-1)
        earlier = backward.rows_at(places, mixture.particles)
        repeat = partial(jnp.repeat, repeats=_DRAWS, axis=0)
        values = self._of_states(earlier, jax.tree.map(repeat, states))
        no_spread = jax.tree.map(lambda leaf: jnp.zeros_like(jnp.real(leaf)), values)

        of_pasts = jax.vmap(lambda term: _over_draws(backward.rows_at(places, term)))(terms)
        return of_pasts, _over_draws(Terms(values, no_spread))

    def _of_states(self, previous: PyTree, states: PyTree) -> PyTree:
        """h of these states; a `ValueError` unless it is one value a particle."""
        with saying("function", "called with x_{t-1} and x_t of all particles"):
            values = over_particles(self.filter.model, self.function)(previous, states)
        check_one_each(jax.tree.leaves(states)[0].shape[0], function=values)
        return jax.tree.map(as_inexact, values)


def _check_sums(sums: PyTree) -> None:
    """Raise a `RuntimeError` where they are NaN; within a caller's jit they stay so."""
    if not is_traced(sums) and any(np.isnan(leaf).any() for leaf in jax.tree.leaves(sums)):
        raise RuntimeError(f"function: a sum is NaN. Either {backward.NO_TRANSITION}; or {NO_PAST}")


def _over_draws(terms: Terms) -> Terms:
    """The moments over each particle's draws, which stand side by side."""
    draws = jax.tree.map(lambda leaf: leaf.reshape(-1, _DRAWS, *leaf.shape[1:]), terms)
    means, within = jax.tree.map(lambda leaf: jnp.mean(leaf, axis=1), draws)

    def both(draws: Array, mean: Array, within: Array) -> Array:
        return within + jnp.mean(jnp.abs(draws - mean[:, None]) ** 2, axis=1)

    return Terms(means, jax.tree.map(both, draws.means, means, within))


@jit_with_floats_traced
def _advance(smoother: Any, key: Any, window: Window, moved: ParticleMixture, inputs: PyTree):
    """The next window, and the estimates."""
    terms, values = smoother._of_pasts(key, inputs, window.mixture, moved, window.terms)
    t = window.num_steps
    row = t % (smoother.lag + 1)
    terms = jax.tree.map(lambda old, new: old.at[row].set(new), terms, values)
    window = Window(moved, terms, t + 1)
    return window, _estimates(smoother, window).means


@jit_with_floats_traced
def _estimates(smoother: Any, window: Window) -> Terms:
    """The moments of r = t - L, ..., t, NaN for those before the first step."""
    num_kept, mixture = smoother.lag + 1, window.mixture
    steps = window.num_steps - num_kept + jnp.arange(num_kept, dtype=jnp.int32)

    def of_step(r: Array) -> Terms:
        means, variances = jax.tree.map(lambda leaf: leaf[r % num_kept], window.terms)
        # The variance is of the means, plus the mean of the variances.
        between = jax.tree.map(mixture.variance, means)
        within = jax.tree.map(mixture.expectation, variances)
        means = jax.tree.map(mixture.expectation, means)
        estimates = Terms(means, jax.tree.map(jnp.add, between, within))
        return jax.tree.map(lambda leaf: jnp.where(r < 0, jnp.nan, leaf), estimates)

    return jax.vmap(of_step)(steps)
