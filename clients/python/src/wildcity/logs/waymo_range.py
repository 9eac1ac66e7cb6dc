"""Points of Waymo's range images: the formulas of range_image_utils.py in the repository of the data set.

A range image [h, w, 4] has the range, the intensity, the elongation and a flag of each pixel. Row 0 is the highest
beam. Column c has the azimuth pi (2 (w - c - 1/2)/w - 1) less the heading of the LiDAR on the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .frames import Matrix, inverse
from .points import Sweep

__all__ = ["Pixels", "points_of"]


@dataclass
class Pixels:
    """One row of the component `lidar`.

    row: its columns. names: those of the values and the shape of both returns. inclinations: of the beams from the
    lowest, in rad, or None if they are spread evenly over `bounds`. poses: of each pixel [h, w, 6], or None.
    """

    row: dict[str, Any]
    names: list[str]
    vehicle_from_laser: Matrix
    inclinations: Any
    bounds: tuple[float, float]
    poses: Any


def points_of(pixels: Pixels, world_from_frame: Matrix, world_from_rig: Matrix, time_us: int) -> Sweep:
    """Points of both returns in the axes of the laser, as it stands on the rig at the pose `world_from_rig`."""
    laser_from_world = inverse(world_from_rig @ pixels.vehicle_from_laser)
    found = []
    for values, shape in (pixels.names[:2], pixels.names[2:]):
        if pixels.row[values].is_valid and pixels.row[shape].is_valid:
            image = pixels.row[values].values.to_numpy().reshape(pixels.row[shape].as_py())
            world, rows, intensity = _world(image, pixels, world_from_frame)
            found.append((world @ laser_from_world[:3, :3].T + laser_from_world[:3, 3], rows, intensity))
    points, rows, intensity = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Sweep(points, np.full(len(points), time_us, np.int64), intensity, rows)


def _world(image: Any, pixels: Pixels, world_from_frame: Matrix) -> tuple[Any, Any, Any]:
    """Points [n, 3] of the world, rows of the image [n], and intensities [n]."""
    height, width = image.shape[:2]
    rows, columns = np.nonzero(image[..., 0] > 0)
    ranges = image[rows, columns, 0].astype(np.float64)
    low, high = pixels.bounds
    even = low + (np.arange(height) + 0.5) / height * (high - low)
    inclination = np.asarray(even if pixels.inclinations is None else pixels.inclinations, np.float64)[::-1][rows]
    mount = pixels.vehicle_from_laser
    heading = np.arctan2(mount[1, 0], mount[0, 0])
    azimuth = (2 * (width - columns - 0.5) / width - 1) * np.pi - heading
    flat = np.cos(inclination)
    laser = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(inclination)], axis=1) * ranges[:, None]
    vehicle = laser @ mount[:3, :3].T + mount[:3, 3]
    if pixels.poses is None:
        world = vehicle @ world_from_frame[:3, :3].T + world_from_frame[:3, 3]
    else:
        poses = pixels.poses[rows, columns].astype(np.float64)
        world = np.einsum("nij,nj->ni", _rotations(poses[:, :3]), vehicle) + poses[:, 3:]
    return world, rows, image[rows, columns, 1]


def _rotations(angles: Any) -> Any:
    """Rz(yaw) Ry(pitch) Rx(roll) [n, 3, 3] of roll, pitch, yaw [n, 3]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
