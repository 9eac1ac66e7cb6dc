"""Files that KITTI and KITTI-360 share: times, calibrations, scans, and numbered files of a sensor."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .errors import LogError
from .frames import Matrix
from .progress import Progress
from .tableio import numbers, text_of
from .writer import LogWriter

__all__ = ["calibration", "numbered", "recorded_images", "rigid", "scan", "times_us"]

_TIME = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?")


def times_us(path: Path) -> list[int]:
    """Times of a timestamps.txt in microseconds since 1970 (as if UTC), cut below the microsecond, increasing.

    A line is `2011-09-26 13:02:25.964389445`.
    """
    times: list[int] = []
    for number, line in enumerate(text_of(path, "the times of a sensor").splitlines(), 1):
        if not line.strip():
            continue
        found = _TIME.fullmatch(line.strip())
        if not found:
            raise LogError(f"{path}, line {number}", f"not a time: {line!r:.40}", "download the file again")
        year, month, day, hour, minute, second = (int(part) for part in found.groups()[:6])
        moment = datetime.datetime(year, month, day, hour, minute, second, tzinfo=datetime.timezone.utc)
        micros = int((found[7] or "").ljust(9, "0")[:6])
        time_us = int(moment.timestamp()) * 1_000_000 + micros
        if times and time_us <= times[-1]:
            problem = f"the clock runs backwards: {line.strip()} follows a later time, or repeats it"
            raise LogError(f"{path}, line {number}", problem, "use the synced drive, or cut the drive there")
        times.append(time_us)
    return times


def calibration(path: Path, what: str) -> dict[str, npt.NDArray[np.float64]]:
    """Lines `name: numbers` of a calibration file; lines that are no numbers, such as dates, are passed over."""
    found = {}
    for line in text_of(path, what).splitlines():
        name, _, values = line.strip().partition(":" if ":" in line else " ")
        try:
            found[name.strip()] = np.array([float(value) for value in values.split()])
        except ValueError:
            continue
    return found


def matrix34(values: npt.NDArray[np.float64] | None, name: str, place: Path) -> Matrix:
    """A rigid transform [4, 4] of the 12 numbers of its upper rows."""
    matrix = np.eye(4)
    matrix[:3] = numbers(values, (12,), name, place).reshape(3, 4)
    return matrix


def rigid(found: dict[str, npt.NDArray[np.float64]], place: Path, turn: str = "R", move: str = "T") -> Matrix:
    """A rigid transform [4, 4] of the lines R (9 numbers) and T (3 numbers)."""
    matrix = np.eye(4)
    matrix[:3, :3] = numbers(found.get(turn), (9,), turn, place).reshape(3, 3)
    matrix[:3, 3] = numbers(found.get(move), (3,), move, place)
    return matrix


def numbered(folder: Path, suffix: str, times: list[int], writer: LogWriter, what: str) -> Iterator[tuple[int, Path]]:
    """Time and file of each frame, of files named by their frame. Times without a file are counted as left out."""
    missing = 0
    for frame, time_us in enumerate(times):
        path = folder / f"{frame:010d}{suffix}"
        if path.exists():
            yield time_us, path
        else:
            missing += 1
    writer.left_out(f"times of {what} without a file", missing, "their files are missing")


def recorded_images(writer: LogWriter, folders: list[Path], inside: str, title: str) -> None:
    """The images of cameras, each with a folder of its name: its times, and its numbered files in the folder `inside`.

    The number of files is shown as `title`.
    """
    times = {folder: times_us(folder / "timestamps.txt") for folder in folders}
    with Progress(title, sum(len(its) for its in times.values())) as progress:
        for folder in folders:
            for time_us, path in numbered(folder / inside, ".png", times[folder], writer, folder.name):
                writer.image(folder.name, time_us, path)
                progress.step()


def scan(path: Path) -> npt.NDArray[np.float32]:
    """Points [n, 4] of a scan: x, y, z, reflectance."""
    values = np.fromfile(path, "<f4")
    if values.size % 4:
        raise LogError(path, f"{values.size} numbers: a point has 4", "download it again: it is cut off")
    return values.reshape(-1, 4)
