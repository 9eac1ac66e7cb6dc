"""The messages of the protocol as dataclasses, and their conversion to and from JSON.

The names of the fields are those of the protocol; `protocol/README.md` explains all of them.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import json
import math
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NoReturn, TypeVar

from .errors import Code, ProtocolError

PROTOCOL = "wildcity.v1"
"""The WebSocket subprotocol."""

OBSERVATION_BYTES = 3 << 29
"""Largest message that is accepted from a server, in bytes."""

Encoding = Literal["jpeg", "png", "raw"]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
T = TypeVar("T")


@dataclass(frozen=True)
class Pose:
    """A rigid transform: position in metres, unit quaternion (w, x, y, z)."""

    xyz: Vector = (0.0, 0.0, 0.0)
    q: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        # Accepts lists and arrays, and stores tuples of floats.
        for name, count in (("xyz", 3), ("q", 4)):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != count:
                raise ValueError(f"{name} has {len(values)} numbers; a pose needs {count}")
            for index, value in enumerate(values):
                if not math.isfinite(value):
                    raise ValueError(f"{name}[{index}] is {value}; a pose needs finite numbers")
            object.__setattr__(self, name, values)


@dataclass(frozen=True)
class TimedPose:
    """A pose of a planned trajectory, `time_us` after the start of the step, in the rig frame at that start."""

    time_us: int
    pose: Pose


@dataclass(frozen=True)
class Trajectory:
    """Planned poses of the ego: 1 to 64 in order of time, up to the end of the step or later."""

    poses: tuple[TimedPose, ...]


@dataclass(frozen=True)
class Action:
    """Longitudinal acceleration (m/s²) and curvature of the path (1/m, positive to the left) during one step."""

    acceleration: float
    curvature: float


@dataclass(frozen=True)
class Step:
    """A step of one of several sessions: see `Session.step` for the fields."""

    movement: Pose | Trajectory | Action
    until_us: int | None = None
    notes: Any = None
    terminate: bool = False


Model = Literal["teleport", "kinematic", "dynamic"]
ContactMode = Literal["end", "report", "off"]


@dataclass(frozen=True)
class Dynamics:
    """How the ego moves: its motion model, its speed (m/s) at the start, and whether it can drive backwards."""

    model: Model
    speed: float = 0.0
    reverse: bool = False


@dataclass(frozen=True)
class Station:
    """A start along a recorded trajectory, `station_m` metres from the trajectory's start."""

    trajectory: str
    station_m: float = 0.0


@dataclass(frozen=True)
class RandomStart:
    """A random start along a recorded drive, sampled uniformly for each episode from its seed.

    `trajectory` is the first one if None, `from_m` and `to_m` its ends (or where a warm-up ends). `lateral_m` is
    the largest distance to the left or right of the drive, `heading_rad` the largest angle to it.
    """

    trajectory: str | None = None
    from_m: float | None = None
    to_m: float | None = None
    lateral_m: float | None = None
    heading_rad: float | None = None


@dataclass(frozen=True)
class DriveSection:
    """A part of a recorded drive: from `from_m` (0) to `to_m` (its end), with a pose every `every_m` metres.

    Without `every_m` the poses are the recorded keyframes.
    """

    name: str
    from_m: float | None = None
    to_m: float | None = None
    every_m: float | None = None


@dataclass(frozen=True)
class DrivePose:
    """A pose of a recorded drive (`world_from_rig`), its distance from the start and its time on the drive's clock."""

    station_m: float
    time_us: int
    pose: Pose


@dataclass(frozen=True)
class Drive:
    """Poses of a recorded drive, in driving order; `length_m` is that of the whole drive."""

    name: str
    version: int
    version_hash: str
    length_m: float
    poses: tuple[DrivePose, ...]


@dataclass(frozen=True)
class SnapshotPoint:
    """A snapshot of a session that still exists, on any connection with the same token."""

    session: str
    snapshot: str


@dataclass(frozen=True)
class RecordedPoint:
    """A step of an episode that the server has recorded; `episode` is the name of its file, without `.jsonl`."""

    episode: str
    step: int


