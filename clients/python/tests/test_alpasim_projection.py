"""50 known points land where AlpaSim's camera models put them, with global and with rolling shutters.

AlpaSim is not needed: `project` follows the published formulas of its cameras (NVIDIA's NCore), written here from the
fields of the message alone, and not from the server's code.
"""

from __future__ import annotations

import io
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from carla_driver_interface._proto import sensorsim_pb2
from numpy.typing import NDArray
from PIL import Image
from test_alpasim import AT, FORWARD, Stub, listening, pose
from test_end_to_end import write_log

SCENE = "points@1+log+0"
AT_END = (2.0, 0.25, 1.5)
AT_START = (1.75, 0.125, 1.5)
WIDTH = 960
HEIGHT = 540

Points = NDArray[np.float64]


def directions() -> Points:
    """[50, 3]: camera-space directions on a grid that all cameras here see."""
    columns = np.tan(np.radians(np.linspace(-32, 32, 10)))
    rows = np.tan(np.radians(np.linspace(-15, 15, 5)))
    x, y = (grid.ravel() for grid in np.meshgrid(columns, rows))
    return np.stack([x, y, np.ones(50)], axis=-1)


def world_from_camera(points: Points, at: tuple[float, float, float]) -> Points:
    """FORWARD: camera z is world x, camera x is world -y, camera y is world -z."""
    return np.stack([points[:, 2], -points[:, 0], -points[:, 1]], axis=-1) + at


def camera_from_world(points: Points, at: Points) -> Points:
    offset = points - at
    return np.stack([-offset[:, 1], -offset[:, 2], offset[:, 0]], axis=-1)


def write_points(path: Path, centres: Points) -> None:
    """Small white Gaussians: sigma is 1.5 px at the focal length of the cameras here."""
    count = len(centres)
    dc = np.full((count, 3), 0.5 / 0.2820948)
    scale = np.log(np.full((count, 3), 0.02))
    rotation = np.tile([1.0, 0, 0, 0], (count, 1))
    columns = np.column_stack([centres, dc, np.full(count, 4.0), scale, rotation]).astype("<f4")
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in names.split()] + ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + columns.tobytes())


CENTRES = world_from_camera(6.0 * directions(), AT_END)


@pytest.fixture(scope="module")
def stub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the built wildcity binary"
    folder = tmp_path_factory.mktemp("projection")
    write_points(folder / "points.ply", CENTRES)
    write_log(folder / "log.json")
    twins = ["--twins", str(folder / "twins")]
    importing = [binary, "import", str(folder / "points.ply"), "--twin", "points", *twins]
    subprocess.run([*importing, "--trajectory", str(folder / "log.json")], check=True, timeout=60)
    serving = [binary, "serve", *twins, "--listen", "127.0.0.1:0", "--alpasim", "127.0.0.1:0"]
    serving += ["--episodes", str(folder / "e"), "--uploads", str(folder / "u")]
    with subprocess.Popen(serving, stdout=subprocess.PIPE, text=True) as process:
        try:
            with grpc.insecure_channel(listening(process)["AlpaSim: listening on "]) as channel:
                yield Stub(channel)
        finally:
            process.terminate()


def pinhole() -> Any:
    lens = sensorsim_pb2.OpenCVPinholeCameraParam(
        principal_point_x=480.0,
        principal_point_y=270.0,
        focal_length_x=600.0,
        focal_length_y=600.0,
        radial_coeffs=[-0.05, 0.01, 0.0, 0.0, 0.0, 0.0],
        tangential_coeffs=[0.001, -0.002],
        thin_prism_coeffs=[0.0] * 4,
    )
    return sensorsim_pb2.CameraSpec(opencv_pinhole_param=lens, resolution_w=WIDTH, resolution_h=HEIGHT)


def ftheta(stub: Any, name: str) -> Any:
    asked = sensorsim_pb2.AvailableCamerasRequest(scene_id=SCENE)
    cameras = {c.logical_id: c.intrinsics for c in stub.get_available_cameras(asked).available_cameras}
    return cameras[name]


