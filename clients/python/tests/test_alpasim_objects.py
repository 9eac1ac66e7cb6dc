"""The AlpaSim door: `dynamic_objects` of requests for images."""

from __future__ import annotations

import json
import os
import subprocess
import zipfile
from typing import Any

import numpy as np
import pytest
import wildcity
from carla_driver_interface._proto import sensorsim_pb2
from test_alpasim import FORWARD, HERE, ORIGIN, SCENE, Door, decoded, door, pinhole, request, thing
from wildcity import Camera, Outputs, Pose, Rig


def test_an_object_with_an_asset_equals_the_actor_of_a_scenario(door: Door) -> None:
    """Byte for byte what a session's `observe` shows of the same car at the same place."""
    http = door.url.replace("ws://", "http://").removesuffix("/v1/session")
    sedan = wildcity.actor("sedan", server=http)
    # The request has the middle of the box, the scenario the ground under it.
    ground_m = 1.0 - 0.5 * sedan.box.height_m
    yaw = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
    scenario = {
        "format": "wildcity.scenario/1",
        "name": "one",
        "twin": {"name": "corridor"},
        "ego": {"start": {"trajectory": "log", "station_m": 0.0}},
        "actors": [{"name": "car", "asset": "sedan", "stand": {"xyz": [12.0, 0.25, ground_m], "q": [1, 0, 0, 0]}}],
        "end": {"time_s": 1.0},
    }
    camera = Camera("front", 96, 64, 60.0, 60.0, 48.0, 32.0, ORIGIN)
    outputs = Outputs(encoding="png")
    with wildcity.connect(door.url) as client:
        with client.open("corridor", rig=Rig("one", (camera,)), outputs=outputs, scenario=scenario) as session:
            session.reset(seed=0)
            seen = session.observe([Pose(HERE, FORWARD)])
    expected = bytes(seen.encoded(seen.metadata.images[0]))
    by_name = door.stub.render_rgb(request(dynamic_objects=[thing("7@sedan", (12.0, 0.25, 1.0))]))
    assert by_name.image_bytes == expected
    by_hash = door.stub.render_rgb(request(dynamic_objects=[thing(f"7@{sedan.hash}", (12.0, 0.25, 1.0))]))
    assert by_hash == by_name
    turned = door.stub.render_rgb(request(dynamic_objects=[thing("7@sedan", (12.0, 0.25, 1.0), yaw)]))
    assert turned != by_name
    assert by_name != door.stub.render_rgb(request())


def blue(image: Any) -> Any:
    """Where an image shows a blue thing: the walls are red and green."""
    return (image[..., 2].astype(int) - image[..., :2].max(axis=-1)) > 40


def test_an_object_without_an_asset_is_a_box_of_its_size_and_colour(door: Door) -> None:
    """The box projected by hand: 4 m long, 2 m wide, 1.5 m high, its rear face 8 m ahead."""
    large = {"camera_intrinsics": pinhole(192, 128), "resolution_w": 192, "resolution_h": 128}
    # The focal length is 60 px at this size.
    box = thing("7@4x2x1.5#0000ff", (HERE[0] + 10.0, HERE[1], HERE[2]))
    image = decoded(door.stub.render_rgb(request(dynamic_objects=[box], **large)).image_bytes)
    rows, columns = np.nonzero(blue(image))
    half_px = 60.0 / 8.0
    assert (columns.min(), columns.max() + 1) == pytest.approx((96 - half_px, 96 + half_px), abs=1.5)
    assert (rows.min(), rows.max() + 1) == pytest.approx((64 - 0.75 * half_px, 64 + 0.75 * half_px), abs=1.5)
    # A face that looks backwards has 0.7 of the colour.
    assert image[64, 96] == pytest.approx((0, 0, 0.7 * 255), abs=20)
    # Without a size it is a grey car.
    bare = thing("7", (HERE[0] + 10.0, HERE[1], HERE[2]))
    image = decoded(door.stub.render_rgb(request(dynamic_objects=[bare])).image_bytes)
    assert image[32, 48] == pytest.approx((90, 90, 90), abs=15)


