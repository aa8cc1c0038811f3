"""The motion that all objects have in common: the camera's."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mpfjax.vision.tracking.associate import argmax_pairs, mahalanobis
from mpfjax.vision.tracking.gaussian import Gaussian, zeros

_FREEDOM = 4.0  # degrees, of Student's distribution of what objects do on their own
_ROUNDS = 5
_RATE = 0.03  # of forgetting
_STILL = 0.02  # the deviation of the camera's motion before anything is known, in boxes
_LEAST, _MOST = 1e-3, 0.5
_LEADERS, _NEAREST = 8, 2  # whose detections, and how many of each, a jolt is sought by
_PRIOR = 5.0  # frames of many objects that the first deviation counts as


class CameraState(NamedTuple):
    """Standard deviations of the camera's motion along (x, y), in boxes.

    - `deviations`: of all of it; `left`: of what the pixels do not tell.
    - `weight`: how many frames of many objects they are the means of.
    """

    deviations: Float[Array, "2"]
    left: Float[Array, "2"]
    weight: Float[Array, ""]

    @classmethod
    def initial(cls) -> "CameraState":
        """A camera that is nearly still."""
        still = zeros(2) + np.float32(_STILL)
        return cls(still, still, zeros() + np.float32(_PRIOR))

    def after(
        self,
        predicted: Gaussian,
        gone: Float[Array, "#m 2"],
        known: Bool[Array, ""],
        cost: Float[Array, "m d"],
        errors: Float[Array, "4"],
        places: Float[Array, "d 4"],
        box: Float[Array, "2"],
    ) -> tuple["CameraState", Float[Array, "2"]]:
        """The shift that all objects have in common, and the deviations after it.

        A camera that shakes or turns shifts all objects at once. An object and a detection form a
        pair where each has its least cost, below 0, with the other. Pair m has an innovation e_m
        with variance S_m. The model is

            e_m = c + noise,  c ~ N(0, σ_c²)

        with heavy-tailed noise for objects that move on their own. The posterior mean of c is
        computed by iterated weighted least squares, with Student's weights. σ_c² is the mean
        product of the innovations of different objects: their own noises are independent. `gone`
        is by how much a jolt, or the motion from pixels, has moved each object: where the latter is
        `known`, c is what is left.
        """
        partner = argmax_pairs(jnp.maximum(-cost, 0.0))
        paired = (partner >= 0)[:, None]
        gaps = places[jnp.maximum(partner, 0), :2] - predicted.place[:, :2]
        gaps = jnp.where(paired, gaps, 0.0)
        variances = (predicted.var_place + (predicted.unit * errors[None]) ** 2)[:, :2]
        deviations = jnp.where(known, self.left, self.deviations)
        prior = (deviations * box) ** 2

        def improve(_: Int[Array, ""], shift: Float[Array, "2"]) -> Float[Array, "2"]:
            trust = (_FREEDOM + 1) / (_FREEDOM * variances + (gaps - shift[None]) ** 2)
            trust = jnp.where(paired, trust, 0.0)
            return jnp.sum(trust * gaps, axis=0) / (jnp.sum(trust, axis=0) + 1 / prior)

        shift = jax.lax.fori_loop(0, _ROUNDS, improve, jnp.zeros_like(prior))
        n = jnp.sum(paired, dtype=gaps.dtype)
        told = jnp.maximum(n - 1, 0.0) / (n + 3)  # two objects tell less than many
        weight = jnp.minimum(self.weight + told, 1 / _RATE)
        all_of_it = jnp.where(paired, gaps + gone, 0.0)
        deviations = _learned(self.deviations, all_of_it / box[None], n, told / weight)
        left = jnp.where(known, _learned(self.left, gaps / box[None], n, told / weight), self.left)
        return CameraState(deviations, left, weight), shift


def jolted(
    predicted: Gaussian,
    errors: Float[Array, "4"],
    places: Float[Array, "d 4"],
    unlike: Float[Array, "m d"],
    seen: Int[Array, " m"],
) -> Float[Array, "2"]:
    """The shift of a jolt that leaves most objects without a detection, zero if there was none.

    `unlike` is infinite where the two are no pair, and `seen` is 0 for what was not seen lately.
    Where at most half of the objects have a detection near them, the shifts that bring one of the
    eight longest seen to one of the two detections next to it are tried: a camera moves all by the
    same. The one that explains most counts, if that is three quarters of them, and two more than
    without it.
    """
    number = jnp.sum(seen > 0, dtype=jnp.int32)

    def explained(shift: Float[Array, "2"]) -> Int[Array, ""]:
        cost = mahalanobis(predicted.shifted(shift), errors, places) + unlike
        near = jnp.any(cost < 0, axis=1) & (seen > 0)
        return jnp.sum(near, dtype=jnp.int32)

    def tried() -> Float[Array, "2"]:
        leaders = jax.lax.top_k(seen, min(_LEADERS, len(seen)))[1]
        gaps = places[None, :, :2] - predicted.place[leaders, None, :2]
        far = jnp.sum((gaps / predicted.unit[leaders, None, :2]) ** 2, axis=2) + unlike[leaders]
        nearest = jax.lax.top_k(-far, min(_NEAREST, len(places)))[1]
        shifts = jnp.take_along_axis(gaps, nearest[..., None], axis=1).reshape(-1, 2)
        numbers = jax.vmap(explained)(shifts)
        best = jnp.argmax(numbers)
        found = (numbers[best] > still + 1) & (4 * numbers[best] >= 3 * number)
        return jnp.where(found, shifts[best], 0.0)

    zero = jnp.zeros(2, places.dtype)
    still = explained(zero)
    return jax.lax.cond(2 * still <= number, tried, lambda: zero)


def _learned(
    deviations: Float[Array, "2"], gaps: Float[Array, "m 2"], n: Array, rate: Array
) -> Float[Array, "2"]:
    """The deviations after a frame with n innovations, in boxes."""
    products = jnp.sum(gaps, axis=0) ** 2 - jnp.sum(gaps**2, axis=0)
    products = jnp.clip(products / jnp.maximum(n * (n - 1), 1.0), -(_MOST**2), _MOST**2)
    squares = (1 - rate) * deviations**2 + rate * products
    return jnp.sqrt(jnp.clip(squares, _LEAST**2, _MOST**2))
