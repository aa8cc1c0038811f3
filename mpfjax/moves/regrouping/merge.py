"""Components that overlap, that are improbable, and that repel each other."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from mpfjax.checks import Count, InnerShare, Positive
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import (
    AbstractMove,
    AbstractPropagation,
    AbstractRegrouping,
    Groups,
    Regrouped,
    Step,
)
from mpfjax.moves.regrouping.features import ByFeatures, relative_weights, separation, summarise
from mpfjax.operations.segments import spread
from mpfjax.operations.stored import take


class Merge(AbstractRegrouping, ByFeatures):
    """Merge components that overlap, after they have done so `patience` times in a row.

    Vermaak et al. (2003), section 4, leaves the criterion open. Here two components overlap when
    both of these hold:

    - their means are less than `max_deviations` pooled standard deviations apart, along the line
      through both means (Ashman's D; two equal Gaussians share 62% of their mass at 1, and 32% at
      2);
    - their means are less than `max_distance` apart, in units of `scale`.

    None omits a condition. `patience` is the number of times in a row that they must overlap before
    they are merged, so that two objects that pass each other are not joined. It counts runs of this
    move: frames, or every k-th frame within `Every(k, ...)`. A chain of overlapping components
    becomes one component, which keeps the lowest label.

    Raises `ValueError` if both conditions are None, for a threshold that is not positive, or for a
    patience below 1. Exact: only labels change.
    """

    max_deviations: Positive | None = eqx.field(static=True, default=1.0)
    max_distance: Positive | None = eqx.field(static=True, default=None, kw_only=True)
    patience: Count = eqx.field(static=True, default=1, kw_only=True)

    def __check_init__(self) -> None:
        if self.max_deviations is None and self.max_distance is None:
            raise ValueError("max_deviations, max_distance: at least one must be given")

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """How many times in a row each pair of components has overlapped, if patience counts."""
        if self.patience == 1:
            return {}
        return {"overlap_durations": jnp.zeros((num_components, num_components), jnp.int32)}

    def regroup(self, key: Key[Array, ""], mixture: ParticleMixture) -> Regrouped:
        """The lowest label of the chain of overlapping components that each particle is in."""
        components, features = mixture.component_indicators, self.features_of(mixture)
        weights = relative_weights(mixture)
        groups = summarise(features, weights, components, mixture.num_components)
        means, covariances = groups.means, groups.covariances
        distance, deviations = separation(
            means[:, None] - means[None], (covariances[:, None] + covariances[None]) / 2
        )
        alive = groups.masses > 0
        overlap, memory = alive[:, None] & alive[None], mixture.memory
        if self.max_deviations is not None:
            overlap &= deviations < self.max_deviations
        if self.max_distance is not None:
            overlap &= distance < self.max_distance
        if self.patience == 1:
            labels = lowest_connected(overlap)
        else:
            durations = jnp.where(overlap, memory["overlap_durations"] + 1, 0)
            labels = lowest_connected(durations >= self.patience)
            # A label that a later move uses again has no past.
            is_free = labels != jnp.arange(mixture.num_components, dtype=labels.dtype)
            durations = jnp.where(is_free[:, None] | is_free[None], 0, durations)
            memory = memory | {"overlap_durations": durations}
        return spread(labels, components), memory


def lowest_connected(adjacent: Bool[Array, "m m"]) -> Int[Array, " m"]:
    """The lowest label in the connected component of each node of a symmetric graph.

    Each node takes the lowest label of its neighbours, then the label of the node of that label,
    until none changes.
    """
    m = adjacent.shape[0]
    label = jnp.arange(m, dtype=jnp.int32)
    reach = adjacent | jnp.eye(m, dtype=bool)

    def lower(state: tuple[Array, Array]) -> tuple[Array, Array]:
        labels, _ = state
        lowest = jnp.min(jnp.where(reach, labels[None], m), axis=1)
        lowest = take(lowest, lowest)
        return lowest, jnp.any(lowest != labels)

    labels, _ = jax.lax.while_loop(lambda state: state[1], lower, (label, jnp.ones((), bool)))
    return labels


class Prune(AbstractMove):
    """Empty the components whose weight is below a share of the heaviest component's weight.

    Mixture weights are posterior odds (Vermaak et al. 2003, eq. 4). Resampling assigns every active
    component some slots, however small its odds; a pruned component releases its slots to the
    others. With M components, a step loses at most the share (M - 1) `least_share` of the weight,
    and Ẑ decreases by at most as much.

    - `group`: a function that returns the number of each particle's group, the same within a
      component, as for `Resample`. A component is then compared with the heaviest of its group:
      hypotheses about one of several objects, whose odds are their weights. None compares all.

    Raises `ValueError` for a share outside (0, 1). Use it after a propagation, before regrouping,
    if hypotheses that have become improbable occupy particles that others need.
    """

    least_share: InnerShare = eqx.field(static=True, default=1e-6)
    group: Groups | None = eqx.field(static=True, default=None)

    approximate = True
    """the mass of the pruned components is lost."""

    weighs = False
    """the observation changes no weight."""

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Set the weights of improbable components to zero, unless y_t is missing."""
        if now.is_missing:
            return mixture
        masses = mixture.log_mixture_weights
        heaviest = jnp.max(masses)
        if self.group is not None:
            groups = mixture.component_groups(self.group(mixture.particles))
            is_rival = groups[:, None] == groups[None]
            heaviest = jnp.max(jnp.where(is_rival, masses[None], -jnp.inf), axis=1)
        hopeless = masses < heaviest + jnp.log(self.least_share)
        dies = spread(hopeless, mixture.component_indicators)
        return mixture.replace(log_weights=jnp.where(dies, -jnp.inf, mixture.log_weights))


