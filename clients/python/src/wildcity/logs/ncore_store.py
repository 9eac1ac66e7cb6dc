"""Component stores of NVIDIA's ncore V4: zarr (format 2) in a folder `*.zarr`, or in an indexed tar `*.zarr.itar`.

An indexed tar is a tar file with an index behind its end, which is not read: the records are found by their headers.
Only numbers, texts and bytes are read, by codecs that run no code of the file.
"""

from __future__ import annotations

import itertools
import json
import math
import tarfile
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt
from numcodecs import get_codec

from .errors import LogError

__all__ = ["Store"]

FIX = "download the store again"

MAX_ELEMENTS = 1 << 28

_CODECS = ("blosc", "zstd", "lz4", "zlib", "gzip", "bz2", "lzma")

_MAGIC = b"itar"
"""Begins the last block of an indexed tar."""


class Store:
    """One store, opened for reading."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stack = ExitStack()
        self._records: dict[str, tuple[int, int]] | None = None
        """Place and size of each file of an indexed tar."""
        if path.is_dir():
            if (path / "zarr.json").exists():
                raise LogError(path, "it is zarr of format 3", "write it with zarr_format=2, ncore's default")
            return
        try:
            self._records = _index(path)
            self._file = self._stack.enter_context(path.open("rb"))
        except OSError as error:
            raise LogError(path, f"cannot read: {error}", FIX) from None

    def __enter__(self) -> Store:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._stack.close()

    def bytes_of(self, key: str) -> bytes | None:
        """A file of the store; None if there is none."""
        if self._records is None:
            path = self.path / key
            return path.read_bytes() if path.is_file() else None
        if key not in self._records:
            return None
        place, size = self._records[key]
        self._file.seek(place)
        data = self._file.read(size)
        if len(data) != size:
            raise LogError(self.path, f"{key} is cut off", FIX)
        return data

    def names(self, group: str) -> list[str]:
        """Names in a group."""
        if self._records is None:
            return sorted(path.name for path in (self.path / group).glob("*") if path.is_dir())
        start = f"{group}/" if group else ""
        inside = {key[len(start) :].split("/")[0] for key in self._records if key.startswith(start)}
        return sorted(name for name in inside if not name.startswith(".z"))

    def attributes(self, node: str) -> dict[str, Any]:
        """Attributes of a group or an array; of the root for an empty name."""
        return self._json(f"{node}/.zattrs" if node else ".zattrs") or {}

    def _json(self, key: str) -> dict[str, Any] | None:
        data = self.bytes_of(key)
        try:
            found = None if data is None else json.loads(data)
        except ValueError as error:
            raise LogError(f"{self.path}, {key}", f"not JSON: {error}", FIX) from None
        if found is not None and not isinstance(found, dict):
            raise LogError(f"{self.path}, {key}", "no object of JSON", FIX)
        return found

    def array(self, node: str) -> npt.NDArray[Any]:
        """An array. Raises `LogError` if there is none."""
        place = f"{self.path}, {node}"
        its = self._json(f"{node}/.zarray")
        if its is None:
            raise LogError(place, "missing: an array", FIX)
        try:
            return self._decoded(node, its)
        except (AttributeError, KeyError, RuntimeError, SystemError, TypeError, ValueError) as error:
            raise LogError(place, f"no array of zarr: {type(error).__name__}: {error}", FIX) from None

    def _decoded(self, node: str, its: dict[str, Any]) -> npt.NDArray[Any]:
        shape, chunks, dtype = tuple(its["shape"]), tuple(its["chunks"]), np.dtype(its["dtype"])
        compressor = its.get("compressor")
        if dtype.kind not in "biufS" or its.get("filters") or its.get("order", "C") != "C":
            raise ValueError(f"{dtype}, filters {its.get('filters')} and order {its.get('order')} are not read")
        if len(chunks) != len(shape) or any(size < 1 for size in chunks) or any(size < 0 for size in shape):
            raise ValueError(f"shape {shape} in chunks of {chunks}")
        if max(math.prod(shape), math.prod(chunks)) * dtype.itemsize > MAX_ELEMENTS * 8:
            raise ValueError(f"shape {shape}: too large")
        if compressor is not None and compressor.get("id") not in _CODECS:
            raise ValueError(f"the codec {compressor.get('id')}")
        codec = None if compressor is None else get_codec(compressor)
        found = np.full(shape, its.get("fill_value") or 0, dtype)
        for numbers in itertools.product(
            *(range(-(-size // chunk)) for size, chunk in zip(shape, chunks, strict=True))
        ):
            name = its.get("dimension_separator", ".").join(str(number) for number in numbers) or "0"
            data = self.bytes_of(f"{node}/{name}")
            if data is not None:
                plain = data if codec is None else bytes(codec.decode(data))
                starts = [number * chunk for number, chunk in zip(numbers, chunks, strict=True)]
                here = tuple(slice(at, at + chunk) for at, chunk in zip(starts, chunks, strict=True))
                part = np.frombuffer(plain, dtype).reshape(chunks)
                found[here] = part[tuple(slice(0, size) for size in found[here].shape)]
        return found


def _index(path: Path) -> dict[str, tuple[int, int]]:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - tarfile.BLOCKSIZE))
        if file.read(len(_MAGIC)) != _MAGIC:
            raise LogError(path, "no index at its end: it is cut off, or no indexed tar", FIX)
    found = {}
    try:
        with tarfile.open(path, "r:") as archive:
            while (member := archive.next()) is not None:
                found[member.name] = (member.offset_data, member.size)
                archive.members = []  # type: ignore[attr-defined]  # It would hold a kilobyte of each.
    except tarfile.TarError as error:
        raise LogError(path, f"no tar: {error}", FIX) from None
    return found
