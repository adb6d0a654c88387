"""`python -m viinter.bench step | alpha`: what the framework costs over the same step in a bare PyTorch loop, and
what the interpolation loss costs where a scene wants it.

A step and its bare twin are timed in turns in one process: after every step of the real training, with all its
callbacks, a twin of the model takes one step in plain PyTorch. Whatever the machine does meanwhile, it does to both.
"""

from __future__ import annotations

import itertools
import multiprocessing
import statistics
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import lightning as L
import torch
from rich.console import Console
from rich.table import Table

from viinter import command, config
from viinter.config import TrainConfig
from viinter.data import PixelStore
from viinter.module import ViewInterpolator
from viinter.train import train

ABOUT = """
Times a training step through viinter.train against the same step in a bare PyTorch loop, in turns in one process, and
says where the time goes. Settings are those of viinter.train.

  python -m viinter.bench step                                       width 128, depth 5, the shipped scene, 200 steps
  python -m viinter.bench step model.width=512 model.depth=8 threads=2
  python -m viinter.bench alpha model=fast                           the same run with and without L_inter and its tower
"""

WARM_UP = 10


class BareTwin(L.Callback):
    """Takes a step of its own, in plain PyTorch, after each step of the training, and times both and their parts.

    A step of the training lasts from the end of the one before to the moment this callback, the last, is called: data,
    forward, backward, optimiser, every other callback, and Lightning's loop. `framework` [steps], `bare` [steps] and
    `parts` hold seconds.
    """

    def __init__(self, cfg: TrainConfig) -> None:
        self.cfg = cfg
        self.framework: list[float] = []
        self.bare: list[float] = []
        self.parts: dict[str, list[float]] = defaultdict(list)

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        scene, cfg = trainer.datamodule.scene, self.cfg
        self.store = PixelStore(scene.views, cfg.optim.batch_pixels, cfg.optim.pixels_from, cfg.seed, module.device)
        self.twin = ViewInterpolator(cfg, scene.n, module.about).to(module.device)
        self.optimizer = self.twin.configure_optimizers()
        for callback in trainer.callbacks:
            if callback is not self:
                self._time(callback, "on_train_batch_start")
                self._time(callback, "on_train_batch_end")
        self.since = self._now(module.device)

    def _time(self, callback: L.Callback, hook: str) -> None:
        inner, name = getattr(callback, hook), f"callback {type(callback).__name__}"

        def timed(*args: Any) -> None:
            begin = time.perf_counter()
            inner(*args)
            self.parts[name].append(time.perf_counter() - begin)

        if getattr(type(callback), hook) is not getattr(L.Callback, hook):
            setattr(callback, hook, timed)

    @staticmethod
    def _now(device: torch.device) -> float:
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def on_train_batch_end(
        self, trainer: L.Trainer, module: ViewInterpolator, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        marks = [self._now(module.device)]
        self.framework.append(marks[0] - self.since)

        def mark() -> None:
            marks.append(self._now(module.device))

        batch = self.store.batch(trainer.global_step)
        mark()
        loss = self.twin.training_step(batch, batch_idx)
        mark()
        self.optimizer.zero_grad()
        loss.backward()
        mark()
        self.optimizer.step()
        mark()
        self.twin.codes.project_()
        mark()
        self.bare.append(marks[-1] - marks[0])
        names = ("sampling", "forward", "backward", "optimiser", "code projection")
        for name, (begin, end) in zip(names, itertools.pairwise(marks), strict=True):
            self.parts[name].append(end - begin)
        self.since = self._now(module.device)


def step(cfg: TrainConfig, folder: Path) -> dict[str, Any]:
    """Median seconds of a step through `train` and in the bare loop, their ratio, and the parts; printed as a table."""
    twin = BareTwin(cfg)
    with tempfile.TemporaryDirectory() as run:
        train(cfg, Path(run), more_callbacks=[twin])
    framework, bare = (statistics.median(times[WARM_UP:]) for times in (twin.framework, twin.bare))
    ratios = sorted(a / b for a, b in zip(twin.framework[WARM_UP:], twin.bare[WARM_UP:], strict=True))
    found = {
        "framework_seconds": framework, "bare_seconds": bare, "ratio": framework / bare,
        "ratio_quartiles": [ratios[len(ratios) // 4], ratios[3 * len(ratios) // 4]],
        "steps": len(twin.framework) - WARM_UP, "threads": torch.get_num_threads(),
        # a callback that acts now and then counts by its mean: its median would be nothing
        "parts": {name: statistics.mean(times[WARM_UP:]) for name, times in twin.parts.items()},
    }  # fmt: skip
    table = Table(title=f"{found['steps']} steps of each, in turns, {found['threads']} threads", title_justify="left")
    table.add_column("")
    table.add_column("ms", justify="right")
    table.add_column("share of the bare step", justify="right")
    table.add_row("through viinter.train (median)", f"{1e3 * framework:.3f}", f"{framework / bare:.1%}")
    table.add_row("bare PyTorch loop (median)", f"{1e3 * bare:.3f}", "100.0%")
    for name, seconds in found["parts"].items():
        table.add_row(f"  {name} (mean)", f"{1e3 * seconds:.3f}", f"{seconds / bare:.1%}")
    console = Console()
    console.print(table)
    low, high = found["ratio_quartiles"]
    console.print(f"ratio {found['ratio']:.3f} (quartiles of the pairs {low:.3f} to {high:.3f})", highlight=False)
    return found


def alpha(cfg: TrainConfig, folder: Path) -> dict[str, Any]:
    """What a scene with `interpolation.alpha=0` saves: the same training with and without L_inter, each in a process of
    its own; seconds a step, seconds of start-up, peak megabytes, and their differences; printed as a table.

    Where `features.weights` is not given, the tower is filled with random numbers: time and memory are the same.
    """
    found = {}
    with tempfile.TemporaryDirectory() as place:
        for name, weight in (("without", 0.0), ("with", cfg.interpolation.alpha or 1.0)):
            changes = [f"interpolation.alpha={weight}"]
            if weight and cfg.features.weights is None:
                changes.append(f"features.weights={random_tower(cfg.features.model, Path(place))}")
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
                found[name] = process.submit(one_run, config.from_plain(config.plain(cfg), changes)).result()
    rows = {key: (found["without"][key], found["with"][key]) for key in found["with"]}
    table = Table(title=f"{cfg.scene.name}, model={cfg.model.name}: L_inter every {cfg.interpolation.every} steps",
                  title_justify="left")  # fmt: skip
    for column in ("", "without", "with", "saved"):
        table.add_column(column, justify="right" if column else "left")
    for key, (without, with_it) in rows.items():
        table.add_row(key, f"{without:.3f}", f"{with_it:.3f}", f"{with_it - without:.3f}")
    Console().print(table)
    return {key: {"without": a, "with": b, "saved": b - a} for key, (a, b) in rows.items()}


def one_run(cfg: TrainConfig) -> dict[str, float]:
    """Time and memory of one training, to be called in a process of its own: its peak memory is then the run's."""
    watch = StepSeconds()
    with tempfile.TemporaryDirectory() as folder:
        found = train(cfg, Path(folder), more_callbacks=[watch])
    return {
        "seconds a step": statistics.mean(watch.seconds[WARM_UP:]),
        "seconds before the first step": found["seconds"]["start-up"],
        "peak MB": found["peak_memory_mb"],
    }


class StepSeconds(L.Callback):
    """Seconds from the end of a step to that of the next."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self.since = time.perf_counter()

    def on_train_batch_end(self, trainer: L.Trainer, module: ViewInterpolator, *_: Any) -> None:
        now = time.perf_counter()
        self.seconds.append(now - self.since)
        self.since = now


def random_tower(model: str, folder: Path) -> Path:
    """A file of weights for the image half of the CLIP architecture `model`, all of them random."""
    import open_clip

    file = folder / "random.pt"
    torch.save(open_clip.create_model(model, pretrained=None).visual.state_dict(), file)
    return file


BENCHES = {"step": step, "alpha": alpha}


def presets(what: str, arguments: list[str]) -> list[str]:
    """Settings for a bench of a minute; sizes of the published network's where it is the one that is timed."""
    found = ["logging.pictures=false", "evaluation.max_share=0", "optim.training_seconds=null", "hydra.run.dir=.",
             "hydra.output_subdir=null", f"optim.steps={210 if what == 'step' else 50}"]  # fmt: skip
    if not any(a.startswith("model=") and a != "model=paper" for a in arguments):
        found += ["model.width=128", "model.depth=5"]
    return found


def main() -> None:
    """`python -m viinter.bench WHAT key=value ...`."""
    command.one_of(BENCHES, presets, ABOUT)


if __name__ == "__main__":
    main()
