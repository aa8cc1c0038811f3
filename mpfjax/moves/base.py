"""The kinds of moves of a filter, and their contracts."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.operations.logarithms import without_gradient


class AbstractMove(eqx.Module):
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
    regroups = False
    """whether it changes the indicators and nothing else."""
    resamples = False
    """whether it redraws the particles by their weights."""
    sorts = False
    """whether it leaves each component's particles side by side in an order of its own, along which
    a propagation that follows in the same step spreads its point sets."""
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
    looks_ahead = False
    """whether its weights, as an initial move, wait for the likelihood that it has looked at. The
    particles of x_0 are then not resampled before they have been weighed by it."""
    resampling = None
    """the `Resample` by which it redraws the particles, whose weights a look-ahead may change."""
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
        raise ValueError(
            f"filter: {type(self).__name__} cannot keep a trajectory, as conditional SMC does;"
            " regrouping moves, Resample, Propagate, Predict and Reweight can"
        )

    def predict(self, key: Key[Array, ""], mixture: ParticleMixture) -> ParticleMixture:
        """The move when y_t is missing. Only a propagation does anything then."""
        del key
        return mixture

    @property
    def reads(self) -> frozenset[str]:
        """The names of the memory of other moves that this move needs."""
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


class AbstractRegrouping(AbstractMove):
    """A move that rewrites the component indicators and nothing else, so that it is exact.

    This is the reclustering F of Vermaak et al. (2003), section 4. With joint weights, the new
    mixture has the same distribution as the old one, whatever the new indicators are.
    """

    weighs = False
    keeps_mass = True
    regroups = True

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
        # Indicators are whole numbers and have no derivative.
        indicators, memory = self.regroup(key, without_gradient(mixture))
        return mixture.replace(component_indicators=indicators, memory=memory)

    def around(self, reference: Any) -> "AbstractRegrouping":
        """The move itself, for which the trajectory that is kept is like any other."""
        del reference
        return self


class AbstractResampling(AbstractMove):
    """A move that redraws the particles of each component and keeps the component's mass.

    Resampling makes copies and is unbiased. Gaussian regeneration draws from a fitted density
    instead, and is `approximate`.
    """

    weighs = False
    keeps_mass = True
    resamples = True
    keeps_families = False


class AbstractAdaptiveResampling(AbstractResampling):
    """A resampling of those components that are due, such as those of low effective sample size."""

    @abc.abstractmethod
    def is_due(self, mixture: ParticleMixture) -> Bool[Array, " m"]:
        """Which components of `mixture` the move would resample."""

    def would_resample(
        self, mixture: ParticleMixture, observation: PyTree = None
    ) -> Bool[Array, " m"]:
        """Those that are due."""
        del observation
        return self.is_due(mixture)


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
