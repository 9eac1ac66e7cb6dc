"""`wildcity alpasim drive`: stock drivers of the package carla-driver-interface drive in a twin."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import wildcity
from carla_driver_interface.driver import BaseDriver, DriveContext, DriveResult
from carla_driver_interface.geometry import Pose, Trajectory
from carla_driver_interface.policies import load_policy
from carla_driver_interface.server import serving
from test_end_to_end import PAIR, Server, import_corridor, server

COMMON = ["--steps", "6", "--warm-up-us", "500000", "--cameras", "front", "--size", "96x64", "--rig", "vehicle6"]


@contextlib.contextmanager
def driver(policy: BaseDriver) -> Iterator[str]:
    """A driver that listens, and its address."""
    with serving(policy, port=0, host="127.0.0.1", mode="alpasim") as port:
        yield f"127.0.0.1:{port}"


def drive(server: Server, address: str, *arguments: str) -> tuple[int, list[dict[str, Any]], str]:
    binary = os.environ["WILDCITY_BIN"]
    command = [
        binary,
        "alpasim",
        "drive",
        "corridor",
        "--egodriver",
        address,
        "--server",
        server.url,
        *COMMON,
        *arguments,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()], done.stderr


@pytest.mark.parametrize("policy", ["route_follower", "constant_speed"])
def test_a_stock_policy_drives_the_same_episode_twice(server: Server, policy: str) -> None:
    with driver(load_policy(policy)) as address:
        first = drive(server, address, "--seed", "3")
        again = drive(server, address, "--seed", "3")
    status, (report,), errors = first
    assert status == 0, errors
    assert again == first
    assert (report["outcome"], report["steps"], report["seed"]) == ("completed", 6, 3)
    # Both start with the recorded 5 m/s.
    assert 2.8 < report["distance_m"] < 4.0


class Recorder(BaseDriver):
    """Drives straight on at 5 m/s, and keeps what it was told."""

    name = "recorder"
    frame_history_length = 100

    def __init__(self) -> None:
        self.seen: list[DriveContext] = []
        self.poses: list[int] = []
        self.states: list[Any] = []
        self.frames: list[int] = []
        self.routes: list[Any] = []

    def drive(self, ctx: DriveContext) -> DriveResult:
        session = ctx.session
        self.seen.append(ctx)
        self.poses = list(session.ego_trajectory.timestamps_us)
        self.states = list(session.dynamic_states)
        self.frames = [frame.frame_end_us for frame in session.frame_history["camera_front"]]
        self.routes.append(session.route_waypoints_in_rig)
        return DriveResult(trajectory_in_rig=straight(ctx))


def straight(ctx: DriveContext) -> Trajectory:
    plan = Trajectory.empty()
    for step in range(1, 20):
        plan.append(ctx.time_now_us + 100_000 * step, Pose.from_xyz_yaw(0.5 * step, 0.0, 0.0, 0.0))
    return plan


def test_a_driver_gets_what_the_contract_says(server: Server) -> None:
    recorder = Recorder()
    with driver(recorder) as address:
        status, (report,), errors = drive(server, address)
    assert status == 0, errors
    start = 1_000_000_000
    times = [ctx.time_now_us for ctx in recorder.seen]
    assert times == [start + 100_000 * k for k in range(6)]
    assert all(ctx.time_query_us == ctx.time_now_us + 100_000 for ctx in recorder.seen)
    # 0.5 s of warm-up are six poses; then one for each further decision.
    assert recorder.poses == [start + 100_000 * k for k in range(-5, 6)]
    assert [state.linear_velocity.x for state in recorder.states] == pytest.approx([5.0] * 11, abs=0.05)
    # The four frames of the warm-up, then one per decision, none twice.
    assert recorder.frames == [start + 100_000 * k for k in range(-3, 6)]
    image = recorder.seen[-1].session.latest_frame("camera_front").as_array()
    assert image.shape == (64, 96, 3) and image.max() > 50
    # 20 points to 80 m ahead, straight on after the end of the drive, which is 10 m long.
    route = recorder.routes[0]
    assert route.shape == (20, 3)
    assert route[:, 0] == pytest.approx([80 / 19 * k for k in range(20)], abs=1e-3)
    (camera,) = recorder.seen[0].session.cameras.values()
    assert (camera.logical_id, camera.intrinsics.resolution_w) == ("camera_front", 96)
    assert camera.rig_to_camera.vec.z > 1.0


class Broken(BaseDriver):
    """Fails in one way."""

    name = "broken"

    def __init__(self, fault: str) -> None:
        self.fault = fault
        self.calls = 0

    def drive(self, ctx: DriveContext) -> DriveResult:
        self.calls += 1
        if self.calls < 3:
            return DriveResult(trajectory_in_rig=straight(ctx))
        if self.fault == "raises":
            raise RuntimeError("no GPU")
        plan = Trajectory.empty()
        if self.fault == "nan":
            plan.append(ctx.time_now_us + 100_000, Pose.from_xyz_yaw(float("nan"), 0.0, 0.0, 0.0))
        elif self.fault == "short":
            plan.append(ctx.time_now_us + 50_000, Pose.from_xyz_yaw(0.2, 0.0, 0.0, 0.0))
        elif self.fault == "ends":
            return DriveResult(trajectory_in_rig=straight(ctx), terminate_session=True)
        elif self.fault == "sleeps":
            time.sleep(5)
        return DriveResult(trajectory_in_rig=plan)


@pytest.mark.parametrize(
    ("fault", "outcome", "reason"),
    [
        ("raises", "agent_error", "drive: Unknown"),
        ("empty", "agent_error", "has no pose after"),
        ("nan", "agent_error", "finite"),
        ("short", "agent_error", "ends 50000 us from now"),
        ("sleeps", "agent_timeout", "did not answer drive within 3 s"),
    ],
)
def test_a_broken_driver_ends_its_episode(server: Server, fault: str, outcome: str, reason: str) -> None:
    with driver(Broken(fault)) as address:
        status, (report,), errors = drive(server, address, "--drive-timeout-ms", "3000")
    expected = 124 if outcome == "agent_timeout" else 1
    assert (status, report["outcome"], report["steps"]) == (expected, outcome, 2), report
    assert reason in report["reason"]
    assert "1 of 1 episodes" in errors


def test_a_driver_may_end_the_episode(server: Server) -> None:
    with driver(Broken("ends")) as address:
        status, (report,), errors = drive(server, address)
    assert (status, report["outcome"], report["steps"]) == (0, "completed", 3), errors


def test_episodes_run_beside_each_other(server: Server) -> None:
    with driver(load_policy("route_follower")) as address:
        status, reports, errors = drive(server, address, "--episodes", "3", "--parallel", "3")
    assert status == 0, errors
    assert sorted(report["seed"] for report in reports) == [0, 1, 2]
    assert len({report["frames_hash"] for report in reports}) == 1


def test_a_driver_follows_a_scenario_to_its_end(tmp_path: Path) -> None:
    """The route is the scenario's, 1 m beside the recorded drive, and its rule ends the episode."""
    import_corridor(tmp_path)
    scenario = {
        "format": "wildcity.scenario/1",
        "name": "aside",
        "twin": {"name": "corridor"},
        "ego": {"start": {"trajectory": "log", "station_m": 3.0}, "dynamics": {"model": "dynamic", "speed": 5.0}},
        "route": {"points": [[0, 1, 0], [50, 1, 0]]},
        "end": {"time_s": 0.4},
    }
    (tmp_path / "scenarios").mkdir()
    (tmp_path / "scenarios" / "aside.json").write_text(json.dumps(scenario))
    recorder = Recorder()
    arguments = ["--scenarios", str(tmp_path / "scenarios")]
    with wildcity.serve(tmp_path / "twins", arguments=arguments) as running, driver(recorder) as address:
        status, reports, errors = drive(Server(running.url), address, "--scenario", "aside")
    assert status == 0, errors
    (report,) = reports
    # The command line allows 6 steps.
    assert (report["outcome"], report["steps"]) == ("completed", 4)
    # At the start the ego is on the recorded drive: the route is 1 m to its left.
    route = recorder.routes[0]
    assert route.shape == (20, 3) and route[:, 1] == pytest.approx([1.0] * 20, abs=0.01)


