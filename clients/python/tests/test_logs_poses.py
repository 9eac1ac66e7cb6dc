"""Files of poses and calibrations to a log: TUM, EuRoC and KITTI; Kalibr, ROS and rig files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import yaml
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

START_NS = 1_403_636_579_763_555_584
FOCAL = (458.654, 457.296, 367.215, 248.375)
K = np.array([[FOCAL[0], 0, FOCAL[2]], [0, FOCAL[1], FOCAL[3]], [0, 0, 1]])
RADTAN = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
EQUI = [-0.012, 0.005, -0.0004, 0.0001]
SIZE = (752, 480)
BODY_FROM_CAMERAS = [mount(0.1, 0.05, 0.0, 5, 2), mount(0.1, -0.06, 0.0, -3)]
BODY_FROM_IMU = matrix([0, 0, 0], Rotation.from_euler("xyz", [0.1, 0.2, 0.3]))


def times_ns(count: int = 20, step: int = 5_000_512) -> list[int]:
    return [START_NS + step * n for n in range(count)]


def at(time_ns: int) -> Array:
    return drive((time_ns - START_NS) / 1e9)


def words(pose: Array) -> list[float]:
    """x y z qw qx qy qz."""
    return [*(float(v) for v in pose[:3, 3]), *wxyz(pose)]


def lines(path: Path, rows: list[list[Any]], head: str = "", by: str = " ") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(head + "".join(by.join(str(value) for value in row) + "\n" for row in rows))


def judge(model: str, coefficients: list[float]) -> Any:
    values = [FOCAL[0], FOCAL[1], FOCAL[2] + 0.5, FOCAL[3] + 0.5, *coefficients]  # COLMAP counts as we do.
    return pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=values)


def compare(log: Log, name: str, time_us: int, pose: Array, body_from_camera: Array, camera: Any) -> None:
    """100 points have the pixels of COLMAP's lens."""
    inside = points_seen(K, SIZE)
    ours = log.project(name, log.poses()[time_us], moved(pose @ body_from_camera, inside))
    np.testing.assert_allclose(ours, camera.img_from_cam(inside), rtol=0, atol=1e-3)
    assert (log.rig[name]["width"], log.rig[name]["height"]) == SIZE


def euroc(root: Path) -> Path:
    mav = root / "MH_01" / "mav0"
    for index, pose in enumerate(BODY_FROM_CAMERAS):
        found = {"sensor_type": "camera", "T_BS": {"cols": 4, "rows": 4, "data": pose.reshape(-1).tolist()}}
        found |= {"rate_hz": 20, "resolution": list(SIZE), "camera_model": "pinhole", "intrinsics": list(FOCAL)}
        found |= {"distortion_model": "radial-tangential", "distortion_coefficients": RADTAN}
        folder = mav / f"cam{index}"
        stamps = [START_NS + 50_000_000 * n for n in range(6) if (index, n) != (1, 2)]
        lines(folder / "data.csv", [[time, f"{time}.png"] for time in stamps], "#timestamp [ns],filename\n", ",")
        (folder / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(found))
        (folder / "data").mkdir()
        for time in stamps:
            (folder / "data" / f"{time}.png").write_bytes(image_bytes(time % 1000 + index, ".png"))
    rows = [[time, *words(at(time)), *[0.0] * 9] for time in times_ns(60)]
    lines(mav / "state_groundtruth_estimate0" / "data.csv", rows, "#timestamp, p_RS_R_x [m], ..\n", ",")
    imu = [[time, 0.1, 0.2, 0.3, 9.81, 0.5, -0.5] for time in times_ns(40)]
    lines(mav / "imu0" / "data.csv", imu, "#timestamp [ns],w_RS_S_x [rad s^-1],..\n", ",")
    found = {"T_BS": {"rows": 4, "cols": 4, "data": BODY_FROM_IMU.reshape(-1).tolist()}}
    (mav / "imu0" / "sensor.yaml").write_text(yaml.safe_dump(found))
    (mav / "leica0").mkdir()
    return root / "MH_01"


