"""Sweeps of a LiDAR as safetensors."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Sweep", "write_safetensors"]

FARTHEST_M = 2000.0
"""No LiDAR of a vehicle sees so far."""

_DTYPES = {"<f4": "F32", "<f8": "F64", "<i8": "I64", "<u2": "U16"}


def write_safetensors(path: Path, tensors: dict[str, npt.NDArray[Any]]) -> None:
    """Writes arrays of little-endian f32, f64, i64 or u16, in this order."""
    header: dict[str, Any] = {}
    offset = 0
    for name, values in tensors.items():
        end = offset + values.nbytes
        dtype = _DTYPES[values.dtype.newbyteorder("<").str]
        header[name] = {"dtype": dtype, "shape": list(values.shape), "data_offsets": [offset, end]}
        offset = end
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for values in tensors.values():
            file.write(np.ascontiguousarray(values).tobytes())


@dataclass
class Sweep:
    """Points of one rotation.

    points_m [n, 3]: in the axes of the LiDAR, in metres. time_us [n]: when each was measured, on the source's clock.
    intensity [n] and ring [n]: as the source has them, or None.
    """

    points_m: npt.NDArray[Any]
    time_us: npt.NDArray[np.int64]
    intensity: npt.NDArray[Any] | None = None
    ring: npt.NDArray[Any] | None = None

    def write(self, path: Path, epoch_us: int) -> dict[str, Any]:
        """Writes the finite points, sorted by time (points of one time keep their order), in log time.

        Returns the first and the last time on the source's clock, how many points were not finite, and how many there
        are. A sweep without points has no times. Raises `ValueError` for points that are no metres, and for numbers of
        lasers that are none.
        """
        keep = np.isfinite(self.points_m).all(axis=1)
        order = np.flatnonzero(keep)
        if len(order) and np.median(np.abs(self.points_m[order]).max(axis=1)) > FARTHEST_M:
            raise ValueError(f"half of its points are farther than {FARTHEST_M:g} m: perhaps they are millimetres")
        order = order[np.argsort(self.time_us[order], kind="stable")]
        tensors: dict[str, npt.NDArray[Any]] = {
            "points_m": self.points_m[order].astype("<f4"),
            "time_us": (self.time_us[order] - epoch_us).astype("<i8"),
        }
        if self.intensity is not None:
            tensors["intensity"] = self.intensity[order].astype("<f4")
        if self.ring is not None:
            ring = self.ring[order]
            if len(ring) and not (ring.min() >= 0 and ring.max() <= 65_535):
                raise ValueError(f"numbers of lasers from {ring.min()} to {ring.max()}: they are 0 to 65535")
            tensors["ring"] = ring.astype("<u2")
        write_safetensors(path, tensors)
        found = {"points": len(order), "dropped": int(len(keep) - len(order))}
        if len(order):
            found |= {"first_us": int(self.time_us[order[0]]), "last_us": int(self.time_us[order[-1]])}
        return found
