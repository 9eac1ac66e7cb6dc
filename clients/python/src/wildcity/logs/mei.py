"""The unified camera model (Mei and Rives 2007) as the fisheye lens of a rig file, fitted.

A ray at the angle t off the axis has the radius m = sin(t) / (cos(t) + xi), distorted to m (1 + k1 m^2 + k2 m^4) and
scaled by gamma. The fisheye lens has f t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8): its five numbers are those with the
least squared error over the field.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import LogError
from .lenses import MAX_FISHEYE_ANGLE, Intrinsics

__all__ = ["Fit", "Mei", "fisheye_of"]

MAX_ERROR_PX = 0.5
"""A fit that is worse is refused."""

MIN_SLOPE = 0.05
"""The field ends where the radius grows by less than this part of what it does at the axis."""


@dataclass(frozen=True)
class Mei:
    """xi: of the mirror. k [2], p [2]: radial and tangential distortion. gamma, center [2]: in pixels."""

    xi: float
    k: tuple[float, float]
    p: tuple[float, float]
    gamma: tuple[float, float]
    center: tuple[float, float]
    width: int
    height: int


@dataclass(frozen=True)
class Fit:
    """error_px: of the fit at most, within the field. tangential_px: of the terms of p, which are left out."""

    intrinsics: Intrinsics
    lens: dict[str, Any]
    error_px: float
    tangential_px: float


def fisheye_of(lens: Mei, place: str) -> Fit:
    """Raises `LogError` with `place` if the numbers are no lens, or if no fisheye lens is within `MAX_ERROR_PX`."""
    values = [lens.xi, *lens.k, *lens.p, *lens.gamma, *lens.center]
    if not np.isfinite(values).all() or min(lens.gamma) <= 0 or lens.xi < 0 or min(lens.width, lens.height) < 1:
        raise LogError(place, f"no intrinsics: xi, k, p, gamma and center are {values}", "download it again")
    angles = _field(lens)
    radii = _radius(lens, angles)
    powers = np.stack([angles**n for n in (1, 3, 5, 7, 9)], axis=1)
    found = np.linalg.lstsq(powers, radii, rcond=None)[0]
    error_px = float(abs(powers @ found - radii).max()) * max(lens.gamma)
    if not error_px <= MAX_ERROR_PX or found[0] <= 0:
        problem = f"no fisheye lens is nearer to it than {error_px:.3g} pixels"
        raise LogError(
            place, problem, f"remove the camera's folder, or calibrate it as equidistant ({MAX_ERROR_PX} px)"
        )
    scale = float(found[0])
    intrinsics = Intrinsics(lens.width, lens.height, lens.gamma[0] * scale, lens.gamma[1] * scale, *lens.center)
    k = [float(value) for value in found[1:] / scale]
    made = {"model": "fisheye", "k": k, "max_angle": round(float(angles[-1]), 4)}
    # |(2 p1 x y + p2 (r^2 + 2 x^2), ..)| is at most 3 r^2 |p|.
    m = float(_mirror(lens, angles[-1:])[0])
    tangential_px = 3 * m * m * float(np.hypot(*lens.p)) * max(lens.gamma)
    return Fit(intrinsics, made, error_px, tangential_px)


def _mirror(lens: Mei, angles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.asarray(np.sin(angles) / (np.cos(angles) + lens.xi))


def _radius(lens: Mei, angles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    m2 = _mirror(lens, angles) ** 2
    return np.asarray(_mirror(lens, angles) * (1 + m2 * (lens.k[0] + m2 * lens.k[1])))


def _field(lens: Mei) -> npt.NDArray[np.float64]:
    """Angles from 0 to the farthest side of the image, or to where the radius hardly grows."""
    angles = np.arange(0, MAX_FISHEYE_ANGLE, 1e-3)
    # The model ends where its denominator is 0.
    angles = angles[np.cos(angles) + lens.xi > 1e-3]
    radii = _radius(lens, angles)
    (cx, cy), (fx, fy) = lens.center, lens.gamma
    side = max(cx / fx, (lens.width - cx) / fx, cy / fy, (lens.height - cy) / fy)
    slopes = np.diff(radii)
    ends = np.flatnonzero((radii[1:] > side) | (slopes < MIN_SLOPE * slopes[0]))
    return np.asarray(angles[: int(ends[0]) + 2] if len(ends) else angles)
