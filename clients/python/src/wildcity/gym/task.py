"""The task of `wildcity/Drive-v0` without any I/O: spaces, reward, end of an episode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..messages import Action, Drive, DriveSection, Dynamics, ImagePart, Model, Opened, Outputs, Rig, Station, Welcome
from ..observation import Observation
from .route import Route

ACCELERATION_M_S2 = 9.8
CURVATURE_1_M = 0.2
"""Acceleration and curvature of an action of 1: the limits of the protocol."""

WAYPOINTS = 20
HISTORY_POSES = 16
SPEED_M_S = 60.0
HISTORY_M = 200.0
"""16 poses at 0.1 s and 60 m/s are 90 m."""
ROUTE_M = 1000.0
RANGE_M = 1000.0
"""The protocol's limit of a LiDAR's range."""
ROUTE_SPACING_M = 80 / 19
"""Distance between two points of a scenario's route."""

OF_A_DRIVE = ("trajectory", "dynamics", "speed", "off_route_m", "start_m", "waypoint_m")
"""Arguments of `DriveConfig` that a scenario replaces."""

Seen = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class DriveState:
    """State of the ego on the recorded drive or on the scenario's route, for rewards."""

    station_m: float
    """Distance along the drive of the point that is nearest to the ego."""
    distance_m: float
    """Distance from that point."""
    speed_m_s: float
    observation: Observation

    @property
    def contacts(self) -> int:
        """Contacts that began in the last step, with actors of the scenario or with the twin."""
        return sum(event.kind == "contact" for event in self.observation.metadata.events)


@dataclass(frozen=True)
class Reward:
    """The reward of a step, in metres of progress: a sum of terms, each with its weight. A weight of 0 leaves it out.

    Where a drive ends, speeding cannot pay: its term takes more than the progress that it brings.
    """

    progress: float = 1.0
    """Progress along the drive or the route, in metres."""
    beside: float = 0.1
    """Minus the distance from it, in metres."""
    speeding: float = 2.0
    """Minus the way above the limit: the speed above `speed_limit_m_s`, in m/s, times the time of the step."""
    comfort: float = 0.5
    """Minus the acceleration above `comfort_m_s2`, braking and turning too, in m/s², times the time of the step."""
    contact: float = 10.0
    """Minus the number of contacts that began in the step."""
    speed_limit_m_s: float = 50 / 3.6
    comfort_m_s2: float = 3.0

    def terms(self, before: DriveState, after: DriveState) -> dict[str, float]:
        """Each term with its weight and its sign."""
        observation = after.observation
        time_s = 1e-6 * (observation.metadata.time_us - before.observation.metadata.time_us)
        acceleration_m_s2 = float(np.linalg.norm(observation.ego.acceleration[:2]))
        return {
            "progress": self.progress * (after.station_m - before.station_m),
            "beside": -self.beside * after.distance_m,
            "speeding": -self.speeding * max(0.0, after.speed_m_s - self.speed_limit_m_s) * time_s,
            "comfort": -self.comfort * max(0.0, acceleration_m_s2 - self.comfort_m_s2) * time_s,
            "contact": -self.contact * after.contacts,
        }

    def __call__(self, before: DriveState, after: DriveState) -> float:
        """The sum of the terms."""
        return sum(self.terms(before, after).values())


