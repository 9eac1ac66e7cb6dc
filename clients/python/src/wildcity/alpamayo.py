"""Inputs of NVIDIA's Alpamayo models from an observation, and their answer as a trajectory.

    with client.open("city", dynamics="dynamic", **alpamayo.session_options("1.5")) as session:
        seen = session.reset()
        data = alpamayo.inputs(seen, model="1.5")
        pred_xyz, pred_rot = model(alpamayo.as_torch(data))
        seen = session.step(alpamayo.trajectory(pred_xyz, pred_rot))

The dictionaries have the keys, types and shapes of `load_physical_aiavdataset` of Alpamayo 1, 1.5 and 2 Super, but for
the recorded future. The models accept swapped cameras and reversed frames without an error, so `inputs` checks all of
it and names the camera at fault. Needs numpy only; `as_torch` needs PyTorch.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .messages import ImageInfo, ImagePart, Outputs, TimedPose
from .observation import Observation
from .pose import Pose
from .protocol import Trajectory

__all__ = ["CAMERAS", "Model", "as_torch", "cameras", "inputs", "nav_text", "session_options", "trajectory"]

Model = Literal["1", "1.5", "2"]

CAMERAS = {
    "cross_left_120fov": 0,
    "front_wide_120fov": 1,
    "cross_right_120fov": 2,
    "rear_left_70fov": 3,
    "rear_tele_30fov": 4,
    "rear_right_70fov": 5,
    "front_tele_30fov": 6,
}
"""The models' index of each camera, from which they compute camera embeddings (`CAMERA_NAMES_TO_INDICES`)."""

FRAMES = 4
"""Frames of each camera, oldest first, `PERIOD_US` apart."""

PERIOD_US = 100_000
HISTORY_POSES = 16
FUTURE_POSES = 64

WARM_UP_US = (HISTORY_POSES - 1) * PERIOD_US
"""The part of the recorded drive before the start that fills frames and history of the first observation."""

_INDICES: dict[tuple[str, str], tuple[int, ...]] = {
    ("1", "trajectory"): (0, 1, 2, 6),
    ("1.5", "trajectory"): (0, 1, 2, 6),
    ("1.5", "vqa"): (0, 1, 2, 6),
    ("2", "trajectory"): (0, 1, 2, 3, 5, 6),
    ("2", "meta_action"): (0, 1, 2, 3, 5, 6),
    ("2", "auto_labeling"): (0, 1, 2, 3, 5, 6),
    ("2", "grounding"): (0, 1, 2, 3, 5, 6),
    ("2", "vqa"): (0, 1, 2, 3, 4, 5),
}
_NAMES = {index: name for name, index in CAMERAS.items()}


def cameras(model: Model, task: str = "trajectory") -> tuple[str, ...]:
    """Names of the cameras that a model reads for a task, in the order of their index.

    Raises `ValueError` if the model does not have the task.
    """
    if (model, task) not in _INDICES:
        known = ", ".join(f"{m} {t}" for m, t in _INDICES)
        raise ValueError(f"model {model!r} has no task {task!r}; known: {known}")
    return tuple(_NAMES[index] for index in _INDICES[model, task])


def session_options(
    model: Model = "1.5", task: str = "trajectory", *, size: tuple[int, int] | None = None
) -> dict[str, Any]:
    """Arguments of `Client.open` with which every observation, including the first, has the inputs of the model.

    The rig is a preset of the real car's cameras. `size` is the (width, height) to render, in pixels, 1920x1080 if
    None. The models shrink images to about 576x320, and a small image is rendered several times faster.
    """
    names = cameras(model, task)
    images = None if size is None else {name: ImagePart(size=size) for name in names}
    return {
        "rig": "alpamayo2" if model == "2" else "alpamayo1",
        "outputs": Outputs(cameras=names, frames=FRAMES, images=images),
        "dt_us": PERIOD_US,
        "warm_up_us": WARM_UP_US,
    }


