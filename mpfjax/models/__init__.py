"""State-space models: the interface, and the models that ship with the library."""

from mpfjax.models.base import AbstractStateSpaceModel as AbstractStateSpaceModel
from mpfjax.models.base import per_particle as per_particle
from mpfjax.models.linear_gaussian import LinearGaussianModel as LinearGaussianModel
from mpfjax.models.quadratic import QuadraticModel as QuadraticModel
