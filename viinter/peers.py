"""What needs no training, at the same probes: a cross-fade of a probe's known views, and optical flow between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from viinter import metrics
from viinter.config import UserError
from viinter.scenes import Probe, Scene


def blend(views: Tensor, probe: Probe) -> Tensor:
    """The mean [H, W, 3] of the probe's known `views` [n, H, W, 3] under its weights."""
    return sum(weight * views[view] for view, weight in probe.mix)


def flow(views: Tensor, probe: Probe) -> Tensor:
    """Both known views of a probe warped to it along one OpenCV DIS flow between them, averaged by its weights.

    The flow is taken to be straight, and to be the same at the probe as in the first view. DIS as it does best here:
    medium preset down to single pixels, frames read bicubically. Raises UserError without OpenCV, and for a probe of
    other than two known views.
    """
    try:
        import cv2
    except ImportError as error:
        raise UserError(f'optical flow needs OpenCV: pip install "viinter[peers]" ({error})') from error
    if len(probe.mix) != 2:
        raise UserError(f"optical flow stands between two known views; {probe.name} has {len(probe.mix)}")
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    (i, wi), (j, wj) = probe.mix
    frames = [views[k].cpu().numpy() for k in (i, j)]
    moved = search.calc(*(cv2.cvtColor((f * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY) for f in frames), None)
    y, x = np.indices(moved.shape[:2], dtype=np.float32)

    def warped(frame: np.ndarray, share: float) -> np.ndarray:
        """`frame` read at so much of the flow."""
        there = x + share * moved[..., 0], y + share * moved[..., 1]
        return cv2.remap(frame, *there, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    return torch.from_numpy(wi * warped(frames[0], -wj) + wj * warped(frames[1], wi)).float()


PEERS: dict[str, Callable[[Tensor, Probe], Tensor]] = {"blend": blend, "flow": flow}


def measure(scene: Scene) -> dict[str, dict[str, Any] | str]:
    """For each peer `metrics.summary` of the standard probes, or the reason why there is none."""
    found: dict[str, dict[str, Any] | str] = {}
    for name, draw in PEERS.items():
        try:
            errors = {p.name: metrics.compare(draw(scene.views, p), p.target) for p in scene.probes["novel"]}
            found[name] = metrics.summary(errors) if errors else "the scene has no probes"
        except UserError as error:
            found[name] = str(error)
    return found
