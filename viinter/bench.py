"""`python -m viinter.bench step | alpha | fast | scaling`: what the framework costs over the same step in a bare loop,
what the interpolation loss costs where a scene wants it, and how `model=fast` stands against the published network.

A step and its bare twin are timed in turns in one process: after every step of the real training, with all its
callbacks, a twin of the model takes one step in plain PyTorch. Whatever the machine does meanwhile, it does to both.
"""

from __future__ import annotations

import itertools
import multiprocessing
import re
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from rich.console import Console
from rich.table import Table

from viinter import command, config, peers, races, scenes
from viinter.config import ConfigError, Layout, TrainConfig
from viinter.data import PixelStore
from viinter.evidence import TARGETS, seconds_to
from viinter.fields.fast import reductions
from viinter.files import write_json
from viinter.module import ViewInterpolator, load
from viinter.train import train

ABOUT = """
Times a training step through viinter.train against the same step in a bare PyTorch loop, in turns in one process, and
says where the time goes. Settings are those of viinter.train.

  python -m viinter.bench step                                       width 128, depth 5, the shipped scene, 200 steps
  python -m viinter.bench step model.width=512 model.depth=8 threads=2
  python -m viinter.bench alpha model=fast                           the same run with and without L_inter and its tower
  python -m viinter.bench fast scene=stanford/knights threads=2      the published network as it is and tuned, half an
                                                                     hour each, and model=fast in parts of that
  python -m viinter.bench scaling scene=stanford/knights threads=2   model=fast over numbers and sizes of views
  python -m viinter.bench fast ... hydra.run.dir=DIR                 goes on with one that was interrupted
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
        self.twin.field.see(self.store.views, self.twin.codes.weight)
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


def typed() -> list[str]:
    """The command line's settings, without those that a race sets itself."""
    own = ("model=", "optim.training_seconds=", "hydra.", "scene.root=", "scene.downsample=")
    return [o for o in HydraConfig.get().overrides.task if not o.startswith(own)]


