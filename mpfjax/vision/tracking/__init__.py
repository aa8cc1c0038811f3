"""The object tracker's moves, on a mixture with a component for each object, and their model."""

from mpfjax.vision.tracking.assignment import Assign as Assign
from mpfjax.vision.tracking.births import Found as Found
from mpfjax.vision.tracking.births import ShareMass as ShareMass
from mpfjax.vision.tracking.camera import FollowCamera as FollowCamera
from mpfjax.vision.tracking.colours import LearnColours as LearnColours
from mpfjax.vision.tracking.contact import ShareDetections as ShareDetections
from mpfjax.vision.tracking.deaths import Bury as Bury
from mpfjax.vision.tracking.model import DetectedObjectModel as DetectedObjectModel
from mpfjax.vision.tracking.model import ObjectState as ObjectState
from mpfjax.vision.tracking.motion import PropagateObjects as PropagateObjects
from mpfjax.vision.tracking.noise import LearnNoise as LearnNoise
from mpfjax.vision.tracking.scores import RankScores as RankScores
