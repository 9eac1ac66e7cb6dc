"""`wildcity/Drive-v0` and its vector environment on a real server, and `wildcity.serve`."""

from __future__ import annotations

import math
import os
import re
import stat
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gymnasium
import numpy as np
import pytest
import wildcity
import wildcity.gym
from gymnasium.utils.env_checker import check_env
from test_end_to_end import PAIR, Server, import_corridor, server
from wildcity import (
    Drive,
    DrivePose,
    LidarBeams,
    LidarColumns,
    Pose,
    Refused,
    RigLidar,
    ServeFailed,
    Station,
    serving,
)
from wildcity.gym import DriveConfig, DriveEnv, DriveState, DriveVectorEnv, Reward, Route

SMALL: dict[str, Any] = {"twin": "corridor", "rig": PAIR, "size": (32, 20), "horizon": 30, "speed": 5.0}
STRAIGHT = np.zeros(2, np.float32)
LEFT = np.array([0.0, 1.0], np.float32)


@pytest.fixture
def env(server: Server) -> Iterator[DriveEnv]:
    made = DriveEnv(server=server.url, render_mode="rgb_array", **SMALL)
    yield made
    made.close()


def test_the_environment_passes_gymnasiums_own_check(server: Server) -> None:
    made = gymnasium.make("wildcity/Drive-v0", server=server.url, render_mode="rgb_array", **SMALL)
    check_env(made.unwrapped)
    made.close()


def test_driving_straight_makes_progress(env: DriveEnv) -> None:
    seen, info = env.reset(seed=1, options={"start": 1.0})
    assert env.observation_space.contains(seen)
    assert info["station_m"] == pytest.approx(1.0, abs=1e-6) and info["distance_m"] < 1e-6
    # The route is 4 m, 8 m, ... ahead, and goes straight on beyond the end of the drive at 10 m.
    assert seen["route"][:, 0] == pytest.approx(4.0 * np.arange(1, 21), abs=1e-4)
    assert seen["route"][:, 1] == pytest.approx(0.0, abs=1e-6)
    seen, reward, terminated, truncated, info = env.step(STRAIGHT)
    assert reward == pytest.approx(0.5, abs=0.01) and not terminated and not truncated
    assert seen["speed"][0] == pytest.approx(5.0, abs=0.05)
    assert seen["image_front"].shape == (20, 32, 3) and seen["image_front"].max() > 50
    picture = env.render()
    assert picture is not None and picture.shape == (20, 32, 3)


def moved(speed: float, acceleration: float, events: int = 0) -> tuple[DriveState, DriveState]:
    """States before and after a step of 0.1 s along a drive."""

    def state(time_us: int, station_m: float) -> DriveState:
        metadata = SimpleNamespace(time_us=time_us, events=[SimpleNamespace(kind="contact")] * events)
        seen = SimpleNamespace(metadata=metadata, ego=SimpleNamespace(acceleration=(0.0, acceleration, 0.0)))
        return DriveState(station_m, 0.5, speed, cast(Any, seen))

    return state(0, 0.0), state(100_000, 0.1 * speed)


def test_the_terms_of_the_reward() -> None:
    terms = Reward().terms(*moved(20.0, -5.0, events=2))
    limit = 50 / 3.6
    expected = {"progress": 2.0, "beside": -0.05, "speeding": -0.2 * (20 - limit), "comfort": -0.1, "contact": -20.0}
    assert terms == pytest.approx(expected)
    assert Reward()(*moved(20.0, -5.0, events=2)) == pytest.approx(sum(expected.values()))
    for name in expected:
        off: dict[str, Any] = {name: 0.0}
        assert Reward(**off).terms(*moved(20.0, -5.0, events=2)) == pytest.approx({**expected, name: 0.0})
    gentle = Reward().terms(*moved(limit, 3.0))
    assert gentle["speeding"] == gentle["comfort"] == 0.0


