"""Episodes as MCAP of ROS 2, read by `rosbags`, which has the messages of ROS 2 by itself."""

from __future__ import annotations

import io
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_episode_records import lines_of, walk


@pytest.fixture(scope="module")
def exported(
    quick_reader: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[dict[str, Any]], bytes]:
    """The frames of a record, and the same episode with images for ROS 2."""
    folder = tmp_path_factory.mktemp("ros2")
    record = walk(folder, quick_reader)
    mcap = folder / "walk.mcap"
    command = ["wildcity", "episode", "export", str(record), "--mcap", str(mcap), "--images", "--ros2"]
    subprocess.run(command, env=quick_reader, check=True, capture_output=True)
    frames = [line for line in lines_of(record) if line["kind"] == "frame"]
    return frames, Path(mcap).read_bytes()


def test_every_message_is_one_of_ros2(exported: tuple[list[dict[str, Any]], bytes]) -> None:
    frames, data = exported
    store = get_typestore(Stores.ROS2_HUMBLE)
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    assert reader.get_header().profile == "ros2"
    messages: list[tuple[str, Any]] = []
    times = []
    for schema, channel, message in reader.iter_messages():
        assert schema is not None
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        for name, definition in get_types_from_msg(schema.data.decode(), schema.name).items():
            assert definition[1] == store.fielddefs[name][1], name
        messages.append((channel.topic, store.deserialize_cdr(message.data, schema.name)))
        # Nothing follows the last field.
        assert bytes(store.serialize_cdr(messages[-1][1], schema.name)) == message.data
        times.append(message.log_time)
    assert times == sorted(times)

    def of(topic: str) -> list[Any]:
        return [content for found, content in messages if found == topic]

    counts = Counter(topic for topic, _ in messages)
    images = of("/camera/front/compressed")
    assert counts["/clock"] == counts["/tf"] == counts["/odometry"] == len(frames)
    assert counts["/plan"] == len(frames) - 1
    assert len(images) == sum(len(frame["images"]) for frame in frames)
    assert counts["/camera/front/camera_info"] == len(images) + 1

    position = of("/odometry")[-1].pose.pose.position
    assert [position.x, position.y, position.z] == frames[-1]["poses"][-1]["xyz"]
    rotation = of("/tf")[-1].transforms[0].transform.rotation
    assert [rotation.w, rotation.x, rotation.y, rotation.z] == frames[-1]["poses"][-1]["q"]
    speeds = [odometry.twist.twist.linear.x for odometry in of("/odometry")]
    assert abs(np.median(speeds) - 10) < 2
    info = of("/camera/front/camera_info")[0]
    assert (info.width, info.height, info.distortion_model) == (64, 40, "plumb_bob")
    assert info.header.frame_id == of("/tf_static")[0].transforms[0].child_frame_id
    assert all(bytes(image.data[:2]) == b"\xff\xd8" and image.format == "jpeg" for image in images)
    assert len({bytes(image.data) for image in images}) > 1
