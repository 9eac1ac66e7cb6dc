"""Records that `wildcity episode run` and `wildcity serve` leave: exported as MCAP, and after kill -9."""

from __future__ import annotations

import io
import json
import random
import signal
import subprocess
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import wildcity
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

ROOT = Path(__file__).resolve().parents[3]
PEDESTRIAN = {
    "format": "wildcity.scenario/1",
    "name": "walk",
    "twin": {"name": "demo"},
    "ego": {
        "start": {"trajectory": "log", "station_m": 10},
        "dynamics": {"model": "dynamic", "speed": 10},
    },
    "actors": [
        {
            "name": "walker",
            "class": "pedestrian",
            "collide": {
                "along": "log",
                "station_m": 25,
                "time_s": 1.5,
                "angle_rad": 1.5708,
                "speed": 1.34,
            },
        }
    ],
    "end": {"time_s": 3.0, "contact": "any"},
}
SUITE = {
    "format": "wildcity.suite/1",
    "name": "walks",
    "scenarios": ["walk.json"],
    "cameras": ["front"],
    "size": [64, 40],
}


def write_suite(folder: Path, **changes: Any) -> Path:
    (folder / "walk.json").write_text(json.dumps(PEDESTRIAN))
    (folder / "suite.json").write_text(json.dumps({**SUITE, **changes}))
    return folder / "suite.json"


