"""Poses in text files: TUM, EuRoC and KITTI odometry.

- TUM (RGB-D benchmark): `time x y z qx qy qz qw`, seconds; `#` begins a comment.
- EuRoC (ASL): `time, x, y, z, qw, qx, qy, qz, ..`, nanoseconds, after a line that begins with `#`.
- KITTI odometry: 12 numbers, the upper rows of world_from_camera; times in seconds are in times.txt beside it.

Decimal seconds are read as decimals, so that the microsecond is exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from .errors import LogError
from .frames import Matrix, transform
from .tableio import require

__all__ = ["poses_of", "rows_of", "seconds_to_us"]


NANOSECOND_DIGITS = 16
"""A whole number with as many digits is a time in nanoseconds, not in seconds."""


def rows_of(path: Path, what: str) -> Iterator[tuple[str, list[str]]]:
    """Place and words of each line that is no comment. Words are separated by spaces or commas."""
    with require(path, what).open(encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            if line.strip() and not line.startswith("#"):
                yield f"{path}, line {number}", line.replace(",", " ").split()


def seconds_to_us(text: str, place: str) -> int:
    """A decimal number of seconds as microseconds, cut below."""
    try:
        return int(Decimal(text) * 1_000_000)
    except (InvalidOperation, ValueError, OverflowError):
        raise LogError(place, f"{text!r} is no time in seconds", "repair the line") from None


def poses_of(path: Path) -> Iterator[tuple[str, int, Matrix]]:
    """Place, time in microseconds and pose [4, 4] of each line; times increase. The format is found by its width."""
    last_us: int | None = None
    kitti_times: Iterator[tuple[str, list[str]]] | None = None
    for place, words in rows_of(path, "the file of poses"):
        if len(words) == 12:
            kitti_times = kitti_times or rows_of(path.with_name("times.txt"), "the times of poses in KITTI's format")
            time_us, pose = _kitti(words, next(kitti_times, None), place)
        elif len(words) >= 8 and words[0].isdigit() and len(words[0]) >= NANOSECOND_DIGITS:
            time_us, pose = int(words[0]) // 1000, _pose(words[1:4], words[4:8], place)
        elif len(words) == 8:
            time_us, pose = seconds_to_us(words[0], place), _pose(words[1:4], [words[7], *words[4:7]], place)
        else:
            problem = f"{len(words)} words: TUM has 8, EuRoC 8 or more after a time in nanoseconds, KITTI 12"
            raise LogError(place, problem, "give a file of one of these formats")
        if last_us is not None and time_us <= last_us:
            problem = f"the time {time_us} us follows {last_us} us: the clock runs backwards, or stands"
            raise LogError(place, problem, "sort the file, or repair its clock")
        last_us = time_us
        yield place, time_us, pose


def _floats(words: list[str], place: str) -> Matrix:
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise LogError(place, f"{' '.join(words)!r:.60} are no numbers", "repair the line") from None
    if not np.isfinite(values).all():
        raise LogError(place, "a number is not finite", "repair or remove the line")
    return values


def _pose(xyz: list[str], q: list[str], place: str) -> Matrix:
    turn = _floats(q, place)
    if abs(float(np.linalg.norm(turn)) - 1) > 1e-2:
        raise LogError(place, f"the quaternion (w, x, y, z) {turn.tolist()} has not the length 1", "repair the line")
    return transform(_floats(xyz, place), turn)


def _kitti(words: list[str], time: tuple[str, list[str]] | None, place: str) -> tuple[int, Matrix]:
    if time is None:
        raise LogError(place, "times.txt has fewer lines than there are poses", "give the times of this sequence")
    pose = np.eye(4)
    pose[:3] = _floats(words, place).reshape(3, 4)
    return seconds_to_us(time[1][0], time[0]), pose
