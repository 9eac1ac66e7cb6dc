"""LPIPS as ONNX: against a restatement of lpips and torchvision in NumPy, with random weights. Needs no PyTorch."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from safetensors.numpy import save_file
from wildcity import export_lpips
from wildcity.export_lpips import NETS, ExportError, shapes
from wildcity.serving import binary

Array = np.ndarray[Any, np.dtype[Any]]


@functools.lru_cache(maxsize=1)
def weights(net: str, seed: int = 5) -> tuple[dict[str, Array], dict[str, Array]]:
    """Of the classifier, with the names of torchvision, and the linear ones, with the names of lpips."""
    random = np.random.default_rng(seed)
    classifier: dict[str, Array] = {"classifier.1.weight": np.zeros((2, 2), np.float32)}
    linear: dict[str, Array] = {}
    for name, shape in shapes(net).items():
        if name.startswith("lin"):
            # Trained ones are not negative.
            linear[f"{name}.model.1.weight"] = random.uniform(0.0, 1.0, shape).astype(np.float32)
        else:
            spread = 0.1 if len(shape) == 1 else np.sqrt(2.0 / np.prod(shape[1:]))
            classifier[name] = (spread * random.standard_normal(shape)).astype(np.float32)
    return classifier, linear


def files(net: str, folder: Path, seed: int = 5) -> list[Path]:
    """Weights as files: the classifier's as safetensors, the linear ones as npz."""
    classifier, linear = weights(net, seed)
    save_file(classifier, folder / "classifier.safetensors")
    # A name of an array in a .npz may have dots.
    np.savez(folder / "linear.npz", **linear)
    return [folder / "classifier.safetensors", folder / "linear.npz"]


# --- lpips and torchvision in NumPy, layer by layer as their sources have them


def conv(x: Array, weight: Array, bias: Array, stride: int, pad: int) -> Array:
    side = weight.shape[2]
    x = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    windows = np.lib.stride_tricks.sliding_window_view(x, (side, side), axis=(1, 2))[:, ::stride, ::stride]
    result: Array = np.tensordot(weight, windows, ([1, 2, 3], [0, 3, 4])) + bias[:, None, None]
    return result


def pool(x: Array, side: int, ceil: bool) -> Array:
    rows, columns = ((length - side + (1 if ceil else 0)) // 2 + 1 for length in x.shape[1:])
    return np.array(
        [
            [x[:, 2 * row : 2 * row + side, 2 * column : 2 * column + side].max((1, 2)) for column in range(columns)]
            for row in range(rows)
        ]
    ).transpose(2, 0, 1)


# torchvision's `features`: (kind, stride, padding) of a convolution, side of a pool; and where lpips' slices end.
ALEXNET: list[Any] = [
    (4, 2), "relu", 3, (1, 2), "relu", 3, (1, 1), "relu", (1, 1), "relu", (1, 1), "relu",
]  # fmt: skip
VGG16: list[Any] = [
    (1, 1), "relu", (1, 1), "relu", 2, (1, 1), "relu", (1, 1), "relu", 2,
    (1, 1), "relu", (1, 1), "relu", (1, 1), "relu", 2,
    (1, 1), "relu", (1, 1), "relu", (1, 1), "relu", 2, (1, 1), "relu", (1, 1), "relu", (1, 1), "relu",
]  # fmt: skip
SQUEEZENET: list[Any] = [(2, 0), "relu", 3, "fire", "fire", 3, "fire", "fire", 3, "fire", "fire", "fire", "fire"]
FEATURES = {"alex": ALEXNET, "vgg": VGG16, "squeeze": SQUEEZENET}
SLICES = {"alex": [2, 5, 8, 10, 12], "vgg": [4, 9, 16, 23, 30], "squeeze": [2, 5, 8, 10, 11, 12, 13]}


def features(net: str, arrays: dict[str, Array], x: Array) -> list[Array]:
    """Of an image [3, h, w]: behind each slice."""
    relu = lambda x: np.maximum(x, 0.0)
    get = lambda layer: [arrays[f"features.{layer}.{kind}"].astype(float) for kind in ("weight", "bias")]
    taps = []
    for index, layer in enumerate(FEATURES[net]):
        if layer == "relu":
            x = relu(x)
        elif layer == "fire":
            squeezed = relu(conv(x, *get(f"{index}.squeeze"), 1, 0))
            wide = [conv(squeezed, *get(f"{index}.expand1x1"), 1, 0), conv(squeezed, *get(f"{index}.expand3x3"), 1, 1)]
            x = np.concatenate([relu(one) for one in wide])
        elif isinstance(layer, int):
            x = pool(x, layer, ceil=net == "squeeze")
        else:
            x = conv(x, *get(index), *layer)
        if index + 1 in SLICES[net]:
            taps.append(x)
    return taps


def lpips(net: str, image: Array, truth: Array, seed: int = 5) -> float:
    """Of images [3, h, w] in [-1, 1]."""
    arrays, linear = weights(net, seed)
    shift, scale = (np.array(values)[:, None, None] for values in ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]))
    of = [features(net, arrays, (x.astype(float) - shift) / scale) for x in (image, truth)]
    total = 0.0
    for tap, (a, b) in enumerate(zip(*of)):
        a, b = (x / (np.sqrt((x**2).sum(0)) + 1e-10) for x in (a, b))
        weight = linear[f"lin{tap}.model.1.weight"].astype(float).reshape(-1, 1, 1)
        total += (weight * (a - b) ** 2).sum(0).mean()
    return float(total)


