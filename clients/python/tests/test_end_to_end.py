"""Both clients against the real server, on a twin that this test makes: a corridor of 40,000 Gaussians."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import os
import queue
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import wildcity
from PIL import Image
from wildcity import (
    Action,
    AxisNoise,
    Camera,
    CameraSensor,
    Disconnected,
    DriveSection,
    Dynamics,
    Exposure,
    ImageNoise,
    Imu,
    LensDirt,
    LidarBeams,
    LidarColumns,
    LidarSensor,
    Observation,
    Outputs,
    Pose,
    RandomStart,
    RecordedPoint,
    Refused,
    Rig,
    RigLidar,
    Sensors,
    SnapshotPoint,
    Station,
    Step,
    TimedPose,
    Trajectory,
    WheelSpeed,
    png_data_uri,
)

Connect = Callable[..., Any]

# Looks along the rig's x: camera x is right (-y), camera y is down (-z).
FORWARD = Pose((0.5, 0.0, 1.5), (0.5, -0.5, 0.5, -0.5))
BACK = Pose((-0.5, 0.0, 1.5), (0.5, -0.5, -0.5, 0.5))
PAIR = Rig(
    "pair",
    (
        Camera("front", 96, 64, 60.0, 60.0, 48.0, 32.0, FORWARD),
        Camera("rear", 65, 43, 40.0, 40.0, 32.5, 21.5, BACK),
    ),
)
RAW = Outputs(encoding="raw", depth=True, opacity=True, normals=True)


ORIGIN = (52.5162, 13.3777, 34.0)
"""Latitude, longitude and altitude of the twin's origin."""

ZONE_ORIGIN = ("EPSG:32756", 334_900.0, 6_252_300.25, 5.0)
"""The same of the twin `zone`, in a UTM zone of the southern hemisphere."""


