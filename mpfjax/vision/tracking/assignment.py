"""Which detection is whose: the likeliest for all together, and how sure that is for each."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key
from optax.assignment import hungarian_algorithm

from mpfjax.checks import check_finite, check_not_negative, check_positive
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.indexing import take
from mpfjax.vision.colour.histograms import bhattacharyya
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.memory import (
    ASSIGNED,
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
_UNDECIDED = 0.25  # B² of colours that speak neither for an object nor against it
_ROUNDS = 15  # of messages; where two components compete for two detections fewer are enough
_LEAST = 1e-3  # a marginal below this counts as this
_SMALL = 10.0  # log odds of which float32 keeps a thousandth of 1 beside the odds


class Assign(AbstractMove):
    """Give every component at most one detection, and every detection to at most one component.

    The assignment of the least total cost (Kuhn 1955). Component m and detection d cost
    -2 log p(d | m), up to a constant, where p is Student's density with `freedom` degrees and
    lengths count in boxes: (ν + 4) log(1 + |d - μ_m|² / ν) + log |S_m|, with μ_m and S_m the
    moments of the component's prediction and of the detector's error. To this come `colour_cost`
    times B² - 1/4, where B² is the mean of the detection's colours from the component's,
    `weak_cost` for a weak detection, and `doubt_cost` for a component that is not yet confirmed.
    No detection costs `gate`. So a component rather gets none than one that costs more, which is
    rather that of a newcomer, above all where the component has been unseen for long; and objects
    that meet are settled together.

    How sure a component can be of its detection is the pair's probability in the joint distribution
    of all assignments, p ∝ Π exp((gate - cost) / 2T) over its pairs, by `marginals`. The
    `temperature` T, above 1, allows for cues that are not as independent as they are taken for.
    With p_m that of the chosen pair, the posterior of joint probabilistic data association
    (Fortmann, Bar-Shalom and Scheffe 1983) is that of the pair with weight p_m and the prediction
    otherwise: of two in contact, who cannot tell whose a detection is follows it less.

    It leaves the particles as they are; memory: the row of each component's detection, -1 for none,
    and the doubts, 1 - p_m.

    One assignment stands for all that there are (`approximate` is true). Raises `ValueError` for a
    gate that is not finite, a temperature or degrees that are not positive, a cost below zero.
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
        """True: the likeliest assignment is taken for the only one."""
        return True

    def initial_memory(self, num_components: int) -> dict[str, Array]:
        """Nobody has a detection."""
        nothing = jnp.full(num_components, _NONE, jnp.int32)
        return {ASSIGNED: nothing, DOUBTS: jnp.zeros(num_components)}

    def forget(self, memory: dict, dead: Array) -> dict:
        """The dead have none."""
        return memory | {
            ASSIGNED: jnp.where(dead, _NONE, memory[ASSIGNED]),
            DOUBTS: jnp.where(dead, 0.0, memory[DOUBTS]),
        }

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Settle whose each detection is."""
        del key
        cost = self.costs(mixture, observation)
        # A column of its own for each component that gets none.
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
        """What each pair costs, or a number beyond all costs where it is impossible.

        `slack`: further standard deviations of x and y, in pixels, that all predictions have.
        """
        found, lives = observation.detections, mixture.memory[LIVES]
        scores = mixture.memory[SCORES]
        squares, volumes = self._distances(mixture, found.boxes, slack)
        tails = (self.freedom + _DIMENSIONS) * jnp.log1p(squares / self.freedom)
        cost = tails + volumes[:, None] + self._unlikeness(mixture, observation)
        cost += self.weak_cost * (found.scores < scores.strong)[None].astype(cost.dtype)
        doubtful = ~lives.confirmed[:, None]
        cost += self.doubt_cost * doubtful.astype(cost.dtype)
        counts = found.valid & (found.scores >= scores.weak)
        possible = lives.alive[:, None] & counts[None] & (cost < self.gate)
        return jnp.where(possible, cost, _IMPOSSIBLE)

    def _distances(
        self,
        mixture: ParticleMixture,
        boxes: Float[Array, "d 4"],
        slack: Float[Array, "2"] | None,
    ) -> tuple[Float[Array, "m d"], Float[Array, " m"]]:
        """Squared distance of each detection in deviations of the prediction, and log |S_m|.

        Coordinates are taken for independent.
        """
        noises = noises_of(mixture, self.model)
        moved = self.model.predicted(mixture.particles, noises)
        means = mixture.component_averages(moved.place)
        # About the mean, or rounding would drown the spread of a box at a thousand pixels.
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
    """The probability of each pair where no row and no column is in more than one.

    An assignment has the weight Π exp(log_odds) over its pairs; a row or column in none counts 1.
    The marginals of that joint distribution by messages from rows to columns and back (loopy belief
    propagation, Williams and Lau 2014): exact where the possible pairs form no loop. Otherwise they
    are too sure. With log odds up to 5 that is .02 in the mean
    over random problems of up to six by six, and up to .3 where two rows and two columns all go
    together: for log odds of 5, 4.3, 4.3 and 4.3 it gives .88, and the marginal is .63. With log
    odds without a bound it is up to a half.
    """
    small = jnp.max(log_odds, initial=0.0) < _SMALL
    return jax.lax.cond(small, _marginals_of_odds, _marginals_of_logs, log_odds)


def _marginals_of_odds(log_odds: Float[Array, "m d"]) -> Float[Array, "m d"]:
    """A tenth of the time of `_marginals_of_logs`; large odds would drown the 1 of no pair."""
    odds = jnp.exp(log_odds)

    def reply(_: Int[Array, ""], back: Float[Array, "m d"]) -> Float[Array, "m d"]:
        weighed = odds * back
        forth = odds / (1 + jnp.sum(weighed, axis=1, keepdims=True) - weighed)
        return 1 / (1 + jnp.sum(forth, axis=0, keepdims=True) - forth)

    weighed = odds * jax.lax.fori_loop(0, _ROUNDS, reply, jnp.ones_like(odds))
    return weighed / (1 + jnp.sum(weighed, axis=1, keepdims=True))


def _marginals_of_logs(log_odds: Float[Array, "m d"]) -> Float[Array, "m d"]:
    """The same messages by their logarithms, for odds of any size."""

    def reply(_: Int[Array, ""], back: Float[Array, "m d"]) -> Float[Array, "m d"]:
        return -_others(log_odds - _others(log_odds + back, axis=1), axis=0)

    back = jax.lax.fori_loop(0, _ROUNDS, reply, jnp.zeros_like(log_odds))
    weighed = log_odds + back
    return jnp.exp(weighed - jnp.logaddexp(weighed, _others(weighed, axis=1)))


def _others(logs: Float[Array, "m d"], axis: int) -> Float[Array, "m d"]:
    """log(1 + the sum of the exponentials of all others along an axis), for each.

    Nothing large is subtracted from what it is part of: the highest one's others are summed anew.
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
    """The detection of each component, not valid where it has none."""
    rows = jnp.maximum(source, 0)
    return Detections(take(detections.boxes, rows), source >= 0, take(detections.scores, rows))
