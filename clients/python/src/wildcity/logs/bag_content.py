"""Images, calibrations and point clouds of ROS messages (sensor_msgs: their definitions say shapes and units)."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from .errors import LogError
from .frames import Matrix, inverse
from .lenses import Intrinsics, camera, lens_of
from .points import Sweep

__all__ = ["camera_of", "compressed_suffix", "png_of", "sweep_of"]

_CHANNELS = {"rgb8": "RGB", "bgr8": "BGR", "rgba8": "RGBA", "bgra8": "BGRA", "mono8": "L", "8UC1": "L", "8UC3": "BGR"}
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField: datatype to the type of NumPy, without the byte order."""

_TIMES = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset", "stamp")
"""Names of the field of a point's time: Ouster, Velodyne, Hesai and RoboSense, Autoware, Livox."""

MAX_SWEEP_S = 2.0
"""A point that is farther from the stamp of its cloud has a time in another unit than its type says."""


def png_of(message: Any, place: str) -> bytes:
    """A sensor_msgs/Image as PNG, without loss: 8 bits, or 16 bits of one channel."""
    encoding, height, width = message.encoding, int(message.height), int(message.width)
    data = np.asarray(message.data, np.uint8)
    is_wide = encoding in ("mono16", "16UC1")
    if not is_wide and encoding not in _CHANNELS:
        problem = f"the encoding {encoding!r}; {', '.join((*_CHANNELS, 'mono16', '16UC1'))} are read"
        raise LogError(place, problem, "convert the topic with image_proc or image_transport, and record that")
    channels = 1 if is_wide else len(_CHANNELS[encoding])
    row = width * channels * (2 if is_wide else 1)
    if len(data) < int(message.step) * height or int(message.step) < row:
        problem = f"{len(data)} bytes for {width} x {height} {encoding} with rows of {message.step} bytes"
        raise LogError(place, problem, "the bag is damaged: record it again")
    rows = data[: int(message.step) * height].reshape(height, int(message.step))[:, :row]
    if is_wide:
        pixels: npt.NDArray[Any] = np.ascontiguousarray(rows).view(">u2" if message.is_bigendian else "<u2")
        image = Image.fromarray(pixels.astype(np.uint16))
    else:
        pixels = rows.reshape((height, width, channels) if channels > 1 else (height, width))
        if encoding.startswith("bgr") or encoding == "8UC3":
            pixels = pixels[..., [2, 1, 0, 3][:channels]]
        image = Image.fromarray(np.ascontiguousarray(pixels))
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=3)
    return out.getvalue()


def compressed_suffix(data: bytes, place: str) -> str:
    """The suffix of a sensor_msgs/CompressedImage by its first bytes."""
    for magic, suffix in ((b"\xff\xd8\xff", ".jpg"), (b"\x89PNG\r\n\x1a\n", ".png")):
        if data.startswith(magic):
            return suffix
    raise LogError(place, "a compressed image is neither JPEG nor PNG", "record JPEG or PNG")


def camera_of(name: str, info: Any, rig_from_camera: Matrix, place: str, *, is_rectified: bool) -> dict[str, Any]:
    """The camera of a sensor_msgs/CameraInfo.

    Raw images have K and D. Rectified ones have the left 3 x 3 part of P, no distortion, and axes turned by R. The
    definition of CameraInfo says so. A binned or cropped image is refused.
    """
    fields = {one.lower(): getattr(info, one) for one in dir(info) if one in ("K", "D", "P", "R", "k", "d", "p", "r")}
    roi, size = info.roi, (int(info.width), int(info.height))
    is_cropped = bool(roi.width and roi.height) and (int(roi.width), int(roi.height)) != size
    if max(info.binning_x, info.binning_y) > 1 or is_cropped or roi.x_offset or roi.y_offset:
        raise LogError(place, "binning or a region of interest", "record whole images with their own camera_info")
    if is_rectified:
        p = np.reshape(fields["p"], (3, 4))
        if abs(p[:, 3]).max() > 0:
            raise LogError(place, "the second camera of a rectified pair", "record its raw images")
        turn = np.eye(4)
        turn[:3, :3] = np.reshape(fields["r"], (3, 3)) if np.any(fields["r"]) else np.eye(3)
        return camera(name, Intrinsics.of_matrix(size, p[:, :3]), rig_from_camera @ inverse(turn), place)
    intrinsics = Intrinsics.of_matrix(size, np.reshape(fields["k"], (3, 3)))
    lens = lens_of(info.distortion_model, [float(value) for value in fields["d"]], intrinsics, place)
    return camera(name, intrinsics, rig_from_camera, place, lens=lens)


