"""Cameras of NVIDIA's ncore as cameras of a rig file: docs/data/sensor_models.rst in ncore's repository.

Its image coordinates begin at the corner of the image, as ours do, except the principal point of `ftheta`, which counts
from the middle of the first pixel.
"""

from __future__ import annotations

from typing import Any

from .errors import LogError
from .frames import Matrix, pose_json
from .lenses import Intrinsics, camera, check_mount, opencv
from .names import name_of
from .tableio import field, numbers

__all__ = ["camera_of"]

_SHUTTERS = {
    "ROLLING_TOP_TO_BOTTOM": "top_to_bottom",
    "ROLLING_LEFT_TO_RIGHT": "left_to_right",
    "ROLLING_BOTTOM_TO_TOP": "bottom_to_top",
    "ROLLING_RIGHT_TO_LEFT": "right_to_left",
    "GLOBAL": None,
}


def camera_of(name: str, model: Any, found: dict[str, Any], rig_from_camera: Matrix, place: str) -> dict[str, Any]:
    """The camera of `model_type` and `model_parameters`, with its windshield and its shutter."""
    width, height = (int(value) for value in numbers(field(found, "resolution", place), (2,), "resolution", place))
    center = [float(value) for value in numbers(field(found, "principal_point", place), (2,), "principal_point", place)]
    shutter = _shutter(found, place)
    if model == "ftheta":
        made = _ftheta(name, found, (width, height), center, rig_from_camera, place)
        if shutter:
            made["shutter"] = shutter
    elif model in ("opencv-fisheye", "opencv-pinhole"):
        focal = [float(value) for value in numbers(field(found, "focal_length", place), (2,), "focal_length", place)]
        intrinsics = Intrinsics(width, height, *focal, *center)
        lens = _fisheye(found, place) if model == "opencv-fisheye" else _pinhole(found, place)
        made = camera(name, intrinsics, rig_from_camera, place, lens=lens, shutter=shutter, from_middle=False)
    else:
        known = "ftheta, opencv-fisheye and opencv-pinhole"
        raise LogError(place, f"the lens model {model!r}; {known} are read", "use a clip of the documented schema")
    windshield = _windshield(found, place)
    return {**made, "windshield": windshield} if windshield else made


def _shutter(found: dict[str, Any], place: str) -> dict[str, Any] | None:
    kind = field(found, "shutter_type", place)
    if kind not in _SHUTTERS:
        raise LogError(place, f"shutter_type is {kind!r}", "use a clip of the documented schema")
    direction, duration = _SHUTTERS[kind], int(found.get("shutter_delay_us", 0))
    return {"direction": direction, "duration_us": duration} if direction and duration > 0 else None


def _ftheta(
    name: str, found: dict[str, Any], size: tuple[int, int], center: list[float], rig_from_camera: Matrix, place: str
) -> dict[str, Any]:
    check_mount(f"camera {name}", rig_from_camera, place)
    forward = field(found, "reference_poly", place) == "ANGLE_TO_PIXELDIST"
    key = "angle_to_pixeldist_poly" if forward else "pixeldist_to_angle_poly"
    values = [float(value) for value in field(found, key, place)]
    if not 2 <= len(values) <= 6 or values[1] <= 0:
        raise LogError(place, f"camera {name} has no intrinsics: {key} is {values}", "download the clip again")
    lens = {
        "model": "ftheta",
        "reference": "angle_to_pixel" if forward else "pixel_to_angle",
        "polynomial": values + [0.0] * (6 - len(values)),
        "linear_cde": [float(value) for value in found.get("linear_cde") or (1.0, 0.0, 0.0)],
        "max_angle": float(field(found, "max_angle", place)),
    }
    middle = {"cx": center[0] + 0.5, "cy": center[1] + 0.5}
    made = {"name": name_of(name), "width": size[0], "height": size[1], **middle, "lens": lens}
    return {**made, "camera_to_rig": pose_json(rig_from_camera)}


def _fisheye(found: dict[str, Any], place: str) -> dict[str, Any]:
    k = numbers(field(found, "radial_coeffs", place), (4,), "radial_coeffs", place)
    return {"model": "fisheye", "k": [float(v) for v in k], "max_angle": float(field(found, "max_angle", place))}


def _pinhole(found: dict[str, Any], place: str) -> dict[str, Any] | None:
    """OpenCV's order is k1, k2, p1, p2, k3, k4, k5, k6, s1 to s4."""
    k = [float(v) for v in numbers(field(found, "radial_coeffs", place), (6,), "radial_coeffs", place)]
    p = [float(v) for v in numbers(field(found, "tangential_coeffs", place), (2,), "tangential_coeffs", place)]
    s = [float(v) for v in numbers(field(found, "thin_prism_coeffs", place), (4,), "thin_prism_coeffs", place)]
    return opencv([*k[:2], *p, *k[2:], *s])


def _windshield(found: dict[str, Any], place: str) -> dict[str, Any] | None:
    its = found.get("external_distortion_parameters")
    if its is None:
        return None
    kind = found.get("external_distortion_type", "bivariate-windshield")
    if kind != "bivariate-windshield":
        raise LogError(place, f"external_distortion_type is {kind!r}", "use a clip of the documented schema")
    forward = field(its, "reference_poly", place) == "FORWARD"
    ending = "" if forward else "_inverse"
    found_parts = {part: field(its, f"{part}_poly{ending}", place) for part in ("horizontal", "vertical")}
    parts = {part: [float(value) for value in values] for part, values in found_parts.items()}
    return {"reference": "forward" if forward else "backward", **parts}
