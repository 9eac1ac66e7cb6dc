"""NVIDIA's Physical AI AV to a log: a miniature clip by the schema of ncore, against its definitions of lenses."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import DracoPy
import numpy as np
import pyarrow
import pyarrow.parquet
import pycolmap
import pytest
from logs_truth import Array, Log, drive, killed_and_resumed, matrix, mount, moved, refused, run, same_poses, wxyz
from PIL import Image
from scipy.spatial.transform import Rotation

CLIP = "01d503d4-449b-46fc-8d78-9085e70d3554"
SIZE = (64, 48)
SCALE = 30.0
CAMERAS = {
    "camera_front_wide_120fov": mount(1.7, 0, 1.5, 0, 2),
    "camera_rear_left_70fov": mount(1.0, 0.9, 1.2, 140),
    "camera_front_tele_30fov": mount(1.75, 0, 1.5, 0),
}
LIDAR = matrix([1.2, 0.0, 2.0], Rotation.from_euler("ZYX", [1.5, 0.02, 0.01]))
POLYNOMIAL = [0.0, 944.6 / SCALE, -20.7 / SCALE, 54.1 / SCALE, -87.5 / SCALE, 31.0 / SCALE]
INVERSE = [0.0, SCALE / 944.6, 1e-5, 0.0, 0.0, 0.0]
CDE = [0.99976, 5.5e-05, 1.7e-05]
WINDSHIELD = {
    "reference_poly": "BACKWARD", "horizontal_poly": [0.0, 1.0, 0.0], "vertical_poly": [0.0, 0.0, 1.0],
    "horizontal_poly_inverse": [0.001, 1.002, 0.0], "vertical_poly_inverse": [0.0, 0.0, 0.999],
}  # fmt: skip
SHARED = {"resolution": list(SIZE), "shutter_delay_us": 31_611, "external_distortion_parameters": None}
MODELS: dict[str, tuple[str, dict[str, Any]]] = {
    "camera_front_wide_120fov": ("ftheta", {
        **SHARED, "shutter_type": "ROLLING_TOP_TO_BOTTOM", "principal_point": [31.2, 24.4],
        "reference_poly": "ANGLE_TO_PIXELDIST", "angle_to_pixeldist_poly": POLYNOMIAL,
        "pixeldist_to_angle_poly": INVERSE, "max_angle": 1.346, "linear_cde": CDE,
        "external_distortion_parameters": WINDSHIELD, "external_distortion_type": "bivariate-windshield",
    }),
    "camera_rear_left_70fov": ("opencv-fisheye", {
        **SHARED, "shutter_type": "ROLLING_BOTTOM_TO_TOP", "principal_point": [31.5, 24.0],
        "focal_length": [40.0, 41.0], "radial_coeffs": [-0.02, 0.004, -0.001, 0.0002], "max_angle": 1.2,
    }),
    "camera_front_tele_30fov": ("opencv-pinhole", {
        **SHARED, "shutter_type": "GLOBAL", "principal_point": [32.0, 24.0], "focal_length": [120.0, 121.0],
        "radial_coeffs": [0.4, 0.1, 0.01, 0.6, 0.2, 0.02], "tangential_coeffs": [1e-4, 2e-4],
        "thin_prism_coeffs": [1e-3, 0.0, 2e-3, 0.0],
    }),
}  # fmt: skip
FRAMES = 7


def frame_us(camera: str, frame: int) -> int:
    return 40_000 + 33_333 * frame + 1_000 * list(CAMERAS).index(camera)


def write(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.parquet.write_table(pyarrow.table(columns), str(path))


def pose_columns(poses: list[Array]) -> dict[str, list[float]]:
    q = np.array([wxyz(pose) for pose in poses])
    found = {f"q{axis}": q[:, index].tolist() for index, axis in enumerate("wxyz")}
    return found | {axis: [float(pose[index, 3]) for pose in poses] for index, axis in enumerate("xyz")}


def encode(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(seed)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for _ in range(FRAMES):
            pixels = np.repeat(np.repeat(random.integers(0, 255, (6, 8, 3), np.uint8), 8, axis=0), 8, axis=1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())


def make(root: Path) -> Path:
    clip = root / CLIP
    times = [10_000 * n for n in range(-2, 40)]
    poses = [drive(time / 1e6) for time in times]
    write(clip / "labels" / f"{CLIP}.egomotion.offline.parquet", {"timestamp": times, **pose_columns(poses)})
    wrong = [matrix([9, 9, 9], Rotation.identity())] * len(times)
    write(clip / "labels" / f"{CLIP}.egomotion.parquet", {"timestamp": times, **pose_columns(wrong)})
    names, others = [*CAMERAS, "lidar_top_360fov"], ["another-clip"]
    mounts = [*CAMERAS.values(), LIDAR]
    write(clip / "calibration" / "sensor_extrinsics.parquet", {
        "clip_id": [CLIP] * len(names) + others, "sensor_name": [*names, "camera_front_wide_120fov"],
        **pose_columns([*mounts, np.eye(4)]),
    })  # fmt: skip
    parameters = [json.dumps(MODELS[name][1]) for name in CAMERAS]
    write(clip / "calibration" / "camera_intrinsics.parquet", {
        "clip_id": [CLIP] * 4, "camera_name": [*CAMERAS, "camera_rear_tele_30fov"],
        "model_type": [*(MODELS[name][0] for name in CAMERAS), "ftheta"], "model_parameters": [*parameters, "{}"],
        "ego_mask_image_png": [b""] * 4,
    })  # fmt: skip
    for seed, name in enumerate(CAMERAS):
        encode(clip / "camera" / f"{CLIP}.{name}.mp4", seed)
        stamps = [frame_us(name, frame) for frame in range(FRAMES)]
        write(clip / "camera" / f"{CLIP}.{name}.timestamps.parquet", {"timestamp": stamps})
    labels = ["automobile", "rider", "person", "protruding_object", "kraken"]
    box, count = matrix([15, 2, 0.8], Rotation.from_euler("z", 0.5)), len(labels)
    values = dict(zip([f"center_{axis}" for axis in "xyz"], map(float, box[:3, 3]), strict=True))
    values |= {"size_x": 4.5, "size_y": 1.9, "size_z": 1.6}
    values |= dict(zip([f"orientation_{axis}" for axis in "wxyz"], wxyz(box), strict=True))
    write(clip / "labels" / f"{CLIP}.obstacle.offline.parquet", {
        "timestamp_us": [101_234] * count, "track_id": list(range(count)), "label_class": labels,
        "reference_frame": ["rig"] * count, "reference_frame_timestamp_us": [105_000] * count,
        "source": ["autolabel"] * count, **{key: [value] * count for key, value in values.items()},
    })  # fmt: skip
    write_sweeps(clip / "lidar" / f"{CLIP}.lidar_top_360fov.parquet")
    return root


def sweep(number: int) -> tuple[Array, Array]:
    """Points of the world [150, 3] and their times in microseconds."""
    random = np.random.default_rng(number)
    times = 100_000 * number + random.permutation(150) * 600
    return moved(drive(0.1 * number), random.uniform(-20, 20, (150, 3))), times


def write_sweeps(path: Path) -> None:
    rows = []
    for number in range(3):
        world, times = sweep(number)
        poses = [np.linalg.inv(drive(float(time) / 1e6) @ LIDAR) for time in times]
        xyz = np.array([moved(pose, point[None])[0] for pose, point in zip(poses, world, strict=True)], np.float32)
        extra = {"intensity": (np.arange(150) % 256).astype(np.uint8)[:, None]}
        extra |= {"timestamp": times.astype(np.uint32)[:, None], "model_element": np.zeros((150, 2), np.uint16)}
        rows.append(DracoPy.encode(xyz, generic_attributes=extra, preserve_order=True, quantization_bits=0))
    starts = [100_000 * number for number in range(3)]
    bounds = {"spin_start_timestamp": starts, "spin_end_timestamp": [start + 100_000 for start in starts]}
    write(path, {**bounds, "draco_encoded_pointcloud": rows})


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("pai"))


@pytest.fixture(scope="module")
def log(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Log:
    out = tmp_path_factory.mktemp("log") / "log"
    run(source, "--out", out)
    return Log(out)


def test_poses_and_frames_are_the_recorded_ones(log: Log, source: Path) -> None:
    same_poses(log, {10_000 * n: drive(n / 100) for n in range(-2, 40)})
    for name in CAMERAS:
        assert log.times("images", camera=name) == [frame_us(name, frame) for frame in range(FRAMES)]
        rows = [row for row in log.rows("images") if row["camera"] == name]
        with av.open(str(source / CLIP / "camera" / f"{CLIP}.{name}.mp4")) as container:
            for row, frame in zip(rows, container.decode(video=0), strict=True):
                ours = np.asarray(Image.open(io.BytesIO((log.folder / row["file"]).read_bytes())))
                assert np.array_equal(ours, frame.to_ndarray(format="rgb24"))
    assert log.rig["camera_front_wide_120fov"]["shutter"] == {"direction": "top_to_bottom", "duration_us": 31_611}
    assert log.rig["camera_rear_left_70fov"]["shutter"]["direction"] == "bottom_to_top"
    assert "shutter" not in log.rig["camera_front_tele_30fov"]


def inside(limit: float) -> Array:
    """Points [100, 3] in a camera's axes, up to an angle off the axis."""
    random = np.random.default_rng(4)
    theta, turn = random.uniform(0.01, limit, 100), random.uniform(0, 2 * np.pi, 100)
    rays = np.stack([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta)], axis=1)
    return rays * random.uniform(3, 50, (100, 1))


