"""Zenseact Open Dataset, Sequences and Drives: JSON and NumPy files, by the data classes of the package zod.

The ego has x forward, y left, z up; poses are those of the ego in the axes of the first one. The camera has OpenCV's
axes and the lens of Kannala and Brandt, which is OpenCV's fisheye (zod/utils/geometry.py: project_3d_to_2d_kannala). A
point has its own time, in microseconds after that of its file; `is_compensated` says whether points are moved to it.
"""

from __future__ import annotations

import datetime
import re
from functools import partial
from itertools import pairwise
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from .errors import LogError
from .frames import Matrix, Poses, transform
from .kinds import Options, choose
from .lenses import Intrinsics, camera, fisheye
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import field, json_file, numbers, text
from .writer import LogWriter, Report

LICENCE = "CC BY-SA 4.0 (Zenseact Open Dataset)"

_IMAGES = ("front_original", "front_dnat", "front_blur")
"""Kinds of images of the one camera, from the most faithful: original, faces replaced (DNAT), faces blurred."""


def _logs(source: Path) -> dict[str, Path]:
    if (source / "info.json").exists():
        return {source.name: source}
    found = sorted(
        [*source.glob("sequences/*/info.json"), *source.glob("drives/*/info.json"), *source.glob("*/info.json")]
    )
    return {path.parent.name: path.parent for path in found}


