from mpfjax.metrics.particle_scores import crps as crps
from mpfjax.metrics.particle_scores import log_score as log_score
from mpfjax.metrics.set_distances import gospa as gospa
from mpfjax.metrics.set_distances import ospa as ospa
from mpfjax.metrics.set_distances import track_switches as track_switches
from mpfjax.metrics.tracking_scores import multi_object_scores as multi_object_scores
