"""cameras.json of the trainer of 3D Gaussian Splatting to a log, against the trainer's own `camera_to_JSON`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs_truth import Array, Log, drive, image_bytes, mount, moved, points_seen, refused, run, same_poses

SIZE, FX, FY = (1600, 900), 1100.0, 1105.0
CAMERA = mount(0, 0, 0, 0)
FRAMES = 5


def entry(frame: int) -> dict[str, Any]:
    # The trainer has W2C as R^T and T, and writes its inverse.
    camera_from_world = np.linalg.inv(drive(0.1 * frame) @ CAMERA)
    world_from_camera = np.linalg.inv(camera_from_world)
    lens = {"width": SIZE[0], "height": SIZE[1], "fx": FX, "fy": FY}
    place = {"position": world_from_camera[:3, 3].tolist(), "rotation": world_from_camera[:3, :3].tolist()}
    return {"id": frame, "img_name": f"{frame:04d}", **place, **lens}


def make(folder: Path) -> Path:
    (folder / "images").mkdir(parents=True)
    (folder / "cameras.json").write_text(json.dumps([entry(frame) for frame in (3, 0, 4, 1, 2)]))
    for frame in (0, 1, 2, 4):
        (folder / "images" / f"{frame:04d}.png").write_bytes(image_bytes(frame, ".png"))
    return folder


def test_poses_have_the_times_of_the_rate(tmp_path: Path) -> None:
    run(make(tmp_path / "model"), "--rate", "12.5", "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    same_poses(log, {80_000 * frame: drive(0.1 * frame) for frame in range(FRAMES)})
    assert log.times("images") == [0, 80_000, 160_000, 320_000]
    for frame, row in zip((0, 1, 2, 4), log.rows("images"), strict=True):
        assert (log.folder / row["file"]).read_bytes() == image_bytes(frame, ".png")
    left_out = " ".join(log.head["left_out"])
    for part in ("images: 1 (", "times of images: 5 (not recorded: 12.5 a second", "scale and direction of the world"):
        assert part in left_out


def test_points_have_the_pixels_of_the_trainer(tmp_path: Path) -> None:
    run(make(tmp_path / "model") / "cameras.json", "--rate", 10, "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    k: Array = np.array([[FX, 0, SIZE[0] / 2], [0, FY, SIZE[1] / 2], [0, 0, 1]])
    inside = points_seen(k, SIZE)
    ours = log.project("camera", log.poses()[200_000], moved(drive(0.2) @ CAMERA, inside))
    flat = inside @ k.T
    np.testing.assert_allclose(ours, flat[:, :2] / flat[:, 2:], rtol=0, atol=1e-3)


def changed(change: Callable[[list[dict[str, Any]]], Any]) -> Callable[[Path], None]:
    def act(path: Path) -> None:
        found = json.loads(path.read_text())
        change(found)
        path.write_text(json.dumps(found))

    return act


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "several lenses": (changed(lambda d: d[1].update(fx=900.0)), "2 different lenses"),
    "no intrinsics": (changed(lambda d: [one.update(fx=0.0) for one in d]), "has no intrinsics"),
    "a missing field": (changed(lambda d: d[2].pop("rotation")), "has no field rotation"),
    "no rotation": (changed(lambda d: d[2]["rotation"][0].__setitem__(0, 5.0)), "rotation is no rotation"),
    "two of a name": (changed(lambda d: d[2].update(img_name=d[1]["img_name"])), "two images of the name"),
    "NaN": (changed(lambda d: d[2]["position"].__setitem__(0, float("nan"))), "not 3 finite numbers"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused(name: str, tmp_path: Path) -> None:
    path = make(tmp_path / "model") / "cameras.json"
    BAD[name][0](path)
    text = refused(tmp_path, path, "--rate", 10)
    assert BAD[name][1] in text, text


def test_a_file_without_a_rate_is_refused(tmp_path: Path) -> None:
    folder = make(tmp_path / "model")
    assert "it has no times, which a log needs; give the images a second with --rate" in refused(tmp_path, folder)
    assert "--rate: 0.0 images a second" in refused(tmp_path, folder, "--rate", 0)
