"""Writes a network of LPIPS as an ONNX file, with the manifest that `wildcity eval --lpips` reads.

    python -m wildcity.export_lpips --net alex --out lpips_alex.onnx
    python -m wildcity.export_lpips --net alex --weights alexnet.pth lpips/weights/v0.1/alex.pth --out lpips_alex.onnx

LPIPS (Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018) compares
features of a network that was trained to classify. wildcity has no weights. The first form takes them from the packages
lpips and torchvision, which must be installed; torchvision downloads those of the classifier if they are not on the
disk. The second form reads files: the classifier's of torchvision, and the linear weights that lpips has in its folder
`weights/v0.1`; or one file with all of an `lpips.LPIPS`. Files end with .safetensors, .npz, or .pth (PyTorch must be
installed). Needs `pip install 'wildcity[lpips]'`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .difix_config import ExportError

__all__ = ["NETS", "ExportError", "export", "main", "manifest"]

Arrays = dict[str, npt.NDArray[Any]]

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Shift and scale of the colours, for images in [-1, 1]: `ScalingLayer` in lpips/lpips.py."""

EPSILON = 1e-10
"""Added to the length of a feature vector before the division: `normalize_tensor` in lpips 0.1.4."""

LICENCE = "BSD-2-Clause (lpips); BSD-3-Clause (torchvision)"


@dataclass(frozen=True)
class Conv:
    """A convolution with the ReLU after it. index: its index in torchvision's `features`."""

    index: int
    inputs: int
    outputs: int
    side: int
    stride: int = 1
    pad: int = 0


@dataclass(frozen=True)
class Fire:
    """SqueezeNet's block: 1 x 1 to `squeezed` channels, then half of `outputs` by 1 x 1 and half by 3 x 3."""

    index: int
    inputs: int
    squeezed: int
    outputs: int


@dataclass(frozen=True)
class Pool:
    """The largest value. ceil: a window that is cut off by the border counts."""

    side: int
    ceil: bool = False


@dataclass(frozen=True)
class Tap:
    """LPIPS compares the features here."""


Step = Conv | Fire | Pool | Tap


def _vgg() -> Iterator[Step]:
    index = inputs = 0
    for outputs, convolutions in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        if index:
            yield Pool(2)
            index += 1
        for _ in range(convolutions):
            yield Conv(index, inputs or 3, outputs, 3, pad=1)
            # The ReLU has a number, too.
            index, inputs = index + 2, outputs
        yield Tap()


NETS: dict[str, Sequence[Step]] = {
    "alex": (
        Conv(0, 3, 64, 11, stride=4, pad=2), Tap(), Pool(3), Conv(3, 64, 192, 5, pad=2), Tap(), Pool(3),
        Conv(6, 192, 384, 3, pad=1), Tap(), Conv(8, 384, 256, 3, pad=1), Tap(), Conv(10, 256, 256, 3, pad=1), Tap(),
    ),
    "vgg": tuple(_vgg()),
    "squeeze": (
        Conv(0, 3, 64, 3, stride=2), Tap(), Pool(3, ceil=True), Fire(3, 64, 16, 128), Fire(4, 128, 16, 128), Tap(),
        Pool(3, ceil=True), Fire(6, 128, 32, 256), Fire(7, 256, 32, 256), Tap(), Pool(3, ceil=True),
        Fire(9, 256, 48, 384), Tap(), Fire(10, 384, 48, 384), Tap(), Fire(11, 384, 64, 512), Tap(),
        Fire(12, 512, 64, 512), Tap(),
    ),
}  # fmt: skip
"""torchvision's alexnet, vgg16 and squeezenet1_1, as far as lpips/pretrained_networks.py cuts them into slices."""

_BACKBONE = re.compile(r"(?:features|net\.slice\d+)\.(?P<layer>\d+(?:\.\w+)?)\.(?P<kind>weight|bias)")
_LINEAR = re.compile(r"lin(?P<tap>\d+)\.model\.\d+\.weight")


