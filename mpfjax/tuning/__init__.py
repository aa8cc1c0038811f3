"""Tuning of a filter's parameters by the gradient of its log marginal likelihood."""

from mpfjax.tuning.climb import TuningRun as TuningRun
from mpfjax.tuning.climb import fit as fit
from mpfjax.tuning.curvature import standard_errors as standard_errors
from mpfjax.tuning.transforms import AbstractTransform as AbstractTransform
from mpfjax.tuning.transforms import Interval as Interval
from mpfjax.tuning.transforms import Positive as Positive
from mpfjax.tuning.transforms import Simplex as Simplex
from mpfjax.tuning.transforms import Unconstrained as Unconstrained
