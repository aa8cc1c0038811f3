"""The motion that all objects have in common: the camera's."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mpfjax.checks import check_positive, check_share
from mpfjax.mixture import ParticleMixture
from mpfjax.moves.base import AbstractMove
from mpfjax.operations.floats import default_float
from mpfjax.operations.indexing import take
from mpfjax.vision.tracking.assignment import Assign
from mpfjax.vision.tracking.memory import CAMERA, LIVES, SCORES, Camera, noises_of, remember
from mpfjax.vision.tracking.model import ObjectState, places_of, units
from mpfjax.vision.tracking.observation import CameraMotion, TrackedFrame

_ROUNDS = 5


class _Shift(NamedTuple):
    """The shift that objects have in common, in pixels.

    - `shift`, `variance`: its posterior mean and variance.
    - `paired`: which components have told of it; `box`: the median size of confirmed ones.
    """

    shift: Float[Array, "2"]
    variance: Float[Array, "2"]
    paired: Bool[Array, " m"]
    box: Float[Array, "2"]


class FollowCamera(AbstractMove):
    """Shift every component by the motion that all objects have in common.

    A camera that shakes or turns shifts all objects at once, independently of their velocities. A
    confirmed component and a strong detection form a pair where each has its least cost, by the
    costs of `assign`, with the other. Pair m has an innovation e_m with variance S_m. The model is

        e_m = c + noise,  c ~ N(0, σ_c²)

    with heavy-tailed noise for objects that move on their own. The posterior mean of the shift c is
    computed by iterated weighted least squares, with Student's weights of `freedom` degrees. σ_c,
    in median boxes, is learned with the forgetting rate `rate`: it tends to zero before a still
    camera.

    Where the frame's `motion` is known from pixels, every component is carried along by it first,
    and c is what is left. What is left has a σ_c of its own, learned in these frames, so that
    detections overrule pixels that prove wrong. In the other frames c is all of the motion.

    The weights do not change. Memory: the last shift, and both σ_c. Any motion that objects have in
    common is taken for the camera's (`approximate` is true). Raises `ValueError` for degrees of
    freedom that are not positive and for a rate outside [0, 1].
    """

    assign: Assign
    freedom: float = eqx.field(static=True, default=4.0)
    rate: float = eqx.field(static=True, default=0.03)

    def __check_init__(self) -> None:
        check_positive(freedom=self.freedom)
        check_share(rate=self.rate)

    @property
    def reads(self) -> frozenset[str]:
        """The memory that it needs of other moves."""
        return frozenset({LIVES, SCORES})

    @property
    def approximate(self) -> bool:
        """True: any common motion is taken for the camera's."""
        return True

    def initial_memory(self, num_components: int) -> dict[str, Camera]:
        """A camera that is nearly still."""
        del num_components
        still = jnp.full(2, 0.02, default_float())
        return {CAMERA: Camera(jnp.zeros(2), still, still)}

    def __call__(
        self, key: Key[Array, ""], mixture: ParticleMixture, observation: TrackedFrame
    ) -> ParticleMixture:
        """Move every component by the motion from pixels, estimate what is left, and add it."""
        del key
        camera: Camera = mixture.memory[CAMERA]
        motion, deviations, rest = observation.motion, camera.deviations, camera.left
        mixture, gone = _carried(mixture, motion)
        if motion is not None:
            deviations = jnp.where(motion.known, rest, deviations)
        left = self._left(mixture, observation, deviations)
        total = left.shift + _mean(gone, left.paired)
        if motion is not None:
            rest = jnp.where(motion.known, self._learned(rest, left.shift, left), rest)
        camera = Camera(left.shift, self._learned(camera.deviations, total, left), rest)
        particles = mixture.particles
        place = particles.place.at[:, :2].add(left.shift[None].astype(particles.place.dtype))
        moved = ObjectState(place, particles.velocity, particles.spread, particles.label)
        return remember(mixture.replace(particles=moved), camera=camera)

    def _left(
        self, mixture: ParticleMixture, observation: TrackedFrame, deviations: Float[Array, "2"]
    ) -> "_Shift":
        """The shift that the detections tell of, with these prior deviations, in median boxes."""
        model, noises = self.assign.model, noises_of(mixture, self.assign.model)
        moved = model.predicted(mixture.particles, noises)
        means = mixture.component_averages(moved.place)
        confirmed = mixture.memory[LIVES].confirmed
        number = jnp.maximum(jnp.sum(confirmed), 1)
        sizes = jnp.where(confirmed[:, None], jnp.exp(means[:, 2:]), jnp.inf)
        box = jnp.sort(sizes, axis=0)[(number - 1) // 2]
        box = jnp.where(jnp.isfinite(box), box, 1.0)
        cost = self.assign.costs(mixture, observation, slack=2 * deviations * box)
        strong = observation.detections.scores >= mixture.memory[SCORES].strong
        cost = jnp.where(confirmed[:, None] & strong[None], cost, jnp.inf)
        paired, partner = _mutual(cost, self.assign.gate)
        gaps = take(places_of(observation.detections.boxes), partner)[:, :2] - means[:, :2]
        spread = mixture.component_averages(moved.spread[:, 0, :2])
        variances = spread + (units(means) * noises.errors[None])[:, :2] ** 2
        shift, posterior = self._common(gaps, variances, paired, (deviations * box) ** 2)
        return _Shift(shift, posterior, paired, box)

    def _learned(
        self, deviations: Float[Array, "2"], shift: Float[Array, "2"], left: "_Shift"
    ) -> Float[Array, "2"]:
        """The deviations after a frame with this shift."""
        squares = jnp.clip((shift**2 + left.variance) / left.box**2, 1e-6, 0.25)
        squares = (1 - self.rate) * deviations**2 + self.rate * squares
        return jnp.where(jnp.any(left.paired), jnp.sqrt(squares), deviations)

    def _common(
        self,
        gaps: Float[Array, "m 2"],
        variances: Float[Array, "m 2"],
        paired: Bool[Array, " m"],
        prior: Float[Array, "2"],
    ) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """The posterior mean and variance of the shift that the innovations have in common."""
        variances = jnp.where(paired[:, None], variances, 1.0)
        gaps = jnp.where(paired[:, None], gaps, 0.0)

        def weights(shift: Float[Array, "2"]) -> Float[Array, "m 2"]:
            squares = (gaps - shift[None]) ** 2 / variances
            trust = (self.freedom + 1) / (self.freedom + squares) / variances
            return jnp.where(paired[:, None], trust, 0.0)

        def improve(_: Int[Array, ""], shift: Float[Array, "2"]) -> Float[Array, "2"]:
            trust = weights(shift)
            return jnp.sum(trust * gaps, axis=0) / (jnp.sum(trust, axis=0) + 1 / prior)

        shift = jax.lax.fori_loop(0, _ROUNDS, improve, jnp.zeros_like(prior))
        return shift, 1 / (jnp.sum(weights(shift), axis=0) + 1 / prior)


def _carried(
    mixture: ParticleMixture, motion: CameraMotion | None
) -> tuple[ParticleMixture, Float[Array, "m 2"]]:
    """The components moved by the motion from pixels, and by how much each."""
    before = mixture.component_averages(mixture.particles.place)
    if motion is None:
        return mixture, jnp.zeros_like(before[:, :2])
    carried = motion.carried(mixture.particles.gaussian)
    mixture = mixture.replace(particles=ObjectState.of(carried, mixture.particles.label))
    return mixture, (mixture.component_averages(mixture.particles.place) - before)[:, :2]


def _mean(rows: Float[Array, "m 2"], chosen: Bool[Array, " m"]) -> Float[Array, "2"]:
    """The mean of the chosen rows, 0 where there are none."""
    number = jnp.maximum(jnp.sum(chosen), 1).astype(rows.dtype)
    return jnp.sum(jnp.where(chosen[:, None], rows, 0.0), axis=0) / number


def _mutual(cost: Float[Array, "m d"], gate: float) -> tuple[Bool[Array, " m"], Int[Array, " m"]]:
    """Rows and columns that are each other's cheapest: whether each row has one, and its column."""
    partner = jnp.argmin(cost, axis=1).astype(jnp.int32)
    cheapest = jnp.min(cost, axis=1)
    column = take(jnp.argmin(cost, axis=0).astype(jnp.int32), partner)
    return (cheapest < gate) & (column == jnp.arange(len(cost))), partner
