"""Twisted particle filters: a look-ahead to all observations, learned from earlier runs."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count, checked
from mpfjax.filter import Filter
from mpfjax.lookahead.quadratics import neutral
from mpfjax.lookahead.regression import fit_lookahead
from mpfjax.lookahead.twisted import PropagateTwisted, RegroupTwisted, Twist, TwistInitial
from mpfjax.mixture import flatten_states
from mpfjax.models.base import is_made_of_noise, over_particles, require_noise
from mpfjax.models.conditionally_linear import is_mixed
from mpfjax.models.law import law_of
from mpfjax.models.noise import noise_dtype
from mpfjax.models.series import as_series
from mpfjax.moves.base import AbstractRegrouping, name_of
from mpfjax.moves.every import Every
from mpfjax.moves.resampling.auxiliary import AuxiliaryResample
from mpfjax.moves.resampling.resample import Resample
from mpfjax.running.run import run_filter

# So many times the particles of a run in each pass.
_LEARNERS = 16


@checked
def learn_lookahead(
    key: Key[Array, ""],
    filter: Filter,
    observations: PyTree,
    num_passes: Count = 5,
    *,
    features: Callable[[PyTree], Array] | None = None,
) -> Filter:
    """Learn a filter whose resampling and proposal look ahead to all later observations.

    A twisted particle filter (Whiteley and Lee 2014), whose twisting functions are learned by
    iteration (Guarniero, Johansen and Lee 2017; Heng, Bishop, Deligiannidis and Doucet 2020). A
    pass runs the filter with the functions learned so far. Then it proceeds backward in time: with
    x_t = f(x_{t-1}, ε), ψ_T first and ν_{T+1} = 1, it fits

        log ψ_t(x_{t-1}, ε) ≈ log L(y_t | x_t) + log ν_{t+1}(x_t)

    by least squares to particles x_{t-1} of the pass and new noise ε, and has in closed form ν_t(x)
    = ∫ N(ε; 0, I) ψ_t(x, ε) dε ≈ p(y_t, ..., y_T | x), by which x_{t-1} is resampled, and q_t(ε |
    x) ∝ N(ε; 0, I) ψ_t(x, ε), by which x_t is drawn. log ψ_t is a quadratic in φ(x) and ε for each
    mode, as represented by the filter's components; a constant and a share of unmodified noise keep
    its tails heavy (`LocalQuadratics`). x_0 is twisted as well if the model computes it from noise.

    The returned filter is exact. ψ was learned with other keys, so Ẑ is unbiased given ψ, and the
    weights represent the filtering distribution. If log ψ is nearly quadratic, log Ẑ and the final
    mixture weights vary far less. If ψ was learned from too few particles, they vary no less than
    before. Before the final time, the particles are where all observations lead, so filtering means
    of x_t are less accurate than those of `filter`. The filter is efficient for these observations
    only; for another series of the same length it is exact, but no more efficient. With other
    parameters of the model it is exact too, and efficient as long as the posterior of the states is
    similar. `eqx.tree_at` changes its `model`, and so do the samplers of `mpfjax.tuning`. No
    `SelectInitial` selects x_0, because ψ does.

    - `filter`: of moves `Resample` (or `AuxiliaryResample`, whose look-ahead is replaced),
      `Propagate` and regrouping; its components have equal allocation. Its model computes x_t from
      noise, `transition_from_noise`. Use one with components if there are several modes.
    - `num_passes`: how often the filter runs to learn, with sixteen times its particles, because
      errors of ψ persist. The whole pass is stored while ψ is fitted.
    - `features`: φ, in which log ψ is nearly quadratic, (states) -> (n, d); of one particle, if the
      model is wrapped by `per_particle`. None is the flattened state.
    - `observations`: arrays, or a `Series`; steps without an observation are skipped.

    For a conditionally linear model ε is the noise of z_t, L the density of y_t given z_0, ..., z_t
    and y_1..y_{t-1}, and φ a function of the particles: by default of the latent and the mean.

    Raises `ValueError` for another filter, and for a model without `transition_from_noise`. Use it
    if all observations are known in advance: for log Ẑ in `metropolis_hastings` and `smc2`, to
    compare models, and for the final weights of modes.
    """
    model = filter.model
    if not is_mixed(model):
        require_noise(model, "learn_lookahead")
    series = as_series(observations, model)
    twist = _knowing_nothing(key, filter, series.length, features)
    learners = _LEARNERS * filter.num_particles
    for pass_key in jax.random.split(key, num_passes):
        run_key, fit_key = jax.random.split(pass_key)
        twisted = _twisted(filter, twist, learners)
        run = run_filter(run_key, twisted, series)
        twist = fit_lookahead(fit_key, twisted, twist, run, series)
    return _twisted(filter, twist, filter.num_particles)


def _knowing_nothing(key: Key[Array, ""], filter: Any, length: int, features: Any) -> Twist:
    """ψ = 1 at every step."""
    model, size = filter.model, filter.num_components
    of_states = over_particles(model, features) or flatten_states
    states = jax.eval_shape(lambda key: law_of(model).sample_initial(key, 2), key)
    num_features = math.prod(jax.eval_shape(of_states, states).shape[1:])
    dtype = noise_dtype(states)
    noise = jax.eval_shape(lambda states: jnp.zeros(law_of(model).noise_dimension(states)), states)
    one = neutral(size, num_features, noise.shape[0], dtype)
    steps = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (length + 1, *leaf.shape)), one)
    initial = None
    if is_made_of_noise(model, "initial"):
        # x_0 has no state before it: one feature, which is zero.
        initial = neutral(size, 1, model.initial_noise_dimension, dtype)
    return Twist(steps, initial, of_states)


def _twisted(filter: Filter, twist: Twist, num_particles: int) -> Filter:
    """The filter whose moves look ahead by `twist`; a `ValueError` for one that cannot."""

    def ahead(move: Any) -> Any:
        if isinstance(move, AbstractRegrouping):
            return RegroupTwisted(move, twist)
        if isinstance(move, AuxiliaryResample):
            return ahead(move.resample)
        if isinstance(move, Resample):
            # Masses of today tell little where ψ knows what is to come: each ψ_t errs by its fit.
            return AuxiliaryResample(dataclasses.replace(move, allocation="equal"), twist)
        if hasattr(move, "proposal") and move.gradient == "none":
            return PropagateTwisted(dataclasses.replace(move, proposal=None), twist)
        if isinstance(move, Every):
            return move.map_inner(ahead)
        who = f"filter: {name_of(move)}"
        raise ValueError(f"{who} cannot look ahead, as Resample, Propagate and regrouping can")

    moves = [ahead(move) for move in filter.moves]
    for kind, needed in ((AuxiliaryResample, "Resample"), (PropagateTwisted, "Propagate")):
        if sum(isinstance(move, kind) for move in moves) != 1:
            raise ValueError(f"filter: its moves need one {needed}, in the chain itself")
    start = TwistInitial(twist, filter.initial_noise)
    initial_moves = [start, *(ahead(move) for move in filter.initial_moves if not move.weighs)]
    return filter.replace(moves=moves, num_particles=num_particles, initial_moves=initial_moves)
