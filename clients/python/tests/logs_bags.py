"""Writes bags of one known drive, by `rosbags` (rosbag2 with sqlite3 or MCAP, ROS 1) and by `mcap`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from logs_truth import Array, drive, image_bytes, matrix, mount, moved, wxyz
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

START_NS = 1_700_000_123_456_789_012
FORMATS = ("sqlite3", "mcap", "mcap_package", "ros1")

SIZE = (640, 400)
K = np.array([[400.0, 0, 322.5], [0, 402.0, 198.25], [0, 0, 1]])
CAMERAS: dict[str, tuple[Array, str, list[float], int, int]] = {
    # Mount, lens, interval and offset in milliseconds.
    "front": (mount(1.6, 0.1, 1.5, 2), "plumb_bob", [-0.28, 0.09, 0.0011, -0.0007, -0.01], 100, 0),
    "left": (mount(1.2, 0.6, 1.4, 80, 3), "equidistant", [-0.02, 0.004, -0.001, 0.0002], 50, 20),
    "right": (mount(1.2, -0.6, 1.4, -75), "rational_polynomial", [0.4, 0.1, 1e-4, 2e-4, 0.01, 0.6, 0.2, 0.02], 67, 40),
}
LIDAR = matrix([1.0, 0.0, 1.9], Rotation.from_euler("ZYX", [91, 2, -1], degrees=True))
IMU = matrix([0.3, 0.1, 0.5], Rotation.from_euler("x", 180, degrees=True))
DROPPED = {"front": {3}, "left": {7, 8}, "right": set[int]()}
SECONDS = 1.2
POINTS = 400


def time_s(time_us: int) -> float:
    """Seconds since the start of the drive."""
    return (time_us - START_NS // 1000) / 1e6


def frame_times_ns(name: str) -> list[int]:
    _, _, _, interval, offset = CAMERAS[name]
    count = int(SECONDS * 1000 / interval)
    return [START_NS + 1_000_000 * (offset + interval * n) for n in range(count) if n not in DROPPED[name]]


@cache
def sweep(number: int) -> tuple[Array, Array, Array]:
    """Points in the LiDAR's axes, their times in seconds after the stamp, and the points in the world."""
    random = np.random.default_rng(number)
    offsets = np.sort(random.uniform(-0.09, 0.0, POINTS).astype(np.float32))
    world = moved(drive(0.1 * number), random.uniform(-25, 25, (POINTS, 3)))
    at = [np.linalg.inv(drive(0.1 * number + float(offset)) @ LIDAR) for offset in offsets]
    return np.array([moved(one, point[None])[0] for one, point in zip(at, world, strict=True)]), offsets, world


def map_from_odom(seconds: float) -> Array:
    return matrix([900 + 0.02 * seconds, 500.0, 0.0], Rotation.from_euler("z", 20, degrees=True))


