"""Data association: the most probable assignment, and the probability of each of its pairs."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from mpfjax.checks import check_finite, check_not_negative, check_positive
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.indexing import take
from mpfjax.vision.colour.histograms import bhattacharyya
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.memory import (
    ASSIGNED,
    DOUBLES,
    DOUBTS,
    LIVES,
    REFERENCES,
    SCORES,
    noises_of,
    remember,
)
from mpfjax.vision.tracking.model import DetectedObjectModel, places_of, units
from mpfjax.vision.tracking.observation import TrackedFrame

_NONE, _IMPOSSIBLE = -1, 1e4
_DIMENSIONS = 4
_WIDEST = -0.5  # log |S| counts as at most this: a detection at the prediction forms a pair
_UNDECIDED = 0.25  # B² at which colours are evidence neither for nor against a pair
_ROUNDS = 15  # iterations of messages; fewer suffice where two rows compete for two columns
_LEAST = 1e-3  # marginals are at least this
_YIELDING = 0.01  # of the gain of a pair, where the component takes only what others leave
_SMALL = 10.0  # log odds at which float32 still resolves a thousandth of 1 added to the odds


class Assign(AbstractMove):
    """Assign at most one detection to each component, and each detection to at most one component.

    The assignment has the least total cost (Kuhn 1955). The cost of component m and detection d is
    -2 log p(d | m), up to a constant. Here p is Student's density with ν = `freedom` degrees of
    freedom, and lengths are in units of the box:

        cost(m, d) = (ν + 4) log(1 + |d - μ_m|² / ν) + log |S_m|

    where μ_m and S_m are the mean and covariance of the predicted detection. To this are added
    `colour_cost` times (B² - 1/4), where B² is the mean squared Bhattacharyya distance between the
    colours of the detection and those of the component; `weak_cost` for a weak detection; and
    `doubt_cost` for a component that is not yet confirmed. A component without a detection costs
    `gate`, so that no pair with a higher cost is formed: its detection more probably belongs to a
    new object. Because of log |S_m| this happens more often to components that have been unseen for
    long; it counts as at most -1/2, so that a detection at the very prediction forms a pair. For a
    component that is more probably a double (`LearnDoubles`), gate - cost is divided by a hundred:
    it takes a detection only from what the others leave, adds little to their doubts, and follows
    its own detection by half.

    The probability of a pair under the joint distribution of all assignments, p ∝ Π exp((gate -
    cost) / 2T) over the pairs of an assignment, is computed by `marginals`. A `temperature` T above
    1 allows for cues that are not independent. With p_m the probability of the chosen pair, the
    posterior of joint probabilistic data association (Fortmann, Bar-Shalom and Scheffe 1983)
    follows the pair with weight p_m and the prediction with weight 1 - p_m: where two objects are
    in contact and the association is ambiguous, a component follows its detection less.

    The particles do not change. Memory: the index of each component's detection, -1 for none, and
    the doubts, 1 - p_m.

    A single assignment stands for all possible ones (`approximate` is true). Raises `ValueError`
    for a gate that is not finite, for a temperature or degrees of freedom that are not positive,
    and for a cost below zero.
    """

    model: DetectedObjectModel
    gate: float = eqx.field(static=True, default=0.0)
    freedom: float = eqx.field(static=True, default=4.0)
    colour_cost: float = eqx.field(static=True, default=14.0)
    weak_cost: float = eqx.field(static=True, default=8.0)
    doubt_cost: float = eqx.field(static=True, default=2.0)
    temperature: float = eqx.field(static=True, default=2.0)

    def __check_init__(self) -> None:
        check_finite(gate=self.gate)
        check_positive(freedom=self.freedom, temperature=self.temperature)
        check_not_negative(
            colour_cost=self.colour_cost, weak_cost=self.weak_cost, doubt_cost=self.doubt_cost
        )

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({SCORES, LIVES})

    @property
    def approximate(self) -> bool:
        """True: the most probable assignment is taken for the only one."""
        return True

    def initial_memory(self, num_components: int) -> dict[str, Array]:
        """No component has a detection."""
        nothing = jnp.full(num_components, _NONE, jnp.int32)
        return {ASSIGNED: nothing, DOUBTS: jnp.zeros(num_components)}

    def forget(self, memory: dict, dead: Array) -> dict:
        """Dead components have no detection."""
        return memory | {
            ASSIGNED: jnp.where(dead, _NONE, memory[ASSIGNED]),
            DOUBTS: jnp.where(dead, 0.0, memory[DOUBTS]),
        }

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Assign the detections of this frame."""
        from optax.assignment import hungarian_algorithm  # kept programs start without optax

        del key
        cost = self.costs(mixture, observation)
        # Each component has one more column of its own, for no detection.
        none = jnp.where(jnp.eye(len(cost), dtype=bool), self.gate, _IMPOSSIBLE)
        rows, columns = hungarian_algorithm(
            jnp.concatenate([cost, none.astype(cost.dtype)], axis=1)
        )
        source = jnp.full(mixture.num_components, _NONE, jnp.int32)
        chosen = jnp.where(columns < cost.shape[1], columns.astype(jnp.int32), _NONE)
        source = source.at[rows].set(chosen)
        doubts = self._doubts(source, cost)
        return remember(mixture, assigned=source, doubts=doubts)

    def _doubts(
        self,
        source: Int[Array, " m"],
        cost: Float[Array, "m d"],
    ) -> Float[Array, " m"]:
        """1 - p_m of the chosen pairs, and 0 where there is none."""
        log_odds = jnp.where(
            cost < _IMPOSSIBLE, (self.gate - cost) / (2 * self.temperature), -jnp.inf
        )
        chosen = jnp.maximum(source, 0)[:, None]
        probability = jnp.take_along_axis(marginals(log_odds), chosen, axis=1)[:, 0]
        doubts = 1 - jnp.clip(probability, _LEAST, 1.0)
        return jnp.where(source >= 0, doubts, 0.0)

    def costs(
        self,
        mixture: ParticleMixture,
        observation: TrackedFrame,
        slack: Float[Array, "2"] | None = None,
    ) -> Float[Array, "m d"]:
        """The cost of each pair, or a number above all costs where the pair is impossible.

        `slack`: standard deviations of x and y, in pixels, to be added to those of all predictions.
        """
        found, lives = observation.detections, mixture.memory[LIVES]
        scores = mixture.memory[SCORES]
        squares, volumes = self._distances(mixture, found.boxes, slack)
        tails = (self.freedom + _DIMENSIONS) * jnp.log1p(squares / self.freedom)
        cost = (
            tails + jnp.minimum(volumes, _WIDEST)[:, None] + self._unlikeness(mixture, observation)
        )
        cost += self.weak_cost * (found.scores < scores.strong)[None].astype(cost.dtype)
        doubtful = ~lives.confirmed[:, None]
        cost += self.doubt_cost * doubtful.astype(cost.dtype)
        counts = found.valid & (found.scores >= scores.weak)
        possible = lives.alive[:, None] & counts[None] & (cost < self.gate)
        if DOUBLES in mixture.memory:
            yielding = mixture.memory[DOUBLES].doubtful[:, None]
            cost = jnp.where(yielding, self.gate - _YIELDING * (self.gate - cost), cost)
        return jnp.where(possible, cost, _IMPOSSIBLE)

    def _distances(
        self,
        mixture: ParticleMixture,
        boxes: Float[Array, "d 4"],
        slack: Float[Array, "2"] | None,
    ) -> tuple[Float[Array, "m d"], Float[Array, " m"]]:
        """Squared Mahalanobis distance of each detection from each prediction, and log |S_m|.

        Coordinates are treated as independent.
        """
        noises = noises_of(mixture, self.model)
        moved = self.model.predicted(mixture.particles, noises)
        means = mixture.component_averages(moved.place)
        # Centred first: the spread of a box a thousand pixels from the origin is lost to rounding.
        offsets = moved.place - take(means, mixture.component_indicators)
        variances = mixture.component_averages(offsets**2 + moved.gaussian.var_place)
        unit = units(means)
        total = variances + (unit * noises.errors[None]) ** 2
        if slack is not None:
            total = total + jnp.pad(slack, (0, 2))[None] ** 2
        gaps = places_of(boxes)[None] - means[:, None]
        squares = jnp.sum(gaps**2 / total[:, None], axis=2)
        return squares, jnp.sum(jnp.log(total / unit**2), axis=1)

    def _unlikeness(
        self, mixture: ParticleMixture, observation: TrackedFrame
    ) -> Float[Array, "m d"]:
        references = mixture.memory.get(REFERENCES)
        if observation.pixels is None or references is None or self.colour_cost == 0:
            return jnp.zeros((mixture.num_components, len(observation.detections.boxes)))
        seen = observation.detected_colours(references.shape[1])
        distances = bhattacharyya(seen[None], references[:, None])
        known = jnp.any(references > 0, axis=(1, 2, 3))[:, None]
        unlike = jnp.mean(jnp.sum(distances, axis=3), axis=2) - _UNDECIDED
        return self.colour_cost * jnp.where(known, unlike, 0.0)