@dataclass(frozen=True)
class Lens:
    """A lens model other than the pinhole. Each model has its own fields; the others are None.

    `opencv`: k (6), p (2), s (4). `fisheye`: k (4), and optionally max_angle. `ftheta`: reference, polynomial
    (6), linear_cde (3), max_angle. `max_angle` is in radians off the axis.
    """

    model: Literal["opencv", "fisheye", "ftheta"]
    k: tuple[float, ...] | None = None
    p: tuple[float, ...] | None = None
    s: tuple[float, ...] | None = None
    reference: Literal["angle_to_pixel", "pixel_to_angle"] | None = None
    polynomial: tuple[float, ...] | None = None
    linear_cde: tuple[float, ...] | None = None
    max_angle: float | None = None


@dataclass(frozen=True)
class Windshield:
    """A windshield, which refracts rays in front of the lens: polynomials of the angles to the right and downwards."""

    reference: Literal["forward", "backward"]
    horizontal: tuple[float, ...]
    vertical: tuple[float, ...]


@dataclass(frozen=True)
class Shutter:
    """A rolling shutter, which exposes rows, or columns, one after the other."""

    direction: Literal["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"]
    duration_us: int


@dataclass(frozen=True)
class Exposure:
    """Colour correction of a camera: matrix @ rgb + offset, or gain * rgb + offset."""

    matrix: tuple[tuple[float, ...], ...] | None = None
    gain: tuple[float, float, float] | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


def png_data_uri(png: bytes) -> str:
    """The bytes of a PNG file as a data URI, for `Camera.overlay`."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


@dataclass(frozen=True)
class Camera:
    """A camera on the vehicle: a pinhole unless it has a lens. Sizes and intrinsics are in pixels.

    `camera_to_rig` transforms camera coordinates (x right, y down, z forward) to the rig frame. The polynomial of
    an f-theta lens determines its focal lengths: leave fx and fy None there. `overlay` is the part of the ego
    vehicle that the camera sees: `png_data_uri(bytes)` of a PNG with alpha, of the image's size. Answers omit it.
    `native_size` is the width and height of what the image shows, in pixels of the camera's native size: an image below
    its native size is the native image shrunk. None if the image has native size.
    """

    name: str
    width: int
    height: int
    fx: float | None
    fy: float | None
    cx: float
    cy: float
    camera_to_rig: Pose
    lens: Lens | None = None
    windshield: Windshield | None = None
    shutter: Shutter | None = None
    exposure: Exposure | None = None
    overlay: str | None = None
    native_size: tuple[float, float] | None = None


@dataclass(frozen=True)
class Rig:
    """The cameras of a vehicle, in the order of the images in observations."""

    name: str
    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class ImagePart:
    """Crop (left, top, width, height) and size (width, height) of a camera's image, in pixels."""

    crop: tuple[int, int, int, int] | None = None
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Outputs:
    """What each observation holds: the cameras (all if None), their encoding, and additional tensors.

    `images` has crops and sizes that differ from the rig's, by camera name. `frames` is how many of the newest
    frames of each camera an observation has, 1 if None. `period_us` is the time between two frames of a camera, by
    name, for cameras that do not take one with every step. `trust` adds a confidence to each image. `actors` adds
    the poses of the scenario's actors. `instances` adds the owner of the Gaussian that each pixel shows.
    """

    cameras: tuple[str, ...] | None = None
    encoding: Encoding = "jpeg"
    quality: int | None = None
    depth: bool = False
    opacity: bool = False
    normals: bool | None = None
    instances: bool | None = None
    images: dict[str, ImagePart] | None = None
    frames: int | None = None
    trust: bool | None = None
    actors: bool | None = None
    period_us: dict[str, int] | None = None


@dataclass(frozen=True)
class Repair:
    """Which images a model of the server repairs. Fields that are None have the server's default.

    Repair of a camera begins when its trust falls below `below`, and ends when it rises above `above`. Images with a
    trust below `at_least` are not repaired. At most `per_step` images of one pose are repaired: those with the lowest
    trust. If the model fails, the image is delivered as rendered with the status `failed`, or with `on_failure="error"`
    the request is refused as `repair_failed`.
    """

    model: str
    below: float | None = None
    above: float | None = None
    at_least: float | None = None
    per_step: int | None = None
    on_failure: Literal["unrepaired", "error"] | None = None


@dataclass(frozen=True)
class LateFrames:
    """Frames that arrive `by_us` late with the probability `chance`. `by_us` is a whole number of the camera's
    frames."""

    chance: float
    by_us: int


