"""The task of `wildcity/Drive-v0` without any I/O: spaces, reward, end of an episode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..observation import Observation
from ..protocol import (
    Action,
    Drive,
    DriveSection,
    Dynamics,
    ImagePart,
    Model,
    Opened,
    Outputs,
    Rig,
    Station,
    Welcome,
)
from .route import Route

ACCELERATION_M_S2 = 9.8
CURVATURE_1_M = 0.2
"""What an action of 1 stands for: the limits of the protocol."""

WAYPOINTS = 20
HISTORY_POSES = 16
SPEED_M_S = 60.0
HISTORY_M = 200.0
"""16 poses at 0.1 s and 60 m/s are 90 m."""
ROUTE_M = 1000.0

Seen = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class DriveState:
    """Where the ego is on the recorded drive: what a reward may depend on."""

    station_m: float
    """Distance along the drive of the point that is nearest to the ego."""
    distance_m: float
    """Distance from that point."""
    speed_m_s: float
    observation: Observation


def default_reward(before: DriveState, after: DriveState) -> float:
    """Progress along the drive in metres, minus a tenth of the distance from it."""
    return after.station_m - before.station_m - 0.1 * after.distance_m


@dataclass(frozen=True)
class DriveConfig:
    """Arguments of `wildcity/Drive-v0`.

    server, token, timeout: as `wildcity.connect`.
    twin, version, trajectory: the twin and the recorded drive to follow; the latest version and the first drive if None.
    rig, cameras, size: the rig (the twin's own if None), the cameras to see, and the (width, height) of each image.
    dynamics, speed, dt_us: the motion model, the speed at the start in m/s, the time of a step.
    horizon: steps after which an episode is truncated.
    off_route_m: distance from the drive at which an episode terminates.
    start_m: episodes start at a random distance along the drive within these two; the default ends 20 m before the end.
    waypoint_m: distance between two of the 20 points of the route ahead.
    reward: a function of the states before and after a step; `default_reward` if None.
    """

    server: str = "ws://127.0.0.1:8080/v1/session"
    twin: str = "demo"
    version: int | None = None
    trajectory: str | None = None
    rig: str | Rig | None = None
    cameras: tuple[str, ...] = ("front",)
    size: tuple[int, int] = (96, 60)
    dynamics: Model = "dynamic"
    speed: float = 5.0
    dt_us: int = 100_000
    horizon: int = 500
    off_route_m: float = 4.0
    start_m: tuple[float, float] | None = None
    waypoint_m: float = 4.0
    reward: Callable[[DriveState, DriveState], float] | None = None
    token: str | None = None
    timeout: float = 90.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        if not self.cameras:
            raise ValueError("cameras is empty; name at least one camera")
        if self.dynamics == "teleport":
            raise ValueError("dynamics is 'teleport'; actions need 'kinematic' or 'dynamic'")
        if self.horizon < 1:
            raise ValueError(f"horizon is {self.horizon}; an episode has at least one step")

    def open_options(self, welcome: Welcome) -> dict[str, Any]:
        """Arguments of `Client.open`. Raises `ValueError` if the twin has no drive to follow."""
        images = {camera: ImagePart(size=self.size) for camera in self.cameras}
        return {
            "twin": self.twin,
            "version": self.version,
            "rig": self.rig,
            # Raw, because small images cost more time to decode than to transfer.
            "outputs": Outputs(cameras=self.cameras, encoding="raw", images=images),
            "dynamics": Dynamics(self.dynamics, speed=self.speed),
            "dt_us": self.dt_us,
            "trajectory": DriveSection(self._drive_name(welcome)),
        }

    def observation_space(self) -> spaces.Dict:
        """The cameras as `image_NAME`, then history, speed and route, all in SI units."""
        width, height = self.size
        images = {
            image_key(camera): spaces.Box(0, 255, (height, width, 3), np.uint8) for camera in self.cameras
        }
        return spaces.Dict(
            {
                **images,
                "history": spaces.Box(-HISTORY_M, HISTORY_M, (HISTORY_POSES, 3), np.float32),
                "speed": spaces.Box(0.0, SPEED_M_S, (1,), np.float32),
                "route": spaces.Box(-ROUTE_M, ROUTE_M, (WAYPOINTS, 2), np.float32),
            }
        )

    def action_space(self) -> spaces.Box:
        """Acceleration by 9.8 m/s² and curvature by 0.2 1/m (positive to the left)."""
        return spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _drive_name(self, welcome: Welcome) -> str:
        if self.trajectory is not None:
            return self.trajectory
        drives = [drive.name for twin in welcome.twins if twin.name == self.twin for drive in twin.trajectories]
        if not drives:
            raise ValueError(f"twin {self.twin!r} has no recorded drive to follow")
        return drives[0]


def image_key(camera: str) -> str:
    """The key of a camera's image. PyTorch's module names, which are made from it, have no dots."""
    return f"image_{camera.replace('.', '_')}"


def drive_of(opened: Opened) -> Drive:
    """The drive that `open_options` asks for."""
    assert opened.trajectory is not None, "the server left out the drive that was asked for"
    return opened.trajectory


class DriveTask:
    """Episodes along one recorded drive."""

    def __init__(self, config: DriveConfig, drive: Drive) -> None:
        self.config = config
        self.trajectory = drive.name
        self.route = Route(drive)
        self._state: DriveState | None = None
        self._steps = 0

    def start(self, numbers: np.random.Generator, options: Mapping[str, Any] | None) -> Station:
        """Where the next episode starts: the option `start`, in metres along the drive, or a random station.

        Raises `ValueError` if an option is unknown.
        """
        given = dict(options or {})
        start = given.pop("start", None)
        given.pop("version", None)
        if given:
            raise ValueError(f"options {sorted(given)} are unknown; known are start and version")
        if start is None:
            length_m = self.route.length_m
            first_m, last_m = self.config.start_m or (0.0, max(length_m - 20.0, length_m / 2))
            start = numbers.uniform(first_m, last_m)
        return start if isinstance(start, Station) else Station(self.trajectory, float(start))

    def begin(self, seen: Observation) -> tuple[Seen, dict[str, Any]]:
        """The first observation of an episode, and its info."""
        self._steps = 0
        self._state = self._state_of(seen, None)
        return self._arrays(self._state), self._info(self._state)

    def movement(self, action: Any) -> Action:
        """An action of the environment as one of the protocol."""
        acceleration, curvature = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        return Action(float(acceleration) * ACCELERATION_M_S2, float(curvature) * CURVATURE_1_M)

    def advance(self, seen: Observation) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Observation, reward, terminated, truncated and info after a step."""
        before = self._state
        assert before is not None, "reset the environment first"
        after = self._state_of(seen, before.station_m)
        self._state = after
        self._steps += 1
        reward = (self.config.reward or default_reward)(before, after)
        terminated = after.distance_m > self.config.off_route_m
        at_end = after.station_m >= self.route.length_m - 0.5
        truncated = not terminated and (at_end or self._steps >= self.config.horizon)
        return self._arrays(after), float(reward), terminated, truncated, self._info(after)

    def _state_of(self, seen: Observation, near_m: float | None) -> DriveState:
        station_m, distance_m = self.route.locate(seen.ego.pose, near_m)
        return DriveState(station_m, distance_m, float(np.linalg.norm(seen.ego.velocity)), seen)

    def _arrays(self, state: DriveState) -> Seen:
        seen = state.observation
        ahead = self.route.ahead(seen.ego.pose, state.station_m, WAYPOINTS, self.config.waypoint_m)
        # Copies: arrays of an observation are views of the received message, and read-only.
        images = {image_key(camera): seen.images[camera].copy() for camera in self.config.cameras}
        return {
            **images,
            "history": np.clip(seen.history_xyz, -HISTORY_M, HISTORY_M).astype(np.float32),
            "speed": np.array([min(state.speed_m_s, SPEED_M_S)], np.float32),
            "route": np.clip(ahead, -ROUTE_M, ROUTE_M).astype(np.float32),
        }

    def _info(self, state: DriveState) -> dict[str, Any]:
        metadata = state.observation.metadata
        return {
            "station_m": state.station_m,
            "distance_m": state.distance_m,
            "time_us": metadata.time_us,
            "version": metadata.version,
            "frame_hash": metadata.frame_hash,
        }
