"""The client's side of the protocol without the connection: it numbers requests and matches answers to them.

Each method of `SessionProtocol` is a generator. It yields the text of one request, receives the answering message
through `send`, and returns the decoded answer. `sync` and `aio` only transfer the messages. Answers in shared memory
are read here.
"""

from __future__ import annotations

import asyncio
import json
import warnings
from collections.abc import Generator, Mapping, Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, TypeVar

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Subprotocol

from .errors import ConnectFailed, Disconnected, ProtocolError, Refused, TimedOut, WildCityError
from .messages import (
    Action,
    Closed,
    Dynamics,
    InMemory,
    Model,
    Ok,
    Opened,
    OpenOptions,
    Outputs,
    RandomStart,
    RecordedPoint,
    Refusal,
    Repair,
    Resumed,
    SharedMemoryOffer,
    SnapshotPoint,
    Station,
    Summary,
    Switched,
    Welcome,
)
from .observation import Many, Observation
from .pose import Pose
from .protocol import OBSERVATION_BYTES, PROTOCOL, Step, Trajectory, decode_answer, encode, to_json
from .shared_memory import SharedMemory

if TYPE_CHECKING:
    from typing_extensions import Unpack

T = TypeVar("T")
Message = str | bytes
Exchange = Generator[str, Message, T]


