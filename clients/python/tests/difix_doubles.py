"""A folder in the layout of nvidia/difix_ref with tiny widths and random weights. Needs PyTorch and transformers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from wildcity.difix_config import Step, UnetConfig, VaeConfig
from wildcity.difix_graph import Difix

VAE: dict[str, Any] = {
    "_class_name": "AutoencoderKL",
    "act_fn": "silu",
    "block_out_channels": [8, 16, 24, 24],
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
    "in_channels": 3,
    "out_channels": 3,
    "latent_channels": 4,
    "layers_per_block": 1,
    "norm_num_groups": 4,
    "scaling_factor": 0.18215,
    "gamma": 1.0,
    "ignore_skip": False,
    "lora_rank": 4,
}
UNET: dict[str, Any] = {
    "_class_name": "UNet2DConditionModel",
    "act_fn": "silu",
    "attention_head_dim": [2, 4, 3, 3],
    "block_out_channels": [16, 32, 48, 48],
    "center_input_sample": False,
    "cross_attention_dim": 12,
    "down_block_types": ["CrossAttnDownBlock2D"] * 3 + ["DownBlock2D"],
    "up_block_types": ["UpBlock2D"] + ["CrossAttnUpBlock2D"] * 3,
    "flip_sin_to_cos": True,
    "freq_shift": 0,
    "in_channels": 4,
    "layers_per_block": 1,
    "norm_eps": 1e-05,
    "norm_num_groups": 4,
    "out_channels": 4,
    "use_linear_projection": True,
}
SCHEDULER: dict[str, Any] = {
    "_class_name": "DDPMScheduler",
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "clip_sample": False,
    "num_train_timesteps": 1000,
    "prediction_type": "epsilon",
    "steps_offset": 1,
    "timestep_spacing": "trailing",
}
ADAPTED = ("conv1", "conv2", "conv_in", "conv_shortcut", "conv", "conv_out", "to_k", "to_q", "to_v", "to_out.0")
"""Ends of the decoder's layers that have an adapter: with the skip convolutions, those of src/model.py of
nv-tlabs/Difix3D."""


def write_folder(path: Path, seed: int = 1, changes: Mapping[str, dict[str, Any]] | None = None) -> Path:
    """Configurations, tensors, tokenizer and text encoder. changes: keys of the configurations of `vae` and `unet`."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    vae, unet = (config | (changes or {}).get(part, {}) for part, config in (("vae", VAE), ("unet", UNET)))
    for part, config in (("vae", vae), ("unet", unet), ("scheduler", SCHEDULER)):
        (path / part).mkdir(parents=True)
        name = "scheduler_config.json" if part == "scheduler" else "config.json"
        (path / part / name).write_text(json.dumps(config))
    model = Difix(VaeConfig.read(vae), UnetConfig.read(unet), Step.read(SCHEDULER), True)
    save_file(adapted(dict(model.vae.state_dict()), generator), path / "vae" / "diffusion_pytorch_model.safetensors")
    tensors = {name: perturbed(values, generator) for name, values in model.unet.state_dict().items()}
    save_file(tensors, path / "unet" / "diffusion_pytorch_model.safetensors")
    write_text_encoder(path)
    return path


def perturbed(values: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Normalizations begin as 1 and 0 everywhere, which hides a weight that is not used."""
    if values.dim() == 1:
        values = values + 0.2 * torch.randn(values.shape, generator=generator)
    return values.contiguous()


def adapted(tensors: dict[str, torch.Tensor], generator: torch.Generator) -> dict[str, torch.Tensor]:
    """The autoencoder's tensors as peft stores them: adapters of rank 4 in the decoder."""
    stored = {}
    for name, values in tensors.items():
        layer, kind = name.rsplit(".", 1)
        values = perturbed(values, generator)
        has_adapter = "decoder" in name and (layer.endswith(ADAPTED) or "skip_conv" in layer)
        if not has_adapter:
            stored[name] = values
            continue
        stored[f"{layer}.base_layer.{kind}"] = values
        if kind == "weight":
            a = values.new_empty(4, *values.shape[1:])
            b = values.new_empty(values.shape[0], 4, *[1] * (values.dim() - 2))
            stored[f"{layer}.lora_A.vae_skip.weight"] = a.normal_(0.0, 0.1, generator=generator)
            stored[f"{layer}.lora_B.vae_skip.weight"] = b.normal_(0.0, 0.1, generator=generator)
    return stored


def write_text_encoder(path: Path) -> None:
    """A tokenizer that knows letters, and a text encoder of two layers."""
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    letters = "abcdefghijklmnopqrstuvwxyz"
    words = ["!", "re", *letters, *(f"{letter}</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    (path / "tokenizer").mkdir()
    (path / "tokenizer" / "vocab.json").write_text(json.dumps({word: at for at, word in enumerate(words)}))
    (path / "tokenizer" / "merges.txt").write_text("#version: 0.2\nr e\n")
    (path / "tokenizer" / "tokenizer_config.json").write_text(json.dumps({"model_max_length": 77, "pad_token": "!"}))
    config = CLIPTextConfig(
        vocab_size=len(words),
        hidden_size=12,
        intermediate_size=24,
        num_hidden_layers=2,
        num_attention_heads=2,
        bos_token_id=len(words) - 2,
        eos_token_id=len(words) - 1,
    )
    CLIPTextModel(config).save_pretrained(path / "text_encoder")
