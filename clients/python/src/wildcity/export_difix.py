"""Writes NVIDIA's Difix as one ONNX file, with the manifest that `wildcity serve --repair` reads.

    python -m wildcity.export_difix --weights DIR --out difix_ref.onnx
    python -m wildcity.export_difix --weights nvidia/difix --out difix.onnx --no-reference --dtype f32

`--weights` is a folder in the layout of diffusers, as nvidia/difix_ref and nvidia/difix have it: tokenizer,
text_encoder, unet, vae, scheduler. If there is no such folder, the name is that of a repository, which is downloaded
from huggingface.co. The weights may be used non-commercially only; wildcity has none. Needs `pip install
'wildcity[difix]'` (PyTorch), no GPU, and for f16 10 GB of memory.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .difix_config import ExportError

if TYPE_CHECKING:
    from .difix_graph import Difix

__all__ = ["ExportError", "export", "main", "manifest"]

OPSET = 17

EXTERNAL_ABOVE_BYTES = 2_000_000_000
"""A file of the ONNX format has at most 2 GiB. Larger weights are in a second file."""

LARGEST_DIFFERENCE = {"f32": 1e-3, "f16": 0.1}
"""Largest difference between graph and modules, for values from -1 to 1. Both round, in different orders."""

MULTIPLE = 64
"""Sides of images, in pixels: `difix_config.image_multiple` of SD-Turbo."""

PIXELS = 589_824
"""1024 x 576: what Difix was trained with (`height=576, width=1024` in src/dataset.py of nv-tlabs/Difix3D)."""

LICENCE = "NVIDIA License, non-commercial (nvidia/difix, nvidia/difix_ref)"


def export(
    weights: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    reference: bool = True,
    dtype: str = "f16",
    name: str | None = None,
    providers: Sequence[str] = ("cuda",),
    attention: str = "plain",
    compare: bool = False,
    external_above: int = EXTERNAL_ABOVE_BYTES,
) -> Path:
    """Writes the graph and, last, its manifest: `out` with the suffix .json, whose path is returned.

    attention: "plain" has operators of ONNX only; "fused" has onnxruntime's MultiHeadAttention.
    compare: runs the graph in onnxruntime on the processor and refuses it if it differs from PyTorch.

    Raises `ExportError` if something in the folder is not what Difix has, or a file cannot be written. Then the files
    at `out` are as they were.
    """
    out = Path(out)
    if out.suffix != ".onnx":
        raise ExportError("--out", f"{out}; a name that ends with .onnx")
    try:
        import torch

        from . import difix_weights
    except ImportError as error:
        raise ExportError("PyTorch", f"{error}; pip install 'wildcity[difix]'") from error
    kind = {"f16": torch.float16, "f32": torch.float32}[dtype]
    model = difix_weights.load(difix_weights.folder(weights), reference, kind)
    if attention == "fused":
        model.fuse_attention()
    try:
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as part:
            written = _write_graph(model, Path(part), out.name, external_above)
            if compare:
                difference = _difference(model, written[0])
                print(f"largest difference from PyTorch: {difference:.2e} of values from -1 to 1", file=sys.stderr)
                # A NaN is refused, too.
                if not difference <= LARGEST_DIFFERENCE[dtype]:
                    message = f"{difference:.2e} from PyTorch; at most {LARGEST_DIFFERENCE[dtype]}. Try another version"
                    raise ExportError("--compare", f"{message} of PyTorch ({torch.__version__} is here)")
            content = manifest(
                [(path.name, blake3(path)) for path in written],
                reference=reference,
                dtype=dtype,
                name=name,
                providers=providers,
                multiple=model.multiple,
            )
            text = Path(part) / out.with_suffix(".json").name
            text.write_text(json.dumps(content, indent=2) + "\n")
            # The manifest last: it pins the others.
            for path in [*reversed(written), text]:
                os.replace(path, out.parent / path.name)
    except OSError as error:
        raise ExportError("--out", f"cannot write {out}: {error}") from error
    return out.with_suffix(".json")


def manifest(
    files: Sequence[tuple[str, str]],
    *,
    reference: bool = True,
    dtype: str = "f16",
    name: str | None = None,
    providers: Sequence[str] = ("cuda",),
    multiple: int = MULTIPLE,
) -> dict[str, Any]:
    """The manifest of a graph (docs/repair.md). files: names and BLAKE3 of the .onnx file, then of its external
    weights."""
    image = {"name": "image", "role": "rgb", "dtype": dtype, "range": [-1, 1]}
    recorded = {"name": "reference", "role": "reference", "dtype": dtype, "range": [-1, 1]}
    return {
        "format": "wildcity.repair/1",
        "name": name or ("difix-ref" if reference else "difix"),
        "version": "1",
        "licence": LICENCE,
        "files": [{"path": path, "blake3": content} for path, content in files],
        "providers": list(providers),
        "memory_mib": 16384,
        "timeout_ms": 600_000 if providers[0] == "cpu" else 2000,
        # Lanczos there and back costs more than Difix gains, so only what the model changed goes back.
        "size": {"multiple_of": multiple, "fit": "resize", "pixels": PIXELS},
        "merge": "residual",
        "inputs": [image, recorded] if reference else [image],
        "outputs": [{"name": "repaired", "role": "rgb", "range": [-1, 1]}],
    }


def blake3(path: Path) -> str:
    """BLAKE3 of a file, 64 hexadecimal digits."""
    import blake3 as package

    digest: str = package.blake3().update_mmap(path).hexdigest()
    return digest


def _write_graph(model: Difix, folder: Path, name: str, external_above: int) -> list[Path]:
    """Writes the graph to a folder: the .onnx file, and a second file if the weights are larger than
    `external_above`."""
    import onnx
    import torch

    dtype = model.prompt.dtype
    inputs = ["image", "reference"] if model.with_reference else ["image"]
    # The smallest image. The graph is the same for all sizes: no shape of the trace is kept.
    images = tuple(torch.zeros(1, 3, model.multiple, model.multiple, dtype=dtype) for _ in inputs)
    axes = {0: "batch", 2: "height", 3: "width"}
    # PyTorch writes weights above 2 GiB as a file for each tensor.
    with tempfile.TemporaryDirectory(dir=folder) as traced, _quiet(), torch.no_grad():
        torch.onnx.export(
            model,
            images,
            os.path.join(traced, "graph.onnx"),
            opset_version=OPSET,
            dynamo=False,
            input_names=inputs,
            output_names=["repaired"],
            dynamic_axes={port: axes for port in [*inputs, "repaired"]},
            custom_opsets={"com.microsoft": 1} if model.has_fused_attention else None,
        )
        graph = onnx.load(os.path.join(traced, "graph.onnx"))
    graph.doc_string = LICENCE
    written = [folder / name]
    if sum(_bytes(values) for values in graph.graph.initializer) > external_above:
        written.append(folder / f"{name}.data")
        onnx.save_model(graph, written[0], save_as_external_data=True, location=written[1].name, size_threshold=1024)
    else:
        onnx.save_model(graph, written[0])
    onnx.checker.check_model(written[0])
    return written


def _bytes(tensor: Any) -> int:
    """Bytes of a tensor of the graph, without a copy."""
    count: int = tensor.ByteSize()
    return count


def _difference(model: Difix, graph: Path) -> float:
    """The largest difference between the modules and the graph, of two images of another size than the traced one."""
    import numpy as np
    import onnxruntime
    import torch

    random = np.random.default_rng(1)
    shape = (2, 3, model.multiple, 2 * model.multiple)
    options = onnxruntime.SessionOptions()
    # Errors only: in f16 it warns of every constant that the processor cannot compute beforehand.
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # Many types, all private to onnxruntime.
        raise ExportError("--compare", f"onnxruntime cannot run the graph on the processor: {error}") from error
    kind = np.float16 if model.prompt.dtype == torch.float16 else np.float32
    feed = {port.name: random.uniform(-1, 1, shape).astype(kind) for port in session.get_inputs()}
    (found,) = session.run(None, feed)
    with torch.no_grad():
        expected = model(*(torch.from_numpy(values) for values in feed.values())).numpy()
    return float(np.abs(found.astype(np.float32) - expected.astype(np.float32)).max())


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the warnings of the tracer: that it is the older of two, and that checks of shapes are not in the
    graph."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m wildcity.export_difix", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--weights", required=True, help="folder of the weights, or a repository of huggingface.co")
    parser.add_argument("--out", required=True, help="the .onnx file; the manifest is written next to it")
    parser.add_argument("--no-reference", action="store_true", help="for nvidia/difix, whose only input is the image")
    parser.add_argument("--dtype", choices=["f16", "f32"], default="f16", help="[default: f16]")
    parser.add_argument(
        "--attention",
        choices=["plain", "fused"],
        default="plain",
        help="fused: an operator of onnxruntime [default: plain]",
    )
    parser.add_argument("--compare", action="store_true", help="compare the graph on the processor with PyTorch")
    parser.add_argument("--name", help="what sessions ask for [default: difix-ref, or difix]")
    parser.add_argument("--providers", default="cuda", help="of the manifest, with commas [default: cuda]")
    chosen = parser.parse_args(arguments)
    try:
        written = export(
            chosen.weights,
            chosen.out,
            reference=not chosen.no_reference,
            dtype=chosen.dtype,
            name=chosen.name,
            providers=chosen.providers.split(","),
            attention=chosen.attention,
            compare=chosen.compare,
        )
    except ExportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(written)
    return 0


if __name__ == "__main__":
    sys.exit(main())
