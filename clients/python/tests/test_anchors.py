"""Other projects' own code on episodes that `wildcity episode run` drives, compared with the scores in their results.

$WILDCITY_ANCHORS is a folder with checkouts of `Bench2Drive`, `alpasim`, `navsim` and `nuplan-devkit` at the commits
that the scores' names have, and of `gsplat`. A check whose checkout is missing, or whose packages are not installed, is
listed as NOT RUN. What the anchors are given is computed here, from the poses of the records.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import types
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

STEP_S = 0.1
AGENTS = ("log", "stand", "idm")


def car(name: str, **behaviour: Any) -> dict[str, Any]:
    return {"name": name, "class": "vehicle", "size": [4.5, 1.9, 1.5], **behaviour}


# The ego is hit in front, from behind and from the side, or by nothing.
ACTORS: dict[str, list[dict[str, Any]]] = {
    "walker": [
        {
            "name": "walker",
            "class": "pedestrian",
            "collide": {"along": "log", "station_m": 45, "time_s": 2.5, "angle_rad": 1.57, "speed": 1.3},
        }
    ],
    "ahead": [car("slow", path={"along": "log", "station_m": 34, "speed": 3})],
    "behind": [car("fast", path={"along": "log", "station_m": 8, "speed": 18})],
    "beside": [
        car(
            "drifting",
            path={"along": "log", "station_m": 22, "offset_m": 3.5, "speed": 10},
            script=[{"when": {"time_s": 0.5}, "do": [{"offset": {"to_m": 0, "over_s": 3}}]}],
        )
    ],
    "free": [car("away", path={"along": "log", "station_m": 60, "speed": 12})],
}


class Driven:
    """An episode: its record in numbers, and what `wildcity episode score` says about it."""

    def __init__(self, record: Path, environment: dict[str, str]) -> None:
        command = ["wildcity", "episode", "score", "--json", str(record)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        self.name = f"{record.parents[1].name}/{record.stem}"
        self.scores: dict[str, Any] = json.loads(done.stdout)["result"]["scores"]
        lines = [json.loads(line) for line in record.read_text().splitlines()]
        self.scenario = next(line for line in lines if line["kind"] == "scenario")
        poses = [line["poses"][-1] for line in lines if line["kind"] == "frame"]
        self.actors = [line["actors"] for line in lines if line["kind"] == "actors"]
        assert len(self.actors) == len(poses)
        self.xy = np.array([pose["xyz"][:2] for pose in poses])
        self.yaw = np.unwrap([yaw_of(pose["q"]) for pose in poses])
        velocity = np.gradient(self.xy, STEP_S, axis=0)
        self.acceleration = np.gradient(velocity, STEP_S, axis=0)
        self.velocity = velocity
        self.yaw_rate = np.gradient(self.yaw, STEP_S)
        self.forward = np.stack([np.cos(self.yaw), np.sin(self.yaw)], axis=1)
        self.right = np.stack([np.sin(self.yaw), -np.cos(self.yaw)], axis=1)


def yaw_of(q: list[float]) -> float:
    w, x, y, z = q
    return float(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))


@pytest.fixture(scope="module")
def driven(quick_reader: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> list[Driven]:
    checkout()
    folder = tmp_path_factory.mktemp("anchors")
    for name, actors in ACTORS.items():
        scenario = {
            "format": "wildcity.scenario/1",
            "name": name,
            "twin": {"name": "demo"},
            "ego": {
                "start": {"trajectory": "log", "station_m": 20},
                "dynamics": {"model": "kinematic", "speed": 10},
            },
            "actors": actors,
            "end": {"time_s": 4.5, "contact": "any"},
        }
        (folder / f"{name}.json").write_text(json.dumps(scenario))
    suite = {
        "format": "wildcity.suite/1",
        "name": "anchors",
        "scenarios": [f"{name}.json" for name in ACTORS],
        "cameras": ["front"],
        "size": [32, 20],
        "accept_unjudged": ["off_road"],
    }
    (folder / "suite.json").write_text(json.dumps(suite))
    for agent in AGENTS:
        command = ["wildcity", "episode", "run", str(folder / "suite.json"), "--agent", agent]
        done = subprocess.run(
            [*command, "--out", str(folder / agent)], env=quick_reader, capture_output=True, text=True
        )
        assert done.returncode in (0, 1), f"{done.stdout}\n{done.stderr}"
    records = [folder / agent / "episodes" / f"{name}-0-1.jsonl" for agent in AGENTS for name in ACTORS]
    return [Driven(record, quick_reader) for record in records]


def checkout(*names: str) -> list[Path]:
    """The folders of checkouts."""
    anchors = os.environ.get("WILDCITY_ANCHORS")
    if not anchors:
        pytest.skip("NOT RUN: set WILDCITY_ANCHORS to the folder with the anchors' checkouts")
    folders = [Path(anchors) / name for name in names]
    for folder in folders:
        if not folder.is_dir():
            pytest.skip(f"NOT RUN: there is no checkout {folder.name} in $WILDCITY_ANCHORS")
    return folders


def module(name: str, *paths: Path) -> Any:
    """A module of a checkout."""
    sys.path[:0] = [str(path) for path in paths]
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"NOT RUN: {name} cannot be imported: {error}")
    finally:
        del sys.path[: len(paths)]


def test_smoothness_is_that_of_bench2drive(driven: list[Driven]) -> None:
    (folder,) = checkout("Bench2Drive")
    anchor = module("efficiency_smoothness_benchmark", folder / "tools")
    found = {}
    for episode in driven:
        nothing = np.zeros((len(episode.xy), 3))
        turning = nothing.copy()
        turning[:, 2] = np.degrees(episode.yaw_rate)
        expected = anchor.seg_compute_comfort_metric(
            episode.acceleration, turning, episode.forward, episode.right, nothing, nothing
        )
        ours = episode.scores["bench2drive.smoothness@7ec25d1"]["value"]
        assert ours == expected, episode.name
        found[episode.name] = ours
    assert len(set(found.values())) > 1, f"a sample that cannot tell: {found}"


def test_comfort_is_that_of_navsim(driven: list[Driven]) -> None:
    folders = checkout("navsim", "nuplan-devkit")
    name = "navsim.planning.simulation.planner.pdm_planner.scoring.pdm_comfort_metrics"
    anchor = module(name, *folders)
    found = {}
    for episode in driven:
        to_car = np.stack([episode.forward, -episode.right], axis=1)
        states = np.zeros((1, len(episode.xy), 11))
        states[0, :, 0:2] = episode.xy
        states[0, :, 2] = episode.yaw
        states[0, :, 3:5] = np.einsum("kij,kj->ki", to_car, episode.velocity)
        states[0, :, 5:7] = np.einsum("kij,kj->ki", to_car, episode.acceleration)
        states[0, :, 9] = episode.yaw_rate
        states[0, :, 10] = np.gradient(episode.yaw_rate, STEP_S)
        within = anchor.ego_is_comfortable(states, np.arange(len(episode.xy)) * STEP_S)
        ours = episode.scores["navsim.epdms@0a380a9"]["parts"]["history_comfort"]
        assert ours == float(np.all(within)), f"{episode.name}: {within}"
        found[episode.name] = ours
    assert len(set(found.values())) > 1, f"a sample that cannot tell: {found}"


def stand_in(name: str, **content: Any) -> None:
    """A module that only the anchor's own program has."""
    made = types.ModuleType(name)
    for key, value in content.items():
        setattr(made, key, value)
    sys.modules[name] = made


