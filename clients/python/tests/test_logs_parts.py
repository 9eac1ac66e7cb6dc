"""Parts that all converters share: tables, transforms, lenses, names, classes, and the command line."""

from __future__ import annotations

import json
import random
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pyproj
import pytest
from logs_truth import refused, run
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation, Slerp
from wildcity.logs import KINDS, LogError, convert, nurec, tableio, tables
from wildcity.logs.earth import earth_centred, geodetic
from wildcity.logs.frames import Poses, inverse, quaternion, rotation, rotation_error, transform
from wildcity.logs.lenses import Intrinsics, camera, fisheye, lens_of, opencv
from wildcity.logs.names import CLASSES, class_of, name_of
from wildcity.logs.points import Sweep
from wildcity.logs.progress import Progress
from wildcity.logs.tables import Spool
from wildcity.logs.writer import LogWriter


@pytest.mark.parametrize("run_lines", [7, 1000])
def test_rows_are_sorted_in_memory_that_is_bounded(
    run_lines: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "RUN_LINES", run_lines)
    rows = [{"time_us": 1000 * (n % 50) - 20_000, "camera": f"c{n % 3}", "n": n % 50} for n in range(150)]
    random.Random(1).shuffle(rows)
    spool = Spool(tmp_path / "images.rows")
    for row in [*rows, *rows[:20]]:  # Twenty rows are there twice.
        spool.add(row)
    count, gaps, clash = spool.sorted_into(tmp_path / "images.jsonl")
    found = [json.loads(line) for line in (tmp_path / "images.jsonl").read_text().splitlines()]
    assert count == len(found) == 150 and not gaps and clash is None
    assert found == sorted(rows, key=lambda row: (row["time_us"], row["camera"]))


def test_two_rows_of_a_time_and_gaps_are_found(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "gps.rows")
    for time_us in (0, 100, 200, 460, 560, 960, 1060):
        spool.add({"time_us": time_us, "latitude_deg": 1.0})
    spool.add({"time_us": 560, "latitude_deg": 2.0})
    _, gaps, clash = spool.sorted_into(tmp_path / "gps.jsonl")
    assert [(gap.count, gap.longest_us, gap.at_us, gap.median_us) for gap in gaps] == [(2, 400, 560, 100)]
    assert clash is not None and "2.0" in clash[1]


def test_a_log_with_two_rows_of_a_time_is_refused(tmp_path: Path) -> None:
    head = {"kind": "k", "id": "i", "licence": "", "converter": ""}
    with LogWriter(tmp_path / "log", head) as writer:
        writer.begin(10**15)
        writer.cameras = [{"name": "c"}]
        for shift in (0.0, 0.1):
            writer.pose(10**15, transform((shift, 0, 0)), "a pose")
        with pytest.raises(LogError, match=r"i \(poses\): two different rows of one time"):
            writer.finish()


HEAD = {"kind": "test", "id": "one", "licence": "none", "converter": "test"}


def test_measurements_that_are_not_finite_are_left_out_and_counted(tmp_path: Path) -> None:
    nan = float("nan")
    with LogWriter(tmp_path / "log", HEAD) as writer:
        writer.imu(1, [0, 0, nan], [0, 0, 9.8])
        writer.gps(1, 49.0, 8.0, nan)
        writer.box(1, "a", "car", [4.0, nan, 1.5], np.eye(4))
        writer.box(2, "a", "car", [4.0, None, 1.5], np.eye(4))
        writer.box(3, "a", "car", [4.0, 2.0], np.eye(4))
        left_out = " ".join(writer._sentences())
        measured = ("rows of the IMU that are not finite: 1", "fixes that are not finite: 1")
        for part in (*measured, "without a size or a pose: 3"):
            assert part in left_out
        assert not writer.has("imu") and not writer.has("gps") and not writer.has("tracks")


def test_values_that_no_log_can_have_are_refused(tmp_path: Path) -> None:
    def refusal(act: Callable[[LogWriter], Any]) -> str:
        with pytest.raises(LogError) as caught, LogWriter(tmp_path / "log", HEAD) as writer:
            act(writer)
        return str(caught.value)

    assert "no degrees" in refusal(lambda its: its.gps(1, 4900.0, 8.0, 1.0))
    assert "no clock is so far" in refusal(lambda its: its.row("imu", 1 << 62, {}))
    assert "not finite" in refusal(lambda its: its.row("images", 1, {"exposure_stops": float("inf")}))
    far = np.eye(4)
    far[0, 3] = 1e200
    assert "no finite rotation" in refusal(lambda its: its.pose(1, far, "place"))
    points = np.zeros((2, 3))
    rings = Sweep(points, np.zeros(2, np.int64), ring=np.array([0.0, 70_000.0]))
    assert "numbers of lasers from 0.0 to 70000.0" in refusal(lambda its: its.sweep("top", 1, lambda: rings))

    far_points = Sweep(np.full((3, 3), 30_000.0), np.zeros(3, np.int64))
    assert "perhaps they are millimetres" in refusal(lambda its: its.sweep("top", 1, lambda: far_points))

    def two_of_a_name(writer: LogWriter) -> None:
        writer.pose(1, np.eye(4), "place")
        writer.cameras = [{"name": "front"}, {"name": "front"}]
        writer.finish()

    assert "two cameras have the name 'front'" in refusal(two_of_a_name)


