"""The report's plots: PSNR against a setting or a measured number, and panels of frames with a zoomed crop."""

from __future__ import annotations

import statistics
from collections.abc import Callable

import matplotlib
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from viinter import image
from viinter.evidence import BUDGET, curve, methods
from viinter.pictures import end_at_rounding, plain_log_x
from viinter.runs import Run
from viinter.views import STRIP

matplotlib.use("Agg")
from matplotlib import pyplot as plt

STYLES = {"known": "o--", "novel": "s-"}


def conditions(runs: list[Run]) -> str:
    """Hardware, versions, threads, precision and seeds of the finished runs, in one line, for every figure."""
    done = [run.metrics for run in runs if run.metrics]
    if not done:
        return "no finished run"
    facts = [{m["hardware"] for m in done}]
    facts += [{f"{name} {m['versions'][name]}" for m in done} for name in ("torch", "lightning")]
    facts += [{f"{m['threads']} thread(s)" for m in done}, {m["precision"] for m in done}]
    facts.append({"seed " + ", ".join(map(str, sorted({m["seed"] for m in done})))})
    return "; ".join(", ".join(sorted(values)) for values in facts)


def _signed(figure: Figure, runs: list[Run]) -> Figure:
    figure.supxlabel(conditions(runs), fontsize=6, color="0.4", x=0.01, ha="left")
    return figure


def psnr_across(groups: dict[str, list[Run]], label: str, printed: dict[str, dict[str, float]]) -> Figure:
    """PSNR of known views and probes for each group: mean and range over its runs; the paper's beside it.

    groups: runs by the text under the axis. printed: for known and novel, the paper's PSNR by the same texts.
    """
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    places = list(groups)
    for kind, style in STYLES.items():
        points = [(k, values) for k, of in enumerate(groups.values()) if (values := _values(of, kind))]
        _with_range(axes, points, style, f"{kind} views, here")
        paper = [(places.index(v), psnr) for v, psnr in printed.get(kind, {}).items() if v in places]
        if paper:
            axes.plot(*zip(*paper, strict=True), style, color="0.6", markersize=4, label=f"{kind} views, paper")
    axes.set_xticks(range(len(places)), places)
    axes.set(xlabel=label, ylabel="PSNR, dB")
    axes.grid(True, alpha=0.3)
    axes.legend(fontsize=8)
    return _signed(figure, [run for of in groups.values() for run in of])


def psnr_against(
    groups: dict[str, list[list[Run]]], x: Callable[[Run], float | None], label: str, kind: str = "novel"
) -> Figure:
    """PSNR of `kind` against the number `x` of a run, on a log axis: a line a group, a point for each list of seeds."""
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for name, seeds in groups.items():
        points = []
        for runs in seeds:
            done = [run for run in runs if run.value(kind, "psnr") is not None and x(run)]
            if done:
                points.append((statistics.fmean(x(run) for run in done), _values(done, kind)))
        _with_range(axes, sorted(points), "o-", name)
    plain_log_x(axes)
    axes.set(xlabel=label, ylabel=f"{kind} PSNR, dB")
    axes.grid(True, which="both", alpha=0.3)
    if axes.lines:
        axes.legend(fontsize=8)
    return _signed(figure, [run for seeds in groups.values() for runs in seeds for run in runs])


def _values(runs: list[Run], kind: str) -> list[float]:
    return [v for run in runs if (v := run.value(kind, "psnr")) is not None]


def _with_range(axes: Axes, points: list[tuple[float, list[float]]], style: str, name: str) -> None:
    """A line through the means of `points`, (x, values), with bars from the least to the largest value."""
    if points:
        means = [statistics.fmean(values) for _, values in points]
        below = [mean - min(values) for mean, (_, values) in zip(means, points, strict=True)]
        above = [max(values) - mean for mean, (_, values) in zip(means, points, strict=True)]
        axes.errorbar([x for x, _ in points], means, [below, above], fmt=style, capsize=3, markersize=4, label=name)


def error_curves(runs: list[Run], flat: dict[str, float]) -> Figure:
    """MSE of probes and known views against training seconds, a line a method: median over seeds, range shaded.

    flat: MSE at the probes of what needs no training, by name.
    """
    figure, both = plt.subplots(1, 2, figsize=(11, 4), sharey=True, layout="constrained")
    for axes, kind in zip(both, ("novel", "known"), strict=True):
        for name, of in methods(runs).items():
            if found := curve(of, kind):
                (line,) = axes.plot(found.seconds, found.median, "o-", markersize=3, label=name)
                axes.fill_between(found.seconds, found.low, found.high, color=line.get_color(), alpha=0.2, linewidth=0)
        if kind == "novel":
            for name, error in flat.items():
                axes.axhline(error, color="0.3", linestyle=":" if name == "blend" else "--", linewidth=1, label=name)
        plain_log_x(axes)
        axes.set(yscale="log", xlabel="training seconds", title=f"{kind} views")
        axes.grid(True, which="both", alpha=0.3)
    both[0].set_ylabel("mean squared error")
    if named := [axes for axes in both if axes.lines]:  # a scene without probes has known views alone
        end_at_rounding(both[0])  # both share the axis
        named[0].legend(fontsize=6)
    return _signed(figure, runs)


