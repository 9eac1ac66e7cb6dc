"""The AlpaSim door: all methods of `sensorsim`, called with the stubs of the package carla-driver-interface."""

from __future__ import annotations

import io
import json
import os
import queue
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
import wildcity
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from google.protobuf.message_factory import GetMessageClass
from PIL import Image
from test_end_to_end import PAIR, import_corridor
from wildcity import Camera, Exposure, Outputs, Pose, Rig, png_data_uri

SCENE = "corridor@1+log+0"
# Exact in f32, so that both interfaces get the same bits.
HERE = (3.0, 0.25, 1.5)
FORWARD = (0.5, -0.5, 0.5, -0.5)
AT = 1_700_000_000_000_000


class Stub:
    """Calls the methods that the package's descriptor of the service has."""

    def __init__(self, channel: grpc.Channel) -> None:
        service = sensorsim_pb2.DESCRIPTOR.services_by_name["SensorsimService"]
        for method in service.methods:
            call = channel.unary_unary(
                f"/{service.full_name}/{method.name}",
                request_serializer=GetMessageClass(method.input_type).SerializeToString,
                response_deserializer=GetMessageClass(method.output_type).FromString,
            )
            setattr(self, method.name, call)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"the service has no method {name}")


@dataclass(frozen=True)
class Door:
    url: str
    stub: Any
    process: subprocess.Popen[str]
    channel: grpc.Channel
    folder: Path


def hood() -> str:
    """An overlay for the rear camera: the lower rows are grey."""
    rgba = np.zeros((43, 65, 4), np.uint8)
    rgba[30:] = (90, 90, 90, 255)
    file = io.BytesIO()
    Image.fromarray(rgba).save(file, "png")
    return png_data_uri(file.getvalue())


@pytest.fixture(scope="module")
def door(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Door]:
    binary = os.environ.get("WILDCITY_BIN")
    assert binary, "set WILDCITY_BIN to the built wildcity binary"
    folder = tmp_path_factory.mktemp("alpasim")
    write_rig(folder / "rig.json")
    twins = import_corridor(folder, "--rig", folder / "rig.json")
    subprocess.run([binary, "actor", "generate", *twins], check=True, timeout=120, stdout=subprocess.DEVNULL)
    serving = [binary, "serve", *twins, "--listen", "127.0.0.1:0", "--alpasim", "127.0.0.1:0"]
    serving += ["--episodes", str(folder / "episodes"), "--uploads", str(folder / "uploads")]
    with subprocess.Popen(serving, stdout=subprocess.PIPE, text=True) as process:
        try:
            lines = listening(process)
            options = [("grpc.max_receive_message_length", 64 << 20), ("grpc.enable_http_proxy", 0)]
            with grpc.insecure_channel(lines["AlpaSim: listening on "], options) as channel:
                stub = Stub(channel)
                yield Door(lines["listening on "], stub, process, channel, folder)
        finally:
            process.terminate()
            assert process.wait(timeout=20) == 0, "the server did not stop cleanly"


def listening(process: subprocess.Popen[str]) -> dict[str, str]:
    """What follows each of the two lines that say where the server listens."""
    lines: queue.Queue[str] = queue.Queue()
    stdout = process.stdout
    assert stdout is not None

    def read() -> None:
        # To the end, so that the server never blocks on a full pipe.
        for line in stdout:
            lines.put(line)

    threading.Thread(target=read, daemon=True).start()
    found: dict[str, str] = {}
    while len(found) < 2:
        line = lines.get(timeout=30)
        for start in ("listening on ", "AlpaSim: listening on "):
            if line.startswith(start):
                found[start] = line.removeprefix(start).strip()
    return found


def write_rig(path: Path) -> None:
    front, rear = PAIR.cameras
    looks = Exposure(gain=(0.5, 1.0, 1.5))
    cameras = (front, Camera(**{**vars(rear), "exposure": looks, "overlay": hood()}))
    path.write_text(json.dumps(wildcity.protocol.encode(Rig("pair", cameras))))


def pose(xyz: tuple[float, ...], q: tuple[float, ...] = FORWARD) -> Any:
    w, x, y, z = q
    vec = common_pb2.Vec3(x=xyz[0], y=xyz[1], z=xyz[2])
    return common_pb2.Pose(vec=vec, quat=common_pb2.Quat(w=w, x=x, y=y, z=z))


