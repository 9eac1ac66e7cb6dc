"""Recorded drives of a twin."""

from __future__ import annotations

import urllib.parse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import ProtocolError
from .http_client import HttpClient
from .protocol import Pose, decode

__all__ = ["RecordedDrive", "recorded_drive"]


@dataclass(frozen=True)
class RecordedDrive:
    """A part of a recorded drive: N poses of the rig in driving order, `world_from_rig`."""

    trajectory: str
    version: int
    length_m: float
    """Length of the whole drive."""
    station_m: NDArray[np.float64]
    """[N]: distances along the drive, as `Station.station_m`."""
    time_us: NDArray[np.int64]
    """[N]: recorded times."""
    xyz: NDArray[np.float64]
    """[N, 3]: positions in the world, in metres."""
    q: NDArray[np.float64]
    """[N, 4]: unit quaternions (w, x, y, z)."""

    def pose(self, index: int) -> Pose:
        """One of the poses."""
        return Pose(tuple(self.xyz[index]), tuple(self.q[index]))


@dataclass(frozen=True)
class _Keyframe:
    station_m: float
    time_us: int
    pose: Pose


@dataclass(frozen=True)
class _Answer:
    trajectory: str
    version: int
    length_m: float
    keyframes: tuple[_Keyframe, ...]


def recorded_drive(
    twin: str,
    trajectory: str,
    *,
    server: str = "http://127.0.0.1:8080",
    version: int | None = None,
    from_m: float | None = None,
    to_m: float | None = None,
    every_m: float | None = None,
    token: str | None = None,
    timeout: float = 60.0,
) -> RecordedDrive:
    """The poses of a recorded drive, from one distance along it to another.

    every_m: distance between two poses; the recorded keyframes if None.
    server: `http://HOST:PORT`, or the `ws://HOST:PORT/v1/session` that `connect` takes.
    token: for a server that was started with tokens; the default is `$WILDCITY_TOKEN`.

    Raises `Refused` if there is no such twin or drive, or a number is out of range, and `ConnectFailed` if the server
    does not answer.
    """
    given = {"version": version, "from_m": from_m, "to_m": to_m, "every_m": every_m}
    query = urllib.parse.urlencode({key: value for key, value in given.items() if value is not None})
    names = [urllib.parse.quote(name, safe="") for name in (twin, trajectory)]
    path = f"/v1/twins/{names[0]}/trajectories/{names[1]}"
    answer = HttpClient(_http(server), token, timeout).json("GET", f"{path}?{query}" if query else path, None)
    decoded: _Answer = decode(_Answer, answer, "trajectory")
    if not decoded.keyframes:
        raise ProtocolError(f"the drive {trajectory!r} has no poses from {from_m} to {to_m} m")
    return RecordedDrive(
        decoded.trajectory,
        decoded.version,
        decoded.length_m,
        np.array([keyframe.station_m for keyframe in decoded.keyframes]),
        np.array([keyframe.time_us for keyframe in decoded.keyframes], np.int64),
        np.array([keyframe.pose.xyz for keyframe in decoded.keyframes]),
        np.array([keyframe.pose.q for keyframe in decoded.keyframes]),
    )


def _http(server: str) -> str:
    """The HTTP address of a server, of which the WebSocket address may be given."""
    parts = urllib.parse.urlsplit(server)
    schemes = {"ws": "http", "wss": "https"}
    return urllib.parse.urlunsplit((schemes.get(parts.scheme, parts.scheme), parts.netloc, "", "", ""))
