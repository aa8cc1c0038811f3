from mpfjax.metrics.modes import mass_above as mass_above
from mpfjax.metrics.modes import modes_represented as modes_represented
