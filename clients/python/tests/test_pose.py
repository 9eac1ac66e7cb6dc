"""Poses, plans and addresses, against SciPy and by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from wildcity import Pose, Trajectory
from wildcity.address import server_url, session_url
from wildcity.messages import Ego


def random_pose(random: np.random.Generator) -> Pose:
    x, y, z, w = Rotation.random(random_state=random).as_quat()
    scale = random.uniform(0.5, 2.0)
    return Pose(tuple(random.normal(size=3)), (w * scale, x * scale, y * scale, z * scale))


def test_poses_compose_and_invert_as_matrices_do() -> None:
    random = np.random.default_rng(4)
    for _ in range(50):
        a, b = random_pose(random), random_pose(random)
        w, x, y, z = a.q
        assert np.allclose(a.rotation, Rotation.from_quat([x, y, z, w]).as_matrix(), atol=1e-12)
        assert np.allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-12)
        assert np.allclose((a.inverse @ a).matrix, np.eye(4), atol=1e-12)
        heading = math.atan2(a.rotation[1, 0], a.rotation[0, 0])
        assert a.yaw == pytest.approx(heading, abs=1e-12)
    with pytest.raises(ValueError, match="no rotation"):
        _ = Pose(q=(0, 0, 0, 0)).matrix


def test_a_flat_pose_has_its_heading() -> None:
    for yaw in (-3.0, -0.5, 0.0, 1.0, 3.1):
        pose = Pose.flat(1.0, 2.0, yaw, z=3.0)
        assert pose.xyz == (1.0, 2.0, 3.0)
        assert pose.yaw == pytest.approx(yaw)
        # One metre ahead.
        assert (pose @ Pose.flat(1.0, 0.0)).xyz == pytest.approx((1 + math.cos(yaw), 2 + math.sin(yaw), 3.0))


def test_a_plan_heads_along_its_way_and_keeps_its_heading_at_rest() -> None:
    plan = Trajectory.from_xy([(1.0, 0.0), (2.0, 1.0), (2.0, 1.0), (2.0, 3.0)], every_us=500_000)
    assert [pose.time_us for pose in plan.poses] == [500_000, 1_000_000, 1_500_000, 2_000_000]
    assert [pose.pose.yaw for pose in plan.poses] == pytest.approx([0.0, math.pi / 4, math.pi / 4, math.pi / 2])
    assert plan.poses[-1].pose.xyz == (2.0, 3.0, 0.0)
    for xy in ([], np.zeros((65, 2))):
        with pytest.raises(ValueError, match="1 to 64"):
            Trajectory.from_xy(xy)


def test_the_ego_says_its_speed_and_heading() -> None:
    ego = Ego(Pose.flat(0, 0, 1.0), (3.0 * math.cos(1.0), 3.0 * math.sin(1.0), 0.0), (0.0, 0.0, 0.0), 0.0, 1)
    assert (ego.speed, ego.yaw) == (pytest.approx(3.0), pytest.approx(1.0))
    backwards = Ego(ego.pose, (-ego.velocity[0], -ego.velocity[1], 0.0), (0.0, 0.0, 0.0), 0.0, 1)
    assert backwards.speed == pytest.approx(-3.0)
    assert Ego(Pose(), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 1).speed == 0.0


@pytest.mark.parametrize(
    "address", ["cars:8080", "http://cars:8080", "http://cars:8080/", "ws://cars:8080", "ws://cars:8080/v1/session"]
)
def test_every_form_of_an_address_is_the_same_server(address: str) -> None:
    assert session_url(address) == "ws://cars:8080/v1/session"
    assert server_url(address) == "http://cars:8080"


def test_addresses_keep_their_security_and_refuse_what_they_do_not_know() -> None:
    assert session_url("https://cars") == "wss://cars/v1/session"
    assert server_url("wss://cars/v1/session") == "https://cars"
    assert session_url("wss://proxy/cars/v1/session") == "wss://proxy/cars/v1/session"
    with pytest.raises(ValueError, match="has a path"):
        server_url("wss://proxy/cars/v1/session")
    assert session_url("[::1]:8080") == "ws://[::1]:8080/v1/session"
    for address in ["", "ftp://cars", "http://", "http://cars/v2", "cars:port", "ws://cars?x=1", "http://me:pw@cars"]:
        with pytest.raises(ValueError, match="give HOST:PORT"):
            session_url(address)