def pinhole(width: int = 96, height: int = 64, logical_id: str = "camera_front") -> Any:
    lens = sensorsim_pb2.OpenCVPinholeCameraParam(
        principal_point_x=width / 2,
        principal_point_y=height / 2,
        focal_length_x=60.0,
        focal_length_y=60.0,
        radial_coeffs=[0.0] * 6,
        tangential_coeffs=[0.0] * 2,
        thin_prism_coeffs=[0.0] * 4,
    )
    return sensorsim_pb2.CameraSpec(
        opencv_pinhole_param=lens,
        logical_id=logical_id,
        resolution_w=width,
        resolution_h=height,
        shutter_type=sensorsim_pb2.ShutterType.GLOBAL,
    )


def request(**changes: Any) -> Any:
    fields: dict[str, Any] = {
        "scene_id": SCENE,
        "resolution_w": 96,
        "resolution_h": 64,
        "camera_intrinsics": pinhole(),
        "frame_start_us": AT,
        "frame_end_us": AT,
        "sensor_pose": sensorsim_pb2.PosePair(start_pose=pose(HERE), end_pose=pose(HERE)),
        "image_format": sensorsim_pb2.ImageFormat.PNG,
        **changes,
    }
    return sensorsim_pb2.RGBRenderRequest(**fields)


def thing(
    track_id: str,
    xyz: tuple[float, ...] = (12.0, 0.0, 1.0),
    q: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0),
    start: tuple[float, ...] | None = None,
) -> Any:
    """A dynamic object, by the pose of the middle of its box."""
    pair = sensorsim_pb2.PosePair(start_pose=pose(start or xyz, q), end_pose=pose(xyz, q))
    return sensorsim_pb2.DynamicObject(track_id=track_id, pose_pair=pair)


def decoded(image_bytes: bytes) -> Any:
    return np.asarray(Image.open(io.BytesIO(image_bytes)))


def observed(door: Door, camera: Camera, outputs: Outputs | None = None) -> Any:
    """The image that a session's `observe` has of one camera, which is mounted at the origin of the rig."""
    with wildcity.connect(door.url) as client:
        with client.open("corridor", rig=Rig("one", (camera,)), outputs=outputs or Outputs(encoding="raw")) as session:
            return session.observe([Pose(HERE, FORWARD)])


ORIGIN = Pose()


def test_version_scenes_and_trajectories(door: Door) -> None:
    version = door.stub.get_version(common_pb2.Empty())
    assert version.version_id.startswith("wildcity ") and version.git_hash
    api = version.grpc_api_version
    assert (api.major, api.minor, api.patch) == (0, 54, 0)
    assert list(door.stub.get_available_scenes(common_pb2.Empty()).scene_ids) == [SCENE, "*"]
    asked = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id="corridor@1+log+2")
    (found,) = door.stub.get_available_trajectories(asked).available_trajectories
    poses = found.trajectory.poses
    # The drive is 10 m long with a pose every 0.5 m and 0.1 s; the origin is 2 m along it.
    assert [p.timestamp_us for p in poses] == [AT + 100_000 * k for k in range(17)]
    assert [p.pose.vec.x for p in poses] == pytest.approx([0.5 * k for k in range(17)])


def test_cameras_are_those_of_the_twin_and_of_a_preset(door: Door) -> None:
    asked = sensorsim_pb2.AvailableCamerasRequest(scene_id=SCENE)
    cameras = {c.logical_id: c for c in door.stub.get_available_cameras(asked).available_cameras}
    assert list(cameras)[:3] == ["camera_front", "camera_rear", "camera_cross_left_120fov"]
    front = cameras["camera_front"]
    assert front.intrinsics.opencv_pinhole_param.focal_length_x == 60.0
    assert front.intrinsics.shutter_type == sensorsim_pb2.ShutterType.GLOBAL
    assert front.rig_to_camera == pose(PAIR.cameras[0].camera_to_rig.xyz, PAIR.cameras[0].camera_to_rig.q)
    wide = cameras["camera_front_wide_120fov"].intrinsics
    lens = wide.ftheta_param
    assert len(lens.pixeldist_to_angle_poly) == len(lens.angle_to_pixeldist_poly) == 6
    assert len(wide.bivariate_windshield_model_param.vertical_poly) == 15
    # One polynomial is the inverse of the other, which AlpaSim's rectifier relies on.
    angles = np.linspace(0.05, lens.max_angle, 50)
    pixels = np.polynomial.polynomial.polyval(angles, lens.angle_to_pixeldist_poly)
    assert np.polynomial.polynomial.polyval(pixels, lens.pixeldist_to_angle_poly) == pytest.approx(angles, abs=1e-3)


