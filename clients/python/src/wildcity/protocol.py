"""The types of the wire, and their way to and from JSON. Names are those on the wire."""

from __future__ import annotations

import base64
import dataclasses
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
"""Largest message accepted from a server."""

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
        # Accepts lists and arrays; what is stored is plain floats, as many as there must be.
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
    """A pose of a trajectory: the rig `time_us` after the step's start, in its frame there."""

    time_us: int
    pose: Pose


@dataclass(frozen=True)
class Trajectory:
    """Where the ego is to be next: 1 to 64 poses in order of time, to the step's end or beyond."""

    poses: tuple[TimedPose, ...]


@dataclass(frozen=True)
class Action:
    """Acceleration along the car (m/s²) and curvature of its way (1/m, to the left), for one step."""

    acceleration: float
    curvature: float


Model = Literal["teleport", "kinematic", "dynamic"]


@dataclass(frozen=True)
class Dynamics:
    """How the ego moves: its model, its speed (m/s) at the start, and whether braking ends in reverse."""

    model: Model
    speed: float = 0.0
    reverse: bool = False


@dataclass(frozen=True)
class Station:
    """A place along a recorded trajectory, `station_m` metres from its start."""

    trajectory: str
    station_m: float = 0.0


@dataclass(frozen=True)
class Lens:
    """How a lens maps rays to pixels, where it is no pinhole; each model has its own fields.

    `opencv`: k (6), p (2), s (4). `fisheye`: k (4), max_angle or none. `ftheta`: reference, polynomial
    (6), linear_cde (3), max_angle. Angles are in radians off the axis.
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
    """What turns rays before the lens: polynomials of the angles to the right and downwards."""

    reference: Literal["forward", "backward"]
    horizontal: tuple[float, ...]
    vertical: tuple[float, ...]


@dataclass(frozen=True)
class Shutter:
    """A shutter that exposes rows, or columns, one after the other."""

    direction: Literal["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"]
    duration_us: int


@dataclass(frozen=True)
class Exposure:
    """What a camera makes of colours: matrix @ rgb + offset, or gain * rgb + offset."""

    matrix: tuple[tuple[float, ...], ...] | None = None
    gain: tuple[float, float, float] | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


def png_data_uri(png: bytes) -> str:
    """A PNG file as `Camera.overlay` has it."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


@dataclass(frozen=True)
class Camera:
    """A camera on the vehicle, a pinhole unless it has a lens; sizes and intrinsics in pixels.

    `camera_to_rig` takes camera coordinates (x right, y down, z forward) to the rig's. An f-theta lens
    has its focal lengths from its polynomial: leave fx and fy None there. `overlay` is what the camera
    sees of its own car: `png_data_uri(bytes)` of a PNG with opacity, of the image's size; answers leave
    it out.
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


@dataclass(frozen=True)
class Rig:
    """The cameras of a vehicle, in the order in which images are answered."""

    name: str
    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class ImagePart:
    """What is sent of a camera's image: crop is (left, top, width, height), size (width, height)."""

    crop: tuple[int, int, int, int] | None = None
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Outputs:
    """What each observation holds: which cameras (all if absent), how encoded, with what.

    `images` are other parts and sizes than the rig's, by the camera's name.
    `frames` is how many last frames of each camera, 1 if absent; `period_us` is the time between two
    frames of a camera that does not take one with every step; `trust` says how far each image may be believed.
    """

    cameras: tuple[str, ...] | None = None
    encoding: Encoding = "jpeg"
    quality: int | None = None
    depth: bool = False
    opacity: bool = False
    normals: bool | None = None
    images: dict[str, ImagePart] | None = None
    frames: int | None = None
    trust: bool | None = None
    period_us: dict[str, int] | None = None


@dataclass(frozen=True)
class ServerInfo:
    """Name and version of the server."""

    name: str
    version: str


@dataclass(frozen=True)
class Limits:
    """What the server accepts."""

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
    """Answer to hello: who the server is and what it offers."""

    seq: int
    protocol: str
    server: ServerInfo
    limits: Limits
    backend: str
    twins: tuple[TwinInfo, ...]


@dataclass(frozen=True)
class Opened:
    """Answer to open: everything resolved, nothing implicit."""

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


@dataclass(frozen=True)
class Resumed:
    """Answer to resume: where the session stands."""

    seq: int
    session: str
    last_seq: int
    step: int
    time_us: int


@dataclass(frozen=True)
class Switched:
    """Answer to switch_version: what the session sees from now on."""

    seq: int
    version: int
    version_hash: str
    profile_hash: str
    profile: dict[str, Any]


@dataclass(frozen=True)
class Summary:
    """How an episode went."""

    outcome: Literal[
        "completed", "off_model", "agent_error", "agent_timeout", "agent_lost", "server_error"
    ]
    steps: int
    time_us: int
    distance_m: float
    least_trust: float | None = None


@dataclass(frozen=True)
class Ok:
    """Answer to prefetch."""

    seq: int


