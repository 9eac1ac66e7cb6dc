"""Places on the earth (WGS84): earth-centred coordinates, and the tangent plane at a place."""

from __future__ import annotations

import math

import numpy as np

from .frames import Matrix

__all__ = ["earth_centred", "geodetic", "tangent_plane"]

EQUATOR_M, FLATTENING = 6378137.0, 1 / 298.257223563
"""WGS84."""


def earth_centred(latitude_deg: float, longitude_deg: float, altitude_m: float) -> Matrix:
    """Earth-centred coordinates [3] of a place, in metres. altitude_m: above the ellipsoid."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    squared = FLATTENING * (2 - FLATTENING)
    normal = EQUATOR_M / math.sqrt(1 - squared * math.sin(latitude) ** 2)
    flat = (normal + altitude_m) * math.cos(latitude)
    up = (normal * (1 - squared) + altitude_m) * math.sin(latitude)
    return np.array([flat * math.cos(longitude), flat * math.sin(longitude), up])


def geodetic(xyz: Matrix) -> tuple[float, float, float]:
    """Latitude and longitude in degrees, and altitude in metres, of earth-centred coordinates [3] near the ground.

    The fixed point of latitude = atan2(z + e^2 N sin latitude, p), which converges by 1/150 in each step.
    """
    squared = FLATTENING * (2 - FLATTENING)
    flat = math.hypot(xyz[0], xyz[1])
    latitude = math.atan2(xyz[2], flat * (1 - squared))
    for _ in range(12):
        normal = EQUATOR_M / math.sqrt(1 - squared * math.sin(latitude) ** 2)
        latitude = math.atan2(xyz[2] + squared * normal * math.sin(latitude), flat)
    normal = EQUATOR_M / math.sqrt(1 - squared * math.sin(latitude) ** 2)
    altitude = flat * math.cos(latitude) + xyz[2] * math.sin(latitude)
    altitude -= normal * (1 - squared * math.sin(latitude) ** 2)
    return math.degrees(latitude), math.degrees(math.atan2(xyz[1], xyz[0])), altitude


def tangent_plane(latitude_deg: float, longitude_deg: float, altitude_m: float) -> tuple[Matrix, Matrix]:
    """The place in earth-centred coordinates [3], and the axes east, north, up there as rows [3, 3]."""
    a, b = math.radians(latitude_deg), math.radians(longitude_deg)
    axes = [
        [-math.sin(b), math.cos(b), 0.0],
        [-math.sin(a) * math.cos(b), -math.sin(a) * math.sin(b), math.cos(a)],
        [math.cos(a) * math.cos(b), math.cos(a) * math.sin(b), math.sin(a)],
    ]
    return earth_centred(latitude_deg, longitude_deg, altitude_m), np.array(axes)
