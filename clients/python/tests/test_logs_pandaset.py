"""PandaSet to a log: a miniature sequence by the devkit's files, against the formula of its `geometry.projection`."""

from __future__ import annotations

import copyreg
import gzip
import io
import json
import pickle
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs_truth import (
    Array,
    Log,
    drive,
    killed_and_resumed,
    matrix,
    mount,
    moved,
    points_seen,
    refused,
    run,
    same_poses,
    wxyz,
)
from PIL import Image
from scipy.spatial.transform import Rotation

FRAMES = 6
START_US = 1_557_540_000_000_000
CAMERAS = {"front_camera": mount(1.2, 0, -0.1, 0), "left_camera": mount(0.3, 0.3, -0.1, 90)}
LATE_US = {"front_camera": 4_000, "left_camera": -3_000}
K = np.array([[1970.0, 0, 970], [0, 1969.5, 483.3], [0, 0, 1]])
SIZE = (1920, 1080)
TURNED = matrix([0, 0, 0], Rotation.from_euler("z", -90, degrees=True))
"""rig_from_ego: PandaSet's y looks ahead."""


def image_bytes(number: int) -> bytes:
    """An image of the cameras' size that no other number gives."""
    out = io.BytesIO()
    Image.new("RGB", SIZE, (number, 0, 0)).save(out, "JPEG")
    return out.getvalue()


def frame_us(frame: int) -> int:
    return START_US + 100_000 * frame


def rig(time_us: int) -> Array:
    return drive((time_us - START_US) / 1e6, (10.5, 20.25, 0.5))


class DataFrame:
    """Becomes a DataFrame of pandas 1.0 in a pickle."""

    NAME = "pandas.core.frame", "DataFrame"

    def __init__(self, columns: dict[str, list[Any]]) -> None:
        self.columns = columns

    def __reduce__(self) -> Any:
        return copyreg.__newobj__, (DataFrame,), {"_data": Manager(self.columns), "_typ": "dataframe"}


class Manager:
    NAME = "pandas.core.internals.managers", "BlockManager"

    def __init__(self, columns: dict[str, list[Any]]) -> None:
        self.columns = columns

    def __reduce__(self) -> Any:
        rows = len(next(iter(self.columns.values())))
        axes = [Index(np.array(list(self.columns), object)), Index(np.arange(rows))]
        blocks, kinds = [], ("f", "i", "O")
        for kind in kinds:
            chosen = [n for n, its in enumerate(self.columns.values()) if np.asarray(its).dtype.kind in (kind, "U")
                      and (kind == "O") == (np.asarray(its).dtype.kind == "U")]  # fmt: skip
            values = [np.asarray(list(self.columns.values())[n], object if kind == "O" else None) for n in chosen]
            if chosen:
                # A slice where the columns are neighbours, as pandas has it.
                is_row = chosen == list(range(chosen[0], chosen[-1] + 1))
                places = slice(chosen[0], chosen[-1] + 1, 1) if is_row else np.array(chosen)
                blocks.append({"values": np.stack(values), "mgr_locs": places})
        state = (axes, [one["values"] for one in blocks], [], {"0.14.1": {"axes": axes, "blocks": blocks}})
        return copyreg.__newobj__, (Manager,), state


def _new_index(_cls: Any, _its: Any) -> None: ...


_new_index.NAME = ("pandas.core.indexes.base", "_new_Index")  # type: ignore[attr-defined]


class Index:
    NAME = "pandas.core.indexes.base", "Index"

    def __init__(self, data: Array) -> None:
        self.data = data

    def __reduce__(self) -> Any:
        return _new_index, (Index, {"data": self.data, "name": None})


class Pickler(pickle._Pickler):  # type: ignore[name-defined,misc]
    """Writes classes with a NAME as globals of that name."""

    def save_global(self, obj: Any, name: str | None = None) -> None:
        if not hasattr(obj, "NAME"):
            return super().save_global(obj, name)
        self.save(obj.NAME[0])
        self.save(obj.NAME[1])
        self.write(pickle.STACK_GLOBAL)
        self.memoize(obj)

    dispatch = {**pickle._Pickler.dispatch, type(_new_index): save_global, type: save_global}  # type: ignore[attr-defined]


def write_frame(path: Path, columns: dict[str, list[Any]]) -> None:
    out = io.BytesIO()
    Pickler(out, 4).dump(DataFrame(columns))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(out.getvalue()))


def pose_of(pose: Array) -> dict[str, Any]:
    return {"position": dict(zip("xyz", map(float, pose[:3, 3]), strict=True)),
            "heading": dict(zip("wxyz", wxyz(pose), strict=True))}  # fmt: skip


def sweep(frame: int) -> tuple[Array, Array, Array]:
    """Points in the world, their times, and their sensors."""
    random = np.random.default_rng(frame)
    local = np.c_[random.uniform(-30, 30, (200, 2)), random.uniform(-2, 3, 200)]
    times = frame_us(frame) + random.integers(-60_000, 40_000, 200)
    return moved(rig(frame_us(frame)), local), times, np.arange(200) % 3 // 2


