"""A model tried out before it is run, where what would go wrong silently is reported by name."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import checked, warn
from mpfjax.models import base
from mpfjax.models.conditionally_linear import is_mixed
from mpfjax.models.law import law_of
from mpfjax.models.observations import one_input, one_observation
from mpfjax.models.targets import TargetsModel, UniformBirth
from mpfjax.moves.base import AbstractProposal, Step
from mpfjax.operations.compiling import in_little_memory, jit_with, with_floats_traced
from mpfjax.trial.statistics import density_faults, origin_faults

_KEYS, _PLACES, _DRAWS = 64, 4, 32  # of the draws that must differ
_FAMILIES, _SIBLINGS = 8, 128  # of states, by whose densities a draw must be of its own
_DENSITY_DRAWS = 8192  # at which a density is integrated
# Of a right model, variances are beyond this once in a million keys.
_MOST_RATIO = 4.0


def _jit(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """A compiled function that runs once or twice: most of the time would go into compiling."""

    @functools.cache
    def program() -> Callable[..., PyTree]:
        options = in_little_memory(soon=True)
        least = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
        return jit_with(options | least if options else {}, function)

    return lambda *arguments: program()(*arguments)


@checked
def check_model(
    key: Key[Array, ""],
    model: base.AbstractStateSpaceModel,
    observation: PyTree,
    *,
    inputs: PyTree = None,
    proposal: AbstractProposal | None = None,
) -> None:
    """Try a model out on one observation, y_1; a `ValueError` names the first fault.

    Call it once for a model that you have written. It finds what a filter would not notice:

    - methods that are missing, and draws or densities of other shapes or types than they must have;
    - noise that particles share. One key serves all particles: `jax.random.normal(key)`, without
      their number in its shape, moves all of them alike;
    - draws that are the same for every key;
    - a draw, or a density at a draw of the model, that is NaN; a likelihood that is zero for all
      particles; a density of a particle that depends on the other particles;
    - a `log_likelihood` that is not the density of `sample_observation` up to a factor of y, if the
      model has this method, and a `log_transition` that is not the density of `sample_transition`:
      a wrong sign, a density for its logarithm, a variance for a standard deviation, a normaliser
      that is missing and depends on x. A draw comes from one of some possible states. The density
      gives each of these a probability to be its origin, and the true origins must agree with it;
    - a `log_initial`, a `log_transition` or a `proposal` that is not the log density of its draws,
      and a `locate` of `UniformBirth`: the mean of f / q over draws of q is 1 for every density f
      that is narrower.

    The last two look at some ten thousand random draws, of x_0 and of the first two steps: they
    accept a correct model, and may accept one that is wrong by a few percent, or in rare events.
    `inputs` are u_1, and `proposal` is what `particle_filter(..., proposal=)` will use. A
    `UserWarning` says where a density has a derivative of NaN by the model's numbers, so that they
    cannot be tuned by gradient; with `handles_missing`, also where the first number of y_1 is
    missing.
    """
    inputs, observation = one_input(inputs, model), one_observation(observation)
    if base.is_made_of_noise(model):
        base.require_noise(model, "check_model")
    for fault in _faults(key, model, observation, inputs):
        raise ValueError(f"model: {base.model_name(model)}.{fault}")
    if proposal is not None:
        now = Step(base.with_inputs(model, inputs), observation, inputs)
        proposal.check(now)
        for fault in _of_density("propose", "its draws", *_of_proposal(key, model, now, proposal)):
            raise ValueError(f"proposal: {type(proposal).__name__}.{fault}")


def _faults(key: Key[Array, ""], model: Any, observation: PyTree, inputs: PyTree) -> Iterator[str]:
    """What is wrong with the model's methods, one after the other, by their names."""
    now = base.with_inputs(model, inputs)
    drawn = _draw(key, model, now)
    yield from _of_draws("sample_initial", drawn["many x_0"])
    if "log_initial" in drawn:
        yield from _of_density("log_initial", "sample_initial", drawn["x_0"], drawn["log_initial"])
    if isinstance(model, TargetsModel) and isinstance(model.birth, UniformBirth):
        yield from _of_births(key, model.birth, model.scans(observation))
    yield from _of_draws("sample_transition", drawn["many x_1"])
    yield from _of_likelihood(now, observation, drawn["x_1"])
    if "log_transition" in drawn:
        what = "log_transition", "sample_transition"
        yield from _of_origins(*what, "x_(t-1)", drawn["origins of x_2"], drawn["siblings"])
        yield from _of_density(*what, drawn["x_1 of places"], drawn["log_transition"])
    if "many y_1" in drawn:
        yield from _of_draws("sample_observation", drawn["many y_1"])
        what = "log_likelihood", "sample_observation", "x_t"
        yield from _of_origins(*what, drawn["origins of y_1"], drawn["families"])


