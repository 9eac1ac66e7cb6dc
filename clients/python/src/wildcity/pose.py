"""Poses. The other messages are generated, in `messages`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

    @classmethod
    def flat(cls, x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> Pose:
        """A pose on level ground: metres, and the angle from the x axis to the left in radians."""
        return cls((x, y, z), (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)))

    @property
    def yaw(self) -> float:
        """The heading: the angle from the x axis to the left, in radians, -pi to pi."""
        w, x, y, z = self.q
        # Of the rotated x axis; equal factors of a quaternion that is no unit cancel.
        return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[4, 4]: `matrix @ (x, y, z, 1)` takes a point out of the frame of this pose."""
        whole = np.eye(4)
        whole[:3, :3] = self.rotation
        whole[:3, 3] = self.xyz
        return whole

    @property
    def rotation(self) -> NDArray[np.float64]:
        """[3, 3]: the axes of the pose are its columns."""
        w, x, y, z = self._unit()
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    @property
    def inverse(self) -> Pose:
        """The way back: `pose.inverse @ pose` is the identity."""
        w, x, y, z = self._unit()
        return Pose(_vector(-(self.rotation.T @ self.xyz)), (w, -x, -y, -z))

    def __matmul__(self, other: Pose) -> Pose:
        """This pose after another: `world_from_rig @ rig_from_camera` is `world_from_camera`."""
        w, x, y, z = self._unit()
        a, b, c, d = other._unit()
        q = (
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        )
        return Pose(_vector(self.rotation @ other.xyz + np.asarray(self.xyz)), q)

    def _unit(self) -> Quaternion:
        length = math.hypot(*self.q)
        if length == 0.0:
            raise ValueError("q is (0, 0, 0, 0), which is no rotation")
        w, x, y, z = (value / length for value in self.q)
        return w, x, y, z


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


class Motion:
    """What follows from the state of the ego; `Ego` has it."""

    pose: Pose
    velocity: Vector

    @property
    def speed(self) -> float:
        """The length of the velocity, in m/s; below 0 if the car moves backwards."""
        ahead = float(np.dot(self.pose.rotation[:, 0], self.velocity))
        return math.copysign(math.hypot(*self.velocity), ahead) if ahead != 0.0 else math.hypot(*self.velocity)

    @property
    def yaw(self) -> float:
        """The heading of the car: see `Pose.yaw`."""
        return self.pose.yaw
