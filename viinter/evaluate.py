"""`python -m viinter.evaluate run=DIR`: a finished run measured again, and once more with finetuned codes.

Notation: a probe's code is first the mix of its endpoints' codes; finetuned, it is optimised alone against the probe's
own image while the field stays as it is (paper Table 3): how much of the error is the code's, how much the field's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from rich.console import Console
from rich.progress import Progress
from torch import Tensor, nn

from viinter import command, config, metrics, scenes
from viinter.codes import mix
from viinter.config import ConfigError, EvaluateConfig, TrainConfig
from viinter.data import PixelStore
from viinter.files import write_json
from viinter.metrics import ViewError
from viinter.module import ViewInterpolator, asked, load, run_device
from viinter.optical_flow import measure_registered
from viinter.scenes import Probe, Scene
from viinter.train import about, describe
from viinter.views import draw, measure

UNFINISHED = "evaluation.unfinished.json"  # in the run folder until all is measured: what has been, and as what
GRADIENTS = 4  # times the memory of drawing a pixel, about, that a step of finetuning takes

ABOUT = """
Measures the known views and probes of a finished run: PSNR, SSIM, MSE, for every image and on average; then the probes
with codes finetuned against their own images, the field frozen. With OpenCV also the probes "registered": each picture
is first moved onto the photograph, so that what it shows counts and not where. Writes RUN/evaluation.json.

  python -m viinter.evaluate run=outputs/demo/paper/DATE_TIME
  python -m viinter.evaluate run=... finetune_steps=0                without finetuned codes

