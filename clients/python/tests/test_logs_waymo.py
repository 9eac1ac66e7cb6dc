"""Waymo Open v2 to a log: a miniature segment by the schema of its repository, against NumPy and COLMAP's lens."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
import pycolmap
import pytest
from logs_truth import (
    Array,
    Log,
    drive,
    image_bytes,
    killed_and_resumed,
    matrix,
    moved,
    points_seen,
    refused,
    run,
    same_poses,
)
from scipy.spatial.transform import Rotation

SEGMENT = "10023947602400723454_1120_000_1140_000"
START_S = 1_552_440_195.4
START = (860.0, 1568.0, -65.0)
FRAMES = 4
CAMERAS = {1: (1.5, 0.0, 0.0), 2: (1.4, 0.1, 45.0), 4: (1.3, 0.2, 90.0)}
SIZE, LENS = (1920, 1280), [0.04, -0.33, 0.001, -0.0005, 0.01]
FOCAL = (2055.5, 2056.5, 939.6, 641.1)
TOP = matrix([1.43, 0.0, 2.184], Rotation.from_euler("ZYX", [2.6, 0.005, 0.002]))
FRONT = matrix([4.07, 0.0, 0.69], Rotation.from_euler("z", 0.01))
BEAMS = np.linspace(-0.31, 0.04, 8)
WIDTH = 60


def world(seconds: float) -> Array:
    """world_from_vehicle as the data set has it: in f32."""
    return drive(seconds, START).astype(np.float32).astype(np.float64)


def frame_us(frame: int) -> int:
    return round((START_S + 0.1 * frame) * 1e6)


def pose_s(frame: int, camera: int) -> float:
    return START_S + 0.1 * frame + 0.05 + 0.003 * camera


def write(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.parquet.write_table(pyarrow.table(columns), str(path), row_group_size=3)


def transforms(poses: list[Array]) -> Any:
    flat = np.concatenate([pose.reshape(-1) for pose in poses]).astype(np.float32)
    return pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(flat), 16)


def rotation_angles(pose: Array) -> Array:
    return Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")[::-1]


def pixel_pose_s(frame: int) -> Array:
    """Seconds since the start at which each column of the top laser was measured."""
    return 0.1 * frame + 0.1 * np.arange(WIDTH) / WIDTH


def ranges(frame: int, laser: int) -> Array:
    image = np.random.default_rng(10 * frame + laser).uniform(2, 40, (8, WIDTH, 4)).astype(np.float32)
    image[2, ::3, 0] = -1
    return image


def laser_points(frame: int, laser: int) -> Array:
    """Points of the world of one range image: the definition in the repository, pixel by pixel."""
    image, mount, found = ranges(frame, laser), TOP if laser == 1 else FRONT, []
    beams = BEAMS if laser == 1 else -1.5 + 3.0 * (np.arange(8) + 0.5) / 8
    for row in range(8):
        for column in range(WIDTH):
            if image[row, column, 0] <= 0:
                continue
            turn = ((WIDTH - column - 0.5) / WIDTH * 2 - 1) * np.pi - np.arctan2(mount[1, 0], mount[0, 0])
            tilt, distance = beams[::-1][row], float(image[row, column, 0])
            point = distance * np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
            pose = world(float(pixel_pose_s(frame)[column])) if laser == 1 else world(0.1 * frame + 0.049)
            found.append(moved(pose @ mount, point[None])[0])
    return np.array(found)


def make(root: Path) -> Path:
    def file(component: str) -> Path:
        return root / component / f"{SEGMENT}.parquet"

    rows = [(frame, camera) for frame in range(FRAMES) for camera in CAMERAS if (frame, camera) != (2, 4)]
    prefix = "[CameraImageComponent]."
    key = {
        "key.segment_context_name": [SEGMENT] * len(rows),
        "key.frame_timestamp_micros": [frame_us(f) for f, _ in rows],
    }
    key |= {"key.camera_name": pyarrow.array([camera for _, camera in rows], pyarrow.int8())}
    done = [pose_s(*row) + 0.02 for row in rows]
    write(file("camera_image"), {
        **key,
        f"{prefix}image": [image_bytes(10 * frame + camera) for frame, camera in rows],
        f"{prefix}pose.transform": transforms([world(pose_s(*row) - START_S) for row in rows]),
        f"{prefix}pose_timestamp": [pose_s(*row) for row in rows],
        f"{prefix}rolling_shutter_params.shutter": [0.004] * len(rows),
        f"{prefix}rolling_shutter_params.camera_trigger_time": [time - 0.044 for time in done],
        f"{prefix}rolling_shutter_params.camera_readout_done_time": done,
    })  # fmt: skip
    prefix = "[CameraCalibrationComponent]."
    names = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
    lens = {
        f"{prefix}intrinsic.{name}": [value] * len(CAMERAS) for name, value in zip(names, [*FOCAL, *LENS], strict=True)
    }
    write(file("camera_calibration"), {
        "key.camera_name": list(CAMERAS), **lens,
        f"{prefix}extrinsic.transform": transforms([extrinsic(camera) for camera in CAMERAS]),
        f"{prefix}width": [SIZE[0]] * 3, f"{prefix}height": [SIZE[1]] * 3,
        f"{prefix}rolling_shutter_direction": [2, 4, 5],
    })  # fmt: skip
    write(file("vehicle_pose"), {
        "key.frame_timestamp_micros": [frame_us(frame) for frame in range(FRAMES)],
        "[VehiclePoseComponent].world_from_vehicle.transform":
            transforms([world(0.1 * frame + 0.049) for frame in range(FRAMES)]),
    })  # fmt: skip
    lasers(file)
    prefix, boxes = "[LiDARBoxComponent].", [1, 2, 4, 3, 0]
    numbers = {"center.x": 12.0, "center.y": -3.0, "center.z": 0.9, "size.x": 4.6, "size.y": 2.0, "size.z": 1.7}
    write(file("lidar_box"), {
        "key.frame_timestamp_micros": [frame_us(1)] * 5, "key.laser_object_id": [f"AB-{n}" for n in range(5)],
        f"{prefix}type": boxes, f"{prefix}box.heading": [0.6] * 5,
        **{f"{prefix}box.{name}": [value] * 5 for name, value in numbers.items()},
    })  # fmt: skip
    return root


def extrinsic(camera: int) -> Array:
    """vehicle_from_camera, with the camera's x ahead."""
    x, y, yaw = CAMERAS[camera]
    return matrix([x, y, 2.1], Rotation.from_euler("ZYX", [yaw, 1, 0.5], degrees=True))


