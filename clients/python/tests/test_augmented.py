"""Views of `wildcity train augment`: read by the data set class, by pycolmap, and by geometry of this file alone."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image
from wildcity import AugmentedError, AugmentedViews

Matrix = NDArray[np.float64]
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def augment(reader: dict[str, str], out: Path, *more: str) -> None:
    command = ["wildcity", "train", "augment", "demo", "--offsets", "1", "--side", "480", "--points", "2000"]
    command += ["--cameras", "front,left", "--out", str(out), *more]
    done = subprocess.run(command, env=reader, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def folder(reader: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rounds: as text with four stations, and as binary with two."""
    out = tmp_path_factory.mktemp("augmented")
    augment(reader, out, "--round", "1", "--every", "80m")
    augment(reader, out, "--round", "2", "--every", "200m", "--colmap", "bin")
    return out


def transforms(folder: Path) -> tuple[dict[str, Matrix], dict[str, Matrix]]:
    """Intrinsics, and `world_from_camera` with x right, y down, z forward, by name: from transforms.json alone."""
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    name = {frame["file_path"]: frame["file_path"].removeprefix("images/") for frame in frames}
    intrinsics = {
        name[f["file_path"]]: np.array([[f["fl_x"], 0, f["cx"]], [0, f["fl_y"], f["cy"]], [0, 0, 1]]) for f in frames
    }
    poses = {name[f["file_path"]]: np.array(f["transform_matrix"]) @ OPENGL for f in frames}
    return intrinsics, poses


def colmap(folder: Path) -> tuple[dict[str, Matrix], dict[str, Matrix]]:
    """The same from sparse/0 alone, by COLMAP's description of its text files."""
    cameras: dict[str, Matrix] = {}
    for line in (folder / "sparse/0/cameras.txt").read_text().splitlines():
        if not line.startswith("#"):
            key, model, _, _, fx, fy, cx, cy = line.split()
            assert model == "PINHOLE"
            cameras[key] = np.array([[float(fx), 0, float(cx)], [0, float(fy), float(cy)], [0, 0, 1]])
    intrinsics, poses = {}, {}
    lines = [line for line in (folder / "sparse/0/images.txt").read_text().split("\n") if not line.startswith("#")]
    for line, points in zip(lines[0:-1:2], lines[1::2]):
        assert points == ""
        _, *pose, camera, name = line.split()
        w, x, y, z, *translation = map(float, pose)
        axis = np.array([x, y, z])
        # Rodrigues' formula in quaternions.
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = (w * w - axis @ axis) * np.eye(3) + 2 * np.outer(axis, axis) + 2 * w * skew
        camera_from_world[:3, 3] = translation
        intrinsics[name], poses[name] = cameras[camera], np.linalg.inv(camera_from_world)
    return intrinsics, poses


def pixels(folder: Path, kind: str, name: str) -> NDArray[np.float64]:
    return np.array(Image.open(folder / kind / name)).astype(np.float64)


def reprojected(
    folder: Path, geometry: tuple[dict[str, Matrix], dict[str, Matrix]], a: str, b: str
) -> tuple[float, float]:
    """Of the pixels of `a` that have depth: the share that `b` shows at the depth they have there, and the median
    difference of their colours, of 255."""
    intrinsics, poses = geometry
    depth = pixels(folder, "depth", a) / 1000
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns]
    at = np.stack([columns + 0.5, rows + 0.5, np.ones_like(z)])
    points = np.linalg.inv(intrinsics[a]) @ at * z
    in_b = np.linalg.inv(poses[b]) @ poses[a] @ np.vstack([points, np.ones_like(z)])
    u, v, scale = intrinsics[b] @ in_b[:3]
    seen = scale > 0.1
    u, v = u / scale, v / scale
    height, width = depth.shape
    seen &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
    row, column = v[seen].astype(int), u[seen].astype(int)
    there = pixels(folder, "depth", b)[row, column] / 1000
    agree = np.abs(there - in_b[2][seen]) < 0.05 + 0.02 * there
    colours = np.abs(pixels(folder, "images", a)[rows[seen], columns[seen]] - pixels(folder, "images", b)[row, column])
    return float(agree.mean()), float(np.median(colours[agree].max(1)))


@pytest.mark.parametrize("source", [transforms, colmap])
def test_depth_of_one_view_lands_on_the_pixels_of_the_other(
    folder: Path, source: Callable[[Path], tuple[dict[str, Matrix], dict[str, Matrix]]]
) -> None:
    one = folder / "round_1"
    intrinsics, poses = source(one)
    lefts = sorted(name for name in poses if "_left" in name)
    assert len(lefts) >= 8
    lost = []
    for left in lefts:
        right = left.replace("left0.50", "right0.50")
        # The rig moved 1 m to the right.
        assert abs(np.linalg.norm(poses[left][:3, 3] - poses[right][:3, 3]) - 1) < 1e-9
        share, difference = reprojected(one, (intrinsics, poses), left, right)
        assert share > 0.75 and difference <= 2, (left, share, difference)
        # A pose that is wrong by 10 cm is seen.
        moved = dict(poses)
        moved[right] = poses[right].copy()
        moved[right][:3, 3] += [0.07, -0.07, 0.05]
        worse, greater = reprojected(one, (intrinsics, moved), left, right)
        assert greater > difference, (left, share, worse, greater)
        lost.append(share - worse)
    # A single view may show by chance what agrees better.
    assert np.mean(lost) > 0.02, lost


