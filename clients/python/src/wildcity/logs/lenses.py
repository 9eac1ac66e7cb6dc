"""Cameras of a rig file from the calibrations of others.

A rig file counts pixels from the corner of the image: the middle of the first pixel is at 0.5. OpenCV, and so most
calibrations, count from the middle of the first pixel: `from_middle=True` adds 0.5 to both coordinates of the principal
point. docs/cameras.md defines the lenses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .errors import LogError
from .frames import Matrix, pose_json, rotation_error
from .names import name_of

__all__ = ["Intrinsics", "camera", "check_mount", "fisheye", "lens_of", "opencv"]

MAX_FISHEYE_ANGLE = 2.8
"""The largest angle off the axis that a rig file accepts, in radians."""


@dataclass(frozen=True)
class Intrinsics:
    """Size, focal lengths and principal point, in pixels, as the source has them."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @staticmethod
    def of_matrix(size: Sequence[int], k: Any) -> Intrinsics:
        """size: width and height. k: the matrix [3, 3] of a pinhole."""
        return Intrinsics(int(size[0]), int(size[1]), float(k[0][0]), float(k[1][1]), float(k[0][2]), float(k[1][2]))


def opencv(coefficients: Sequence[float]) -> dict[str, Any] | None:
    """The lens of OpenCV's distortion coefficients, in OpenCV's order.

    coefficients: k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]]; OpenCV's tilts (tau) must be 0. None if all are
    0, which is a pinhole.
    """
    c = [float(value) for value in coefficients]
    if len(c) not in (0, 4, 5, 8, 12, 14) or any(c[12:]):
        raise ValueError(f"{len(c)} distortion coefficients: 4, 5, 8 or 12 are read, and tilted sensors are not")
    if not any(c):
        return None
    c += [0.0] * (12 - len(c))
    lens: dict[str, Any] = {"model": "opencv", "k": [c[0], c[1], *c[4:8]], "p": c[2:4]}
    return {**lens, "s": c[8:12]} if any(c[8:12]) else lens


def fisheye(coefficients: Sequence[float], intrinsics: Intrinsics) -> dict[str, Any]:
    """The lens of OpenCV's fisheye model (Kalibr and ROS: equidistant).

    coefficients: k1 to k4. Its `max_angle` reaches the corner of the image that is the farthest from the axis.
    """
    k = [float(value) for value in coefficients]
    if len(k) != 4:
        raise ValueError(f"{len(k)} coefficients of a fisheye lens: it has 4")
    return {"model": "fisheye", "k": k, "max_angle": _corner_angle(k, intrinsics)}


def _corner_angle(k: Sequence[float], i: Intrinsics) -> float:
    """The angle off the axis of the farthest corner, in radians, where theta (1 + k1 theta^2 + ..) still grows."""
    corner = max(math.hypot((x - i.cx) / i.fx, (y - i.cy) / i.fy) for x in (0, i.width) for y in (0, i.height))
    theta, step = 0.0, 1e-3
    while theta + step < MAX_FISHEYE_ANGLE:
        t2 = (theta + step) ** 2
        slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
        if slope <= 0 or (theta + step) * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) > corner:
            return round(theta + step, 3)
        theta += step
    return MAX_FISHEYE_ANGLE


_OPENCV_NAMES = ("radtan", "plumb_bob", "rational_polynomial", "opencv", "brown", "radial-tangential")
_FISHEYE_NAMES = ("equidistant", "equidistant4", "equi", "fisheye", "kannala_brandt", "kannalabrandt4")


def lens_of(model: str, coefficients: Sequence[float], intrinsics: Intrinsics, place: str) -> dict[str, Any] | None:
    """The lens of a distortion model by its name in Kalibr, ROS or OpenCV; None for a pinhole.

    Raises `LogError` with `place` for a model that rig files lack, such as `omni`, `ds`, `eucm` and `fov`.
    """
    name = model.strip().lower().replace("-", "_")
    try:
        if name in ("", "none", "pinhole"):
            return None if not any(coefficients) else opencv(coefficients)
        if name in _OPENCV_NAMES or name == "radial_tangential":
            return opencv(coefficients)
        if name in _FISHEYE_NAMES:
            return fisheye(coefficients, intrinsics)
    except ValueError as error:
        raise LogError(place, str(error), "calibrate with a model of docs/cameras.md") from None
    known = "opencv (radtan, plumb_bob, rational_polynomial) and fisheye (equidistant)"
    raise LogError(place, f"the lens model {model!r}; rigs have {known}", "calibrate with one of these models")


def camera(
    name: str,
    intrinsics: Intrinsics,
    rig_from_camera: Matrix,
    place: str,
    *,
    lens: dict[str, Any] | None = None,
    shutter: dict[str, Any] | None = None,
    from_middle: bool = True,
) -> dict[str, Any]:
    """A camera of a rig file. Raises `LogError` with `place` if it has no intrinsics or no valid pose."""
    i = intrinsics
    numbers = (i.fx, i.fy, i.cx, i.cy)
    if not all(math.isfinite(value) for value in numbers) or min(i.fx, i.fy) <= 0:
        problem = f"camera {name} has no intrinsics: fx, fy, cx, cy are {numbers}"
        raise LogError(place, problem, "calibrate the camera and write its focal lengths, in pixels")
    if min(i.width, i.height) < 1:
        raise LogError(place, f"camera {name} has the size {i.width} x {i.height}", "write its size, in pixels")
    if max(i.fx, i.fy) < 10 <= max(i.width, i.height):
        problem = f"camera {name} has focal lengths of {i.fx} and {i.fy}: too few pixels, and perhaps millimetres"
        raise LogError(place, problem, "write focal lengths in pixels")
    check_mount(f"camera {name}", rig_from_camera, place)
    shift = 0.5 if from_middle else 0.0
    found: dict[str, Any] = {"name": name_of(name), "width": i.width, "height": i.height}
    found |= {"fx": i.fx, "fy": i.fy, "cx": i.cx + shift, "cy": i.cy + shift}
    if lens is not None:
        found["lens"] = lens
    if shutter is not None:
        found["shutter"] = shutter
    return {**found, "camera_to_rig": pose_json(rig_from_camera)}


def check_mount(what: str, rig_from_sensor: Matrix, place: str) -> None:
    """Refuses a mount that is no rotation, or that is farther than 30 m away, which is a mistake of units."""
    if rotation_error(rig_from_sensor) > 1e-3:
        raise LogError(place, f"the pose of {what} is no rotation and translation", "write a rigid transform")
    distance = float(abs(rig_from_sensor[:3, 3]).max())
    if distance > 30:
        problem = (
            f"{what} is {distance:g} m from the rig's origin: no vehicle is so long, and perhaps it is millimetres"
        )
        raise LogError(place, problem, "write mounts in metres")
