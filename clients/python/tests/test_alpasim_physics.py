"""AlpaSim's `physics`: boxes on the ground. Its messages are described here by hand, from the published field
numbers."""

from __future__ import annotations

from typing import Any

import grpc
import pytest
from carla_driver_interface._proto import common_pb2
from google.protobuf import descriptor_pb2, descriptor_pool
from google.protobuf.message_factory import GetMessageClass
from test_alpasim import SCENE, Door, door, pose

OPTIONAL, REPEATED = (
    descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL,
    descriptor_pb2.FieldDescriptorProto.LABEL_REPEATED,
)
STRING, FIXED64 = descriptor_pb2.FieldDescriptorProto.TYPE_STRING, descriptor_pb2.FieldDescriptorProto.TYPE_FIXED64
INT32 = descriptor_pb2.FieldDescriptorProto.TYPE_INT32
"""The wire of an enum is that of an int32."""

MESSAGES: dict[str, list[tuple[str, int, Any, int]]] = {
    "PosePair": [("now_pose", 1, ".common.Pose", OPTIONAL), ("future_pose", 2, ".common.Pose", OPTIONAL)],
    "EgoData": [
        ("aabb", 1, ".common.AABB", OPTIONAL),
        ("pose_pair", 2, ".PACKAGE.PosePair", OPTIONAL),
        ("ego_trajectory_aabb", 3, ".common.Trajectory", OPTIONAL),
    ],
    "OtherObject": [("aabb", 1, ".common.AABB", OPTIONAL), ("pose_pair", 2, ".PACKAGE.PosePair", OPTIONAL)],
    "Request": [
        ("scene_id", 1, STRING, OPTIONAL),
        ("now_us", 2, FIXED64, OPTIONAL),
        ("future_us", 3, FIXED64, OPTIONAL),
        ("ego_data", 4, ".PACKAGE.EgoData", OPTIONAL),
        ("other_objects", 5, ".PACKAGE.OtherObject", REPEATED),
    ],
    "ReturnPose": [("pose", 1, ".common.Pose", OPTIONAL), ("status", 2, INT32, OPTIONAL)],
    "Return": [
        ("ego_pose", 1, ".PACKAGE.ReturnPose", OPTIONAL),
        ("other_poses", 2, ".PACKAGE.ReturnPose", REPEATED),
        ("ego_trajectory_aabb", 4, ".common.Trajectory", OPTIONAL),
        ("ego_status", 5, INT32, REPEATED),
    ],
}
SUCCESSFUL_UPDATE, INSUFFICIENT_POINTS, HIGH_TRANSLATION, HIGH_ROTATION = 0, 2, 3, 4


def classes() -> dict[str, Any]:
    package = "wildcity_test_physics"
    common = common_pb2.DESCRIPTOR
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
    file.dependency.append(common.name)
    for name, fields in MESSAGES.items():
        message = file.message_type.add(name=name)
        for field, number, kind, label in fields:
            added = message.field.add(name=field, number=number, label=label)
            if isinstance(kind, str):
                added.type = descriptor_pb2.FieldDescriptorProto.TYPE_MESSAGE
                added.type_name = kind.replace(".PACKAGE", f".{package}").replace(".common", f".{common.package}")
            else:
                added.type = kind
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(common.serialized_pb)
    pool.AddSerializedFile(file.SerializeToString())
    return {name: GetMessageClass(pool.FindMessageTypeByName(f"{package}.{name}")) for name in MESSAGES}


PHYSICS = classes()


def call(door: Door, method: str, asked: Any, answer: Any) -> Any:
    invoke = door.channel.unary_unary(
        f"/physics.PhysicsService/{method}",
        request_serializer=lambda message: message.SerializeToString(),
        response_deserializer=answer.FromString,
    )
    return invoke(asked, timeout=30)


def ground(door: Door, **fields: Any) -> Any:
    return call(door, "ground_intersection", PHYSICS["Request"](**{"scene_id": SCENE, **fields}), PHYSICS["Return"])


def parsed(name: str, message: Any) -> Any:
    """A message of the package `common` in the pool of this file's messages."""
    field = next(
        f for m in MESSAGES for f in PHYSICS[m].DESCRIPTOR.fields if f.message_type and f.message_type.name == name
    )
    return GetMessageClass(field.message_type).FromString(message.SerializeToString())


