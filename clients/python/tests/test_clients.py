"""Both clients against a server that follows a script."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import wildcity.aio
from conftest import frame, vector
from fake_server import HANG_UP, OBSERVATION, SILENCE, FakeServer, observation
from websockets.utils import accept_key
from wildcity import (
    BadFrame,
    ConnectFailed,
    Disconnected,
    Pose,
    ProtocolError,
    Refused,
    TimedOut,
)
from wildcity.protocol import PROTOCOL

Connect = Callable[..., Any]
HERE = Pose((12.5, -3.25, 0.125), (0.8, 0.0, 0.0, 0.6))


def seqs(requests: list[dict[str, Any]]) -> list[int]:
    return [request["seq"] for request in requests]


def test_a_whole_session(connect: Connect) -> None:
    script: list[str | bytes] = ["welcome", "opened", OBSERVATION, OBSERVATION, OBSERVATION, "ok", "closed"]
    with FakeServer(script) as server:
        with connect(server.url) as client, client.open("street") as session:
            assert client.welcome.twins[0].name == "street"
            assert session.opened.cameras[1].name == "rear"
            session.reset(seed=7)
            seen = session.step(HERE)
            assert seen.images["front"].shape == (3, 4, 3)
            assert np.isfinite(seen.depth["rear"]).all()
            session.observe([HERE, HERE])
            session.prefetch([HERE])
    types = [request["type"] for request in server.requests[0]]
    assert types == ["hello", "open", "reset", "step", "observe", "prefetch", "close"]
    assert seqs(server.requests[0]) == [0, 1, 2, 3, 4, 5, 6]


def test_a_session_closed_by_hand_is_not_closed_again(connect: Connect) -> None:
    with FakeServer(["welcome", "opened", "closed"]) as server:
        with connect(server.url) as client, client.open("street") as session:
            assert session.close().outcome == "off_model"
    assert len(server.requests[0]) == 3


def test_a_refused_request_keeps_its_number(connect: Connect) -> None:
    with FakeServer(["welcome", "opened", "error", OBSERVATION]) as server:
        session = connect(server.url).open("street")
        with pytest.raises(Refused) as refused:
            session.step(HERE)
        assert refused.value.code == "pose_not_finite"
        assert refused.value.field == "pose.q[2]"
        assert not refused.value.fatal
        session.step(HERE)
    assert seqs(server.requests[0]) == [0, 1, 2, 2]


def test_a_request_that_json_cannot_represent_is_not_sent(connect: Connect) -> None:
    with FakeServer(["welcome", "opened", OBSERVATION]) as server:
        client = connect(server.url)
        with pytest.raises(ValueError, match="^seed is not a finite number"):
            client.open("street", seed=float("nan"))
        session = client.open("street")
        with pytest.raises(ValueError, match=r"^action\.curvature is not a finite number"):
            session.step(wildcity.Action(0.0, float("inf")))
        session.step(HERE)
    assert seqs(server.requests[0]) == [0, 1, 2]


def test_every_form_of_an_address_leads_to_the_sessions(connect: Connect) -> None:
    for url in ("http://127.0.0.1:1", "127.0.0.1:1", "ws://127.0.0.1:1"):
        with pytest.raises(wildcity.ConnectFailed, match="connect to ws://127.0.0.1:1/v1/session: "):
            connect(url)
    with pytest.raises(ValueError, match="give HOST:PORT"):
        connect("127.0.0.1:1/v2")


def test_a_server_that_does_not_read_ends_in_a_time_out(connect: Connect) -> None:
    with unresponsive_server() as url:
        client = connect(url, timeout=0.5)
        asked = time.monotonic()
        # 30 MB are more than the buffers of two sockets hold.
        with pytest.raises(TimedOut):
            client.open("x" * 30_000_000)
        assert time.monotonic() - asked < 10.0


@contextlib.contextmanager
def unresponsive_server() -> Iterator[str]:
    """A server that answers the upgrade and `hello`, and reads nothing after that."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        peer, _ = listener.accept()
        request = b""
        while b"\r\n\r\n" not in request:
            request += peer.recv(4096)
        (key,) = re.findall(rb"(?i)sec-websocket-key: (\S+)", request)
        answer = (
            "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Accept: {accept_key(key.decode())}\r\n"
            f"Sec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n"
        )
        peer.sendall(answer.encode())
        peer.recv(4096)
        welcome = json.dumps(vector("answers/welcome.json")).encode()
        # A text frame of a two-byte length (RFC 6455, section 5.2).
        peer.sendall(struct.pack(">BBH", 0x81, 126, len(welcome)) + welcome)
        done.wait()
        peer.close()

    done = threading.Event()
    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"ws://127.0.0.1:{listener.getsockname()[1]}/v1/session"
    finally:
        done.set()
        thread.join()
        listener.close()