@dataclass(frozen=True)
class FrozenFrames:
    """Intervals of `for_us` in which the picture stands still with the probability `chance`."""

    chance: float
    for_us: int


@dataclass(frozen=True)
class ImageNoise:
    """Shot and read noise in linear light: `full_well` electrons at white, standard deviation `read` in electrons."""

    full_well: float
    read: float


@dataclass(frozen=True)
class ExposureDrift:
    """An exposure that drifts with the standard deviation `stops`; a new value is sampled every `period_us`."""

    stops: float
    period_us: int


@dataclass(frozen=True)
class LensDirt:
    """Dark, round spots on the lens. `radius` is a fraction of the width, `opacity` of the light that is absorbed."""

    spots: int
    radius: float
    opacity: float


@dataclass(frozen=True)
class CameraSensor:
    """Effects on a camera's images. Those that are None are off. `drop` is the probability that a frame is lost."""

    drop: float | None = None
    late: LateFrames | None = None
    freeze: FrozenFrames | None = None
    noise: ImageNoise | None = None
    exposure: ExposureDrift | None = None
    dirt: LensDirt | None = None


@dataclass(frozen=True)
class AxisNoise:
    """Standard deviations of a sample's noise and of the bias of an axis."""

    noise: float = 0.0
    bias: float = 0.0


@dataclass(frozen=True)
class Imu:
    """An inertial measurement unit: m/s² and rad/s. Errors that are None are off."""

    accelerometer: AxisNoise | None = None
    gyroscope: AxisNoise | None = None
    bias_period_us: int | None = None


@dataclass(frozen=True)
class WheelSpeed:
    """The speed that the wheels measure: `noise` in m/s, and `scale`, the standard deviation of its scale error."""

    noise: float = 0.0
    scale: float = 0.0


@dataclass(frozen=True)
class Sensors:
    """Sensor effects, sampled from the episode's seed, and the delay after which a decision takes effect.

    `cameras` has effects by the camera's name. With `imu` and `wheel_speed` observations have `Observation.imu` and
    `Observation.wheel_speed`.
    """

    cameras: dict[str, CameraSensor] | None = None
    imu: Imu | None = None
    wheel_speed: WheelSpeed | None = None
    delay_us: int | None = None


@dataclass(frozen=True)
class ServerInfo:
    """Name and version of the server."""

    name: str
    version: str


@dataclass(frozen=True)
class Limits:
    """Limits of the server."""

    message_bytes: int
    observe_poses: int
    cameras: int
    side_px: int
    answer_pixels: int
    idle_ms: int
    resume_ms: int


@dataclass(frozen=True)
class TrajectoryInfo:
    """A recorded trajectory of a twin."""

    name: str
    length_m: float
    keyframes: int


@dataclass(frozen=True)
class TwinInfo:
    """A twin that can be opened."""

    name: str
    version: int
    version_hash: str
    gaussians: int
    sh_degree: int
    trajectories: tuple[TrajectoryInfo, ...]


@dataclass(frozen=True)
class Welcome:
    """Answer to `hello`: name, limits and twins of the server."""

    seq: int
    protocol: str
    server: ServerInfo
    limits: Limits
    backend: str
    twins: tuple[TwinInfo, ...]
    repairs: tuple[str, ...] | None = None


@dataclass(frozen=True)
class OpenedRepair:
    """The repair of a session's images. `repair_hash` is BLAKE3 of all that determines the bytes, except the image.

    `references`: whether a model that compares with images of the drive gets recorded or rendered ones.
    """

    model: str
    version: str
    repair_hash: str
    provider: str
    deterministic: bool
    below: float
    above: float
    at_least: float
    per_step: int
    on_failure: Literal["unrepaired", "error"]
    references: Literal["recorded", "rendered"] | None = None


@dataclass(frozen=True)
class OpenedScenario:
    """The scenario of a session. `hash` identifies its first episode: the scenario with seed, values and hashes."""

    name: str
    hash: str
    actors: int


