"""The frames of a bag: /tf and /tf_static as a tree, with interpolated transforms (tf2: linear, and SLERP)."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .errors import LogError
from .frames import Matrix, Poses, inverse, transform

__all__ = ["Tree", "matrix_of"]


def matrix_of(position: Any, orientation: Any) -> Matrix:
    """The transform [4, 4] of geometry_msgs' position or translation, and its quaternion (x, y, z, w)."""
    q = (orientation.w, orientation.x, orientation.y, orientation.z)
    if not np.isfinite(q).all() or abs(float(np.linalg.norm(q)) - 1) > 1e-2:
        raise ValueError(f"the quaternion (w, x, y, z) {tuple(map(float, q))} has not the length 1")
    return transform((position.x, position.y, position.z), q)


@dataclass
class _Edge:
    """parent_from_child over time: times in nanoseconds, and 7 numbers (x, y, z, w, x, y, z) for each."""

    parent: str
    is_static: bool
    times_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    poses: Poses | None = None

    def add(self, time_ns: int, parent_from_child: list[float]) -> None:
        self.times_ns.append(time_ns)
        self.values.extend(parent_from_child)

    def matrix(self, index: int) -> Matrix:
        seven = self.values[7 * index : 7 * index + 7]
        return transform(seven[:3], seven[3:])

    def at(self, time_ns: int) -> Matrix | None:
        """The transform at a time, or None if the edge does not cover it."""
        if self.is_static:
            return self.matrix(0)
        if self.poses is None:
            self.poses = Poses(self.times_ns, [self.matrix(index) for index in range(len(self.times_ns))])
        return self.poses.at(time_ns) if self.poses.covers(time_ns) else None


class Tree:
    """Frames by name, each with its parent."""

    def __init__(self, place: str) -> None:
        self.place = place
        self.edges: dict[str, _Edge] = {}

    def add(self, message: Any, is_static: bool) -> None:
        """Adds the transforms of a tf2_msgs/TFMessage."""
        for one in message.transforms:
            child, parent = one.child_frame_id.lstrip("/"), one.header.frame_id.lstrip("/")
            place = f"{self.place}, tf {parent} -> {child}"
            stamp = one.header.stamp
            time_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
            try:
                matrix_of(one.transform.translation, one.transform.rotation)
            except ValueError as error:
                raise LogError(place, str(error), "repair the publisher of this transform") from None
            edge = self.edges.setdefault(child, _Edge(parent, is_static))
            if edge.parent != parent or edge.is_static != is_static:
                raise LogError(place, f"{child} also has the parent {edge.parent}", "record one tree of frames")
            if edge.times_ns and (is_static or time_ns == edge.times_ns[-1]):
                continue  # A static transform is sent again, or one of a time that is known.
            if edge.times_ns and time_ns < edge.times_ns[-1]:
                problem = f"the clock runs backwards, from {edge.times_ns[-1]} to {time_ns} ns"
                raise LogError(place, problem, "cut the bag there, or repair the clock")
            move, turn = one.transform.translation, one.transform.rotation
            edge.add(time_ns, [move.x, move.y, move.z, turn.w, turn.x, turn.y, turn.z])

    def up(self, frame: str) -> Iterator[str]:
        """The frame, its parent, and so on to the root."""
        seen: set[str] = set()
        while frame not in seen:
            seen.add(frame)
            yield frame
            if frame not in self.edges:
                return
            frame = self.edges[frame].parent
        raise LogError(self.place, f"the frames of tf form a ring at {frame}", "record one tree of frames")

    def static(self, target: str, source: str, what: str) -> Matrix:
        """target_from_source, where all transforms between them are static. what: for the error."""
        chain = self._chain(target, source)
        if chain is None:
            known = ", ".join(sorted({*self.edges, *(edge.parent for edge in self.edges.values())})) or "none"
            problem = f"no transform from {target} to {source}, the frame of {what}; frames: {known}"
            fix = "record /tf_static, choose --rig-frame, or leave the topic out with --leave-out TOPIC"
            raise LogError(f"{self.place}, tf_static", problem, fix)
        moving = [child for child in {*chain[0], *chain[1]} if not self.edges[child].is_static]
        if moving:
            problem = f"{what} moves on the rig: the transform of {moving[0]} is not static"
            raise LogError(f"{self.place}, tf", problem, "choose another --rig-frame")
        ups = [np.eye(4), np.eye(4)]
        for side in (0, 1):
            for child in chain[side]:
                ups[side] = self.edges[child].matrix(0) @ ups[side]
        return inverse(ups[0]) @ ups[1]

    def _chain(self, target: str, source: str) -> tuple[list[str], list[str]] | None:
        """The edges from each frame up to their nearest common one, named by their children."""
        over_target, over_source = list(self.up(target)), list(self.up(source))
        for index, frame in enumerate(over_source):
            if frame in over_target:
                return over_target[: over_target.index(frame)], over_source[:index]
        return None

    def poses(self, world: str, rig: str) -> Iterator[tuple[int, Matrix | None]]:
        """world_from_rig at each time of the moving transform nearest to the rig: time in nanoseconds, and the pose.

        Other transforms between them are interpolated. None where one of them does not cover the time.
        """
        chain = self._chain(world, rig)
        if chain is None or chain[0]:
            raise LogError(f"{self.place}, tf", f"{rig} is not below {world}", "choose --world-frame and --rig-frame")
        moving = [child for child in chain[1] if not self.edges[child].is_static]
        if not moving:
            problem = f"nothing moves between {world} and {rig}"
            raise LogError(f"{self.place}, tf", problem, "choose --world-frame and --rig-frame, or --odometry")
        for time_ns in self.edges[moving[0]].times_ns:
            pose: Matrix | None = np.eye(4)
            for child in chain[1]:
                step = self.edges[child].at(time_ns)
                pose = None if pose is None or step is None else step @ pose
            yield time_ns, pose
