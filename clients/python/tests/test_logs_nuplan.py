"""nuPlan to a log: a miniature database by the schema of its devkit, against NumPy and COLMAP's lens."""

from __future__ import annotations

import pickle
import sqlite3
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
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

NAME = "2021.05.12.22.00.38_veh-35_01008_01518"
START_US = 1_620_857_889_651_124
START = (664_430.25, 3_999_650.5, 606.0)
CAMERAS = {"CAM_F0": mount(1.65, 0, 1.5, 0), "CAM_L0": mount(1.6, 0.2, 1.5, 55), "CAM_B0": mount(-0.5, 0, 1.6, 180)}
LIDAR = matrix([-0.1, 0.2, 1.9], Rotation.from_euler("ZYX", [0.3, 0.02, -0.01]))
K = np.array([[1545.0, 0, 960], [0, 1545.0, 560], [0, 0, 1]])
LENS, SIZE = [-0.356123, 0.172545, -0.00213, 0.000464, -0.05231], (1920, 1080)

SCHEMA = """
CREATE TABLE log (token BLOB PRIMARY KEY, logfile VARCHAR, location VARCHAR, map_version VARCHAR);
CREATE TABLE ego_pose (token BLOB PRIMARY KEY, timestamp INTEGER, x FLOAT, y FLOAT, z FLOAT, qw FLOAT, qx FLOAT,
 qy FLOAT, qz FLOAT, vx FLOAT, vy FLOAT, vz FLOAT, acceleration_x FLOAT, acceleration_y FLOAT, acceleration_z FLOAT,
 angular_rate_x FLOAT, angular_rate_y FLOAT, angular_rate_z FLOAT, epsg INTEGER, log_token BLOB);
CREATE TABLE camera (token BLOB PRIMARY KEY, log_token BLOB, channel VARCHAR, model VARCHAR, translation BLOB,
 rotation BLOB, intrinsic BLOB, distortion BLOB, width INTEGER, height INTEGER);
CREATE TABLE image (token BLOB PRIMARY KEY, next_token BLOB, prev_token BLOB, ego_pose_token BLOB, camera_token BLOB,
 filename_jpg VARCHAR, timestamp INTEGER);
CREATE TABLE lidar (token BLOB PRIMARY KEY, log_token BLOB, channel VARCHAR, model VARCHAR, translation BLOB,
 rotation BLOB);
CREATE TABLE lidar_pc (token BLOB PRIMARY KEY, next_token BLOB, prev_token BLOB, ego_pose_token BLOB,
 lidar_token BLOB, scene_token BLOB, filename VARCHAR, timestamp INTEGER);
CREATE TABLE lidar_box (token BLOB PRIMARY KEY, lidar_pc_token BLOB, track_token BLOB, next_token BLOB,
 prev_token BLOB, x FLOAT, y FLOAT, z FLOAT, width FLOAT, length FLOAT, height FLOAT, vx FLOAT, vy FLOAT, vz FLOAT,
 yaw FLOAT, confidence FLOAT);
CREATE TABLE track (token BLOB PRIMARY KEY, category_token BLOB, width FLOAT, length FLOAT, height FLOAT);
CREATE TABLE category (token BLOB PRIMARY KEY, name VARCHAR, description VARCHAR);
"""


def ego(time_us: int) -> Array:
    return drive((time_us - START_US) / 1e6, START)


def token(text: str) -> bytes:
    return text.encode().ljust(8, b".")[:8]


def listed(name: str, values: list[Any], monkeypatch: pytest.MonkeyPatch) -> bytes:
    """A pickle of a list, of the class that the devkit has for it."""
    module = types.ModuleType("nuplan.database.common.data_types")
    its = type(name, (list,), {"__module__": module.__name__})
    setattr(module, name, its)
    parts = module.__name__.split(".")
    for index in range(1, len(parts)):
        monkeypatch.setitem(sys.modules, ".".join(parts[:index]), types.ModuleType(".".join(parts[:index])))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return pickle.dumps(its(values))


