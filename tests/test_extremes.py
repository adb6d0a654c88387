"""The edges of what can be asked for, each with its right answer, for `paper` and for `fast`.

Those of one function are tested with it:

| extreme | right answer | test |
|---|---|---|
| 1 view | refused: nothing to interpolate between | here; test_scenes `..._one_image_stops`, `..._too_small_...` |
| 2 identical views | finite; the picture at both ends, with `fast` between them too | here |
| a constant image, a black one | learned | here |
| perfect reconstruction | no PSNR, and no mean of infinities | here; test_metrics `..._has_no_psnr_...` |
| a checkerboard of single pixels | `paper` no worse than flat grey; `fast` reproduces it | here |
| 1 x N, N x 1, 5 x 5, 1 x 1 images | learned; no SSIM | here |
| SSIM where the window does not fit | missing | test_metrics `test_ssim_is_missing_where_...` |
| 4096 x 4096 | drawn and measured in little more memory than the picture's own | here |
| 200 views | all take part | here |
| M = 1 | codes are +-radius, views share them, and all is finite | here |
| M = 4096 | as at any other length | here; test_codes (norms up to 4096) |
| EXR with values to 1e4 | refused with the setting that helps; scaled; drawn in the file's units | here; test_scenes |
| EXR with NaN or infinite pixels | refused, with the first such pixel | test_image `test_non_finite_pixels` |
| 16 bits | every stored value exactly | test_image `test_sixteen_bits_come_back_exactly`; here through a run |
| a code at zero | drawn anew, and counted | here; test_codes `..._is_drawn_anew_...` |
| alpha = 0 | no tower at all | test_callbacks `test_without_alpha_...`, test_command_line |
| alpha = 1e6 | finite, codes on their sphere | here |
| t outside [0, 1] | goes on along the line, finite | here; test_codes `test_lerp_is_affine_...` |
| a schedule resumed past its end | no further step, the last rate | test_callbacks `..._when_resumed`, `..._past_...` |
| losses and gradients that are not finite | kept from the weights | test_guard |
"""

import json
from pathlib import Path

import lightning as L
import pytest
import torch
from conftest import WITH_TOWER, checkpoint_of, keep_config, pattern

from viinter import config, image, memory, metrics
from viinter.codes import lerp
from viinter.config import RenderConfig, UserError
from viinter.fields.fast import FastField
from viinter.fields.paper import PaperField
from viinter.module import load
from viinter.render import render
from viinter.scenes import load as load_scene
from viinter.train import train
from viinter.views import draw

PAPER = {"model": "paper", "model.width": 32, "model.depth": 3}
FAST = {"model": "fast", "model.layers": 2, "optim.lr": 0.02, "optim.beta2": 0.99, "optim.pixels_from": "rows"}
both = pytest.mark.parametrize("model", [PAPER, FAST], ids=["paper", "fast"])


def folder(root: Path, views, ending=".png", bits=8) -> Path:
    for k, view in enumerate(views):
        image.write(root / f"{k}{ending}", view, bits=bits)
    return root


def cut(height, width, move=0.0):
    return pattern(move, 0, max(height, width))[:height, :width]


def finite(found):
    """All numbers are there and plain (`metrics.json` refuses NaN and infinity itself), and nothing was restarted."""
    return found["restarts"] == 0 and all(found["known"][key] is not None for key in ("mse", "psnr"))


@pytest.fixture
def run(make_config, tmp_path):
    """`run(views, **values)`: metrics of 60 steps on a folder of these views, and the model."""

    def trained(views, ending=".png", bits=8, **values):
        root = folder(tmp_path / "scene", views, ending, bits)
        found = train(make_config("folder", root, **{"optim.steps": 60, **values}), tmp_path / "run")
        return found, load(tmp_path / "run")

    return trained


def drawn_at(model, t):
    z = model.codes.weight.detach()
    return draw(model.field, lerp(z[0], z[1], t), model.about["height"], model.about["width"])


def psnr(picture, target):
    return metrics.psnr((picture.clamp(0, 1) - target).square().mean().item())


# Views


@both
def test_one_view_is_refused(make_config, tmp_path, model):
    values = {**model, "scene.holdout": "none", "scene.max_views": 1}
    with pytest.raises(UserError, match="expected at least 2, to interpolate between"):
        train(make_config("folder", folder(tmp_path, [pattern(0), pattern(0.1)]), **values), tmp_path / "run")


