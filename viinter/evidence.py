"""Error against run time over several runs: methods and their seeds, times to a target, where the time goes.

A *method* is a group of runs that differ in seed and budget alone. Notation: training seconds as everywhere.
"""

from __future__ import annotations

import statistics
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from viinter.comparisons import cell
from viinter.page import Table
from viinter.runs import Run

TARGETS = (25, 28, 30, 33, 36)  # dB
BUDGET = ("seed", "optim.training_seconds", "optim.steps")


def methods(runs: list[Run], budgets: bool = True) -> dict[str, list[Run]]:
    """Runs by what was asked of them beside the seed, and, unless `budgets` are told apart, beside the budget."""
    apart = BUDGET[:1] if budgets else BUDGET
    asked = [[o for o in run.overrides if o.partition("=")[0] not in apart] for run in runs]
    common = set(asked[0]).intersection(*asked) if asked else set()
    found: dict[str, list[Run]] = defaultdict(list)
    for run, overrides in zip(runs, asked, strict=True):
        own = [o for o in overrides if o not in common and not o.startswith("hydra")]
        name = f"{run.setting('scene.name')}, model={run.setting('model.name')}"
        found[" ".join(own) or name].append(run)
    return dict(found)


@dataclass
class Curve:
    """Training seconds [T], and over the runs the median MSE and its range at each, [T]."""

    seconds: np.ndarray
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray


def curve(runs: list[Run], kind: str) -> Curve | None:
    """MSE of `kind` against training seconds: median and range over the seeds, where all of them were measured.

    Runs are measured at times of their own; between two measurements the logarithm of the error is taken to go in a
    straight line over the logarithm of the time. None if no run has a measurement.
    """
    lines = []
    for run in runs:
        points = [(r["training_seconds"], r[f"{kind}_mse"]) for r in run.rows if r[f"{kind}_mse"]]
        points = [(s, e) for s, e in points if s and s > 0]
        if points:
            lines.append(np.log(np.array(sorted(points))).T)
    if not lines:
        return None
    begin, end = max(line[0, 0] for line in lines), min(line[0, -1] for line in lines)
    times = sorted({t for line in lines for t in line[0] if begin <= t <= end})
    if not times:
        return None
    errors = np.exp([np.interp(times, *line) for line in lines])
    return Curve(np.exp(times), np.median(errors, 0), errors.min(0), errors.max(0))


def seconds_to(run: Run, decibel: float) -> float | None:
    """Training seconds at the first measurement whose novel PSNR was `decibel` or more; None if there was none."""
    return next((r["training_seconds"] for r in run.rows if (r["novel_psnr"] or -1) >= decibel), None)


def times_to_targets(runs: list[Run]) -> Table:
    """Training seconds until the probes were first measured at so many dB, for each method."""
    rows = []
    for name, of in methods(runs).items():
        line = [name]
        for target in TARGETS:
            reached = [s for run in of if (s := seconds_to(run, target)) is not None]
            text = f"{statistics.median(reached):.0f} s" if reached else "not reached"
            line.append(text + (f" ({len(reached)} of {len(of)})" if 0 < len(reached) < len(of) else ""))
        rows.append([*line, cell(of, "novel", "psnr")])
    columns = ["method", *(f"{target} dB" for target in TARGETS), "novel PSNR at the end"]
    notes = ["Median over seeds of the training seconds at the first measurement of that quality at the probes."]
    return Table("Time to quality", columns, rows, notes)


def where_time_goes(runs: list[Run]) -> Table:
    """Mean seconds of each part of the runs, of the whole, and peak memory, for each method."""
    done = methods([run for run in runs if "seconds" in (run.metrics or {})])
    parts = list(dict.fromkeys(part for of in done.values() for run in of for part in run.metrics["seconds"]))
    rows = []
    for name, of in done.items():
        means = [statistics.fmean(run.metrics["seconds"].get(part, 0.0) for run in of) for part in parts]
        memory = max(run.metrics.get("peak_device_memory_mb", run.metrics["peak_memory_mb"]) for run in of)
        rows.append([name, *(f"{mean:.1f}" for mean in means), f"{sum(means):.1f}", f"{memory:.0f}"])
    notes = ["Mean seconds of a run; peak memory in MB, of the device where there is one, else of the process (which a "
             "sweep's jobs share)."]  # fmt: skip
    return Table("Where the time goes", ["method", *parts, "all", "peak MB"], rows, notes)


def omitted(runs: list[Run]) -> Table:
    """What the runs' scenes did not need, why, and what that saved: mean over the runs, or how it can be measured."""
    found: dict[tuple[str, str, str, str], list[dict]] = defaultdict(list)
    for metrics in (run.metrics for run in runs if run.metrics):
        for left in metrics["omitted"]:
            found[metrics["scene"], left["part"], left["reason"], left.get("how", "")].append(left)
    rows = []
    for (scene, part, reason, how), each in found.items():
        saved = [[left[key] for left in each if left.get(key) is not None] for key in ("seconds", "megabytes")]
        numbers = [f"{statistics.fmean(values):.1f}" if values else "-" for values in saved]
        rows.append([scene, part, reason, *numbers, how])
    return Table("Left out", ["scene", "part", "reason", "seconds saved", "MB saved", "how measured"], rows)