def ours_of(log: Log, name: str, points: Array) -> Array:
    return log.project(name, log.poses()[100_000], moved(drive(0.1) @ CAMERAS[name], points))


def test_points_have_the_pixels_of_ftheta(log: Log) -> None:
    points = inside(1.2)
    radius = np.hypot(points[:, 0], points[:, 1])
    delta = np.polyval(POLYNOMIAL[::-1], np.arctan2(radius, points[:, 2])) / radius
    linear = np.array([[CDE[0], CDE[1]], [CDE[2], 1.0]])
    # The principal point counts from the middle of the first pixel, the image from its corner.
    theirs = (linear @ (points[:, :2] * delta[:, None]).T).T + [31.2 + 0.5, 24.4 + 0.5]
    np.testing.assert_allclose(ours_of(log, "camera_front_wide_120fov", points), theirs, rtol=0, atol=1e-5)
    windshield = {"reference": "backward", "horizontal": [0.001, 1.002, 0.0], "vertical": [0.0, 0.0, 0.999]}
    assert log.rig["camera_front_wide_120fov"]["windshield"] == windshield


def test_points_have_the_pixels_of_opencv(log: Log) -> None:
    its = MODELS["camera_rear_left_70fov"][1]
    values = [*its["focal_length"], *its["principal_point"], *its["radial_coeffs"]]
    fisheye = pycolmap.Camera(model="OPENCV_FISHEYE", width=SIZE[0], height=SIZE[1], params=values)
    points = inside(1.0)
    np.testing.assert_allclose(ours_of(log, "camera_rear_left_70fov", points), fisheye.img_from_cam(points), atol=1e-6)
    its, points = MODELS["camera_front_tele_30fov"][1], inside(0.3)
    k, (p1, p2), s = its["radial_coeffs"], its["tangential_coeffs"], its["thin_prism_coeffs"]
    a, b = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = a * a + b * b
    c = (1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3) / (1 + k[3] * r2 + k[4] * r2**2 + k[5] * r2**3)
    u = a * c + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + s[0] * r2 + s[1] * r2**2
    v = b * c + 2 * p2 * a * b + p1 * (r2 + 2 * b * b) + s[2] * r2 + s[3] * r2**2
    theirs = np.stack([120 * u + 32, 121 * v + 24], axis=1)
    np.testing.assert_allclose(ours_of(log, "camera_front_tele_30fov", points), theirs, rtol=0, atol=1e-6)