def test_both_sources_and_the_record_have_the_same_poses(folder: Path) -> None:
    one = folder / "round_1"
    a_intrinsics, a = transforms(one)
    b_intrinsics, b = colmap(one)
    assert a.keys() == b.keys()
    views = AugmentedViews(folder, rounds=[1])
    assert {sample.name for sample in views.samples} == a.keys()
    for sample, view in zip(views.samples, views):
        assert np.abs(a[sample.name] - b[sample.name]).max() < 1e-9
        assert np.abs(a[sample.name] - view["world_from_camera"]).max() < 1e-9
        assert np.abs(view["world_from_camera"] @ view["camera_from_world"] - np.eye(4)).max() < 1e-9
        assert (a_intrinsics[sample.name] == b_intrinsics[sample.name]).all()
        assert (a_intrinsics[sample.name] == view["K"]).all()


@pytest.mark.parametrize("number", [1, 2])
def test_pycolmap_loads_text_and_binary(folder: Path, number: int) -> None:
    round_folder = folder / f"round_{number}"
    model = pycolmap.Reconstruction(round_folder / "sparse" / "0")
    intrinsics, poses = transforms(round_folder)
    assert model.num_images() == len(poses) and model.num_cameras() == 2 and model.num_points3D() == 2000
    for image in model.images.values():
        camera_from_world = np.eye(4)
        camera_from_world[:3] = image.cam_from_world().matrix()
        assert np.abs(np.linalg.inv(camera_from_world) - poses[image.name]).max() < 1e-9
        assert np.abs(image.camera.calibration_matrix() - intrinsics[image.name]).max() < 1e-9
        height, width = pixels(round_folder, "masks", image.name).shape
        assert (image.camera.width, image.camera.height) == (width, height)
    # Points lie on what the views show.
    at = np.array([point.xyz for point in model.points3D.values()])
    colours = np.array([point.color for point in model.points3D.values()])
    assert np.abs(at).max() < 1000 and colours.std() > 20


def test_the_data_set_chooses_rounds_and_cameras(folder: Path) -> None:
    both = AugmentedViews(folder)
    assert both.rounds == [1, 2] and AugmentedViews(folder, rounds="newest").rounds == [2]
    front = AugmentedViews(folder, rounds=(1,), cameras=["front"])
    assert 0 < len(front) < len(both)
    assert all(sample.camera == "front" and sample.round == 1 for sample in front.samples)
    view = front[0]
    shape = view["image"].shape[:2]
    assert view["image"].dtype == np.uint8 and view["mask"].dtype == bool and view["depth"].dtype == np.float32
    assert shape == view["mask"].shape == view["depth"].shape == (309, 480)
    assert view["depth"].max() <= 65 and not view["depth"][~view["mask"]].any()
    sample = front.samples[0]
    assert abs(float(view["weight"]) - 0.3 * sample.trust) < 1e-7 and not sample.repaired
    # As a loader makes a batch: every value has one shape in all items.
    batch = {key: np.stack([item[key] for item in front]) for key in view}
    assert batch["image"].shape == (len(front), *shape, 3) and batch["weight"].shape == (len(front),)
    with pytest.raises(IndexError):
        front[len(front)]
    with pytest.raises(AugmentedError, match=r"rounds \[1, 2\], and not \[7\]"):
        AugmentedViews(folder, rounds=[7])
    with pytest.raises(AugmentedError, match="rear"):
        AugmentedViews(folder, cameras=["rear"])
    with pytest.raises(AugmentedError, match="no round_N"):
        AugmentedViews(folder / "round_1")


def test_hashes_and_completeness_are_checked(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder / "round_2", copy / "round_2")
    views = AugmentedViews(copy, verify=True)
    path = copy / "round_2" / "depth" / views.samples[3].name
    data = bytearray(path.read_bytes())
    data[-20] ^= 1
    path.write_bytes(data)
    with pytest.raises(AugmentedError, match="differs from its hash"):
        AugmentedViews(copy, verify=True)
    path.unlink()
    with pytest.raises(AugmentedError, match="is missing"):
        views.verify()
    record = copy / "round_2" / "augment.json"
    text: dict[str, Any] = json.loads(record.read_text())
    record.write_text(json.dumps({**text, "complete": False}))
    with pytest.raises(AugmentedError, match="not complete"):
        AugmentedViews(copy)
    record.write_text(json.dumps({**text, "format": "other/1"}))
    with pytest.raises(AugmentedError, match="other/1"):
        AugmentedViews(copy)
