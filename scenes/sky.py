"""Trains the demo twin's sky: `python scenes/sky.py` writes `scenes/sky.safetensors` (needs only numpy);
`python scenes/sky.py truths` writes the values that `tests/render/sky.rs` compares with.

The network is the sky of street reconstructions (OmniRe's SkyModel, Chen et al. 2024). Its input is a
direction, its sines and cosines over octaves, and an appearance of 16 numbers. It has three layers, and
the second one gets the input again. It is half as wide as theirs and has an octave less, so that tests
bake it quickly. It learns a clear day from a formula: haze on the horizon, blue above, fair-weather
clouds, and a sun where the street's light comes from (`src/generate/light.rs`).

The seed is fixed. A BLAS that adds in a different order changes the last bits, so the file is in the
repository.
"""

import json
import struct
import sys

import numpy as np

OCTAVES = 6
WIDTH = 32
EMBEDDING = 16
# "Images" of the training set: their appearances differ in brightness and tint, their mean in neither.
TINTS = np.array([[1.0, 1.0, 1.0], [1.06, 1.0, 0.93], [0.94, 1.0, 1.07]], np.float32)
# Towards the sun, as TO_SUN in src/generate/light.rs.
TO_SUN = np.array([-0.600, -0.400, 0.693]) / np.linalg.norm([-0.600, -0.400, 0.693])


def smooth(t):
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def noise(seed, x, y):
    """Smooth noise over the plane, in [-1, 1], one lattice cell per unit."""
    lattice = np.random.default_rng(seed).uniform(-1.0, 1.0, (64, 64))
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    tx, ty = smooth(x - column), smooth(y - row)
    at = lambda i, j: lattice[(row + j) % 64, (column + i) % 64]
    below = at(0, 0) + tx * (at(1, 0) - at(0, 0))
    above = at(0, 1) + tx * (at(1, 1) - at(0, 1))
    return below + ty * (above - below)


def day(away):
    """Colours [n, 3] in [0, 1] towards unit directions [n, 3], z up."""
    z = away[:, 2:]
    haze, zenith = np.array([0.84, 0.88, 0.92]), np.array([0.24, 0.46, 0.80])
    rgb = haze + (zenith - haze) * np.sqrt(smooth((z + 0.02) / 0.75))
    angle = np.arccos(np.clip(away @ TO_SUN, -1.0, 1.0))[:, None]
    # Air lights up around the sun.
    rgb = rgb + (np.array([1.0, 0.97, 0.90]) - rgb) * (0.55 * np.exp(-angle / 0.22))
    # A flat layer of clouds, seen from below.
    layer = away[:, :2] / (np.maximum(z, 0.0) + 0.30)
    octave = lambda scale, seed: noise(seed, scale * layer[:, :1], scale * layer[:, 1:])
    cover = octave(1.7, 41) + 0.5 * octave(3.9, 42)
    cloud = smooth((cover - 0.05) / 0.9) * smooth((z - 0.02) / 0.16)
    shade = smooth((cover - 0.55) / 0.9) * np.array([0.16, 0.14, 0.11])
    rgb = rgb + (np.array([0.97, 0.97, 0.96]) - shade - rgb) * (0.90 * cloud)
    # The sun with its glare, as cameras show it: ten times as wide as it is.
    rgb = rgb + (np.array([1.0, 0.995, 0.97]) - rgb) * np.exp(-((angle / 0.07) ** 2))
    # No camera looks below the horizon: the haze continues there, darker.
    return rgb * (1.0 - 0.35 * smooth((-z - 0.05) / 0.5))


def encode(away, octaves=OCTAVES):
    """[n, 3 + 6 octaves]: the direction, then all sines, then all cosines, from the lowest octave."""
    scaled = np.concatenate([away * 2.0**i for i in range(octaves)], axis=1)
    return np.concatenate([away, np.sin(scaled), np.cos(scaled)], axis=1)


def look(rng, count):
    """Directions, three in four above the horizon, and more of them near it and near the sun."""
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    z = np.where(rng.uniform(size=count) < 0.5, rng.uniform(-1.0, 1.0, count), rng.uniform(-0.05, 0.75, count))
    run = np.sqrt(1.0 - z * z)
    away = np.stack([run * np.cos(azimuth), run * np.sin(azimuth), z], axis=1)
    at_sun = rng.uniform(size=count) < 0.06
    near = TO_SUN + 0.08 * rng.standard_normal((count, 3))
    away[at_sun] = (near / np.linalg.norm(near, axis=1, keepdims=True))[at_sun]
    return away


