"""The truth of the miniature logs: a rig, a drive and points; and readers of what a conversion wrote."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation, Slerp
from wildcity.logs.__main__ import main

Array = npt.NDArray[Any]

CAMERA_AXES = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])
"""rig_from_camera of a camera that looks ahead: its z is the rig's x, its x the rig's -y."""


def matrix(xyz: Any, turn: Rotation) -> Array:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = turn.as_matrix(), xyz
    return made


def mount(x: float, y: float, z: float, yaw_deg: float, pitch_deg: float = 0.0) -> Array:
    """rig_from_camera of a camera with this heading."""
    return matrix([x, y, z], Rotation.from_euler("ZY", [yaw_deg, pitch_deg], degrees=True) * CAMERA_AXES)


def wxyz(pose: Array) -> list[float]:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return [float(w), float(x), float(y), float(z)]


def drive(seconds: float, start: tuple[float, float, float] = (1010.3, 610.7, 0.0)) -> Array:
    """world_from_rig at a time: a curve with a changing speed, some pitch and some roll."""
    s = 8 * seconds + 0.5 * seconds**2
    yaw = 0.02 * s + 0.3
    xyz = np.array(start) + [50 * np.sin(yaw), -50 * np.cos(yaw), 0.02 * s]
    turn = Rotation.from_euler("ZYX", [yaw, 0.01 * np.sin(seconds), 0.02 * np.cos(2 * seconds)])
    return matrix(xyz, turn)


def points_seen(k: Array, size: tuple[int, int], count: int = 100, seed: int = 1, margin: float = 0.15) -> Array:
    """Points [count, 3] in the axes of a camera that a pinhole sees, away from the border by a share of the size."""
    random = np.random.default_rng(seed)
    u = random.uniform(margin, 1 - margin, count) * size[0]
    v = random.uniform(margin, 1 - margin, count) * size[1]
    z = random.uniform(3, 60, count)
    return np.stack([(u - k[0, 2]) / k[0, 0] * z, (v - k[1, 2]) / k[1, 1] * z, z], axis=1)


def moved(pose: Array, points: Array) -> Array:
    return points @ pose[:3, :3].T + pose[:3, 3]


class Log:
    """A log as it was written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.head = json.loads((folder / "log.json").read_text())
        self.rig = {one["name"]: one for one in json.loads((folder / "rig.json").read_text())["cameras"]}
        self.epoch_us = self.head["clock"]["epoch_us"]
        self.origin = np.array(self.head["world"]["origin_m"])

    def rows(self, table: str) -> list[dict[str, Any]]:
        path = self.folder / f"{table}.jsonl"
        found = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        times = [row["time_us"] for row in found]
        assert times == sorted(times)
        return found

    def times(self, table: str, **values: Any) -> list[int]:
        """Times on the source's clock of rows with these values."""
        rows = [row for row in self.rows(table) if all(row[key] == value for key, value in values.items())]
        return [row["time_us"] + self.epoch_us for row in rows]

    def pose(self, value: dict[str, Any], is_world: bool = True) -> Array:
        w, x, y, z = value["q"]
        return matrix(np.array(value["xyz"]) + is_world * self.origin, Rotation.from_quat([x, y, z, w]))

    def poses(self) -> dict[int, Array]:
        """world_from_rig in the source's world, by time on its clock."""
        return {row["time_us"] + self.epoch_us: self.pose(row["world_from_rig"]) for row in self.rows("poses")}

    def between(self, times_us: Array) -> tuple[Array, Rotation]:
        """Positions [n, 3] and rotations at times on the source's clock: linear, and SLERP."""
        known = self.poses()
        keys = np.array(sorted(known), np.float64)
        xyz = np.array([known[int(key)][:3, 3] for key in keys])
        turns = Slerp(keys, Rotation.from_matrix([known[int(key)][:3, :3] for key in keys]))
        return np.stack([np.interp(times_us, keys, xyz[:, axis]) for axis in range(3)], 1), turns(times_us)

    def sweep_in_world(self, row: dict[str, Any]) -> tuple[Array, Array]:
        """Points of a sweep in the source's world, each by the pose at its own time, and these times."""
        tensors = load_file(self.folder / row["file"])
        points, times = tensors["points_m"].astype(np.float64), tensors["time_us"] + self.epoch_us
        assert (np.diff(times) >= 0).all() and row["until_us"] + self.epoch_us == times[-1]
        assert row["time_us"] + self.epoch_us == times[0]
        mounts = {one["name"]: one["rig_from_lidar"] for one in self.head["lidars"]}
        in_rig = moved(self.pose(mounts[row["lidar"]], is_world=False), points)
        at = times if "compensated_to_us" not in row else np.full(len(times), row["compensated_to_us"] + self.epoch_us)
        xyz, turns = self.between(at)
        return xyz + turns.apply(in_rig), times

    def project(self, camera: str, world_from_rig: Array, points: Array) -> Array:
        """Pixels [n, 2] of points in the source's world, by the formulas of docs/cameras.md."""
        one = self.rig[camera]
        world_from_camera = world_from_rig @ self.pose(one["camera_to_rig"], is_world=False)
        x, y, z = moved(np.linalg.inv(world_from_camera), points).T
        lens = one.get("lens")
        if lens is None or lens["model"] == "opencv":
            a, b = _opencv(x / z, y / z, lens or {"k": [0] * 6})
        elif lens["model"] == "fisheye":
            theta = np.arctan2(np.hypot(x, y), z)
            assert (theta <= lens["max_angle"]).all()
            bent = theta * (1 + sum(k * theta ** (2 * n + 2) for n, k in enumerate(lens["k"])))
            a, b = bent * x / np.hypot(x, y), bent * y / np.hypot(x, y)
        else:
            return _ftheta(one, x, y, z)
        return np.stack([one["fx"] * a + one["cx"], one["fy"] * b + one["cy"]], axis=1)