def inputs(seen: Observation, model: Model = "1.5", task: str = "trajectory") -> dict[str, Any]:
    """The inputs of a model, as new C-contiguous arrays.

    `image_frames` uint8 (N, 4, 3, H, W), by camera index, oldest first; `camera_indices` int64 (N);
    `ego_history_xyz` float32 (1, 1, 16, 3) and `ego_history_rot` float32 (1, 1, 16, 3, 3), metres in the rig frame
    at t0, 0.1 s apart, the last one the identity; `absolute_timestamps` int64 (N, 4), microseconds of the episode;
    `relative_timestamps` float32 (N, 4), seconds since the earliest frame; `t0_us`, the time of the observation.
    Model 2 has more keys: see `docs/alpamayo.md` of the project.

    Raises `ValueError`, which names the camera, if a camera is missing or in the wrong order, if its frames are not
    those at t0 - 0.3, -0.2, -0.1 and 0 s, if sizes differ, or if fewer than 16 poses were driven.
    """
    names = cameras(model, task)
    t0_us = seen.metadata.time_us
    infos = {name: _checked_frames(seen, name, t0_us) for name in names}
    _check_order(infos)
    _check_sizes(infos)
    driven = seen.ego.history_count
    if driven < HISTORY_POSES:
        raise ValueError(
            f"the ego history has {driven} driven poses at t0 = {t0_us} us, the model reads {HISTORY_POSES}: "
            "open the session with warm_up_us=1_500_000 or more, or drive that long first"
        )
    # [4, H, W, 3] to [4, 3, H, W], copied, because models and DLPack need writable memory without strides.
    frames = [np.ascontiguousarray(seen.frames(name).transpose(0, 3, 1, 2)) for name in names]
    absolute = np.array([[i.shutter_end_us for i in infos[name]] for name in names], np.int64)
    earliest = int(absolute.min())
    data: dict[str, Any] = {
        "image_frames": np.stack(frames),
        "camera_indices": np.array([CAMERAS[name] for name in names], np.int64),
        "ego_history_xyz": seen.history_xyz.astype(np.float32).reshape(1, 1, HISTORY_POSES, 3),
        "ego_history_rot": seen.history_rot.astype(np.float32).reshape(1, 1, HISTORY_POSES, 3, 3),
        "absolute_timestamps": absolute,
        "relative_timestamps": ((absolute - earliest) * 1e-6).astype(np.float32),
        "t0_us": t0_us,
    }
    if model == "2":
        data |= _inputs_of_2(seen, infos, t0_us, earliest)
    return data


def nav_text(seen: Observation) -> str | None:
    """The instruction of the route, for `nav_text` of Alpamayo 1.5's `create_message`.

    It is the text of the route's next command, with the distance in metres; None if the scenario gives none now.
    """
    route = seen.metadata.route
    return None if route is None else route.text


def as_torch(data: Mapping[str, Any]) -> dict[str, Any]:
    """The inputs with every array as a `torch.Tensor` in the same memory (DLPack), on the CPU."""
    torch = importlib.import_module("torch")
    return {key: torch.from_dlpack(value) if isinstance(value, np.ndarray) else value for key, value in data.items()}


def trajectory(pred_xyz: Any, pred_rot: Any, sample: int = 0) -> Trajectory:
    """A model's answer as a trajectory for `Session.step`: 64 poses in the rig frame at t0, 0.1 to 6.4 s later.

    `pred_xyz` is (1, 1, S, 64, 3) in metres, `pred_rot` is (1, 1, S, 64, 3, 3); arrays or tensors on any device.
    Raises `ValueError` if a shape differs, a number is not finite, or a rotation is not one within 1e-3.
    """
    xyz = _as_array(pred_xyz)
    rotations = _as_array(pred_rot)
    samples = xyz.shape[2] if xyz.ndim == 5 else 0
    for name, array, tail in (("pred_xyz", xyz, (3,)), ("pred_rot", rotations, (3, 3))):
        expected = (1, 1, samples, FUTURE_POSES, *tail)
        if samples == 0 or array.shape != expected:
            raise ValueError(f"{name} has shape {array.shape}; expected (1, 1, S, {FUTURE_POSES}, {str(tail)[1:]}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} has numbers that are not finite")
    if not 0 <= sample < samples:
        raise ValueError(f"sample {sample} of {samples}")
    poses = []
    for k in range(FUTURE_POSES):
        rotation = rotations[0, 0, sample, k]
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error > 1e-3 or np.linalg.det(rotation) < 0:
            raise ValueError(f"pred_rot[0, 0, {sample}, {k}] is no rotation: it is {error:.1e} from orthonormal")
        x, y, z = (float(value) for value in xyz[0, 0, sample, k])
        poses.append(TimedPose((k + 1) * PERIOD_US, Pose((x, y, z), _quaternion(rotation))))
    return Trajectory(tuple(poses))


