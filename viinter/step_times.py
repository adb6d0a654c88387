"""Where the time of a run goes: seconds of each part of the steps, and of what comes between them."""

from __future__ import annotations

import time
from collections import defaultdict

from lightning.pytorch.profilers import Profiler

# the ends of Lightning's names for what it calls, and ours
PARTS = {
    ".transfer_batch_to_device": "sampling",
    "Strategy.training_step": "forward",
    "Strategy.backward": "backward",
    "ViewInterpolator.optimizer_step": "optimiser",  # the closure with forward and backward is taken off
    "InterpolationLoss.on_train_batch_end": "interpolation step",
    "RenormalizeCodes.on_train_batch_end": "projection",
    "ErrorClock.on_train_batch_end": "evaluation",
    "ErrorClock.on_train_end": "evaluation",
    "ViewLogger.on_train_batch_end": "logging",
    "ViewLogger.on_train_end": "logging",
    "SaveCheckpoint.on_train_batch_end": "checkpoints",
    "SaveCheckpoint.on_train_end": "checkpoints",
}


class StepTimes(Profiler):
    """Adds up the seconds of `PARTS`, which Lightning tells it when they begin and end.

    Nothing waits for the device: on a GPU a part's seconds are those in which it was asked for. A resumed run counts
    from its resumption.
    """

    def __init__(self) -> None:
        super().__init__()
        self.born, self.first_step = time.perf_counter(), 0.0
        self.part: dict[str, str | None] = {}
        self.since: dict[str, float] = {}
        self.sums: dict[str, float] = defaultdict(float)

    def start(self, action_name: str) -> None:
        if action_name not in self.part:
            self.part[action_name] = next((p for end, p in PARTS.items() if action_name.endswith(end)), None)
            if action_name == "run_training_batch":
                self.first_step = time.perf_counter()
        if self.part[action_name]:
            self.since[action_name] = time.perf_counter()

    def stop(self, action_name: str) -> None:
        if self.part[action_name]:
            self.sums[self.part[action_name]] += time.perf_counter() - self.since[action_name]

    def seconds(self) -> dict[str, float]:
        """Seconds by part; `start-up` (the scene, the tower, Lightning) before them, and `rest` after them."""
        found = {"start-up": (self.first_step or time.perf_counter()) - self.born, **self.sums}
        if "optimiser" in found:
            found["optimiser"] -= found["forward"] + found["backward"]
        return {**found, "rest": time.perf_counter() - self.born - sum(found.values())}
