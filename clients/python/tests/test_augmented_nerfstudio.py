"""nerfstudio's own parser and loaders read the views of `wildcity train augment`.

Needs PyTorch (some gigabytes), so it is optional. It was run with torch 2.5.1 and numpy 1.26 after

    pip install --no-deps nerfstudio==1.1.5 viser tensorboard absl-py grpcio markdown werkzeug
    pip install jaxtyping msgspec opencv-python-headless rich tyro zstandard
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from wildcity import AugmentedViews

torch = pytest.importorskip("torch", reason="PyTorch is optional: pip install torch")
REASON = "nerfstudio is optional; the head of this file says what to install"
parsers = pytest.importorskip("nerfstudio.data.dataparsers.nerfstudio_dataparser", reason=REASON)
loaders = pytest.importorskip("nerfstudio.data.utils.data_utils", reason=REASON)

# nerfstudio leaves an image open.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

FISHEYE_K = [0.02, -0.01, 0.003, -0.001]
RIG = {
    "name": "car",
    "cameras": [
        {
            "name": name,
            "width": 240,
            "height": 160,
            "fx": 90,
            "fy": 91,
            "cx": 118,
            "cy": 81.5,
            "lens": {"model": "fisheye", "k": FISHEYE_K},
            "camera_to_rig": {"xyz": [1.9, 0, 1.65], "q": q},
        }
        for name, q in [("ahead", [0.5, -0.5, 0.5, -0.5]), ("left", [0.7071067811865476, -0.7071067811865476, 0, 0])]
    ],
}


def run(reader: dict[str, str], *command: str) -> None:
    done = subprocess.run(["wildcity", *command], env=reader, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def folders(reader: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Views by pinholes of two sizes, and by fisheyes."""
    at = tmp_path_factory.mktemp("nerfstudio")
    (at / "rig.json").write_text(json.dumps(RIG))
    run(reader, "twin", "generate", "--twin", "fisheyes", "--length-km", "0.1", "--density", "1")
    run(reader, "twin", "drive", "fisheyes", "--rig", str(at / "rig.json"))
    options = ["--offsets", "1", "--every", "40m", "--points", "100", "--out"]
    # The images of `front` and `left` differ in size and focal length.
    run(reader, "train", "augment", "demo", "--cameras", "front,left", *options, str(at / "pinholes"))
    run(reader, "train", "augment", "fisheyes", "--lenses", *options, str(at / "lenses"))
    return {kind: at / kind for kind in ("pinholes", "lenses")}


def parsed(folder: Path, split: str = "train", **options: Any) -> Any:
    """What nerfstudio's parser makes of a round, with the options of docs/augmentation.md."""
    config = parsers.NerfstudioDataParserConfig(
        data=folder / "round_1", orientation_method="none", center_method="none", auto_scale_poses=False, **options
    )
    return config.setup().get_dataparser_outputs(split=split)


