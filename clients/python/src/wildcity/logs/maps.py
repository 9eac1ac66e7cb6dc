"""Map files (`wildcity.map/1`) from lanes that have a left and a right edge."""

from __future__ import annotations

from typing import Any

import numpy as np

from .errors import LogError
from .frames import Matrix

__all__ = ["MapBuilder"]

MAX_POINTS = 1000
"""Points of a middle line that is computed from two edges."""


class MapBuilder:
    """Collects lanes and areas; coordinates are those of the source's world, and the log's origin is subtracted."""

    def __init__(self, origin_m: Matrix) -> None:
        self.origin_m = origin_m
        self.lanes: dict[str, dict[str, Any]] = {}
        self.areas: list[dict[str, Any]] = []
        self.stop_lines: list[dict[str, Any]] = []

    def lane(
        self,
        lane_id: str,
        left: Any,
        right: Any,
        following: list[str],
        *,
        kind: str = "driving",
        is_intersection: bool = False,
        limit_mps: float | None = None,
        center: Any = None,
        place: str = "",
    ) -> None:
        """Adds a lane. left, right: edges [n, 3] in driving direction. center: its middle, or None to compute it."""
        edges = [self._line(line, f"{place} lane {lane_id}", 2) for line in (left, right)]
        middle = _middle(*edges) if center is None else self._line(center, f"{place} lane {lane_id}", 2)
        lane: dict[str, Any] = {"id": lane_id}
        if kind != "driving":
            lane["kind"] = kind
        lane |= {"center": middle.tolist(), "left": edges[0].tolist(), "right": edges[1].tolist(), "next": following}
        if is_intersection:
            lane["intersection"] = True
        if limit_mps is not None and 0.1 <= limit_mps <= 200:
            lane["limit_mps"] = limit_mps
        self.lanes[lane_id] = lane

    def area(self, kind: str, outline: Any, place: str = "") -> None:
        """Adds an area: drivable, intersection or crosswalk. outline: [n, 3]; a repeated first point is dropped."""
        line = self._line(outline, f"{place} area {kind}", 3)
        if np.array_equal(line[0], line[-1]):
            line = line[:-1]
        self.areas.append({"kind": kind, "outline": line.tolist()})

    def _line(self, points: Any, place: str, least: int) -> Matrix:
        line = np.asarray(points, np.float64)
        if line.ndim != 2 or line.shape[1] != 3 or len(line) < least or not np.isfinite(line).all():
            raise LogError(place, f"its line is no list of {least} or more points (x, y, z)", "repair the map")
        return np.asarray(line - self.origin_m)

    def file(self) -> dict[str, Any] | None:
        """The map file, or None if there is nothing. A successor that is no lane of the map is dropped."""
        for lane in self.lanes.values():
            lane["next"] = [name for name in lane["next"] if name in self.lanes]
        if not self.lanes and not self.areas:
            return None
        return {
            "format": "wildcity.map/1",
            "lanes": list(self.lanes.values()),
            "areas": self.areas,
            "stop_lines": self.stop_lines,
        }


def _middle(left: Matrix, right: Matrix) -> Matrix:
    """The mean of both edges at equal parts of their lengths, with as many points as the longer list has."""
    count = min(max(len(left), len(right), 2), MAX_POINTS)
    return (_spread(left, count) + _spread(right, count)) / 2


def _spread(line: Matrix, count: int) -> Matrix:
    """Points at equal parts of a line's length [count, 3]."""
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    if along[-1] == 0:
        return np.repeat(line[:1], count, axis=0)
    at = np.linspace(0, along[-1], count)
    return np.stack([np.interp(at, along, line[:, axis]) for axis in range(3)], axis=1)
