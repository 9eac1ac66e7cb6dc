"""A live bridge between a session and ROS 2: a stack drives in a twin by its own topics.

python ros2_bridge.py ws://127.0.0.1:8080/v1/session TWIN [--period-ms 100] [--wait-s 0.5]

It needs `rclpy` of a ROS 2 installation, and `ackermann_msgs`. Published, with simulated time:

- `/clock`, `/odom` (map to base_link) and the same as tf; tf_static of the cameras, once
- `/<camera>/image_raw` (rgb8) and `/<camera>/camera_info`, at the end of the image's exposure

Subscribed: `/ackermann_cmd` (AckermannDriveStamped: speed and steering angle) or `/trajectory` (nav_msgs/Path in the
frame `map` or `base_link`, with a stamp for each pose). The simulation waits for a command after each observation, for
up to --wait-s; without a new one it repeats the last.

`Bridge` knows no ROS: `make` builds messages of any library, so that its test needs no installation.
"""

from __future__ import annotations

import argparse
import array
import importlib
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import wildcity
from wildcity import Action, Pose, TimedPose, Trajectory

WHEELBASE_M = 2.85
"""Of the car that the server simulates."""

MAX_ACCELERATION = 3.0
"""In m/s², where the command gives none."""

Make = Callable[..., Any]
"""Makes a message: `make("std_msgs/msg/Header", stamp=.., frame_id=..)`."""


class Bridge:
    """Messages of observations, and movements of commands. Times are in simulated microseconds."""

    def __init__(self, make: Make, cameras: tuple[Any, ...]) -> None:
        self.make, self.cameras = make, {camera.name: camera for camera in cameras}

    def stamp(self, time_us: int) -> Any:
        """A time of ROS."""
        return self.make("builtin_interfaces/msg/Time", sec=time_us // 1_000_000, nanosec=time_us % 1_000_000 * 1000)

    def header(self, time_us: int, frame: str) -> Any:
        """A header."""
        return self.make("std_msgs/msg/Header", stamp=self.stamp(time_us), frame_id=frame)

    def static_frames(self) -> Any:
        """tf_static: base_link to the optical frame of each camera, whose axes are those of the rig file."""
        found = [self._transform(0, "base_link", f"{c.name}_optical", c.camera_to_rig) for c in self.cameras.values()]
        return self.make("tf2_msgs/msg/TFMessage", transforms=found)

    def messages(self, observation: Any) -> Iterator[tuple[str, Any]]:
        """Topics and messages of an observation: the clock first."""
        data = observation.metadata
        yield "/clock", self.make("rosgraph_msgs/msg/Clock", clock=self.stamp(data.time_us))
        moved = self._transform(data.time_us, "map", "base_link", data.ego.pose)
        yield "/tf", self.make("tf2_msgs/msg/TFMessage", transforms=[moved])
        yield "/odom", self._odometry(data.time_us, data.ego)
        for info in data.images:
            pixels = observation.images[info.camera]
            yield f"/{info.camera}/camera_info", self.camera_info(info.shutter_end_us, info.camera)
            yield f"/{info.camera}/image_raw", self._image(info.shutter_end_us, info.camera, pixels)

    def camera_info(self, time_us: int, name: str) -> Any:
        """The CameraInfo of a camera. ROS counts from the middle of the first pixel, the server from its corner.

        Raises `ValueError` for a lens that CameraInfo cannot say, such as f-theta.
        """
        camera = self.cameras[name]
        model, d = _distortion(camera)
        cx, cy = camera.cx - 0.5, camera.cy - 0.5
        k = [camera.fx, 0.0, cx, 0.0, camera.fy, cy, 0.0, 0.0, 1.0]
        p = [camera.fx, 0.0, cx, 0.0, 0.0, camera.fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(time_us, f"{name}_optical"),
            height=camera.height,
            width=camera.width,
            distortion_model=model,
            d=array.array("d", d),
            k=np.array(k),
            r=np.eye(3).reshape(9),
            p=np.array(p),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def ackermann(self, command: Any, speed: float, period_us: int) -> Action:
        """The action of an AckermannDrive: its speed at the end of the step, as far as the acceleration allows."""
        wanted = (command.speed - speed) / (1e-6 * period_us)
        most = abs(command.acceleration) or MAX_ACCELERATION
        curvature = math.tan(command.steering_angle) / WHEELBASE_M
        return Action(max(-most, min(most, wanted)), max(-0.2, min(0.2, curvature)))

    def path(self, message: Any, pose: Pose, now_us: int) -> Trajectory:
        """The trajectory of a nav_msgs/Path: poses after now, in the rig frame at now. Raises `ValueError`."""
        found: list[TimedPose] = []
        frame = message.header.frame_id.lstrip("/")
        if frame not in ("map", "base_link"):
            raise ValueError(f"/trajectory is in the frame {frame!r}: send it in map or base_link")
        for one in message.poses:
            stamp, position, q = one.header.stamp, one.pose.position, one.pose.orientation
            since_us = stamp.sec * 1_000_000 + stamp.nanosec // 1000 - now_us
            its = Pose((position.x, position.y, position.z), (q.w, q.x, q.y, q.z))
            if since_us > (found[-1].time_us if found else 0):
                found.append(TimedPose(since_us, relative(pose, its) if frame == "map" else its))
        if not found:
            raise ValueError("/trajectory has no pose after the present: give each pose the stamp of its time")
        return Trajectory(tuple(found[:64]))

    def _image(self, time_us: int, name: str, pixels: Any) -> Any:
        height, width = pixels.shape[:2]
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(time_us, f"{name}_optical"),
            height=height,
            width=width,
            encoding="rgb8",
            is_bigendian=0,
            step=3 * width,
            data=array.array("B", np.ascontiguousarray(pixels).tobytes()),
        )

    def _vector(self, xyz: Any, kind: str = "Vector3") -> Any:
        x, y, z = (float(value) for value in xyz)
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _turn(self, pose: Pose) -> Any:
        w, x, y, z = pose.q
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _transform(self, time_us: int, parent: str, child: str, pose: Pose) -> Any:
        inner = self.make("geometry_msgs/msg/Transform", translation=self._vector(pose.xyz), rotation=self._turn(pose))
        head = self.header(time_us, parent)
        return self.make("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=inner)

    def _odometry(self, time_us: int, ego: Any) -> Any:
        """Pose in the map, and velocity in the axes of base_link, as nav_msgs/Odometry has it."""
        place = self.make(
            "geometry_msgs/msg/Pose", position=self._vector(ego.pose.xyz, "Point"), orientation=self._turn(ego.pose)
        )
        velocity = rotation(ego.pose).T @ np.array(ego.velocity)
        twist = self.make(
            "geometry_msgs/msg/Twist", linear=self._vector(velocity), angular=self._vector((0, 0, ego.yaw_rate))
        )
        unknown = np.zeros(36)
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(time_us, "map"),
            child_frame_id="base_link",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=place, covariance=unknown),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
        )


