"""`python -m viinter.train`: from the files of a scene to a run folder, top to bottom.

files -> `scenes.load` -> `SceneData` -> `PixelBatch` -> code -> field -> loss -> optimiser -> `InterpolationLoss` ->
`RenormalizeCodes` -> `ErrorClock` -> `metrics.json`. `DivergenceGuard` watches over every optimiser step.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import sys
import timeit
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.plugins.environments import SLURMEnvironment
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import OmegaConf
from rich.console import Console

from viinter import command, config, features, image, memory, pictures, scenes
from viinter.callbacks import (
    Budget,
    Clock,
    ErrorClock,
    InterpolationLoss,
    ProgressBar,
    RenormalizeCodes,
    ViewLogger,
)
from viinter.checkpoints import Interruption, SaveCheckpoint
from viinter.codes import along, project
from viinter.config import ConfigError, TrainConfig, UserError
from viinter.data import SceneData
from viinter.files import failure_noted, write_json
from viinter.guard import DivergenceError, DivergenceGuard
from viinter.metrics import SSIM_WINDOW
from viinter.module import ViewInterpolator, checkpoint_file, read_checkpoint
from viinter.scenes import Scene
from viinter.step_times import StepTimes

FPS = 30  # of interpolation.mp4

ABOUT = """
Trains one field and one code for each image of a scene, and draws the views between them.

  python -m viinter.train model=fast                                 the shipped scene, two minutes on two cores
  python -m viinter.train model=fast scene=folder scene.root=DIR     your own photographs
  python -m viinter.train scene=stanford/lego model.code_dim=64      the paper's network (a GPU and hours)
  python -m viinter.train -m codes.p=none,inf,2,1.5,1 scale=cpu      a sweep, one run folder for each
  python -m viinter.train resume=RUN_DIR                             goes on with an interrupted run, or sweep
  tensorboard --logdir outputs                                       watch
