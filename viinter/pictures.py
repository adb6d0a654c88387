"""Pictures of a run that a person looks at first: the strip, the film, error against run time.

Notation: frames are [H, W, 3] in [0, 1].
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import torch
from torch import Tensor, nn

from viinter import video
from viinter.metrics import psnr
from viinter.views import draw

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, LogFormatter, NullLocator

ROUNDING = (1 / 255) ** 2 / 12  # mean squared error of rounding to 8 bits


def write_film(
    file: Path, field: nn.Module, codes: Tensor, size: tuple[int, int], chunk_pixels: int, fps: float
) -> None:
    """`interpolation.mp4` of the codes [F, M], there and back again, so that it plays without a jump."""
    there = [draw(field, z, *size, chunk_pixels).clamp(0, 1).mul(255).round().to("cpu", torch.uint8) for z in codes]
    video.write_mp4(file, (frame / 255 for frame in there + there[-2:0:-1]), fps)


class PlainNumbers(LogFormatter):
    """Labels of a log axis as people say them, 30 and 100; none between the powers of ten where these are many."""

    def __init__(self) -> None:
        super().__init__(minor_thresholds=(2, 0.6))

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def plain_log_x(axes: Axes) -> None:
    """A log axis along x, with `PlainNumbers`."""
    axes.set_xscale("log")
    axes.xaxis.set(major_formatter=PlainNumbers(), minor_formatter=PlainNumbers())


def end_at_rounding(axes: Axes) -> None:
    """Errors smaller than that of an 8-bit image leave the plot: exact views would take most of a log axis."""
    bottom, top = axes.get_ylim()
    if bottom < ROUNDING < top:
        axes.set_ylim(bottom=ROUNDING)


def plot_error(file: Path, rows: list[dict[str, Any]], title: str) -> None:
    """MSE against training seconds, both on log axes, known views and probes apart."""
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for kind, style in (("known", "o-"), ("novel", "s--")):
        points = [(r["training_seconds"], r[f"{kind}_mse"]) for r in rows if r[f"{kind}_mse"]]
        if points:
            axes.plot(*zip(*points, strict=True), style, label=f"{kind} views", markersize=4)
    plain_log_x(axes)
    axes.set(yscale="log", xlabel="training seconds", ylabel="mean squared error", title=title)
    axes.grid(True, which="both", alpha=0.3)
    if axes.lines:
        end_at_rounding(axes)
        axes.legend()
        # a secondary axis with a function that falls would be labelled upside down (matplotlib 3.11)
        right = axes.secondary_yaxis("right")
        right.yaxis.set_major_locator(FixedLocator([10 ** (-d / 10) for d in range(0, 121, 5)]))
        right.yaxis.set_major_formatter(lambda mse, _: f"{psnr(mse):.0f}")
        right.yaxis.set_minor_locator(NullLocator())
        right.set_ylabel("dB of that mean")
    figure.savefig(file, dpi=130)
    plt.close(figure)
