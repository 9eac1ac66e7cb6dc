"""Stand-ins for models, to test an agent without their weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import alpamayo

__all__ = ["Alpamayo", "ModelInputError"]

_DTYPES = {
    "image_frames": np.uint8,
    "camera_indices": np.int64,
    "ego_history_xyz": np.float32,
    "ego_history_rot": np.float32,
    "absolute_timestamps": np.int64,
    "relative_timestamps": np.float32,
}


class ModelInputError(ValueError):
    """An input that the published drivers of Alpamayo refuse, or that the model would misread."""


class Alpamayo:
    """Returns a circular arc for every input that Alpamayo's published drivers accept.

    Checks what AlpaSim's driver checks (set of cameras, four frames each, 1.5 s of poses that reach t0, no frame after
    t0) and what AlpaGym's does (rising times, one image shape, 20 waypoints of a route if there is one), and also the
    type and shape of every array and the order of the cameras.
    """

    def __init__(
        self,
        model: alpamayo.Model = "1.5",
        task: str = "trajectory",
        *,
        speed: float = 5.0,
        curvature: float = 0.0,
        samples: int = 1,
    ) -> None:
        """`speed` in m/s and `curvature` in 1/m (positive to the left) of the arc; `samples` is the number of arcs."""
        self.model = model
        self.indices = [alpamayo.CAMERAS[name] for name in alpamayo.cameras(model, task)]
        self.speed = speed
        self.curvature = curvature
        self.samples = samples
        self.calls = 0

    def __call__(
        self, data: Mapping[str, Any], route: Any = None, nav_text: str | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """`pred_xyz` (1, 1, S, 64, 3) and `pred_rot` (1, 1, S, 64, 3, 3). Raises `ModelInputError`."""
        arrays = {key: np.asarray(data[key]) if key in data else None for key in _DTYPES}
        self._check_types(arrays)
        self._check_cameras(arrays)
        self._check_times(arrays, int(data["t0_us"]))
        self._check_history(arrays)
        if route is not None and np.asarray(route).shape[:1] != (20,):
            raise ModelInputError(f"the route has {len(route)} waypoints; expected 20")
        if nav_text is not None and (self.model != "1.5" or "<|" in nav_text):
            raise ModelInputError(f"nav_text is {nav_text!r}: model 1.5 takes one, without tokens of the model")
        self.calls += 1
        return self._arc()

    def _check_types(self, arrays: Mapping[str, Any]) -> None:
        cameras = len(self.indices)
        shapes = {
            "camera_indices": (cameras,),
            "ego_history_xyz": (1, 1, 16, 3),
            "ego_history_rot": (1, 1, 16, 3, 3),
            "absolute_timestamps": (cameras, 4),
            "relative_timestamps": (cameras, 4),
        }
        for key, dtype in _DTYPES.items():
            array = arrays[key]
            if array is None:
                raise ModelInputError(f"{key} is missing")
            if array.dtype != dtype:
                raise ModelInputError(f"{key} is {array.dtype}; expected {np.dtype(dtype)}")
            if key in shapes and array.shape != shapes[key]:
                raise ModelInputError(f"{key} has shape {array.shape}; expected {shapes[key]}")
        frames = arrays["image_frames"]
        if frames.ndim != 5 or frames.shape[:3] != (cameras, 4, 3) or 0 in frames.shape:
            raise ModelInputError(f"image_frames has shape {frames.shape}; expected ({cameras}, 4, 3, H, W)")

    def _check_cameras(self, arrays: Mapping[str, Any]) -> None:
        indices = arrays["camera_indices"].tolist()
        if set(indices) != set(self.indices):
            raise ModelInputError(f"the cameras are {indices}; expected {self.indices}")
        if indices != self.indices:
            raise ModelInputError(f"the cameras are in the order {indices}; expected {self.indices}")

    def _check_times(self, arrays: Mapping[str, Any], t0_us: int) -> None:
        for index, times in zip(self.indices, arrays["absolute_timestamps"], strict=True):
            if not (np.diff(times) > 0).all():
                raise ModelInputError(f"the times of camera {index} do not rise: {times.tolist()}")
            if times[-1] > t0_us:
                raise ModelInputError(f"camera {index} has a frame of {times[-1]} us, after t0 = {t0_us} us")
            if t0_us - times[-1] >= alpamayo.PERIOD_US:
                raise ModelInputError(f"camera {index} is stale: {times[-1]} us, t0 is {t0_us} us")

    def _check_history(self, arrays: Mapping[str, Any]) -> None:
        xyz = arrays["ego_history_xyz"][0, 0]
        rotations = arrays["ego_history_rot"][0, 0]
        if not (np.isfinite(xyz).all() and np.isfinite(rotations).all()):
            raise ModelInputError("the ego history has numbers that are not finite")
        if np.abs(xyz[-1]).max() > 1e-4 or np.abs(rotations[-1] - np.eye(3)).max() > 1e-4:
            raise ModelInputError("the last pose of the ego history is not the identity")

    def _arc(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        ahead = self.speed * 0.1 * np.arange(1, 65)
        heading = self.curvature * ahead
        # sin(x)/x and (1 - cos(x))/x of the heading, which np.sinc gives without a division by zero at 0.
        half = np.sinc(heading / (2 * np.pi))
        x = ahead * np.sinc(heading / np.pi)
        y = ahead * half * np.sin(heading / 2)
        xyz = np.stack([x, y, np.zeros(64)], axis=-1)
        cos = np.cos(heading)
        sin = np.sin(heading)
        rotations = np.zeros((64, 3, 3))
        rotations[:, 0, 0] = cos
        rotations[:, 0, 1] = -sin
        rotations[:, 1, 0] = sin
        rotations[:, 1, 1] = cos
        rotations[:, 2, 2] = 1.0
        shape = (1, 1, self.samples, 64)
        pred_xyz = np.ascontiguousarray(np.broadcast_to(xyz, (*shape, 3)), np.float32)
        pred_rot = np.ascontiguousarray(np.broadcast_to(rotations, (*shape, 3, 3)), np.float32)
        return pred_xyz, pred_rot
