"""nuScenes to a log: a miniature data set by the schema of its devkit, against NumPy and against the devkit."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs_truth import (
    Log,
    contents,
    drive,
    image_bytes,
    judge,
    killed_and_resumed,
    matrix,
    mount,
    moved,
    points_seen,
    refused,
    run,
    run_and_kill,
    same_poses,
    wxyz,
)
from scipy.spatial.transform import Rotation
from wildcity.logs.writer import LogWriter

START_US = 1_532_402_927_647_951
CAMERAS = {
    "CAM_FRONT": (mount(1.70, 0.02, 1.51, 0.3, -0.4), 1266.4),
    "CAM_FRONT_RIGHT": (mount(1.55, -0.49, 1.49, -56.0), 1260.8),
    "CAM_FRONT_LEFT": (mount(1.52, 0.49, 1.51, 55.0), 1272.6),
    "CAM_BACK": (mount(0.03, 0.0, 1.57, 180.0, 0.2), 809.2),
    "CAM_BACK_LEFT": (mount(1.04, 0.48, 1.56, 108.0), 1256.7),
    "CAM_BACK_RIGHT": (mount(1.01, -0.48, 1.56, -110.0), 1259.5),
}
LIDAR = matrix([0.94, 0.0, 1.84], Rotation.from_euler("z", -90, degrees=True))
SIZE = (1600, 900)
FRAMES = 6


def k_of(focal: float) -> np.ndarray[Any, Any]:
    return np.array([[focal, 0, 816.27], [0, focal, 491.51], [0, 0, 1]])


class Tables:
    """The tables while they are made."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.rows: dict[str, list[dict[str, Any]]] = {}
        self.poses: dict[int, Any] = {}

    def add(self, table: str, token: str, **fields: Any) -> str:
        self.rows.setdefault(table, []).append({"token": token, **fields})
        return token

    def sensor(self, channel: str, modality: str, pose: Any, k: Any) -> None:
        self.add("sensor", f"s-{channel}", channel=channel, modality=modality)
        place = {"translation": [float(v) for v in pose[:3, 3]], "rotation": wxyz(pose)}
        self.add("calibrated_sensor", f"c-{channel}", sensor_token=f"s-{channel}", **place, camera_intrinsic=k)

    def data(self, scene: int, channel: str, frame: int, time_us: int, suffix: str, content: bytes) -> None:
        token = f"d{scene}-{channel}-{frame}"
        pose = drive((time_us - START_US) / 1e6)
        self.poses[time_us] = pose
        place = {"translation": [float(v) for v in pose[:3, 3]], "rotation": wxyz(pose)}
        self.add("ego_pose", f"e{token}", timestamp=time_us, **place)
        is_image = suffix == ".jpg"
        name = f"{'samples' if frame % 2 == 0 else 'sweeps'}/{channel}/{time_us}{suffix}"
        (self.root / name).parent.mkdir(parents=True, exist_ok=True)
        (self.root / name).write_bytes(content)
        size = {"width": SIZE[0], "height": SIZE[1]} if is_image else {"width": 0, "height": 0}
        links = {"prev": "", "next": f"d{scene}-{channel}-{frame + 1}" if frame + 1 < FRAMES else ""}
        keys = {"sample_token": f"m{scene}-{frame // 2}", "ego_pose_token": f"e{token}"}
        shape = {"fileformat": suffix[1:], "is_key_frame": frame % 2 == 0, **size}
        keys["calibrated_sensor_token"] = f"c-{channel}"
        self.add("sample_data", token, **keys, timestamp=time_us, **shape, filename=name, **links)

    def write(self) -> None:
        folder = self.root / "v1.0-mini"
        folder.mkdir(parents=True)
        for table, rows in self.rows.items():
            (folder / f"{table}.json").write_text(json.dumps(rows, indent=0))


def lidar_points(time_us: int) -> np.ndarray[Any, Any]:
    """Points in the LiDAR's axes at the time of the sweep; the same points of the world in each sweep."""
    world = moved(drive(0.2), np.random.default_rng(5).uniform(-20, 20, (500, 3)))
    return moved(np.linalg.inv(drive((time_us - START_US) / 1e6) @ LIDAR), world)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Tables:
    return make(tmp_path_factory.mktemp("nuscenes"))