def dump(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


CUBOIDS = {
    "uuid": ["car-1", "man-1", "man-2", "ufo"],
    "label": ["Pickup Truck", "Pedestrian with Object", "Pedestrian", "Saucer"],
    "yaw": [0.4, 0.0, 0.0, 0.0],
    "stationary": [0, 0, 0, 0],
    "cuboids.sensor_id": [-1, 0, 1, -1],
    **{f"position.{axis}": [at, at + 1, at + 2, 0.0] for axis, at in zip("xyz", (30.0, 40.0, 1.0), strict=True)},
    **{f"dimensions.{axis}": [value, 0.5, 0.5, 1.0] for axis, value in zip("xyz", (1.9, 4.7, 1.6), strict=True)},
}  # fmt: skip


def make(root: Path) -> Path:
    times = [frame_us(frame) for frame in range(FRAMES)]
    lidar = root / "lidar"
    dump(lidar / "timestamps.json", [time / 1e6 for time in times])
    dump(lidar / "poses.json", [pose_of(rig(time) @ TURNED) for time in times])
    for frame in range(FRAMES):
        world, at, sensor = sweep(frame)
        values = dict(zip("xyz", world.T.tolist(), strict=True))
        columns = {"i": [float(n) for n in range(200)], "t": (at / 1e6).tolist(), "d": sensor.tolist()}
        write_frame(lidar / f"{frame:02d}.pkl.gz", {**values, **columns})
        if frame != 4:
            write_frame(root / "annotations" / "cuboids" / f"{frame:02d}.pkl.gz", CUBOIDS)
    for number, (name, place) in enumerate(CAMERAS.items()):
        folder = root / "camera" / name
        seen = [time + LATE_US[name] for time in times]
        dump(folder / "timestamps.json", [time / 1e6 for time in seen])
        dump(folder / "poses.json", [pose_of(rig(time) @ place) for time in seen])
        dump(folder / "intrinsics.json", {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]})
        for frame in range(FRAMES):
            if (number, frame) != (1, 3):
                (folder / f"{frame:02d}.jpg").write_bytes(image_bytes(10 * frame + number))
    fixes = [
        {"lat": 37.7 + frame / 1e5, "long": -122.4, "height": 3.5, "xvel": 1.0, "yvel": 2.0} for frame in range(FRAMES)
    ]
    dump(root / "meta" / "timestamps.json", [time / 1e6 for time in times])
    dump(root / "meta" / "gps.json", fixes)
    return root


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("pandaset") / "042").parent