@both
def test_two_identical_views_are_one_picture_at_every_mix(run, model):
    found, trained = run([pattern(0)] * 2, **{**model, "optim.steps": 200, "optim.lr": model.get("optim.lr", 3e-3)})
    assert finite(found)
    for t in (0.0, 1.0) if model is PAPER else (0.0, 0.25, 0.5, 1.0):
        assert psnr(drawn_at(trained, t), pattern(0)) > 30
    assert torch.isfinite(drawn_at(trained, 0.5)).all()


@both
@pytest.mark.parametrize("value", [0.0, 0.3])
def test_a_constant_image_is_learned(run, model, value):
    found, _ = run([torch.full((32, 32, 3), value)] * 2, **model)
    assert finite(found)
    assert found["known"]["psnr"] > 35


def test_a_perfect_reconstruction_has_no_psnr(run, tmp_path):
    """The fast field starts at this grey, and no gradient moves it."""
    found, _ = run([torch.full((32, 32, 3), 0.5)] * 2, ".exr", 32, **FAST)
    assert found["restarts"] == 0
    assert (found["known"]["mse"], found["known"]["psnr"]) == (0.0, None)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["known"]["psnr"] is None
    header, row = (tmp_path / "run" / "error_vs_time.csv").read_text().splitlines()
    assert dict(zip(header.split(","), row.split(","), strict=True))["known_psnr"] == ""


@both
def test_a_checkerboard_of_single_pixels(run, model):
    board = ((torch.arange(32)[:, None] + torch.arange(32)) % 2).float()[..., None].expand(32, 32, 3)
    found, _ = run([board] * 2, **{**model, "optim.steps": 100})
    assert finite(found)
    flat_grey = metrics.psnr(0.25)
    assert found["known"]["psnr"] > (flat_grey - 0.1 if model is PAPER else 35)


@both
@pytest.mark.parametrize(("height", "width"), [(1, 64), (64, 1), (5, 5), (1, 1)])
def test_images_smaller_than_any_window(run, model, height, width):
    found, trained = run([cut(height, width), cut(height, width, 0.02)], **{**model, "optim.steps": 100})
    assert finite(found)
    assert found["known"]["psnr"] > 20
    assert found["known"]["ssim"] is None
    assert drawn_at(trained, 0.5).shape == (height, width, 3)


@both
def test_two_hundred_views(run, model):
    found, _ = run([cut(16, 16, k / 1000) for k in range(200)], **model)
    assert finite(found)
    assert (len(found["known"]["per_view"]), len(found["novel"]["per_view"])) == (175, 25)
    assert found["known"]["psnr"] > 15
    if model is PAPER:
        assert abs(found["known"]["psnr"] - found["novel"]["psnr"]) < 3
    else:  # known views are exact
        assert found["known"]["psnr"] > found["novel"]["psnr"] > 30


# 4096 x 4096


def peak(work):
    """Megabytes that `work` takes at its height, over those taken before; Linux counts them."""
    reset = Path("/proc/self/clear_refs")
    if not reset.exists():
        pytest.skip("peak memory is read from Linux's /proc")
    reset.write_text("5")  # the peak begins anew at what is taken now
    before = memory.peak_mb()
    work()
    return memory.peak_mb() - before


@pytest.mark.parametrize("name", ["paper", "fast"])
def test_a_frame_of_4096_x_4096_is_drawn_in_little_more_than_its_own_memory(name):
    field = PaperField(4, width=8, depth=2) if name == "paper" else FastField(
        4, views=2, height=64, width=64, layers=1, sets=2, motion=1, margin=1.1, texture_pixels=64 * 64,
        sharpness=5.0, entropy=0.0, smooth=0.0, consistency=0.0, remainder=False)  # fmt: skip
    own = 4096 * 4096 * 3 * 4 / 2**20
    assert peak(lambda: draw(field.eval(), torch.ones(4), 4096, 4096)) < 3 * own


