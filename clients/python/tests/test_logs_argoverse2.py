"""Argoverse 2 to a log: a miniature log by the schema of its API, against NumPy and against the API."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.feather
import pyproj
import pytest
from logs_truth import (
    Array,
    Log,
    drive,
    image_bytes,
    judge,
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
from scipy.spatial.transform import Rotation
from wildcity.logs.argoverse2 import CITIES

NAME = "7fab2350-7eaf-3b7e-a39d-000000000000"
START_NS = 315_966_253_572_412_942
CAMERAS = {
    "ring_front_center": (mount(1.63, 0, 1.4, 0), (1550, 2048)),
    "ring_side_left": (mount(1.3, 0.2, 1.4, 98), (2048, 1550)),
    "stereo_front_left": (mount(1.6, 0.24, 1.2, 0.3), (2048, 1550)),
}
K = np.array([[1776.04, 0, 777.99], [0, 1776.04, 1013.5], [0, 0, 1]])
START = (5172.6, 2419.1, 66.9)


def city(time_ns: int) -> Array:
    return drive((time_ns - START_NS) / 1e9, START)


def pose_columns(poses: list[Array]) -> dict[str, list[float]]:
    q = np.array([wxyz(pose) for pose in poses])
    found = {f"q{axis}": q[:, index].tolist() for index, axis in enumerate("wxyz")}
    return found | {f"t{axis}_m": [float(pose[index, 3]) for pose in poses] for index, axis in enumerate("xyz")}


def feather(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.feather.write_feather(pyarrow.table(columns), str(path), compression="zstd")


def world_points() -> Array:
    return moved(city(START_NS), np.random.default_rng(3).uniform(-25, 25, (256, 3)))


def make(log: Path) -> Path:
    rows: list[dict[str, Any]] = []
    times = [START_NS + 9_973_311 * n for n in range(60)]
    sweeps = [times[10] + 1, times[20] + 2, times[30] + 3]
    frames = {name: [START_NS + 50_000_123 * n + 7_000_000 * at for n in range(9) if (at, n) != (1, 4)]
              for at, name in enumerate(CAMERAS)}  # fmt: skip
    every = sorted({*times, *sweeps, *(time for its in frames.values() for time in its), times[5] + 1})
    feather(log / "city_SE3_egovehicle.feather", {"timestamp_ns": every, **pose_columns([city(t) for t in every])})
    mounts = {name: its[0] for name, its in CAMERAS.items()} | {
        "up_lidar": matrix([1.35, 0, 1.64], Rotation.identity())
    }
    feather(log / "calibration" / "egovehicle_SE3_sensor.feather",
            {"sensor_name": list(mounts), **pose_columns(list(mounts.values()))})  # fmt: skip
    numbers = {
        "fx_px": K[0, 0],
        "fy_px": K[1, 1],
        "cx_px": K[0, 2],
        "cy_px": K[1, 2],
        "k1": -0.24,
        "k2": -0.2,
        "k3": 0.3,
    }
    sizes = {"height_px": [its[1][1] for its in CAMERAS.values()], "width_px": [its[1][0] for its in CAMERAS.values()]}
    columns = {key: [float(value)] * len(CAMERAS) for key, value in numbers.items()}
    sizes = {key: np.array(values, np.uint16) for key, values in sizes.items()}
    feather(log / "calibration" / "intrinsics.feather", {"sensor_name": list(CAMERAS), **columns, **sizes})
    for at, (name, its) in enumerate(frames.items()):
        folder = log / "sensors" / "cameras" / name
        folder.mkdir(parents=True)
        for n, time_ns in enumerate(its):
            (folder / f"{time_ns}.jpg").write_bytes(image_bytes(10 * n + at))
    for time_ns in sweeps:
        xyz = moved(np.linalg.inv(city(time_ns)), world_points())
        count = len(xyz)
        points = {axis: xyz[:, index].astype(np.float32) for index, axis in enumerate("xyz")}
        rest = {"intensity": np.arange(count, dtype=np.uint8), "laser_number": (np.arange(count) % 64).astype(np.uint8)}
        offsets = np.random.default_rng(1).permutation(count).astype(np.int32) * 390_000
        feather(log / "sensors" / "lidar" / f"{time_ns}.feather", {**points, **rest, "offset_ns": offsets})
    for category in ("REGULAR_VEHICLE", "BICYCLIST", "STROLLER", "BOLLARD", "CHIMERA"):
        for time_ns in sweeps:
            rows.append({"timestamp_ns": time_ns, "track_uuid": f"track-{category}", "category": category})
    box = matrix([12, -3, 0.8], Rotation.from_euler("z", 0.7))
    table = {key: [row[key] for row in rows] for key in rows[0]}
    size = {"length_m": 4.5, "width_m": 2.0, "height_m": 1.6}
    shape: dict[str, Any] = {key: [value] * len(rows) for key, value in size.items()}
    shape["num_interior_pts"] = [5] * len(rows)
    feather(log / "annotations.feather", {**table, **shape, **pose_columns([box] * len(rows))})
    write_map(log / "map" / f"log_map_archive_{NAME}____PIT_city_47896.json")
    return log


def corner(x: float, y: float) -> dict[str, float]:
    return {"x": START[0] + x, "y": START[1] + y, "z": START[2]}


def write_map(path: Path) -> None:
    lane = {"id": 7, "is_intersection": True, "lane_type": "VEHICLE", "successors": [8, 99], "predecessors": []}
    lane |= {"left_lane_boundary": [corner(0, 2), corner(10, 2), corner(20, 2)]}
    lane |= {"right_lane_boundary": [corner(0, -2), corner(20, -2)], "left_lane_mark_type": "NONE"}
    bike = {**lane, "id": 8, "lane_type": "BIKE", "is_intersection": False, "successors": []}
    area = {"id": 3, "area_boundary": [corner(0, 5), corner(9, 5), corner(9, -5)]}
    crossing = {"id": 4, "edge1": [corner(0, 0), corner(0, 9)], "edge2": [corner(3, 0), corner(3, 9)]}
    found = {"lane_segments": {"7": lane, "8": bike}, "drivable_areas": {"3": area}}
    path.parent.mkdir()
    path.write_text(json.dumps({**found, "pedestrian_crossings": {"4": crossing}}))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("av2") / "val" / NAME)


@pytest.fixture(scope="module")
def log(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Log:
    out = tmp_path_factory.mktemp("log") / "log"
    said = run(source.parents[1], "--out", out)
    assert "gap: images ring_side_left: 1 interval longer than" in said
    return Log(out)


def test_poses_and_times_are_the_recorded_ones(log: Log, source: Path) -> None:
    table = pyarrow.feather.read_table(source / "city_SE3_egovehicle.feather")
    times = table.column("timestamp_ns").to_pylist()
    same_poses(log, {time_ns // 1000: city(time_ns) for time_ns in reversed(times)})
    assert "poses in the same microsecond as the pose before: 4" in " ".join(log.head["left_out"])
    files = sorted((source / "sensors" / "cameras").glob("*/*.jpg"))
    rows = sorted(log.rows("images"), key=lambda row: (row["camera"], row["time_us"]))
    assert len(rows) == len(files) == 26
    for row, path in zip(rows, files, strict=True):
        assert (row["camera"], row["time_us"] + log.epoch_us) == (path.parent.name, int(path.stem) // 1000)
        assert (log.folder / row["file"]).read_bytes() == path.read_bytes()


def views(log: Log) -> list[tuple[str, int, Array, Array]]:
    """Camera, time in nanoseconds, 100 points of the city, and our pixels of them."""
    found = []
    for name, (pose, size) in CAMERAS.items():
        time_ns = START_NS + 50_000_123 * 2 + 7_000_000 * list(CAMERAS).index(name)
        seen = moved(city(time_ns) @ pose, points_seen(K, size))
        found.append((name, time_ns, seen, log.project(name, log.poses()[time_ns // 1000], seen)))
    return found


def test_points_have_the_pixels_of_the_formula(log: Log) -> None:
    assert {name: (one["width"], one["height"]) for name, one in log.rig.items()} == {
        name: size for name, (_, size) in CAMERAS.items()}  # fmt: skip
    for name, time_ns, seen, ours in views(log):
        flat = moved(np.linalg.inv(city(time_ns) @ CAMERAS[name][0]), seen) @ K.T
        np.testing.assert_allclose(ours - 0.5, flat[:, :2] / flat[:, 2:], rtol=0, atol=1e-3)


def test_points_have_the_pixels_of_the_api(log: Log, source: Path) -> None:
    program = """
