"""Reads the tensors of a Difix folder into the network, and computes the embedding of the prompt.

nvidia/difix and nvidia/difix_ref keep the decoder's adapters (LoRA, Hu et al. 2021) next to the weights they change:
`decoder.conv_in.base_layer.weight`, `decoder.conv_in.lora_A.vae_skip.weight`, `decoder.conv_in.lora_B.vae_skip.weight`.
The graph has their sum.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from .difix_config import PROMPT, TIMESTEP, ExportError, Step, UnetConfig, VaeConfig, read_json
from .difix_graph import Difix
from .difix_unet import sinusoids

__all__ = ["folder", "load", "merge_adapters", "prompt_embedding"]

LORA_ALPHA = 8
"""The sum is base + alpha / rank * B A. src/model.py of nv-tlabs/Difix3D gives a rank (4) and no alpha: the default of
peft's LoraConfig applies. `lora_alpha` in vae/config.json takes precedence."""

F16_MAX = 65504.0

_NAMES = ("diffusion_pytorch_model.safetensors", "diffusion_pytorch_model.fp16.safetensors")
_ADAPTER = re.compile(r"(?P<layer>.+)\.lora_(?P<side>[AB])\.[^.]+\.weight")
_HUB_ID = re.compile(r"\w[\w.-]*/\w[\w.-]*")
_HUB_FILES = ["*.json", "*.txt", "unet/*.safetensors", "vae/*.safetensors", "text_encoder/*.safetensors"]


def folder(weights: str | os.PathLike[str]) -> Path:
    """A folder, or the name of a repository on huggingface.co, which is downloaded. Raises `ExportError`."""
    path = Path(weights)
    if path.is_dir():
        return path
    if path.exists() or not _HUB_ID.fullmatch(os.fspath(weights)):
        raise ExportError("--weights", f"{os.fspath(weights)}: no such folder; give one, or nvidia/difix_ref")
    print(f"there is no folder {weights}: downloading {weights} from huggingface.co", file=sys.stderr)
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(os.fspath(weights), allow_patterns=_HUB_FILES))
    except Exception as error:  # Many types: no network, no licence accepted, no such repository.
        raise ExportError("--weights", f"{weights}: {error}") from error


def load(path: Path, with_reference: bool, dtype: torch.dtype) -> Difix:
    """The network with the weights of a folder. Raises `ExportError` with the file, and the key or tensor."""
    vae_json = read_json(path / "vae" / "config.json", "vae/config.json")
    vae = VaeConfig.read(vae_json)
    unet = UnetConfig.read(read_json(path / "unet" / "config.json", "unet/config.json"))
    scheduler = "scheduler/scheduler_config.json"
    step = Step.read(read_json(path / scheduler, scheduler))
    alpha = vae_json.get("lora_alpha", LORA_ALPHA)
    if not isinstance(alpha, (int, float)):
        raise ExportError("vae/config.json: lora_alpha", f"{alpha!r}; a number")
    with torch.device("meta"):
        model = Difix(vae, unet, step, with_reference)
    _fill(model.vae, "vae", _tensors(path, "vae"), alpha, dtype)
    _fill(model.unet, "unet", _tensors(path, "unet"), alpha, dtype)
    model.unet.time = sinusoids(TIMESTEP, unet.widths[0]).to(dtype)
    embedding = prompt_embedding(path)
    if embedding.shape[2] != unet.context:
        message = f"{embedding.shape[2]} values a token; cross_attention_dim of unet/config.json is {unet.context}"
        raise ExportError("text_encoder", message)
    model.prompt = embedding.to(dtype)
    model.eval().requires_grad_(False)
    return model


