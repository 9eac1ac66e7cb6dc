"""ROS 1 bags, rosbag2 folders and MCAP files of ROS messages.

The bag is read twice, one message after the other: first for frames, calibrations and stamps (`bag_survey`), then for
the sensors. Times are the stamps of the headers, to the microsecond below. The poses are those of an Odometry topic if
there is one, else of tf: at the times of the moving transform nearest to the rig, with others interpolated.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .bag_content import camera_of, compressed_suffix, png_of, sweep_of
from .bag_frames import matrix_of
from .bag_reader import Bag, Message
from .bag_survey import Survey, survey
from .calibrations import cameras_of
from .errors import LogError
from .frames import Matrix, inverse
from .kinds import Options
from .lenses import check_mount
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import text_of
from .writer import LogWriter, Report


def logs(source: Path) -> list[str]:
    """A bag is one log."""
    return [source.stem]


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes the log of a bag."""
    with Bag(source) as bag:
        found = survey(bag, options)
        decides: dict[str, Any] = {"bytes": _bytes(source), "messages": bag.count}
        if options.rig is not None:
            decides["rig"] = text_of(options.rig, "the calibration")
        licence = "not stated by the bag"
        with opened("bag", source, out, options, log=source.stem, licence=licence, decides=decides) as writer:
            return _Conversion(bag, found, options, writer).run()


def _bytes(source: Path) -> int:
    files = [path for path in source.rglob("*") if path.is_file()] if source.is_dir() else [source]
    return sum(path.stat().st_size for path in files)


