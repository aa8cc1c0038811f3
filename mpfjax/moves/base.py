"""The three kinds of moves that a filter is a chain of."""

import abc

import equinox as eqx
from jaxtyping import Array, Bool, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.operations.gradients import without_gradient


class AbstractMove(eqx.Module):
    """A step of a filter, `(key, mixture, observation) -> mixture`.

    A move is of one of three kinds, and its kind is its contract: an `AbstractRegrouping` leaves
    the distribution as it is, an `AbstractRejuvenation` leaves the mass of every component as it
    is, an `AbstractPropagation` takes the particles from t-1 to t. `approximate` declares a move
    that is not part of the exact recursion, so that the estimate of the marginal likelihood is
    no longer unbiased.
    """

    @property
    def approximate(self) -> bool:
        """Whether the move departs from the exact recursion."""
        return False

    @abc.abstractmethod
    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree
    ) -> ParticleMixture:
        """Move the mixture, given y_t."""

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """What is left of the move where y_t is missing; nothing, unless it propagates."""
        del key
        return mixture

    def initial_memory(self, num_components: int) -> dict[str, PyTree]:
        """What the move carries from step to step, under its own name; most carry nothing."""
        del num_components
        return {}

    def forget(self, memory: dict[str, PyTree], dead: Bool[Array, " m"]) -> dict[str, PyTree]:
        """The mixture's memory without what the move knows of dead components.

        A filter asks for it after each move, so that a label which is taken again has no past.
        """
        del dead
        return memory


class AbstractRegrouping(AbstractMove):
    """A move that rewrites the component indicators and nothing else, so that it is exact.

    The reclustering F of Vermaak et al. (2003), section 4: with joint weights the new mixture
    equals the old one in distribution whatever the new indicators are.
    """

    @abc.abstractmethod
    def regroup(
        self, key: Key[Array, ""], mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], dict[str, PyTree]]:
        """The new component indicators, and the new memory of the mixture."""

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: PyTree = None
    ) -> ParticleMixture:
        """Regroup the particles; the observation plays no part."""
        if mixture.num_components == 1:
            return mixture
        # Indicators are whole numbers, through which no derivative passes.
        indicators, memory = self.regroup(key, without_gradient(mixture))
        return mixture.replace(component_indicators=indicators, memory=memory)


class AbstractRejuvenation(AbstractMove):
    """A move that redraws the particles within each component and keeps the component's mass."""


class AbstractPropagation(AbstractMove):
    """A move that draws x_t and multiplies the weights by L D / q, so that the mass changes."""