@dataclass(frozen=True)
class Closed:
    """Answer to close."""

    seq: int
    summary: Summary


@dataclass(frozen=True)
class Refusal:
    """Answer to any request that was refused; `Refused` is raised from it."""

    code: Code
    message: str
    fatal: bool
    seq: int | None = None
    field: str | None = None


@dataclass(frozen=True)
class Ego:
    """The ego vehicle: `world_from_rig`, velocity (m/s) and acceleration (m/s²) in world axes.

    `yaw_rate` is in rad/s, `steering` the angle of the front wheels in radians, both to the left; an ego that
    teleports has no wheels. The last `history_count` poses of the history were driven; earlier ones repeat the
    start.
    """

    pose: Pose
    velocity: Vector
    acceleration: Vector
    yaw_rate: float
    history_count: int
    steering: float | None = None


@dataclass(frozen=True)
class Trust:
    """How far an image may be believed: `value` is 1 as recorded, 0 where nothing is known.

    Its parts: metres and radians to the nearest recorded keyframe; of what looks down, the shares of pixels
    with less than half opacity and of rays that meet nothing of the twin.
    """

    value: float
    distance_m: float
    angle_rad: float
    low_coverage: float
    outside: float


@dataclass(frozen=True)
class ImageInfo:
    """One image: its camera, the request's pose it shows, size, intrinsics, times, hash.

    `tensor` names its colour in the frame; `hash` is BLAKE3 of its pixels before encoding. `back` counts
    frames of this camera back from the newest, which is 0. `seen` is the share of it that the lens sees,
    where that is not all: the rest is 0.
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


@dataclass(frozen=True)
class Stage:
    """Wall time of a render stage, in milliseconds."""

    name: str
    ms: float


@dataclass(frozen=True)
class Timings:
    """What an observation cost, in milliseconds."""

    queue_ms: float
    render_ms: float
    encode_ms: float
    stages_ms: tuple[Stage, ...]


@dataclass(frozen=True)
class Residency:
    """The server's memory: what Gaussians take in it and may take, and what had to be waited for."""

    held_bytes: int
    limit_bytes: int
    waited_for: int
    waited_us: int


@dataclass(frozen=True)
class Metadata:
    """What an observation says beside its tensors."""

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


ANSWERS: dict[str, type[Any]] = {
    "welcome": Welcome,
    "opened": Opened,
    "resumed": Resumed,
    "ok": Ok,
    "switched": Switched,
    "closed": Closed,
    "error": Refusal,
}


def parse_json(text: str | bytes, what: str) -> Any:
    """JSON without the extensions that Python's reader allows."""
    try:
        return json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"{what} is not JSON: {error}") from error


def decode_answer(text: str) -> Any:
    """A text frame from the server, as one of `ANSWERS`."""
    value = parse_json(text, "an answer")
    kind = value.get("type") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in ANSWERS:
        raise ProtocolError(f"an answer has type {kind!r}; expected one of {', '.join(ANSWERS)}")
    return decode(ANSWERS[kind], value, kind)


def encode(value: Any) -> Any:
    """A dataclass as what `json` writes; what is None is left out."""
    if dataclasses.is_dataclass(value):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return {name: encode(item) for name, item in fields.items() if item is not None}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [encode(item) for item in value]
    if isinstance(value, dict):
        return {name: encode(item) for name, item in value.items()}
    return value


def decode(kind: Any, value: Any, path: str) -> Any:
    """JSON as the type it must be; a mismatch names the path, as `opened.cameras[0].fx`.

    Unknown fields are ignored: a server may say more than this client knows.
    """
    if kind is Any:
        return value
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return value if value in arguments else _mismatch(path, value, " or ".join(arguments))
    if origin in (types.UnionType, typing.Union):  # always `X | None`
        return None if value is None else decode(arguments[0], value, path)
    if origin is tuple:
        return _decode_tuple(arguments, value, path)
    if origin is dict or kind is dict:
        return value if isinstance(value, dict) else _mismatch(path, value, "an object")
    if dataclasses.is_dataclass(kind):
        return _decode_dataclass(typing.cast(type[Any], kind), value, path)
    if kind is float:
        # Python's reader turns 1e999 into infinity, which is no JSON number.
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or not math.isfinite(value):
            return _mismatch(path, value, "a finite number")
        return float(value)
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


def _decode_dataclass(kind: type[Any], value: Any, path: str) -> Any:
    if not isinstance(value, dict):
        return _mismatch(path, value, "an object")
    hints = typing.get_type_hints(kind)
    fields = {}
    for field in dataclasses.fields(kind):
        if field.name in value:
            fields[field.name] = decode(hints[field.name], value[field.name], f"{path}.{field.name}")
        elif field.default is dataclasses.MISSING:
            raise ProtocolError(f"{path}.{field.name} is missing")
    return kind(**fields)


def _mismatch(path: str, value: Any, expected: str) -> NoReturn:
    raise ProtocolError(f"{path} is {str(value)[:100]!r}; expected {expected}")


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON number")
