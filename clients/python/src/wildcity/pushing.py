"""Pushing trained scenes to a server, as a new version of a twin."""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import json
import os
import time
import urllib.parse
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

from .errors import Code, ConnectFailed, ProtocolError, PushFailed, Refused

CHUNK_BYTES = 1 << 20
"""Bytes of a file that are read at once."""
TRIES = 6
"""How often a lost connection is tried again without a byte getting through."""
POLL_S = 0.1
"""How often the server is asked how it stands with a push."""

State = Literal[
    "uploading",
    "queued",
    "ingesting",
    "validating",
    "committing",
    "prefetching",
    "ready",
    "refused",
    "failed",
]


@dataclass(frozen=True)
class PushProgress:
    """How far a push is: `done` of `total` within its state (bytes, Gaussians or views)."""

    state: State
    done: int
    total: int


@dataclass(frozen=True)
class Push:
    """A push that is ready: the version that it made, and what was found in its files."""

    id: str
    twin: str
    version: int
    version_hash: str
    report: dict[str, Any]


def push(
    files: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    twin: str,
    server: str = "http://127.0.0.1:8080",
    token: str | None = None,
    axes: str = "identity",
    scale: float = 1.0,
    cells: Literal["all"] | Sequence[tuple[int, int]] | None = None,
    base: int | None = None,
    record: Literal["f32", "h52", "q32", "q24"] | None = None,
    levels: bool = True,
    profile: Sequence[str] = (),
    note: str | None = None,
    min_psnr_db: float | None = None,
    push_id: str | None = None,
    progress: Callable[[PushProgress], None] | None = None,
    timeout: float = 60.0,
) -> Push:
    """Uploads scene files and makes them the next version of a twin; returns when it is ready.

    The files become one scene. It replaces the 64 m cells that its Gaussians lie in, or `cells`, or all.
    With `base`, the version it was trained from, cells that changed since are not overwritten. An upload
    that was cut goes on where it stopped. `token` is `$WILDCITY_TOKEN` unless given. The same `push_id`
    again is the same push.

    Raises `PushFailed` if the scene was refused, `Refused` if a request was, `ConnectFailed` if the
    server does not answer.
    """
    paths = [files] if isinstance(files, (str, os.PathLike)) else list(files)
    wire = _Wire(server, token, timeout)
    told = progress or (lambda _: None)
    asked: dict[str, Any] = {
        "id": push_id or uuid.uuid4().hex,
        "files": [
            {"upload": _upload(wire, Path(path), told), "axes": axes, "scale": scale}
            for path in paths
        ],
        "levels": levels,
        "profile": list(profile),
    }
    if min_psnr_db is not None:
        asked["golden"] = {"min_psnr_db": min_psnr_db}
    cells = cells if cells is None or isinstance(cells, str) else [(x, y) for x, y in cells]
    optional = {"cells": cells, "base": base, "record": record, "note": note}
    asked |= {name: value for name, value in optional.items() if value is not None}
    at = f"/v1/twins/{urllib.parse.quote(twin, safe='')}/pushes"
    # Asked again under the same id if the answer is lost: carried out once.
    answer, again = wire.patiently("POST", at, asked), 0
    while True:
        done, total = answer["progress"]["done"], answer["progress"]["total"]
        told(PushProgress(answer["state"], done, total))
        if answer["state"] in ("ready", "refused", "failed"):
            return _ended(answer)
        time.sleep(POLL_S)
        try:
            answer = wire.patiently("GET", f"{at}/{answer['id']}", None)
        except Refused as refused:
            # The server started again, and knows no pushes from before. Its uploads are still there.
            if refused.code != "unknown_push" or again >= TRIES:
                raise
            again += 1
            answer = wire.patiently("POST", at, asked)


def rollback(
    twin: str,
    version: int,
    *,
    server: str = "http://127.0.0.1:8080",
    token: str | None = None,
    timeout: float = 60.0,
) -> int:
    """Makes an old version of a twin the latest again, as a new one, whose number it returns."""
    at = f"/v1/twins/{urllib.parse.quote(twin, safe='')}/rollback"
    answer = _Wire(server, token, timeout).json("POST", at, {"version": version})
    return int(answer["version"])


