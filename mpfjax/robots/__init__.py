"""Robots with a map and an unknown pose: occupancy grids, laser scanners and odometry.

After Thrun, Burgard and Fox (2005), *Probabilistic Robotics*, with the parameter names of AMCL and
nav2. Positions are (x, y) in metres, poses (x, y, heading) with radians.
"""

from mpfjax.robots.localisation import OdometryMotion as OdometryMotion
from mpfjax.robots.localisation import RobotModel as RobotModel
from mpfjax.robots.localisation import interpolated_poses as interpolated_poses
from mpfjax.robots.localisation import odometry_steps as odometry_steps
from mpfjax.robots.maps import OccupancyGrid as OccupancyGrid
from mpfjax.robots.maps import read_map as read_map
from mpfjax.robots.pose import PoseEstimate as PoseEstimate
from mpfjax.robots.pose import follow as follow
from mpfjax.robots.pose import localised as localised
from mpfjax.robots.pose import lost as lost
from mpfjax.robots.sensors import AbstractLaser as AbstractLaser
from mpfjax.robots.sensors import BeamModel as BeamModel
from mpfjax.robots.sensors import LikelihoodField as LikelihoodField
