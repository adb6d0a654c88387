"""`python -m viinter.stability map | precision | long`: where training stops working, and how far the defaults are
from there; float32 against float64; two hundred thousand steps in a row.

Each writes its numbers, and a report as Markdown and HTML, into `outputs/stability/<scene>/<model>/<what>/`.
"""

from __future__ import annotations

import itertools
import json
import logging
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import matplotlib
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track

from viinter import command, config, memory, metrics, page, scenes, twin
from viinter.callbacks import Budget
from viinter.config import ConfigError, TrainConfig
from viinter.files import write_json
from viinter.guard import DivergenceError
from viinter.module import ViewInterpolator
from viinter.page import Picture, Section, Table
from viinter.train import train

matplotlib.use("Agg")
from matplotlib import pyplot as plt

ABOUT = """
Where training stops working, and how far the defaults are from there. Settings are those of viinter.train; they are the
default that is varied.

  python -m viinter.stability map                 short trainings of the paper's network, one setting changed at a time
  python -m viinter.stability map model=fast      and the stiffest in pairs; called again it goes on where it was
  python -m viinter.stability precision           values and gradients against float64, eager against compiled
  python -m viinter.stability long                200,000 cheap steps: norms, schedule, clock and memory must not drift
"""

Changes = dict[str, str]  # name of an axis -> its value, for those that are not at their default
CLOSE = 3.0  # dB below the default that still count as working


@dataclass(frozen=True)
class Axis:
    """One thing to vary: the values of `name`, the default's among them, and the settings that a value stands for."""

    name: str
    default: str
    values: Sequence[str]
    settings: Callable[[str], dict[str, Any]]


