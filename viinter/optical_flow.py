"""Optical flow between two pictures by OpenCV, and a picture moved onto another along it.

Notation: a picture is [H, W, 3] in [0, 1]; a displacement is [H, W, 2], in pixels, x first.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from viinter import metrics
from viinter.config import UserError

SMOOTH = 32  # a picture's shorter side, measured in the width within which `registered` moves all pixels alike


def displacement(start: Tensor, end: Tensor) -> np.ndarray:
    """How far what `start` shows at each pixel is from there in `end`.

    DIS (Kroeger et al. 2016) as it does best here: medium preset down to single pixels. Raises UserError without
    OpenCV, and for pictures that are too small for it (below some 11 pixels a side).
    """
    cv2 = _opencv()
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    frames = [(p.float().clamp(0, 1).cpu().numpy() * 255).round().astype(np.uint8) for p in (start, end)]
    try:
        return search.calc(*(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames), None)
    except cv2.error as error:
        height, width = start.shape[:2]
        raise UserError(f"optical flow needs larger views than {height} x {width}: {error.err}") from error


def read(picture: Tensor, moved: np.ndarray) -> Tensor:
    """`picture` read, bicubically, at each pixel plus `moved` there."""
    cv2 = _opencv()
    y, x = np.indices(moved.shape[:2], dtype=np.float32)
    there = cv2.remap(picture.float().cpu().numpy(), x + moved[..., 0], y + moved[..., 1], cv2.INTER_CUBIC,
                      borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    return torch.from_numpy(there)


def registered(image: Tensor, target: Tensor) -> Tensor:
    """`image`, clamped, moved onto `target` along the smoothed flow between them.

    Its error is that of what `image` shows, not of where (as in Bhat et al. 2021, who so judge pictures that nothing
    could have put in place to the pixel): half way between two cameras a third need not have stood, and from a little
    beside it a blur has less error than a sharp picture. The flow is smoothed so that it cannot rearrange details.
    """
    smooth = min(target.shape[:2]) / SMOOTH
    moved = _opencv().GaussianBlur(displacement(target, image), (0, 0), smooth)
    return read(image.clamp(0, 1), moved)


def measure_registered(drawn: dict[str, tuple[Tensor, Tensor]]) -> dict[str, Any] | str:
    """`metrics.summary` of pairs (image, target), each `registered` first; or the reason why there is none."""
    try:
        errors = {
            name: metrics.compare(registered(image, target), target.cpu()) for name, (image, target) in drawn.items()
        }
    except UserError as error:
        return str(error)
    return metrics.summary(errors)


def _opencv() -> ModuleType:
    try:
        import cv2
    except ImportError as error:
        raise UserError(f'optical flow needs OpenCV: pip install "viinter[peers]" ({error})') from error
    return cv2
