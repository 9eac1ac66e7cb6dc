"""HTTP requests to a server."""

from __future__ import annotations

import contextlib
import http.client
import json
import time
import urllib.parse
from collections.abc import Iterator
from typing import Any

from .address import server_url
from .authorization import authorization_headers
from .errors import ConnectFailed, ProtocolError, Refused
from .protocol import to_json

ATTEMPTS = 6
"""Largest number of attempts in a row that fail without transferring a byte."""
RETRY_DELAY_S = 0.2
"""Delay before the first repetition of a failed attempt; it doubles with each further repetition."""


class HttpClient:
    """Sends HTTP requests, each on a connection of its own."""

    def __init__(self, server: str, token: str | None, timeout: float) -> None:
        parts = urllib.parse.urlsplit(server_url(server))
        secure = parts.scheme == "https"
        self._connection_type = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        self._host = parts.hostname or ""
        self._port = parts.port
        self._timeout = timeout
        self._headers = authorization_headers(token)

    def json_with_retries(self, method: str, path: str, body: Any) -> Any:
        """As `json`, and repeats the request up to `ATTEMPTS` times if no answer comes."""
        for failures in range(ATTEMPTS):
            try:
                return self.json(method, path, body)
            except ConnectFailed:
                time.sleep(RETRY_DELAY_S * 2**failures)
        return self.json(method, path, body)

    def json(
        self,
        method: str,
        path: str,
        body: dict[str, Any] | Iterator[bytes] | None,
        headers: dict[str, str] | None = None,
    ) -> Any:
        """Sends JSON or bytes, and returns the JSON of the answer."""
        sent = {**self._headers, **(headers or {})}
        content = to_json(body).encode() if isinstance(body, dict) else body
        connection = self._connection_type(self._host, self._port, timeout=self._timeout)
        try:
            connection.connect()
            # A server that refuses may close before it has read the whole body. Its answer has the reason.
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                connection.request(method, path, content, sent)
            response = connection.getresponse()
            status = response.status
            text = response.read()
        except (OSError, http.client.HTTPException) as error:
            raise ConnectFailed(f"no answer from {self._host}:{self._port}: {error}") from error
        finally:
            connection.close()
        try:
            answer = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ProtocolError(f"the answer with HTTP status {status} is not JSON: {text[:200]!r}") from error
        if 200 <= status < 300:
            return answer
        if not isinstance(answer, dict) or "code" not in answer:
            raise ProtocolError(f"HTTP status {status} without an error code: {text[:200]!r}")
        raise Refused(answer["code"], answer["message"], answer.get("field"), False)
