"""Waymo Open Dataset, Perception 2.0: Parquet files by component, read by pyarrow and without TensorFlow.

The components, their fields and frames are those of src/waymo_open_dataset/v2/perception of the data set's repository.
The vehicle has x forward, y left, z up; cameras have x forward, y left, z up, too, and count pixels from the corner of
the image. Lenses are OpenCV's. Each image has the pose of the vehicle and the time of that pose, and these are the
poses of the log. The pose of a frame, in which boxes and range images are, has no time of its own (dataset.proto: it
roughly corresponds to the middle of the frame). So boxes and points are transformed to the world by it, and get the
time and the pose of an image of their frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .arrow_files import parquet_rows
from .errors import LogError
from .frames import CAMERA_AXES, Matrix, rotation_error
from .kinds import Options, choose
from .lenses import Intrinsics, camera, opencv
from .names import name_of
from .progress import Progress
from .source import opened
from .tableio import numbers
from .waymo_range import Pixels, points_of
from .writer import LogWriter, Report

LICENCE = "Waymo Dataset License Agreement for Non-Commercial Use"

CAMERAS = {1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right"}
LASERS = {1: "top", 2: "front", 3: "side_left", 4: "side_right", 5: "rear"}
CLASSES = {0: "TYPE_UNKNOWN", 1: "TYPE_VEHICLE", 2: "TYPE_PEDESTRIAN", 3: "TYPE_SIGN", 4: "TYPE_CYCLIST"}
DIRECTIONS = {1: "top_to_bottom", 2: "left_to_right", 3: "bottom_to_top", 4: "right_to_left"}

_FRAME = "key.frame_timestamp_micros"
_SHUTTER = "[CameraImageComponent].rolling_shutter_params."
_TIMES = [_SHUTTER + name for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")]
_POSE, _POSE_TIME = "[CameraImageComponent].pose.transform", "[CameraImageComponent].pose_timestamp"


def logs(source: Path) -> list[str]:
    """Names of the segments."""
    return sorted(path.stem for path in (source / "camera_image").glob("*.parquet"))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one segment."""
    name = choose(logs(source), options.log, source, "segment (camera_image/*.parquet)")
    return _Segment(source, name).convert(source, out, options)


def _microseconds(seconds: float) -> int:
    return round(seconds * 1e6)


