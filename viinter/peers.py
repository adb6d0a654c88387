"""What needs no training, at the same probes: a cross-fade of a probe's known views, and optical flow between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from viinter import metrics, optical_flow
from viinter.config import UserError
from viinter.scenes import Probe, Scene


def blend(views: Tensor, probe: Probe) -> Tensor:
    """The mean [H, W, 3] of the probe's known `views` [n, H, W, 3] under its weights."""
    return sum(weight * views[view] for view, weight in probe.mix)


def flow(views: Tensor, probe: Probe) -> Tensor:
    """Both known views of a probe moved to it along one optical flow between them, averaged by its weights.

    The flow is taken to be straight, and to be the same at the probe as in the first view. Raises UserError without
    OpenCV, for a probe of other than two known views, and for views that are too small.
    """
    if len(probe.mix) != 2:
        raise UserError(f"optical flow stands between two known views; {probe.name} has {len(probe.mix)}")
    (i, wi), (j, wj) = probe.mix
    moved = optical_flow.displacement(views[i], views[j])
    return wi * optical_flow.read(views[i], -wj * moved) + wj * optical_flow.read(views[j], wi * moved)


PEERS: dict[str, Callable[[Tensor, Probe], Tensor]] = {"blend": blend, "flow": flow}


def measure(scene: Scene) -> dict[str, dict[str, Any] | str]:
    """For each peer `metrics.summary` of the standard probes, or the reason why there is none; in it, as `registered`,
    the same once each picture has been moved onto its target (`optical_flow.registered`), or a reason again."""
    found: dict[str, dict[str, Any] | str] = {}
    for name, draw in PEERS.items():
        try:
            drawn = {p.name: (draw(scene.views, p), p.target) for p in scene.probes["novel"]}
        except UserError as error:
            found[name] = str(error)
            continue
        errors = {probe: metrics.compare(*pair) for probe, pair in drawn.items()}
        found[name] = "the scene has no probes"
        if errors:
            found[name] = metrics.summary(errors) | {"registered": optical_flow.measure_registered(drawn)}
    return found
