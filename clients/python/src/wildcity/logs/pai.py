"""NVIDIA's Physical AI Autonomous Vehicles: a clip in the folders of the tool pai-clip-dl of NVIDIA's ncore.

The schema is that of docs/conversions/pai and tools/data_converter/pai in ncore's repository: rig x forward, y left, z
up, on the ground under the rear axle; quaternions (x, y, z, w); times in microseconds; the timestamp of a frame is the
end of its readout, which takes `shutter_delay_us`. The `.offline` file of a component is preferred, as ncore does.

Cameras are MP4 videos. Their frames are decoded by PyAV and written as PNG, so that nothing is lost after decoding.
Points of a sweep are in the axes of the LiDAR at their own times, which are attributes of the points in Draco's format.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import DracoPy
import numpy as np

from .arrow_files import parquet_rows
from .errors import LogError
from .frames import Matrix, Poses, transform
from .kinds import Options, choose
from .pai_lenses import camera_of
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import require
from .videos import add_video
from .writer import LogWriter, Report

LICENCE = "the licence of nvidia/PhysicalAI-Autonomous-Vehicles"

SLACK_US = 100_000
"""How far a point may be outside the bounds of its spin: further ones are in another unit."""

_POSE = ["qx", "qy", "qz", "qw", "x", "y", "z"]


def _clips(source: Path) -> dict[str, Path]:
    if (source / "calibration").is_dir():
        return {source.name: source}
    return {path.parent.name: path.parent for path in sorted(source.glob("*/calibration"))}


def logs(source: Path) -> list[str]:
    """Ids of the clips."""
    return list(_clips(source))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one clip."""
    found = _clips(source)
    name = choose(list(found), options.log, source, "clip")
    clip = _Clip(found[name], name)
    decides = {"clip": str(found[name])}
    with opened("pai", source, out, options, log=name, licence=LICENCE, decides=decides) as writer:
        times, poses = clip.poses(writer)
        readouts = clip.rig(writer)
        for camera in readouts:
            clip.images(writer, camera)
        clip.boxes(writer, Poses(times, poses))
        clip.sweeps(writer)
        writer.left_out("files of radars", len(list(clip.root.glob("radar/*.parquet"))), "no table for them")
        return writer.finish()


