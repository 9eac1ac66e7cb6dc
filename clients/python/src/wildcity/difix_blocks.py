"""Blocks of Difix's autoencoder and of its denoiser, as PyTorch modules: residual blocks, sampling, attention."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["FINE_EPS", "Attention", "Down", "Fused", "Level", "Resnet", "Up"]

FINE_EPS = 1e-6
"""Added to variances in the autoencoder, and before attention (sd-turbo; Rombach et al.'s `Normalize`)."""


class Level(nn.Module):
    """The blocks of one size. What a level does not have is empty."""

    def __init__(self) -> None:
        super().__init__()
        self.resnets: nn.ModuleList = nn.ModuleList()
        self.attentions: nn.ModuleList = nn.ModuleList()
        self.downsamplers: nn.ModuleList = nn.ModuleList()
        self.upsamplers: nn.ModuleList = nn.ModuleList()


class Resnet(nn.Module):
    """A residual block; with `time_width` the time is added between its convolutions."""

    def __init__(self, before: int, width: int, groups: int, eps: float, time_width: int | None = None) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(groups, before, eps)
        self.conv1 = nn.Conv2d(before, width, 3, padding=1)
        self.time_emb_proj = nn.Linear(time_width, width) if time_width else None
        self.norm2 = nn.GroupNorm(groups, width, eps)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.conv_shortcut = nn.Conv2d(before, width, 1) if before != width else None

    def forward(self, x: Tensor, time: Tensor | None = None) -> Tensor:
        """x: [n, before, rows, columns]; time: [1, time_width]. Returns [n, width, rows, columns]."""
        change = self.conv1(functional.silu(self.norm1(x)))
        if self.time_emb_proj is not None:
            change = change + self.time_emb_proj(functional.silu(time))[:, :, None, None]
        change = self.conv2(functional.silu(self.norm2(change)))
        return (x if self.conv_shortcut is None else self.conv_shortcut(x)) + change


class Down(nn.Module):
    """Half the size. The autoencoder pads on the right and below only (`pad_before=0`), the denoiser on all sides."""

    def __init__(self, width: int, pad_before: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(width, width, 3, stride=2)
        self.pads = (pad_before, 1, pad_before, 1)

    def forward(self, x: Tensor) -> Tensor:
        """[n, width, rows, columns] to half the rows and columns."""
        half: Tensor = self.conv(functional.pad(x, self.pads))
        return half


class Up(nn.Module):
    """Twice the size: each value four times, then a convolution."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """[n, width, rows, columns] to twice the rows and columns."""
        double: Tensor = self.conv(functional.interpolate(x, scale_factor=2.0, mode="nearest"))
        return double


class Attention(nn.Module):
    """softmax(q k / sqrt(d)) v in several heads (Vaswani et al. 2017)."""

    def __init__(self, width: int, heads: int, context: int, has_bias: bool = False, upcast: bool = False) -> None:
        super().__init__()
        self.heads = heads
        self.upcast = upcast
        # For self-attention, which has a score for each pair of places; set by `Difix.fuse_attention`.
        self.fused = False
        self.to_q = nn.Linear(width, width, bias=has_bias)
        self.to_k = nn.Linear(context, width, bias=has_bias)
        self.to_v = nn.Linear(context, width, bias=has_bias)
        self.to_out = nn.ModuleList([nn.Linear(width, width)])

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        """x: [n, tokens, width]; context: [n or 1, its tokens, context]. Returns the shape of x."""
        q = self.to_q(x)
        k = self.to_k(context)
        v = self.to_v(context)
        if self.fused and torch.jit.is_tracing():
            attended = Fused.apply(q, k, v, self.heads)
        else:
            attended = self._plain(q, k, v)
        result: Tensor = self.to_out[0](attended)
        return result

    def _plain(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """All scores at once."""
        q = self._split(q)
        k = self._split(k)
        v = self._split(v)
        kind = v.dtype
        if self.upcast:
            q = q.float()
            k = k.float()
        # Half of the scale on either side, so that no product leaves the range of f16.
        root = q.shape[3] ** -0.25
        weights = ((q * root) @ (k * root).transpose(2, 3)).softmax(-1).to(kind)
        return (weights @ v).transpose(1, 2).flatten(2)

    def _split(self, x: Tensor) -> Tensor:
        """[n, tokens, width] to [n, heads, tokens, width / heads]."""
        return x.reshape(x.shape[0], -1, self.heads, x.shape[2] // self.heads).transpose(1, 2)


class Fused(torch.autograd.Function):
    """The operator MultiHeadAttention of onnxruntime, which does not keep the scores. It is not part of ONNX's opset
    17."""

    @staticmethod
    def symbolic(graph: Any, q: Any, k: Any, v: Any, heads: int) -> Any:
        """The operator divides by the root of a head's width itself."""
        return graph.op("com.microsoft::MultiHeadAttention", q, k, v, num_heads_i=heads).setType(q.type())

    @staticmethod
    def forward(_: Any, q: Tensor, k: Tensor, v: Tensor, heads: int) -> Tensor:
        """Only its shape and type are used, while tracing."""
        return torch.zeros_like(q)
