"""`DivergenceGuard`: a loss or gradient that is not finite never reaches the weights, and training goes on.

Two things happen, on two clocks. At every optimiser step (pixel step or interpolation step) the loss and the norm of
the gradient are looked at where they are, on the device, and a bad step changes neither weights, codes nor Adam's
moments: fused Adam skips a step whose `found_inf` is 1, the way mixed precision has it skip. Nothing waits for the
device there. Every `EVERY` pixel steps the count of bad steps is read: if there were any, the last good state comes
back and the rate is halved; if there were none, the state of now is the good one.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn
from torch.nn.utils import get_total_norm

from viinter.config import UserError
from viinter.module import ViewInterpolator

EVERY = 5  # pixel steps between two readings: what a bad step can cost
MOST = 10  # restarts in one run; the rate is then a thousandth
WORST = 1.0  # pixel loss of a state that is still worth keeping: any picture at all has less, colours being in [0, 1]
SMALLEST_SCALE = 2.0**-20  # of a gradient scaler (16-mixed): below it every gradient overflows

log = logging.getLogger("viinter")


class DivergenceError(UserError):
    """A run that went wrong again and again; its message says what happened and what may help."""


class DivergenceGuard(L.Callback):
    """Keeps bad steps from the weights, brings back the last good state, lowers the rate, and in the end gives up.

    A bad step is one whose loss or gradient is not finite, or whose gradient is so large that its square, which Adam
    keeps, is not. A good state is one with no bad step since the last reading, finite weights and a last pixel loss of
    at most 1. It takes the memory of the weights and of Adam's two moments once more.

    The rate goes back up, twofold at a time, after 5 good steps for a first restart, 20 for a second, 80 for a third.
    It is lowered in the optimiser's `initial_lr`, from which `callbacks.Budget` works out each step's rate.

    After `MOST` restarts the next one raises DivergenceError. `restarts` holds `{"step", "back_to", "rate", "losses",
    "gradients"}` for each: the step at which it was noticed, that of the state brought back, the share of the rate
    from then on, and how many steps had a bad loss or gradient (a gradient of a bad loss counts too). The state of all
    this is in the checkpoint, so that a resumed run restarts where the uninterrupted one would have.
    """

    def __init__(self) -> None:
        self.restarts: list[dict[str, Any]] = []
        self.lowered, self.raise_at = 0, 0
        self.kept: list[tuple[Tensor, dict[str, Tensor]]] = []
        self.kept_step = 0
        self.bad = torch.zeros(2)
        self.loss = self.pixel_loss = torch.zeros(())

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self.bad = self.bad.to(module.device)
        self.loss = self.pixel_loss = torch.zeros((), device=module.device)
        self.scaler = getattr(trainer.precision_plugin, "scaler", None)
        self.kept = [
            (value.to(module.device), {k: v.to(module.device) for k, v in moments.items()})
            for value, moments in self.kept
        ]

    def on_before_backward(self, trainer: L.Trainer, module: ViewInterpolator, loss: Tensor) -> None:
        self.loss = loss.detach()

    def on_before_optimizer_step(
        self, trainer: L.Trainer, module: ViewInterpolator, optimizer: torch.optim.Optimizer
    ) -> None:
        gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        # a gradient scaler skips overflowing steps itself and tries smaller scales: only the loss is left to look at
        norm = self.loss if self.scaler else get_total_norm(gradients)
        bad = ~torch.isfinite(torch.stack([self.loss.float(), norm.float()]))
        self.bad += bad
        if self.scaler:
            gradients[0] += torch.where(bad.any(), math.nan, 0.0)  # it goes by the gradients alone
        else:
            optimizer.found_inf = bad.any().float()

    def on_train_batch_end(self, trainer: L.Trainer, module: ViewInterpolator, outputs: Any, *_: Any) -> None:
        self.pixel_loss = outputs["loss"]

    def on_train_batch_start(self, trainer: L.Trainer, module: ViewInterpolator, *_: Any) -> None:
        if trainer.global_step % EVERY == 0:
            self._look(trainer, module)

    def on_train_end(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        """The last steps are looked at too, and one more batch shows whether the weights they have left can draw."""
        if self.kept:
            batch = trainer.datamodule.store.batch(trainer.global_step)
            with torch.no_grad(), trainer.strategy.precision_plugin.forward_context():
                self.bad[0] += ~torch.isfinite(module(batch.xy, module.codes.weight[batch.view]).float().sum())
            self._look(trainer, module)

    def _look(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        weights = get_total_norm([p.detach() for p in module.parameters()])
        numbers = [self.bad, self.pixel_loss[None], weights[None]]
        losses, gradients, pixel_loss, weights = torch.cat([n.float() for n in numbers]).tolist()
        lost = self.scaler is not None and self.scaler.get_scale() < SMALLEST_SCALE
        wrong = losses + gradients > 0 or not math.isfinite(weights) or lost
        # processes that train together restart and keep together
        if trainer.strategy.reduce_boolean_decision(wrong, all=False):
            self._restart(trainer, module, int(losses), int(gradients))
            return
        if trainer.strategy.reduce_boolean_decision(pixel_loss <= WORST):
            self._keep(trainer.optimizers[0])
            self.kept_step = trainer.global_step
        if self.lowered and trainer.global_step >= self.raise_at:
            self._change_rate(trainer, 1)
            self.raise_at = trainer.global_step + self._patience()

    def _restart(self, trainer: L.Trainer, module: ViewInterpolator, losses: int, gradients: int) -> None:
        step = trainer.global_step
        what = f"not finite at or before step {step}: {losses} losses and {gradients} gradients of the last steps"
        if len(self.restarts) == MOST:
            raise DivergenceError(self._advice(module, what))
        self._bring_back(trainer.optimizers[0])
        self.bad.zero_()
        if self.scaler:
            self.scaler.update(1.0)
        self._change_rate(trainer, -1)
        rate = 0.5**self.lowered
        self.restarts.append(
            {"step": step, "back_to": self.kept_step, "rate": rate, "losses": losses, "gradients": gradients}
        )
        self.raise_at = step + self._patience()
        trainer.logger.experiment.add_scalar("run/restarts", len(self.restarts), step)
        if trainer.is_global_zero:
            log.warning("%s; back to step %d at %g of the rate", what, self.kept_step, rate)

    def _advice(self, module: ViewInterpolator, what: str) -> str:
        cfg = module.cfg
        rates = f"optim.lr={cfg.optim.lr:g}; the last restart had {cfg.optim.lr * 0.5**self.lowered:g}"
        change = [f"lower optim.lr to a thousandth ({cfg.optim.lr / 1000:g})"]
        if cfg.trainer.precision != "32-true":
            change.append(f"train in float32, not trainer.precision={cfg.trainer.precision}")
        if cfg.interpolation.alpha > 0:
            change.append(f"lower interpolation.alpha={cfg.interpolation.alpha:g}")
        return f"training diverged, {what}, after {MOST} restarts ({rates}). What may help: {'; '.join(change)}"

    def _change_rate(self, trainer: L.Trainer, twofold: int) -> None:
        self.lowered -= twofold
        for group in trainer.optimizers[0].param_groups:
            group["initial_lr"] *= 2.0**twofold

    def _patience(self) -> int:
        return EVERY * 4 ** (len(self.restarts) - 1)

    @torch.no_grad()
    def _keep(self, optimizer: torch.optim.Optimizer) -> None:
        """Copies weights and moments, into the memory of the last copy where there is one."""
        if not self.kept:
            self.kept = [(p.detach().clone(), {}) for p in weights_of(optimizer)]
        for p, (value, moments) in zip(weights_of(optimizer), self.kept, strict=True):
            value.copy_(p)
            for key, moment in optimizer.state.get(p, {}).items():
                if key in moments:
                    moments[key].copy_(moment)
                else:
                    moments[key] = moment.clone()

    @torch.no_grad()
    def _bring_back(self, optimizer: torch.optim.Optimizer) -> None:
        for p, (value, moments) in zip(weights_of(optimizer), self.kept, strict=True):
            p.copy_(value)
            if not moments:  # at the time of the copy p had not been trained yet
                optimizer.state.pop(p, None)
            for key, moment in moments.items():
                optimizer.state[p][key].copy_(moment)

    def state_dict(self) -> dict[str, Any]:
        names = ("restarts", "lowered", "raise_at", "kept", "kept_step", "bad")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)


def weights_of(optimizer: torch.optim.Optimizer) -> Iterator[nn.Parameter]:
    """All that `optimizer` trains, in its own order."""
    return (p for group in optimizer.param_groups for p in group["params"])
