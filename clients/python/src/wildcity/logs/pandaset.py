"""PandaSet (Xiao et al., ITSC 2021), by the files and formulas of pandaset-devkit.

lidar/poses.json has world_from_ego at lidar/timestamps.json: x right, y forward, z up; the rig is the ego turned so
that x is forward. Points and boxes are in the world, where what stands still keeps its place: they are compensated.
Cameras have a pose in the world for each image; a rig has one place for each camera, which is the mean of those that
the poses say. Images have the pinhole of intrinsics.json (geometry.projection). Times are seconds since 1970.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from .errors import LogError
from .frame_pickles import columns_of
from .frames import Matrix, Poses, inverse, transform
from .kinds import Options, choose
from .lenses import Intrinsics, camera
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import field, json_file, numbers
from .writer import LogWriter, Report

LICENCE = "CC BY 4.0, and the terms of PandaSet"

EGO_FROM_RIG = transform((0, 0, 0), (math.sqrt(0.5), 0, 0, math.sqrt(0.5)))
"""The rig's x is the ego's y."""

LIDARS = ("pandar64", "pandargt")
"""The column `d` of a point: the scanner that turns, and the one that looks ahead."""

MAX_MOVE_M, MAX_TURN_DEG = 0.5, 2.0
"""By how much a camera may move on the rig: more is an error of axes, units or clocks."""

_CUBOID = ["uuid", "label", "yaw", "cuboids.sensor_id"] + [
    f"{part}.{axis}" for part in ("position", "dimensions") for axis in "xyz"
]


def _sequences(source: Path) -> dict[str, Path]:
    if (source / "lidar" / "poses.json").exists():
        return {source.name: source}
    return {path.parent.parent.name: path.parent.parent for path in sorted(source.glob("*/lidar/poses.json"))}


def logs(source: Path) -> list[str]:
    """Numbers of the sequences, such as 001."""
    return list(_sequences(source))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one sequence."""
    found = _sequences(source)
    name = choose(list(found), options.log, source, "sequence (*/lidar/poses.json)")
    root = found[name]
    times, egos = _timed_poses(root / "lidar")
    poses = Poses(times, [ego @ EGO_FROM_RIG for ego in egos])
    with opened("pandaset", source, out, options, log=name, licence=LICENCE, decides={"frames": len(times)}) as writer:
        writer.begin(times[0], egos[0][:3, 3])
        for time_us, ego in zip(times, egos, strict=True):
            writer.pose(time_us, ego @ EGO_FROM_RIG, str(root / "lidar" / "poses.json"))
        _cameras(writer, root, poses)
        _gps(writer, root / "meta")
        _boxes(writer, root / "annotations" / "cuboids", times)
        _sweeps(writer, root / "lidar", poses)
        writer.left_out("height of the rig above the ground", 1, "it is not in the data")
        semantic = len(list((root / "annotations" / "semseg").glob("*.pkl.gz")))
        writer.left_out("classes of single points, sweeps", semantic, "no field for them")
        return writer.finish()


def _times(path: Path) -> list[int]:
    """Increasing times in microseconds."""
    values = json_file(path, "the times of a sensor")
    seconds = numbers(values, (len(values) if isinstance(values, list) else 0,), "the list of times", path)
    # Seconds since 1970 have ten digits; milliseconds would have thirteen.
    if not len(seconds) or not ((seconds > 1e8) & (seconds < 1e10)).all():
        raise LogError(path, f"times {list(seconds[:2])} are no seconds since 1970", "write times in seconds")
    times = [round(float(value) * 1e6) for value in seconds]
    for before, after in pairwise(times):
        if after <= before:
            problem = f"the time {after} us follows {before} us: the clock runs backwards"
            raise LogError(path, problem, "download the sequence again")
    return times


