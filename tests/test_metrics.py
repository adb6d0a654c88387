"""Errors of single images."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from viinter import metrics


def test_psnr_is_that_of_the_mean_squared_error_of_one_image():
    target = torch.full((16, 16, 3), 0.5)
    found = metrics.compare(target + 0.1, target)
    assert found.mse == pytest.approx(0.01, rel=1e-5)
    assert found.psnr == pytest.approx(20, abs=1e-4)


def test_predictions_are_clamped_first():
    target = torch.ones(16, 16, 3)
    assert metrics.compare(target + 5, target).mse == 0


def test_a_perfect_image_has_no_psnr_and_an_ssim_of_one():
    image = torch.rand(16, 16, 3)
    found = metrics.compare(image, image)
    assert found.psnr is None
    assert found.ssim == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(("height", "width", "exists"), [(11, 11, True), (10, 40, False), (1, 1, False)])
def test_ssim_is_missing_where_its_window_does_not_fit(height, width, exists):
    image = torch.rand(height, width, 3)
    assert (metrics.compare(image, image * 0.9).ssim is not None) == exists


def test_ssim_agrees_with_its_formula_on_a_constant_pair():
    # no variance: ssim = (2 ab + c1) / (a^2 + b^2 + c1)
    a, b = torch.full((20, 20, 3), 0.6), torch.full((20, 20, 3), 0.4)
    assert metrics.ssim(a, b) == pytest.approx((2 * 0.24 + 1e-4) / (0.36 + 0.16 + 1e-4), abs=1e-3)


@given(st.lists(st.floats(1e-8, 1), min_size=1, max_size=5))
def test_the_summary_averages_decibels_over_images_and_never_pools(errors):
    images = {str(k): metrics.ViewError(e, metrics.psnr(e), None) for k, e in enumerate(errors)}
    found = metrics.summary(images)
    assert found["psnr"] == pytest.approx(sum(-10 * math.log10(e) for e in errors) / len(errors))
    assert found["ssim"] is None
    assert list(found["per_view"]) == list(images)


def test_a_summary_of_nothing_is_missing_not_nan():
    assert metrics.summary({}) == {"psnr": None, "ssim": None, "mse": None, "per_view": {}}


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="differ in shape"):
        metrics.compare(torch.rand(4, 4, 3), torch.rand(4, 5, 3))