def axes(cfg: TrainConfig) -> list[Axis]:
    """What is varied for the model of `cfg`."""

    def one(name: str, key: str, default: Any, *others: Any) -> Axis:
        values = sorted({default, *others}) if not isinstance(default, str) else [default, *others]
        return Axis(name, str(default), [str(v) for v in values], lambda value: {key: value})

    found = [
        Axis("rate x", "1", ["1", "3", "10", "30", "100"], lambda x: {"optim.lr": cfg.optim.lr * float(x)}),
        one("code radius", "codes.radius", cfg.codes.radius, 1e-3, 1e3),
        Axis("p", cfg.codes.p, ["none", "1", "1.5", "2", "20", "inf"], lambda p: {"codes.p": p}),
        one("precision", "trainer.precision", "32-true", "bf16-true", "bf16-mixed"),
    ]
    if isinstance(cfg.model, config.PaperModel):
        found += [
            Axis("sine frequency", f"{cfg.model.first_omega:g}", ["1", "30", "100", "300"],
                 lambda omega: {"model.first_omega": omega, "model.hidden_omega": omega}),
            one("width", "model.width", cfg.model.width, cfg.model.width // 4, cfg.model.width * 4),
            one("depth", "model.depth", cfg.model.depth, 2, 8, 16),
        ]  # fmt: skip
    else:
        found += [
            one("sharpness", "model.sharpness", cfg.model.sharpness, 0.5, 50.0, 500.0),
            one("layers (width)", "model.layers", cfg.model.layers, 1, 2, 16),
            one("motion (depth)", "model.motion", cfg.model.motion, 1, 3),
        ]
    return found


def pairs(cfg: TrainConfig) -> list[tuple[str, str]]:
    """The stiffest axes, that are varied two at a time."""
    steep = "sine frequency" if isinstance(cfg.model, config.PaperModel) else "sharpness"
    return [("rate x", steep), ("rate x", "code radius"), ("p", "code radius")]


def key(changes: Changes) -> str:
    return ", ".join(f"{name} {value}" for name, value in changes.items()) or "default"


def plan(cfg: TrainConfig) -> dict[str, Changes]:
    """All runs of the map, each once: the default, one axis at a time, and the pairs."""
    known = {axis.name: axis for axis in axes(cfg)}
    found: dict[str, Changes] = {}

    def add(*chosen: tuple[Axis, str]) -> None:
        changes = {axis.name: value for axis, value in chosen if value != axis.default}
        found.setdefault(key(changes), changes)

    for axis in known.values():
        for value in axis.values:
            add((axis, value))
    for first, second in pairs(cfg):
        for a, b in itertools.product(known[first].values, known[second].values):
            add((known[first], a), (known[second], b))
    return found


def outcome(cfg: TrainConfig, changes: Changes) -> dict[str, Any]:
    """One short training: `{"ended", "known", "novel", "mse", "restarts", "seconds"}`; `ended` is "finished", or
    "stopped" by the guard, or "refused" by the settings, and the reason is in `why`."""
    settings: dict[str, Any] = {"logging.progress": False}
    for axis in axes(cfg):
        if axis.name in changes:
            settings |= axis.settings(changes[axis.name])
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            changed = config.from_plain(config.plain(cfg), [f"{k}={v}" for k, v in settings.items()])
            found = train(changed, Path(folder))
        except (DivergenceError, ConfigError) as error:
            ended = "stopped" if isinstance(error, DivergenceError) else "refused"
            return {"ended": ended, "why": str(error), "seconds": time.perf_counter() - begin}
    kind = "novel" if found["novel"]["per_view"] else "known"
    return {
        "ended": "finished", "known": found["known"]["psnr"], "novel": found["novel"]["psnr"],
        "mse": found[kind]["mse"], "restarts": found["restarts"], "seconds": time.perf_counter() - begin,
    }  # fmt: skip


def verdict(run: dict[str, Any], default: dict[str, Any], flat: float) -> str:
    """"works" (at most `CLOSE` dB below the default), "worse", or "fails": stopped, or no better than a flat colour."""
    if run["ended"] != "finished":
        return "refused" if run["ended"] == "refused" else "fails"
    if run["mse"] >= flat:
        return "fails"
    return "works" if run["mse"] <= default["mse"] * 10 ** (CLOSE / 10) else "worse"


def flat_error(cfg: TrainConfig) -> float:
    """The mean squared error of one flat picture, the known views' mean colour, at the probes (else the known)."""
    scene = scenes.load(cfg.scene)
    colour = scene.views.mean((0, 1, 2))
    targets = [probe.target for probe in scene.probes["novel"]] or list(scene.views)
    errors = [metrics.compare(colour.expand_as(target), target).mse for target in targets]
    return sum(errors) / len(errors)


def stability_map(cfg: TrainConfig, folder: Path) -> dict[str, Any]:
    """Trains all of `plan`, and writes `map.json` and the report. Runs that `map.json` holds already are
    not repeated; raises ConfigError if they were made with other settings."""
    file, base = folder / "map.json", config.plain(cfg)
    found: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"settings": base, "runs": {}}
    if found["settings"] != base:
        raise ConfigError(f"{file} was made with other settings: give another folder with hydra.run.dir=DIR")
    logging.getLogger("viinter").setLevel(logging.ERROR)  # restarts are counted, not told one by one
    found["flat_mse"] = flat_error(cfg)
    open_runs = {name: changes for name, changes in plan(cfg).items() if name not in found["runs"]}
    for name, changes in track(open_runs.items(), "short trainings", disable=not cfg.logging.progress):
        found["runs"][name] = outcome(cfg, changes)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(file, found)
    for run in found["runs"].values():
        run["verdict"] = verdict(run, found["runs"]["default"], found["flat_mse"])
    write_json(file, found)
    text = f"Where training stops working: {circumstances(cfg)}"
    return finish(folder, text, map_section(cfg, found), found)


def finish(folder: Path, title: str, section: Section, found: dict[str, Any]) -> dict[str, Any]:
    """Writes the page, prints it, and passes `found` on."""
    page.write(folder, title, [section])
    console = Console(soft_wrap=True)
    console.print((folder / "report.md").read_text(), markup=False, highlight=False)
    console.print(f"{folder}: {', '.join(sorted(f.name for f in folder.iterdir()))}", markup=False, highlight=False)
    return found


def circumstances(cfg: TrainConfig) -> str:
    return (f"{cfg.scene.name}, model={cfg.model.name}, seed {cfg.seed}, {torch.get_num_threads()} thread(s), "
            f"PyTorch {torch.__version__}, CPU")  # fmt: skip