def test_masks_name_the_cameras_with_an_overlay(door: Door) -> None:
    (mask,) = door.stub.get_available_ego_masks(common_pb2.Empty()).ego_mask_metadata
    assert (mask.ego_mask_id.camera_logical_id, mask.ego_mask_id.rig_config_id) == ("camera_rear", "pair")


@pytest.mark.parametrize("size", [(96, 64), (48, 32), (191, 64)])
def test_images_equal_those_of_observe_byte_for_byte(door: Door, size: tuple[int, int]) -> None:
    width, height = size
    camera = Camera("front", 96, 64, 60.0, 60.0, 48.0, 32.0, ORIGIN)
    outputs = Outputs(encoding="png", images={"front": wildcity.ImagePart(size=size)})
    seen = observed(door, camera, outputs)
    got = door.stub.render_rgb(request(resolution_w=width, resolution_h=height)).image_bytes
    assert got == bytes(seen.encoded(seen.metadata.images[0]))
    assert decoded(got).shape == (height, width, 3) and decoded(got).max() > 50


def test_a_lens_with_a_windshield_equals_observe(door: Door) -> None:
    """The f-theta camera that the door lists, mounted at the origin of a rig with the same numbers."""
    asked = sensorsim_pb2.AvailableCamerasRequest(scene_id=SCENE)
    listed = {c.logical_id: c.intrinsics for c in door.stub.get_available_cameras(asked).available_cameras}
    spec = listed["camera_front_wide_120fov"]
    with wildcity.connect(door.url) as client, client.open("corridor", rig="alpamayo2") as session:
        (camera,) = (c for c in session.opened.cameras if c.name == "front_wide_120fov")
    mounted = Camera(**{**vars(camera), "fx": None, "fy": None, "camera_to_rig": ORIGIN})
    size = {"front_wide_120fov": wildcity.ImagePart(size=(192, 108))}
    seen = observed(door, mounted, Outputs(encoding="png", images=size))
    got = door.stub.render_rgb(request(camera_intrinsics=spec, resolution_w=192, resolution_h=108)).image_bytes
    assert got == bytes(seen.encoded(seen.metadata.images[0]))


def test_formats_of_images(door: Door) -> None:
    png = decoded(door.stub.render_rgb(request()).image_bytes)
    planar = request(image_format=sensorsim_pb2.ImageFormat.RGB_UINT8_PLANAR)
    raw = np.frombuffer(door.stub.render_rgb(planar).image_bytes, np.uint8).reshape(3, 64, 96)
    assert np.array_equal(raw.transpose(1, 2, 0), png)
    jpeg = request(image_format=sensorsim_pb2.ImageFormat.JPEG, image_quality=90.0)
    camera = Camera("front", 96, 64, 60.0, 60.0, 48.0, 32.0, ORIGIN)
    seen = observed(door, camera, Outputs(encoding="jpeg", quality=90))
    assert door.stub.render_rgb(jpeg).image_bytes == bytes(seen.encoded(seen.metadata.images[0]))


def test_exposure_and_overlay_are_those_of_the_twins_camera(door: Door) -> None:
    rear = pinhole(65, 43, "camera_rear")
    plain = request(camera_intrinsics=pinhole(65, 43, "camera_other"), resolution_w=65, resolution_h=43)
    exposed = request(camera_intrinsics=rear, resolution_w=65, resolution_h=43)
    masked = request(camera_intrinsics=rear, resolution_w=65, resolution_h=43, insert_ego_mask=True)
    images = [decoded(door.stub.render_rgb(one).image_bytes).astype(int) for one in (plain, exposed, masked)]
    assert np.abs(images[1] - np.clip(images[0] * (0.5, 1.0, 1.5), 0, 255)).max() <= 2
    assert np.array_equal(images[1][:30], images[2][:30])
    assert (images[2][30:] == 90).all() and not (images[1][30:] == 90).all()