@dataclass(frozen=True)
class Server:
    url: str

    def get(self, path: str) -> tuple[int, str]:
        base = self.url.replace("ws://", "http://").removesuffix("/v1/session")
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(base + path, timeout=10) as answer:
            return answer.status, answer.read().decode()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the built wildcity binary"
    folder = tmp_path_factory.mktemp("end_to_end")
    twins = import_corridor(folder, "--geo", ",".join(map(str, ORIGIN)))
    zone = ["--twin", "zone", "--geo", ",".join(map(str, ZONE_ORIGIN))]
    subprocess.run([binary, "import", folder / "corridor.ply", *zone, *twins], check=True, timeout=60)
    serving = [binary, "serve", *twins, "--listen", "127.0.0.1:0"]
    serving += ["--episodes", str(folder / "episodes"), "--uploads", str(folder / "uploads")]
    with subprocess.Popen(serving, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
        try:
            yield Server(listening_url(process))
        finally:
            process.terminate()
            assert process.wait(timeout=20) == 0, "the server did not stop cleanly"


def test_sensors_have_effects(connect: Connect, server: Server) -> None:
    noisy = CameraSensor(drop=0.3, noise=ImageNoise(1000, 5), dirt=LensDirt(4, 0.1, 1.0))
    sensors = Sensors(
        cameras={"front": noisy},
        imu=Imu(gyroscope=AxisNoise(0.001)),
        wheel_speed=WheelSpeed(scale=0.01),
        delay_us=200_000,
    )
    outputs = Outputs(encoding="raw")
    with connect(server.url) as client:
        seen = []
        for name, effects in (("sensed", sensors), ("again", sensors), ("plain", Sensors(delay_us=200_000))):
            dynamics = Dynamics("kinematic", 5.0)
            opening = {"rig": PAIR, "outputs": outputs, "dynamics": dynamics, "session": name}
            with client.open("corridor", sensors=effects, start=Station("log", 2.0), **opening) as session:
                assert session.opened.sensors is not None
                drive = [session.reset(seed=4)]
                drive += [session.step(Action(1.0, 0.02)) for _ in range(12)]
                seen.append(drive)
        assert session.opened.sensors == Sensors(delay_us=200_000)
    for one, other, plain in zip(*seen, strict=True):
        assert one.metadata.frame_hash == other.metadata.frame_hash
        assert one.metadata.ego == plain.metadata.ego
        front, rear = one.metadata.images
        assert rear.sensor is None and front.sensor is not None
        assert front.sensor.status == "degraded" and front.sensor.due_us == one.metadata.time_us
        # The levels of detail are those that all views of a frame need: an earlier view of the front may refine them.
        stands_in = "dropped" in front.sensor.reasons
        assert rear.hash == plain.metadata.images[1].hash or stands_in
        taken = seen[2][front.sensor.taken_us // 100_000].metadata.images[0]
        assert front.sensor.clean_hash == taken.hash != front.hash
        assert one.images["front"].std() > 0
        assert one.imu.shape == (1, 6) and one.wheel_speed.shape == (1,)
        assert one.imu[0, 2] == pytest.approx(9.80665, abs=1e-3)
        with pytest.raises(KeyError):
            _ = plain.imu
    reasons = {reason for one in seen[0] for reason in one.metadata.images[0].sensor.reasons}
    assert reasons == {"dropped", "noise", "dirt"}


def test_drives_through_the_twin(connect: Connect, server: Server) -> None:
    with connect(server.url) as client:
        assert [twin.name for twin in client.welcome.twins] == ["corridor", "zone"]
        start = Station("log", 2.0)
        with client.open("corridor", rig=PAIR, outputs=RAW, start=start, seed=3) as session:
            opened = session.opened
            assert opened.start.xyz == pytest.approx((2.0, 0.0, 0.0))
            assert [(c.name, c.width, c.height) for c in opened.cameras] == [
                ("front", 96, 64),
                ("rear", 65, 43),
            ]
            first = session.reset(seed=3)
            check(first, step=0)
            for step in range(1, 21):
                seen = session.step(Pose((2.0 + 0.25 * step, 0.0, 0.0)))
                check(seen, step)
                assert seen.ego.velocity == pytest.approx((2.5, 0.0, 0.0))
            assert not np.array_equal(first.images["front"], seen.images["front"])
            # 0.25 m per step, relative to the current pose.
            assert seen.history_xyz[:, 0] == pytest.approx(0.25 * np.arange(-15, 1), abs=1e-6)
            assert seen.ego.history_count == 16
            summary = session.close()
            assert (summary.outcome, summary.steps) == ("completed", 20)
            assert summary.distance_m == pytest.approx(5.0)


def test_frames_of_the_recorded_and_the_driven_part(connect: Connect, server: Server) -> None:
    outputs = Outputs(encoding="raw", frames=3, trust=True, period_us={"rear": 200_000})
    with connect(server.url) as client:
        with client.open("corridor", rig=PAIR, outputs=outputs, warm_up_us=500_000) as session:
            first = session.reset()
            then = {camera: first.frames(camera) for camera in ("front", "rear")}
            times = [info.shutter_end_us for info in first.frame_infos("rear")]
            assert times == [-400_000, -200_000, 0]
            assert first.ego.history_count == 6
            seen = session.step(Pose((3.0, 1.0, 0.0)))
    assert np.array_equal(seen.frames("front")[:2], then["front"][1:])
    assert np.array_equal(seen.frames("rear"), then["rear"])
    on_route = first.metadata.images[0].trust
    beside = seen.metadata.images[0].trust
    assert on_route is not None and beside is not None
    assert on_route.distance_m == pytest.approx(0.0, abs=1e-9) and beside.distance_m == pytest.approx(1.0)
    assert beside.value < on_route.value <= 1.0


def test_has_the_sweeps_of_its_lidar(connect: Connect, server: Server) -> None:
    beams = LidarBeams(
        tuple(math.radians(5 - k) for k in range(24)),
        100_000,
        columns=LidarColumns(360, math.pi, math.pi / 180 - math.pi),
    )
    top = RigLidar("top", beams, Pose((1.0, 0.0, 1.9), (1.0, 0.0, 0.0, 0.0)))
    rig = Rig(PAIR.name, PAIR.cameras, (top,))
    lossy = Sensors(lidars={"top": LidarSensor(noise_m=0.02, drop=0.5)})
    with connect(server.url) as client:
        with client.open("corridor", rig=rig, outputs=RAW) as session:
            first = session.reset().lidars["top"]
            here = session.opened.start
            observation = session.step(here @ Pose.flat(2.0, 0.0))
            cloud = observation.lidars["top"]
            with pytest.raises(KeyError, match="'roof'.*there is top"):
                _ = observation.lidars["roof"]
            assert not session.observe([here]).lidars
        with client.open("corridor", rig=rig, outputs=dataclasses.replace(RAW, semantics=True)) as session:
            labelled = session.reset().lidars["top"]
        with client.open("corridor", rig=rig, outputs=RAW, sensors=lossy) as session:
            lost = session.reset().lidars["top"]
    assert len(first) > 1_000 and 0.45 < len(lost) / len(first) < 0.55, (len(lost), len(first))
    assert labelled.classes.tolist() == [1] * len(first), "a twin without classes is unlabelled"
    with pytest.raises(KeyError, match="semantics=True"):
        _ = first.classes
    assert cloud.points.shape == (len(cloud), 3) and cloud.intensity.shape == cloud.rows.shape == (len(cloud),)
    # The beam of each return, from the LiDAR: elevation of its row and azimuth of its column.
    from_lidar = cloud.points.astype(float) - [1.0, 0.0, 1.9]
    range_m = np.linalg.norm(from_lidar, axis=1)
    assert range_m.min() > 0.5
    elevation = np.degrees(np.arcsin(from_lidar[:, 2] / range_m))
    assert np.abs(elevation - (5.0 - cloud.rows)).max() < 0.01
    azimuth = np.degrees(np.arctan2(from_lidar[:, 1], from_lidar[:, 0]))
    off = (azimuth - (180.0 - cloud.columns) + 180.0) % 360.0 - 180.0
    assert np.abs(off).max() < 0.01
    metadata = observation.metadata.sweeps[0]
    assert (metadata.end_us, metadata.columns) == (observation.metadata.time_us, 360)
    assert np.abs(cloud.times_us - (metadata.end_us - (359 - cloud.columns.astype(float)) * 100_000 / 360)).max() < 1.0
    assert (cloud.instances == 1).all()


def test_a_twin_without_classes_is_unlabelled(connect: Connect, server: Server) -> None:
    outputs = Outputs(encoding="raw", instances=True, semantics=True)
    with connect(server.url) as client:
        with client.open("corridor", rig=PAIR, outputs=outputs) as session:
            assert session.opened.semantics is not None
            assert not session.opened.semantics.labelled
            assert session.opened.semantics.classes[:3] == ("none", "unlabelled", "road")
            seen = session.reset()
        with client.open("corridor", rig=PAIR, outputs=RAW) as session:
            assert session.opened.semantics is None
            with pytest.raises(KeyError, match="semantics=True"):
                session.reset().semantics["front"]
    for camera, classes in seen.semantics.items():
        assert classes.dtype == np.uint8
        assert np.array_equal(classes, seen.instances[camera])
    assert (seen.semantics["front"] == 1).any()


def test_knows_where_it_is_on_the_earth(connect: Connect, server: Server) -> None:
    latitude, longitude, altitude = ORIGIN
    plane = f"+proj=topocentric +ellps=WGS84 +lat_0={latitude} +lon_0={longitude} +h_0={altitude}"
    steps = f"+step +inv {plane} +step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    to_earth = pyproj.Transformer.from_pipeline(f"+proj=pipeline {steps}")
    geod = pyproj.Geod(ellps="WGS84")
    with connect(server.url) as client, client.open("corridor", rig=PAIR, outputs=RAW) as session:
        for x, y, yaw in ((0.0, 0.0, 0.0), (1500.0, -800.0, 2.0), (-20_000.0, 9000.0, -0.5)):
            pose = Pose((x, y, 1.0), (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)))
            geo = session.step(pose).metadata.geo
            assert geo is not None
            east, north, up = to_earth.transform(x, y, 1.0)
            assert (geo.longitude, geo.latitude) == pytest.approx((east, north), abs=1e-11)
            assert geo.altitude == pytest.approx(up, abs=1e-6)
            # The heading is the azimuth of a point a metre ahead.
            ahead = to_earth.transform(x + math.cos(yaw), y + math.sin(yaw), 1.0)
            azimuth = geod.inv(east, north, ahead[0], ahead[1])[0]
            assert (geo.heading - azimuth + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-3)


def test_knows_where_it_is_in_a_utm_zone(connect: Connect, server: Server) -> None:
    zone, easting, northing, altitude = ZONE_ORIGIN
    projection = pyproj.Proj(zone)
    with connect(server.url) as client, client.open("zone", rig=PAIR, outputs=RAW) as session:
        for x, y, yaw in ((0.0, 0.0, 0.0), (1500.0, -800.0, 2.0), (-20_000.0, 9000.0, -0.5)):
            pose = Pose((x, y, 1.0), (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)))
            geo = session.step(pose).metadata.geo
            assert geo is not None
            east, north = projection(easting + x, northing + y, inverse=True)
            assert (geo.longitude, geo.latitude) == pytest.approx((east, north), abs=1e-11)
            assert geo.altitude == pytest.approx(altitude + 1.0, abs=1e-9)
            convergence = projection.get_factors(east, north).meridian_convergence
            heading = 90.0 - math.degrees(yaw) + convergence
            assert (geo.heading - heading + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-6)


