"""Writes a log, so that a folder with its name is always whole, and a run that was killed goes on.

Everything is written to `OUT.partial`, which is renamed at the end. Images and sweeps are written one by one; each is
named in `done.jsonl` when it is whole. A run reads the metadata of the source again and makes all rows again, but not
the files that are named there: so the result of a run that was killed equals that of one that was not.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np

from .errors import LogError
from .frames import Matrix, pose_json, rotation_error
from .lenses import check_mount
from .names import class_of, name_of
from .points import Sweep
from .tables import Gap, Spool, compact

__all__ = ["LogWriter", "Report"]

FORMAT = "wildcity.log/1"

_LATEST_US = 1 << 61
"""Rows are sorted by their times as texts of 19 digits."""

MAX_SENSORS = 16
"""Cameras, and LiDARs, of a log."""


@dataclass
class Report:
    """What a conversion wrote: rows of each table, gaps, and what it left out."""

    out: Path
    rows: dict[str, int] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    resumed: int = 0


class LogWriter:
    """Writes one log. The times of all its methods are on the source's clock, in microseconds."""

    def __init__(self, out: Path, source: dict[str, Any], *, reference: bool = False) -> None:
        """source: kind, id, licence and converter, and under other names what else decides the result.

        reference: whether images stay where they are, and are named by their absolute paths.
        """
        self.out, self.part = out, out.with_name(out.name + ".partial")
        self.source, self.reference = source, reference
        self.epoch_us = 0
        self.origin_m: Matrix = np.zeros(3)
        self.offsets_us: dict[str, int] = {}
        self.geo: dict[str, Any] | None = None
        self.cameras: list[dict[str, Any]] = []
        self.lidars: list[dict[str, Any]] = []
        self._empty: list[Path] = []
        self._left_out: Counter[str] = Counter()
        self._why: dict[str, str] = {}
        self._spools: dict[str, Spool] = {}
        self._done = self._open()
        self.resumed = len(self._done)
        self._journal: TextIO = (self.part / "done.jsonl").open("a", encoding="utf-8")

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._journal.close()
        for spool in self._spools.values():
            spool.close()
        if error is not None and not self._done:
            shutil.rmtree(self.part, ignore_errors=True)  # There is nothing that the next run could use.

    def _open(self) -> dict[str, Any]:
        """Makes the folder, or continues in it. Returns what is in it by name."""
        if self.out.exists():
            raise LogError(self.out, "it exists", "choose another --out, or remove it")
        try:
            (self.part / "rows").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LogError(self.part, f"cannot make the folder: {error.strerror}", "choose another --out") from None
        same, text = self.part / "source.json", compact({**self.source, "reference": self.reference})
        if same.exists() and same.read_text(encoding="utf-8") != text:
            raise LogError(self.part, "a conversion with another source or other options", "remove this folder")
        same.write_text(text, encoding="utf-8")
        done: dict[str, Any] = {}
        journal = self.part / "done.jsonl"
        lines = journal.read_bytes().splitlines(keepends=True) if journal.exists() else []
        whole = [line for line in lines if line.endswith(b"\n")]
        if len(whole) < len(lines):
            journal.write_bytes(b"".join(whole))
        for line in whole:
            entry = json.loads(line)
            path = self.part / entry["file"]
            if path.is_file() and path.stat().st_size == entry["bytes"]:
                done[entry["file"]] = entry["found"]
        return done

    def begin(self, first_us: int, origin_m: Any = (0.0, 0.0, 0.0)) -> None:
        """Sets time 0, a whole second that is at least 1 s before the first row, and the world's origin, whole metres.

        Whole numbers, so that both subtractions are exact to the last bit that matters. A clock that begins at 0, as
        in many pose files, keeps its 0.
        """
        second = first_us // 1_000_000 - 1
        self.epoch_us = 1_000_000 * (max(second, 0) if first_us >= 0 else second)
        self.origin_m = np.asarray(np.round(np.asarray(origin_m, np.float64)) + 0.0, np.float64)

    def world(self, world_from_x: Matrix) -> dict[str, Any]:
        """A pose in the source's world as JSON, relative to the log's origin."""
        moved = world_from_x.copy()
        moved[:3, 3] -= self.origin_m
        return pose_json(moved)

    def row(self, table: str, time_us: int, fields: dict[str, Any]) -> None:
        """Adds a row to a table. Raises `LogError` for numbers that are not finite, and times that are none."""
        if not abs(time_us) < _LATEST_US:
            problem = f"a time of {time_us} us: no clock is so far"
            raise LogError(f"{self.source['id']} ({table})", problem, "repair the clock, or its unit")
        if table not in self._spools:
            self._spools[table] = Spool(self.part / "rows" / f"{table}.rows")
        try:
            self._spools[table].add({"time_us": int(time_us) - self.epoch_us, **fields})
        except (ValueError, OverflowError):
            place, problem = f"{self.source['id']} ({table})", f"a number that is not finite, at {time_us} us: {fields}"
            raise LogError(place, problem, "repair the source") from None

    def has(self, table: str) -> bool:
        """Whether a table has a row."""
        return table in self._spools

    def pose(self, time_us: int, world_from_rig: Matrix, place: str) -> None:
        """Adds a pose of the vehicle. Raises `LogError` with `place` if it is not finite, or no rotation."""
        if rotation_error(world_from_rig) > 1e-3:
            raise LogError(place, "the pose is no finite rotation and translation", "repair or remove the row")
        self.row("poses", time_us, {"world_from_rig": self.world(world_from_rig)})

    def image(self, camera: str, time_us: int, source: Path, **fields: Any) -> None:
        """Adds an image that lies in a file, which is copied byte for byte, or referenced."""
        if not source.is_file():
            raise LogError(source, "the image is missing", "download it, or choose a log that is complete")
        if self.reference:
            file = os.path.abspath(source)
        else:
            file = self._file("images", camera, time_us, source.suffix.lower())
            self.payload(file, partial(_copied, source))
        self.row("images", time_us, {"camera": name_of(camera), "file": file, **fields})

    def image_bytes(self, camera: str, time_us: int, suffix: str, data: Callable[[], bytes], **fields: Any) -> None:
        """Adds an image of the bytes that `data` returns; it is called only if the file is not written yet."""
        if self.reference:
            raise LogError("--reference", "images of this source are in no files of their own", "leave it out")
        file = self._file("images", camera, time_us, suffix)

        def write(path: Path) -> dict[str, Any]:
            path.write_bytes(data())
            return {}

        self.payload(file, write)
        self.row("images", time_us, {"camera": name_of(camera), "file": file, **fields})

    def sweep(
        self,
        lidar: str,
        time_us: int,
        read: Callable[[], Sweep | tuple[Sweep, dict[str, Any]]],
        *,
        compensated_to_us: int | None = None,
    ) -> Any:
        """Adds a sweep. time_us: of the sweep, which its file has in its name. Its row begins with its first point.

        read: the sweep, and perhaps what else the caller wants to know of it, which is returned as `extra`, also if
        the file was written by an earlier run.
        """
        file = self._file("lidar", lidar, time_us, ".safetensors")

        def write(path: Path) -> dict[str, Any]:
            made = read()
            sweep, extra = made if isinstance(made, tuple) else (made, {})
            try:
                return {**sweep.write(path, self.epoch_us), "extra": extra}
            except ValueError as error:
                place = f"{self.source['id']}, sweep of {lidar} at {time_us} us"
                raise LogError(place, str(error), "download or record it again") from None

        found = self.payload(file, write)
        if found["dropped"]:
            self.left_out(f"points of {name_of(lidar)} that are not finite", found["dropped"], "no position")
        if not found["points"]:
            self._empty.append(self.part / file)
            self.left_out(f"sweeps of {name_of(lidar)} without points", 1, "no times")
            return found
        fields = {"until_us": found["last_us"] - self.epoch_us, "lidar": name_of(lidar), "file": file}
        if compensated_to_us is not None:
            fields["compensated_to_us"] = compensated_to_us - self.epoch_us
        self.row("lidar", found["first_us"], fields)
        return found

    def box(
        self, time_us: int, track: str, label: str, size: Any, world_from_box: Matrix, velocity: Any = None
    ) -> None:
        """Adds a box of a track. size: length, width, height in metres. velocity: [3] in m/s in the world, or None.

        A box of an unknown class, without a size up to 100 m, or without a pose is left out and counted.
        """
        ours = class_of(label)
        sizes = [_float(value) for value in size]
        if ours is None:
            return self.left_out(f"boxes of class {label}", 1, "no such class of actors")
        if len(sizes) != 3 or not all(0 < side <= 100 for side in sizes) or rotation_error(world_from_box) > 1e-3:
            return self.left_out(f"boxes of class {label} without a size or a pose", 1, "not finite, or 0")
        fields: dict[str, Any] = {"track": track, "class": ours, "size": sizes}
        fields["world_from_box"] = self.world(world_from_box)
        if velocity is not None and np.isfinite(velocity).all():
            fields["velocity"] = [float(value) for value in velocity]
        self.row("tracks", time_us, fields)

    def imu(self, time_us: int, rate: Any, acceleration: Any) -> None:
        """Adds a row of the IMU. rate [3]: rad/s; acceleration [3]: m/s^2; both in the rig's axes.

        One that is not finite is left out and counted.
        """
        if not (np.isfinite(rate).all() and np.isfinite(acceleration).all()):
            return self.left_out("rows of the IMU that are not finite", 1, "no measurement")
        fields = {"angular_velocity_rad_per_s": [float(v) for v in rate]}
        self.row("imu", time_us, {**fields, "acceleration_m_per_s2": [float(v) for v in acceleration]})

    def gps(self, time_us: int, latitude_deg: float, longitude_deg: float, altitude_m: float) -> None:
        """Adds a fix on WGS84: degrees, and metres above the ellipsoid. One that is not finite is left out and counted.

        Raises `LogError` for a latitude or a longitude that is no angle in degrees.
        """
        if not np.isfinite([latitude_deg, longitude_deg, altitude_m]).all():
            return self.left_out("fixes that are not finite", 1, "no position")
        if abs(latitude_deg) > 90 or abs(longitude_deg) > 180:
            place, problem = f"{self.source['id']} (gps)", f"latitude {latitude_deg}, longitude {longitude_deg}"
            raise LogError(place, f"{problem}: no degrees", "repair the fixes, or remove them")
        fields = {"latitude_deg": float(latitude_deg), "longitude_deg": float(longitude_deg)}
        self.row("gps", time_us, {**fields, "altitude_m": float(altitude_m)})

    def lidar(self, name: str, rig_from_lidar: Matrix) -> None:
        """Names a LiDAR and its mount. Raises `LogError` if it is no mount on a vehicle."""
        check_mount(f"LiDAR {name}", rig_from_lidar, self.source["id"])
        self.lidars.append({"name": name_of(name), "rig_from_lidar": pose_json(rig_from_lidar)})

    def left_out(self, what: str, count: int = 1, why: str = "") -> None:
        """Counts what of the source the log does not have. what: its name in the source; why: the reason."""
        if count:
            self._left_out[what] += count
            self._why.setdefault(what, why)

    def _file(self, folder: str, sensor: str, time_us: int, suffix: str) -> str:
        return f"{folder}/{name_of(sensor)}/{time_us - self.epoch_us:012d}{suffix}"

    def payload(self, file: str, write: Callable[[Path], dict[str, Any]]) -> Any:
        """Writes a file unless it is whole already. Returns what `write` returned, now or in an earlier run."""
        if file in self._done:
            return self._done[file]
        target, temporary = self.part / file, self.part / "file.part"
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            found = write(temporary)
            size = temporary.stat().st_size
            os.replace(temporary, target)
        except OSError as error:
            raise LogError(target, f"cannot write: {error.strerror}", "make space, and run the command again") from None
        self._journal.write(compact({"file": file, "bytes": size, "found": found}) + "\n")
        self._journal.flush()
        self._done[file] = found
        return found

    def finish(self, map_file: dict[str, Any] | None = None) -> Report:
        """Writes the tables, rig.json and log.json, and gives the folder its name."""
        for need, what in (("poses", "poses of the vehicle"),):
            if need not in self._spools:
                raise LogError(
                    self.source["id"], f"it has no {what}", "a log needs them: choose a source that has them"
                )
        for what, names in (("cameras", self.cameras), ("LiDARs", self.lidars)):
            if len(names) > MAX_SENSORS:
                problem = f"{len(names)} {what}; a log has at most {MAX_SENSORS}"
                raise LogError(self.source["id"], problem, "make a source with fewer of them")
            twice = [name for name, count in Counter(one["name"] for one in names).items() if count > 1]
            if twice:
                problem = f"two {what} have the name {twice[0]!r} in a log, of a-z, 0-9 and . _ -"
                raise LogError(self.source["id"], problem, "give them other names")
        if not self.cameras:
            problem = "it has no camera with intrinsics"
            raise LogError(self.source["id"], problem, "a log needs a rig: choose a source that has cameras")
        report = Report(self.out, resumed=self.resumed)
        for table, spool in sorted(self._spools.items()):
            target = self.part / f"{table}.jsonl"
            report.rows[table], gaps, clash = spool.sorted_into(target)
            report.gaps += gaps
            if clash:
                problem = f"two different rows of one time: {clash[0].strip()} and {clash[1].strip()}"
                raise LogError(f"{self.source['id']} ({table})", problem, "repair the clock, or remove one of them")
        report.left_out = self._sentences()
        self._json("rig.json", {"name": name_of(self.source["kind"]), "cameras": self.cameras})
        if map_file is not None:
            self._json("map.json", map_file)
        self._json("log.json", self._head(report))
        self._journal.close()
        shutil.rmtree(self.part / "rows")
        for path in self._empty:
            path.unlink()
        for name in ("source.json", "file.part", "done.jsonl"):
            (self.part / name).unlink(missing_ok=True)
        os.rename(self.part, self.out)
        return report

    def _head(self, report: Report) -> dict[str, Any]:
        source = {name: self.source[name] for name in ("kind", "id", "licence", "converter")}
        origin = [float(value) for value in self.origin_m]
        return {
            "format": FORMAT,
            "name": name_of(self.source["id"]),
            "source": source,
            "clock": {"epoch_us": self.epoch_us, "offsets_us": self.offsets_us},
            "world": {"origin_m": origin, "geo": self.geo},
            "lidars": self.lidars,
            "left_out": report.left_out,
        }

    def _sentences(self) -> list[str]:
        return [f"{what}: {count} ({self._why[what]})" for what, count in sorted(self._left_out.items())]

    def _json(self, name: str, value: Any) -> None:
        text = json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False)
        (self.part / name).write_text(text + "\n", encoding="utf-8")


def _float(value: Any) -> float:
    """A number, or NaN for what is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def _copied(source: Path, target: Path) -> dict[str, Any]:
    shutil.copyfile(source, target)
    return {}
