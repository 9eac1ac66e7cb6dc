"""comma2k19 (Schafer et al. 2018): NumPy files and a video for each minute, by the README of its repository.

The poses are those of the camera: `frame_positions` are earth-centred, and the rotation of the quaternion (w, x, y, z)
in `frame_orientations` leads from the device's axes (forward, right, down) to earth-centred ones (utils/camera.py:
device_from_ecef). The rig is the device with y to the left and z up. The world is the tangent plane at the first pose.
Intrinsics are the constants of utils/camera.py. Times are seconds since the start of the device.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .earth import geodetic, tangent_plane
from .errors import LogError
from .frames import CAMERA_AXES, rotation
from .kinds import Options, choose
from .lenses import Intrinsics, camera
from .source import opened
from .tableio import require
from .videos import add_video
from .writer import LogWriter, Report

LICENCE = "MIT (comma2k19)"

SIZE, FOCAL_PX = (1164, 874), 910.0
"""Of the device's camera; the principal point is the middle of the image."""

_DOWN_TO_UP = np.diag([1.0, -1.0, -1.0])
"""From (forward, right, down) to (forward, left, up), and back."""


def _segments(source: Path) -> dict[str, Path]:
    if (source / "global_pose").is_dir():
        return {source.resolve().name: source}
    found = sorted([*source.glob("*/global_pose"), *source.glob("*/*/global_pose")])
    return {str(path.parent.relative_to(source)): path.parent for path in found}


def logs(source: Path) -> list[str]:
    """Names of the segments: the route and the minute."""
    return list(_segments(source))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one segment."""
    found = _segments(source)
    name = choose(list(found), options.log, source, "segment")
    segment = found[name]
    folder = segment / "global_pose"
    times = _times(folder / "frame_times")
    positions, turns = (
        _array(folder / "frame_positions", (len(times), 3)),
        _array(folder / "frame_orientations", (len(times), 4)),
    )
    decides = {"frames": len(times)}
    with opened("comma2k19", source, out, options, log=name, licence=LICENCE, decides=decides) as writer:
        writer.begin(times[0])
        place = geodetic(positions[0])
        writer.geo = dict(zip(("latitude_deg", "longitude_deg", "altitude_m"), place, strict=True))
        origin, axes = tangent_plane(*place)
        for time_us, position, q in zip(times, positions, turns, strict=True):
            if not abs(float(np.linalg.norm(q)) - 1) < 1e-3:
                raise LogError(folder / "frame_orientations", f"{q.tolist()} has not the length 1", "download it again")
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = axes @ rotation(q) @ _DOWN_TO_UP, axes @ (position - origin)
            writer.pose(time_us, pose, str(folder))
        center = (SIZE[0] / 2, SIZE[1] / 2)
        intrinsics = Intrinsics(*SIZE, FOCAL_PX, FOCAL_PX, *center)
        writer.cameras.append(camera("front", intrinsics, CAMERA_AXES, str(segment), from_middle=False))
        writer.left_out("place of the rig on the vehicle", 1, "the rig is the camera, y left, z up")
        _video(writer, segment, times)
        _imu(writer, segment / "processed_log" / "IMU")
        _gps(writer, segment / "processed_log" / "GNSS" / "live_gnss_ublox")
        others = [path for part in ("CAN", "GNSS") for path in (segment / "processed_log" / part).glob("*")]
        others = [path for path in others if path.name != "live_gnss_ublox"]
        writer.left_out("folders of processed_log (CAN, other GNSS)", len(others), "not read")
        return writer.finish()


def _array(path: Path, shape: tuple[int, ...]) -> Any:
    """Finite numbers of a NumPy file. An axis of the shape that is -1 may have any length."""
    try:
        found = np.load(require(path, "a table of the segment"), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise LogError(path, f"no array of NumPy: {error}", "download the segment again") from None
    fits = found.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, found.shape, strict=True))
    if not fits or found.dtype.kind not in "fiu" or not np.isfinite(found).all():
        raise LogError(path, f"{found.dtype} {found.shape}, not finite numbers {shape}", "download the segment again")
    return found.astype(np.float64)


def _times(path: Path) -> list[int]:
    """Seconds as microseconds, increasing."""
    times = np.rint(_array(path, (-1,)) * 1e6).astype(np.int64)
    wrong = np.flatnonzero(np.diff(times) <= 0)
    if not len(times) or len(wrong):
        problem = "no times" if not len(times) else f"row {wrong[0] + 1} is not later: the clock runs backwards"
        raise LogError(path, problem, "download the segment again")
    return [int(time) for time in times]


def _video(writer: LogWriter, segment: Path, times: list[int]) -> None:
    video = segment / "video.hevc"
    if not video.exists():
        return writer.left_out("images", len(times), "the segment has no video.hevc")
    add_video(writer, "front", video, times, segment / "global_pose" / "frame_times")


def _imu(writer: LogWriter, folder: Path) -> None:
    """Accelerations and rates have clocks of their own: a row has both if they are of one time, else neither."""
    if not (folder / "accelerometer").is_dir() or not (folder / "gyro").is_dir():
        return writer.left_out("IMU", 1, "no accelerometer or no gyro")
    parts = [(_times(folder / name / "t"), name) for name in ("accelerometer", "gyro")]
    values = [_array(folder / name / "value", (len(times), 3)) @ _DOWN_TO_UP for times, name in parts]
    rates = dict(zip(parts[1][0], values[1], strict=True))
    missing = 0
    for time_us, acceleration in zip(parts[0][0], values[0], strict=True):
        if time_us in rates:
            writer.imu(time_us, rates[time_us], acceleration)
        else:
            missing += 1
    writer.left_out("accelerations without a rate of their time", missing, "nothing is resampled")


def _gps(writer: LogWriter, folder: Path) -> None:
    """live_gnss_ublox: latitude, longitude, speed, UTC, altitude, bearing."""
    if not folder.is_dir():
        return writer.left_out("GPS", 1, "no live_gnss_ublox")
    times = _times(folder / "t")
    for time_us, row in zip(times, _array(folder / "value", (len(times), 6)), strict=True):
        writer.gps(time_us, row[0], row[1], row[4])
