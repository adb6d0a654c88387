"""The pixels of a scene, kept on the training device and sampled there.

Notation: `n` known views of `H x W`; a batch holds `V` views and `P` pixels of each. Pixel j of W sits at
x = -1 + 2j/W.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import lightning as L
import torch
from torch import Tensor

from viinter.config import PixelsFrom
from viinter.scenes import Scene

PIECE = 64  # pixels of a row that come from one view; found by trial (docs/fast_tried.md)


class PixelBatch(NamedTuple):
    """`view` [V] indices of known views, `xy` [V, P, 2] in [-1, 1), `rgb` [V, P, 3] in [0, 1]."""

    view: Tensor
    xy: Tensor
    rgb: Tensor


class PixelStore:
    """All known pixels on one device, and batches drawn from them at random, with replacement.

    Batch k depends on `seed` and k alone, so that a resumed run goes on with the very batches it would have had.
    `one_view`: `pixels` of one random view (the published code). `all_views`: the same number spread evenly over
    all views (over `pixels` of them, drawn at random, if there are more views than pixels). `rows`: pieces of `PIECE`
    pixels (at most a row's), evenly spread over the frame and each of a random view, as many as come nearest to
    `pixels`; a field that reads textures finds what it needs of them in the cache. A piece that reaches a row's end
    goes on in the next.

    Of several processes that train together, `parts`, each gets an equal share of the batch that one alone would have,
    number `part` of them; what is spread is rounded up to a multiple of `parts`.
    """

    def __init__(
        self, views: Tensor, pixels: int, pixels_from: PixelsFrom, seed: int, device: torch.device,
        part: int = 0, parts: int = 1,
    ) -> None:  # fmt: skip
        self.n, self.height, self.width, _ = views.shape
        self.views = views.to(device)
        self.rgb = self.views.reshape(-1, 3)
        self.pixels, self.pixels_from, self.seed = pixels, pixels_from, seed
        self.generator = torch.Generator(device)
        self.pitch = torch.tensor([2 / self.width, 2 / self.height], device=device)
        self.every_view = torch.arange(self.n, device=device)
        self.part, self.parts = part, parts

    def batch(self, k: int) -> PixelBatch:
        """Batch number `k`."""
        view, pixel = self._drawn(self.generator.manual_seed((self.seed * 0x9E3779B1 + k) % 2**32))
        row = torch.div(pixel, self.width, rounding_mode="floor")
        xy = torch.stack([pixel - row * self.width, row], -1) * self.pitch - 1
        return PixelBatch(view, xy, self.rgb[pixel + view[:, None] * (self.height * self.width)])

    def _drawn(self, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Views [V], and pixels [V, P] of them, counted row by row."""
        device, area, own = self.rgb.device, self.height * self.width, slice(self.part, None, self.parts)
        if self.pixels_from is PixelsFrom.rows:
            length = min(self.width, PIECE)
            count = self._whole(max(1, round(self.pixels / length)))
            view = torch.randint(self.n, (count,), generator=random, device=device)
            within = (torch.rand(count, generator=random, device=device) * (area / count)).long()
            first = torch.arange(count, device=device) * area // count + within
            return view[own], ((first[:, None] + torch.arange(length, device=device)) % area)[own]
        if self.pixels_from is PixelsFrom.one_view:
            view, share = torch.randint(self.n, (1,), generator=random, device=device), self._whole(self.pixels)
        elif self.n <= self.pixels:
            view, share = self.every_view, self._whole(-(-self.pixels // self.n))
        else:
            view = torch.randint(self.n, (self._whole(self.pixels),), generator=random, device=device)
            share = 1
        pixel = torch.randint(area, (len(view), share), generator=random, device=device)
        return (view, pixel[:, own]) if share > 1 else (view[own], pixel[own])

    def _whole(self, count: int) -> int:
        return -(-count // self.parts) * self.parts


class _Numbers:
    """The endless numbers of the batches, starting where the trainer stands. It has no state of its own: its
    `state_dict` is there to tell Lightning that it can be resumed."""

    def __init__(self, trainer: L.Trainer) -> None:
        self.trainer = trainer

    def __iter__(self) -> Iterator[int]:
        return itertools.count(self.trainer.global_step)

    def state_dict(self) -> dict:
        return {}

    def load_state_dict(self, state: dict) -> None:
        pass


class SceneData(L.LightningDataModule):
    """Serves the known views of a scene (any layout) as an endless stream of `PixelBatch`es on the training device.

    There are no workers and no copies: a scene's pixels fit any device that can train on them, and a worker that ships
    them costs more than a training step. The loader gives only a batch's number and the batch is drawn on arrival,
    because Lightning would round what a loader gives to `trainer.precision`, coordinates and targets too.
    """

    def __init__(self, scene: Scene, batch_pixels: int, pixels_from: PixelsFrom, seed: int) -> None:
        super().__init__()
        self.scene, self.batch_pixels, self.pixels_from, self.seed = scene, batch_pixels, pixels_from, seed

    def train_dataloader(self) -> _Numbers:
        device = self.trainer.strategy.root_device
        self.store = PixelStore(
            self.scene.views, self.batch_pixels, self.pixels_from, self.seed, device,
            self.trainer.global_rank, self.trainer.world_size,
        )  # fmt: skip
        return _Numbers(self.trainer)

    def transfer_batch_to_device(self, batch: int, device: torch.device, dataloader_idx: int) -> PixelBatch:
        return self.store.batch(batch)