@dataclass(frozen=True)
class DriveConfig:
    """Arguments of `wildcity/Drive-v0`.

    server, token, timeout: as `wildcity.connect`.
    twin, version, trajectory: the twin and the recorded drive to follow; the latest version and the first drive if
    None.
    scenario: a scenario to drive in, as for `Client.open`. Route, start, dynamics and end are then those of the
        scenario, and trajectory, dynamics, speed, off_route_m, start_m and waypoint_m must have their defaults.
    rig, cameras, size: the rig (the twin's own if None), the cameras to render, and the (width, height) of each image.
    lidars: the LiDARs of the rig to observe, each with the (rows, columns) of its beams; none if empty.
    dynamics, speed, dt_us: the motion model, the speed at the start in m/s, the time of a step.
    horizon: steps after which an episode is truncated.
    off_route_m: distance from the drive at which an episode terminates.
    start_m: episodes start at a random distance along the drive between these two; the default ends 20 m before its
        end.
    waypoint_m: distance between two of the 20 points of the route ahead.
    profile: changes of the twin's render profile, as for `Client.open`: {"tau_px": 4.0} draws small images faster.
    record: whether the server records the episodes. A training makes a file with each reset.
    reward: a `Reward` with weights of your own, or any function of the states before and after a step.

    Raises `ValueError` that names the argument.
    """

    server: str = "ws://127.0.0.1:8080/v1/session"
    twin: str = "demo"
    version: int | None = None
    trajectory: str | None = None
    scenario: str | Mapping[str, Any] | None = None
    rig: str | Rig | None = None
    cameras: tuple[str, ...] = ("front",)
    size: tuple[int, int] = (96, 60)
    lidars: Mapping[str, tuple[int, int]] = field(default_factory=dict, hash=False)
    dynamics: Model = "dynamic"
    speed: float = 5.0
    dt_us: int = 100_000
    horizon: int = 500
    off_route_m: float = 4.0
    start_m: tuple[float, float] | None = None
    waypoint_m: float = 4.0
    profile: Mapping[str, Any] | None = field(default=None, hash=False)
    record: bool = False
    reward: Callable[[DriveState, DriveState], float] = Reward()
    token: str | None = None
    timeout: float = 90.0

    def __post_init__(self) -> None:
        if isinstance(self.cameras, str):
            raise ValueError(f"cameras is {self.cameras!r}; give a tuple of names, as ({self.cameras!r},)")
        object.__setattr__(self, "cameras", tuple(self.cameras))
        if not self.cameras:
            raise ValueError("cameras is empty; name at least one camera")
        if not isinstance(self.lidars, Mapping):
            raise ValueError(f"lidars is {self.lidars!r}; give rows and columns by name, as {{'top': (64, 1800)}}")
        if np.shape(self.size) != (2,):
            raise ValueError(f"size is {self.size!r}; give width and height of the images, as (96, 60)")
        keys = [*map(image_key, self.cameras), *map(lidar_key, self.lidars)]
        if len(set(keys)) < len(keys):
            raise ValueError(f"cameras and lidars: two of them have one key, in {', '.join(keys)}")
        if self.scenario is not None:
            own = [one for one in fields(self) if one.name in OF_A_DRIVE]
            given = [one.name for one in own if getattr(self, one.name) != one.default]
            if given:
                raise ValueError(f"with scenario, {', '.join(given)} cannot be set: the scenario defines them")
        if self.dynamics == "teleport":
            raise ValueError("dynamics is 'teleport'; actions need 'kinematic' or 'dynamic'")
        # Not `<`, which NaN passes.
        if not self.horizon >= 1:
            raise ValueError(f"horizon is {self.horizon}; an episode has at least one step")
        for name in ("off_route_m", "waypoint_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; give a distance above 0, in metres")
        start_m = (0.0, 0.0) if self.start_m is None else self.start_m
        if np.shape(start_m) != (2,) or not 0 <= start_m[0] <= start_m[1]:
            raise ValueError(f"start_m is {start_m}; give the least and the greatest distance, as (0.0, 50.0)")
        if not callable(self.reward):
            raise ValueError(f"reward is {self.reward!r}; give a `Reward` or a function of two states")

    def open_options(self, welcome: Welcome) -> dict[str, Any]:
        """Arguments of `Client.open`. Raises `ValueError` if there is no such twin, or it has no drive to follow."""
        twins = [twin.name for twin in welcome.twins]
        if self.twin not in twins:
            raise ValueError(f"there is no twin {self.twin!r}; the server has {', '.join(sorted(twins)) or 'none'}")
        images = {camera: ImagePart(size=self.size) for camera in self.cameras}
        options = {
            "twin": self.twin,
            "version": self.version,
            "rig": self.rig,
            # Raw, because small images cost more time to decode than to transfer.
            "outputs": Outputs(cameras=self.cameras, encoding="raw", images=images),
            "dt_us": self.dt_us,
            "profile": None if self.profile is None else dict(self.profile),
            "record": self.record,
        }
        if self.scenario is not None:
            return {**options, "scenario": self.scenario}
        return {
            **options,
            "dynamics": Dynamics(self.dynamics, speed=self.speed),
            "trajectory": DriveSection(self._drive_name(welcome)),
        }

    def observation_space(self) -> spaces.Dict:
        """The cameras as `image_NAME`, the LiDARs as `lidar_NAME`, then history, speed and route, all in SI units."""
        width, height = self.size
        images = {image_key(camera): spaces.Box(0, 255, (height, width, 3), np.uint8) for camera in self.cameras}
        ranges = {lidar_key(name): spaces.Box(0.0, RANGE_M, shape, np.float32) for name, shape in self.lidars.items()}
        return spaces.Dict(
            {
                **images,
                **ranges,
                "history": spaces.Box(-HISTORY_M, HISTORY_M, (HISTORY_POSES, 3), np.float32),
                "speed": spaces.Box(0.0, SPEED_M_S, (1,), np.float32),
                "route": spaces.Box(-ROUTE_M, ROUTE_M, (WAYPOINTS, 2), np.float32),
            }
        )

    def action_space(self) -> spaces.Box:
        """Acceleration in units of 9.8 m/s² and curvature in units of 0.2 1/m (positive to the left)."""
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


