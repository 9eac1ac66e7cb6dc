"""Tables of a log while they are written: rows in any order, sorted by time at the end in bounded memory."""

from __future__ import annotations

import heapq
import json
import statistics
from array import array
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TextIO

__all__ = ["Gap", "Spool", "compact"]

RUN_LINES = 200_000
"""Lines that are sorted in memory at once, about 60 MB."""

_SHIFT = 1 << 62
"""Added to a time, so that the keys of all times have the same number of digits and sort as text."""

GAP_FACTOR = 1.5
"""An interval longer than this many median intervals of its sensor is a gap."""


def compact(value: Any) -> str:
    """JSON without spaces, with the shortest decimal numbers that give the same floats; refuses NaN."""
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


@dataclass(frozen=True)
class Gap:
    """Where a sensor has no rows for longer than its median interval says. Times are log times in microseconds."""

    table: str
    sensor: str
    count: int
    longest_us: int
    at_us: int
    median_us: int

    def __str__(self) -> str:
        name = f"{self.table} {self.sensor}".strip()
        intervals = "interval" if self.count == 1 else "intervals"
        return (
            f"{name}: {self.count} {intervals} longer than {GAP_FACTOR} x {self.median_us / 1e6:.6g} s, "
            f"the longest {self.longest_us / 1e6:.6g} s, after {self.at_us / 1e6:.6f} s"
        )


class Spool:
    """Rows of one table, in a file, each with its key: the time and then the row itself."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: TextIO = path.open("w", encoding="utf-8")

    def add(self, row: dict[str, Any]) -> None:
        """row: with `time_us`, the log time."""
        self._file.write(f"{row['time_us'] + _SHIFT:019d}{compact(row)}\n")

    def close(self) -> None:
        """Ends the writing of rows."""
        self._file.close()

    def sorted_into(self, target: Path) -> tuple[int, list[Gap], tuple[str, str] | None]:
        """Writes the table. Returns the number of rows, the gaps, and two different rows of a sensor at one time."""
        self._file.close()
        times: dict[str, array[int]] = {}
        last: dict[str, str] = {}
        count, clash = 0, None
        with target.open("w", encoding="utf-8", newline="\n") as out:
            for line in self._sorted():
                text = line[19:]
                row = json.loads(text)
                sensor = row.get("camera") or row.get("lidar") or row.get("track") or ""
                seen = times.setdefault(sensor, array("q"))
                if len(seen) and seen[-1] == row["time_us"]:
                    if last[sensor] != text:
                        clash = clash or (last[sensor], text)
                    continue
                seen.append(row["time_us"])
                last[sensor] = text
                out.write(text)
                count += 1
        table = target.stem
        # Tracks come and go: what they lack is no gap of a sensor.
        sensors = sorted(times.items()) if table != "tracks" else []
        return count, [gap for sensor, seen in sensors for gap in _gaps(table, sensor, seen)], clash

    def _sorted(self) -> Iterator[str]:
        with ExitStack() as stack:
            runs: list[TextIO] = []
            source = stack.enter_context(self._path.open(encoding="utf-8"))
            while lines := [line for _, line in zip(range(RUN_LINES), source, strict=False)]:
                lines.sort()
                if not runs and len(lines) < RUN_LINES:
                    yield from lines
                    return
                path = self._path.with_suffix(f".run{len(runs)}")
                with path.open("w", encoding="utf-8") as run:
                    run.writelines(lines)
                runs.append(stack.enter_context(path.open(encoding="utf-8")))
            yield from heapq.merge(*runs)


def _gaps(table: str, sensor: str, times: array[int]) -> Iterator[Gap]:
    if len(times) < 3:
        return
    intervals = array("q", (b - a for a, b in pairwise(times)))
    median = int(statistics.median_low(intervals))
    wide = [index for index, interval in enumerate(intervals) if interval > GAP_FACTOR * median]
    if wide:
        longest = max(wide, key=lambda index: intervals[index])
        yield Gap(table, sensor, len(wide), intervals[longest], times[longest], median)
