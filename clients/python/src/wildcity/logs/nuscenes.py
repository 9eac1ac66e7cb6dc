"""nuScenes, by its tables: https://www.nuscenes.org/nuscenes#data-format and docs/schema_nuscenes.md of its devkit.

Frames: `global` has z up, metres; `ego` has x forward, y left, z up, on the ground under the rear axle; cameras have
OpenCV's axes. Times are microseconds. Images have no distortion. The time of an image is that of the trigger. The
points of a sweep are compensated for the motion of the vehicle to the sweep's timestamp (Caesar et al., "nuScenes",
CVPR 2020, section 3).

Tables are read row by row, and only rows of one scene stay in memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LogError
from .frames import Matrix, transform
from .kinds import Options, choose
from .lenses import Intrinsics, camera
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import field, integer, json_rows, numbers, require, text
from .writer import LogWriter, Report

LICENCE = "CC BY-NC-SA 4.0, and the terms of use of nuScenes"


_TEXTS = {
    "scene": ("token", "name"),
    "sample": ("token", "scene_token"),
    "sample_data": ("token", "sample_token", "ego_pose_token", "calibrated_sensor_token", "filename"),
    "calibrated_sensor": ("token", "sensor_token"),
    "sensor": ("token", "channel", "modality"),
    "ego_pose": ("token",),
    "sample_annotation": ("token", "sample_token", "instance_token"),
    "instance": ("token", "category_token"),
    "category": ("token", "name"),
}
"""Fields of tables that are texts, and not empty."""

_TIMED = ("sample", "sample_data", "ego_pose")
"""Tables with the field `timestamp`, in microseconds."""


class _Tables:
    """The tables of one version of the data set."""

    def __init__(self, source: Path) -> None:
        folders = [source] if (source / "sample_data.json").exists() else sorted(source.glob("v1.*"))
        if len(folders) != 1:
            names = ", ".join(folder.name for folder in folders) or "none"
            raise LogError(source, f"folders of tables: {names}", "give the folder of one version, such as v1.0-mini")
        self.folder = folders[0]
        self.root = self.folder.parent

    def place(self, table: str) -> str:
        return str(self.folder / f"{table}.json")

    def rows(self, table: str, key: str | None = None, values: Any = None) -> Iterator[dict[str, Any]]:
        """The rows of a table whose field `key` is one of `values`."""
        for row in json_rows(self.folder / f"{table}.json", f"the table {table} of nuScenes"):
            if key is None or text(field(row, key, self.place(table)), key, self.place(table)) in values:
                place = f"{self.place(table)}, token {row.get('token')}"
                for name in _TEXTS.get(table, ()):
                    text(field(row, name, place), name, place)
                if table in _TIMED:
                    integer(field(row, "timestamp", place), "timestamp", place)
                yield row

    def by_token(self, table: str, tokens: Any = None) -> dict[str, dict[str, Any]]:
        key = None if tokens is None else "token"
        found = {str(field(row, "token", self.place(table))): row for row in self.rows(table, key, tokens)}
        for token in tokens or ():
            if token not in found:
                raise LogError(self.place(table), f"no row with the token {token}", "use tables of one version")
        return found

    def pose(self, row: dict[str, Any], table: str) -> Matrix:
        """The fields `translation` and `rotation` of a row."""
        place = f"{self.place(table)}, token {row.get('token')}"
        q = numbers(field(row, "rotation", place), (4,), "rotation", place)
        if abs(float(np.linalg.norm(q)) - 1) > 1e-3:
            raise LogError(place, f"rotation is {list(q)}, no unit quaternion", "repair the row")
        return transform(numbers(field(row, "translation", place), (3,), "translation", place), q)


def logs(source: Path) -> list[str]:
    """Names of the scenes."""
    tables = _Tables(source)
    place = tables.place("scene")
    return [text(field(row, "name", place), "name", place) for row in tables.rows("scene")]


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one scene."""
    tables = _Tables(source)
    scenes = {row["name"]: row for row in tables.rows("scene")}
    name = choose(list(scenes), options.log, tables.folder, "scene")
    samples = {row["token"]: row for row in tables.rows("sample", "scene_token", {scenes[name]["token"]})}
    data = list(tables.rows("sample_data", "sample_token", samples))
    if not data:
        raise LogError(tables.place("sample_data"), f"no row of the scene {name}", "use tables of one version")
    _check_clock(data, tables.place("sample_data"))
    mounts = tables.by_token("calibrated_sensor", {row["calibrated_sensor_token"] for row in data})
    sensors = tables.by_token("sensor", {row["sensor_token"] for row in mounts.values()})
    for row in data:
        mount = mounts[row["calibrated_sensor_token"]]
        row["mount"], row["sensor"] = mount, sensors[mount["sensor_token"]]
    data.sort(key=lambda row: (row["timestamp"], row["sensor"]["channel"], row["token"]))
    poses = tables.by_token("ego_pose", {row["ego_pose_token"] for row in data})
    first = numbers(poses[data[0]["ego_pose_token"]].get("translation"), (3,), "translation", tables.place("ego_pose"))
    with opened("nuscenes", source, out, options, log=name, licence=LICENCE, decides=_sizes(tables)) as writer:
        writer.begin(data[0]["timestamp"], first)
        _rig(tables, writer, data)
        for row in poses.values():
            writer.pose(row["timestamp"], tables.pose(row, "ego_pose"), f"{tables.place('ego_pose')}, {row['token']}")
        _boxes(tables, writer, samples)
        _sensors(tables, writer, data, name)
        writer.left_out("maps", 1, "the log of this kind has no map")
        return writer.finish()