def make(root: Path) -> Tables:
    tables = Tables(root)
    for channel, (pose, focal) in CAMERAS.items():
        tables.sensor(channel, "camera", pose, k_of(focal).tolist())
    tables.sensor("LIDAR_TOP", "lidar", LIDAR, [])
    tables.sensor("RADAR_FRONT", "radar", matrix([3.4, 0, 0.5], Rotation.identity()), [])
    tables.add("category", "car", name="vehicle.car", description="")
    tables.add("category", "bike", name="vehicle.bicycle", description="")
    tables.add("category", "ghost", name="flying.saucer", description="")
    for name in ("car", "bike", "ghost"):
        tables.add("instance", f"i-{name}", category_token=name)
    for scene in range(2):
        tables.add("scene", f"scene{scene}", name=f"scene-000{scene}", log_token="log", nbr_samples=3)
        for frame in range(FRAMES):
            base = START_US + 50_000 * frame + 20_000_000 * scene
            if frame % 2 == 0:
                tables.add("sample", f"m{scene}-{frame // 2}", scene_token=f"scene{scene}", timestamp=base)
                for name in ("car", "bike", "ghost"):
                    pose = drive(frame / 20) @ matrix([12, 3, 1], Rotation.from_euler("z", 0.4))
                    place = {"translation": [float(v) for v in pose[:3, 3]], "rotation": wxyz(pose)}
                    keys = {"sample_token": f"m{scene}-{frame // 2}", "instance_token": f"i-{name}"}
                    tables.add("sample_annotation", f"a{scene}{frame}{name}", **keys, size=[1.9, 4.6, 1.7], **place)
            points = np.zeros((500, 5), "<f4")
            points[:, :3], points[:, 3], points[:, 4] = lidar_points(base), 7, np.arange(500) % 32
            tables.data(scene, "LIDAR_TOP", frame, base, ".pcd.bin", points.tobytes())
            tables.data(scene, "RADAR_FRONT", frame, base + 3_001, ".pcd", b"radar")
            for number, channel in enumerate(CAMERAS):
                if scene == 0 and channel == "CAM_BACK" and frame in (2, 3):
                    continue  # Dropped frames: the rows before and after are not linked to them.
                time_us = base + 7_000 * number + 11
                tables.data(scene, channel, frame, time_us, ".jpg", image_bytes(10 * frame + number))
    tables.write()
    return tables


@pytest.fixture(scope="module")
def log(dataset: Tables, tmp_path_factory: pytest.TempPathFactory) -> Log:
    out = tmp_path_factory.mktemp("log") / "scene-0000"
    said = run(dataset.root, "--log", "scene-0000", "--out", out)
    assert "nuScenes" in said and "gap: images cam_back: 1 interval longer" in said and "0.15 s" in said
    return Log(out)


def seen(channel: str, time_us: int) -> np.ndarray[Any, Any]:
    """100 points of the world that a camera sees."""
    pose, focal = CAMERAS[channel]
    return moved(drive((time_us - START_US) / 1e6) @ pose, points_seen(k_of(focal), SIZE))


def test_points_have_the_pixels_of_the_formula(log: Log) -> None:
    poses = log.poses()
    for channel, (pose, focal) in CAMERAS.items():
        times = log.times("images", camera=channel.lower())
        assert len(times) == (4 if channel == "CAM_BACK" else 6)
        assert (log.rig[channel.lower()]["width"], log.rig[channel.lower()]["height"]) == SIZE
        for time_us in times:
            world = seen(channel, time_us)
            ours = log.project(channel.lower(), poses[time_us], world)
            flat = moved(np.linalg.inv(drive((time_us - START_US) / 1e6) @ pose), world) @ k_of(focal).T
            # Theirs counts from the middle of the first pixel.
            np.testing.assert_allclose(ours - 0.5, flat[:, :2] / flat[:, 2:], rtol=0, atol=1e-3)


