"""Trains the model that repairs images: `python scenes/repair.py` writes `scenes/repair.onnx` and `scenes/repair.json`.

It needs `pip install jax onnx onnxruntime blake3 ./clients/python` and the program (`WILDCITY_BIN`, or in PATH), but no
GPU. A complete run took 4 minutes on one core, 135 s of it for training.

Three streets are generated twice: without errors, and with reconstruction errors like those of captures
(`wildcity twin generate --spoil`). The degraded street is rendered off its drive. The inputs of the model are this
image and `reference_warped`: the true images of the drive, warped into the view with the depth of the degraded street
(docs/repair.md). Its target is the true image of the view. Then the model is measured on a street of another seed.

The model is a U-Net of three levels. For each pixel it predicts a blend weight for the warped image, and a change of
colour: `residual = valid * weight * (warped - rgb) + change`.

Seeds are fixed. Another version of XLA adds in a different order, which changes the last bits. So the files are in the
repository.
"""

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

CAMERAS = ("front", "front_left", "front_right")
SIZE = (360, 232)
# Distances of references from the view, in metres along the drive; recorded images are 2 m apart.
ALONG_M = (-8.0, -5.5, -3.0, -0.5, 2.0)
RECORDED_M = 2.0
# Height and width of the training crops, in pixels, and the number of crops in a step.
CROP, BATCH = 96, 6
# Channels of the three levels.
WIDTHS = (12, 24, 40)
# Seeds of the streets, and the amount of their errors (`--spoil`).
TRAINED, UNSEEN = {101: 0.3, 102: 0.5, 103: 0.7}, {201: 0.5}
# Offsets to the left, where there is road: on the right are parked cars.
OFFSETS_M = (1.0, 3.0, 5.0)


# --- Streets


def generate(twins, seed, amount):
    """Twins `trueSEED` and `spoiledSEED`, unless they are there."""
    from wildcity.serving import binary

    for name, spoil in ((f"true{seed}", ()), (f"spoiled{seed}", ("--spoil", str(amount)))):
        if (Path(twins) / name).exists():
            continue
        street = ("--length-km", "0.2", "--density", "2", "--seed", str(seed), *spoil)
        sky = ("--sky", Path(__file__).parent / "sky.safetensors", "--sky-axes", "identity")
        for command in (("generate", "--twin", name, *street), ("sky", name, *sky)):
            subprocess.run([binary(), "twin", *command, "--twins", twins], check=True, stdout=subprocess.DEVNULL)


class Image:
    """The image of a camera: colours, depth (m, 0 for none), focal length and middle (px), world_from_camera."""

    def __init__(self, rgb, depth, camera, world_from_rig):
        self.rgb, self.depth = rgb, depth
        self.focal, self.middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        turn, at = matrix(world_from_rig)
        turn_rig, at_rig = matrix(camera.camera_to_rig)
        self.turn, self.at = turn @ turn_rig, turn @ at_rig + at


def matrix(pose):
    """Rotation matrix and translation of a pose."""
    w, x, y, z = pose.q
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows), np.array(pose.xyz)


