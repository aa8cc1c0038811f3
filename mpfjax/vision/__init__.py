"""Frames, boxes, colour histograms and their models, detection, an object tracker, scenes."""

from mpfjax.vision.boxes import check_boxes as check_boxes
from mpfjax.vision.boxes import parse_box as parse_box
from mpfjax.vision.boxes import read_tracks as read_tracks
from mpfjax.vision.boxes import write_tracks as write_tracks
from mpfjax.vision.colour_model import BoxState as BoxState
from mpfjax.vision.colour_model import ColourModel as ColourModel
from mpfjax.vision.colours import AbstractColours as AbstractColours
from mpfjax.vision.colours import HSVColours as HSVColours
from mpfjax.vision.colours import RGBColours as RGBColours



from mpfjax.vision.detections import Detections as Detections
from mpfjax.vision.detection import BackgroundSubtraction as BackgroundSubtraction
from mpfjax.vision.distracter import DistracterScene as DistracterScene
from mpfjax.vision.distracter import distracter_scene as distracter_scene
from mpfjax.vision.frames import read_frames as read_frames
from mpfjax.vision.frames import write_video as write_video
from mpfjax.vision.histograms import IntegralHistogram as IntegralHistogram
from mpfjax.vision.histograms import bhattacharyya as bhattacharyya
from mpfjax.vision.histograms import integral_histogram as integral_histogram
from mpfjax.vision.joint_colour import joint_colour_model as joint_colour_model
from mpfjax.vision.joint_colour import object_boxes as object_boxes
from mpfjax.vision.joint_colour import with_lambda as with_lambda
from mpfjax.vision.labels import boxes_around as boxes_around
from mpfjax.vision.labels import labelled_states as labelled_states
from mpfjax.vision.object_moves import ObjectExclusion as ObjectExclusion
from mpfjax.vision.object_moves import PruneHypotheses as PruneHypotheses
from mpfjax.vision.scenes import Scene as Scene
from mpfjax.vision.scenes import football_scene as football_scene
from mpfjax.vision.soft_histograms import SoftColourModel as SoftColourModel
from mpfjax.vision.soft_histograms import soft_histograms as soft_histograms
from mpfjax.vision.tracker import ObjectTracker as ObjectTracker
from mpfjax.vision.tracker import Tracks as Tracks