def test_a_rolling_shutter_moves_the_camera_within_the_image(door: Door) -> None:
    spec = pinhole()
    spec.shutter_type = sensorsim_pb2.ShutterType.ROLLING_TOP_TO_BOTTOM
    behind = (HERE[0] - 0.5, HERE[1], HERE[2])
    pair = sensorsim_pb2.PosePair(start_pose=pose(behind), end_pose=pose(HERE))
    rolled = decoded(door.stub.render_rgb(request(camera_intrinsics=spec, sensor_pose=pair)).image_bytes)
    # A global shutter takes the pose at the end alone.
    still = decoded(door.stub.render_rgb(request(sensor_pose=pair)).image_bytes)
    assert np.array_equal(still, decoded(door.stub.render_rgb(request()).image_bytes))
    first = sensorsim_pb2.PosePair(start_pose=pose(behind), end_pose=pose(behind))
    before = decoded(door.stub.render_rgb(request(sensor_pose=first)).image_bytes)
    # The first row is exposed at the first pose, the last row at the last.
    difference = [np.abs(rolled[row].astype(int) - other[row]).mean() for row, other in ((1, before), (-2, still))]
    crossed = [np.abs(rolled[row].astype(int) - other[row]).mean() for row, other in ((1, still), (-2, before))]
    assert difference[0] < crossed[0] and difference[1] < crossed[1]


def test_a_batch_answers_camera_by_camera(door: Door) -> None:
    item = sensorsim_pb2.BatchRGBRenderRequestItem
    good = item(camera_name="front", request=request())
    turned = item(
        camera_name="turned", request=request(sensor_pose=sensorsim_pb2.PosePair(end_pose=pose(HERE, (2, 0, 0, 0))))
    )
    empty = item(camera_name="empty", request=request(resolution_w=0))
    late = item(camera_name="late", request=request(frame_start_us=AT + 1))
    answer = door.stub.batch_render_rgb(sensorsim_pb2.BatchRGBRenderRequest(items=[good, turned, empty, late]))
    assert [(i.camera_name, i.success) for i in answer.items] == [
        ("front", True),
        ("turned", False),
        ("empty", False),
        ("late", False),
    ]
    assert answer.items[0].result == door.stub.render_rgb(request())
    messages = [i.error_message for i in answer.items[1:]]
    for message, text in zip(messages, ["unit quaternion", "width is 0", "frame_start_us"], strict=True):
        assert message.startswith("INVALID_ARGUMENT: ") and text in message
    # More views than one frame has.
    many = [item(camera_name=f"c{k}", request=request(resolution_w=16, resolution_h=8)) for k in range(20)]
    answer = door.stub.batch_render_rgb(sensorsim_pb2.BatchRGBRenderRequest(items=many))
    assert len({i.result.image_bytes for i in answer.items}) == 1 and len(answer.items) == 20


def test_aggregated_requests_and_loaded_scenes(door: Door) -> None:
    asked = sensorsim_pb2.AggregatedRenderRequest(rgb_requests=[request(), request(scene_id="corridor@1+log+2")])
    answer = door.stub.render_aggregated(asked)
    assert answer.rgb_returns[0] == door.stub.render_rgb(request())
    # The same local pose in a scene with another origin is another place.
    assert answer.rgb_returns[1] != answer.rgb_returns[0]
    loaded = door.stub.get_loaded_scenes(common_pb2.Empty())
    assert loaded.loaded_instance_capacity == 16
    assert {entry.scene_id for entry in loaded.scenes} >= {SCENE, "corridor@1+log+2"}
    assert all(entry.loaded_instance_count == 1 for entry in loaded.scenes)