def lasers(file: Callable[[str], Path]) -> None:
    rows = [(frame, laser) for frame in range(FRAMES) for laser in (1, 2)]
    key = {"key.frame_timestamp_micros": [frame_us(frame) for frame, _ in rows]}
    key["key.laser_name"] = [laser for _, laser in rows]
    images = [ranges(*row) for row in rows]
    prefix = "[LiDARComponent].range_image_return"
    nothing = np.full((8, WIDTH, 4), -1, np.float32)
    columns: dict[str, Any] = {}
    for number, its in ((1, images), (2, [nothing] * len(rows))):
        columns[f"{prefix}{number}.values"] = [image.reshape(-1).tolist() for image in its]
        columns[f"{prefix}{number}.shape"] = [list(image.shape) for image in its]
    write(file("lidar"), {**key, **columns})
    prefix = "[LiDARPoseComponent].range_image_return1"
    values = []
    for frame in range(FRAMES):
        poses = [world(float(time)) for time in pixel_pose_s(frame)]
        line = np.array([[*rotation_angles(pose), *pose[:3, 3]] for pose in poses], np.float32)
        values.append(np.broadcast_to(line, (8, WIDTH, 6)).reshape(-1).tolist())
    write(file("lidar_pose"), {
        "key.frame_timestamp_micros": [frame_us(frame) for frame in range(FRAMES)], "key.laser_name": [1] * FRAMES,
        f"{prefix}.values": values, f"{prefix}.shape": [[8, WIDTH, 6]] * FRAMES,
    })  # fmt: skip
    prefix = "[LiDARCalibrationComponent]."
    write(file("lidar_calibration"), {
        "key.laser_name": [1, 2], f"{prefix}extrinsic.transform": transforms([TOP, FRONT]),
        f"{prefix}beam_inclination.min": [0.0, -1.5], f"{prefix}beam_inclination.max": [0.0, 1.5],
        f"{prefix}beam_inclination.values": [BEAMS.tolist(), None],
    })  # fmt: skip


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("waymo"))


