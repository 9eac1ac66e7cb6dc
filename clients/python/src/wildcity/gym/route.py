"""Distances along and from a recorded drive, in the plane of the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..messages import Drive
from ..pose import Pose

BEHIND_M = 20.0
AHEAD_M = 40.0
"""Largest distance from the last station at which the next one is searched: more than a step of 0.5 s at 60 m/s."""


class Route:
    """The polyline through the poses of a recorded drive."""

    def __init__(self, drive: Drive) -> None:
        if len(drive.poses) < 2:
            raise ValueError(f"the drive {drive.name!r} has {len(drive.poses)} pose; a route needs two")
        self.station_m = np.array([one.station_m for one in drive.poses])
        self.xy = np.array([one.pose.xyz[:2] for one in drive.poses])
        self.length_m = float(self.station_m[-1])

    def locate(self, pose: Pose, near_m: float | None = None) -> tuple[float, float]:
        """The station of the nearest point of the route, and the distance from it, both in metres.

        With `near_m`, the previous station, only its neighbourhood is searched, because a route may cross itself.
        """
        first = 0
        last = len(self.station_m) - 1
        if near_m is not None:
            first = max(0, int(np.searchsorted(self.station_m, near_m - BEHIND_M)) - 1)
            last = min(last, int(np.searchsorted(self.station_m, near_m + AHEAD_M)))
        start = self.xy[first:last]
        along = self.xy[first + 1 : last + 1] - start
        to_ego = np.array(pose.xyz[:2]) - start
        squared = np.einsum("ij,ij->i", along, along)
        t = np.einsum("ij,ij->i", to_ego, along) / np.where(squared > 0, squared, 1.0)
        t = np.clip(t, 0.0, 1.0)
        distance_m = np.linalg.norm(to_ego - t[:, None] * along, axis=1)
        nearest = int(distance_m.argmin())
        from_m = self.station_m[first + nearest]
        to_m = self.station_m[first + nearest + 1]
        return float(from_m + t[nearest] * (to_m - from_m)), float(distance_m[nearest])

    def ahead(self, pose: Pose, station_m: float, count: int, spacing_m: float) -> NDArray[np.float64]:
        """[count, 2]: the next points of the route, `spacing_m` apart, in the rig frame; straight on after its end."""
        stations = station_m + spacing_m * np.arange(1, count + 1)
        world = np.stack([np.interp(stations, self.station_m, self.xy[:, axis]) for axis in (0, 1)], axis=-1)
        beyond = np.clip(stations - self.length_m, 0.0, None)
        world += beyond[:, None] * self._last_direction()
        w, x, y, z = pose.q
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        dx, dy = (world - np.array(pose.xyz[:2])).T
        return np.stack([np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx], axis=-1)

    def _last_direction(self) -> NDArray[np.float64]:
        """Unit vector of the last two points that differ."""
        steps = np.diff(self.xy, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        moving = np.flatnonzero(lengths > 1e-6)
        if len(moving) == 0:
            return np.zeros(2)
        last = moving[-1]
        direction: NDArray[np.float64] = steps[last] / lengths[last]
        return direction