def pair(height: int, width: int, seed: int = 2) -> tuple[Array, Array]:
    """Two images that differ, in f32."""
    random = np.random.default_rng(seed)
    truth = random.uniform(-1, 1, (3, height, width))
    image = np.clip(truth + 0.3 * random.standard_normal(truth.shape), -1, 1)
    return image.astype(np.float32), truth.astype(np.float32)


def session(path: Path) -> Callable[[Array, Array], Array]:
    run = onnxruntime.InferenceSession(path.with_suffix(".onnx"), providers=["CPUExecutionProvider"])
    assert {port.name: port.shape for port in run.get_inputs()} == dict.fromkeys(
        ("image", "truth"), [1, 3, "height", "width"]
    )

    def distance(image: Array, truth: Array) -> Array:
        (found,) = run.run(["distance"], {"image": image[None], "truth": truth[None]})
        return np.asarray(found)

    return distance


@pytest.mark.parametrize("net", ["alex", "vgg", "squeeze"])
def test_the_graph_is_the_network(net: str, tmp_path: Path) -> None:
    written = export_lpips.export(net, tmp_path / "lpips.onnx", files(net, tmp_path))
    distance = session(written)
    found = []
    # Odd sizes, so that pools cut off or round up.
    for height, width in ((35, 52), (38, 33)):
        image, truth = pair(height, width)
        found.append(distance(image, truth))
        assert found[-1].shape == (1, 1, 1, 1)
        wanted = lpips(net, image, truth)
        assert wanted > 0.01 and abs(found[-1].item() - wanted) <= 2e-6 * wanted + 1e-7, (found[-1].item(), wanted)
        assert distance(truth, image).item() == pytest.approx(wanted, rel=1e-5)
        assert distance(truth, truth).item() == 0.0
    # One colour: features without a length stay finite.
    flat = np.full((3, 64, 64), -0.03, np.float32)
    assert np.isfinite(distance(flat, pair(64, 64)[0])).all()


def test_the_networks_have_the_sizes_of_the_published_ones() -> None:
    # torchvision's features (alexnet, vgg16, squeezenet1_1), and lpips' channels.
    for net, parameters, channels in (
        ("alex", 2_469_696, [64, 192, 384, 256, 256]),
        ("vgg", 14_714_688, [64, 128, 256, 512, 512]),
        ("squeeze", 722_496, [64, 128, 256, 384, 384, 512, 512]),
    ):
        own = shapes(net)
        assert [shape[1] for name, shape in own.items() if name.startswith("lin")] == channels
        assert sum(int(np.prod(shape)) for name, shape in own.items() if name.startswith("features")) == parameters
    assert set(NETS) == {"alex", "vgg", "squeeze"}


def test_weights_of_the_package_give_the_same_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Names of lpips.LPIPS(net="squeeze").state_dict(): its slices keep torchvision's numbers.
    classifier, linear = weights("squeeze")
    slices = {
        name: 1 + sum(int(name.split(".")[1]) >= end for end in SLICES["squeeze"])
        for name in classifier
        if "features" in name
    }
    state = {f"net.slice{number}.{name.removeprefix('features.')}": classifier[name] for name, number in slices.items()}
    state |= linear | {name.replace("lin", "lins.", 1): values for name, values in linear.items()}
    state |= {"scaling_layer.shift": np.zeros((1, 3, 1, 1), np.float32)}
    asked = []

    class Tensor:
        def __init__(self, values: Array) -> None:
            self.detach = self.cpu = lambda: self
            self.numpy = lambda: values

    def network(**given: Any) -> Any:
        asked.append(given)
        return types.SimpleNamespace(state_dict=lambda: {name: Tensor(values) for name, values in state.items()})

    monkeypatch.setitem(sys.modules, "lpips", types.SimpleNamespace(LPIPS=network))
    installed = export_lpips.export("squeeze", tmp_path / "installed.onnx")
    assert asked == [{"net": "squeeze", "version": "0.1", "verbose": False}]
    given = export_lpips.export("squeeze", tmp_path / "given.onnx", files("squeeze", tmp_path))
    both = [path.with_suffix(".onnx").read_bytes() for path in (installed, given)]
    assert both[0] == both[1]
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(ExportError, match="pip install lpips, or give files as --weights"):
        export_lpips.export("alex", tmp_path / "x.onnx")