The same command goes on with one that was interrupted.
"""


def evaluate(cfg: EvaluateConfig) -> dict[str, Any]:
    """Measures the run folder `cfg.run` and writes `evaluation.json` there.

    What an interrupted call with the same settings has measured is taken from `evaluation.unfinished.json`.

    Returns:
        `known`, `novel`, ... as in `metrics.json`; for the standard probes also `finetuned` and, with OpenCV,
        `registered` (`optical_flow.registered`).

    Raises:
        UserError: no run folder, or the scene's images are not those it was trained on.
        KeyboardInterrupt: after Ctrl-C; its message says what was kept.
    """
    console = Console()
    if cfg.threads:
        torch.set_num_threads(cfg.threads)
    trained = config.read_run(cfg.run, [f"paths.data={cfg.data}"] if cfg.data else [])
    model = load(cfg.run, run_device(cfg.accelerator))
    scene = scenes.load(trained.scene)
    if about(scene) != model.about:
        raise ConfigError(f"{trained.scene.root} no longer holds the known views that {cfg.run} was trained on")
    console.print(describe(scene))
    codes = model.codes.weight.detach()
    note = Path(cfg.run) / UNFINISHED
    held: dict[str, Any] = {"asked": asked(cfg, ["run", "data", "accelerator", "threads"]), "finetuned": {}}
    if note.is_file() and (older := json.loads(note.read_text()))["asked"] == held["asked"]:
        held = older
    probes = scene.probes["novel"] if cfg.finetune_steps else []
    try:
        if "found" not in held:
            held["found"] = measured(model, trained, scene, cfg.chunk_pixels, console)
            write_json(note, held)
        left = [probe for probe in probes if probe.name not in held["finetuned"]]
        for group, found_codes in finetune(model.field, codes, left, cfg, console):
            errors = {}
            for probe, z in zip(group, found_codes, strict=True):
                with as_trained(model, trained):
                    image = draw(model.field, z, scene.height, scene.width, cfg.chunk_pixels)
                errors[probe.name] = asdict(metrics.compare(image, probe.target.to(image.device)))
            held["finetuned"] |= errors
            write_json(note, held)
    except KeyboardInterrupt:
        if "found" not in held:
            raise
        done = f"interrupted with {len(held['finetuned'])} of {len(probes)} codes finetuned"
        raise KeyboardInterrupt(f"{done}; the same command goes on") from None
    found: dict[str, Any] = held["found"]
    if probes:
        found["finetuned"] = metrics.summary({name: ViewError(**e) for name, e in held["finetuned"].items()})
    write_json(Path(cfg.run) / "evaluation.json", found)
    note.unlink()
    for kind, values in found.items():
        if not values["per_view"]:  # the scene has no such probes
            continue
        shown = [f"{values[k]:.{d}f} {unit}" for k, d, unit in (("psnr", 2, "dB"), ("ssim", 4, "SSIM"))
                 if values[k] is not None]  # fmt: skip
        console.print(f"{kind:16} {len(values['per_view']):4} views  {'  '.join(shown)}", highlight=False)
    console.print(f"written: {Path(cfg.run) / 'evaluation.json'}", highlight=False, soft_wrap=True)
    return found


def measured(
    model: ViewInterpolator, trained: TrainConfig, scene: Scene, chunk_pixels: int, console: Console
) -> dict[str, Any]:
    """`views.measure` of all known views and probes, and the standard probes `registered` where there is OpenCV."""
    drawn = {}
    with console.status("measuring every view") as status:

        def seen(kind: str, k: int, image: Tensor, target: Tensor) -> None:
            status.update(f"measuring {kind} {k + 1}")
            if kind == "novel":
                drawn[scene.probes[kind][k].name] = image.cpu(), target.cpu()

        with as_trained(model, trained):
            found: dict[str, Any] = measure(model.field, model.codes.weight.detach(), scene, None, chunk_pixels, seen)
        if drawn:
            status.update("registering the probes")
            registered = measure_registered(drawn)
            if isinstance(registered, str):
                why = f"The probes were not registered: {registered}"
                console.print(why, highlight=False, markup=False, soft_wrap=True)
            else:
                found["registered"] = registered
    return found


def as_trained(model: ViewInterpolator, trained: TrainConfig) -> torch.autocast:
    """The mixed precision that training measured in, for a run that had one."""
    name = trained.trainer.precision
    kind = torch.bfloat16 if name.startswith("bf16") else torch.float16
    return torch.autocast(model.device.type, kind, enabled="16" in name and model.dtype == torch.float32)


def finetune(
    field: nn.Module, codes: Tensor, probes: list[Probe], cfg: EvaluateConfig, console: Console
) -> Iterator[tuple[list[Probe], Tensor]]:
    """The codes that show the targets of `probes` best, found by Adam from their mixes; `field` is not touched.

    A code is not held on the sphere: a mix lies inside it. Its step is measured against the code book's own scale,
    which the norm's order changes by orders of magnitude, and falls to zero along a cosine. Several probes take their
    steps side by side, as many as `cfg.chunk_pixels` allows; none knows of the others.

    Yields:
        n of the probes, until all have been, and their codes [n, M].
    """
    if not probes:  # and no bar for them
        return
    first = cfg.finetune_lr * codes.square().mean().sqrt().item()
    many = max(1, cfg.chunk_pixels // (GRADIENTS * cfg.finetune_pixels))
    groups = [probes[k : k + many] for k in range(0, len(probes), many)]
    with Progress(console=console) as progress:
        task = progress.add_task("finetuning codes", total=len(groups) * cfg.finetune_steps)
        for group in groups:
            z = torch.stack([mix(codes, probe.mix) for probe in group])
            z = z.to(torch.promote_types(z.dtype, torch.float32)).requires_grad_()  # steps are finer than 16 bits
            targets, pixels = torch.stack([probe.target for probe in group]), len(group) * cfg.finetune_pixels
            store = PixelStore(targets, pixels, config.PixelsFrom.all_views, 0, codes.device)
            optimizer = torch.optim.Adam([z], lr=first)
            for step in range(cfg.finetune_steps):
                optimizer.param_groups[0]["lr"] = first * (1 + math.cos(math.pi * step / cfg.finetune_steps)) / 2
                batch = store.batch(step)
                loss = len(group) * F.mse_loss(field(batch.xy, z), batch.rgb)  # the sum of their errors
                (z.grad,) = torch.autograd.grad(loss, [z])
                optimizer.step()
                progress.advance(task)
            yield group, z.detach()


if __name__ == "__main__":
    command.main(EvaluateConfig, "evaluate", lambda cfg, _: evaluate(cfg), ABOUT)
