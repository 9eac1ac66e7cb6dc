"""Writes lidar.safetensors and lidar.json: points of a LiDAR that turns on a moving vehicle, in the world, and the
depth of an image against them.

    pip install numpy scipy safetensors
    python3 tests/eval/lidar.py

`tests/eval/lidar.rs` compares the points to 1e-9 m and the numbers to 1e-9 m.
"""

import json
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file
from scipy.spatial.transform import Rotation, Slerp

WIDTH, HEIGHT = 160, 90
FX, FY, CX, CY = 100.0, 104.0, 81.0, 43.0


def matrix(rotation, position):
    made = np.eye(4)
    made[:3, :3] = rotation.as_matrix()
    made[:3, 3] = position
    return made


def poses():
    """A drive that turns: poses every 0.1 s, and a gap of 0.3 s. One step turns by a thousandth of a degree only."""
    times = np.array([0, 100_000, 200_000, 300_000, 600_000, 700_000], dtype=np.int64)
    headings = np.array([0.0, 4.0, 30.0, 30.001, 60.0, 61.0])
    rotations = Rotation.from_euler("zyx", [[a, 0.3 * a, 2 - a / 9] for a in headings], degrees=True)
    positions = np.stack([times * 1.2e-5, np.sin(times * 3e-6), 0.1 * np.cos(times * 5e-6)], -1)
    return times, rotations, positions + [100.0, -40.0, 2.0]


def in_world(points, point_times, rig_from_lidar):
    times, rotations, positions = poses()
    world, kept = [], []
    for point, time in zip(points.astype(np.float64), point_times):
        after = int(np.searchsorted(times, time, side="right"))
        if after == 0:
            continue
        if times[after - 1] == time:
            rotation, position = rotations[after - 1], positions[after - 1]
        elif after == len(times) or times[after] - times[after - 1] > 200_000:
            continue
        else:
            share = (time - times[after - 1]) / (times[after] - times[after - 1])
            pair = Slerp([0, 1], rotations[after - 1 : after + 1])
            rotation = pair([share])[0]
            position = positions[after - 1] + share * (positions[after] - positions[after - 1])
        rig = rig_from_lidar[:3, :3] @ point + rig_from_lidar[:3, 3]
        world.append(rotation.as_matrix() @ rig + position)
        kept.append(int(time))
    return np.array(world), np.array(kept)


def depth(world, camera, depth_map, opacity, counts):
    """From the nearest point on, of each without another of them within 2 px: rendered depth minus its own."""
    points = (world - camera[:3, 3]) @ camera[:3, :3]
    points = points[points[:, 2] > 0]
    at = points[:, :2] / points[:, 2:] * [FX, FY] + [CX, CY]
    within = ((at >= 0) & (at < [WIDTH, HEIGHT])).all(axis=1)
    at, z = at[within], points[within, 2]
    kept = np.zeros(len(z), dtype=bool)
    for index in np.argsort(z, kind="stable"):
        kept[index] = not (np.linalg.norm(at[kept] - at[index], axis=-1) <= 2).any()
    columns, rows = at.astype(int).T
    used = kept & counts[rows, columns] & (opacity[rows, columns] >= 0.5)
    used &= (depth_map[rows, columns] > 0) & (z < 80)
    errors = np.abs(depth_map[rows, columns].astype(np.float64) - z)[used]
    bins = []
    for low, high in [(0, 10), (10, 30), (30, 80)]:
        of = errors[(z[used] >= low) & (z[used] < high)]
        bins.append([len(of), float(of.mean())])
    return {"points": len(errors), "mean_m": float(errors.mean()), "median_m": float(np.median(errors)), "bins": bins}


def main():
    random = np.random.default_rng(3)
    count = 1500
    times = random.integers(-20_000, 720_000, count)
    angles = random.uniform(-0.9, 0.9, count)
    distance = random.uniform(3, 100, count)
    points = np.stack([distance * np.cos(angles), distance * np.sin(angles), random.uniform(-2, 6, count)], -1)
    points = points.astype(np.float32)
    rig_from_lidar = matrix(Rotation.from_euler("xyz", [1, -2, 90], degrees=True), [1.2, 0.0, 1.9])
    pose_times, rotations, positions = poses()
    world_from_rig = np.stack([matrix(r, p) for r, p in zip(rotations, positions)])
    file = {
        "points_m": points,
        "time_us": times.astype(np.int64),
        "rig_from_lidar": rig_from_lidar,
        "pose_time_us": pose_times,
        "world_from_rig": np.ascontiguousarray(world_from_rig),
    }
    here = Path(__file__)
    save_file(file, here.with_suffix(".safetensors"))
    order = np.argsort(times, kind="stable")
    world, kept = in_world(points[order], times[order], rig_from_lidar)
    # A camera that looks along y of the rig at 0.2 s, where the LiDAR's x points.
    looks = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    camera = world_from_rig[2] @ matrix(looks, [0.5, 0.2, 1.5])
    row, column = np.mgrid[0:HEIGHT, 0:WIDTH]
    depth_map = (20 + 0.2 * column + 0.1 * row).astype(np.float32)
    opacity = np.where(column < 130, 0.5, 0.49).astype(np.float32)
    counts = row > 10
    made = {
        "world": world.tolist(),
        "time_us": kept.tolist(),
        "skipped": count - len(world),
        "camera": camera.tolist(),
        "size_px": [WIDTH, HEIGHT],
        "pinhole": [FX, FY, CX, CY],
        "depth": depth(world, camera, depth_map, opacity, counts),
    }
    assert 100 < made["skipped"] < count - 500 and made["depth"]["points"] > 50, made["depth"]
    here.with_suffix(".json").write_text(json.dumps(made) + "\n")


if __name__ == "__main__":
    main()