def map_section(cfg: TrainConfig, found: dict[str, Any]) -> Section:
    runs, known = found["runs"], {axis.name: axis for axis in axes(cfg)}
    flat = metrics.psnr(found["flat_mse"])

    def at(*chosen: tuple[Axis, str]) -> dict[str, Any]:
        return runs[key({axis.name: value for axis, value in chosen if value != axis.default})]

    def cell(run: dict[str, Any]) -> str:
        if run["ended"] != "finished":
            return run["ended"]
        fails = " fails" if run["verdict"] == "fails" else ""
        return decibel(run["mse"]) + fails + (f", {run['restarts']} restarts" if run["restarts"] else "")

    stopped, refused = (sum(run["ended"] == ended for run in runs.values()) for ended in ("stopped", "refused"))
    restarted = sum(bool(run.get("restarts")) for run in runs.values())
    text = (
        f"{len(runs)} trainings of {cfg.optim.steps} steps of {cfg.optim.batch_pixels} pixels, views reduced "
        f"{cfg.scene.downsample}-fold, {sum(r['seconds'] for r in runs.values()):.0f} s in all. The default has "
        f"`optim.lr={cfg.optim.lr:g}` and comes to {decibel(runs['default']['mse'])} dB at the probes; one flat colour "
        f"has {flat:.1f}. Works: at most {CLOSE:g} dB below the default. Fails: stopped by the guard, or no better "
        f"than the flat colour. {stopped} runs were stopped, {restarted} restarted and finished, {refused} refused by "
        f"the settings' check; all others were finite throughout."
    )
    verdicts = ("works", "worse", "fails", "refused")
    rows = [
        [name, *(", ".join(v for v in axis.values if at((axis, v))["verdict"] == kind) or "-" for kind in verdicts)]
        for name, axis in known.items()
    ]
    items = [
        text, Table("One setting changed at a time", ["setting", *verdicts], rows),
        Picture("PSNR of the mean squared error at the probes in dB", lambda: map_figure(cfg, found)),
    ]  # fmt: skip
    for name, axis in known.items():
        items.append(Table(name, axis.values, [[cell(at((axis, v))) for v in axis.values]]))
    for first, second in pairs(cfg):
        a, b = known[first], known[second]
        rows = [[v, *(cell(at((a, u), (b, v))) for u in a.values)] for v in b.values]
        items.append(Table(f"{first} and {second}", [f"{second} \\ {first}", *a.values], rows))
    return Section("map", "The map", items)


def decibel(mse: float) -> str:
    psnr = metrics.psnr(mse)
    return "exact" if psnr is None else f"{psnr:.1f}"


def map_figure(cfg: TrainConfig, found: dict[str, Any]) -> Figure:
    """One panel an axis and one a pair: the PSNR in each cell, grey where training fails."""
    known = {axis.name: axis for axis in axes(cfg)}
    nothing = Axis("", "", [""], lambda _: {})
    panels = [(axis, nothing) for axis in known.values()] + [(known[a], known[b]) for a, b in pairs(cfg)]
    best = max(metrics.psnr(r["mse"]) for r in found["runs"].values() if r.get("mse"))
    flat = metrics.psnr(found["flat_mse"])
    heights = [1] * len(known) + [len(known[b].values) for _, b in pairs(cfg)]
    figure, frames = plt.subplots(
        len(panels), 1, figsize=(7, 0.45 * sum(heights) + 0.75 * len(heights)), layout="constrained",
        height_ratios=[h + 0.5 for h in heights],
    )  # fmt: skip
    for frame, (a, b) in zip(frames, panels, strict=True):
        for (x, u), (y, v) in itertools.product(enumerate(a.values), enumerate(b.values)):
            run = found["runs"][key({i.name: w for i, w in ((a, u), (b, v)) if w != i.default})]
            shown = metrics.psnr(run["mse"]) if run.get("mse") else None
            share = 0.0 if shown is None else min(max((shown - flat) / (best - flat), 0.0), 1.0)
            fails = run["verdict"] in ("fails", "refused")
            frame.add_patch(plt.Rectangle((x - 0.5, y - 0.5), 1, 1, color="0.75" if fails else plt.cm.viridis(share)))
            text = run["ended"] if shown is None else f"{shown:.1f}" + ("" if not fails else " fails")
            text += f"\n{run['restarts']} restarts" if run.get("restarts") else ""
            frame.text(x, y, text, ha="center", va="center", fontsize=7, color="black" if fails or share > 0.6 else "w")
        frame.set(xlim=(-0.5, len(a.values) - 0.5), ylim=(len(b.values) - 0.5, -0.5), ylabel=b.name)
        frame.set_xticks(range(len(a.values)), a.values, fontsize=7)
        frame.set_yticks(range(len(b.values)), b.values, fontsize=7)
        frame.set_title(a.name, fontsize=8, loc="left", pad=2)
        frame.tick_params(length=0)
    figure.suptitle(circumstances(cfg), fontsize=8)
    return figure


