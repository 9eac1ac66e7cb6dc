"""`wildcity alpasim export`: the files are what AlpaSim's runtime reads (its `Artifact`, `Rig` and
`TrafficObjects`)."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
import subprocess
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from test_end_to_end import import_corridor, write_corridor

EPOCH_US = 1_700_000_000_000_000


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """The files of each scene, by its name."""
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the built wildcity binary"
    folder = tmp_path_factory.mktemp("export")
    twins = import_corridor(folder)
    exporting = [binary, "alpasim", "export", "corridor", "--out", str(folder / "scenes"), *twins]
    done = subprocess.run([*exporting, "--every-m", "4", "--length-s", "1"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = {}
    for path in sorted((folder / "scenes").glob("*.usdz")):
        assert str(path) in done.stdout
        with zipfile.ZipFile(path) as archive:
            assert archive.testzip() is None
            found[path.name] = {name: archive.read(name) for name in archive.namelist()}
    return found


def test_a_scene_every_four_metres(scenes: dict[str, dict[str, bytes]]) -> None:
    # The drive is 10 m long.
    assert list(scenes) == [f"corridor@1+log+{start}.usdz" for start in (0, 4, 8)]
    for name, files in scenes.items():
        assert set(files) == {"metadata.yaml", "rig_trajectories.json", "sequence_tracks.json", "map.xodr"}
        metadata = yaml.safe_load(files["metadata.yaml"])
        assert f"{metadata['scene_id']}.usdz" == name
        required = {"version_string", "training_date", "dataset_hash", "uuid", "is_resumable", "logger"}
        assert required <= set(metadata) and metadata["is_resumable"] is False
        assert metadata["sensors"]["lidar_ids"] == [] and "camera_front" in metadata["sensors"]["camera_ids"]
        assert metadata["time_range"]["start"] < metadata["time_range"]["end"]


def test_rigs_are_in_the_local_frame_at_ten_hertz(scenes: dict[str, dict[str, bytes]]) -> None:
    rig = json.loads(scenes["corridor@1+log+4.usdz"]["rig_trajectories.json"])
    assert np.array_equal(rig["world_to_nre"]["matrix"], np.eye(4))
    (drive,) = rig["rig_trajectories"]
    times = drive["T_rig_world_timestamps_us"]
    assert times == [EPOCH_US + 100_000 * k for k in range(11)]
    poses = np.array(drive["T_rig_worlds"])
    # 5 m/s along x from the origin, which is 4 m along the drive.
    assert poses[:, :3, 3] == pytest.approx(np.array([[0.5 * k, 0, 0] for k in range(11)]), abs=1e-9)
    assert np.array_equal(poses[0, :3, :3], np.eye(3)) and poses[:, 3].tolist() == [[0, 0, 0, 1]] * 11
    names = {c["logical_sensor_name"] for c in rig["camera_calibrations"].values()}
    assert {"camera_front", "camera_front_wide_120fov"} <= names
    assert set(drive["cameras_frame_timestamps_us"]) == set(rig["camera_calibrations"])
    for ranges in drive["cameras_frame_timestamps_us"].values():
        assert [end for _, end in ranges] == times[2:]
        assert all(isinstance(start, int) and start < end for start, end in ranges)
    assert drive["rig_bbox"]["rot"] == [0, 0, 0] and min(drive["rig_bbox"]["dim"]) > 1


def test_the_runtime_begins_within_the_poses(scenes: dict[str, dict[str, bytes]]) -> None:
    """The times of AlpaSim 3032e0c, `_build_rollout_timing`, with its own shutters: 30 ms, or up to 100 ms."""
    step_us = 100_000
    for name, files in scenes.items():
        (drive,) = json.loads(files["rig_trajectories.json"])["rig_trajectories"]
        times = drive["T_rig_world_timestamps_us"]
        ranges = [frames[0] for frames in drive["cameras_frame_timestamps_us"].values()]
        begin = min(end for _, end in ranges)
        assert all(end == begin for _, end in ranges), name
        for shutter_us in (30_000, 100_000):
            # The exposure of the first frame, and of the step that would stand before it.
            assert times[0] <= begin - shutter_us - step_us, name
        # At least one step of the policy fits in, and a tick before the last pose's time does not count.
        assert (times[-1] - begin) // step_us >= 1, name


def test_a_drive_that_is_too_short_is_refused(tmp_path: Path) -> None:
    binary = os.environ["WILDCITY_BIN"]
    twins = import_corridor(tmp_path)
    exporting = [binary, "alpasim", "export", "corridor", "--out", str(tmp_path / "scenes"), *twins]
    done = subprocess.run([*exporting, "--length-s", "0.25"], capture_output=True, text=True)
    assert done.returncode == 1 and "has 3 poses" in done.stderr and "needs 4" in done.stderr, done.stderr


@dataclasses.dataclass
class Flags:
    use_localhost: bool = False


@dataclasses.dataclass
class Wizard:
    """The shape of the section `wizard` of AlpaSim 3032e0c: types as there, and only the fields that matter here."""

    run_sim_services: list[str] | None = MISSING
    external_services: dict[str, list[str]] | None = None
    debug_flags: Flags = dataclasses.field(default_factory=Flags)


@dataclasses.dataclass
class Scenes:
    scene_ids: list[str] | None = None
    test_suite_id: str | None = None
    local_usdz_dir: str | None = None


@dataclasses.dataclass
class Config:
    defines: dict[str, str] = MISSING
    wizard: Wizard = MISSING
    scenes: Scenes = MISSING
    runtime: DictConfig = dataclasses.field(default_factory=lambda: OmegaConf.create({}))


# As its wizard lists them: a file of the group `deploy` comes before one of `topology`, and `+physics` at the end.
BASE = """
defaults: [config_schema, _self_, {deploy: null}, {topology: null}]
wizard: {run_sim_services: [driver, renderer, physics, trafficsim, controller, runtime]}
scenes: {scene_ids: [one-of-its-own]}
runtime:
  simulation_config: {ego_mask_rig_config_id: hyperion_8_1, physics_update_mode: EGO_ONLY}
