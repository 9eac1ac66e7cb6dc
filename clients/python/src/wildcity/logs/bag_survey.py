"""The first reading of a bag: frames, calibrations, first stamps, and which topics become which sensors."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from .bag_frames import Tree
from .bag_reader import Bag, Message
from .errors import LogError
from .kinds import Options
from .names import name_of
from .progress import Progress

__all__ = ["Survey", "survey"]

_RIG_FRAMES = ("base_footprint", "base_link", "rear_axle", "ego_vehicle", "vehicle", "body", "base")
"""Frames of the vehicle, in the order in which they are taken: REP 105 puts base_footprint on the ground."""

_TYPES = {
    "sensor_msgs/msg/Image": "image",
    "sensor_msgs/msg/CompressedImage": "compressed",
    "sensor_msgs/msg/PointCloud2": "cloud",
    "sensor_msgs/msg/Imu": "imu",
    "sensor_msgs/msg/NavSatFix": "gps",
    "nav_msgs/msg/Odometry": "odometry",
    "sensor_msgs/msg/CameraInfo": "info",
    "tf2_msgs/msg/TFMessage": "tf",
    "tf/msg/tfMessage": "tf",
}

_IMAGE_ENDS = ("compressed", "image_raw", "image_rect", "image_rect_color", "image_color", "image_mono", "image")


@dataclass
class Survey:
    """What the first reading found. Topics by their roles; stamps in nanoseconds."""

    tree: Tree
    roles: dict[str, str] = field(default_factory=dict)
    """image, compressed, cloud, imu, gps or odometry, by topic."""
    names: dict[str, str] = field(default_factory=dict)
    """Name of the camera or the LiDAR, by topic."""
    frames: dict[str, str] = field(default_factory=dict)
    """Frame of the first message, by topic."""
    infos: dict[str, Any] = field(default_factory=dict)
    """The first CameraInfo, by topic."""
    left_out: dict[str, tuple[int, str]] = field(default_factory=dict)
    """Number of messages and the reason, by topic."""
    first_ns: int = 0
    child_frame: str | None = None
    """child_frame_id of the odometry that gives the poses."""

    def rig_frame(self, options: Options) -> str:
        """The frame of the rig: the user's, or the first of the usual ones that tf or the odometry has."""
        if options.rig_frame:
            return options.rig_frame
        known = {*self.tree.edges, *(edge.parent for edge in self.tree.edges.values())}
        found = next((frame for frame in _RIG_FRAMES if frame in known), self.child_frame)
        if found is None:
            problem = f"no frame of the vehicle among {', '.join(sorted(known)) or 'no frames'}"
            raise LogError(f"{self.tree.place}, tf", problem, "choose one with --rig-frame")
        return found

    def info_of(self, topic: str) -> tuple[str, Any]:
        """The topic of the CameraInfo of an image topic, and the message."""
        folder = topic
        while folder:
            folder = folder.rpartition("/")[0]
            if f"{folder}/camera_info" in self.infos:
                return f"{folder}/camera_info", self.infos[f"{folder}/camera_info"]
        wanted = f"{_camera_topic(topic)}/camera_info"
        problem = f"no CameraInfo for {topic}: the rig has no intrinsics of this camera"
        raise LogError(
            self.tree.place, problem, f"record {wanted}, or give the camera {self.names[topic]} with --rig FILE"
        )


def _camera_topic(topic: str) -> str:
    """The namespace of a camera: its topic without the last words that say what kind of image it is."""
    parts = topic.rstrip("/").split("/")
    while len(parts) > 2 and parts[-1] in _IMAGE_ENDS:
        parts.pop()
    return "/".join(parts)


def survey(bag: Bag, options: Options) -> Survey:
    """Reads the bag once: calibrations, frames and stamps; no image and no cloud is decoded."""
    found = Survey(Tree(str(bag.path)))
    topics = bag.topics()
    for topic, (kind, count) in topics.items():
        role = _TYPES.get(kind)
        if role is None or topic.endswith("compressedDepth"):
            found.left_out[topic] = (count, f"{kind} is not read")
        elif count:
            found.roles[topic] = role
    for topic in options.leave_out:
        if topic not in topics:
            raise LogError(bag.path, f"no topic {topic}, only {', '.join(topics)}", "choose another --leave-out")
        if found.roles.pop(topic, None):
            found.left_out[topic] = (topics[topic][1], "the user left it out")
    _one_of(found, topics, "imu", None)
    _one_of(found, topics, "gps", None)
    _one_of(found, topics, "odometry", options.odometry)
    _name_cameras(found, topics)
    calibrations: dict[str, bytes] = {}
    with Progress(f"bag {bag.path.name}, frames", sum(topics[topic][1] for topic in found.roles)) as progress:
        for message in bag.messages(set(found.roles)):
            _take(found, message, bag, calibrations)
            progress.step()
    if not found.first_ns:
        raise LogError(bag.path, "no message that a log can have", "record images, clouds, poses or tf")
    return found


def _take(found: Survey, message: Message, bag: Bag, calibrations: dict[str, bytes]) -> None:
    topic, role = message.topic, found.roles[message.topic]
    place = f"{bag.path}, topic {topic}"
    if role == "tf":
        found.tree.add(message.decode(), is_static=topic.endswith("tf_static"))
        return
    if role == "info":
        if topic not in calibrations:
            calibrations[topic], found.infos[topic] = message.after_stamp(), message.decode()
        elif calibrations[topic] != message.after_stamp():
            raise LogError(place, "the calibration changes", "cut the bag there, and convert both parts")
        return
    if topic in found.frames:
        return
    stamp_ns = message.stamp_ns()
    if stamp_ns <= 0:
        raise LogError(place, "header.stamp is 0", "record messages with the times of their measurement")
    found.first_ns = min(found.first_ns or stamp_ns, stamp_ns)
    decoded = message.decode()
    found.frames[topic] = decoded.header.frame_id.lstrip("/")
    if role == "odometry":
        found.child_frame = decoded.child_frame_id.lstrip("/")


def _one_of(found: Survey, topics: dict[str, tuple[str, int]], role: str, chosen: str | None) -> None:
    """Keeps one topic of a role of which a log has one: the user's, or the first by name."""
    names = sorted(topic for topic, its in found.roles.items() if its == role)
    if chosen is not None and chosen not in names:
        known = ", ".join(names) or "none"
        raise LogError(found.tree.place, f"no {role} topic {chosen}, only {known}", "choose another topic")
    if role == "odometry" and len(names) > 1 and chosen is None:
        raise LogError(found.tree.place, f"several odometries: {', '.join(names)}", "choose one with --odometry")
    for topic in names:
        if topic != (chosen or names[0]):
            found.left_out[topic] = (topics[topic][1], f"the log has one {role}: {chosen or names[0]}")
            del found.roles[topic]


def _name_cameras(found: Survey, topics: dict[str, tuple[str, int]]) -> None:
    """Names cameras and LiDARs by their topics; of two image topics of one camera the raw one stays."""
    owners: dict[str, str] = {}
    order = {"image": 0, "compressed": 1, "cloud": 2}
    for topic in sorted(found.roles, key=lambda one: (order.get(found.roles[one], 9), one)):
        role = found.roles[topic]
        if role not in order:
            continue
        name = name_of(_camera_topic(topic) if role != "cloud" else topic)
        owner = owners.setdefault(name, topic)
        if owner != topic:
            found.left_out[topic] = (topics[topic][1], f"the same camera as {owner}")
            del found.roles[topic]
        else:
            found.names[topic] = name