def test_steps_several_sessions_at_once(connect: Connect, server: Server) -> None:
    with connect(server.url) as client, connect(server.url) as other:
        car = Dynamics("kinematic", 5.0)
        left = client.open("corridor", rig=PAIR, outputs=RAW, session="left")
        right = client.open("corridor", rig=PAIR, outputs=RAW, session="right", dynamics=car)
        alone = other.open("corridor", rig=PAIR, outputs=RAW)
        here = Pose((1.0, 0.5, 0.0))
        seen = client.step_many({"left": here, "right": Step(Action(1.0, 0.0), 300_000, {"why": "test"})})
        same = alone.step(here)
        assert seen["left"].metadata.frame_hash == same.metadata.frame_hash
        for name in ("front", "rear"):
            assert np.array_equal(seen["left"].images[name], same.images[name])
        assert seen["right"].metadata.step == 3
        seen = client.step_many({"left": Action(0.0, 0.0), "right": Action(0.0, 0.0), "gone": here})
        assert seen["right"].metadata.step == 4
        assert (seen["left"].code, seen["left"].field) == ("session_state", "steps[0].action")
        assert (seen["gone"].code, seen["gone"].field) == ("unknown_session", "steps[2].session")
        with pytest.raises(Refused, match="session_state"):
            client.open("corridor")
        assert left.reset().metadata.session == "left"
        # After a lost connection both are resumed.
        client.close()
        assert right.resume().also[0].session == "right"
        assert left.step(here).metadata.session == "left"
        assert left.close().steps == 1
        assert right.step(Action(0.0, 0.0)).metadata.step == 5
        right.close()
        alone.close()


