"""The ASL format of EuRoC MAV (Burri et al., IJRR 2016): mav0/cam0, mav0/imu0, mav0/state_groundtruth_estimate0.

The rig is the body, which is the IMU; `T_BS` of a sensor is body_from_sensor. Times are nanoseconds. Lenses stay as
they are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .calibrations import euroc_camera, yaml_file
from .errors import LogError
from .frames import Matrix
from .kinds import Options
from .pose_files import poses_of, rows_of
from .progress import Progress
from .source import opened
from .tableio import field, numbers
from .writer import LogWriter, Report

_POSES = ("state_groundtruth_estimate0", "vicon0", "leica0", "mocap0")


def _root(source: Path) -> Path:
    return source / "mav0" if (source / "mav0").is_dir() else source


def logs(source: Path) -> list[str]:
    """A sequence is one log."""
    return [source.stem if source.name != "mav0" else source.resolve().parent.stem]


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes the log of a sequence."""
    root = _root(source)
    poses = root / _POSES[0] / "data.csv"
    cameras = sorted(path for path in root.glob("cam*") if path.is_dir())
    if not cameras:
        raise LogError(root, "no folder cam0", "give the folder that has mav0")
    decides = {"bytes": poses.stat().st_size if poses.exists() else 0}
    licence = "not stated by the folder"
    with opened("euroc", source, out, options, log=logs(source)[0], licence=licence, decides=decides) as writer:
        for place, time_us, pose in poses_of(poses):
            if not writer.epoch_us and not writer.has("poses"):
                writer.begin(min(time_us, *(_first_us(folder) for folder in cameras)), pose[:3, 3])
            writer.pose(time_us, pose, place)
        for folder in cameras:
            place = str(folder / "sensor.yaml")
            found = yaml_file(folder / "sensor.yaml", "the calibration of a camera")
            writer.cameras.append(euroc_camera(found, folder.name, place))
        _images(writer, cameras)
        _imu(writer, root / "imu0")
        writer.left_out("height and heading of the rig", 1, "the rig is the body, in its own axes")
        for folder in sorted(root.glob("*")):
            if folder.is_dir() and folder not in cameras and folder.name not in (_POSES[0], "imu0"):
                writer.left_out(f"the folder {folder.name}", 1, "not read")
        return writer.finish()


def _first_us(folder: Path) -> int:
    place, words = next(rows_of(folder / "data.csv", "the images of a camera"), ("", ["0"]))
    return _time_us(words[0], place)


def _time_us(word: str, place: str) -> int:
    if not word.isdigit():
        raise LogError(place, f"{word!r} is no time in nanoseconds", "repair the line")
    return int(word) // 1000


def _images(writer: LogWriter, cameras: list[Path]) -> None:
    with Progress("euroc, images", 0) as progress:
        for folder in cameras:
            last_us = -1
            for place, words in rows_of(folder / "data.csv", "the images of a camera"):
                time_us = _time_us(words[0], place)
                if time_us <= last_us or len(words) != 2:
                    problem = f"{' '.join(words)!r:.60}: the clock runs backwards, or there is no file"
                    raise LogError(place, problem, "repair the line")
                writer.image(folder.name, time_us, folder / "data" / words[1])
                last_us = time_us
                progress.step()


def _imu(writer: LogWriter, folder: Path) -> None:
    if not (folder / "data.csv").exists():
        return writer.left_out("IMU", 1, "no imu0/data.csv")
    path = folder / "sensor.yaml"
    mount: Matrix = np.eye(4)
    if path.exists():
        value = field(field(yaml_file(path, "the calibration of the IMU"), "T_BS", path), "data", path)
        mount = numbers(value, (16,), "T_BS", path).reshape(4, 4)
    last_us = -1
    for place, words in rows_of(folder / "data.csv", "the IMU"):
        time_us = _time_us(words[0], place)
        if time_us <= last_us:
            raise LogError(place, f"the time {words[0]} is not later: the clock runs backwards", "repair the line")
        last_us = time_us
        try:
            values = numbers([float(word) for word in words[1:7]], (6,), "the row", place)
        except ValueError:
            raise LogError(place, f"{' '.join(words)!r:.60} are no numbers", "repair the line") from None
        writer.imu(time_us, mount[:3, :3] @ values[:3], mount[:3, :3] @ values[3:])