def insert(db: sqlite3.Connection, table: str, **values: Any) -> None:
    marks = ", ".join("?" * len(values))
    db.execute(f"INSERT INTO {table} ({', '.join(values)}) VALUES ({marks})", tuple(values.values()))


def make(root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = root / "nuplan-v1.1" / "splits" / "mini" / f"{NAME}.db"
    path.parent.mkdir(parents=True)
    db = sqlite3.connect(path)
    db.executescript(SCHEMA)
    for n in reversed(range(60)):
        time_us = START_US + 10_001 * n
        pose, q = ego(time_us), wxyz(ego(time_us))
        xyz = dict(zip("xyz", map(float, pose[:3, 3]), strict=True))
        turn = dict(zip(("qw", "qx", "qy", "qz"), q, strict=True))
        insert(db, "ego_pose", token=token(f"e{n}"), timestamp=time_us, epsg=32611, **xyz, **turn)
    for index, (channel, pose) in enumerate(CAMERAS.items()):
        place = listed("Translation", [float(v) for v in pose[:3, 3]], monkeypatch)
        turned = listed("Rotation", wxyz(pose), monkeypatch)
        lens = {"intrinsic": listed("CameraIntrinsic", K.tolist(), monkeypatch), "distortion": pickle.dumps(LENS)}
        size = {"width": SIZE[0], "height": SIZE[1]}
        insert(db, "camera", token=token(channel), channel=channel, translation=place, rotation=turned, **lens, **size)
        for n in range(6):
            file = f"{NAME}/{channel}/{n:04d}.jpg"
            row = {"camera_token": token(channel), "filename_jpg": file, "next_token": token(f"i{index}{n + 1}")}
            insert(db, "image", token=token(f"i{index}{n}"), timestamp=START_US + 100_000 * n + 5_000 * index, **row)
            blob = root / "nuplan-v1.1" / "sensor_blobs" / file
            if (index, n) != (2, 3):
                blob.parent.mkdir(parents=True, exist_ok=True)
                blob.write_bytes(image_bytes(10 * n + index))
    lidar = {"channel": "MergedPointCloud", "rotation": listed("Rotation", wxyz(LIDAR), monkeypatch)}
    place = listed("Translation", [float(v) for v in LIDAR[:3, 3]], monkeypatch)
    insert(db, "lidar", token=token("lidar"), translation=place, **lidar)
    boxes(db)
    for n in (0, 2):
        write_pcd(root / "nuplan-v1.1" / "sensor_blobs" / sweep_file(n), cloud(n))
    db.commit()
    db.close()
    return root


def sweep_file(n: int) -> str:
    return f"{NAME}/MergedPointCloud/{n:04d}.pcd"


def cloud(n: int) -> Array:
    """Rows of a file: x, y, z, intensity, ring, lidar_info."""
    random = np.random.default_rng(n)
    xyz = np.c_[random.uniform(-40, 40, (150, 2)), random.uniform(-2, 3, 150)]
    return np.c_[xyz, random.uniform(0, 255, 150), random.integers(0, 40, 150), random.integers(0, 5, 150)].astype(
        "<f4"
    )


def write_pcd(path: Path, rows: Array) -> None:
    """As PointCloud.save of the devkit writes it, with its bytes of zeros at the end."""
    kinds = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u1"), ("lidar_info", "u2")]
    table = np.zeros(len(rows), np.dtype(kinds))
    for (name, _), column in zip(kinds, rows.T, strict=True):
        table[name] = column
    header = f"""# .PCD v.7 - Point Cloud Data file format
VERSION .7
FIELDS {" ".join(name for name, _ in kinds)}
SIZE {" ".join(kind[1] for _, kind in kinds)}
TYPE F F F F U U
COUNT 1 1 1 1 1 1
WIDTH {len(rows)}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {len(rows)}
DATA binary
"""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + table.tobytes() + bytes(7))


