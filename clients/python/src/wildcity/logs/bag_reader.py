"""Reads messages of ROS 1 bags, rosbag2 folders and MCAP files with the package rosbags, one after the other.

Stamps are nanoseconds. Where a message begins with std_msgs/Header, its stamp is read without decoding the message.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.rosbag1 import ReaderError as Error1
from rosbags.rosbag2 import ReaderError as Error2
from rosbags.typesys import Stores, get_typestore

from .errors import LogError

__all__ = ["Bag", "Message"]

_BROKEN = "give a bag of ROS (MCAP: profile ros2), or repair it: `ros2 bag reindex`, `rosbag reindex`, `mcap recover`"


@dataclass
class Message:
    """A message as it was recorded. kind: its type as `package/msg/Name`. data: the serialized message."""

    topic: str
    kind: str
    data: bytes
    decode: Callable[[], Any]
    is2: bool

    def stamp_ns(self) -> int:
        """The stamp of the header with which the message begins.

        CDR (ROS 2): four bytes, of which the second names the byte order, then i32 seconds and u32 nanoseconds. ROS 1:
        u32 number, u32 seconds, u32 nanoseconds.
        """
        if not self.is2:
            _, seconds, nanoseconds = struct.unpack_from("<III", self.data)
            return int(seconds * 1_000_000_000 + nanoseconds)
        order = "<" if self.data[1] & 1 else ">"
        seconds, nanoseconds = struct.unpack_from(f"{order}iI", self.data, 4)
        return int(seconds * 1_000_000_000 + nanoseconds)

    def after_stamp(self) -> bytes:
        """What follows the stamp: equal for two messages that differ in their stamps only."""
        return self.data[12:]


class Bag:
    """An open bag."""

    def __init__(self, path: Path) -> None:
        self.path = path
        store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE)
        try:
            self._reader = AnyReader([path], default_typestore=store)
            self._reader.open()
        except (AnyReaderError, Error1, Error2, OSError, ValueError, AssertionError, struct.error) as error:
            raise LogError(path, f"cannot open the bag: {error}", _BROKEN) from None

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._reader.close()

    @property
    def count(self) -> int:
        """Messages in all."""
        return self._reader.message_count

    def topics(self) -> dict[str, tuple[str, int]]:
        """Type and number of messages of each topic."""
        found: dict[str, tuple[str, int]] = {}
        for topic, info in sorted(self._reader.topics.items()):
            if info.msgtype is None:
                problem = f"topic {topic} has messages of several types"
                raise LogError(self.path, problem, "record one type for each topic")
            found[topic] = (info.msgtype, info.msgcount)
        return found

    def messages(self, topics: set[str]) -> Iterator[Message]:
        """Messages of topics, in the order in which they were recorded."""
        wanted = [one for one in self._reader.connections if one.topic in topics]
        if not wanted:
            return
        try:
            for connection, _, data in self._reader.messages(wanted):
                yield self._message(connection, data)
        except (AnyReaderError, Error1, Error2, OSError, ValueError, AssertionError, struct.error, EOFError) as error:
            raise LogError(self.path, f"cannot read the bag to its end: {error}", _BROKEN) from None

    def _message(self, connection: Connection, data: bytes) -> Message:
        def decode() -> Any:
            try:
                return self._reader.deserialize(data, connection.msgtype)
            except (AnyReaderError, KeyError, ValueError, AssertionError, struct.error, IndexError) as error:
                place = f"{self.path}, topic {connection.topic}"
                raise LogError(place, f"a message cannot be decoded: {error!r}", _BROKEN) from None

        return Message(connection.topic, connection.msgtype, bytes(data), decode, self._reader.is2)