def shapes(net: str) -> dict[str, list[int]]:
    """The arrays of a network, by the names that `collected` gives them."""
    expected: dict[str, list[int]] = {}

    def conv(layer: str, inputs: int, outputs: int, side: int) -> int:
        expected[f"features.{layer}.weight"] = [outputs, inputs, side, side]
        expected[f"features.{layer}.bias"] = [outputs]
        return outputs

    channels = taps = 0
    for step in NETS[net]:
        if isinstance(step, Conv):
            channels = conv(str(step.index), step.inputs, step.outputs, step.side)
        elif isinstance(step, Fire):
            conv(f"{step.index}.squeeze", step.inputs, step.squeezed, 1)
            conv(f"{step.index}.expand1x1", step.squeezed, step.outputs // 2, 1)
            conv(f"{step.index}.expand3x3", step.squeezed, step.outputs // 2, 3)
            channels = step.outputs
        elif isinstance(step, Tap):
            expected[f"lin{taps}"] = [1, channels, 1, 1]
            taps += 1
    return expected


def collected(net: str, files: Sequence[tuple[str, Mapping[str, Any]]]) -> Arrays:
    """The arrays of a network in f32, of one or more files. Raises `ExportError` with the file and the array."""
    expected = shapes(net)
    found: Arrays = {}
    for file, arrays in files:
        for name, values in arrays.items():
            backbone, linear = _BACKBONE.fullmatch(name), _LINEAR.fullmatch(name)
            if backbone:
                own = f"features.{backbone['layer']}.{backbone['kind']}"
            elif linear:
                own = f"lin{linear['tap']}"
            else:
                # The classifier's last layers, the scaling of colours, and lpips' second list of the linear weights.
                continue
            array = np.asarray(values, np.float32)
            if own not in expected:
                raise ExportError(f"{file}: {name}", f"{net} has no such array: is it of another network?")
            if list(array.shape) != expected[own]:
                raise ExportError(f"{file}: {name}", f"the shape {list(array.shape)}; {net} has {expected[own]}")
            if not np.isfinite(array).all():
                raise ExportError(f"{file}: {name}", "a value is NaN or infinite")
            if own in found and not np.array_equal(found[own], array):
                raise ExportError(f"{file}: {name}", "another file has other values")
            found[own] = array
    for name in expected:
        if name not in found:
            part = (
                "linear weights, which lpips has in weights/v0.1"
                if name.startswith("lin")
                else "classifier of torchvision"
            )
            names = ", ".join(file for file, _ in files)
            raise ExportError(f"--weights {names}", f"no array {name}: it is in the {part}")
    return found


@dataclass
class _Graph:
    """A graph while it is written: nodes in the order in which they run, and arrays by their names."""

    nodes: list[Any] = field(default_factory=list)
    constants: Arrays = field(default_factory=dict)

    def constant(self, name: str, values: npt.NDArray[Any]) -> str:
        self.constants[name] = values
        return name

    def node(self, kind: str, name: str, inputs: Iterable[str], **attributes: Any) -> str:
        """An operator with one output, which has the node's name."""
        return self.split(kind, [name], inputs, **attributes)[0]

    def split(self, kind: str, names: list[str], inputs: Iterable[str], **attributes: Any) -> list[str]:
        """An operator with several outputs. It has the name of the first."""
        from onnx import helper

        self.nodes.append(helper.make_node(kind, list(inputs), names, names[0], **attributes))
        return names


def graph(net: str, arrays: Arrays) -> bytes:
    """The ONNX file: `distance` of `image` and `truth`, [1, 3, height, width] in [-1, 1]."""
    from onnx import TensorProto, checker, helper, numpy_helper

    made = _Graph()
    # Both at once, as a batch.
    both = made.node("Concat", "both", ["image", "truth"], axis=0)
    shift, scale = (np.array(values, np.float32).reshape(1, 3, 1, 1) for values in (SHIFT, SCALE))
    x = made.node("Sub", "shifted", [both, made.constant("shift", shift)])
    x = made.node("Div", "scaled", [x, made.constant("scale", scale)])

    def conv(layer: str, x: str, side: int, stride: int = 1, pad: int = 0) -> str:
        of = [
            x,
            *(made.constant(name, arrays[name]) for name in (f"features.{layer}.weight", f"features.{layer}.bias")),
        ]
        done = made.node("Conv", layer, of, kernel_shape=[side] * 2, strides=[stride] * 2, pads=[pad] * 4)
        return made.node("Relu", f"{layer}.relu", [done])

    distances: list[str] = []
    for at, step in enumerate(NETS[net]):
        if isinstance(step, Conv):
            x = conv(str(step.index), x, step.side, step.stride, step.pad)
        elif isinstance(step, Fire):
            squeezed = conv(f"{step.index}.squeeze", x, 1)
            wide = [conv(f"{step.index}.expand1x1", squeezed, 1), conv(f"{step.index}.expand3x3", squeezed, 3, pad=1)]
            x = made.node("Concat", f"{step.index}.expanded", wide, axis=1)
        elif isinstance(step, Pool):
            x = made.node(
                "MaxPool", f"pool{at}", [x], kernel_shape=[step.side] * 2, strides=[2, 2], ceil_mode=int(step.ceil)
            )
        else:
            distances.append(_tap(made, len(distances), x, arrays))
    total = distances[0]
    for tap, one in enumerate(distances[1:], 1):
        name = "distance" if tap == len(distances) - 1 else f"sum{tap}"
        total = made.node("Add", name, [total, one])
    sides = [1, 3, "height", "width"]
    images = [helper.make_tensor_value_info(name, TensorProto.FLOAT, sides) for name in ("image", "truth")]
    distance = helper.make_tensor_value_info(total, TensorProto.FLOAT, [1, 1, 1, 1])
    constants = [numpy_helper.from_array(values, name) for name, values in made.constants.items()]
    whole = helper.make_graph(made.nodes, f"lpips_{net}", images, [distance], constants)
    # onnxruntime reads version 8 of the format from 1.10 on.
    model = helper.make_model(
        whole, ir_version=8, opset_imports=[helper.make_opsetid("", 17)], producer_name="wildcity"
    )
    checker.check_model(model)
    content: bytes = model.SerializeToString()
    return content


def _tap(made: _Graph, tap: int, x: str, arrays: Arrays) -> str:
    """The mean over the pixels of the weighted squares of differences, of features with the length 1."""
    name = f"tap{tap}"
    channels = made.constant("channels", np.array([1], np.int64))
    squares = made.node(
        "ReduceSum", f"{name}.squares", [made.node("Mul", f"{name}.squared", [x, x]), channels], keepdims=1
    )
    epsilon = made.constant("epsilon", np.array(EPSILON, np.float32))
    length = made.node("Add", f"{name}.length", [made.node("Sqrt", f"{name}.root", [squares]), epsilon])
    unit = made.node("Div", f"{name}.unit", [x, length])
    image, truth = made.split("Split", [f"{name}.image", f"{name}.truth"], [unit], axis=0)
    apart = made.node("Sub", f"{name}.apart", [image, truth])
    apart = made.node("Mul", f"{name}.apart2", [apart, apart])
    weighted = made.node(
        "Conv", f"{name}.weighted", [apart, made.constant(f"lin{tap}", arrays[f"lin{tap}"])], kernel_shape=[1, 1]
    )
    return made.node("ReduceMean", f"{name}.mean", [weighted], axes=[2, 3], keepdims=1)


def manifest(net: str, file: str, content_blake3: str, providers: Sequence[str] = ("cpu",)) -> dict[str, Any]:
    """The manifest (docs/evaluation.md)."""
    images = [{"name": role, "role": role, "range": [-1, 1]} for role in ("image", "truth")]
    return {
        "format": "wildcity.network/1",
        "name": f"lpips-{net}",
        "version": "0.1",
        "licence": LICENCE,
        "files": [{"path": file, "blake3": content_blake3}],
        "providers": list(providers),
        "timeout_ms": 60_000,
        "inputs": images,
        "output": "distance",
    }


def export(
    net: str,
    out: str | os.PathLike[str],
    weights: Sequence[str | os.PathLike[str]] = (),
    *,
    providers: Sequence[str] = ("cpu",),
) -> Path:
    """Writes the graph and, last, its manifest: `out` with the suffix .json, whose path is returned.

    net: "alex", "vgg" or "squeeze". weights: files; without them the installed package lpips.

    Raises `ExportError` if the weights are not those of the network, or a file cannot be written. Then the files at
    `out` are as they were.
    """
    out = Path(out)
    if out.suffix != ".onnx":
        raise ExportError("--out", f"{out}; a name that ends with .onnx")
    if net not in NETS:
        raise ExportError("--net", f"{net}; one of {', '.join(NETS)}")
    try:
        import blake3
        import onnx  # noqa: F401
    except ImportError as error:
        raise ExportError(error.name or "a package", f"{error}; pip install 'wildcity[lpips]'") from error
    files = [(os.fspath(path), _read(Path(path))) for path in weights] or [("lpips", _installed(net))]
    content = graph(net, collected(net, files))
    said = manifest(net, out.name, blake3.blake3(content).hexdigest(), providers)
    try:
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as part:
            written = [Path(part) / out.name, Path(part) / out.with_suffix(".json").name]
            written[0].write_bytes(content)
            written[1].write_text(json.dumps(said, indent=2) + "\n")
            # The manifest last: it pins the graph.
            for path in written:
                os.replace(path, out.parent / path.name)
    except OSError as error:
        raise ExportError("--out", f"cannot write {out}: {error}") from error
    return out.with_suffix(".json")


def _read(path: Path) -> Mapping[str, Any]:
    """The arrays of a file."""
    try:
        if path.suffix == ".npz":
            with np.load(path) as stored:
                return dict(stored)
        if path.suffix == ".safetensors":
            from safetensors.numpy import load_file

            return dict(load_file(path))
        if path.suffix == ".pth":
            import torch

            # Arrays only: a file of this kind may contain a program.
            return _arrays(torch.load(path, map_location="cpu", weights_only=True))
    except ModuleNotFoundError as error:
        message = f"{error}; install it, or convert the file to .npz or .safetensors"
        raise ExportError(f"--weights {path}", message) from error
    except Exception as error:  # Errors of the readers have no common class.
        raise ExportError(f"--weights {path}", str(error)) from error
    raise ExportError(f"--weights {path}", "a name that ends with .safetensors, .npz or .pth")


def _installed(net: str) -> Mapping[str, Any]:
    """The arrays of the installed package, which has torchvision load those of the classifier."""
    try:
        import lpips
    except ImportError as error:
        raise ExportError("lpips", f"{error}; pip install lpips, or give files as --weights") from error
    try:
        return _arrays(lpips.LPIPS(net=net, version="0.1", verbose=False).state_dict())
    except Exception as error:  # No network, no space, another version.
        raise ExportError("lpips", f"it cannot load {net}: {error}") from error


def _arrays(tensors: Mapping[str, Any]) -> Arrays:
    return {name: values.detach().cpu().numpy() for name, values in tensors.items()}


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m wildcity.export_lpips", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--net", required=True, choices=list(NETS), help="the network; numbers of two cannot be compared"
    )
    parser.add_argument("--out", required=True, help="the .onnx file; the manifest is written next to it")
    parser.add_argument(
        "--weights", nargs="+", default=[], help="files of weights [default: the installed package lpips]"
    )
    parser.add_argument("--providers", default="cpu", help="of the manifest, with commas [default: cpu]")
    chosen = parser.parse_args(arguments)
    try:
        written = export(chosen.net, chosen.out, chosen.weights, providers=chosen.providers.split(","))
    except ExportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(written)
    return 0


if __name__ == "__main__":
    sys.exit(main())
