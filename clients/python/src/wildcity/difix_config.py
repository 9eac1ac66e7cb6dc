"""Reads and checks the JSON files of a Difix folder: the sizes of the two networks, and the one step of the scheduler.

Needs no PyTorch. Difix (Wu et al., "Difix3D+: Improving 3D Reconstructions with Single-Step Diffusion Models", CVPR
2025; code: nv-tlabs/Difix3D) is SD-Turbo with skip connections in its autoencoder. Its folder has the layout of
diffusers: `vae/config.json`, `unet/config.json`, `scheduler/scheduler_config.json`, and the weights next to them.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import WildCityError

__all__ = ["ExportError", "Step", "UnetConfig", "VaeConfig", "image_multiple", "read_json"]

TIMESTEP = 199
"""The noise level that Difix takes a rendered image for, of 1000 (Difix3D+, section 4.1; `timesteps=[199]` in the
README of nv-tlabs/Difix3D)."""

PROMPT = "remove degradation"
"""The prompt of every image, in training and afterwards (README of nv-tlabs/Difix3D)."""


class ExportError(WildCityError):
    """Something in the folder of weights is not what Difix has. `field` is the file, with the key or the tensor."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message


@dataclass(frozen=True)
class VaeConfig:
    """The autoencoder. SD-Turbo has `widths` (128, 256, 512, 512)."""

    widths: tuple[int, ...]
    """Channels at 1, 1/2, 1/4 and 1/8 of the image's size."""
    layers: int
    """Residual blocks of each level on the way down; one more on the way up."""
    groups: int
    """Groups of channels that are normalized together."""
    scale: float
    """Latent values are the encoder's means times this: 0.18215 in `vae/config.json` of sd-turbo."""
    gamma: float
    """Factor of the skip activations: 1 (`decoder.gamma` in src/model.py of nv-tlabs/Difix3D)."""

    @staticmethod
    def read(config: dict[str, Any], file: str = "vae/config.json") -> VaeConfig:
        """Checks a `vae/config.json`. Raises `ExportError` with the key."""
        widths = _integers(config, file, "block_out_channels")
        levels = len(widths)
        if levels != 4:
            raise ExportError(
                f"{file}: block_out_channels", f"{levels} levels; Difix has 4, one for each skip convolution"
            )
        expected = {
            "in_channels": 3,
            "out_channels": 3,
            "latent_channels": 4,
            "act_fn": "silu",
            "down_block_types": ["DownEncoderBlock2D"] * levels,
            "up_block_types": ["UpDecoderBlock2D"] * levels,
            "mid_block_add_attention": True,
            "use_quant_conv": True,
            "use_post_quant_conv": True,
            "shift_factor": None,
            "latents_mean": None,
            "latents_std": None,
            "ignore_skip": False,
        }
        _expect(config, file, expected)
        return VaeConfig(
            widths,
            _integer(config, file, "layers_per_block"),
            _integer(config, file, "norm_num_groups", 32),
            _number(config, file, "scaling_factor", 0.18215),
            _number(config, file, "gamma", 1.0),
        )


@dataclass(frozen=True)
class UnetConfig:
    """The denoiser. SD-Turbo has `widths` (320, 640, 1280, 1280)."""

    widths: tuple[int, ...]
    """Channels at 1, 1/2, 1/4 and 1/8 of the latent image's size."""
    heads: tuple[int, ...]
    """Heads of the attention at each level. diffusers calls their number `attention_head_dim`."""
    attends: tuple[bool, ...]
    """Whether a level has attention: all but the last."""
    layers: int
    """Residual blocks of each level on the way down; one more on the way up."""
    context: int
    """Width of the prompt's embedding: 1024."""
    groups: int
    """Groups of channels that are normalized together."""
    eps: float
    """Added to variances of the residual blocks' normalizations."""
    upcast: bool
    """Whether attention scores are computed in f32."""

    @staticmethod
    def read(config: dict[str, Any], file: str = "unet/config.json") -> UnetConfig:
        """Checks a `unet/config.json`. Raises `ExportError` with the key."""
        widths = _integers(config, file, "block_out_channels")
        down = config.get("down_block_types")
        kinds = {"CrossAttnDownBlock2D": "CrossAttnUpBlock2D", "DownBlock2D": "UpBlock2D"}
        if not isinstance(down, list) or len(down) != len(widths) or not all(kind in kinds for kind in down):
            raise ExportError(f"{file}: down_block_types", f"{down!r}; {len(widths)} of {', '.join(kinds)}")
        expected = {
            "in_channels": 4,
            "out_channels": 4,
            "up_block_types": [kinds[kind] for kind in reversed(down)],
            "mid_block_type": "UNetMidBlock2DCrossAttn",
            "act_fn": "silu",
            "flip_sin_to_cos": True,
            "freq_shift": 0,
            "time_embedding_type": "positional",
            "time_embedding_dim": None,
            "time_cond_proj_dim": None,
            "resnet_time_scale_shift": "default",
            "use_linear_projection": True,
            "transformer_layers_per_block": 1,
            "num_attention_heads": None,
            "only_cross_attention": False,
            "dual_cross_attention": False,
            "class_embed_type": None,
            "num_class_embeds": None,
            "addition_embed_type": None,
            "encoder_hid_dim": None,
            "center_input_sample": False,
            "downsample_padding": 1,
            "mid_block_scale_factor": 1,
            "conv_in_kernel": 3,
            "conv_out_kernel": 3,
        }
        _expect(config, file, expected)
        # diffusers' default is False: it must be said.
        if "use_linear_projection" not in config:
            raise ExportError(f"{file}: use_linear_projection", "missing; SD-Turbo has true")
        heads = config.get("attention_head_dim", 8)
        heads = tuple(heads) if isinstance(heads, list) else (heads,) * len(widths)
        fits = len(heads) == len(widths) and all(isinstance(n, int) and n > 0 for n in heads)
        if not fits or any(width % count for width, count in zip(widths, heads)):
            raise ExportError(f"{file}: attention_head_dim", f"{heads!r}; divisors of block_out_channels {widths!r}")
        return UnetConfig(
            widths,
            heads,
            tuple(kind == "CrossAttnDownBlock2D" for kind in down),
            _integer(config, file, "layers_per_block"),
            _integer(config, file, "cross_attention_dim"),
            _integer(config, file, "norm_num_groups", 32),
            _number(config, file, "norm_eps", 1e-5),
            bool(config.get("upcast_attention")),
        )


