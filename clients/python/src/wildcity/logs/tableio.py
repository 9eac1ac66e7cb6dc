"""Reads the files of a source: JSON tables one row at a time, text and JSON, each with a named error."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import LogError
from .progress import Progress

__all__ = ["field", "integer", "json_file", "json_rows", "numbers", "require", "text", "text_of"]

_CHUNK = 1 << 20
"""Characters that are read at once."""

_SLOW_BYTES = 1 << 27
"""A larger table has a progress bar of its own."""


def require(path: Path, what: str) -> Path:
    """The path, if it exists. what: its role, for the error."""
    if not path.exists():
        raise LogError(path, f"missing: {what}", "download or unpack this part of the source")
    return path


def text_of(path: Path, what: str) -> str:
    """A small text file."""
    try:
        return require(path, what).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(path, f"cannot read: {error}", "download or unpack it again") from None


def json_file(path: Path, what: str) -> Any:
    """A small JSON file."""
    try:
        return json.loads(text_of(path, what))
    # Thousands of brackets, each within the one before it, exceed the depth of Python's parser.
    except (json.JSONDecodeError, RecursionError) as error:
        raise LogError(path, f"not JSON: {error}", "download or unpack it again") from None


def json_rows(path: Path, what: str) -> Iterator[dict[str, Any]]:
    """The objects of a JSON array, one by one: the file may be larger than the memory."""
    decoder = json.JSONDecoder()
    size = require(path, what).stat().st_size
    # A table of the full data set takes half a minute; of a small one nothing is said.
    label = Progress(path.name, size // _CHUNK) if size >= _SLOW_BYTES else None
    with path.open(encoding="utf-8") as file:
        text = file.read(_CHUNK)
        at = _skip(text, 0)
        if text[at : at + 1] != "[":
            raise LogError(path, "not a JSON array of rows", "download or unpack it again")
        at += 1
        while True:
            at = _skip(text, at)
            if text[at : at + 1] == "]":
                return
            try:
                row, at = decoder.raw_decode(text, at)
            except json.JSONDecodeError as error:
                # A row may be cut off by the end of the chunk.
                more = file.read(_CHUNK)
                if not more:
                    raise LogError(path, f"not JSON, or cut off: {error}", "download or unpack it again") from None
                text, at = text[at:] + more, 0
                if label is not None:
                    label.step()
                continue
            if not isinstance(row, dict):
                raise LogError(path, f"a row is {row!r:.40}, not an object", "download or unpack it again")
            yield row


_SPACE = re.compile(r"[\s,]*")


def _skip(text: str, at: int) -> int:
    """The place of the next character that is no space and no comma."""
    found = _SPACE.match(text, at)
    return found.end() if found else at


def field(row: Any, name: str, place: str | Path) -> Any:
    """A field of a row."""
    if not isinstance(row, dict) or name not in row:
        raise LogError(place, f"a row has no field {name}: {row!r:.200}", "use files of the documented schema")
    return row[name]


def integer(value: Any, name: str, place: str | Path) -> int:
    """A whole number."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise LogError(place, f"{name} is {value!r:.80}, no whole number", "repair the file")
    return value


def text(value: Any, name: str, place: str | Path) -> str:
    """A text that is not empty."""
    if not isinstance(value, str) or not value:
        raise LogError(place, f"{name} is {value!r:.80}, no text", "repair the file")
    return value


def numbers(value: Any, shape: tuple[int, ...], name: str, place: str | Path) -> npt.NDArray[np.float64]:
    """Finite numbers of a shape."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        want = " x ".join(str(n) for n in shape)
        raise LogError(place, f"{name} is {value!r:.80}, not {want} finite numbers", "repair the file")
    return array
