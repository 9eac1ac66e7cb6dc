"""nuPlan: a SQLite database for each log, by docs/nuplan_schema.md of nuplan-devkit, and images in `sensor_blobs`.

The ego has x forward, y left, z up, at the rear axle; the world is UTM (`epsg`). Times are microseconds. Lenses are
OpenCV's (k1, k2, p1, p2, k3), and images are distorted. Calibrations are pickles of lists; they are read by an
unpickler that knows lists and the three list classes of the devkit, and runs nothing.

A sweep is a merged cloud (`MergedPointCloud`) in the axes of the row `lidar` that it names, whose place on the ego is
there: so the devkit moves boxes to it (`get_boxes`, Frame.SENSOR). Its points have no times of their own.
"""

from __future__ import annotations

import io
import pickle
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LogError
from .frames import Matrix, transform
from .kinds import Options, choose
from .lenses import Intrinsics, camera, opencv
from .pcd import pcd_points
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import integer, numbers
from .writer import LogWriter, Report

LICENCE = "CC BY-NC-SA 4.0, and the terms of use of nuPlan"

_TABLES = ("ego_pose", "camera", "image", "lidar_box", "lidar_pc", "track", "category")


def _logs(source: Path) -> dict[str, Path]:
    files = [source] if source.is_file() else sorted([*source.glob("*.db"), *source.glob("**/splits/*/*.db")])
    return {path.stem: path for path in files}


def logs(source: Path) -> list[str]:
    """Names of the logs."""
    return list(_logs(source))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one log."""
    found = _logs(source)
    name = choose(list(found), options.log, source, "log (*.db)")
    database = _Database(found[name])
    with closing(database):
        decides = {"bytes": found[name].stat().st_size}
        with opened("nuplan", source, out, options, log=name, licence=LICENCE, decides=decides) as writer:
            _check_clock(database)
            _poses(database, writer)
            blobs = _blobs_folder(found[name], source)
            _rig(database, writer)
            _images(database, writer, blobs)
            _boxes(database, writer)
            _sweeps(database, writer, blobs)
            writer.left_out("accelerations and rates", database.count("ego_pose"), "without gravity: no IMU's")
            writer.left_out("map", 1, "in files of its own (maps/), which are not read")
            return writer.finish()


class _Database:
    """The database of a log, opened for reading."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tables: list[str] = []
        try:
            self._connection = sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)
            rows = self._connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise LogError(path, f"not a database of SQLite: {error}", "download it again") from None
        self.tables = [str(name) for (name,) in rows]
        missing = [name for name in _TABLES if name not in self.tables]
        if missing:
            self._connection.close()
            raise LogError(path, f"missing: the table {missing[0]}", "download the database again")
        self._connection.row_factory = sqlite3.Row

    def close(self) -> None:
        self._connection.close()

    def rows(self, query: str) -> Iterator[sqlite3.Row]:
        """Rows of a query, one by one."""
        try:
            yield from self._connection.execute(query)
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise LogError(self.path, f"cannot read: {error}", "use a database of the documented schema") from None

    def count(self, table: str) -> int:
        return int(next(self.rows(f"SELECT COUNT(*) AS n FROM {table}"))["n"])


def _poses(database: _Database, writer: LogWriter) -> None:
    place, first = f"{database.path}, table ego_pose", True
    for row in database.rows("SELECT * FROM ego_pose ORDER BY timestamp"):
        time_us = integer(row["timestamp"], "timestamp", place)
        if first:
            writer.begin(time_us, [row["x"], row["y"], row["z"]])
            writer.geo, first = _geo(row, writer.origin_m), False
        writer.pose(time_us, _pose([row[axis] for axis in "xyz"], [row[f"q{axis}"] for axis in "wxyz"], place), place)
    if first:
        raise LogError(place, "no poses", "download the database again")


def _check_clock(database: _Database) -> None:
    """Refuses a row of a sensor whose `next_token` is not later."""
    for table in ("image", "lidar_pc"):
        query = f"SELECT a.timestamp AS before_us, b.timestamp AS after_us FROM {table} AS a "
        query += f"JOIN {table} AS b ON b.token = a.next_token WHERE b.timestamp <= a.timestamp LIMIT 1"
        for row in database.rows(query):
            problem = f"the timestamp {row['after_us']} follows {row['before_us']}: the clock runs backwards"
            raise LogError(f"{database.path}, table {table}", problem, "download the database again")


def _geo(row: sqlite3.Row, origin_m: Any) -> dict[str, Any] | None:
    code = row["epsg"] if "epsg" in row.keys() else None  # noqa: SIM118 (a row is no mapping)
    if code is None or not (32601 <= int(code) <= 32660 or 32701 <= int(code) <= 32760):
        return None
    place = {"easting_m": float(origin_m[0]), "northing_m": float(origin_m[1]), "altitude_m": float(origin_m[2])}
    return {"projection": f"EPSG:{int(code)}", **place}


def _pose(xyz: Any, q: Any, place: str) -> Matrix:
    q = numbers(q, (4,), "the quaternion", place)
    if not ((abs(q) < 2).all() and abs(float(np.linalg.norm(q)) - 1) < 1e-3):
        raise LogError(place, f"the quaternion (w, x, y, z) {list(q)} has not the length 1", "download it again")
    return transform(numbers(xyz, (3,), "the position", place), q)