def test_returns_to_a_snapshot_and_branches(connect: Connect, server: Server) -> None:
    log = Station("log", 2.0)
    name = f"tree-{time.time_ns()}"
    with connect(server.url) as client:
        dynamics = Dynamics("dynamic", 5.0)
        with client.open("corridor", rig=PAIR, outputs=RAW, start=log, dynamics=dynamics, session=name) as session:
            session.reset(seed=1)
            before = session.step(Action(1.0, 0.05), until_us=300_000, notes={"why": "to the fork"})
            assert (before.metadata.step, before.metadata.time_us) == (3, 300_000)
            session.snapshot("fork")
            left = session.step(Action(0.0, 0.1))
            again = session.restore("fork")
            assert again.metadata.ego == before.metadata.ego
            assert np.array_equal(again.images["front"], before.images["front"])
            with connect(server.url) as other:
                with other.branch(SnapshotPoint(name, "fork")) as branch:
                    assert branch.opened.dynamics == dynamics
                    same = branch.step(Action(0.0, 0.1))
            assert same.frame[-1000:] == left.frame[-1000:]
            assert same.metadata.ego == left.metadata.ego
        with client.branch(RecordedPoint(f"{name}-1", 3)) as branch:
            same = branch.step(Action(0.0, 0.1))
            assert same.metadata.ego == left.metadata.ego
            assert same.metadata.frame_hash == left.metadata.frame_hash
        with pytest.raises(Refused, match="no recorded episode"):
            client.branch(RecordedPoint("nothing-1", 0))