def test_boxes_and_what_is_left_out(log: Log) -> None:
    rows = log.rows("tracks")
    assert [(row["track"], row["class"]) for row in rows] == [
        ("0", "vehicle"), ("1", "bicycle"), ("2", "pedestrian"), ("3", "object")]  # fmt: skip
    assert rows[0]["time_us"] + log.epoch_us == 101_234 and rows[0]["size"] == [4.5, 1.9, 1.6]
    box = matrix([15, 2, 0.8], Rotation.from_euler("z", 0.5))
    np.testing.assert_allclose(log.pose(rows[0]["world_from_box"]), drive(0.105) @ box, rtol=0, atol=1e-3)
    left_out = " ".join(log.head["left_out"])
    for part in ("class kraken: 1", "camera camera_rear_tele_30fov: 1"):
        assert part in left_out


def test_the_lidar_is_deskewed_by_its_own_times(log: Log) -> None:
    rows = log.rows("lidar")
    assert len(rows) == 3 and "compensated_to_us" not in rows[0]
    for number, row in enumerate(rows):
        found, times = log.sweep_in_world(row)
        world, wanted = sweep(number)
        order = np.argsort(wanted)
        assert np.array_equal(times, wanted[order])
        np.testing.assert_allclose(found, world[order], rtol=0, atol=1e-3)