def test_ssim_is_measured_in_strips_that_give_what_the_whole_gives(monkeypatch):
    target = pattern(0, 0, 100)[:90]
    picture = (target + 0.1 * torch.rand(target.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
    whole, sizes, inner = metrics.ssim(picture, target), [], metrics.structural_similarity_index_measure

    def watched(strip, *args, **kwargs):
        sizes.append(strip.shape[2])
        return inner(strip, *args, **kwargs)

    monkeypatch.setattr(metrics, "structural_similarity_index_measure", watched)
    for rows in (1, 7, 89):
        monkeypatch.setattr(metrics, "STRIP_PIXELS", rows * 100)
        sizes.clear()
        assert metrics.ssim(picture, target) == pytest.approx(whole, abs=1e-6)
        assert max(sizes) <= min(90, rows + 10)


# Codes


@both
@pytest.mark.parametrize("p", ["1", "none"])
@pytest.mark.parametrize("seed", [0, 1])  # the two codes come to lie apart, or both on one side
def test_codes_of_one_number(run, model, p, seed):
    found, trained = run([cut(32, 32, k / 50) for k in range(2)],
                         **{**model, "model.code_dim": 1, "codes.p": p, "seed": seed})  # fmt: skip
    assert finite(found)
    if p != "none":
        assert (trained.codes.weight.abs() - 1).abs().max() < 1e-6
    for t in (0.0, 0.5, 1.0):
        assert torch.isfinite(drawn_at(trained, t)).all()


@both
def test_codes_of_4096_numbers(run, model):
    found, trained = run([cut(32, 32, k / 50) for k in range(2)], **{**model, "model.code_dim": 4096})
    assert finite(found)
    assert found["known"]["psnr"] > 14
    assert (trained.codes.weight.double().abs().sum(1) - 1).abs().max() < 1e-5


@both
def test_a_code_at_zero_is_drawn_anew_and_counted(make_config, tmp_path, model):
    class Zero(L.Callback):
        def on_before_zero_grad(self, trainer, module, optimizer):
            if trainer.global_step == 3:
                with torch.no_grad():
                    module.codes.weight[1] = 0
                    optimizer.state[module.codes.weight]["exp_avg"][1] = 0

        def on_before_optimizer_step(self, trainer, module, optimizer):
            if trainer.global_step == 3:
                module.codes.weight.grad[1] = 0

    found = train(make_config(**{**model, "optim.steps": 6}), tmp_path, more_callbacks=[Zero()])
    assert finite(found)
    assert found["codes_redrawn"] == 1
    assert (load(tmp_path).codes.weight.abs().sum(1) - 1).abs().max() < 1e-6


@both
def test_beyond_the_known_views_all_stays_finite(run, model):
    _, trained = run([cut(32, 32, k / 50) for k in range(3)], **model)
    for t in (-100.0, -1.0, -0.01, 1.01, 2.0, 100.0):
        assert torch.isfinite(drawn_at(trained, t)).all()


# Files


@both
def test_bright_images_are_scaled_and_drawn_in_their_own_units(run, make_config, tmp_path, model):
    bright = pattern(0) * 1e4
    scale = {"scene.out_of_range": "scale", "scene.root": str(tmp_path / "scene")}
    values = {**model, **scale, "optim.steps": 150}
    found, trained = run([bright, bright], ".exr", 32, **values)
    assert finite(found)
    assert trained.about["white"] == pytest.approx(bright.max().item())
    keep_config(make_config("folder", tmp_path / "scene", **values), tmp_path / "run")
    render(RenderConfig(run=str(tmp_path / "run"), format=config.FrameFormat.exr, frames=1, out=str(tmp_path / "out")))
    frame = image.read(min((tmp_path / "out").glob("frame_*.exr")))
    assert psnr(frame / bright.max(), bright / bright.max()) == pytest.approx(found["known"]["psnr"], abs=1.5)
    assert 1e3 < frame.max() < 2e4


def test_bright_images_are_refused_where_nobody_asked_for_them(make_config, tmp_path):
    views = [pattern(0), pattern(0.1)]
    views[1][3, 4] = 1e4
    with pytest.raises(UserError, match=r"10000(.|\n)*scene\.out_of_range"):
        train(make_config("folder", folder(tmp_path, views, ".exr", 32)), tmp_path / "run")


@both
def test_sixteen_bits_reach_the_training_as_stored(run, make_config, tmp_path, model):
    stored = torch.arange(32 * 32 * 3).reshape(32, 32, 3) * 21
    found, _ = run([stored / 65535] * 2, ".png", 16, **model)
    assert finite(found)
    scene = load_scene(make_config("folder", tmp_path / "scene").scene)
    assert torch.equal((scene.views[0].double() * 65535).round().long(), stored)


# L_inter


@both
def test_a_huge_alpha_leaves_all_finite_and_the_codes_on_their_sphere(make_config, tmp_path, fake_tower, model):
    cfg = make_config(**{**model, **WITH_TOWER, "interpolation.alpha": 1e6, "optim.steps": 60})
    assert finite(train(cfg, tmp_path))
    state = checkpoint_of(tmp_path)
    assert all(torch.isfinite(t.double()).all() for t in state["state_dict"].values())
    moments = [t for s in state["optimizer_states"][0]["state"].values() for t in s.values()]
    assert all(torch.isfinite(t).all() for t in moments)
    assert (load(tmp_path).codes.weight.abs().sum(1) - 1).abs().max() < 1e-6
