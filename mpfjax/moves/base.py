"""The kinds of moves of a filter, and their contracts."""

import abc
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from operator import attrgetter
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from mpfjax.checks import Checked, check, is_series, shown
from mpfjax.mixture import ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.law import Law, law_of
from mpfjax.operations.random import split

Gradient = Literal["none", "stop"]
Groups = Callable[[PyTree], Int[Array, " n"]]  # the number of the group of each particle


class Step(eqx.Module):
    """The step that a move is part of, the argument `now` of `move(key, mixture, now)`."""

    model: Any
    """the filter's own model, an `AbstractStateSpaceModel` at u_t."""
    observation: PyTree
    """y_t; None where it is missing, and most moves then do nothing."""
    inputs: PyTree = None
    """u_t, the known inputs of the step, from which the model at u_t was made."""
    filter: Any = None
    """the `Filter` itself, whose model has no inputs; None for a move that is run alone."""
    is_initial: bool = eqx.field(static=True, default=False)
    """whether it is x_0 that is moved, with y_1 for an observation, if that is known."""

    @property
    def is_present(self) -> bool:
        """Whether there is an observation."""
        return self.observation is not None

    @property
    def is_missing(self) -> bool:
        """Whether it is a step without an observation, as the moving of x_0 is not."""
        return not self.is_present and not self.is_initial

    @property
    def propagation(self) -> "AbstractPropagationOfEach | None":
        """The filter's first move that draws and weights x_t of each particle; None without one."""
        chain = all_of(self.filter.moves if self.filter else (), within=False)
        return next((move for move in chain if isinstance(move, AbstractPropagationOfEach)), None)

    @property
    def law(self) -> Law:
        """The law of the model at u_t."""
        return law_of(self.model)

    @property
    def initial_law(self) -> Law:
        """The law of the model without inputs, because x_0 has no input."""
        return law_of((self.filter or self).model)


class Given(Checked):
    """A base of what a filter gives its model, so that it may hold none itself."""

    def __check_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if isinstance(getattr(self, name), AbstractStateSpaceModel):
                who = type(self).__name__
                raise ValueError(f"{name}: a model, but {who} stores none; the filter has its own")
        super().__check_init__()


class AbstractMove(Given):
    """A move of a filter, `(key, mixture, now) -> mixture`, where `now` is a `Step`.

    The kind of a move is its contract. An `AbstractRegrouping` does not change the distribution. An
    `AbstractResampling` does not change the weight of any component. An `AbstractPropagation` takes
    the particles from t-1 to t. An `AbstractMarkovMove` moves x_t by a kernel that leaves its
    distribution invariant. An `AbstractWrapper` contains other moves. Properties that do not follow
    from the kind are declared by the attributes and methods below.
    """

    approximate = True
    """whether the move is not part of the exact recursion, so that Ẑ is no longer unbiased. A class
    says that it is: nothing is known of others."""
    weighs = True
    """whether it may change the weights by what was observed; a filter needs one that does."""
    keeps_mass = False
    """whether the mass of all particles stays what it was, so that nothing is to be normalised."""
    needs_parents = False
    """whether it looks at `mixture.parents`, x_{t-1} of each particle that has x_t. If one of its
    moves does, a filter keeps them during the step. Otherwise they cost nothing."""
    keeps_parents = True
    """whether each particle comes from one particle of the mixture that the move was given, or
    begins anew. Where it does not, what follows ancestors refuses the move."""
    keeps_families = True
    """whether it draws independently, or tells the memory of Eve indices, so that the errors of
    one run are known."""
    biases_score = True
    """whether it redraws particles in a way that derivatives in the model's parameters do not see,
    so that the score is biased. A class says that it does not."""
    holds: ClassVar[tuple[str, ...]] = ()
    """the names of the fields with the moves that it runs; see `AbstractWrapper`."""

    @abc.abstractmethod
    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Move the mixture at this step."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model or numbers of a filter that are not supported."""

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """The memory of the move at x_0, under its own name; most moves have none.

        `now` contains the model, and y_1 and u_1 if they are known; y_1 may be missing.
        """
        return {}

    def around(self, reference: Any) -> "AbstractMove":
        """The move in conditional SMC, which retains one trajectory, a `Reference`; most refuse."""
        who = f"filter: {type(self).__name__}"
        raise ValueError(f"{who} cannot keep a trajectory, as Resample and Propagate can")

    @property
    def inner(self) -> "Moves":
        """The moves that this move runs."""
        parts = [getattr(self, name) for name in self.holds]
        return tuple(jax.tree.leaves(parts, is_leaf=_is_move))

    def map_inner(self, change: Callable[[Any], Any]) -> Any:
        """The move in which `change(move)` replaces each move that it runs."""
        if not self.holds:
            return self
        parts = {name: getattr(self, name) for name in self.holds}
        return dataclasses.replace(self, **jax.tree.map(change, parts, is_leaf=_is_move))


