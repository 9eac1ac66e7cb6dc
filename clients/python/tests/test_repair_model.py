"""The model that comes with the project, run by onnxruntime as the server does, and the warp that it was trained
with."""

from __future__ import annotations

import importlib.util
import json
import subprocess
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray
from PIL import Image
from wildcity.serving import binary

ROOT = Path(__file__).resolve().parents[3]
MANIFEST = json.loads((ROOT / "scenes" / "repair.json").read_text())


@pytest.fixture(scope="module")
def scenes() -> ModuleType:
    spec = importlib.util.spec_from_file_location("repair", ROOT / "scenes" / "repair.py")
    assert spec is not None and spec.loader is not None
    repair = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(repair)
    return repair


@pytest.fixture(scope="module")
def session() -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(ROOT / "scenes" / "repair.onnx", providers=["CPUExecutionProvider"])


def test_the_graph_is_what_the_manifest_says(session: onnxruntime.InferenceSession) -> None:
    channels = {"rgb": 3, "reference_warped": 3, "reference_valid": 1}
    assert [entry["role"] for entry in MANIFEST["inputs"]] == list(channels)
    assert [(given.name, given.type, given.shape[1]) for given in session.get_inputs()] == [
        (entry["name"], "tensor(float)", channels[entry["role"]]) for entry in MANIFEST["inputs"]
    ]
    assert [given.name for given in session.get_outputs()] == [entry["name"] for entry in MANIFEST["outputs"]]


def test_the_server_takes_the_file_and_draws_it_in_tiles_that_equal_the_whole() -> None:
    library = next((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so*"))
    command = [
        binary(),
        "dev",
        "repair",
        ROOT / "scenes" / "repair.json",
        "--onnxruntime",
        library,
        "--size",
        "64x64",
    ]
    check = subprocess.run(command, capture_output=True, text=True)
    assert check.returncode == 0, check.stderr
    # Two convolutions of 3 x 3 at each size on the way down and one on the way up, the last one at full size.
    assert "halo         21 px; tiles equal the whole" in check.stdout
    assert "three runs gave the same bytes" in check.stdout


def test_an_image_of_any_size_in_multiples_of_4(session: onnxruntime.InferenceSession) -> None:
    rng = np.random.default_rng(1)
    feed = {name: rng.random((1, count, 232, 360), np.float32) for name, count in (("rgb", 3), ("reference_warped", 3))}
    feed["reference_valid"] = (rng.random((1, 1, 232, 360)) < 0.7).astype(np.float32)
    whole = session.run(None, feed)[0]
    assert whole.shape == (1, 3, 232, 360) and np.isfinite(whole).all()
    part = session.run(None, {name: values[:, :, 64:164, 40:188] for name, values in feed.items()})[0]
    assert part.shape == (1, 3, 100, 148)
    # Farther than 24 pixels from the border of the part, the border has no influence.
    inner = part[:, :, 24:-24, 24:-24]
    assert np.abs(inner - whole[:, :, 88:140, 64:164]).max() < 1e-5


def test_a_view_of_a_street_that_it_has_not_seen_gets_better(scenes: ModuleType) -> None:
    # 3 m beside the drive: as rendered, recorded images warped into the view, where they are valid, and the truth.
    tiles = np.array(Image.open(Path(__file__).with_name("repair_view.png")))
    rendered, warped, valid, true = np.split(tiles, 4)
    valid = (valid[..., 0] > 127).astype(np.uint8)
    repaired = scenes.repairer(ROOT / "scenes" / "repair.onnx")(rendered, warped, valid)
    filled = scenes.fill(rendered, warped, valid)
    dB = [float(scenes.psnr(image, true)) for image in (rendered, filled, repaired)]
    assert dB[2] > dB[0] + 2.0, dB
    assert dB[2] > dB[1] + 0.3, dB


def seen_from(scenes: ModuleType, x_m: float, rgb: NDArray[np.uint8], depth: NDArray[np.float64]) -> object:
    """An image of a camera that looks along z, at x."""
    height, width = depth.shape
    pose = SimpleNamespace(q=(1.0, 0.0, 0.0, 0.0), xyz=(0.0, 0.0, 0.0))
    camera = SimpleNamespace(fx=100.0, fy=100.0, cx=width / 2, cy=height / 2, camera_to_rig=pose)
    return scenes.Image(rgb, depth, camera, SimpleNamespace(q=pose.q, xyz=(x_m, 0.0, 0.0)))


def test_the_warp_brings_recorded_pixels_where_the_view_sees_them(scenes: ModuleType) -> None:
    rgb = np.random.default_rng(2).integers(0, 256, (40, 60, 3), np.uint8)
    wall = np.full((40, 60), 10.0)
    target = seen_from(scenes, 0.0, np.zeros_like(rgb), wall)
    # 10 m away, 0.3 m are 3 pixels: the camera on the right sees a point 3 pixels farther left.
    warped, valid = scenes.warp(target, [seen_from(scenes, 0.3, rgb, wall)])
    assert (valid[:, 3:] == 1).all() and (valid[:, :3] == 0).all()
    assert (warped[:, 3:] == rgb[:, :-3]).all() and (warped[:, :3] == 0).all()
    # The image whose ray has the smaller angle wins, in any order.
    other = 255 - rgb
    near, far = seen_from(scenes, 0.1, rgb, wall), seen_from(scenes, 0.4, other, wall)
    assert (scenes.warp(target, [near, far])[0] == scenes.warp(target, [far, near])[0]).all()
    assert (scenes.warp(target, [far, near])[0][:, 4:] == rgb[:, 3:-1]).all()
    # Up to 0.2 m and 5 % of another depth count as the same surface.
    for depth_m, share in ((10.69, 1.0), (10.71, 0.0), (9.31, 1.0), (9.29, 0.0), (0.0, 0.0)):
        moved = seen_from(scenes, 0.0, rgb, np.full((40, 60), depth_m))
        assert scenes.warp(target, [moved])[1].mean() == share, depth_m
    # Not even close to the camera is "no depth" a depth.
    near_wall = seen_from(scenes, 0.0, rgb, np.full((40, 60), 0.15))
    assert scenes.warp(near_wall, [near_wall])[1].all()
    assert not scenes.warp(near_wall, [seen_from(scenes, 0.0, rgb, np.zeros((40, 60)))])[1].any()
    # Without a depth of its own, a pixel has no colour.
    wall_with_a_hole = wall.copy()
    wall_with_a_hole[5, 7] = 0.0
    warped, valid = scenes.warp(seen_from(scenes, 0.0, rgb, wall_with_a_hole), [seen_from(scenes, 0.0, rgb, wall)])
    assert valid[5, 7] == 0 and (warped[5, 7] == 0).all() and valid.sum() == 40 * 60 - 1
