"""Every: other moves, at every k-th step only."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from mpfjax.checks import Count
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractWrapper, Moves, Step, as_moves, in_turn, name_of


class Every(AbstractWrapper):
    """Run other moves at the steps k, 2k, 3k, ..., and none at the steps between.

    Vermaak et al. (2003), section 4, regroup "from time to time". Regrouping is exact at any time,
    and is not necessary at every step. The step number is stored in the mixture's memory, so that a
    run that continues from a checkpoint equals an uninterrupted run. The number does not depend on
    the run: under `vmap` over seeds the steps between take no time. A missing observation does not
    count as a step, because nothing is regrouped or resampled there.

    - `every`: k, at least 1.
    - `moves`: regrouping and resampling moves, in order.

    Raises `ValueError` for k < 1, no moves, and a move of another kind: without a propagation at
    every step the state would not move. Use it if regrouping takes a large part of the time.
    """

    every: Count = eqx.field(static=True)
    moves: Moves = eqx.field(converter=lambda moves: as_moves(moves, "moves"))

    holds = ("moves",)

    def __check_init__(self) -> None:
        others = [name_of(move) for move in self.moves if not move.keeps_mass]
        if others or not self.moves:
            which = "neither regroups, resamples nor moves by a Markov kernel"
            raise ValueError(f"moves: {', '.join(others) or 'none'} {which}")

    @property
    def name(self) -> str:
        """The name under which the step number is stored."""
        return f"every {self.every}: {', '.join(type(move).__name__ for move in self.moves)}"

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """The number of steps since the moves last ran, and the memory of the moves."""
        counter = {self.name: {"steps": jnp.zeros((), jnp.int32)}}
        return counter | super().initial_memory(now, num_components)

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Run the moves if this is a k-th step; none where y_t is missing."""
        if now.is_missing:
            return mixture
        steps = mixture.memory[self.name]["steps"] + 1
        memory = mixture.memory | {self.name: {"steps": steps % self.every}}
        # As after the moves, which run at every k-th step alone: both have one form.
        mixture = mixture.replace(memory=memory).with_order(False)
        runs = steps == self.every
        return jax.lax.cond(runs, lambda: in_turn(key, self.moves, mixture, now), lambda: mixture)
