"""What every field offers to the training around it.

Notation: `V` codes at once, `P` pixels under each, `M` the length of a code, `n` known views.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch.nn.functional as F
from torch import Tensor, nn


class Field(nn.Module):
    """F(xy | z) -> rgb: `forward(xy [V, P, 2] in [-1, 1), z [V, M]) -> [V, P, 3]`, not clamped.

    The other methods have defaults that do nothing; a field that wants more of the training overrides them.
    """

    def calibrate(self, codes: Tensor) -> None:
        """Called once, before training, with the code book [n, M] as it starts."""

    def parameter_groups(self, codes: nn.Parameter) -> list[dict[str, Any]]:
        """The optimiser's groups: `params`, and `share`, their learning rate as a share of `optim.lr`."""
        return [{"params": [*self.parameters(), codes], "share": 1.0}]

    def at(self, progress: float, step: int = 0) -> None:
        """Called before each step with the share of the budget that is used, in [0, 1], and the steps taken."""

    def stage(self) -> int | None:
        """A number that changes whenever `at` has changed which operations a training step consists of. Whatever else
        changes from step to step must then be in buffers: on a GPU a step is captured once for each stage (`replay`).
        None, for a field that does not keep to this: its steps are not captured."""
        return None

    def rates(self) -> list[float]:
        """A factor on the learning rate of each of `parameter_groups`, after `at`."""
        return [1.0]

    def enough(self, steps_per_pass: float) -> float:
        """Steps that are of use, where a pass over all known pixels takes `steps_per_pass`: seconds beyond are left."""
        return math.inf

    def settle(self, seconds: float, views: int, batch: float, drawing: Callable[[], float]) -> float:
        """Called once, before the first step of a budget in `seconds`; returns the seconds that `finish` will take.

        There are `views` known views, a training step has `batch` times the pixels of one, and `drawing()` takes the
        time, in seconds, of drawing one as the field is now.
        """
        return 0.0

    def see(self, views: Tensor, codes: Tensor) -> None:
        """Called before the first step, and where training goes on, with the known views [n, H, W, 3] and their codes
        [n, M]."""

    def finish(self, views: Tensor, codes: Tensor) -> None:
        """Called once, after the last step, with the known views [n, H, W, 3] and their codes [n, M]."""

    def loss(self, view: Tensor, xy: Tensor, rgb: Tensor, codes: Tensor) -> Tensor:
        """What a training step makes smaller, from pixels at `xy` [V, P, 2] of the known views number `view` [V] that
        have colours `rgb` [V, P, 3] there; `codes` [n, M] are those of all known views. The mean squared error over
        pixels and channels, unless a field has more to ask."""
        return F.mse_loss(self(xy, codes.index_select(0, view)), rgb)
