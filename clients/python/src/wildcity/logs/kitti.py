"""KITTI raw data (Geiger et al., IJRR 2013, and the readme of its development kit): synced or extracted drives.

The rig is the GPS/IMU unit: x forward, y left, z up; its height above the ground is not in the data. The world is the
Mercator plane of the development kit (convertOxtsToPose): x east, y north, z up, scaled for the first latitude. Synced
drives have rectified images, which are pinholes; extracted drives have distorted ones with OpenCV's lens.

The scanner turns counter-clockwise, faces forward in the middle of a sweep, and the readme says that a sweep is
linear in time between its recorded start and end: so a point at azimuth a has the time start + (a + pi)/(2 pi) (end -
start).
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .errors import LogError
from .frames import Matrix, Poses, inverse
from .kinds import Options, choose
from .kitti_files import calibration, numbered, recorded_images, rigid, scan, times_us
from .lenses import Intrinsics, camera, opencv
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import numbers, require, text_of
from .writer import LogWriter, Report

LICENCE = "CC BY-NC-SA 3.0 (KITTI)"

EARTH_RADIUS_M = 6378137.0
"""Of the Mercator projection in the development kit."""


def _drives(source: Path) -> dict[str, Path]:
    if (source / "oxts").is_dir():
        return {source.name: source}
    return {path.parent.name: path.parent for path in sorted([*source.glob("*/oxts"), *source.glob("*/*/oxts")])}


def logs(source: Path) -> list[str]:
    """Names of the drives, such as 2011_09_26_drive_0001_sync."""
    return list(_drives(source))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one drive."""
    drives = _drives(source)
    name = choose(list(drives), options.log, source, "drive")
    drive = drives[name]
    times = times_us(drive / "oxts" / "timestamps.txt")
    files = sorted((drive / "oxts" / "data").glob("*.txt"))
    if not files or len(files) != len(times):
        problem = f"{len(files)} files for {len(times)} times"
        raise LogError(drive / "oxts", problem, "download and unpack the drive again")
    first = _packet(files[0])
    scale = math.cos(math.radians(first[0]))
    start = _pose(first, scale)
    decides = {"drive": str(drive), "frames": len(files)}
    with opened("kitti", source, out, options, log=name, licence=LICENCE, decides=decides) as writer:
        writer.begin(times[0], start[:3, 3])
        writer.geo = _geo(writer.origin_m, scale)
        poses = [_motion(writer, file, time_us, scale) for file, time_us in zip(files, times, strict=True)]
        rig_from_velodyne = _rig(writer, drive, is_rectified=not name.endswith("extract"))
        writer.left_out("height of the rig above the ground", 1, "the rig is the GPS/IMU unit, x forward, z up")
        _images(writer, drive, name)
        _sweeps(writer, drive)
        _boxes(writer, drive, rig_from_velodyne, Poses(times, poses))
        return writer.finish()


def _packet(file: Path) -> Any:
    """The 30 numbers of a packet: dataformat.txt names them."""
    values = text_of(file, "a packet of the GPS/IMU unit").split()
    try:
        return numbers([float(value) for value in values], (30,), "the packet", file)
    except ValueError:
        raise LogError(file, "a packet has words that are no numbers", "download it again") from None


def _pose(packet: Any, scale: float) -> Matrix:
    """world_from_imu of latitude and longitude (degrees), altitude (m), and roll, pitch, yaw (rad)."""
    latitude, longitude, altitude, roll, pitch, yaw = packet[:6]
    pose = np.eye(4)
    pose[0, 3] = scale * EARTH_RADIUS_M * math.radians(longitude)
    pose[1, 3] = scale * EARTH_RADIUS_M * math.log(math.tan(math.radians(90 + latitude) / 2))
    pose[2, 3] = altitude
    cos, sin = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, cos[0], -sin[0]], [0, sin[0], cos[0]]])
    about_y = np.array([[cos[1], 0, sin[1]], [0, 1, 0], [-sin[1], 0, cos[1]]])
    about_z = np.array([[cos[2], -sin[2], 0], [sin[2], cos[2], 0], [0, 0, 1]])
    pose[:3, :3] = about_z @ about_y @ about_x
    return pose


def _geo(origin_m: Matrix, scale: float) -> dict[str, float]:
    """The anchor of the log's origin: the inverse of the projection."""
    radius = scale * EARTH_RADIUS_M
    latitude = 2 * math.degrees(math.atan(math.exp(origin_m[1] / radius))) - 90
    longitude = math.degrees(origin_m[0] / radius)
    return {"latitude_deg": latitude, "longitude_deg": longitude, "altitude_m": float(origin_m[2])}


def _motion(writer: LogWriter, file: Path, time_us: int, scale: float) -> Matrix:
    packet = _packet(file)
    pose = _pose(packet, scale)
    writer.pose(time_us, pose, str(file))
    writer.gps(time_us, *packet[:3])
    writer.imu(time_us, packet[17:20], packet[11:14])
    return pose


