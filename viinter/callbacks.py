"""What happens around a pixel step: the budget, the interpolation step, the codes' projection, and what is recorded.

Notation: `n` known views, `M` the length of a code; "training seconds" are those spent in training steps alone.

The order matters, and `train.py` keeps it: `guard.DivergenceGuard` (before the rate is set, and before anything is
made of the last weights), `Budget` (rate before a step, stop after), `InterpolationLoss`, `RenormalizeCodes` (so that
the codes are on the sphere whenever a pixel step reads them), then what only looks: `ErrorClock`, `ViewLogger`,
`ProgressBar`, and last those of `checkpoints.py`.
"""

from __future__ import annotations

import csv
import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor
from torch.utils.checkpoint import checkpoint
from torch.utils.tensorboard import SummaryWriter

from viinter.codes import lerp
from viinter.config import EvaluationConfig, InterpolationConfig, LoggingConfig, OptimConfig, flat, plain
from viinter.features import FeatureTower, interpolation_loss
from viinter.files import whole
from viinter.module import ViewInterpolator
from viinter.scenes import Scene
from viinter.views import STRIP, draw, draw_strip, measure, pixel_grid

HEADROOM = 1.5  # times the seconds that finishing should take are kept back: a machine's pace varies by so much
LAST_SECONDS = 30.0  # that the last measurement may take however short a run was
LOST = 2.0  # times the least error of the known views so far: from there on what was learned is being lost

CSV_COLUMNS = [
    "step", "training_seconds", "wall_seconds", "known_mse", "known_psnr", "known_ssim", "novel_mse", "novel_psnr",
    "novel_ssim", "code_norm_min", "code_norm_max", "lr",
]  # fmt: skip

log = logging.getLogger("viinter")


class Clock:
    """Training seconds: runs between `start` and `stop`, stands still inside `paused()`.

    Reading it costs no synchronisation; a pause waits for the device first, so that queued training work is counted
    as training and not as whatever comes next.
    """

    def __init__(self) -> None:
        self.before, self.since, self.born = 0.0, None, time.perf_counter()
        self.wall_before = 0.0

    @property
    def seconds(self) -> float:
        return self.before + (time.perf_counter() - self.since if self.since is not None else 0.0)

    @property
    def wall_seconds(self) -> float:
        return self.wall_before + time.perf_counter() - self.born

    def start(self) -> None:
        self.since = time.perf_counter()

    def stop(self) -> None:
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        self.before, self.since = self.seconds, None

    @contextmanager
    def paused(self) -> Iterator[None]:
        running = self.since is not None
        if running:
            self.stop()
        try:
            yield
        finally:
            if running:
                self.start()

    def state_dict(self) -> dict[str, float]:
        return {"training_seconds": self.seconds, "wall_seconds": self.wall_seconds}

    def load_state_dict(self, state: dict[str, float]) -> None:
        self.before = state["training_seconds"]
        self.wall_before, self.born = state["wall_seconds"], time.perf_counter()


def agreed(trainer: L.Trainer, value: Any) -> Any:
    """The first process's `value`: clocks differ between processes that train together, and what they do must not."""
    return trainer.strategy.broadcast(value) if trainer.world_size > 1 else value


@contextmanager
def looking(trainer: L.Trainer, module: ViewInterpolator) -> Iterator[None]:
    """Evaluation mode, in the precision that the run trains in; then training mode again."""
    module.eval()
    with trainer.strategy.precision_plugin.forward_context():
        yield
    module.train()