def test_points_have_the_pixels_of_the_devkit(log: Log, dataset: Tables) -> None:
    program = """
import numpy as np
from nuscenes.utils.geometry_utils import view_points
from pyquaternion import Quaternion
pixels = []
for one in given["views"]:
    points = np.array(one["points"]).T
    for place in (one["ego"], one["sensor"]):
        points = Quaternion(place["rotation"]).rotation_matrix.T @ (points - np.array(place["translation"])[:, None])
    pixels.append(view_points(points, np.array(one["k"]), normalize=True)[:2].T.tolist())
print(json.dumps(pixels))
"""
    poses, views, ours = log.poses(), [], []
    mounts = {row["token"]: row for row in dataset.rows["calibrated_sensor"]}
    egos = {row["timestamp"]: row for row in dataset.rows["ego_pose"]}
    for channel in CAMERAS:
        for time_us in log.times("images", camera=channel.lower()):
            world, one = seen(channel, time_us), mounts[f"c-{channel}"]
            views.append({"points": world.tolist(), "ego": egos[time_us], "sensor": one, "k": one["camera_intrinsic"]})
            ours.append(log.project(channel.lower(), poses[time_us], world) - 0.5)
    np.testing.assert_allclose(ours, judge(program, {"views": views}), rtol=0, atol=1e-3)


def test_poses_and_times_are_the_recorded_ones(log: Log, dataset: Tables) -> None:
    same_poses(log, {time: pose for time, pose in dataset.poses.items() if time < START_US + 10_000_000})
    names = {row["file"]: row for row in log.rows("images")}
    for row in dataset.rows["sample_data"]:
        if row["timestamp"] < START_US + 10_000_000 and row["fileformat"] == "jpg":
            channel = row["filename"].split("/")[1].lower()
            name = f"images/{channel}/{row['timestamp'] - log.epoch_us:012d}.jpg"
            assert names.pop(name)["camera"] == channel
            assert (log.folder / name).read_bytes() == (dataset.root / row["filename"]).read_bytes()
    assert not names


def test_the_points_of_the_lidar_are_in_their_places(log: Log) -> None:
    world = moved(drive(0.2), np.random.default_rng(5).uniform(-20, 20, (500, 3)))
    rows = log.rows("lidar")
    assert len(rows) == 6
    for row in rows:
        found, times = log.sweep_in_world(row)
        assert row["compensated_to_us"] == row["time_us"] and len(set(times)) == 1
        np.testing.assert_allclose(found, world, rtol=0, atol=1e-3)


def test_boxes_and_what_is_left_out(log: Log) -> None:
    rows = log.rows("tracks")
    assert {(row["track"], row["class"]) for row in rows} == {("i-car", "vehicle"), ("i-bike", "bicycle")}
    assert all(row["size"] == [4.6, 1.9, 1.7] for row in rows)
    at = drive(0.1) @ matrix([12, 3, 1], Rotation.from_euler("z", 0.4))
    second = next(row for row in rows if row["time_us"] + log.epoch_us == START_US + 100_000)
    np.testing.assert_allclose(log.pose(second["world_from_box"]), at, rtol=0, atol=1e-6)
    left_out = " | ".join(log.head["left_out"])
    for part in ("boxes of class flying.saucer: 3", "sweeps of RADAR_FRONT: 6", "exposure times of images: 34"):
        assert part in left_out


def test_a_killed_run_goes_on(dataset: Tables, log: Log, tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, log.folder, dataset.root, "--log", "scene-0000", after=5, again=9)


def test_references_name_the_recorded_files(dataset: Tables, tmp_path: Path) -> None:
    run(dataset.root, "--log", "scene-0000", "--reference", "--out", tmp_path / "log")
    files = {row["file"] for row in Log(tmp_path / "log").rows("images")}
    assert len(files) == 34 and all(Path(file).is_relative_to(dataset.root) for file in files)
    assert not (tmp_path / "log" / "images").exists()


def test_the_list_of_scenes(dataset: Tables, tmp_path: Path) -> None:
    assert "scene-0000\nscene-0001\n" in run(dataset.root, "--list")
    assert "several of scene: scene-0000, scene-0001; choose one with --log" in refused(tmp_path, dataset.root)
    assert "no scene 'scene-9'" in refused(tmp_path, dataset.root, "--log", "scene-9")


