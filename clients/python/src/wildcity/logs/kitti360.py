"""KITTI-360 (Liao et al., PAMI 2022): https://www.cvlibs.net/datasets/kitti-360/documentation.php

The GPS/IMU unit has x forward, y right, z down; the rig is that unit turned by half a turn about x, so that y is left
and z up. poses.txt has the frame and world_from_imu for frames where it is known, at the times of the scanner.
Rectified images of the cameras 00 and 01 are pinholes, whose axes are those of calib_cam_to_pose turned by R_rect. The
fisheye cameras 02 and 03 have the unified model (Mei 2007) of image_02.yaml and image_03.yaml, by the formula of the
devkit (helpers/project.py), which has no tangential distortion: mei.py fits a fisheye lens to it.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .errors import LogError
from .frames import Matrix, inverse
from .kinds import Options, choose
from .kitti_files import calibration, matrix34, numbered, recorded_images, scan, times_us
from .lenses import Intrinsics, camera
from .mei import Mei, fisheye_of
from .points import Sweep
from .progress import Progress
from .source import opened
from .tableio import numbers, require, text_of
from .writer import LogWriter, Report

LICENCE = "CC BY-NC-SA 3.0 (KITTI-360)"

IMU_FROM_RIG = np.diag([1.0, -1.0, -1.0, 1.0])

_VALUE = re.compile(r"^ *(\w+): *(\S+)", re.MULTILINE)
"""A name and a value of OpenCV's YAML, which may lack the space between them."""

LABELS = {"rider": "bicycle", "rv": "caravan"}
"""Labels of boxes with another name than other data sets give to the class."""