def test_euroc(tmp_path: Path) -> None:
    source = euroc(tmp_path)
    said = run(source, "--out", tmp_path / "log")
    assert "gap: images cam1: 1 interval longer than 1.5 x 0.05 s, the longest 0.1 s" in said
    log = Log(tmp_path / "log")
    same_poses(log, {time // 1000: at(time) for time in times_ns(60)})
    assert log.times("images", camera="cam0") == [(START_NS + 50_000_000 * n) // 1000 for n in range(6)]
    for index, pose in enumerate(BODY_FROM_CAMERAS):
        compare(log, f"cam{index}", START_NS // 1000, at(START_NS), pose, judge("OPENCV", RADTAN))
    row = log.rows("imu")[7]
    np.testing.assert_allclose(row["angular_velocity_rad_per_s"], BODY_FROM_IMU[:3, :3] @ [0.1, 0.2, 0.3])
    np.testing.assert_allclose(row["acceleration_m_per_s2"], BODY_FROM_IMU[:3, :3] @ [9.81, 0.5, -0.5])
    assert row["time_us"] + log.epoch_us == times_ns()[7] // 1000
    assert "the folder leica0" in " ".join(log.head["left_out"])
    killed_and_resumed(tmp_path, log.folder, source, after=4)


def kalibr(path: Path) -> Path:
    cameras = [np.linalg.inv(pose) for pose in BODY_FROM_CAMERAS]
    shared = {"camera_model": "pinhole", "intrinsics": list(FOCAL), "resolution": list(SIZE)}
    first = {**shared, "distortion_model": "radtan", "distortion_coeffs": RADTAN, "T_cam_imu": cameras[0].tolist()}
    step = (cameras[1] @ BODY_FROM_CAMERAS[0]).tolist()
    second = {**shared, "distortion_model": "equidistant", "distortion_coeffs": EQUI, "T_cn_cnm1": step}
    path.write_text(yaml.safe_dump({"cam0": first, "cam1": second}))
    return path


def test_poses_of_tum_with_a_calibration_of_kalibr(tmp_path: Path) -> None:
    rows = [
        [f"{time / 1e9:.6f}", *words(at(time))[:3], *words(at(time))[4:], words(at(time))[3]] for time in times_ns()
    ]
    lines(tmp_path / "poses.tum", rows, "# timestamp tx ty tz qx qy qz qw\n")
    run(tmp_path / "poses.tum", "--rig", kalibr(tmp_path / "camchain.yaml"), "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    # As they are written: six decimals, which a float of this size does not have.
    exact = [int(row[0].replace(".", "")) for row in rows]
    same_poses(log, {time_us: at(time) for time_us, time in zip(exact, times_ns(), strict=True)})
    compare(log, "cam0", exact[3], at(times_ns()[3]), BODY_FROM_CAMERAS[0], judge("OPENCV", RADTAN))
    compare(log, "cam1", exact[3], at(times_ns()[3]), BODY_FROM_CAMERAS[1], judge("OPENCV_FISHEYE", EQUI))


def ros(path: Path) -> Path:
    found = {"image_width": SIZE[0], "image_height": SIZE[1], "camera_name": "head"}
    found |= {"camera_matrix": {"rows": 3, "cols": 3, "data": K.reshape(-1).tolist()}}
    found |= {"distortion_model": "plumb_bob", "distortion_coefficients": {"data": [*RADTAN, 0.02]}}
    path.write_text(yaml.safe_dump(found))
    return path


def test_a_folder_of_tum_with_a_calibration_of_ros(tmp_path: Path) -> None:
    folder = tmp_path / "freiburg"
    cameras = {time: at(time) @ mount(0, 0, 0, 0) for time in times_ns()}
    rows = [[f"{time / 1e9:.4f}", *words(pose)[:3], *words(pose)[4:], words(pose)[3]] for time, pose in cameras.items()]
    lines(folder / "groundtruth.txt", rows, "# ground truth trajectory\n")
    images = [(f"{START_NS / 1e9 + 0.033 * n:.6f}", f"rgb/{n}.png") for n in range(4)]
    lines(folder / "rgb.txt", [list(row) for row in images], "# color images\n")
    (folder / "rgb").mkdir()
    for n in range(4):
        (folder / "rgb" / f"{n}.png").write_bytes(image_bytes(n, ".png"))
    lines(folder / "depth.txt", [["1", "depth/1.png"]])
    run(folder, "--rig", ros(tmp_path / "head.yaml"), "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    exact = [int(row[0].replace(".", "")) * 100 for row in rows]
    same_poses(log, {time_us: at(time) for time_us, time in zip(exact, times_ns(), strict=True)})
    assert log.times("images", camera="head") == [int(time.replace(".", "")) for time, _ in images]
    compare(log, "head", exact[5], at(times_ns()[5]), mount(0, 0, 0, 0), judge("FULL_OPENCV", [*RADTAN, 0.02, 0, 0, 0]))
    assert "rows of depth.txt: 1" in " ".join(log.head["left_out"])


def test_poses_of_kitti(tmp_path: Path) -> None:
    """The world has the axes of the first camera: x right, y down, z ahead."""
    axes = mount(0, 0, 0, 0)
    poses = [np.linalg.inv(axes) @ np.linalg.inv(at(times_ns()[0])) @ at(time) @ axes for time in times_ns()]
    lines(tmp_path / "00.txt", [pose[:3].reshape(-1).tolist() for pose in poses])
    lines(tmp_path / "times.txt", [[f"{0.001001 + 0.103 * n:.6e}"] for n in range(len(poses))])
    run(tmp_path / "00.txt", "--rig", ros(tmp_path / "camera.yaml"), "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    first = np.linalg.inv(at(times_ns()[0]))
    exact = [1_001 + 103_000 * n for n in range(20)]
    same_poses(log, {time_us: first @ at(time) for time_us, time in zip(exact, times_ns(), strict=True)})
    # Of a float, 0.001001 s would be 1000 us.
    assert log.epoch_us == 0 and log.rows("poses")[0]["time_us"] == 1_001


def test_poses_of_a_camera_of_a_rig_file(tmp_path: Path) -> None:
    rig = Path(__file__).resolve().parents[3] / "scenes" / "rigs" / "alpamayo1.json"
    pose = json.loads(rig.read_text())["cameras"][0]["camera_to_rig"]
    rig_from_camera = matrix(pose["xyz"], Rotation.from_quat([*pose["q"][1:], pose["q"][0]]))
    rows = [[time, *words(at(time) @ rig_from_camera)] for time in times_ns()]
    lines(tmp_path / "data.csv", rows, "#timestamp [ns], ..\n", ",")
    run(tmp_path / "data.csv", "--rig", rig, "--pose-of", "camera", "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    same_poses(log, {time // 1000: at(time) for time in times_ns()})
    assert log.rig["cross_left_120fov"]["lens"]["model"] == "ftheta"


BAD_POSES: dict[str, tuple[str, str]] = {
    "a clock that runs backwards": (
        "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n",
        "line 2: the time 1000000 us follows 2000000",
    ),
    "a clock that stands": ("2 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "the clock runs backwards, or stands"),
    "no quaternion": ("2 0 0 0 0 0 0 5\n", "line 1: the quaternion"),
    "no numbers": ("2 0 0 east 0 0 0 1\n", "are no numbers"),
    "not finite": ("2 0 0 nan 0 0 0 1\n", "a number is not finite"),
    "another format": ("2 0 0\n", "line 1: 3 words: TUM has 8"),
    "nothing": ("# empty\n", "no poses"),
    "KITTI without times": ("1 0 0 0 0 1 0 0 0 0 1 0\n", "times.txt: missing"),
}


@pytest.mark.parametrize("name", BAD_POSES)
def test_bad_poses_are_refused(name: str, tmp_path: Path) -> None:
    text, wanted = BAD_POSES[name]
    (tmp_path / "poses.txt").write_text(text)
    said = refused(tmp_path, tmp_path / "poses.txt", "--rig", ros(tmp_path / "camera.yaml"))
    assert wanted in said, said


BAD_RIGS: dict[str, tuple[str, str, str]] = {
    "omni": ("camchain.yaml", "camera_model: pinhole", "the camera model 'omni'; rigs have pinhole"),
    "fov": ("camchain.yaml", "distortion_model: radtan", "the lens model 'fov'; rigs have opencv"),
    "no intrinsics": ("camchain.yaml", "intrinsics:", "cam0: a row has no field intrinsics"),
    "no mapping": ("list.yaml", "", "no mapping of names to values"),
    "another file": ("other.yaml", "", "none of the fields cam0 (Kalibr)"),
    "broken": ("broken.yaml", "", "not YAML"),
    "INRIA": ("cameras.json", "", "3D Gaussian Splatting: it has no times"),
    "no cameras": ("rig.json", "", "no cameras"),
}
CONTENTS = {
    "list.yaml": "[1, 2]", "other.yaml": "a: 1", "broken.yaml": "a: [1", "rig.json": '{"name": "a", "cameras": []}',
    "cameras.json": '[{"id": 0, "img_name": "a", "width": 9, "height": 9, "position": [0, 0, 0], "fx": 9, "fy": 9}]',
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_RIGS)
def test_bad_calibrations_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("2 0 0 0 0 0 0 1\n")
    file, old, wanted = BAD_RIGS[name]
    path = tmp_path / file
    if file in CONTENTS:
        path.write_text(CONTENTS[file])
    else:
        text = kalibr(path).read_text()
        path.write_text(text.replace(old, "lost:" if name == "no intrinsics" else f"{old.split(':')[0]}: {name}"))
    said = refused(tmp_path, tmp_path / "poses.txt", "--rig", path)
    assert wanted in said and str(path) in said, said


def test_poses_without_a_calibration_are_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("2 0 0 0 0 0 0 1\n")
    assert "give a calibration with --rig FILE" in refused(tmp_path, tmp_path / "poses.txt")


def test_bad_euroc_is_refused(tmp_path: Path) -> None:
    source = euroc(tmp_path)
    images = source / "mav0" / "cam0" / "data.csv"
    whole = images.read_text()
    images.write_text(whole + f"{START_NS},{START_NS}.png\n")
    assert "data.csv, line 8: " in refused(tmp_path, source) and "backwards" in refused(tmp_path, source)
    images.write_text(whole)
    (source / "mav0" / "cam1" / "sensor.yaml").unlink()
    assert "sensor.yaml: missing: the calibration of a camera" in refused(tmp_path, source)
