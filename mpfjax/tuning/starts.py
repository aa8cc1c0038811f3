"""The starts of chains of parameters, and the way back to the parameters' own scale."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from mpfjax.checks import shown
from mpfjax.tuning.densities import Prior, checked_prior
from mpfjax.tuning.problem import Problem, Reals

SamplePrior = Callable[[Key[Array, ""]], Mapping[str, Array]]


@dataclass(frozen=True)
class Starts:
    """The starts of chains: the filter's own parameters, or draws of the prior."""

    key: Key[Array, ""]
    problem: Problem
    num_chains: int
    sample_prior: SamplePrior | None
    deviations: Reals
    """of the random walk at first."""

    @property
    def settings(self) -> dict[str, Any]:
        """All that has to be the same for a checkpoint to fit, by name."""
        return {
            "filter": self.problem.tree,
            "parameters": str(self.problem.tuned),
            "transforms": self.problem.transforms,
            "num_chains": int(self.num_chains),
            "proposal_deviations": self.deviations,
        }

    def checked(self, log_prior: Any) -> Prior:
        """The prior; a `ValueError` for one that is no number where chains start."""
        if self.sample_prior is None:
            return checked_prior(log_prior, self.problem, self.problem.start(), "at the start")
        draws = drawn(self.key, self.problem, self.sample_prior, 1)
        first = jax.tree.map(lambda u: u[0], draws)
        return checked_prior(log_prior, self.problem, first, "at a draw of sample_prior")


def repeated(reals: Reals, num_chains: int) -> Reals:
    """The same parameters for each chain."""
    return jax.tree.map(lambda u: jnp.broadcast_to(u, (num_chains, *u.shape)), reals)


def drawn(key: Key[Array, ""], problem: Problem, sample_prior: SamplePrior, num: int) -> Reals:
    """Draws of the prior in unconstrained numbers, leaves (num, ...)."""
    start = problem.start()
    keys = jax.random.split(key, num)
    one = sample_prior(keys[0])
    if not isinstance(one, Mapping) or set(one) != set(start):
        names = sorted(one) if isinstance(one, Mapping) else shown(one)
        raise ValueError(f"sample_prior: it gave {names}, no values by the names {sorted(start)}")
    draws, reals = jax.vmap(sample_prior)(keys), {}
    for name, transform in problem.transforms.items():
        present = transform.constrain(start[name])
        values = jnp.asarray(draws[name])
        if values.shape[1:] != present.shape:
            raise ValueError(
                f"sample_prior: {name} of shape {values.shape[1:]}, where the parameter's is"
                f" {present.shape}"
            )
        if not transform.contains(np.asarray(values)):
            kind = type(transform).__name__
            raise ValueError(f"sample_prior: a draw of {name} is outside {kind}'s domain")
        reals[name] = jax.vmap(transform.unconstrain)(values.astype(present.dtype))
    return reals


def constrained(problem: Problem, reals: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Stacks of parameters, of any leading axes, on their own scale."""

    def convert(name: str, u: np.ndarray) -> np.ndarray:
        rows = jnp.asarray(u).reshape(-1, *np.shape(problem.start()[name]))
        values = np.asarray(jax.vmap(problem.transforms[name].constrain)(rows))
        leading = u.shape[: u.ndim - rows.ndim + 1]
        return values.reshape(*leading, *values.shape[1:])

    return {name: convert(name, u) for name, u in reals.items()}