def sweep_of(message: Any, stamp_ns: int, place: str) -> tuple[Sweep, bool]:
    """The points of a sensor_msgs/PointCloud2, and whether they have a time each.

    A time is in nanoseconds after the stamp if it is an integer, in seconds after it if it is a float. An integer of 64
    bits or a float of 64 bits may also be absolute, then it is near the stamp: of nanoseconds or of seconds.
    """
    points = _structured(message, place)
    names = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise LogError(place, f"the fields of a point are {', '.join(names)}", "record clouds with x, y and z")
    xyz = np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1)
    found = next((name for name in _TIMES if name in names), None)
    if found is None:
        times_ns = np.full(len(points), stamp_ns, np.int64)
    else:
        times_ns = _times_ns(points[found], stamp_ns, f"{place}, field {found}")
    intensity = next((points[name] for name in ("intensity", "i", "reflectivity") if name in names), None)
    ring = next((points[name] for name in ("ring", "channel", "laser_id", "line") if name in names), None)
    return Sweep(xyz, times_ns // 1000, intensity, ring), found is not None


def _structured(message: Any, place: str) -> npt.NDArray[Any]:
    order = ">" if message.is_bigendian else "<"
    fields = [one for one in message.fields if int(one.datatype) in _DTYPES and one.name]
    formats = [order + _DTYPES[int(one.datatype)] for one in fields]
    step, row_step = int(message.point_step), int(message.row_step)
    height, width = int(message.height), int(message.width)
    data = np.asarray(message.data, np.uint8)
    if step < 1 or row_step < width * step or len(data) < height * row_step:
        problem = f"{len(data)} bytes for {height} rows of {width} points of {step} bytes"
        raise LogError(place, problem, "the bag is damaged: record it again")
    rows = data[: height * row_step].reshape(height, row_step)[:, : width * step]
    names, offsets = [one.name for one in fields], [int(one.offset) for one in fields]
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    return np.ascontiguousarray(rows).reshape(-1).view(dtype)


def _times_ns(values: npt.NDArray[Any], stamp_ns: int, place: str) -> npt.NDArray[np.int64]:
    if not len(values):
        return np.zeros(0, np.int64)
    usual = float(np.nanmedian(values))
    if values.dtype.kind in "iu":
        is_absolute = values.dtype.itemsize == 8 and abs(usual - stamp_ns) < abs(usual)
        times = values.astype(np.int64) + (0 if is_absolute else stamp_ns)
    else:
        unit = next((unit for unit in (1.0, 1e9) if abs(usual * unit - stamp_ns) < 60e9), None)
        if values.dtype.itemsize == 8 and unit is not None:
            # Whole seconds first: a float of 64 bits has about 200 ns at today's times.
            times = np.rint(values * unit).astype(np.int64)
        else:
            times = stamp_ns + np.rint(np.nan_to_num(values.astype(np.float64)) * 1e9).astype(np.int64)
    worst = int(abs(times - stamp_ns).max())
    if worst > MAX_SWEEP_S * 1e9:
        problem = f"a point is {worst / 1e9:g} s from the stamp of its cloud, so its unit is not the documented one"
        raise LogError(place, problem, "record integers in nanoseconds, or floats in seconds, after the stamp")
    return times
