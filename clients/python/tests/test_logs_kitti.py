"""KITTI raw and KITTI-360 to a log: miniature drives by their readmes, against the projection that these define."""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from logs_truth import (
    CAMERA_AXES,
    Array,
    Log,
    drive,
    image_bytes,
    killed_and_resumed,
    matrix,
    moved,
    points_seen,
    refused,
    run,
    same_poses,
)
from scipy.spatial.transform import Rotation, Slerp

FRAMES = 8
START_US = 1_317_042_138_000_000
RADIUS = 6378137.0
LATITUDE, LONGITUDE = 49.015, 8.4342
SCALE = math.cos(math.radians(LATITUDE))
SIZE = (1242, 375)
DRIVE = "2011_09_26_drive_0001"

VELODYNE_FROM_IMU = matrix([-0.8087, 0.3196, -0.7997], Rotation.from_euler("ZYX", [0.015, 0.002, -0.001]))
CAMERA_FROM_VELODYNE = matrix([-0.004, -0.0763, -0.2717], CAMERA_AXES.inv() * Rotation.from_euler("x", 0.02))
RECTIFY = matrix([0, 0, 0], Rotation.from_euler("xyz", [0.004, 0.009, -0.007]))
OTHERS = [matrix([-0.54 * n / 2, 0.001 * n, -0.002], Rotation.from_euler("xyz", [0.01, 0.02 * n, 0])) for n in range(4)]
K = np.array([[721.5377, 0, 609.5593], [0, 721.5377, 172.854], [0, 0, 1]])
D = [-0.36, 0.2, 0.001, -0.0003, -0.07]
P = [np.c_[K, [-K[0, 0] * 0.53 * n / 2, 2.1 * n, 0.003 * n]] for n in range(4)]


def frame_us(frame: int) -> int:
    return START_US + 103_457 * frame


