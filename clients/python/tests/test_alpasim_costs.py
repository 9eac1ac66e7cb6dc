"""The table of costs of AlpaSim's services, measured: the server gets the worst request of each method, and its memory,
its processor time and what it writes to the disk are compared with the method's row."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import grpc
import pytest
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from test_alpasim import SCENE, Door, door, pinhole, request, sweep

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the memory of a process is read from /proc")

PAGE = Path(__file__).parents[3] / "docs/reference/alpasim-costs.md"
MIB = 1 << 20
MESSAGE_BYTES = 64 * MIB
MESSAGES = 1 << 16
FIRST_TIME = 8 * MIB
"""Pages of code that run for the first time, and of threads that start."""

REPEATED = {
    "render_rgb": 8,
    "batch_render_rgb": 1,
    "render_aggregated": 1,
    "render_lidar": 6,
    "ground_intersection": 5,
}
"""The field of each request that may have the most messages."""


@dataclass(frozen=True)
class Row:
    memory: float
    seconds: float
    disk: float


def rows() -> dict[str, Row]:
    found = re.findall(r"^\| `(\w+)` \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|", PAGE.read_text(), re.MULTILINE)
    return {of: Row(float(memory) * MIB, float(seconds), float(disk) * MIB) for of, memory, seconds, disk in found}


ROWS = rows()


def status(door: Door, field: str) -> int:
    text = Path(f"/proc/{door.process.pid}/status").read_text()
    line = next(line for line in text.splitlines() if line.startswith(field))
    return int(line.split()[1]) << 10


def processor_s(door: Door) -> float:
    text = Path(f"/proc/{door.process.pid}/stat").read_text()
    return sum(map(int, text.rsplit(")", 1)[1].split()[11:13])) / os.sysconf("SC_CLK_TCK")


def disk_bytes(door: Door) -> int:
    return sum(path.stat().st_size for path in door.folder.rglob("*") if path.is_file())


def metric(door: Door, name: str) -> float:
    address = door.url.removeprefix("ws://").split("/")[0]
    with urlopen(f"http://{address}/metrics", timeout=30) as answer:
        text = answer.read().decode()
    found = re.search(rf"^{name} (\S+)", text, re.MULTILINE)
    assert found, f"no metric {name}"
    return float(found[1])


def reserved_bytes(door: Door) -> int:
    """Memory for the frames of open scenes, which the rows are in addition to."""
    return int(metric(door, "wildcity_residency_reserved_bytes"))


def check(of: str, door: Door, work: Callable[[], Any], beside: int = 0) -> Any:
    """Fails if some work takes more than the row of a method, and `beside` bytes of memory that are reserved."""
    Path(f"/proc/{door.process.pid}/clear_refs").write_text("5")
    memory, seconds, disk = status(door, "VmRSS:"), processor_s(door), disk_bytes(door)
    answer = work()
    memory = status(door, "VmHWM:") - memory
    seconds, disk = processor_s(door) - seconds, disk_bytes(door) - disk
    row = ROWS[of]
    allowed = f"{row.memory / MIB:.1f} + {beside / MIB:.1f} MiB"
    said = f"{of}: {memory / MIB:.1f} of {allowed}, {seconds:.2f} of {row.seconds} s"
    print(said)
    assert memory <= row.memory + beside + FIRST_TIME, said
    # The page has tenths. The first use of a version writes its lease, of a hundred bytes.
    assert disk <= row.disk + MIB / 10, f"{of}: {disk} bytes on the disk"
    # Whole seconds, rounded down.
    assert seconds < row.seconds + 1, said
    return answer


def varint(value: int) -> bytes:
    parts = []
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    return bytes([*parts, value])


def largest(method: str) -> bytes:
    """As many messages as a request may have, and an unknown field up to its largest size."""
    messages = b""
    if method in REPEATED:
        messages = (bytes([REPEATED[method] << 3 | 2, 0])) * MESSAGES
    room = MESSAGE_BYTES - len(messages) - 100
    return messages + bytes([15 << 3 | 2]) + varint(room) + bytes(room)


def send(door: Door, method: str, message: bytes) -> grpc.StatusCode:
    service = (
        "physics.PhysicsService" if method == "ground_intersection" else "nre.grpc.protos.sensorsim.SensorsimService"
    )
    call = door.channel.unary_unary(f"/{service}/{method}", lambda sent: sent, lambda received: received)
    try:
        call(message, timeout=60)
    except grpc.RpcError as refused:
        return refused.code()
    return grpc.StatusCode.OK


@pytest.mark.parametrize("method", ROWS)
def test_the_largest_request_costs_what_the_table_says(door: Door, method: str) -> None:
    message = largest(method)
    assert MESSAGE_BYTES - 200 < len(message) <= MESSAGE_BYTES
    code = check(method, door, lambda: send(door, method, message))
    # It was decoded, and refused for what it says at most.
    assert code in (grpc.StatusCode.OK, grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.NOT_FOUND), code


def raw(side: int) -> Any:
    lens = pinhole(side, side, "wide")
    raw = sensorsim_pb2.ImageFormat.RGB_UINT8_PLANAR
    return request(resolution_w=side, resolution_h=side, camera_intrinsics=lens, image_format=raw)


def test_the_largest_answers_cost_what_the_table_says(door: Door) -> None:
    """Images of 48 MiB in all, of an answer's 64."""
    item = sensorsim_pb2.BatchRGBRenderRequestItem
    batch = sensorsim_pb2.BatchRGBRenderRequest(items=[item(camera_name=f"c{k}", request=raw(1024)) for k in range(16)])
    aggregated = sensorsim_pb2.AggregatedRenderRequest(rgb_requests=[raw(1024)] * 12, lidar_requests=[sweep()])
    # Opens the scene.
    door.stub.render_rgb(request())
    large = raw(4096)
    image = check("render_rgb", door, lambda: door.stub.render_rgb(large), reserved_bytes(door))
    assert len(image.image_bytes) == 48 * MIB
    answer = check("batch_render_rgb", door, lambda: door.stub.batch_render_rgb(batch), reserved_bytes(door))
    assert sum(len(one.result.image_bytes) for one in answer.items) == 48 * MIB
    answer = check("render_aggregated", door, lambda: door.stub.render_aggregated(aggregated), reserved_bytes(door))
    assert len(answer.rgb_returns) == 12 and answer.lidar_returns[0].num_points > 1_000
    swept = check("render_lidar", door, lambda: door.stub.render_lidar(sweep()), reserved_bytes(door))
    assert swept.num_points > 1_000
    # To put the planes of 48 MiB one after the other on a thread that answers took a second of this build.
    longest = metric(door, "wildcity_poll_longest_seconds")
    assert longest < 0.3, f"a task held a thread that answers for {longest} s"


def test_the_longest_lists_cost_what_the_table_says(door: Door) -> None:
    asked = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id=SCENE)
    check("get_available_trajectories", door, lambda: door.stub.get_available_trajectories(asked))
    check("get_available_scenes", door, lambda: door.stub.get_available_scenes(common_pb2.Empty()))
