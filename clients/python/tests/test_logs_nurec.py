"""Scenes of NVIDIA NuRec to a log: a miniature archive by the schema that AlpaSim reads."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logs_truth import Log, drive, matrix, moved, refused, run, same_poses, wxyz
from scipy.spatial.transform import Rotation
from test_logs_pai import CAMERAS, MODELS, POLYNOMIAL, inside

SEQUENCE = "clipgt-00040136"
WIDE = "camera_front_wide_120fov"
WORLD_TO_NRE = matrix([-1000.0, -600.0, 3.0], Rotation.from_euler("z", 0.2))
TIMES = [1_700_000_000_000_000 + 99_800 * n for n in range(20)]
BOX = matrix([12, -3, 0.8], Rotation.from_euler("z", 0.6))


def world(time_us: int) -> Any:
    return drive((time_us - TIMES[0]) / 1e6)


def documents() -> dict[str, Any]:
    model, parameters = MODELS[WIDE]
    kept = {key: value for key, value in parameters.items() if key != "shutter_delay_us"}
    calibration = {
        "sequence_id": SEQUENCE, "logical_sensor_name": WIDE, "unique_sensor_idx": 0,
        "T_sensor_rig": CAMERAS[WIDE].tolist(), "camera_model": {"type": model, "parameters": kept},
    }  # fmt: skip
    rig = {
        "T_world_base": np.eye(4).tolist(), "world_to_nre": {"matrix": WORLD_TO_NRE.tolist()},
        "camera_calibrations": {f"{WIDE}@{SEQUENCE}": calibration},
        "rig_trajectories": [{
            "sequence_id": SEQUENCE, "T_rig_world_timestamps_us": TIMES,
            "T_rig_worlds": [world(time).tolist() for time in TIMES],
            "cameras_frame_timestamps_us": {f"{WIDE}@{SEQUENCE}": [[time - 31_000, time] for time in TIMES]},
        }],
    }  # fmt: skip
    poses = []
    for time in TIMES[:3]:
        pose = WORLD_TO_NRE @ world(time) @ BOX
        w, x, y, z = wxyz(pose)
        poses.append([*(float(v) for v in pose[:3, 3]), x, y, z, w])
    labels = ["automobile", "person", "gremlin"]
    tracks = {SEQUENCE: {
        "tracks_data": {
            "tracks_id": ["7", "8", "9"], "tracks_label_class": labels, "tracks_flags": [["CONTROLLABLE"]] * 3,
            "tracks_timestamps_us": [TIMES[:3]] * 3, "tracks_poses": [poses] * 3,
        },
        "cuboidtracks_data": {"cuboids_dims": [[4.5, 1.9, 1.6]] * 3},
    }}  # fmt: skip
    return {"rig_trajectories.json": rig, "sequence_tracks.json": tracks}


def write(path: Path, found: dict[str, Any]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("default.usda", "#usda 1.0")
        for name, document in found.items():
            archive.writestr(name, json.dumps(document))
        archive.writestr("map.xodr", "<OpenDRIVE/>")
    return path


def test_a_scene(tmp_path: Path) -> None:
    run(write(tmp_path / "scene.usdz", documents()), "--out", tmp_path / "log")
    log = Log(tmp_path / "log")
    same_poses(log, {time: world(time) for time in TIMES})
    points = inside(1.2)
    ours = log.project(WIDE, log.poses()[TIMES[4]], moved(world(TIMES[4]) @ CAMERAS[WIDE], points))
    radius = np.hypot(points[:, 0], points[:, 1])
    delta = np.polyval(POLYNOMIAL[::-1], np.arctan2(radius, points[:, 2])) / radius
    linear = np.array([[0.99976, 5.5e-05], [1.7e-05, 1.0]])
    theirs = (linear @ (points[:, :2] * delta[:, None]).T).T + [31.2 + 0.5, 24.4 + 0.5]
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5)
    assert log.rig[WIDE]["shutter"] == {"direction": "top_to_bottom", "duration_us": 31_000}
    rows = log.rows("tracks")
    assert [row["class"] for row in rows] == ["vehicle", "pedestrian"] * 3
    for row in rows:
        wanted = world(row["time_us"] + log.epoch_us) @ BOX
        np.testing.assert_allclose(log.pose(row["world_from_box"]), wanted, rtol=0, atol=1e-6)
    left_out = " ".join(log.head["left_out"])
    for part in (f"images of {WIDE}: 20", "class gremlin: 3", "map.xodr: 1 (`wildcity twin map import`", "archive: 1"):
        assert part in left_out


def rig_of(found: dict[str, Any]) -> dict[str, Any]:
    its: dict[str, Any] = found["rig_trajectories.json"]
    return its


BAD: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no rigs": (lambda f: f.pop("rig_trajectories.json"), "missing: rig_trajectories.json"),
    "a clock that runs backwards": (
        lambda f: rig_of(f)["rig_trajectories"][0].update(T_rig_world_timestamps_us=TIMES[::-1]), "runs backwards"),
    "too few poses": (
        lambda f: rig_of(f)["rig_trajectories"][0]["T_rig_worlds"].pop(), "19 poses for 20 times"),
    "no calibration": (lambda f: rig_of(f)["camera_calibrations"].clear(), "a row has no field camera_front_wide"),
    "no intrinsics": (
        lambda f: next(iter(rig_of(f)["camera_calibrations"].values()))["camera_model"]["parameters"].pop("max_angle"),
        "a row has no field max_angle"),
    "tracks of other lengths": (
        lambda f: f["sequence_tracks.json"][SEQUENCE]["tracks_data"]["tracks_id"].pop(), "different lengths"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_scenes_are_refused(name: str, tmp_path: Path) -> None:
    found = documents()
    BAD[name][0](found)
    text = refused(tmp_path, write(tmp_path / "scene.usdz", found))
    assert BAD[name][1] in text and "scene.usdz" in text, text


def test_a_file_that_is_no_archive_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.usdz").write_bytes(b"version https://git-lfs.github.com/spec/v1")
    assert "cannot read: File is not a zip file" in refused(tmp_path, tmp_path / "scene.usdz")