def test_a_killed_run_goes_on(source: Path, log: Log, tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, log.folder, source, after=10)


def edited(folder: str, name: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def act(root: Path) -> None:
        path = root / CLIP / folder / f"{name}.parquet"
        columns = pyarrow.parquet.read_table(path).to_pydict()
        change(columns)
        write(path, columns)

    return act


def lens(key: str, value: Any) -> Callable[[Path], None]:
    def change(columns: dict[str, Any]) -> None:
        columns["model_parameters"][0] = json.dumps({**MODELS["camera_front_wide_120fov"][1], key: value})

    return edited("calibration", "camera_intrinsics", change)


WIDE = f"{CLIP}.camera_front_wide_120fov"
BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no poses": (
        lambda r: [path.unlink() for path in (r / CLIP / "labels").glob("*.egomotion.offline.*")]
        + [(r / CLIP / "labels" / f"{CLIP}.egomotion.parquet").write_bytes(b"PAR1")], "not a Parquet file"),
    "a clock that runs backwards": (
        edited("labels", f"{CLIP}.egomotion.offline", lambda t: t["timestamp"].__setitem__(5, 0)), "runs backwards"),
    "no intrinsics": (lens("angle_to_pixeldist_poly", [0.0, 0.0, 0.0]), "has no intrinsics"),
    "an unknown shutter": (lens("shutter_type", "CURTAIN"), "shutter_type is 'CURTAIN'"),
    "an unknown lens": (
        edited("calibration", "camera_intrinsics", lambda t: t["model_type"].__setitem__(1, "omni")), "'omni'; ftheta"),
    "a lost mount": (
        edited("calibration", "sensor_extrinsics", lambda t: t["sensor_name"].__setitem__(1, "x")), "no row of camera"),
    "millimetres": (
        edited("calibration", "sensor_extrinsics", lambda t: t["x"].__setitem__(0, 1700.0)), "perhaps it is millimetr"),
    "too few times": (edited("camera", f"{WIDE}.timestamps", lambda t: t["timestamp"].pop()), "the video has more"),
    "too many times": (
        edited("camera", f"{WIDE}.timestamps", lambda t: t["timestamp"].append(10**7)), "7 frames for 8 times"),
    "a broken sweep": (
        edited("lidar", f"{CLIP}.lidar_top_360fov", lambda t: t["draco_encoded_pointcloud"].__setitem__(0, b"DRACO")),
        "no point cloud of Draco"),
    "times of another unit": (
        edited("lidar", f"{CLIP}.lidar_top_360fov", lambda t: t["spin_start_timestamp"].__setitem__(2, 10**9)),
        "outside the spin of 1000000000"),
    "a lost LiDAR": (
        edited("calibration", "sensor_extrinsics", lambda t: t["sensor_name"].__setitem__(3, "x")), "no row of lidar"),
    "a broken video": (lambda r: (r / CLIP / "camera" / f"{WIDE}.mp4").write_bytes(b"mp4"), "cannot decode the video"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_clips_are_refused(name: str, tmp_path: Path) -> None:
    root = make(tmp_path / "data")
    BAD[name][0](root)
    text = refused(tmp_path, root)
    assert BAD[name][1] in text, text
