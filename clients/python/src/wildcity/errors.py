"""What can go wrong between a client and its server. Every exception is a `WildCityError`."""

from __future__ import annotations

from typing import Any, Literal

Code = Literal[
    "malformed_json",
    "invalid_request",
    "unexpected_binary",
    "message_too_large",
    "seq_out_of_order",
    "wrong_order",
    "unsupported_protocol",
    "session_state",
    "unknown_twin",
    "unknown_version",
    "twin_damaged",
    "unknown_rig",
    "unknown_camera",
    "unknown_trajectory",
    "unknown_session",
    "session_exists",
    "invalid_name",
    "pose_not_finite",
    "pose_invalid",
    "camera_invalid",
    "out_of_range",
    "answer_too_large",
    "busy",
    "deadline_exceeded",
    "timed_out",
    "shutting_down",
    "unauthorized",
    "forbidden",
    "unknown_upload",
    "upload_offset",
    "upload_digest",
    "storage_full",
    "unknown_push",
    "conflict",
    "push_refused",
    "internal",
]
"""The closed list of refusals; `protocol/README.md` says what each means and what to do."""


class WildCityError(Exception):
    """Any failure of this package."""


class ConnectFailed(WildCityError):
    """There is no connection to be had."""


class Disconnected(WildCityError):
    """The connection is gone; `resume` may continue the session."""


class TimedOut(WildCityError):
    """No answer in time. The connection was given up; `resume` may continue the session."""


class ProtocolError(WildCityError):
    """The server answered what the protocol does not allow; the connection was given up."""


class BadFrame(ProtocolError):
    """A binary frame is not an observation, or an image in it cannot be decoded."""


class Refused(WildCityError):
    """The server refused the request. Nothing changed, and it can be sent again.

    Unless `fatal`: then the connection ended with it.
    """

    def __init__(self, code: Code, message: str, field: str | None, fatal: bool) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message
        self.field = field
        self.fatal = fatal


class PushFailed(WildCityError):
    """A push was refused, or the server could not do it. Nothing changed.

    `code` is `conflict` if others changed the same `cells`, and `push_refused` if the scene cannot be
    used; `report` then says what was found.
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
