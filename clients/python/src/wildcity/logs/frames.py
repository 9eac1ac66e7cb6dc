"""Rigid transforms as 4 x 4 matrices, and their rows in a log.

`a_from_b` transforms coordinates in b to a. Matrices are float64 [4, 4], positions are in metres, quaternions are
(w, x, y, z). The axes of world, rig and camera are those of protocol/README.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

__all__ = [
    "CAMERA_AXES",
    "Matrix",
    "Poses",
    "inverse",
    "pose_json",
    "quaternion",
    "rotation",
    "rotation_error",
    "transform",
]

Matrix: TypeAlias = npt.NDArray[np.float64]

CAMERA_AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""rig_from_camera of a camera at the rig's origin that looks along the rig's x axis."""


def rotation(q: Sequence[float] | Matrix) -> Matrix:
    """The rotation matrix [3, 3] of a quaternion (w, x, y, z) of any length above 0."""
    w, x, y, z = np.asarray(q, np.float64) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(matrix: Matrix) -> Matrix:
    """The unit quaternion (w, x, y, z) with w >= 0 of a rotation matrix [3, 3].

    Of the four equal formulas (Shepperd 1978) it takes the one whose divisor is the largest.
    """
    m = np.asarray(matrix, np.float64)
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    squares = np.array([1 + trace, *(1 + 2 * np.diag(m) - trace)])
    largest = int(np.argmax(squares))
    if largest == 0:
        q = np.array([squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.zeros(4)
        q[0], q[1 + i] = m[k, j] - m[j, k], squares[largest]
        q[1 + j], q[1 + k] = m[j, i] + m[i, j], m[k, i] + m[i, k]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0 else -q


def transform(xyz: Sequence[float] | Matrix, q: Sequence[float] | Matrix = (1.0, 0.0, 0.0, 0.0)) -> Matrix:
    """The matrix [4, 4] of a position in metres and a quaternion (w, x, y, z)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation(q), xyz
    return matrix


def inverse(matrix: Matrix) -> Matrix:
    """The inverse of a rigid transform [4, 4]."""
    result = np.eye(4)
    result[:3, :3] = matrix[:3, :3].T
    result[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return result


def rotation_error(matrix: Matrix) -> float:
    """How far the upper left 3 x 3 part is from a rotation: the largest entry of R R^T - 1; 2 for a reflection.

    Infinite if an entry is not finite, or more than 1e12.
    """
    r = np.asarray(matrix, np.float64)[:3, :3]
    # No place is so far, and squares of larger numbers overflow.
    if not (np.abs(matrix) < 1e12).all():
        return float("inf")
    return 2.0 if np.linalg.det(r) < 0 else float(np.abs(r @ r.T - np.eye(3)).max())


def pose_json(matrix: Matrix) -> dict[str, Any]:
    """A transform as JSON has it: `{"xyz": [x, y, z], "q": [w, x, y, z]}`."""
    return {"xyz": [float(v) for v in matrix[:3, 3]], "q": [float(v) for v in quaternion(matrix[:3, :3])]}


class Poses:
    """Timed poses, interpolated: linear in position, SLERP in rotation."""

    def __init__(self, times_us: Sequence[int], poses: Sequence[Matrix]) -> None:
        """times_us: strictly increasing. poses: one transform [4, 4] for each time."""
        self.times_us = np.asarray(times_us, np.int64)
        self.xyz = np.array([pose[:3, 3] for pose in poses])
        self.q = np.array([quaternion(pose[:3, :3]) for pose in poses])

    def covers(self, time_us: int) -> bool:
        """Whether the time is between the first and the last pose."""
        return len(self.times_us) > 0 and bool(self.times_us[0] <= time_us <= self.times_us[-1])

    def at(self, time_us: int) -> Matrix:
        """The pose [4, 4] at a time that the poses cover."""
        after = int(np.searchsorted(self.times_us, time_us))
        if self.times_us[after] == time_us:
            return transform(self.xyz[after], self.q[after])
        before = after - 1
        part = float(time_us - self.times_us[before]) / float(self.times_us[after] - self.times_us[before])
        xyz = (1 - part) * self.xyz[before] + part * self.xyz[after]
        return transform(xyz, _slerp(self.q[before], self.q[after], part))


def _slerp(a: Matrix, b: Matrix, part: float) -> Matrix:
    cosine = float(a @ b)
    if cosine < 0:
        a, cosine = -a, -cosine
    if cosine > 1 - 1e-12:
        return (1 - part) * a + part * b
    angle = np.arccos(cosine)
    return np.asarray((np.sin((1 - part) * angle) * a + np.sin(part * angle) * b) / np.sin(angle))
