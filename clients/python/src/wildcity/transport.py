"""Connections of the two clients: one message in each direction at a time."""

from __future__ import annotations

import asyncio
import socket
import threading
import time

from websockets.asyncio.client import ClientConnection as AsyncConnection
from websockets.asyncio.client import connect as connect_async
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection as BlockingConnection
from websockets.sync.client import connect as connect_blocking

from .session_protocol import CONNECT_OPTIONS, Message, connect_failed


class AsyncTransport:
    """A WebSocket of asyncio."""

    def __init__(self, connection: AsyncConnection) -> None:
        self._connection = connection
        self.subprotocol = connection.subprotocol

    @classmethod
    async def connect(cls, url: str, headers: dict[str, str]) -> AsyncTransport:
        """Raises `ConnectFailed`."""
        try:
            return cls(await connect_async(url, additional_headers=headers, **CONNECT_OPTIONS))
        except (OSError, ValueError, WebSocketException) as error:
            raise connect_failed(url, error) from error

    async def answer(self, request: str, timeout: float) -> Message:
        """Sends a request, and returns the next message."""
        return await asyncio.wait_for(self._answer(request), timeout)

    async def _answer(self, request: str) -> Message:
        await self._connection.send(request)
        return await self._connection.recv()

    async def close(self) -> None:
        await self._connection.close()

    def give_up(self) -> None:
        """Closes without a closing handshake, because a cancellation must not wait for one."""
        self._connection.transport.abort()


class BlockingTransport:
    """A WebSocket whose calls block."""

    def __init__(self, connection: BlockingConnection) -> None:
        self._connection = connection
        self.subprotocol = connection.subprotocol

    @classmethod
    def connect(cls, url: str, headers: dict[str, str]) -> BlockingTransport:
        """Raises `ConnectFailed`."""
        try:
            # Entered here and closed in `close`, because it outlives any block.
            return cls(connect_blocking(url, additional_headers=headers, **CONNECT_OPTIONS).__enter__())
        except (OSError, ValueError, WebSocketException) as error:
            raise connect_failed(url, error) from error

    def answer(self, request: str, timeout: float) -> Message:
        """Sends a request, and returns the next message."""
        deadline = time.monotonic() + timeout
        # `send` has no time-out: it would block forever on a server that does not read.
        shutdown_timer = threading.Timer(timeout, self._connection.socket.shutdown, (socket.SHUT_RDWR,))
        shutdown_timer.start()
        try:
            self._connection.send(request)
        except ConnectionClosed as error:
            if time.monotonic() >= deadline:
                raise TimeoutError from error
            raise
        finally:
            shutdown_timer.cancel()
        return self._connection.recv(timeout=max(0.0, deadline - time.monotonic()))

    def close(self) -> None:
        self._connection.close()

    def give_up(self) -> None:
        """Closes the connection after an error."""
        self._connection.close()
