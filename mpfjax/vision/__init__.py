"""Computer vision: frames, boxes, colour histograms, detections, the object tracker."""

from mpfjax.vision.boxes.colour_model import ColourModel as ColourModel
from mpfjax.vision.boxes.joint_colour import joint_colour_model as joint_colour_model
from mpfjax.vision.boxes.recipes import PRESETS as PRESETS
from mpfjax.vision.boxes.recipes import follow_boxes as follow_boxes
from mpfjax.vision.colour import HSVColours as HSVColours
from mpfjax.vision.colour import RGBColours as RGBColours
from mpfjax.vision.files.boxes import read_detections as read_detections
from mpfjax.vision.files.boxes import read_tracks as read_tracks
from mpfjax.vision.files.boxes import write_tracks as write_tracks
from mpfjax.vision.files.frames import read_frames as read_frames
from mpfjax.vision.files.frames import write_video as write_video
from mpfjax.vision.files.sequences import read_truth as read_truth
from mpfjax.vision.tracking.detections import Detections as Detections
from mpfjax.vision.tracking.opencv import BackgroundSubtraction as BackgroundSubtraction
from mpfjax.vision.tracking.opencv import OpticalFlow as OpticalFlow
from mpfjax.vision.tracking.state import Tracks as Tracks
from mpfjax.vision.tracking.track import track as track
from mpfjax.vision.tracking.tracker import ObjectTracker as ObjectTracker