Change = Callable[[dict[str, list[dict[str, Any]]]], Any]
BAD: dict[str, tuple[Change, str]] = {
    "a table is missing": (lambda t: t.pop("ego_pose"), "ego_pose.json: missing: the table ego_pose"),
    "a field is missing": (lambda t: t["sample_data"][3].pop("timestamp"), "a row has no field"),
    "no intrinsics": (
        lambda t: t["calibrated_sensor"][0].update(camera_intrinsic=[]), "camera_intrinsic is [], not 3 x 3 finite",
    ),
    "no focal length": (
        lambda t: t["calibrated_sensor"][0].update(camera_intrinsic=[[0] * 3] * 3), "camera CAM_FRONT has no intrinsics"
    ),
    "millimetres": (
        lambda t: t["calibrated_sensor"][0].update(translation=[1700, 20, 1510]), "perhaps it is millimetres",
    ),
    "a clock that runs backwards": (
        lambda t: t["sample_data"][8 + 1].update(timestamp=START_US - 1), "the clock runs backwards",
    ),
    "no rotation": (lambda t: t["ego_pose"][0].update(rotation=[0, 0, 0, 0]), "no unit quaternion"),
    "a lost token": (lambda t: t["ego_pose"].pop(0), "no row with the token"),
    "a pose that is not finite": (lambda t: t["ego_pose"][0].update(translation=[0, 0, float("nan")]), "finite"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_tables_are_refused(name: str, dataset: Tables, tmp_path: Path) -> None:
    change, words = BAD[name]
    copy = Tables(tmp_path / "data")
    copy.rows = json.loads(json.dumps(dataset.rows))
    change(copy.rows)
    copy.write()
    for folder in ("samples", "sweeps"):
        (copy.root / folder).symlink_to(dataset.root / folder)
    text = refused(tmp_path, copy.root, "--log", "scene-0000")
    assert words in text and str(copy.root) in text, text


def test_a_cut_table_and_a_missing_image_are_refused(dataset: Tables, tmp_path: Path) -> None:
    copy = Tables(tmp_path / "data")
    copy.rows = dataset.rows
    copy.write()
    assert "missing: a sweep of the LiDAR" in refused(tmp_path, copy.root, "--log", "scene-0000")
    for lidar in ("samples/LIDAR_TOP", "sweeps/LIDAR_TOP"):
        (copy.root / lidar).parent.mkdir()
        (copy.root / lidar).symlink_to(dataset.root / lidar)
    assert "the image is missing" in refused(tmp_path, copy.root, "--log", "scene-0000")
    table = copy.root / "v1.0-mini" / "sample.json"
    table.write_bytes(table.read_bytes()[:-20])
    assert "not JSON, or cut off" in refused(tmp_path / "b", copy.root, "--log", "scene-0000")


def test_an_unknown_source_is_named_with_what_is_known(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    text = refused(tmp_path, tmp_path / "data")
    assert "it looks like none of the known kinds" in text and "v1.0-*/sample_data.json" in text
    assert "there is no such file or folder" in refused(tmp_path, tmp_path / "nothing")


def test_a_log_is_not_overwritten_and_other_options_do_not_go_on(dataset: Tables, tmp_path: Path) -> None:
    out = tmp_path / "log"
    run_and_kill(2, dataset.root, "--log", "scene-0000", "--out", out)
    assert "other options; remove this folder" in run(dataset.root, "--log", "scene-0001", "--out", out, code=1)
    run(dataset.root, "--log", "scene-0000", "--out", out)
    assert "it exists" in run(dataset.root, "--log", "scene-0000", "--out", out, code=1)


def test_a_full_disk_is_an_error_and_the_next_run_goes_on(
    dataset: Tables, log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = [0]

    def full(self: LogWriter, table: str, time_us: int, fields: dict[str, Any]) -> None:
        written[0] += 1
        if written[0] > 60:
            raise OSError(errno.ENOSPC, "No space left on device")
        row(self, table, time_us, fields)

    row, out = LogWriter.row, tmp_path / "log"
    with monkeypatch.context() as patched:
        patched.setattr(LogWriter, "row", full)
        text = run(dataset.root, "--log", "scene-0000", "--out", out, code=1)
    assert "No space left on device; make space" in text and not out.exists()
    assert "went on: " in run(dataset.root, "--log", "scene-0000", "--out", out)
    assert contents(out) == contents(log.folder)