def logs(source: Path) -> list[str]:
    """Ids of the sequences and drives."""
    return list(_logs(source))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one sequence or drive."""
    found = _logs(source)
    name = choose(list(found), options.log, source, "sequence or drive")
    folder = found[name]
    info, place = _plain(json_file(folder / "info.json", "the list of files")), str(folder / "info.json")
    # Paths are relative to the root of the data set, two folders above.
    root = folder.parent.parent
    times, poses = _poses(root / text(field(info, "egomotionpath", place), "egomotionpath", place))
    with opened("zod", source, out, options, log=name, licence=LICENCE, decides={"poses": len(times)}) as writer:
        writer.begin(times[0], poses[0][:3, 3])
        for time_us, pose in zip(times, poses, strict=True):
            writer.pose(time_us, pose, "ego_motion")
        mount = _rig(writer, root / text(field(info, "calibrationpath", place), "calibrationpath", place))
        _images(writer, root, field(info, "cameraframes", place), place)
        _sweeps(writer, root, info, place)
        _boxes(writer, root, info, mount, Poses(times, poses))
        radars = info.get("radarframes") or {}
        writer.left_out("radar sequences", sum(len(its) for its in radars.values()), "no table for them")
        writer.left_out("accelerations and rates", len(times), "whether they have gravity is not documented")
        writer.left_out("oxts and vehicle data", 1, "HDF5 is not read")
        return writer.finish()


def _plain(value: Any) -> Any:
    """JSON with keys in lower case and without `_`: the package writes and reads several spellings."""
    if isinstance(value, dict):
        return {re.sub("_", "", key).lower(): _plain(its) for key, its in value.items()}
    return [_plain(its) for its in value] if isinstance(value, list) else value


def _microseconds(text: Any, place: str) -> int:
    """A time of ISO 8601 in microseconds since 1970."""
    try:
        moment = datetime.datetime.fromisoformat(str(text).replace("Z", "+00:00"))
    except ValueError:
        raise LogError(place, f"{text!r} is no time", "download it again") from None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.timezone.utc)
    since = moment - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
    return since // datetime.timedelta(microseconds=1)


def _poses(path: Path) -> tuple[list[int], list[Matrix]]:
    """Times in microseconds, and poses of the ego."""
    found, place = json_file(path, "the poses of the ego"), str(path)
    seconds, values = field(found, "timestamps", place), field(found, "poses", place)
    if not isinstance(seconds, list) or not isinstance(values, list):
        raise LogError(place, "timestamps and poses are no lists", "download it again")
    # Seconds since 1970 have ten digits; milliseconds would have thirteen.
    known = numbers(seconds, (len(seconds),), "timestamps", place)
    if not ((known > 0) & (known < 1e10)).all():
        raise LogError(place, f"times {seconds[:2]} are no seconds since 1970", "download it again")
    times = [round(float(time) * 1e6) for time in known]
    if not times or len(values) != len(times):
        raise LogError(place, f"{len(values)} poses for {len(times)} times", "download it again")
    for before, after in pairwise(times):
        if after <= before:
            raise LogError(
                place, f"the time {after} us follows {before} us: the clock runs backwards", "download it again"
            )
    return times, [numbers(value, (4, 4), f"poses[{index}]", place) for index, value in enumerate(values)]


def _rig(writer: LogWriter, path: Path) -> Matrix:
    """Adds the camera and the LiDAR. Returns rig_from_lidar."""
    place = str(path)
    front = field(json_file(path, "the calibration"), "FC", place)
    size = numbers(field(front, "image_dimensions", place), (2,), "image_dimensions", place)
    width, height = (int(value) for value in size)
    try:
        k = np.asarray(field(front, "intrinsics", place), np.float64)
    except (TypeError, ValueError):
        k = np.empty(0)
    if k.ndim != 2 or k.shape[0] != 3 or k.shape[1] < 3 or not np.isfinite(k).all():
        raise LogError(place, "camera front has no intrinsics: they are no 3 x 3 or 3 x 4 numbers", "download it again")
    intrinsics = Intrinsics.of_matrix((width, height), k)
    mount = numbers(field(front, "extrinsics", place), (4, 4), "extrinsics", place)
    distortion = numbers(field(front, "distortion", place), (4,), "distortion", place)
    made = camera("front", intrinsics, mount, place)
    writer.cameras.append({**made, "lens": fisheye(list(distortion), intrinsics)})
    rig_from_lidar = numbers(field(front, "lidar_extrinsics", place), (4, 4), "lidar_extrinsics", place)
    writer.lidar("velodyne", rig_from_lidar)
    return rig_from_lidar


def _images(writer: LogWriter, root: Path, frames: Any, place: str) -> None:
    kinds = {re.sub("_", "", name): name for name in _IMAGES}
    found = [plain for plain in kinds if frames.get(plain)]
    if not found:
        raise LogError(place, f"no images of {', '.join(kinds.values())}", "download the images")
    for plain in found[1:]:
        writer.left_out(f"images {kinds[plain]}", len(frames[plain]), f"the log has {kinds[found[0]]}")
    last_us = -1
    with Progress("zod, images", len(frames[found[0]])) as progress:
        for one in frames[found[0]]:
            time_us = _microseconds(field(one, "time", place), place)
            if time_us <= last_us:
                raise LogError(
                    place, f"the time {one['time']} is not later: the clock runs backwards", "download it again"
                )
            writer.image("front", time_us, root / text(field(one, "filepath", place), "filepath", place))
            last_us = time_us
            progress.step()


def _sweeps(writer: LogWriter, root: Path, info: dict[str, Any], place: str) -> None:
    frames = field(info, "lidarframes", place).get("velodyne") or []
    with Progress("zod, sweeps", len(frames)) as progress:
        for one in frames:
            path = root / text(field(one, "filepath", place), "filepath", place)
            core_us = _microseconds(path.stem.rpartition("_")[2], str(path))
            compensated_us = core_us if field(one, "iscompensated", place) else None
            writer.sweep("velodyne", core_us, partial(_sweep, path, core_us), compensated_to_us=compensated_us)
            progress.step()


def _sweep(path: Path, core_us: int) -> Sweep:
    """A .npy file of structures: x, y, z, timestamp (microseconds after that of the file), intensity, diode_index."""
    if not path.exists():
        raise LogError(path, "missing: a sweep", "download the sweeps of the sequence")
    try:
        found = np.load(path, allow_pickle=False)
        points = np.stack([found[axis] for axis in "xyz"], axis=1)
        times = core_us + found["timestamp"].astype(np.int64)
        return Sweep(points, times, found["intensity"], found["diode_index"])
    except (ValueError, IndexError, EOFError, OSError, SyntaxError, TokenError) as error:
        raise LogError(path, f"no sweep of ZOD: {error}", "download it again") from None


def _boxes(writer: LogWriter, root: Path, info: dict[str, Any], rig_from_lidar: Matrix, poses: Poses) -> None:
    """Boxes of the key frame, in the axes of the LiDAR at the time of that frame."""
    annotations = info.get("annotations")
    its = annotations.get("objectdetection") if isinstance(annotations, dict) else None
    if its is None:
        return writer.left_out("boxes", 1, "the sequence has no annotations of objects")
    place = "info.json, annotations"
    path = root / text(field(its, "filepath", place), "filepath", place)
    time_us = _microseconds(field(info, "keyframetime", "info.json"), "info.json")
    if not poses.covers(time_us):
        return writer.left_out("boxes", 1, "no pose at the time of the key frame")
    for one in json_file(path, "the annotations of objects"):
        values = field(one, "properties", path)
        if not isinstance(values, dict):
            raise LogError(path, f"properties are {values!r:.40}, no object", "download it again")
        if "location_3d" not in values:
            writer.left_out("objects without a box in space", 1, "boxes of the image only")
            continue
        center = field(field(values, "location_3d", path), "coordinates", path)
        q = numbers([field(values, f"orientation_3d_q{axis}", path) for axis in "wxyz"], (4,), "orientation_3d", path)
        if not ((abs(q) < 2).all() and abs(float(np.linalg.norm(q)) - 1) < 1e-3):
            raise LogError(path, f"orientation_3d (w, x, y, z) {list(q)} has not the length 1", "download it again")
        size = [field(values, f"size_3d_{side}", path) for side in ("length", "width", "height")]
        label = ".".join(str(values[key]) for key in ("class", "type") if values.get(key))
        pose = poses.at(time_us) @ rig_from_lidar @ transform(numbers(center, (3,), "location_3d", path), q)
        writer.box(time_us, str(field(values, "annotation_uuid", path)), label, size, pose)
