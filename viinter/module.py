"""The field and the code book of a scene as one LightningModule: the pixel step, the optimiser, the checkpoint.

Notation: `n` known views, `M` the length of a code; rgb in [0, 1].
"""

from __future__ import annotations

import pickle
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch import Tensor

from viinter.codes import CodeBook
from viinter.config import ConfigError, EvaluateConfig, Layout, RenderConfig, TrainConfig, from_plain, norm_order, plain
from viinter.data import PixelBatch
from viinter.fields.charts import WINDOW, ChartedField
from viinter.fields.fast import DEEP, FEW, USUAL, FastField
from viinter.fields.field import Field
from viinter.fields.paper import PaperField
from viinter.replay import ReplayedLoss


def make_field(cfg: TrainConfig, n: int, height: int, width: int) -> Field:
    """The field that a configuration's model (`config.MODELS`) describes, for `n` views of `height` x `width`."""
    settings = {k: v for k, v in plain(cfg.model).items() if k != "name"}
    if cfg.model.name == "paper":
        return PaperField(**settings)
    settings |= {"views": n, "height": height, "width": width}
    window = settings.pop("window") or (WINDOW if cfg.scene.layout is Layout.studio else n)
    by_hand = cfg.scene.layout in (Layout.llff, Layout.folder) and n > FEW and window >= n
    for key, usual in zip(("layers", "sets"), DEEP if by_hand else USUAL, strict=True):
        settings[key] = settings[key] or usual
    return FastField(**settings) if window >= n else ChartedField(window=window, **settings)


class ViewInterpolator(L.LightningModule):
    """F(xy | z) and one code for each of the `n` known views, trained on pixels (`L_recon`, paper Section 3.2).

    The loss is the mean squared error over pixels and channels, as in the published code; the paper writes the sum,
    which is the same up to the learning rate (and Adam does not see it).

    Args:
        cfg: the whole configuration; it travels in the checkpoint as plain values.
        n: number of known views.
        about: plain facts on the scene that drawing needs without the images: names, height, width, endpoints, white.
    """

    def __init__(self, cfg: TrainConfig, n: int, about: dict[str, Any]) -> None:
        super().__init__()
        self.cfg, self.about = cfg, about
        self.field = make_field(cfg, n, about["height"], about["width"])
        self.codes = CodeBook(n, cfg.model.code_dim, norm_order(cfg.codes.p), cfg.codes.radius, cfg.codes.length)
        self.codes.project_()
        self.field.calibrate(self.codes.weight)
        self.replayed: tuple[Any, ReplayedLoss | None] = None, None

    def forward(self, xy: Tensor, z: Tensor) -> Tensor:
        """Colours [V, P, 3] of `xy` [V, P, 2] under codes `z` [V, M]."""
        return self.field(xy, z)

    def on_train_start(self) -> None:
        """Lightning moves the weights between one `fit` and the next, and a graph would go on with the old ones."""
        self.replayed = None, None

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        """The loss of a batch; on one GPU, without mixed precision, a CUDA graph's if the field allows it."""
        stage = self.field.stage() if batch.xy.is_cuda else None
        if stage is None or torch.is_autocast_enabled("cuda") or torch.distributed.is_initialized():
            return self.loss(*batch)
        key = (stage, *(part.shape for part in batch))
        if self.replayed[0] != key:
            self.replayed = None, None  # gives its memory back first
            self.replayed = key, ReplayedLoss(self.loss, list(self.parameters()), batch)
        return self.replayed[1](*batch)

    def loss(self, view: Tensor, xy: Tensor, rgb: Tensor) -> Tensor:
        """The field's loss (`fields.field.Field.loss`) of a `PixelBatch`."""
        return self.field.loss(view, xy, rgb, self.codes.weight)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam over field and codes (supplement); the rate is set before each step by `callbacks.Budget`."""
        groups = self.field.parameter_groups(self.codes.weight)
        for group in groups:
            group["initial_lr"] = self.cfg.optim.lr * group.pop("share")
        return torch.optim.Adam(groups, lr=self.cfg.optim.lr, betas=(0.9, self.cfg.optim.beta2), fused=True)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["config"], checkpoint["about"] = plain(self.cfg), self.about


def checkpoint_file(run: str | Path) -> Path | None:
    """The newest checkpoint of the run folder `run`; None if there is none.

    That is `checkpoints/last.ckpt`, and `previous.ckpt` if a run was killed just between renaming the one and the
    other (`checkpoints.SaveCheckpoint`).
    """
    files = [Path(run) / "checkpoints" / name for name in ("last.ckpt", "previous.ckpt")]
    return next((file for file in files if file.is_file()), None)


def asked(cfg: RenderConfig | EvaluateConfig, apart: Sequence[str]) -> dict[str, Any]:
    """What decides the outcome of a command on the finished run `cfg.run`: its settings but those in `apart`, and
    which checkpoint it is."""
    settings = {key: value for key, value in plain(cfg).items() if key not in apart}
    return settings | {"checkpoint": checkpoint_file(cfg.run).stat().st_mtime_ns}


def read_checkpoint(file: Path) -> dict[str, Any]:
    """What the checkpoint `file` holds, on the CPU: plain values and tensors only (`weights_only=True`).

    Raises ConfigError for a file that is damaged or none of ours, and says how to go on from the older one.
    """
    try:
        found = torch.load(file, map_location="cpu", weights_only=True)
        if isinstance(found, dict) and {"config", "about", "state_dict", "global_step"} <= set(found):
            return found
        reason = "another program's"
    except pickle.UnpicklingError:  # PyTorch's own words advise to run what the file holds
        reason = "it holds something other than plain values and tensors"
    except (OSError, EOFError, RuntimeError, ValueError, TypeError, LookupError, struct.error) as error:
        reason = f"truncated or damaged, {error or type(error).__name__}".partition("\n")[0]
    raise ConfigError(f"{file} is not a whole checkpoint of this version: {reason}.{_older(file)}")


def _older(file: Path) -> str:
    older = file.with_name("previous.ckpt")
    if file == older or not older.is_file():
        return " There is no older one"
    try:
        step = read_checkpoint(older)["global_step"]
    except ConfigError:
        return f" Neither is {older}"
    return f" The one before it, of step {step}, is whole. To take it: mv {older} {file}"


def load(run: str | Path, device: torch.device | str = "cpu") -> ViewInterpolator:
    """The trained model of the run folder `run`, in evaluation mode on `device`, its weights of the type they had.

    Raises ConfigError if there is no checkpoint or it is not one of ours.
    """
    file = checkpoint_file(run)
    if file is None:
        file = Path(run) / "checkpoints" / "last.ckpt"
        raise ConfigError(f"{run} is no run folder with a checkpoint: there is no {file}")
    checkpoint = read_checkpoint(file)
    try:
        model = ViewInterpolator(
            from_plain(checkpoint["config"]), len(checkpoint["about"]["names"]), checkpoint["about"]
        )
        model.to(checkpoint["state_dict"]["codes.weight"].dtype)  # trainer.precision may be 64-true or bf16-true
        model.load_state_dict(checkpoint["state_dict"])
    except (LookupError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file} is not a checkpoint of this version: {error}") from error
    return model.to(device).eval()


def run_device(accelerator: str) -> torch.device:
    """The device of `auto`, `cpu`, `cuda`, `mps`; raises ConfigError for one that is not here."""
    if accelerator == "auto":
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    here = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if not here.get(accelerator):
        raise ConfigError(f"accelerator={accelerator}: expected auto or one of {[k for k, ok in here.items() if ok]}")
    return torch.device(accelerator)
