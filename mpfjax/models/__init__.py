"""State-space models: the interface, and the models that ship with the library."""

from mpfjax.models.base import AbstractStateSpaceModel as AbstractStateSpaceModel
from mpfjax.models.base import per_particle as per_particle
from mpfjax.models.conditionally_linear import (
    AbstractConditionallyLinearModel as AbstractConditionallyLinearModel,
)
from mpfjax.models.dynamics import AbstractDynamics as AbstractDynamics
from mpfjax.models.dynamics import Autoregression as Autoregression
from mpfjax.models.dynamics import RandomWalk as RandomWalk
from mpfjax.models.interaction import PairwiseRepulsion as PairwiseRepulsion
from mpfjax.models.jumps import RandomWalkWithJumps as RandomWalkWithJumps
from mpfjax.models.linear_gaussian import LinearGaussianModel as LinearGaussianModel
from mpfjax.models.multi_object import MultiObjectModel as MultiObjectModel
from mpfjax.models.quadratic import QuadraticModel as QuadraticModel
from mpfjax.models.switching import (
    SwitchingLinearGaussianModel as SwitchingLinearGaussianModel,
)
from mpfjax.models.trial import check_model as check_model
from mpfjax.models.velocity import WalkWithVelocity as WalkWithVelocity