def test_what_no_converter_foresees_is_a_named_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> Any:
        return {}["lost"]

    (tmp_path / "lanes.osm").write_text("<osm/>")
    monkeypatch.setattr("wildcity.logs.lanelet2.convert", fails)
    with pytest.raises(LogError, match="does not have so: KeyError: 'lost'; use files of the documented schema"):
        convert(tmp_path / "lanes.osm", tmp_path / "log")


@pytest.mark.parametrize("chunk", [1, 3, 17, 10_000])
def test_a_table_of_json_is_read_row_by_row(chunk: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tableio, "_CHUNK", chunk)
    rows = [{"token": f"{n:032x}", "text": 'a "quoted", [bracketed] {text} \\ ü', "n": -1.5e-7 * n} for n in range(30)]
    for indent in (None, 0, 2):
        path = tmp_path / "table.json"
        path.write_text(json.dumps(rows, indent=indent))
        assert list(tableio.json_rows(path, "a table")) == rows
    path.write_text(json.dumps(rows)[:-40])
    with pytest.raises(LogError, match="not JSON, or cut off"):
        list(tableio.json_rows(path, "a table"))
    for text, words in (("{}", "not a JSON array"), ("[1, 2]", "a row is 1"), ("", "not a JSON array")):
        path.write_text(text)
        with pytest.raises(LogError, match=words):
            list(tableio.json_rows(path, "a table"))


def test_transforms_are_those_of_scipy() -> None:
    turns = Rotation.random(300, random_state=1)
    # Turns about an axis by half a turn take the other branches.
    turns = Rotation.concatenate(
        [turns, Rotation.from_rotvec(np.pi * np.eye(3)), Rotation.from_rotvec(3.1 * np.eye(3))]
    )
    for turn in turns:
        w, x, y, z = quaternion(turn.as_matrix())
        assert w >= 0
        np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), turn.as_matrix(), atol=1e-12)
        np.testing.assert_allclose(rotation((w, x, y, z)), turn.as_matrix(), atol=1e-12)
    pose = transform((1, 2, 3), (0.5, 0.5, -0.5, 0.5))
    np.testing.assert_allclose(inverse(pose) @ pose, np.eye(4), atol=1e-15)
    assert rotation_error(pose) < 1e-12 and rotation_error(np.diag([1.0, 1, -1, 1])) == 2.0
    assert rotation_error(2 * np.eye(4)) > 1 and rotation_error(np.full((4, 4), np.nan)) == float("inf")


def test_poses_are_interpolated_as_by_scipy() -> None:
    # From 3.0 to 3.5 rad the quaternions with w >= 0 change their side.
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.4], [0.1, 0, 3.0], [0, 0, 3.5]])
    times = [0, 100, 250, 300]
    found = [transform((n, n * n, 0), (turn.as_quat()[[3, 0, 1, 2]])) for n, turn in enumerate(turns)]
    poses, judge = Poses(times, found), Slerp(times, turns)
    for time_us in (0, 1, 50, 100, 249, 275, 300):
        np.testing.assert_allclose(poses.at(time_us)[:3, :3], judge(time_us).as_matrix(), atol=1e-12)
    assert poses.at(50)[0, 3] == 0.5 and not poses.covers(301) and not poses.covers(-1) and poses.covers(0)


def test_places_on_the_earth_are_those_of_proj() -> None:
    judge = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    for place in ((0.0, 0.0, 0.0), (49.0133, 8.4211, 115.0), (-33.9, 151.2, -20.0), (71.0, -156.8, 4000.0)):
        xyz = earth_centred(*place)
        np.testing.assert_allclose(xyz, judge.transform(place[1], place[0], place[2]), rtol=0, atol=1e-6)
        np.testing.assert_allclose(geodetic(xyz), place, rtol=0, atol=1e-6)


INTRINSICS = Intrinsics(640, 480, 300.0, 301.0, 320.0, 240.0)


def test_a_fisheye_reaches_the_corner_of_the_image() -> None:
    lens = fisheye([-0.02, 0.004, -0.001, 0.0002], INTRINSICS)
    model = pycolmap.Camera(model="OPENCV_FISHEYE", width=640, height=480, params=[300, 301, 320, 240, *lens["k"]])
    corner = model.cam_from_img(np.array([[0.0, 0.0]]))[0]
    assert lens["max_angle"] == pytest.approx(np.arctan(np.hypot(*corner)), abs=2e-3)
    folded = fisheye([-0.3, 0, 0, 0], INTRINSICS)  # The slope 1 - 0.9 theta^2 ends at 1.054.
    assert folded["max_angle"] == pytest.approx(1.054, abs=1e-3)


