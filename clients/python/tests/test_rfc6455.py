"""RFC 6455 against the real server, by two WebSocket implementations that are not this project's.

`websockets` is a complete client; `wsproto` (the implementation of Hypercorn) turns events into bytes and back, so that
a test decides about every frame. The cases follow the groups of the Autobahn test suite: 1 framing, 2 pings and pongs,
3 reserved bits, 4 opcodes, 5 fragmentation, 6 UTF-8, 7 close handling, 9 limits.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import websockets.exceptions
from websockets.frames import Frame, Opcode
from websockets.sync.client import ClientConnection, connect
from wsproto import ConnectionType, WSConnection
from wsproto.events import (
    AcceptConnection,
    BytesMessage,
    CloseConnection,
    Ping,
    Pong,
    RejectConnection,
    RejectData,
    Request,
    TextMessage,
)
from wsproto.frame_protocol import CloseReason

HELLO = json.dumps(
    {
        "type": "hello",
        "seq": 0,
        "client": {"name": "rfc6455-λ-路", "version": "1"},
        "protocols": ["wildcity.v1"],
    },
    ensure_ascii=False,
)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server without twins: `hello` is all that these tests ask for."""
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the built wildcity binary"
    folder = tmp_path_factory.mktemp("rfc6455")
    (folder / "twins").mkdir()
    with serving(binary, folder) as (url, process):
        yield url
        assert process.poll() is None, "the server has ended"