class _Segment:
    """The files of one segment, and the poses of its images."""

    def __init__(self, source: Path, name: str) -> None:
        self.source, self.name = source, name
        self.poses: dict[int, Matrix] = {}
        self.of_frame: dict[int, int] = {}
        """Time of the pose that boxes and points of a frame get."""
        self.readouts: dict[int, list[int]] = {}
        """By camera, the microseconds between the middles of the exposures of the first and the last line."""
        self.frame_poses: dict[int, Matrix] = {}

    def path(self, component: str) -> Path:
        return self.source / component / f"{self.name}.parquet"

    def rows(self, component: str, names: list[str], at_once: int = 64) -> Iterator[dict[str, Any]]:
        return parquet_rows(self.path(component), names, f"the component {component}", at_once)

    def convert(self, source: Path, out: Path, options: Options) -> Report:
        self._read_poses()
        decides = {"poses": len(self.poses)}
        with opened("waymo", source, out, options, log=self.name, licence=LICENCE, decides=decides) as writer:
            first_us = min(self.poses)
            writer.begin(first_us, self.poses[first_us][:3, 3])
            for time_us, pose in self.poses.items():
                writer.pose(time_us, pose, str(self.path("camera_image")))
            self._rig(writer)
            self._images(writer)
            self._sweeps(writer)
            self._boxes(writer)
            writer.left_out("maps, 2D boxes, key points and segmentations", 1, "no fields for them")
            return writer.finish()

    def _read_poses(self) -> None:
        names = [_FRAME, "key.camera_name", _POSE, _POSE_TIME, *_TIMES]
        first_camera: dict[int, int] = {}
        for row in self.rows("camera_image", names):
            place = f"{self.path('camera_image')}, frame {row[_FRAME]}"
            time_us, number = _microseconds(row[_POSE_TIME].as_py()), row["key.camera_name"].as_py()
            pose = _transform(row[_POSE], place)
            known = self.poses.setdefault(time_us, pose)
            if abs(known - pose).max() > 0.01:
                raise LogError(place, f"two poses of the vehicle at {time_us} us", "download the segment again")
            frame = row[_FRAME].as_py()
            if number < first_camera.get(frame, 99):
                first_camera[frame], self.of_frame[frame] = number, time_us
            shutter, trigger, done = (row[name].as_py() for name in _TIMES)
            self.readouts.setdefault(number, []).append(_microseconds(done - trigger - shutter))
        if not self.poses:
            raise LogError(self.path("camera_image"), "no images, and so no poses", "download the segment again")
        pose_name = "[VehiclePoseComponent].world_from_vehicle.transform"
        for row in self.rows("vehicle_pose", [_FRAME, pose_name]):
            self.frame_poses[row[_FRAME].as_py()] = _transform(row[pose_name], str(self.path("vehicle_pose")))

    def _rig(self, writer: LogWriter) -> None:
        prefix = "[CameraCalibrationComponent]."
        lens = [prefix + f"intrinsic.{name}" for name in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")]
        rest = [prefix + name for name in ("extrinsic.transform", "width", "height", "rolling_shutter_direction")]
        for row in self.rows("camera_calibration", ["key.camera_name", *lens, *rest]):
            place, number = str(self.path("camera_calibration")), row["key.camera_name"].as_py()
            values = [row[name].as_py() for name in lens]
            width, height, direction = (row[name].as_py() for name in rest[1:])
            pose = _transform(row[rest[0]], place) @ CAMERA_AXES
            shutter = None
            if direction in DIRECTIONS and self.readouts.get(number):
                median = int(np.median(self.readouts[number]))
                shutter = {"direction": DIRECTIONS[direction], "duration_us": median}
                spread = max(self.readouts[number]) - min(self.readouts[number])
                if spread:
                    what = f"changes of the readout of {CAMERAS.get(number)}, up to {spread} us, images"
                    writer.left_out(what, len(self.readouts[number]), "the rig has the median")
            intrinsics = Intrinsics(width, height, *values[:4])
            name = CAMERAS.get(number, f"camera_{number}")
            writer.cameras.append(
                camera(name, intrinsics, pose, place, lens=opencv(values[4:]), shutter=shutter, from_middle=False)
            )

    def _images(self, writer: LogWriter) -> None:
        """The time of an image is that of the middle of the exposure of its last line."""
        names = ["key.camera_name", "[CameraImageComponent].image", *_TIMES]
        total = sum(len(its) for its in self.readouts.values())
        with Progress(f"waymo {self.name}, images", total) as progress:
            for row in self.rows("camera_image", names, at_once=8):
                shutter, _, done = (row[name].as_py() for name in _TIMES)
                name = CAMERAS.get(row["key.camera_name"].as_py(), "unknown")
                exposure_us = max(1, _microseconds(shutter))
                time_us = _microseconds(done - shutter / 2)
                writer.image_bytes(name, time_us, ".jpg", row[names[1]].as_py, exposure_us=exposure_us)
                progress.step()

    def _sweeps(self, writer: LogWriter) -> None:
        if not self.path("lidar").exists():
            return writer.left_out("sweeps", 1, "no component lidar")
        mounts = self._lasers(writer)
        returns = [f"[LiDARComponent].range_image_return{n}.{part}" for n in (1, 2) for part in ("values", "shape")]
        pixel_poses = _PixelPoses(self)
        count = 0
        with Progress(f"waymo {self.name}, sweeps", len(self.of_frame) * len(mounts)) as progress:
            for row in self.rows("lidar", [_FRAME, "key.laser_name", *returns], at_once=2):
                frame, number = row[_FRAME].as_py(), row["key.laser_name"].as_py()
                time_us = self._time_of(frame, "lidar")
                if number not in mounts:
                    place = self.path("lidar_calibration")
                    raise LogError(place, f"no row of the laser {number}", "use components of one segment")
                pixels = Pixels(row, returns, *mounts[number], pixel_poses.at(frame, number))
                read = partial(points_of, pixels, self.frame_poses[frame], self.poses[time_us], time_us)
                writer.sweep(LASERS[number], time_us, read, compensated_to_us=time_us)
                count += 1
                progress.step()
        writer.left_out("times of single points, sweeps", count, "not recorded: all have the time of a pose")
        writer.left_out("elongations of points, sweeps", count, "no field for them")

    def _lasers(self, writer: LogWriter) -> dict[int, tuple[Matrix, Any, tuple[float, float]]]:
        """Mount, inclinations of the beams from below (or None), and the lowest and the highest, by laser."""
        prefix = "[LiDARCalibrationComponent]."
        names = [prefix + f"{name}" for name in ("extrinsic.transform", "beam_inclination.values")]
        names += [prefix + f"beam_inclination.{name}" for name in ("min", "max")]
        found = {}
        for row in self.rows("lidar_calibration", ["key.laser_name", *names]):
            mount = _transform(row[names[0]], str(self.path("lidar_calibration")))
            number, values = row["key.laser_name"].as_py(), row[names[1]].as_py() or None
            found[number] = (mount, values, (row[names[2]].as_py(), row[names[3]].as_py()))
            writer.lidar(LASERS[number], mount)
        return found

    def _time_of(self, frame: int, component: str) -> int:
        if frame not in self.of_frame or frame not in self.frame_poses:
            problem = f"the frame {frame} has no image, or no pose"
            raise LogError(self.path(component), problem, "download camera_image and vehicle_pose of the segment")
        return self.of_frame[frame]

    def _boxes(self, writer: LogWriter) -> None:
        if not self.path("lidar_box").exists():
            return writer.left_out("boxes", 1, "no component lidar_box")
        prefix = "[LiDARBoxComponent]."
        numbers_of = [prefix + f"box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"]
        names = [_FRAME, "key.laser_object_id", prefix + "type", prefix + "box.heading", *numbers_of]
        count = 0
        for row in self.rows("lidar_box", names):
            values = [row[name].as_py() for name in numbers_of]
            time_us, heading = self._time_of(row[_FRAME].as_py(), "lidar_box"), row[names[3]].as_py()
            box = np.eye(4)
            box[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
            box[:3, 3] = values[:3]
            pose = self.frame_poses[row[_FRAME].as_py()] @ box
            label = CLASSES.get(row[names[2]].as_py(), "TYPE_UNKNOWN")
            writer.box(time_us, name_of(row[names[1]].as_py()), label, values[3:], pose)
            count += 1
        writer.left_out("speeds, accelerations and difficulties of boxes", count, "their axes are not documented")


class _PixelPoses:
    """world_from_vehicle of each pixel of the top laser, joined to its range image by the frame."""

    def __init__(self, segment: _Segment) -> None:
        self._names = [f"[LiDARPoseComponent].range_image_return1.{part}" for part in ("values", "shape")]
        names = [_FRAME, "key.laser_name", *self._names]
        self._rows = segment.rows("lidar_pose", names, at_once=2) if segment.path("lidar_pose").exists() else iter(())
        self._waiting: dict[tuple[int, int], Any] = {}

    def at(self, frame: int, laser: int) -> Any:
        """Roll, pitch, yaw, x, y, z of each pixel [h, w, 6], or None. Only the top laser has them."""
        if laser != 1:
            return None
        while (frame, laser) not in self._waiting:
            row = next(self._rows, None)
            if row is None:
                return None
            key = (row[_FRAME].as_py(), row["key.laser_name"].as_py())
            shape = row[self._names[1]].as_py()
            self._waiting[key] = row[self._names[0]].values.to_numpy().reshape(shape)
        return self._waiting.pop((frame, laser))


def _transform(value: Any, place: str) -> Matrix:
    """A transform [4, 4] of 16 numbers by row. The rotation, which older files have in f32, is made exact."""
    matrix = numbers(value.as_py(), (16,), "a transform", place).reshape(4, 4)
    if rotation_error(matrix) > 1e-3:
        raise LogError(place, "a transform is no rotation and translation", "download the segment again")
    u, _, v = np.linalg.svd(matrix[:3, :3])
    return np.vstack([np.c_[u @ v, matrix[:3, 3]], [0, 0, 0, 1]])
