"""Fast fields around a ring: every few views in a row have layers of their own, and these overlap.

Notation: `n` known views around a ring, `m` of them in a window; `V` codes at once, `P` pixels under each, `M` the
length of a code. Chart `c`, of `n`, is a `fast.FastField` of one set for the views c, c + 1, ..., c + m - 1, counted
around the ring.

A motion that is linear in the code is the motion of neighbours, and a few layers hold one side of what the cameras go
around. So views that see the same side share a chart, as regions do in an atlas. A code is drawn by the charts that
hold the known views nearest to it, and their mean is what is seen: between two known views that of m - 1 charts, which
were learned apart from each other, so that it takes the place of the sets of one field for all views. At each pixel a
chart counts by how well known views agree where its motion takes them: one may have found a wrong motion there.

The codes stay as they were drawn at random. They say which view is meant; where a chart has it, its motion learns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from viinter.fields.fast import ENOUGH, JUDGED, FastField, Pace
from viinter.fields.field import Field
from viinter.fields.maps import FAINT

WINDOW = 3  # views in a chart: the fewest that overlap
STEPS = 300  # of each chart, if `ENOUGH` passes over its views are not more
PACE = Pace(coarsest=16, coarse=0.30, half=0.50, shift=0.2, bend=0.2)  # from view to view motion is far, and it turns
HELD = 10.0  # times as much as a field of all views a chart is held to the known ones: few views leave more open
MANY = 4  # times smaller than those of one field are a chart's textures at most, in pixels, since there are so many
SHARP = 20.0  # how soon, on the way to a known view, a chart is left that lacks it
LEAST = 1e-3  # of the first chart's weight: with less a chart is not drawn


class ChartedField(Field):
    """F(xy | z) -> rgb by `views` charts of `window` known views each; the other arguments are `FastField`'s, of which
    `sets` is not used: charts that overlap are as many."""

    def __init__(
        self, code_dim: int, views: int, height: int, width: int, window: int, sets: int, texture_pixels: int,
        consistency: float, **settings: Any,
    ) -> None:  # fmt: skip
        super().__init__()
        settings |= {"sets": 1, "texture_pixels": max(1, texture_pixels // MANY), "consistency": HELD * consistency}
        # compared as they are normalized, since a turntable's light does not turn
        settings |= {"pace": PACE, "tries": False, "doubts": True, "normalize": True}
        self.charts = nn.ModuleList(FastField(code_dim, window, height, width, **settings) for _ in range(views))
        self.window, self.round, self.turn = window, 0, 0
        self.known: Tensor | None = None
        # of the known views in a code: z = sum_v share_v z_v, as nearly as that can be
        self.register_buffer("shares", torch.zeros(code_dim, views))
        self.register_buffer("size", torch.tensor([width, height]).float(), persistent=False)

    def around(self, known: Tensor) -> list[Tensor]:
        """Of what each known view has, [n, ...], that of each chart's views, [m, ...] n times."""
        twice = torch.cat([known, known[: self.window - 1]])
        return [twice[first : first + self.window] for first in range(len(known))]

    def calibrate(self, codes: Tensor) -> None:
        self.shares.copy_(torch.linalg.pinv(codes.detach()))
        for chart in self.charts:
            chart.calibrate(codes)

    def parameter_groups(self, codes: nn.Parameter) -> list[dict[str, Any]]:
        """One chart's, each with what all charts have of it."""
        *groups, _ = zip(*(chart.parameter_groups(codes) for chart in self.charts), strict=True)
        shared = [{**group[0], "params": [p for own in group for p in own["params"]]} for group in groups]
        return [*shared, {"params": [codes], "share": 0.0}]

    def rates(self) -> list[float]:
        return self.charts[0].rates()

    def at(self, progress: float, step: int = 0) -> None:
        """Charts are trained in turns, so that to each a round of all is one step."""
        self.round, self.turn = divmod(step, len(self.charts))
        for chart in self.charts:
            chart.at(progress, self.round)

    def enough(self, steps_per_pass: float) -> float:
        _, passes = ENOUGH
        return max(STEPS * len(self.charts), passes * self.window * steps_per_pass)

    def settle(self, seconds: float, views: int, batch: float, drawing: Callable[[], float]) -> float:
        """A known view is drawn by as many charts as finish on it, and looking it up in others takes as long again."""
        return views * drawing() * (1 / JUDGED + 2 * bool(len(self.charts[0].remainder)))

    def see(self, views: Tensor, codes: Tensor) -> None:
        self.known = views
        for chart, *own in zip(self.charts, self.around(views), self.around(codes), strict=True):
            chart.see(*own)

    def loss(self, view: Tensor, xy: Tensor, rgb: Tensor, codes: Tensor) -> Tensor:
        """The loss of the chart whose turn it is, at the same pixels of its own views (`see`)."""
        own = (view + self.round) % self.window  # as evenly spread as `view` is, over some rounds
        known = (own + self.turn) % len(codes)
        x, y = torch.minimum(((xy + 1) / 2 * self.size).round(), self.size - 1).long().unbind(-1)
        around = codes.roll(-self.turn, 0)[: self.window]
        return self.charts[self.turn].loss(own, xy, self.known[known[:, None], y, x], around)

    def finish(self, views: Tensor, codes: Tensor) -> None:
        for chart, *own in zip(self.charts, self.around(views), self.around(codes), strict=True):
            chart.finish(*own)
        self.known = None

    def weights(self, z: Tensor) -> Tensor:
        """How much each chart counts under the codes `z` [V, M]: [V, n], summing to 1 and mostly 0.

        That follows from how much of a code is made of the known views that a chart holds. At a known view those that
        hold it count alike, and on the way to another one those that lack it fade out.
        """
        share = z @ self.shares.to(z.dtype)
        held = sum(share.roll(-k, 1) for k in range(self.window))
        weights = torch.exp(SHARP * (held - held.amax(1, keepdim=True)))
        weights = (weights - LEAST).clamp_min(0)
        return weights / weights.sum(1, keepdim=True)

    def forward(self, xy: Tensor, z: Tensor) -> Tensor:
        """Colours [V, P, 3] of the pixels `xy` [V, P, 2] in [-1, 1) under the codes `z` [V, M]; not clamped.

        Beside their `weights` charts that overlap count, at each pixel, by the inverse of the squared error that their
        motion makes there between known views (`FastField.judged`), as measurements do by that of their variance.
        """
        weights, total = self.weights(z), z.new_zeros(*xy.shape[:2], 4)
        for k in weights.any(0).nonzero()[:, 0].tolist():
            some = weights[:, k].nonzero()[:, 0]
            rgb, doubt = self.charts[k].judged(xy[some], z[some])
            share = weights[some, k, None, None] / (doubt.square() + FAINT**2)
            total = total.index_add(0, some, torch.cat([share * rgb, share.expand(*rgb.shape[:2], 1)], -1))
        return total[..., :3] / total[..., 3:]