class SessionProtocol:
    """State of one client. A request consumes its number only if its answer arrives and is not an error."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.first_seq = 1
        """Number of the next request of a connection without a session."""
        self.next_seq = 1
        self.sessions: list[str] = []
        """Names of the open sessions."""
        self.memory: SharedMemory | None = None
        """Where observations are, if not in messages."""

    def hello(self) -> Exchange[Welcome]:
        """Starts a connection."""
        self.memory = None
        client = {"name": self.name, "version": version("wildcity")}
        fields = {"client": client, "protocols": [PROTOCOL]}
        welcome = yield from self._ask("hello", 0, Welcome, fields)
        if welcome.protocol != PROTOCOL:
            raise ProtocolError(f"the server chose protocol {welcome.protocol!r}")
        self._begin(1)
        return welcome

    def ask_for_memory(self) -> Exchange[SharedMemoryOffer]:
        """Asks for observations in shared memory, directly after `hello`."""
        offer = yield from self._ask("share_memory", self.first_seq, SharedMemoryOffer, {})
        self._begin(self.first_seq + 1)
        return offer

    def use_memory(self, memory: SharedMemory) -> Exchange[None]:
        """Proves that the memory was opened: observations are then delivered in it."""
        yield from self._ask("share_memory", self.first_seq, Ok, {"proof": memory.proof})
        self._begin(self.first_seq + 1)
        self.memory = memory

    def open(self, twin: str, **options: Unpack[OpenOptions]) -> Exchange[Opened]:
        """Opens a session."""
        unknown = options.keys() - OpenOptions.__annotations__.keys()
        if unknown:
            raise TypeError(f"open() got an unexpected keyword argument {min(unknown)!r}")
        given = {name: value for name, value in options.items() if value is not None}
        repair = given.get("repair")
        if isinstance(repair, str):
            given["repair"] = Repair(repair)
        if "start" in given:
            given["start"] = _start(options["start"])
        fields = {"twin": twin, "seed": 0, "outputs": encode(Outputs()), **encode(given)}
        opened = yield from self._next("open", Opened, fields)
        self._add(opened.session)
        return opened

    def step(
        self,
        movement: Pose | Trajectory | Action,
        terminate: bool,
        until_us: int | None = None,
        notes: Any = None,
        *,
        on: str | None = None,
    ) -> Exchange[Observation]:
        """Moves the ego and advances the time by one step, or by several along a plan.

        Here and below, `on` is the session, which the request names if there are several.
        """
        fields = {**self._named(on), **_step(Step(movement, until_us, notes, terminate))}
        return (yield from self._next("step", Observation, fields))

    def step_many(
        self, steps: Mapping[str, Pose | Trajectory | Action | Step]
    ) -> Exchange[dict[str, Observation | Refused]]:
        """Steps several sessions."""
        entries = [
            {"session": name, **_step(step if isinstance(step, Step) else Step(step))} for name, step in steps.items()
        ]
        many = yield from self._next("step_many", Many, {"steps": entries})
        return many.results

    def observe(self, poses: Sequence[Pose], *, on: str | None = None) -> Exchange[Observation]:
        """Renders images from poses without moving."""
        fields = {**self._named(on), "poses": encode(poses)}
        return (yield from self._next("observe", Observation, fields))

    def prefetch(self, poses: Sequence[Pose], *, on: str | None = None) -> Exchange[None]:
        """Announces where the ego may go next."""
        yield from self._next("prefetch", Ok, {**self._named(on), "poses": encode(poses)})

    def reset(
        self,
        seed: int,
        start: Pose | Station | RandomStart | None,
        dynamics: Model | Dynamics | None = None,
        speed: float | None = None,
        *,
        on: str | None = None,
    ) -> Exchange[Observation]:
        """Starts a new episode."""
        optional = {"start": _start(start), "dynamics": encode(dynamics), "speed": speed}
        fields: dict[str, Any] = {**self._named(on), "seed": seed}
        fields |= {name: value for name, value in optional.items() if value is not None}
        return (yield from self._next("reset", Observation, fields))

    def branch(self, point: SnapshotPoint | RecordedPoint, session: str | None) -> Exchange[Opened]:
        """Opens a session in a state of another episode."""
        fields = {"from": encode(point)}
        if session is not None:
            fields["session"] = session
        opened = yield from self._next("branch", Opened, fields)
        self._add(opened.session)
        return opened

    def snapshot(self, name: str, *, on: str | None = None) -> Exchange[None]:
        """Stores the state of the episode under a name."""
        yield from self._next("snapshot", Ok, {**self._named(on), "name": name})

    def restore(self, name: str, *, on: str | None = None) -> Exchange[Observation]:
        """Returns to a snapshot."""
        return (yield from self._next("restore", Observation, {**self._named(on), "name": name}))

    def switch_version(self, version: int | None, *, on: str | None = None) -> Exchange[Switched]:
        """Shows another version of the twin."""
        fields: dict[str, Any] = {} if version is None else {"version": version}
        return (yield from self._next("switch_version", Switched, {**self._named(on), **fields}))

    def close(self, *, on: str | None = None) -> Exchange[Summary]:
        """Ends the session."""
        closed = yield from self._next("close", Closed, self._named(on))
        self.sessions = [name for name in self.sessions if len(self.sessions) > 1 and name != on]
        return closed.summary

    def resume(self, session: str, last_seq: int, also: Sequence[str] = ()) -> Exchange[Resumed]:
        """Resumes sessions on a new connection. Must be the first request after `hello` (and `share_memory`)."""
        fields: dict[str, Any] = {"session": session, "last_seq": last_seq}
        if also:
            fields["also"] = list(also)
        try:
            resumed = yield from self._ask("resume", self.first_seq, Resumed, fields)
        except Refused as refused:
            if refused.code == "unknown_session":
                # A session is over. A new one can be opened on this connection, and its request takes
                # the number of this refused one.
                self.sessions = []
                self.next_seq = self.first_seq
            raise
        # One request is under way at a time, so the session has carried out either request `last_seq` or
        # the one after it.
        if resumed.last_seq not in (last_seq, last_seq + 1):
            raise ProtocolError(f"the session is at {resumed.last_seq}, not at {last_seq}")
        self.sessions = [session, *also]
        self.next_seq = last_seq + 1
        return resumed

    def resume_own(self) -> Exchange[Resumed]:
        """As `resume`, for the sessions that this client opened."""
        if not self.sessions:
            raise ProtocolError("this client has no open session to resume")
        first, *also = self.sessions
        return (yield from self.resume(first, self.next_seq - 1, also))

    def _begin(self, first_seq: int) -> None:
        self.first_seq = first_seq
        if not self.sessions:
            self.next_seq = first_seq

    def _add(self, session: str) -> None:
        if session not in self.sessions:
            self.sessions.append(session)

    def _named(self, on: str | None) -> dict[str, Any]:
        return {"session": on} if on is not None and len(self.sessions) > 1 else {}

    def _next(self, kind: str, answer: type[T], fields: dict[str, Any]) -> Exchange[T]:
        result = yield from self._ask(kind, self.next_seq, answer, fields)
        self.next_seq += 1
        return result

    def _ask(self, kind: str, seq: int, answer: type[T], fields: dict[str, Any]) -> Exchange[T]:
        request = to_json({"type": kind, "seq": seq, **fields})
        if self.memory is not None and answer in (Observation, Many):
            self.memory.check_next_slot()
        message = yield request
        got = self._decode(message, answer)
        got_seq = got.metadata.seq if isinstance(got, Observation) else got.seq
        # An error has no number if the server could not read the request.
        if got_seq != seq and not (isinstance(got, Refusal) and got_seq is None):
            raise ProtocolError(f"expected an answer to request {seq}, got one to {got_seq}")
        if isinstance(got, Refusal):
            raise Refused(got.code, got.message, got.field, got.fatal)
        if not isinstance(got, answer):
            raise ProtocolError(f"{kind} was answered with {type(got).__name__}")
        return got

    def _decode(self, message: Message, answer: type[Any]) -> Any:
        """The answer in a message, or in the shared memory. `answer` is what is expected."""
        if isinstance(message, bytes):
            if self.memory is not None:
                warnings.warn(
                    "the server had no room in shared memory: an observation came over the socket",
                    RuntimeWarning,
                    stacklevel=2,
                )
            return Many(message) if answer is Many else Observation(message)
        got = decode_answer(message)
        if not isinstance(got, InMemory):
            return got
        if self.memory is None:
            raise ProtocolError("the server uses shared memory, which was not asked for")
        frame = self.memory.read(got)
        read = Many(frame) if answer is Many else Observation(frame)
        seq = read.seq if isinstance(read, Many) else read.metadata.seq
        if seq != got.seq:
            raise ProtocolError(f"the shared memory has the answer to request {seq}, not to {got.seq}")
        return read


CONNECT_OPTIONS: dict[str, Any] = {
    "subprotocols": [Subprotocol(PROTOCOL)],
    "compression": None,
    "max_size": OBSERVATION_BYTES,
    "open_timeout": 10,
    "close_timeout": 1,
    # The time-out of each answer already detects a dead server.
    "ping_interval": None,
    "proxy": None,
}
"""Options with which both clients connect."""


def connect_failed(url: str, error: Exception) -> ConnectFailed:
    """The reason why there is no connection."""
    reason = refusal_of(error) if isinstance(error, InvalidStatus) else None
    return ConnectFailed(f"cannot connect to {url}: {reason or error}")


def refusal_of(error: InvalidStatus) -> str | None:
    """The code and the message with which the server refused the upgrade to WebSocket, if it gave some."""
    try:
        refusal = json.loads(error.response.body or b"")
        return f"{refusal['code']}: {refusal['message']}"
    except (ValueError, KeyError, TypeError):
        return None


def can_reuse_connection(error: BaseException) -> bool:
    """Whether the next request may use the connection on which a request failed with `error`."""
    return isinstance(error, Refused) and not error.fatal


def translate_error(error: BaseException, timeout: float) -> WildCityError | None:
    """An error of the transport as an error of this package; None if it is not one of the transport."""
    # Before Python 3.11 asyncio.TimeoutError is another class.
    if isinstance(error, (TimeoutError, asyncio.TimeoutError)):
        return TimedOut(f"no answer within {timeout} s")
    if isinstance(error, (ConnectionClosed, OSError)):
        return Disconnected(str(error))
    return None


def _movement(movement: Pose | Trajectory | Action) -> dict[str, Any]:
    if isinstance(movement, Trajectory):
        return {"trajectory": encode(movement.poses)}
    return {"action" if isinstance(movement, Action) else "pose": encode(movement)}


def _step(step: Step) -> dict[str, Any]:
    optional = {"until_us": step.until_us, "notes": step.notes}
    fields = {**_movement(step.movement), "terminate": step.terminate}
    return fields | {name: value for name, value in optional.items() if value is not None}


def _start(start: Pose | Station | RandomStart | None) -> Any:
    if isinstance(start, RandomStart):
        return {"random": encode(start)}
    return {"pose": encode(start)} if isinstance(start, Pose) else encode(start)