@pytest.mark.parametrize(
    ("changes", "code", "text"),
    [
        ({"scene_id": "nowhere@1+log+0"}, "NOT_FOUND", "nowhere"),
        ({"scene_id": "corridor@9+log+0"}, "NOT_FOUND", "9"),
        ({"scene_id": "corridor@1+other+0"}, "NOT_FOUND", "other"),
        ({"scene_id": "corridor@1+log+11"}, "NOT_FOUND", "11 m"),
        ({"scene_id": "corridor"}, "NOT_FOUND", "TWIN@VERSION"),
        ({"camera_intrinsics": None}, "INVALID_ARGUMENT", "camera_intrinsics"),
        ({"sensor_pose": None}, "INVALID_ARGUMENT", "sensor_pose"),
        ({"sensor_pose": sensorsim_pb2.PosePair(end_pose=pose((float("nan"), 0, 0)))}, "INVALID_ARGUMENT", "finite"),
        ({"resolution_h": 100_000}, "INVALID_ARGUMENT", "height"),
        ({"image_format": sensorsim_pb2.ImageFormat.AV1}, "INVALID_ARGUMENT", "image_format"),
        ({"dynamic_objects": [thing("7@nothing")]}, "INVALID_ARGUMENT", "nothing"),
        ({"dynamic_objects": [thing("7@4x2x0")]}, "INVALID_ARGUMENT", "height_m is 0.0"),
        ({"dynamic_objects": [thing("7@4x2x1#red")]}, "INVALID_ARGUMENT", "6 hex digits"),
        (
            {"dynamic_objects": [sensorsim_pb2.DynamicObject(track_id="7@4x2x1")]},
            "INVALID_ARGUMENT",
            "pose_pair is missing",
        ),
        ({"dynamic_objects": [thing("7", (float("inf"), 0, 0))]}, "INVALID_ARGUMENT", "finite"),
        ({"dynamic_objects": [thing("7")] * 257}, "INVALID_ARGUMENT", "257 dynamic_objects; at most 256"),
    ],
)
def test_errors_have_the_codes_that_the_runtime_knows(
    door: Door, changes: dict[str, Any], code: str, text: str
) -> None:
    with pytest.raises(grpc.RpcError) as refused:
        door.stub.render_rgb(request(**changes))
    assert (refused.value.code().name, text in refused.value.details()) == (code, True), refused.value.details()


def sweep(**changes: Any) -> Any:
    here = common_pb2.Pose(vec=common_pb2.Vec3(x=3.0, y=0.25, z=1.9), quat=common_pb2.Quat(w=1.0))
    asked = {
        "scene_id": SCENE,
        "lidar_config": sensorsim_pb2.LidarSpec(lidar_type=sensorsim_pb2.AT128),
        "frame_start_us": AT - 100_000,
        "frame_end_us": AT,
        "sensor_pose": sensorsim_pb2.PosePair(start_pose=here, end_pose=here),
    }
    return sensorsim_pb2.LidarRenderRequest(**(asked | changes))


def test_lidars_are_rendered_as_points(door: Door) -> None:
    answer = door.stub.render_lidar(sweep())
    points = np.array(answer.point_xyzs, np.float32).reshape(-1, 3)
    assert len(points) == answer.num_points == len(answer.point_intensities) > 1_000
    assert np.array_equal(np.frombuffer(answer.point_xyzs_buffer, "<f4").reshape(-1, 3), points)
    assert np.array_equal(np.frombuffer(answer.point_intensities_buffer, "<f4"), answer.point_intensities)
    # AT128 sees 60 degrees to both sides, from 12.93 degrees above to 12.47 below.
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    assert np.abs(azimuth).max() < 60.01 and elevation.max() < 12.94 and elevation.min() > -12.48
    # The same points at the end of a sweep in which the LiDAR has moved 2 m: they are deskewed.
    start = common_pb2.Pose(vec=common_pb2.Vec3(x=1.0, y=0.25, z=1.9), quat=common_pb2.Quat(w=1.0))
    end = common_pb2.Pose(vec=common_pb2.Vec3(x=3.0, y=0.25, z=1.9), quat=common_pb2.Quat(w=1.0))
    moving = door.stub.render_lidar(sweep(sensor_pose=sensorsim_pb2.PosePair(start_pose=start, end_pose=end)))
    moved = np.array(moving.point_xyzs, np.float32).reshape(-1, 3)
    for axis in (1, 2):
        low, high = np.percentile(points[:, axis], [2, 98]), np.percentile(moved[:, axis], [2, 98])
        assert np.abs(low - high).max() < 0.3, (axis, low, high)
    pair = door.stub.render_aggregated(
        sensorsim_pb2.AggregatedRenderRequest(rgb_requests=[request()], lidar_requests=[sweep()])
    )
    assert len(pair.rgb_returns) == 1 and pair.lidar_returns[0] == answer


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"lidar_config": None}, "lidar_config: is missing"),
        ({"sensor_pose": None}, "sensor_pose"),
        ({"frame_start_us": AT + 1}, "is after frame_end_us"),
        ({"frame_start_us": AT - 2_000_000}, "duration_us"),
    ],
)
def test_lidars_that_cannot_be_rendered_are_refused(door: Door, changes: dict[str, Any], text: str) -> None:
    with pytest.raises(grpc.RpcError) as refused:
        door.stub.render_lidar(sweep(**changes))
    assert refused.value.code() == grpc.StatusCode.INVALID_ARGUMENT, refused.value.details()
    assert text in refused.value.details(), refused.value.details()