def alpasim(name: str) -> Any:
    """A module of AlpaSim's evaluation, without the simulator that it belongs to."""
    (folder,) = checkout("alpasim")
    source = folder / "src" / "eval" / "src" / "eval"
    for package in ("eval", "eval.scorers", "eval.aggregation"):
        stand_in(package, __path__=[str(source.joinpath(*package.split(".")[1:]))])
    metric = SimpleNamespace(MAX="max")
    stand_in("eval.data", AggregationType=metric, MetricReturn=SimpleNamespace, SimulationResult=object)
    stand_in("eval.scorers.base", Scorer=object)
    return module(name)


def test_collisions_are_those_of_alpasim(driven: list[Driven]) -> None:
    scorer = alpasim("eval.scorers.collision").CollisionScorer()
    shapely = pytest.importorskip("shapely", reason="NOT RUN: shapely is not installed")
    affinity = importlib.import_module("shapely.affinity")

    def placed(shape: Any, center: Any, yaw: float) -> Any:
        turned = affinity.rotate(shape, yaw, origin=(0, 0), use_radians=True)
        return affinity.translate(turned, *center)

    found = {}
    for episode in driven:
        length, width, _ = episode.scenario["ego"]["size"]
        # 2 % smaller, with corners rounded by a quarter of the lesser side.
        half, side, round_m = 0.49 * length, 0.49 * width, 0.245 * width
        rounded = shapely.box(-half, -side, half, side).buffer(-round_m).buffer(round_m, quad_segs=64)
        lines = [shapely.LineString([(x, side), (x, -side)]) for x in (half, -half)]
        steps = []
        for xy, yaw, forward, there in zip(episode.xy, episode.yaw, episode.forward, episode.actors, strict=True):
            center = xy + episode.scenario["ego"]["center_x"] * forward
            ego, front, rear = (placed(shape, center, yaw) for shape in (rounded, *lines))
            shapes = [ego]
            for index, position, q, *_ in there:
                along, across, _ = episode.scenario["actors"][index]["size"]
                box = shapely.box(-along / 2, -across / 2, along / 2, across / 2)
                shapes.append(placed(box, position[:2], yaw_of(q)))
            steps.append(polygons(shapely, shapes, front, rear))
        timeline = SimpleNamespace(get_polygons_at_time=lambda step, steps=steps: steps[step])
        times = range(len(steps))
        metrics = scorer.calculate(SimpleNamespace(timestamps_us=times, actor_polygons=timeline))
        hits = {metric.name: metric.values for metric in metrics}
        first = next((step for step in times if hits["collision_any"][step]), None)
        at_fault = first is not None and (hits["collision_front"][first] or hits["collision_lateral"][first])
        ours = episode.scores["alpasim.scene@3032e0c"]["parts"]["collision_at_fault"]
        assert ours == float(at_fault), f"{episode.name}: {first}"
        kind = first is not None and next(key for key, hit in hits.items() if hit[first])
        found[episode.name] = kind
    assert set(found.values()) >= {"collision_front", "collision_rear", False}, found


