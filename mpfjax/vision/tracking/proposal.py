"""The proposal that knows the detection: for one detection an object, the best there is."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from mpfjax.checks import check_shape, check_type
from mpfjax.operations.generator import fast_key
from mpfjax.operations.indexing import take
from mpfjax.operations.matrices import row_sums
from mpfjax.proposals import AbstractProposal
from mpfjax.vision.tracking.model import (
    AssignedFrame,
    DetectedObjectModel,
    ObjectState,
    log_normal,
)


class DetectionProposal(AbstractProposal):
    """Draw places from p(x_t | x_{t-1}, d), the posterior given an object's own detection.

    The likelihood of a `DetectedObjectModel` is a Gaussian bump over a floor, so that the posterior
    of a place is a mixture of two: with probability Z / (Z + floor) the product of prediction and
    bump, otherwise the prediction, where Z is the integral of their product and the floor is the
    model's `miss` and the object's doubt. Without colours the
    weights L D / q are Z + floor, whatever is drawn: this is the optimal proposal (Doucet,
    Godsill and Andrieu 2000). The velocity is drawn given the place, as in D. Where an object has
    no detection q is D.
    """

    model: DetectedObjectModel

    def __check_init__(self) -> None:
        check_type(DetectedObjectModel, "a DetectedObjectModel", model=self.model)

    def propose(
        self, key: Key[Array, ""], observation: AssignedFrame, previous_states: ObjectState
    ) -> tuple[ObjectState, Float[Array, " n"]]:
        """x_t from the mixture, and its log density."""
        key_noise, key_which, key_velocity = jax.random.split(fast_key(key), 3)
        n, dtype = previous_states.place.shape[0], previous_states.place.dtype
        noise = jax.random.normal(key_noise, (n, 4), dtype)
        which = jax.random.uniform(key_which, (n,), dtype)
        velocity = jax.random.normal(key_velocity, (n, 2), dtype)
        return self._drawn(noise, which, velocity, observation, previous_states)

    def noise_dimension(self, previous_states: ObjectState) -> int:
        """Four numbers for the place, one for its part of the mixture, two for the velocity."""
        del previous_states
        return 7

    def propose_from_noise(
        self, noise: Float[Array, "n 7"], observation: AssignedFrame, previous_states: ObjectState
    ) -> tuple[ObjectState, Float[Array, " n"]]:
        """The same, made of standard normal noise."""
        check_shape("n 7", noise=noise)
        which = jax.scipy.special.ndtr(noise[:, 4])
        return self._drawn(noise[:, :4], which, noise[:, 5:], observation, previous_states)

    def _drawn(
        self,
        noise: Float[Array, "n 4"],
        which: Float[Array, " n"],
        velocity: Float[Array, "n 2"],
        observation: AssignedFrame,
        previous_states: ObjectState,
    ) -> tuple[ObjectState, Float[Array, " n"]]:
        """x_t and its log density; `which` is uniform."""
        mean, deviations = self.model.predicted(previous_states)
        places, errors = self.model.detection_of(observation, previous_states)
        floor = self.model.miss + take(observation.doubts, previous_states.label)
        share = self._share(places - mean, deviations, errors, floor)
        gain = deviations**2 / (deviations**2 + errors**2)
        posterior_mean = mean + gain * (places - mean)
        posterior_deviations = deviations * jnp.sqrt(1 - gain)
        from_posterior = which < share
        place = jnp.where(
            from_posterior[:, None],
            posterior_mean + posterior_deviations * noise,
            mean + deviations * noise,
        )
        states = self.model.with_velocity(velocity, previous_states, place)
        log_place = jnp.logaddexp(
            jnp.log(share) + log_normal(place, posterior_mean, posterior_deviations),
            jnp.log1p(-share) + log_normal(place, mean, deviations),
        )
        return states, log_place + self.model.log_velocity(states, previous_states)

    def _share(
        self,
        gaps: Float[Array, "n 4"],
        deviations: Float[Array, "n 4"],
        errors: Float[Array, "n 4"],
        floor: Float[Array, " n"],
    ) -> Float[Array, " n"]:
        """Z / (Z + floor), with Z = Π_k N(d_k; ...) relative to the bump's height of one."""
        total = deviations**2 + errors**2
        detected = jnp.isfinite(errors[:, 0])
        shrinkage = jnp.where(detected[:, None], jnp.log(errors**2 / total), 0.0)
        log_z = row_sums(0.5 * shrinkage - 0.5 * gaps**2 / total)
        odds = log_z - jnp.log(floor.astype(log_z.dtype))
        # Shares of exactly one would make a log density of zero times infinity.
        return jnp.where(detected, jnp.clip(jax.nn.sigmoid(odds), 1e-6, 1 - 1e-6), 0.0)