def corners(cfg: TrainConfig) -> dict[str, list[str]]:
    """Stiff settings, at which float32 is held against float64."""
    found = {"default": []} | {f"{k}={v}": [f"{k}={v}"] for k, v in (
        ("codes.radius", 1e-3), ("codes.radius", 1e3), ("codes.p", "none"), ("model.code_dim", 4096))}  # fmt: skip
    if isinstance(cfg.model, config.PaperModel):
        for omega in (1, 100, 300):
            found[f"sine frequency {omega}"] = [f"model.first_omega={omega}", f"model.hidden_omega={omega}"]
        found["published size"] = ["model.width=512", "model.depth=8"]
        found["model.layer_norm=false"] = ["model.layer_norm=false"]
        found["frequency 300, radius 1000"] = [*found["sine frequency 300"], "codes.radius=1000"]
    else:
        found |= {f"{k}={v}": [f"{k}={v}"] for k, v in (("model.sharpness", 500), ("model.layers", 16))}
    return found


def precision(cfg: TrainConfig, folder: Path) -> dict[str, Any]:
    """Relative errors of the field, the projection and L_inter against float64, and of the compiled against the eager
    field; `precision.json` and the report."""
    found: dict[str, Any] = {"field": {}, "projection": {}, "interpolation_loss": {}, "compiled": None}
    for name, changes in track(corners(cfg).items(), "float64 twins", disable=not cfg.logging.progress):
        found["field"][name] = twin.field_errors(config.from_plain(config.plain(cfg), changes))
    scales = ((1.0, 1.0), (1e-3, 1e3), (1e3, 1e-3))
    for p, (radius, scale) in itertools.product((1.0, 1.5, 2.0, 20.0, math.inf), scales):
        name = f"p={p:g}, codes of {scale:g} to radius {radius:g}"
        found["projection"][name] = twin.projection_errors(p, radius, scale)
    for scale in (1e-3, 1.0, 1e3):
        found["interpolation_loss"][f"features of {scale:g}"] = twin.interpolation_loss_errors(scale)
    if twin.compiler():
        found["compiled"] = twin.compiled_errors(cfg)
    write_json(folder / "precision.json", found)

    def rows(part: dict[str, dict]) -> list[list[str]]:
        return [[name, *(f"{e:.1e}" for e in errors.values())] for name, errors in part.items()]

    kinds = ("value", "loss", "gradient")
    side_by_side = {
        name: {f"{precision}: {kind}": errors[precision][kind] for precision in errors for kind in kinds}
        for name, errors in found["field"].items()
    }
    items = [Table("The field and its training step", ["setting", *side_by_side["default"]], rows(side_by_side))]
    for part in ("projection", "interpolation_loss"):
        items.append(Table(part.replace("_", " "), ["case", "value", "gradient"], rows(found[part])))
    if found["compiled"]:
        compiled = rows({"default": found["compiled"]})
        items.append(Table("Compiled against eager, float32", ["setting", *kinds], compiled))
    else:
        items.append("**Compiled against eager: not compared.** `torch.compile` wants a C++ compiler; there is none.")
    title = f"Relative errors against float64: {circumstances(cfg)}"
    return finish(folder, title, Section("precision", "Relative errors", items), found)