def test_reads_the_recorded_drive_and_starts_along_it(connect: Connect, server: Server) -> None:
    http = server.url.replace("ws://", "http://").removesuffix("/v1/session")
    drive = wildcity.recorded_drive("corridor", "log", from_m=1.0, to_m=2.0, every_m=0.5, server=http)
    assert [pose.station_m for pose in drive.poses] == [1.0, 1.5, 2.0]
    assert drive.poses[1].pose.xyz == pytest.approx((1.5, 0.0, 0.0))
    with connect(server.url) as client:
        start = RandomStart("log", 1.0, 2.0, lateral_m=0.25)
        section = DriveSection("log", 1.0, 2.0, 0.5)
        with client.open("corridor", rig=PAIR, start=start, trajectory=section) as session:
            assert session.opened.trajectory == drive
            places = {session.reset(seed).ego.pose.xyz for seed in range(5)}
            assert len(places) == 5
            assert all(1.0 <= x <= 2.0 and abs(y) <= 0.25 for x, y, _ in places)
            assert session.reset(3, dynamics="kinematic", speed=4.0).ego.velocity[0] == pytest.approx(4.0)


def test_drives_a_car(connect: Connect, server: Server) -> None:
    with connect(server.url) as client:
        dynamics = Dynamics("dynamic", speed=5.0)
        start = Station("log", 2.0)
        with client.open("corridor", rig=PAIR, outputs=RAW, start=start, dynamics=dynamics) as session:
            assert session.opened.dynamics == dynamics
            ahead = [TimedPose(100_000 * k, Pose((0.5 * k, 0.0, 0.0))) for k in range(1, 65)]
            seen = session.step(Trajectory(tuple(ahead)))
            assert seen.ego.pose.xyz == pytest.approx((2.5, 0.0, 0.0), abs=1e-3)
            seen = session.step(Action(acceleration=1.0, curvature=0.05))
            assert seen.ego.pose.xyz[0] > 2.95 and seen.ego.pose.xyz[1] > 1e-4
            assert seen.ego.steering is not None and 0.05 < seen.ego.steering < 0.16
            assert seen.ego.yaw_rate > 0.0
            with pytest.raises(Refused, match="action or trajectory"):
                session.step(Pose())


def test_a_model_reads_four_frames_at_each_decision(server: Server) -> None:
    outputs = wildcity.Outputs(frames=4, trust=True)
    with wildcity.connect(server.url) as client:
        session = client.open("corridor", outputs=outputs, decision_us=1_000_000, warm_up_us=1_600_000)
        opened = session.opened
        assert (opened.outputs.frames, opened.outputs.trust, opened.decision_us) == (4, True, 10**6)
        assert opened.start.xyz == pytest.approx((8.0, 0.0, 0.0))


