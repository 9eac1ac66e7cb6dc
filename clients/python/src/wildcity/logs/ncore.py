"""NVIDIA's ncore V4, the format of Physical AI AV: docs/data/formats.rst and conventions.rst of its repository.

`rig` has x forward, y left, z up, on the ground under the rear axle; poses are rigid transforms between named frames,
of which those between a sensor and the rig are static. The time of an image is the end of its frame. Points of a LiDAR
are rays in its axes at their own times, not compensated. Boxes are turned about the fixed x, then y, then z axis
(`transformations.bbox_pose`). Times are microseconds.
"""

from __future__ import annotations

import ast
import statistics
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LogError
from .frames import Matrix, Poses, inverse, rotation_error
from .kinds import Options, choose
from .ncore_store import FIX, Store
from .pai_lenses import camera_of
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import field, integer, numbers
from .writer import LogWriter, Report

LICENCE = "the licence of the data set, such as nvidia/PhysicalAI-Autonomous-Vehicles"

_SUFFIXES = {"jpeg": ".jpg", "jpg": ".jpg", "png": ".png"}

_READ = ("poses", "intrinsics", "cameras", "lidars", "cuboids")


def _paths(source: Path) -> list[Path]:
    if source.is_file():
        return [source]
    found = [path for name in ("*ncore4*.zarr.itar", "*ncore4*.zarr") for path in source.glob(name)]
    return sorted(found or [path for name in ("*/*ncore4*.zarr.itar", "*/*ncore4*.zarr") for path in source.glob(name)])


def _sequences(source: Path, stack: ExitStack) -> dict[str, list[Store]]:
    """Stores by the sequence of which they have a part."""
    found: dict[str, list[Store]] = {}
    for path in _paths(source):
        store = stack.enter_context(Store(path))
        its = store.attributes("")
        if its.get("version") != "v4":
            raise LogError(path, f"the version {its.get('version')!r} of the format, not v4", "convert it with ncore")
        found.setdefault(str(field(its, "sequence_id", path)), []).append(store)
    return found