@pytest.mark.parametrize("kind", ["pinholes", "lenses"])
def test_the_parser_has_the_cameras_poses_and_files(folders: dict[str, Path], kind: str) -> None:
    round_folder = folders[kind] / "round_1"
    views = AugmentedViews(folders[kind])
    by_name = {sample.name: view for sample, view in zip(views.samples, views)}
    outputs = parsed(folders[kind], eval_mode="all")
    cameras = outputs.cameras
    assert len(outputs.image_filenames) == len(cameras) == len(by_name) > 8
    assert len(set(cameras.width.flatten().tolist())) == (2 if kind == "pinholes" else 1)
    assert outputs.dataparser_scale == 1.0
    assert (outputs.dataparser_transform[:, :3] == torch.eye(3)).all() and not outputs.dataparser_transform[:, 3].any()
    for at, path in enumerate(outputs.image_filenames):
        name = path.relative_to(round_folder / "images").as_posix()
        view = by_name[name]
        assert path.is_file()
        assert outputs.mask_filenames[at] == round_folder / "masks" / name
        assert outputs.metadata["depth_filenames"][at] == round_folder / "depth" / name
        assert (int(cameras.height[at]), int(cameras.width[at])) == view["image"].shape[:2]
        fx, fy, cx, cy = (float(values[at]) for values in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
        k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        assert np.abs(k - view["K"]).max() < 1e-4
        pose = view["world_from_camera"] @ np.diag([1.0, -1.0, -1.0, 1.0])
        # nerfstudio keeps f32.
        assert np.abs(cameras.camera_to_worlds[at].numpy() - pose[:3]).max() < 1e-4
        if kind == "lenses":
            assert np.allclose(cameras.distortion_params[at], [*FISHEYE_K, 0, 0], atol=1e-7)
            assert np.allclose(view["distortion"], FISHEYE_K)
    kinds = {int(value) for value in cameras.camera_type.flatten()}
    assert kinds == {parsers.CameraType.PERSPECTIVE.value if kind == "pinholes" else parsers.CameraType.FISHEYE.value}


@pytest.mark.parametrize("kind", ["pinholes", "lenses"])
def test_rays_of_the_parser_are_those_of_our_lenses(folders: dict[str, Path], kind: str) -> None:
    """A ray of nerfstudio, projected by the formulas of docs/cameras.md, is at the pixel that it was made for."""
    outputs = parsed(folders[kind], eval_mode="all")
    cameras = outputs.cameras
    for at in (0, len(cameras) - 1):
        width, height = int(cameras.width[at]), int(cameras.height[at])
        columns, rows = np.meshgrid(np.arange(0, width, 7) + 0.5, np.arange(0, height, 7) + 0.5)
        coords = torch.from_numpy(np.stack([rows.ravel(), columns.ravel()], -1)).float()
        rays = cameras.generate_rays(camera_indices=at, coords=coords)
        camera_from_world = cameras.camera_to_worlds[at][:, :3].double().numpy().T
        x, y, z = camera_from_world @ rays.directions.double().numpy().T
        # OpenGL's axes.
        y, z = -y, -z
        off_axis = np.hypot(x, y)
        theta = np.arctan2(off_axis, z)
        k1, k2, k3, k4 = FISHEYE_K
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        radius = off_axis / z if kind == "pinholes" else bent
        scale = radius / np.maximum(off_axis, 1e-12)
        u = float(cameras.fx[at]) * scale * x + float(cameras.cx[at])
        v = float(cameras.fy[at]) * scale * y + float(cameras.cy[at])
        assert np.hypot(u - columns.ravel(), v - rows.ravel()).max() < 0.02


@pytest.mark.parametrize("kind", ["pinholes", "lenses"])
def test_masks_and_depths_come_through_the_loaders(folders: dict[str, Path], kind: str) -> None:
    outputs = parsed(folders[kind], eval_mode="all")
    views = AugmentedViews(folders[kind])
    by_name = {sample.name: view for sample, view in zip(views.samples, views)}
    for at in (0, len(by_name) // 2):
        name = outputs.image_filenames[at].relative_to(folders[kind] / "round_1" / "images").as_posix()
        height, width = by_name[name]["mask"].shape
        mask = loaders.get_image_mask_tensor_from_path(outputs.mask_filenames[at])
        assert (mask[..., 0].numpy() == by_name[name]["mask"]).all()
        scale = outputs.metadata["depth_unit_scale_factor"]
        depth = loaders.get_depth_image_from_path(outputs.metadata["depth_filenames"][at], height, width, scale)
        assert np.abs(depth[..., 0].numpy() - by_name[name]["depth"]).max() < 1e-4 and depth.max() > 5


def test_splits_of_the_parser_have_all_views_once(folders: dict[str, Path]) -> None:
    train, val = (parsed(folders["pinholes"], split) for split in ("train", "val"))
    names = sorted(train.image_filenames + val.image_filenames)
    assert names == sorted(parsed(folders["pinholes"], eval_mode="all").image_filenames)
    assert 0 < len(val.image_filenames) < len(train.image_filenames)