def run_suite(suite: Path, out: Path, environment: dict[str, str]) -> None:
    command = ["wildcity", "episode", "run", str(suite), "--agent", "log", "--out", str(out)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 1, f"the pedestrian is hit\n{done.stdout}\n{done.stderr}"


def lines_of(record: Path) -> list[dict[str, Any]]:
    """The whole lines of a record; a last one without a line break is left out."""
    text = record.read_bytes()
    whole = text[: text.rfind(b"\n") + 1]
    return [json.loads(line) for line in whole.splitlines()]


def walk(folder: Path, environment: dict[str, str]) -> Path:
    """The record of an episode in which a pedestrian is hit."""
    run_suite(write_suite(folder), folder / "run", environment)
    return folder / "run" / "episodes" / "walk-0-1.jsonl"


@pytest.fixture(scope="module")
def driven(
    quick_reader: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[dict[str, Any]], bytes]:
    """A record in which a pedestrian is hit, and the same as MCAP."""
    folder = tmp_path_factory.mktemp("walk")
    record = walk(folder, quick_reader)
    mcap = folder / "walk.mcap"
    command = ["wildcity", "episode", "export", str(record), "--mcap", str(mcap)]
    subprocess.run(command, env=quick_reader, check=True, capture_output=True)
    assert encoded(record.with_suffix(".mcap").read_bytes()) == encoded(mcap.read_bytes()), "the run wrote the same"
    return lines_of(record), mcap.read_bytes()


def strict(schema: Any) -> Any:
    """A schema that refuses fields that it does not describe, unless it says that there are others."""
    if isinstance(schema, list):
        return [strict(value) for value in schema]
    if not isinstance(schema, dict):
        return schema
    closed = {"additionalProperties": False} if "properties" in schema else {}
    return {**closed, **{key: strict(value) for key, value in schema.items()}}


def test_every_line_of_a_record_is_in_the_schema(
    driven: tuple[list[dict[str, Any]], bytes], quick_reader: dict[str, str], tmp_path: Path
) -> None:
    schema = strict(json.loads((ROOT / "protocol" / "record.json").read_text()))
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    lines, _ = driven
    kinds = Counter(line["kind"] for line in lines)
    assert kinds.keys() == {"episode", "scenario", "actors", "event", "frame", "result", "end"}, kinds
    for line in lines:
        kind = line["kind"]
        validator.validate(line)
        assert not validator.is_valid({**line, "unknown": 1}), kind
        required = schema["oneOf"][[one["title"] for one in schema["oneOf"]].index(line.get("event", kind))]["required"]
        for name in required:
            assert not validator.is_valid({key: line[key] for key in line if key != name}), f"{kind} without {name}"


def encoded(data: bytes) -> list[tuple[str, int, bytes]]:
    """Topic, time in nanoseconds and bytes of each message. Every CRC is checked."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    return [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]


def read(data: bytes, **options: Any) -> list[tuple[str, str, int, Any]]:
    """Topic, schema, time in nanoseconds and content of each message. Every CRC is checked."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True, decoder_factories=[DecoderFactory()])
    found = []
    for schema, channel, message in reader.iter_messages(**options):
        assert schema is not None
        if schema.encoding == "jsonschema":
            assert json.loads(schema.data)["type"] == "object"
            content = json.loads(message.data)
        else:
            decoder = DecoderFactory().decoder_for(channel.message_encoding, schema)
            assert decoder is not None, schema.name
            content = decoder(message.data)
            assert content.ListFields(), f"{channel.topic}: an empty message"
        found.append((channel.topic, schema.name, message.log_time, content))
    return found


def test_an_export_is_read_by_the_mcap_package(
    driven: tuple[list[dict[str, Any]], bytes],
) -> None:
    lines, data = driven
    frames = [line for line in lines if line["kind"] == "frame"]
    messages = read(data)
    counts = Counter((topic, schema) for topic, schema, _, _ in messages)
    assert counts == {
        ("/tf", "foxglove.FrameTransforms"): len(frames) + 1,
        ("/actors", "foxglove.SceneUpdate"): len(frames),
        ("/ego/odometry", "foxglove.Odometry"): len(frames),
        ("/ego/pose", "foxglove.PoseInFrame"): len(frames),
        ("/actors/poses", "foxglove.PosesInFrame"): len(frames),
        ("/ego/path", "foxglove.PosesInFrame"): 1,
        ("/plan", "foxglove.PosesInFrame"): len(frames) - 1,
        ("/route", "foxglove.PosesInFrame"): 1,
        ("/camera/0/calibration", "foxglove.CameraCalibration"): 1,
        ("/log", "foxglove.Log"): 2,
        ("/wildcity/episode", "wildcity.Episode"): 1,
        ("/wildcity/step", "wildcity.Step"): len(frames),
        ("/wildcity/event", "wildcity.Event"): 2,
        ("/wildcity/result", "wildcity.Result"): 1,
    }
    times = [time for _, _, time, _ in messages]
    assert times == sorted(times)

    def of(topic: str) -> list[Any]:
        return [content for found, _, _, content in messages if found == topic]

    # The ego's last pose, the walker's box, the fault and the hash of the last image are those of the record.
    last = of("/tf")[-1].transforms[0]
    assert (last.parent_frame_id, last.child_frame_id) == ("world", "rig")
    position = [last.translation.x, last.translation.y, last.translation.z]
    np.testing.assert_array_equal(position, frames[-1]["poses"][-1]["xyz"])
    actors = [line for line in lines if line["kind"] == "actors"]
    boxes = {entity.id: entity for entity in of("/actors")[-1].entities}
    assert set(boxes) == {"ego", "walker"}
    center, size = boxes["walker"].cubes[0].pose.position, boxes["walker"].cubes[0].size
    np.testing.assert_allclose([center.x, center.y], actors[-1]["actors"][0][1][:2], rtol=1e-12)
    assert (size.x, size.y, size.z) == (0.6, 0.6, 1.75)
    assert "walker" in of("/log")[0].message and "at fault" in of("/log")[0].message
    assert of("/wildcity/step")[-1]["images"] == frames[-1]["images"]
    assert of("/wildcity/result")[0]["verdict"] == "failed"


def test_an_export_is_indexed(driven: tuple[list[dict[str, Any]], bytes]) -> None:
    _, data = driven
    summary = make_reader(io.BytesIO(data), validate_crcs=True).get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.chunk_indexes and all(chunk.compression == "zstd" for chunk in summary.chunk_indexes)
    everything = read(data)
    assert summary.statistics.message_count == len(everything)
    # A part of the time and one topic are found by the index.
    begin = summary.statistics.message_start_time + 500_000_000
    part = read(data, topics=["/tf"], starting_at=begin, ending_before=begin + 500_000_000)
    wanted = [one[2] for one in everything if one[0] == "/tf" and begin <= one[2] < begin + 500_000_000]
    assert [one[2] for one in part] == wanted and len(wanted) == 5


def test_images_of_an_export_are_those_of_the_record(
    driven: tuple[list[dict[str, Any]], bytes], quick_reader: dict[str, str], tmp_path: Path
) -> None:
    lines, without = driven
    record = tmp_path / "walk-0-1.jsonl"
    record.write_text("".join(json.dumps(line) + "\n" for line in lines))
    mcap = tmp_path / "walk.mcap"
    command = ["wildcity", "episode", "export", str(record), "--mcap", str(mcap), "--images"]
    done = subprocess.run(command, env=quick_reader, check=True, capture_output=True, text=True)
    assert "differs" not in done.stdout, done.stdout
    images = [one for one in read(mcap.read_bytes()) if one[1] == "foxglove.CompressedImage"]
    frames = [line for line in lines if line["kind"] == "frame"]
    assert [time for _, _, time, _ in images] == [(1_000_000_000 + frame["time_us"]) * 1000 for frame in frames]
    for topic, _, _, image in images:
        assert (topic, image.format, image.frame_id) == ("/camera/0/image", "jpeg", "camera/0")
        assert image.data.startswith(b"\xff\xd8") and image.data.endswith(b"\xff\xd9")
    others = [one[:3] for one in read(mcap.read_bytes()) if one[1] != "foxglove.CompressedImage"]
    assert Counter(others) == Counter(one[:3] for one in read(without))


def test_damage_of_an_export_is_noticed(driven: tuple[list[dict[str, Any]], bytes]) -> None:
    _, data = driven
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    for chunk in summary.chunk_indexes:
        damaged = bytearray(data)
        damaged[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0x40
        with pytest.raises(Exception, match="(?i)crc|zstd|decompress|corrupt|checksum"):
            read(bytes(damaged))


def test_kill_9_of_a_run_leaves_readable_records(quick_reader: dict[str, str], tmp_path: Path) -> None:
    suite = write_suite(tmp_path, seeds=[0, 49], size=[320, 206])
    out = tmp_path / "run"
    command = ["wildcity", "episode", "run", str(suite), "--agent", "log", "--out", str(out)]
    running = subprocess.Popen(command, env=quick_reader, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    record = out / "episodes" / "walk-0-1.jsonl"
    while not (record.is_file() and record.read_bytes().count(b'"kind":"frame"') > 4):
        assert running.poll() is None, "it ended before it was killed"
        time.sleep(0.002)
    running.send_signal(signal.SIGKILL)
    running.wait()
    frames = [line for line in lines_of(record) if line["kind"] == "frame"]
    assert [frame["step"] for frame in frames] == list(range(len(frames)))
    show = ["wildcity", "episode", "show", str(record)]
    shown = subprocess.run(show, env=quick_reader, capture_output=True, text=True)
    assert shown.returncode == 0 and f"steps       {frames[-1]['step']}" in shown.stdout, shown.stdout


def test_kill_9_of_a_server_loses_at_most_the_step_under_way(quick_reader: dict[str, str], tmp_path: Path) -> None:
    draw = random.Random(17)
    for attempt in range(4):
        folder = tmp_path / str(attempt)
        command = ["wildcity", "serve", "--listen", "127.0.0.1:0", "--episodes", str(folder)]
        server = subprocess.Popen(
            [*command, "--threads", "1"], env=quick_reader, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert server.stdout is not None
        url = server.stdout.readline().removeprefix("listening on ").strip()
        answered: list[str] = []
        killer = threading.Timer(0.1 * draw.random(), server.kill)
        with pytest.raises((wildcity.WildCityError, OSError)):
            with wildcity.connect(url) as client:
                scenario = {**PEDESTRIAN, "end": {"time_s": 60.0}}
                outputs = wildcity.Outputs(cameras=("front",), images={"front": wildcity.ImagePart(size=(64, 40))})
                session = client.open("demo", session="a", scenario=scenario, outputs=outputs)
                answered.append(session.reset(seed=0).metadata.frame_hash)
                while True:
                    if len(answered) == 20:
                        killer.start()
                    action = wildcity.Action(acceleration=-0.5, curvature=0.0)
                    answered.append(session.step(action).metadata.frame_hash)
        server.wait()
        server.stdout.close()
        record = folder / "a-1.jsonl"
        frames = [line for line in lines_of(record) if line["kind"] == "frame"]
        recorded = [frame["frame_hash"] for frame in frames]
        # Every answer that was sent is on record; beside them at most the step under way.
        assert recorded[: len(answered)] == answered and len(recorded) <= len(answered) + 1
        verified = subprocess.run(
            ["wildcity", "episode", "verify", str(record)], env=quick_reader, capture_output=True, text=True
        )
        assert verified.returncode == 3, f"{verified.stdout}\n{verified.stderr}"
        assert f"verified to step {frames[-1]['step']}" in verified.stderr, verified.stderr
