"""Writes boxes.json: boxes before a pinhole camera, and the pixels that they hide, by shapely.

    pip install numpy shapely
    python3 tests/eval/boxes.py

`tests/eval/boxes.rs` compares every pixel with it.
"""

import json
from pathlib import Path

import numpy as np
import shapely

WIDTH, HEIGHT = 96, 64
FX, FY, CX, CY = 70.0, 75.0, 47.0, 33.5
GROWN_PX = 3.0
# A pixel whose middle is nearer than this to the limit may be on either side.
UNSURE_PX = 1e-6


def rotation(q):
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose(xyz, q):
    q = q / np.linalg.norm(q)
    return {"xyz": [float(value) for value in xyz], "q": [float(value) for value in q]}


def hull(box, camera):
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    world = signs * box["size"] @ rotation(np.array(box["world_from_box"]["q"])).T
    world += box["world_from_box"]["xyz"]
    points = (world - camera["xyz"]) @ rotation(np.array(camera["q"]))
    assert (points[:, 2] > 0.1).all(), "all corners are before the camera"
    at = points[:, :2] / points[:, 2:] * [FX, FY] + [CX, CY]
    return shapely.MultiPoint(at).convex_hull


def main():
    random = np.random.default_rng(5)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    middles = shapely.points(x.ravel(), y.ravel())
    cases = []
    for _ in range(12):
        turn = np.array([1.0, *random.normal(0, 0.1, 3)])
        camera = pose(random.normal(0, 1, 3), turn)
        boxes = []
        for _ in range(random.integers(1, 4)):
            size = random.uniform(0.5, 4, 3)
            ahead = np.array([*random.uniform(-4, 4, 2), random.uniform(8, 25)])
            middle = rotation(np.array(camera["q"])) @ ahead + camera["xyz"]
            box = {"size": size.tolist(), "world_from_box": pose(middle, random.normal(0, 1, 4))}
            boxes.append(box)
        distances = np.min([shapely.distance(hull(box, camera), middles) for box in boxes], axis=0)
        hidden = (distances <= GROWN_PX).reshape(HEIGHT, WIDTH)
        unsure = np.abs(distances - GROWN_PX) < UNSURE_PX
        assert not unsure.any()
        rows = ["".join("#" if one else "." for one in row) for row in hidden]
        cases.append({"camera": camera, "boxes": boxes, "hidden": rows})
    assert sum(row.count("#") for case in cases for row in case["hidden"]) > 5000
    made = {"size_px": [WIDTH, HEIGHT], "pinhole": [FX, FY, CX, CY], "cases": cases}
    Path(__file__).with_suffix(".json").write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
