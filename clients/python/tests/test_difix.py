"""The manifest, the configurations and the scheduler's step of Difix. Needs no PyTorch: test_difix_graph.py has the
rest."""

from __future__ import annotations

import copy
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from wildcity import WildCityError, export_difix
from wildcity.difix_config import ExportError, Step, UnetConfig, VaeConfig, image_multiple
from wildcity.serving import binary

# As in sd-turbo, and what nvidia/difix_ref adds.
VAE: dict[str, Any] = {
    "act_fn": "silu",
    "block_out_channels": [128, 256, 512, 512],
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
    "in_channels": 3,
    "out_channels": 3,
    "latent_channels": 4,
    "layers_per_block": 2,
    "norm_num_groups": 32,
    "scaling_factor": 0.18215,
    "gamma": 1.0,
    "ignore_skip": False,
    "lora_rank": 4,
}
UNET: dict[str, Any] = {
    "act_fn": "silu",
    "attention_head_dim": [5, 10, 20, 20],
    "block_out_channels": [320, 640, 1280, 1280],
    "cross_attention_dim": 1024,
    "down_block_types": ["CrossAttnDownBlock2D"] * 3 + ["DownBlock2D"],
    "up_block_types": ["UpBlock2D"] + ["CrossAttnUpBlock2D"] * 3,
    "in_channels": 4,
    "layers_per_block": 2,
    "norm_eps": 1e-05,
    "norm_num_groups": 32,
    "out_channels": 4,
    "use_linear_projection": True,
}
SCHEDULER: dict[str, Any] = {
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "num_train_timesteps": 1000,
    "prediction_type": "epsilon",
}


