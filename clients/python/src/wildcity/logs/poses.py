"""A file of poses with a calibration (`--rig`), or a folder of the TUM RGB-D benchmark.

The poses of a file are those of the rig of the calibration; with `--pose-of camera` they are those of its first camera.
A file in KITTI's format has poses of a camera in a world with the axes of the first camera, which is turned so that z
is up. A folder has groundtruth.txt, the poses of the camera, and rgb.txt, the images.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .calibrations import cameras_of
from .errors import LogError
from .frames import CAMERA_AXES, Matrix, inverse, transform
from .kinds import Options
from .pose_files import poses_of, rows_of, seconds_to_us
from .progress import Progress
from .source import opened
from .writer import LogWriter, Report


def logs(source: Path) -> list[str]:
    """A file or a folder is one log."""
    return [source.stem]


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes the log."""
    is_folder = source.is_dir()
    file = source / "groundtruth.txt" if is_folder else source
    if options.rig is None:
        raise LogError(source, "poses without intrinsics of a camera", "give a calibration with --rig FILE")
    cameras = cameras_of(options.rig)
    is_camera = is_folder or options.pose_of == "camera"
    if is_folder and len(cameras) != 1:
        raise LogError(options.rig, f"{len(cameras)} cameras; the folder has one", "give its calibration")
    decides = {"bytes": file.stat().st_size if file.exists() else 0, "cameras": cameras}
    with opened("poses", source, out, options, log=source.stem, licence="not stated", decides=decides) as writer:
        writer.cameras = cameras
        camera_from_rig = inverse(_mount(cameras[0])) if is_camera else np.eye(4)
        _poses(writer, file, camera_from_rig)
        if is_folder:
            _images(writer, source, cameras[0]["name"])
        return writer.finish()


def _mount(camera: dict[str, Any]) -> Matrix:
    pose = camera["camera_to_rig"]
    return transform(pose["xyz"], pose["q"])


def _poses(writer: LogWriter, file: Path, camera_from_rig: Matrix) -> None:
    # In KITTI's format both the world and the body have the axes of a camera: x right, y down, z ahead.
    is_kitti = len(next(rows_of(file, "the file of poses"), ("", []))[1]) == 12
    with Progress(f"poses of {file.name}", 0) as progress:
        for place, time_us, pose in poses_of(file):
            turned = CAMERA_AXES @ pose @ inverse(CAMERA_AXES) if is_kitti else pose @ camera_from_rig
            if not progress.done:
                writer.begin(time_us, turned[:3, 3])
            writer.pose(time_us, turned, place)
            progress.step()
    if not progress.done:
        raise LogError(file, "no poses", "give a file with poses")


def _images(writer: LogWriter, folder: Path, camera: str) -> None:
    """rgb.txt: `time file`, seconds."""
    last_us = -1
    for place, words in rows_of(folder / "rgb.txt", "the list of images"):
        if len(words) != 2:
            raise LogError(place, f"{len(words)} words, not a time and a file", "repair the line")
        time_us = seconds_to_us(words[0], place)
        if time_us <= last_us:
            raise LogError(place, f"the time {words[0]} is not later: the clock runs backwards", "sort the list")
        writer.image(camera, time_us, folder / words[1])
        last_us = time_us
    for name in ("depth.txt", "accelerometer.txt"):
        if (folder / name).exists():
            writer.left_out(f"rows of {name}", sum(1 for _ in rows_of(folder / name, name)), "not read")