class Street:
    """A street without and with errors, rendered by a server."""

    def __init__(self, server, seed):
        import wildcity

        self.url = server.url
        self.twins = [f"{kind}{seed}" for kind in ("true", "spoiled")]
        self.drive = wildcity.recorded_drive(f"true{seed}", "log", every_m=RECORDED_M, server=server.http)
        recorded = [recorded.pose for recorded in self.drive.poses]
        self.recorded = []
        for true, spoiled in zip(self.draw(0, recorded), self.draw(1, recorded)):
            for image, drawn in zip(true, spoiled):
                image.depth = drawn.depth
            self.recorded.append(true)

    def draw(self, which, poses):
        """Renders the images of each pose, in the order of the cameras.

        Each call has its own connection: a server drops clients that are silent for minutes, while they warp or train.
        """
        import wildcity
        from wildcity.messages import ImagePart

        parts = {camera: ImagePart(size=SIZE) for camera in CAMERAS}
        outputs = wildcity.Outputs(cameras=CAMERAS, encoding="raw", depth=True, opacity=True, images=parts)
        drawn = []
        with wildcity.connect(self.url) as client:
            session = client.open(self.twins[which], session=self.twins[which], outputs=outputs)
            for first in range(0, len(poses), 8):
                part = poses[first : first + 8]
                for pose, view in zip(part, session.observe(part).views):
                    images = []
                    for camera in session.opened.cameras:
                        depth = np.where(view.opacity[camera.name] >= 0.5, view.depth[camera.name], 0.0)
                        images.append(Image(np.array(view.images[camera.name]), depth, camera, pose))
                    drawn.append(images)
            session.close()
        return drawn

    def beside(self, station_m, offset_m, yaw=0.0):
        """The pose to the left of a station of the drive."""
        from wildcity import Pose

        at = min(station_m / RECORDED_M, len(self.drive.poses) - 1.001)
        first, share = int(at), at - int(at)
        from_, to = (np.array(p.pose.xyz) for p in self.drive.poses[first : first + 2])
        ahead = (to - from_) / np.linalg.norm(to - from_)
        xyz = from_ + share * (to - from_) + offset_m * np.array([-ahead[1], ahead[0], 0.0])
        half = 0.5 * (np.arctan2(ahead[1], ahead[0]) + yaw)
        return Pose(tuple(xyz), (np.cos(half), 0.0, 0.0, np.sin(half)))

    def references(self, station_m):
        """Recorded images near a station, in the order in which the warp tries them."""
        chosen = []
        for along_m in ALONG_M:
            at = int(np.ceil((station_m + along_m) / RECORDED_M - 0.5))
            if 0 <= at < len(self.recorded) and at not in chosen:
                chosen.append(at)
        return [image for at in chosen for image in self.recorded[at]]

    def views(self, stations_m, offsets_m, yaws=None):
        """Per station and camera (rendered, warped, valid, true) as u8, and the images of the degraded street."""
        yaws = np.zeros(len(stations_m)) if yaws is None else yaws
        poses = [self.beside(*where) for where in zip(stations_m, offsets_m, yaws)]
        arrays, images = [], []
        for station_m, true, spoiled in zip(stations_m, self.draw(0, poses), self.draw(1, poses)):
            references = self.references(station_m)
            for wanted, rendered in zip(true, spoiled):
                arrays.append((rendered.rgb, *warp(rendered, references), wanted.rgb))
                images.append(rendered)
        return arrays, images


def warp(target, references):
    """`reference_warped` [h, w, 3] and `reference_valid` [h, w] of a view, as u8: docs/repair.md defines them."""
    height, width = target.depth.shape
    warped, valid = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8)
    rows, columns = np.nonzero(target.depth > 0.0)
    depth = target.depth[rows, columns].astype(float)
    pixel = np.stack([columns + 0.5, rows + 0.5], 1)
    in_camera = np.concatenate([(pixel - target.middle) / target.focal, np.ones((len(depth), 1))], 1)
    away = in_camera @ target.turn.T
    point = away * depth[:, None] + target.at
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    best = np.full(len(depth), -2.0)
    for reference in references:
        x, y, z = reference.turn.T @ (point - reference.at).T
        (fx, fy), (cx, cy) = reference.focal, reference.middle
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = fx * x / z + cx, fy * y / z + cy
        index = np.nonzero((z > 0.0) & (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height))[0]
        there, z = reference.depth[v[index].astype(int), u[index].astype(int)], z[index]
        index = index[(there > 0.0) & (np.abs(there - z) <= 0.2 + 0.05 * z)]
        ray = point[index] - reference.at
        cosine = (ray * away[index]).sum(1) / np.sqrt((ray * ray).sum(1))
        wins = cosine > best[index]
        index = index[wins]
        best[index] = cosine[wins]
        colours = bilinear(reference.rgb, np.stack([u[index], v[index]], 1))
        warped[rows[index], columns[index]] = np.floor(colours + 0.5)
        valid[rows[index], columns[index]] = 1
    return warped, valid


