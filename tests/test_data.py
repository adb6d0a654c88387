"""Pixel batches."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from viinter.config import PixelsFrom
from viinter.data import PIECE, PixelStore

CPU = torch.device("cpu")


def numbered(n: int, height: int, width: int) -> torch.Tensor:
    """Views whose every pixel holds (view, row, column)."""
    view, row, column = torch.meshgrid(torch.arange(n), torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([view, row, column], -1).float()


@given(st.integers(1, 40), st.integers(1, 30), st.integers(1, 30), st.integers(1, 64), st.sampled_from(PixelsFrom))
def test_every_pixel_comes_with_its_own_coordinates_and_view(n, height, width, pixels, pixels_from):
    store = PixelStore(numbered(n, height, width), pixels, pixels_from, 0, CPU)
    batch = store.batch(5)
    view, row, column = batch.rgb.unbind(-1)
    assert torch.equal(view, batch.view[:, None].expand_as(view).float())
    assert torch.allclose(batch.xy[..., 0], -1 + 2 * column / width, atol=1e-6)
    assert torch.allclose(batch.xy[..., 1], -1 + 2 * row / height, atol=1e-6)
    assert batch.xy.min() >= -1
    assert batch.xy.max() < 1
    if pixels_from is not PixelsFrom.rows:  # those come in whole pieces of rows
        assert batch.rgb.shape[0] * batch.rgb.shape[1] >= pixels


def test_one_view_takes_all_pixels_from_one_view_and_all_views_the_same_share_from_each():
    views = numbered(5, 8, 8)
    one = PixelStore(views, 100, PixelsFrom.one_view, 0, CPU).batch(0)
    assert one.rgb.shape == (1, 100, 3)
    every = PixelStore(views, 100, PixelsFrom.all_views, 0, CPU).batch(0)
    assert every.view.tolist() == [0, 1, 2, 3, 4]
    assert every.rgb.shape == (5, 20, 3)


def test_a_batch_depends_on_seed_and_number_alone():
    views = numbered(5, 8, 8)
    first, again = (PixelStore(views, 50, PixelsFrom.one_view, 7, CPU) for _ in range(2))
    for k in range(5):
        first.batch(k)
    assert torch.equal(first.batch(3).xy, again.batch(3).xy)
    assert not torch.equal(again.batch(3).xy, again.batch(4).xy)
    assert not torch.equal(again.batch(3).xy, PixelStore(views, 50, PixelsFrom.one_view, 8, CPU).batch(3).xy)


@pytest.mark.parametrize("pixels_from", PixelsFrom)
def test_views_and_pixels_are_drawn_evenly(pixels_from):
    store = PixelStore(numbered(4, 5, 6), 60, pixels_from, 0, CPU)
    counts = torch.zeros(4, 5, 6)
    for k in range(2000):
        view, row, column = store.batch(k).rgb.long().flatten(0, 1).unbind(-1)
        counts.index_put_((view, row, column), torch.ones(len(view)), accumulate=True)
    share = counts / counts.sum()
    if pixels_from is PixelsFrom.one_view:
        assert torch.allclose(share.sum((1, 2)), torch.full((4,), 0.25), atol=0.05)
    assert torch.allclose(share.sum(0), torch.full((5, 6), 1 / 30), atol=0.003)


@given(st.integers(1, 9), st.integers(1, 30), st.integers(1, 200), st.integers(1, 5000))
def test_pieces_of_rows_are_whole_in_order_and_spread_over_the_frame(n, height, width, pixels):
    batch = PixelStore(numbered(n, height, width), pixels, PixelsFrom.rows, 0, CPU).batch(2)
    _, row, column = batch.rgb.unbind(-1)
    pixel, length = row * width + column, min(width, PIECE)
    assert ((pixel.diff(dim=-1) == 1) | (pixel.diff(dim=-1) == 1 - height * width)).all()
    assert pixel.shape == (max(1, round(pixels / length)), length)
    assert torch.equal(pixel[:, 0], pixel[:, 0].sort().values)
    strata = torch.arange(len(pixel) + 1) * (height * width / len(pixel))  # one from each of so many parts of the frame
    assert (pixel[:, 0] >= strata[:-1].floor()).all()
    assert (pixel[:, 0] <= strata[1:]).all()


@pytest.mark.parametrize("parts", [2, 3])
@pytest.mark.parametrize(("pixels_from", "n"), [("one_view", 4), ("all_views", 4), ("all_views", 70), ("rows", 4)])
def test_processes_that_train_together_share_the_batch_of_one(pixels_from, n, parts):
    def batch(part, parts):
        return PixelStore(numbered(n, 5, 6), 60, PixelsFrom(pixels_from), 0, CPU, part, parts).batch(3)

    def pixels(batch):
        view = batch.view[:, None, None].expand(-1, batch.xy.shape[1], 1)
        return torch.cat([view.float(), batch.xy, batch.rgb], -1).flatten(0, 1)

    whole, shares = pixels(batch(0, 1)), [pixels(batch(part, parts)) for part in range(parts)]
    assert len({len(share) for share in shares}) == 1
    both = torch.cat(shares)
    assert len(whole) <= len(both) < len(whole) + parts * (6 if pixels_from == "rows" else n)
    if len(both) == len(whole):
        assert torch.equal(both.unique(dim=0), whole.unique(dim=0))
