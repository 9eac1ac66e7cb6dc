"""comma2k19 to a log: a miniature segment by its README, against PROJ."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from logs_truth import Array, Log, drive, killed_and_resumed, moved, points_seen, refused, run, wxyz
from scipy.spatial.transform import Rotation
from test_logs_pai import FRAMES, encode

PLACE = (37.7209977, -122.4723053, 33.37)
PLANE = pyproj.Transformer.from_pipeline(
    f"+proj=topocentric +ellps=WGS84 +lat_0={PLACE[0]} +lon_0={PLACE[1]} +h_0={PLACE[2]}"
)
START_S = 46408.547498
DOWN = np.diag([1.0, -1.0, -1.0])


def local(frame: int) -> Array:
    """world_from_rig of a frame, in the tangent plane at the first one."""
    return np.linalg.inv(np.vstack([np.c_[np.eye(3), drive(0.0)[:3, 3]], [0, 0, 0, 1]])) @ drive(0.05 * frame)


def time_s(frame: int) -> float:
    return START_S + 0.05 * frame


def save(path: Path, values: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.save(file, np.asarray(values))


def earth_from_plane() -> Array:
    """Axes of the plane in earth-centred coordinates, as columns."""
    points = [np.array(PLANE.transform(*point, direction="INVERSE")) for point in np.vstack([np.zeros(3), np.eye(3)])]
    return np.stack([point - points[0] for point in points[1:]], axis=1)


def make(root: Path) -> Path:
    segment = root / "b0c9d2329ad1606b_2018-08-02" / "40"
    axes, pose = earth_from_plane(), segment / "global_pose"
    save(pose / "frame_times", [time_s(frame) for frame in range(FRAMES)])
    save(pose / "frame_positions", [PLANE.transform(*local(n)[:3, 3], direction="INVERSE") for n in range(FRAMES)])
    turns = [Rotation.from_matrix(axes @ local(n)[:3, :3] @ DOWN).as_matrix() for n in range(FRAMES)]
    save(pose / "frame_orientations", [wxyz(np.vstack([np.c_[turn, [0, 0, 0]], [0, 0, 0, 1]])) for turn in turns])
    encode(segment / "video.mp4", 3)
    (segment / "video.mp4").rename(segment / "video.hevc")
    imu = segment / "processed_log" / "IMU"
    times = [START_S + 0.0096 * n for n in range(30)]
    for name, value in (("accelerometer", [0.5, 0.2, -9.8]), ("gyro", [0.01, 0.02, 0.03])):
        save(imu / name / "t", times if name == "gyro" else [*times[:-1], times[-1] + 0.001])
        save(imu / name / "value", [value] * 30)
    gnss = segment / "processed_log" / "GNSS" / "live_gnss_ublox"
    save(gnss / "t", [START_S + 0.1 * n for n in range(4)])
    save(gnss / "value", [[PLACE[0], PLACE[1], 8.0, 1.5e9, PLACE[2], 90.0]] * 4)
    save(segment / "processed_log" / "CAN" / "speed" / "t", [0.0])
    return root


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("comma"))


@pytest.fixture(scope="module")
def log(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Log:
    out = tmp_path_factory.mktemp("log") / "log"
    run(source, "--out", out)
    return Log(out)


def test_poses_are_those_of_the_tangent_plane(log: Log) -> None:
    found = log.poses()
    assert sorted(found) == [round(time_s(frame) * 1e6) for frame in range(FRAMES)]
    for frame in range(FRAMES):
        # Earth-centred metres have 1e-9 m in f64.
        np.testing.assert_allclose(found[round(time_s(frame) * 1e6)], local(frame), rtol=0, atol=1e-6)
    geo = log.head["world"]["geo"]
    assert geo["latitude_deg"] == pytest.approx(PLACE[0], abs=1e-9)
    assert geo["longitude_deg"] == pytest.approx(PLACE[1], abs=1e-9)
    assert geo["altitude_m"] == pytest.approx(PLACE[2], abs=1e-3)


def test_points_have_the_pixels_of_its_camera(log: Log) -> None:
    k = np.array([[910.0, 0, 582], [0, 910.0, 437], [0, 0, 1]])
    inside = points_seen(k, (1164, 874))
    ahead = inside[:, [2, 0, 1]] * [1, -1, -1]
    ours = log.project("front", log.poses()[round(time_s(2) * 1e6)], moved(local(2), ahead))
    flat = inside @ k.T
    np.testing.assert_allclose(ours, flat[:, :2] / flat[:, 2:], rtol=0, atol=1e-4)


def test_sensors_have_their_own_times(log: Log) -> None:
    assert log.times("images", camera="front") == [round(time_s(frame) * 1e6) for frame in range(FRAMES)]
    rows = log.rows("imu")
    assert len(rows) == 29 and rows[3]["acceleration_m_per_s2"] == [0.5, -0.2, 9.8]
    assert rows[3]["angular_velocity_rad_per_s"] == [0.01, -0.02, -0.03]
    assert len(log.rows("gps")) == 4 and log.rows("gps")[0]["altitude_m"] == PLACE[2]
    left_out = " ".join(log.head["left_out"])
    assert "accelerations without a rate of their time: 1" in left_out and "(CAN, other GNSS): 1" in left_out


def test_a_killed_run_goes_on(source: Path, log: Log, tmp_path: Path) -> None:
    killed_and_resumed(tmp_path, log.folder, source, after=3)


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "a clock that runs backwards": (
        lambda p: save(p / "frame_times", [time_s(n % 3) for n in range(FRAMES)]), "row 3 is not later"),
    "too few poses": (lambda p: save(p / "frame_positions", np.zeros((3, 3))), "frame_positions: float64 (3, 3), not"),
    "no rotation": (lambda p: save(p / "frame_orientations", np.ones((FRAMES, 4))), "has not the length 1"),
    "a missing table": (lambda p: (p / "frame_orientations").unlink(), "frame_orientations: missing"),
    "no array": (lambda p: (p / "frame_times").write_bytes(b"\x93NUMPY"), "no array of NumPy"),
    "a video that is cut off": (
        lambda p: (p.parent / "video.hevc").write_bytes(b"hevc"), "video.hevc: cannot decode the video"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_segments_are_refused(name: str, tmp_path: Path) -> None:
    root = make(tmp_path / "data")
    BAD[name][0](next(root.glob("*/*/global_pose")))
    text = refused(tmp_path, root)
    assert BAD[name][1] in text, text