"""
TOPOLOGY = "# @package _global_\nruntime: {endpoints: {physics: {skip: false}}}\n"
DISABLED = """# @package _global_
runtime: {endpoints: {physics: {skip: true}}, simulation_config: {physics_update_mode: NONE}}
"""


def test_the_wizard_composes_the_deploy_file(tmp_path: Path) -> None:
    binary = os.environ["WILDCITY_BIN"]
    twins = import_corridor(tmp_path)
    exporting = [binary, "alpasim", "export", "corridor", "--out", "scenes", "--address", "[::1]:6001", *twins]
    done = subprocess.run(exporting, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    scenes = tmp_path / "scenes"
    assert f"--config-dir {scenes} deploy=wildcity" in done.stdout
    configs = tmp_path / "configs"
    for name, text in {"base_config": BASE, "topology/1gpu": TOPOLOGY, "physics/disabled": DISABLED}.items():
        (configs / name).parent.mkdir(parents=True, exist_ok=True)
        (configs / f"{name}.yaml").write_text(text)
    (configs / "deploy").mkdir()
    (configs / "deploy" / "wildcity.yaml").write_bytes((scenes / "deploy" / "wildcity.yaml").read_bytes())
    ConfigStore.instance().store(name="config_schema", node=Config)
    OmegaConf.register_new_resolver("repo-relative", lambda path: f"/alpasim/{path}", replace=True)
    chosen = ["deploy=wildcity", "topology=1gpu"]
    with initialize_config_dir(version_base="1.3", config_dir=str(configs)):
        config = compose("base_config", overrides=chosen)
        without = compose("base_config", overrides=[*chosen, "+physics=disabled"])
    assert config.defines.filesystem == "/alpasim/data"
    assert config.scenes == {"scene_ids": None, "test_suite_id": None, "local_usdz_dir": str(scenes)}
    # The server is both services, and neither is started.
    assert config.wizard.external_services == {"renderer": ["[::1]:6001"], "physics": ["[::1]:6001"]}
    assert config.wizard.run_sim_services == ["driver", "trafficsim", "controller", "runtime"]
    assert config.wizard.debug_flags.use_localhost
    assert config.runtime.simulation_config.ego_mask_rig_config_id is None
    assert config.runtime.endpoints.physics.skip is False and without.runtime.endpoints.physics.skip is True


@pytest.mark.parametrize("address", ["6000", ":6000", "host:0", "host:70000", "host:"])
def test_an_address_without_host_and_port_is_refused(tmp_path: Path, address: str) -> None:
    exporting = [os.environ["WILDCITY_BIN"], "alpasim", "export", "corridor", "--out", str(tmp_path / "scenes")]
    done = subprocess.run([*exporting, "--address", address], capture_output=True, text=True)
    assert done.returncode == 2 and "expected HOST:PORT" in done.stderr, done.stderr


def test_one_sequence_without_tracks(scenes: dict[str, dict[str, bytes]]) -> None:
    for files in scenes.values():
        (sequence,) = json.loads(files["sequence_tracks.json"]).values()
        lists = [*sequence["tracks_data"].values(), *sequence["cuboidtracks_data"].values()]
        assert len(lists) == 6 and all(values == [] for values in lists)


def test_tracks_are_within_the_scene_by_the_middle_of_their_boxes(tmp_path: Path) -> None:
    binary = os.environ["WILDCITY_BIN"]
    twins = import_corridor(tmp_path)
    made = subprocess.run(
        [binary, "actor", "generate", *twins], capture_output=True, text=True, check=True, timeout=120
    )
    (sedan,) = (
        line.split()[1] for before, line in itertools.pairwise(made.stdout.splitlines()) if "actor sedan:" in before
    )

    def track(name: str, first: int, last: int, **more: Any) -> dict[str, Any]:
        turn = math.pi / 2
        keyframes = [
            {"time_us": 100_000 * k, "pose": {"xyz": [10.0, k, 0.5], "yaw_rad": turn}} for k in range(first, last)
        ]
        return {"id": name, "class": "vehicle", "size": [4.0, 2.0, 1.5], "keyframes": keyframes, **more}

    # The scene that starts at 4 m lasts from 0.8 s to 1.8 s.
    tracks = [
        track("whole", 0, 21),
        track("walker", 12, 15, **{"class": "pedestrian"}),
        track("before", 0, 8),
        track("once", 18, 21),
        track("sedan", 0, 21, asset=sedan),
        track("named", 0, 21, asset="sedan"),
    ]
    (tmp_path / "tracks.json").write_text(json.dumps({"format": "wildcity.tracks/1", "tracks": tracks}))
    exporting = [binary, "alpasim", "export", "corridor", "--out", str(tmp_path / "scenes"), *twins]
    exporting += ["--every-m", "4", "--length-s", "1", "--tracks", str(tmp_path / "tracks.json")]
    done = subprocess.run(exporting, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(tmp_path / "scenes" / "corridor@1+log+4.usdz") as archive:
        (sequence,) = json.loads(archive.read("sequence_tracks.json")).values()
    data, sizes = sequence["tracks_data"], sequence["cuboidtracks_data"]["cuboids_dims"]
    # A name is found when the scene is written, so that the scene stays the same.
    assert data["tracks_id"] == ["whole@4x2x1.5", "walker@4x2x1.5", f"sedan@{sedan}", f"named@{sedan}"]
    assert data["tracks_label_class"] == ["automobile", "person", "automobile", "automobile"]
    # AlpaSim moves what is CONTROLLABLE, and takes the rest as standing.
    assert data["tracks_flags"] == ["CONTROLLABLE"] * 4
    showing = [binary, "actor", "show", sedan, "--json", *twins]
    shown = subprocess.run(showing, capture_output=True, text=True, check=True, timeout=60)
    box = json.loads(shown.stdout)["description"]["box"]
    assert (
        sizes[0] == [4.0, 2.0, 1.5]
        and sizes[3] == sizes[2] == [box["length_m"], box["width_m"], box["height_m"]] != sizes[0]
    )
    times = [EPOCH_US + 100_000 * k for k in range(11)]
    assert data["tracks_timestamps_us"] == [times, times[4:7], times, times]
    poses = np.array(data["tracks_poses"][0])
    # Half the height above the ground, 4 m behind in x; the quaternion is x, y, z, w.
    assert poses[:, :3] == pytest.approx(np.array([[6.0, 8.0 + k, 1.25] for k in range(11)]), abs=1e-9)
    assert poses[:, 3:] == pytest.approx(np.array([[0, 0, 0.5**0.5, 0.5**0.5]] * 11), abs=1e-9)
    assert np.array(data["tracks_poses"][2])[:, 2] == pytest.approx(0.5 + sizes[2][2] / 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "tracks.json"),
        ('{"format": "wildcity.tracks/2", "tracks": []}', "wildcity.tracks/1"),
        (
            '{"format": "wildcity.tracks/1", "tracks": [{"id": "a", "class": "vehicle", "size": [4, 2, 1],'
            ' "asset": "%s", "keyframes": [{"time_us": 0, "pose": {"xyz": [0, 0, 0]}}]}]}' % ("0" * 64),
            'track "a"',
        ),
    ],
)
def test_bad_tracks_are_refused(tmp_path: Path, text: str, message: str) -> None:
    binary = os.environ["WILDCITY_BIN"]
    twins = import_corridor(tmp_path)
    (tmp_path / "tracks.json").write_text(text)
    exporting = [binary, "alpasim", "export", "corridor", "--out", str(tmp_path / "scenes"), *twins]
    done = subprocess.run([*exporting, "--tracks", str(tmp_path / "tracks.json")], capture_output=True, text=True)
    assert done.returncode == 1 and message in done.stderr, done.stderr
    assert not (tmp_path / "scenes").exists()


def test_the_map_is_a_road_along_the_drive_and_beyond(scenes: dict[str, dict[str, bytes]]) -> None:
    root = ElementTree.fromstring(scenes["corridor@1+log+0.usdz"]["map.xodr"])
    assert root.tag == "OpenDRIVE" and root.find("header/geoReference") is None
    (road,) = root.findall("road")
    lines: list[Any] = road.findall("planView/geometry")
    numbers = [{key: float(value) for key, value in line.attrib.items()} for line in lines]
    end = 0.0
    for line in numbers:
        # Each line begins where the one before ends.
        assert line["s"] == pytest.approx(end)
        end += line["length"]
    assert end == pytest.approx(float(road.attrib["length"])) and end > 120
    last = numbers[-1]
    assert last["x"] + math.cos(last["hdg"]) * last["length"] > 120
    widths = [float(width.attrib["a"]) for width in road.iter("width")]
    assert widths == [3.5, 3.5]
    assert [lane.attrib["id"] for lane in road.iter("lane")] == ["1", "0", "-1"]


def test_a_twin_without_a_drive_is_refused(tmp_path: Path) -> None:
    binary = os.environ["WILDCITY_BIN"]
    write_corridor(tmp_path / "corridor.ply")
    twins = ["--twins", str(tmp_path / "twins")]
    subprocess.run([binary, "import", str(tmp_path / "corridor.ply"), "--twin", "bare", *twins], check=True)
    exporting = [binary, "alpasim", "export", "bare", "--out", str(tmp_path / "scenes"), *twins]
    done = subprocess.run(exporting, capture_output=True, text=True)
    assert done.returncode == 1 and "no recorded drive" in done.stderr
    assert not (tmp_path / "scenes").exists()
