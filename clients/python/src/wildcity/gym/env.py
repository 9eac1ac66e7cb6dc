"""`wildcity/Drive-v0`: one episode after the other in one session."""

from __future__ import annotations

import contextlib
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ..sync import Session, connect
from .task import DriveConfig, Seen, Task, task_of


def checked(config: DriveConfig) -> DriveConfig:
    """The same, after its server was asked. Raises `ValueError` if there is no such twin, or it has no drive."""
    with connect(config.server, name="wildcity-gym", timeout=config.timeout, token=config.token) as client:
        config.open_options(client.welcome)
    return config


class DriveEnv(gymnasium.Env[Any, Any]):
    """Follow a recorded drive, or drive in a scenario. The arguments are those of `DriveConfig`, and `render_mode`.

    The server is asked here for the twin: `ValueError` if it has none of this name, `wildcity.ConnectFailed` if it does
    not answer. The session is opened by the first `reset`, whose options are `start`, a distance along the drive in
    metres (or a `Station`), and `version`, the version of the twin to show from then on. `render` returns the images
    side by side.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None, **arguments: Any) -> None:
        self.config = checked(DriveConfig(**arguments))
        self.render_mode = render_mode
        self.observation_space = self.config.observation_space()
        self.action_space = self.config.action_space()
        self._open = contextlib.ExitStack()
        self._session: Session | None = None
        self._task: Task | None = None
        self._version: int | None = None
        self._seen: Seen | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Starts an episode."""
        super().reset(seed=seed)
        session, task = self._opened()
        version = (options or {}).get("version")
        if version is not None and version != self._version:
            self._version = session.switch_version(version).version
        start = task.start(self.np_random, options)
        first = session.reset(int(self.np_random.integers(1 << 32)), start)
        self._seen, info = task.begin(first)
        return self._seen, info

    def step(self, action: Any) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Applies acceleration and curvature for one step."""
        session, task = self._opened()
        result = task.advance(session.step(task.movement(action)))
        self._seen = result[0]
        return result

    def render(self) -> NDArray[np.uint8] | None:
        """uint8 [height, width * cameras, 3]: the images of the last observation."""
        if self.render_mode is None or self._seen is None:
            return None
        images = [image for key, image in self._seen.items() if key.startswith("image_")]
        return np.concatenate(images, axis=1)

    def close(self) -> None:
        """Ends session and connection."""
        self._session = self._task = None
        self._open.close()

    def _opened(self) -> tuple[Session, Task]:
        if self._session is None or self._task is None:
            config = self.config
            # An error on the way closes what is open by then: the next call connects again.
            with contextlib.ExitStack() as opening:
                client = opening.enter_context(
                    connect(config.server, name="wildcity-gym", timeout=config.timeout, token=config.token)
                )
                session = opening.enter_context(client.open(**config.open_options(client.welcome)))
                task = task_of(config, session.opened)
                self._open = opening.pop_all()
            self._session, self._task, self._version = session, task, session.opened.version
        return self._session, self._task