@dataclass(frozen=True)
class Opened:
    """Answer to `open`: every setting of the session, defaults included."""

    seq: int
    session: str
    twin: str
    version: int
    version_hash: str
    profile_hash: str
    profile: dict[str, Any]
    backend: str
    seed: int
    start: Pose
    dynamics: Dynamics
    dt_us: int
    deadline_ms: int
    decision_us: int
    warm_up_us: int
    cameras: tuple[Camera, ...]
    outputs: Outputs
    trajectories: tuple[TrajectoryInfo, ...]
    reserved_bytes: int
    repair: OpenedRepair | None = None
    sensors: Sensors | None = None
    scenario: OpenedScenario | None = None
    trajectory: Drive | None = None


@dataclass(frozen=True)
class ResumedSession:
    """A session that was resumed together with another."""

    session: str
    step: int
    time_us: int
    opened: Opened


@dataclass(frozen=True)
class Resumed:
    """Answer to `resume`: the state of the session."""

    seq: int
    session: str
    last_seq: int
    step: int
    time_us: int
    opened: Opened | None = None
    also: tuple[ResumedSession, ...] | None = None


@dataclass(frozen=True)
class Switched:
    """Answer to `switch_version`: the version that the session shows from the next step on."""

    seq: int
    version: int
    version_hash: str
    profile_hash: str
    profile: dict[str, Any]


@dataclass(frozen=True)
class Summary:
    """Summary of an episode."""

    outcome: Literal[
        "completed",
        "off_model",
        "driving_failure",
        "agent_error",
        "agent_timeout",
        "agent_lost",
        "server_error",
    ]
    steps: int
    time_us: int
    distance_m: float
    least_trust: float | None = None
    episode: str | None = None


@dataclass(frozen=True)
class Ok:
    """Answer to `prefetch` and to `snapshot`."""

    seq: int


@dataclass(frozen=True)
class Closed:
    """Answer to `close`."""

    seq: int
    summary: Summary


@dataclass(frozen=True)
class Refusal:
    """Answer to a refused request. The client raises `Refused` from it."""

    code: Code
    message: str
    fatal: bool
    seq: int | None = None
    field: str | None = None


@dataclass(frozen=True)
class Ego:
    """State of the ego: `world_from_rig`, velocity (m/s) and acceleration (m/s²) in world axes.

    `yaw_rate` (rad/s) and `steering`, the angle of the front wheels (radians), are positive to the left. An ego that
    teleports has no `steering`. The last `history_count` poses of the history were driven; earlier ones repeat
    the start.
    """

    pose: Pose
    velocity: Vector
    acceleration: Vector
    yaw_rate: float
    history_count: int
    steering: float | None = None


@dataclass(frozen=True)
class Geo:
    """Place of the ego on the earth (WGS84): degrees, metres above the ellipsoid, and degrees from north to the
    east."""

    latitude: float
    longitude: float
    altitude: float
    heading: float


@dataclass(frozen=True)
class Trust:
    """Confidence in an image: `value` is 1 at a recorded pose, 0 where nothing is known.

    It is computed from the others: distance (metres) and angle (radians) to the nearest recorded keyframe, and,
    among the pixels that look down at the ground, the fraction with an opacity below one half and the fraction
    of rays that meet nothing of the twin.
    """

    value: float
    distance_m: float
    angle_rad: float
    low_coverage: float
    outside: float


@dataclass(frozen=True)
class ImageRepair:
    """Whether an image was repaired, in a session that asked for repair.

    `kept`: not selected. `repaired`: by the model. `failed`: the model failed, because of `failure`. `rendered_hash`
    is BLAKE3 of the pixels before the repair, which is the image's `hash` unless it was repaired. `references` names
    the recorded images that were inputs of the model, at most 8.
    """

    status: Literal["kept", "repaired", "failed"]
    rendered_hash: str
    failure: Literal["timed_out", "not_finite", "withdrawn", "other"] | None = None
    references: tuple[str, ...] | None = None


@dataclass(frozen=True)
class ImageSensor:
    """The effects of a camera's sensor on an image.

    `due_us` is when the frame was due, and `taken_us` when its picture was taken. `clean_hash` is BLAKE3 of the pixels
    before noise, exposure and dirt; None if the camera has none of them.
    """

    status: Literal["ok", "degraded"]
    reasons: tuple[Literal["dropped", "late", "frozen", "noise", "exposure", "dirt"], ...]
    due_us: int
    taken_us: int
    stops: float | None = None
    clean_hash: str | None = None