def test_lenses_by_their_names() -> None:
    assert lens_of("none", [], INTRINSICS, "p") is None and lens_of("plumb_bob", [0] * 5, INTRINSICS, "p") is None
    assert opencv([1, 2, 3, 4]) == {"model": "opencv", "k": [1, 2, 0, 0, 0, 0], "p": [3, 4]}
    assert opencv(range(1, 13)) == {
        "model": "opencv", "k": [1, 2, 5, 6, 7, 8], "p": [3, 4], "s": [9, 10, 11, 12]}  # fmt: skip
    for name, coefficients, words in (
        ("omni", [1, 2, 3, 4], "the lens model 'omni'"),
        ("radtan", [1, 2, 3], "3 distortion coefficients"),
        ("opencv", [1] * 14, "tilted sensors are not"),
        ("equidistant", [1, 2], "2 coefficients of a fisheye lens"),
    ):
        with pytest.raises(LogError, match=words):
            lens_of(name, coefficients, INTRINSICS, "camera.yaml")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"fx": float("nan")}, "has no intrinsics"),
        ({"width": 0}, "has the size 0 x 480"),
        ({"fx": 4.1, "fy": 4.1}, "perhaps millimetres"),
    ],
)
def test_bad_cameras_are_refused(fields: dict[str, Any], words: str) -> None:
    values = {**INTRINSICS.__dict__, **fields}
    with pytest.raises(LogError, match=words):
        camera("front", Intrinsics(**values), np.eye(4), "camera.yaml")


def test_names_and_classes() -> None:
    assert name_of("/Camera Front/Left") == "camera_front_left" and name_of(".x") == "x" and name_of("") == "unnamed"
    assert len(name_of("n" * 99)) == 64
    labels = {
        "vehicle.bus.bendy": "vehicle", "vehicle.bicycle": "bicycle", "human.pedestrian.adult": "pedestrian",
        "movable_object.trafficcone": "object", "REGULAR_VEHICLE": "vehicle", "MOTORCYCLIST": "vehicle",
        "WHEELED_RIDER": "pedestrian", "Person_sitting": "pedestrian", "Tram": "vehicle", "TYPE_SIGN": "object",
        "vehicle.emergency.police": "vehicle", "static_object.bicycle_rack": "object", "Cyclist": "bicycle",
    }  # fmt: skip
    assert {label: class_of(label) for label in labels} == labels
    assert class_of("DontCare") is None and class_of("TYPE_UNKNOWN") is None
    names = [name for its in CLASSES.values() for name in its]
    assert len(names) == len(set(names)), "a name is in two classes"


def test_a_sweep_is_sorted_and_keeps_its_finite_points(tmp_path: Path) -> None:
    points = np.array([[1, 0, 0], [2, 0, 0], [np.nan, 0, 0], [3, 0, 0]])
    times = np.array([30, 10, 20, 10], np.int64) + 10**15
    found = Sweep(points, times, np.arange(4.0), np.arange(4)).write(tmp_path / "a.safetensors", 10**15)
    assert found == {"points": 3, "dropped": 1, "first_us": 10**15 + 10, "last_us": 10**15 + 30}
    tensors = load_file(tmp_path / "a.safetensors")
    assert tensors["points_m"][:, 0].tolist() == [2, 3, 1] and tensors["time_us"].tolist() == [10, 10, 30]
    assert tensors["ring"].tolist() == [1, 3, 0] and tensors["ring"].dtype == np.uint16
    kinds = {name: values.dtype.str for name, values in tensors.items()}
    assert kinds == {"points_m": "<f4", "time_us": "<i8", "intensity": "<f4", "ring": "<u2"}


def test_progress_is_a_bar_on_a_terminal_and_ten_lines_in_a_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with Progress("files", 1000) as progress:
        for _ in range(1000):
            progress.step()
    assert capsys.readouterr().err.splitlines()[-1] == "files: 1000 of 1000" and progress.done == 1000
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    clock = iter(np.arange(0, 10_000, 0.06))
    monkeypatch.setattr("wildcity.logs.progress.time.monotonic", lambda: float(next(clock)))
    with Progress("files", 100) as progress:
        for _ in range(100):
            progress.step()
    bars = capsys.readouterr().err.split("\r")
    assert 40 < len(bars) < 60 and "[###" in bars[-2] and bars[-2].startswith("files: [")


def test_the_help_names_every_kind_and_says_how_to_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        run("--help")
    assert stopped.value.code == 0
    with pytest.raises(SystemExit) as stopped:
        run("somewhere")
    assert stopped.value.code == 2, "neither --out nor --list"


def test_a_source_of_several_kinds_needs_the_kind(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    (data / "metadata.yaml").write_text("")
    (data / "x.db").write_bytes(b"")
    assert "it looks like several kinds: " in refused(tmp_path, data)
    assert len({kind.name for kind in KINDS}) == len(KINDS)


def test_brackets_within_brackets_are_a_damaged_file(tmp_path: Path) -> None:
    deep = tmp_path / "deep.json"
    deep.write_text("[" * 100_000)
    with pytest.raises(LogError, match="not JSON"):
        tableio.json_file(deep, "a table")
    archive = tmp_path / "deep.zip"
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("rig_trajectories.json", "[" * 100_000)
    with pytest.raises(LogError, match="cannot read"):
        nurec._json(archive, "rig_trajectories.json")
