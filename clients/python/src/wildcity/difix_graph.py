"""The network of Difix as PyTorch modules. Parameters have the names of the published tensors.

One run repairs an image, with a second view of the same place as reference:

1. Both views are encoded. A latent is the mean that the encoder predicts (the first 4 of 8 channels), times 0.18215.
   NVIDIA draws a random sample around that mean; a repaired image that differs from run to run has no hash.
2. The denoiser sees both views. Self-attention goes over the tokens of both together, cross-attention of each view to the
   prompt by itself (src/mv_unet.py of nv-tlabs/Difix3D).
3. One step of the scheduler gives clean latents (`difix_config.Step`).
4. The latent of the image alone is decoded. Before each level of the decoder a 1x1 convolution of the encoder's activations
   of the same size is added (src/model.py of nv-tlabs/Difix3D, after pix2pix-turbo, Parmar et al. 2024).

The two networks are SD-Turbo's: Rombach et al. 2022, version 2.1.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from .difix_config import TIMESTEP, ExportError, Step, UnetConfig, VaeConfig, image_multiple

__all__ = ["Difix", "Unet", "Vae"]

VAE_EPS = 1e-6
"""Added to variances in the autoencoder, and before attention (sd-turbo; Rombach et al.'s `Normalize`)."""


class Difix(nn.Module):
    """Repairs images. Values are -1 (black) to 1 (white)."""

    def __init__(self, vae: VaeConfig, unet: UnetConfig, step: Step, with_reference: bool) -> None:
        super().__init__()
        self.vae = Vae(vae)
        self.unet = Unet(unet, 2 if with_reference else 1)
        self.step = step
        self.with_reference = with_reference
        self.multiple = image_multiple(vae, unet)
        # A constant of the graph, not a tensor of the folder.
        self.register_buffer("prompt", torch.zeros(1, 77, unet.context), persistent=False)

    def forward(self, image: Tensor, reference: Tensor | None = None) -> Tensor:
        """image, reference: [batch, 3, height, width]; returns the repaired image in the same shape."""
        self._check(image, reference)
        views = image
        if reference is not None:
            # Views of one image are neighbours: [image 0, reference 0, image 1, ...]. NVIDIA's pipeline concatenates
            # along the batch, which is the same for one image only.
            views = torch.stack([image, reference], 1).flatten(0, 1)
        latent, skips = self.vae.encode(views)
        noise = self.unet(latent, self.prompt)
        # In f32 also if the graph has f16: these are few values, and they decide all others.
        clean = latent.float() - self.step.noise_weight * noise.float()
        clean = (clean / self.step.signal_weight).to(latent.dtype)
        if reference is not None:
            # NVIDIA's code decodes both views and drops one.
            clean = clean[0::2]
            skips = [skip[0::2] for skip in skips]
        decoded: Tensor = self.vae.decode(clean, skips)
        return decoded.clamp(-1.0, 1.0)

    def fuse_attention(self) -> None:
        """Self-attention of the denoiser becomes one operator of onnxruntime in the graph."""
        for module in self.modules():
            if isinstance(module, TransformerBlock):
                module.attn1.fused = True

    def _check(self, image: Tensor, reference: Tensor | None) -> None:
        """What a graph cannot say: sizes, and whether there is a reference."""
        if (reference is not None) != self.with_reference:
            raise ExportError("reference", "needed" if self.with_reference else "given, but this model has none")
        if torch.jit.is_tracing():
            return
        if image.dim() != 4 or image.shape[1] != 3 or 0 in image.shape:
            raise ExportError("image", f"the shape {list(image.shape)}; [batch, 3, height, width]")
        if image.shape[2] % self.multiple or image.shape[3] % self.multiple:
            size = f"{image.shape[3]} x {image.shape[2]}"
            raise ExportError("image", f"{size} pixels; both sides must be multiples of {self.multiple}")
        if reference is not None and reference.shape != image.shape:
            raise ExportError("reference", f"the shape {list(reference.shape)}; that of the image, {list(image.shape)}")


class Vae(nn.Module):
    """The autoencoder, with skip connections from encoder to decoder."""

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        self.scale = config.scale
        self.gamma = config.gamma
        self.encoder = Encoder(config)
        self.decoder = Decoder(config)
        self.quant_conv = nn.Conv2d(8, 8, 1)
        self.post_quant_conv = nn.Conv2d(4, 4, 1)

    def encode(self, views: Tensor) -> tuple[Tensor, list[Tensor]]:
        """views: [n, 3, height, width]. Latents [n, 4, height/8, width/8], and what the encoder's four levels got."""
        moments, skips = self.encoder(views)
        # 4 channels of means, 4 of logarithms of variances.
        mean = self.quant_conv(moments)[:, :4]
        return mean * self.scale, [skip * self.gamma if self.gamma != 1.0 else skip for skip in skips]

    def decode(self, latent: Tensor, skips: list[Tensor]) -> Tensor:
        """The image of a latent: [n, 3, height, width]."""
        decoded: Tensor = self.decoder(self.post_quant_conv(latent / self.scale), skips)
        return decoded


class Encoder(nn.Module):
    """An image to means and variances, at 1/8 of its size."""

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        widths = config.widths
        self.conv_in = nn.Conv2d(3, widths[0], 3, padding=1)
        self.down_blocks = nn.ModuleList()
        before = widths[0]
        for level, width in enumerate(widths):
            block = Level()
            block.resnets = nn.ModuleList(
                Resnet(before if layer == 0 else width, width, config.groups, VAE_EPS) for layer in range(config.layers)
            )
            if level + 1 < len(widths):
                block.downsamplers = nn.ModuleList([Down(width, pad_before=0)])
            self.down_blocks.append(block)
            before = width
        self.mid_block = VaeMiddle(widths[-1], config.groups)
        self.conv_norm_out = nn.GroupNorm(config.groups, widths[-1], VAE_EPS)
        self.conv_out = nn.Conv2d(widths[-1], 8, 3, padding=1)

    def forward(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """[n, 3, height, width] to [n, 8, height/8, width/8]; and the input of each level, largest first."""
        x = self.conv_in(x)
        skips = []
        for block in self.down_blocks:
            skips.append(x)
            for resnet in block.resnets:
                x = resnet(x)
            for down in block.downsamplers:
                x = down(x)
        x = self.mid_block(x)
        return self.conv_out(functional.silu(self.conv_norm_out(x))), skips


class Decoder(nn.Module):
    """A latent to an image."""

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        widths = config.widths[::-1]
        self.conv_in = nn.Conv2d(4, widths[0], 3, padding=1)
        self.mid_block = VaeMiddle(widths[0], config.groups)
        self.up_blocks = nn.ModuleList()
        before = widths[0]
        for level, width in enumerate(widths):
            # The encoder's level of this size got the channels of the level above it: 512, 256, 128, 128.
            skip = config.widths[max(len(widths) - 2 - level, 0)]
            setattr(self, f"skip_conv_{level + 1}", nn.Conv2d(skip, before, 1, bias=False))
            block = Level()
            block.resnets = nn.ModuleList(
                Resnet(before if layer == 0 else width, width, config.groups, VAE_EPS)
                for layer in range(config.layers + 1)
            )
            if level + 1 < len(widths):
                block.upsamplers = nn.ModuleList([Up(width)])
            self.up_blocks.append(block)
            before = width
        self.conv_norm_out = nn.GroupNorm(config.groups, widths[-1], VAE_EPS)
        self.conv_out = nn.Conv2d(widths[-1], 3, 3, padding=1)

    def forward(self, x: Tensor, skips: list[Tensor]) -> Tensor:
        """x: [n, 4, height/8, width/8]; skips: as the encoder returns them, so that the smallest is used first."""
        x = self.mid_block(self.conv_in(x))
        skip_convs = (self.skip_conv_1, self.skip_conv_2, self.skip_conv_3, self.skip_conv_4)
        for block, skip_conv, skip in zip(self.up_blocks, skip_convs, reversed(skips)):
            x = x + skip_conv(skip)
            for resnet in block.resnets:
                x = resnet(x)
            for up in block.upsamplers:
                x = up(x)
        decoded: Tensor = self.conv_out(functional.silu(self.conv_norm_out(x)))
        return decoded


class VaeMiddle(nn.Module):
    """Two residual blocks with attention between them: each view by itself, one head."""

    def __init__(self, width: int, groups: int) -> None:
        super().__init__()
        self.resnets = nn.ModuleList([Resnet(width, width, groups, VAE_EPS) for _ in range(2)])
        self.attentions = nn.ModuleList([Attention(width, 1, width, has_bias=True)])
        self.attentions[0].group_norm = nn.GroupNorm(groups, width, VAE_EPS)

    def forward(self, x: Tensor) -> Tensor:
        """[n, width, rows, columns]."""
        x = self.resnets[0](x)
        attention = self.attentions[0]
        tokens = attention.group_norm(x).flatten(2).transpose(1, 2)
        x = x + attention(tokens, tokens).transpose(1, 2).reshape(x.shape)
        result: Tensor = self.resnets[1](x)
        return result


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
        # Of self-attention, which has as many scores as pairs of places; set by `Difix.fuse_attention`.
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
    """The operator MultiHeadAttention of onnxruntime, which does not keep the scores. It is not part of ONNX's opset 17."""

    @staticmethod
    def symbolic(graph: Any, q: Any, k: Any, v: Any, heads: int) -> Any:
        """The operator divides by the root of a head's width itself."""
        return graph.op("com.microsoft::MultiHeadAttention", q, k, v, num_heads_i=heads).setType(q.type())

    @staticmethod
    def forward(_: Any, q: Tensor, k: Tensor, v: Tensor, heads: int) -> Tensor:
        """Only its shape and type are used, while tracing."""
        return torch.zeros_like(q)


class Transformer(nn.Module):
    """Attention among the places of a level, and to the prompt."""

    def __init__(self, config: UnetConfig, level: int, views: int) -> None:
        super().__init__()
        width = config.widths[level]
        self.norm = nn.GroupNorm(config.groups, width, VAE_EPS)
        self.proj_in = nn.Linear(width, width)
        self.transformer_blocks = nn.ModuleList([TransformerBlock(config, level, views)])
        self.proj_out = nn.Linear(width, width)

    def forward(self, x: Tensor, prompt: Tensor) -> Tensor:
        """[n, width, rows, columns]."""
        tokens = self.proj_in(self.norm(x).flatten(2).transpose(1, 2))
        tokens = self.proj_out(self.transformer_blocks[0](tokens, prompt))
        return x + tokens.transpose(1, 2).reshape(x.shape)


class TransformerBlock(nn.Module):
    """Self-attention over the tokens of all views of a place, then per view: cross-attention to the prompt, and two layers."""

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