def boxes(db: sqlite3.Connection) -> None:
    for name in ("vehicle", "bicycle", "pedestrian", "czone_sign", "phantom"):
        insert(db, "category", token=token(name), name=name)
        insert(db, "track", token=token(f"t{name}"), category_token=token(name))
    for n in range(3):
        keys = {"next_token": token(f"l{n + 1}"), "lidar_token": token("lidar"), "filename": sweep_file(n)}
        insert(db, "lidar_pc", token=token(f"l{n}"), timestamp=START_US + 50_005 * n, **keys)
        for name in ("vehicle", "bicycle", "pedestrian", "czone_sign", "phantom"):
            size = {"length": 4.7, "width": 1.9, "height": 1.6, "x": START[0] + n, "y": START[1] + 4, "z": START[2] + 1}
            keys = {"lidar_pc_token": token(f"l{n}"), "track_token": token(f"t{name}"), "yaw": 1.1}
            velocity = {"vx": 3.0, "vy": 4.0, "vz": 0.5}
            insert(db, "lidar_box", token=token(f"b{n}{name}"), confidence=0.5, **size, **keys, **velocity)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as monkeypatch:
        return make(tmp_path_factory.mktemp("nuplan"), monkeypatch)


@pytest.fixture(scope="module")
def log(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Log:
    out = tmp_path_factory.mktemp("log") / "log"
    said = run(source, "--out", out)
    assert "gap: images cam_b0: 1 interval longer than" in said
    return Log(out)


def test_poses_times_images_and_the_place_are_the_recorded_ones(log: Log) -> None:
    same_poses(log, {START_US + 10_001 * n: ego(START_US + 10_001 * n) for n in range(60)})
    for index, channel in enumerate(CAMERAS):
        frames = [n for n in range(6) if (index, n) != (2, 3)]
        times = [START_US + 100_000 * n + 5_000 * index for n in frames]
        assert log.times("images", camera=channel.lower()) == times
        rows = [row for row in log.rows("images") if row["camera"] == channel.lower()]
        for n, row in zip(frames, rows, strict=True):
            assert (log.folder / row["file"]).read_bytes() == image_bytes(10 * n + index)
    place = {"easting_m": log.origin[0], "northing_m": log.origin[1], "altitude_m": log.origin[2]}
    assert log.head["world"]["geo"] == {"projection": "EPSG:32611", **place}
    assert abs(log.origin - ego(START_US)[:3, 3]).max() <= 0.5


def test_points_have_the_pixels_of_the_lens(log: Log) -> None:
    values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *LENS, 0, 0, 0]
    model = pycolmap.Camera(model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=values)
    for channel, pose in CAMERAS.items():
        inside, time_us = points_seen(K, SIZE), START_US + 10_001 * 30
        seen = moved(ego(time_us) @ pose, inside)
        ours = log.project(channel.lower(), log.poses()[time_us], seen)
        np.testing.assert_allclose(ours - 0.5, model.img_from_cam(inside), rtol=0, atol=1e-3)
        assert (log.rig[channel.lower()]["width"], log.rig[channel.lower()]["height"]) == SIZE


def test_boxes_and_what_is_left_out(log: Log) -> None:
    rows = log.rows("tracks")
    assert len(rows) == 12 and {row["class"] for row in rows} == {"vehicle", "bicycle", "pedestrian", "object"}
    one = next(row for row in rows if row["track"] == token("tvehicle").hex())
    assert one["size"] == [4.7, 1.9, 1.6] and one["velocity"] == [3.0, 4.0, 0.5]
    wanted = matrix([START[0], START[1] + 4, START[2] + 1], Rotation.from_euler("z", 1.1))
    np.testing.assert_allclose(log.pose(one["world_from_box"]), wanted, rtol=0, atol=1e-6)
    left_out = " ".join(log.head["left_out"])
    for part in (
        "class phantom: 3",
        "merged sweeps of the LiDARs without a file: 1",
        "images of CAM_B0 without a file: 1",
    ):
        assert part in left_out


