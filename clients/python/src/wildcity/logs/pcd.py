"""Files of the Point Cloud Library (.pcd, binary) as a structured array."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import LogError
from .tableio import require

__all__ = ["pcd_points"]

MAX_POINTS = 1 << 25

_KINDS = {"I": "i", "U": "u", "F": "f"}


def pcd_points(path: Path, names: list[str]) -> npt.NDArray[Any]:
    """Points with at least these fields. Raises `LogError` for a file that is cut off, or of another encoding."""
    fix = "download it again"
    with require(path, "a sweep").open("rb") as file:
        header: dict[str, list[str]] = {}
        while "DATA" not in header:
            line = file.readline(4096)
            if not line.endswith(b"\n"):
                raise LogError(path, "no header of a PCD file", fix)
            key, *values = line.decode("ascii", "replace").split() or ["#"]
            header[key.upper()] = values
        try:
            kinds = [_KINDS[kind] + size for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
            counts = [int(count) for count in header.get("COUNT", ["1"] * len(kinds))]
            row = np.dtype([(name, "<" + kind, (count,)) if count > 1 else (name, "<" + kind)
                            for name, kind, count in zip(header["FIELDS"], kinds, counts, strict=True)])  # fmt: skip
            points = int(header["POINTS"][0])
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise LogError(path, f"no header of a PCD file: {type(error).__name__} {error}", fix) from None
        if header["DATA"] != ["binary"]:
            raise LogError(path, f"its points are {' '.join(header['DATA'])}, and binary ones are read", fix)
        missing = [name for name in names if name not in (row.names or ())]
        if missing or not 0 <= points <= MAX_POINTS:
            raise LogError(path, f"{points} points, without the fields {missing}", "use files of the documented schema")
        data = file.read(points * row.itemsize)
    if len(data) != points * row.itemsize:
        raise LogError(path, f"{len(data)} bytes of {points} points of {row.itemsize} bytes: it is cut off", fix)
    return np.frombuffer(data, row)
