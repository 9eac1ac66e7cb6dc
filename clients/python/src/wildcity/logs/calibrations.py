"""Calibrations in files of their own: rig files, Kalibr's camchain, ROS' camera_info and EuRoC's sensor.yaml.

- Kalibr (wiki, "Yaml formats"): cam0, cam1, .. each with `T_cam_imu`, or the first without a mount and the others with
  `T_cn_cnm1`, the transform from the camera before to this one. The mount is then relative to the IMU or to cam0.
- ROS (camera_calibration_parsers): the fields of sensor_msgs/CameraInfo; no mount.
- EuRoC (ASL data set format): `T_BS` is body_from_sensor.

All of them count pixels from the middle of the first one.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LogError
from .frames import CAMERA_AXES, Matrix, inverse
from .lenses import Intrinsics, camera, lens_of
from .tableio import field, numbers, text_of

__all__ = ["cameras_of", "euroc_camera", "yaml_file"]

_KALIBR_PINHOLE = "pinhole"


def yaml_file(path: Path, what: str) -> Any:
    """A YAML file; OpenCV's first line `%YAML:1.0` is passed over."""
    try:
        import yaml
    except ModuleNotFoundError:
        raise LogError(path, "YAML needs the package yaml", "pip install 'wildcity[yaml]'") from None
    lines = text_of(path, what).splitlines()
    try:
        return yaml.safe_load("\n".join(line for line in lines if not line.startswith("%YAML")))
    except yaml.YAMLError as error:
        raise LogError(path, f"not YAML: {' '.join(str(error).split())}", "repair the file") from None


def cameras_of(path: Path) -> list[dict[str, Any]]:
    """Cameras of a rig file, from a calibration of any of the kinds above; the kind is found by the content.

    Cameras without a mount look along x from the rig's origin.
    """
    if path.suffix == ".json":
        return _rig_file(path)
    found = yaml_file(path, "the calibration")
    place = str(path)
    if not isinstance(found, dict):
        raise LogError(place, "no mapping of names to values", "give a rig file, or a file of Kalibr or ROS")
    if "cam0" in found:
        return _kalibr(found, place)
    if "camera_matrix" in found:
        return [_ros(found, place)]
    if "T_BS" in found:
        return [euroc_camera(found, "cam0", place)]
    known = "cam0 (Kalibr), camera_matrix (ROS), T_BS (EuRoC)"
    raise LogError(place, f"none of the fields {known}", "give a rig file, or a file of Kalibr or ROS")


def _rig_file(path: Path) -> list[dict[str, Any]]:
    try:
        found = json.loads(text_of(path, "the rig file"))
    except json.JSONDecodeError as error:
        raise LogError(path, f"not JSON: {error}", "repair the file") from None
    if isinstance(found, list) and found and "img_name" in found[0]:
        problem = "a list of cameras of INRIA's 3D Gaussian Splatting: it has no times, which a log needs"
        raise LogError(path, problem, "convert it as SOURCE with --rate, or give poses with times and a rig file")
    cameras = field(found, "cameras", path)
    if not isinstance(cameras, list) or not cameras:
        raise LogError(path, "no cameras", "give a rig file, such as scenes/rigs/vehicle6.json")
    for one in cameras:
        field(one, "camera_to_rig", path)
    return cameras


def _kalibr(found: dict[str, Any], place: str) -> list[dict[str, Any]]:
    cameras, imu_from_camera = [], np.eye(4)
    for index in range(len(found)):
        name = f"cam{index}"
        if name not in found:
            break
        one, its = found[name], f"{place}, {name}"
        model = field(one, "camera_model", its)
        if model != _KALIBR_PINHOLE:
            problem = f"the camera model {model!r}; rigs have {_KALIBR_PINHOLE}"
            raise LogError(its, problem, "calibrate with pinhole-radtan or pinhole-equi")
        if "T_cam_imu" in one:
            imu_from_camera = inverse(_rigid(one["T_cam_imu"], "T_cam_imu", its))
        elif index > 0:
            imu_from_camera = imu_from_camera @ inverse(_rigid(field(one, "T_cn_cnm1", its), "T_cn_cnm1", its))
        else:
            imu_from_camera = CAMERA_AXES
        intrinsics = _four(one, "intrinsics", field(one, "resolution", its), its)
        coefficients = field(one, "distortion_coeffs", its)
        lens = lens_of(str(field(one, "distortion_model", its)), coefficients, intrinsics, its)
        cameras.append(camera(name, intrinsics, imu_from_camera, its, lens=lens))
    return cameras


def _four(one: Any, name: str, size: Any, place: str) -> Intrinsics:
    """fx, fy, cx, cy of a list."""
    fx, fy, cx, cy = numbers(field(one, name, place), (4,), name, place)
    width, height = numbers(size, (2,), "resolution", place)
    return Intrinsics(int(width), int(height), float(fx), float(fy), float(cx), float(cy))


def _rigid(value: Any, name: str, place: str) -> Matrix:
    if isinstance(value, dict):
        value = np.reshape(field(value, "data", place), (4, 4)) if len(field(value, "data", place)) == 16 else []
    return numbers(value, (4, 4), name, place)


def _ros(found: dict[str, Any], place: str) -> dict[str, Any]:
    k = numbers(field(field(found, "camera_matrix", place), "data", place), (9,), "camera_matrix", place)
    size = (field(found, "image_width", place), field(found, "image_height", place))
    intrinsics = Intrinsics.of_matrix(size, k.reshape(3, 3))
    coefficients = field(field(found, "distortion_coefficients", place), "data", place)
    model = str(found.get("distortion_model") or found.get("camera_model") or "plumb_bob")
    lens = lens_of(model, coefficients, intrinsics, place)
    return camera(str(found.get("camera_name", "camera")), intrinsics, CAMERA_AXES, place, lens=lens)


def euroc_camera(found: dict[str, Any], name: str, place: str) -> dict[str, Any]:
    """The camera of a sensor.yaml, on a rig that is the body."""
    intrinsics = _four(found, "intrinsics", field(found, "resolution", place), place)
    model, coefficients = field(found, "distortion_model", place), field(found, "distortion_coefficients", place)
    lens = lens_of(str(model), coefficients, intrinsics, place)
    return camera(name, intrinsics, _rigid(field(found, "T_BS", place), "T_BS", place), place, lens=lens)