@_jit
def _draw(key, model, now):
    """Draws of a model, and its densities at them, by name; `now` is the model at u_1.

    All are of one program, of few calls of each method, since compiling takes most of the time.
    """
    keys = jax.random.split(key, 6)
    law, draw_initial = law_of(now), law_of(model).sample_initial
    drawn: dict[str, PyTree] = {"many x_0": _of_many_keys(draw_initial, keys[0], _DRAWS)}
    draws = model.sample_initial(keys[1], _DENSITY_DRAWS)
    initial = law.start(draws)
    if callable(getattr(model, "log_initial", None)):
        drawn["x_0"], drawn["log_initial"] = draws, law_of(model).log_initial(draws)
    starts = _rows(initial, slice(_FAMILIES))
    places = _repeat(_rows(starts, slice(_PLACES)), _DRAWS)
    drawn["many x_1"] = _of_many_keys(law.move, keys[2], places)
    groups = [_rows(initial, slice(_FAMILIES * _SIBLINGS)), _repeat(starts, _SIBLINGS)]
    has_density = is_mixed(model) or callable(getattr(model, "log_transition", None))
    if has_density:
        groups.append(_repeat(_rows(starts, slice(_PLACES)), _DENSITY_DRAWS))
    before = jax.tree.map(lambda *parts: jnp.concatenate(parts), *groups)
    after, number = law.move(keys[3], before), _FAMILIES * _SIBLINGS
    drawn["x_1"] = _rows(after, slice(0, number, _SIBLINGS // _DRAWS))
    families = _in_families(_rows(after, slice(2 * number)))
    siblings = drawn["siblings"] = _rows(families, slice(_FAMILIES, None))
    if has_density:
        children = law.part(law.move(keys[4], _side_by_side(siblings)))
        starts, ends = (_rows(each, slice(2 * number, None)) for each in (before, after))
        drawn["x_1 of places"] = ends = law.part(ends)
        drawn["log_transition"] = law.log_transition(ends, starts)

        def log_transition(draw: PyTree, states: PyTree) -> Float[Array, " s"]:
            return law.log_transition(_repeat(_rows(draw, None), _SIBLINGS), states)

        drawn["origins of x_2"] = _log_densities(log_transition, _in_families(children), siblings)
    if callable(getattr(model, "sample_observation", None)) and law.is_whole:
        same = _repeat(_rows(after, slice(_PLACES)), _DRAWS)
        drawn["many y_1"] = _of_many_keys(law.observe, keys[5], same)
        observations = _in_families(law.observe(keys[5], _side_by_side(families)))
        drawn["families"] = families
        drawn["origins of y_1"] = _log_densities(law.log_likelihood, observations, families)
    return drawn


def _of_many_keys(draw: Callable[..., PyTree], key: Key[Array, ""], of: Any) -> PyTree:
    return jax.vmap(lambda key: draw(key, of))(jax.random.split(key, _KEYS))


def _rows(states: PyTree, which: Any) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[which], states)


def _repeat(states: PyTree, number: int) -> PyTree:
    return jax.tree.map(lambda leaf: jnp.repeat(leaf, number, axis=0), states)


def _in_families(states: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf: leaf.reshape(-1, _SIBLINGS, *leaf.shape[1:]), states)


def _side_by_side(families: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), families)


def _log_densities(
    log_density: Callable[[PyTree, PyTree], Array], draws: PyTree, states: PyTree
) -> Float[Array, "f s s"]:
    """The log density of each draw given each of the states of its family."""

    def of_family(family: tuple[PyTree, PyTree]) -> Float[Array, "s s"]:
        return jax.lax.map(lambda draw: log_density(draw, family[1]), family[0])

    return jax.lax.map(of_family, (draws, states))


@_jit
def _likelihoods(model: Any, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
    return law_of(model).log_likelihood(observation, states)


def _of_draws(method: str, draws: PyTree) -> Iterator[str]:
    """Faults of draws for many keys, of particles of a few places side by side.

    Their mean must not vary more than that of independent ones.
    """
    for column in _columns(draws):
        by_place = column.reshape(_KEYS, -1, _DRAWS)
        if np.isnan(column).any():
            yield f"{method} draws NaN"
        is_same = (column == column[:1]).all() and (by_place != by_place[:, :, :1]).any()
        if is_same and method == "sample_transition":
            yield f"{method} gives the same draws for every key; draw with the key that it is given"
        of_means = by_place.mean(axis=2).var(axis=0, ddof=1).mean()
        expected = by_place.var(axis=2, ddof=1).mean() / _DRAWS
        rounding = (1e-5 * np.abs(column).max()) ** 2
        if of_means > _MOST_RATIO * expected + rounding:
            yield (
                f"{method} draws noise that particles share; one key serves all of them, so that"
                " the shape of what is drawn must begin with their number, as"
                " jax.random.normal(key, states.shape) does"
            )


def _columns(draws: PyTree) -> list[np.ndarray]:
    """Each number of the state, (keys, particles)."""
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(draws)]
    rows = [leaf.reshape(*leaf.shape[:2], -1) for leaf in leaves]
    return [row[:, :, k] for row in rows for k in range(row.shape[2])]


