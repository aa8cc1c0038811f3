"""mpfjax: particle filters that keep many hypotheses alive, in JAX."""

import importlib as _importlib
from typing import TYPE_CHECKING

from mpfjax.filter import Filter as Filter
from mpfjax.filters import auxiliary_particle_filter as auxiliary_particle_filter
from mpfjax.filters import bernoulli_filter as bernoulli_filter
from mpfjax.filters import clustered_particle_filter as clustered_particle_filter
from mpfjax.filters import distributed_partitioned_sampling as distributed_partitioned_sampling
from mpfjax.filters import gaussian_mixture_particle_filter as gaussian_mixture_particle_filter
from mpfjax.filters import gaussian_particle_filter as gaussian_particle_filter
from mpfjax.filters import independent_particle_filters as independent_particle_filters
from mpfjax.filters import mixture_particle_filter as mixture_particle_filter
from mpfjax.filters import particle_filter as particle_filter
from mpfjax.filters import partitioned_sampling as partitioned_sampling
from mpfjax.mixture import ParticleMixture as ParticleMixture
from mpfjax.models.base import AbstractStateSpaceModel as AbstractStateSpaceModel
from mpfjax.models.base import per_particle as per_particle
from mpfjax.models.births import AbstractBirth as AbstractBirth
from mpfjax.models.births import Box as Box
from mpfjax.models.births import Disc as Disc
from mpfjax.models.births import UniformBirth as UniformBirth
from mpfjax.models.clutter import ClutteredModel as ClutteredModel
from mpfjax.models.conditionally_linear import (
    AbstractConditionallyLinearModel as AbstractConditionallyLinearModel,
)
from mpfjax.models.dynamics import Autoregression as Autoregression
from mpfjax.models.dynamics import RandomWalk as RandomWalk
from mpfjax.models.dynamics import RandomWalkWithJumps as RandomWalkWithJumps
from mpfjax.models.dynamics import WalkWithVelocity as WalkWithVelocity
from mpfjax.models.linear import LinearGaussianModel as LinearGaussianModel
from mpfjax.models.linear import SwitchingLinearGaussianModel as SwitchingLinearGaussianModel
from mpfjax.models.multi_object import MultiObjectModel as MultiObjectModel
from mpfjax.models.multi_object import PairwiseRepulsion as PairwiseRepulsion
from mpfjax.models.observations import Series as Series
from mpfjax.models.quadratic import QuadraticModel as QuadraticModel
from mpfjax.models.targets import TargetsModel as TargetsModel
from mpfjax.models.trial import check_model as check_model
from mpfjax.models.trial import simulate as simulate
from mpfjax.moves.base import AbstractMarkovMove as AbstractMarkovMove
from mpfjax.moves.base import AbstractMove as AbstractMove
from mpfjax.moves.base import AbstractPropagation as AbstractPropagation
from mpfjax.moves.base import AbstractProposal as AbstractProposal
from mpfjax.moves.base import AbstractRegrouping as AbstractRegrouping
from mpfjax.moves.base import AbstractResampling as AbstractResampling
from mpfjax.moves.base import AbstractWrapper as AbstractWrapper
from mpfjax.moves.base import Step as Step
from mpfjax.moves.every import Every as Every
from mpfjax.moves.initial import SelectInitial as SelectInitial
from mpfjax.moves.metropolis import AbstractMetropolis as AbstractMetropolis
from mpfjax.moves.metropolis import RandomWalkMetropolis as RandomWalkMetropolis
from mpfjax.moves.objects.bernoulli import Associate as Associate
from mpfjax.moves.objects.exclusion import Exclusion as Exclusion
from mpfjax.moves.objects.partitioned import Partitioned as Partitioned
from mpfjax.moves.objects.tracks import Targets as Targets
from mpfjax.moves.objects.tracks import number_distribution as number_distribution
from mpfjax.moves.objects.tracks import targets as targets
from mpfjax.moves.objects.tracks import track_table as track_table
from mpfjax.moves.propagation.marginalised import PropagateMarginalised as PropagateMarginalised
from mpfjax.moves.propagation.nested import PropagateNested as PropagateNested
from mpfjax.moves.propagation.propagate import Propagate as Propagate
from mpfjax.moves.propagation.proposals import GaussNewtonProposal as GaussNewtonProposal
from mpfjax.moves.propagation.proposals import NetworkProposal as NetworkProposal
from mpfjax.moves.propagation.regimes import PropagateRegimes as PropagateRegimes
from mpfjax.moves.propagation.regimes import RegimeProposal as RegimeProposal
from mpfjax.moves.regrouping.kmeans import KMeans as KMeans
from mpfjax.moves.regrouping.merge import Merge as Merge
from mpfjax.moves.regrouping.merge import Prune as Prune
from mpfjax.moves.regrouping.partitions import GroupBy as GroupBy
from mpfjax.moves.regrouping.partitions import Pool as Pool
from mpfjax.moves.regrouping.partitions import RandomPartition as RandomPartition
from mpfjax.moves.regrouping.split import Split as Split
from mpfjax.moves.resampling.auxiliary import AuxiliaryResample as AuxiliaryResample
from mpfjax.moves.resampling.gaussian import GaussianRegeneration as GaussianRegeneration
from mpfjax.moves.resampling.resample import Resample as Resample
from mpfjax.operations.compiling import keep_programs as keep_programs
from mpfjax.operations.random import normal as normal
from mpfjax.report import StepInfo as StepInfo
from mpfjax.running.islands import IslandInteraction as IslandInteraction
from mpfjax.running.islands import run_islands as run_islands
from mpfjax.running.late import Replay as Replay
from mpfjax.running.long_runs import Checkpoint as Checkpoint
from mpfjax.running.run import monte_carlo as monte_carlo
from mpfjax.running.run import run_filter as run_filter
from mpfjax.running.scan import FilterRun as FilterRun
from mpfjax.running.storage import load_checkpoint as load_checkpoint
from mpfjax.running.storage import save_checkpoint as save_checkpoint
from mpfjax.running.studies import Study as Study
from mpfjax.running.studies import read_study as read_study
from mpfjax.running.studies import run_study as run_study
from mpfjax.smoothing.forecasts import forecast as forecast
from mpfjax.smoothing.variance import with_eve_indices as with_eve_indices
from mpfjax.transforms import map_moves as map_moves
from mpfjax.transforms import with_alarm as with_alarm
from mpfjax.transforms import with_lookahead as with_lookahead
from mpfjax.transforms import with_point_sets as with_point_sets
from mpfjax.transforms import with_proposals_per_particle as with_proposals_per_particle
from mpfjax.transforms import with_resampling as with_resampling
from mpfjax.transforms import with_restarts as with_restarts
from mpfjax.transforms import with_score_gradient as with_score_gradient
from mpfjax.transforms import with_selected_start as with_selected_start
from mpfjax.transforms import with_start as with_start

# The one place that says it: pyproject.toml reads it from here.
__version__ = "0.1.0"

# Imported when they are first asked for: a first filter needs none of them, nor their optax.
_LATER = ("exact", "metrics", "robots", "tuning")

if TYPE_CHECKING:
    from mpfjax import exact as exact
    from mpfjax import metrics as metrics
    from mpfjax import robots as robots
    from mpfjax import tuning as tuning
else:  # hidden from type checkers, to which it would say that every name is there

    def __getattr__(name):
        if name in _LATER:
            return _importlib.import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_LATER})
