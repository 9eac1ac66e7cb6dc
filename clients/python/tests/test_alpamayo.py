"""The adapter for Alpamayo: exact inputs, the errors of its checks, and a closed loop with the stand-in model."""

from __future__ import annotations

import importlib
import json
import math
import os
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import wildcity
from test_end_to_end import Server, server
from wildcity import Dynamics, Observation, alpamayo
from wildcity.testing import Alpamayo, ModelInputError

T0_US = 2_000_000
BACK_POSE = {"xyz": [1.0, 2.0, 0.5], "q": [0.8, 0.0, 0.0, 0.6]}
SIZE = (8, 6)
"""Width and height of the images."""

Metadata = dict[str, Any]


def pixel(camera: int, back: int) -> int:
    """A colour that only this frame has."""
    return 10 * camera + back


def observation(
    model: alpamayo.Model,
    change: Callable[[Metadata], None] = lambda _: None,
    sizes: dict[str, tuple[int, int]] | None = None,
) -> Observation:
    """What a session with the model's cameras sees; `change` damages the metadata."""
    names = alpamayo.cameras(model)
    images = []
    history = []
    tensors: dict[str, np.ndarray[Any, Any]] = {
        "ego.history_xyz": np.array([[-0.5 * k, 0, 0] for k in range(15, -1, -1)], "<f4"),
        "ego.history_rot": np.broadcast_to(np.eye(3), (16, 3, 3)).astype("<f4"),
    }
    for index, name in enumerate(names):
        width, height = (sizes or {}).get(name, SIZE)
        for back in range(4):
            tensor = f"camera/{name}/rgb" if back == 0 else f"camera/{name}/history/{back}/rgb"
            value = pixel(alpamayo.CAMERAS[name], back)
            tensors[tensor] = np.full((height, width, 3), value, np.uint8)
            info = {"camera": name, "index": index, "pose": 0, "tensor": tensor, "encoding": "raw", "back": back}
            info |= {"width": width, "height": height, "fx": 4.0, "fy": 4.0, "cx": 4.0, "cy": 3.0}
            info |= {"camera_to_rig": BACK_POSE, "hash": "00" * 32}
            info |= {key: T0_US - 100_000 * back for key in ("shutter_start_us", "shutter_end_us")}
            (history if back else images).append(info)
    hashes = dict.fromkeys(("version_hash", "profile_hash", "frame_hash"), "00" * 32)
    metadata: Metadata = {
        **{"seq": 3, "step": 20, "time_us": T0_US, "session": "s", "seed": 0, "terminated": False},
        **{"twin": "city", "version": 1, "backend": "cpu", "images": images, "history": history, **hashes},
        "ego": {
            **{"pose": BACK_POSE, "velocity": [5.0, 0.0, 0.0], "acceleration": [0.0, 0.0, 0.0]},
            **{"yaw_rate": 0.0, "history_count": 16},
        },
        "timings": {"queue_ms": 0.0, "render_ms": 0.0, "encode_ms": 0.0, "stages_ms": []},
        "residency": {"held_bytes": 0, "limit_bytes": 0, "waited_for": 0, "waited_us": 0},
    }
    change(metadata)
    return Observation(safetensors(metadata, tensors))


def safetensors(metadata: Metadata, tensors: dict[str, np.ndarray[Any, Any]]) -> bytes:
    header: dict[str, Any] = {"__metadata__": {"observation": json.dumps(metadata)}}
    data = b""
    for name, array in tensors.items():
        dtype = "U8" if array.dtype == np.uint8 else "F32"
        header[name] = {"dtype": dtype, "shape": array.shape, "data_offsets": [len(data), len(data) + array.nbytes]}
        data += array.tobytes()
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def entries(metadata: Metadata, camera: str) -> list[dict[str, Any]]:
    """The four frames of a camera, oldest first."""
    every = [*metadata["images"], *metadata["history"]]
    return sorted((e for e in every if e["camera"] == camera), key=lambda entry: -entry["back"])