def test_pictures_show_the_corridor(connect: Connect, server: Server) -> None:
    """Red wall on the left, green on the right; the rear camera sees them swapped."""
    with connect(server.url) as client:
        with client.open("corridor", rig=PAIR, outputs=RAW, start=Pose((10, 0, 0))) as session:
            seen = session.reset()
    for camera, left, right in (("front", 0, 1), ("rear", 1, 0)):
        image = seen.images[camera].astype(float)
        columns = image.shape[1] // 4
        assert image[:, :columns, left].mean() > 3 * image[:, :columns, right].mean()
        assert image[:, -columns:, right].mean() > 3 * image[:, -columns:, left].mean()
    # The camera is between the walls: the left wall faces right, which is +x of the camera.
    normals = seen.normals["front"]
    assert normals[20:44, 2:10, 0].mean() > 0.95 and normals[20:44, -10:-2, 0].mean() < -0.95
    # The wall is 2 m to the left: z = fx * 2 m / (cx - u) for the pixel centre of column 8.
    depth, opacity = seen.depth["front"][32, 8], seen.opacity["front"][32, 8]
    assert opacity > 0.9
    assert depth == pytest.approx(60.0 * 2.0 / (48.0 - 8.5), rel=0.1)


def test_exposure_and_overlay_are_those_of_the_rig(connect: Connect, server: Server) -> None:
    hood = np.zeros((64, 96, 4), np.uint8)
    hood[48:] = (10, 20, 30, 255)
    file = io.BytesIO()
    Image.fromarray(hood).save(file, "png")
    looks = dataclasses.replace(
        PAIR.cameras[0],
        exposure=Exposure(gain=(0.5, 1.0, 2.0), offset=(0.0, 0.1, 0.0)),
        overlay=png_data_uri(file.getvalue()),
    )
    raw = Outputs(("front",), "raw", normals=True)
    seen = {}
    with connect(server.url) as client:
        for name, camera in (("plain", PAIR.cameras[0]), ("looks", looks)):
            with client.open("corridor", rig=Rig("one", (camera,)), outputs=raw) as session:
                seen[name] = session.reset()
    plain, image = (seen[name].images["front"].astype(float) for name in ("plain", "looks"))
    wanted = np.clip(plain * (0.5, 1.0, 2.0) + (0.0, 25.5, 0.0), 0, 255)
    # Both images are rounded once, and the gain doubles the rounding error of blue.
    assert np.abs(image - wanted)[:48].max() <= 2.0
    assert (image[48:] == (10, 20, 30)).all()
    assert np.array_equal(seen["plain"].normals["front"], seen["looks"].normals["front"])
    wrong = dataclasses.replace(looks, width=95)
    with connect(server.url) as client, pytest.raises(Refused, match="overlay"):
        client.open("corridor", rig=Rig("one", (wrong,)), outputs=raw)


def test_encodings_agree(connect: Connect, server: Server) -> None:
    seen: dict[str, Observation] = {}
    with connect(server.url) as client:
        for encoding in ("raw", "png", "jpeg"):
            outputs = Outputs(encoding=encoding, quality=95 if encoding == "jpeg" else None)
            with client.open("corridor", rig=PAIR, outputs=outputs) as session:
                seen[encoding] = session.reset()
    raw = seen["raw"].images["front"]
    assert np.array_equal(raw, seen["png"].images["front"])
    error = np.abs(raw.astype(int) - seen["jpeg"].images["front"])
    assert error.mean() < 8
    hashes = {observation.metadata.frame_hash for observation in seen.values()}
    assert len(hashes) == 1, "the hash is of the pixels before encoding"


def test_the_same_drive_gives_the_same_hashes(connect: Connect, server: Server) -> None:
    def drive() -> list[str]:
        with connect(server.url) as client:
            with client.open("corridor", rig=PAIR, start=Pose((1, 0, 0))) as session:
                seen = [session.reset(seed=1)]
                seen += [session.step(Pose((1.0 + k, 0.1 * k, 0.0))) for k in range(3)]
                return [observation.metadata.frame_hash for observation in seen]

    first = drive()
    assert drive() == first
    assert len(set(first)) > 1


