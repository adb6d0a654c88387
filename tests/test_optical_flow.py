"""Optical flow between two pictures, and pictures moved onto their targets."""

import sys

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from viinter import metrics, optical_flow
from viinter.config import UserError


def waves(right=0.0, down=0.0, side=96):
    """Slow waves of many directions [side, side, 3], moved by so many pixels."""
    draw = torch.Generator().manual_seed(0)
    turns, phases = 0.25 * torch.randn(40, 2, generator=draw), 6.28 * torch.rand(40, 3, generator=draw)
    y, x = torch.meshgrid(*(torch.arange(float(side)) - by for by in (down, right)), indexing="ij")
    angles = torch.stack([x, y], -1) @ turns.T
    return (0.5 + torch.cos(angles[..., None] + phases).mean(2)).clamp(0, 1)


def gain(image, target):
    """PSNR that moving `image` onto `target` brings."""
    moved = optical_flow.registered(image, target)
    return metrics.compare(moved, target).psnr - metrics.compare(image, target).psnr


@pytest.fixture(autouse=True)
def _opencv(request):
    if "without" not in request.node.name:
        pytest.importorskip("cv2")


def test_displacement_is_how_far_things_moved():
    found = optical_flow.displacement(waves(), waves(right=3, down=-1.5))
    assert np.abs(np.median(found[8:-8, 8:-8], (0, 1)) - (3, -1.5)).max() < 0.1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_a_picture_beside_its_place_is_moved_onto_it(dtype):
    assert gain(waves(right=2.5, down=1).to(dtype), waves()) > 8
    assert optical_flow.registered(waves(right=2.5, down=1).to(dtype), waves()).dtype == torch.float32


def test_what_a_picture_shows_is_not_mended():
    """Neither a blur becomes sharp, nor noise another noise, nor dark colours light."""
    blurred = F.avg_pool2d(waves().movedim(-1, 0), 15, 1, 7, count_include_pad=False).movedim(0, -1)
    assert gain(blurred, waves()) < 1
    noise = torch.rand(2, 96, 96, 3, generator=torch.Generator().manual_seed(0))
    assert gain(*noise) < 1
    assert gain(0.6 * waves(), waves()) < 1


def test_a_picture_in_its_place_stays():
    assert torch.allclose(optical_flow.registered(waves(), waves()), waves(), atol=2e-3)


def test_colours_beyond_the_range_are_clamped_first():
    assert torch.equal(optical_flow.registered(3 * waves() - 1, waves()),
                       optical_flow.registered((3 * waves() - 1).clamp(0, 1), waves()))  # fmt: skip


def test_pictures_too_small_are_refused_and_the_reason_is_kept():
    small = torch.rand(8, 8, 3)
    with pytest.raises(UserError, match="larger views than 8 x 8"):
        optical_flow.displacement(small, small)
    assert "larger views than 8 x 8" in optical_flow.measure_registered({"a": (small, small)})


def test_each_pair_has_its_errors():
    found = optical_flow.measure_registered({"a": (waves(right=2), waves()), "b": (waves(right=9), waves())})
    assert found["per_view"].keys() == {"a", "b"}
    assert found["per_view"]["a"]["psnr"] > metrics.compare(waves(right=2), waves()).psnr + 8


def test_without_opencv_the_reason_is_given(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert 'pip install "viinter[peers]"' in optical_flow.measure_registered({"a": (waves(), waves())})