def bilinear(image, at):
    """Colours of an image between its pixels, whose centres are at + 0.5; clamped at the border."""
    last = np.array(image.shape[1::-1]) - 1
    at = np.clip(at - 0.5, 0.0, last)
    low = np.minimum(at.astype(int), last - 1)
    (tx, ty), (x, y) = (at - low).T[:, :, None], low.T
    upper = image[y, x] * (1.0 - tx) + image[y, x + 1] * tx
    lower = image[y + 1, x] * (1.0 - tx) + image[y + 1, x + 1] * tx
    return upper * (1.0 - ty) + lower * ty


# --- The network


def layers():
    """Name, inputs and outputs of each convolution, 3 x 3."""
    a, b, c = WIDTHS
    return [
        ("fine", 7, a), ("fine_more", a, a), ("middle", a, b), ("middle_more", b, b), ("coarse", b, c),
        ("coarse_more", c, c), ("up_middle", c + b, b), ("up_fine", b + a, a), ("out", a, 4),
    ]  # fmt: skip


def initial(seed):
    rng = np.random.default_rng(seed)
    parameters = {}
    for name, inputs, outputs in layers():
        spread = np.sqrt(2.0 / (9 * inputs)) * (0.1 if name == "out" else 1.0)
        parameters[name] = (
            (spread * rng.standard_normal((3, 3, inputs, outputs))).astype(np.float32),
            np.zeros(outputs, np.float32),
        )
    return parameters