def field(number: int, value: bytes | int) -> bytes:
    """A field of a protobuf message."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def varint(value: int) -> bytes:
    low = bytes([value & 127])
    return low if value < 128 else bytes([low[0] | 128]) + varint(value >> 7)


def double(elements: int) -> bytes:
    """A graph with the ports of Difix: repaired = image + (reference - reference). elements: 1 for f32, 10 for f16."""

    def port(name: bytes) -> bytes:
        dims = [field(2, b"batch"), field(1, 3), field(2, b"height"), field(2, b"width")]
        shape = b"".join(field(1, dim) for dim in dims)
        return field(1, name) + field(2, field(1, field(1, elements) + field(2, shape)))

    def node(kind: bytes, a: bytes, b: bytes, result: bytes) -> bytes:
        return field(1, a) + field(1, b) + field(2, result) + field(4, kind)

    nodes = [node(b"Sub", b"reference", b"reference", b"none"), node(b"Add", b"image", b"none", b"repaired")]
    graph = b"".join(field(1, one) for one in nodes) + field(2, b"difix")
    graph += field(11, port(b"image")) + field(11, port(b"reference")) + field(12, port(b"repaired"))
    return field(1, 8) + field(7, graph) + field(8, field(1, b"") + field(2, 17))


def check(manifest: Path, *options: str) -> subprocess.CompletedProcess[str]:
    library = next((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so*"))
    command = [binary(), "dev", "repair", manifest, "--onnxruntime", library, *options]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.parametrize("dtype", ["f16", "f32"])
def test_the_server_takes_the_manifest_with_a_graph_of_the_same_ports(dtype: str, tmp_path: Path) -> None:
    (tmp_path / "difix_ref.onnx").write_bytes(double(10 if dtype == "f16" else 1))
    files = [("difix_ref.onnx", "0" * 64)]
    path = tmp_path / "difix_ref.json"
    path.write_text(json.dumps(export_difix.manifest(files, dtype=dtype, providers=["cpu"])))
    refused = check(path)
    assert refused.returncode != 0 and "files[0].blake3" in refused.stderr
    # The error says the hash of the file, so that no package for BLAKE3 is needed here.
    found = refused.stderr.split("the file has ")[1][:64]
    path.write_text(json.dumps(export_difix.manifest([("difix_ref.onnx", found)], dtype=dtype, providers=["cpu"])))
    checked = check(path, "--size", "100x70")
    assert checked.returncode == 0, checked.stderr
    assert "three runs gave the same bytes" in checked.stdout
    # The other type is refused, and so is a model without reference.
    other = "f32" if dtype == "f16" else "f16"
    path.write_text(json.dumps(export_difix.manifest([("difix_ref.onnx", found)], dtype=other, providers=["cpu"])))
    assert "inputs[0].dtype" in check(path).stderr
    alone = export_difix.manifest([("difix_ref.onnx", found)], dtype=dtype, providers=["cpu"], reference=False)
    path.write_text(json.dumps(alone))
    assert '"reference" of the graph has no entry' in check(path).stderr


def test_the_manifest_says_what_difix_is() -> None:
    content = export_difix.manifest([("difix_ref.onnx", "1" * 64), ("difix_ref.onnx.data", "2" * 64)])
    assert content["name"] == "difix-ref" and content["providers"] == ["cuda"]
    assert [file["path"] for file in content["files"]] == ["difix_ref.onnx", "difix_ref.onnx.data"]
    assert "non-commercial" in content["licence"]
    assert content["size"] == {"multiple_of": 64, "fit": "resize", "pixels": 1024 * 576}
    assert content["merge"] == "residual"
    assert [(entry["name"], entry["role"], entry["range"]) for entry in content["inputs"]] == [
        ("image", "rgb", [-1, 1]),
        ("reference", "reference", [-1, 1]),
    ]
    alone = export_difix.manifest([("difix.onnx", "1" * 64)], reference=False, name="mine")
    assert alone["name"] == "mine" and len(alone["inputs"]) == 1


def test_the_step_is_that_of_sd_turbo_at_199() -> None:
    step = Step.read(SCHEDULER)
    # The square roots of the betas are equidistant; the share of the signal is the product of 1 - beta of 200 steps.
    betas = np.linspace(math.sqrt(0.00085), math.sqrt(0.012), 1000) ** 2
    share = float(np.prod(1.0 - betas[:200]))
    assert step.signal_weight == pytest.approx(math.sqrt(share), abs=1e-14)
    assert share == pytest.approx(0.755238, abs=5e-7)
    # The numbers of diffusers, which multiplies in f32.
    assert step.signal_weight == pytest.approx(0.869044511, abs=2e-9)
    assert step.noise_weight == pytest.approx(0.494733907, abs=2e-9)


def test_the_configurations_of_sd_turbo() -> None:
    vae, unet = VaeConfig.read(VAE), UnetConfig.read(UNET)
    assert (vae.widths, vae.layers, vae.scale, vae.gamma) == ((128, 256, 512, 512), 2, 0.18215, 1.0)
    assert (unet.widths, unet.heads) == ((320, 640, 1280, 1280), (5, 10, 20, 20))
    assert unet.attends == (True, True, True, False) and not unet.upcast
    assert image_multiple(vae, unet) == export_difix.MULTIPLE == 64
    assert UnetConfig.read(UNET | {"attention_head_dim": 8}).heads == (8, 8, 8, 8)
    # Keys that diffusers adds, and null where it means false.
    added = {"dual_cross_attention": None, "num_class_embeds": None, "mid_block_scale_factor": 1.0, "sample_size": 64}
    assert UnetConfig.read(UNET | added) == unet


@pytest.mark.parametrize(
    ("reader", "config", "key", "value", "says"),
    [
        (VaeConfig, VAE, "latent_channels", 16, "Difix has 4"),
        (VaeConfig, VAE, "block_out_channels", [128, 256, 512], "3 levels"),
        (VaeConfig, VAE, "block_out_channels", "128", "a list of positive integers"),
        (VaeConfig, VAE, "ignore_skip", True, "Difix has False"),
        (VaeConfig, VAE, "shift_factor", 0.1, "Difix has None"),
        (VaeConfig, VAE, "scaling_factor", float("nan"), "a positive number"),
        (UnetConfig, UNET, "down_block_types", ["DownBlock2D"], "4 of CrossAttnDownBlock2D, DownBlock2D"),
        (UnetConfig, UNET, "up_block_types", ["UpBlock2D"] * 4, "Difix has ['UpBlock2D', 'CrossAttn"),
        (UnetConfig, UNET, "use_linear_projection", False, "Difix has True"),
        (UnetConfig, UNET, "use_linear_projection", None, "Difix has True"),
        (UnetConfig, UNET, "attention_head_dim", [5, 10, 20, 21], "divisors"),
        (UnetConfig, UNET, "cross_attention_dim", [1024], "a positive integer"),
        (UnetConfig, UNET, "layers_per_block", None, "a positive integer"),
        (Step, SCHEDULER, "prediction_type", "v_prediction", "Difix has 'epsilon'"),
        (Step, SCHEDULER, "beta_schedule", "linear", "Difix has 'scaled_linear'"),
        (Step, SCHEDULER, "num_train_timesteps", 199, "more than the time 199"),
        (Step, SCHEDULER, "beta_end", None, "a positive number"),
    ],
)
def test_another_network_is_refused_with_the_key(
    reader: Any, config: dict[str, Any], key: str, value: Any, says: str
) -> None:
    reader.read(config)
    wrong = copy.deepcopy(config)
    wrong[key] = value
    with pytest.raises(ExportError) as refused:
        reader.read(wrong)
    assert refused.value.field.endswith(f": {key}"), refused.value.field
    assert says in refused.value.message
    assert isinstance(refused.value, WildCityError)


def test_what_must_be_said_is_missed() -> None:
    for reader, config, key in ((UnetConfig, UNET, "use_linear_projection"), (Step, SCHEDULER, "beta_schedule")):
        without = {name: value for name, value in config.items() if name != key}
        with pytest.raises(ExportError, match=f"json: {key}: missing"):
            reader.read(without)  # type: ignore[attr-defined]


def test_without_pytorch_the_command_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    out = tmp_path / "difix.onnx"
    assert export_difix.main(["--weights", str(tmp_path), "--out", str(out)]) == 1
    assert "pip install 'wildcity[difix]'" in capsys.readouterr().err
    assert export_difix.main(["--weights", str(tmp_path), "--out", str(tmp_path / "difix.pt")]) == 1
    assert "a name that ends with .onnx" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
