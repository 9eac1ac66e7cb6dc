"""How soft a mesh is as an actor: pictures by `wildcity actor show` against Mitsuba's of the same triangles.

    pip install mitsuba numpy pillow trimesh
    python tests/actors/softness.py WILDCITY CesiumMilkTruck.glb OUT [GAUSSIANS ...]

Mitsuba 3 (EPFL) is an independent renderer. It draws the triangles unlit, with the display colours of their
textures, 64 samples per pixel. For each number of Gaussians the script prints, distance by distance: the PSNR
within the box of the truck in dB; over all edges between two flat colours, the median width from 10 to 90 % and
the median distance from the edge of the triangles, in pixels. It writes OUT/softness.png: a part of the picture
at 5 m, as triangles and as Gaussians, from left to right.
"""

import pathlib
import subprocess
import sys

import mitsuba
import numpy as np
import trimesh
from PIL import Image

mitsuba.set_variant("scalar_rgb")

# From the file's axes (x to the front of the truck, y up) to the actor's (x forward, y left, z up).
AXES = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
WIDTH, HEIGHT, FOCAL = 1440, 928, 1800.0
DISTANCES = (3, 5, 8, 15)
GREY = 0.55
# Pixels on each side of an edge in which there is no other.
REACH = 10
# The part of the picture at 5 m that is shown: first column, first row, size.
PART = (620, 60, 340, 340)


def shapes(path: pathlib.Path, folder: pathlib.Path) -> tuple[list[dict], np.ndarray]:
    """Emitting shapes in the actor's axes, and the size of their box."""
    scene = trimesh.load(path)
    parts, lowest, highest = [], np.full(3, np.inf), np.full(3, -np.inf)
    for name in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[name]
        mesh = scene.geometry[geometry].copy()
        mesh.apply_transform(matrix)
        mesh.vertices = mesh.vertices @ AXES.T
        lowest = np.minimum(lowest, mesh.vertices.min(axis=0))
        highest = np.maximum(highest, mesh.vertices.max(axis=0))
        parts.append((f"{len(parts)}", mesh))
    origin = np.array([*(0.5 * (lowest + highest))[:2], lowest[2]])
    described = []
    for name, mesh in parts:
        material = mesh.visual.material
        factor = np.ones(4) if material.baseColorFactor is None else np.asarray(material.baseColorFactor) / 255.0
        if material.baseColorTexture is not None:
            image = folder / f"{name}.png"
            material.baseColorTexture.convert("RGB").save(image)
            radiance = {"type": "bitmap", "filename": str(image), "raw": True, "filter_type": "bilinear"}
        else:
            linear = factor[:3]
            display = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
            radiance = {"type": "rgb", "value": display.tolist()}
        uv = getattr(mesh.visual, "uv", None)
        own = mitsuba.Mesh(name, len(mesh.vertices), len(mesh.faces), has_vertex_texcoords=uv is not None)
        parameters = mitsuba.traverse(own)
        parameters["vertex_positions"] = np.ravel(mesh.vertices - origin).astype(np.float32)
        parameters["faces"] = np.ravel(mesh.faces).astype(np.uint32)
        if uv is not None:
            # Mitsuba counts v from the top of a bitmap, trimesh from its bottom.
            flipped = np.column_stack([uv[:, 0], 1 - uv[:, 1]])
            parameters["vertex_texcoords"] = np.ravel(flipped).astype(np.float32)
        parameters.update()
        file = folder / f"{name}.ply"
        own.write_ply(str(file))
        described.append(
            {
                "type": "ply",
                "filename": str(file),
                "face_normals": True,
                "bsdf": {"type": "twosided", "nested": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}}},
                "emitter": {"type": "area", "radiance": radiance},
            }
        )
    return described, highest - lowest


def truth(described: list[dict], size: np.ndarray, distance: float) -> np.ndarray:
    """The picture that `wildcity actor show --distance` draws of the triangles."""
    aside = 0.5 * size[1] + distance
    look = mitsuba.ScalarTransform4f().look_at(origin=[0, -aside, 1.5], target=[0, 0, 1.5], up=[0, 0, 1])
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1, "hide_emitters": False},
        "sensor": {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5 * WIDTH / FOCAL))),
            "fov_axis": "x",
            "to_world": look,
            "sampler": {"type": "stratified", "sample_count": 64},
            "film": {
                "type": "hdrfilm",
                "width": WIDTH,
                "height": HEIGHT,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
            },
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": GREY}},
    }
    for index, shape in enumerate(described):
        scene[f"shape{index}"] = shape
    return np.clip(np.asarray(mitsuba.render(mitsuba.load_dict(scene))), 0, 1)


