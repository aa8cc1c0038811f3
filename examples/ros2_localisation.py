"""A ROS 2 node that publishes the pose of a robot, and the probability that it is lost.

    python -m examples.ros2_localisation --ros-args -p map:=map.yaml

It subscribes to /scan and /odom and publishes /pose and /lost. The scanner is at the pose `mount`
in the robot's frame. It needs an installation of ROS 2, which the tests do not have: use it as a
template.
"""

import math
import queue
import threading
from collections import deque
from typing import Any

import jax
import numpy as np
import rclpy  # pyright: ignore[reportMissingImports]
from geometry_msgs.msg import PoseWithCovarianceStamped  # pyright: ignore[reportMissingImports]
from nav_msgs.msg import Odometry  # pyright: ignore[reportMissingImports]
from rclpy.node import Node  # pyright: ignore[reportMissingImports]
from rclpy.qos import qos_profile_sensor_data  # pyright: ignore[reportMissingImports]
from sensor_msgs.msg import LaserScan  # pyright: ignore[reportMissingImports]
from std_msgs.msg import Float32  # pyright: ignore[reportMissingImports]

import mpfjax
from mpfjax import robots

MIN_DISTANCE, MIN_TURN = 0.25, 0.2  # update_min_d and update_min_a of AMCL


class Localisation(Node):
    """Pairs scans with the odometry at their time stamps; a thread runs the filter on the pairs."""

    def __init__(self) -> None:
        super().__init__("mpfjax_localisation")
        path = self.declare_parameter("map", "map.yaml").value
        self.mount = self.declare_parameter("mount", [0.0, 0.0, 0.0]).value
        self.grid = robots.read_map(path)
        self.odometry: deque[tuple[float, ...]] = deque(maxlen=1000)
        self.scans: deque[Any] = deque(maxlen=100)
        self.pairs: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.last_pose: np.ndarray | None = None
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
        self.lost = self.create_publisher(Float32, "lost", 10)
        self.create_subscription(Odometry, "odom", self.on_odometry, qos_profile_sensor_data)
        self.create_subscription(LaserScan, "scan", self.scans.append, qos_profile_sensor_data)
        threading.Thread(target=self.follow, daemon=True).start()

    def on_odometry(self, message: Any) -> None:
        """Store the pose, and pair the scans that are not newer."""
        place, q = message.pose.pose.position, message.pose.pose.orientation
        heading = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        now = seconds(message)
        if self.odometry and now <= self.odometry[-1][0]:
            return
        self.odometry.append((now, place.x, place.y, heading))
        while self.scans and seconds(self.scans[0]) <= now:
            scan = self.scans.popleft()
            if self.odometry[0][0] <= seconds(scan):
                self.pair(scan)

    def pair(self, scan: Any) -> None:
        """Queue the scan where the robot has moved or turned far enough since the last one."""
        times, *poses = np.array(self.odometry).T
        pose = robots.interpolated_poses([seconds(scan)], times, np.transpose(poses))[0]
        step = np.zeros(3)
        if self.last_pose is not None:
            step = robots.odometry_steps(np.stack([self.last_pose, pose]))[0]
            if np.hypot(step[0], step[1]) < MIN_DISTANCE and abs(step[2]) < MIN_TURN:
                return
        self.last_pose = pose
        self.pairs.put((step, scan))

    def follow(self) -> None:
        """Run the filter, and publish an estimate for each pair."""
        first = self.pairs.get()
        scan = first[1]
        sensor = robots.LikelihoodField(
            scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges)),
            laser_max_range=scan.range_max, laser_min_range=scan.range_min, mount=self.mount,
        )  # fmt: skip
        model = robots.RobotModel(self.grid, robots.OdometryMotion(), sensor, clearance=0.1)
        plain = mpfjax.mixture_particle_filter(model, 2000, 16, scale=(1.0, 1.0, 0.5, 0.5))
        filter = mpfjax.with_restarts(mpfjax.with_initialisation(plain))
        headers = deque([scan.header])

        def pairs() -> Any:
            yield first[0], np.asarray(scan.ranges, np.float32)
            while True:
                step, latest = self.pairs.get()
                headers.append(latest.header)
                yield step, np.asarray(latest.ranges, np.float32)

        for estimate in robots.follow(jax.random.key(0), filter, pairs()):
            message = PoseWithCovarianceStamped(header=headers.popleft())
            message.header.frame_id = "map"
            x, y, heading = map(float, estimate.pose)
            message.pose.pose.position.x, message.pose.pose.position.y = x, y
            message.pose.pose.orientation.z = math.sin(heading / 2)
            message.pose.pose.orientation.w = math.cos(heading / 2)
            covariance = np.zeros((6, 6))  # of x, y, z and the turns about them
            covariance[np.ix_([0, 1, 5], [0, 1, 5])] = estimate.covariance
            message.pose.covariance = covariance.ravel().tolist()
            self.poses.publish(message)
            self.lost.publish(Float32(data=estimate.lost))


def seconds(message: Any) -> float:
    """The time stamp of a message."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    rclpy.spin(Localisation())


if __name__ == "__main__":
    main()
