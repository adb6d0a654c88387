"""Trainings side by side: each a `python -m viinter.train` of its own, one after another, and what they cost and reach.

Notation: training seconds as everywhere; an exponent e says that a cost grows as size^e.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from viinter import runs
from viinter.config import UserError
from viinter.evidence import seconds_to
from viinter.runs import Run

# the published network with the width and depth that do best on two CPU cores, and a rate: at 5e-4 the network
# fell back to one flat colour on fern (after a minute) and on Chess (after four)
TUNED = ["model=paper", "model.width=128", "model.depth=5", "optim.lr=3e-4"]


def methods(seconds: float) -> dict[str, list[str]]:
    """The trainings of `python -m viinter.bench fast`: their names, and what is added to the command.

    The published network, and the same tuned, have `seconds`; `model=fast` has a thousandth, a sixtieth and a third of
    them, each a run of its own: its schedule follows the budget.
    """
    found = {
        "paper, as published": ["model=paper", f"optim.training_seconds={seconds:g}"],
        "paper, tuned": [*TUNED, f"optim.training_seconds={seconds:g}"],
    }
    for part in (1000, 60, 3):
        found[f"fast, 1/{part} of the time"] = ["model=fast", f"optim.training_seconds={seconds / part:g}"]
    return found


def train(folder: Path, own: Sequence[str], common: Sequence[str]) -> Run:
    """The run in `folder` of `python -m viinter.train common... own...`: finished before, gone on with, or new.

    Raises UserError if it fails, what it says on the way goes to the terminal; and if the folder holds another run.
    """
    asked = [*common, *own]
    if (folder / "checkpoints").exists():
        if (held := runs.read([folder])[0].overrides) != asked:
            both = f"a run of {' '.join(held)}, not of {' '.join(asked)}"
            raise UserError(f"{folder} holds {both}; choose another folder")
        command = [f"resume={folder}"]
    else:
        command = [*asked, f"hydra.run.dir='{folder}'"]
    if not (folder / "metrics.json").exists():
        command = [sys.executable, "-m", "viinter.train", *command]
        if subprocess.run(command).returncode:
            raise UserError(f"{' '.join(command[1:])} failed; the same bench in the same folder goes on from here")
    return runs.read([folder])[0]


def block(root: Path, side: int, folder: Path) -> Path:
    """A folder with the files of the grid `root` that lie among its first `side` x `side` known views.

    The files are linked, not copied. Raises UserError if no file is named `..._RR_CC...`.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file in sorted(root.iterdir()):
        place = re.search(r"_(\d\d)_(\d\d)", file.stem)
        if place and max(map(int, place.groups())) <= 4 * (side - 1):
            (folder / file.name).symlink_to(file.resolve())
    if not any(folder.iterdir()):
        raise UserError(f"scene.root={root}: expected a planar grid, with files named ..._RR_CC...")
    return folder


def exponent(sizes: Sequence[float], costs: Sequence[float | None]) -> float | None:
    """The slope of log cost over log size by least squares; None where a cost is missing or there is one size."""
    if None in costs or len(set(sizes)) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def costs(run: Run, decibel: float) -> dict[str, float | None]:
    """Training seconds until the probes had `decibel` (None: not reached), milliseconds a step, and peak megabytes."""
    metrics = run.metrics
    return {
        "seconds": seconds_to(run, decibel),
        "ms": 1e3 * metrics["training_seconds"] / metrics["steps"],
        "MB": metrics.get("peak_device_memory_mb", metrics["peak_memory_mb"]),
    }


def times_as_fast(run: Run, than: Run) -> float | None:
    """The training seconds of the run `than` over those after which `run` was first measured at its novel PSNR or
    above; None if it never was."""
    seconds = seconds_to(run, than.value("novel", "psnr"))
    return than.metrics["training_seconds"] / seconds if seconds else None


def step_work(height: float, width: float, layers: int, pixels: int) -> dict[str, float]:
    """Operations and bytes of one step of `model=fast` with textures of `height` x `width` (and their margins), and
    milliseconds by memory alone on an H100.

    For each pixel and layer, 4 corners of 4 channels, and of disparity and drift, are read forward, and read and added
    to backward; each reading takes about 12 operations a channel, the softmax and what moves about 100 a layer. What
    the graph keeps for the backward pass is written and read once: about 20 numbers a pixel and layer. Adam reads
    value, gradient and two moments and writes three of them, and the gradient is cleared, for each of the layers'
    numbers. Looking up a quarter of the pixels in another view is not counted.
    """
    numbers = layers * 3 * (1.1 * height) * (1.1 * width) * 13 / 12  # colours, and weights and disparities of a quarter
    reads = pixels * layers
    operations = 3 * reads * (6 * 12 + 100) + 12 * numbers
    moved = 4 * (reads * (3 * 24 + 2 * 20) + 8 * numbers)
    return {"GFLOP": operations / 1e9, "MB": moved / 1e6, "ms at 3.35 TB/s": moved / 3.35e12 * 1e3}