def work_precision(runs: list[Run], flat: dict[str, float]) -> Figure:
    """Novel PSNR at the end of each budget against training seconds, a line a method; the Pareto front is ringed.

    A point is the mean over seeds, with the range. On the front is what nothing quicker equals. flat: as above, PSNR.
    """
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    every = []
    for name, of in methods(runs, budgets=False).items():
        points = []
        for budget in dict.fromkeys(tuple(run.setting(key) for key in BUDGET[1:]) for run in of):
            seeds = [run for run in of if tuple(run.setting(key) for key in BUDGET[1:]) == budget]
            if values := _values(seeds, "novel"):
                seconds = [run.metrics["training_seconds"] for run in seeds if run.value("novel", "psnr") is not None]
                points.append((statistics.fmean(seconds), values))
        _with_range(axes, sorted(points), "o-", name)
        every += [(seconds, statistics.fmean(values)) for seconds, values in points]
    front = pareto(every)
    if front:
        axes.plot(*zip(*front, strict=True), "o", markersize=11, fillstyle="none", color="black", label="Pareto front")
    for name, psnr in flat.items():
        axes.axhline(psnr, color="0.3", linestyle=":" if name == "blend" else "--", linewidth=1, label=name)
    plain_log_x(axes)
    axes.set(xlabel="training seconds of the budget", ylabel="novel PSNR, dB")
    axes.grid(True, which="both", alpha=0.3)
    if axes.lines:
        axes.legend(fontsize=6)
    return _signed(figure, runs)


def pareto(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those (seconds, quality) that are better than all that take no longer."""
    front: list[tuple[float, float]] = []
    for seconds, quality in sorted(points, key=lambda p: (p[0], -p[1])):
        if not front or quality > front[-1][1]:
            front.append((seconds, quality))
    return front


def panel(rows: dict[str, list[Run]], shown: list[int]) -> Figure:
    """Frames between two known views, a row for each setting: whole, then zoomed in at their middle.

    rows: by label, the runs of one setting; the first with a strip is shown. shown: which of the strip's five frames.
    A row without a strip says why.
    """
    strips = {label: next((s for run in runs if (s := _strip(run)) is not None), None) for label, runs in rows.items()}
    height, width = next((s[0].shape[:2] for s in strips.values() if s is not None), (64, 64))
    gap, columns = max(2, width // 24), 2 * len(shown)
    sheet = torch.ones(len(rows) * (height + gap), columns * (width + gap), 3)
    figure, axes = plt.subplots(figsize=(1.3 * columns, 1.3 * len(rows) * height / width + 0.4), layout="constrained")
    for k, (label, runs) in enumerate(rows.items()):
        top = k * (height + gap)
        if strips[label] is None:
            why = next((run.missing for run in runs if run.missing), "no strip.png (logging.pictures=false)")
            axes.text(gap, top + height / 2, why if runs else "no such job", fontsize=8)
            continue
        for at, frame in enumerate(shown):
            view = _fit(strips[label][frame], height, width)
            crop = view[height * 3 // 8 : height * 5 // 8 + 1, width * 3 // 8 : width * 5 // 8 + 1]
            for place, part in ((at, view), (len(shown) + at, _fit(crop, height, width))):
                left = place * (width + gap)
                sheet[top : top + height, left : left + width] = part
    axes.imshow(sheet.numpy())
    for spine in axes.spines.values():
        spine.set_visible(False)
    names = [f"t = {frame / (STRIP - 1):g}" for frame in shown]
    axes.set_xticks([(k + 0.5) * (width + gap) for k in range(columns)], names * 2, fontsize=8)
    axes.set_yticks([(k + 0.5) * (height + gap) for k in range(len(rows))], list(rows), fontsize=8)
    axes.tick_params(length=0, top=True, labeltop=True, bottom=False, labelbottom=False)
    return _signed(figure, [run for runs in rows.values() for run in runs])


def _fit(view: Tensor, height: int, width: int) -> Tensor:
    """`view` [h, w, 3] as large as goes into `height` x `width`, each pixel a block of one colour; white around it."""
    scale = min(height / view.shape[0], width / view.shape[1])
    rows, columns = (torch.arange(round(side * scale)) for side in view.shape[:2])
    fitted = torch.ones(height, width, 3)
    part = view[(rows / scale).long().clamp_max(view.shape[0] - 1)]
    fitted[: len(rows), : len(columns)] = part[:, (columns / scale).long().clamp_max(view.shape[1] - 1)]
    return fitted


def _strip(run: Run) -> list[Tensor] | None:
    """The five frames [H, W, 3] of a run's strip.png, from one known view to the other."""
    file = run.folder / "strip.png"
    return list(image.read(file).chunk(STRIP, 1)) if file.is_file() else None
