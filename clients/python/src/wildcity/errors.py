"""Exceptions of this package. All derive from `WildCityError`."""

from __future__ import annotations

from typing import Any

from .messages import Code


class WildCityError(Exception):
    """Base class of all exceptions of this package."""


class ConnectFailed(WildCityError):
    """The client could not connect to the server."""


class Disconnected(WildCityError):
    """The connection was lost. `Session.resume` may continue the session."""


class TimedOut(WildCityError):
    """No answer came in time, and the client closed the connection. `Session.resume` may continue the session."""


class SlotInUse(WildCityError):
    """Arrays of an earlier observation still exist, whose memory the next one takes. Nothing was sent.

    Only with `connect(..., shared_memory=True, copy=False)`.
    """


class ProtocolError(WildCityError):
    """The server sent an answer that the protocol does not permit, and the client closed the connection."""


class BadFrame(ProtocolError):
    """A binary frame is not a valid observation, or an image in it cannot be decoded."""


class Refused(WildCityError):
    """The server refused the request. Nothing changed, and the request can be sent again.

    `field` is the name of the invalid field, or None. If `fatal`, the server also closed the connection.
    """

    def __init__(self, code: Code, message: str, field: str | None, fatal: bool) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message
        self.field = field
        self.fatal = fatal


class PushFailed(WildCityError):
    """A push was refused, or the server failed to carry it out. Nothing changed.

    `code` is `conflict` if other pushes changed the same `cells`, and `push_refused` if the scene is invalid.
    `report` then has what the server found in the files.
    """

    def __init__(
        self,
        code: Code,
        message: str,
        cells: tuple[tuple[int, int], ...],
        report: dict[str, Any] | None,
    ) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message
        self.cells = cells
        self.report = report
