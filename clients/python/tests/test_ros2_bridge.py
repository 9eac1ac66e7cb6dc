"""The example of a live bridge to ROS 2, with the message types of ROS 2 as `rosbags` has them, and no installation."""

from __future__ import annotations

import array
import importlib.util
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import wildcity
from logs_truth import drive, matrix, wxyz
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation
from test_end_to_end import PAIR, Server, server
from wildcity import Pose

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "ros2_bridge.py"
STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(
    get_types_from_msg("std_msgs/Header header\nAckermannDrive drive\n", "ackermann_msgs/msg/AckermannDriveStamped")
)
DRIVE = "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"
STORE.register(get_types_from_msg(DRIVE, "ackermann_msgs/msg/AckermannDrive"))


def load() -> Any:
    spec = importlib.util.spec_from_file_location("ros2_bridge", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make(kind: str, **fields: Any) -> Any:
    values = {key: np.asarray(its) if isinstance(its, array.array) else its for key, its in fields.items()}
    return STORE.types[kind](**values)


def sent(message: Any) -> Any:
    """The message as it arrives: written by its type and read again, which a wrong field does not survive."""
    kind = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


BRIDGE = load()


def pose_of(turn: Any) -> Pose:
    return Pose(tuple(turn[:3, 3]), tuple(wxyz(turn)))


def camera(**fields: Any) -> Any:
    plain = {"name": "front", "width": 64, "height": 40, "fx": 50.0, "fy": 51.0, "cx": 32.5, "cy": 20.5}
    place = {"camera_to_rig": Pose((1.5, 0, 1.4), (0.5, -0.5, 0.5, -0.5)), "lens": None, "windshield": None}
    return SimpleNamespace(**{**plain, **place, **fields})


def bridge(**fields: Any) -> Any:
    return BRIDGE.Bridge(make, (camera(**fields),))


def observation(time_us: int = 12_345_678) -> Any:
    ego = SimpleNamespace(pose=pose_of(drive(1.0)), velocity=tuple(drive(1.0)[:3, 0] * 7.0), yaw_rate=0.2)
    info = SimpleNamespace(camera="front", shutter_end_us=time_us - 5_000)
    metadata = SimpleNamespace(time_us=time_us, ego=ego, images=(info,))
    pixels = np.arange(40 * 64 * 3, dtype=np.uint8).reshape(40, 64, 3)
    return SimpleNamespace(metadata=metadata, images={"front": pixels})


def test_messages_of_an_observation_have_the_types_of_ros() -> None:
    found = [(topic, sent(message)) for topic, message in bridge().messages(observation())]
    assert [topic for topic, _ in found] == ["/clock", "/tf", "/odom", "/front/camera_info", "/front/image_raw"]
    by = dict(found)
    assert (by["/clock"].clock.sec, by["/clock"].clock.nanosec) == (12, 345_678_000)
    odometry = by["/odom"]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "base_link")
    position, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
    np.testing.assert_allclose([position.x, position.y, position.z], drive(1.0)[:3, 3])
    np.testing.assert_allclose([turn.w, turn.x, turn.y, turn.z], wxyz(drive(1.0)))
    linear = odometry.twist.twist.linear  # In the axes of base_link: ahead.
    np.testing.assert_allclose([linear.x, linear.y, linear.z], [7, 0, 0], atol=1e-9)
    moved = by["/tf"].transforms[0]
    assert (moved.header.frame_id, moved.child_frame_id) == ("map", "base_link")
    image = by["/front/image_raw"]
    assert (image.header.stamp.sec, image.header.stamp.nanosec, image.header.frame_id) == (
        12,
        340_678_000,
        "front_optical",
    )
    assert (image.encoding, image.step, image.height, image.width) == ("rgb8", 192, 40, 64)
    assert np.array_equal(image.data.reshape(40, 64, 3), observation().images["front"])
    info = by["/front/camera_info"]
    assert info.k.tolist() == [50, 0, 32, 0, 51, 20, 0, 0, 1] and info.d.tolist() == [0] * 5