def _rig(writer: LogWriter, drive: Path, *, is_rectified: bool) -> Matrix:
    """Adds the cameras and the scanner. Returns rig_from_velodyne."""
    day = drive.parent
    paths = [day / f"calib_{name}.txt" for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam")]
    found = [calibration(path, "a calibration of the day, which is a download of its own") for path in paths]
    rig_from_velodyne = inverse(rigid(found[0], paths[0]))
    rig_from_0 = rig_from_velodyne @ inverse(rigid(found[1], paths[1]))
    writer.lidar("velodyne", rig_from_velodyne)
    for number in range(4):
        if (drive / f"image_{number:02d}").is_dir():
            make = _rectified if is_rectified else _distorted
            writer.cameras.append(make(found[2], number, rig_from_0, paths[2]))
    return rig_from_velodyne


def _rectified(found: dict[str, Any], number: int, rig_from_0: Matrix, place: Path) -> dict[str, Any]:
    """A camera whose pixels are P_rect R_rect_00 of a point in the axes of camera 0."""
    suffix = f"{number:02d}"
    p = numbers(found.get(f"P_rect_{suffix}"), (12,), f"P_rect_{suffix}", place).reshape(3, 4)
    size = numbers(found.get(f"S_rect_{suffix}"), (2,), f"S_rect_{suffix}", place)
    camera_from_0 = np.eye(4)
    camera_from_0[:3, :3] = numbers(found.get("R_rect_00"), (9,), "R_rect_00", place).reshape(3, 3)
    if abs(float(np.linalg.det(p[:, :3]))) < 1e-9:
        raise LogError(place, f"camera {suffix} has no intrinsics: P_rect_{suffix} is singular", "download it again")
    camera_from_0[:3, 3] = np.linalg.solve(p[:, :3], p[:, 3])
    intrinsics = Intrinsics.of_matrix([int(value) for value in size], p[:, :3])
    return camera(f"image_{suffix}", intrinsics, rig_from_0 @ inverse(camera_from_0), str(place))


def _distorted(found: dict[str, Any], number: int, rig_from_0: Matrix, place: Path) -> dict[str, Any]:
    suffix = f"{number:02d}"
    k = numbers(found.get(f"K_{suffix}"), (9,), f"K_{suffix}", place).reshape(3, 3)
    lens = opencv(list(numbers(found.get(f"D_{suffix}"), (5,), f"D_{suffix}", place)))
    size = [int(value) for value in numbers(found.get(f"S_{suffix}"), (2,), f"S_{suffix}", place)]
    pose = rig_from_0 @ inverse(rigid(found, place, f"R_{suffix}", f"T_{suffix}"))
    return camera(f"image_{suffix}", Intrinsics.of_matrix(size, k), pose, str(place), lens=lens)


def _images(writer: LogWriter, drive: Path, name: str) -> None:
    folders = sorted(path for path in drive.glob("image_0?") if path.is_dir())
    recorded_images(writer, folders, "data", f"kitti {name}, images")
    if not folders:
        raise LogError(drive, "no folder image_00 to image_03", "download the images of the drive")


def _sweeps(writer: LogWriter, drive: Path) -> None:
    folder = drive / "velodyne_points"
    if not folder.is_dir():
        writer.left_out("sweeps of the scanner", 1, "the drive has no folder velodyne_points")
        return
    times = {part: times_us(folder / f"timestamps{part}.txt") for part in ("", "_start", "_end")}
    if len({len(its) for its in times.values()}) != 1:
        raise LogError(folder, "files of times have different lengths", "download the drive again")
    bounds = dict(zip(times[""], zip(times["_start"], times["_end"], strict=True), strict=True))
    count = 0
    with Progress("kitti, sweeps", len(bounds)) as progress:
        for time_us, path in numbered(folder / "data", ".bin", times[""], writer, "sweeps"):
            start_us, end_us = bounds[time_us]
            if end_us <= start_us:
                raise LogError(folder, f"{path.name} ends before it starts", "repair timestamps_start and _end")
            writer.sweep("velodyne", time_us, partial(_sweep, path, start_us, end_us))
            count += 1
            progress.step()
    writer.left_out("times of single points, sweeps", count, "from the azimuth, between recorded start and end")
    writer.left_out("sweeps as text", len(list((folder / "data").glob("*.txt"))), "binary sweeps are read")


def _sweep(path: Path, start_us: int, end_us: int) -> Sweep:
    values = scan(path)
    azimuth = np.arctan2(values[:, 1].astype(np.float64), values[:, 0].astype(np.float64))
    part = (azimuth + math.pi) / (2 * math.pi)
    times = start_us + np.rint(part * (end_us - start_us)).astype(np.int64)
    return Sweep(values[:, :3], times, intensity=values[:, 3])


def _boxes(writer: LogWriter, drive: Path, rig_from_velodyne: Matrix, poses: Poses) -> None:
    """tracklet_labels.xml: boxes by frame in the scanner's axes; a pose is that of the middle of the box's bottom."""
    path = drive / "tracklet_labels.xml"
    if not path.exists():
        writer.left_out("boxes", 1, "the drive has no tracklet_labels.xml")
        return
    times = times_us(require(drive / "velodyne_points" / "timestamps.txt", "the times of the boxes"))
    try:
        tracklets = ElementTree.parse(path).getroot().findall("./tracklets/item")
        for number, item in enumerate(tracklets):
            label, first = item.findtext("objectType") or "", int(item.findtext("first_frame") or 0)
            height, width, length = (float(item.findtext(side) or "nan") for side in "hwl")
            for index, one in enumerate(item.findall("./poses/item")):
                time_us = times[first + index]
                if not poses.covers(time_us):
                    writer.left_out("boxes outside the times of the poses", 1, "no pose of the rig")
                    continue
                box = _tracklet_pose(one, height)
                world_from_box = poses.at(time_us) @ rig_from_velodyne @ box
                writer.box(time_us, f"tracklet-{number}", label, (length, width, height), world_from_box)
    except (ElementTree.ParseError, ValueError, IndexError) as error:
        raise LogError(path, f"cannot read the boxes: {error}", "download it again") from None


def _tracklet_pose(one: ElementTree.Element, height: float) -> Matrix:
    x, y, z, turn = (float(one.findtext(name) or "nan") for name in ("tx", "ty", "tz", "rz"))
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    pose[:3, 3] = x, y, z + height / 2
    return pose