import warnings
warnings.simplefilter("ignore")
import numpy as np
from pathlib import Path
from av2.geometry.camera.pinhole_camera import PinholeCamera
from av2.utils.io import read_city_SE3_ego
log, pixels = Path(given["log"]), []
poses = read_city_SE3_ego(log)
for name, time_ns, points in given["views"]:
    ego = poses[time_ns].inverse().transform_point_cloud(np.array(points))
    pixels.append(PinholeCamera.from_feather(log, name).project_ego_to_img(ego)[0].tolist())
print(json.dumps(pixels))
"""
    found = views(log)
    given = [(name, time_ns, seen.tolist()) for name, time_ns, seen, _ in found]
    theirs = judge(program, {"log": str(source), "views": given})
    np.testing.assert_allclose([ours - 0.5 for *_, ours in found], theirs, rtol=0, atol=1e-3)


def test_the_points_of_the_lidar_are_in_their_places(log: Log) -> None:
    rows = log.rows("lidar")
    assert len(rows) == 3
    for row in rows:
        found, times = log.sweep_in_world(row)
        offsets = np.random.default_rng(1).permutation(256) * 390
        order = np.argsort(offsets)
        assert np.array_equal(times - (row["compensated_to_us"] + log.epoch_us), offsets[order])
        np.testing.assert_allclose(found, world_points()[order], rtol=0, atol=1e-3)


def test_boxes_and_the_map(log: Log) -> None:
    rows = log.rows("tracks")
    classes = {row["track"]: row["class"] for row in rows}
    assert classes == {"track-REGULAR_VEHICLE": "vehicle", "track-BICYCLIST": "bicycle",
                       "track-STROLLER": "pedestrian", "track-BOLLARD": "object"}  # fmt: skip
    assert "boxes of class CHIMERA: 3" in " ".join(log.head["left_out"])
    time_ns = START_NS + 9_973_311 * 10 + 1
    wanted = city(time_ns) @ matrix([12, -3, 0.8], Rotation.from_euler("z", 0.7))
    assert rows[0]["time_us"] + log.epoch_us == time_ns // 1000 and rows[0]["size"] == [4.5, 2.0, 1.6]
    np.testing.assert_allclose(log.pose(rows[0]["world_from_box"]), wanted, rtol=0, atol=1e-6)
    found = json.loads((log.folder / "map.json").read_text())
    assert [(lane["id"], lane.get("kind"), lane["next"]) for lane in found["lanes"]] == [
        ("7", None, ["8"]), ("8", "bicycle", [])]  # fmt: skip
    assert [area["kind"] for area in found["areas"]] == ["drivable", "crosswalk"]
    middle = np.array(found["lanes"][0]["center"]) + log.origin - START
    np.testing.assert_allclose(middle, [[0, 0, 0], [10, 0, 0], [20, 0, 0]], atol=1e-6)


def test_the_place_on_the_earth_is_that_of_the_city(log: Log) -> None:
    """The origins of av2/geometry/utm.py, by PROJ."""
    degrees = {
        "ATX": (30.27464237939507, -97.7404457407424), "DTW": (42.29993066912924, -83.17555750783717),
        "MIA": (25.77452579915163, -80.19656914449405), "PAO": (37.416065, -122.13571963362166),
        "PIT": (40.44177902989321, -80.01294377242584), "WDC": (38.889377, -77.0355047439081),
    }  # fmt: skip
    for city, (latitude, longitude) in degrees.items():
        zone, easting, northing = CITIES[city]
        judge = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:326{zone:02d}", always_xy=True)
        np.testing.assert_allclose(judge.transform(longitude, latitude), (easting, northing), rtol=0, atol=1e-3)
    _, easting, northing = CITIES["PIT"]
    place = {"easting_m": easting + log.origin[0], "northing_m": northing + log.origin[1]}
    assert log.head["world"]["geo"] == {"projection": "EPSG:32617", **place}


def test_a_killed_run_goes_on(source: Path, log: Log, tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, log.folder, source.parents[1], after=27)


def edited(name: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def act(log: Path) -> None:
        path = log / name
        table = {key: list(values) for key, values in pyarrow.feather.read_table(path).to_pydict().items()}
        change(table)
        feather(path, table)

    return act


def swap(values: list[Any]) -> None:
    values[3], values[4] = values[4], values[3]


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no poses": (edited("city_SE3_egovehicle.feather", lambda t: [its.clear() for its in t.values()]), "no poses"),
    "a missing table": (lambda log: (log / "calibration/intrinsics.feather").unlink(), "intrinsics.feather: missing"),
    "a missing column": (edited("annotations.feather", lambda t: t.pop("qw")), "annotations.feather: no column qw"),
    "a clock that runs backwards": (
        edited("city_SE3_egovehicle.feather", lambda t: swap(t["timestamp_ns"])), "the clock runs backwards"),
    "a broken file": (
        lambda log: (log / "city_SE3_egovehicle.feather").write_bytes(b"ARROW1"), "not a Feather file"),
    "no intrinsics": (
        edited("calibration/intrinsics.feather", lambda t: t["sensor_name"].__setitem__(0, "stereo_front_right")),
        "no row of stereo_front_right"),
    "millimetres": (
        edited("calibration/egovehicle_SE3_sensor.feather", lambda t: t["tx_m"].__setitem__(0, 1635.0)),
        "perhaps it is millimetres"),
    "no rotation": (edited("city_SE3_egovehicle.feather", lambda t: t["qw"].__setitem__(2, 7.0)), "not the length 1"),
    "a broken map": (lambda log: next(log.glob("map/*")).write_text("{"), "not JSON"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_logs_are_refused(name: str, tmp_path: Path) -> None:
    log = make(tmp_path / NAME)
    BAD[name][0](log)
    text = refused(tmp_path, log, "--kind", "argoverse2")
    assert BAD[name][1] in text, text


def test_the_extra_is_named_if_it_is_not_installed(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    for name in [name for name in sys.modules if name.startswith(("wildcity.logs.argoverse2", "wildcity.logs.arrow"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert "the kind argoverse2 needs the package pyarrow; pip install 'wildcity[av2]'" in refused(tmp_path, source)