def test_observe_does_not_move(connect: Connect, server: Server) -> None:
    with connect(server.url) as client:
        with client.open("corridor", rig=PAIR, outputs=RAW, start=Pose((3, 0, 0))) as session:
            session.reset()
            seen = session.observe([Pose((3, 0, 0)), Pose((6, 0, 0))])
            assert len(seen.views) == 2
            assert not np.array_equal(seen.views[0].images["front"], seen.views[1].images["front"])
            assert seen.ego.pose.xyz == (3.0, 0.0, 0.0)
            there = session.step(Pose((6, 0, 0)))
            assert there.metadata.step == 1
            assert np.array_equal(there.images["front"], seen.views[1].images["front"])
            assert np.array_equal(there.depth["rear"], seen.views[1].depth["rear"])


@pytest.mark.parametrize(
    ("options", "code", "field"),
    [
        ({"twin": "nowhere"}, "unknown_twin", "twin"),
        ({"twin": "../etc"}, "invalid_name", "twin"),
        ({"version": 99}, "unknown_version", "version"),
        ({"rig": "bicycle"}, "unknown_rig", "rig"),
        ({"rig": PAIR, "outputs": Outputs(("left",))}, "unknown_camera", "outputs.cameras[0]"),
        ({"start": Station("nowhere")}, "unknown_trajectory", "start.trajectory"),
        ({"start": Pose(q=(2, 0, 0, 0))}, "pose_invalid", "start.pose.q"),
        ({"seed": -1}, "out_of_range", "seed"),
    ],
)
def test_invalid_open_requests_are_refused_without_effect(
    connect: Connect, server: Server, options: dict[str, Any], code: str, field: str | None
) -> None:
    with connect(server.url) as client:
        with pytest.raises(Refused) as refused:
            client.open(**{"twin": "corridor", **options})
        assert (refused.value.code, refused.value.field) == (code, field)
        assert not refused.value.fatal
        client.open("corridor", rig=PAIR).close()


def test_a_refused_step_changes_nothing(connect: Connect, server: Server) -> None:
    with connect(server.url) as client:
        with client.open("corridor", rig=PAIR) as session:
            session.reset()
            with pytest.raises(Refused) as refused:
                session.step(Pose((1e12, 0.0, 0.0)))
            assert (refused.value.code, refused.value.field) == ("pose_invalid", "pose.xyz[0]")
            seen = session.step(Pose((1.0, 0.0, 0.0)))
            assert seen.metadata.step == 1


def test_a_lost_connection_is_resumed(connect: Connect, server: Server) -> None:
    with connect(server.url) as client:
        with client.open("corridor", rig=PAIR) as session:
            session.reset()
            before = session.step(Pose((1.0, 0.0, 0.0)))
            client.close()
            with pytest.raises(Disconnected):
                session.step(Pose((2.0, 0.0, 0.0)))
            resumed = session.resume()
            assert (resumed.last_seq, resumed.step) == (before.metadata.seq, 1)
            assert session.step(Pose((2.0, 0.0, 0.0))).metadata.step == 2


def test_a_killed_agents_session_lives_on(connect: Connect, server: Server) -> None:
    """Another client that resumes the session gets the last answer again, byte for byte."""
    with connect(server.url) as client:
        session = client.open("corridor", rig=PAIR, session=f"killed-{time.time_ns()}")
        name = session.opened.session
        session.reset()
        seen = session.step(Pose((1.0, 0.0, 0.0)))
    with connect(server.url) as client:
        session = client.resume(name, seen.metadata.seq - 1)
        again = session.step(Pose((1.0, 0.0, 0.0)))
        assert again.frame == seen.frame
        assert session.step(Pose((2.0, 0.0, 0.0))).metadata.step == 2
        session.close()
    # The answer to `close` is lost with a connection as other answers are, and is there again.
    with connect(server.url) as client:
        client.resume(name, seen.metadata.seq + 1).close()
    with connect(server.url) as client, pytest.raises(Refused) as refused:
        client.resume(f"never-{name}", 1)
    assert refused.value.code == "unknown_session"