def test_wrong_weights_are_refused_and_nothing_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lpips.onnx"
    out.write_bytes(b"as it was")
    classifier, linear = weights("squeeze")
    stored = lambda name, arrays: (save_file(arrays, tmp_path / name), tmp_path / name)[1]
    good = files("squeeze", tmp_path)
    half = dict(classifier)
    half.pop("features.4.expand3x3.bias")
    bent = classifier | {"features.0.bias": np.zeros(63, np.float32)}
    holes = linear | {"lin2.model.1.weight": np.full((1, 256, 1, 1), np.nan, np.float32)}
    other = classifier | {"features.0.bias": np.ones(64, np.float32)}
    (tmp_path / "torn.safetensors").write_bytes(b"\xff" * 9)
    for given, fault in (
        ([good[0]], "no array lin0: it is in the linear weights, which lpips has in weights/v0.1"),
        ([good[1]], "no array features.0.weight: it is in the classifier of torchvision"),
        ([stored("half.safetensors", half), good[1]], "no array features.4.expand3x3.bias"),
        ([stored("bent.safetensors", bent), good[1]], "features.0.bias: the shape [63]; squeeze has [64]"),
        ([good[0], stored("holes.safetensors", holes)], "lin2.model.1.weight: a value is NaN or infinite"),
        ([*good, stored("other.safetensors", other)], "features.0.bias: another file has other values"),
        ([tmp_path / "torn.safetensors"], "torn.safetensors: "),
        ([tmp_path / "missing.npz"], "missing.npz: [Errno 2] No such file"),
        ([tmp_path / "weights.bin"], "a name that ends with .safetensors, .npz or .pth"),
    ):
        with pytest.raises(ExportError) as refused:
            export_lpips.export("squeeze", out, given)
        assert fault in str(refused.value), refused.value
    with pytest.raises(
        ExportError, match=r"features\.0\.(weight|bias): the shape .*; alex has |alex has no such array"
    ):
        export_lpips.export("alex", out, good)
    with pytest.raises(ExportError, match=r"--out: .*; a name that ends with \.onnx"):
        export_lpips.export("squeeze", tmp_path / "lpips.json", good)
    with pytest.raises(ExportError, match="--net: resnet; one of alex, vgg, squeeze"):
        export_lpips.export("resnet", out, good)
    with pytest.raises(ExportError, match="--out: cannot write"):
        export_lpips.export("squeeze", tmp_path / "nowhere" / "lpips.onnx", good)
    assert out.read_bytes() == b"as it was" and not out.with_suffix(".json").exists()
    assert export_lpips.main(["--net", "squeeze", "--out", str(out), "--weights", str(good[0])]) == 1
    assert "error: --weights" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []


def test_eval_measures_with_it(tmp_path: Path) -> None:
    written = export_lpips.main(
        ["--net", "alex", "--out", str(tmp_path / "lpips.onnx"), "--weights", *map(str, files("alex", tmp_path))]
    )
    assert written == 0
    manifest = json.loads((tmp_path / "lpips.json").read_text())
    assert manifest["files"][0]["path"] == "lpips.onnx" and manifest["name"] == "lpips-alex"

    def run(*arguments: str) -> None:
        done = subprocess.run([binary(), *arguments], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    street(tmp_path)
    run("render", "scene.ply", "--cameras", "views.jsonl", "--out", "rendered", "--backend", "cpu")
    from PIL import Image

    shown = np.asarray(Image.open(tmp_path / "rendered" / "ahead.png").convert("RGB"))
    changed = np.clip(shown.astype(int) + np.random.default_rng(3).integers(-40, 41, shown.shape), 0, 255).astype(
        np.uint8
    )
    (tmp_path / "real").mkdir()
    Image.fromarray(changed).save(tmp_path / "real" / "ahead.png")
    library = next((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so*"))
    images = ("--images", "views.jsonl", "--image-dir", "real", "--backend", "cpu", "--out", "out")
    run("eval", "scene.ply", *images, "--lpips", "lpips.json", "--onnxruntime", str(library))
    made = json.loads((tmp_path / "out" / "eval.json").read_text())
    assert made["subject"]["lpips_network"] == "lpips-alex 0.1"
    planes = [image.transpose(2, 0, 1) / 127.5 - 1.0 for image in (shown, changed)]
    wanted = lpips("alex", *planes)
    assert wanted > 0.01 and made["images"][0]["lpips"] == pytest.approx(wanted, rel=1e-5)


def street(folder: Path) -> None:
    """A scene of some Gaussians, and a list of one camera that sees them."""
    random = np.random.default_rng(1)
    names = [
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    count = 400
    values = np.concatenate(
        [
            random.uniform(-2, 2, (count, 3)),
            random.uniform(-1, 1, (count, 3)),
            np.full((count, 1), 3.0),
            np.full((count, 3), -1.5),
            np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        ],
        1,
    ).astype("<f4")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    (folder / "scene.ply").write_bytes("\n".join([*header, ""]).encode() + values.tobytes())
    camera = {"name": "ahead", "image": "ahead.png", "width": 96, "height": 80, "fx": 80, "fy": 80, "cx": 48, "cy": 40}
    pose = {"position": [0, 0, -5], "R_world_to_cam": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
    (folder / "views.jsonl").write_text(json.dumps(camera | pose) + "\n")