class Maker:
    """Makes messages of a ROS version."""

    def __init__(self, kind: str) -> None:
        self.is1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is1 else Stores.ROS2_HUMBLE)
        if self.is1:
            text = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))

    def make(self, kind: str, /, **fields: Any) -> Any:
        its = self.store.types[kind]
        names = {field.name.lower(): field.name for field in dataclasses.fields(its)}
        return its(**{names[key]: value for key, value in fields.items()})

    def header(self, time_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **({"seq": 7} if self.is1 else {}))

    def vector(self, xyz: Any, name: str = "Vector3") -> Any:
        return self.make(f"geometry_msgs/msg/{name}", **dict(zip("xyz", map(float, xyz), strict=True)))

    def turn(self, pose: Array) -> Any:
        return self.make("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", wxyz(pose), strict=True)))

    def transform(self, time_ns: int, parent: str, child: str, pose: Array) -> Any:
        inner = self.make("geometry_msgs/msg/Transform", translation=self.vector(pose[:3, 3]), rotation=self.turn(pose))
        head = self.header(time_ns, parent)
        return self.make("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=inner)

    def frames(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def info(self, time_ns: int, name: str) -> Any:
        _, model, d, _, _ = CAMERAS[name]
        roi = {key: 0 for key in ("x_offset", "y_offset", "height", "width")}
        region = self.make("sensor_msgs/msg/RegionOfInterest", **roi, do_rectify=False)
        p = np.concatenate([K, np.zeros((3, 1))], axis=1).reshape(-1)
        numbers = {"k": K.reshape(-1), "r": np.eye(3).reshape(-1), "p": p, "d": np.array(d)}
        shape = {"height": SIZE[1], "width": SIZE[0], "binning_x": 0, "binning_y": 0, "roi": region}
        head = self.header(time_ns, f"{name}_optical")
        return self.make("sensor_msgs/msg/CameraInfo", header=head, distortion_model=model, **numbers, **shape)

    def raw(self, time_ns: int, name: str, pixels: Array, encoding: str) -> Any:
        rows = np.concatenate([pixels.reshape(len(pixels), -1), np.zeros((len(pixels), 5), np.uint8)], axis=1)
        shape = {"height": pixels.shape[0], "width": pixels.shape[1], "step": rows.shape[1], "is_bigendian": 0}
        head, data = self.header(time_ns, f"{name}_optical"), np.ascontiguousarray(rows).reshape(-1)
        return self.make("sensor_msgs/msg/Image", header=head, encoding=encoding, data=data, **shape)

    def compressed(self, time_ns: int, name: str, data: bytes) -> Any:
        head = self.header(time_ns, f"{name}_optical")
        values = np.frombuffer(data, np.uint8)
        return self.make("sensor_msgs/msg/CompressedImage", header=head, format="jpeg", data=values)

    def cloud(self, time_ns: int, xyz: Array, times: Array, time_name: str = "time") -> Any:
        dtype = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (time_name, times.dtype), ("ring", "<u2")])
        points = np.zeros(len(xyz), dtype)
        for axis, values in zip("xyz", xyz.T, strict=True):
            points[axis] = values
        points[time_name], points["ring"] = times, np.arange(len(xyz)) % 16
        codes = {"<f4": 7, "<u2": 4, "<f8": 8, "<u4": 6}
        assert dtype.fields is not None
        fields = [
            self.make("sensor_msgs/msg/PointField", name=key, offset=its[1], datatype=codes[its[0].str], count=1)
            for key, its in dtype.fields.items()
        ]
        shape = {"height": 1, "width": len(xyz), "point_step": dtype.itemsize, "row_step": dtype.itemsize * len(xyz)}
        data = np.frombuffer(points.tobytes(), np.uint8)
        head = self.header(time_ns, "lidar")
        rest = {"fields": fields, "data": data, "is_bigendian": False, "is_dense": True}
        return self.make("sensor_msgs/msg/PointCloud2", header=head, **shape, **rest)

    def imu(self, time_ns: int, rate: Any, acceleration: Any) -> Any:
        covariances = ("orientation", "angular_velocity", "linear_acceleration")
        fields: dict[str, Any] = {f"{name}_covariance": np.zeros(9) for name in covariances}
        fields |= {"angular_velocity": self.vector(rate), "linear_acceleration": self.vector(acceleration)}
        return self.make(
            "sensor_msgs/msg/Imu", header=self.header(time_ns, "imu"), orientation=self.turn(IMU), **fields
        )

    def fix(self, time_ns: int, latitude: float, status: int = 0) -> Any:
        state = self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1)
        rest = {"position_covariance": np.zeros(9), "position_covariance_type": 0, "status": state}
        place = {"latitude": latitude, "longitude": 8.5, "altitude": 410.0}
        return self.make("sensor_msgs/msg/NavSatFix", header=self.header(time_ns, "gps"), **place, **rest)

    def odometry(self, time_ns: int, pose: Array, child: str = "imu") -> Any:
        inner = self.make(
            "geometry_msgs/msg/Pose", position=self.vector(pose[:3, 3], "Point"), orientation=self.turn(pose)
        )
        zero = self.vector((0, 0, 0))
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        posed = self.make("geometry_msgs/msg/PoseWithCovariance", pose=inner, covariance=np.zeros(36))
        moving = self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
        head = self.header(time_ns, "map")
        return self.make("nav_msgs/msg/Odometry", header=head, child_frame_id=child, pose=posed, twist=moving)


Recorded = list[tuple[int, str, Any]]
"""Time at which a message was recorded, in nanoseconds, topic, and message."""