def project(spec: Any, points: Points) -> Points:
    """Pixels of camera-space points in an image of WIDTH x HEIGHT; a pixel's centre is at +0.5."""
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    if spec.HasField("bivariate_windshield_model_param"):
        model = spec.bivariate_windshield_model_param
        angles = np.arcsin(unit[:, :2])
        x, y = (np.sin(bivariate(angles, poly)) for poly in (model.horizontal_poly, model.vertical_poly))
        unit = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=-1)
    scale = np.array([WIDTH / spec.resolution_w, HEIGHT / spec.resolution_h])
    if spec.HasField("ftheta_param"):
        lens = spec.ftheta_param
        across = np.linalg.norm(unit[:, :2], axis=1)
        radius = np.polynomial.polynomial.polyval(np.arctan2(across, unit[:, 2]), lens.angle_to_pixeldist_poly)
        flat = unit[:, :2] / np.maximum(across, 1e-12)[:, None] * radius[:, None]
        linear = lens.linear_cde
        matrix = np.array([[linear.linear_c, linear.linear_d], [linear.linear_e, 1.0]])
        # The principal point counts from the centre of the first pixel.
        centre = np.array([lens.principal_point_x, lens.principal_point_y]) + 0.5
        return np.asarray((flat @ matrix.T + centre) * scale)
    lens = spec.opencv_pinhole_param
    x, y = (unit[:, :2] / unit[:, 2:]).T
    k = lens.radial_coeffs
    p = lens.tangential_coeffs
    squared = x * x + y * y
    radial = (1 + squared * (k[0] + squared * (k[1] + squared * k[2]))) / (
        1 + squared * (k[3] + squared * (k[4] + squared * k[5]))
    )
    u = x * radial + 2 * p[0] * x * y + p[1] * (squared + 2 * x * x)
    v = y * radial + p[0] * (squared + 2 * y * y) + 2 * p[1] * x * y
    focal = np.array([lens.focal_length_x, lens.focal_length_y])
    centre = np.array([lens.principal_point_x, lens.principal_point_y])
    return np.asarray((np.stack([u, v], axis=-1) * focal + centre) * scale)


def bivariate(angles: Points, coefficients: Any) -> Points:
    """Sum of c phi^i theta^j, ordered by j and then by i."""
    order = next(n for n in range(6) if (n + 1) * (n + 2) // 2 == len(coefficients))
    powers = [(i, j) for j in range(order + 1) for i in range(order + 1 - j)]
    terms = [c * angles[:, 0] ** i * angles[:, 1] ** j for c, (i, j) in zip(coefficients, powers, strict=True)]
    return np.asarray(np.sum(terms, axis=0))


def rolled(spec: Any) -> Points:
    """Pixels with a shutter that rolls from top to bottom: the row tells the time, and the time the pose."""
    pixels = project(spec, camera_from_world(CENTRES, np.array(AT_END)))
    for _ in range(20):
        time = np.clip((pixels[:, 1] - 0.5) / (HEIGHT - 1), 0, 1)[:, None]
        at = (1 - time) * np.array(AT_START) + time * np.array(AT_END)
        pixels = project(spec, camera_from_world(CENTRES, at))
    return pixels


def found(image: NDArray[np.uint8], expected: Points) -> Points:
    """The centroid of the light around each expected pixel."""
    light = image[:, :, 1].astype(float)
    centroids = []
    for u, v in expected:
        left, top = int(u) - 8, int(v) - 8
        part = light[top : top + 17, left : left + 17]
        assert part.shape == (17, 17) and part.max() > 60, f"nothing at {u:.1f}, {v:.1f}"
        rows, columns = np.mgrid[0:17, 0:17] + 0.5
        centroids.append([(part * columns).sum() / part.sum() + left, (part * rows).sum() / part.sum() + top])
    return np.array(centroids)


@pytest.mark.parametrize("shutter", ["GLOBAL", "ROLLING_TOP_TO_BOTTOM"])
@pytest.mark.parametrize("camera", ["pinhole", "camera_cross_left_120fov", "camera_front_wide_120fov"])
def test_points_land_where_alpasim_projects_them(stub: Any, camera: str, shutter: str) -> None:
    spec = pinhole() if camera == "pinhole" else ftheta(stub, camera)
    spec.shutter_type = sensorsim_pb2.ShutterType.Value(shutter)
    request = sensorsim_pb2.RGBRenderRequest(
        scene_id=SCENE,
        resolution_w=WIDTH,
        resolution_h=HEIGHT,
        camera_intrinsics=spec,
        frame_start_us=AT,
        frame_end_us=AT + 30_000,
        sensor_pose=sensorsim_pb2.PosePair(start_pose=pose(AT_START, FORWARD), end_pose=pose(AT_END, FORWARD)),
        image_format=sensorsim_pb2.ImageFormat.PNG,
    )
    image = np.asarray(Image.open(io.BytesIO(stub.render_rgb(request).image_bytes)))
    still = project(spec, camera_from_world(CENTRES, np.array(AT_END)))
    expected = still if shutter == "GLOBAL" else rolled(spec)
    error = np.linalg.norm(found(image, expected) - expected, axis=1)
    assert len(error) == 50 and error.max() < 0.1, error.round(3)
    if shutter != "GLOBAL":
        # The motion is seen: the top rows lie elsewhere.
        assert np.linalg.norm(expected - still, axis=1).max() > 5.0
