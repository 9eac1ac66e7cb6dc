"""Zenseact Open Dataset to a log: a miniature sequence by the data classes of its package."""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs_truth import (
    Array,
    Log,
    drive,
    image_bytes,
    killed_and_resumed,
    matrix,
    mount,
    moved,
    points_seen,
    refused,
    run,
    same_poses,
    wxyz,
)
from scipy.spatial.transform import Rotation

START_US = 1_644_845_012_100_000
CAMERA, LIDAR = mount(2.0, 0, 1.3, 0.5, 1), matrix([0.2, 0, 1.8], Rotation.from_euler("z", 90, degrees=True))
K, SIZE = np.array([[2042.0, 0, 1956.1, 0], [0, 2042.5, 1077.3, 0], [0, 0, 1, 0]]), (3848, 2168)
DISTORTION = [0.0848, -0.0613, 0.0271, -0.0057]
KEY_US = START_US + 400_000


def iso(time_us: int) -> str:
    moment = datetime.datetime(1970, 1, 1) + datetime.timedelta(microseconds=time_us)
    return moment.isoformat(timespec="microseconds") + "Z"


def ego(time_us: float) -> Array:
    return drive((time_us - START_US) / 1e6, (0, 0, 0))


def sweep(number: int) -> tuple[Array, Array]:
    """Points of the world [200, 3] and their times after that of the file."""
    random = np.random.default_rng(number)
    offsets = random.permutation(200) * 450 - 45_000
    return moved(ego(START_US + 100_000 * number), random.uniform(-20, 20, (200, 3))), offsets


def make(root: Path) -> Path:
    folder = root / "sequences" / "000002"
    for name in ("camera_front_blur", "camera_front_dnat", "lidar_velodyne", "annotations"):
        (folder / name).mkdir(parents=True)
    times = [START_US + 10_000 * n for n in range(-10, 90)]
    motion = {"timestamps": [time / 1e6 for time in times], "poses": [ego(time).tolist() for time in times]}
    motion |= {name: [[0, 0, 0]] * len(times) for name in ("velocities", "accelerations", "angular_rates")}
    (folder / "ego_motion.json").write_text(json.dumps({**motion, "origin_lat_lon": [57.7, 11.9]}))
    front = {"extrinsics": CAMERA.tolist(), "lidar_extrinsics": LIDAR.tolist(), "intrinsics": K.tolist()}
    front |= {"distortion": DISTORTION, "undistortion": [0.0] * 4, "image_dimensions": list(SIZE)}
    (folder / "calibration.json").write_text(json.dumps({"FC": {**front, "field_of_view": [120.0, 67.0]}}))
    cameras: dict[str, list[dict[str, Any]]] = {"front_blur": [], "front_dnat": []}
    for n in range(8):
        for kind in ("blur", "dnat"):
            if (n, kind) != (5, "dnat"):
                name = f"sequences/000002/camera_front_{kind}/000002_india_{iso(START_US + 100_000 * n)}.jpg"
                (root / name).write_bytes(image_bytes(10 * n + len(kind)))
                frame = {"filepath": name, "time": iso(START_US + 100_000 * n), "height": SIZE[1], "width": SIZE[0]}
                cameras[f"front_{kind}"].append(frame)
    lidars = [lidar(root, number) for number in range(1, 6)]
    write_annotations(folder / "annotations" / "object_detection.json")
    annotations = {"object_detection": {"project": "object_detection",
                   "filepath": "sequences/000002/annotations/object_detection.json"}}  # fmt: skip
    info = {"id": "000002", "start_time": iso(START_US), "keyframe_time": iso(KEY_US), "annotations": annotations}
    paths = {f"{name}_path": f"sequences/000002/{name}.json" for name in ("calibration", "ego_motion", "metadata")}
    frames = {"camera_frames": cameras, "lidar_frames": {"velodyne": lidars}, "radar_frames": {"front": [{}]}}
    (folder / "info.json").write_text(json.dumps({**info, **paths, **frames}))
    return root


def lidar(root: Path, number: int) -> dict[str, Any]:
    core_us = START_US + 100_000 * number
    world, offsets = sweep(number)
    is_compensated = number == 5
    found = np.zeros(200, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<i8"),
                           ("intensity", "u1"), ("diode_index", "u1")])  # fmt: skip
    poses = [ego(core_us if is_compensated else core_us + int(offset)) @ LIDAR for offset in offsets]
    xyz = np.array([moved(np.linalg.inv(pose), point[None])[0] for pose, point in zip(poses, world, strict=True)])
    for axis, values in zip("xyz", xyz.T, strict=True):
        found[axis] = values
    found["timestamp"], found["diode_index"] = offsets, np.arange(200) % 128
    name = f"sequences/000002/lidar_velodyne/000002_quebec_{iso(core_us)}.npy"
    np.save(root / name, found)
    return {"filepath": name, "time": iso(core_us), "is_compensated": is_compensated}


def write_annotations(path: Path) -> None:
    box, rows = matrix([3, 12, -0.9], Rotation.from_euler("z", 0.4)), []
    turn = dict(zip([f"orientation_3d_q{axis}" for axis in "wxyz"], wxyz(box), strict=True))
    kinds = [("Vehicle", "Car"), ("VulnerableVehicle", "Bicycle"), ("Pedestrian", None), ("PoleObject", None)]
    for number, (name, kind) in enumerate([*kinds, ("Blob", None), ("Vehicle", "Van")]):
        place = {"location_3d": {"type": "Point", "coordinates": [float(v) for v in box[:3, 3]]}, **turn}
        size = {"size_3d_length": 4.4, "size_3d_width": 1.8, "size_3d_height": 1.5}
        values = {"annotation_uuid": f"uuid-{number}", "class": name, "type": kind, "unclear": False}
        rows.append({"geometry": {}, "properties": {**values, **(place | size if number < 5 else {})}})
    path.write_text(json.dumps(rows))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("zod"))