def _distortion(camera: Any) -> tuple[str, list[float]]:
    """distortion_model and D of a camera."""
    lens = camera.lens
    if camera.windshield is not None or (lens is not None and lens.model == "ftheta"):
        raise ValueError(f"camera {camera.name}: CameraInfo has no f-theta lens and no windshield: choose another rig")
    if lens is None:
        return "plumb_bob", [0.0] * 5
    k = [*(lens.k or ()), *[0.0] * 6]
    if lens.model == "fisheye":
        return "equidistant", k[:4]
    if any(lens.s or ()):
        raise ValueError(f"camera {camera.name}: CameraInfo has no thin-prism coefficients: choose another rig")
    p = list(lens.p or (0.0, 0.0))
    return "rational_polynomial", [k[0], k[1], *p, *k[2:6]]


def rotation(pose: Pose) -> Any:
    """The rotation matrix [3, 3] of a pose."""
    w, x, y, z = pose.q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def relative(base: Pose, other: Pose) -> Pose:
    """base_from_other of two poses in one frame."""
    w, x, y, z = base.q[0], *(-value for value in base.q[1:])
    a, b, c, d = other.q
    q = (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    x, y, z = rotation(base).T @ (np.array(other.xyz) - np.array(base.xyz))
    return Pose((x, y, z), q)


def of_ros(kind: str, **fields: Any) -> Any:
    """A message of a ROS 2 installation."""
    package, _, name = kind.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), name)(**fields)


def class_of_ros(kind: str) -> Any:
    """The class of a message type of a ROS 2 installation."""
    package, _, name = kind.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def main() -> None:
    """Runs until the episode ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url")
    parser.add_argument("twin")
    parser.add_argument("--period-ms", type=int, default=100, help="simulated time of a step")
    parser.add_argument("--wait-s", type=float, default=0.5, help="longest wait for a command")
    chosen = parser.parse_args()
    rclpy = importlib.import_module("rclpy")
    qos = importlib.import_module("rclpy.qos")
    rclpy.init()
    node = rclpy.create_node("wildcity")
    period_us = 1000 * chosen.period_ms
    latest: list[Any] = []
    drive, path = "ackermann_msgs/msg/AckermannDriveStamped", "nav_msgs/msg/Path"
    node.create_subscription(class_of_ros(path), "/trajectory", latest.append, 1)
    node.create_subscription(class_of_ros(drive), "/ackermann_cmd", latest.append, 1)
    publishers: dict[str, Any] = {}
    with (
        wildcity.connect(chosen.url) as client,
        client.open(chosen.twin, dynamics="kinematic", dt_us=period_us) as session,
    ):
        bridge = Bridge(of_ros, session.opened.cameras)
        kept = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        static = node.create_publisher(class_of_ros("tf2_msgs/msg/TFMessage"), "/tf_static", kept)
        static.publish(bridge.static_frames())
        observation = session.reset(seed=1)
        movement: Action | Trajectory = Action(0.0, 0.0)
        while not observation.metadata.terminated:
            for topic, message in bridge.messages(observation):
                if topic not in publishers:
                    publishers[topic] = node.create_publisher(type(message), topic, 1)
                publishers[topic].publish(message)
            latest.clear()
            until = time.monotonic() + chosen.wait_s
            while not latest and time.monotonic() < until:
                rclpy.spin_once(node, timeout_sec=0.01)
            data = observation.metadata
            if latest and hasattr(latest[-1], "drive"):
                speed = float(np.linalg.norm(data.ego.velocity))
                movement = bridge.ackermann(latest[-1].drive, speed, period_us)
            elif latest:
                try:
                    movement = bridge.path(latest[-1], data.ego.pose, data.time_us)
                except ValueError as error:
                    node.get_logger().warning(str(error))
            observation = session.step(movement)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
