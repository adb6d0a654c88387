"""Codes: one learned vector for each known view, kept on a p-norm sphere, and mixed to reach the views between.

Notation: `n` known views, `M` the length of a code, `z` a code [M], the code book [n, M]. `p` is the order of the
norm: None (no projection), `math.inf` (the largest absolute entry) or a number >= 1; `radius` is the value the norm is
kept at. All functions take any number of leading dimensions.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor, nn

SMALLEST = 1e-6  # a code whose largest entry is below this has lost its direction


def p_norm(z: Tensor, p: float) -> Tensor:
    """The p-norm of codes `z` [..., M] as [..., 1]; p >= 1 or `math.inf`.

    Entries are divided by the largest before the power is taken, so that neither a large p nor a large or small code
    over- or underflows. A code of zeros has norm 0.
    """
    largest = z.abs().amax(-1, keepdim=True)
    if p == math.inf:
        return largest
    scaled = z / largest.clamp_min(torch.finfo(z.dtype).tiny)
    return largest * scaled.abs().pow(p).sum(-1, keepdim=True).pow(1 / p)


def project(z: Tensor, p: float | None, radius: float = 1.0) -> Tensor:
    """Codes `z` [..., M] scaled to the p-norm `radius` (paper Section 3.3); unchanged for p = None.

    A code of zeros has no direction and stays at zero; `CodeBook.project` replaces such codes.
    """
    if p is None:
        return z
    norm = p_norm(z, p)
    return torch.where(norm > 0, z * (radius / norm.clamp_min(torch.finfo(z.dtype).tiny)), z)


def lerp(zi: Tensor, zj: Tensor, t: float | Tensor) -> Tensor:
    """`(1 - t) z_i + t z_j` (paper Section 3.3); t outside [0, 1] goes on along the line beyond the known views."""
    return (1 - t) * zi + t * zj


def mix(codes: Tensor, weights: list[tuple[int, float]]) -> Tensor:
    """The weighted sum [M] of rows of the code book `codes` [n, M]: `[(view, weight), ...]`.

    With four views this interpolates interpolated codes (supplement, "Interpolated Between Interpolated Codes").
    """
    views = torch.tensor([view for view, _ in weights], device=codes.device)
    shares = torch.tensor([share for _, share in weights], device=codes.device, dtype=codes.dtype)
    return shares @ codes[views]


def ease(t: Tensor) -> Tensor:
    """`t` in [0, 1] with zero speed at both ends: 3 t^2 - 2 t^3."""
    return t * t * (3 - 2 * t)


def path(codes: Tensor, views: list[int], frames: int, smooth: bool = False, loop: bool = False) -> Tensor:
    """Codes [F, M] along straight lines through the known `views`, `frames` from each to the next, the last included.

    `smooth` slows down at each view; `loop` comes back to the first view and leaves out its second appearance.
    """
    stops = [*views, views[0]] if loop else views
    t = torch.arange(frames, device=codes.device, dtype=codes.dtype)[:, None] / frames
    t = ease(t) if smooth else t
    legs = [lerp(codes[i], codes[j], t) for i, j in itertools.pairwise(stops)]
    return torch.cat(legs if loop else [*legs, codes[stops[-1]][None]])


def along(codes: Tensor, views: list[int], count: int) -> Tensor:
    """`count` codes [count, M] evenly spaced along straight lines through the known `views`, both ends included."""
    stops, legs = codes[views], len(views) - 1
    t = torch.linspace(0, legs, count, device=codes.device, dtype=codes.dtype)
    leg = t.long().clamp_max(legs - 1)
    return lerp(stops[leg], stops[leg + 1], (t - leg)[:, None])


def radius_of_length(length: float, p: float, code_dim: int) -> float:
    """The mean p-norm of normal random codes of `code_dim` entries, scaled to the Euclidean `length`.

    The published radius 1 means another Euclidean length for each p (at M = 128: 0.11 for p = 1, 1 for p = 2, 4 for
    p = inf). Codes on the p-norm sphere of this radius have Euclidean lengths around `length`, the same for all p.
    """
    z = torch.randn(1024, code_dim, generator=torch.Generator().manual_seed(0))
    return p_norm(project(z, 2.0, length), p).mean().item()


class CodeBook(nn.Module):
    """The codes of a scene's known views, `weight` [n, M], drawn from a standard normal (supplement: PyTorch default).

    `project_` puts them on the sphere in place; a code with all entries below 1e-6 is replaced by one drawn at the
    start, and `redrawn` (a tensor, so that counting needs no synchronisation) counts how often that happened.

    Args:
        views, code_dim: n and M.
        p, radius: the norm, and the value that it is kept at.
        length: in place of `radius`, see `radius_of_length`; without a norm, the codes' mean Euclidean length as drawn.
    """

    def __init__(self, views: int, code_dim: int, p: float | None, radius: float, length: float | None = None) -> None:
        super().__init__()
        drawn = torch.randn(views, code_dim)
        if length is not None and p is None:
            drawn *= length / math.sqrt(code_dim)
        elif length is not None:
            radius = radius_of_length(length, p, code_dim)
        self.p, self.radius = p, radius
        self.weight = nn.Parameter(drawn)
        self.register_buffer("spare", torch.randn(views, code_dim))
        self.register_buffer("redrawn", torch.zeros((), dtype=torch.long))

    @torch.no_grad()
    def project_(self) -> None:
        """Puts every code on the p-norm sphere of the radius, in place; no projection for p = None."""
        if self.p is None:
            return
        lost = self.weight.abs().amax(-1, keepdim=True) < SMALLEST * min(self.radius, 1.0)
        self.redrawn += lost.sum()
        self.weight.copy_(project(torch.where(lost, self.spare, self.weight), self.p, self.radius))

    @torch.no_grad()
    def norms(self) -> Tensor:
        """The p-norm of every code, [n]; the Euclidean norm where there is no projection."""
        return p_norm(self.weight, self.p or 2.0)[:, 0]