class Budget(L.Callback):
    """Ends the run after so many steps or training seconds, and lays the cosine schedule over whichever is given.

    The rate goes from `lr` to `lr * lr_decay` (supplement: 1e-5 to 1e-6) and stays there past the end. The
    field is told where the budget stands before each step, and settles and finishes on the clock: see
    `fields.field.Field`. `HEADROOM` times the seconds that finishing will take are kept back from the steps, but half
    of the training seconds at most; the schedule is laid over those from the first step to there. A step that would end
    beyond them, if it took as long as the one before, is not begun. Training seconds that are more than the field has a
    use for are left over.
    """

    def __init__(self, cfg: OptimConfig, clock: Clock) -> None:
        self.cfg, self.clock, self.begun, self.kept_back, self.enough = cfg, clock, 0.0, 0.0, math.inf
        self.ended: float | None = None  # the last step since training began or went on, in training seconds

    def used(self, trainer: L.Trainer, ahead: float = 0.0) -> float:
        """The share of the budget that is used, or will be `ahead` seconds from now; above 1 beyond its end."""
        if (seconds := self.cfg.training_seconds) is None:
            return trainer.global_step / self.cfg.steps
        stepping = seconds - min(self.kept_back, seconds / 2) - self.begun
        used = (self.clock.seconds + ahead - self.begun) / stepping if stepping > 0 else 1.0
        return max(used, trainer.global_step / self.enough)

    def progress(self, trainer: L.Trainer) -> float:
        """The share of the budget that is used, in [0, 1]."""
        return min(self.used(trainer), 1.0)

    def factor(self, progress: float) -> float:
        """The rate at `progress`, as a share of the first."""
        return self.cfg.lr_decay + (1 - self.cfg.lr_decay) * (1 + math.cos(math.pi * progress)) / 2

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self.clock.start()
        store = trainer.datamodule.store
        module.field.see(store.views, module.codes.weight)
        batch = self.cfg.batch_pixels / (store.height * store.width)
        self.enough = module.field.enough(store.n / batch)
        if (seconds := self.cfg.training_seconds) is not None and not trainer.global_step:
            self.kept_back = HEADROOM * module.field.settle(
                seconds, store.n, batch, lambda: agreed(trainer, seconds_to_draw(module, store.height, store.width))
            )
            self.begun = self.clock.seconds
        trainer.should_stop = agreed(trainer, self.progress(trainer)) >= 1

    def on_train_batch_start(self, trainer: L.Trainer, module: ViewInterpolator, batch: Any, batch_idx: int) -> None:
        progress = agreed(trainer, self.progress(trainer))
        module.field.at(progress, trainer.global_step)
        factor = self.factor(progress)
        for group, rate in zip(trainer.optimizers[0].param_groups, module.field.rates(), strict=True):
            group["lr"] = group["initial_lr"] * factor * rate

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        before, self.ended = self.ended, self.clock.seconds
        step = 0.0 if before is None else self.ended - before  # the first takes longer than those after it
        if agreed(trainer, self.used(trainer) >= 1 or self.used(trainer, step) > 1):
            trainer.should_stop = True

    def on_train_end(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        store = trainer.datamodule.store
        module.field.finish(store.views, module.codes.weight.detach())
        self.clock.stop()

    def state_dict(self) -> dict[str, float]:
        return {**self.clock.state_dict(), "begun": self.begun, "kept_back": self.kept_back}

    def load_state_dict(self, state: dict[str, float]) -> None:
        self.clock.load_state_dict(state)
        self.begun, self.kept_back = state.get("begun", 0.0), state["kept_back"]


def seconds_to_draw(module: ViewInterpolator, height: int, width: int, chunk_pixels: int = 65_536) -> float:
    """Seconds that drawing one view takes, from drawing one chunk of it twice: the first time has more to do."""
    rows = min(height, max(1, chunk_pixels // width))
    for _ in range(2):
        begin = time.perf_counter()
        draw(module.field, module.codes.weight[0].detach(), rows, width, chunk_pixels).sum().item()
        took = time.perf_counter() - begin
    return took * height / rows


class InterpolationLoss(L.Callback):
    """The interpolation step (paper Section 3.4): every `every`-th step, a whole frame from a mix of two codes.

    Random known views i and j and t in [0, 1]; the frame drawn from `(1 - t) z_i + t z_j` is held against the same
    mix of the two views' features. It is an optimiser step of its own, as in the published code (the paper adds the
    two losses), and does not count in `global_step`. The frame is drawn in chunks whose activations are worked out
    again in the backward pass, so that memory follows `chunk_pixels`.

    Args:
        cfg: weight, interval, chunk.
        tower: the frozen feature extractor.
        features: of the known views, [n, D], extracted once.
        size: (height, width) of the frame that the tower sees.
        seed: draws i, j and t of a step from `seed` and the step alone.
    """

    def __init__(
        self, cfg: InterpolationConfig, tower: FeatureTower, features: Tensor, size: tuple[int, int], seed: int
    ) -> None:
        self.cfg, self.tower, self.features, self.size, self.seed = cfg, tower, features, size, seed
        self.last: Tensor | None = None
        self.random = torch.Generator()

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self.features = self.features.to(module.device)
        self.tower.to(module.device)

    def on_train_batch_end(self, trainer: L.Trainer, module: ViewInterpolator, *_: Any) -> None:
        step = trainer.global_step - 1
        if step % self.cfg.every:
            return
        self.random.manual_seed((self.seed * 0x9E3779B1 + step) % 2**32)
        i, j = torch.randint(len(self.features), (2,), generator=self.random).tolist()
        t = torch.rand((), generator=self.random).item()
        optimizer = module.optimizers()

        def closure() -> Tensor:
            optimizer.zero_grad()
            with trainer.strategy.precision_plugin.train_step_context():
                z = lerp(module.codes.weight[i], module.codes.weight[j], t)
                frame = self.frame(module.field, z)
            seen = self.tower(frame)[0]
            loss = self.cfg.alpha * interpolation_loss(seen, self.features[i], self.features[j], t)
            trainer.strategy.backward(loss, None)
            if trainer.world_size > 1:  # all draw the same frame, but for what a GPU leaves to chance
                for p in module.parameters():
                    if p.grad is not None:
                        p.grad = trainer.strategy.reduce(p.grad, reduce_op="mean")
            self.last = loss.detach()
            return loss

        optimizer.step(closure)

    def frame(self, field: torch.nn.Module, z: Tensor) -> Tensor:
        """The frame [1, 3, h, w] float32 under the code `z` [M], with gradients to field and code."""
        h, w = self.size
        chunks = pixel_grid(h, w, z.device).split(self.cfg.chunk_pixels)
        draw_chunk: Callable[[Tensor], Tensor] = lambda xy: field(xy[None], z[None])[0]  # noqa: E731
        if len(chunks) == 1:
            rgb = draw_chunk(chunks[0])
        else:
            rgb = torch.cat([checkpoint(draw_chunk, xy, use_reentrant=False) for xy in chunks])
        return rgb.float().reshape(1, h, w, 3).permute(0, 3, 1, 2)


class RenormalizeCodes(L.Callback):
    """Puts the codes on the p-norm sphere after every optimiser step (paper Section 3.3, Equation 5), and at the start.

    At the start of a resumed run codes that are on the sphere are left as they are, to the last bit.
    """

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        off = (module.codes.norms() / module.codes.radius - 1).abs().max()
        if off > 1e-6:
            module.codes.project_()

    def on_train_batch_end(self, trainer: L.Trainer, module: ViewInterpolator, *_: Any) -> None:
        module.codes.project_()


class ErrorClock(L.Callback):
    """Error against run time: measures known views and standard probes at geometrically spaced training seconds.

    The first measurement comes at `first_seconds`, each next when the training seconds have grown by `factor`, and
    none if all of them together would take more than half of `max_share` of the training seconds. The clock stands
    still meanwhile. Each gives a row of `error_vs_time.csv` and scalars in TensorBoard.

    If the known views then have more than `LOST` times their least error so far, it warns: too high a rate takes a sine
    network back to one flat colour, with every number finite. Errors of one `Field.stage` are compared: another may
    begin anew.

    One comes at the end always. Where a view takes so long to draw that it would take more than is left of
    `max_share`, and more than `LAST_SECONDS`, only one of `every[kind]` views of each kind, evenly spaced, is measured
    then (`viinter.evaluate` measures all of them); so too for the probes beyond the standard ones, and `film_frames`.
    """

    def __init__(self, cfg: EvaluationConfig, scene: Scene, clock: Clock, run_dir: Path) -> None:
        self.cfg, self.scene, self.clock, self.file = cfg, scene, clock, run_dir / "error_vs_time.csv"
        self.rows: list[dict[str, Any]] = []
        self.next, self.spent, self.longest = cfg.first_seconds, 0.0, 0.0
        self.one = 0.0  # seconds for a view
        self.stage: int | None = None
        self.since = 0  # rows of the stages before
        self.final: dict[str, dict] = {}
        self.every: dict[str, int] = {}
        self.listeners: list[Callable[[str, int, Tensor, Tensor], None]] = []

    def on_train_batch_end(self, trainer: L.Trainer, module: ViewInterpolator, *_: Any) -> None:
        now = self.clock.seconds
        if now < self.next or trainer.should_stop:
            return
        if not self.longest:
            self._time_a_view(trainer, module)
            self.longest = self.one * self._views("known", "novel")
        share = self.cfg.max_share / 2
        if self.spent + self.longest >= share * now:
            self.next = (self.spent + self.longest) / share if share else math.inf
            return
        self.evaluate(trainer, module, ["known", "novel"])
        self.next = now * self.cfg.factor

    def on_train_end(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        if self.rows and self.rows[-1]["step"] == trainer.global_step:
            self.rows.pop()
        self._time_a_view(trainer, module)  # not as it was in training: the field has finished since
        standard, others = ["known", "novel"], [kind for kind in self.scene.probes if kind != "novel"]
        left = self.cfg.max_share * self.clock.seconds - self.spent - STRIP * self.one  # a strip is drawn too
        every = self._every(standard, max(left, LAST_SECONDS))
        self.final = self.evaluate(trainer, module, standard, every)
        beyond = self._every(others, self._extra_seconds())
        self.final |= self._measure(trainer, module, others, beyond)
        self.every = dict.fromkeys(standard, every) | dict.fromkeys(others, beyond)

    def film_frames(self, asked: int) -> int:
        """So many of the `asked` frames of a film that drawing them keeps to what a last measurement may take."""
        return max(2, min(asked, int(self._extra_seconds() / max(self.one, 1e-9))))

    def _extra_seconds(self) -> float:
        """What the probes beyond the standard ones may take at the end, and the film once more."""
        return max(self.cfg.max_share / 5 * self.clock.seconds, LAST_SECONDS / 2)

    def _views(self, *kinds: str) -> int:
        return sum(self.scene.n if kind == "known" else len(self.scene.probes[kind]) for kind in kinds)

    def _every(self, kinds: list[str], seconds: float) -> int:
        return max(1, math.ceil(self.one * self._views(*kinds) / seconds))

    def _time_a_view(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        with self.clock.paused(), looking(trainer, module):
            self.one = seconds_to_draw(module, self.scene.height, self.scene.width, self.cfg.chunk_pixels)

    def _measure(
        self, trainer: L.Trainer, module: ViewInterpolator, kinds: list[str], every: int
    ) -> dict[str, dict]:
        if not kinds:
            return {}
        with looking(trainer, module):
            return measure(
                module.field, module.codes.weight.detach(), self.scene, kinds, self.cfg.chunk_pixels, self._seen, every
            )

    def evaluate(
        self, trainer: L.Trainer, module: ViewInterpolator, kinds: list[str], every: int = 1
    ) -> dict[str, dict]:
        """Measures and adds a row, with the clock standing still."""
        with self.clock.paused():
            begin = time.perf_counter()
            training, wall = self.clock.seconds, self.clock.wall_seconds
            found = self._measure(trainer, module, kinds, every)
            norms = module.codes.norms()
            row = {"step": trainer.global_step, "training_seconds": training, "wall_seconds": wall}
            for kind in ("known", "novel"):
                row |= {f"{kind}_{key}": found[kind][key] for key in ("mse", "psnr", "ssim")}
            row |= {"code_norm_min": norms.min().item(), "code_norm_max": norms.max().item()}
            row["lr"] = trainer.optimizers[0].param_groups[0]["lr"]
            stage = module.field.stage()
            if self.stage not in (None, stage):
                self.since = len(self.rows)
            self.stage = stage
            self.rows.append(row)
            self._write(trainer.logger.experiment, row)
            self._warn_of_loss(trainer)
            took = time.perf_counter() - begin
            self.spent, self.longest = self.spent + took, max(self.longest, took)
        return found

    def _warn_of_loss(self, trainer: L.Trainer) -> None:
        *before, now = self.rows[self.since :]
        if before and trainer.is_global_zero:
            best = min(before, key=lambda row: row["known_mse"])
            if before[-1]["known_mse"] <= LOST * best["known_mse"] < now["known_mse"]:
                log.warning(
                    "the known views had %.1f dB at step %d and have %.1f at step %d: what was learned is being lost; "
                    "a lower optim.lr (now %g) may help",
                    best["known_psnr"] or math.inf, best["step"], now["known_psnr"], now["step"], now["lr"],
                )  # fmt: skip

    def _seen(self, kind: str, index: int, image: Tensor, target: Tensor) -> None:
        for listener in self.listeners:
            listener(kind, index, image, target)

    def _write(self, board: SummaryWriter, row: dict[str, Any]) -> None:
        with whole(self.file) as part, part.open("w", newline="") as out:
            table = csv.DictWriter(out, CSV_COLUMNS)
            table.writeheader()
            table.writerows(self.rows)
        for key, value in row.items():
            if value is not None and key != "step":
                group, _, what = key.partition("_")
                tag = f"{group}/{what}" if group in ("known", "novel") else f"run/{key}"
                board.add_scalar(tag, value, row["step"])

    def state_dict(self) -> dict[str, Any]:
        measured = {"rows": self.rows, "stage": self.stage, "since": self.since}
        return {**measured, "next": self.next, "spent": self.spent, "longest": self.longest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.rows, self.next = state["rows"], state["next"]
        self.spent, self.longest = state["spent"], state["longest"]
        self.stage, self.since = state.get("stage"), state.get("since", 0)


class ViewLogger(L.Callback):
    """Pictures in TensorBoard: a known view and a probe beside their targets, and a strip of an interpolation.

    It takes the pictures that `ErrorClock` draws anyway, and keeps the last `strip`; the scalars of single steps
    (loss, PSNR of the batch, L_inter, rate, norms) go out every `every_seconds`, so that no step waits for them.
    """

    def __init__(self, cfg: LoggingConfig, scene: Scene, clock: Clock, errors: ErrorClock, chunk_pixels: int) -> None:
        self.cfg, self.scene, self.clock, self.chunk_pixels = cfg, scene, clock, chunk_pixels
        self.next = 0.0
        self.kept: dict[str, Tensor] = {}
        self.strip: Tensor | None = None
        self.measured = 0
        self.errors = errors
        self.interpolation: InterpolationLoss | None = None
        if cfg.pictures:
            errors.listeners.append(self._keep)

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self.interpolation = next((c for c in trainer.callbacks if isinstance(c, InterpolationLoss)), None)
        self.measured = len(self.errors.rows)

    def _keep(self, kind: str, index: int, image: Tensor, target: Tensor) -> None:
        if index == 0:
            self.kept[kind] = torch.cat([image.clamp(0, 1), target], 1)

    def on_train_batch_end(self, trainer: L.Trainer, module: ViewInterpolator, outputs: Any, *_: Any) -> None:
        if self.clock.seconds >= self.next:
            with self.clock.paused():
                self._scalars(trainer, module, outputs["loss"].item())
            self.next = self.clock.seconds + self.cfg.every_seconds
        if len(self.errors.rows) > self.measured:
            self.measured = len(self.errors.rows)
            with self.clock.paused():
                self._pictures(trainer, module)

    def on_train_end(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self._pictures(trainer, module)
        final = {
            f"final/{kind}_{key}": self.errors.final[kind][key]
            for kind in ("known", "novel") for key in ("psnr", "ssim") if self.errors.final[kind][key] is not None
        }  # fmt: skip
        trainer.logger.log_hyperparams({k: _shown(v) for k, v in flat(plain(module.cfg)).items()}, final)

    def _scalars(self, trainer: L.Trainer, module: ViewInterpolator, loss: float) -> None:
        board, step = trainer.logger.experiment, trainer.global_step
        board.add_scalar("train/loss", loss, step)
        if loss > 0:
            board.add_scalar("train/psnr", -10 * math.log10(loss), step)
        if self.interpolation and self.interpolation.last is not None:
            board.add_scalar("train/interpolation_loss", self.interpolation.last.item(), step)
        board.add_scalar("run/lr", trainer.optimizers[0].param_groups[0]["lr"], step)
        norms = module.codes.norms()
        board.add_scalar("run/code_norm_min", norms.min().item(), step)
        board.add_scalar("run/code_norm_max", norms.max().item(), step)

    def _pictures(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        if not self.cfg.pictures:
            return
        begin = time.perf_counter()
        board, step = trainer.logger.experiment, trainer.global_step
        for kind, pair in self.kept.items():
            board.add_image(f"views/{kind}_and_target", pair, step, dataformats="HWC")
        with looking(trainer, module):
            self.strip = draw_strip(module.field, module.codes.weight.detach(), self.scene, self.chunk_pixels)
        board.add_image("views/interpolation", self.strip, step, dataformats="HWC")
        board.flush()
        self.errors.spent += time.perf_counter() - begin


def _shown(value: Any) -> bool | int | float | str:
    """A value as TensorBoard's HPARAMS tab takes it."""
    return value if isinstance(value, bool | int | float | str) else str(value)


class ProgressBar(L.Callback):
    """A bar with loss, PSNR of the batch, the last PSNR of known views and probes, and the time left.

    It is refreshed twice a second and reads the loss only then: a step waits for nothing.
    """

    def __init__(self, budget: Budget, clock: Clock, errors: ErrorClock) -> None:
        self.budget, self.clock, self.errors, self.next = budget, clock, errors, 0.0
        self.bar = Progress(
            TextColumn("{task.description}"), BarColumn(20), TextColumn("{task.percentage:3.0f} %"),
            TimeRemainingColumn(compact=True), TextColumn("{task.fields[numbers]}"),
        )  # fmt: skip

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self.bar.start()
        self.task = self.bar.add_task("training", total=1.0, numbers="")
        self.errors.listeners.append(self._evaluating)

    def _evaluating(self, kind: str, index: int, *_: Any) -> None:
        self.bar.update(self.task, description=f"measuring {kind} {index + 1}")

    def on_train_batch_end(self, trainer: L.Trainer, module: ViewInterpolator, outputs: Any, *_: Any) -> None:
        now = time.perf_counter()
        if now >= self.next or trainer.should_stop:
            self.next = now + 0.5
            self._show(trainer, outputs["loss"].item())

    def _show(self, trainer: L.Trainer, loss: float) -> None:
        numbers = f"step {trainer.global_step} loss {loss:.1e}"
        if loss > 0:
            numbers += f" {-10 * math.log10(loss):.1f} dB"
        if self.errors.rows:
            row = self.errors.rows[-1]
            numbers += "".join(f" {k} {row[f'{k}_psnr']:.1f} dB" for k in ("known", "novel") if row[f"{k}_psnr"])
        self.bar.update(self.task, completed=self.budget.progress(trainer), numbers=numbers, description="training")

    def on_train_end(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self.bar.update(self.task, description="training")
        self.bar.stop()

    def on_exception(self, trainer: L.Trainer, module: ViewInterpolator, exception: BaseException) -> None:
        self.bar.stop()