def logs(source: Path) -> list[str]:
    """Ids of the sequences."""
    with ExitStack() as stack:
        return list(_sequences(source, stack))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one sequence."""
    with ExitStack() as stack:
        found = _sequences(source, stack)
        name = choose(list(found), options.log, source, "sequence")
        sequence = _Sequence(name, found[name])
        decides = {store.path.name: store.path.stat().st_size for store in found[name]}
        with opened("ncore", source, out, options, log=name, licence=LICENCE, decides=decides) as writer:
            frames = _Frames(sequence)
            writer.begin(frames.times[0], frames.poses[0][:3, 3])
            for time_us, pose in zip(frames.times, frames.poses, strict=True):
                writer.pose(time_us, pose, frames.place)
            _cameras(sequence, frames, writer)
            _boxes(sequence, frames, writer)
            _lidars(sequence, frames, writer)
            for kind in sequence.kinds():
                if kind not in _READ:
                    writer.left_out(f"components of {kind}", len(sequence.instances(kind)), "not read")
            return writer.finish()


class _Sequence:
    """The stores of one sequence."""

    def __init__(self, name: str, stores: list[Store]) -> None:
        self.name, self.stores = name, stores

    def kinds(self) -> list[str]:
        return sorted({kind for store in self.stores for kind in store.names("") if store.names(kind)})

    def instances(self, kind: str) -> dict[str, Store]:
        """Names of the components of a kind, and the store that has each."""
        return {name: store for store in self.stores for name in store.names(kind)}

    def one(self, kind: str) -> tuple[Store, str]:
        """The component of a kind: the only one, or the one with the name `default`."""
        found = self.instances(kind)
        name = next(iter(found)) if len(found) == 1 else "default"
        if name not in found:
            names = ", ".join(found) or "none"
            raise LogError(self.name, f"components of {kind}: {names}", "give stores with one, or with `default`")
        return found[name], f"{kind}/{name}"


class _Frames:
    """The poses: of the rig in the world by time, and of sensors on the rig."""

    def __init__(self, sequence: _Sequence) -> None:
        store, node = sequence.one("poses")
        self.place = f"{store.path}, {node}"
        self._static: dict[str, list[tuple[str, Matrix]]] = {}
        for (source, target), its in self._edges(store, f"{node}/static_poses"):
            pose = self._pose(field(its, "pose", self.place), f"{self.place}, {source} to {target}")
            self._static.setdefault(source, []).append((target, pose))
            self._static.setdefault(target, []).append((source, inverse(pose)))
        moving = dict(self._edges(store, f"{node}/dynamic_poses"))
        key = ("rig", "world") if ("rig", "world") in moving else ("world", "rig")
        if key not in moving:
            raise LogError(self.place, "no dynamic pose of rig and world", "give the store that has the poses")
        its = moving[key]
        times, found = field(its, "timestamps_us", self.place), field(its, "poses", self.place)
        if not isinstance(times, list) or not isinstance(found, list) or not times:
            raise LogError(self.place, "no lists of poses and times", FIX)
        self.times = [integer(time_us, "timestamps_us", self.place) for time_us in times]
        if len(found) != len(self.times):
            raise LogError(self.place, f"{len(found)} poses for {len(self.times)} times", FIX)
        _increasing(self.times, self.place)
        poses = [self._pose(value, f"{self.place}, pose {index}") for index, value in enumerate(found)]
        self.poses = poses if key == ("rig", "world") else [inverse(pose) for pose in poses]
        self._rig = Poses(self.times, self.poses)

    def _edges(self, store: Store, node: str) -> Iterator[tuple[tuple[str, str], dict[str, Any]]]:
        """Transforms by the frames from which and to which they go, whose names are written as a tuple of Python."""
        for key, its in store.attributes(node).items():
            try:
                source, target = ast.literal_eval(key)
            except (ValueError, SyntaxError, TypeError):
                raise LogError(f"{self.place}, {node}", f"{key!r:.60} is no pair of frames", FIX) from None
            yield (str(source), str(target)), its

    @staticmethod
    def _pose(value: Any, place: str) -> Matrix:
        pose = numbers(value, (4, 4), "the pose", place)
        if rotation_error(pose) > 1e-3:
            raise LogError(place, "the pose is no rotation and translation", FIX)
        return pose

    def rig_from(self, frame: str) -> Matrix | None:
        """The place of a frame on the rig, through static poses; None if it has none."""
        open_frames, seen = [(frame, np.eye(4))], {frame}
        while open_frames:
            name, its_from_frame = open_frames.pop(0)
            if name == "rig":
                return its_from_frame
            for target, target_from_its in self._static.get(name, []):
                if target not in seen and not {name, target} <= {"world", "world_global"}:
                    seen.add(target)
                    open_frames.append((target, target_from_its @ its_from_frame))
        return None

    def world_from(self, frame: str, time_us: int) -> Matrix | None:
        """The place of a frame in the world at a time; None if it is not known."""
        if frame == "world":
            return np.eye(4)
        mount = self.rig_from(frame)
        return self._rig.at(time_us) @ mount if mount is not None and self._rig.covers(time_us) else None


def _increasing(times: list[int], place: str) -> None:
    for before, after in pairwise(times):
        if after <= before:
            raise LogError(place, f"the time {after} us follows {before} us: the clock runs backwards", FIX)


def _times_of_frames(store: Store, node: str) -> list[tuple[int, int]]:
    """Start and end of each frame of a sensor."""
    place = f"{store.path}, {node}/frames"
    found = field(store.attributes(f"{node}/frames"), "frames_timestamps_us", place)
    times = [(int(start), int(end)) for start, end in numbers(found, (len(found), 2), "frames_timestamps_us", place)]
    _increasing([end for _, end in times], place)
    if any(end < start for start, end in times):
        raise LogError(place, "a frame ends before it starts", FIX)
    return times


def _cameras(sequence: _Sequence, frames: _Frames, writer: LogWriter) -> None:
    for name, store in sequence.instances("cameras").items():
        node = f"cameras/{name}"
        times = _times_of_frames(store, node)
        mount = frames.rig_from(name)
        if mount is None:
            writer.left_out(f"images of {name}", len(times), "no static pose of it and the rig")
            continue
        lenses, lens_node = sequence.one("intrinsics")
        place = f"{lenses.path}, {lens_node}/cameras/{name}"
        its = lenses.attributes(f"{lens_node}/cameras/{name}")
        parameters = dict(field(its, "camera_model_parameters", place))
        delay_us = round(statistics.median([end - start for start, end in times])) if times else 0
        # The name of the lens in older stores.
        model = "opencv-pinhole" if its.get("camera_model_type") == "pinhole" else its.get("camera_model_type")
        distortion = {"external_distortion_type": its.get("external_distortion_type", "bivariate-windshield")}
        writer.cameras.append(
            camera_of(name, model, {**parameters, **distortion, "shutter_delay_us": delay_us}, mount, place)
        )
        with Progress(f"ncore, {name}", len(times)) as progress:
            for _, end_us in times:
                image = f"{node}/frames/{end_us}/image"
                suffix = _SUFFIXES.get(str(store.attributes(image).get("format")).lower())
                if suffix is None:
                    problem = f"an image of the format {store.attributes(image).get('format')!r}"
                    raise LogError(f"{store.path}, {image}", problem, "use images of JPEG or PNG")
                writer.image_bytes(name, end_us, suffix, partial(_image, store, image))
                progress.step()


def _image(store: Store, node: str) -> bytes:
    """The bytes of an encoded image: an array of one text, whose zeros at the end NumPy would cut off."""
    data = store.bytes_of(f"{node}/0")
    if data is None:
        raise LogError(f"{store.path}, {node}", "missing: an image", FIX)
    return data


def _lidars(sequence: _Sequence, frames: _Frames, writer: LogWriter) -> None:
    for name, store in sequence.instances("lidars").items():
        node = f"lidars/{name}"
        times = _times_of_frames(store, node)
        mount = frames.rig_from(name)
        if mount is None:
            writer.left_out(f"sweeps of {name}", len(times), "no static pose of it and the rig")
            continue
        writer.lidar(name, mount)
        with Progress(f"ncore, {name}", len(times)) as progress:
            for start_us, end_us in times:
                writer.sweep(name, end_us, partial(_sweep, store, f"{node}/frames/{end_us}", (start_us, end_us)))
                progress.step()


def _sweep(store: Store, node: str, bounds: tuple[int, int]) -> Sweep:
    """All returns of all rays; a return that is not there is NaN."""
    place = f"{store.path}, {node}"
    direction = store.array(f"{node}/ray_bundle/direction").astype(np.float64)
    times = store.array(f"{node}/ray_bundle/timestamp_us").astype(np.int64)
    distance = store.array(f"{node}/ray_bundle_returns/distance_m").astype(np.float64)
    intensity = store.array(f"{node}/ray_bundle_returns/intensity")
    rays = len(times)
    if direction.shape != (rays, 3) or distance.shape[1:] != (rays,) or intensity.shape != distance.shape:
        raise LogError(place, "directions, times and returns have different numbers of rays", FIX)
    if rays and not (abs(np.linalg.norm(direction, axis=1) - 1) < 1e-2).all():
        raise LogError(place, "directions that have not the length 1", FIX)
    if rays and not bounds[0] <= times.min() <= times.max() <= bounds[1]:
        problem = f"rays of {times.min()} to {times.max()} us, outside the frame of {bounds[0]} to {bounds[1]} us"
        raise LogError(place, problem, FIX)
    which, ray = np.nonzero(np.isfinite(distance))
    element = f"{node}/ray_bundle/model_element"
    ring = store.array(element)[ray, 0] if store.bytes_of(f"{element}/.zarray") is not None else None
    points = direction[ray] * distance[which, ray][:, None]
    return Sweep(points, times[ray], intensity[which, ray], ring)


def _boxes(sequence: _Sequence, frames: _Frames, writer: LogWriter) -> None:
    if not sequence.instances("cuboids"):
        return writer.left_out("boxes", 1, "the stores have no cuboids")
    store, node = sequence.one("cuboids")
    place = f"{store.path}, {node}"
    for one in field(store.attributes(f"{node}/cuboids"), "cuboid_track_observations", place):
        frame, box = str(field(one, "reference_frame_id", place)), field(one, "bbox3", place)
        world_from_frame = frames.world_from(
            frame, integer(field(one, "reference_frame_timestamp_us", place), "reference_frame_timestamp_us", place)
        )
        if world_from_frame is None:
            writer.left_out(f"boxes in the frame {frame} without a pose", 1, "outside the times, or not on the rig")
            continue
        pose = np.eye(4)
        pose[:3, :3] = _turned(numbers(field(box, "rot", place), (3,), "rot", place))
        pose[:3, 3] = numbers(field(box, "centroid", place), (3,), "centroid", place)
        track, label = str(field(one, "track_id", place)), str(field(one, "class_id", place))
        time_us = integer(field(one, "timestamp_us", place), "timestamp_us", place)
        writer.box(
            time_us, track, label, numbers(field(box, "dim", place), (3,), "dim", place), world_from_frame @ pose
        )


def _turned(angles: Matrix) -> Matrix:
    """The rotation about the fixed x, then y, then z axis."""
    (a, b, c), (x, y, z) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, a, -x], [0, x, a]])
    about_y = np.array([[b, 0, y], [0, 1, 0], [-y, 0, b]])
    about_z = np.array([[c, -z, 0], [z, c, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)
