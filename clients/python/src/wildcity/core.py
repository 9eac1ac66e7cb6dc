"""The conversation without the wire: numbers requests and matches answers.

Each method of `Conversation` is a generator that yields the text of one request, is sent the message that came back,
and returns the answer. `sync` and `aio` only move messages.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Generator, Mapping, Sequence
from importlib.metadata import version
from typing import Any, TypeVar

from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol

from .errors import Disconnected, ProtocolError, Refused, TimedOut, WildCityError
from .observation import Observation
from .protocol import (
    OBSERVATION_BYTES,
    PROTOCOL,
    Action,
    Closed,
    Dynamics,
    Model,
    Ok,
    Opened,
    Outputs,
    Pose,
    Refusal,
    Resumed,
    Rig,
    Station,
    Summary,
    Switched,
    Trajectory,
    Welcome,
    decode_answer,
    encode,
)

T = TypeVar("T")
Message = str | bytes
Exchange = Generator[str, Message, T]


class Conversation:
    """One client's side. A number is used up only when its answer came and was no error."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.next_seq = 1
        self.session: str | None = None
        """Name of the open session."""

    def hello(self) -> Exchange[Welcome]:
        """Begins a connection."""
        client = {"name": self.name, "version": version("wildcity")}
        fields = {"client": client, "protocols": [PROTOCOL]}
        welcome = yield from self._ask("hello", 0, Welcome, fields)
        if welcome.protocol != PROTOCOL:
            raise ProtocolError(f"the server chose protocol {welcome.protocol!r}")
        if self.session is None:
            self.next_seq = 1
        return welcome

    def open(
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
    ) -> Exchange[Opened]:
        """Opens a session."""
        optional = {
            "version": version,
            "session": session,
            "start": _start(start),
            "rig": encode(rig),
            "dynamics": encode(dynamics),
            "profile": None if profile is None else dict(profile),
            "dt_us": dt_us,
            "deadline_ms": deadline_ms,
            "decision_us": decision_us,
            "warm_up_us": warm_up_us,
        }
        fields = {name: value for name, value in optional.items() if value is not None}
        fields |= {"twin": twin, "seed": seed, "outputs": encode(outputs or Outputs())}
        opened = yield from self._next("open", Opened, fields)
        self.session = opened.session
        return opened

    def step(self, movement: Pose | Trajectory | Action, terminate: bool) -> Exchange[Observation]:
        """Moves."""
        fields = {**_movement(movement), "terminate": terminate}
        return (yield from self._next("step", Observation, fields))

    def observe(self, poses: Sequence[Pose]) -> Exchange[Observation]:
        """Looks."""
        return (yield from self._next("observe", Observation, {"poses": encode(poses)}))

    def prefetch(self, poses: Sequence[Pose]) -> Exchange[None]:
        """Says where it may go."""
        yield from self._next("prefetch", Ok, {"poses": encode(poses)})

    def reset(self, seed: int, start: Pose | Station | None) -> Exchange[Observation]:
        """Begins an episode."""
        fields: dict[str, Any] = {"seed": seed}
        if start is not None:
            fields["start"] = _start(start)
        return (yield from self._next("reset", Observation, fields))

    def switch_version(self, version: int | None) -> Exchange[Switched]:
        """Sees another version."""
        fields = {} if version is None else {"version": version}
        return (yield from self._next("switch_version", Switched, fields))

    def close(self) -> Exchange[Summary]:
        """Ends the session."""
        closed = yield from self._next("close", Closed, {})
        self.session = None
        return closed.summary

    def resume(self, session: str, last_seq: int) -> Exchange[Resumed]:
        """Continues a session on a new connection, where hello was 0 and this is 1."""
        fields = {"session": session, "last_seq": last_seq}
        try:
            resumed = yield from self._ask("resume", 1, Resumed, fields)
        except Refused as refused:
            if refused.code == "unknown_session":
                # Gone for good; a new one can be opened here, with the number of this try.
                self.session, self.next_seq = None, 1
            raise
        # One request at a time: the session is where the client is, or one answer ahead.
        if resumed.last_seq not in (last_seq, last_seq + 1):
            raise ProtocolError(f"the session is at {resumed.last_seq}, not at {last_seq}")
        self.session, self.next_seq = session, last_seq + 1
        return resumed

    def resume_own(self) -> Exchange[Resumed]:
        """As `resume`, for the session that was open here."""
        if self.session is None:
            raise ProtocolError("no session is open to resume")
        return (yield from self.resume(self.session, self.next_seq - 1))

    def _next(self, kind: str, answer: type[T], fields: dict[str, Any]) -> Exchange[T]:
        result = yield from self._ask(kind, self.next_seq, answer, fields)
        self.next_seq += 1
        return result

    def _ask(self, kind: str, seq: int, answer: type[T], fields: dict[str, Any]) -> Exchange[T]:
        # ValueError for NaN and infinity, which JSON cannot say.
        request = json.dumps({"type": kind, "seq": seq, **fields}, allow_nan=False)
        message = yield request
        got = Observation(message) if isinstance(message, bytes) else decode_answer(message)
        got_seq = got.metadata.seq if isinstance(got, Observation) else got.seq
        # A request that could not be read has no number to answer with.
        if got_seq != seq and not (isinstance(got, Refusal) and got_seq is None):
            raise ProtocolError(f"expected an answer to request {seq}, got one to {got_seq}")
        if isinstance(got, Refusal):
            raise Refused(got.code, got.message, got.field, got.fatal)
        if not isinstance(got, answer):
            raise ProtocolError(f"{kind} was answered with {type(got).__name__}")
        return got


DIAL: dict[str, Any] = {
    "subprotocols": [Subprotocol(PROTOCOL)],
    "compression": None,
    "max_size": OBSERVATION_BYTES,
    "open_timeout": 10,
    "close_timeout": 1,
    # Lock step: the answer's time-out says enough about the other side.
    "ping_interval": None,
    "proxy": None,
}
"""How both clients connect."""


def headers(token: str | None) -> dict[str, str]:
    """What a client sends with its upgrade."""
    return {} if token is None else {"Authorization": f"Bearer {token}"}


def keeps_connection(error: BaseException) -> bool:
    """Whether the next request may use the connection on which this one failed."""
    return isinstance(error, Refused) and not error.fatal


def translated(error: BaseException, timeout: float) -> WildCityError | None:
    """What the transport raised, as an error of this package; None if it is another's."""
    # Before 3.11 asyncio has a time-out of its own.
    if isinstance(error, (TimeoutError, asyncio.TimeoutError)):
        return TimedOut(f"no answer within {timeout} s")
    if isinstance(error, (ConnectionClosed, OSError)):
        return Disconnected(str(error))
    return None


def _movement(movement: Pose | Trajectory | Action) -> dict[str, Any]:
    if isinstance(movement, Trajectory):
        return {"trajectory": encode(movement.poses)}
    return {"action" if isinstance(movement, Action) else "pose": encode(movement)}


def _start(start: Pose | Station | None) -> Any:
    return {"pose": encode(start)} if isinstance(start, Pose) else encode(start)
