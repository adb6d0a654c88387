"""Errors of single images: MSE, PSNR, SSIM, each one number for one image, to be averaged over images by the caller.

Notation: an image is [H, W, 3] in [0, 1]; a prediction is clamped to [0, 1] first. A perfect image has no finite PSNR
and an image smaller than SSIM's window has no SSIM: both are None, never infinity or a made-up number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

SSIM_WINDOW = 11
STRIP_PIXELS = 2**20  # that SSIM, which needs some twenty numbers a pixel, looks at together


@dataclass(frozen=True)
class ViewError:
    """Errors of one image: `mse`, `psnr` in dB (None if perfect), `ssim` (None if smaller than 11 pixels a side)."""

    mse: float
    psnr: float | None
    ssim: float | None


def psnr(mse: float) -> float | None:
    """`-10 log10(mse)` for values in [0, 1], in dB; None for a mean squared error of zero."""
    return -10 * math.log10(mse) if mse > 0 else None


def ssim(image: Tensor, target: Tensor) -> float | None:
    """Structural similarity (Wang et al. 2004): 11x11 Gaussian window, sigma 1.5, values in [0, 1].

    None if a side is shorter than the window. Worked out in strips of rows, so that memory does not grow with the
    image; each has the rows beside it that its windows reach.
    """
    height, width = target.shape[:2]
    if min(height, width) < SSIM_WINDOW:
        return None
    pair, reach, total = torch.stack([image, target]).permute(0, 3, 1, 2), SSIM_WINDOW // 2, 0.0
    for rows in torch.arange(height).split(max(1, STRIP_PIXELS // width)):
        first, last = int(rows[0]), int(rows[-1]) + 1
        top = max(0, first - reach)
        strip = pair[:, :, top : last + reach]
        _, similar = structural_similarity_index_measure(
            strip[:1], strip[1:], data_range=1.0, kernel_size=SSIM_WINDOW, return_full_image=True
        )
        total += similar[:, :, first - top : last - top].mean().item() * len(rows)
    return total / height


def compare(image: Tensor, target: Tensor) -> ViewError:
    """Errors of `image` [H, W, 3], clamped to [0, 1] first, against `target` [H, W, 3]."""
    if image.shape != target.shape:
        raise ValueError(f"image {tuple(image.shape)} and target {tuple(target.shape)} differ in shape")
    image = image.clamp(0, 1)
    mse = (image - target).square().mean(dtype=torch.float64).item()
    return ViewError(mse, psnr(mse), ssim(image, target))


def mean(values: list[float | None]) -> float | None:
    """Mean over images of those values that exist; None if none does."""
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known else None


def summary(errors: dict[str, ViewError]) -> dict:
    """`{psnr, ssim, mse, per_view}`: means over images (never pooled) and each image's own, by its name."""
    return {
        "psnr": mean([e.psnr for e in errors.values()]),
        "ssim": mean([e.ssim for e in errors.values()]),
        "mse": mean([e.mse for e in errors.values()]),
        "per_view": {name: {"psnr": e.psnr, "ssim": e.ssim, "mse": e.mse} for name, e in errors.items()},
    }