def _timed_poses(folder: Path) -> tuple[list[int], list[Matrix]]:
    """Times, and world_from_sensor of each."""
    path = folder / "poses.json"
    times, values = _times(folder / "timestamps.json"), json_file(path, "the poses of a sensor")
    if not isinstance(values, list) or len(values) != len(times):
        count = len(values) if isinstance(values, list) else 0
        raise LogError(path, f"{count} poses for {len(times)} times", "download the sequence again")
    return times, [_pose(one, f"{path}, entry {index}") for index, one in enumerate(values)]


def _pose(one: Any, place: str) -> Matrix:
    at, turn = field(one, "position", place), field(one, "heading", place)
    xyz = numbers([field(at, axis, place) for axis in "xyz"], (3,), "position", place)
    q = numbers([field(turn, axis, place) for axis in "wxyz"], (4,), "heading", place)
    if not (abs(xyz) < 1e9).all():
        raise LogError(place, f"position {list(xyz)} is on no earth", "download it again")
    if not ((abs(q) < 2).all() and abs(float(np.linalg.norm(q)) - 1) < 1e-3):
        raise LogError(place, f"heading (w, x, y, z) {list(q)} has not the length 1", "download it again")
    return transform(xyz, q)


def _cameras(writer: LogWriter, root: Path, poses: Poses) -> None:
    folders = sorted(path.parent for path in root.glob("camera/*/timestamps.json"))
    if not folders:
        raise LogError(root / "camera", "no folder of a camera with timestamps.json", "download the cameras")
    with Progress("pandaset, images", 0) as progress:
        for folder in folders:
            times, seen = _timed_poses(folder)
            files = {time_us: folder / f"{index:02d}.jpg" for index, time_us in enumerate(times)}
            there = {time_us: path for time_us, path in files.items() if path.is_file()}
            if not there:
                raise LogError(folder, "no images 00.jpg, 01.jpg, ..", "download the camera again")
            mount = _mount(writer, folder, dict(zip(times, seen, strict=True)), poses)
            writer.cameras.append(_camera(folder, next(iter(there.values())), mount))
            for time_us, path in there.items():
                writer.image(folder.name, time_us, path)
                progress.step()
            writer.left_out(f"times of {folder.name} without a file", len(files) - len(there), "not downloaded")


def _mount(writer: LogWriter, folder: Path, seen: dict[int, Matrix], poses: Poses) -> Matrix:
    """rig_from_camera: the mean of what the poses of the images say."""
    found = [inverse(poses.at(time_us)) @ pose for time_us, pose in seen.items() if poses.covers(time_us)]
    place = folder / "poses.json"
    if not found:
        raise LogError(place, "no image between the first and the last pose of the LiDAR", "use one sequence")
    u, _, v = np.linalg.svd(sum(one[:3, :3] for one in found))
    mean = np.eye(4)
    mean[:3, :3] = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    mean[:3, 3] = np.mean([one[:3, 3] for one in found], axis=0)
    moves = [float(np.linalg.norm(one[:3, 3] - mean[:3, 3])) for one in found]
    turns = [math.degrees(2 * math.asin(min(1.0, _chord(one, mean) / 2))) for one in found]
    said = f"up to {max(moves):.4f} m and {max(turns):.4f} degrees"
    if max(moves) > MAX_MOVE_M or max(turns) > MAX_TURN_DEG:
        problem = f"the camera moves on the rig by {said}, so its poses and those of the LiDAR do not belong together"
        raise LogError(place, problem, "use files of one sequence, in metres, with headings (w, x, y, z)")
    writer.left_out(f"movement of {folder.name} on the rig, poses", len(found), f"{said}: the log has the mean")
    return mean


def _chord(a: Matrix, b: Matrix) -> float:
    """2 sin(angle / 2) of the rotation from b to a."""
    return float(np.linalg.norm(a[:3, :3] - b[:3, :3])) / math.sqrt(2)


def _camera(folder: Path, image: Path, mount: Matrix) -> dict[str, Any]:
    path = folder / "intrinsics.json"
    found = json_file(path, "the intrinsics of a camera")
    values = numbers([field(found, name, path) for name in ("fx", "fy", "cx", "cy")], (4,), "fx, fy, cx, cy", path)
    try:
        with Image.open(image) as opened_image:
            size = opened_image.size
    except OSError as error:
        raise LogError(image, f"no image: {error}", "download it again") from None
    return camera(folder.name, Intrinsics(*size, *(float(value) for value in values)), mount, str(path))