def test_what_concerns_all_images_fails_the_batch(door: Door) -> None:
    """The runtime stops, or tries again, by the code of the whole answer."""
    item = sensorsim_pb2.BatchRGBRenderRequestItem
    good = item(camera_name="front", request=request())
    lost = item(camera_name="lost", request=request(scene_id="corridor@9+log+0"))
    for items, code, text in (
        ([good, lost], "NOT_FOUND", "9"),
        ([good, item(camera_name="none")], "INVALID_ARGUMENT", "request is missing"),
        ([good] * 257, "INVALID_ARGUMENT", "257 images; at most 256"),
    ):
        with pytest.raises(grpc.RpcError) as refused:
            door.stub.batch_render_rgb(sensorsim_pb2.BatchRGBRenderRequest(items=items))
        assert (refused.value.code().name, text in refused.value.details()) == (code, True), refused.value.details()


def test_a_public_address_needs_consent() -> None:
    binary = os.environ["WILDCITY_BIN"]
    serving = [binary, "serve", "--listen", "127.0.0.1:0", "--alpasim", "0.0.0.0:0"]
    done = subprocess.run(serving, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "--alpasim-open" in done.stderr, done.stderr
    with subprocess.Popen(
        [*serving, "--alpasim-open"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        try:
            assert listening(process)["AlpaSim: listening on "].startswith("0.0.0.0:")
        finally:
            process.terminate()


def test_a_server_that_stops_answers_unavailable(tmp_path: Path) -> None:
    """AlpaSim's runtime tries again after this status."""
    binary = os.environ["WILDCITY_BIN"]
    twins = import_corridor(tmp_path)
    serving = [binary, "serve", *twins, "--listen", "127.0.0.1:0", "--alpasim", "127.0.0.1:0", "--backend", "reference"]
    serving += ["--episodes", str(tmp_path / "e"), "--uploads", str(tmp_path / "u")]
    with subprocess.Popen(serving, stdout=subprocess.PIPE, text=True) as process:
        try:
            address = listening(process)["AlpaSim: listening on "]
            with grpc.insecure_channel(address, [("grpc.enable_retries", 0)]) as channel:
                stub = Stub(channel)
                # The reference backend takes seconds for it.
                running = stub.render_rgb.future(request(resolution_w=1920, resolution_h=1440))
                time.sleep(0.5)
                process.terminate()
                assert running.exception(timeout=20).code() == grpc.StatusCode.UNAVAILABLE
            assert process.wait(timeout=20) == 0
        finally:
            process.terminate()


def test_too_little_memory_is_a_backend_that_was_waited_for(door: Door) -> None:
    """AlpaSim's runtime tries again after this text."""
    binary = os.environ["WILDCITY_BIN"]
    serving = [binary, "serve", "--twins", str(door.folder / "twins"), "--memory-gib", "0.001"]
    serving += ["--listen", "127.0.0.1:0", "--alpasim", "127.0.0.1:0"]
    serving += ["--episodes", str(door.folder / "e"), "--uploads", str(door.folder / "u")]
    with subprocess.Popen(serving, stdout=subprocess.PIPE, text=True) as process:
        try:
            address = listening(process)["AlpaSim: listening on "]
            with grpc.insecure_channel(address, [("grpc.enable_retries", 0)]) as channel:
                with pytest.raises(grpc.RpcError) as refused:
                    Stub(channel).render_rgb(request())
        finally:
            process.terminate()
    assert refused.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED
    assert refused.value.details().startswith("Stopped waiting for backend"), refused.value.details()
