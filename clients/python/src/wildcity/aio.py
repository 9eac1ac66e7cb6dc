"""The client for asyncio: as `wildcity.sync`, with `await`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TypeVar

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as dial
from websockets.exceptions import WebSocketException

from .core import DIAL, Conversation, Exchange, Message, headers, keeps_connection, translated
from .errors import ConnectFailed, Disconnected, WildCityError
from .observation import Observation
from .protocol import (
    PROTOCOL,
    Action,
    Dynamics,
    Model,
    Opened,
    Outputs,
    Pose,
    Resumed,
    Rig,
    Station,
    Summary,
    Switched,
    Trajectory,
    Welcome,
)

T = TypeVar("T")


async def connect(
    url: str,
    *,
    name: str = "wildcity-python",
    timeout: float = 90.0,
    token: str | None = None,
) -> Client:
    """Connects to `ws://host:port/v1/session` and says hello.

    `timeout` is how long an answer may take, in seconds; the server's own limits are shorter.
    `token` is for a server that has tokens.
    """
    client = Client(url, name=name, timeout=timeout, token=token)
    await client._connect()
    return client


class Client:
    """A connection to a server. Use `connect`, and close it or use it in an `async with` block."""

    welcome: Welcome
    """What the server said to hello: its limits, its twins."""

    def __init__(self, url: str, *, name: str, timeout: float, token: str | None) -> None:
        self.url, self.timeout = url, timeout
        self._headers = headers(token)
        self._conversation = Conversation(name)
        self._connection: ClientConnection | None = None

    async def open(
        self,
        twin: str,
        *,
        version: int | None = None,
        session: str | None = None,
        seed: int = 0,
        start: Pose | Station | None = None,
        rig: str | Rig | None = None,
        profile: Mapping[str, float | bool | None] | None = None,
        outputs: Outputs | None = None,
        dynamics: Model | Dynamics | None = None,
        dt_us: int | None = None,
        deadline_ms: int | None = None,
        decision_us: int | None = None,
        warm_up_us: int | None = None,
    ) -> Session:
        """Opens a session on a twin; what is left out is the server's or the twin's default."""
        opened = await self._run(
            self._conversation.open(
                twin,
                version=version,
                session=session,
                seed=seed,
                start=start,
                rig=rig,
                profile=profile,
                outputs=outputs,
                dynamics=dynamics,
                dt_us=dt_us,
                deadline_ms=deadline_ms,
                decision_us=decision_us,
                warm_up_us=warm_up_us,
            )
        )
        return Session(self, opened)

    async def resume(self, session: str, last_seq: int) -> Session:
        """Continues a session that another client opened and lost; see `wildcity.sync`."""
        await self._run(self._conversation.resume(session, last_seq))
        return Session(self, None)

    async def close(self) -> None:
        """Closes the connection; an open session can be resumed for a while."""
        connection, self._connection = self._connection, None
        if connection is not None:
            await connection.close()

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def _connect(self) -> None:
        await self.close()
        try:
            connection = await dial(self.url, additional_headers=self._headers, **DIAL)
        except (OSError, ValueError, WebSocketException) as error:
            raise ConnectFailed(f"cannot connect to {self.url}: {error}") from error
        self._connection = connection
        if connection.subprotocol != PROTOCOL:
            await self.close()
            raise ConnectFailed(f"{self.url} does not speak {PROTOCOL}")
        self.welcome = await self._run(self._conversation.hello())

    async def _reconnect(self) -> Resumed:
        await self._connect()
        return await self._run(self._conversation.resume_own())

    async def _run(self, exchange: Exchange[T]) -> T:
        # ValueError here, before anything is sent, changes nothing.
        request = next(exchange)
        # Taken away while a call runs: a second one at the same time is a mistake, not a queue.
        connection, self._connection = self._connection, None
        if connection is None:
            raise Disconnected("there is no connection, or a call is under way on it")
        keep = False
        try:
            exchange.send(await asyncio.wait_for(_answer(connection, request), self.timeout))
        except StopIteration as done:
            keep = True
            result: T = done.value
            return result
        except BaseException as error:
            keep = keeps_connection(error)
            failure = translated(error, self.timeout)
            if failure is None:
                raise
            raise failure from error
        finally:
            if keep:
                self._connection = connection
            else:
                # No closing handshake: this may be a cancellation, which must not wait.
                connection.transport.abort()
        raise AssertionError("an exchange is one message each way")


async def _answer(connection: ClientConnection, request: str) -> Message:
    await connection.send(request)
    return await connection.recv()


class Session:
    """An open session. Closed at the end of an `async with` block, if its connection stands."""

    def __init__(self, client: Client, opened: Opened | None) -> None:
        self._client = client
        self._conversation = client._conversation
        self._opened = opened

    @property
    def opened(self) -> Opened:
        """What the server resolved: cameras, start, hashes. Not known after `Client.resume`."""
        if self._opened is None:
            raise WildCityError("this session was opened by another client")
        return self._opened

    async def step(
        self, movement: Pose | Trajectory | Action, *, terminate: bool = False
    ) -> Observation:
        """Moves the ego; `terminate` ends the episode with it.

        To its next `world_from_rig`, if it teleports; by an action, if it is a car; along a trajectory in either case.
        """
        return await self._client._run(self._conversation.step(movement, terminate))

    async def observe(self, poses: Sequence[Pose]) -> Observation:
        """What would be seen from poses, without moving: one view for each."""
        return await self._client._run(self._conversation.observe(poses))

    async def prefetch(self, poses: Sequence[Pose]) -> None:
        """Has loaded what is seen from poses, in the order of the way. Does not wait for it."""
        return await self._client._run(self._conversation.prefetch(poses))

    async def reset(self, seed: int = 0, start: Pose | Station | None = None) -> Observation:
        """Starts a new episode, at the session's start if none is given."""
        return await self._client._run(self._conversation.reset(seed, start))

    async def switch_version(self, version: int | None = None) -> Switched:
        """Sees another version of the twin from the next step on, or the latest; the episode goes on."""
        return await self._client._run(self._conversation.switch_version(version))

    async def close(self) -> Summary:
        """Ends the session; another can be opened on the same client."""
        return await self._client._run(self._conversation.close())

    async def resume(self) -> Resumed:
        """Connects again after `Disconnected` or `TimedOut`, and continues the session.

        Then repeat the call that failed: it keeps its number, so it is carried out once, and if it
        was carried out already its answer comes again.
        """
        return await self._client._reconnect()

    async def __aenter__(self) -> Session:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._client._connection is None or self._conversation.session is None:
            return
        try:
            await self.close()
        except WildCityError:
            # The error that ended the block says more than the one that followed it.
            if error is None:
                raise