def logs(source: Path) -> list[str]:
    """Names of the sequences, such as 2013_05_28_drive_0000_sync."""
    return sorted(path.parent.name for path in (source / "data_poses").glob("*/poses.txt"))


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one sequence."""
    name = choose(logs(source), options.log, source, "sequence (data_poses/*/poses.txt)")
    scanner = source / "data_3d_raw" / name / "velodyne_points"
    images = source / "data_2d_raw" / name
    frame_times = times_us(scanner / "timestamps.txt")
    poses = _poses(source / "data_poses" / name / "poses.txt", frame_times)
    decides = {"frames": len(frame_times), "poses": len(poses)}
    with opened("kitti360", source, out, options, log=name, licence=LICENCE, decides=decides) as writer:
        writer.begin(frame_times[0], next(iter(poses.values()))[:3, 3])
        for time_us, pose in poses.items():
            writer.pose(time_us, pose, f"{name}/poses.txt")
        _rig(writer, source / "calibration", images)
        _images(writer, images, name)
        _sweeps(writer, scanner, frame_times)
        _boxes(writer, source, name, frame_times)
        return writer.finish()


def _poses(path: Path, times: list[int]) -> dict[int, Matrix]:
    """world_from_rig by time."""
    found: dict[int, Matrix] = {}
    for number, line in enumerate(text_of(path, "the poses of the sequence").splitlines(), 1):
        place = f"{path}, line {number}"
        try:
            frame, *values = (float(value) for value in line.split())
        except ValueError:
            raise LogError(place, f"not numbers: {line!r:.60}", "download it again") from None
        if not 0 <= frame < len(times):
            raise LogError(place, f"frame {frame:g} has no time in timestamps.txt", "use files of one sequence")
        pose = np.eye(4)
        pose[:3] = numbers(values, (12,), "the pose", place).reshape(3, 4)
        found[times[int(frame)]] = pose @ IMU_FROM_RIG
    if not found:
        raise LogError(path, "no poses", "download it again")
    return found


def _rig(writer: LogWriter, folder: Path, images: Path) -> None:
    mounts_path, lens_path = folder / "calib_cam_to_pose.txt", folder / "perspective.txt"
    velodyne_path = folder / "calib_cam_to_velo.txt"
    mounts, lenses = calibration(mounts_path, "mounts of cameras"), calibration(lens_path, "lenses of cameras")
    words = text_of(velodyne_path, "the mount of the scanner").split()
    velodyne_from_0 = numbers(words, (12,), "the mount of the scanner", velodyne_path)
    rig_from_0 = IMU_FROM_RIG @ matrix34(mounts.get("image_00"), "image_00", mounts_path)
    rig_from_velodyne = rig_from_0 @ inverse(matrix34(velodyne_from_0, "the mount of the scanner", velodyne_path))
    writer.lidar("velodyne", rig_from_velodyne)
    for number in ("00", "01"):
        if not (images / f"image_{number}").is_dir():
            continue
        p = numbers(lenses.get(f"P_rect_{number}"), (12,), f"P_rect_{number}", lens_path).reshape(3, 4)
        turn = np.eye(4)
        turn[:3, :3] = numbers(lenses.get(f"R_rect_{number}"), (9,), f"R_rect_{number}", lens_path).reshape(3, 3)
        size = [int(v) for v in numbers(lenses.get(f"S_rect_{number}"), (2,), f"S_rect_{number}", lens_path)]
        mount = IMU_FROM_RIG @ matrix34(mounts.get(f"image_{number}"), f"image_{number}", mounts_path)
        intrinsics = Intrinsics.of_matrix(size, p[:, :3])
        writer.cameras.append(camera(f"image_{number}", intrinsics, mount @ inverse(turn), str(lens_path)))
    for number in ("02", "03"):
        if (images / f"image_{number}").is_dir():
            mount = IMU_FROM_RIG @ matrix34(mounts.get(f"image_{number}"), f"image_{number}", mounts_path)
            _fisheye(writer, folder / f"image_{number}.yaml", mount)
    writer.left_out("height of the rig above the ground", 1, "the rig is the GPS/IMU unit, y left, z up")


def _fisheye(writer: LogWriter, path: Path, mount: Matrix) -> None:
    """Adds a camera with the lens of a file of OpenCV, whose names are each there once."""
    found = dict(_VALUE.findall(text_of(path, "the lens of a fisheye camera")))
    if found.get("model_type") != "MEI":
        raise LogError(path, f"model_type is {found.get('model_type')}, not MEI", "download the calibrations again")
    names = ("xi", "k1", "k2", "p1", "p2", "gamma1", "gamma2", "u0", "v0", "image_width", "image_height")
    try:
        xi, k1, k2, p1, p2, *gamma_and_center, width, height = (float(found[name]) for name in names)
    except (KeyError, ValueError) as error:
        raise LogError(path, f"no intrinsics: {error}", "download the calibrations again") from None
    gamma1, gamma2, u0, v0 = gamma_and_center
    lens = Mei(xi, (k1, k2), (p1, p2), (gamma1, gamma2), (u0, v0), int(width), int(height))
    fit = fisheye_of(lens, str(path))
    writer.cameras.append(camera(path.stem, fit.intrinsics, mount, str(path), lens=fit.lens))
    why = (
        f"the fisheye lens is up to {fit.error_px:.3f} pixels from it; the terms p1 and p2, which the devkit leaves out"
    )
    writer.left_out(f"lens model of Mei of {path.stem}", 1, f"{why}, too, are up to {fit.tangential_px:.2f} pixels")


def _images(writer: LogWriter, images: Path, name: str) -> None:
    inside = {f"image_{number}": "data_rect" if number < "02" else "data_rgb" for number in ("00", "01", "02", "03")}
    there = {name: its for name, its in inside.items() if (images / name).is_dir()}
    if not there:
        raise LogError(images, "no folder image_00 to image_03", "download the images of the sequence")
    for name_of_camera, its in there.items():
        recorded_images(writer, [images / name_of_camera], its, f"kitti360 {name}, {name_of_camera}")


def _sweeps(writer: LogWriter, folder: Path, times: list[int]) -> None:
    count = 0
    with Progress("kitti360, sweeps", len(times)) as progress:
        for time_us, path in numbered(folder / "data", ".bin", times, writer, "sweeps"):
            writer.sweep("velodyne", time_us, partial(_sweep, path, time_us))
            count += 1
            progress.step()
    writer.left_out("times of single points, sweeps", count, "not recorded: all points have the time of the sweep")
    writer.left_out("scans of the sick scanners", len(list(folder.parent.glob("sick_points/data/*"))), "not read")


def _sweep(path: Path, time_us: int) -> Sweep:
    values = scan(path)
    return Sweep(values[:, :3], np.full(len(values), time_us, np.int64), intensity=values[:, 3])


def _boxes(writer: LogWriter, source: Path, name: str, times: list[int]) -> None:
    """Boxes that move, of data_3d_bboxes: each row has its frame; `transform` places and scales the corners."""
    paths = [source / "data_3d_bboxes" / part / f"{name}.xml" for part in ("train_full", "train")]
    path = next((one for one in paths if one.exists()), None)
    if path is None:
        writer.left_out("boxes", 1, f"no data_3d_bboxes/train/{name}.xml")
        return
    try:
        for _, item in ElementTree.iterparse(require(path, "boxes")):
            if item.find("transform") is not None and item.find("vertices") is not None:
                _box(writer, item, times)
                item.clear()
    except (ElementTree.ParseError, ValueError, IndexError, TypeError) as error:
        raise LogError(path, f"cannot read the boxes: {error}", "download it again") from None


def _box(writer: LogWriter, item: ElementTree.Element, times: list[int]) -> None:
    frame, label = int(item.findtext("timestamp") or -1), (item.findtext("label") or "").strip()
    if frame < 0:
        return writer.left_out("boxes that do not move", 1, "tracks are of what moves, and these have no times")
    transform, corners = _opencv_matrix(item.find("transform")), _opencv_matrix(item.find("vertices"))
    if not (np.isfinite(corners).all() and (abs(transform) < 1e9).all()):
        raise ValueError(f"numbers of a {label} that are no metres")
    # transform = R S: the singular value decomposition U D V^T gives R = U V^T and S = V D V^T.
    u, d, v = np.linalg.svd(transform[:3, :3])
    pose, stretch = np.eye(4), v.T @ np.diag(d) @ v
    pose[:3, :3] = u @ v
    low, high = corners.min(axis=0), corners.max(axis=0)
    pose[:3, 3] = transform[:3, :3] @ ((low + high) / 2) + transform[:3, 3]
    number = item.findtext("instanceId") or item.findtext("dynamicSeq") or item.findtext("index") or ""
    track = f"{item.findtext('semanticId') or label}-{number}".strip()
    writer.box(times[frame], track, LABELS.get(label, label), np.diag(stretch) * (high - low), pose)


def _opencv_matrix(node: Any) -> Matrix:
    rows, columns = int(node.findtext("rows")), int(node.findtext("cols"))
    return np.array([float(value) for value in node.findtext("data").split()]).reshape(rows, columns)