def _sizes(tables: _Tables) -> dict[str, Any]:
    return {path.name: path.stat().st_size for path in sorted(tables.folder.glob("*.json"))}


def _check_clock(data: list[dict[str, Any]], place: str) -> None:
    """Refuses rows of a sensor whose times do not increase from each to its `next`."""
    times = {row["token"]: int(field(row, "timestamp", place)) for row in data}
    for row in data:
        after = times.get(field(row, "next", place))
        if after is not None and after <= times[row["token"]]:
            problem = f"timestamp {after} of {row['next']} follows {times[row['token']]}: the clock runs backwards"
            raise LogError(place, problem, "repair the timestamps")


def _rig(tables: _Tables, writer: LogWriter, data: list[dict[str, Any]]) -> None:
    seen: dict[str, dict[str, Any]] = {}
    for row in data:
        mount, channel = row["mount"], str(row["sensor"]["channel"])
        place = f"{tables.place('calibrated_sensor')}, token {mount['token']}"
        if channel in seen:
            same = all(seen[channel][key] == mount[key] for key in ("translation", "rotation", "camera_intrinsic"))
            if not same:
                raise LogError(place, f"a second calibration of {channel} in one scene", "split the scene")
            continue
        seen[channel] = mount
        pose, modality = tables.pose(mount, "calibrated_sensor"), row["sensor"]["modality"]
        if modality == "camera":
            k = numbers(field(mount, "camera_intrinsic", place), (3, 3), "camera_intrinsic", place)
            size = (field(row, "width", place), field(row, "height", place))
            writer.cameras.append(camera(channel, Intrinsics.of_matrix(size, k), pose, place))
        elif modality == "lidar":
            writer.lidar(channel, pose)


def _boxes(tables: _Tables, writer: LogWriter, samples: dict[str, dict[str, Any]]) -> None:
    place = tables.place("sample_annotation")
    boxes = list(tables.rows("sample_annotation", "sample_token", samples))
    instances = tables.by_token("instance", {row["instance_token"] for row in boxes})
    categories = tables.by_token("category", {row["category_token"] for row in instances.values()})
    for row in boxes:
        width, length, height = numbers(field(row, "size", place), (3,), "size", f"{place}, token {row['token']}")
        label = categories[instances[row["instance_token"]]["category_token"]]["name"]
        pose = tables.pose(row, "sample_annotation")
        time_us = samples[row["sample_token"]]["timestamp"]
        writer.box(time_us, row["instance_token"], label, (length, width, height), pose)
    writer.left_out("attributes and visibilities of boxes", len(boxes), "no field for them")


def _sensors(tables: _Tables, writer: LogWriter, data: list[dict[str, Any]], name: str) -> None:
    with Progress(f"nuscenes {name}", len(data)) as progress:
        for row in data:
            channel, modality, time_us = row["sensor"]["channel"], row["sensor"]["modality"], row["timestamp"]
            file = tables.root / field(row, "filename", tables.place("sample_data"))
            if modality == "camera":
                writer.image(channel, time_us, file)
                writer.left_out("exposure times of images", 1, "not recorded: the time of an image is the trigger")
            elif modality == "lidar":
                require(file, "a sweep of the LiDAR")
                writer.sweep(channel, time_us, partial(_sweep, file, time_us), compensated_to_us=time_us)
            else:
                writer.left_out(f"sweeps of {channel}", 1, f"no table for {modality}")
            progress.step()


def _sweep(file: Path, time_us: int) -> Sweep:
    """A .pcd.bin: x, y, z, intensity, ring in f32 for each point, and no times."""
    values = np.fromfile(file, "<f4")
    if values.size % 5:
        raise LogError(file, f"{values.size} numbers: a point has 5", "download it again: it is cut off")
    values = values.reshape(-1, 5)
    times = np.full(len(values), time_us, np.int64)
    return Sweep(values[:, :3], times, intensity=values[:, 3], ring=values[:, 4])
