"""Sweeps of LiDARs in MCAP files, as readers of Foxglove and of ROS 2 decode them."""

from __future__ import annotations

import io
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import wildcity
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_episode_records import walk
from wildcity import ImagePart, Outputs

SPEED_M_S = 30.0
STEPS = 3

# `NumericType` of Foxglove, and `datatype` of ROS 2.
FOXGLOVE = {3: "<u2", 6: "<i4", 7: "<f4"}
ROS = {4: "<u2", 5: "<i4", 7: "<f4"}


class Drive:
    """A record of a drive along the demo street with a LiDAR, and the sweeps that were sent."""

    def __init__(self, environment: dict[str, str], folder: Path) -> None:
        self.environment = environment
        self.folder = folder
        command = ["wildcity", "serve", "--listen", "127.0.0.1:0", "--episodes", str(folder)]
        server = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert server.stdout is not None
        url = next(line.split()[-1] for line in server.stdout if line.startswith("listening on ws"))
        try:
            small = Outputs(cameras=("front",), images={"front": ImagePart(size=(64, 40))}, semantics=True)
            with (
                wildcity.connect(url) as client,
                client.open("demo", rig="vehicle6-lidar", outputs=small, session="sweeps") as session,
            ):
                self.seen = [session.reset()]
                start = self.seen[0].ego.pose
                for step in range(1, STEPS + 1):
                    ahead = wildcity.Pose.flat(0.1 * SPEED_M_S * step, 0.0, 0.0)
                    self.seen.append(session.step(start @ ahead))
        finally:
            server.terminate()
            server.communicate()

    def export(self, *options: str) -> bytes:
        mcap = self.folder / "sweeps.mcap"
        command = ["wildcity", "episode", "export", str(self.folder / "sweeps-1.jsonl"), "--mcap", str(mcap), *options]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert f"sweeps      {STEPS + 1}" in done.stdout and "differs" not in done.stdout, done.stdout
        return mcap.read_bytes()


@pytest.fixture(scope="module")
def drive(quick_reader: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return Drive(quick_reader, tmp_path_factory.mktemp("sweeps"))


def table(data: bytes, stride: int, fields: list[tuple[str, int, str]]) -> NDArray[Any]:
    names, offsets, formats = zip(*fields, strict=True)
    kind = np.dtype({"names": names, "offsets": offsets, "formats": formats, "itemsize": stride})
    return np.frombuffer(data, kind)


def check(drive: Drive, sweeps: list[NDArray[Any]]) -> None:
    """The points are those that were sent, moved by what the ego drove after each was measured."""
    assert len(sweeps) == len(drive.seen)
    for step, (found, seen) in enumerate(zip(sweeps, drive.seen, strict=True)):
        sent = seen.lidars["top"]
        assert len(found) == len(sent.points) > 10_000
        assert np.array_equal(found["row"], sent.rows)
        assert np.array_equal(found["column"], sent.columns)
        assert np.array_equal(found["instance"], sent.instances)
        assert sent.classes is not None and len(np.unique(sent.classes)) > 3
        assert np.array_equal(found["class"], sent.classes)
        assert np.array_equal(found["intensity"], sent.intensity)
        end_us = seen.metadata.time_us
        assert np.abs(found["offset_us"] + end_us - sent.times_us).max() <= 1
        # The ego is at rest before the first step.
        moved_m = SPEED_M_S * 1e-6 * found["offset_us"] if step > 0 else np.zeros(len(found))
        points = np.stack([found[axis] for axis in "xyz"], axis=1)
        expected = sent.points + np.stack([moved_m, 0 * moved_m, 0 * moved_m], axis=1)
        assert np.abs(points - expected).max() < 1e-3
        assert step == 0 or np.abs(moved_m).max() > 2.9


def test_foxglove_finds_point_clouds(drive: Drive) -> None:
    reader = make_reader(io.BytesIO(drive.export("--lidar")), validate_crcs=True, decoder_factories=[DecoderFactory()])
    clouds = []
    for schema, _, message, cloud in reader.iter_decoded_messages(topics=["/lidar/0/points"]):
        assert schema is not None
        assert schema.name == "foxglove.PointCloud" and cloud.frame_id == "rig"
        assert message.log_time == cloud.timestamp.seconds * 10**9 + cloud.timestamp.nanos
        fields = [(field.name, field.offset, FOXGLOVE[field.type]) for field in cloud.fields]
        clouds.append(table(cloud.data, cloud.point_stride, fields))
    check(drive, clouds)


def test_ros_2_finds_point_clouds(drive: Drive) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    reader = make_reader(io.BytesIO(drive.export("--lidar", "--images", "--ros2")), validate_crcs=True)
    clouds = []
    topics = set()
    for schema, channel, message in reader.iter_messages():
        assert schema is not None
        topics.add(channel.topic)
        for name, definition in get_types_from_msg(schema.data.decode(), schema.name).items():
            assert definition == store.fielddefs[name], name
        if channel.topic == "/lidar/top/points":
            cloud: Any = store.deserialize_cdr(message.data, schema.name)
            # Nothing follows the last field.
            assert bytes(store.serialize_cdr(cloud, schema.name)) == message.data
            assert cloud.header.frame_id == "base_link" and cloud.is_dense and not cloud.is_bigendian
            assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data)
            fields = [(field.name, field.offset, ROS[field.datatype]) for field in cloud.fields]
            clouds.append(table(cloud.data.tobytes(), cloud.point_step, fields))
    assert "/camera/front/compressed" in topics
    check(drive, clouds)


def test_a_rig_without_lidar_is_refused(drive: Drive, tmp_path: Path) -> None:
    record = walk(tmp_path, drive.environment)
    command = ["wildcity", "episode", "export", str(record), "--mcap", str(tmp_path / "none.mcap"), "--lidar"]
    done = subprocess.run(command, env=drive.environment, capture_output=True, text=True)
    assert done.returncode != 0 and "has no LiDAR" in done.stderr, done.stderr
    assert not (tmp_path / "none.mcap").exists()
