"""The kinds of sources: their names, how they are known by their content, and their converters.

A converter is imported only when it is used, so that what it needs must be installed only then.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, cast

from .errors import LogError
from .writer import Report

__all__ = ["KINDS", "Kind", "Options", "detect"]


@dataclass(frozen=True)
class Options:
    """What a user may choose.

    log: which of several logs of the source. reference: images stay where they are. rig: a calibration for poses, or
    for cameras of a bag, that have none of their own. pose_of: whose poses a file has, `rig` or `camera`. rate: images
    a second, where no times are recorded. origin: latitude, longitude (degrees) and altitude (m) of the world of a map.
    licence: a note for log.json. Of a bag: rig_frame and world_frame, its frames; odometry, the topic that gives the
    poses; leave_out, topics that are not converted. values: what the user gave, for the check of a run that goes on.
    """

    log: str | None = None
    reference: bool = False
    rig_frame: str | None = None
    world_frame: str | None = None
    odometry: str | None = None
    leave_out: tuple[str, ...] = ()
    rig: Path | None = None
    pose_of: str | None = None
    rate: float | None = None
    origin: tuple[float, float, float] | None = None
    licence: str | None = None
    values: dict[str, str] = field(default_factory=dict)


class Converter(Protocol):
    """What each module of a kind has."""

    def convert(self, source: Path, out: Path, options: Options) -> Report:
        """Writes the log."""

    def logs(self, source: Path) -> list[str]:
        """Names of the logs in the source, one of which `Options.log` chooses."""


@dataclass(frozen=True)
class Kind:
    """A kind of source. extra: of the package, which has what the converter imports."""

    name: str
    title: str
    module: str
    is_like: Callable[[Path], bool]
    looks: str
    extra: str | None = None

    def converter(self) -> Converter:
        """Its module. Raises `LogError` that names the extra to install."""
        try:
            return cast(Converter, importlib.import_module(f".{self.module}", __package__))
        except ModuleNotFoundError as error:
            if self.extra is None or str(error.name).startswith("wildcity"):
                raise
            problem = f"the kind {self.name} needs the package {error.name}"
            raise LogError(self.name, problem, f"pip install 'wildcity[{self.extra}]'") from None


def _has(*names: str) -> Callable[[Path], bool]:
    """Whether the folder has a path of each pattern."""
    return lambda source: source.is_dir() and all(next(source.glob(name), None) is not None for name in names)


def _ends(*suffixes: str) -> Callable[[Path], bool]:
    """Whether it is a file with one of these suffixes."""
    return lambda source: source.is_file() and source.suffix in suffixes


def _any(*tests: Callable[[Path], bool]) -> Callable[[Path], bool]:
    return lambda source: any(test(source) for test in tests)


def _inria_cameras(source: Path) -> bool:
    """Whether it is a cameras.json of a training, or the folder of a model with one."""
    path = source / "cameras.json" if source.is_dir() else source
    if path.name != "cameras.json" or not path.is_file():
        return False
    with path.open("rb") as file:
        return b'"img_name"' in file.read(4096)


_IS_KITTI = _any(_has("oxts/timestamps.txt"), _has("*/oxts/timestamps.txt"), _has("*/*/oxts/timestamps.txt"))


KINDS: tuple[Kind, ...] = (
    Kind(
        "nuscenes", "nuScenes", "nuscenes", _any(_has("v1.*/sample_data.json"), _has("sample_data.json")),
        "a folder with v1.0-*/sample_data.json",
    ),
    Kind(
        "kitti", "KITTI raw", "kitti", lambda source: _IS_KITTI(source) and not _has("data_poses")(source),
        "a drive such as 2011_09_26_drive_0001_sync beside calib_*.txt, or a folder of such days",
    ),
    Kind(
        "kitti360", "KITTI-360", "kitti360", _has("calibration/perspective.txt", "data_poses"),
        "a folder with calibration, data_poses, data_2d_raw and data_3d_raw",
    ),
    Kind(
        "argoverse2", "Argoverse 2", "argoverse2",
        _any(*(_has(f"{depth}city_SE3_egovehicle.feather") for depth in ("", "*/", "*/*/"))),
        "a log with city_SE3_egovehicle.feather, or a folder of such logs", "av2",
    ),
    Kind(
        "nuplan", "nuPlan", "nuplan", _any(_has("*.db"), _has("**/splits/*/*.db"), _ends(".db")),
        "a .db file, or a folder with splits and sensor_blobs",
    ),
    Kind(
        "waymo", "Waymo Open v2", "waymo", _has("camera_image/*.parquet", "camera_calibration/*.parquet"),
        "a folder with camera_image, camera_calibration, vehicle_pose, .. of Parquet files", "waymo",
    ),
    Kind(
        "pai", "NVIDIA Physical AI AV", "pai", _any(*(_has(f"{depth}calibration/camera_intrinsics*.parquet",
        f"{depth}labels/*.egomotion*.parquet") for depth in ("", "*/"))),
        "a clip with calibration, labels and camera, as pai-clip-dl of ncore writes it", "pai",
    ),
    Kind(
        "ncore", "NVIDIA ncore V4", "ncore", _any(_ends(".itar"), *(_has(f"{depth}*ncore4*.zarr{ending}")
        for depth in ("", "*/") for ending in ("", ".itar"))),
        "a folder with *.ncore4*.zarr.itar or *.ncore4*.zarr, or one of these files", "ncore",
    ),
    Kind(
        "nurec", "NVIDIA NuRec (USDZ)", "nurec", _ends(".usdz"), "a .usdz file with rig_trajectories.json",
    ),
    Kind(
        "euroc", "EuRoC (ASL)", "euroc", _any(_has("mav0/cam0/data.csv"), _has("cam0/data.csv", "cam0/sensor.yaml")),
        "a folder with mav0/cam0/data.csv", "yaml",
    ),
    Kind(
        "poses", "poses of TUM, EuRoC or KITTI", "poses",
        _any(_has("groundtruth.txt", "rgb.txt"), _ends(".txt", ".tum", ".csv")),
        "a .txt, .tum or .csv file of poses with --rig FILE, or a TUM folder with groundtruth.txt and rgb.txt", "yaml",
    ),
    Kind(
        "pandaset", "PandaSet", "pandaset",
        _any(*(_has(f"{depth}lidar/poses.json", f"{depth}camera/*/intrinsics.json") for depth in ("", "*/"))),
        "a sequence with camera, lidar and meta, or the folder of the sequences",
    ),
    Kind(
        "zod", "Zenseact Open Dataset", "zod",
        _any(_has("sequences/*/info.json"), _has("drives/*/info.json"), _has("info.json", "calibration.json")),
        "a folder with sequences or drives, or one of these",
    ),
    Kind(
        "comma2k19", "comma2k19", "comma2k19",
        _any(*(_has(f"{depth}global_pose/frame_positions") for depth in ("", "*/", "*/*/"))),
        "a segment with global_pose and video.hevc, or a folder of such segments", "comma",
    ),
    Kind(
        "inria", "cameras of a training (3D Gaussian Splatting)", "inria", _inria_cameras,
        "cameras.json of a model, with --rate HZ",
    ),
    Kind(
        "lanelet2", "Lanelet2 (a map)", "lanelet2", _ends(".osm"), "an .osm file; OUT is a map file, not a log",
    ),
    Kind(
        "bag", "ROS 1 bag, rosbag2 or MCAP", "bags", _any(_has("metadata.yaml"), _ends(".bag", ".mcap", ".db3")),
        "a folder with metadata.yaml, or a .bag, .mcap or .db3 file", "rosbag",
    ),
)  # fmt: skip


def detect(source: Path) -> Kind:
    """The kind of a source by its content. Raises `LogError` if there is none, or if several fit."""
    if not source.exists():
        raise LogError(source, "there is no such file or folder", "give the folder or the file of the source")
    found = [kind for kind in KINDS if kind.is_like(source)]
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(kind.name for kind in found)
        raise LogError(source, f"it looks like several kinds: {names}", "choose one with --kind")
    looks = "".join(f"\n  {kind.name:<10} {kind.looks}" for kind in KINDS)
    raise LogError(source, "it looks like none of the known kinds", f"give --kind, or one of these:{looks}")


def named(name: str) -> Kind:
    """A kind by its name."""
    return next(kind for kind in KINDS if kind.name == name)


def choose(names: Iterator[str] | list[str], chosen: str | None, source: Path, what: str) -> str:
    """The log of a source that the user chose, or the only one."""
    found = list(names)
    if not found:
        raise LogError(source, f"it has no {what}", "give the folder of a whole data set")
    if chosen is None and len(found) == 1:
        return found[0]
    shown = ", ".join(found[:8]) + (f", .. ({len(found)} in all)" if len(found) > 8 else "")
    if chosen is None:
        raise LogError(source, f"it has several of {what}: {shown}", "choose one with --log")
    if chosen not in found:
        raise LogError(source, f"it has no {what} {chosen!r}, only {shown}", "choose one with --log")
    return chosen
