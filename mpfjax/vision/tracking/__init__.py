"""The object tracker's moves, on a mixture with a component for each object, and their model."""

from mpfjax.vision.tracking.appearance import LearnAppearance as LearnAppearance
from mpfjax.vision.tracking.assignment import Assign as Assign
from mpfjax.vision.tracking.births import Births as Births
from mpfjax.vision.tracking.births import ShareMass as ShareMass
from mpfjax.vision.tracking.camera import FollowCamera as FollowCamera
from mpfjax.vision.tracking.deaths import Deaths as Deaths
from mpfjax.vision.tracking.doubles import LearnDoubles as LearnDoubles
from mpfjax.vision.tracking.guesses import LearnGuesses as LearnGuesses
from mpfjax.vision.tracking.model import DetectedObjectModel as DetectedObjectModel
from mpfjax.vision.tracking.model import ObjectState as ObjectState
from mpfjax.vision.tracking.motion import PropagateObjects as PropagateObjects
from mpfjax.vision.tracking.noise import LearnNoise as LearnNoise
from mpfjax.vision.tracking.scores import RankScores as RankScores
