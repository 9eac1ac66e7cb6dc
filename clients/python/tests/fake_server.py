"""A small server that answers from a script of golden messages."""

from __future__ import annotations

import json
import struct
import threading
from typing import Any

from conftest import frame, vector
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Subprotocol
from wildcity.protocol import PROTOCOL

OBSERVATION = "an observation"
SILENCE = "silence"
HANG_UP = "hang up"


class FakeServer:
    """Accepts one connection per script. `requests` has the requests of each connection.

    An entry of a script is OBSERVATION, SILENCE, HANG_UP, the name of a golden answer (sent with the
    request's number), or exactly the message to send.
    """

    def __init__(self, *scripts: list[str | bytes]) -> None:
        self._scripts = iter(scripts)
        self.requests: list[list[dict[str, Any]]] = []
        # An asyncio client does not answer the closing handshake while its loop is not running.
        self._server = serve(
            self._follow,
            "127.0.0.1",
            0,
            subprotocols=[Subprotocol(PROTOCOL)],
            close_timeout=0.1,
        )
        port = self._server.socket.getsockname()[1]
        self.url = f"ws://127.0.0.1:{port}/v1/session"
        self._thread = threading.Thread(target=self._server.serve_forever)

    def __enter__(self) -> FakeServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()

    def _follow(self, connection: ServerConnection) -> None:
        requests: list[dict[str, Any]] = []
        self.requests.append(requests)
        try:
            for entry in next(self._scripts):
                request = json.loads(connection.recv())
                requests.append(request)
                if entry == HANG_UP:
                    connection.close_socket()
                    return
                if entry != SILENCE:
                    connection.send(self._message(entry, request["seq"]))
            # Until the client disconnects. Requests beyond the script are recorded and get no answer.
            requests.extend(json.loads(beyond) for beyond in connection)
        except ConnectionClosed:
            pass

    def _message(self, entry: str | bytes, seq: int) -> str | bytes:
        if entry == OBSERVATION:
            return observation(seq)
        if isinstance(entry, bytes) or entry.startswith(("{", "[")):
            return entry
        answer = vector(f"answers/{entry}.json")
        if "seq" in answer:
            answer["seq"] = seq
        return json.dumps(answer)


def observation(seq: int) -> bytes:
    """The golden raw frame with another number."""
    data = frame("observations/raw.bin")
    (length,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + length])
    metadata = json.loads(header["__metadata__"]["observation"])
    metadata["seq"] = seq
    header["__metadata__"]["observation"] = json.dumps(metadata)
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data[8 + length :]