def marginals(log_odds: Float[Array, "m d"]) -> Float[Array, "m d"]:
    """The probability of each pair, where each row and each column is in at most one pair.

    An assignment has the weight Π exp(log_odds) over its pairs; a row or column without a pair
    contributes a factor of 1. The marginals of this joint distribution are computed by loopy belief
    propagation with messages from rows to columns and back (Williams and Lau 2014). They are exact
    where the possible pairs form no cycle. Otherwise they are overconfident. With log odds up to 5
    the mean error is .02 over random problems of up to six by six. The error is up to .3 where each
    of two rows can go with each of two columns: for log odds of 5, 4.3, 4.3 and 4.3 the result is
    .88, and the exact marginal is .63. With unbounded log odds the error is up to a half.
    """
    small = jnp.max(log_odds, initial=0.0) < _SMALL
    return jax.lax.cond(small, _marginals_of_odds, _marginals_of_logs, log_odds)


def _marginals_of_odds(log_odds: Float[Array, "m d"]) -> Float[Array, "m d"]:
    """The messages as odds, in a tenth of the time of `_marginals_of_logs`, for moderate odds."""
    odds = jnp.exp(log_odds)

    def reply(_: Int[Array, ""], back: Float[Array, "m d"]) -> Float[Array, "m d"]:
        weighed = odds * back
        forth = odds / (1 + jnp.sum(weighed, axis=1, keepdims=True) - weighed)
        return 1 / (1 + jnp.sum(forth, axis=0, keepdims=True) - forth)

    weighed = odds * jax.lax.fori_loop(0, _ROUNDS, reply, jnp.ones_like(odds))
    return weighed / (1 + jnp.sum(weighed, axis=1, keepdims=True))