def test_many_agents_at_once(server: Server) -> None:
    hashes: queue.Queue[tuple[str, ...]] = queue.Queue()

    def drive() -> None:
        with wildcity.connect(server.url) as client:
            with client.open("corridor", rig=PAIR) as session:
                seen = [session.step(Pose((float(k), 0.0, 0.0))) for k in range(5)]
                hashes.put(tuple(observation.metadata.frame_hash for observation in seen))

    threads = [threading.Thread(target=drive) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert hashes.qsize() == 8
    assert len({hashes.get() for _ in threads}) == 1


def test_http_routes(server: Server) -> None:
    assert server.get("/healthz")[0] == 200
    assert server.get("/readyz")[0] == 200
    status, body = server.get("/v1/twins")
    assert status == 200
    twin, _ = json.loads(body)["twins"]
    assert (twin["name"], twin["gaussians"]) == ("corridor", 40_000)


def check(seen: Observation, step: int) -> None:
    assert (seen.metadata.step, seen.metadata.time_us) == (step, 100_000 * step)
    for name, height, width in (("front", 64, 96), ("rear", 43, 65)):
        info = seen.views[0].cameras[name]
        assert info.shutter_end_us == seen.metadata.time_us
        assert seen.images[name].shape == (height, width, 3)
        assert seen.images[name].max() > 50
        assert seen.depth[name].shape == seen.opacity[name].shape == (height, width)
        assert np.isfinite(seen.depth[name]).all()
        assert 0.0 <= seen.opacity[name].min() <= seen.opacity[name].max() <= 1.0


def listening_url(process: subprocess.Popen[str]) -> str:
    lines: queue.Queue[str] = queue.Queue()
    assert process.stdout is not None
    # Keeps reading, so that the server never blocks on a full pipe.
    stdout = process.stdout
    threading.Thread(target=lambda: [lines.put(line) for line in stdout], daemon=True).start()
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            line = lines.get(timeout=1)
        except queue.Empty:
            assert process.poll() is None, f"the server ended with {process.returncode}"
            continue
        if line.startswith("listening on "):
            return line.removeprefix("listening on ").strip()
    raise AssertionError("the server did not say where it listens")


def import_corridor(folder: Path, *options: str | Path) -> list[str]:
    """Imports the corridor and its recorded drive into `folder`/twins. Returns the arguments that name these twins."""
    write_corridor(folder / "corridor.ply")
    write_log(folder / "log.json")
    twins = ["--twins", str(folder / "twins")]
    files = [folder / "corridor.ply", "--twin", "corridor", "--trajectory", folder / "log.json"]
    subprocess.run([os.environ["WILDCITY_BIN"], "import", *files, *twins, *options], check=True, timeout=60)
    return twins


def write_corridor(path: Path) -> None:
    """Walls 2 m to each side of the x axis, 3 m high: red on the left (y > 0), green right."""
    # 90 m² a wall: one Gaussian per 7 cm square. A pixel's depth is that of the first centres around
    # its ray, so sigmas of 6 cm bring it nearer by about that much.
    count = 40_000
    numbers = np.random.default_rng(1)
    x, z = numbers.uniform(-5, 25, count), numbers.uniform(0, 3, count)
    left = np.arange(count) < count // 2
    y = np.where(left, 2.0, -2.0)
    # Degree-0 harmonics: colour = 0.5 + 0.2820948 dc.
    bright, dark = (0.9 - 0.5) / 0.2820948, (0.05 - 0.5) / 0.2820948
    dc = np.where(left[:, None], [bright, dark, dark], [dark, bright, dark])
    opacity = np.full(count, 4.0)  # logit: 0.98
    scale = np.log(np.broadcast_to([0.06, 0.006, 0.06], (count, 3)))
    rotation = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (count, 4))
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    columns = np.column_stack([x, y, z, dc, opacity, scale, rotation]).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in names.split()] + ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + columns.tobytes())


def write_log(path: Path) -> None:
    keyframes = [
        {"time_us": 100_000 * k, "world_from_rig": {"xyz": [0.5 * k, 0, 0], "q": [1, 0, 0, 0]}} for k in range(21)
    ]
    path.write_text(json.dumps({"name": "log", "keyframes": keyframes}))