def polygons(shapely: Any, shapes: list[Any], front: Any, rear: Any) -> Any:
    """The shapes of a step as AlpaSim asks for them; the ego is the first."""
    tree = importlib.import_module("shapely.strtree").STRtree(shapes)
    return SimpleNamespace(
        str_tree=tree,
        bbox_polygons=shapes,
        get_idx_for_agent=lambda name: 0,
        get_polygon_for_agent=lambda name: shapes[0],
        get_front_bumper_line_for_agent=lambda name: front,
        get_rear_bumper_line_for_agent=lambda name: rear,
    )


def test_scene_scores_are_those_of_alpasim(driven: list[Driven]) -> None:
    anchor = alpasim("eval.aggregation.scene_score")
    config = alpasim("eval.schema").SceneScoreConfig()
    found = {}
    for episode in driven:
        score = episode.scores["alpasim.scene@3032e0c"]
        # Later versions also fail an ego that left its corridor; none of these does.
        row = {**score["parts"], "left_corridor_laterally": 0.0}
        expected = anchor.score_rollout(row, config).score
        assert abs(score["value"] - expected) < 1e-12, episode.name
        found[episode.name] = expected
    assert {0.0, 1.0} <= set(found.values()) and len(set(found.values())) > 2, found


def test_gsplat_reads_the_ply_of_a_trained_scene(tmp_path: Path) -> None:
    (folder,) = checkout("gsplat")
    exporter = module("exporter", folder / "gsplat")

    def wildcity(*arguments: str) -> None:
        command = [os.environ["WILDCITY_BIN"], *arguments]
        environment = {**os.environ, "XDG_DATA_HOME": str(tmp_path)}
        subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)

    wildcity("twin", "generate", "--twin", "lane", "--length-km", "0.1", "--density", "1")
    wildcity("train", "augment", "lane", "--every", "25m", "--side", "160", "--cameras", "front", "--out", "views")
    wildcity("train", "views/round_1", "--steps", "20", "--out", "scene.ply")
    header, _, body = (tmp_path / "scene.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property float ")]
    values = np.frombuffer(body, "<f4").reshape(-1, len(names))
    assert len(values) > 1_000

    def columns(prefix: str) -> np.ndarray:
        numbers = [name for name in names if name.startswith(prefix)]
        return values[:, [names.index(f"{prefix}{k}") for k in range(len(numbers))]]

    splats = {name: tensor.numpy() for name, tensor in exporter.load_ply_to_splats(str(tmp_path / "scene.ply")).items()}
    assert np.array_equal(splats["means"], values[:, [names.index(axis) for axis in "xyz"]])
    assert np.array_equal(splats["scales"], columns("scale_"))
    assert np.array_equal(splats["quats"], columns("rot_"))
    assert np.array_equal(splats["opacities"], values[:, names.index("opacity")])
    assert np.array_equal(splats["sh0"][:, 0], columns("f_dc_"))
    # The file has all coefficients of red, then of green, then of blue.
    rest = columns("f_rest_").reshape(len(values), 3, -1)
    assert rest.shape[2] == 3
    assert np.array_equal(splats["shN"], rest.swapaxes(1, 2))