def run_suite(folder: Path, agent: str, **dynamics: Any) -> tuple[int, dict[str, Any]]:
    """Runs a scenario of 0.6 s along the corridor, and returns the exit code and result.json."""
    binary = os.environ["WILDCITY_BIN"]
    (folder / "rig.json").write_text(json.dumps(wildcity.protocol.encode(PAIR)))
    twins = import_corridor(folder, "--rig", folder / "rig.json")
    scenario = {
        "format": "wildcity.scenario/1",
        "name": "straight",
        "twin": {"name": "corridor"},
        "ego": {
            "start": {"trajectory": "log", "station_m": 2.0},
            "dynamics": {"model": "dynamic", "speed": 5.0, **dynamics},
        },
        "end": {"time_s": 0.6, "off_route_m": 10.0},
    }
    (folder / "straight.json").write_text(json.dumps(scenario))
    command = [binary, "episode", "run", str(folder / "straight.json"), "--agent", agent, *twins]
    command += ["--out", str(folder / "out"), "--retries", "0", "--accept-unjudged", "off_road"]
    done = subprocess.run(command, timeout=120)
    return done.returncode, json.loads((folder / "out" / "result.json").read_text())


def test_a_suite_judges_a_driver(tmp_path: Path) -> None:
    with driver(load_policy("route_follower")) as address:
        status, result = run_suite(tmp_path, f"egodriver:{address}")
    assert (status, result["agent"], result["counts"]["passed"]) == (0, f"egodriver:{address}", 1), result