@pytest.fixture(scope="module")
def log(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Log:
    out = tmp_path_factory.mktemp("log") / "log"
    run(source, "--out", out)
    return Log(out)


def test_poses_times_images_and_fixes_are_the_recorded_ones(source: Path, log: Log) -> None:
    same_poses(log, {frame_us(frame): rig(frame_us(frame)) for frame in range(FRAMES)})
    for number, name in enumerate(CAMERAS):
        frames = [frame for frame in range(FRAMES) if (number, frame) != (1, 3)]
        assert log.times("images", camera=name) == [frame_us(frame) + LATE_US[name] for frame in frames]
        rows = [row for row in log.rows("images") if row["camera"] == name]
        for frame, row in zip(frames, rows, strict=True):
            assert (log.folder / row["file"]).read_bytes() == image_bytes(10 * frame + number)
    assert log.rows("gps")[2]["latitude_deg"] == 37.7 + 2 / 1e5
    assert run(source, "--list").splitlines()[-1] == "042"


def test_points_have_the_pixels_of_the_devkit(log: Log) -> None:
    for name, place in CAMERAS.items():
        time_us = frame_us(2) + LATE_US[name]
        world_from_camera = rig(time_us) @ place
        seen = moved(world_from_camera, points_seen(K, SIZE) + [0, 0, 4])
        # geometry.projection: the inverse of the image's pose, and then the matrix of the camera.
        flat = moved(np.linalg.inv(world_from_camera), seen) @ K.T
        xyz, turns = log.between(np.array([time_us]))
        ours = log.project(name, matrix(xyz[0], turns[0]), seen)
        np.testing.assert_allclose(ours - 0.5, flat[:, :2] / flat[:, 2:], rtol=0, atol=0.3)
        assert (log.rig[name]["width"], log.rig[name]["height"]) == SIZE


def test_points_are_where_the_devkit_has_them(log: Log) -> None:
    rows = log.rows("lidar")
    assert len(rows) == 2 * FRAMES and {row["lidar"] for row in rows} == {"pandar64", "pandargt"}
    for number, name in enumerate(("pandar64", "pandargt")):
        found = [row for row in rows if row["lidar"] == name]
        for frame, row in enumerate(found):
            world, at, sensor = sweep(frame)
            chosen = np.flatnonzero(sensor == number)
            order = chosen[np.argsort(at[chosen], kind="stable")]
            ours, times = log.sweep_in_world(row)
            assert np.array_equal(times, at[order]) and row["compensated_to_us"] + log.epoch_us == frame_us(frame)
            np.testing.assert_allclose(ours, world[order], rtol=0, atol=1e-3)


def test_boxes_have_their_length_ahead(log: Log) -> None:
    rows = log.rows("tracks")
    assert len(rows) == 2 * (FRAMES - 1)
    car = next(row for row in rows if row["track"] == "car-1")
    assert car["class"] == "vehicle" and car["size"] == [4.7, 1.9, 1.6]
    # 0 is along y, and the rotation is counter-clockwise: as the devkit documents it.
    ahead = Rotation.from_euler("z", 0.4).apply([0, 1, 0])
    pose = log.pose(car["world_from_box"])
    np.testing.assert_allclose(pose[:3, 0], ahead, atol=1e-9)
    np.testing.assert_allclose(pose[:3, 3], [30, 40, 1], atol=1e-6)
    left_out = " ".join(log.head["left_out"])
    for part in (
        "class Saucer: 5",
        "looks ahead: 5",
        "without a file of boxes: 1",
        "times of left_camera without a file: 1",
    ):
        assert part in left_out


def test_a_camera_that_moves_on_the_rig_is_stated(source: Path, log: Log, tmp_path: Path) -> None:
    stated = next(one for one in log.head["left_out"] if one.startswith("movement of front_camera"))
    assert float(stated.partition("up to ")[2].partition(" m")[0]) < 0.01
    root = make(tmp_path / "data")
    path = root / "camera" / "front_camera" / "poses.json"
    poses = json.loads(path.read_text())
    poses[2]["position"]["z"] += 0.3
    dump(path, poses)
    run(root, "--out", tmp_path / "log")
    stated = next(one for one in Log(tmp_path / "log").head["left_out"] if one.startswith("movement of front_camera"))
    assert 0.23 < float(stated.partition("up to ")[2].partition(" m")[0]) < 0.26


def test_a_killed_run_goes_on(source: Path, log: Log, tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, log.folder, source, after=14)


class Harmful:
    """A pickle of it would run a command."""

    def __reduce__(self) -> Any:
        return subprocess.check_output, (("touch", "harm"),)


def edited(name: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def act(root: Path) -> None:
        found = json.loads((root / name).read_text())
        change(found)
        dump(root / name, found)

    return act


FRONT, LIDAR = "camera/front_camera", "lidar"
BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no intrinsics": (lambda r: (r / FRONT / "intrinsics.json").unlink(), "intrinsics.json: missing"),
    "no focal length": (edited(f"{FRONT}/intrinsics.json", lambda d: d.update(fx=0.0)), "has no intrinsics"),
    "a clock that runs backwards": (
        edited(f"{FRONT}/timestamps.json", lambda d: d.__setitem__(3, d[1])), "the clock runs backwards"),
    "milliseconds": (
        edited(f"{LIDAR}/timestamps.json", lambda d: d.__setitem__(slice(None), [1000 * t for t in d])),
        "are no seconds since 1970"),
    "too few poses": (edited(f"{LIDAR}/poses.json", lambda d: d.pop()), "5 poses for 6 times"),
    "no quaternion": (edited(f"{LIDAR}/poses.json", lambda d: d[2]["heading"].update(w=3.0)), "has not the length 1"),
    "NaN": (edited(f"{LIDAR}/poses.json", lambda d: d[2]["position"].update(x=float("nan"))), "not 3 finite numbers"),
    "another sequence": (
        edited(f"{FRONT}/poses.json", lambda d: [one["position"].update(x=5.0) for one in d]), "moves on the rig"),
    "no images": (lambda r: [one.unlink() for one in (r / FRONT).glob("*.jpg")], "no images 00.jpg"),
    "a pickle that runs code": (
        lambda r: (r / LIDAR / "02.pkl.gz").write_bytes(gzip.compress(pickle.dumps(Harmful()))),
        "02.pkl.gz: no pickled table: a pickle of subprocess.check_output"),
    "a pickle that is cut off": (
        lambda r: (r / LIDAR / "02.pkl.gz").write_bytes((r / LIDAR / "02.pkl.gz").read_bytes()[:300]),
        "02.pkl.gz: no pickled table"),
    "a missing column": (lambda r: write_frame(r / LIDAR / "02.pkl.gz", {"x": [1.0]}), "no column y, only x"),
    "times of points in milliseconds": (
        lambda r: write_frame(r / LIDAR / "02.pkl.gz", {**{axis: [1.0] for axis in "xyzi"}, "t": [1e12], "d": [0]}),
        "are not within 1 s"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_sequences_are_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    root = make(tmp_path / "data")
    BAD[name][0](root)
    text = refused(tmp_path, root)
    assert BAD[name][1] in text, text
    assert not (tmp_path / "harm").exists()
