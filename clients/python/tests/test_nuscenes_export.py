"""Episodes as tables of nuScenes, read by our own converter, and by the devkit if there is one."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs_truth import Log, judge, moved, run
from PIL import Image
from scipy.spatial.transform import Rotation
from test_episode_records import lines_of, walk


@pytest.fixture(scope="module")
def exported(
    quick_reader: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[dict[str, Any]], Path]:
    """The lines of a record, and the folder of its tables with images."""
    folder = tmp_path_factory.mktemp("nuscenes")
    record = walk(folder, quick_reader)
    tables = folder / "tables"
    command = ["wildcity", "episode", "export", str(record), "--nuscenes", str(tables), "--images"]
    said = subprocess.run(command, env=quick_reader, check=True, capture_output=True, text=True).stdout
    assert f"rows to {tables}" in said
    again = subprocess.run(command, env=quick_reader, check=False, capture_output=True, text=True)
    assert again.returncode != 0 and "exists: name another folder" in again.stderr
    return lines_of(record), tables


def test_our_converter_reads_what_was_recorded(exported: tuple[list[dict[str, Any]], Path], tmp_path: Path) -> None:
    lines, tables = exported
    run(tables, "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    frames = {line["time_us"] + 1_000_000_000: line for line in lines if line["kind"] == "frame"}
    poses = log.poses()
    for time_us, line in frames.items():
        w, x, y, z = line["poses"][-1]["q"]
        np.testing.assert_allclose(poses[time_us][:3, 3], line["poses"][-1]["xyz"], rtol=0, atol=1e-6)
        turn = Rotation.from_quat([x, y, z, w])
        assert (Rotation.from_matrix(poses[time_us][:3, :3]) * turn.inv()).magnitude() < 1e-6
    rows = log.rows("images")
    assert len(rows) == sum(len(line["images"]) for line in frames.values())
    for row in rows[:6]:
        with Image.open(log.folder / row["file"]) as image:
            assert image.size == (log.rig[row["camera"]]["width"], log.rig[row["camera"]]["height"])
    actors = {line["time_us"] + 1_000_000_000: line["actors"] for line in lines if line["kind"] == "actors"}
    boxes = log.rows("tracks")
    assert boxes and {row["class"] for row in boxes} == {"pedestrian"}
    for row in boxes:
        _, xyz, *_ = actors[row["time_us"] + log.epoch_us][0]
        middle = log.pose(row["world_from_box"])[:3, 3]
        np.testing.assert_allclose(middle - [0, 0, row["size"][2] / 2], xyz, rtol=0, atol=0.01)


def test_the_devkit_loads_it_and_has_the_same_boxes(
    exported: tuple[list[dict[str, Any]], Path], tmp_path: Path
) -> None:
    _, tables = exported
    found = judge(
        """
from nuscenes.nuscenes import NuScenes
nusc = NuScenes(version="v1.0-wildcity", dataroot=given["root"], verbose=False)
nusc.list_scenes = None
sample = nusc.get("sample", nusc.scene[0]["first_sample_token"])
count = 1
while sample["next"]:
    sample, count = nusc.get("sample", sample["next"]), count + 1
sample = nusc.get("sample", nusc.scene[0]["first_sample_token"])
data = {}
for channel, token in sample["data"].items():
    path, boxes, k = nusc.get_sample_data(token, box_vis_level=0)
    data[channel] = {"path": path, "k": k.tolist(), "corners": [box.corners().T.tolist() for box in boxes]}
anns = [nusc.get_box(token) for token in sample["anns"]]
print(json.dumps({"samples": count, "data": data, "boxes": [box.corners().T.tolist() for box in anns],
    "names": [box.name for box in anns], "velocity": nusc.box_velocity(sample["anns"][0]).tolist()}))
""",
        {"root": str(tables)},
    )
    run(tables, "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    assert found["samples"] == len({row["time_us"] for row in log.rows("tracks")}) and found["names"]
    assert set(found["data"]) == {name.upper() for name in log.rig}
    first = log.rows("tracks")[0]
    for channel, its in found["data"].items():
        assert Path(its["path"]).is_file()
        one = log.rig[channel.lower()]
        np.testing.assert_allclose(np.array(its["k"])[:2, 2] + 0.5, [one["cx"], one["cy"]], atol=1e-9)
        for corners in its["corners"]:
            rig = log.poses()[first["time_us"] + log.epoch_us]
            world = moved(rig @ log.pose(one["camera_to_rig"], is_world=False), np.array(corners))
            local = moved(np.linalg.inv(log.pose(first["world_from_box"])), world)
            np.testing.assert_allclose(abs(local), np.tile(np.array(first["size"]) / 2, (8, 1)), atol=1e-3)
