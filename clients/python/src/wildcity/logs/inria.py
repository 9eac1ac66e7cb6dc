"""cameras.json of the trainer of 3D Gaussian Splatting (Kerbl et al. 2023), which writes it beside its models.

It has the pose and the lens of each image and no times: `--rate` gives them, in the order of the names of the images.
`rotation` and `position` are world_from_camera in OpenCV's axes (camera_to_JSON). The world is that of the training:
whether it is in metres and has z up is not in the file. The rig is the camera, turned so that x is ahead.
"""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LogError
from .frames import CAMERA_AXES, Matrix, inverse, rotation_error
from .kinds import Options
from .lenses import Intrinsics, camera
from .source import opened
from .tableio import field, json_file, numbers
from .writer import LogWriter, Report

_NAME = "camera"


def _file(source: Path) -> Path:
    return source / "cameras.json" if source.is_dir() else source


def logs(source: Path) -> list[str]:
    """A file is one log."""
    return [_file(source).parent.name]


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes the log."""
    path = _file(source)
    if options.rate is None:
        raise LogError(path, "it has no times, which a log needs", "give the images a second with --rate, such as 10")
    if not (math.isfinite(options.rate) and 1e-3 <= options.rate <= 1e4):
        raise LogError("--rate", f"{options.rate} images a second", "give a number from 0.001 to 10000")
    entries = json_file(path, "the cameras of a training")
    if not isinstance(entries, list) or not entries:
        raise LogError(path, "no list of cameras", "give the cameras.json of a model")
    entries = sorted(entries, key=lambda one: str(field(one, "img_name", path)))
    for before, after in pairwise(entries):
        if before["img_name"] == after["img_name"]:
            raise LogError(path, f"two images of the name {after['img_name']}", "remove one of them")
    decides = {"entries": len(entries), "rate": options.rate}
    licence, name = "that of the images", logs(source)[0]
    with opened("inria", source, out, options, log=name, licence=licence, decides=decides) as writer:
        writer.cameras.append(_lens(entries, path))
        for index, one in enumerate(entries):
            time_us, place = round(index * 1e6 / options.rate), f"{path}, {one['img_name']}"
            pose = _pose(one, place) @ inverse(CAMERA_AXES)
            if index == 0:
                writer.begin(time_us, pose[:3, 3])
            writer.pose(time_us, pose, place)
            _image(writer, path.parent / "images", str(one["img_name"]), time_us)
        why = f"not recorded: {options.rate:g} a second, in the order of the names"
        writer.left_out("times of images", len(entries), why)
        writer.left_out("scale and direction of the world", 1, "those of the training: a log has metres, and z up")
        return writer.finish()


def _lens(entries: list[Any], path: Path) -> dict[str, Any]:
    """The one lens of all entries, a pinhole with the axis in the middle of the image."""
    names = ("width", "height", "fx", "fy")
    lenses = {json.dumps([field(one, name, path) for name in names]) for one in entries}
    if len(lenses) > 1:
        problem = f"{len(lenses)} different lenses; which images were taken at one time is not in the file"
        raise LogError(path, problem, "write a file for each camera")
    width, height, fx, fy = numbers(json.loads(lenses.pop()), (4,), ", ".join(names), path)
    intrinsics = Intrinsics(int(width), int(height), float(fx), float(fy), float(width) / 2, float(height) / 2)
    return camera(_NAME, intrinsics, CAMERA_AXES, str(path), from_middle=False)


def _pose(one: Any, place: str) -> Matrix:
    pose = np.eye(4)
    pose[:3, :3] = numbers(field(one, "rotation", place), (3, 3), "rotation", place)
    pose[:3, 3] = numbers(field(one, "position", place), (3,), "position", place)
    if rotation_error(pose) > 1e-3:
        raise LogError(place, "rotation is no rotation", "write the file again with the trainer")
    return pose


def _image(writer: LogWriter, folder: Path, name: str, time_us: int) -> None:
    """The image beside the file, whose suffix the trainer cuts off."""
    endings = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
    found = next((path for ending in endings if (path := folder / (name + ending)).is_file()), None)
    if found is None or not found.resolve().is_relative_to(folder.resolve()):
        return writer.left_out("images", 1, "no folder images beside cameras.json has them")
    writer.image(_NAME, time_us, found)