"""


def train(
    cfg: TrainConfig, run_dir: Path, resume: bool = False, more_callbacks: Sequence[L.Callback] = ()
) -> dict[str, Any]:
    """Trains on a scene and fills the run folder.

    Args:
        cfg: all settings.
        run_dir: where everything is written.
        resume: go on from the last checkpoint in `run_dir`; from the start if it was killed before the first one.
        more_callbacks: run after ours at every hook.

    Returns:
        What `metrics.json` holds: plain numbers, lists and strings. Of several processes the first alone has it.

    Raises:
        UserError: settings, images or weights that cannot be used, and nothing has been trained then; or a full disk,
            and the last checkpoint is whole; `DivergenceError`: the run diverged again and again.
        KeyboardInterrupt: after Ctrl-C or SIGTERM, when the checkpoint has been written; its message says how to go on.
    """
    times = StepTimes()
    config.check(cfg)
    again = f"python -m viinter.train resume={run_dir}"
    if not resume and (run_dir / "checkpoints").exists():
        raise ConfigError(f"{run_dir} holds a run already. Go on with it: {again}")
    console = Console(quiet=not cfg.logging.progress or rank_zero_only.rank != 0)
    if cfg.threads:
        torch.set_num_threads(cfg.threads)
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    # Lightning 2.6 asks torch 2.14's pytree in the old way
    warnings.filterwarnings("ignore", "`isinstance.treespec, LeafSpec.`", FutureWarning)
    L.seed_everything(cfg.seed, verbose=False)

    scene = scenes.load(cfg.scene)
    console.print(describe(scene))
    data = SceneData(scene, cfg.optim.batch_pixels, cfg.optim.pixels_from, cfg.seed)
    module = ViewInterpolator(cfg, scene.n, about(scene))

    start = checkpoint_file(run_dir)
    if start is not None:
        check_checkpoint(start, cfg, scene)
    run_dir.mkdir(parents=True, exist_ok=True)
    clock = Clock()
    budget = Budget(cfg.optim, clock)
    errors = ErrorClock(cfg.evaluation, scene, clock, run_dir)
    guard = DivergenceGuard()
    callbacks: list[L.Callback] = [guard, budget]
    if cfg.interpolation.alpha > 0:
        callbacks.append(interpolation_step(cfg, scene, console))
    callbacks.append(RenormalizeCodes())
    first = rank_zero_only.rank == 0  # of the processes that train together it alone looks and writes
    if first:
        view_logger = ViewLogger(cfg.logging, scene, clock, errors, cfg.evaluation.chunk_pixels)
        callbacks += [errors, view_logger]
        if cfg.logging.progress:
            callbacks.append(ProgressBar(budget, clock, errors))
    checkpoint = SaveCheckpoint(cfg.checkpoint.every_seconds, clock, run_dir)
    callbacks += [Interruption(checkpoint.save, errors), checkpoint, *more_callbacks]

    try:
        trainer = L.Trainer(
            **{**config.plain(cfg.trainer), "strategy": strategy(cfg)},
            max_epochs=-1,
            logger=TensorBoardLogger(run_dir, name="", version="", default_hp_metric=False),
            callbacks=callbacks,
            profiler=times,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
            # ours saves into the run folder, and the launcher puts the job back into the queue
            plugins=[SLURMEnvironment(auto_requeue=False)] if SLURMEnvironment.detect() else None,
        )
    except (ValueError, MisconfigurationException) as error:  # its message names the value and what is accepted
        raise ConfigError(f"trainer.*: {error}") from error
    try:
        trainer.fit(module, data, ckpt_path=start, weights_only=True)
        if not first:
            return {}
        module.to(trainer.strategy.root_device).eval()  # Lightning leaves it on the CPU
        metrics = {**errors.final, "measured_every": errors.every, **facts(cfg, scene, module, trainer, clock)}
        metrics |= {"seconds": times.seconds(), "restarts": len(guard.restarts), "restarted": guard.restarts}
        write_json(run_dir / "metrics.json", metrics)
        (run_dir / "hparams.yaml").unlink(missing_ok=True)  # TensorBoardLogger's; .hydra/config.yaml has them all
        if cfg.logging.pictures:
            show(cfg, scene, module, errors, view_logger.strip, run_dir)
    except SystemExit as ended:
        # not one of ours: submitit's, after it has put the job into the queue. Of several processes the first tells
        if not (first and isinstance(ended.__context__, KeyboardInterrupt)):
            raise
        raise KeyboardInterrupt(f"interrupted at step {trainer.global_step}; go on with: {again}") from None
    except DivergenceError:
        raise
    except (UserError, OSError) as error:
        raise UserError(f"{error}; then go on with: {again}") from error
    if cfg.optim.training_seconds is not None and trainer.global_step >= budget.enough:
        console.print(f"ended before {cfg.optim.training_seconds:g} s: more steps only learn known views by heart")
    console.print(summary(metrics, run_dir), soft_wrap=True)
    return metrics


def strategy(cfg: TrainConfig) -> str:
    """How several devices train together; of the fast field's textures only some are in training at a time."""
    if cfg.model.name == "fast" and cfg.trainer.strategy == "auto" and config.several(cfg.trainer.devices):
        return "ddp_find_unused_parameters_true"
    return cfg.trainer.strategy


def check_checkpoint(file: Path, cfg: TrainConfig, scene: Scene) -> None:
    """Raises ConfigError if the run of the checkpoint `file` had another scene or model."""
    found = read_checkpoint(file)
    if found["about"] != about(scene):
        raise ConfigError(f"{cfg.scene.root} does not hold the known views that {file} was trained on")
    for key, value in config.plain(cfg.model).items():
        was = found["config"]["model"].get(key)
        if value != was:
            raise ConfigError(f"model.{key}={value}: expected {was}, with which {file} was trained")


def train_or_go_on(cfg: TrainConfig, run_dir: Path) -> dict[str, Any]:
    """`train`, in a folder that may hold this very run already, as a job of a sweep that is started again has.

    A finished run stays as it is and its metrics are returned; one with a checkpoint goes on from there.

    Raises:
        UserError: as `train`, and if the folder holds a run with other settings.
    """
    done, begun = run_dir / "metrics.json", checkpoint_file(run_dir)
    if done.is_file():
        metrics = json.loads(done.read_text())
        same_settings(cfg, metrics.get("settings", {}), run_dir)
        return metrics
    if begun:
        same_settings(cfg, read_checkpoint(begun)["config"], run_dir)
    return train(cfg, run_dir, resume=(run_dir / "checkpoints").exists())


