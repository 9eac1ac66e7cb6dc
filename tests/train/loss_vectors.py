"""Writes loss_vectors.json: every loss and its derivatives by PyTorch's autograd, in f64.

    pip install numpy torch
    python3 tests/train/loss_vectors.py

`tests/train/loss_vectors.rs` compares with it. The losses are written here as their sources have them, in whole tensors
and without derivatives: Wang et al. 2004 for SSIM (11 x 11, sigma 1.5, zeros beyond edges), 2DGS eq. 14 for normals,
3DGS-MCMC eq. 10 for opacity and scale, the project's paper, section 4.2, for the ground.
"""

import json
from pathlib import Path

import numpy as np
import torch

WIDTH, HEIGHT = 8, 6
PIXELS = WIDTH * HEIGHT
random = np.random.default_rng(5)


def numbers(low, high, *shape):
    """Inputs of four digits, which JSON has exactly."""
    return torch.tensor(np.round(random.uniform(low, high, shape), 4), requires_grad=True)


def weighted_mean(values, weights):
    return (values * weights[..., None]).sum() / (3 * weights.sum())


def ssim(x, y):
    taps = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    taps = taps / taps.sum()
    kernel = (taps[:, None] * taps[None, :])[None, None].repeat(3, 1, 1, 1)
    x, y = (image.permute(2, 0, 1)[None] for image in (x, y))

    def blur(image):
        return torch.nn.functional.conv2d(image, kernel, padding=5, groups=3)

    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    both = blur(x * y) - mean_x * mean_y
    above = (2 * mean_x * mean_y + 0.01**2) * (2 * both + 0.03**2)
    return (above / ((mean_x**2 + mean_y**2 + 0.01**2) * (var_x + var_y + 0.03**2))).mean()


def normal_loss(opacity, depth_sum, rays, given):
    """1 - n . given, with n from the points to the left, right, above and below."""
    points = (depth_sum / opacity)[..., None] * rays
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = torch.nn.functional.normalize(torch.cross(down, across, dim=-1), dim=-1)
    inner = given[1:-1, 1:-1]
    counts = (inner != 0).any(-1)
    return (1 - (normal * inner).sum(-1))[counts].mean()


def ground_terms(means, normals, opacity, up, forward, slice_m):
    heights, slices = means @ up, torch.floor(means @ forward / slice_m)
    deviations = [heights[slices == k].std(unbiased=False) for k in slices.unique() if (slices == k).sum() > 1]
    # A slice of one has no deviation, and counts in the mean.
    height = torch.stack(deviations).sum() / len(slices.unique())
    return height, (1 - (normals @ up).abs()).mean(), ((1 - opacity) ** 2).mean()


cases = []


def add(name, value, **inputs):
    value.backward()
    case = {"name": name, "value": value.item(), "inputs": {}, "by": {}}
    for key, tensor in inputs.items():
        case["inputs"][key] = tensor.detach().reshape(-1).tolist()
        if tensor.grad is not None:
            case["by"][key] = tensor.grad.reshape(-1).tolist()
            tensor.grad = None
    cases.append(case)


image, target = numbers(0, 1, HEIGHT, WIDTH, 3), numbers(0, 1, HEIGHT, WIDTH, 3).detach()
weights = numbers(0, 1, HEIGHT, WIDTH).detach()
weights.reshape(-1)[3:9] = 0
add("l1", weighted_mean((image - target).abs(), weights), image=image, target=target, weights=weights)
add("l2", weighted_mean((image - target) ** 2, weights), image=image, target=target, weights=weights)
add(
    "masked dssim",
    1 - ssim(image * weights[..., None], target * weights[..., None]),
    image=image,
    target=target,
    weights=weights,
)

opacity, depth_sum = numbers(0.1, 1, HEIGHT, WIDTH), numbers(1, 20, HEIGHT, WIDTH)
measured = numbers(2, 30, HEIGHT, WIDTH).detach()
with torch.no_grad():
    measured.reshape(-1)[7] = 0
    opacity.reshape(-1)[11] = 0.04
counts = (measured > 0) & (opacity > 0.05)
depths = {"opacity": opacity, "depth_sum": depth_sum, "measured": measured}
add("disparity", (opacity / depth_sum - 1 / measured)[counts].abs().mean(), **depths)
add("metric depth", (depth_sum / opacity - measured)[counts].abs().mean(), **depths)

opaque = numbers(0.3, 1, HEIGHT, WIDTH)
surface = torch.tensor(np.round(opaque.detach().numpy() * random.uniform(4, 6, (HEIGHT, WIDTH)), 4), requires_grad=True)
rays = torch.cat([numbers(-0.5, 0.5, HEIGHT, WIDTH, 2).detach(), torch.ones(HEIGHT, WIDTH, 1, dtype=torch.float64)], -1)
given = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64).repeat(HEIGHT, WIDTH, 1)
given[2, 3] = 0
add("normals", normal_loss(opaque, surface, rays, given), opacity=opaque, depth_sum=surface, rays=rays, given=given)

logits, ln_scales = numbers(-6, 6, 40), numbers(-6, 1, 20, 3)
add("opacity", torch.sigmoid(logits).mean(), values=logits)
add("scale", ln_scales.exp().mean(), values=ln_scales)

up = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
forward = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
means, normals, opacities = numbers(-4, 4, 30, 3), numbers(-1, 1, 30, 3), numbers(0, 1, 30)
for term, name in enumerate(["height", "upright", "opaque"]):
    value = ground_terms(means, normals, opacities, up, forward, 2.0)[term]
    add("ground: " + name, value, mean=means, normal=normals, opacity=opacities, up=up, forward=forward)

rgb, alpha, sky = numbers(0, 1, HEIGHT, WIDTH, 3), numbers(0, 1, HEIGHT, WIDTH), numbers(0, 1, HEIGHT, WIDTH, 3)
matrix, offset, by = numbers(-0.1, 1.1, 3, 3), numbers(-0.1, 0.1, 3), numbers(-1, 1, HEIGHT, WIDTH, 3).detach()
composed = (rgb + (1 - alpha[..., None]) * sky) @ matrix.T + offset
add("compose", (composed * by).sum(), rgb=rgb, opacity=alpha, sky=sky, matrix=matrix, offset=offset, weights=by)

lines = ",\n".join(json.dumps(case, separators=(",", ":")) for case in cases)
(Path(__file__).parent / "loss_vectors.json").write_text(f"[\n{lines}\n]\n")
print(f"{len(cases)} losses")
