from mpfjax.metrics.modes import mass_above as mass_above
from mpfjax.metrics.modes import modes_represented as modes_represented
from mpfjax.metrics.set_distances import GOSPA as GOSPA
from mpfjax.metrics.set_distances import gospa as gospa
from mpfjax.metrics.set_distances import ospa as ospa
from mpfjax.metrics.tracking_scores import multi_object_scores as multi_object_scores
from mpfjax.metrics.uniqueness import effective_dynamics as effective_dynamics
from mpfjax.metrics.uniqueness import uniqueness as uniqueness
