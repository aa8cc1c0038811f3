"""The interface of a state-space model, its known inputs u_t, what it must have and return, and the
wrapper for models of one particle.
"""

import abc
import contextlib
import difflib
import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import RULES, Count, Rule, check, check_one_each, kinds, saying, shown
from mpfjax.models.noise import noise_dtype
from mpfjax.operations.logarithms import default_float
from mpfjax.operations.random import normal, split


class AbstractStateSpaceModel(eqx.Module):
    """A Markov state x_t with observations y_t; all methods act on all particles at once.

    p(x_0), D(x_t | x_{t-1}) and L(y_t | x_t) of Vermaak et al. (2003), section 2. x_0 follows the
    prior, before any observation; the first observation is y_1. The states are a pytree whose
    leaves have a leading axis n of particles. One key serves all n particles, which is several
    times faster than a key for each. To write the model for one particle instead, wrap it with
    `per_particle`.

    A class may set `handles_missing = True`. It then receives observations with NaN for missing
    values, and its likelihood must use the values that are present.

    A model may also define `log_transition(states, previous_states)`, log D of each particle, shape
    (n,), and `log_initial(states)`, log p(x_0). Guided proposals, smoothers and scores require the
    first, `exact.grid_filter` and particle Gibbs with a prior the second, a bootstrap filter none.

    A class may set `periods`, with the structure of one state: the periods of its periodic
    components, such as angles, and zero for all others. Mixture filters then cluster particles on
    the circle, and means of mixtures are circular.

    Instead of `sample_transition`, a model may define x_t as a function of noise:
    `transition_from_noise(noise, states)`, whose `noise` is standard normal, (n, k), and
    `noise_dimension`, k. `sample_transition` then draws independent noise. `jax.scipy.special.ndtr`
    of a normal number is uniform. `Propagate(noise="rqmc")` requires this form: its noise is
    distributed evenly over the particles. `initial_from_noise(noise)` and `initial_noise_dimension`
    do the same for x_0.

    A model that declares a field `inputs`, None by default, finds u_t there at each step: known
    data besides the observation, such as a control, a covariate or the time since the last step.
    All its methods can read `self.inputs`. A model that uses u_t in another way defines
    `with_inputs` itself. x_0 has no input.
    """

    handles_missing = False
    passes_inputs_to: ClassVar[tuple[str, ...]] = ()
    """The fields with parts of the model, to which `with_inputs` hands u_t."""

    def with_inputs(self, inputs: PyTree) -> "AbstractStateSpaceModel":
        """The model at a step whose known inputs are u_t: the field `inputs` is set.

        A model may override it, so that any of its parameters varies in time. It is called while
        JAX traces a step, so it must not use the values of u_t in Python.
        """
        if parts := self.passes_inputs_to:
            return replace_fields(self, **{n: with_inputs(getattr(self, n), inputs) for n in parts})
        return replace_fields(self, inputs=inputs)

    @abc.abstractmethod
    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """Draw x_0 for `num_particles` particles: every leaf has shape (n, ...)."""

    def sample_transition(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """Draw x_t ~ D(. | x_{t-1}) for every particle: `transition_from_noise` of fresh noise."""
        model: Any = self
        num_particles, dimension = jax.tree.leaves(states)[0].shape[0], model.noise_dimension
        # Drawn as a vector, one column is fused with what uses it.
        shape = (num_particles,) if dimension == 1 else (num_particles, dimension)
        noise = normal(key, shape, noise_dtype(states)).reshape(num_particles, dimension)
        return model.transition_from_noise(noise, states)

    @abc.abstractmethod
    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        """log L(y_t | x_t) of every particle, up to a constant shared by all of them."""


def takes_inputs(model: Any) -> bool:
    """Whether a model takes u_t: it has a field `inputs`, or its own `with_inputs`.

    Or the parts of it to which it passes u_t do, functions among them.
    """
    if isinstance(model, tuple):
        return any(map(takes_inputs, model))
    if parts := getattr(model, "passes_inputs_to", ()):
        return any(takes_inputs(getattr(model, name)) for name in parts)
    model = innermost(model)
    method = getattr(type(model), "with_inputs", AbstractStateSpaceModel.with_inputs)
    return hasattr(model, "inputs") or method is not AbstractStateSpaceModel.with_inputs


def with_inputs(model: Any, inputs: PyTree) -> Any:
    """The model with u_t, or unchanged where there is none, or where it takes none."""
    if inputs is None or not takes_inputs(model):
        return model
    if isinstance(model, tuple):
        return tuple(with_inputs(part, inputs) for part in model)
    if hasattr(model, "with_inputs"):
        return model.with_inputs(inputs)
    return replace_fields(model, inputs=inputs)


def replace_fields(model: Any, /, **fields: Any) -> Any:
    """A copy of a model with some fields set, without checks or conversions."""
    copy = object.__new__(type(model))
    for name, value in (vars(model) | fields).items():
        object.__setattr__(copy, name, value)
    return copy


def is_made_of_noise(model: Any, state: str = "transition") -> bool:
    """Whether the model makes x_t of noise, or x_0 ("initial"), and has no other law for it."""
    drawing, making = f"sample_{state}", f"{state}_from_noise"
    size = "noise_dimension" if state == "transition" else "initial_noise_dimension"
    kind = type(_unwrap(model))
    # A class that draws a state itself may inherit how it is made of noise.
    owners = [owner for owner in kind.__mro__ if {drawing, making} & vars(owner).keys()]
    is_other = callable(getattr(kind, making, None)) and making not in vars(owners[0])
    return hasattr(model, making) and hasattr(model, size) and not is_other


def require_noise(model: Any, needed_by: str) -> None:
    """Raise a `ValueError` unless the model can make x_t of noise."""
    require(model, "transition_from_noise", needed_by)
    check(Count, noise_dimension=getattr(model, "noise_dimension", None))
    if not is_made_of_noise(model):
        who = f"model: {model_name(model)}, which has a sample_transition of its own,"
        raise ValueError(f"{who} inherits its transition_from_noise, which {needed_by} needs")


def require(model: Any, method: str, needed_by: str, argument: str = "model") -> None:
    """Raise a `ValueError` where `model` lacks `method`, before anything compiles."""
    if isinstance(model, type):
        raise ValueError(f"{argument}: {shown(model)} is a class; write {model.__name__}(...)")
    if hasattr(model, "initial_moves"):
        raise ValueError(f"{argument}: a {type(model).__name__} is no model, but has one, .model")
    if not callable(getattr(model, method, None)):
        who = shown(model) if model is None else model_name(model)
        methods = {*_BATCHED, *_SHARED, *vars(AbstractStateSpaceModel)}
        close = difflib.get_close_matches(method, vars(type(_unwrap(model))).keys() - methods, 1)
        hint = f"; is {close[0]} meant for it?" if close else ""
        raise ValueError(f"{argument}: {who} defines no {method}, which {needed_by} needs{hint}")


def model_name(model: Any) -> str:
    """The name of the user's own class, whether `per_particle` wraps it or not."""
    return type(_unwrap(model)).__name__


@contextlib.contextmanager
def asking(model: Any, method: str, argument: str = "", value: Any = None) -> Iterator[None]:
    """A block that calls a method of the model, whose errors say so, and what it was given."""
    try:
        yield
    except Exception:
        clauses = [f"given {argument} {shown(value)}"] if argument else []
        is_users = not type(model).__module__.startswith("mpfjax.")
        if getattr(model, "inputs", ()) is None and is_users:
            clauses.append("whose `inputs` is None: pass inputs= to the call")
        with saying(f"model: {model_name(model)}.{method}", ", ".join(clauses)):
            raise


def _unwrap(model: Any) -> Any:
    return model.model if isinstance(model, _PerParticleModel) else model


def innermost(model: Any) -> Any:
    """The user's own model, of one particle or of one object where it is wrapped."""
    inner = getattr(model, "object_model", _unwrap(model))
    return model if inner is model else innermost(inner)


class _ModelRule(Rule):
    """A model has the methods, of all particles at once, whatever its class is."""

    def check(self, value: Any, name: str) -> None:
        """Raise a `ValueError` that says what is missing."""
        law, of_noise = "sample_transition", AbstractStateSpaceModel.sample_transition
        if getattr(type(value), law, None) is of_noise and not hasattr(value, "latent_dynamics"):
            law = "transition_from_noise"
            if not hasattr(value, law):
                who = f"{name}: {model_name(value)} defines no sample_transition"
                raise ValueError(f"{who}, nor {law}, one of which a filter needs")
        for method in ("sample_initial", law, "log_likelihood"):
            require(value, method, "a filter", name)
        try:
            inspect.signature(value.sample_initial).bind("key", "num_particles")
        except TypeError as error:
            raise ValueError(
                f"{name}: {model_name(value)}.sample_initial takes no (key, num_particles); if it"
                " is of one particle, wrap it, mpfjax.per_particle(model)"
            ) from error


_IS_MODEL = _ModelRule(lambda value: hasattr(value, "log_likelihood"), "a model")
RULES[AbstractStateSpaceModel] = _IS_MODEL


def check_states(states: Any, model: Any, method: str, num_particles: int) -> None:
    """Raise a `ValueError` for states of another number of particles, or no states at all."""
    check_one_each(num_particles, **{f"model: {model_name(model)}.{method}": states})


def check_moved(
    states: Any, previous_states: Any, model: Any, method: str = "sample_transition"
) -> None:
    """Raise a `ValueError` where structure, shapes or types of x_t are not those of x_{t-1}."""
    moved, expected = kinds(states), kinds(previous_states)
    if moved != expected:
        who = f"model: {model_name(model)}.{method}"
        raise ValueError(f"{who} returned {moved}, and not the kind of x_(t-1), {expected}")


def real_each(values: Any, num_particles: int, asked: Any, method: str = "") -> Float[Array, " n"]:
    """What a method of a model returned, or a function that `asked` names; a `ValueError` unless
    it is one real number per particle.
    """
    if getattr(values, "shape", None) != (num_particles,) or jnp.iscomplexobj(values):
        who = f"model: {model_name(asked)}.{method}" if method else asked
        real = f"one real value per particle, ({num_particles},)"
        raise ValueError(f"{who} returned {shown(values)}, not {real}")
    return jnp.asarray(values)


# Optional attributes beside the three methods: functions of one particle, and those that all
# particles share.
_BATCHED = (
    "log_transition", "log_initial", "with_history", "initial_from_noise", "transition_from_noise",
    "transition_mean", "observation_mean", "sample_observation",
)  # fmt: skip
_SHARED = (
    "transition_covariance", "observation_covariance", "prepare_observation", "noise_dimension",
    "initial_noise_dimension", "periods",
)  # fmt: skip


class _PerParticleModel(AbstractStateSpaceModel):
    """A model of one particle, mapped over all of them with a key for each."""

    model: Any

    @property
    def handles_missing(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return getattr(self.model, "handles_missing", False)

    def with_inputs(self, inputs: PyTree) -> "_PerParticleModel":
        return _PerParticleModel(with_inputs(self.model, inputs))

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        return jax.vmap(self.model.sample_initial)(split(key, num_particles))

    def sample_transition(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        if not hasattr(self.model, "sample_transition"):
            return super().sample_transition(key, states)
        return _OverParticles(self.model.sample_transition, draws=True)(key, states)

    def log_likelihood(self, observation: PyTree, states: PyTree) -> Float[Array, " n"]:
        return jax.vmap(self.model.log_likelihood, in_axes=(None, 0))(observation, states)

    def __getattr__(self, name: str) -> Any:
        # Only reached for names that the class lacks: the densities and means that a proposal
        # looks for are there exactly when the wrapped model has them.
        model = self.__dict__.get("model")
        if name in _BATCHED and hasattr(model, name):
            return _OverParticles(getattr(model, name), draws=name == "sample_observation")
        if name in _SHARED and hasattr(model, name):
            return getattr(model, name)
        raise AttributeError(f"{type(model).__name__} (per_particle) has no attribute {name!r}")


@dataclass(frozen=True)
class _OverParticles:
    """A function of one particle, mapped over all of them; equal where the functions are.

    A draw gets a key for each: with that of all, it would draw them one and the same.
    """

    function: Callable[..., Any]
    draws: bool = False

    def __call__(self, *args: PyTree) -> PyTree:
        if self.draws:
            args = (split(args[0], len(jax.tree.leaves(args[1])[0])), *args[1:])
        return jax.vmap(self.function)(*args)


def over_particles(model: Any, function: Any) -> Any:
    """A function of the particles from one in the terms of the model: of one, or of all."""
    is_mapped = isinstance(function, _OverParticles) or not callable(function)
    if not isinstance(model, _PerParticleModel) or is_mapped:
        return function
    return _OverParticles(function)


def per_particle(model: Any) -> AbstractStateSpaceModel:
    """The model for all particles from a model that is written for a single particle.

    `model` has `sample_initial(key)`, `sample_transition(key, state)` and
    `log_likelihood(observation, state)`, each for one particle. It may also have, for one particle,
    `log_transition(state, previous_state)`, `log_initial(state)`, `with_history(state,
    previous_state)`, `transition_from_noise(noise, state)` with noise (k,) (also instead of
    `sample_transition`), `sample_observation(key, state)`, `transition_mean(state)` and
    `observation_mean(state)`, and, for all particles, `noise_dimension`, `transition_covariance`,
    `observation_covariance` and `prepare_observation(observation)`. Known inputs u_t are set as its
    `inputs` if it has an attribute of this name, or passed to its `with_inputs(inputs)`. Use it for
    a first version of a model: with a key for each particle, draws take four to five times as long
    as for a batched model.

    Raises `ValueError` if one of the three methods is missing.
    """
    law = "transition_from_noise"
    law = law if hasattr(model, law) else "sample_transition"
    for method in ("sample_initial", law, "log_likelihood"):
        require(model, method, "per_particle")
    return _PerParticleModel(model)


def periods_of(model: Any) -> PyTree:
    """The periods of the state in floating point; None for a model without any."""
    periods = getattr(model, "periods", None)
    return jax.tree.map(lambda period: jnp.asarray(period, default_float()), periods)
