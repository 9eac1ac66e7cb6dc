"""Argoverse 2, Sensor and LiDAR data sets: https://argoverse.github.io/user-guide/datasets/sensor.html and av2-api.

The egovehicle frame has x forward, y left, z up, at the middle of the rear axle; the city frame has z up, metres. Times
are nanoseconds. Images are undistorted: the coefficients k1 to k3 of the calibration are those of the lens before, and
the API projects without them. The points of a sweep are in the egovehicle frame, compensated for its motion to the
sweep's timestamp; each has its own time after it (`offset_ns`).
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .arrow_files import columns, records
from .errors import LogError
from .frames import Matrix, Poses, transform
from .kinds import Options, choose
from .lenses import Intrinsics, camera
from .maps import MapBuilder
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import field, json_file
from .writer import LogWriter, Report

LICENCE = "CC BY-NC-SA 4.0 (Argoverse 2)"

CITIES = {
    "ATX": (14, 621150.0275, 3349889.9996),
    "DTW": (17, 320669.9346, 4685369.9988),
    "MIA": (17, 580560.0088, 2850959.9999),
    "PAO": (10, 576480.0006, 4141379.9353),
    "PIT": (17, 583710.0070, 4477259.9998),
    "WDC": (18, 323459.9997, 4306469.9870),
}
"""UTM zone, easting and northing of each city's origin, of its degrees in av2/geometry/utm.py."""

_POSE = ["qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"]
_POSES, _MOUNTS = "city_SE3_egovehicle.feather", "calibration/egovehicle_SE3_sensor.feather"
_LANE_KINDS = {"BIKE": "bicycle"}


def _logs(source: Path) -> dict[str, Path]:
    if (source / _POSES).exists():
        return {source.name: source}
    return {
        path.parent.name: path.parent for path in sorted([*source.glob(f"*/{_POSES}"), *source.glob(f"*/*/{_POSES}")])
    }


def logs(source: Path) -> list[str]:
    """Ids of the logs."""
    return list(_logs(source))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one log."""
    found = _logs(source)
    name = choose(list(found), options.log, source, "log")
    log = found[name]
    times, poses, repeated = _poses(log / _POSES)
    with opened("argoverse2", source, out, options, log=name, licence=LICENCE, decides={"poses": len(times)}) as writer:
        first_us = min([times[0], *(int(path.stem) // 1000 for path in log.glob("sensors/*/*.feather"))])
        writer.begin(first_us, poses[0][:3, 3])
        writer.geo = _geo(writer, log)
        for time_us, pose in zip(times, poses, strict=True):
            writer.pose(time_us, pose, str(log / _POSES))
        writer.left_out("poses in the same microsecond as the pose before", repeated, "a log has microseconds")
        cameras = _rig(writer, log)
        _images(writer, log, cameras)
        _sweeps(writer, log)
        _boxes(writer, log, Poses(times, poses))
        return writer.finish(_map(writer, log))


def _map_path(log: Path) -> Path | None:
    return next(iter(sorted(log.glob("map/log_map_archive_*.json"))), None)


def _geo(writer: LogWriter, log: Path) -> dict[str, Any] | None:
    """The anchor of the log's origin. The name of the map names the city: log_map_archive_ID____PIT_city_47896.json."""
    path = _map_path(log)
    found = re.search(r"____([A-Z]+)_city_", path.name) if path else None
    if found is None or found[1] not in CITIES:
        writer.left_out("place on the earth", 1, "the log has no map with the name of its city")
        return None
    writer.left_out("height above the ellipsoid", 1, "that of the city's frame is not documented")
    zone, easting, northing = CITIES[found[1]]
    east, north = easting + float(writer.origin_m[0]), northing + float(writer.origin_m[1])
    return {"projection": f"EPSG:326{zone:02d}", "easting_m": east, "northing_m": north}


def _pose(row: dict[str, Any], place: str) -> Matrix:
    q = [float(row[name]) for name in _POSE[:4]]
    if not abs(float(np.linalg.norm(q)) - 1) < 1e-3:
        raise LogError(place, f"the quaternion (w, x, y, z) {q} has not the length 1", "download the file again")
    return transform([float(row[name]) for name in _POSE[4:]], q)


def _poses(path: Path) -> tuple[list[int], list[Matrix], int]:
    """Times in microseconds, city_from_egovehicle, and how many more rows are in the microsecond of another."""
    times: list[int] = []
    repeated = 0
    poses: list[Matrix] = []
    for row in records(path, ["timestamp_ns", *_POSE], "the poses of the log"):
        time_us = int(row["timestamp_ns"]) // 1000
        if times and time_us < times[-1]:
            problem = f"timestamp_ns {row['timestamp_ns']} follows a later one: the clock runs backwards"
            raise LogError(path, problem, "download the file again")
        if times and time_us == times[-1]:
            repeated += 1
            continue
        times.append(time_us)
        poses.append(_pose(row, str(path)))
    if not times:
        raise LogError(path, "no poses", "download the file again")
    return times, poses, repeated