def lidar_key(lidar: str) -> str:
    """The key of a LiDAR's ranges, without dots as that of a camera."""
    return f"lidar_{lidar.replace('.', '_')}"


def check_lidars(config: DriveConfig, opened: Opened) -> None:
    """Raises `ValueError` if the rig lacks a LiDAR of `config.lidars`, or has it with other beams."""
    beams = {lidar.name: (lidar.rows, lidar.columns) for lidar in opened.lidars}
    for name, shape in config.lidars.items():
        if name not in beams:
            raise ValueError(f"lidars: the rig has no LiDAR {name!r}; it has {', '.join(sorted(beams)) or 'none'}")
        if tuple(shape) != beams[name]:
            rows, columns = beams[name]
            raise ValueError(f"lidars: {name!r} has {rows} rows and {columns} columns, not {tuple(shape)}")


def task_of(config: DriveConfig, opened: Opened) -> Task:
    """The task of a session that was opened with `open_options`. Raises `ValueError` if its LiDARs are other ones."""
    check_lidars(config, opened)
    if config.scenario is not None:
        return ScenarioTask(config, opened)
    assert opened.trajectory is not None, "the server left out the drive that was asked for"
    return DriveTask(config, opened.trajectory)


class Task(ABC):
    """Episodes of one session."""

    def __init__(self, config: DriveConfig) -> None:
        self.config = config
        self._state: DriveState | None = None
        self._steps = 0

    def start(self, numbers: np.random.Generator, options: Mapping[str, Any] | None) -> Station | None:
        """The start of the next episode: the option `start`, or the default of the task.

        Raises `ValueError` if an option is unknown.
        """
        given = dict(options or {})
        start = given.pop("start", None)
        given.pop("version", None)
        if given:
            raise ValueError(f"options {sorted(given)} are unknown; known are start and version")
        return self._start(numbers, start)

    def begin(self, seen: Observation) -> tuple[Seen, dict[str, Any]]:
        """The first observation of an episode, and its info."""
        self._steps = 0
        self._state = self._state_of(seen, None)
        return self._arrays(self._state), self._info(self._state)

    def movement(self, action: Any) -> Action:
        """An action of the environment as one of the protocol."""
        given = np.asarray(action, np.float64)
        if given.shape != (2,):
            raise ValueError(f"action has the shape {given.shape}; it is two numbers: acceleration and curvature")
        if not np.isfinite(given).all():
            raise ValueError(f"action is {given}; give numbers from -1 to 1")
        acceleration, curvature = np.clip(given, -1.0, 1.0)
        return Action(float(acceleration) * ACCELERATION_M_S2, float(curvature) * CURVATURE_1_M)

    def advance(self, seen: Observation) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Observation, reward, terminated, truncated and info after a step."""
        before = self._state
        assert before is not None, "reset the environment first"
        after = self._state_of(seen, before.station_m)
        self._state = after
        self._steps += 1
        reward = self.config.reward(before, after)
        terminated, ended = self._ended(after)
        truncated = not terminated and (ended or self._steps >= self.config.horizon)
        return self._arrays(after), float(reward), terminated, truncated, self._info(after)

    @abstractmethod
    def _start(self, numbers: np.random.Generator, start: Any) -> Station | None:
        """The start of the next episode; `start` is the option of this name."""

    @abstractmethod
    def _state_of(self, seen: Observation, near_m: float | None) -> DriveState:
        """The state of the ego; `near_m` is its previous station."""

    @abstractmethod
    def _ended(self, state: DriveState) -> tuple[bool, bool]:
        """Whether the episode terminates, and whether it is truncated."""

    @abstractmethod
    def _ahead(self, state: DriveState) -> NDArray[np.float64]:
        """[20, 2]: points of the route ahead, in the rig frame."""

    def _arrays(self, state: DriveState) -> Seen:
        seen = state.observation
        ahead = self._ahead(state)
        # Copies: arrays of an observation are views of the received message, and read-only.
        images = {image_key(camera): seen.images[camera].copy() for camera in self.config.cameras}
        ranges = {lidar_key(name): seen.lidars[name].ranges.clip(0.0, RANGE_M) for name in self.config.lidars}
        return {
            **images,
            **ranges,
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


class DriveTask(Task):
    """Episodes along one recorded drive."""

    def __init__(self, config: DriveConfig, drive: Drive) -> None:
        super().__init__(config)
        self.trajectory = drive.name
        self.route = Route(drive)

    def _start(self, numbers: np.random.Generator, start: Any) -> Station:
        if start is None:
            length_m = self.route.length_m
            first_m, last_m = self.config.start_m or (0.0, max(length_m - 20.0, length_m / 2))
            start = numbers.uniform(first_m, last_m)
        return start if isinstance(start, Station) else Station(self.trajectory, float(start))

    def _state_of(self, seen: Observation, near_m: float | None) -> DriveState:
        station_m, distance_m = self.route.locate(seen.ego.pose, near_m)
        return DriveState(station_m, distance_m, float(np.linalg.norm(seen.ego.velocity)), seen)

    def _ended(self, state: DriveState) -> tuple[bool, bool]:
        # The server ends the episode at a contact with the twin.
        is_off = state.distance_m > self.config.off_route_m or state.observation.metadata.terminated
        return is_off, state.station_m >= self.route.length_m - 0.5

    def _ahead(self, state: DriveState) -> NDArray[np.float64]:
        pose = state.observation.ego.pose
        return self.route.ahead(pose, state.station_m, WAYPOINTS, self.config.waypoint_m)


class ScenarioTask(Task):
    """Episodes of a scenario. The server determines progress and end."""

    def __init__(self, config: DriveConfig, opened: Opened) -> None:
        super().__init__(config)
        if opened.dynamics.model == "teleport":
            raise ValueError("the scenario has no ego.dynamics: actions need the model kinematic or dynamic")

    def _start(self, numbers: np.random.Generator, start: Any) -> Station | None:
        if start is None or isinstance(start, Station):
            return start
        raise ValueError(f"start is {start!r}; a scenario says where episodes start: give a Station or nothing")

    def _state_of(self, seen: Observation, near_m: float | None) -> DriveState:
        route = seen.metadata.route
        if route is None:
            raise ValueError("the scenario has no route: give it one, or a start along a trajectory")
        return DriveState(route.station_m, abs(route.off_m), float(np.linalg.norm(seen.ego.velocity)), seen)

    def _ended(self, state: DriveState) -> tuple[bool, bool]:
        reason = end_of(state.observation)
        is_over = reason in ("time", "condition")
        return reason is not None and not is_over, is_over

    def _ahead(self, state: DriveState) -> NDArray[np.float64]:
        route = state.observation.metadata.route
        assert route is not None, "`_state_of` has refused it"
        points = np.array([point[:2] for point in route.points], np.float64).reshape(-1, 2)
        return straight_on(points[:WAYPOINTS])

    def _info(self, state: DriveState) -> dict[str, Any]:
        metadata = state.observation.metadata
        return {
            **super()._info(state),
            "command": metadata.route.command if metadata.route is not None else "straight",
            "contacts": state.contacts,
            "end": end_of(state.observation) or "",
        }


def end_of(seen: Observation) -> str | None:
    """The rule of the scenario that ended the episode with this observation, if there is one."""
    return next((event.name for event in seen.metadata.events if event.kind == "end"), None)


def straight_on(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """[20, 2]: the points of a route in the rig frame; straight on after its end."""
    missing = WAYPOINTS - len(points)
    if missing == 0:
        return points
    last = points[-1] if len(points) else np.zeros(2)
    step = points[-1] - points[-2] if len(points) > 1 else np.array([ROUTE_SPACING_M, 0.0])
    length_m = float(np.linalg.norm(step))
    step = step * (ROUTE_SPACING_M / length_m) if length_m > 1e-6 else np.array([ROUTE_SPACING_M, 0.0])
    more: NDArray[np.float64] = np.concatenate([points, last + step * np.arange(1, missing + 1)[:, None]])
    return more