def same_settings(cfg: TrainConfig, kept: dict[str, Any], run_dir: Path) -> None:
    """Raises ConfigError, naming a key, if the run in `run_dir`, whose plain settings are `kept`, is another one."""
    mine, theirs = (config.flat(json.loads(json.dumps(values))) for values in (config.plain(cfg), kept))
    if other := [key for key in {**mine, **theirs} if mine.get(key) != theirs.get(key)]:
        key = other[0]
        raise ConfigError(
            f"{run_dir} holds a run with {key}={theirs.get(key)}, not {mine.get(key)}; give hydra.sweep.dir=DIR, a "
            "folder of its own"
        )


def interpolation_step(cfg: TrainConfig, scene: Scene, console: Console) -> InterpolationLoss:
    """Loads the feature tower and extracts the known views' features, once (supplement, Algorithm 1, "Prepare")."""
    tower = features.load(cfg.features, torch.device("cpu"))
    with console.status(f"features of {scene.n} views"):
        embedded = features.embed_views(tower, scene.views)
    size = features.frame_size(scene.height, scene.width)
    return InterpolationLoss(cfg.interpolation, tower, embedded, size, cfg.seed)


def about(scene: Scene) -> dict[str, Any]:
    """What drawing needs to know of the scene without its images; travels in the checkpoint."""
    return {"name": scene.name, "names": scene.names, "height": scene.height, "width": scene.width,
            "endpoints": list(scene.endpoints), "white": scene.white}  # fmt: skip


def describe(scene: Scene) -> str:
    """The scene in a few lines."""
    probes = ", ".join(f"{len(p)} {kind}" for kind, p in scene.probes.items() if p) or "none"
    lines = [f"{scene.name}: {scene.n} known views of {scene.height} x {scene.width}; probes: {probes}"]
    return "\n".join([*lines, *(f"  {note}" for note in scene.notes)])


def omitted(cfg: TrainConfig, scene: Scene, module: ViewInterpolator, steps: int) -> list[dict[str, Any]]:
    """What this scene did not need: `{"part", "reason", "seconds", "megabytes", "how"}`, the last three being what it
    saved over the run, or None where only another run can tell, and how that was or can be measured."""
    found = []

    def left_out(part: str, reason: str, how: str, *saved: float | None) -> None:
        seconds, megabytes = saved or (None, None)
        found.append({"part": part, "reason": reason, "seconds": seconds, "megabytes": megabytes, "how": how})

    if cfg.interpolation.alpha == 0:
        how = "python -m viinter.bench alpha, with the settings of this run"
        left_out("interpolation step and feature tower", "interpolation.alpha is 0", how)
    if cfg.codes.p == "none":
        codes = module.codes.weight.detach()
        seconds = timeit.timeit(lambda: project(codes, 1.0).sum().item(), number=20) / 20
        left_out("code projection", "codes.p is none", "timed on these codes, times the steps", seconds * steps, 0.0)
    if not scene.probes["novel"]:
        left_out("held-out evaluation", "the scene has no probes", "there is no probe to measure it on")
    if min(scene.height, scene.width) < SSIM_WINDOW:
        left_out("SSIM", f"views have a side below its window of {SSIM_WINDOW}", "it cannot be computed")
    left_out("camera poses and grid positions", "training never reads them", "nothing was read or kept", 0.0, 0.0)
    if cfg.trainer.precision == "32-true":
        how = "the same run with trainer.precision=bf16-mixed"
        left_out("mixed precision", "trainer.precision is 32-true", how)
    return found


def facts(cfg: TrainConfig, scene: Scene, module: ViewInterpolator, trainer: L.Trainer, clock: Clock) -> dict[str, Any]:
    """What `metrics.json` says of the run beside the errors: time, memory, what was left out, versions."""
    found = {
        "training_seconds": clock.seconds, "wall_seconds": clock.wall_seconds, "steps": trainer.global_step,
        "peak_memory_mb": memory.peak_mb(), "codes_redrawn": int(module.codes.redrawn),
        "code_length": module.codes.weight.detach().norm(dim=1).mean().item(), "probes_left_out": scene.left_out,
        "omitted": omitted(cfg, scene, module, trainer.global_step), "scene": scene.name, "model": cfg.model.name,
        "seed": cfg.seed, "threads": torch.get_num_threads(), "device": str(module.device),
        "precision": cfg.trainer.precision,
        "versions": {"python": platform.python_version(), "torch": torch.__version__, "lightning": L.__version__},
        "hardware": hardware(module.device), "views": scene.n, "height": scene.height, "width": scene.width,
        "settings": config.plain(cfg),
    }  # fmt: skip
    if module.device.type == "cuda":
        found["peak_device_memory_mb"] = torch.cuda.max_memory_allocated() / 2**20
    return found