@dataclass(frozen=True)
class Step:
    """The one step of the scheduler: clean = (latent - noise_weight * noise) / signal_weight.

    A latent image at time t is sqrt(a) * clean + sqrt(1 - a) * noise (DDPM, Ho et al. 2020, equation 4), where a is the
    product of 1 - beta up to t. The network predicts the noise. There is no step after this one, so the prediction of
    the clean image is the result, and no noise is added: what DDPMScheduler computes with `timesteps=[199]`.
    """

    signal_weight: float
    """sqrt(a): 0.869044511."""
    noise_weight: float
    """sqrt(1 - a): 0.494733907."""

    @staticmethod
    def read(config: dict[str, Any], file: str = "scheduler/scheduler_config.json", timestep: int = TIMESTEP) -> Step:
        """Checks a `scheduler_config.json` and computes the step. Raises `ExportError` with the key.

        sd-turbo's file has beta_start 0.00085, beta_end 0.012, `scaled_linear` (the square roots of the betas are
        equidistant) and 1000 steps. Then a is 0.755238 at 199. `clip_sample` does not count: NVIDIA's pipeline switches
        it off.
        """
        expected = {
            "beta_schedule": "scaled_linear",
            "prediction_type": "epsilon",
            "trained_betas": None,
            "thresholding": False,
            "rescale_betas_zero_snr": False,
        }
        _expect(config, file, expected)
        if "beta_schedule" not in config:
            raise ExportError(f"{file}: beta_schedule", 'missing; SD-Turbo has "scaled_linear"')
        count = _integer(config, file, "num_train_timesteps")
        if count <= timestep:
            raise ExportError(f"{file}: num_train_timesteps", f"{count}; more than the time {timestep} of Difix")
        first = math.sqrt(_number(config, file, "beta_start"))
        last = math.sqrt(_number(config, file, "beta_end"))
        share = 1.0
        for time in range(timestep + 1):
            share *= 1.0 - (first + (last - first) * time / (count - 1)) ** 2
        return Step(math.sqrt(share), math.sqrt(1.0 - share))


def image_multiple(vae: VaeConfig, unet: UnetConfig) -> int:
    """The sides of an image must be multiples of this, in pixels: each level of both networks halves them. 64 for
    SD-Turbo.

    diffusers takes multiples of 8, with other sizes of `upsample` when a side of a level is odd. A graph is traced
    once, so it has one rule for all sizes.
    """
    levels: int = len(vae.widths) - 1 + len(unet.widths) - 1
    return 1 << levels


def read_json(path: Path, field: str) -> dict[str, Any]:
    """A JSON object of a folder. Raises `ExportError` with `field`."""
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ExportError(
            field, f"{error}; give a folder in the layout of diffusers, such as nvidia/difix_ref"
        ) from error
    if not isinstance(value, dict):
        raise ExportError(field, f"{type(value).__name__}; an object")
    return value


def _expect(config: dict[str, Any], file: str, expected: dict[str, Any]) -> None:
    """Every key that is there has the expected value. diffusers also writes null for false."""
    for key, value in expected.items():
        found = config.get(key, value)
        if found != value and not (value is False and found is None):
            raise ExportError(f"{file}: {key}", f"{found!r}; Difix has {value!r}")


def _integers(config: dict[str, Any], file: str, key: str) -> tuple[int, ...]:
    found = config.get(key)
    if not isinstance(found, list) or not found or not all(isinstance(n, int) and n > 0 for n in found):
        raise ExportError(f"{file}: {key}", f"{found!r}; a list of positive integers")
    return tuple(found)


def _integer(config: dict[str, Any], file: str, key: str, default: int | None = None) -> int:
    found = config.get(key, default)
    if not isinstance(found, int) or found <= 0:
        raise ExportError(f"{file}: {key}", f"{found!r}; a positive integer")
    return found


def _number(config: dict[str, Any], file: str, key: str, default: float | None = None) -> float:
    found = config.get(key, default)
    if not isinstance(found, (int, float)) or not math.isfinite(found) or found <= 0:
        raise ExportError(f"{file}: {key}", f"{found!r}; a positive number")
    return float(found)