def prompt_embedding(path: Path) -> Tensor:
    """The embedding of the prompt by the folder's text encoder: [1, tokens, context]. Raises `ExportError`.

    As diffusers does for Stable Diffusion: padded to the longest prompt (77 tokens), the last hidden state.
    """
    from transformers import CLIPTextModel, CLIPTokenizer
    from transformers.utils import logging

    for part in ("tokenizer", "text_encoder"):
        if not (path / part).is_dir():
            raise ExportError(part, f"no such folder in {path}")
    had_bar = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        tokenizer = CLIPTokenizer.from_pretrained(path / "tokenizer", local_files_only=True)
        encoder = CLIPTextModel.from_pretrained(path / "text_encoder", local_files_only=True, dtype=torch.float32)
    except Exception as error:  # The type depends on the version of transformers.
        raise ExportError("text_encoder", f"transformers cannot read it: {error}") from error
    finally:
        if had_bar:
            logging.enable_progress_bar()
    length = encoder.config.max_position_embeddings
    tokens = tokenizer(PROMPT, padding="max_length", max_length=length, truncation=True, return_tensors="pt")
    with torch.no_grad():
        hidden: Tensor = encoder(tokens.input_ids)[0]
    return hidden


def merge_adapters(tensors: Mapping[str, Tensor], field: str, alpha: float = LORA_ALPHA) -> dict[str, Tensor]:
    """Tensors without adapters: each base layer has what its adapter adds. Raises `ExportError` with the tensor."""
    merged: dict[str, Tensor] = {}
    adapters: dict[str, dict[str, Tensor]] = {}
    for name, values in tensors.items():
        found = _ADAPTER.fullmatch(name)
        if found:
            adapters.setdefault(found["layer"], {})[found["side"]] = values
        else:
            merged[name.replace(".base_layer.", ".")] = values
    for layer, sides in adapters.items():
        base = merged.get(f"{layer}.weight")
        if base is None or set(sides) != {"A", "B"}:
            raise ExportError(f"{field}: {layer}", "an adapter needs base_layer.weight, lora_A and lora_B")
        a, b = sides["A"].float().flatten(1), sides["B"].float().flatten(1)
        rank = a.shape[0]
        if b.shape != (base.shape[0], rank) or a.shape[1] * base.shape[0] != base.numel():
            shapes = f"lora_A {list(sides['A'].shape)}, lora_B {list(sides['B'].shape)}, weight {list(base.shape)}"
            raise ExportError(f"{field}: {layer}", f"the shapes of the adapter do not fit: {shapes}")
        merged[f"{layer}.weight"] = base.float() + (alpha / rank) * (b @ a).reshape(base.shape)
    return merged


def _tensors(path: Path, part: str) -> dict[str, Tensor]:
    """The tensors of `vae` or `unet`."""
    from safetensors.torch import load_file

    for name in _NAMES:
        if (path / part / name).is_file():
            try:
                return dict(load_file(path / part / name))
            except Exception as error:  # Errors of the reader have no common class.
                raise ExportError(f"{part}/{name}", str(error)) from error
    raise ExportError(f"{part}/{_NAMES[0]}", f"no such file in {path}")


def _fill(network: nn.Module, part: str, tensors: Mapping[str, Tensor], alpha: float, dtype: torch.dtype) -> None:
    """Every parameter of a network gets the tensor of its name."""
    file = f"{part}/{_NAMES[0]}"
    values = merge_adapters(tensors, file, alpha)
    expected: dict[str, Any] = {name: list(parameter.shape) for name, parameter in network.state_dict().items()}
    for message, names in (
        ("missing; Difix has it", [name for name in expected if name not in values]),
        ("Difix has no such tensor", [name for name in values if name not in expected]),
    ):
        if names:
            others = f", and {len(names) - 1} others are too" if len(names) > 1 else ""
            raise ExportError(f"{file}: {names[0]}", message + others)
    for name, shape in expected.items():
        found = values[name]
        if list(found.shape) != shape:
            raise ExportError(f"{file}: {name}", f"the shape {list(found.shape)}; Difix has {shape}")
        if not torch.isfinite(found).all():
            raise ExportError(f"{file}: {name}", "a value is NaN or infinite")
        if dtype == torch.float16 and found.abs().max() > F16_MAX:
            raise ExportError(f"{file}: {name}", f"a value is above {F16_MAX:.0f}, where f16 ends; give --dtype f32")
    network.load_state_dict({name: values[name].to(dtype) for name in expected}, assign=True)