def hardware(device: torch.device) -> str:
    """The processor that trained, by name."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    name = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").is_file():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    return f"{name}, {os.cpu_count()} logical processors"


def show(
    cfg: TrainConfig, scene: Scene, module: ViewInterpolator, errors: ErrorClock, strip: torch.Tensor, run_dir: Path
) -> None:
    """`strip.png`, `interpolation.mp4`, `error_vs_time.png`."""
    image.write(run_dir / "strip.png", strip.cpu())
    size, chunk, codes = (scene.height, scene.width), cfg.evaluation.chunk_pixels, module.codes.weight.detach()
    frames = errors.film_frames(cfg.logging.frames)  # a film with fewer of them takes as long to watch
    film = along(codes, scene.tour, frames)
    fps = FPS * frames / cfg.logging.frames
    pictures.write_film(run_dir / "interpolation.mp4", module.field, film, size, chunk, fps)
    pictures.plot_error(run_dir / "error_vs_time.png", errors.rows, f"{scene.name}, model={cfg.model.name}")


def summary(metrics: dict[str, Any], run_dir: Path) -> str:
    """The result in a few lines, with the places to look."""
    lines = []
    for kind, text in (("known", "known views"), ("novel", "probes"), ("novel_posed", "posed probes")):
        if (found := metrics.get(kind)) and found["per_view"]:
            psnr = "no finite PSNR" if found["psnr"] is None else f"{found['psnr']:.2f} dB"
            ssim = "no SSIM" if found["ssim"] is None else f"SSIM {found['ssim']:.4f}"
            every = metrics["measured_every"][kind]
            some = f"  ({len(found['per_view'])} views, one of {every})" if every > 1 else ""
            lines.append(f"{text:12} {psnr}  {ssim}{some}")
    if max(metrics["measured_every"].values()) > 1:
        lines.append(f"views take long to draw here; to measure them all: python -m viinter.evaluate run={run_dir}")
    lines.append(f"{metrics['steps']} steps in {metrics['training_seconds']:.1f} training seconds"
                 f" ({metrics['wall_seconds']:.1f} wall)")  # fmt: skip
    shown = ("strip.png", "interpolation.mp4", "error_vs_time.png", "metrics.json")
    lines.append(f"{run_dir}: " + ", ".join(name for name in shown if (run_dir / name).exists()))
    return "\n".join(lines)


def main() -> None:
    """The door: a new run or sweep through Hydra, or `resume=DIR` in the folder of an interrupted one."""
    resumed = [a.partition("=")[2] for a in sys.argv[1:] if a.startswith("resume=")]
    if resumed and (sweep := Path(resumed[0]) / "multirun.yaml").is_file():
        typed = OmegaConf.load(sweep).hydra.overrides
        own = [o for o in [*typed.hydra, *typed.task] if not o.startswith(("hydra.mode=", "hydra.sweep.dir="))]
        others = [a for a in sys.argv[1:] if not a.startswith("resume=")]
        sys.argv[1:] = ["-m", *own, f"hydra.sweep.dir={resumed[0]}", *others]
    elif resumed:
        command.prepare()
        others = [a for a in sys.argv[1:] if not a.startswith("resume=")]
        try:
            cfg = config.read_run(resumed[0], others)
            with failure_noted(Path(resumed[0])) if rank_zero_only.rank == 0 else nullcontext():
                train(cfg, Path(resumed[0]), resume=True)
        except UserError as error:
            sys.exit(f"{type(error).__name__}: {error}")
        except KeyboardInterrupt as interrupt:
            sys.exit(str(interrupt) or "interrupted")
        return
    command.main(TrainConfig, "train", train_or_go_on, ABOUT)


if __name__ == "__main__":
    main()