def test_images_of_a_batch_have_their_own_objects(door: Door) -> None:
    item = sensorsim_pb2.BatchRGBRenderRequestItem
    box = [thing("7@4x2x1.5#0000ff", (12.0, 0.25, 1.5))]
    other = [thing("7@4x2x1.5#0000ff", (14.0, 0.25, 1.5)), thing("8@sedan", (9.0, -0.75, 0.75))]
    wrong = [thing("7@nothing")]
    requests = [request(), request(dynamic_objects=box), request(dynamic_objects=other), request(dynamic_objects=box)]
    items = [item(camera_name=f"c{k}", request=one) for k, one in enumerate(requests)]
    items.insert(1, item(camera_name="wrong", request=request(dynamic_objects=wrong)))
    answer = door.stub.batch_render_rgb(sensorsim_pb2.BatchRGBRenderRequest(items=items))
    assert [(one.camera_name, one.success) for one in answer.items] == [
        ("c0", True),
        ("wrong", False),
        ("c1", True),
        ("c2", True),
        ("c3", True),
    ]
    assert "nothing" in answer.items[1].error_message
    images = [one.result for one in answer.items if one.success]
    assert images == [door.stub.render_rgb(one) for one in requests]
    assert images[1] == images[3] and len({image.image_bytes for image in images}) == 3


def test_an_object_moves_while_the_rows_are_exposed(door: Door) -> None:
    spec = pinhole()
    spec.shutter_type = sensorsim_pb2.ShutterType.ROLLING_TOP_TO_BOTTOM
    left, right = (9.0, 1.25, 1.5), (9.0, -0.75, 1.5)
    moving = thing("7@1x1x3#0000ff", right, start=left)
    asked = request(camera_intrinsics=spec, dynamic_objects=[moving])
    rolled = blue(decoded(door.stub.render_rgb(asked).image_bytes))
    still = blue(decoded(door.stub.render_rgb(request(dynamic_objects=[moving])).image_bytes))
    at_end = blue(decoded(door.stub.render_rgb(request(dynamic_objects=[thing(moving.track_id, right)])).image_bytes))
    # A global shutter takes the pose at the end alone.
    assert np.array_equal(still, at_end)

    def middle(mask: Any, row: int) -> float:
        return float(np.nonzero(mask[row])[0].mean())

    # The rear face is 5.5 m ahead, so that 2 m aside are 22 px over all 64 rows.
    assert middle(at_end, 24) == pytest.approx(middle(at_end, 40), abs=0.6)
    assert middle(rolled, 40) - middle(rolled, 24) == pytest.approx(22 * 16 / 64, abs=1.5)
    assert middle(rolled, 40) < middle(at_end, 40)


def test_exported_tracks_are_drawn(door: Door) -> None:
    """The renderer draws the ids that the export writes into a scene's file."""
    binary = os.environ["WILDCITY_BIN"]
    keyframes = [
        {"time_us": 100_000 * k, "pose": {"xyz": [6.0 + 0.25 * k, 0.0, 0.25], "q": [1, 0, 0, 0]}} for k in range(21)
    ]
    track = {"id": "van", "class": "vehicle", "size": [4.0, 1.75, 1.5], "keyframes": keyframes}
    tracks = {"format": "wildcity.tracks/1", "tracks": [track]}
    (door.folder / "tracks.json").write_text(json.dumps(tracks))
    exporting = [binary, "alpasim", "export", "corridor", "--out", str(door.folder / "scenes")]
    exporting += ["--twins", str(door.folder / "twins"), "--tracks", str(door.folder / "tracks.json")]
    subprocess.run(exporting, check=True, timeout=60, stdout=subprocess.DEVNULL)
    with zipfile.ZipFile(door.folder / "scenes" / f"{SCENE}.usdz") as archive:
        (sequence,) = json.loads(archive.read("sequence_tracks.json")).values()
    data = sequence["tracks_data"]
    x, y, z, qx, qy, qz, qw = data["tracks_poses"][0][8]
    drawn = thing(data["tracks_id"][0], (x, y, z), (qw, qx, qy, qz))
    by_hand = thing("van@4x1.75x1.5", (8.0, 0.0, 1.0))
    image = door.stub.render_rgb(request(dynamic_objects=[drawn]))
    assert image == door.stub.render_rgb(request(dynamic_objects=[by_hand])) != door.stub.render_rgb(request())