def _of_likelihood(model: Any, observation: PyTree, states: PyTree) -> Iterator[str]:
    """Faults of log L of draws of x_1."""
    values, half = _likelihoods(model, observation, states), len(jax.tree.leaves(states)[0]) // 2
    others = _likelihoods(model, observation, jax.tree.map(lambda leaf: leaf[half:], states))
    values, others = np.asarray(values, float), np.asarray(others, float)
    if not (values < np.inf).all():
        yield "log_likelihood is NaN or +inf at a draw of x_1"
    if not np.allclose(values[half:], others, rtol=1e-3, atol=1e-3):
        yield "log_likelihood of a particle depends on the other particles"
    if (values == -np.inf).all():
        yield f"log_likelihood is -inf at all {len(values)} draws of x_1: no particle explains it"
    _warn_of_derivative(model, observation, states)
    partly = _with_first_missing(observation)
    if getattr(model, "handles_missing", False) and partly is not None:
        if np.isnan(_likelihoods(model, partly, states)).any():
            yield "log_likelihood is NaN where a number is missing, despite handles_missing"
        hint = "; blank it before it is used: y = jnp.where(jnp.isnan(y), 0.0, y)"
        _warn_of_derivative(model, partly, states, f" where a number is missing{hint}")


def _with_first_missing(observation: PyTree) -> PyTree:
    """y without its first floating point number; None if it has no other."""
    floats, others = eqx.partition(observation, eqx.is_inexact_array)
    numbers, unravel = ravel_pytree(floats)
    if len(numbers) < 2:
        return None
    return eqx.combine(unravel(numbers.at[0].set(jnp.nan)), others)


def _warn_of_derivative(model: Any, observation: PyTree, states: PyTree, where: str = "") -> None:
    """A warning if log L has a derivative of NaN by the numbers of the model."""
    try:
        slopes = with_floats_traced(lambda traced: _derivative(traced, observation, states), model)
    except (TypeError, ValueError, NotImplementedError):
        # JAX has no derivative of it, as of a while loop in reverse (ValueError), of whole numbers
        # (TypeError) or of a call to the host (NotImplementedError). A filter needs none.
        return
    if any(np.isnan(slope).any() for slope in jax.tree.leaves(slopes)):
        message = f"{base.model_name(model)}.log_likelihood has a derivative of NaN{where}"
        warn(f"model: {message}", UserWarning)


@_jit
def _derivative(model, observation, states):
    def total(model: Any) -> Array:
        values = law_of(model).log_likelihood(observation, states)
        return jnp.sum(jnp.where(jnp.isfinite(values), values, 0.0))

    return eqx.filter_grad(total)(model)


def _of_origins(
    method: str, source: str, state: str, logs: Array, families: PyTree
) -> Iterator[str]:
    """Faults of the log density of draws, each given its own state and its siblings'."""
    what = "log D" if method == "log_transition" else "log L"
    for fault in origin_faults(np.asarray(logs, float), _columns(families), what, state):
        yield f"{method} {fault.format(source)}"


@_jit
def _of_proposal(key, model, now, proposal):
    """Draws of a proposal from each of a few x_0, and log q."""
    starts = law_of(model).sample_initial(jax.random.fold_in(key, 1), _PLACES)
    draws, logs = proposal.propose(key, now, _repeat(starts, _DENSITY_DRAWS))
    return now.law.part(draws), logs


def _of_density(name: str, source: str, draws: PyTree, logs: Array) -> Iterator[str]:
    """Faults of a log density, at the draws of each place apart."""
    values = [np.asarray(leaf, float).reshape(len(leaf), -1) for leaf in jax.tree.leaves(draws)]
    rows, log_densities = np.concatenate(values, axis=1), np.asarray(logs, float)
    for first in range(0, len(rows), _DENSITY_DRAWS):
        part = slice(first, first + _DENSITY_DRAWS)
        for fault in density_faults(list(rows[part].T), log_densities[part]):
            yield f"{name} {fault.format(source)}"


def _of_births(
    key: Key[Array, ""], birth: UniformBirth, scans: tuple[PyTree, ...]
) -> Iterator[str]:
    """Faults of the densities of places at the first measurement of each sensor."""
    for k, scan in enumerate(scans):
        leaves = jax.tree.leaves(scan)
        is_there = [np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1) for leaf in leaves]
        if not (rows := np.flatnonzero(np.all(is_there, axis=0))).size:
            continue
        locate = birth.locate[k] if isinstance(birth.locate, tuple) else birth.locate
        measurement = jax.tree.map(lambda leaf, row=rows[0]: leaf[row], scan)
        places, logs = locate(key, measurement, _DENSITY_DRAWS)
        logs = base.real_each(logs, _DENSITY_DRAWS, "birth.locate")
        yield from _of_density("birth.locate's log density", "its places", places, logs)