def raw_pixels(number: int) -> Array:
    return np.random.default_rng(number).integers(0, 255, (10, 16, 3), np.uint8)


def messages(m: Maker, *, odometry: bool = False) -> Recorded:
    """All messages of the drive, unsorted. The bag's times are 3 to 30 ms after the stamps."""
    found: Recorded = []

    def add(time_ns: int, topic: str, message: Any, delay_ms: int = 3) -> None:
        found.append((time_ns + 1_000_000 * delay_ms, topic, message))

    mounts = {f"{name}_optical": its[0] for name, its in CAMERAS.items()} | {"lidar": LIDAR, "imu": IMU}
    static = [m.transform(START_NS, "base_link", child, pose) for child, pose in mounts.items()]
    add(START_NS - 700_000_000, "/tf_static", m.frames(*static))
    for n in range(-30, 90):
        time_ns = START_NS + 20_000_000 * n
        world = drive(n / 50)
        if odometry:
            add(time_ns, "/odom", m.odometry(time_ns, world @ IMU))
            continue
        odom = np.linalg.inv(map_from_odom(n / 50)) @ world
        add(time_ns, "/tf", m.frames(m.transform(time_ns, "odom", "base_link", odom)))
        if n % 10 == 0:
            add(time_ns, "/tf", m.frames(m.transform(time_ns, "map", "odom", map_from_odom(n / 50))))
    for number, name in enumerate(CAMERAS):
        for n, time_ns in enumerate(frame_times_ns(name)):
            add(time_ns, f"/camera/{name}/camera_info", m.info(time_ns, name))
            if name == "left":
                data = image_bytes(100 + n)
                add(time_ns, "/camera/left/image_raw/compressed", m.compressed(time_ns, name, data), 30)
            else:
                pixels = raw_pixels(1000 * number + n)
                encoding = "rgb8" if name == "front" else "bgr8"
                add(time_ns, f"/camera/{name}/image_raw", m.raw(time_ns, name, pixels, encoding), 25)
    for n in range(1, 12):
        time_ns = START_NS + 100_000_000 * n
        xyz, offsets, _ = sweep(n)
        add(time_ns, "/lidar/points", m.cloud(time_ns, xyz, offsets), 12)
    for n in range(120):
        time_ns = START_NS + 10_000_000 * n + 123_456
        add(time_ns, "/imu", m.imu(time_ns, (0.1, 0.2, 0.01 * n), (0.5, 0.0, -9.81)))
        if n % 20 == 0:
            add(time_ns, "/fix", m.fix(time_ns, 47.4 + 1e-5 * n, -1 if n == 40 else 0))
            text = {"data": "cloudy"}
            add(time_ns, "/weather", m.make("std_msgs/msg/String", **text))
    return found


def write(path: Path, kind: str, change: Callable[[Maker, Recorded], Recorded] | None = None) -> Path:
    """Writes the bag. change: of the messages before they are written."""
    m = Maker(kind)
    found = messages(m, odometry=kind == "ros1")
    found = sorted(change(m, found) if change else found, key=lambda one: one[0])
    if kind == "ros1":
        path = path.with_suffix(".bag")
        with Writer1(path) as writer1:
            _fill(writer1, m, found)
    elif kind == "mcap_package":
        path = path.with_suffix(".mcap")
        _write_mcap(path, m, found)
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
        with Writer2(path, version=9, storage_plugin=plugin) as writer2:
            _fill(writer2, m, found)
    return path


def _fill(writer: Any, m: Maker, found: Recorded) -> None:
    serialize = m.store.serialize_ros1 if m.is1 else m.store.serialize_cdr
    connections: dict[str, Any] = {}
    for time_ns, topic, message in found:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=m.store)
        writer.write(connections[topic], time_ns, serialize(message, message.__msgtype__))


def _write_mcap(path: Path, m: Maker, found: Recorded) -> None:
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=100_000)
        writer.start("ros2", "test")
        channels: dict[str, int] = {}
        for time_ns, topic, message in found:
            kind = message.__msgtype__
            if topic not in channels:
                text = m.store.generate_msgdef(kind, ros_version=2)[0].encode()
                schema = writer.register_schema(kind, "ros2msg", text)
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], time_ns, bytes(m.store.serialize_cdr(message, kind)), time_ns)
        writer.finish()
