"""Keeping what has been trained: checkpoints in time, and signals that ask a run to stop."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import lightning as L

from viinter.callbacks import Clock, ErrorClock, agreed
from viinter.files import whole
from viinter.module import ViewInterpolator


class SaveCheckpoint(L.Callback):
    """`checkpoints/last.ckpt`, every so many wall seconds and at the end; the one before stays as `previous.ckpt`.

    A checkpoint is brought to the disk under another name before it takes its place: at any moment one of the two
    files is there and whole. Raises UserError if it cannot be written; the older ones are then as they were.
    """

    def __init__(self, every_seconds: float, clock: Clock, run_dir: Path) -> None:
        self.every_seconds, self.clock, self.file = every_seconds, clock, run_dir / "checkpoints" / "last.ckpt"
        self.next = time.perf_counter() + every_seconds

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        if agreed(trainer, time.perf_counter() >= self.next) and not trainer.should_stop:
            self.save(trainer)

    def on_train_end(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        self.save(trainer)

    def save(self, trainer: L.Trainer) -> None:
        with self.clock.paused():
            with whole(self.file) if trainer.is_global_zero else nullcontext(self.file) as part:
                trainer.save_checkpoint(part)
                if trainer.is_global_zero:
                    with part.open("rb+") as written:
                        os.fsync(written.fileno())
                    if self.file.exists():
                        os.replace(self.file, self.file.with_name("previous.ckpt"))
            self.next = time.perf_counter() + self.every_seconds


SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
           if hasattr(signal, name)]  # fmt: skip


class Interruption(L.Callback):
    """Ctrl-C, SIGTERM, a closed terminal, and what a cluster sends before it takes the machine away: saves, then lets
    the signal do what it would have done.

    A signal is only noted when it comes, and obeyed at the end of the step or between two views that are measured: in
    the middle of a step weights, moments and codes do not belong together. After the checkpoint the handler that was
    there before is called (submitit's puts the job back into the queue and ends the process); where there was none,
    and after Ctrl-C, KeyboardInterrupt is raised. A second signal does not wait, and does not save. Processes that
    train together stop together, at the end of a step.
    """

    def __init__(self, save: Callable[[L.Trainer], None], errors: ErrorClock) -> None:
        self.save, self.errors = save, errors
        # before Lightning puts its own in their place, which know nothing of our run folder
        self.before = {number: signal.getsignal(number) for number in SIGNALS}
        self.noted: int | None = None

    def on_train_start(self, trainer: L.Trainer, module: ViewInterpolator) -> None:
        if threading.current_thread() is not threading.main_thread():
            return  # signals are the main thread's; Lightning puts the handlers back at the end
        for number, handler in self.before.items():
            if handler is not signal.SIG_IGN:
                signal.signal(number, self.note)
        if trainer.world_size == 1:
            self.errors.listeners.append(lambda *_: self.obey(trainer))

    def note(self, number: int, frame: Any) -> None:
        if self.noted is not None:
            raise KeyboardInterrupt
        self.noted = number

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        self.obey(trainer)

    def obey(self, trainer: L.Trainer) -> None:
        if not trainer.strategy.reduce_boolean_decision(self.noted is not None, all=False):
            return
        self.save(trainer)
        number, self.noted = self.noted, None
        handler = self.before.get(number)
        if not callable(handler):
            raise KeyboardInterrupt
        handler(number, None)
