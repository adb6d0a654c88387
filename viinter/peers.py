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
    """Both known views of a probe warped to it along OpenCV's DIS flow (medium preset), averaged by its weights.

    The flow between the two is taken to be straight, and to be the same at the probe as where it was found. Raises
    UserError without OpenCV, and for a probe of other than two known views.
    """
    try:
        import cv2
    except ImportError as error:
        raise UserError(f'optical flow needs OpenCV: pip install "viinter[peers]" ({error})') from error
    if len(probe.mix) != 2:
        raise UserError(f"optical flow stands between two known views; {probe.name} has {len(probe.mix)}")
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    (i, wi), (j, wj) = probe.mix
    frames = [(views[k].cpu().numpy() * 255).round().astype(np.uint8) for k in (i, j)]
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    y, x = np.indices(grey[0].shape, dtype=np.float32)

    def warped(a: int, b: int, share: float) -> np.ndarray:
        """View `a` moved by `share` of the way to `b`."""
        moved = search.calc(grey[a], grey[b], None) * share
        back = cv2.BORDER_REPLICATE
        return cv2.remap(frames[a], x - moved[..., 0], y - moved[..., 1], cv2.INTER_LINEAR, borderMode=back) / 255

    return torch.from_numpy(wi * warped(0, 1, wj) + wj * warped(1, 0, wi)).float()


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