def test_speeding_does_not_pay(server: Server) -> None:
    """On the same 10 m, as fast as the car can go earns less than the recorded speed."""

    def total(action: np.ndarray[Any, Any], **limits: float) -> float:
        env = DriveEnv(server=server.url, **SMALL, reward=Reward(**limits))
        env.reset(seed=1, options={"start": 0.0})
        try:
            rewards = 0.0
            while True:
                _, reward, terminated, truncated, _ = env.step(action)
                rewards += reward
                if terminated or truncated:
                    return rewards
        finally:
            env.close()

    full = np.array([1.0, 0.0], np.float32)
    limits = {"speed_limit_m_s": 6.0}
    assert total(full, **limits) < total(STRAIGHT, **limits) - 1.0
    # Each of the two terms alone makes it so; without both it would not.
    assert total(full, **limits, comfort=0.0) < total(STRAIGHT, **limits)
    assert total(full, **limits, speeding=0.0) < total(STRAIGHT, **limits)
    assert total(full, comfort=0.0, speeding=0.0) >= total(STRAIGHT) - 0.5


@pytest.mark.parametrize("record", [False, True])
def test_a_reset_leaves_a_record_only_if_asked_to(tmp_path: Path, record: bool) -> None:
    import_corridor(tmp_path)
    with wildcity.serve(tmp_path / "twins", episodes=tmp_path / "episodes") as running:
        env = DriveEnv(server=running.url, **SMALL, **({"record": True} if record else {}))
        for _ in range(2):
            env.reset(seed=1)
            env.step(STRAIGHT)
        env.close()
    assert len(list((tmp_path / "episodes").glob("*.jsonl"))) == (2 if record else 0)


def test_the_profile_is_that_of_the_session(server: Server) -> None:
    env = DriveEnv(server=server.url, **SMALL, profile={"tau_px": 4.0})
    env.reset(seed=1)
    session, _ = env._opened()
    assert session.opened.profile["tau_px"] == 4.0
    env.close()
    with pytest.raises(wildcity.Refused, match="tau"):
        DriveEnv(server=server.url, **SMALL, profile={"tau": 4.0}).reset(seed=1)


def test_a_twin_that_is_not_there_is_named_when_it_is_asked_for(server: Server) -> None:
    threads = threading.active_count()
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(ValueError, match="there is no twin 'nope'; the server has corridor"):
            make("wildcity/Drive-v0", server=server.url, **{**SMALL, "twin": "nope"})
        with pytest.raises(wildcity.ConnectFailed):
            make("wildcity/Drive-v0", server="127.0.0.1:9", **SMALL)
    assert threading.active_count() == threads


def test_an_episode_ends_off_the_route_at_its_end_and_at_the_horizon(server: Server) -> None:
    def drive(action: np.ndarray[Any, Any], **changes: Any) -> tuple[bool, bool, int, float]:
        env = DriveEnv(server=server.url, **{**SMALL, **changes})
        env.reset(seed=1, options={"start": 0.0})
        try:
            for step in range(1, 100):
                _, _, terminated, truncated, info = env.step(action)
                if terminated or truncated:
                    return terminated, truncated, step, info["distance_m"]
            raise AssertionError("the episode does not end")
        finally:
            env.close()

    terminated, truncated, _, distance_m = drive(LEFT, off_route_m=0.05)
    assert (terminated, truncated) == (True, False) and 0.05 < distance_m < 1.0
    # The wall of the corridor is met before.
    terminated, truncated, _, distance_m = drive(LEFT, off_route_m=3.0)
    assert (terminated, truncated) == (True, False) and distance_m < 3.0
    # 9.5 m at 5 m/s.
    terminated, truncated, steps, distance_m = drive(STRAIGHT)
    assert (terminated, truncated) == (False, True) and steps in (19, 20) and distance_m < 1e-3
    assert drive(STRAIGHT, horizon=3)[:3] == (False, True, 3)