@pytest.mark.parametrize(("model", "indices"), [("1", [0, 1, 2, 6]), ("1.5", [0, 1, 2, 6]), ("2", [0, 1, 2, 3, 5, 6])])
def test_inputs_have_the_types_shapes_and_order_of_the_loaders(model: alpamayo.Model, indices: list[int]) -> None:
    data = alpamayo.inputs(observation(model), model)
    count = len(indices)
    frames = data["image_frames"]
    assert (frames.dtype, frames.shape) == (np.uint8, (count, 4, 3, SIZE[1], SIZE[0]))
    for position, index in enumerate(indices):
        assert [int(frame[0, 0, 0]) for frame in frames[position]] == [pixel(index, back) for back in (3, 2, 1, 0)]
    assert (data["camera_indices"].dtype, data["camera_indices"].tolist()) == (np.int64, indices)
    assert (data["ego_history_xyz"].dtype, data["ego_history_xyz"].shape) == (np.float32, (1, 1, 16, 3))
    assert data["ego_history_xyz"][0, 0, 0].tolist() == [-7.5, 0.0, 0.0]
    assert (data["ego_history_rot"].dtype, data["ego_history_rot"].shape) == (np.float32, (1, 1, 16, 3, 3))
    assert data["absolute_timestamps"].tolist() == [[1_700_000, 1_800_000, 1_900_000, 2_000_000]] * count
    assert data["relative_timestamps"].dtype == np.float32
    assert data["relative_timestamps"] == pytest.approx(np.tile([0.0, 0.1, 0.2, 0.3], (count, 1)), abs=1e-7)
    assert data["t0_us"] == T0_US
    for key, array in data.items():
        if isinstance(array, np.ndarray):
            # DLPack refuses read-only memory.
            assert array.flags.c_contiguous and array.flags.writeable, key


def test_model_2_has_the_keys_that_its_loader_adds() -> None:
    data = alpamayo.inputs(observation("2"), "2")
    assert data["camera_names"][0] == "camera_cross_left_120fov"
    assert (data["camera_tmin"], data["ego_t0"].tolist()) == (1_700_000, [T0_US])
    assert data["ego_t0_relative"] == pytest.approx([0.3])
    assert (data["ego_t0_frame_idx"].tolist(), data["prediction_start_offset"].tolist()) == ([3], [0.0])
    assert data["ego_history_tvals"] == pytest.approx(np.arange(-15, 1) * 0.1)
    assert data["ego_t0_xyz"].tolist() == [[[1.0, 2.0, 0.5]]]
    assert data["ego_t0_inv_quat"] == pytest.approx(np.array([[[0.8, 0.0, 0.0, -0.6]]]))
    assert list(data["camera_calibrations"]) == [0, 1, 2, 3, 5, 6]
    with pytest.raises(ValueError, match="rear_tele_30fov.*has no frame"):
        alpamayo.inputs(observation("2"), "2", "vqa")
    with pytest.raises(ValueError, match="no task 'captioning'"):
        alpamayo.inputs(observation("2"), "2", "captioning")


def swap_cameras(metadata: Metadata) -> None:
    for camera, index in (("cross_left_120fov", 2), ("cross_right_120fov", 0)):
        for entry in entries(metadata, camera):
            entry["index"] = index


def reverse_frames(metadata: Metadata) -> None:
    frames = entries(metadata, "front_tele_30fov")
    times = [frame["shutter_end_us"] for frame in frames]
    for frame, time_us in zip(frames, reversed(times), strict=True):
        frame["shutter_end_us"] = time_us


def make_stale(metadata: Metadata) -> None:
    for frame in entries(metadata, "front_wide_120fov"):
        frame["shutter_end_us"] -= 100_000


def skip_a_frame(metadata: Metadata) -> None:
    entries(metadata, "front_wide_120fov")[0]["shutter_end_us"] -= 100_000


def drop_a_frame(metadata: Metadata) -> None:
    oldest = entries(metadata, "cross_right_120fov")[0]
    metadata["history"].remove(oldest)


def rename_a_camera(metadata: Metadata) -> None:
    for entry in entries(metadata, "cross_right_120fov"):
        entry["camera"] = "right"


def shorten_history(metadata: Metadata) -> None:
    metadata["ego"]["history_count"] = 15


