"""The proposal that knows the detection: for one detection an object, the best there is."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from mpfjax.checks import check_type
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
        mean, deviations = self.model.predicted(previous_states)
        places, errors = self.model.detection_of(observation, previous_states)
        floor = self.model.miss + take(observation.doubts, previous_states.label)
        share = self._share(places - mean, deviations, errors, floor)
        gain = deviations**2 / (deviations**2 + errors**2)
        posterior_mean = mean + gain * (places - mean)
        posterior_deviations = deviations * jnp.sqrt(1 - gain)
        from_posterior = jax.random.uniform(key_which, share.shape, share.dtype) < share
        noise = jax.random.normal(key_noise, mean.shape, mean.dtype)
        place = jnp.where(
            from_posterior[:, None],
            posterior_mean + posterior_deviations * noise,
            mean + deviations * noise,
        )
        states = self.model.with_velocity(key_velocity, previous_states, place)
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