def _ended(answer: dict[str, Any]) -> Push:
    if answer["state"] == "ready":
        made = answer["version"], answer["version_hash"], answer.get("report") or {}
        return Push(answer["id"], answer["twin"], *made)
    error = answer["error"]
    code: Code = error["code"]
    cells = tuple((x, y) for x, y in error.get("cells", ()))
    raise PushFailed(code, error["message"], cells, answer.get("report"))


def _upload(wire: _Wire, path: Path, told: Callable[[PushProgress], None]) -> str:
    """The id of a file's upload, with all of its bytes on the server."""
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
            size += len(chunk)
        announced = {"name": path.name, "size": size, "digest": f"sha-256:{digest.hexdigest()}"}
        tries, furthest = 0, -1
        while True:
            upload = wire.patiently("POST", "/v1/uploads", announced)
            if upload["complete"]:
                told(PushProgress("uploading", size, size))
                return str(upload["id"])
            offset = int(upload["offset"])
            tries = 0 if offset > furthest else tries + 1
            furthest = max(furthest, offset)
            if tries:
                time.sleep(0.2 * 2**tries)
            file.seek(offset)
            headers = {"Upload-Offset": str(offset), "Content-Length": str(size - offset)}
            try:
                body = _chunks(file, offset, size, told)
                wire.json("PATCH", f"/v1/uploads/{upload['id']}", body, headers)
            except ConnectFailed:
                if tries >= TRIES:
                    raise
            except Refused as refused:
                # Another connection of ours is further, or the server was busy.
                if refused.code not in ("upload_offset", "busy", "timed_out") or tries >= TRIES:
                    raise


def _chunks(
    file: BinaryIO, offset: int, size: int, told: Callable[[PushProgress], None]
) -> Iterator[bytes]:
    while offset < size and (chunk := file.read(min(CHUNK_BYTES, size - offset))):
        yield chunk
        offset += len(chunk)
        told(PushProgress("uploading", offset, size))


class _Wire:
    """Requests of HTTP, each on a connection of its own."""

    def __init__(self, server: str, token: str | None, timeout: float) -> None:
        parts = urllib.parse.urlsplit(server)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(f"{server!r} is not a server; expected http://HOST:PORT")
        secure = parts.scheme == "https"
        self._dial = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        self._host, self._port, self._timeout = parts.hostname, parts.port, timeout
        self._token = token or os.environ.get("WILDCITY_TOKEN")

    def patiently(self, method: str, path: str, body: Any) -> Any:
        """As `json`, again and again while the connection is lost."""
        for tries in range(TRIES):
            try:
                return self.json(method, path, body)
            except ConnectFailed:
                time.sleep(0.2 * 2**tries)
        return self.json(method, path, body)

    def json(
        self,
        method: str,
        path: str,
        body: dict[str, Any] | Iterator[bytes] | None,
        headers: dict[str, str] | None = None,
    ) -> Any:
        """Sends JSON or bytes, and gives the JSON that is answered."""
        sent = dict(headers or {})
        if self._token:
            sent["Authorization"] = f"Bearer {self._token}"
        content = json.dumps(body, allow_nan=False).encode() if isinstance(body, dict) else body
        connection = self._dial(self._host, self._port, timeout=self._timeout)
        try:
            connection.connect()
            # A server that refuses a body need not read all of it: its answer says why.
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                connection.request(method, path, content, sent)
            response = connection.getresponse()
            status, text = response.status, response.read()
        except (OSError, http.client.HTTPException) as error:
            raise ConnectFailed(f"no answer from {self._host}:{self._port}: {error}") from error
        finally:
            connection.close()
        try:
            answer = json.loads(text)
        except ValueError as error:
            raise ProtocolError(f"HTTP {status}, and no JSON: {text[:200]!r}") from error
        if 200 <= status < 300:
            return answer
        if not isinstance(answer, dict) or "code" not in answer:
            raise ProtocolError(f"HTTP {status}: {text[:200]!r}")
        raise Refused(answer["code"], answer["message"], answer.get("field"), False)