def scenario(**changes: Any) -> dict[str, Any]:
    """Along the corridor's drive at 5 m/s, with a car in the way."""
    actors = [{"name": "car", "class": "vehicle", "size": [4.0, 1.8, 1.5], "stand": {"xyz": [9.0, 0.0, 0.0]}}]
    return {
        "format": "wildcity.scenario/1",
        "name": "straight",
        "twin": {"name": "corridor"},
        "ego": {"start": {"trajectory": "log", "station_m": 0.0}, "dynamics": {"model": "dynamic", "speed": 5.0}},
        "actors": actors,
        "end": {"time_s": 2.5, "off_route_m": 1.0, "contact": "any"},
        # The corridor is narrower than the car's way to the side.
        "verdict": {"twin_contact": False},
        **changes,
    }


@pytest.fixture
def drive_in(server: Server) -> Iterator[Any]:
    """Drives a scenario with one action until it ends: all results of `step`."""
    made: list[DriveEnv] = []

    def drive(action: np.ndarray[Any, Any], **changes: Any) -> list[Any]:
        env = DriveEnv(server=server.url, **{**SMALL, "horizon": 100, "scenario": scenario(**changes)})
        made.append(env)
        seen, info = env.reset(seed=1)
        assert env.observation_space.contains(seen) and info["station_m"] == pytest.approx(0.0, abs=1e-6)
        results = [env.step(action)]
        while not (results[-1][2] or results[-1][3]):
            results.append(env.step(action))
        return results

    yield drive
    for env in made:
        env.close()


def test_a_scenario_ends_by_its_own_rules(drive_in: Any) -> None:
    def end(results: list[Any]) -> tuple[bool, bool, str]:
        _, _, terminated, truncated, info = results[-1]
        return terminated, truncated, info["end"]

    met = drive_in(STRAIGHT)
    assert end(met) == (True, False, "contact")
    rewards = [reward for _, reward, *_ in met]
    # Half a metre a step, until the contact costs 10.
    assert rewards[:-1] == pytest.approx([0.5] * (len(met) - 1), abs=0.02)
    assert rewards[-1] == pytest.approx(-10.0, abs=0.6) and met[-1][4]["contacts"] == 1
    assert all(result[4]["contacts"] == 0 and result[4]["end"] == "" for result in met[:-1])
    assert end(drive_in(LEFT)) == (True, False, "off_route")
    assert end(drive_in(STRAIGHT, actors=[])) == (True, False, "route_done")
    timed = drive_in(STRAIGHT, end={"time_s": 0.3})
    assert end(timed) == (False, True, "time") and len(timed) == 3


def test_the_route_of_a_scenario_is_the_servers(drive_in: Any) -> None:
    route = {"points": [[0, 0.5, 0], [30, 0.5, 0]]}
    (seen, reward, *_), *_ = drive_in(STRAIGHT, actors=[], route=route, end={"time_s": 0.2})
    # From the place beside the ego on, 80/19 m apart, and straight on after its end.
    assert seen["route"][:, 1] == pytest.approx([0.5] * 20, abs=0.01)
    assert seen["route"][:, 0] == pytest.approx([80 / 19 * k for k in range(20)], abs=0.01)
    # Progress along it, less a tenth of the distance from it.
    assert reward == pytest.approx(0.5 - 0.05, abs=0.01)


def test_a_scenario_passes_gymnasiums_own_check(server: Server) -> None:
    made = gymnasium.make("wildcity/Drive-v0", server=server.url, scenario=scenario(), **SMALL)
    check_env(made.unwrapped, skip_render_check=True)
    made.close()


def test_the_vector_environment_is_n_environments_of_a_scenario(server: Server) -> None:
    arguments = {**SMALL, "server": server.url, "scenario": scenario(end={"time_s": 0.3, "contact": "any"})}
    ours = DriveVectorEnv(2, **arguments)
    theirs = gymnasium.vector.SyncVectorEnv([lambda: DriveEnv(**arguments)] * 2)
    try:
        compare(ours.reset(seed=5), theirs.reset(seed=5))
        for _ in range(6):
            actions = np.zeros((2, 2), np.float32)
            compare(ours.step(actions), theirs.step(actions))
    finally:
        ours.close()
        theirs.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ego": {"start": {"trajectory": "log", "station_m": 0.0}}}, "no ego.dynamics"),
        ({"ego": {"start": {"pose": {"xyz": [1, 0, 0]}}, "dynamics": {"model": "dynamic", "speed": 5.0}}}, "no route"),
    ],
)
def test_a_scenario_that_cannot_be_driven_is_refused(server: Server, changes: dict[str, Any], message: str) -> None:
    env = DriveEnv(server=server.url, **{**SMALL, "scenario": scenario(actors=[], end={"time_s": 1}, **changes)})
    with pytest.raises(ValueError, match=message):
        env.reset(seed=1)
    env.close()


