"""NVIDIA's ncore V4 to a log: miniature stores by its documentation, against its formulas and its own reader."""

from __future__ import annotations

import io
import json
import lzma
import struct
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pycolmap
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
)
from scipy.spatial.transform import Rotation

NAME = "01d503d4-449b-46fc-8d78-9085e70d3554"
START_US = 1_700_000_000_000_000
SIZE = (1920, 1080)
CAMERAS = {"camera_front_wide_120fov": mount(1.7, 0, 1.5, 0, 2), "camera_left": mount(1.0, 0.9, 1.2, 90)}
LIDAR = matrix([1.2, 0.1, 2.0], Rotation.from_euler("ZYX", [1.5, 0.02, 0.01]))
RIG_FROM_BODY = matrix([0.1, 0.2, 0.3], Rotation.from_euler("z", 0.2))
POLYNOMIAL, CDE = [0.0, 944.6, -20.7, 54.1, -87.5, 31.0], [0.99976, 5.5e-05, 1.7e-05]
RADIAL, TANGENTIAL = [0.1, 0.02, 0.003, 0.01, 0.002, 0.0], [1e-4, 2e-4]
K = np.array([[1200.0, 0, 955.5], [0, 1210, 541.25], [0, 0, 1]])
SHARED = {"resolution": list(SIZE), "external_distortion_parameters": None}
LENSES: dict[str, dict[str, Any]] = {
    "camera_front_wide_120fov": {"camera_model_type": "ftheta", "camera_model_parameters": {
        **SHARED, "shutter_type": "ROLLING_TOP_TO_BOTTOM", "principal_point": [958.5, 541.0],
        "reference_poly": "ANGLE_TO_PIXELDIST", "angle_to_pixeldist_poly": POLYNOMIAL,
        "pixeldist_to_angle_poly": [0.0, 1 / 944.6, 0, 0, 0, 0], "max_angle": 1.2, "linear_cde": CDE}},
    "camera_left": {"camera_model_type": "opencv-pinhole", "camera_model_parameters": {
        **SHARED, "shutter_type": "GLOBAL", "principal_point": [K[0, 2], K[1, 2]], "focal_length": [K[0, 0], K[1, 1]],
        "radial_coeffs": RADIAL, "tangential_coeffs": TANGENTIAL, "thin_prism_coeffs": [0.0] * 4}},
}  # fmt: skip
FRAMES, READOUT_US = 5, 31_000
BLOSC = {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 2, "blocksize": 0}

Files = dict[str, bytes]


def group(files: Files, name: str, attributes: Any = None) -> None:
    parts = name.split("/") if name else []
    for depth in range(len(parts) + 1):
        files.setdefault("/".join([*parts[:depth], ".zgroup"]), b'{"zarr_format": 2}')
    if attributes is not None:
        files[f"{name}/.zattrs" if name else ".zattrs"] = json.dumps(attributes).encode()


