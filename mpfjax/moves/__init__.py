"""The moves that filters are chains of: regrouping, rejuvenating, propagating."""

from mpfjax.moves.base import AbstractMove as AbstractMove
from mpfjax.moves.base import AbstractPropagation as AbstractPropagation
from mpfjax.moves.base import AbstractRegrouping as AbstractRegrouping
from mpfjax.moves.base import AbstractRejuvenation as AbstractRejuvenation
from mpfjax.moves.clusters import PropagateInClusters as PropagateInClusters
from mpfjax.moves.every import Every as Every
from mpfjax.moves.exchange import Exchange as Exchange
from mpfjax.moves.exclusion import Exclusion as Exclusion
from mpfjax.moves.families import PropagateFamilies as PropagateFamilies
from mpfjax.moves.features import Features as Features
from mpfjax.moves.gaussian import GaussianRegeneration as GaussianRegeneration
from mpfjax.moves.group_by import GroupBy as GroupBy
from mpfjax.moves.independent import PropagateIndependently as PropagateIndependently
from mpfjax.moves.kmeans import KMeans as KMeans
from mpfjax.moves.lookahead import ResampleAhead as ResampleAhead
from mpfjax.moves.merge import Merge as Merge
from mpfjax.moves.partitioned import Partitioned as Partitioned
from mpfjax.moves.pool import Pool as Pool
from mpfjax.moves.propagation import Predict as Predict
from mpfjax.moves.propagation import Propagate as Propagate
from mpfjax.moves.propagation import Weigh as Weigh
from mpfjax.moves.prune import Prune as Prune
from mpfjax.moves.random_partition import RandomPartition as RandomPartition
from mpfjax.moves.resampling import Resample as Resample
from mpfjax.moves.split import Split as Split
from mpfjax.moves.stages import PropagateInStages as PropagateInStages
