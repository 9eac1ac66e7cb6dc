"""The golden vectors: this client builds the same requests and decodes the same answers and frames."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any, get_args

import jsonschema
import numpy as np
import pytest
import wildcity
from conftest import PROTOCOL, frame, vector
from wildcity import (
    Action,
    AxisNoise,
    BadFrame,
    Camera,
    CameraSensor,
    Code,
    DriveSection,
    Dynamics,
    Exposure,
    ExposureDrift,
    FrozenFrames,
    ImageNoise,
    ImagePart,
    Imu,
    LateFrames,
    Lens,
    LensDirt,
    LidarBeams,
    LidarColumns,
    LidarSensor,
    Observation,
    Outputs,
    Pose,
    ProtocolError,
    RandomStart,
    RecordedPoint,
    Refused,
    Repair,
    Rig,
    RigLidar,
    Sensors,
    Shutter,
    SnapshotPoint,
    Station,
    Step,
    TimedPose,
    Trajectory,
    WheelSpeed,
    png_data_uri,
)
from wildcity.messages import ANSWERS
from wildcity.observation import Many
from wildcity.protocol import decode_answer, encode
from wildcity.session_protocol import SessionProtocol

SENSORS = Sensors(
    cameras={
        "front": CameraSensor(
            drop=0.125,
            late=LateFrames(0.25, 100_000),
            freeze=FrozenFrames(0.0625, 1_000_000),
            noise=ImageNoise(5000.0, 8.0),
            exposure=ExposureDrift(0.25, 2_000_000),
            dirt=LensDirt(12, 0.03125, 0.75),
        )
    },
    imu=Imu(AxisNoise(0.03125, 0.0625), AxisNoise(0.0078125, 0.00390625), 60_000_000),
    wheel_speed=WheelSpeed(0.0625, 0.015625),
    delay_us=200_000,
    lidars={"top": LidarSensor(noise_m=0.03125)},
)
TOP = RigLidar(
    "top",
    LidarBeams(
        (0.125, 0.0, -0.25),
        100_000,
        columns=LidarColumns(1_800, 3.125, -3.125),
        max_range_m=120.0,
        min_range_m=0.5,
        row_azimuth_offsets_rad=(0.0, 0.015625, -0.015625),
    ),
    Pose((1.25, 0.0, 1.875), (1.0, 0.0, 0.0, 0.0)),
)
HERE = Pose((12.5, -3.25, 0.125), (0.8, 0.0, 0.0, 0.6))
ABOVE = Pose((12.5, -3.25, 30.0))
PLANNED = Trajectory((TimedPose(100_000, Pose((1.5, 0.5, 0.0))), TimedPose(200_000, Pose((3.25, 0.5, 0.0)))))
LONGER = Trajectory((TimedPose(500_000, Pose((1.5, 0.5, 0.0))), TimedPose(1_000_000, Pose((3.25, 0.5, 0.0)))))
LOG = Station("log", 12.5)
FRONT = Camera("front", 4, 3, 3.5, 3.5, 2.0, 1.5, Pose((1.6, 0.0, 1.5), (0.5, -0.5, 0.5, -0.5)))
REAR = dataclasses.replace(
    FRONT,
    name="rear",
    camera_to_rig=Pose((-0.9, 0.0, 1.4), (0.5, -0.5, -0.5, 0.5)),
    lens=Lens("fisheye", k=(-0.03, -0.005, -0.001, 0.001), max_angle=1.2),
    shutter=Shutter("top_to_bottom", 30_000),
    exposure=Exposure(matrix=((1.25, 0.0, 0.0), (0.0, 1.125, -0.0625), (0.0, 0.0, 1.5)), offset=(0.0, -0.03125, 0.0)),
)
SEEN = dataclasses.replace(
    FRONT, exposure=Exposure(gain=(1.5, 1.0, 0.75)), overlay=png_data_uri(b"hood"), native_size=(8.0, 6.5)
)

REQUESTS: dict[str, Callable[[SessionProtocol], Any]] = {
    "hello": lambda c: c.hello(),
    "open": lambda c: c.open(
        "street",
        version=3,
        session="run-17",
        seed=42,
        start=LOG,
        rig=Rig("pair", (SEEN, REAR), (TOP,)),
        outputs=Outputs(
            ("front", "rear"),
            "raw",
            85,
            depth=True,
            opacity=True,
            normals=True,
            instances=True,
            semantics=True,
            images={"front": ImagePart((1, 0, 3, 3), (6, 6))},
            frames=4,
            trust=True,
            period_us={"rear": 200_000},
        ),
        dt_us=100_000,
        deadline_ms=20_000,
        decision_us=500_000,
        warm_up_us=1_600_000,
        trajectory=DriveSection("log", 12.5, 62.5, 0.5),
    ),
    "open_preset": lambda c: c.open("street", rig="vehicle6", profile={"tau_px": 2.0}),
    "open_dynamics": lambda c: c.open("street", dynamics=Dynamics("dynamic", 8.25, reverse=True)),
    "open_model": lambda c: c.open("street", dynamics="kinematic"),
    "open_sensors": lambda c: c.open("street", sensors=SENSORS),
    "open_repair": lambda c: c.open("street", repair=Repair("zero-dce", 0.625, 0.875, 0.125, 4, "error")),
    "step_action": lambda c: c.step(Action(-1.5, 0.025), False),
    "step_trajectory": lambda c: c.step(PLANNED, False),
    "step_until": lambda c: c.step(LONGER, False, 1_000_000, {"confidence": 0.75, "reasoning": "a clear road"}),
    "step": lambda c: c.step(HERE, False),
    "step_terminate": lambda c: c.step(HERE, True),
    "observe": lambda c: c.observe([HERE, ABOVE]),
    "prefetch": lambda c: c.prefetch([HERE, ABOVE]),
    "reset": lambda c: c.reset(7, None),
    "reset_pose": lambda c: c.reset(8, HERE),
    "reset_station": lambda c: c.reset(9, LOG),
    "reset_random": lambda c: c.reset(
        10, RandomStart("log", 20.0, 300.0, 0.5, 0.0625), Dynamics("kinematic", 3.0), 8.5
    ),
    "switch_version": lambda c: c.switch_version(4),
    "switch_latest": lambda c: c.switch_version(None),
    "snapshot": lambda c: c.snapshot("before-junction"),
    "restore": lambda c: c.restore("before-junction"),
    "branch": lambda c: c.branch(SnapshotPoint("run-17", "before-junction"), "run-18"),
    "branch_recorded": lambda c: c.branch(RecordedPoint("run-17-1", 40), None),
    "close": lambda c: c.close(),
    "close_named": lambda c: with_sessions(c, "run-17", "run-18").close(on="run-17"),
    "share_memory": lambda p: p.ask_for_memory(),
    "share_memory_proof": lambda p: p.use_memory(SimpleNamespace(proof="5f1c0e64" * 4)),
    "resume": lambda c: c.resume("run-17", 4),
    "resume_also": lambda c: c.resume("run-17", 4, ["run-18"]),
    "step_many": lambda c: c.step_many(
        {
            "run-17": HERE,
            "run-18": Step(Action(-1.5, 0.025), 200_000, {"confidence": 0.75}, terminate=True),
        }
    ),
}


def with_sessions(protocol: SessionProtocol, *names: str) -> SessionProtocol:
    protocol.sessions = list(names)
    return protocol


def names(folder: str) -> list[str]:
    return sorted(path.stem for path in (PROTOCOL / "vectors" / folder).glob("*.json"))


@pytest.mark.parametrize("name", names("requests"))
def test_requests_are_the_golden_ones(name: str) -> None:
    golden = vector(f"requests/{name}.json")
    if "client" in golden:
        golden["client"]["version"] = wildcity.__version__
    protocol = SessionProtocol("golden")
    protocol.first_seq = protocol.next_seq = golden["seq"]
    assert json.loads(next(REQUESTS[name](protocol))) == golden


@pytest.mark.parametrize("name", names("answers"))
def test_answers_keep_everything(name: str) -> None:
    golden = vector(f"answers/{name}.json")
    answer = decode_answer(json.dumps(golden))
    assert type(answer) is ANSWERS[golden.pop("type")]
    assert without_lidars(plain(answer)) == golden


@pytest.mark.parametrize("name", names("answers"))
def test_unknown_fields_of_answers_are_ignored(name: str) -> None:
    golden = vector(f"answers/{name}.json")
    assert decode_answer(json.dumps(with_unknown_fields(golden))) == decode_answer(json.dumps(golden))


def test_unknown_fields_of_the_metadata_are_ignored() -> None:
    data = frame("observations/raw.bin")
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    metadata = json.loads(header["__metadata__"]["observation"])
    header["__metadata__"]["observation"] = json.dumps(with_unknown_fields(metadata))
    text = json.dumps(header).encode()
    more = len(text).to_bytes(8, "little") + text + data[8 + length :]
    assert Observation(more).metadata == Observation(data).metadata


def test_observations_of_several_sessions() -> None:
    data = frame("many/two.bin")
    many = Many(data)
    assert many.seq == 3
    assert list(many.results) == ["run-17", "run-18"]
    seen, refused = many.results.values()
    assert isinstance(seen, Observation)
    alone = Observation(frame("observations/raw.bin"))
    assert bytes(seen.frame) == alone.frame
    assert np.array_equal(seen.images["front"], alone.images["front"])
    assert isinstance(refused, Refused)
    expected = vector("many/two.expected.json")["answers"][1]["error"]
    assert (refused.code, refused.message, refused.field) == tuple(expected.values())
    for wrong in (data[:-1], data.replace(b"run-17", b"run-19", 1), frame("observations/raw.bin")):
        with pytest.raises(BadFrame):
            Many(wrong)
    with pytest.raises(BadFrame):
        Observation(data)


def with_unknown_fields(value: Any) -> Any:
    """Adds a field to every object, except `profile`, `period_us`, and `cameras` and `lidars` of sensors: they are
    maps, so any field is known."""
    if isinstance(value, list):
        return [with_unknown_fields(item) for item in value]
    if not isinstance(value, dict):
        return value

    def inner(name: str, value: Any) -> Any:
        if name in ("profile", "period_us"):
            return value
        if name in ("cameras", "lidars") and isinstance(value, dict):
            return {sensor: with_unknown_fields(effects) for sensor, effects in value.items()}
        return with_unknown_fields(value)

    fields = {name: inner(name, value) for name, value in value.items()}
    return {**fields, "since_next_year": [1, "x"]}


@pytest.mark.parametrize(
    "name",
    [
        "raw",
        "png",
        "jpeg",
        "two_poses",
        "bundle",
        "normals",
        "instances",
        "semantics",
        "trust",
        "repair",
        "sensors",
        "no_images",
    ],
)
def test_observations_decode_to_their_contents(name: str) -> None:
    expected = vector(f"observations/{name}.expected.json")
    observation = Observation(frame(f"observations/{name}.bin"))
    assert without_absent(plain(observation.metadata)) == expected["observation"]
    assert observation.ego.pose == HERE
    assert observation.history_xyz.shape == (16, 3)
    assert observation.history_rot.shape == (16, 3, 3)
    assert observation.history_xyz[0].tolist() == expected["history_xyz_m_first"]
    assert observation.history_xyz[-1].tolist() == expected["history_xyz_m_last"]
    assert np.array_equal(observation.history_rot[-1], np.eye(3))
    for tensor in expected["tensors"]:
        array = observation.tensor(tensor["name"])
        assert array.dtype == {"U8": np.uint8, "U16": np.uint16, "F32": np.float32}[tensor["dtype"]]
        assert tensor["shape"] in (None, list(array.shape))
    infos = observation.metadata.images
    for info, image in zip(infos, expected["images"], strict=True):
        check_image(observation, info.pose, info.camera, image, expected["rgb_tolerance"])


def without_absent(metadata: dict[str, Any]) -> dict[str, Any]:
    """Without the fields that the server omits: an empty history, and `back` of current frames."""
    for name in ("history", "events", "sweeps"):
        if not metadata[name]:
            del metadata[name]
    for image in metadata["images"]:
        assert image.pop("back") == 0
    return metadata


def without_lidars(value: Any) -> Any:
    """Without empty lists of LiDARs, which the server omits, in the settings of sessions wherever they stand."""
    if isinstance(value, list):
        return [without_lidars(item) for item in value]
    if isinstance(value, dict):
        return {key: without_lidars(item) for key, item in value.items() if (key, item) != ("lidars", [])}
    return value


def check_image(observation: Observation, pose: int, camera: str, expected: dict[str, Any], tolerance: int) -> None:
    view = observation.views[pose]
    image = view.images[camera]
    assert image.dtype == np.uint8 and list(image.shape) == expected["shape"]
    assert not image.flags.writeable
    assert view.images[camera] is image, "decoded twice"
    for pixel in expected["pixels"]:
        at = pixel["y"], pixel["x"]
        assert np.abs(image[at].astype(int) - pixel["rgb"]).max() <= tolerance
        maps_by_name = (("depth_m", view.depth), ("opacity", view.opacity), ("normal", view.normals))
        for name, maps in maps_by_name:
            if pixel[name] is None:
                assert camera not in maps
            else:
                assert maps[camera].dtype == np.float32
                assert np.array_equal(maps[camera][at], np.float32(pixel[name]))
        if "instance" in pixel:
            assert view.instances[camera].dtype == np.uint16
            assert view.instances[camera][at] == pixel["instance"]
        else:
            assert camera not in view.instances
        if "class" in pixel:
            assert view.semantics[camera].dtype == np.uint8
            assert view.semantics[camera][at] == pixel["class"]
        else:
            assert camera not in view.semantics


def test_frames_of_a_camera_are_in_the_order_they_were_taken() -> None:
    observation = Observation(frame("observations/bundle.bin"))
    assert [i.shutter_end_us for i in observation.frame_infos("front")] == [0, 100_000, 200_000]
    frames = observation.frames("front")
    assert frames.dtype == np.uint8 and frames.shape == (3, 3, 4, 3)
    assert np.array_equal(frames[2], observation.images["front"])
    # Blue differs: it is 3 + 50 k in frame k before the current one.
    assert frames[:, 0, 0, 2].tolist() == [103, 53, 3]
    with pytest.raises(KeyError, match="roof"):
        observation.frames("roof")
    with pytest.raises(KeyError, match="'roof': images are of front"):
        _ = observation.images["roof"]
    with pytest.raises(KeyError, match=r"Outputs\(depth=True\)"):
        _ = observation.depth["front"]
    with pytest.raises(KeyError, match=r"Sensors\(imu=Imu\(\)\)"):
        _ = observation.imu


def test_raw_tensors_are_read_in_place() -> None:
    data = frame("observations/raw.bin")
    observation = Observation(data)
    whole = np.frombuffer(data, np.uint8)
    for array in (observation.images["rear"], observation.depth["rear"], observation.history_xyz):
        assert np.shares_memory(whole, array)


def test_mappings_hold_the_cameras_in_order() -> None:
    observation = Observation(frame("observations/raw.bin"))
    assert list(observation.images) == ["front", "rear"] == list(observation.views[0].cameras)
    with pytest.raises(KeyError):
        observation.images["left"]
    assert len(Observation(frame("observations/png.bin")).depth) == 0


DAMAGED = {
    "empty": "header length",
    "short_length": "header length",
    "short_header": "header length",
    "short_data": "end at offset",
    "trailing": "end at offset",
    "header_beyond_frame": "header length",
    "header_2_60": f"header length is {2**60}",
    "header_not_json": "not JSON",
    "header_not_object": "a JSON object",
    "header_not_utf8": "utf-8",
    "no_metadata": "__metadata__",
    "overlap": "has offset 188",
    "gap": "has offset 196",
    "offset_past_end": "bytes; its shape asks for 48",
    "reversed_offsets": "has offsets",
    "negative_offset": "has offsets",
    "unknown_dtype": "F33",
    "wrong_dtype": "I32",
    "wrong_shape": r"\[4, 3, 3\]; expected U8 \[3, 4, 3\]",
    "shape_not_bytes": "its shape asks for 12",
    "shape_overflow": "its shape asks for",
    "shape_not_numbers": "expected counts",
    "missing_tensor": "no tensor 'camera/left/rgb'",
    "observation_not_json": "metadata is not JSON",
    "observation_incomplete": "metadata.step is missing",
    "image_not_png": "cannot be decoded",
    "image_of_other_size": "2x1 px",
}


@pytest.mark.parametrize("case", vector("damaged/index.json"), ids=lambda case: case["file"])
def test_damaged_frames_are_refused(case: dict[str, str]) -> None:
    data = frame(f"damaged/{case['file']}")
    says = DAMAGED[case["file"].removesuffix(".bin")]
    if case["refused_at"] == "frame":
        with pytest.raises(BadFrame, match=says):
            Observation(data)
    else:
        observation = Observation(data)
        with pytest.raises(BadFrame, match=says):
            observation.images["front"]


def test_no_prefix_and_no_flipped_byte_raises_anything_else() -> None:
    data = frame("observations/png.bin")
    for length in range(len(data)):
        with pytest.raises(BadFrame):
            Observation(data[:length])
    refused = 0
    for position in range(len(data)):
        flipped = bytearray(data)
        flipped[position] ^= 0x15
        try:
            observation = Observation(bytes(flipped))
            for name in observation.images:
                observation.images[name]
        except BadFrame:
            refused += 1
    assert refused > len(data) // 4


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not JSON"),
        ("[1]", "type None"),
        ('{"type": "sing"}', "type 'sing'"),
        ('{"type": ["error"]}', "expected one of"),
        ("[" * 100_000, "not JSON"),
        ('{"type": "closed", "seq": 8}', "closed.summary is missing"),
        ('{"type": "closed", "seq": true, "summary": {}}', "closed.seq is 'True'"),
        ('{"type": "resumed", "seq": NaN}', "NaN"),
        ('{"type": "error", "seq": 1, "code": "odd", "message": "", "fatal": false}', "error.code"),
    ],
)
def test_invalid_answers_are_named(text: str, says: str) -> None:
    with pytest.raises(ProtocolError, match=says):
        decode_answer(text)


def test_a_pose_is_finite_and_complete() -> None:
    assert Pose(np.array([1, 2, 3]), [1, 0, 0, 0]).xyz == (1.0, 2.0, 3.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"q\[2\] is nan"):
        Pose(q=(1.0, 0.0, float("nan"), 0.0))
    with pytest.raises(ValueError, match="xyz has 2 numbers"):
        Pose((1.0, 2.0))  # type: ignore[arg-type]


def test_codes_are_those_of_the_schema() -> None:
    schema = json.loads((PROTOCOL / "schema/answer.json").read_text())
    assert {variant["const"] for variant in schema["$defs"]["Code"]["oneOf"]} == set(get_args(Code))


@cache
def validator(name: str) -> jsonschema.Draft202012Validator:
    """Of a schema, itself checked once."""
    schema = json.loads((PROTOCOL / f"schema/{name}.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_vectors_obey_the_schemas() -> None:
    """The vectors are valid, and a message without a required field is not."""
    for schema_name, folder in (("request", "requests"), ("answer", "answers")):
        schema = validator(schema_name)
        for name in names(folder):
            message = vector(f"{folder}/{name}.json")
            schema.validate(message)
            del message["type"]
            assert not schema.is_valid(message)
    schema = validator("observation")
    frames = ("raw", "png", "jpeg", "two_poses", "normals", "instances", "semantics", "trust", "repair", "sensors")
    for name in (*frames, "no_images"):
        metadata = vector(f"observations/{name}.expected.json")["observation"]
        schema.validate(metadata)
        del metadata["frame_hash"]
        assert not schema.is_valid(metadata)


MOVE = {"type": "step", "seq": 3}
HERE_JSON = {"xyz": [0.0, 0.0, 0.0], "q": [1.0, 0.0, 0.0, 0.0]}
ACTION = {"acceleration": 0.0, "curvature": 0.0}


@pytest.mark.parametrize(
    "request_",
    [
        {**MOVE},
        {**MOVE, "pose": HERE_JSON, "action": ACTION},
        {**MOVE, "trajectory": []},
        {**MOVE, "trajectory": [{"time_us": 0, "pose": HERE_JSON}]},
        {**MOVE, "action": {"acceleration": 9.9, "curvature": 0.0}},
        {"type": "observe", "seq": 3, "poses": []},
        {"type": "observe", "seq": 3, "poses": [HERE_JSON] * 17},
        {"type": "open", "seq": 1, "twin": "../etc"},
        {"type": "open", "seq": 1, "twin": "a", "session": "A b"},
        {"type": "open", "seq": 1, "twin": "a", "dt_us": 999},
        {"type": "open", "seq": 1, "twin": "a", "dt_us": None},
        {"type": "open", "seq": 1, "twin": "a", "start": None},
        {"type": "open", "seq": 1, "twin": "a", "outputs": {"quality": 0}},
        {"type": "open", "seq": 1, "twin": "a", "outputs": {"frames": 17}},
        {"type": "open", "seq": 1, "twin": "a", "rig": {"name": "r", "cameras": []}},
    ],
    ids=str,
)
def test_the_schema_refuses_what_the_server_refuses(request_: dict[str, Any]) -> None:
    assert not validator("request").is_valid(request_)


# What depends on the state of the session or the server, or on other numbers of the same request, is beyond a schema.
BEYOND_A_SCHEMA = {
    "malformed_json",
    "wrong_order",
    "session_state",
    "seq_out_of_order",
    "unsupported_protocol",
    "answer_too_large",
    "scenario_invalid",
} | {
    f"unknown_{what}"
    for what in ["session", "twin", "version", "rig", "camera", "trajectory", "repair", "scenario", "state"]
}
DEPENDS_ON_OTHERS = (
    # Integers above 2^53 and 2^64, lengths of quaternions, and what the drive, the steps and the other cameras are.
    ("seq", "1e18"),
    ("seq", "1e30"),
    ("seq", "18446744073709551616"),
    ("seed", "1e20"),
    ("q", "pose_invalid"),
    ("start.station_m", '"station_m":9.1'),
    ("start.station_m", '"station_m":1'),
    ("start.random.from_m", '"from_m":1}'),
    ("start.random.to_m", '"from_m":5,"to_m":4'),
    ("trajectory.to_m", '"from_m":2,"to_m":1'),
    ("trajectory.every_m", '"every_m":0}'),
    ("rig.cameras[1].name", "{CAM},{CAM}"),
    ("profile.", ""),
    ("outputs.images.front.crop", '"crop":['),
    ("outputs.period_us.rear", "150000"),
    ("deadline_ms", "60001"),
    ("decision_us", "150000"),
    ("warm_up_us", '"start":{"pose"'),
    ("sensors.cameras.front.late.by_us", "150000"),
    ("sensors.cameras.rear.late.by_us", "300000"),
    ("sensors.cameras.front", "9300000"),
    ("sensors.delay_us", "150000"),
    ("until_us", "150000"),
    ("until_us", "200000"),
    ("trajectory[1].time_us", "200000"),
    ("trajectory", "50000"),
    ("trajectory", '"until_us":200000'),
    ("start.pose", '"start":{"pose":POSE}'),
    ("speed", '"speed":3}'),
    ("speed", '"speed":-1}'),
    ("also[1]", '["b","b"]'),
    ("also[0]", '["a"]'),
    ("steps[1].session", '"a","pose":POSE},{"session":"a"'),
    # Values of any type: `null` within them is refused by the server alone.
    ("notes", ":null"),
    ("notes", ",null"),
    ("scenario", '"scenario":{'),
    ("notes", "NaN"),
    # A pinhole needs focal lengths; whether a lens, a windshield or an overlay can be used is a computation.
    ("rig.cameras[0].fx", '"height":8,"fy":8'),
    ("rig.cameras[0].lens", "-1e9"),
    ("rig.cameras[0].windshield.horizontal", "[0,1],"),
    ("rig.cameras[0].overlay", "camera_invalid"),
    ("rig.cameras[0].native_size", "[0,8]"),
)


def bad_requests() -> list[tuple[str, str, str, str]]:
    """Line, code, field and text of the server's table of bad requests, as far as a schema may refuse them."""
    table = (PROTOCOL.parent / "tests/server/bad_requests.txt").read_text()
    pose = '{"xyz":[0,0,0],"q":[1,0,0,0]}'
    beginnings = {
        "OPEN": '{"type":"open","seq":N,"twin":"test"',
        "CAM": '"name":"c","width":8,"height":8,"fx":8,"fy":8,"cx":4,"cy":4,"camera_to_rig":POSE',
        "STEP": '{"type":"step","seq":N,"pose":',
        "CAR": '{"type":"step","seq":N,"action":',
        "POSE": pose,
        '"seq":N': '"seq":1',
    }
    rows = []
    for number, line in enumerate(table.splitlines(), 1):
        if not line or line.startswith("#"):
            continue
        code, field, text = (part.strip() for part in line.split("|", 2))
        row = f"{code} {text}"
        depends = any(field.startswith(of) or field.endswith(of) for of, part in DEPENDS_ON_OTHERS if part in row)
        if code in BEYOND_A_SCHEMA or depends:
            continue
        if text.startswith("RIG"):
            text = 'OPEN,"rig":{"name":"r","cameras":[' + text[3:] + "]}}"
        for name, beginning in beginnings.items():
            text = text.replace(name, beginning)
        rows.append((f"line {number}", code, field, text))
    return rows


class DoubledKey(Exception):
    pass


def without_doubled_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) != len({name for name, _ in pairs}):
        raise DoubledKey
    return dict(pairs)


def not_finite(text: str) -> None:
    """As JavaScript writes NaN, and as the server reads it."""
    return None


def test_the_schema_refuses_the_bad_requests_of_the_server() -> None:
    accepted, count = [], 0
    for row in bad_requests():
        text = row[-1].replace("1e999", "NaN").replace("nan", "NaN")
        try:
            request_ = json.loads(text, object_pairs_hook=without_doubled_keys, parse_constant=not_finite)
        except DoubledKey:
            continue
        count += 1
        if validator("request").is_valid(request_):
            accepted.append(row[:3])
    assert not accepted
    assert count > 300, count


def plain(value: Any) -> Any:
    """A dataclass as plain JSON values."""
    return json.loads(json.dumps(encode(value)))