def sessions(server: Server) -> int:
    """Sessions that the server holds, those without a connection too."""
    lines = server.get("/metrics")[1].splitlines()
    return int(next(line for line in lines if line.startswith("wildcity_sessions ")).split()[1])


@pytest.mark.parametrize("kind", [DriveEnv, lambda **arguments: DriveVectorEnv(2, **arguments)])
def test_a_refused_reset_leaves_no_session(server: Server, kind: Any) -> None:
    without_dynamics = scenario(actors=[], ego={"start": {"trajectory": "log", "station_m": 0.0}})
    env = kind(server=server.url, **{**SMALL, "scenario": without_dynamics})
    before = sessions(server)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"no ego\.dynamics"):
            env.reset(seed=1)
    assert sessions(server) == before == 0
    env.close()


def test_an_error_of_one_environment_leaves_no_call_of_another_under_way(server: Server) -> None:
    envs = DriveVectorEnv(4, server=server.url, **SMALL)
    envs.reset(seed=1)
    # The first action is refused before it is sent, while the others wait for their answers.
    actions: Any = [np.zeros(3), STRAIGHT, STRAIGHT, STRAIGHT]
    with pytest.raises(ValueError, match="action has the shape"):
        envs.step(actions)
    envs.step(np.zeros((4, 2), np.float32))
    with pytest.raises(ValueError, match="action has the shape"):
        envs.step(actions)
    assert sessions(server) == 4
    envs.close()
    assert sessions(server) == 0


def test_a_scenario_says_where_episodes_start(server: Server) -> None:
    env = DriveEnv(server=server.url, **{**SMALL, "scenario": scenario(actors=[])})
    assert env.reset(options={"start": Station("log", 3.0)})[1]["station_m"] == pytest.approx(3.0)
    with pytest.raises(ValueError, match=r"start is 3\.0; a scenario says"):
        env.reset(options={"start": 3.0})
    env.close()


def test_a_reward_of_the_users_own(server: Server) -> None:
    def speed(before: DriveState, after: DriveState) -> float:
        return after.speed_m_s

    env = DriveEnv(server=server.url, reward=speed, **SMALL)
    env.reset(seed=1)
    assert env.step(STRAIGHT)[1] == pytest.approx(5.0, abs=0.05)
    env.close()


def test_starts_follow_the_seed(env: DriveEnv) -> None:
    starts = [env.reset(seed=seed)[1]["station_m"] for seed in (1, 1, 2)]
    assert starts[0] == starts[1] != starts[2]
    assert env.reset()[1]["station_m"] not in starts
    assert env.reset(options={"start": Station("log", 2.0), "version": 1})[1]["station_m"] == pytest.approx(2.0)
    with pytest.raises(ValueError, match="'station'.* unknown; known are start and version"):
        env.reset(options={"station": 2.0})
    with pytest.raises(Refused, match="unknown_version"):
        env.reset(options={"version": 9})