def train(steps, batch=4096, seed=7):
    rng = np.random.default_rng(seed)
    inputs = 3 + 6 * OCTAVES + EMBEDDING
    layer = lambda out, wide: rng.uniform(-1.0, 1.0, (out, wide)).astype(np.float32) / np.sqrt(wide)
    w = [layer(WIDTH, inputs), layer(WIDTH, WIDTH + inputs), layer(3, WIDTH)]
    b = [np.zeros(WIDTH, np.float32), np.zeros(WIDTH, np.float32), np.zeros(3, np.float32)]
    images = (0.1 * rng.standard_normal((len(TINTS), EMBEDDING))).astype(np.float32)
    parameters = [*w, *b, images]
    first = [np.zeros_like(p) for p in parameters]
    second = [np.zeros_like(p) for p in parameters]
    for step in range(1, steps + 1):
        away = look(rng, batch)
        # The last "image" is the mean appearance, which the neutral sky belongs to.
        image = rng.integers(0, len(TINTS) + 1, batch)
        share = np.concatenate([np.eye(len(TINTS)), np.full((1, len(TINTS)), 1.0 / len(TINTS))])
        share = share[image].astype(np.float32)
        tint = np.concatenate([TINTS, np.ones((1, 3), np.float32)])[image]
        wanted = np.clip(day(away) * tint, 0.004, 0.996).astype(np.float32)
        x = np.concatenate([encode(away).astype(np.float32), share @ images], axis=1)
        h0 = np.maximum(x @ w[0].T + b[0], 0.0)
        skip = np.concatenate([h0, x], axis=1)
        h1 = np.maximum(skip @ w[1].T + b[1], 0.0)
        rgb = 1.0 / (1.0 + np.exp(-(h1 @ w[2].T + b[2])))
        error = rgb - wanted
        # Backpropagation of the mean squared error.
        d2 = (2.0 / error.size) * error * rgb * (1.0 - rgb)
        d1 = (d2 @ w[2]) * (h1 > 0.0)
        d_skip = d1 @ w[1]
        d0 = d_skip[:, :WIDTH] * (h0 > 0.0)
        d_x = d0 @ w[0] + d_skip[:, WIDTH:]
        slopes = [d0.T @ x, d1.T @ skip, d2.T @ h1, d0.sum(0), d1.sum(0), d2.sum(0)]
        slopes.append(share.T @ d_x[:, -EMBEDDING:])
        # Adam (Kingma and Ba 2014), with a rate that falls along a cosine.
        rate = 4e-3 * 0.5 * (1.0 + np.cos(np.pi * step / steps)) + 1e-5
        for p, slope, m, v in zip(parameters, slopes, first, second):
            m += 0.1 * (slope - m)
            v += 0.001 * (slope * slope - v)
            p -= rate * (m / (1.0 - 0.9**step)) / (np.sqrt(v / (1.0 - 0.999**step)) + 1e-10)
        if step % 500 == 0:
            mse = float(np.mean(error * error))
            print(f"step {step}: {-10.0 * np.log10(mse):.2f} dB", flush=True)
    names = [f"sky_head.layers.{i}.{what}" for what in ("weight", "bias") for i in range(3)]
    return dict(zip([*names, "appearance_embedding.weight"], parameters))


def write(path, tensors):
    """A safetensors file: the header's length, the header as JSON, the values."""
    header, body = {"__metadata__": {"made_by": "scenes/sky.py"}}, b""
    for name, values in tensors.items():
        data = values.astype("<f4").tobytes()
        header[name] = {"dtype": "F32", "shape": list(values.shape), "data_offsets": [len(body), len(body) + len(data)]}
        body += data
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + body)


def colours(tensors, away, image=None):
    """The network in f64, by definition: colours [n, 3] towards unit directions [n, 3]."""
    layer = lambda i, x: x @ tensors[f"sky_head.layers.{i}.weight"].T + tensors[f"sky_head.layers.{i}.bias"]
    tensors = {name: values.astype(np.float64) for name, values in tensors.items()}
    images = tensors["appearance_embedding.weight"]
    appearance = images.mean(axis=0) if image is None else images[image]
    octaves = (tensors["sky_head.layers.0.weight"].shape[1] - len(appearance) - 3) // 6
    x = np.concatenate([encode(away, octaves), np.tile(appearance, (len(away), 1))], axis=1)
    hidden = np.concatenate([np.maximum(layer(0, x), 0.0), x], axis=1)
    return 1.0 / (1.0 + np.exp(-layer(2, np.maximum(layer(1, hidden), 0.0))))


def read(path):
    """All tensors of a safetensors file of F32."""
    with open(path, "rb") as file:
        data = file.read()
    length = struct.unpack("<Q", data[:8])[0]
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    header.pop("__metadata__", None)
    values = lambda t: np.frombuffer(body[slice(*t["data_offsets"])], "<f4").reshape(t["shape"])
    return {name: values(tensor) for name, tensor in header.items()}


def truths(path):
    """The content of `tests/render/sky.json`: directions, and their colours as numpy computes them."""
    tensors, away = read(path), look(np.random.default_rng(3), 48)
    seen = [
        [*direction, *colours(tensors, direction[None])[0], *colours(tensors, direction[None], 1)[0]]
        for direction in away
    ]
    return "[\n" + ",\n".join(json.dumps([float(f"{value:.17g}") for value in row]) for row in seen) + "\n]\n"


if __name__ == "__main__":
    if sys.argv[1:] == ["truths"]:
        sys.stdout.write(truths("scenes/sky.safetensors"))
    else:
        write("scenes/sky.safetensors", train(steps=9_000))