def test_sweeps_are_where_the_devkit_has_them(log: Log) -> None:
    rows = log.rows("lidar")
    assert [row["lidar"] for row in rows] == ["mergedpointcloud"] * 2
    for n, row in zip((0, 2), rows, strict=True):
        time_us = START_US + 50_005 * n
        found, times = log.sweep_in_world(row)
        assert set(times) == {time_us}
        # ego_pose.trans_matrix @ lidar.trans_matrix @ point
        wanted = moved(ego(time_us) @ LIDAR, cloud(n)[:, :3].astype(np.float64))
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-3)


def test_a_killed_run_goes_on(source: Path, log: Log, tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, log.folder, source, after=11)


class Harmful:
    """A pickle of it would run a command."""

    def __reduce__(self) -> Any:
        return (print, ("harm",))


Change = Callable[[sqlite3.Connection], Any]
BAD: dict[str, tuple[Change, str]] = {
    "a missing table": (lambda db: db.execute("DROP TABLE track"), "missing: the table track"),
    "no poses": (lambda db: db.execute("DELETE FROM ego_pose"), "table ego_pose: no poses"),
    "a clock that runs backwards": (
        lambda db: db.execute("UPDATE image SET timestamp = 5 WHERE token = ?", (token("i13"),)),
        "table image: the timestamp 5 follows"),
    "a pickle that runs code": (
        lambda db: db.execute("UPDATE camera SET intrinsic = ?", (pickle.dumps(Harmful()),)),
        "intrinsic is no pickle of a list: a pickle of builtins.print"),
    "no intrinsics": (
        lambda db: db.execute("UPDATE camera SET intrinsic = ?", (pickle.dumps([[0.0] * 3] * 3),)),
        "camera CAM_B0 has no intrinsics"),
    "millimetres": (
        lambda db: db.execute("UPDATE camera SET translation = ?", (pickle.dumps([1650.0, 0.0, 1500.0]),)),
        "perhaps it is millimetres"),
    "no rotation": (lambda db: db.execute("UPDATE ego_pose SET qw = 3"), "has not the length 1"),
    "a sweep of an unknown LiDAR": (lambda db: db.execute("DELETE FROM lidar"), "that the table lidar lacks"),
    "a missing column": (lambda db: db.execute("ALTER TABLE image DROP COLUMN filename_jpg"), "no such column"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_databases_are_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = make(tmp_path / "data", monkeypatch)
    path = root / "nuplan-v1.1" / "splits" / "mini" / f"{NAME}.db"
    db = sqlite3.connect(path)
    BAD[name][0](db)
    db.commit()
    db.close()
    text = refused(tmp_path, root)
    assert BAD[name][1] in text and str(path) in text, text
    assert "harm" not in capsys.readouterr().out


BAD_SWEEPS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut off": (lambda data: data[:-300], "it is cut off"),
    "text": (lambda data: data.replace(b"DATA binary", b"DATA ascii"), "its points are ascii"),
    "no header": (lambda data: b"\x00" * 5000, "no header of a PCD file"),
    "a missing field": (lambda data: data.replace(b"intensity", b"brilliant"), "without the fields ['intensity']"),
    "a wrong size": (lambda data: data.replace(b"SIZE 4 4", b"SIZE 4 x"), "no header of a PCD file"),
    "too many points": (lambda data: data.replace(b"POINTS 150", b"POINTS 99999999999"), "99999999999 points"),
}


@pytest.mark.parametrize("name", BAD_SWEEPS)
def test_bad_sweeps_are_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = make(tmp_path / "data", monkeypatch)
    path = root / "nuplan-v1.1" / "sensor_blobs" / sweep_file(2)
    path.write_bytes(BAD_SWEEPS[name][0](path.read_bytes()))
    text = refused(tmp_path, root)
    assert BAD_SWEEPS[name][1] in text and "0002.pcd" in text, text


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log.db").write_bytes(b"SQLite is something else" * 99)
    assert "not a database of SQLite" in refused(tmp_path, tmp_path / "log.db")
