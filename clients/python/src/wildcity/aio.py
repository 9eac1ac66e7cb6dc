"""The client for asyncio.

The blocking client is this file without `await`: clients/generate.py writes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

from .address import session_url
from .authorization import authorization_headers
from .errors import ConnectFailed, Disconnected, Refused, WildCityError
from .messages import (
    Action,
    Dynamics,
    Model,
    Opened,
    RandomStart,
    RecordedPoint,
    Resumed,
    SnapshotPoint,
    Station,
    Summary,
    Switched,
    Welcome,
)
from .observation import Observation
from .pose import Pose
from .protocol import PROTOCOL, Step, Trajectory
from .session_protocol import Exchange, SessionProtocol, can_reuse_connection, translate_error
from .shared_memory import SharedMemory
from .transport import AsyncTransport

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from .messages import OpenOptions

T = TypeVar("T")


async def connect(
    url: str,
    *,
    name: str = "wildcity-python",
    timeout: float = 90.0,
    token: str | None = None,
    shared_memory: bool = False,
    copy: bool = True,
) -> Client:
    """Connects to `ws://HOST:PORT/v1/session` or `wss://HOST/v1/session` and sends `hello`.

    `name` appears in the server's log. `timeout` is how long an answer may take, in seconds; the server's own
    limits are shorter. `token` is for a server that was started with tokens; the default is `$WILDCITY_TOKEN`.

    With `shared_memory`, observations come in memory that the server shares, in place of the socket. The server must
    run on this machine, in the same container and as the same user. With `copy=False` the arrays of an observation are
    views of that memory: at most two observations can be kept in addition to the requested one, and while arrays of an
    older one exist, calls raise `SlotInUse`.

    Raises `ConnectFailed`, `ProtocolError` if the server speaks another protocol, or `Refused` with the code
    `shared_memory_unavailable`.
    """
    client = Client(url, name=name, timeout=timeout, token=token, shared_memory=shared_memory, copy=copy)
    await client._connect()
    return client


class Client:
    """A connection to a server. Use `connect`, and close it or use it in an `async with` block."""

    welcome: Welcome
    """The server's answer to `hello`: its limits and its twins."""

    def __init__(
        self, url: str, *, name: str, timeout: float, token: str | None, shared_memory: bool = False, copy: bool = True
    ) -> None:
        self.url = session_url(url)
        self.timeout = timeout
        self._shared_memory = shared_memory
        self._copy = copy
        self._headers = authorization_headers(token)
        self._protocol = SessionProtocol(name)
        self._connection: AsyncTransport | None = None

    def __repr__(self) -> str:
        if self._connection is None:
            return f"<Client of {self.url}: closed>"
        return f"<Client of {self.url}: twins {', '.join(twin.name for twin in self.welcome.twins) or 'none'}>"

    async def open(self, twin: str, **options: Unpack[OpenOptions]) -> Session:
        """Opens a session on a twin. Arguments that are None have the default of the server or of the twin.

        A connection can have 64 sessions; while one is open, the next needs a name, `session`.

        `scenario` is the name of one of the server's, `{"name": .., "values": {..}}`, or the scenario itself.
        `repair` is the name of a model of the server's that repairs images, or a `Repair`. `sensors` has effects of
        cameras and other sensors: lost frames, noise and the like. `contact` says what contact with the twin does:
        "end" the episode, "report" it, or "off"; by default the scenario or the dynamics decide.

        Raises `Refused` if the server refuses.
        """
        opened = await self._run(self._protocol.open(twin, **options))
        return Session(self, opened.session, opened)

    async def branch(self, point: SnapshotPoint | RecordedPoint, *, session: str | None = None) -> Session:
        """Opens a session in a state of another episode, with that episode's settings.

        The new session has that state as its snapshot `start`: `restore("start")` shows it. Raises `Refused` if
        there is no such state.
        """
        opened = await self._run(self._protocol.branch(point, session))
        return Session(self, opened.session, opened)

    async def resume(self, session: str, last_seq: int) -> Session:
        """Continues a session that another client opened, for example one in a process that ended.

        `last_seq` is the number of the last answer that the other client received (`metadata.seq`). Call it
        directly after connecting.
        """
        resumed = await self._run(self._protocol.resume(session, last_seq))
        return Session(self, session, resumed.opened)

    async def step_many(
        self,
        steps: Mapping[str, Pose | Trajectory | Action | Step],
    ) -> dict[str, Observation | Refused]:
        """Steps several sessions of this connection, 1 to 64, in one message: `steps` has their movements by name.

        Returns, by session name, the observation or the `Refused` of that session's step. A refused step does not stop
        the others. Raises `Refused` if the list itself is refused; then no session was stepped.
        """
        return await self._run(self._protocol.step_many(steps))

    async def close(self) -> None:
        """Closes the connection. An open session can be resumed within `welcome.limits.resume_ms`."""
        connection = self._connection
        self._connection = None
        self._protocol.memory = None
        if connection is not None:
            await connection.close()

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def _connect(self) -> None:
        await self.close()
        self._connection = await AsyncTransport.connect(self.url, self._headers)
        if self._connection.subprotocol != PROTOCOL:
            await self.close()
            raise ConnectFailed(f"{self.url} does not speak {PROTOCOL}")
        self.welcome = await self._run(self._protocol.hello())
        if self._shared_memory:
            await self._share_memory()

    async def _share_memory(self) -> None:
        try:
            offer = await self._run(self._protocol.ask_for_memory())
            await self._run(self._protocol.use_memory(SharedMemory(offer, self._copy)))
        except BaseException:
            await self.close()
            raise

    async def _reconnect(self) -> Resumed:
        await self._connect()
        return await self._run(self._protocol.resume_own())

    async def _run(self, exchange: Exchange[T]) -> T:
        # May raise ValueError. Nothing has been sent or changed then.
        request = next(exchange)
        # `_connection` is None during a call, so a second call at the same time fails.
        connection = self._connection
        self._connection = None
        if connection is None:
            raise Disconnected("there is no connection, or another call is under way on it")
        keep = False
        try:
            exchange.send(await connection.answer(request, self.timeout))
        except StopIteration as done:
            keep = True
            result: T = done.value
            return result
        except BaseException as error:
            keep = can_reuse_connection(error)
            failure = translate_error(error, self.timeout)
            if failure is None:
                raise
            raise failure from error
        finally:
            if keep:
                self._connection = connection
            else:
                connection.give_up()
        raise AssertionError("an exchange is one message in each direction")