def mix_indices(metadata: Metadata) -> None:
    entries(metadata, "cross_right_120fov")[0]["index"] = 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (swap_cameras, "'front_wide_120fov' has index 1 .* camera 'cross_left_120fov' has 2; .* order cross_left"),
        (reverse_frames, "'front_tele_30fov' has its frames reversed"),
        (make_stale, "'front_wide_120fov' is stale: its newest frame is of 1900000 us, t0 is 2000000"),
        (skip_a_frame, "'front_wide_120fov' has frames at .1600000, 1800000"),
        (drop_a_frame, "'cross_right_120fov' has 3 frames"),
        (rename_a_camera, r"'cross_right_120fov' \(index 2\) has no frame .* right"),
        (shorten_history, "15 driven poses at t0 = 2000000 us"),
        (mix_indices, "'cross_right_120fov' has frames of the indices"),
    ],
)
def test_what_the_models_would_misread_is_refused_by_name(change: Callable[[Metadata], None], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        alpamayo.inputs(observation("1.5", change), "1.5")


def test_images_of_different_sizes_are_refused() -> None:
    seen = observation("1.5", sizes={"front_tele_30fov": (6, 8)})
    with pytest.raises(ValueError, match="'front_tele_30fov' has a frame of 6x8, camera 'cross_left_120fov' of 8x6"):
        alpamayo.inputs(seen, "1.5")


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("camera_indices", lambda a: a[::-1].copy(), "in the order"),
        ("camera_indices", lambda a: np.array([0, 1, 2, 3]), "expected .0, 1, 2, 6"),
        ("image_frames", lambda a: a[:, :3], "image_frames has shape"),
        ("image_frames", lambda a: a.astype(np.float32), "image_frames is float32"),
        ("absolute_timestamps", lambda a: a[:, ::-1].copy(), "camera 0 do not rise"),
        ("absolute_timestamps", lambda a: a - 100_000, "camera 0 is stale"),
        ("absolute_timestamps", lambda a: a + 1, "after t0"),
        ("ego_history_xyz", lambda a: a + 1.0, "not the identity"),
        ("ego_history_xyz", lambda a: a[:, :, 1:], "ego_history_xyz has shape"),
    ],
)
def test_the_stand_in_refuses_what_the_published_drivers_refuse(
    key: str, change: Callable[[Any], Any], message: str
) -> None:
    data = alpamayo.inputs(observation("1.5"), "1.5")
    Alpamayo("1.5")(data)
    with pytest.raises(ModelInputError, match=message):
        Alpamayo("1.5")({**data, key: change(data[key])})


def test_a_route_has_twenty_waypoints() -> None:
    data = alpamayo.inputs(observation("1.5"), "1.5")
    Alpamayo()(data, route=np.zeros((20, 3)))
    with pytest.raises(ModelInputError, match="19 waypoints"):
        Alpamayo()(data, route=np.zeros((19, 3)))


def test_the_text_of_the_route_is_the_instruction_of_model_1_5() -> None:
    def with_text(text: str | None) -> Callable[[Metadata], None]:
        route = {"points": [[0, 0, 0]], "command": "left", "station_m": 0.0, "off_m": 0.0, "length_m": 9.0}
        return lambda metadata: metadata.update(route=route if text is None else {**route, "text": text})

    assert alpamayo.nav_text(observation("1.5")) is None
    assert alpamayo.nav_text(observation("1.5", with_text(None))) is None
    seen = observation("1.5", with_text("Turn left in 40m"))
    said = alpamayo.nav_text(seen)
    assert said == "Turn left in 40m"
    data = alpamayo.inputs(seen, "1.5")
    Alpamayo("1.5")(data, nav_text=said)
    with pytest.raises(ModelInputError, match="nav_text"):
        Alpamayo("1.5")(data, nav_text="<|route_end|>")
    with pytest.raises(ModelInputError, match="model 1.5 takes one"):
        Alpamayo("1")(alpamayo.inputs(seen, "1"), nav_text=said)


def test_an_answer_becomes_the_trajectory_of_the_same_arc() -> None:
    pred_xyz, pred_rot = Alpamayo(speed=8.0, curvature=0.05, samples=2)(alpamayo.inputs(observation("1.5")))
    assert (pred_xyz.shape, pred_rot.shape) == ((1, 1, 2, 64, 3), (1, 1, 2, 64, 3, 3))
    planned = alpamayo.trajectory(pred_xyz, pred_rot, sample=1)
    assert [pose.time_us for pose in planned.poses] == [100_000 * k for k in range(1, 65)]
    for k, timed in enumerate(planned.poses, start=1):
        heading = 8.0 * 0.1 * k * 0.05
        # On a circle of radius 20 m that touches the x axis.
        assert timed.pose.xyz == pytest.approx((20 * math.sin(heading), 20 * (1 - math.cos(heading)), 0.0), abs=1e-4)
        assert timed.pose.q == pytest.approx((math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)), abs=1e-6)


