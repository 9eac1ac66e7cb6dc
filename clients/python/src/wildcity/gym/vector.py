"""N sessions of one server as a vector environment: one thread, no processes, no copies between processes."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ..aio import Client, Session, connect
from .env import checked
from .task import DriveConfig, Seen, Task, task_of

T = TypeVar("T")


class DriveVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """N environments as `DriveEnv`. All steps are sent before the first answer is awaited.

    An environment whose episode has ended starts a new one with the next step, which ignores its action
    (`AutoresetMode.NEXT_STEP`). `reset` has the options of `DriveEnv`, and `reset_mask`, which selects environments.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, num_envs: int = 1, render_mode: str | None = None, **arguments: Any) -> None:
        self.config = checked(DriveConfig(**arguments))
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_observation_space = self.config.observation_space()
        self.single_action_space = self.config.action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._numbers = [np.random.default_rng() for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, np.bool_)
        self._lanes: list[_Lane] = []
        self._seen: list[Seen] = []
        self._loop = asyncio.new_event_loop()
        # A thread of its own, because the caller's may already run a loop, as in a notebook.
        self._thread = threading.Thread(target=self._loop.run_forever, name="wildcity-gym", daemon=True)
        self._thread.start()

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Seen, dict[str, Any]]:
        """Starts an episode in every environment. With a number as seed, environment k has the seed `seed + k`."""
        seeds = seed if isinstance(seed, list) else [None if seed is None else seed + k for k in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments")
        given = dict(options or {})
        mask = np.asarray(given.pop("reset_mask", np.ones(self.num_envs, np.bool_)), np.bool_)
        for index, one in enumerate(seeds):
            if one is not None and mask[index]:
                self._numbers[index] = np.random.default_rng(one)
        lanes = self._opened()
        chosen = [index for index in range(self.num_envs) if mask[index]]
        started = self._wait(_gather([lanes[index].begin(self._numbers[index], given) for index in chosen]))
        infos: dict[str, Any] = {}
        if not self._seen:
            if not mask.all():
                raise ValueError("the first reset is of all environments")
            self._seen = [{} for _ in range(self.num_envs)]
        for index, (seen, info) in zip(chosen, started, strict=True):
            self._seen[index] = seen
            infos = self._add_info(infos, info, index)
        self._ended[mask] = False
        return self._batch(), infos

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Seen, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Applies an action in every environment, [num_envs, 2]."""
        lanes = self._opened()
        results = self._wait(
            _gather(
                [
                    lane.restart(self._numbers[index]) if self._ended[index] else lane.step(actions[index])
                    for index, lane in enumerate(lanes)
                ]
            )
        )
        rewards = np.zeros(self.num_envs)
        terminated = np.zeros(self.num_envs, np.bool_)
        truncated = np.zeros(self.num_envs, np.bool_)
        infos: dict[str, Any] = {}
        for index, result in enumerate(results):
            self._seen[index], rewards[index], terminated[index], truncated[index], info = result
            infos = self._add_info(infos, info, index)
        self._ended = terminated | truncated
        return self._batch(), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """The images of each environment side by side."""
        if self.render_mode is None or not self._seen:
            return None
        keys = [key for key in self._seen[0] if key.startswith("image_")]
        return tuple(np.concatenate([seen[key] for key in keys], axis=1) for seen in self._seen)

    def close_extras(self, **_: Any) -> None:
        """Ends all sessions and connections, and the thread."""
        if self._loop.is_closed():
            return
        self._wait(_gather([lane.close() for lane in self._lanes]))
        self._lanes = []
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _opened(self) -> list[_Lane]:
        if not self._lanes:
            self._lanes = self._wait(_open_all(self.config, self.num_envs))
        return self._lanes

    def _batch(self) -> Seen:
        return {key: np.stack([seen[key] for seen in self._seen]) for key in self._seen[0]}

    def _wait(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()


class _Lane:
    """One session and its task."""

    def __init__(self, client: Client, session: Session, task: Task) -> None:
        self._client = client
        self._session = session
        self._task = task
        self._version = session.opened.version

    async def begin(
        self, numbers: np.random.Generator, options: dict[str, Any] | None = None
    ) -> tuple[Seen, dict[str, Any]]:
        version = (options or {}).get("version")
        if version is not None and version != self._version:
            self._version = (await self._session.switch_version(version)).version
        start = self._task.start(numbers, options)
        return self._task.begin(await self._session.reset(int(numbers.integers(1 << 32)), start))

    async def restart(self, numbers: np.random.Generator) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        seen, info = await self.begin(numbers)
        return seen, 0.0, False, False, info

    async def step(self, action: Any) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        return self._task.advance(await self._session.step(self._task.movement(action)))

    async def close(self) -> None:
        async with self._client, self._session:
            pass


async def _open_all(config: DriveConfig, count: int) -> list[_Lane]:
    # An error on the way closes what is open by then: the next call connects again.
    async with contextlib.AsyncExitStack() as opening:

        async def enter(work: Coroutine[Any, Any, contextlib.AbstractAsyncContextManager[T]]) -> T:
            return await opening.enter_async_context(await work)

        connecting = [
            connect(config.server, name="wildcity-gym", timeout=config.timeout, token=config.token)
            for _ in range(count)
        ]
        clients = await _gather([enter(one) for one in connecting])
        options = config.open_options(clients[0].welcome)
        sessions = await _gather([enter(client.open(**options)) for client in clients])
        lanes = [
            _Lane(client, session, task_of(config, session.opened))
            for client, session in zip(clients, sessions, strict=True)
        ]
        opening.pop_all()
    return lanes


async def _gather(work: list[Coroutine[Any, Any, T]]) -> list[T]:
    """The results of all awaitables. Raises the first error after all have ended, so that no call is under way then."""
    tasks = [asyncio.ensure_future(one) for one in work]
    await asyncio.gather(*tasks, return_exceptions=True)
    return [task.result() for task in tasks]
