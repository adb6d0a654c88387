"""Pictures and textures as maps: as sums of levels, read between their pixels, compared around them.

Notation: `N` maps of `C` channels, [N, C, h, w], or those of `S` sets of `L` layers; `n` images [n, h, w, 3]; `V` views
of `P` pixels each.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

CONTRAST = 0.14  # rgb: the deviation of colours around a pixel that are `normalized`
FAINT = 0.01  # rgb: deviations below this may be noise and stay smaller
OCCLUDED = 0.05  # rgb: differences well above this count little, they may be another surface


def pyramid(levels: list[Tensor]) -> Tensor:
    """The sum of the maps [N, C, h, w], at the size of the last."""
    total = levels[0]
    for own in levels[1:]:
        total = stretch(total, own) + own
    return total


def stretch(maps: Tensor, like: Tensor) -> Tensor:
    """Maps [N, C, h, w] brought to the size of `like` [..., h', w']; corner pixels stay at the corners."""
    return F.interpolate(maps, size=like.shape[-2:], mode="bilinear", align_corners=True)


def read(maps: Tensor, u: Tensor) -> Tensor:
    """Maps [S L, C, h, w] read at `u` [S, L, V, 2, P], [S, L, C, V, P]."""
    return sample(maps, u.flatten(0, 1)).unflatten(0, u.shape[:2])


def sample(maps: Tensor, u: Tensor) -> Tensor:
    """Maps [N, C, h, w] read at `u` [N, V, 2, P] in [-1, 1] (corner pixels at the ends), [N, C, V, P]."""
    return F.grid_sample(maps, u.movedim(2, -1), mode="bilinear", padding_mode="border", align_corners=True)


def robust(error: Tensor) -> Tensor:
    """Half of a squared difference of colours while it is small, and less of a large one, which may be that to another
    surface (Charbonnier et al. 1994)."""
    return OCCLUDED * ((error + OCCLUDED**2).sqrt() - OCCLUDED)


def normalized(views: Tensor) -> Tensor:
    """Colours [n, h, w, 3] less their mean around each pixel, over their deviation there, scaled to `CONTRAST`: light
    that changes from view to view leaves them as they are (as in Zhang et al. 2018, who so compare stereo pictures)."""
    maps = views.movedim(-1, 1)
    maps = maps - around(maps, 3)
    deviation = around(maps.square().mean(1, keepdim=True), 3).sqrt()
    return (CONTRAST * maps / (deviation + FAINT)).movedim(1, -1).contiguous()


def around(maps: Tensor, size: int) -> Tensor:
    """Maps [N, C, h, w] averaged around each pixel: over `size` x `size`, twice."""
    for _ in range(2):
        maps = F.avg_pool2d(maps, size, 1, size // 2, count_include_pad=False)
    return maps


def look_up(views: Tensor, which: Tensor, at: Tensor) -> Tensor:
    """Colours [..., V, P, 3] of the images number `which` [V] of `views` [n, h, w, 3] at `at` [..., V, 2, P], counted
    in pixels, bilinearly; beyond the border, those at the border. No gradient goes to the images.

    Every V has an image of its own: `sample` would have to copy it, or be called once for each image.
    """
    _, height, width, _ = views.shape
    pixels = views.detach().reshape(-1, 3)
    x, y = at.unbind(-2)
    x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    left, top = x.detach().floor().long(), y.detach().floor().long()
    right, down = (x - left)[..., None], (y - top)[..., None]
    first = (which[:, None] * height + top) * width + left
    beside, below = (left < width - 1).long(), (top < height - 1).long() * width
    above = torch.lerp(pixels[first], pixels[first + beside], right)
    under = torch.lerp(pixels[first + below], pixels[first + below + beside], right)
    return torch.lerp(above, under, down)