def at(xyz: tuple[float, ...], q: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)) -> Any:
    return parsed("Pose", pose(xyz, q))


SIZE = parsed("AABB", common_pb2.AABB(size_x=4.0, size_y=2.0, size_z=1.5))
TILTED = (0.99875026, 0.04997917, 0.0, 0.0)
"""0.1 rad about x."""


def test_boxes_stand_on_the_ground_of_the_drive(door: Door) -> None:
    """The drive of the corridor is level, at z = 0."""
    poses = [at((3.0, 0.5, 1.25)), at((5.0, -0.5, 0.5), TILTED), at((5.0, 0.0, 4.0)), at((5.0, 90.0, 0.75))]
    steps = [common_pb2.PoseAtTime(timestamp_us=k) for k in range(4)]
    for step, one in zip(steps, poses, strict=True):
        step.pose.ParseFromString(one.SerializeToString())
    trajectory = parsed("Trajectory", common_pb2.Trajectory(poses=steps))
    pair = PHYSICS["PosePair"](now_pose=poses[2], future_pose=poses[0])
    ego = PHYSICS["EgoData"](aabb=SIZE, pose_pair=pair, ego_trajectory_aabb=trajectory)
    answer = ground(door, ego_data=ego, other_objects=[PHYSICS["OtherObject"](aabb=SIZE, pose_pair=pair)] * 2)
    assert [one.timestamp_us for one in answer.ego_trajectory_aabb.poses] == [0, 1, 2, 3]
    assert list(answer.ego_status) == [SUCCESSFUL_UPDATE, SUCCESSFUL_UPDATE, HIGH_TRANSLATION, INSUFFICIENT_POINTS]
    first, second, third, fourth = (one.pose for one in answer.ego_trajectory_aabb.poses)
    assert (first.vec.x, first.vec.y, first.vec.z) == pytest.approx((3.0, 0.5, 0.75), abs=1e-6)
    assert (second.vec.x, second.vec.y, second.vec.z) == pytest.approx((5.0, -0.5, 0.75), abs=1e-6)
    assert (second.quat.w, second.quat.x) == pytest.approx((1.0, 0.0), abs=1e-6)
    # Implausible corrections are refused: the pose is as it was.
    assert (third, fourth) == (poses[2], poses[3])
    for one in (answer.ego_pose, *answer.other_poses):
        assert (one.pose, one.status) == (first, SUCCESSFUL_UPDATE)
    assert len(answer.other_poses) == 2


def test_each_form_of_the_ego_is_answered_alone(door: Door) -> None:
    pair = PHYSICS["PosePair"](future_pose=at((3.0, 0.0, 1.0), (0.98, 0.199, 0.0, 0.0)))
    answer = ground(door, ego_data=PHYSICS["EgoData"](aabb=SIZE, pose_pair=pair))
    assert answer.ego_pose.status == HIGH_ROTATION and not answer.HasField("ego_trajectory_aabb")
    assert ground(door) == PHYSICS["Return"]()


def test_version_and_scenes_are_those_of_the_renderer(door: Door) -> None:
    empty = common_pb2.Empty()
    for method, answer in (
        ("get_version", common_pb2.VersionId),
        ("get_available_scenes", common_pb2.AvailableScenesReturn),
    ):
        assert call(door, method, empty, answer) == getattr(door.stub, method)(empty)
    with pytest.raises(grpc.RpcError) as refused:
        call(door, "shut_down", empty, common_pb2.Empty)
    assert refused.value.code() == grpc.StatusCode.UNIMPLEMENTED


@pytest.mark.parametrize(
    ("fields", "code", "text"),
    [
        ({"scene_id": "nowhere@1+log+0"}, "NOT_FOUND", "nowhere"),
        (
            {"ego_data": PHYSICS["EgoData"](pose_pair=PHYSICS["PosePair"]())},
            "INVALID_ARGUMENT",
            "ego_data.aabb is missing",
        ),
        ({"other_objects": [PHYSICS["OtherObject"](aabb=SIZE)]}, "INVALID_ARGUMENT", "future_pose is missing"),
    ],
)
def test_errors_name_what_is_wrong(door: Door, fields: dict[str, Any], code: str, text: str) -> None:
    with pytest.raises(grpc.RpcError) as refused:
        ground(door, **fields)
    assert (refused.value.code().name, text in refused.value.details()) == (code, True), refused.value.details()
