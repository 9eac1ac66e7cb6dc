"""Poses. The other messages are generated, in `messages`."""

from __future__ import annotations

import math
from dataclasses import dataclass

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class Pose:
    """A rigid transform: position in metres, unit quaternion (w, x, y, z)."""

    xyz: Vector = (0.0, 0.0, 0.0)
    q: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        # Accepts lists and arrays, and stores tuples of floats.
        for name, count in (("xyz", 3), ("q", 4)):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != count:
                raise ValueError(f"{name} has {len(values)} numbers; a pose needs {count}")
            for index, value in enumerate(values):
                if not math.isfinite(value):
                    raise ValueError(f"{name}[{index}] is {value}; a pose needs finite numbers")
            object.__setattr__(self, name, values)
