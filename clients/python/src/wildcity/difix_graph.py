"""The network of Difix as PyTorch modules. Parameters have the names of the published tensors.

One run repairs an image, with a second view of the same place as reference:

1. Both views are encoded. A latent is the mean that the encoder predicts (the first 4 of 8 channels), times 0.18215.
   NVIDIA draws a random sample around that mean; a repaired image that differs from run to run has no hash.
2. The denoiser gets both views. Self-attention is over the tokens of both views together, cross-attention to the prompt
   is separate for each view (src/mv_unet.py of nv-tlabs/Difix3D).
3. One step of the scheduler gives clean latents (`difix_config.Step`).
4. Only the latent of the image is decoded. Before each level of the decoder a 1x1 convolution of the encoder's
   activations of the same size is added (src/model.py of nv-tlabs/Difix3D, after pix2pix-turbo, Parmar et al. 2024).

The two networks are SD-Turbo's: Rombach et al. 2022, version 2.1.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from .difix_blocks import FINE_EPS, Attention, Down, Level, Resnet, Up
from .difix_config import ExportError, Step, UnetConfig, VaeConfig, image_multiple
from .difix_unet import TransformerBlock, Unet

__all__ = ["Difix", "Vae"]


class Difix(nn.Module):
    """Repairs images. Values are -1 (black) to 1 (white)."""

    def __init__(self, vae: VaeConfig, unet: UnetConfig, step: Step, with_reference: bool) -> None:
        super().__init__()
        self.vae = Vae(vae)
        self.unet = Unet(unet, 2 if with_reference else 1)
        self.step = step
        self.with_reference = with_reference
        self.has_fused_attention = False
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
        self.has_fused_attention = True
        for module in self.modules():
            if isinstance(module, TransformerBlock):
                module.attn1.fused = True

    def _check(self, image: Tensor, reference: Tensor | None) -> None:
        """Checks what a graph cannot express: sizes, and whether there is a reference."""
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
                Resnet(before if layer == 0 else width, width, config.groups, FINE_EPS)
                for layer in range(config.layers)
            )
            if level + 1 < len(widths):
                block.downsamplers = nn.ModuleList([Down(width, pad_before=0)])
            self.down_blocks.append(block)
            before = width
        self.mid_block = VaeMiddle(widths[-1], config.groups)
        self.conv_norm_out = nn.GroupNorm(config.groups, widths[-1], FINE_EPS)
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
                Resnet(before if layer == 0 else width, width, config.groups, FINE_EPS)
                for layer in range(config.layers + 1)
            )
            if level + 1 < len(widths):
                block.upsamplers = nn.ModuleList([Up(width)])
            self.up_blocks.append(block)
            before = width
        self.conv_norm_out = nn.GroupNorm(config.groups, widths[-1], FINE_EPS)
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
        self.resnets = nn.ModuleList([Resnet(width, width, groups, FINE_EPS) for _ in range(2)])
        self.attentions = nn.ModuleList([Attention(width, 1, width, has_bias=True)])
        self.attentions[0].group_norm = nn.GroupNorm(groups, width, FINE_EPS)

    def forward(self, x: Tensor) -> Tensor:
        """[n, width, rows, columns]."""
        x = self.resnets[0](x)
        attention = self.attentions[0]
        tokens = attention.group_norm(x).flatten(2).transpose(1, 2)
        x = x + attention(tokens, tokens).transpose(1, 2).reshape(x.shape)
        result: Tensor = self.resnets[1](x)
        return result