def test_an_action_of_another_shape_is_refused(env: DriveEnv) -> None:
    env.reset(seed=1)
    for action in ([0.0, 0.0, 0.0], 0.5):
        with pytest.raises(ValueError, match="action has the shape"):
            env.step(action)
    with pytest.raises(ValueError, match="action is .*nan"):
        env.step([math.nan, 0.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras": ()}, "cameras is empty"),
        ({"cameras": "front"}, "cameras is 'front'; give a tuple"),
        ({"lidars": "top"}, "lidars is 'top'; give rows"),
        ({"horizon": math.nan}, "horizon is nan"),
        ({"size": 96}, "size is 96; give width and height"),
        ({"dynamics": "teleport"}, "teleport"),
        ({"horizon": 0}, "horizon is 0"),
        ({"off_route_m": -1.0}, "off_route_m is -1.0"),
        ({"waypoint_m": math.nan}, "waypoint_m is nan"),
        ({"start_m": (50.0, 10.0)}, "start_m is"),
        ({"start_m": 5.0}, "start_m is 5.0"),
        ({"reward": 3}, "reward is 3"),
    ],
)
def test_bad_arguments_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DriveConfig(**changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"trajectory": "log"},
        {"dynamics": "kinematic"},
        {"speed": 8.0},
        {"off_route_m": 1.0},
        {"start_m": (0.0, 5.0)},
        {"waypoint_m": 2.0},
        {"speed": 8.0, "trajectory": "log"},
    ],
)
def test_arguments_of_a_drive_are_refused_with_a_scenario(changes: dict[str, Any]) -> None:
    names = ", ".join(sorted(changes, reverse=True))
    with pytest.raises(ValueError, match=f"with scenario, {names} cannot be set:"):
        DriveConfig(scenario="follow", **changes)
    DriveConfig(**changes)
    DriveConfig(scenario="follow", dt_us=50_000, horizon=10, speed=5.0)


def test_unknown_cameras_are_refused_by_the_server(server: Server) -> None:
    env = DriveEnv(server=server.url, **{**SMALL, "cameras": ("left",)})
    with pytest.raises(Refused, match="unknown_camera"):
        env.reset()
    env.close()


def test_the_vector_environment_is_n_environments(server: Server) -> None:
    """Observations, rewards, ends and restarts equal those of Gymnasium's own SyncVectorEnv, step by step."""
    arguments = {**SMALL, "horizon": 4, "server": server.url}
    ours = gymnasium.make_vec("wildcity/Drive-v0", num_envs=3, vectorization_mode="vector_entry_point", **arguments)
    theirs = gymnasium.vector.SyncVectorEnv([lambda: DriveEnv(**arguments)] * 3)
    numbers = np.random.default_rng(7)
    try:
        expected = theirs.reset(seed=5)
        compare(ours.reset(seed=5), expected)
        assert ours.observation_space == theirs.observation_space
        for _ in range(11):
            actions = numbers.uniform(-1, 1, (3, 2)).astype(np.float32)
            result = ours.step(actions)
            compare(result, theirs.step(actions))
            assert ours.observation_space.contains(result[0])
        mask = np.array([True, False, False])
        compare(ours.reset(seed=9, options={"reset_mask": mask}), theirs.reset(seed=9, options={"reset_mask": mask}))
    finally:
        ours.close()
        theirs.close()


def compare(ours: Any, theirs: Any) -> None:
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs)
        for key in theirs:
            compare(ours[key], theirs[key])
    elif isinstance(theirs, tuple):
        for one, other in zip(ours, theirs, strict=True):
            compare(one, other)
    else:
        assert np.array_equal(ours, theirs), (ours, theirs)


def test_closing_ends_the_sessions(server: Server) -> None:
    envs = DriveVectorEnv(2, server=server.url, **SMALL)
    envs.reset(seed=1)
    assert server.get("/v1/sessions")[1].count('"session"') >= 2
    envs.close()
    assert server.get("/v1/sessions")[1].count('"session"') == 0


def test_a_route_that_crosses_itself_is_followed_by_its_stations() -> None:
    # A figure of eight: two circles of radius 10 m that touch at the origin.
    angle = np.linspace(0, 2 * np.pi, 200)
    first = np.stack([10 * np.sin(angle), 10 - 10 * np.cos(angle)], axis=-1)
    second = np.stack([10 * np.sin(angle), 10 * np.cos(angle) - 10], axis=-1)
    xy = np.concatenate([first, second[1:]])
    station_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    poses = tuple(
        DrivePose(station, time_us, Pose((x, y, 0.0)))
        for time_us, (station, (x, y)) in enumerate(zip(station_m.tolist(), xy.tolist(), strict=True))
    )
    route = Route(Drive("eight", 1, "", float(station_m[-1]), poses))
    at_crossing = Pose((0.1, 0.0, 0.0))
    assert route.locate(at_crossing, 1.0)[0] == pytest.approx(0.1, abs=0.01)
    middle = route.length_m / 2
    assert route.locate(at_crossing, middle)[0] == pytest.approx(middle + 0.1, abs=0.01)
    # 2 m outside of the first circle, at its far end.
    station, distance = route.locate(Pose((0.0, 22.0, 0.0)), middle / 2)
    assert (station, distance) == (pytest.approx(middle / 2, abs=0.2), pytest.approx(2.0, abs=0.01))