@pytest.mark.parametrize(
    "dynamics", [{"speed": 3.0}, {"model": "kinematic", "speed": 0.0}, {"model": "teleport", "speed": 0.0}]
)
def test_the_scenario_says_how_the_ego_starts(tmp_path: Path, dynamics: dict[str, Any]) -> None:
    # The recorded drive has 5 m/s.
    recorder = Recorder()
    with driver(recorder) as address:
        status, result = run_suite(tmp_path, f"egodriver:{address}", **dynamics)
    (episode,) = result["episodes"]
    assert "errors" not in episode and result["counts"]["technical"] == 0, (status, result)
    speed = recorder.states[0].linear_velocity.x
    assert speed == pytest.approx(dynamics["speed"], abs=0.05)


@pytest.mark.parametrize(("speed", "is_ordered"), [("5.004", True), ("4.9", False)])
def test_an_agent_that_starts_at_another_speed_is_not_judged(tmp_path: Path, speed: str, is_ordered: bool) -> None:
    with driver(load_policy("route_follower")) as address:
        agent = f"{os.environ['WILDCITY_BIN']} alpasim drive --egodriver {address} --speed {speed}"
        _, result = run_suite(tmp_path, agent)
    (episode,) = result["episodes"]
    said = [error["message"] for error in episode.get("errors", [])]
    expected = [] if is_ordered else ["the agent opened with another dynamics.speed than WILDCITY_OPEN says"]
    assert said == expected, result


def test_a_suite_counts_a_broken_driver_as_not_driven(tmp_path: Path) -> None:
    with driver(Broken("raises")) as address:
        status, result = run_suite(tmp_path, f"egodriver:{address}")
    (episode,) = result["episodes"]
    assert (status, result["counts"]["technical"]) == (3, 1), result
    assert [error["kind"] for error in episode["errors"]] == ["agent_error"]


@pytest.mark.parametrize("agent", ["egodriver:", "egodriver:127.0.0.1:1; true"])
def test_an_address_that_is_none_is_refused(tmp_path: Path, agent: str) -> None:
    binary = os.environ["WILDCITY_BIN"]
    suite = Path(__file__).parents[3] / "scenes" / "suites" / "street" / "suite.json"
    command = [binary, "episode", "run", str(suite), "--agent", agent, "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "expected egodriver:HOST:PORT" in done.stderr, done.stderr
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def street(quick_reader: dict[str, str]) -> Iterator[Server]:
    """A server with the demo street."""
    with wildcity.serve(Path(quick_reader["XDG_DATA_HOME"]) / "wildcity" / "twins") as running:
        yield Server(running.url)


@pytest.mark.parametrize("policy", ["route_follower", "constant_speed"])
def test_a_stock_policy_drives_60_steps_of_the_demo_street(street: Server, policy: str) -> None:
    options = ["--steps", "60", "--cameras", "front", "--size", "96x62"]
    command = [os.environ["WILDCITY_BIN"], "alpasim", "drive", "demo", "--server", street.url, *options]
    with driver(load_policy(policy)) as address:
        runs = [
            subprocess.run([*command, "--egodriver", address], capture_output=True, text=True, timeout=240)
            for _ in range(2)
        ]
    first, again = (json.loads(run.stdout) for run in runs)
    if policy == "route_follower":
        assert (first["outcome"], first["steps"]) == ("completed", 60), runs[0].stderr
    else:
        # It does not steer, and the street bends: it drives into a parked car.
        assert (first["outcome"], first["steps"] < 60) == ("driving_failure", True), runs[0].stderr
    assert first["distance_m"] > 10.0
    assert again == first