@pytest.fixture(scope="module")
def log(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Log:
    out = tmp_path_factory.mktemp("log") / "log"
    assert "gap: images front: 1 interval longer than" in run(source, "--out", out)
    return Log(out)


def test_poses_times_and_images_are_the_recorded_ones(log: Log) -> None:
    same_poses(log, {START_US + 10_000 * n: ego(START_US + 10_000 * n) for n in range(-10, 90)})
    frames = [n for n in range(8) if n != 5]
    assert log.times("images", camera="front") == [START_US + 100_000 * n for n in frames]
    for n, row in zip(frames, log.rows("images"), strict=True):
        assert (log.folder / row["file"]).read_bytes() == image_bytes(10 * n + 4)
    assert "images front_blur: 8 (the log has front_dnat)" in " ".join(log.head["left_out"])


def test_points_have_the_pixels_of_the_package(log: Log) -> None:
    """The formula of project_3d_to_2d_kannala."""
    inside = points_seen(K[:, :3], SIZE, margin=0.02)
    radius = np.hypot(inside[:, 0], inside[:, 1])
    t = np.arctan2(radius, inside[:, 2])
    bent = t * (1 + DISTORTION[0] * t**2 + DISTORTION[1] * t**4 + DISTORTION[2] * t**6 + DISTORTION[3] * t**8)
    theirs = np.stack(
        [K[0, 0] * bent * inside[:, 0] / radius + K[0, 2], K[1, 1] * bent * inside[:, 1] / radius + K[1, 2]], 1
    )
    ours = log.project("front", log.poses()[KEY_US], moved(ego(KEY_US) @ CAMERA, inside))
    np.testing.assert_allclose(ours - 0.5, theirs, rtol=0, atol=1e-3)
    assert (log.rig["front"]["width"], log.rig["front"]["height"]) == SIZE


def test_the_lidar_is_deskewed_by_its_own_times(log: Log) -> None:
    rows = log.rows("lidar")
    assert len(rows) == 5 and [("compensated_to_us" in row) for row in rows] == [False] * 4 + [True]
    for number, row in enumerate(rows, 1):
        found, times = log.sweep_in_world(row)
        world, offsets = sweep(number)
        order = np.argsort(offsets)
        assert np.array_equal(times, START_US + 100_000 * number + offsets[order])
        np.testing.assert_allclose(found, world[order], rtol=0, atol=1e-3)


def test_boxes(log: Log) -> None:
    rows = log.rows("tracks")
    assert [row["class"] for row in rows] == ["vehicle", "bicycle", "pedestrian", "object"]
    wanted = ego(KEY_US) @ LIDAR @ matrix([3, 12, -0.9], Rotation.from_euler("z", 0.4))
    np.testing.assert_allclose(log.pose(rows[0]["world_from_box"]), wanted, rtol=0, atol=1e-6)
    assert rows[0]["size"] == [4.4, 1.8, 1.5] and rows[0]["time_us"] + log.epoch_us == KEY_US
    left_out = " ".join(log.head["left_out"])
    for part in ("class Blob: 1", "objects without a box in space: 1", "radar sequences: 1"):
        assert part in left_out


def test_a_killed_run_goes_on(source: Path, log: Log, tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, log.folder, source, after=9)


def edited(name: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def act(root: Path) -> None:
        path = root / "sequences" / "000002" / name
        found = json.loads(path.read_text())
        change(found)
        path.write_text(json.dumps(found))

    return act


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no calibration": (lambda r: (r / "sequences/000002/calibration.json").unlink(), "missing: the calibration"),
    "no intrinsics": (edited("calibration.json", lambda d: d["FC"].update(intrinsics=[])), "has no intrinsics"),
    "no focal length": (
        edited("calibration.json", lambda d: d["FC"]["intrinsics"][0].__setitem__(0, 0.0)), "has no intrinsics"),
    "a clock that runs backwards": (
        edited("ego_motion.json", lambda d: d["timestamps"].__setitem__(7, 1.0)), "the clock runs backwards"),
    "too few poses": (edited("ego_motion.json", lambda d: d["poses"].pop()), "99 poses for 100 times"),
    "no images": (edited("info.json", lambda d: d["camera_frames"].clear()), "no images of front_original"),
    "a bad time": (
        edited("info.json", lambda d: d["camera_frames"]["front_dnat"][0].update(time="noon")), "'noon' is no time"),
    "a broken sweep": (
        lambda r: next((r / "sequences/000002/lidar_velodyne").glob("*")).write_bytes(b"npy"), "no sweep of ZOD"),
    "millimetres": (
        edited("calibration.json", lambda d: d["FC"]["extrinsics"][0].__setitem__(3, 2000.0)), "perhaps it is millim"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_sequences_are_refused(name: str, tmp_path: Path) -> None:
    root = make(tmp_path / "data")
    BAD[name][0](root)
    text = refused(tmp_path, root)
    assert BAD[name][1] in text, text