def residual(parameters, rgb, warped, valid):
    """The network on [b, h, w, channels] in [0, 1]; h and w are multiples of 4."""
    import jax
    import jax.numpy as jnp

    def conv(name, x):
        weight, bias = parameters[name]
        return (
            jax.lax.conv_general_dilated(x, weight, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")) + bias
        )

    relu = jax.nn.relu
    halve = lambda x: 0.25 * (x[:, ::2, ::2] + x[:, 1::2, ::2] + x[:, ::2, 1::2] + x[:, 1::2, 1::2])
    double = lambda x: x.repeat(2, axis=1).repeat(2, axis=2)
    fine = relu(conv("fine_more", relu(conv("fine", jnp.concatenate([rgb, warped, valid], -1)))))
    middle = relu(conv("middle_more", relu(conv("middle", halve(fine)))))
    coarse = relu(conv("coarse_more", relu(conv("coarse", halve(middle)))))
    middle = relu(conv("up_middle", jnp.concatenate([double(coarse), middle], -1)))
    fine = relu(conv("up_fine", jnp.concatenate([double(middle), fine], -1)))
    out = conv("out", fine)
    return valid * jax.nn.sigmoid(out[..., 3:]) * (warped - rgb) + out[..., :3]


def train(arrays, steps, rate=1e-3, seed=7):
    """Adam, with a rate that falls along a cosine; the loss is `sqrt(error² + 0.01²)`."""
    import jax
    import jax.numpy as jnp

    def loss(parameters, rgb, warped, valid, true):
        error = rgb + residual(parameters, rgb, warped, valid) - true
        return jnp.sqrt(error * error + 1e-4).mean(), (error * error).mean()

    @jax.jit
    def update(parameters, first, second, step, batch):
        rgb, warped, valid, true = (x.astype(jnp.float32) for x in batch)
        (_, mse), slopes = jax.value_and_grad(loss, has_aux=True)(
            parameters, rgb / 255, warped / 255, valid[..., None], true / 255
        )
        now = rate * 0.5 * (1.0 + jnp.cos(jnp.pi * step / steps)) + 1e-5
        every = jax.tree_util.tree_map
        first = every(lambda m, g: 0.9 * m + 0.1 * g, first, slopes)
        second = every(lambda v, g: 0.999 * v + 0.001 * g * g, second, slopes)
        falls = lambda p, m, v: p - now * (m / (1 - 0.9**step)) / (jnp.sqrt(v / (1 - 0.999**step)) + 1e-8)
        return every(falls, parameters, first, second), first, second, mse

    rng = np.random.default_rng(seed)
    parameters = initial(seed)
    first = second = jax.tree_util.tree_map(np.zeros_like, parameters)
    begun, errors = time.monotonic(), []
    for step in range(1, steps + 1):
        crops = []
        for index in rng.integers(0, len(arrays), BATCH):
            row, column = (rng.integers(0, side - CROP + 1) for side in SIZE[::-1])
            turn = -1 if rng.uniform() < 0.5 else 1
            crops.append([x[row : row + CROP, column : column + CROP][:, ::turn] for x in arrays[index]])
        batch = [np.stack(parts) for parts in zip(*crops)]
        parameters, first, second, mse = update(parameters, first, second, float(step), batch)
        errors.append(float(mse))
        if step % 200 == 0:
            mean = -10.0 * np.log10(np.mean(errors[-200:]))
            print(f"step {step} of {steps}: {mean:.2f} dB, {time.monotonic() - begun:.0f} s", flush=True)
    return jax.tree_util.tree_map(np.asarray, parameters)


def write(parameters, out):
    """The network as ONNX, and its manifest."""
    import blake3
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, weights = [], []

    def node(kind, name, inputs, **attributes):
        nodes.append(helper.make_node(kind, inputs, [name], name=name, **attributes))
        return name

    def constant(name, values):
        weights.append(numpy_helper.from_array(np.asarray(values), name))
        return name

    def conv(name, x, relu=True):
        weight, bias = parameters[name]
        of = [x, constant(f"{name}.weight", weight.transpose(3, 2, 0, 1).copy()), constant(f"{name}.bias", bias)]
        done = node("Conv", name, of, kernel_shape=[3, 3], pads=[1, 1, 1, 1])
        return node("Relu", f"{name}.relu", [done]) if relu else done

    halve = lambda name, x: node("AveragePool", name, [x], kernel_shape=[2, 2], strides=[2, 2])
    nearest = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    double = lambda name, x: node("Resize", name, [x, "", "twice"], **nearest)
    constant("twice", np.array([1.0, 1.0, 2.0, 2.0], np.float32))
    images = ("rgb", "reference_warped", "reference_valid")
    fine = conv("fine_more", conv("fine", node("Concat", "images", images, axis=1)))
    middle = conv("middle_more", conv("middle", halve("half", fine)))
    coarse = conv("coarse_more", conv("coarse", halve("quarter", middle)))
    middle = conv("up_middle", node("Concat", "join_middle", [double("double_coarse", coarse), middle], axis=1))
    fine = conv("up_fine", node("Concat", "join_fine", [double("double_middle", middle), fine], axis=1))
    constant("split", np.array([3, 1], np.int64))
    nodes.append(helper.make_node("Split", [conv("out", fine, relu=False), "split"], ["change", "logit"], axis=1))
    share = node("Mul", "share", [node("Sigmoid", "weight", ["logit"]), "reference_valid"])
    taken = node("Mul", "taken", [share, node("Sub", "apart", ["reference_warped", "rgb"])])
    node("Add", "residual", [taken, "change"])
    tensor = lambda name, channels: helper.make_tensor_value_info(
        name, TensorProto.FLOAT, ["batch", channels, "height", "width"]
    )  # fmt: skip
    inputs = [tensor(name, channels) for name, channels in zip(images, (3, 3, 1))]
    graph = helper.make_graph(nodes, "repair", inputs, [tensor("residual", 3)], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    content = model.SerializeToString(deterministic=True)
    (out / "repair.onnx").write_bytes(content)
    manifest = {
        "format": "wildcity.repair/1",
        "name": "street-repair",
        "version": "1",
        "licence": "MIT OR Apache-2.0",
        "files": [{"path": "repair.onnx", "blake3": blake3.blake3(content).hexdigest()}],
        "providers": ["cpu", "cuda", "tensorrt"],
        "timeout_ms": 20000,
        "size": {"multiple_of": 4, "fit": "tile", "tile": [256, 256]},
        "merge": "residual",
        "inputs": [{"name": name, "role": name} for name in images],
        "outputs": [{"name": "residual", "role": "residual"}],
    }
    (out / "repair.json").write_text(json.dumps(manifest, indent=2) + "\n")
    return len(content)


# --- Gain


def repairer(path):
    """The file as a function of (rendered, warped, valid), all u8, to u8."""
    import onnxruntime

    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])

    def run(rendered, warped, valid):
        image = lambda x: (x.astype(np.float32) / 255).transpose(2, 0, 1)[None]
        rgb = image(rendered)
        feed = {"rgb": rgb, "reference_warped": image(warped), "reference_valid": valid.astype(np.float32)[None, None]}
        repaired = np.clip(rgb + session.run(None, feed)[0], 0.0, 1.0)[0].transpose(1, 2, 0)
        return np.floor(255 * repaired + 0.5).astype(np.uint8)

    return run