def test_serve_starts_and_stops_the_program(tmp_path: Path) -> None:
    import_corridor(tmp_path)
    with wildcity.serve(tmp_path / "twins", memory_gib=1) as running:
        process = running.process
        with wildcity.connect(running.url) as client:
            assert [twin.name for twin in client.welcome.twins] == ["corridor"]
            client.open("corridor", rig=PAIR).reset()
        assert wildcity.recorded_drive("corridor", "log", server=running.http).length_m == pytest.approx(10.0)
    assert process.returncode == 0


def test_a_server_that_does_not_start_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        pytest.raises(ServeFailed, match=r"(?s)ended with 2.*--colour"),
        wildcity.serve(tmp_path, arguments=["--colour"]),
    ):
        raise AssertionError("it started")
    silent = tmp_path / "silent"
    silent.write_text("#!/bin/sh\nexec sleep 60\n")
    silent.chmod(silent.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("WILDCITY_BIN", str(silent))
    began = time.monotonic()
    with pytest.raises(ServeFailed, match="did not listen within 0.3 s"), wildcity.serve(timeout=0.3):
        raise AssertionError("it started")
    assert time.monotonic() - began < 10
    monkeypatch.setenv("WILDCITY_BIN", str(tmp_path / "nowhere"))
    with pytest.raises(ServeFailed, match="cannot run"), wildcity.serve():
        raise AssertionError("it started")
    monkeypatch.delenv("WILDCITY_BIN")
    monkeypatch.setenv("PATH", os.devnull)
    monkeypatch.setattr(serving.sysconfig, "get_path", lambda _: str(tmp_path))
    with pytest.raises(ServeFailed, match="there is no program wildcity"), wildcity.serve():
        raise AssertionError("it started")


def test_ranges_of_a_lidar(server: Server) -> None:
    elevations = tuple(np.radians(np.linspace(2.0, -24.0, 14)))
    beams = LidarBeams(elevations, 100_000, columns=LidarColumns(90, 3.1, -3.1), max_range_m=50.0)
    rig = replace(PAIR, lidars=(RigLidar("roof.top", beams, Pose((0.5, 0.0, 1.6), (1.0, 0.0, 0.0, 0.0))),))
    given: dict[str, Any] = {**SMALL, "rig": rig, "lidars": {"roof.top": (14, 90)}, "server": server.url}
    made = gymnasium.make("wildcity/Drive-v0", **given)
    check_env(made.unwrapped, skip_render_check=True)
    seen, _ = made.reset(seed=1, options={"start": 1.0})
    ranges = seen["lidar_roof_top"]
    assert ranges.shape == (14, 90)
    hit = ranges > 0
    assert hit.mean() > 0.5 and ranges[hit].min() > 0.5 and ranges[hit].max() <= 50.0
    # The second row is level, and its columns 22 and 67 look at the walls, 2 m to the left and to the right.
    assert ranges[1, [22, 67]] == pytest.approx(2.0, abs=0.1)
    made.close()

    for lidars, text in [
        ({"roof.top": (14, 91)}, "14 rows and 90 columns, not (14, 91)"),
        ({"no": (1, 1)}, "no LiDAR 'no'; it has roof.top"),
    ]:
        wrong = gymnasium.make("wildcity/Drive-v0", **{**given, "lidars": lidars})
        with pytest.raises(ValueError, match=re.escape(text)):
            wrong.reset()
        wrong.close()
