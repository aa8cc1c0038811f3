"""Propagation of a conditionally linear model: a draw of z_t, and moments of x_t."""

from mpfjax.checks import check
from mpfjax.models.conditionally_linear import AbstractConditionallyLinearModel
from mpfjax.moves.base import AbstractPropagationOfEach, Step
from mpfjax.moves.propagation.propagate import Draw


class PropagateMarginalised(Draw, AbstractPropagationOfEach):
    """Draw z_t, predict, weight by the predictive density of y_t, and update by it.

    The step of a Rao-Blackwellised particle filter, or mixture Kalman filter (Chen and Liu 2000;
    Doucet, de Freitas, Murphy and Russell 2000), for an `AbstractConditionallyLinearModel`. Each
    particle (z, m, P) draws z_t, and its Kalman filter predicts x_t. The weight is multiplied by

        p(y_t | z_0, ..., z_t, y_1..y_{t-1}) = N(y_t; H m + c, H P Hᵀ + R)

    and by the likelihood of observations of z_t alone. Then the Kalman filter is updated. Mixture
    weights follow from the joint weights as in `Propagate`, and Ẑ is unbiased. In the mixed form,
    z_t is drawn from its distribution given y_1..y_{t-1}, N(f + A m, A P Aᵀ + V), and first updates
    x_{t-1}. The covariance is updated in Joseph's form, which keeps it positive in float32.

    - `proposal`: z_t ~ q instead of the model's transition, such as `RegimeProposal()`. An
      `AbstractProposal` whose `propose(key, now, particles)` receives the particles (latent, mean,
      covariance) of t - 1, and returns z_t and log q. The factor is then p(y_t | ...) p(z_t) / q.
    - `gradient`, `noise`: as in `Propagate`, for the draw of z_t. Moments are differentiated.

    Without an observation z_t is drawn from its transition, and moments are predicted. Raises
    `ValueError` for another model, and as `Propagate` does. `particle_filter`,
    `mixture_particle_filter` and `auxiliary_particle_filter` use it for such a model.
    """

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for another model, and as `Propagate` does."""
        check(AbstractConditionallyLinearModel, model=now.model)
        super().check(now, num_particles, num_components)
