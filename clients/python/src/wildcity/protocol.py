"""The parts of the protocol that are no message of their own, and the conversion of messages to and from JSON.

The messages are in `messages`. The names of the fields are those of the protocol; `protocol/README.md` explains all of
them.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import json
import math
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NoReturn

from .errors import ProtocolError
from .messages import ANSWERS, Action, TimedPose
from .pose import Pose

PROTOCOL = "wildcity.v1"
"""The WebSocket subprotocol."""

OBSERVATION_BYTES = 3 << 29
"""Largest message that is accepted from a server, in bytes."""


@dataclass(frozen=True)
class Trajectory:
    """Planned poses of the ego: 1 to 64 in order of time, up to the end of the step or later."""

    poses: tuple[TimedPose, ...]

    @classmethod
    def from_xy(cls, xy: Any, *, every_us: int = 100_000) -> Trajectory:
        """A plan in the plane: [n, 2] metres ahead of the rig and to its left, one each `every_us` after the start of
        the step. Each pose heads along the way from the one before."""
        poses = []
        before = (0.0, 0.0)
        yaw = 0.0
        for index, (x, y) in enumerate(xy):
            at = (float(x), float(y))
            way = (at[0] - before[0], at[1] - before[1])
            # A car that stands keeps its heading.
            if math.hypot(*way) > 1e-3:
                yaw = math.atan2(way[1], way[0])
            before = at
            poses.append(TimedPose((index + 1) * every_us, Pose.flat(*at, yaw)))
        if not 1 <= len(poses) <= 64:
            raise ValueError(f"xy has {len(poses)} points; a plan has 1 to 64")
        return cls(tuple(poses))


@dataclass(frozen=True)
class Step:
    """A step of one of several sessions: see `Session.step` for the fields."""

    movement: Pose | Trajectory | Action
    until_us: int | None = None
    notes: Any = None
    terminate: bool = False


def png_data_uri(png: bytes) -> str:
    """The bytes of a PNG file as a data URI, for `Camera.overlay`."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def parse_json(text: str | bytes, what: str) -> Any:
    """Parses JSON without the extensions that Python's parser accepts. `what` names it in errors."""
    try:
        return json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"{what} is not JSON: {error}") from error


def to_json(value: Any) -> str:
    """The JSON of a request. Raises `ValueError` with the field if a number is NaN or infinite: JSON has neither."""
    try:
        return json.dumps(value, allow_nan=False)
    except ValueError as error:
        field = _not_finite(value, "")
        if field is None:
            raise
        raise ValueError(f"{field} is not a finite number") from error


def _not_finite(value: Any, field: str) -> str | None:
    """The first field that is NaN or infinite."""
    if isinstance(value, float):
        return None if math.isfinite(value) else field
    if isinstance(value, dict):
        found = (_not_finite(item, f"{field}.{name}" if field else str(name)) for name, item in value.items())
    elif isinstance(value, (list, tuple)):
        found = (_not_finite(item, f"{field}[{at}]") for at, item in enumerate(value))
    else:
        return None
    return next((name for name in found if name is not None), None)


def decode_answer(text: str) -> Any:
    """Decodes a text frame from the server as one of `ANSWERS`."""
    value = parse_json(text, "an answer")
    kind = value.get("type") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in ANSWERS:
        raise ProtocolError(f"an answer has type {kind!r}; expected one of {', '.join(ANSWERS)}")
    return decode(ANSWERS[kind], value, kind)


def encode(value: Any) -> Any:
    """Converts a dataclass to what `json` can write. Fields that are None are left out."""
    if dataclasses.is_dataclass(value):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return {name: encode(item) for name, item in fields.items() if item is not None}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [encode(item) for item in value]
    if isinstance(value, Mapping):
        return {name: encode(item) for name, item in value.items()}
    return value


def decode(kind: Any, value: Any, path: str) -> Any:
    """Converts JSON to the type `kind`. An error names the path, for example `opened.cameras[0].fx`.

    Unknown fields are ignored, because a newer server may send more fields than this client knows.
    """
    if kind is Any:
        return value
    if kind is float:
        # Python's parser turns 1e999 into infinity, which is not a JSON number.
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or not math.isfinite(value):
            return _mismatch(path, value, "a finite number")
        return float(value)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return value if value in arguments else _mismatch(path, value, " or ".join(arguments))
    if origin in (types.UnionType, typing.Union):  # always `X | None`
        return None if value is None else decode(arguments[0], value, path)
    if origin is tuple:
        return _decode_tuple(arguments, value, path)
    if origin is dict or kind is dict:
        if not isinstance(value, dict):
            return _mismatch(path, value, "an object")
        of_values = arguments[1] if arguments else Any
        return {name: decode(of_values, item, f"{path}.{name}") for name, item in value.items()}
    if dataclasses.is_dataclass(kind):
        return _decode_dataclass(kind, value, path)
    if type(value) is not kind:
        return _mismatch(path, value, kind.__name__)
    return value


def _decode_tuple(arguments: tuple[Any, ...], value: Any, path: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        return _mismatch(path, value, "an array")
    kinds = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else list(arguments)
    if len(kinds) != len(value):
        return _mismatch(path, value, f"{len(kinds)} items")
    pairs = enumerate(zip(kinds, value, strict=True))
    return tuple(decode(kind, item, f"{path}[{index}]") for index, (kind, item) in pairs)


def _decode_dataclass(kind: Any, value: Any, path: str) -> Any:
    if not isinstance(value, dict):
        return _mismatch(path, value, "an object")
    fields = {}
    for name, hint, is_required in _fields(kind):
        if name in value:
            fields[name] = decode(hint, value[name], f"{path}.{name}")
        elif is_required:
            raise ProtocolError(f"{path}.{name} is missing")
    return kind(**fields)


@functools.cache
def _fields(kind: type[Any]) -> tuple[tuple[str, Any, bool], ...]:
    """Name and type of each field, and whether it has no default. Cached: Python evaluates the types at each call."""
    hints = typing.get_type_hints(kind)
    fields = dataclasses.fields(kind)
    return tuple((field.name, hints[field.name], field.default is dataclasses.MISSING) for field in fields)


def _mismatch(path: str, value: Any, expected: str) -> NoReturn:
    raise ProtocolError(f"{path} is {str(value)[:100]!r}; expected {expected}")


def _reject_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a JSON number")