def _gps(writer: LogWriter, folder: Path) -> None:
    path = folder / "gps.json"
    if not path.exists():
        return writer.left_out("gps", 1, "the sequence has no meta/gps.json")
    times, rows = _times(folder / "timestamps.json"), json_file(path, "the fixes")
    if len(rows) != len(times):
        raise LogError(path, f"{len(rows)} fixes for {len(times)} times", "download the sequence again")
    for index, (time_us, row) in enumerate(zip(times, rows, strict=True)):
        place = f"{path}, entry {index}"
        values = [field(row, name, place) for name in ("lat", "long", "height")]
        writer.gps(time_us, *numbers(values, (3,), "lat, long, height", place))


def _boxes(writer: LogWriter, folder: Path, times: list[int]) -> None:
    """Boxes in the world. `yaw` is 0 along y, and turns to -x; dimensions.y is the length."""
    if not folder.is_dir():
        return writer.left_out("boxes", 1, "the sequence has no annotations/cuboids")
    for index, time_us in enumerate(times):
        path = folder / f"{index:02d}.pkl.gz"
        if not path.exists():
            writer.left_out("sweeps without a file of boxes", 1, "not downloaded")
            continue
        found = columns_of(path, _CUBOID, "the boxes of a sweep")
        for row in zip(*found.values(), strict=True):
            one = dict(zip(found, row, strict=True))
            if int(one["cuboids.sensor_id"]) == 1:
                writer.left_out("second boxes of an object, of the LiDAR that looks ahead", 1, "one box a time")
                continue
            turn = (float(one["yaw"]) + math.pi / 2) / 2
            at, sides = ([float(one[f"{part}.{axis}"]) for axis in "xyz"] for part in ("position", "dimensions"))
            pose = transform(at, (math.cos(turn), 0, 0, math.sin(turn)))
            writer.box(time_us, str(one["uuid"]), str(one["label"]), (sides[1], sides[0], sides[2]), pose)


def _sweeps(writer: LogWriter, folder: Path, poses: Poses) -> None:
    times = [int(time_us) for time_us in poses.times_us]
    for name in LIDARS:
        writer.lidar(name, np.eye(4))
    writer.left_out("places of the LiDARs on the rig", len(LIDARS), "not in the data: their points are in its axes")
    with Progress("pandaset, sweeps", len(times) * len(LIDARS)) as progress:
        for index, time_us in enumerate(times):
            path = folder / f"{index:02d}.pkl.gz"
            for number, name in enumerate(LIDARS):
                progress.step()
                if not path.exists():
                    writer.left_out(f"times of {name} without a file", 1, "not downloaded")
                    continue
                read = partial(_sweep, path, number, poses.at(time_us), time_us)
                writer.sweep(name, time_us, read, compensated_to_us=time_us)


def _sweep(path: Path, number: int, world_from_rig: Matrix, time_us: int) -> Sweep:
    found = columns_of(path, ["x", "y", "z", "i", "t", "d"], "a sweep")
    try:
        chosen = found["d"].astype(np.int64) == number
        world = np.stack([found[axis][chosen].astype(np.float64) for axis in "xyz"], axis=1)
        seconds, intensity = found["t"][chosen].astype(np.float64), found["i"][chosen].astype(np.float32)
    except (TypeError, ValueError) as error:
        raise LogError(path, f"a column that is no numbers: {error}", "download it again") from None
    if not np.isfinite(seconds).all() or (abs(seconds * 1e6 - time_us) > 1_000_000).any():
        problem = f"times of points that are not within 1 s of the sweep's, {time_us} us"
        raise LogError(path, problem, "use files of one sequence, with times in seconds")
    points = (world - world_from_rig[:3, 3]) @ world_from_rig[:3, :3]
    return Sweep(points, np.rint(seconds * 1e6).astype(np.int64), intensity)
