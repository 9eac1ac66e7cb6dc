"""Scenes of NVIDIA NuRec (USDZ): the poses, the rig and the tracks that AlpaSim's runtime reads from the archive.

`rig_trajectories.json` and `sequence_tracks.json` are read as alpasim_utils/scenario.py of NVlabs/alpasim reads them,
and cameras as ncore defines them: `T_rig_worlds` is world_from_rig, `T_sensor_rig` is rig_from_camera, poses of tracks
are x, y, z, qx, qy, qz, qw of the middle of a box in the axes of the reconstruction, to which `world_to_nre` leads.
Times are microseconds. The archive has the times of the recorded images, but no images.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LogError
from .frames import Matrix, inverse, transform
from .kinds import Options, choose
from .pai_lenses import camera_of
from .source import opened
from .tableio import field, numbers
from .writer import LogWriter, Report

LICENCE = "not stated by the archive"

MAX_BYTES = 1 << 30
"""Of a file of the archive after decompression."""

_RIGS, _TRACKS = "rig_trajectories.json", "sequence_tracks.json"


def logs(source: Path) -> list[str]:
    """Ids of the sequences."""
    return [str(field(one, "sequence_id", source)) for one in field(_json(source, _RIGS), "rig_trajectories", source)]


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes one sequence."""
    found, place = _json(source, _RIGS), f"{source}, {_RIGS}"
    name = choose(logs(source), options.log, source, "sequence")
    trajectory = next(one for one in found["rig_trajectories"] if str(one["sequence_id"]) == name)
    decides = {"bytes": source.stat().st_size}
    with opened("nurec", source, out, options, log=name, licence=LICENCE, decides=decides) as writer:
        _poses(writer, trajectory, place)
        _rig(writer, found, trajectory, place)
        world_to_nre = field(field(found, "world_to_nre", place), "matrix", place)
        _boxes(writer, source, name, inverse(numbers(world_to_nre, (4, 4), "world_to_nre", place)))
        with zipfile.ZipFile(source) as archive:
            others = [one for one in archive.namelist() if one not in (_RIGS, _TRACKS)]
        writer.left_out("map.xodr", "map.xodr" in others, "`wildcity twin map import` reads it")
        writer.left_out("other files of the archive", len([one for one in others if one != "map.xodr"]), "not read")
        return writer.finish()


def _json(source: Path, name: str) -> Any:
    try:
        with zipfile.ZipFile(source) as archive:
            size = archive.getinfo(name).file_size
            if size > MAX_BYTES:
                raise LogError(f"{source}, {name}", f"{size} bytes, more than {MAX_BYTES}", "download it again")
            return json.loads(archive.read(name))
    except KeyError:
        raise LogError(source, f"missing: {name}", "give a scene of NuRec, as AlpaSim reads it") from None
    except (
        zipfile.BadZipFile,
        RuntimeError,
        EOFError,
        OSError,
        zlib.error,
        json.JSONDecodeError,
        UnicodeDecodeError,
        MemoryError,
    ) as error:
        raise LogError(f"{source}, {name}", f"cannot read: {error}", "download it again") from None


def _poses(writer: LogWriter, trajectory: Any, place: str) -> None:
    times, poses = field(trajectory, "T_rig_world_timestamps_us", place), field(trajectory, "T_rig_worlds", place)
    if not times or len(times) != len(poses):
        raise LogError(place, f"{len(poses)} poses for {len(times)} times", "download it again")
    writer.begin(int(times[0]), numbers(poses[0], (4, 4), "T_rig_worlds[0]", place)[:3, 3])
    last_us: int | None = None
    for index, (time_us, value) in enumerate(zip(times, poses, strict=True)):
        if last_us is not None and int(time_us) <= last_us:
            problem = f"T_rig_world_timestamps_us[{index}] is {time_us}, after {last_us}: the clock runs backwards"
            raise LogError(place, problem, "download it again")
        last_us = int(time_us)
        writer.pose(last_us, numbers(value, (4, 4), f"T_rig_worlds[{index}]", place), f"{place}, T_rig_worlds[{index}]")


def _rig(writer: LogWriter, found: Any, trajectory: Any, place: str) -> None:
    """Adds the cameras of the trajectory. A rolling shutter takes the median of the recorded ranges."""
    calibrations = field(found, "camera_calibrations", place)
    for unique, ranges in sorted(field(trajectory, "cameras_frame_timestamps_us", place).items()):
        its = field(calibrations, unique, f"{place}, camera_calibrations")
        model, where = field(its, "camera_model", place), f"{place}, {unique}"
        parameters = dict(field(model, "parameters", where))
        spans = [int(end) - int(start) for start, end in ranges]
        parameters.setdefault("shutter_delay_us", int(np.median(spans)) if spans else 0)
        mount = numbers(field(its, "T_sensor_rig", where), (4, 4), "T_sensor_rig", where)
        name, kind = str(field(its, "logical_sensor_name", where)), str(field(model, "type", where)).replace("_", "-")
        writer.cameras.append(camera_of(name, kind, parameters, mount, where))
        writer.left_out(f"images of {name}", len(ranges), "the archive has their times only")


def _boxes(writer: LogWriter, source: Path, name: str, world_from_nre: Matrix) -> None:
    place = f"{source}, {_TRACKS}"
    with zipfile.ZipFile(source) as archive:
        if _TRACKS not in archive.namelist():
            return writer.left_out("boxes", 1, f"the archive has no {_TRACKS}")
    found = _json(source, _TRACKS).get(name)
    if found is None:
        return writer.left_out("boxes", 1, f"{_TRACKS} has no sequence {name}")
    tracks, sizes = (
        field(found, "tracks_data", place),
        field(field(found, "cuboidtracks_data", place), "cuboids_dims", place),
    )
    names = ("tracks_id", "tracks_label_class", "tracks_timestamps_us", "tracks_poses")
    columns = [field(tracks, column, place) for column in names]
    if len({len(sizes), *(len(column) for column in columns)}) != 1:
        raise LogError(place, "its lists have different lengths", "download it again")
    for track, label, times, poses, size in zip(*columns, sizes, strict=True):
        if len(times) != len(poses):
            raise LogError(f"{place}, track {track}", f"{len(poses)} poses for {len(times)} times", "download it again")
        for time_us, value in zip(times, poses, strict=True):
            x, y, z, qx, qy, qz, qw = numbers(value, (7,), "a pose", f"{place}, track {track}")
            pose = world_from_nre @ transform((x, y, z), (qw, qx, qy, qz))
            writer.box(int(time_us), str(track), str(label), numbers(size, (3,), "cuboids_dims", place), pose)
    writer.left_out("flags of tracks", len(sizes), "no field for them")