def shown(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Prints a table; its first column is text, the others numbers."""
    table = Table(title=title, title_justify="left")
    for k, column in enumerate(columns):
        table.add_column(column, justify="right" if k else "left")
    for row in rows:
        table.add_row(*row)
    # in a file nothing need be wrapped
    (Console() if sys.stdout.isatty() else Console(width=160)).print(table)


def reached(value: float | None, digits: int = 1) -> str:
    return "not reached" if value is None else f"{value:.{digits}f}"


def fast(cfg: TrainConfig, folder: Path) -> dict[str, Any]:
    """`races.methods` on one scene and seed, one after another, beside what needs no training; printed as tables, and
    kept in `bench.json`. `optim.training_seconds` is the time of the published network. Raises ConfigError if the scene
    has no probes."""
    scene = scenes.load(cfg.scene)
    if not scene.probes["novel"]:
        raise ConfigError(f"scene.root={cfg.scene.root}: expected a scene with probes; {' '.join(scene.notes)}")
    where = [f"scene.root={cfg.scene.root}", f"scene.downsample={cfg.scene.downsample}"]
    asked = [*typed(), *where, "evaluation.first_seconds=1"]
    found = {}
    for name, own in races.methods(cfg.optim.training_seconds).items():
        Console().rule(name)
        found[name] = races.train(folder / re.sub(r"\W+", "_", name), own, asked)
    probed = [kind for kind in ("novel", "novel_posed") if scene.probes.get(kind)]
    rows = [
        [name, f"{r.metrics['steps']}", f"{r.metrics['training_seconds']:.1f}", f"{r.value('known', 'psnr'):.2f}",
         *(f"{r.value(kind, 'psnr'):.2f}" for kind in probed), *(reached(seconds_to(r, target)) for target in TARGETS)]
        for name, r in found.items()
    ]  # fmt: skip
    with Console().status("cross-fade and optical flow at the probes"):
        untrained = {k: f["psnr"] for k, f in peers.measure(scene).items() if not isinstance(f, str)}
    rows += [[f"{name}, no training", "", "", "", f"{psnr:.2f}", *("" for _ in [*probed[1:], *TARGETS])]
             for name, psnr in untrained.items()]  # fmt: skip
    columns = ["", "steps", "training s", "known", *probed, *(f"s to {target} dB" for target in TARGETS)]
    threads = cfg.threads or torch.get_num_threads()
    shown(f"{scene.name}, {scene.width} x {scene.height}, {threads} threads", columns, rows)
    for name, r in found.items():
        keys = ("training_seconds", "known_psnr", "novel_psnr")
        shown(f"{name}: PSNR along the way", list(keys), [[reached(row[k]) for k in keys] for row in r.rows])
    ends = {name: r.value("novel", "psnr") for name, r in found.items()}
    published, tuned, *parts = ends
    for slow, part in ((published, parts[0]), (tuned, parts[1])):
        verb = "reaches" if ends[part] >= ends[slow] else "does not reach"
        Console().print(f"{part}: {ends[part]:.2f} dB, {verb} {slow}: {ends[slow]:.2f} dB", highlight=False)
    ratios = {
        slow: {part: races.times_as_fast(found[part], found[slow]) for part in parts} for slow in (published, tuned)
    }
    shown("Times as fast to the novel PSNR at the end of (first measurement at or above it)", ["", *ratios],
          [[part, *(reached(of[part]) for of in ratios.values())] for part in parts])  # fmt: skip
    Console().print(f"curves and pictures: python -m viinter.report {folder}", highlight=False, soft_wrap=True)
    result = {"novel": ends, "peers": untrained, "times as fast": ratios}
    write_json(folder / "bench.json", result)
    return result


def scaling(cfg: TrainConfig, folder: Path) -> dict[str, Any]:
    """What `model=fast` costs over the number of known views and over their size, three of each, on a planar scene:
    training seconds to 28 dB at the probes, a step's milliseconds, peak megabytes, and the exponents; and what a step's
    operations and bytes predict for a GPU. Printed as tables, and kept in `bench.json`."""
    if cfg.scene.layout is not Layout.planar:
        raise ConfigError(f"scene.layout={cfg.scene.layout.name}: expected a planar scene, whose grid can be cut down")
    asked = [*typed(), "model=fast", f"optim.training_seconds={cfg.optim.training_seconds:g}",
             "evaluation.first_seconds=0.5", "evaluation.factor=1.15", "evaluation.max_share=2"]  # fmt: skip
    result = {}
    whole, factor = scenes.load(cfg.scene), cfg.scene.downsample
    sizes = {"number of views": {side * side: ([f"scene.downsample={factor}"], side) for side in (3, 4, 5)},
             "pixels of a view": {whole.height * whole.width // by**2: ([f"scene.downsample={factor * by}"], 5)
                                  for by in (4, 2, 1)}}  # fmt: skip
    for what, each in sizes.items():
        measured = {}
        for size, (own, side) in each.items():
            Console().rule(f"{what}: {size}")
            root = races.block(Path(cfg.scene.root), side, folder / f"grid_{side}")
            run = races.train(folder / f"{what.replace(' ', '_')}_{size}", [*own, f"scene.root={root}"], asked)
            measured[size] = races.costs(run, SCALING_TARGET)
        keys = ("seconds", "ms", "MB")
        powers = {key: races.exponent(list(measured), [m[key] for m in measured.values()]) for key in keys}
        rows = [[str(size), *(reached(m[key]) for key in keys)] for size, m in measured.items()]
        rows.append(["exponent", *("" if powers[key] is None else f"{powers[key]:.2f}" for key in keys)])
        shown(f"by {what}", [what, f"s to {SCALING_TARGET} dB", "ms a step", "peak MB"], rows)
        result[what] = {"measured": measured, "exponents": powers}
    field, pixels = load(run.folder).field, run.setting("optim.batch_pixels")
    layers = field.sets * field.layers
    *_, by = reductions(whole.height, whole.width, run.setting("model.texture_pixels"))
    result["a step"] = races.step_work(whole.height / by, whole.width / by, layers, pixels)
    shown(f"One step, {layers} layers, {pixels} pixels", ["", *result["a step"]],
          [["model=fast", *(f"{value:.3g}" for value in result["a step"].values())]])  # fmt: skip
    write_json(folder / "bench.json", result)
    return result


SCALING_TARGET = 28  # dB
BENCHES = {"step": step, "alpha": alpha, "fast": fast, "scaling": scaling}
RACES = {"fast": 1800, "scaling": 60}  # training seconds


def presets(what: str, arguments: list[str]) -> list[str]:
    """Settings for a bench of a minute, sizes of the published network's where it is the one that is timed; for a race
    its time and its folder."""
    if what in RACES:
        return [f"optim.training_seconds={RACES[what]}", "hydra.output_subdir=null",
                f"hydra.run.dir=outputs/bench_{what}/${{now:%Y-%m-%d_%H-%M-%S}}"]  # fmt: skip
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
