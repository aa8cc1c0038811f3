"""The kinds of moves of a filter, and their contracts."""

import abc
from collections import ChainMap
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import Checked, check, is_series, shown
from mpfjax.mixture import ParticleMixture
from mpfjax.operations.logarithms import without_gradient

Gradient = Literal["none", "stop"]


class AbstractMove(Checked):
    """A step of a filter, `(key, mixture, observation) -> mixture`.

    The kind of a move is its contract. An `AbstractRegrouping` does not change the distribution.
    An `AbstractResampling` does not change the mass of any component. An `AbstractPropagation`
    takes the particles from t-1 to t. An `AbstractMarkovMove` moves x_t by a kernel that leaves
    its distribution invariant. A move is `approximate` if it is not part of the exact recursion;
    the marginal likelihood is then no longer unbiased.
    """

    approximate = False
    """whether the move departs from the exact recursion."""
    weighs = True
    """whether it may change the weights by what was observed; a filter needs one that does."""
    keeps_mass = False
    """whether the mass of all particles stays what it was, so that nothing is to be normalised."""
    propagates = False
    """whether it takes the particles from t-1 to t."""
    draws_each = False
    """whether it draws and weighs x_t of each particle without a look at the others, so that it may
    be asked for several draws of each."""
    regroups = False
    """whether it changes the indicators and nothing else."""
    resamples = False
    """whether it redraws the particles by their weights."""
    needs_parents = False
    """whether it looks at `mixture.parents`, x_{t-1} of each particle that has x_t. If one of its
    moves does, a filter keeps them during the step. Otherwise they cost nothing."""
    keeps_parents = True
    """whether each particle comes from one particle of the mixture that the move was given. Where
    it does not, the move sets its ancestor index to -1, and what follows ancestors refuses it."""
    biases_score = False
    """whether it redraws particles in a way that derivatives in the model's parameters do not see,
    so that the score is biased."""
    keeps_families = True
    """whether it draws independently, or tells the memory of first ancestors, so that the errors of
    one run are known."""
    resampling = None
    """the `Resample` by which it redraws the particles, whose weights a look-ahead may change."""
    keeps_trajectories = False
    """whether conditional SMC, which keeps one trajectory, may run it as it is."""
    inner = ()
    """the moves that it runs from time to time."""
    particles_per_component = None
    """the slots that each component gets, where the move fixes their number."""

    @abc.abstractmethod
    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Move the mixture, given y_t."""

    def would_resample(
        self, mixture: ParticleMixture, observation: PyTree = None
    ) -> Bool[Array, " m"]:
        """Which components the move would resample, for the report of a step; most moves none."""
        del observation
        return jnp.zeros(mixture.num_components, bool)

    def around(self, reference: Any) -> "AbstractMove":
        """The move in conditional SMC, which keeps one trajectory, a `Reference`; most cannot."""
        del reference
        if self.keeps_trajectories:
            return self
        who = f"filter: {type(self).__name__}"
        raise ValueError(f"{who} cannot keep a trajectory, as Resample and Propagate can")

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The move when y_t is missing. Only a propagation does anything then."""
        del key
        return mixture

    def map_inner(self, change: Callable[[Any], Any]) -> Any:
        """The move with `change(move)` in the place of each move that it runs for the chain."""
        del change
        return self

    def evidence_against(
        self, mixture: ParticleMixture, observation: PyTree, increment: Float[Array, ""]
    ) -> Float[Array, ""] | None:
        """The report's `log_evidence_against_start` after a step; None of a move that has none."""
        del mixture, observation, increment
        return None

    @property
    def reads(self) -> frozenset[str]:
        """The names of the memory of other moves that this move needs.

        A filter itself keeps "log_increment" for moves that read it: the growth of the mass in the
        step so far, which after a propagation is log p(y_t | y_1..y_{t-1}).
        """
        return frozenset()

    @property
    def own_memory(self) -> frozenset[str]:
        """The names of the memory that the move keeps."""
        return frozenset(eqx.filter_eval_shape(self.initial_memory, 1))

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """The initial memory of the move, under its own name; most moves have none."""
        del num_components
        return {}

    def forget(self, memory: dict[str, PyTree], dead: Bool[Array, " m"]) -> dict[str, PyTree]:
        """The mixture's memory without this move's memory of dead components.

        A filter calls this after each move, so that a label that is used again has no past.
        """
        del dead
        return memory