@dataclass(frozen=True)
class ImageInfo:
    """Metadata of one image: its camera, the index of the request's pose, size, intrinsics, times, hash.

    `tensor` is the name of its colour tensor, and `hash` is BLAKE3 of its pixels before encoding. `back` counts the
    frames of this camera back from the newest, which is 0. `seen` is the fraction of the image inside the valid
    field of the lens, if that is not the whole image; pixels outside are 0.
    """

    camera: str
    index: int
    pose: int
    tensor: str
    encoding: Encoding
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_to_rig: Pose
    shutter_start_us: int
    shutter_end_us: int
    hash: str
    lens: Lens | None = None
    windshield: Windshield | None = None
    seen: float | None = None
    back: int = 0
    trust: Trust | None = None
    repair: ImageRepair | None = None
    sensor: ImageSensor | None = None


@dataclass(frozen=True)
class Stage:
    """Wall time of a render stage, in milliseconds."""

    name: str
    ms: float


@dataclass(frozen=True)
class Timings:
    """Wall time that an observation took, in milliseconds."""

    queue_ms: float
    render_ms: float
    encode_ms: float
    stages_ms: tuple[Stage, ...]
    repair_ms: float | None = None


@dataclass(frozen=True)
class Residency:
    """Memory of the server: bytes that Gaussians take and may take, and how long the request waited for loading."""

    held_bytes: int
    limit_bytes: int
    waited_for: int
    waited_us: int


@dataclass(frozen=True)
class Event:
    """Something that happened since the previous observation. A contact without an actor is one with the twin."""

    time_us: int
    kind: Literal["contact", "trigger", "appeared", "left", "off_model", "end"]
    actor: str | None = None
    name: str | None = None
    at_fault: bool | None = None
    impact: float | None = None


@dataclass(frozen=True)
class Route:
    """Where to drive: points in the rig's frame (metres), what to do next, and where the ego is on the route."""

    points: tuple[Vector, ...]
    command: Literal["left", "right", "straight"]
    station_m: float
    off_m: float
    length_m: float
    text: str | None = None


@dataclass(frozen=True)
class Actor:
    """An actor of the scenario: its box stands on the ground at `pose`, x forward; `size` is length, width, height.

    `instance` is its number in `Observation.instances`.
    """

    name: str
    kind: str
    size: Vector
    pose: Pose
    velocity: Vector
    yaw_rate: float
    instance: int = 0


@dataclass(frozen=True)
class Metadata:
    """Everything in an observation except its tensors."""

    seq: int
    step: int
    time_us: int
    session: str
    seed: int
    terminated: bool
    twin: str
    version: int
    version_hash: str
    profile_hash: str
    backend: str
    frame_hash: str
    ego: Ego
    images: tuple[ImageInfo, ...]
    timings: Timings
    residency: Residency
    history: tuple[ImageInfo, ...] = ()
    events: tuple[Event, ...] = ()
    route: Route | None = None
    actors: tuple[Actor, ...] | None = None
    geo: Geo | None = None


@dataclass(frozen=True)
class SessionRefusal:
    """Why a step of `step_many` was refused."""

    code: Code
    message: str
    field: str | None = None


@dataclass(frozen=True)
class SessionAnswer:
    """The result of one step of `step_many`: the tensor that is its observation, or an error."""

    session: str
    tensor: str | None = None
    error: SessionRefusal | None = None


@dataclass(frozen=True)
class ManyMetadata:
    """Everything in the answer to `step_many` except the observations."""

    seq: int
    answers: tuple[SessionAnswer, ...]


@dataclass(frozen=True)
class SharedMemoryOffer:
    """Memory of the server for observations, and how to open it."""

    seq: int
    path: str
    target: str
    """Target of the symbolic link `path`. With another target, the path belongs to another machine or container."""
    proof_bytes: int
    slots: int
    slot_bytes: int


@dataclass(frozen=True)
class InMemory:
    """Where in the shared memory an answer is."""

    seq: int
    slot: int
    offset: int
    bytes: int


ANSWERS: dict[str, type[Any]] = {
    "welcome": Welcome,
    "opened": Opened,
    "resumed": Resumed,
    "ok": Ok,
    "shared_memory": SharedMemoryOffer,
    "in_memory": InMemory,
    "switched": Switched,
    "closed": Closed,
    "error": Refusal,
}