def test_every_rotation_becomes_its_quaternion() -> None:
    numbers = np.random.default_rng(1)
    quaternions = numbers.normal(size=(64, 4))
    # Half turns and nearly half turns, where the formula by the trace alone divides by zero.
    quaternions[:6] = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1e-9, 1, 1, 0], [0, 0, 1, 1], [1, 0, 0, 0]]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotations = np.array(rows).transpose(2, 0, 1)
    planned = alpamayo.trajectory(np.zeros((1, 1, 1, 64, 3)), rotations[None, None, None])
    for timed, q in zip(planned.poses, quaternions, strict=True):
        assert abs(np.dot(timed.pose.q, q)) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda xyz, rot: (xyz[:, :, :, :63], rot), "pred_xyz has shape"),
        (lambda xyz, rot: (xyz, rot[..., 0]), "pred_rot has shape"),
        (lambda xyz, rot: (xyz * math.nan, rot), "pred_xyz has numbers that are not finite"),
        (lambda xyz, rot: (xyz, rot * 1.01), "no rotation"),
        (lambda xyz, rot: (xyz, rot * [1, 1, -1]), "no rotation"),
    ],
)
def test_an_answer_that_is_no_trajectory_is_refused(change: Callable[[Any, Any], Any], message: str) -> None:
    answer = Alpamayo()(alpamayo.inputs(observation("1.5")))
    with pytest.raises(ValueError, match=message):
        alpamayo.trajectory(*change(*answer))


def test_as_torch_shares_the_memory() -> None:
    torch = pytest.importorskip("torch", reason="PyTorch is optional: pip install torch")
    data = alpamayo.inputs(observation("2"), "2")
    tensors = alpamayo.as_torch(data)
    assert tensors["image_frames"].dtype == torch.uint8
    assert tensors["image_frames"].data_ptr() == data["image_frames"].ctypes.data
    planned = alpamayo.trajectory(*(torch.from_numpy(a).bfloat16() for a in Alpamayo("2")(data)))
    assert len(planned.poses) == 64


def test_alpamayos_own_code_takes_the_dictionary() -> None:
    """`create_message` of a checkout of Alpamayo 1.5 numbers the frames and names the cameras in order."""
    checkout = os.environ.get("WILDCITY_ALPAMAYO")
    if checkout is None:
        pytest.skip("WILDCITY_ALPAMAYO names no checkout of github.com/NVlabs/alpamayo1.5")
    pytest.importorskip("torch", reason="PyTorch is optional: pip install torch")
    sys.path.insert(0, str(Path(checkout) / "src"))
    helper = importlib.import_module("alpamayo1_5.helper")
    data = alpamayo.as_torch(alpamayo.inputs(observation("1.5"), "1.5"))
    frames = data["image_frames"].flatten(0, 1)
    _, user, _ = helper.create_message(frames, data["camera_indices"], nav_text="Turn left in 40m")
    assert "Turn left in 40m" in user["content"][-1]["text"]
    texts = [part["text"].strip() for part in user["content"][:-1] if part["type"] == "text"]
    images = [part["image"] for part in user["content"] if part["type"] == "image"]
    frames = ["frame 0", "frame 1", "frame 2", "frame 3"]
    names = ["Front left camera:", "Front camera:", "Front right camera:", "Front telephoto camera:"]
    assert texts == [text for name in names for text in (name, *frames)]
    expected = [pixel(index, back) for index in (0, 1, 2, 6) for back in (3, 2, 1, 0)]
    assert [int(image[0, 0, 0]) for image in images] == expected


@pytest.mark.parametrize("model", ["1.5", "2"])
def test_a_stand_in_drives_in_the_server(model: alpamayo.Model, server: Server) -> None:
    options = alpamayo.session_options(model, size=(64, 36))
    driver = Alpamayo(model, speed=5.0)
    with wildcity.connect(server.url) as client:
        with client.open("corridor", dynamics=Dynamics("dynamic", speed=5.0), **options) as session:
            seen = session.reset()
            start = seen.ego.pose.xyz
            for _ in range(3):
                seen = session.step(alpamayo.trajectory(*driver(alpamayo.inputs(seen, model))))
    assert driver.calls == 3
    assert seen.ego.pose.xyz[0] == pytest.approx(start[0] + 1.5, abs=0.02)
