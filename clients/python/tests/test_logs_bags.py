"""Bags to a log: rosbag2, MCAP and ROS 1, written by `rosbags` and `mcap`, against NumPy and COLMAP's lenses."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from logs_bags import (
    CAMERAS,
    FORMATS,
    IMU,
    SIZE,
    START_NS,
    K,
    Maker,
    Recorded,
    frame_times_ns,
    raw_pixels,
    sweep,
    time_s,
    write,
)
from logs_truth import Log, drive, image_bytes, killed_and_resumed, moved, points_seen, refused, run, same_poses
from PIL import Image

COLMAP_MODELS = {
    "plumb_bob": ("FULL_OPENCV", lambda d: [*d, 0, 0, 0]),
    "rational_polynomial": ("FULL_OPENCV", list),
    "equidistant": ("OPENCV_FISHEYE", list),
}


@pytest.fixture(scope="module", params=FORMATS)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Log, str]:
    folder = tmp_path_factory.mktemp(request.param)
    source = write(folder / "bag", request.param)
    said = run(source, "--out", folder / "log")
    return request.param, source, Log(folder / "log"), said


Made = tuple[str, Path, Log, str]


def test_times_are_the_recorded_ones_and_gaps_are_reported(made: Made) -> None:
    _, _, log, said = made
    for name in CAMERAS:
        assert log.times("images", camera=f"camera_{name}") == [time // 1000 for time in frame_times_ns(name)]
    assert log.times("imu") == [(START_NS + 10_000_000 * n + 123_456) // 1000 for n in range(120)]
    assert log.head["clock"]["offsets_us"] == {} and log.epoch_us % 1_000_000 == 0
    gaps = sorted(line for line in said.splitlines() if line.startswith("gap: "))
    assert [gap.split(":")[1] for gap in gaps] == [" gps", " images camera_front", " images camera_left"], gaps
    assert "1 interval longer than 1.5 x 0.1 s, the longest 0.2 s" in gaps[1]
    assert "1 interval longer than 1.5 x 0.05 s, the longest 0.15 s" in gaps[2]


def test_poses_are_those_of_the_bag(made: Made) -> None:
    _, _, log, _ = made
    times = [(START_NS + 20_000_000 * n) // 1000 for n in range(-30, 90)]
    same_poses(log, {time: drive((time - START_NS // 1000 + 0.0) / 1e6) for time in times if time in log.poses()})
    # Beyond the last transform of map -> odom, at 80, there is no pose of the world; the odometry has all.
    assert sorted(log.poses()) == (times if made[0] == "ros1" else times[:111])


def test_points_have_the_pixels_of_other_programs(made: Made) -> None:
    _, _, log, _ = made
    for name, (pose, model, d, _, _) in CAMERAS.items():
        inside = points_seen(K, SIZE)
        assert (log.rig[f"camera_{name}"]["width"], log.rig[f"camera_{name}"]["height"]) == SIZE
        kind, parameters = COLMAP_MODELS[model]
        values = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *parameters(d)]  # COLMAP counts as we do.
        judge = pycolmap.Camera(model=kind, width=SIZE[0], height=SIZE[1], params=values)
        for time_us in log.times("images", camera=f"camera_{name}")[::4]:
            world_from_rig = drive(time_s(time_us))
            xyz, turn = log.between(np.array([time_us]))
            posed = np.eye(4)
            posed[:3, :3], posed[:3, 3] = turn[0].as_matrix(), xyz[0]
            ours = log.project(f"camera_{name}", posed, moved(world_from_rig @ pose, inside))
            np.testing.assert_allclose(ours, judge.img_from_cam(inside), rtol=0, atol=0.05)


def test_the_lidar_is_deskewed_by_its_own_times(made: Made) -> None:
    _, _, log, _ = made
    rows = log.rows("lidar")
    assert len(rows) == 11 and {row["lidar"] for row in rows} == {"lidar_points"}
    for number, row in enumerate(rows, 1):
        found, times = log.sweep_in_world(row)
        _, offsets, world = sweep(number)
        assert "compensated_to_us" not in row
        np.testing.assert_allclose(times - START_NS // 1000, 100_000 * number + offsets * 1e6, rtol=0, atol=1.5)
        np.testing.assert_allclose(found, world, rtol=0, atol=1e-3)


def test_images_are_the_recorded_ones(made: Made) -> None:
    _, _, log, _ = made
    for number, name in enumerate(CAMERAS):
        for n, row in enumerate(one for one in log.rows("images") if one["camera"] == f"camera_{name}"):
            data = (log.folder / row["file"]).read_bytes()
            if name == "left":
                assert row["file"].endswith(".jpg") and data == image_bytes(100 + n)
            else:
                pixels = np.asarray(Image.open(io.BytesIO(data)))
                wanted = raw_pixels(1000 * number + n)
                assert row["file"].endswith(".png") and np.array_equal(pixels, wanted[..., :: -1 if number else 1])


def test_the_imu_is_in_the_axes_of_the_rig_and_the_rest_is_named(made: Made) -> None:
    _, _, log, said = made
    row = log.rows("imu")[50]
    np.testing.assert_allclose(row["angular_velocity_rad_per_s"], IMU[:3, :3] @ [0.1, 0.2, 0.5], atol=1e-12)
    np.testing.assert_allclose(row["acceleration_m_per_s2"], [0.5, 0, 9.81], atol=1e-12)
    assert [round(one["latitude_deg"], 7) for one in log.rows("gps")] == [47.4, 47.4002, 47.4006, 47.4008, 47.401]
    left_out = " | ".join(log.head["left_out"])
    assert "messages of /weather: 6 (std_msgs/msg/String is not read)" in left_out
    assert "messages of /fix without a fix: 1" in left_out and left_out.split(" | ")[0] in said


def test_a_killed_run_goes_on(made: Made, tmp_path: Path) -> None:
    kind, source, log, _ = made
    if kind in ("mcap", "ros1"):
        killed_and_resumed(tmp_path, log.folder, source, after=20)


Change = Callable[[Maker, Recorded], Recorded]


def without(topic: str) -> Change:
    return lambda _, found: [one for one in found if one[1] != topic]


def swapped(m: Maker, found: Recorded) -> Recorded:
    """Two images change their places in the bag, but not their stamps."""
    times = [index for index, one in enumerate(found) if one[1] == "/camera/front/image_raw"]
    a, b = times[4], times[5]
    found[a], found[b] = (found[a][0], found[a][1], found[b][2]), (found[b][0], found[b][1], found[a][2])
    return found


def with_message(topic: str, make: Callable[[Maker], Any]) -> Change:
    """The messages of a topic are replaced by one other."""
    return lambda m, found: [*without(topic)(m, found), (START_NS + 5_000_000, topic, make(m))]


def in_milliseconds(m: Maker) -> Any:
    xyz, offsets, _ = sweep(3)
    return m.cloud(START_NS, xyz, (offsets * 1000).astype("<f4"))


def omni(m: Maker) -> Any:
    info = m.info(START_NS, "front")
    info.distortion_model = "omni"
    return info


def moving_mount(m: Maker, found: Recorded) -> Recorded:
    one = m.transform(START_NS, "base_link", "lidar", np.eye(4))
    kept = [entry for entry in found if entry[1] != "/tf_static"]
    mounts = [m.transform(START_NS, "base_link", f"{name}_optical", its[0]) for name, its in CAMERAS.items()]
    mounts.append(m.transform(START_NS, "base_link", "imu", IMU))
    return [*kept, (START_NS - 9, "/tf_static", m.frames(*mounts)), (START_NS, "/tf", m.frames(one))]


def far(m: Maker) -> Any:
    pose = np.eye(4)
    pose[:3, 3] = 1600, 100, 1500
    frames = ["lidar", "imu", *(f"{name}_optical" for name in CAMERAS)]
    return m.frames(*(m.transform(START_NS, "base_link", frame, pose) for frame in frames))


BAD: dict[str, tuple[Change, str]] = {
    "no calibration": (
        without("/camera/front/camera_info"), "no CameraInfo for /camera/front/image_raw: the rig has no intrinsics"),
    "no mounts": (without("/tf_static"), "no transform from base_link to front_optical"),
    "no poses": (without("/tf"), "tf: nothing moves between base_link and base_link"),
    "a clock that runs backwards": (swapped, "topic /camera/front/image_raw: the clock runs backwards"),
    "milliseconds": (with_message("/lidar/points", in_milliseconds), "field time: a point is 89"),
    "millimetres": (with_message("/tf_static", far), "perhaps it is millimetres"),
    "an unknown lens": (with_message("/camera/front/camera_info", omni), "the lens model 'omni'; rigs have opencv"),
    "an unknown encoding": (
        with_message("/camera/front/image_raw", lambda m: m.raw(START_NS, "front", raw_pixels(0), "bayer_rggb8")),
        "the encoding 'bayer_rggb8'; rgb8",
    ),
    "no stamps": (with_message("/imu", lambda m: m.imu(0, (0, 0, 0), (0, 0, 0))), "topic /imu: header.stamp is 0"),
    "a moving mount": (moving_mount, "LiDAR lidar_points moves on the rig"),
    "two calibrations": (
        lambda m, found: [*found, (START_NS + 10**9, "/camera/front/camera_info", omni(m))], "the calibration changes"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_bags_are_refused(name: str, tmp_path: Path) -> None:
    change, words = BAD[name]
    source = write(tmp_path / "bag", "sqlite3", change)
    text = refused(tmp_path, source)
    assert words in text and str(source) in text, text


def test_a_camera_without_a_calibration_in_the_bag_takes_that_of_a_rig_file(made: Made, tmp_path: Path) -> None:
    """Neither its CameraInfo nor its mount is in the bag."""

    def change(m: Maker, found: Recorded) -> Recorded:
        kept = without("/camera/front/camera_info")(m, found)
        for _, topic, message in kept:
            if topic == "/tf_static":
                message.transforms = [one for one in message.transforms if one.child_frame_id != "front_optical"]
        return kept

    source = write(tmp_path / "bag", "sqlite3", change)
    assert "give the camera camera_front with --rig FILE" in refused(tmp_path, source)
    front = {**made[2].rig["camera_front"], "cx": 111.5}
    rig = {"name": "r", "cameras": [front, {**front, "name": "roof"}]}
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    said = run(source, "--rig", tmp_path / "rig.json", "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    assert log.rig["camera_front"] == front and log.rig["camera_left"] == made[2].rig["camera_left"]
    assert len(log.times("images", camera="camera_front")) == 11
    assert "left out: camera roof of --rig: 1 (the bag has camera_front, camera_left, camera_right)" in said


def test_a_topic_can_be_left_out(tmp_path: Path) -> None:
    """The IMU has no mount: the bag is refused until the user leaves it out."""

    def change(m: Maker, found: Recorded) -> Recorded:
        for _, topic, message in found:
            if topic == "/tf_static":
                message.transforms = [one for one in message.transforms if one.child_frame_id != "imu"]
        return found

    source = write(tmp_path / "bag", "sqlite3", change)
    assert "the frame of the IMU" in (text := refused(tmp_path, source)) and "--leave-out TOPIC" in text
    said = run(source, "--leave-out", "/imu", "--leave-out", "/fix", "--out", tmp_path / "log")
    assert "messages of /imu: 120 (the user left it out)" in said and not Log(tmp_path / "log").rows("gps")
    assert "no topic /nothing, only " in refused(tmp_path, source, "--leave-out", "/nothing")


def test_an_imu_without_accelerations_gives_no_zeros(tmp_path: Path) -> None:
    """By sensor_msgs/Imu, a first covariance of -1 says that the message has no such measurement."""

    def change(_: Maker, found: Recorded) -> Recorded:
        messages = [message for _, topic, message in found if topic == "/imu"]
        messages[3].linear_acceleration_covariance[0] = -1
        messages[4].angular_velocity_covariance[0] = -1
        messages[5].angular_velocity.x = float("nan")
        return found

    run(write(tmp_path / "bag", "sqlite3", change), "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    assert len(log.rows("imu")) == 117
    left_out = " ".join(log.head["left_out"])
    assert "messages of /imu without a measurement: 2 (a covariance of -1" in left_out
    assert "rows of the IMU that are not finite: 1" in left_out


@pytest.mark.parametrize("kind", ["mcap_package", "ros1"])
def test_a_broken_bag_is_refused(kind: str, tmp_path: Path) -> None:
    source = write(tmp_path / "bag", kind)
    whole = source.read_bytes()
    source.write_bytes(whole[: len(whole) // 2])
    text = refused(tmp_path, source)
    assert "bag: " in text and "reindex" in text and not (tmp_path / "refused.partial").exists()


def test_references_of_a_bag_are_refused(made: Made, tmp_path: Path) -> None:
    assert "--reference: images of this source are in no files" in refused(tmp_path, made[1], "--reference")


@pytest.mark.parametrize(("kind", "unit"), [("<u4", 1e9), ("<f8", 1.0), ("<f8 absolute", 1.0)])
def test_times_of_points_in_other_types(kind: str, unit: float, tmp_path: Path) -> None:
    xyz, offsets, _ = sweep(2)
    later = offsets.astype(np.float64) + 0.1
    times = later * unit + (START_NS / 1e9 if "absolute" in kind else 0)

    def change(m: Maker, found: Recorded) -> Recorded:
        cloud = m.cloud(START_NS, xyz, times.astype(kind[:3]), "t" if kind == "<u4" else "timestamp")
        return [*without("/lidar/points")(m, found), (START_NS, "/lidar/points", cloud)]

    run(write(tmp_path / "bag", "sqlite3", change), "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    _, found = log.sweep_in_world(log.rows("lidar")[0])
    np.testing.assert_allclose(found, START_NS // 1000 + later * 1e6, rtol=0, atol=1.5)