class Odometer(L.Callback):
    """Notes, two hundred times in a run, what must not drift."""

    def __init__(self, cfg: TrainConfig) -> None:
        self.cfg, self.every = cfg, max(1, cfg.optim.steps // 200)
        self.rows: list[dict[str, float]] = []

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self.clock = next(c for c in trainer.callbacks if isinstance(c, Budget)).clock
        # both from here: the training clock has been running for a moment
        self.begin = time.perf_counter() - self.clock.seconds

    def on_train_batch_end(self, trainer: L.Trainer, module: ViewInterpolator, *_: Any) -> None:
        step = trainer.global_step
        if step % self.every:
            return
        optim, done = self.cfg.optim, (step - 1) / self.cfg.optim.steps
        rate = optim.lr * (optim.lr_decay + (1 - optim.lr_decay) * (1 + math.cos(math.pi * done)) / 2)
        radius, norms = self.cfg.codes.radius, module.codes.norms()
        seconds = self.clock.seconds
        self.rows.append({
            "step": step, "training_seconds": seconds, "stopwatch_seconds": time.perf_counter() - self.begin,
            "peak_memory_mb": memory.peak_mb(),
            "norm_error": (norms / radius - 1).abs().max().item(),
            "rate_error": abs(trainer.optimizers[0].param_groups[0]["lr"] / rate - 1),
        })  # fmt: skip


def long(cfg: TrainConfig, folder: Path) -> dict[str, Any]:
    """Many cheap steps; `long.json` and the report. Returns `{"checks": {what: (number, bound)}, "rows"}`.

    Held are: the number of steps; the codes' norms and the schedule against their formulas at every note; the training
    clock, which must not run ahead of a stop-watch nor change its share of it between the first and the last tenth of
    the run; and the memory that the last nine tenths add.
    """
    watch = Odometer(cfg)
    with tempfile.TemporaryDirectory() as run:
        metrics_found = train(cfg, Path(run), more_callbacks=[watch])
    rows, tenth = watch.rows, max(1, len(watch.rows) // 10)

    def share(part: list[dict[str, float]]) -> float:
        return (part[-1]["training_seconds"] - part[0]["training_seconds"]) / (
            part[-1]["stopwatch_seconds"] - part[0]["stopwatch_seconds"]
        )

    checks = {
        "steps not taken": (cfg.optim.steps - metrics_found["steps"], 0),
        "restarts": (metrics_found["restarts"], 0),
        "largest relative error of a code's norm": (max(r["norm_error"] for r in rows), 1e-6),
        "largest relative error of the rate": (max(r["rate_error"] for r in rows), 1e-9),
        "seconds that the clock runs ahead of a stop-watch":
            (max(r["training_seconds"] - r["stopwatch_seconds"] for r in rows), 0.01),
        "change of the clock's share of the stop-watch":
            (abs(share(rows[-tenth - 1 :]) - share(rows[: tenth + 1])), 0.1),
        "MB that the last nine tenths add": (rows[-1]["peak_memory_mb"] - rows[tenth - 1]["peak_memory_mb"], 16.0),
    }  # fmt: skip
    text = f"{metrics_found['training_seconds']:.0f} training seconds, {metrics_found['wall_seconds']:.0f} wall."
    held = [[what, f"{value:.3g}", f"{bound:g}", "held" if value <= bound else "**not held**"]
            for what, (value, bound) in checks.items()]  # fmt: skip
    section = Section("long", "What must not drift", [
        text, Table("Held", ["", "found", "at most", ""], held), Picture("Over the run", lambda: long_figure(rows)),
    ])  # fmt: skip
    write_json(folder / "long.json", {"checks": checks, "rows": rows})
    return finish(folder, f"{cfg.optim.steps} steps: {circumstances(cfg)}", section, {"checks": checks, "rows": rows})


def long_figure(rows: list[dict[str, float]]) -> Figure:
    figure, frames = plt.subplots(2, 2, figsize=(8, 5), layout="constrained", sharex=True)
    shown = {"norm_error": "relative error of a code's norm", "rate_error": "relative error of the rate",
             "training_seconds": "training seconds", "peak_memory_mb": "peak memory, MB"}  # fmt: skip
    for frame, (name, title) in zip(frames.flat, shown.items(), strict=True):
        frame.plot([r["step"] for r in rows], [r[name] for r in rows])
        frame.set_title(title, fontsize=9)
        frame.set_xlabel("step")
    return figure


REPORTS = {"map": stability_map, "precision": precision, "long": long}
QUIET = ["trainer.accelerator=cpu", "logging.pictures=false", "evaluation.max_share=0", "optim.training_seconds=null"]


def presets(what: str, arguments: list[str]) -> list[str]:
    """The settings that a report varies, smaller than those of a training: a run of a second or two."""
    model = next((a.partition("=")[2] for a in arguments if a.startswith("model=")), "paper")
    found = [*QUIET, f"hydra.run.dir=outputs/stability/${{hydra:runtime.choices.scene}}/{model}/{what}",
             "hydra.output_subdir=null"]  # fmt: skip
    if what == "map":
        found += ["threads=1"]
        sizes = {"paper": ["scene.downsample=8", "optim.steps=200", "optim.batch_pixels=1024", "model.width=64",
                           "model.depth=4"],
                 "fast": ["scene.downsample=4", "optim.steps=150", "optim.batch_pixels=2048",
                          "model.layers=4"]}  # fmt: skip
        found += ["scale=cpu", *sizes.get(model, [])]
    elif what == "precision":
        found += ["scale=cpu"]
    else:
        found += ["scene.downsample=16", "optim.steps=200000", "optim.batch_pixels=32", "model.code_dim=8", "threads=1"]
        sizes = {"paper": ["model.width=8", "model.depth=2", "optim.lr=1e-3"], "fast": ["model.layers=2"]}
        found += sizes.get(model, [])
    return found


def main() -> None:
    """`python -m viinter.stability WHAT key=value ...`."""
    command.one_of(REPORTS, presets, ABOUT)


if __name__ == "__main__":
    main()