def stamp(time_us: int) -> str:
    moment = datetime.datetime.fromtimestamp(time_us // 1_000_000, datetime.timezone.utc)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{time_us % 1_000_000:06d}123"


def recorded(frame: int) -> Array:
    """world_from_imu of a frame in the Mercator plane."""
    east = SCALE * RADIUS * math.radians(LONGITUDE)
    north = SCALE * RADIUS * math.log(math.tan(math.radians(90 + LATITUDE) / 2))
    return drive(0.1 * frame, (east - 50 * math.sin(0.3), north + 50 * math.cos(0.3), 113.0))


def packet(frame: int) -> str:
    pose = recorded(frame)
    latitude = LATITUDE  # The first one sets the scale of the projection.
    if frame:
        latitude = 2 * math.degrees(math.atan(math.exp(pose[1, 3] / (SCALE * RADIUS)))) - 90
    yaw, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
    values = np.arange(30, dtype=float)
    values[:6] = latitude, math.degrees(pose[0, 3] / (SCALE * RADIUS)), pose[2, 3], roll, pitch, yaw
    return " ".join(repr(float(value)) for value in values)


def between(times_us: Array, known: dict[int, Array]) -> tuple[Array, Rotation]:
    keys = np.array(sorted(known))
    xyz = np.array([known[key][:3, 3] for key in keys])
    turns = Slerp(keys.astype(float), Rotation.from_matrix([known[key][:3, :3] for key in keys]))
    return np.stack([np.interp(times_us, keys, xyz[:, axis]) for axis in range(3)], 1), turns(times_us)


def lines(path: Path, values: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(values) + "\n")


def numbers(values: Any) -> str:
    return " ".join(f"{value:.12e}" for value in np.asarray(values).reshape(-1))


def scan(frame: int) -> Array:
    random = np.random.default_rng(frame)
    return np.c_[random.uniform(-30, 30, (300, 2)), random.uniform(-2, 3, 300), random.uniform(0, 1, 300)].astype("<f4")


def kitti(root: Path, kind: str) -> Path:
    day, folder = root / "2011_09_26", root / "2011_09_26" / f"{DRIVE}_{kind}"
    imu, camera = VELODYNE_FROM_IMU, CAMERA_FROM_VELODYNE
    lines(day / "calib_imu_to_velo.txt", ["calib_time: 25-May-2012 16:47:16",
        f"R: {numbers(imu[:3, :3])}", f"T: {numbers(imu[:3, 3])}"])  # fmt: skip
    lines(day / "calib_velo_to_cam.txt", [f"R: {numbers(camera[:3, :3])}", f"T: {numbers(camera[:3, 3])}"])
    calibration = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.95e-02"]
    for n in range(4):
        calibration += [f"S_0{n}: 1.392e+03 5.12e+02", f"K_0{n}: {numbers(K)}", f"D_0{n}: {numbers(D)}"]
        calibration += [f"R_0{n}: {numbers(OTHERS[n][:3, :3])}", f"T_0{n}: {numbers(OTHERS[n][:3, 3])}"]
        calibration += [f"S_rect_0{n}: 1.242e+03 3.75e+02", f"R_rect_0{n}: {numbers(RECTIFY[:3, :3])}"]
        calibration += [f"P_rect_0{n}: {numbers(P[n])}"]
    lines(day / "calib_cam_to_cam.txt", calibration)
    times = [frame_us(frame) for frame in range(FRAMES)]
    lines(folder / "oxts" / "timestamps.txt", [stamp(time) for time in times])
    for frame in range(FRAMES):
        lines(folder / "oxts" / "data" / f"{frame:010d}.txt", [packet(frame)])
    for n in range(4):
        lines(folder / f"image_0{n}" / "timestamps.txt", [stamp(time - 3_000 + n) for time in times])
        (folder / f"image_0{n}" / "data").mkdir()
        for frame in range(FRAMES):
            if (n, frame) != (1, 4):
                name = folder / f"image_0{n}" / "data" / f"{frame:010d}.png"
                name.write_bytes(image_bytes(10 * frame + n, ".png"))
    scans(folder / "velodyne_points", times)
    tracklets(folder / "tracklet_labels.xml")
    return folder


def scans(folder: Path, times: list[int], bounds: bool = True) -> None:
    (folder / "data").mkdir(parents=True)
    lines(folder / "timestamps.txt", [stamp(time) for time in times])
    if bounds:
        lines(folder / "timestamps_start.txt", [stamp(time - 51_000) for time in times])
        lines(folder / "timestamps_end.txt", [stamp(time + 52_000) for time in times])
    for frame in range(FRAMES):
        (folder / "data" / f"{frame:010d}.bin").write_bytes(scan(frame).tobytes())


def tracklets(path: Path) -> None:
    items = ""
    for label in ("Car", "Cyclist", "Misc", "DontCare"):
        poses = "".join(
            f"<item><tx>{10 + frame}</tx><ty>3</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.5</rz></item>"
            for frame in range(3)
        )
        items += f"<item><objectType>{label}</objectType><h>1.5</h><w>1.8</w><l>4.2</l><first_frame>2</first_frame>"
        items += f"<poses><count>3</count><item_version>2</item_version>{poses}</poses></item>"
    path.write_text(f"<boost_serialization><tracklets><count>4</count>{items}</tracklets></boost_serialization>")


@pytest.fixture(scope="module", params=["sync", "extract"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Log]:
    root = tmp_path_factory.mktemp(request.param)
    folder = kitti(root, request.param)
    run(folder if request.param == "sync" else root, "--out", root / "log")
    return request.param, folder, Log(root / "log")


Made = tuple[str, Path, Log]
RIG_FROM_VELODYNE = np.linalg.inv(VELODYNE_FROM_IMU)


def test_kitti_poses_times_and_images(made: Made) -> None:
    _, folder, log = made
    same_poses(log, {frame_us(frame): recorded(frame) for frame in range(FRAMES)})
    for n in range(4):
        times = [frame_us(f) - 3_000 + n for f in range(FRAMES) if (n, f) != (1, 4)]
        assert log.times("images", camera=f"image_0{n}") == times
    for row in log.rows("images"):
        frame = round((row["time_us"] + log.epoch_us - START_US) / 103_457)
        source = folder / row["camera"] / "data" / f"{frame:010d}.png"
        assert (log.folder / row["file"]).read_bytes() == source.read_bytes()
    assert "times of image_01 without a file: 1" in " ".join(log.head["left_out"])
    imu = log.rows("imu")[3]
    assert imu["angular_velocity_rad_per_s"] == [17, 18, 19] and imu["acceleration_m_per_s2"] == [11, 12, 13]
    assert log.rows("gps")[0]["latitude_deg"] == LATITUDE


def test_the_anchor_is_the_place_of_the_origin(made: Made) -> None:
    log = made[2]
    geo, first = log.head["world"]["geo"], log.rows("gps")[0]
    offset = recorded(0)[:3, 3] - log.origin
    assert abs(offset).max() <= 0.5
    metres = math.radians(1) * RADIUS
    # The projection is conformal: metres of the plane are metres at the first latitude.
    north = (first["latitude_deg"] - geo["latitude_deg"]) * metres
    east = (first["longitude_deg"] - geo["longitude_deg"]) * metres * SCALE
    np.testing.assert_allclose([east, north], offset[:2], atol=0.01)


def test_kitti_points_have_the_pixels_of_its_readme(made: Made) -> None:
    kind, _, log = made
    for n in range(4):
        world = recorded(3) @ RIG_FROM_VELODYNE @ np.linalg.inv(CAMERA_FROM_VELODYNE)
        if kind == "sync":
            world = world @ np.linalg.inv(RECTIFY)
        seen = moved(world, points_seen(K, SIZE) + [0.1, 0, 1])
        ours = log.project(f"image_0{n}", log.poses()[frame_us(3)], seen)
        camera_0 = moved(CAMERA_FROM_VELODYNE @ np.linalg.inv(recorded(3) @ RIG_FROM_VELODYNE), seen)
        if kind == "sync":
            flat = moved(RECTIFY, camera_0) @ P[n][:, :3].T + P[n][:, 3]
            theirs = flat[:, :2] / flat[:, 2:]
        else:
            values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *D, 0, 0, 0]
            model = pycolmap.Camera(model="FULL_OPENCV", width=1392, height=512, params=values)
            theirs = model.img_from_cam(moved(OTHERS[n], camera_0))
        np.testing.assert_allclose(ours - 0.5, theirs, rtol=0, atol=1e-3)


def test_kitti_points_are_deskewed_by_their_azimuth(made: Made) -> None:
    _, _, log = made
    known = {frame_us(frame): recorded(frame) for frame in range(FRAMES)}
    for frame in range(1, FRAMES - 1):
        points = scan(frame)[:, :3].astype(np.float64)
        turn = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
        times = frame_us(frame) - 51_000 + turn * 103_000
        xyz, turns = between(times, known)
        world = xyz + turns.apply(moved(RIG_FROM_VELODYNE, points))
        found, found_times = log.sweep_in_world(log.rows("lidar")[frame])
        order = np.argsort(np.rint(turn * 103_000), kind="stable")
        np.testing.assert_allclose(found_times, times[order], atol=1)
        np.testing.assert_allclose(found, world[order], rtol=0, atol=1e-3)


def test_kitti_boxes(made: Made) -> None:
    _, _, log = made
    rows = log.rows("tracks")
    assert [row["class"] for row in rows[:3]] == ["vehicle", "bicycle", "object"] and len(rows) == 9
    assert "boxes of class DontCare: 3" in " ".join(log.head["left_out"])
    assert rows[0]["size"] == [4.2, 1.8, 1.5] and rows[0]["time_us"] + log.epoch_us == frame_us(2)
    middle = matrix([10, 3, -1.7 + 0.75], Rotation.from_euler("z", 0.5))
    wanted = recorded(2) @ RIG_FROM_VELODYNE @ middle
    np.testing.assert_allclose(log.pose(rows[0]["world_from_box"]), wanted, rtol=0, atol=1e-6)


def test_a_killed_run_goes_on(made: Made, tmp_path: Path) -> None:
    kind, folder, log = made
    if kind == "sync":
        killed_and_resumed(tmp_path, log.folder, folder, after=33)


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return change


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no calibration": (lambda f: (f.parent / "calib_cam_to_cam.txt").unlink(), "calib_cam_to_cam.txt: missing"),
    "no intrinsics": (edit("../calib_cam_to_cam.txt", "P_rect_02", "P_lost_02"), "P_rect_02 is None"),
    "a clock that runs backwards": (
        edit("oxts/timestamps.txt", stamp(frame_us(3)), stamp(frame_us(1))), "timestamps.txt, line 4: the clock runs"),
    "a scan that is cut off": (
        lambda f: (f / "velodyne_points/data/0000000002.bin").write_bytes(b"1234567"), "0000000002.bin: 1 numbers"),
    "a lost packet": (lambda f: (f / "oxts/data/0000000002.txt").unlink(), "7 files for 8 times"),
    "a short packet": (lambda f: lines(f / "oxts/data/0000000002.txt", ["1 2 3"]), "0000000002.txt: the packet is"),
    "no images": (lambda f: [(f / f"image_0{n}").rename(f / f"old{n}") for n in range(4)], "no folder image_00"),
    "broken boxes": (edit("tracklet_labels.xml", "</tracklets>", ""), "tracklet_labels.xml: cannot read the boxes"),
    "millimetres": (
        edit("../calib_velo_to_cam.txt", "T: -4.000000000000e-03", "T: -4.0e+03"), "perhaps it is millimetres"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_drives_are_refused(name: str, tmp_path: Path) -> None:
    folder = kitti(tmp_path, "sync")
    BAD[name][0](folder)
    text = refused(tmp_path, folder)
    assert BAD[name][1] in text, text


IMU_FROM_CAMERA = [matrix([1.5, -0.3 * n, -0.6], Rotation.from_euler("x", 180, degrees=True)
                          * Rotation.from_euler("Z", 60 * n * (n > 1), degrees=True) * CAMERA_AXES)
                   for n in range(4)]  # fmt: skip
"""Of KITTI-360: its IMU has y right and z down."""
VELODYNE_FROM_0 = matrix([0.77, 0.28, -0.08], Rotation.from_euler("ZYX", [0.05, 0, 0.02]) * CAMERA_AXES)
SEQUENCE = "2013_05_28_drive_0000_sync"
DOWN = matrix([0, 0, 0], Rotation.from_euler("x", 180, degrees=True))


def kitti360(root: Path) -> Path:
    calibration = root / "calibration"
    lines(calibration / "calib_cam_to_pose.txt",
          [f"image_0{n}: {numbers(pose[:3])}" for n, pose in enumerate(IMU_FROM_CAMERA)])  # fmt: skip
    lines(calibration / "calib_cam_to_velo.txt", [numbers(VELODYNE_FROM_0[:3])])
    for n in (2, 3):
        lens360(calibration / f"image_0{n}.yaml", MEI)
    persp = []
    for n in range(2):
        persp += [f"S_rect_0{n}: 1242 375", f"R_rect_0{n}: {numbers(OTHERS[n + 1][:3, :3])}"]
        persp += [f"P_rect_0{n}: {numbers(P[n])}"]
    lines(calibration / "perspective.txt", persp)
    times = [frame_us(frame) for frame in range(FRAMES)]
    # Frame 5 has no pose, as in the data set.
    poses = [f"{frame} {numbers((drive(0.1 * frame) @ DOWN)[:3])}" for frame in range(FRAMES) if frame != 5]
    lines(root / "data_poses" / SEQUENCE / "poses.txt", poses)
    for n in range(4):
        folder = root / "data_2d_raw" / SEQUENCE / f"image_0{n}"
        lines(folder / "timestamps.txt", [stamp(time - 3_000 + n) for time in times])
        data = folder / ("data_rect" if n < 2 else "data_rgb")
        data.mkdir()
        for frame in range(FRAMES):
            (data / f"{frame:010d}.png").write_bytes(image_bytes(10 * frame + n, ".png"))
    scans(root / "data_3d_raw" / SEQUENCE / "velodyne_points", times, bounds=False)
    boxes = [box360("car", 4), box360("building", -1), box360("rider", 3), box360("unicorn", 3)]
    lines(root / "data_3d_bboxes" / "train" / f"{SEQUENCE}.xml", ["<opencv_storage>", *boxes, "</opencv_storage>"])
    return root


MEI = {"xi": 2.2, "k1": 0.0168, "k2": 1.65, "p1": 0.0, "p2": 0.0,
       "gamma1": 1336.3, "gamma2": 1335.7, "u0": 716.9, "v0": 705.7}  # fmt: skip


def lens360(path: Path, values: dict[str, float]) -> None:
    """As OpenCV writes it, a space missing."""
    names = {"mirror": ("xi",), "distortion": ("k1", "k2", "p1", "p2"), "projection": ("gamma1", "gamma2", "u0", "v0")}
    text = ["%YAML:1.0", "---", "model_type: MEI", "camera_name: image_02", "image_width: 1400", "image_height: 1400"]
    for part, its in names.items():
        text += [f"{part}_parameters:", *(f"   {name}:{' ' if name != 'k2' else ''}{values[name]!r}" for name in its)]
    lines(path, text)


def test_fisheyes_have_the_pixels_of_the_devkit(tmp_path: Path) -> None:
    root = kitti360(tmp_path / "data")
    run(root, "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    random = np.random.default_rng(3)
    for n in (2, 3):
        theta, phi = random.uniform(0, math.radians(97), 100), random.uniform(-math.pi, math.pi, 100)
        inside = random.uniform(2, 50, (100, 1)) * np.stack(
            [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)  # fmt: skip
        seen = moved(drive(0.2) @ DOWN @ IMU_FROM_CAMERA[n], inside)
        # CameraFisheye.cam2image of helpers/project.py.
        x, y, z = (inside / np.linalg.norm(inside, axis=1)[:, None]).T
        x, y = x / (z + MEI["xi"]), y / (z + MEI["xi"])
        r2 = x * x + y * y
        bent = 1 + MEI["k1"] * r2 + MEI["k2"] * r2 * r2
        theirs = np.stack([MEI["gamma1"] * bent * x + MEI["u0"], MEI["gamma2"] * bent * y + MEI["v0"]], axis=1)
        ours = log.project(f"image_0{n}", log.poses()[frame_us(2)], seen)
        np.testing.assert_allclose(ours - 0.5, theirs, rtol=0, atol=0.1)
        stated = next(one for one in log.head["left_out"] if one.startswith(f"lens model of Mei of image_0{n}"))
        assert abs(ours - 0.5 - theirs).max() < float(stated.partition("up to ")[2].split()[0]) + 1e-3
        assert log.times("images", camera=f"image_0{n}") == [frame_us(f) - 3_000 + n for f in range(FRAMES)]


def box360(label: str, frame: int) -> str:
    pose = drive(0.1) @ matrix([9, -2, 0.4], Rotation.from_euler("z", 0.3))
    pose[:3, :3] = pose[:3, :3] @ np.diag([4.4, 1.9, 1.6])
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    parts = ""
    for name, values in (("transform", pose), ("vertices", corners)):
        parts += (
            f"<{name}><rows>{len(values)}</rows><cols>{values.shape[1]}</cols><data>{numbers(values)}</data></{name}>"
        )
    ids = f"<index>1</index><label>{label}</label><semanticId>26</semanticId><instanceId>7</instanceId>"
    return f"<object_{label}>{ids}<timestamp>{frame}</timestamp>{parts}</object_{label}>"


def test_kitti360(tmp_path: Path) -> None:
    root = kitti360(tmp_path / "data")
    run(root, "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    same_poses(log, {frame_us(frame): drive(0.1 * frame) for frame in range(FRAMES) if frame != 5})
    assert sorted(log.rig) == [f"image_0{n}" for n in range(4)]
    for n in range(2):
        assert log.times("images", camera=f"image_0{n}") == [frame_us(f) - 3_000 + n for f in range(FRAMES)]
        turn = matrix([0, 0, 0], Rotation.from_matrix(OTHERS[n + 1][:3, :3]))
        inside = points_seen(K, SIZE)
        seen = moved(drive(0.2) @ DOWN @ IMU_FROM_CAMERA[n] @ np.linalg.inv(turn), inside)
        ours = log.project(f"image_0{n}", log.poses()[frame_us(2)], seen)
        flat = inside @ K.T
        np.testing.assert_allclose(ours - 0.5, flat[:, :2] / flat[:, 2:], rtol=0, atol=1e-3)
    world_from_velodyne = drive(0.2) @ DOWN @ IMU_FROM_CAMERA[0] @ np.linalg.inv(VELODYNE_FROM_0)
    found, _ = log.sweep_in_world(log.rows("lidar")[2])
    np.testing.assert_allclose(found, moved(world_from_velodyne, scan(2)[:, :3]), rtol=0, atol=1e-3)
    rows = log.rows("tracks")
    assert [(row["class"], row["time_us"] + log.epoch_us) for row in rows] == [
        ("bicycle", frame_us(3)), ("vehicle", frame_us(4))]  # fmt: skip
    np.testing.assert_allclose(rows[0]["size"], [4.4, 1.9, 1.6], atol=1e-9)
    wanted = drive(0.1) @ matrix([9, -2, 0.4], Rotation.from_euler("z", 0.3))
    np.testing.assert_allclose(log.pose(rows[0]["world_from_box"]), wanted, rtol=0, atol=1e-6)
    left_out = " ".join(log.head["left_out"])
    for part in ("lens model of Mei of image_02: 1", "boxes that do not move: 1", "class unicorn: 1"):
        assert part in left_out


def test_bad_kitti360_is_refused(tmp_path: Path) -> None:
    root = kitti360(tmp_path / "data")
    poses = root / "data_poses" / SEQUENCE / "poses.txt"
    whole = poses.read_text()
    poses.write_text(whole + "99 1 0 0 0 0 1 0 0 0 0 1 0\n")
    assert "poses.txt, line 8: frame 99 has no time" in refused(tmp_path, root)
    poses.write_text(whole + "7 1 0 0 0\n")
    assert "the pose is [1.0, 0.0, 0.0, 0.0], not 12 finite numbers" in refused(tmp_path, root)
    poses.write_text(whole)
    (root / "calibration" / "calib_cam_to_velo.txt").unlink()
    assert "calib_cam_to_velo.txt: missing: the mount of the scanner" in refused(tmp_path, root)


BAD_LENSES: dict[str, tuple[dict[str, Any], str]] = {
    "no number": ({"gamma1": "wide"}, "no intrinsics: could not convert string"),
    "NaN": ({"u0": float("nan")}, "no intrinsics: xi, k, p, gamma and center are"),
    "no focal length": ({"gamma2": 0.0}, "no intrinsics: xi, k, p, gamma and center are"),
    "no fisheye": (
        {"xi": 0.0, "k1": 0.0, "k2": 0.0, "gamma1": 30.0, "gamma2": 30.0},
        "no fisheye lens is nearer to it than",
    ),
}


@pytest.mark.parametrize("name", BAD_LENSES)
def test_bad_lenses_of_kitti360_are_refused(name: str, tmp_path: Path) -> None:
    root = kitti360(tmp_path / "data")
    lens360(root / "calibration" / "image_03.yaml", {**MEI, **BAD_LENSES[name][0]})
    text = refused(tmp_path, root)
    assert BAD_LENSES[name][1] in text and "image_03.yaml" in text, text
    lens360(root / "calibration" / "image_03.yaml", MEI)
    lens = (root / "calibration" / "image_03.yaml").read_text()
    (root / "calibration" / "image_03.yaml").write_text(lens.replace("MEI", "SCARAMUZZA"))
    assert "model_type is SCARAMUZZA, not MEI" in refused(tmp_path, root)