class Exclusion(AbstractPropagation, ByFeatures):
    """Lower the weights of particles near the predicted means of the other components.

        log-weight_i -= strength · Σ_{m ≠ c_i} exp(-|x_i - μ_m|² / (2 radius²))

    The sum is over active components. μ_m is the unweighted mean of the propagated particles of
    component m: the mean of its prediction if every step resamples. Distances are in units of
    `scale`; the repulsion is nearly 0 at three times the radius.

    - `group`: a function that returns the number of each particle's object, the same within a
      component, as for `Prune`. Components of one object are then rival hypotheses, which do not
      repel each other, and each is weighted by its share of its object's weight. None assigns a
      different object to each component.

    This is NOT part of the exact recursion of any paper here. Components interact as objects do in
    a Markov random field, but through their means instead of their states. The filtering
    distribution is then not that of the model, and the marginal likelihood is biased (`approximate`
    is true). Use it after `Propagate`, if each component represents an object, objects cannot share
    a position, and several components would otherwise end on one of several similar objects. Never
    use it if components are hypotheses about ONE object, unless `group` declares this.

    Raises `ValueError` for a strength or radius that is not positive.
    """

    strength: Positive = eqx.field(static=True, kw_only=True)
    radius: Positive = eqx.field(static=True, kw_only=True)
    group: Groups | None = eqx.field(static=True, default=None, kw_only=True)

    approximate = True
    """components interact in a way that the model does not have."""

    weighs = False
    """the observation changes no weight."""

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Lower the weight of every particle by its nearness to the means of other objects."""
        if mixture.num_components == 1 or now.is_missing:
            return mixture
        features, labels = self.features_of(mixture), mixture.component_indicators
        weights = mixture.occupied.astype(features.dtype)
        groups = summarise(features, weights, labels, mixture.num_components)
        objects, owners, shares = self._objects(mixture)
        total = jnp.zeros(mixture.num_particles, features.dtype)
        for m in range(mixture.num_components):
            square = jnp.sum((features - groups.means[m][None]) ** 2, axis=1)
            nearness = shares[m].astype(square.dtype) * jnp.exp(-square / (2 * self.radius**2))
            total += jnp.where((objects != owners[m]) & (groups.masses[m] > 0), nearness, 0.0)
        return mixture.reweight(-self.strength * total)

    def _objects(
        self, mixture: ParticleMixture
    ) -> tuple[Int[Array, " n"], Int[Array, " m"], Float[Array, " m"]]:
        """The object of each particle and component, and the component's share of its mass."""
        labels, m = mixture.component_indicators, mixture.num_components
        masses = mixture.log_mixture_weights
        if self.group is None:
            return labels, jnp.arange(m, dtype=labels.dtype), jnp.ones_like(masses)
        objects = self.group(mixture.particles)
        owners = mixture.component_groups(objects)
        of_object = jnp.where(owners[:, None] == owners[None], masses[None], -jnp.inf)
        shares = jnp.exp(masses - jax.nn.logsumexp(of_object, axis=1))
        return objects, owners, jnp.where(mixture.active, shares, 0.0)