class Session:
    """An open session of its client. An `async with` block closes it at its end, if the connection is still open."""

    def __init__(self, client: Client, name: str, opened: Opened | None) -> None:
        self.name = name
        self._client = client
        self._protocol = client._protocol
        self._opened = opened

    def __repr__(self) -> str:
        if self._opened is None:
            return f"<Session {self.name}: resumed>"
        cameras = ", ".join(camera.name for camera in self._opened.cameras)
        return f"<Session {self.name}: twin {self._opened.twin} version {self._opened.version}, cameras {cameras}>"

    @property
    def opened(self) -> Opened:
        """All settings of the session: cameras, start, hashes."""
        if self._opened is None:
            raise WildCityError("the server did not send the settings of the resumed session")
        return self._opened

    async def step(
        self,
        movement: Pose | Trajectory | Action,
        *,
        until_us: int | None = None,
        notes: Any = None,
        terminate: bool = False,
    ) -> Observation:
        """Moves the ego, advances the simulated time by one step, and returns the observation there.

        A `Pose` is the next `world_from_rig` of an ego that teleports, an `Action` moves a car, and a `Trajectory`
        moves both. `until_us` is for how long a trajectory or an action is followed, in whole steps; the observation
        is the one at its end. `notes` is anything that `json` can write, up to 65,536 bytes, and goes into the
        record. `terminate` ends the episode with this step.
        """
        return await self._client._run(self._protocol.step(movement, terminate, until_us, notes, on=self.name))

    async def observe(self, poses: Sequence[Pose]) -> Observation:
        """Renders images from poses without moving the ego: `views[k]` of the observation shows `poses[k]`."""
        return await self._client._run(self._protocol.observe(poses, on=self.name))

    async def prefetch(self, poses: Sequence[Pose]) -> None:
        """Asks the server to load what is visible from poses, in driving order. Does not wait for it."""
        return await self._client._run(self._protocol.prefetch(poses, on=self.name))

    async def reset(
        self,
        seed: int = 0,
        start: Pose | Station | RandomStart | None = None,
        *,
        dynamics: Model | Dynamics | None = None,
        speed: float | None = None,
    ) -> Observation:
        """Starts a new episode at `start`, or at the session's start if it is None.

        `dynamics`, and `speed` (m/s) in place of their speed, apply to this episode only.
        """
        return await self._client._run(self._protocol.reset(seed, start, dynamics, speed, on=self.name))

    async def snapshot(self, name: str) -> None:
        """Stores the state of the episode under a name, in place of an earlier snapshot of that name."""
        return await self._client._run(self._protocol.snapshot(name, on=self.name))

    async def restore(self, name: str) -> Observation:
        """Returns to a snapshot of this session, and returns the observation of that state."""
        return await self._client._run(self._protocol.restore(name, on=self.name))

    async def switch_version(self, version: int | None = None) -> Switched:
        """Shows another version of the twin from the next step on, or the latest. The episode continues."""
        return await self._client._run(self._protocol.switch_version(version, on=self.name))

    async def close(self) -> Summary:
        """Ends the session. Another one can be opened on the same client."""
        return await self._client._run(self._protocol.close(on=self.name))

    async def resume(self) -> Resumed:
        """Connects again after `Disconnected` or `TimedOut`, and continues the session.

        Then repeat the call that failed. It keeps its number, so the server carries it out only once: if it
        already did, it sends the same answer again.
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
        if self._client._connection is None or self.name not in self._protocol.sessions:
            return
        try:
            await self.close()
        except WildCityError:
            # The error that ended the block is more informative than the one of closing.
            if error is None:
                raise