def test_the_mounts_of_the_cameras_are_static_frames() -> None:
    one = sent(bridge().static_frames()).transforms[0]
    assert (one.header.frame_id, one.child_frame_id) == ("base_link", "front_optical")
    assert (one.transform.translation.x, one.transform.rotation.w, one.transform.rotation.x) == (1.5, 0.5, -0.5)


def test_lenses_have_the_coefficients_of_opencv_or_are_refused() -> None:
    lens = SimpleNamespace(model="opencv", k=(1, 2, 3, 4, 5, 6), p=(7, 8), s=None)
    info = sent(bridge(lens=lens).camera_info(0, "front"))
    assert (info.distortion_model, info.d.tolist()) == ("rational_polynomial", [1, 2, 7, 8, 3, 4, 5, 6])
    lens = SimpleNamespace(model="fisheye", k=(1, 2, 3, 4), p=None, s=None)
    info = sent(bridge(lens=lens).camera_info(0, "front"))
    assert (info.distortion_model, info.d.tolist()) == ("equidistant", [1, 2, 3, 4])
    with pytest.raises(ValueError, match="no f-theta lens"):
        bridge(lens=SimpleNamespace(model="ftheta")).camera_info(0, "front")


def test_commands_become_movements() -> None:
    command = make("ackermann_msgs/msg/AckermannDrive", steering_angle=0.1, steering_angle_velocity=0.0, speed=8.0,
                   acceleration=2.0, jerk=0.0)  # fmt: skip
    action = bridge().ackermann(sent(command), 7.95, 100_000)
    assert action.acceleration == pytest.approx(0.5) and action.curvature == pytest.approx(math.tan(0.1) / 2.85)
    assert bridge().ackermann(command, 3.0, 100_000).acceleration == 2.0
    now = drive(1.0)
    poses = []
    for since_us, pose in ((-1, drive(0.9)), (100_000, drive(1.1)), (200_000, drive(1.2))):
        q, place = dict(zip("wxyz", wxyz(pose), strict=True)), dict(zip("xyz", map(float, pose[:3, 3]), strict=True))
        inner = make("geometry_msgs/msg/Pose", position=make("geometry_msgs/msg/Point", **place),
                     orientation=make("geometry_msgs/msg/Quaternion", **q))  # fmt: skip
        head = bridge().header(5_000_000 + since_us, "map")
        poses.append(make("geometry_msgs/msg/PoseStamped", header=head, pose=inner))
    path = sent(make("nav_msgs/msg/Path", header=bridge().header(5_000_000, "map"), poses=poses))
    trajectory = bridge().path(path, pose_of(now), 5_000_000)
    assert [one.time_us for one in trajectory.poses] == [100_000, 200_000]
    for one, seconds in zip(trajectory.poses, (1.1, 1.2), strict=True):
        w, x, y, z = one.pose.q
        ours = matrix(one.pose.xyz, Rotation.from_quat([x, y, z, w]))
        np.testing.assert_allclose(now @ ours, drive(seconds), atol=1e-9)
    with pytest.raises(ValueError, match="no pose after the present"):
        bridge().path(path, pose_of(now), 9_000_000)
    with pytest.raises(ValueError, match="in the frame 'odom'"):
        bridge().path(make("nav_msgs/msg/Path", header=bridge().header(0, "odom"), poses=[]), pose_of(now), 0)


def test_a_session_drives_by_the_messages(server: Server) -> None:
    """Two steps of a server, one by each kind of command, through the types of ROS."""
    with wildcity.connect(server.url) as client, client.open("corridor", rig=PAIR, dynamics="kinematic") as session:
        its = BRIDGE.Bridge(make, session.opened.cameras)
        seen = session.reset(seed=1)
        names = [camera.name for camera in session.opened.cameras]
        for _ in range(2):
            topics = {topic: sent(message) for topic, message in its.messages(seen)}
            assert {f"/{name}/image_raw" for name in names} <= topics.keys()
            assert np.array_equal(topics[f"/{names[0]}/image_raw"].data, seen.images[names[0]].reshape(-1))
            command = SimpleNamespace(steering_angle=0.0, speed=5.0, acceleration=0.0)
            seen = session.step(its.ackermann(command, 0.0, session.opened.dt_us))
        assert seen.metadata.time_us == 2 * session.opened.dt_us