def parse_json(text: str | bytes, what: str) -> Any:
    """Parses JSON without the extensions that Python's parser accepts. `what` names it in errors."""
    try:
        return json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"{what} is not JSON: {error}") from error


def to_json(value: Any) -> str:
    """The JSON of a request. Raises `ValueError` with the field if a number is NaN or infinite: JSON has neither."""
    try:
        return json.dumps(value, allow_nan=False)
    except ValueError as error:
        field = _not_finite(value, "")
        if field is None:
            raise
        raise ValueError(f"{field} is not a finite number") from error


def _not_finite(value: Any, field: str) -> str | None:
    """The first field that is NaN or infinite."""
    if isinstance(value, float):
        return None if math.isfinite(value) else field
    if isinstance(value, dict):
        found = (_not_finite(item, f"{field}.{name}" if field else str(name)) for name, item in value.items())
    elif isinstance(value, (list, tuple)):
        found = (_not_finite(item, f"{field}[{at}]") for at, item in enumerate(value))
    else:
        return None
    return next((name for name in found if name is not None), None)


def decode_answer(text: str) -> Any:
    """Decodes a text frame from the server as one of `ANSWERS`."""
    value = parse_json(text, "an answer")
    kind = value.get("type") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in ANSWERS:
        raise ProtocolError(f"an answer has type {kind!r}; expected one of {', '.join(ANSWERS)}")
    return decode(ANSWERS[kind], value, kind)


def encode(value: Any) -> Any:
    """Converts a dataclass to what `json` can write. Fields that are None are left out."""
    if dataclasses.is_dataclass(value):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return {name: encode(item) for name, item in fields.items() if item is not None}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [encode(item) for item in value]
    if isinstance(value, dict):
        return {name: encode(item) for name, item in value.items()}
    return value


def decode(kind: Any, value: Any, path: str) -> Any:
    """Converts JSON to the type `kind`. An error names the path, for example `opened.cameras[0].fx`.

    Unknown fields are ignored, because a newer server may send more fields than this client knows.
    """
    if kind is Any:
        return value
    if kind is float:
        # Python's parser turns 1e999 into infinity, which is not a JSON number.
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or not math.isfinite(value):
            return _mismatch(path, value, "a finite number")
        return float(value)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return value if value in arguments else _mismatch(path, value, " or ".join(arguments))
    if origin in (types.UnionType, typing.Union):  # always `X | None`
        return None if value is None else decode(arguments[0], value, path)
    if origin is tuple:
        return _decode_tuple(arguments, value, path)
    if origin is dict or kind is dict:
        if not isinstance(value, dict):
            return _mismatch(path, value, "an object")
        of_values = arguments[1] if arguments else Any
        return {name: decode(of_values, item, f"{path}.{name}") for name, item in value.items()}
    if dataclasses.is_dataclass(kind):
        return _decode_dataclass(kind, value, path)
    if type(value) is not kind:
        return _mismatch(path, value, kind.__name__)
    return value


def _decode_tuple(arguments: tuple[Any, ...], value: Any, path: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        return _mismatch(path, value, "an array")
    kinds = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else list(arguments)
    if len(kinds) != len(value):
        return _mismatch(path, value, f"{len(kinds)} items")
    pairs = enumerate(zip(kinds, value, strict=True))
    return tuple(decode(kind, item, f"{path}[{index}]") for index, (kind, item) in pairs)


def _decode_dataclass(kind: Any, value: Any, path: str) -> Any:
    if not isinstance(value, dict):
        return _mismatch(path, value, "an object")
    fields = {}
    for name, hint, is_required in _fields(kind):
        if name in value:
            fields[name] = decode(hint, value[name], f"{path}.{name}")
        elif is_required:
            raise ProtocolError(f"{path}.{name} is missing")
    return kind(**fields)


@functools.cache
def _fields(kind: type[Any]) -> tuple[tuple[str, Any, bool], ...]:
    """Name and type of each field, and whether it has no default. Cached: Python evaluates the types at each call."""
    hints = typing.get_type_hints(kind)
    fields = dataclasses.fields(kind)
    return tuple((field.name, hints[field.name], field.default is dataclasses.MISSING) for field in fields)


def _mismatch(path: str, value: Any, expected: str) -> NoReturn:
    raise ProtocolError(f"{path} is {str(value)[:100]!r}; expected {expected}")


def _reject_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a JSON number")
