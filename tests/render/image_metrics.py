"""Writes image_metrics.json: PSNR, SSIM and FLIP of three pairs of images, by the packages of other authors.

    pip install numpy scikit-image==0.26.0 torchmetrics==1.9.0 torch flip-evaluator==1.7
    python3 tests/render/image_metrics.py

`tests/render/image_metrics.rs` compares with it: PSNR and SSIM to 1e-12, FLIP to the rounding of f32.
"""

import json
from pathlib import Path

import flip_evaluator
import numpy as np
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure


def truth(width, height, seed):
    """Sky, ground, boxes with edges, thin poles: what streets have."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width]
    image = np.stack([0.5 + 0.4 * y / height, 0.55 + 0.2 * x / width, 0.9 - 0.5 * y / height], -1)
    for _ in range(9):
        left, top = random.integers(0, width), random.integers(0, height)
        wide, high = random.integers(1, width // 3), random.integers(1, height // 2)
        image[top : top + high, left : left + wide] = random.random(3)
    return np.round(255 * image).astype(np.uint8)


def spoiled(image, kind, seed):
    random = np.random.default_rng(seed)
    values = image.astype(np.float64)
    if kind == "noise":
        values += random.normal(0, 20, values.shape)
    if kind == "shift":
        values = 0.9 * np.roll(values, (1, 2), (0, 1)) + 12
    if kind == "blur":
        for axis in (0, 1):
            values = (np.roll(values, 1, axis) + 2 * values + np.roll(values, -1, axis)) / 4
        values[..., 2] *= 0.8
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def scores(image, reference):
    image, reference = (pixels.astype(np.float64) / 255 for pixels in (image, reference))
    batches = [torch.from_numpy(pixels).permute(2, 0, 1)[None] for pixels in (image, reference)]
    errors, mean, _ = flip_evaluator.evaluate(
        *(pixels.astype(np.float32) for pixels in (reference, image)), "LDR", applyMagma=False
    )
    errors = np.asarray(errors, dtype=np.float64).reshape(image.shape[0], image.shape[1], -1)[..., 0]
    return {
        "psnr_db": float(peak_signal_noise_ratio(reference, image, data_range=1)),
        "ssim_within": float(
            structural_similarity(
                reference,
                image,
                data_range=1,
                channel_axis=-1,
                gaussian_weights=True,
                sigma=1.5,
                use_sample_covariance=False,
            )
        ),
        "ssim_mirrored": float(structural_similarity_index_measure(*batches, data_range=1.0)),
        "flip": float(mean),
        # The error of every 7th pixel.
        "flip_map": [round(float(error), 7) for error in errors.reshape(-1)[::7]],
    }


def main():
    cases = []
    for seed, (kind, width, height) in enumerate([("noise", 48, 36), ("shift", 61, 37), ("blur", 24, 40)]):
        reference = truth(width, height, seed)
        image = spoiled(reference, kind, seed)
        cases.append(
            {
                "name": kind,
                "size_px": [width, height],
                "truth": reference.tobytes().hex(),
                "image": image.tobytes().hex(),
                **scores(image, reference),
            }
        )
    path = Path(__file__).with_suffix(".json")
    path.write_text(json.dumps(cases, indent=1) + "\n")


if __name__ == "__main__":
    main()