@contextlib.contextmanager
def serving(binary: str, folder: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    command = [binary, "serve", "--twins", str(folder / "twins"), "--listen", "127.0.0.1:0"]
    command += ["--episodes", str(folder / "episodes"), "--uploads", str(folder / "uploads")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
        try:
            assert process.stdout is not None
            for line in process.stdout:
                if "ws://" in line:
                    yield line[line.index("ws://") :].split()[0], process
                    break
        finally:
            process.terminate()
            assert process.wait(timeout=20) == 0, "the server did not stop cleanly"


def client(url: str) -> ClientConnection:
    return connect(url, subprotocols=["wildcity.v1"], compression=None, proxy=None, ping_interval=None)


def welcomed(answer: str | bytes) -> None:
    assert isinstance(answer, str)
    assert json.loads(answer)["type"] == "welcome", answer


class Wire:
    """`wsproto` on a socket, with one place to write frames as they are."""

    def __init__(self, url: str) -> None:
        address = urlsplit(url)
        assert address.hostname is not None
        self.socket = socket.create_connection((address.hostname, address.port), timeout=10)
        self.connection = WSConnection(ConnectionType.CLIENT)
        self.events: list[Any] = []
        request = Request(host=address.netloc, target=address.path, subprotocols=["wildcity.v1"])
        self.send(request)
        accepted = self.next()
        assert isinstance(accepted, AcceptConnection), accepted
        assert accepted.subprotocol == "wildcity.v1"

    def send(self, event: Any) -> None:
        self.socket.sendall(self.connection.send(event))

    def frame(self, first_byte: int, payload: bytes, masked: bool = True) -> None:
        """A frame of these bytes, with a header of the usual form."""
        flag = 0x80 if masked else 0
        if len(payload) < 126:
            head = struct.pack("!BB", first_byte, flag | len(payload))
        elif len(payload) < 1 << 16:
            head = struct.pack("!BBH", first_byte, flag | 126, len(payload))
        else:
            head = struct.pack("!BBQ", first_byte, flag | 127, len(payload))
        key = b"\x11\x22\x33\x44"
        if masked:
            payload = bytes(byte ^ key[index % 4] for index, byte in enumerate(payload))
            head += key
        self.socket.sendall(head + payload)

    def next(self) -> Any:
        """The next event; texts in one piece. None when the connection has ended."""
        text = ""
        while True:
            while not self.events:
                data = self.socket.recv(65536)
                self.connection.receive_data(data or None)
                self.events.extend(self.connection.events())
                if not data and not self.events:
                    return None
            event = self.events.pop(0)
            if isinstance(event, TextMessage) and not event.message_finished:
                text += event.data
            elif isinstance(event, TextMessage):
                return text + event.data
            else:
                return event

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def wire(url: str) -> Iterator[Wire]:
    wire = Wire(url)
    yield wire
    wire.close()


def fails_with(wire: Wire, close: int, code: str) -> None:
    """The server says what is wrong, sends a Close frame with its code, and ends the connection."""
    answer = json.loads(wire.next())
    assert (answer["type"], answer["code"], answer["fatal"]) == ("error", code, True), answer
    closing = wire.next()
    assert isinstance(closing, CloseConnection) and closing.code == close, closing
    assert wire.socket.recv(1) == b""


# 1, 5: framing and fragmentation.


@pytest.mark.parametrize("pieces", [1, 2, 3, 17, len(HELLO.encode())])
def test_websockets_fragments_a_text(url: str, pieces: int) -> None:
    data = HELLO.encode()
    size = -(-len(data) // pieces)
    with client(url) as connection:
        connection.send((data[at : at + size] for at in range(0, len(data), size)), text=True)
        welcomed(connection.recv(timeout=10))


@pytest.mark.parametrize("between", [b"", b"x" * 125])
def test_control_frames_come_between_fragments(wire: Wire, between: bytes) -> None:
    half = len(HELLO) // 2
    wire.send(TextMessage(HELLO[:half], message_finished=False))
    wire.send(Ping(between))
    wire.send(Pong(b"unasked"))
    pong = wire.next()
    assert isinstance(pong, Pong) and bytes(pong.payload) == between
    wire.send(TextMessage("", message_finished=False))
    wire.send(TextMessage(HELLO[half:]))
    welcomed(wire.next())


def test_a_frame_arrives_byte_by_byte(wire: Wire) -> None:
    for byte in wire.connection.send(TextMessage(HELLO)):
        wire.socket.sendall(bytes([byte]))
    welcomed(wire.next())


@pytest.mark.parametrize("length", [0, 125, 126, 127, 128, 65535, 65536, 1 << 20])
def test_messages_of_every_length_of_header(wire: Wire, length: int) -> None:
    """White space after a request is JSON, and white space alone is not."""
    wire.frame(0x81, (HELLO.encode()).ljust(length))
    answer = json.loads(wire.next())
    assert answer["type"] == "welcome"
    wire.frame(0x81, b" " * length)
    assert json.loads(wire.next())["code"] == "malformed_json"


def test_many_empty_fragments_are_one_message(wire: Wire) -> None:
    wire.frame(0x01, b"")
    for _ in range(1000):
        wire.frame(0x00, b"")
    wire.frame(0x80, HELLO.encode())
    welcomed(wire.next())


@pytest.mark.parametrize(
    "frames",
    [
        [(0x80, b"x")],
        [(0x00, b"x")],
        [(0x01, b"{"), (0x81, b"}")],
        [(0x01, b"{"), (0x02, b"}")],
        [(0x01, b"{"), (0x80, b"}"), (0x80, b"}")],
    ],
    ids=["continuation", "fragment of nothing", "text in text", "binary in text", "after the end"],
)
def test_fragments_in_the_wrong_order(wire: Wire, frames: list[tuple[int, bytes]]) -> None:
    for first_byte, payload in frames:
        wire.frame(first_byte, payload)
    if len(frames) == 3:
        # The first two are a message, and not a request.
        assert json.loads(wire.next())["code"] == "invalid_request"
    fails_with(wire, CloseReason.PROTOCOL_ERROR, "malformed_json")


# 2: pings and pongs.


def test_websockets_gets_its_pongs(url: str) -> None:
    with client(url) as connection:
        waiting = [connection.ping(bytes([number]) * number) for number in range(0, 126, 25)]
        assert all(pong.wait(timeout=10) for pong in waiting)
        connection.pong(b"unasked")
        connection.send(HELLO)
        welcomed(connection.recv(timeout=10))


def test_fragmented_pings_and_long_ones_are_errors(url: str) -> None:
    for first_byte, payload in [(0x09, b""), (0x09, b"x"), (0x89, b"x" * 126), (0x8A, b"x" * 126)]:
        wire = Wire(url)
        wire.frame(first_byte, payload)
        fails_with(wire, CloseReason.PROTOCOL_ERROR, "malformed_json")
        wire.close()


# 3, 4: reserved bits and opcodes, and the mask.


@pytest.mark.parametrize("first_byte", [0xC1, 0xA1, 0x91, 0xF1, 0xC9, 0x98])
def test_reserved_bits_are_errors(wire: Wire, first_byte: int) -> None:
    wire.frame(first_byte, b"{}")
    fails_with(wire, CloseReason.PROTOCOL_ERROR, "malformed_json")


@pytest.mark.parametrize("opcode", [*range(3, 8), *range(11, 16)])
def test_reserved_opcodes_are_errors(wire: Wire, opcode: int) -> None:
    wire.frame(0x80 | opcode, b"")
    fails_with(wire, CloseReason.PROTOCOL_ERROR, "malformed_json")


def test_unmasked_frames_are_errors(wire: Wire) -> None:
    wire.frame(0x81, HELLO.encode(), masked=False)
    fails_with(wire, CloseReason.PROTOCOL_ERROR, "malformed_json")


def test_binary_messages_are_refused_and_the_connection_goes_on(wire: Wire) -> None:
    wire.send(BytesMessage(b"\x00\xff"))
    assert json.loads(wire.next())["code"] == "unexpected_binary"
    wire.send(TextMessage(HELLO))
    welcomed(wire.next())


# 6: UTF-8.


@pytest.mark.parametrize(
    "text",
    [
        b"\xc3\x28",
        b"\xa0\xa1",
        b"\xe2\x28\xa1",
        b"\xf0\x28\x8c\xbc",
        b"\xed\xa0\x80",
        b"\xc0\xaf",
        b"\xf4\x90\x80\x80",
        b"\xff",
        b"\xce\xba\xe1\xbd",
    ],
    ids=lambda text: text.hex(),
)
@pytest.mark.parametrize("pieces", [1, 2])
def test_texts_that_are_not_utf8(wire: Wire, text: bytes, pieces: int) -> None:
    if pieces == 1:
        wire.frame(0x81, text)
    else:
        wire.frame(0x01, text[:1])
        wire.frame(0x80, text[1:])
    fails_with(wire, CloseReason.INVALID_FRAME_PAYLOAD_DATA, "malformed_json")


def test_a_character_may_be_cut_by_fragments(wire: Wire) -> None:
    data = HELLO.encode()
    cut = data.index("路".encode()) + 1
    wire.frame(0x01, data[:cut])
    wire.frame(0x80, data[cut:])
    welcomed(wire.next())


# 7: the closing handshake.


@pytest.mark.parametrize("code", [1000, 1001, 1002, 1003, 1007, 1008, 1009, 1010, 1011, 3000, 4999])
def test_websockets_gets_its_close_code_back(url: str, code: int) -> None:
    with client(url) as connection:
        connection.send(HELLO)
        welcomed(connection.recv(timeout=10))
        began = time.monotonic()
        connection.close(code, "done")
        assert (connection.close_code, time.monotonic() - began < 1.0) == (code, True)
        assert connection.protocol.close_rcvd is not None
        assert connection.protocol.close_rcvd_then_sent is False


def test_a_close_frame_without_a_code(wire: Wire) -> None:
    wire.frame(0x88, b"")
    closing = wire.next()
    assert isinstance(closing, CloseConnection)
    assert closing.code == CloseReason.NO_STATUS_RCVD
    assert wire.socket.recv(1) == b""


@pytest.mark.parametrize("code", [0, 999, 1004, 1005, 1006, 1015, 1016, 2999, 5000, 65535])
def test_codes_that_are_not_for_the_wire(wire: Wire, code: int) -> None:
    wire.frame(0x88, struct.pack("!H", code))
    while not isinstance(closing := wire.next(), CloseConnection):
        assert json.loads(closing)["code"] == "malformed_json"
    assert closing.code == CloseReason.PROTOCOL_ERROR
    assert wire.socket.recv(1) == b""


def test_close_frames_that_are_cut_or_not_utf8(url: str) -> None:
    for payload, expected in [(b"\x03", 1002), (b"\x03\xe8\xff", 1007)]:
        wire = Wire(url)
        wire.frame(0x88, payload)
        while not isinstance(closing := wire.next(), CloseConnection):
            assert json.loads(closing)["code"] == "malformed_json"
        assert closing.code == expected, payload
        wire.close()


def test_what_follows_a_close_frame_is_ignored(wire: Wire) -> None:
    wire.frame(0x88, struct.pack("!H", 1000))
    wire.frame(0x81, HELLO.encode())
    wire.frame(0x89, b"ping")
    closing = wire.next()
    assert isinstance(closing, CloseConnection) and closing.code == 1000
    assert wire.socket.recv(1) == b""


def test_a_client_that_leaves_without_a_close_frame(url: str) -> None:
    for _ in range(5):
        Wire(url).close()
    with client(url) as connection:
        connection.send(HELLO)
        welcomed(connection.recv(timeout=10))


def test_a_server_that_stops_says_so(tmp_path: Path) -> None:
    (tmp_path / "twins").mkdir()
    with serving(os.environ["WILDCITY_BIN"], tmp_path) as (url, process):
        with client(url) as connection:
            connection.send(HELLO)
            welcomed(connection.recv(timeout=10))
            process.terminate()
            assert json.loads(connection.recv(timeout=10))["code"] == "shutting_down"
            with pytest.raises(websockets.exceptions.ConnectionClosed) as closed:
                connection.recv(timeout=10)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 1001


# 9: limits.


def test_a_message_that_is_too_large(url: str) -> None:
    with client(url) as connection:
        sending = threading.Thread(target=send_quietly, args=(connection, " " * (2 << 20)))
        sending.start()
        assert json.loads(connection.recv(timeout=10))["code"] == "message_too_large"
        with pytest.raises(websockets.exceptions.ConnectionClosed) as closed:
            connection.recv(timeout=10)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009
        sending.join()


def send_quietly(connection: ClientConnection, text: str) -> None:
    with contextlib.suppress(websockets.exceptions.ConnectionClosed, OSError):
        connection.send(text)


# The handshake.


def test_handshakes_are_refused_with_a_reason(url: str) -> None:
    for options, status, code, field in [
        ({}, 400, "unsupported_protocol", "sec-websocket-protocol"),
        ({"subprotocols": ["wildcity.v9"]}, 400, "unsupported_protocol", "sec-websocket-protocol"),
        ({"subprotocols": ["wildcity.v1"], "origin": "https://x.org"}, 403, "forbidden", "origin"),
    ]:
        with pytest.raises(websockets.exceptions.InvalidStatus) as refused:
            connect(url, proxy=None, **options)  # type: ignore[arg-type]
        answer = refused.value.response
        body = json.loads(answer.body or b"")
        assert (answer.status_code, body["code"], body["field"]) == (status, code, field)


def test_wsproto_reads_the_refusal_of_another_path(url: str) -> None:
    address = urlsplit(url)
    assert address.hostname is not None
    with socket.create_connection((address.hostname, address.port), timeout=10) as stream:
        connection = WSConnection(ConnectionType.CLIENT)
        stream.sendall(connection.send(Request(host=address.netloc, target="/v1/nothing")))
        events: list[Any] = []
        while not any(isinstance(event, RejectData) for event in events):
            connection.receive_data(stream.recv(65536))
            events.extend(connection.events())
    rejected = next(event for event in events if isinstance(event, RejectConnection))
    assert rejected.status_code == 404
    body = b"".join(event.data for event in events if isinstance(event, RejectData))
    assert json.loads(body)["code"] == "invalid_request"


def test_compression_is_not_agreed(url: str) -> None:
    with connect(url, subprotocols=["wildcity.v1"], compression="deflate", proxy=None) as connection:
        assert connection.protocol.extensions == []
        assert connection.subprotocol == "wildcity.v1"
        connection.send(HELLO)
        welcomed(connection.recv(timeout=10))


def test_the_frames_of_both_libraries_are_the_same() -> None:
    """The tests above rest on frames that this file builds: they are those of `websockets`."""
    head = Frame(Opcode.TEXT, b"x" * 200).serialize(mask=False)[:4]
    assert head == struct.pack("!BBH", 0x81, 126, 200)