Moves = tuple[AbstractMove, ...]


def _is_move(node: Any) -> bool:
    return isinstance(node, AbstractMove)


class FunctionMove(AbstractMove):
    """A function `(key, mixture, now) -> mixture` as a move; what it does is not known.

    Where y_t is missing, it is called with `now.observation` None.
    """

    function: Callable[..., ParticleMixture]

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """What the function returns."""
        return self.function(key, mixture, now)


def as_moves(moves: Any, name: str) -> Moves:
    """The moves as a tuple; a `ValueError` for other things, or a single move without a list."""
    if not is_series(moves):
        raise ValueError(f"{name}: {shown(moves)} is not a list of moves")
    moves = tuple(moves)
    for move in moves:
        check(Callable[..., Any], "a move, (key, mixture, now) -> mixture", **{name: move})
    return tuple(m if isinstance(m, AbstractMove) else FunctionMove(m) for m in moves)


def in_turn(
    key: Key[Array, ""], moves: Moves, mixture: ParticleMixture, now: Step
) -> ParticleMixture:
    """The mixture after the moves, one after the other, as at some steps of a run alone."""
    for move_key, move in zip(split(key, len(moves)), moves, strict=True) if moves else ():
        mixture = move(move_key, mixture, now)
    return mixture.with_order(False)


def name_of(move: AbstractMove) -> str:
    """The name of the move's class, or of the user's function."""
    function = move.function if isinstance(move, FunctionMove) else move
    return getattr(function, "__name__", type(function).__name__)


def all_of(moves: Iterable[AbstractMove], within: bool = True) -> Iterator[AbstractMove]:
    """The moves, and before each of them those that it runs, also `within` a propagation."""
    for move in moves:
        if within or not isinstance(move, AbstractPropagation):
            yield from all_of(move.inner, within)
        yield move


def memory_of(moves: Iterable[AbstractMove], now: Step, num_components: int) -> dict[str, PyTree]:
    """The initial memory of all moves; a `ValueError` where two have one of the same name."""
    memory: dict[str, PyTree] = {}
    for move in moves:
        entries = move.initial_memory(now, num_components)
        for name in sorted(entries.keys() & memory.keys()):
            raise ValueError(f"moves: two of them use the memory {name!r}, as {name_of(move)}")
        memory |= entries
    return memory


Regrouped = tuple[Int[Array, " n"], dict[str, PyTree]]


class AbstractRegrouping(AbstractMove):
    """A move that changes the component indicators and nothing else, and is therefore exact.

    This is the reclustering F of Vermaak et al. (2003), section 4. With joint weights, the new
    mixture represents the same distribution as the old one, for any new indicators.
    """

    approximate = False
    biases_score = False
    weighs = False
    keeps_mass = True

    @abc.abstractmethod
    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """The new component indicators, and the new memory of the mixture."""

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Regroup the particles, unless y_t is missing."""
        if mixture.num_components == 1 or now.is_missing:
            return mixture
        # Indicators are whole numbers and have no derivative.
        return self.with_indicators(mixture, *self.regroup(key, jax.lax.stop_gradient(mixture)))

    def with_indicators(
        self, mixture: ParticleMixture, indicators: Int[Array, " n"], memory: dict[str, PyTree]
    ) -> ParticleMixture:
        """The mixture with these indicators, broken if a particle's is outside of [0, M)."""
        inside = jnp.clip(indicators, 0, mixture.num_components - 1)
        regrouped = mixture.replace(component_indicators=inside, memory=memory)
        return regrouped.broken_where(mixture.occupied & (inside != indicators))

    def around(self, reference: Any) -> "AbstractRegrouping":
        """The move itself, which treats all particles alike."""
        return self