def test_a_fatal_error_ends_the_connection(connect: Connect) -> None:
    with FakeServer(["welcome", "opened", "error_fatal"]) as server:
        session = connect(server.url).open("street")
        with pytest.raises(Refused, match="shutting_down") as refused:
            session.step(HERE)
        assert refused.value.fatal
        with pytest.raises(Disconnected):
            session.step(HERE)


def test_a_lost_answer_is_fetched_after_resuming(connect: Connect) -> None:
    """The golden `resumed` says that request 4 was carried out."""
    first: list[str | bytes] = ["welcome", "opened", OBSERVATION, OBSERVATION, HANG_UP]
    with FakeServer(first, ["welcome", "resumed", OBSERVATION, OBSERVATION]) as server:
        session = connect(server.url).open("street")
        session.reset()
        session.step(HERE)
        with pytest.raises(Disconnected):
            session.step(HERE)
        assert session.resume().last_seq == 4
        assert session.step(HERE).metadata.seq == 4
        assert session.step(HERE).metadata.seq == 5
    resume = {"type": "resume", "seq": 1, "session": "run-17", "last_seq": 3}
    assert server.requests[1][1] == resume
    assert seqs(server.requests[1]) == [0, 1, 4, 5]


def test_a_new_session_can_follow_one_that_is_gone(connect: Connect) -> None:
    gone = '{"type":"error","seq":1,"code":"unknown_session","message":"","fatal":false}'
    second: list[str | bytes] = ["welcome", gone, "opened", OBSERVATION]
    with FakeServer(["welcome", "opened", OBSERVATION, HANG_UP], second) as server:
        client = connect(server.url)
        session = client.open("street")
        session.step(HERE)
        with pytest.raises(Disconnected):
            session.step(HERE)
        with pytest.raises(Refused, match="unknown_session"):
            session.resume()
        client.open("street").step(HERE)
    assert seqs(server.requests[1]) == [0, 1, 1, 2]


def test_another_client_can_resume_a_session(connect: Connect) -> None:
    with FakeServer(["welcome", "resumed", OBSERVATION]) as server:
        session = connect(server.url).resume("run-17", 4)
        assert session.step(HERE).metadata.seq == 5
        assert (session.opened.session, session.opened.dt_us) == ("run-17", 100_000)


def test_a_session_at_another_request_is_not_resumed(connect: Connect) -> None:
    with FakeServer(["welcome", "resumed"]) as server:
        with pytest.raises(ProtocolError, match="the session is at 4, not at 2"):
            connect(server.url).resume("run-17", 2)


def test_silence_ends_in_a_time_out(connect: Connect) -> None:
    with FakeServer(["welcome", "opened", SILENCE]) as server:
        session = connect(server.url, timeout=0.2).open("street")
        with pytest.raises(TimedOut):
            session.step(HERE)
        # The answer may still come, so the connection cannot be used again.
        with pytest.raises(Disconnected):
            session.step(HERE)


@pytest.mark.parametrize(
    ("reply", "error", "says"),
    [
        (observation(3), ProtocolError, "answer to request 2, got one to 3"),
        ("opened", ProtocolError, "step was answered with Opened"),
        ('{"type":', ProtocolError, "not JSON"),
        (frame("damaged/overlap.bin"), BadFrame, "offset"),
    ],
)
def test_invalid_answers_are_named(connect: Connect, reply: str | bytes, error: type[Exception], says: str) -> None:
    with FakeServer(["welcome", "opened", reply]) as server:
        session = connect(server.url).open("street")
        with pytest.raises(error, match=says):
            session.step(HERE)
        with pytest.raises(Disconnected):
            session.step(HERE)


def test_connecting_without_a_server_fails(connect: Connect) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    for url in (f"ws://127.0.0.1:{port}/v1/session", "http://127.0.0.1/", "not a url"):
        with pytest.raises(ConnectFailed):
            connect(url)


def test_a_cancelled_call_gives_the_connection_up() -> None:
    async def cancel(url: str) -> None:
        client = await wildcity.aio.connect(url)
        session = await client.open("street")
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(session.step(HERE), 0.1)
        with pytest.raises(Disconnected):
            await session.step(HERE)

    with FakeServer(["welcome", "opened", SILENCE]) as server:
        asyncio.run(cancel(server.url))


def test_calls_do_not_overlap() -> None:
    """A call of a second thread fails, instead of getting the first thread's answer."""
    with FakeServer(["welcome", "opened", SILENCE]) as server:
        client = wildcity.connect(server.url, timeout=0.5)
        session = client.open("street")
        started = threading.Event()

        def first() -> None:
            started.set()
            with pytest.raises(TimedOut):
                session.step(HERE)

        thread = threading.Thread(target=first)
        thread.start()
        started.wait()
        # Until the first call has the connection.
        while client._connection is not None:
            pass
        with pytest.raises(Disconnected, match="under way"):
            session.step(HERE)
        thread.join()