def _marginals_of_logs(log_odds: Float[Array, "m d"]) -> Float[Array, "m d"]:
    """The same messages as logarithms, for odds of any size."""

    def reply(_: Int[Array, ""], back: Float[Array, "m d"]) -> Float[Array, "m d"]:
        return -_others(log_odds - _others(log_odds + back, axis=1), axis=0)

    back = jax.lax.fori_loop(0, _ROUNDS, reply, jnp.zeros_like(log_odds))
    weighed = log_odds + back
    return jnp.exp(weighed - jnp.logaddexp(weighed, _others(weighed, axis=1)))


def _others(logs: Float[Array, "m d"], axis: int) -> Float[Array, "m d"]:
    """log(1 + the sum of the exponentials of all others along an axis), for each.

    The sum without the largest entry is computed anew, since subtracting it would cancel.
    """
    first = jnp.argmax(logs, axis=axis, keepdims=True)
    others = jnp.arange(logs.shape[axis]).reshape((1, -1) if axis == 1 else (-1, 1)) != first
    highest = jnp.maximum(jnp.max(logs, axis=axis, keepdims=True), 0.0)
    second = jnp.max(jnp.where(others, logs, 0.0), axis=axis, keepdims=True, initial=0.0)
    low = jnp.exp(-second) + jnp.sum(
        jnp.where(others, jnp.exp(logs - second), 0.0), axis=axis, keepdims=True
    )
    shares = jnp.exp(logs - highest)
    high = jnp.exp(-highest) + jnp.sum(shares, axis=axis, keepdims=True) - shares
    return jnp.where(others, highest + jnp.log(jnp.where(others, high, 1.0)), second + jnp.log(low))


def own_detections(source: Int[Array, " m"], detections: Detections) -> Detections:
    """The detection of each component; not valid for a component that has none."""
    rows = jnp.maximum(source, 0)
    return Detections(take(detections.boxes, rows), source >= 0, take(detections.scores, rows))