class _Conversion:
    """The second reading."""

    def __init__(self, bag: Bag, found: Survey, options: Options, writer: LogWriter) -> None:
        self.bag, self.found, self.options, self.writer = bag, found, options, writer
        self.rig = found.rig_frame(options)
        self.mounts: dict[str, Matrix] = {}
        self.last_ns: dict[str, int] = {}
        self.rig_from_child = np.eye(4)
        self.takers: dict[str, Callable[[Message, int, str], None]] = {
            "image": self._image,
            "compressed": self._image,
            "cloud": self._cloud,
            "imu": self._imu,
            "gps": self._gps,
            "odometry": self._odometry,
        }

    def run(self) -> Report:
        """Writes all tables."""
        for topic, (count, why) in self.found.left_out.items():
            self.writer.left_out(f"messages of {topic}", count, why)
        self._begin()
        self._sensors()
        topics = {topic for topic, role in self.found.roles.items() if role in self.takers}
        counts = self.bag.topics()
        with Progress(f"bag {self.bag.path.name}", sum(counts[topic][1] for topic in topics)) as progress:
            for message in self.bag.messages(topics):
                stamp_ns, place = message.stamp_ns(), f"{self.bag.path}, topic {message.topic}"
                self._check_clock(message.topic, stamp_ns, place)
                self.takers[self.found.roles[message.topic]](message, stamp_ns, place)
                progress.step()
        return self.writer.finish()

    def _check_clock(self, topic: str, stamp_ns: int, place: str) -> None:
        before = self.last_ns.get(topic, 0)
        if stamp_ns // 1000 <= before // 1000:
            problem = f"the clock runs backwards: the stamp {stamp_ns} ns follows {before} ns"
            raise LogError(place, problem, "cut the bag there, or repair the stamps")
        self.last_ns[topic] = stamp_ns

    def _begin(self) -> None:
        """Sets the epoch and the origin, and adds the poses of tf if there is no odometry."""
        odometry = next((topic for topic, role in self.found.roles.items() if role == "odometry"), None)
        first_us = self.found.first_ns // 1000
        if odometry is not None:
            child = self.found.child_frame or self.rig
            if child != self.rig:
                self.rig_from_child = self.found.tree.static(self.rig, child, "the odometry")
            message = next(iter(self.bag.messages({odometry})))
            pose = self._odometry_pose(message, f"{self.bag.path}, topic {odometry}")
            self.writer.begin(first_us, pose[:3, 3])
            return
        world = self.options.world_frame or list(self.found.tree.up(self.rig))[-1]
        is_begun, skipped = False, 0
        for time_ns, world_from_rig in self.found.tree.poses(world, self.rig):
            if world_from_rig is None:
                skipped += 1
                continue
            if not is_begun:
                self.writer.begin(min(first_us, time_ns // 1000), world_from_rig[:3, 3])
                is_begun = True
            self.writer.pose(time_ns // 1000, world_from_rig, f"{self.bag.path}, tf {world} -> {self.rig}")
        why = "another transform between the world and the rig does not cover their times"
        self.writer.left_out(f"transforms of {self.rig}", skipped, why)

    def _mount(self, topic: str, what: str) -> Matrix:
        rig_from_sensor = self.found.tree.static(self.rig, self.found.frames[topic], what)
        check_mount(what, rig_from_sensor, f"{self.bag.path}, tf_static to {self.found.frames[topic]}")
        return rig_from_sensor

    def _sensors(self) -> None:
        """Adds cameras and LiDARs, and the mount of the IMU. A camera of `--rig` needs no calibration in the bag."""
        given = {one["name"]: one for one in cameras_of(self.options.rig)} if self.options.rig else {}
        known = {name for topic, name in self.found.names.items() if self.found.roles[topic] != "cloud"}
        for name in given.keys() - known:
            self.writer.left_out(
                f"camera {name} of --rig", 1, f"the bag has {', '.join(sorted(known)) or 'no cameras'}"
            )
        for topic, role in sorted(self.found.roles.items()):
            name = self.found.names.get(topic, "")
            if role in ("image", "compressed") and name in given:
                self.writer.cameras.append(given[name])
            elif role in ("image", "compressed"):
                info_topic, info = self.found.info_of(topic)
                mount = self._mount(topic, f"camera {name}")
                place = f"{self.bag.path}, topic {info_topic}"
                is_rectified = any("rect" in part for part in topic.split("/"))
                self.writer.cameras.append(camera_of(name, info, mount, place, is_rectified=is_rectified))
            elif role == "cloud":
                self.writer.lidar(name, self._mount(topic, f"LiDAR {name}"))
            elif role == "imu":
                self.mounts[topic] = self._mount(topic, "the IMU")

    def _image(self, message: Message, stamp_ns: int, place: str) -> None:
        name, time_us = self.found.names[message.topic], stamp_ns // 1000
        if self.found.roles[message.topic] == "image":
            self.writer.image_bytes(name, time_us, ".png", lambda: png_of(message.decode(), place))
            return
        data = message.decode().data.tobytes()
        self.writer.image_bytes(name, time_us, compressed_suffix(data, place), lambda: data)

    def _cloud(self, message: Message, stamp_ns: int, place: str) -> None:
        name = self.found.names[message.topic]
        found = self.writer.sweep(name, stamp_ns // 1000, lambda: _sweep(message, stamp_ns, place))
        if not found["extra"]["timed"]:
            why = "their clouds have no field of times: all points have the stamp"
            self.writer.left_out(f"times of points of {name}, sweeps", 1, why)

    def _imu(self, message: Message, stamp_ns: int, _: str) -> None:
        decoded, turn = message.decode(), self.mounts[message.topic][:3, :3]
        # By sensor_msgs/Imu: a first covariance of -1 says that there is no such measurement.
        if -1 in (decoded.angular_velocity_covariance[0], decoded.linear_acceleration_covariance[0]):
            why = "a covariance of -1: without rates or accelerations"
            self.writer.left_out(f"messages of {message.topic} without a measurement", 1, why)
            return
        rate, acceleration = decoded.angular_velocity, decoded.linear_acceleration
        in_rig = [turn @ (vector.x, vector.y, vector.z) for vector in (rate, acceleration)]
        self.writer.imu(stamp_ns // 1000, *in_rig)

    def _gps(self, message: Message, stamp_ns: int, _: str) -> None:
        fix = message.decode()
        if fix.status.status < 0:
            self.writer.left_out(f"messages of {message.topic} without a fix", 1, "no position")
            return
        self.writer.gps(stamp_ns // 1000, fix.latitude, fix.longitude, fix.altitude)

    def _odometry_pose(self, message: Message, place: str) -> Matrix:
        decoded: Any = message.decode()
        pose = decoded.pose.pose
        try:
            world_from_child = matrix_of(pose.position, pose.orientation)
        except ValueError as error:
            raise LogError(place, str(error), "repair the publisher of the odometry") from None
        return world_from_child @ inverse(self.rig_from_child)

    def _odometry(self, message: Message, stamp_ns: int, place: str) -> None:
        self.writer.pose(stamp_ns // 1000, self._odometry_pose(message, place), place)


def _sweep(message: Message, stamp_ns: int, place: str) -> tuple[Sweep, dict[str, Any]]:
    sweep, is_timed = sweep_of(message.decode(), stamp_ns, place)
    return sweep, {"timed": is_timed}
