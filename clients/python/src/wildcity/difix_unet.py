"""The denoiser of Difix: SD-Turbo's network (Rombach et al. 2022, version 2.1), with attention among two views."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from .difix_blocks import FINE_EPS, Attention, Down, Level, Resnet, Up
from .difix_config import TIMESTEP, UnetConfig

__all__ = ["Unet", "sinusoids"]


class Unet(nn.Module):
    """Predicts the noise in latents at one noise level. `views` latents in a row show the same place."""

    def __init__(self, config: UnetConfig, views: int) -> None:
        super().__init__()
        widths = config.widths
        layers = config.layers
        groups = config.groups
        time_width = 4 * widths[0]

        def resnet(before: int, width: int) -> Resnet:
            return Resnet(before, width, groups, config.eps, time_width)

        def transformer(level: int) -> Transformer:
            return Transformer(config, level, views)

        self.conv_in = nn.Conv2d(4, widths[0], 3, padding=1)
        self.register_buffer("time", sinusoids(TIMESTEP, widths[0]), persistent=False)
        self.time_embedding = TimeEmbedding(widths[0], time_width)
        self.down_blocks = nn.ModuleList()
        before = widths[0]
        # Channels of what each block leaves for its counterpart on the way up.
        skips = [widths[0]]
        for level, width in enumerate(widths):
            block = Level()
            block.resnets = nn.ModuleList(resnet(before if layer == 0 else width, width) for layer in range(layers))
            if config.attends[level]:
                block.attentions = nn.ModuleList(transformer(level) for _ in range(layers))
            skips += [width] * layers
            if level + 1 < len(widths):
                block.downsamplers = nn.ModuleList([Down(width, pad_before=1)])
                skips.append(width)
            self.down_blocks.append(block)
            before = width
        self.mid_block = Level()
        self.mid_block.resnets = nn.ModuleList([resnet(before, before) for _ in range(2)])
        self.mid_block.attentions = nn.ModuleList([transformer(len(widths) - 1)])
        self.up_blocks = nn.ModuleList()
        for level, width in reversed(list(enumerate(widths))):
            block = Level()
            block.resnets = nn.ModuleList(
                resnet((before if layer == 0 else width) + skips.pop(), width) for layer in range(layers + 1)
            )
            if config.attends[level]:
                block.attentions = nn.ModuleList(transformer(level) for _ in range(layers + 1))
            if level > 0:
                block.upsamplers = nn.ModuleList([Up(width)])
            self.up_blocks.append(block)
            before = width
        self.conv_norm_out = nn.GroupNorm(groups, widths[0], config.eps)
        self.conv_out = nn.Conv2d(widths[0], 4, 3, padding=1)

    def forward(self, latent: Tensor, prompt: Tensor) -> Tensor:
        """latent: [n, 4, rows, columns]; prompt: [1, 77, context]. The noise, in the shape of `latent`."""
        time = self.time_embedding(self.time)
        x = self.conv_in(latent)
        skips = [x]
        for block in self.down_blocks:
            for layer, resnet in enumerate(block.resnets):
                x = resnet(x, time)
                if block.attentions:
                    x = block.attentions[layer](x, prompt)
                skips.append(x)
            for down in block.downsamplers:
                x = down(x)
                skips.append(x)
        x = self.mid_block.resnets[0](x, time)
        x = self.mid_block.attentions[0](x, prompt)
        x = self.mid_block.resnets[1](x, time)
        for block in self.up_blocks:
            for layer, resnet in enumerate(block.resnets):
                x = resnet(torch.cat([x, skips.pop()], 1), time)
                if block.attentions:
                    x = block.attentions[layer](x, prompt)
            for up in block.upsamplers:
                x = up(x)
        noise: Tensor = self.conv_out(functional.silu(self.conv_norm_out(x)))
        return noise


def sinusoids(time: int, width: int) -> Tensor:
    """A time as cosines, then sines, of frequencies 1 to 1/10000: [1, width] (Vaswani et al. 2017; DDPM)."""
    half = width // 2
    angles = time * torch.exp(-math.log(10_000.0) / half * torch.arange(half, dtype=torch.float32))
    return torch.cat([angles.cos(), angles.sin()])[None]


class TimeEmbedding(nn.Module):
    """Two layers on the sinusoids of the time."""

    def __init__(self, width: int, wide: int) -> None:
        super().__init__()
        self.linear_1 = nn.Linear(width, wide)
        self.linear_2 = nn.Linear(wide, wide)

    def forward(self, sines: Tensor) -> Tensor:
        """[1, width] to [1, 4 * width]."""
        embedded: Tensor = self.linear_2(functional.silu(self.linear_1(sines)))
        return embedded


class Transformer(nn.Module):
    """Attention among the places of a level, and to the prompt."""

    def __init__(self, config: UnetConfig, level: int, views: int) -> None:
        super().__init__()
        width = config.widths[level]
        self.norm = nn.GroupNorm(config.groups, width, FINE_EPS)
        self.proj_in = nn.Linear(width, width)
        self.transformer_blocks = nn.ModuleList([TransformerBlock(config, level, views)])
        self.proj_out = nn.Linear(width, width)

    def forward(self, x: Tensor, prompt: Tensor) -> Tensor:
        """[n, width, rows, columns]."""
        tokens = self.proj_in(self.norm(x).flatten(2).transpose(1, 2))
        tokens = self.proj_out(self.transformer_blocks[0](tokens, prompt))
        return x + tokens.transpose(1, 2).reshape(x.shape)


class TransformerBlock(nn.Module):
    """Self-attention over the tokens of all views of a place, then per view: cross-attention to the prompt, and two
    layers."""

    def __init__(self, config: UnetConfig, level: int, views: int) -> None:
        super().__init__()
        width = config.widths[level]
        heads = config.heads[level]
        self.views = views
        self.norm1 = nn.LayerNorm(width)
        self.attn1 = Attention(width, heads, width, upcast=config.upcast)
        self.norm2 = nn.LayerNorm(width)
        self.attn2 = Attention(width, heads, config.context, upcast=config.upcast)
        self.norm3 = nn.LayerNorm(width)
        self.ff = FeedForward(width)

    def forward(self, tokens: Tensor, prompt: Tensor) -> Tensor:
        """tokens: [n, count, width]."""
        shape = tokens.shape
        together = self.norm1(tokens)
        if self.views > 1:
            together = together.reshape(-1, self.views * shape[1], shape[2])
        tokens = tokens + self.attn1(together, together).reshape(shape)
        tokens = tokens + self.attn2(self.norm2(tokens), prompt)
        return tokens + self.ff(self.norm3(tokens))


class FeedForward(nn.Module):
    """A gated layer of four times the width, and a layer back (GEGLU, Shazeer 2020)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        gated = nn.Module()
        gated.proj = nn.Linear(width, 8 * width)
        # The second place is dropout in training.
        self.net = nn.ModuleList([gated, nn.Identity(), nn.Linear(4 * width, width)])

    def forward(self, x: Tensor) -> Tensor:
        """[n, tokens, width]."""
        values, gate = self.net[0].proj(x).chunk(2, -1)
        back: Tensor = self.net[2](values * functional.gelu(gate))
        return back