class AbstractResampling(AbstractMove):
    """A move that redraws the particles of each component and preserves the component's weight.

    Resampling copies particles and is unbiased. Gaussian regeneration draws from a fitted density
    instead, and is `approximate`.
    """

    weighs = False
    keeps_mass = True
    keeps_families = False

    @abc.abstractmethod
    def resample(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The mixture with its particles redrawn."""

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Resample, unless y_t is missing, or the mixture waits for it."""
        if now.is_missing:
            return mixture
        return unless_waiting(self.resample(key, mixture), mixture)


def unless_waiting(resampled: ParticleMixture, mixture: ParticleMixture) -> ParticleMixture:
    """The mixture resampled, or as it was where it waits for an observation."""
    if (waits := mixture.waits) is None:
        return resampled
    # Not by a condition, which would copy all that goes through it at every step.
    return jax.tree.map(
        lambda new, old: new if new is old else jnp.where(waits, old, new),
        resampled,
        mixture.with_order(resampled.in_order),
    )


class AbstractMarkovMove(AbstractMove):
    """A move by a Markov kernel that leaves the distribution of each particle's x_t invariant.

    The "move" of resample-move (Gilks and Berzuini 2001), also called rejuvenation. Weights,
    component indicators and ancestor indices do not change, so it is exact.
    """

    approximate = False
    weighs = False
    keeps_mass = True
    keeps_families = False


class AbstractPropagation(AbstractMove):
    """A move that draws x_t and multiplies the weights by L D / q, which changes the total weight.

    Without an observation it draws x_t by the model's transition and leaves the weights unchanged.
    Moves that it contains act inside it.
    """

    weighs = True
    keeps_mass = False

    # What is resampled within has no trajectories.
    around = AbstractMove.around


class AbstractPropagationOfEach(AbstractPropagation):
    """A propagation that draws and weights x_t of each particle independently of the others.

    It can therefore draw several x_t for each particle, or propagate other particles: the first one
    of a filter is `now.propagation` for all its moves.
    """


def _of_inner(together: Callable[..., bool], name: str) -> Any:
    """An attribute that is so of any of the moves held, or of all."""

    def of_moves(self: AbstractMove) -> bool:
        return together(map(attrgetter(name), self.inner))

    return property(of_moves, doc=f"Whether it is so of {together.__name__} of the moves held.")


class AbstractWrapper(AbstractMove):
    """A move that contains other moves, and forwards everything that it does not define itself.

    The class names the fields that contain them: `holds = ("moves",)`, each a move or a tuple of
    moves. Transforms of filters reach all moves by these names.
    """

    approximate = _of_inner(any, "approximate")
    weighs = _of_inner(any, "weighs")
    keeps_mass = _of_inner(all, "keeps_mass")
    needs_parents = _of_inner(any, "needs_parents")
    keeps_parents = _of_inner(all, "keeps_parents")
    keeps_families = _of_inner(all, "keeps_families")
    biases_score = _of_inner(any, "biases_score")

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """The checks of the inner moves."""
        for move in self.inner:
            move.check(now, num_particles, num_components)

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """The memory of the inner moves."""
        return memory_of(self.inner, now, num_components)

    def around(self, reference: Any) -> Any:
        """This move with its inner moves conditional on the trajectory."""
        return self.map_inner(lambda move: move.around(reference))


class AbstractProposal(Given):
    """A proposal distribution of x_t given x_{t-1} and y_t, with the density of each draw."""

    def check(self, now: Step) -> None:
        """Raise a `ValueError` for a model that the proposal does not support; most support any."""

    @abc.abstractmethod
    def propose(
        self, key: Key[Array, ""], now: Step, previous_states: PyTree
    ) -> tuple[PyTree, Float[Array, " n"]]:
        """x_t ~ q(. | x_{t-1}, y_t) for every particle, and log q of each, shape (n,).

        `now` contains the model, y_t and u_t. A proposal may also define `log_density(now, states,
        previous_states)`, log q of states that were not drawn from it, (n,), which
        `mpfjax.smoothing.conditional_filter` requires. If its draws are functions of standard
        normal noise, (n, k), it may define `propose_from_noise(noise, now, previous_states)`, which
        returns the same as `propose`, and `noise_dimension(previous_states)`, which is k;
        `Propagate(noise="rqmc")` requires both.
        """


def check_keep_parents(argument: str, moves: Iterable[AbstractMove], needed_by: str) -> None:
    """Raise a `ValueError` that names a move after which particles have no single parents."""
    for move in all_of(moves):
        if not move.keeps_parents:
            which = f"one parent x_(t-1), which {needed_by} needs (restarts leave none)"
            raise ValueError(f"{argument}: {name_of(move)} leaves no particle {which}")