Moves = tuple[AbstractMove, ...]


class FunctionMove(AbstractMove):
    """A function `(key, mixture, observation) -> mixture` as a move; what it does is not known."""

    function: Callable[..., ParticleMixture]

    approximate = True

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """What the function returns."""
        return self.function(key, mixture, observation)

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """Raise a `ValueError`: a function does not say what it does without an observation."""
        del key, mixture
        raise ValueError(f"moves: {self.function!r} does not define predict, for a missing y_t")


def as_moves(moves: Any, name: str) -> Moves:
    """The moves as a tuple; a `ValueError` for other things, or a single move without a list."""
    if not is_series(moves):
        raise ValueError(f"{name}: {shown(moves)} is not a list of moves")
    moves = tuple(moves)
    for move in moves:
        check(Callable[..., Any], "a move, (key, mixture, observation) -> mixture", **{name: move})
    return tuple(m if isinstance(m, AbstractMove) else FunctionMove(m) for m in moves)


def name_of(move: AbstractMove) -> str:
    """The name of the move's class, or of the user's function."""
    function = move.function if isinstance(move, FunctionMove) else move
    return getattr(function, "__name__", type(function).__name__)


def with_inner(moves: Iterable[AbstractMove]) -> Iterator[AbstractMove]:
    """The moves, and after each of them those that it runs from time to time."""
    for move in moves:
        yield move
        yield from with_inner(move.inner)


def initial_memory(moves: Iterable[AbstractMove], num_components: int) -> dict[str, PyTree]:
    """The initial memory of all moves."""
    return dict(ChainMap(*(move.initial_memory(num_components) for move in moves)))


def without_dead(
    moves: Moves, memory: dict[str, PyTree], dead: Bool[Array, " m"]
) -> dict[str, PyTree]:
    """The memory of all moves without that of dead components."""
    for move in moves:
        memory = move.forget(memory, dead)
    return memory


Regrouped = tuple[Int[Array, " n"], dict[str, PyTree]]


class AbstractRegrouping(AbstractMove):
    """A move that rewrites the component indicators and nothing else, so that it is exact.

    This is the reclustering F of Vermaak et al. (2003), section 4. With joint weights, the new
    mixture has the same distribution as the old one, whatever the new indicators are.
    """

    weighs = False
    keeps_mass = True
    regroups = True
    keeps_trajectories = True

    @abc.abstractmethod
    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """The new component indicators, and the new memory of the mixture."""

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Regroup the particles; the observation plays no part."""
        if mixture.num_components == 1:
            return mixture
        # Indicators are whole numbers and have no derivative.
        indicators, memory = self.regroup(key, without_gradient(mixture))
        return mixture.replace(component_indicators=indicators, memory=memory)


class AbstractResampling(AbstractMove):
    """A move that redraws the particles of each component and keeps the component's mass.

    Resampling makes copies and is unbiased. Gaussian regeneration draws from a fitted density
    instead, and is `approximate`.
    """

    weighs = False
    keeps_mass = True
    resamples = True
    keeps_families = False


class AbstractMarkovMove(AbstractMove):
    """A move by a Markov kernel that leaves the distribution of each particle's x_t as it is.

    The "move" of resample-move (Gilks and Berzuini 2001), called rejuvenation in the literature.
    Weights, component indicators and ancestor indices stay, so that it is exact.
    """

    weighs = False
    keeps_mass = True
    keeps_families = False


class AbstractPropagation(AbstractMove):
    """A move that draws x_t and multiplies the weights by L D / q, so that the mass changes."""

    propagates = True
