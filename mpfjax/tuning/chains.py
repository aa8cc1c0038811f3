"""What the samplers of parameters share: the prior, a random walk, and the loop over steps."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree
from tqdm import tqdm

from mpfjax.checks import check_callable, shown
from mpfjax.tuning.problem import Problem, Reals
from mpfjax.tuning.transforms import AbstractTransform

_NO_PAST = "log_transition is -inf, or NaN"  # of backward sampling, where all weights are NaN
BROKEN = "the log prior or log marginal likelihood was NaN or inf"


class Prior(eqx.Module):
    """log p(θ) + log |∂θ/∂u|, of parameters in unconstrained numbers u."""

    function: Callable[[dict[str, Array]], Float[Array, ""]]
    transforms: dict[str, AbstractTransform]

    def __call__(self, reals: Reals) -> Float[Array, ""]:
        """The log density, up to the constant that the function leaves out."""
        density = self.function(
            {name: self.transforms[name].constrain(u) for name, u in reals.items()}
        )
        for name, u in reals.items():
            density += self.transforms[name].log_jacobian(u)
        return density


def checked_prior(log_prior: Any, problem: Problem, start: Reals, where: str) -> Prior:
    """The prior; a `ValueError` for one that is no finite number at the start."""
    check_callable("a function of the parameters by name", log_prior=log_prior)
    density = log_prior({name: problem.transforms[name].constrain(u) for name, u in start.items()})
    is_number = eqx.is_array_like(density) and jnp.ndim(density) == 0
    if not is_number or not jnp.issubdtype(jnp.result_type(density), jnp.floating):
        raise ValueError(f"log_prior: {shown(density)} {where} is no floating point number")
    prior = Prior(log_prior, problem.transforms)
    value = float(prior(start))
    if not np.isfinite(value):
        raise ValueError(f"log_prior: {value} {where}")
    return prior


def checked_deviations(given: float | Mapping[str, Any], start: Reals) -> Reals:
    """The deviation of each unconstrained number; a `ValueError` for what is none."""
    by_name = given if isinstance(given, Mapping) else dict.fromkeys(start, given)
    if set(by_name) != set(start):
        raise ValueError(f"proposal_deviations: those of {sorted(by_name)}, not of {sorted(start)}")
    deviations = {}
    for name, u in start.items():
        try:
            value = np.asarray(by_name[name], float)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"proposal_deviations: {shown(by_name[name])} of {name} is no number"
            ) from error
        if not (np.isfinite(value).all() and (value > 0).all()):
            raise ValueError(f"proposal_deviations: {value} of {name} is not positive")
        if value.shape not in ((), u.shape):
            raise ValueError(
                f"proposal_deviations: shape {value.shape} of {name} is neither () nor {u.shape}"
            )
        deviations[name] = jnp.broadcast_to(jnp.asarray(value, u.dtype), u.shape)
    return deviations


def walk(key: Key[Array, ""], reals: Reals, deviations: Reals) -> Reals:
    """A Gaussian step in u."""
    names = sorted(reals)
    return {
        name: reals[name]
        + deviations[name] * jax.random.normal(key, reals[name].shape, reals[name].dtype)
        for name, key in zip(names, jax.random.split(key, len(names)), strict=True)
    }


def constrained(problem: Problem, reals: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Stacks of parameters, of any leading axes, on their own scale."""

    def convert(name: str, u: np.ndarray) -> np.ndarray:
        rows = jnp.asarray(u).reshape(-1, *np.shape(problem.start()[name]))
        values = np.asarray(jax.vmap(problem.transforms[name].constrain)(rows))
        leading = u.shape[: u.ndim - rows.ndim + 1]
        return values.reshape(*leading, *values.shape[1:])

    return {name: convert(name, u) for name, u in reals.items()}


def is_broken(error: RuntimeError) -> bool:
    """Whether a density was NaN or infinite."""
    return BROKEN in str(error) or _NO_PAST in str(error)


def take_steps(
    caller: str,
    advance: Callable[[Key[Array, " chains"], Any], tuple[Any, PyTree]],
    states: Any,
    key: Key[Array, ""],
    num_steps: int,
    num_chains: int,
    progress: bool,
) -> tuple[PyTree, str | None]:
    """What each step of all chains reports, stacked as (chains, steps, ...), and why they stopped.

    A step that is `BROKEN` ends the chains with a warning and the steps so far; the first one is a
    RuntimeError.
    """
    path, stopped = [], None
    for step in tqdm(range(num_steps), disable=not progress, unit="step"):
        keys = jax.random.split(jax.random.fold_in(key, step), num_chains)
        try:
            states, report = advance(keys, states)
            path.append(jax.tree.map(np.asarray, report))
        except RuntimeError as error:
            if not is_broken(error):
                raise
            stopped = f"{BROKEN} at step {step}"
            warnings.warn(f"{caller}: {stopped}", stacklevel=3)
            break
    if not path:
        raise RuntimeError(f"{caller}: {BROKEN} in the first step")
    return jax.tree.map(lambda *rows: np.stack(rows, axis=1), *path), stopped