class _Lists(pickle.Unpickler):
    """Reads pickles of lists of numbers. The classes of the devkit are lists, and become lists."""

    def find_class(self, module: str, name: str) -> Any:
        if module.endswith("data_types") and name in ("Translation", "Rotation", "CameraIntrinsic"):
            return _List
        raise pickle.UnpicklingError(f"a pickle of {module}.{name}")


class _List(list[Any]):
    """Stands for a class of the devkit that is a list."""


def _list(blob: Any, name: str, place: str) -> Any:
    try:
        return _Lists(io.BytesIO(blob)).load()
    except (pickle.UnpicklingError, TypeError, EOFError, AttributeError, IndexError, ValueError) as error:
        raise LogError(place, f"{name} is no pickle of a list: {error}", "download the database again") from None


def _rig(database: _Database, writer: LogWriter) -> None:
    for row in database.rows("SELECT * FROM camera ORDER BY channel"):
        name = str(row["channel"])
        place = f"{database.path}, table camera, {name}"
        values = {key: _list(row[key], key, place) for key in ("translation", "rotation", "intrinsic", "distortion")}
        k = numbers(values["intrinsic"], (3, 3), "intrinsic", place)
        pose = _pose(values["translation"], numbers(values["rotation"], (4,), "rotation", place), place)
        lens = opencv(list(numbers(values["distortion"], (5,), "distortion", place)))
        intrinsics = Intrinsics.of_matrix((row["width"], row["height"]), k)
        writer.cameras.append(camera(name, intrinsics, pose, place, lens=lens))


def _blobs_folder(path: Path, source: Path) -> Path | None:
    """The folder to which names of files are relative: sensor_blobs beside the splits, or in the source."""
    around = [source, *path.parents]
    return next((folder / "sensor_blobs" for folder in around if (folder / "sensor_blobs").is_dir()), None)


def _images(database: _Database, writer: LogWriter, folder: Path | None) -> None:
    total = database.count("image")
    if folder is None:
        return writer.left_out("images", total, "no folder sensor_blobs in the source or above the database")
    query = "SELECT i.filename_jpg AS file, i.timestamp AS time_us, c.channel AS channel FROM image AS i "
    query += "JOIN camera AS c ON c.token = i.camera_token ORDER BY i.timestamp, c.channel"
    with Progress(f"nuplan {database.path.stem}, images", total) as progress:
        for row in database.rows(query):
            file = folder / row["file"]
            if file.is_file():
                writer.image(row["channel"], int(row["time_us"]), file)
            else:
                writer.left_out(f"images of {row['channel']} without a file", 1, "not downloaded")
            progress.step()


def _sweeps(database: _Database, writer: LogWriter, folder: Path | None) -> None:
    total = database.count("lidar_pc")
    if folder is None or "lidar" not in database.tables:
        return writer.left_out("merged sweeps of the LiDARs", total, "no folder sensor_blobs, or no table lidar")
    mounts: dict[bytes, str] = {}
    for row in database.rows("SELECT * FROM lidar ORDER BY channel"):
        name = str(row["channel"])
        place = f"{database.path}, table lidar, {name}"
        values = [_list(row[key], key, place) for key in ("translation", "rotation")]
        writer.lidar(name, _pose(values[0], numbers(values[1], (4,), "rotation", place), place))
        mounts[row["token"]] = name
    count = 0
    with Progress(f"nuplan {database.path.stem}, sweeps", total) as progress:
        for row in database.rows("SELECT filename, lidar_token, timestamp FROM lidar_pc ORDER BY timestamp"):
            progress.step()
            if row["lidar_token"] not in mounts:
                place = f"{database.path}, table lidar_pc"
                raise LogError(place, "a sweep of a LiDAR that the table lidar lacks", "download the database again")
            file, time_us = folder / str(row["filename"]), int(row["timestamp"])
            if file.is_file():
                writer.sweep(mounts[row["lidar_token"]], time_us, partial(_sweep, file, time_us))
                count += 1
            else:
                writer.left_out("merged sweeps of the LiDARs without a file", 1, "not downloaded")
    writer.left_out("times of single points, sweeps", count, "not recorded: all points have the time of the sweep")


def _sweep(path: Path, time_us: int) -> Sweep:
    points = pcd_points(path, ["x", "y", "z", "intensity", "ring"])
    xyz = np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1)
    times = np.full(len(points), time_us, np.int64)
    return Sweep(xyz, times, points["intensity"], points["ring"])


def _boxes(database: _Database, writer: LogWriter) -> None:
    query = "SELECT b.*, p.timestamp AS time_us, c.name AS label FROM lidar_box AS b "
    query += "JOIN lidar_pc AS p ON p.token = b.lidar_pc_token JOIN track AS t ON t.token = b.track_token "
    query += "JOIN category AS c ON c.token = t.category_token ORDER BY p.timestamp"
    for row in database.rows(query):
        yaw = float(row["yaw"])
        pose = transform([row[axis] for axis in "xyz"], (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)))
        size, velocity = [row[side] for side in ("length", "width", "height")], [row[f"v{axis}"] for axis in "xyz"]
        known = None if None in velocity else velocity
        writer.box(int(row["time_us"]), bytes(row["track_token"]).hex(), row["label"], size, pose, known)
    count = database.count("lidar_box")
    writer.left_out("confidences of boxes", count, "no field for them")
