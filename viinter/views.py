"""Drawing views of a field, and measuring them against the known views and probes of a scene.

Notation: a view is [H, W, 3] in [0, 1]; pixel j of W sits at x = -1 + 2j/W. A field maps `xy` [V, P, 2] and codes
[V, M] to rgb [V, P, 3]. Nothing here knows about training.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn

from viinter import metrics
from viinter.codes import along, mix
from viinter.config import UserError
from viinter.scenes import Scene

STRIP = 5  # frames of a strip


def pixel_grid(
    height: int, width: int, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Tensor:
    """Coordinates [H * W, 2] of all pixels in row order, x first, in [-1, 1)."""
    y = -1 + 2 * torch.arange(height, device=device, dtype=dtype) / height
    x = -1 + 2 * torch.arange(width, device=device, dtype=dtype) / width
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)


@torch.no_grad()
def draw(field: nn.Module, z: Tensor, height: int, width: int, chunk_pixels: int = 131_072) -> Tensor:
    """The view [H, W, 3] float32 (not clamped) that `field` shows under the code `z` [M], `chunk_pixels` at a time.

    The field is continuous, so any size can be drawn; memory grows with `chunk_pixels`, not with the size. If memory
    runs out, half as many rows are drawn at a time from there on. Raises UserError if one row is too much.
    """
    rows = max(1, chunk_pixels // width)
    rgb = torch.empty(height, width, 3, dtype=torch.float32, device=z.device)
    grid = pixel_grid(height, width, z.device, torch.promote_types(z.dtype, torch.float32)).view(height, width, 2)
    start = 0
    while start < height:
        try:
            part = rgb[start : start + rows]
            part.view(-1, 3).copy_(field(grid[start : start + rows].reshape(1, -1, 2), z[None])[0])
        except (torch.OutOfMemoryError, RuntimeError) as error:
            # on the CPU it is a RuntimeError like any other but for its words
            if not isinstance(error, torch.OutOfMemoryError) and "can't allocate memory" not in str(error):
                raise
            if rows == 1:
                raise UserError(f"out of memory: one row of {width} pixels is too much to draw at a time") from error
            rows //= 2
        else:
            start += rows
    return rgb


def draw_strip(field: nn.Module, codes: Tensor, scene: Scene, chunk_pixels: int) -> Tensor:
    """`STRIP` frames side by side [H, STRIP * W, 3] in [0, 1], from one of the scene's endpoints to the other (as the
    paper's Figure 5; `scenes.tour`), under mixes of `codes` [n, M]."""
    frames = along(codes, scene.tour, STRIP)
    return torch.cat([draw(field, z, scene.height, scene.width, chunk_pixels) for z in frames], 1).clamp(0, 1)


def measure(
    field: nn.Module,
    codes: Tensor,
    scene: Scene,
    kinds: list[str] | None = None,
    chunk_pixels: int = 131_072,
    seen: Callable[[str, int, Tensor, Tensor], None] | None = None,
    every: int = 1,
) -> dict[str, dict]:
    """Errors of the known views ("known") and of the scene's probes ("novel", ...), each as `metrics.summary`.

    Args:
        field: the field; its own mode and precision are used as they are.
        codes: the code book [n, M].
        scene: views and probes.
        kinds: which of "known" and the kinds of `scene.probes`; None for all.
        chunk_pixels: pixels drawn at a time.
        seen: called with (kind, index, image, target) for every view drawn, for pictures or a progress bar.
        every: measures one of so many views of each kind, evenly spaced, and at least one.
    """
    found = {}
    for kind in kinds or ["known", *scene.probes]:
        errors = {}
        targets = list(_targets(codes, scene, kind))
        first = min(every, len(targets)) // 2
        for index, (name, z, target) in enumerate(targets[first::every]):
            image = draw(field, z, scene.height, scene.width, chunk_pixels)
            target = target.to(image.device)
            if seen:
                seen(kind, index, image, target)
            errors[name] = metrics.compare(image, target)
        found[kind] = metrics.summary(errors)
    return found


def _targets(codes: Tensor, scene: Scene, kind: str) -> Iterator[tuple[str, Tensor, Tensor]]:
    if kind == "known":
        yield from zip(scene.names, codes, scene.views, strict=True)
    else:
        for probe in scene.probes[kind]:
            yield probe.name, mix(codes, probe.mix), probe.target
