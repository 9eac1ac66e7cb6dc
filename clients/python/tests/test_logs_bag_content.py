"""Images, calibrations, clouds and frames of ROS messages, one by one."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs_bags import SIZE, START_NS, K, Maker, Recorded, sweep, write
from logs_truth import Log, matrix, mount, moved, points_seen, refused, run
from PIL import Image
from scipy.spatial.transform import Rotation
from wildcity.logs import LogError
from wildcity.logs.bag_content import camera_of, png_of, sweep_of
from wildcity.logs.bag_frames import Tree

M = Maker("sqlite3")
MOUNT = mount(1.5, 0.2, 1.4, 10)


def log_of(camera: dict[str, Any], tmp_path: Path) -> Log:
    """A log that has the camera, for its projection."""
    log = Log.__new__(Log)
    log.folder, log.rig, log.origin, log.epoch_us = tmp_path, {camera["name"]: camera}, np.zeros(3), 0
    return log


def test_a_rectified_image_has_the_pinhole_p_and_axes_turned_by_r(tmp_path: Path) -> None:
    """CameraInfo: pixels are P (R X), of X in the axes of the camera."""
    info = M.info(START_NS, "front")
    turn = Rotation.from_euler("xyz", [0.02, -0.03, 0.01]).as_matrix()
    info.r, info.p = turn.reshape(-1), np.c_[K * [[0.9], [0.9], [1]], np.zeros(3)].reshape(-1)
    made = camera_of("front", info, MOUNT, "p", is_rectified=True)
    assert "lens" not in made
    inside = points_seen(K, SIZE)
    flat = inside @ turn.T @ info.p.reshape(3, 4)[:, :3].T
    ours = log_of(made, tmp_path).project("front", np.eye(4), moved(MOUNT, inside))
    np.testing.assert_allclose(ours - 0.5, flat[:, :2] / flat[:, 2:], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda info: setattr(info, "binning_x", 2), "binning or a region of interest"),
        (lambda info: setattr(info.roi, "x_offset", 8), "binning or a region of interest"),
        (lambda info: setattr(info, "p", np.r_[K[0], -40.0, K[1], 0, K[2], 0]), "second camera of a rectified pair"),
        (lambda info: setattr(info, "p", np.zeros(12)), "has no intrinsics"),
    ],
)
def test_images_that_a_rig_cannot_say_are_refused(change: Callable[[Any], None], words: str) -> None:
    info = M.info(START_NS, "front")
    change(info)
    with pytest.raises(LogError, match=words):
        camera_of("front", info, MOUNT, "p", is_rectified=True)


def test_raw_images_become_the_same_pixels() -> None:
    random = np.random.default_rng(2)
    for encoding, channels, order in (("mono8", 1, [0]), ("rgba8", 4, [0, 1, 2, 3]), ("bgra8", 4, [2, 1, 0, 3])):
        pixels = random.integers(0, 255, (7, 9, channels), np.uint8)
        found = np.asarray(Image.open(io.BytesIO(png_of(M.raw(START_NS, "front", pixels, encoding), "p"))))
        assert np.array_equal(found.reshape(7, 9, channels), pixels[..., order])
    for is_bigendian, dtype in ((0, "<u2"), (1, ">u2")):
        wide = random.integers(0, 65535, (7, 9)).astype(dtype)
        message = M.raw(START_NS, "front", wide.view(np.uint8).reshape(7, 18, 1), "mono16")
        message.width, message.is_bigendian = 9, is_bigendian
        found = np.asarray(Image.open(io.BytesIO(png_of(message, "p"))))
        assert np.array_equal(found, wide.astype(np.uint16))
    message.height = 99
    with pytest.raises(LogError, match="bytes for 9 x 99 mono16"):
        png_of(message, "p")


def test_a_cloud_of_rows_with_padding_is_read(tmp_path: Path) -> None:
    xyz, offsets, _ = sweep(2)
    flat = M.cloud(START_NS, xyz[:60], offsets[:60])
    rows = flat.data.reshape(4, -1)
    flat.height, flat.width, flat.row_step = 4, 15, rows.shape[1] + 7
    flat.data = np.concatenate([rows, np.full((4, 7), 9, np.uint8)], axis=1).reshape(-1)
    found, is_timed = sweep_of(flat, START_NS, "p")
    np.testing.assert_allclose(found.points_m, xyz[:60], atol=1e-5)
    assert is_timed and found.ring is not None and found.ring.tolist() == [n % 16 for n in range(60)]
    flat.row_step = 1
    with pytest.raises(LogError, match="bytes for 4 rows of 15 points"):
        sweep_of(flat, START_NS, "p")
    plain = M.cloud(START_NS, xyz, offsets, "velocity")
    assert sweep_of(plain, START_NS, "p")[1] is False
    for one in plain.fields:
        one.name = f"{one.name}_"
    with pytest.raises(LogError, match="the fields of a point are x_, y_"):
        sweep_of(plain, START_NS, "p")


def test_a_cloud_without_times_says_so(tmp_path: Path) -> None:
    def change(m: Maker, found: Recorded) -> Recorded:
        kept = [one for one in found if one[1] != "/lidar/points"]
        xyz, offsets, _ = sweep(1)
        return [*kept, (START_NS, "/lidar/points", m.cloud(START_NS, xyz, offsets, "velocity"))]

    said = run(write(tmp_path / "bag", "sqlite3", change), "--out", tmp_path / "log")
    assert "times of points of lidar_points, sweeps: 1 (their clouds have no field of times" in said
    assert "compensated_to_us" not in Log(tmp_path / "log").rows("lidar")[0]


def test_compressed_images_that_are_neither_jpeg_nor_png_are_refused(tmp_path: Path) -> None:
    def change(m: Maker, found: Recorded) -> Recorded:
        topic = "/camera/left/image_raw/compressed"
        return [(time, name, m.compressed(START_NS, "left", b"WEBP") if name == topic else its)
                for time, name, its in found]  # fmt: skip

    assert "neither JPEG nor PNG" in refused(tmp_path, write(tmp_path / "bag", "sqlite3", change))


def tree(*transforms: Any, is_static: bool = False) -> Tree:
    made = Tree("bag")
    for one in transforms:
        made.add(M.frames(one), is_static)
    return made


def test_trees_that_are_none_are_refused() -> None:
    pose = matrix([1, 0, 0], Rotation.identity())
    with pytest.raises(LogError, match="b also has the parent a"):
        tree(M.transform(1, "a", "b", pose), M.transform(2, "c", "b", pose))
    with pytest.raises(LogError, match="the clock runs backwards, from 5 to 3 ns"):
        tree(M.transform(5, "a", "b", pose), M.transform(3, "a", "b", pose))
    with pytest.raises(LogError, match="the frames of tf form a ring at a"):
        list(tree(M.transform(1, "a", "b", pose), M.transform(1, "b", "a", pose)).up("a"))
    bad = M.transform(1, "a", "b", pose)
    bad.transform.rotation.w = 5.0
    with pytest.raises(LogError, match="has not the length 1"):
        tree(bad)
    with pytest.raises(LogError, match="d is not below a"):
        list(tree(M.transform(1, "a", "b", pose), M.transform(1, "c", "d", pose)).poses("a", "d"))


def test_a_transform_that_is_sent_again_counts_once() -> None:
    first, other = matrix([1, 0, 0], Rotation.identity()), matrix([2, 0, 0], Rotation.from_euler("z", 1))
    moving = tree(M.transform(1, "a", "b", first), M.transform(1, "a", "b", first), M.transform(9, "a", "b", other))
    assert [time for time, _ in moving.poses("a", "b")] == [1, 9]
    fixed = tree(M.transform(1, "a", "b", first), M.transform(7, "a", "b", first), is_static=True)
    fixed.add(M.frames(M.transform(1, "a", "c", other)), True)
    np.testing.assert_allclose(fixed.static("b", "c", "x"), np.linalg.inv(first) @ other, atol=1e-15)


def test_several_odometries_and_frames_need_a_choice(tmp_path: Path) -> None:
    def change(m: Maker, found: Recorded) -> Recorded:
        kept = [one for one in found if one[1] != "/tf"]
        for n in range(5):
            for topic in ("/odom_a", "/odom_b"):
                pose = matrix([n if topic == "/odom_a" else 2 * n, 0, 0], Rotation.identity())
                time_ns = START_NS + 100_000_000 * n
                kept.append((time_ns, topic, m.odometry(time_ns, pose, "base_link")))
        return kept

    source = write(tmp_path / "bag", "sqlite3", change)
    assert "several odometries: /odom_a, /odom_b; choose one with --odometry" in refused(tmp_path, source)
    assert "no odometry topic /x, only /odom_a, /odom_b" in refused(tmp_path, source, "--odometry", "/x")
    said = run(source, "--odometry", "/odom_b", "--out", tmp_path / "log")
    assert "messages of /odom_a: 5 (the log has one odometry: /odom_b)" in said
    assert [pose[0, 3] for _, pose in sorted(Log(tmp_path / "log").poses().items())] == [0, 2, 4, 6, 8]
    text = refused(tmp_path, source, "--odometry", "/odom_b", "--rig-frame", "wheel")
    assert "no transform from wheel to " in text and "choose --rig-frame" in text