def _opencv(a: Array, b: Array, lens: dict[str, Any]) -> tuple[Array, Array]:
    k1, k2, k3, k4, k5, k6 = lens["k"]
    p1, p2 = lens.get("p", (0, 0))
    r2 = a * a + b * b
    c = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    s1, s2, s3, s4 = lens.get("s", (0, 0, 0, 0))
    u = a * c + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + s1 * r2 + s2 * r2 * r2
    return u, b * c + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b + s3 * r2 + s4 * r2 * r2


def _ftheta(one: dict[str, Any], x: Array, y: Array, z: Array) -> Array:
    lens = one["lens"]
    assert lens["reference"] == "angle_to_pixel"
    theta = np.arctan2(np.hypot(x, y), z)
    rho = np.polynomial.polynomial.polyval(theta, lens["polynomial"])
    c, d, e = lens.get("linear_cde", (1, 0, 0))
    bent = np.stack([rho * x / np.hypot(x, y), rho * y / np.hypot(x, y)])
    return np.asarray((np.array([[c, d], [e, 1]]) @ bent).T + [one["cx"], one["cy"]])


def same_poses(log: Log, truth: dict[int, Array]) -> None:
    """The log has these poses at these times, and no others, within 1e-6 m and 1e-6 rad."""
    found = log.poses()
    assert sorted(found) == sorted(truth)
    for time_us, pose in truth.items():
        np.testing.assert_allclose(found[time_us], pose, rtol=0, atol=1e-6)


def image_bytes(number: int, suffix: str = ".jpg") -> bytes:
    """A small image that no other number gives."""
    pixels = np.random.default_rng(number).integers(0, 255, (9, 16, 3), np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "JPEG" if suffix == ".jpg" else "PNG")
    return out.getvalue()


def run(*arguments: Any, code: int = 0) -> str:
    """Runs the command line in this process. Returns what it said."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        returned = main([str(argument) for argument in arguments])
    assert returned == code, f"{returned}\n{said.getvalue()}"
    return said.getvalue()


_KILLED = """
import os, sys
from wildcity.logs.__main__ import main
from wildcity.logs.writer import LogWriter

original, files = LogWriter.payload, 0

def payload(*arguments):
    global files
    files += 1
    if files > int(sys.argv[1]):
        os.kill(os.getpid(), 9)
    return original(*arguments)

LogWriter.payload = payload
main(sys.argv[2:])
"""


def run_and_kill(after: int, *arguments: Any) -> None:
    """Runs the command line in a process that is killed after so many files."""
    words = [sys.executable, "-c", _KILLED, after, *arguments]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=120)
    assert done.returncode == -signal.SIGKILL, f"{done.returncode}\n{done.stdout}\n{done.stderr}"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def killed_and_resumed(tmp: Path, whole: Path, *arguments: Any, after: int = 3, again: int | None = None) -> None:
    """A run that is killed leaves no OUT; the same command then writes what `whole` has, byte for byte.

    after: files after which it is killed. again: files after which the next run is killed, too.
    """
    out = tmp / "resumed"
    run_and_kill(after, *arguments, "--out", out)
    assert not out.exists()
    partial = out.with_name("resumed.partial")
    with (partial / "done.jsonl").open("ab") as journal:
        journal.write(b'{"file": "images/to')  # As a kill within the write of a line leaves it.
    if again is not None:
        run_and_kill(again, *arguments, "--out", out)
    assert f"went on: {again or after} files were whole" in run(*arguments, "--out", out)
    assert contents(out) == contents(whole)
    assert not partial.exists()


def refused(tmp: Path, *arguments: Any) -> str:
    """The error of a conversion, which leaves no OUT."""
    out = tmp / "refused"
    text = run(*arguments, "--out", out, code=1)
    assert not out.exists() and text.count("error: ") == 1, text
    return text[text.index("error: ") :]


def judge(program: str, given: dict[str, Any]) -> Any:
    """What a program prints as JSON, run by the Python of `WILDCITY_LOG_JUDGES`, which has the devkits."""
    python = os.environ.get("WILDCITY_LOG_JUDGES")
    if not python:
        pytest.skip("set WILDCITY_LOG_JUDGES to a Python that has nuscenes-devkit and av2: they need packages of 3 GB")
    words = [python, "-c", f"import json, sys\ngiven = json.load(sys.stdin)\n{program}"]
    done = subprocess.run(words, input=json.dumps(given), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