def crossing(share: np.ndarray, level: float) -> float:
    """Where a profile from 0 to 1 passes a level for the first time, in pixels; nan if it does not."""
    above = np.nonzero(share > level)[0]
    if len(above) == 0 or above[0] == 0:
        return float("nan")
    k = above[0]
    return k - 1 + (level - share[k - 1]) / (share[k] - share[k - 1])


def edges(image: np.ndarray) -> list[tuple[tuple, np.ndarray, np.ndarray]]:
    """Sharp edges between two flat colours across rows and columns: the pixels around each, and both colours."""
    found = []
    for is_row in (True, False):
        lines = (image if is_row else image.transpose(1, 0, 2))[::4]
        # In each line and at each pixel, the colours from so far before it to so far after it.
        around = np.lib.stride_tricks.sliding_window_view(lines, 2 * REACH + 1, axis=1)
        before, after = around[..., : REACH - 2], around[..., REACH + 3 :]
        step = after.mean(axis=-1) - before.mean(axis=-1)
        flat = np.maximum(np.ptp(before, axis=-1), np.ptp(after, axis=-1)).max(axis=-1) < 0.03
        last = (-1, 0)
        for line, first in np.argwhere(flat & (np.abs(step).max(axis=-1) > 0.3)):
            # The same edge is found by several neighbours; the first one counts.
            if last[0] == line and first < last[1] + REACH:
                continue
            last = (line, first)
            window = slice(first, first + 2 * REACH + 1)
            place = (4 * line, window) if is_row else (window, 4 * line)
            found.append((place, before[line, first].mean(axis=-1), step[line, first]))
    return found


def edge_px(image: np.ndarray, where: list, truths: list | None) -> tuple[float, float, list]:
    """Medians over edges: width from 10 to 90 %, and distance from the edge of the triangles; and all places."""
    widths, places = [], []
    for place, before, step in where:
        share = (image[place] - before) @ step / (step @ step)
        low, middle, high = (crossing(share, level) for level in (0.1, 0.5, 0.9))
        widths.append(high - low)
        places.append(middle)
    if truths is None:
        return float(np.nanmedian(widths)), 0.0, places
    off = np.abs(np.array(places) - np.array(truths))
    return float(np.nanmedian(widths)), float(np.nanmedian(off)), places


def main() -> None:
    program, source, out = sys.argv[1], pathlib.Path(sys.argv[2]), pathlib.Path(sys.argv[3])
    counts = [int(count) for count in sys.argv[4:]] or [50_000, 100_000, 200_000, 400_000, 800_000]
    out.mkdir(parents=True, exist_ok=True)
    described, size = shapes(source, out)
    truths, where, middles = {}, {}, {}
    for distance in DISTANCES:
        stored = out / f"truth_{distance}.npy"
        if not stored.exists():
            np.save(stored, truth(described, size, distance))
        truths[distance] = np.load(stored)
        Image.fromarray((truths[distance] * 255 + 0.5).astype(np.uint8)).save(out / f"truth_{distance}.png")
        where[distance] = edges(truths[distance])
        width, _, middles[distance] = edge_px(truths[distance], where[distance], None)
        print(f"triangles at {distance} m: {len(where[distance])} edges of {width:.2f} px", flush=True)
    axes = " ".join(str(int(value)) for value in AXES.ravel())
    parts = [part(truths[5])]
    for count in counts:
        twins = out / f"twins_{count}"
        importing = [program, "actor", "import", source, "--name", "truck", "--axes", axes, "--twins", twins]
        importing += ["--gaussians", str(count), "--record", "f32"]
        subprocess.run(importing, check=True, stdout=subprocess.DEVNULL)
        row = []
        for distance in DISTANCES:
            picture = out / f"{count}_{distance}.png"
            command = [program, "actor", "show", "truck", "--twins", twins, "--picture", picture]
            subprocess.run(command + ["--distance", str(distance)], check=True, stdout=subprocess.DEVNULL)
            image = np.asarray(Image.open(picture)).astype(float) / 255
            covered = np.abs(truths[distance] - GREY).max(axis=2) > 0.02
            rows, columns = np.nonzero(covered)
            window = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
            error = np.mean((image[window] - truths[distance][window]) ** 2)
            width, off, _ = edge_px(image, where[distance], middles[distance])
            row.append(f"{-10 * np.log10(error):.1f} dB {width:.2f} px {off:.2f} px")
            if distance == 5:
                parts.append(part(image))
        print(f"{count:>8} | " + " | ".join(row), flush=True)
    Image.fromarray(np.concatenate(parts, axis=1)).save(out / "softness.png")


def part(image: np.ndarray) -> np.ndarray:
    """The part of a picture that is shown."""
    x, y, width, height = PART
    return (image[y : y + height, x : x + width] * 255 + 0.5).astype(np.uint8)


if __name__ == "__main__":
    main()