def _checked_frames(seen: Observation, name: str, t0_us: int) -> tuple[ImageInfo, ...]:
    """The four frames of a camera, oldest first, at exactly the times that the model reads."""
    infos = seen.frame_infos(name)
    if not infos:
        present = sorted({image.camera for image in (*seen.metadata.images, *seen.metadata.history)})
        raise ValueError(
            f"camera {name!r} (index {CAMERAS[name]}) has no frame in this observation, "
            f"which has {', '.join(present) or 'no images'}"
        )
    if len(infos) != FRAMES:
        raise ValueError(
            f"camera {name!r} has {len(infos)} frames, the model reads {FRAMES}: open the session with "
            f"outputs=Outputs(frames={FRAMES}) and warm_up_us=1_500_000"
        )
    times = [info.shutter_end_us for info in infos]
    expected = [t0_us - back * PERIOD_US for back in range(FRAMES - 1, -1, -1)]
    if times == expected[::-1]:
        raise ValueError(f"camera {name!r} has its frames reversed: {times} us; expected the oldest first, {expected}")
    if times != expected:
        if times[-1] < t0_us:
            raise ValueError(f"camera {name!r} is stale: its newest frame is of {times[-1]} us, t0 is {t0_us} us")
        raise ValueError(f"camera {name!r} has frames at {times} us; the model reads {expected}")
    return infos


def _check_order(infos: Mapping[str, tuple[ImageInfo, ...]]) -> None:
    """The session's cameras must be in the order of the model's, whichever others lie between."""
    last_name = ""
    last_index = -1
    for name, frames in infos.items():
        indices = {frame.index for frame in frames}
        if len(indices) != 1:
            raise ValueError(f"camera {name!r} has frames of the indices {sorted(indices)}; expected one")
        (index,) = indices
        if index <= last_index:
            raise ValueError(
                f"camera {name!r} has index {index} in this session, camera {last_name!r} has {last_index}; "
                f"the model expects the order {', '.join(infos)}"
            )
        last_name = name
        last_index = index


def _check_sizes(infos: Mapping[str, tuple[ImageInfo, ...]]) -> None:
    first = next(iter(infos))
    expected = (infos[first][0].width, infos[first][0].height)
    for name, frames in infos.items():
        for frame in frames:
            if (frame.width, frame.height) != expected:
                raise ValueError(
                    f"camera {name!r} has a frame of {frame.width}x{frame.height}, camera {first!r} of "
                    f"{expected[0]}x{expected[1]}; the model reads one size: set Outputs(images=...)"
                )


def _inputs_of_2(
    seen: Observation, infos: Mapping[str, tuple[ImageInfo, ...]], t0_us: int, earliest_us: int
) -> dict[str, Any]:
    """The keys that Alpamayo 2 Super's loader adds."""
    pose = seen.ego.pose
    w, x, y, z = pose.q
    newest = {name: frames[-1] for name, frames in infos.items()}
    return {
        "camera_names": [f"camera_{name}" for name in infos],
        "camera_tmin": earliest_us,
        "ego_available": np.array(True),
        "ego_t0": np.array([t0_us], np.int64),
        "ego_t0_relative": np.array([(t0_us - earliest_us) * 1e-6], np.float32),
        "ego_t0_frame_idx": np.array([FRAMES - 1], np.int64),
        "prediction_start_offset": np.zeros(1, np.float32),
        "ego_history_tvals": np.arange(-HISTORY_POSES + 1, 1, dtype=np.float32) * np.float32(0.1),
        "ego_t0_xyz": np.array(pose.xyz, np.float32).reshape(1, 1, 3),
        # The inverse of a unit quaternion is its conjugate.
        "ego_t0_inv_quat": np.array([w, -x, -y, -z], np.float32).reshape(1, 1, 4),
        "camera_calibrations": {
            CAMERAS[name]: {
                "camera_name": f"camera_{name}",
                "camera_model": frame,
                "sensor_pose": frame.camera_to_rig,
            }
            for name, frame in newest.items()
        },
    }


def _as_array(values: Any) -> NDArray[np.float64]:
    if hasattr(values, "detach"):
        # bfloat16 has no numpy type, and a tensor of a GPU has no numpy memory.
        values = values.detach().float().cpu().numpy()
    return np.asarray(values, np.float64)


def _quaternion(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of a rotation matrix: the largest component first, as Shepperd (1978)."""
    trace = float(np.trace(rotation))
    squares = np.array([trace, *np.diag(rotation)])
    largest = int(squares.argmax())
    if largest == 0:
        off = rotation - rotation.T
        q = np.array([1.0 + trace, off[2, 1], off[0, 2], off[1, 0]])
    else:
        i = largest - 1
        j = (i + 1) % 3
        k = (i + 2) % 3
        q = np.zeros(4)
        q[0] = rotation[k, j] - rotation[j, k]
        q[1 + i] = 1.0 + rotation[i, i] - rotation[j, j] - rotation[k, k]
        q[1 + j] = rotation[j, i] + rotation[i, j]
        q[1 + k] = rotation[k, i] + rotation[i, k]
    q /= np.linalg.norm(q)
    # One of the two quaternions of a rotation: the one with w not negative.
    w, x, y, z = (float(value) for value in (q if q[0] >= 0 else -q))
    return (w, x, y, z)