class _Clip:
    """The files of one clip."""

    def __init__(self, root: Path, name: str) -> None:
        self.root, self.name = root, name
        self.mounts: dict[str, Matrix] = {}
        """rig_from_sensor, by the sensor's name."""

    def file(self, folder: str, name: str) -> Path:
        """A Parquet file, or its `.offline` variant if there is one."""
        offline = self.root / folder / f"{name}.offline.parquet"
        return offline if offline.exists() else self.root / folder / f"{name}.parquet"

    def rows(self, path: Path, names: list[str], what: str) -> Iterator[dict[str, Any]]:
        """Rows as Python values; of a table of several clips only those of this one."""
        for row in parquet_rows(path, names, what, rows_at_once=1024):
            found = {name: value.as_py() for name, value in row.items()}
            if found.get("clip_id", self.name) == self.name:
                yield found

    def poses(self, writer: LogWriter) -> tuple[list[int], list[Matrix]]:
        """Adds the poses of the rig. Returns their times and themselves."""
        path = self.file("labels", f"{self.name}.egomotion")
        times: list[int] = []
        poses: list[Matrix] = []
        for row in self.rows(path, ["timestamp", *_POSE], "the poses of the clip"):
            time_us = int(row["timestamp"])
            if times and time_us <= times[-1]:
                problem = f"the timestamp {time_us} follows {times[-1]}: the clock runs backwards"
                raise LogError(path, problem, "download the clip again")
            times.append(time_us)
            poses.append(_pose(row, str(path)))
        if not times:
            raise LogError(path, "no poses", "download the clip again")
        writer.begin(times[0], poses[0][:3, 3])
        for time_us, pose in zip(times, poses, strict=True):
            writer.pose(time_us, pose, str(path))
        return times, poses

    def rig(self, writer: LogWriter) -> list[str]:
        """Adds the cameras that have a video. Returns their names."""
        path, mounts_path = self.file("calibration", "camera_intrinsics"), self.file("calibration", "sensor_extrinsics")
        names = ["clip_id", "sensor_name", *_POSE]
        self.mounts = {row["sensor_name"]: _pose(row, str(mounts_path))
                  for row in self.rows(mounts_path, names, "the mounts of the sensors")}  # fmt: skip
        found = []
        names = ["clip_id", "camera_name", "model_type", "model_parameters"]
        for row in sorted(
            self.rows(path, names, "the intrinsics of the cameras"), key=lambda row: str(row["camera_name"])
        ):
            name, place = str(row["camera_name"]), f"{path}, {row['camera_name']}"
            if not self.video(name).exists():
                writer.left_out(f"camera {name}", 1, "the clip has no video of it")
                continue
            if name not in self.mounts:
                raise LogError(mounts_path, f"no row of {name}", "use calibrations of one clip")
            try:
                parameters = json.loads(row["model_parameters"])
            except (TypeError, json.JSONDecodeError):
                raise LogError(place, "model_parameters is no JSON: no intrinsics", "download it again") from None
            writer.cameras.append(camera_of(name, row["model_type"], parameters, self.mounts[name], place))
            found.append(name)
        return found

    def video(self, camera: str) -> Path:
        return self.root / "camera" / f"{self.name}.{camera}.mp4"

    def images(self, writer: LogWriter, camera: str) -> None:
        """Adds the frames of a video."""
        path, video = self.root / "camera" / f"{self.name}.{camera}.timestamps.parquet", self.video(camera)
        times = [int(row["timestamp"]) for row in self.rows(path, ["timestamp"], "the times of a video")]
        add_video(writer, camera, video, times, path)
        boxes = path.with_name(path.name.replace(".timestamps.", ".blurred_boxes."))
        writer.left_out(f"blurred boxes of {camera}, files", int(boxes.exists()), "no field for them")

    def sweeps(self, writer: LogWriter) -> None:
        """Adds the spins of each LiDAR: a row has their bounds, and the points as Draco encodes them."""
        names = ["spin_start_timestamp", "spin_end_timestamp", "draco_encoded_pointcloud"]
        for path in sorted((self.root / "lidar").glob(f"{self.name}.lidar_*.parquet")):
            lidar = path.name.removeprefix(f"{self.name}.").partition(".")[0]
            if lidar not in self.mounts:
                raise LogError(path, f"sensor_extrinsics has no row of {lidar}", "use calibrations of one clip")
            writer.lidar(lidar, self.mounts[lidar])
            with Progress(f"pai, {lidar}", 0) as progress:
                for row in parquet_rows(path, names, "the sweeps of a LiDAR", rows_at_once=2):
                    start_us, end_us = (int(row[name].as_py()) for name in names[:2])
                    read = partial(_sweep, row[names[2]].as_py, (start_us, end_us), f"{path}, spin at {start_us} us")
                    writer.sweep(lidar, start_us, read)
                    progress.step()

    def boxes(self, writer: LogWriter, poses: Poses) -> None:
        """Adds the obstacles: boxes in the rig's frame at `reference_frame_timestamp_us`."""
        path = self.file("labels", f"{self.name}.obstacle")
        if not path.exists():
            return writer.left_out("boxes", 1, "the clip has no obstacles")
        numbers = [f"center_{axis}" for axis in "xyz"] + [f"size_{axis}" for axis in "xyz"]
        turn = [f"orientation_{axis}" for axis in "wxyz"]
        names = ["timestamp_us", "track_id", "label_class", "reference_frame", "reference_frame_timestamp_us"]
        for row in self.rows(require(path, "the obstacles"), [*names, *numbers, *turn], "the obstacles"):
            reference_us, frame = int(row["reference_frame_timestamp_us"]), row["reference_frame"]
            if frame != "rig":
                writer.left_out(f"boxes in the frame {frame}", 1, "not the rig's")
            elif not poses.covers(reference_us):
                writer.left_out("boxes outside the times of the poses", 1, "no pose of the rig")
            else:
                box = transform([row[name] for name in numbers[:3]], [row[name] for name in turn])
                world_from_box = poses.at(reference_us) @ box
                size = [row[name] for name in numbers[3:]]
                writer.box(int(row["timestamp_us"]), str(row["track_id"]), row["label_class"], size, world_from_box)


def _pose(row: dict[str, Any], place: str) -> Matrix:
    x, y, z, w = (float(row[name]) for name in _POSE[:4])
    if not abs((x * x + y * y + z * z + w * w) ** 0.5 - 1) < 1e-3:
        raise LogError(place, f"the quaternion (x, y, z, w) {(x, y, z, w)} has not the length 1", "download it again")
    return transform([float(row[name]) for name in _POSE[4:]], (w, x, y, z))


def _sweep(data: Callable[[], bytes], bounds: tuple[int, int], place: str) -> Sweep:
    """Points of Draco with the attributes `timestamp`, in microseconds as the bounds, and `intensity`."""
    try:
        found = DracoPy.decode(data())
    except (ValueError, TypeError, RuntimeError, DracoPy.FileTypeException) as error:
        raise LogError(place, f"no point cloud of Draco: {error}", "download the clip again") from None
    values = {its["name"]: np.asarray(its["data"]).reshape(len(found.points), -1)[:, 0] for its in found.attributes}
    if "timestamp" not in values:
        raise LogError(place, "its points have no attribute timestamp", "use a clip of the documented schema")
    times = values["timestamp"].astype(np.int64)
    if len(times) and (times.min() < bounds[0] - SLACK_US or times.max() > bounds[1] + SLACK_US):
        problem = f"points of {times.min()} to {times.max()} us, outside the spin of {bounds[0]} to {bounds[1]} us"
        raise LogError(place, problem, "use a clip of the documented schema")
    return Sweep(np.asarray(found.points), times, values.get("intensity"))