def _rig(writer: LogWriter, log: Path) -> set[str]:
    """Adds the cameras. The points are in the egovehicle frame: so is their LiDAR."""
    path = log / "calibration" / "intrinsics.feather"
    mounts = {row["sensor_name"]: _pose(row, str(log / _MOUNTS))
              for row in records(log / _MOUNTS, ["sensor_name", *_POSE], "the mounts of the sensors")}  # fmt: skip
    names = ["sensor_name", "fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px"]
    added = set()
    for row in records(path, names, "the intrinsics of the cameras"):
        name = str(row["sensor_name"])
        if name not in mounts:
            raise LogError(log / _MOUNTS, f"no row of {name}", "use calibrations of one log")
        size = (int(row["width_px"]), int(row["height_px"]))
        focal = [float(row[key]) for key in names[1:5]]
        writer.cameras.append(camera(name, Intrinsics(*size, *focal), mounts[name], str(path)))
        added.add(name)
    writer.lidar("lidar", np.eye(4))
    writer.left_out("height of the rig above the ground", 1, "the rig is the middle of the rear axle")
    writer.left_out("distortion coefficients of lenses before undistortion", len(added), "images are undistorted")
    return added


def _images(writer: LogWriter, log: Path, cameras: set[str]) -> None:
    files = sorted((log / "sensors" / "cameras").glob("*/*.jpg"), key=lambda path: (path.parent.name, int(path.stem)))
    if not files:
        writer.left_out("images", 1, "the log has no sensors/cameras")
    with Progress("argoverse2, images", len(files)) as progress:
        for path in files:
            name = path.parent.name
            if name not in cameras:
                place = log / "calibration" / "intrinsics.feather"
                raise LogError(place, f"no row of the camera {name}: it has no intrinsics", "use files of one log")
            writer.image(name, int(path.stem) // 1000, path)
            progress.step()


def _sweeps(writer: LogWriter, log: Path) -> None:
    files = sorted((log / "sensors" / "lidar").glob("*.feather"), key=lambda path: int(path.stem))
    with Progress("argoverse2, sweeps", len(files)) as progress:
        for path in files:
            time_us = int(path.stem) // 1000
            writer.sweep("lidar", time_us, partial(_sweep, path), compensated_to_us=time_us)
            progress.step()


def _sweep(path: Path) -> Sweep:
    found = columns(path, ["x", "y", "z", "intensity", "laser_number", "offset_ns"], "a sweep")
    points = np.stack([found[axis] for axis in "xyz"], axis=1)
    times = (int(path.stem) + found["offset_ns"].astype(np.int64)) // 1000
    return Sweep(points, times, found["intensity"], found["laser_number"])


def _boxes(writer: LogWriter, log: Path, poses: Poses) -> None:
    """Boxes are in the egovehicle frame at their own time."""
    path = log / "annotations.feather"
    if not path.exists():
        return writer.left_out("boxes", 1, "the log has no annotations.feather")
    names = ["timestamp_ns", "track_uuid", "category", "length_m", "width_m", "height_m", *_POSE]
    count = 0
    for row in records(path, names, "boxes"):
        time_us = int(row["timestamp_ns"]) // 1000
        if not poses.covers(time_us):
            writer.left_out("boxes outside the times of the poses", 1, "no pose of the rig")
            continue
        size = [row[side] for side in ("length_m", "width_m", "height_m")]
        pose = poses.at(time_us) @ _pose(row, str(path))
        writer.box(time_us, str(row["track_uuid"]), str(row["category"]), size, pose)
        count += 1
    writer.left_out("numbers of points in boxes", count, "no field for them")


def _map(writer: LogWriter, log: Path) -> dict[str, Any] | None:
    """log_map_archive_*.json: lane segments, drivable areas and crossings, in the city frame."""
    path = _map_path(log)
    if path is None:
        writer.left_out("map", 1, "the log has no map/log_map_archive_*.json")
        return None
    found, builder, place = json_file(path, "the map"), MapBuilder(writer.origin_m), str(path)
    for one in field(found, "lane_segments", place).values():
        left, right = (_points(field(one, f"{side}_lane_boundary", place), place) for side in ("left", "right"))
        following = [str(name) for name in field(one, "successors", place)]
        kind = _LANE_KINDS.get(one.get("lane_type"), "driving")
        is_intersection = bool(one.get("is_intersection"))
        builder.lane(str(one["id"]), left, right, following, kind=kind, is_intersection=is_intersection, place=place)
    for one in found.get("drivable_areas", {}).values():
        builder.area("drivable", _points(field(one, "area_boundary", place), place), place)
    for one in found.get("pedestrian_crossings", {}).values():
        a, b = (_points(field(one, edge, place), place) for edge in ("edge1", "edge2"))
        builder.area("crosswalk", [*a, *b[::-1]], place)
    writer.left_out("marks and neighbours of lanes", len(builder.lanes), "no field for them")
    return builder.file()


def _points(line: Any, place: str) -> list[list[float]]:
    return [[float(field(point, axis, place)) for axis in "xyz"] for point in line]