def array(files: Files, name: str, values: Array, chunks: tuple[int, ...] | None = None) -> None:
    group(files, name.rpartition("/")[0])
    chunks = values.shape if chunks is None else chunks
    its = {"zarr_format": 2, "shape": values.shape, "chunks": chunks, "dtype": values.dtype.str, "order": "C"}
    files[f"{name}/.zarray"] = json.dumps({**its, "compressor": BLOSC, "filters": None, "fill_value": 0}).encode()
    codec = numcodecs.get_codec(BLOSC)
    for row in range(values.shape[0] // chunks[0]):
        part = np.ascontiguousarray(values[row * chunks[0] : (row + 1) * chunks[0]])
        files[f"{name}/" + ".".join([str(row), *["0"] * (values.ndim - 1)])] = codec.encode(part)


def text(files: Files, name: str, data: bytes, form: str) -> None:
    """An array of one text, not compressed: an encoded image."""
    group(files, name.rpartition("/")[0])
    its = {"zarr_format": 2, "shape": [], "chunks": [], "dtype": f"|S{len(data)}", "order": "C", "compressor": None}
    files[f"{name}/.zarray"] = json.dumps({**its, "filters": None, "fill_value": ""}).encode()
    files[f"{name}/.zattrs"] = json.dumps({"format": form}).encode()
    files[f"{name}/0"] = data


def cbor(value: Any) -> bytes:
    def head(kind: int, count: int) -> bytes:
        return bytes([kind << 5 | 27]) + struct.pack(">Q", count)

    if isinstance(value, dict):
        return head(5, len(value)) + b"".join(cbor(key) + cbor(its) for key, its in value.items())
    if isinstance(value, list):
        return head(4, len(value)) + b"".join(cbor(its) for its in value)
    return head(3, len(value.encode())) + value.encode() if isinstance(value, str) else head(0, value)


def write_itar(path: Path, files: Files) -> None:
    out = io.BytesIO()
    index: dict[str, list[Any]] = {"items": [], "offset_datas": [], "sizes": []}
    with tarfile.TarFile(fileobj=out, mode="w") as archive:
        for name, data in files.items():
            its = tarfile.TarInfo(name)
            its.size = len(data)
            archive.addfile(its, io.BytesIO(data))
            index["items"].append(name)
            index["offset_datas"].append(out.tell() - -(-len(data) // 512) * 512)
            index["sizes"].append(len(data))
    packed, place = lzma.compress(cbor(index)), out.tell()
    tail = packed + bytes(-len(packed) % 512) + struct.pack("<4sIQI", b"itar", 1, place, len(packed)).ljust(512, b"\0")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(out.getvalue() + tail)


def write_folder(path: Path, files: Files) -> None:
    for name, data in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(data)


def end_us(camera: str, frame: int) -> int:
    return START_US + 100_000 + 100_000 * frame + 3_000 * list(CAMERAS).index(camera)


def rig(time_us: float) -> Array:
    return drive((time_us - START_US) / 1e6, (0.3, 0.7, 0.0))


def sweep(frame: int) -> tuple[Array, Array]:
    """Points of the world [2, 80, 3], two of each ray, and the times of the rays. The second of each third is NaN."""
    random = np.random.default_rng(frame)
    times = START_US + 100_000 * frame + np.arange(80) * 1_200
    ray = random.uniform(-1, 1, (80, 3))
    world = np.array([[moved(rig(time) @ LIDAR, (length * one / np.linalg.norm(one))[None])[0]
                       for one, time in zip(ray, times, strict=True)] for length in (9.0, 21.0)])  # fmt: skip
    world[1, ::3] = np.nan
    return world, times


def root(files: Files, name: str) -> None:
    interval = {"start": START_US, "stop": START_US + 700_001}
    meta = {"sequence_id": NAME, "sequence_timestamp_interval_us": interval, "generic_meta_data": {}, "version": "v4"}
    group(files, "", {**meta, "component_group_name": name})


def component(files: Files, kind: str, name: str) -> str:
    meta = {"component_name": kind, "component_instance_name": name, "component_version": "v1"}
    group(files, f"{kind}/{name}", {**meta, "generic_meta_data": {}})
    return f"{kind}/{name}"


def stores() -> dict[str, Files]:
    files: Files = {}
    root(files, "")
    node = component(files, "poses", "default")
    times = [START_US + 10_000 * n for n in range(71)]
    static = {(name, "rig"): pose for name, pose in CAMERAS.items()}
    # A sensor whose place on the rig goes over another frame, and backwards.
    static |= {("body", "lidar_top"): np.linalg.inv(LIDAR) @ RIG_FROM_BODY, ("body", "rig"): RIG_FROM_BODY}
    static[("world", "world_global")] = matrix([4e6, 5e5, 4.9e6], Rotation.from_euler("z", 1.0))
    group(files, f"{node}/static_poses", {str(key): {"pose": pose.tolist(), "dtype": "float64"}
                                          for key, pose in static.items()})  # fmt: skip
    moving = {"poses": [rig(time).tolist() for time in times], "timestamps_us": times, "dtype": "float64"}
    group(files, f"{node}/dynamic_poses", {"('rig', 'world')": moving})
    node = component(files, "intrinsics", "default")
    for name, lens in LENSES.items():
        group(files, f"{node}/cameras/{name}", lens)
    group(files, f"{node}/lidars")
    for number, name in enumerate(CAMERAS):
        node = component(files, "cameras", name)
        start = READOUT_US if number == 0 else 0
        spans = [[end_us(name, frame) - start, end_us(name, frame)] for frame in range(FRAMES)]
        group(files, f"{node}/frames", {"frames_timestamps_us": spans})
        for frame in range(FRAMES):
            at = f"{node}/frames/{end_us(name, frame)}"
            group(files, f"{at}/generic_data", {})
            text(files, f"{at}/image", image_bytes(10 * frame + number), "jpeg")
    group(files, component(files, "radars", "radar_front") + "/frames", {"frames_timestamps_us": []})
    return {"": files, "lidar": lidar_store(), "labels": label_store()}


def lidar_store() -> Files:
    files: Files = {}
    root(files, "lidar")
    node = component(files, "lidars", "lidar_top")
    group(files, f"{node}/frames", {"frames_timestamps_us": [
        [START_US + 100_000 * frame, START_US + 100_000 * frame + 94_800] for frame in range(3)]})  # fmt: skip
    for frame in range(3):
        world, times = sweep(frame)
        own = np.array([[moved(np.linalg.inv(rig(time) @ LIDAR), point[None])[0]
                         for point, time in zip(row, times, strict=True)] for row in world])  # fmt: skip
        at, distance = f"{node}/frames/{START_US + 100_000 * frame + 94_800}", np.linalg.norm(own, axis=2)
        group(files, f"{at}/ray_bundle", {"n_rays": 80})
        array(files, f"{at}/ray_bundle/direction", (own[0] / distance[0][:, None]).astype("<f4"))
        array(files, f"{at}/ray_bundle/timestamp_us", times.astype("<u8"))
        array(files, f"{at}/ray_bundle/model_element", np.stack([np.arange(80) % 16, np.arange(80)], 1).astype("<u2"))
        group(files, f"{at}/ray_bundle_returns", {"n_returns": 2})
        array(files, f"{at}/ray_bundle_returns/distance_m", distance.astype("<f4"), (1, 80))
        intensity = np.where(np.isnan(distance), np.nan, 0.25)
        array(files, f"{at}/ray_bundle_returns/intensity", intensity.astype("<f4"), (1, 80))
    return files


BOX = {"centroid": [15.0, 2.0, 0.8], "dim": [4.5, 1.9, 1.6], "rot": [0.1, -0.2, 0.5]}


def label_store() -> Files:
    files: Files = {}
    root(files, "labels")
    node = component(files, "cuboids", "default")
    rows = [("automobile", "rig", 205_000), ("person", "lidar_top", 205_000), ("rider", "world", 205_000),
            ("kraken", "rig", 205_000), ("person", "rig", 999_000), ("person", "trailer", 205_000)]  # fmt: skip
    group(files, f"{node}/cuboids", {"cuboid_track_observations": [
        {"track_id": f"{label}-{frame}", "class_id": label, "timestamp_us": START_US + 201_234, "bbox3": BOX,
         "reference_frame_id": frame, "reference_frame_timestamp_us": START_US + after, "source": "AUTOLABEL"}
        for label, frame, after in rows]})  # fmt: skip
    return files


def make(folder: Path, write: Callable[[Path, Files], None] = write_itar, ending: str = ".zarr.itar") -> Path:
    for name, files in stores().items():
        write(folder / f"{NAME}.ncore4{'-' if name else ''}{name}{ending}", files)
    return folder


@pytest.fixture(scope="module", params=["itar", "folder"])
def source(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ncore")
    return make(folder) if request.param == "itar" else make(folder, write_folder, ".zarr")


@pytest.fixture(scope="module")
def log(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Log:
    out = tmp_path_factory.mktemp("log") / "log"
    run(source, "--out", out)
    return Log(out)


def test_poses_times_and_images_are_the_recorded_ones(log: Log) -> None:
    same_poses(log, {START_US + 10_000 * n: rig(START_US + 10_000 * n) for n in range(71)})
    for number, name in enumerate(CAMERAS):
        assert log.times("images", camera=name) == [end_us(name, frame) for frame in range(FRAMES)]
        rows = [row for row in log.rows("images") if row["camera"] == name]
        for frame, row in enumerate(rows):
            assert (log.folder / row["file"]).read_bytes() == image_bytes(10 * frame + number)
    assert log.rig["camera_front_wide_120fov"]["shutter"] == {"direction": "top_to_bottom", "duration_us": READOUT_US}
    assert "shutter" not in log.rig["camera_left"]
    assert "components of radars: 1" in " ".join(log.head["left_out"])


def test_points_have_the_pixels_of_the_documented_lenses(log: Log) -> None:
    time_us = START_US + 200_000
    points = points_seen(K, SIZE)
    ours = log.project("camera_left", rig(time_us), moved(rig(time_us) @ CAMERAS["camera_left"], points))
    values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *RADIAL[:2], *TANGENTIAL, *RADIAL[2:]]
    model = pycolmap.Camera(model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=values)
    np.testing.assert_allclose(ours, model.img_from_cam(points), rtol=0, atol=1e-3)
    name = "camera_front_wide_120fov"
    ours = log.project(name, rig(time_us), moved(rig(time_us) @ CAMERAS[name], points))
    radius = np.hypot(points[:, 0], points[:, 1])
    scale = np.polyval(POLYNOMIAL[::-1], np.arctan2(radius, points[:, 2])) / radius
    x, y = scale * points[:, 0], scale * points[:, 1]
    theirs = np.stack([CDE[0] * x + CDE[1] * y, CDE[2] * x + y], axis=1) + [958.5, 541.0]
    # Its principal point counts from the middle of the first pixel, and ours from the corner.
    np.testing.assert_allclose(ours - 0.5, theirs, rtol=0, atol=1e-3)


def test_the_lidar_is_deskewed_by_its_own_times(log: Log) -> None:
    rows = log.rows("lidar")
    assert [row["lidar"] for row in rows] == ["lidar_top"] * 3 and "compensated_to_us" not in rows[0]
    for frame, row in enumerate(rows):
        world, times = sweep(frame)
        found, found_times = log.sweep_in_world(row)
        is_there = np.isfinite(world[..., 0])
        flat, order = world[is_there], np.argsort(np.tile(times, 2)[is_there.reshape(-1)], kind="stable")
        assert np.array_equal(found_times, np.tile(times, 2)[is_there.reshape(-1)][order])
        np.testing.assert_allclose(found, flat[order], rtol=0, atol=1e-3)


def test_boxes_are_turned_about_fixed_axes(log: Log) -> None:
    rows = {row["track"]: row for row in log.rows("tracks")}
    assert sorted(rows) == ["automobile-rig", "person-lidar_top", "rider-world"]
    box = matrix(BOX["centroid"], Rotation.from_euler("xyz", BOX["rot"]))
    at = rig(START_US + 205_000)
    xyz, turns = log.between(np.array([START_US + 205_000]))
    assert abs(xyz[0] - at[:3, 3]).max() < 1e-3
    wanted = {"automobile-rig": at @ box, "person-lidar_top": at @ LIDAR @ box, "rider-world": box}
    for track, pose in wanted.items():
        np.testing.assert_allclose(log.pose(rows[track]["world_from_box"]), pose, rtol=0, atol=1e-3)
        assert rows[track]["size"] == BOX["dim"] and rows[track]["time_us"] + log.epoch_us == START_US + 201_234
    left_out = " ".join(log.head["left_out"])
    for part in ("class kraken: 1", "frame rig without a pose: 1", "frame trailer without a pose: 1"):
        assert part in left_out


def test_ncore_reads_the_same(tmp_path: Path) -> None:
    """The miniature is one of ncore: its own reader has the same images, rays and boxes."""
    make(tmp_path / "data")
    run(tmp_path / "data", "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    found = judge(
        """
import numpy as np
from pathlib import Path
from ncore.impl.common.transformations import bbox_pose
from ncore.impl.data.v4 import components as c
reader = c.SequenceComponentGroupsReader([Path(path) for path in given["paths"]], open_consolidated=False)
camera = reader.open_component_readers(c.CameraSensorComponent.Reader)[given["camera"]]
lidar = reader.open_component_readers(c.LidarSensorComponent.Reader)["lidar_top"]
cuboids = reader.open_component_readers(c.CuboidsComponent.Reader)["default"]
end = int(lidar.frames_timestamps_us[1, 1])
rays = lidar.get_frame_ray_bundle_data(end, "direction").astype(float)
distance = lidar.get_frame_ray_bundle_return_data(end, "distance_m", None).astype(float)
points = [(rays * row[:, None])[np.isfinite(row)].tolist() for row in distance]
box = next(iter(cuboids.get_observations())).bbox3
print(json.dumps({
    "times": camera.frames_timestamps_us[:, 1].tolist(), "points": points[0] + points[1],
    "image": list(camera.get_frame_data(given["at"]).get_encoded_image_data()),
    "box": bbox_pose(box.to_array()).tolist()}))
""",
        {"paths": [str(path) for path in sorted((tmp_path / "data").iterdir())], "camera": "camera_left",
         "at": end_us("camera_left", 1)},
    )  # fmt: skip
    assert found["times"] == log.times("images", camera="camera_left")
    assert bytes(found["image"]) == image_bytes(11)
    ours, _ = log.sweep_in_world(log.rows("lidar")[1])
    assert len(ours) == len(found["points"])
    np.testing.assert_allclose(found["box"], matrix(BOX["centroid"], Rotation.from_euler("xyz", BOX["rot"])), atol=1e-6)


def test_a_killed_run_goes_on(source: Path, log: Log, tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, log.folder, source, after=7)


def test_the_sequences_are_listed(source: Path) -> None:
    assert run(source, "--list").splitlines()[-1] == NAME


def changed(store: str, node: str, change: Callable[[Any], Any]) -> Callable[[dict[str, Files]], None]:
    def act(found: dict[str, Files]) -> None:
        its = json.loads(found[store][node])
        change(its)
        found[store][node] = json.dumps(its).encode()

    return act


FRONT = "cameras/camera_front_wide_120fov/frames"
SPANS, RIG = f"{FRONT}/.zattrs", "poses/default/dynamic_poses/.zattrs"
BUNDLE = f"lidars/lidar_top/frames/{START_US + 94_800}/ray_bundle"
LENS = "intrinsics/default/cameras/camera_left/.zattrs"
BAD: dict[str, tuple[Callable[[dict[str, Files]], Any], str]] = {
    "another version": (changed("", ".zattrs", lambda d: d.update(version="v3")), "the version 'v3' of the format"),
    "no poses": (changed("", RIG, lambda d: d.clear()), "no dynamic pose of rig and world"),
    "a clock that runs backwards": (
        changed("", SPANS, lambda d: d["frames_timestamps_us"].reverse()), "the clock runs backwards"),
    "a frame that ends before it starts": (
        changed("", SPANS, lambda d: d["frames_timestamps_us"][1].__setitem__(0, START_US + 400_000)),
        "a frame ends before it starts"),
    "no intrinsics": (changed("", LENS, lambda d: d.clear()), "has no field camera_model_parameters"),
    "no focal length": (
        changed("", LENS, lambda d: d["camera_model_parameters"].update(focal_length=[0, 0])), "has no intrinsics"),
    "no rotation": (
        changed("", RIG, lambda d: d["('rig', 'world')"]["poses"][3][0].__setitem__(0, 7.0)), "is no rotation"),
    "frames that run code": (
        changed("", RIG, lambda d: d.update({"__import__('os').system('touch harm')": {}})), "is no pair of frames"),
    "a lost image": (lambda d: d[""].pop(f"cameras/camera_left/frames/{end_us('camera_left', 2)}/image/0"), "an image"),
    "a lost array": (lambda d: d["lidar"].pop(f"{BUNDLE}/direction/.zarray"), "missing: an array"),
    "a broken chunk": (lambda d: d["lidar"].update({f"{BUNDLE}/timestamp_us/0": b"blosc"}), "no array of zarr"),
    "a codec that runs code": (
        changed("lidar", f"{BUNDLE}/direction/.zarray", lambda d: d.update(compressor={"id": "pickle"})),
        "the codec pickle"),
    "a huge array": (
        changed("lidar", f"{BUNDLE}/direction/.zarray", lambda d: d.update(shape=[10**9, 3], chunks=[10**9, 3])),
        "too large"),
    "times in seconds": (
        lambda d: array(d["lidar"], f"{BUNDLE}/timestamp_us", np.full(80, 1_700_000_000, "<u8")), "outside the frame"),
    "no JSON": (lambda d: d[""].update({SPANS: b"{"}), "not JSON"),
    "zarr 3": (lambda d: d[""].update({"zarr.json": b"{}"}), "zarr of format 3"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_stores_are_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = stores()
    BAD[name][0](found)
    for part, files in found.items():
        write_folder(tmp_path / "data" / f"{NAME}.ncore4{'-' if part else ''}{part}.zarr", files)
    said = refused(tmp_path, tmp_path / "data")
    assert BAD[name][1] in said, said
    assert not (tmp_path / "harm").exists()


def test_archives_that_are_cut_off_are_refused(tmp_path: Path) -> None:
    folder = make(tmp_path / "data")
    path = folder / f"{NAME}.ncore4-lidar.zarr.itar"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert "no index at its end: it is cut off" in refused(tmp_path, folder)
    path.write_bytes(b"x" * 3000 + whole[-512:])
    assert "no tar" in refused(tmp_path, folder)