@pytest.fixture(scope="module")
def log(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Log:
    out = tmp_path_factory.mktemp("log") / "log"
    run(source, "--out", out)
    return Log(out)


def test_poses_times_and_images_are_the_recorded_ones(log: Log) -> None:
    rows = [(frame, camera) for frame in range(FRAMES) for camera in CAMERAS if (frame, camera) != (2, 4)]
    same_poses(log, {round(pose_s(*row) * 1e6): world(pose_s(*row) - START_S) for row in rows})
    # The middle of the exposure of the last column, of 4 ms; the readout of all columns takes 44 - 4 ms.
    found = {(row["camera"], row["time_us"] + log.epoch_us): row for row in log.rows("images")}
    names = {1: "front", 2: "front_left", 4: "side_left"}
    for frame, camera in rows:
        row = found.pop((names[camera], round((pose_s(frame, camera) + 0.018) * 1e6)))
        assert row["exposure_us"] == 4000
        assert (log.folder / row["file"]).read_bytes() == image_bytes(10 * frame + camera)
    assert not found
    assert log.rig["front"]["shutter"] == {"direction": "left_to_right", "duration_us": 40000}
    assert log.rig["front_left"]["shutter"]["direction"] == "right_to_left" and "shutter" not in log.rig["side_left"]


def test_points_have_the_pixels_of_the_definition(log: Log) -> None:
    k = np.array([[FOCAL[0], 0, FOCAL[2]], [0, FOCAL[1], FOCAL[3]], [0, 0, 1]])
    values = [*FOCAL, *LENS, 0, 0, 0]
    model = pycolmap.Camera(model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=values)
    for camera, name in ((1, "front"), (2, "front_left"), (4, "side_left")):
        seconds = pose_s(1, camera) - START_S
        ahead = points_seen(k, SIZE)[:, [2, 0, 1]] * [1, -1, -1]  # x ahead, y left, z up.
        seen = moved(world(seconds) @ extrinsic(camera), ahead)
        theirs = model.img_from_cam(np.stack([-ahead[:, 1], -ahead[:, 2], ahead[:, 0]], 1))
        ours = log.project(name, log.poses()[round(pose_s(1, camera) * 1e6)], seen)
        # Waymo counts from the corner, as we do.
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=0.01)
        assert (log.rig[name]["width"], log.rig[name]["height"]) == SIZE


def test_the_points_of_both_lasers_are_in_their_places(log: Log) -> None:
    rows = log.rows("lidar")
    assert len(rows) == 2 * FRAMES
    for row in rows:
        frame = round((row["time_us"] + log.epoch_us - frame_us(0)) / 1e5 - 0.53)
        found, _ = log.sweep_in_world(row)
        # f32 of the pixels' poses: 1e-4 m at 1568 m.
        wanted = laser_points(frame, 1 if row["lidar"] == "top" else 2)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-3)


def test_boxes(log: Log) -> None:
    rows = log.rows("tracks")
    assert [row["class"] for row in rows] == ["vehicle", "pedestrian", "bicycle", "object"]
    assert rows[0]["size"] == [4.6, 2.0, 1.7]
    wanted = world(0.149) @ matrix([12, -3, 0.9], Rotation.from_euler("z", 0.6))
    np.testing.assert_allclose(log.pose(rows[0]["world_from_box"]), wanted, rtol=0, atol=1e-4)
    assert "boxes of class TYPE_UNKNOWN: 1" in " ".join(log.head["left_out"])


def test_a_killed_run_goes_on(source: Path, log: Log, tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, log.folder, source, after=13)


def edited(component: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def act(root: Path) -> None:
        path = root / component / f"{SEGMENT}.parquet"
        columns = pyarrow.parquet.read_table(path).to_pydict()
        change(columns)
        write(path, columns)

    return act


def flatten(columns: dict[str, Any]) -> None:
    columns["[CameraImageComponent].pose.transform"][0] = [0.0] * 16


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "a missing component": (
        lambda r: (r / "vehicle_pose" / f"{SEGMENT}.parquet").unlink(), "missing: the component vehicle_pose"),
    "a missing column": (
        edited("lidar_box", lambda t: t.pop("[LiDARBoxComponent].box.heading")), "no column [LiDARBoxComponent]"),
    "no intrinsics": (
        edited("camera_calibration", lambda t: t["[CameraCalibrationComponent].intrinsic.f_u"].__setitem__(0, 0.0)),
        "camera front has no intrinsics"),
    "no rotation": (edited("camera_image", flatten), "a transform is no rotation"),
    "two poses at a time": (
        edited("camera_image", lambda t: t["[CameraImageComponent].pose_timestamp"].__setitem__(5, pose_s(0, 1))),
        "two poses of the vehicle at"),
    "no frame": (
        edited("lidar", lambda t: t["key.frame_timestamp_micros"].__setitem__(0, 7)), "the frame 7 has no image"),
    "no laser": (edited("lidar_calibration", lambda t: t["key.laser_name"].__setitem__(0, 3)), "of the laser 1"),
    "a broken file": (
        lambda r: (r / "lidar" / f"{SEGMENT}.parquet").write_bytes(b"PAR1 and no more"), "not a Parquet file"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_segments_are_refused(name: str, tmp_path: Path) -> None:
    root = make(tmp_path / "data")
    BAD[name][0](root)
    text = refused(tmp_path, root)
    assert BAD[name][1] in text, text