def psnr(image, true):
    return -10.0 * np.log10(max(np.mean((image / 255.0 - true / 255.0) ** 2), 1e-10))


def fill(rendered, warped, valid):
    """Warped where valid, rendered elsewhere."""
    return np.where(valid[..., None] == 1, warped, rendered)


def gains(street, repair, every_m=12.0):
    """Rows (offset, share valid, dB rendered, dB warped, dB repaired), means over the images; on the drive first."""
    stations_m = np.arange(10.0, street.drive.length_m - 10.0, every_m)
    rows = []
    for offset_m in (0.0, *OFFSETS_M):
        arrays, _ = street.views(stations_m, np.full(len(stations_m), offset_m))
        scores = [
            (
                valid.mean(),
                psnr(rendered, true),
                psnr(fill(rendered, warped, valid), true),
                psnr(repair(rendered, warped, valid), true),
            )
            for rendered, warped, valid, true in arrays
        ]
        rows.append((offset_m, *np.mean(scores, axis=0)))
    return rows


def flicker(street, repair, offset_m=3.0, from_m=60.0, frames=12, step_m=0.8):
    """Mean abs(R_t - W(R_t-1)) of (rendered, repaired, true), where the depths agree; in [0, 1]."""
    stations_m = from_m + step_m * np.arange(frames)
    arrays, images = street.views(stations_m, np.full(frames, offset_m))
    sums = np.zeros(3)
    for index in range(len(CAMERAS), len(images)):
        now, before = images[index], images[index - len(CAMERAS)]
        of = lambda index: (arrays[index][0], repair(*arrays[index][:3]), arrays[index][3])
        for which, (shown, shown_before) in enumerate(zip(of(index), of(index - len(CAMERAS)))):
            before.rgb = shown_before
            moved, valid = warp(now, [before])
            sums[which] += np.abs(shown / 255.0 - moved / 255.0)[valid == 1].mean()
    return sums / (len(images) - len(CAMERAS))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder of repair.onnx and repair.json")
    parser.add_argument("--twins", type=Path, help="folder that keeps the streets [default: a temporary one]")
    parser.add_argument(
        "--steps", type=int, default=1500, help="steps of training; 0 measures the files that are there"
    )
    parser.add_argument("--views", type=int, default=28, help="poses per street that are trained on")
    options = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    import wildcity

    with tempfile.TemporaryDirectory() as temporary:
        twins = options.twins or Path(temporary)
        streets = {**TRAINED, **UNSEEN}
        for seed, amount in streets.items():
            print(f"generating street {seed}, spoiled by {amount}", flush=True)
            generate(twins, seed, amount)
        with wildcity.serve(twins, backend="cpu") as server:
            if options.steps:
                arrays = []
                for seed in TRAINED:
                    print(f"drawing street {seed}", flush=True)
                    street = Street(server, seed)
                    rng = np.random.default_rng(seed)
                    stations_m = rng.uniform(10.0, street.drive.length_m - 10.0, options.views)
                    offsets_m = rng.uniform(-1.0, 6.0, options.views)
                    arrays += street.views(stations_m, offsets_m, rng.uniform(-0.1, 0.1, options.views))[0]
                print(f"wrote {write(train(arrays, options.steps), options.out)} bytes", flush=True)
            repair = repairer(options.out / "repair.onnx")
            for seed in UNSEEN:
                street = Street(server, seed)
                print("a street that it has not seen, PSNR in dB\noffset  valid  rendered  warped  repaired")
                for offset_m, valid, *scores in gains(street, repair):
                    print("{:4.0f} m {:7.2f} {:9.2f} {:7.2f} {:9.2f}".format(offset_m, valid, *scores), flush=True)
                rendered, repaired, true = flicker(street, repair)
                print(f"flicker at 3 m: rendered {rendered:.4f}, repaired {repaired:.4f}, true {true:.4f}")


if __name__ == "__main__":
    main()
