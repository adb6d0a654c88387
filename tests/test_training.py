"""Whole runs in this process: what they leave behind, that they can be repeated and resumed, and that they learn."""

import json
import math
import pickle
from pathlib import Path

import pytest
import torch
from conftest import (
    REPOSITORY,
    WITH_TOWER,
    Crash,
    CrashAt,
    checkpoint_of,
    draw_folder,
    same,
    trained,
    without_times,
)

from viinter import features, image
from viinter.config import UserError, plain
from viinter.module import ViewInterpolator, load
from viinter.train import train

# Learning


LEARNING = {
    "model.width": 32, "model.depth": 3, "model.code_dim": 8, "optim.steps": 300, "optim.batch_pixels": 1024,
    "optim.lr": 2e-3,
}  # fmt: skip


def test_a_smooth_scene_is_learned_and_its_probes_are_close_to_the_known_views(make_config, tmp_path):
    found = train(make_config(**LEARNING), tmp_path)
    assert found["known"]["psnr"] > 30
    assert found["novel"]["psnr"] > 25
    assert found["known"]["ssim"] > 0.95
    assert found["known"]["psnr"] == pytest.approx(-10 * math.log10(found["known"]["mse"]), abs=3)


def test_a_scene_is_learned_from_one_view_a_step_and_with_interpolation_steps(make_config, tmp_path, fake_tower):
    values = {**LEARNING, **WITH_TOWER, "optim.steps": 150, "optim.pixels_from": "one_view"}
    cfg = make_config("pair", **{**values, "interpolation.alpha": 1e-3, "interpolation.every": 20})
    assert train(cfg, tmp_path)["known"]["psnr"] > 25


@pytest.mark.parametrize(
    ("layout", "known", "novel", "size"),
    [("planar", 9, 12, (32, 32)), ("folder", 4, 0, (32, 32)), ("pair", 2, 0, (32, 32)), ("studio", 9, 1, (20, 24)),
     ("llff", 9, 1, (32, 32))],
)  # fmt: skip
def test_every_layout_trains(make_config, tmp_path, layout, known, novel, size):
    found = train(make_config(layout, **{"optim.steps": 2}), tmp_path)
    assert (len(found["known"]["per_view"]), len(found["novel"]["per_view"])) == (known, novel)
    model = load(tmp_path)
    assert (model.about["height"], model.about["width"]) == size


REAL = [
    ("planar", "stanford/knights", {"scene.downsample": 8}),
    ("llff", "llff/fern", {"scene.images": "images_8", "scene.downsample": 4}),
    ("studio", "studio/head", {"scene.downsample": 4}), ("pair", "pairs/portrait", {"scene.downsample": 4}),
]  # fmt: skip


@pytest.mark.parametrize(("layout", "name", "values"), REAL, ids=[name for _, name, _ in REAL])
def test_real_scenes_train(make_config, shared_data, tmp_path, layout, name, values):
    found = train(make_config(layout, shared_data(name), **{"optim.steps": 2, **values}), tmp_path)
    assert 0 < found["known"]["psnr"] < 100


def test_photographs_are_drawn_where_their_cameras_stood(make_config, shared_data, tmp_path):
    """Codes come out in proportion to the cameras: their poses, which training never saw, say what a probe's is."""
    found = train(make_config("llff", shared_data("llff/fern"), **{
        "model": "fast", "scene.images": "images_8", "scene.downsample": 4, "interpolation.alpha": 0,
        "model.code_dim": 128, "optim.steps": 80, "optim.lr": 0.02, "optim.lr_decay": 0.05, "optim.beta2": 0.99,
        "optim.batch_pixels": 16384, "optim.pixels_from": "rows",
    }), tmp_path)  # fmt: skip
    assert found["novel_posed"]["psnr"] > found["novel"]["psnr"] + 4


# Repeating and resuming


def test_the_same_run_twice_gives_the_same_numbers(make_config, tmp_path):
    cfg = make_config()
    once, twice = train(cfg, tmp_path / "once"), train(cfg, tmp_path / "twice")
    assert without_times(once) == without_times(twice)
    assert same(trained(tmp_path / "once"), trained(tmp_path / "twice"))
    other = train(make_config(seed=1), tmp_path / "other")
    assert other["known"] != once["known"]


@pytest.mark.parametrize("tower", [{}, WITH_TOWER], ids=["pixels alone", "with the interpolation step"])
@pytest.mark.parametrize(
    ("model", "pixels_from"), [("paper", "one_view"), ("paper", "all_views"), ("fast", "rows"), ("fast", "one_view")]
)
def test_a_resumed_run_ends_as_if_it_had_not_been_interrupted(
    make_config, tmp_path, fake_tower, model, pixels_from, tower
):
    cfg = make_config(**{
        "model": model, "optim.steps": 20, "optim.pixels_from": pixels_from, "checkpoint.every_seconds": 1e-9, **tower
    })  # fmt: skip
    straight = train(cfg, tmp_path / "straight")
    with pytest.raises(Crash):
        train(cfg, tmp_path / "resumed", more_callbacks=[CrashAt(10)])
    assert checkpoint_of(tmp_path / "resumed")["global_step"] == 10
    resumed = train(cfg, tmp_path / "resumed", resume=True)
    assert same(trained(tmp_path / "straight"), trained(tmp_path / "resumed"))
    assert without_times(straight) == without_times(resumed)


def test_a_run_can_be_resumed_twice(make_config, tmp_path):
    cfg = make_config(**{"checkpoint.every_seconds": 1e-9})
    train(cfg, tmp_path / "straight")
    for resume, step in ((False, 1), (True, 4)):
        with pytest.raises(Crash):
            train(cfg, tmp_path / "resumed", resume=resume, more_callbacks=[CrashAt(step)])
    train(cfg, tmp_path / "resumed", resume=True)
    assert same(trained(tmp_path / "straight"), trained(tmp_path / "resumed"))


def test_a_resumed_run_goes_on_counting_its_seconds(make_config, tmp_path):
    cfg = make_config(**{"checkpoint.every_seconds": 1e-9})
    with pytest.raises(Crash):
        train(cfg, tmp_path, more_callbacks=[CrashAt(5)])
    before = checkpoint_of(tmp_path)["callbacks"]["Budget"]
    found = train(cfg, tmp_path, resume=True)
    for key in ("training_seconds", "wall_seconds"):
        assert found[key] > before[key] > 0


def test_looking_does_not_change_what_is_trained(make_config, tmp_path, fake_tower):
    often = {
        "evaluation.first_seconds": 1e-9, "evaluation.factor": 1.000001, "evaluation.max_share": 1e9,
        "logging.every_seconds": 1e-9, "logging.pictures": True, "checkpoint.every_seconds": 1e-9,
    }  # fmt: skip
    looked = train(make_config(**{**often, **WITH_TOWER}), tmp_path / "looked")
    assert len((tmp_path / "looked" / "error_vs_time.csv").read_text().splitlines()) == 1 + 6
    blind = train(make_config(**WITH_TOWER), tmp_path / "blind")
    assert len((tmp_path / "blind" / "error_vs_time.csv").read_text().splitlines()) == 1 + 1
    assert same(trained(tmp_path / "looked"), trained(tmp_path / "blind"))
    assert looked["known"] == blind["known"]


# The run folder


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory, drawn):
    """The folder of a run with pictures, the interpolation step and a progress bar, and what `train` returned."""
    from conftest import settings

    patch = pytest.MonkeyPatch()

    def build(cfg):
        module = torch.nn.Sequential(torch.nn.AvgPool2d(32), torch.nn.Flatten(), torch.nn.Linear(147, 8))
        return features.FeatureTower("fake", module, cfg.patches, (0.5,) * 3, (0.5,) * 3)

    patch.setitem(features.TOWERS, "fake", build)
    run_dir = tmp_path_factory.mktemp("runs") / "new" / "run"
    shown = {"logging.progress": True, "logging.pictures": True, "evaluation.first_seconds": 1e-6}
    found = train(settings("planar", drawn("planar"), {**shown, **WITH_TOWER}), run_dir)
    patch.undo()
    return run_dir, found


def files_of(run_dir: Path) -> set[str]:
    names = {str(file.relative_to(run_dir)) for file in run_dir.rglob("*") if file.is_file()}
    return {"events.out.tfevents.*" if name.startswith("events.out.tfevents.") else name for name in names}


def test_a_run_folder_holds_what_the_design_lists_and_nothing_else(whole_run):
    assert files_of(whole_run[0]) == {
        "metrics.json", "error_vs_time.csv", "error_vs_time.png", "strip.png", "interpolation.mp4",
        "checkpoints/last.ckpt", "events.out.tfevents.*",
    }  # fmt: skip


def test_without_pictures_there_are_none(make_config, tmp_path):
    train(make_config(), tmp_path)
    assert files_of(tmp_path) == {
        "metrics.json", "error_vs_time.csv", "checkpoints/last.ckpt", "events.out.tfevents.*",
    }  # fmt: skip


def test_the_metrics_are_plain_json_with_the_stated_keys(whole_run):
    run_dir, found = whole_run

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    read = json.loads((run_dir / "metrics.json").read_text(), parse_constant=refuse)
    assert read == found
    stated = {"known", "novel", "training_seconds", "wall_seconds", "steps", "peak_memory_mb", "omitted", "seed",
              "versions"}  # fmt: skip
    assert stated <= read.keys()
    for kind, count in (("known", 9), ("novel", 12), ("novel_cells", 4), ("novel_quarters", 0)):
        assert read[kind].keys() == {"psnr", "ssim", "mse", "per_view"}
        assert len(read[kind]["per_view"]) == count
    for kind in ("known", "novel", "novel_cells"):
        for key in ("psnr", "ssim", "mse"):
            each = [view[key] for view in read[kind]["per_view"].values()]
            assert read[kind][key] == pytest.approx(sum(each) / len(each))
    assert read["probes_left_out"] == {"novel": 0, "novel_cells": 0, "novel_quarters": 24}
    assert all(part.keys() == {"part", "reason", "seconds", "megabytes", "how"} for part in read["omitted"])
    assert 0 < read["training_seconds"] < read["wall_seconds"]
    assert (read["steps"], read["seed"]) == (6, 0)


def test_a_checkpoint_holds_no_code_and_no_tower(whole_run):
    found = checkpoint_of(whole_run[0])  # weights_only=True refuses all but tensors and plain values
    assert not [key for key in found["state_dict"] if not key.startswith(("field.", "codes."))]
    trainable = dict(load(whole_run[0]).named_parameters())
    moments = found["optimizer_states"][0]["state"]
    assert len(moments) == len(trainable)
    tower = 147 * 8
    assert tower not in {t.numel() for s in moments.values() for t in s.values()}
    assert b"viinter" not in pickle.dumps(found["config"])  # plain values, not our classes


def test_a_checkpoint_brings_back_the_model_that_was_trained(whole_run):
    model = load(whole_run[0])
    assert not model.training
    assert plain(model.cfg) == checkpoint_of(whole_run[0])["config"]
    assert model.about["names"][0] == "view_00_00.png"
    assert (model.codes.weight.abs().sum(1) - 1).abs().max() < 1e-6


def test_tensorboard_has_scalars_pictures_and_hyperparameters_with_the_final_metrics(whole_run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = EventAccumulator(str(whole_run[0]))
    board.Reload()
    tags = board.Tags()
    assert {
        "train/loss", "train/psnr", "train/interpolation_loss", "run/lr", "run/code_norm_min", "run/code_norm_max",
        "known/psnr", "known/ssim", "known/mse", "novel/psnr", "novel/ssim", "novel/mse", "final/known_psnr",
        "final/novel_psnr",
    } <= set(tags["scalars"])  # fmt: skip
    assert {"views/known_and_target", "views/novel_and_target", "views/interpolation"} <= set(tags["images"])
    (final,) = board.Scalars("final/novel_psnr")
    assert final.value == pytest.approx(whole_run[1]["novel"]["psnr"], rel=1e-6)
    hyperparameters = board.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    assert b"optim.lr" in hyperparameters
    assert b"codes.p" in hyperparameters


def test_the_strip_shows_five_frames_side_by_side(whole_run):
    assert image.read(whole_run[0] / "strip.png").shape == (32, 5 * 32, 3)


# Precision


@pytest.mark.parametrize(
    ("precision", "weights", "product"),
    [("32-true", torch.float32, torch.float32), ("64-true", torch.float64, torch.float64),
     ("bf16-true", torch.bfloat16, torch.bfloat16), ("bf16-mixed", torch.float32, torch.bfloat16)],
)  # fmt: skip
def test_every_precision_trains_and_is_what_it_says(
    make_config, tmp_path, monkeypatch, fake_tower, precision, weights, product
):
    seen, step = set(), ViewInterpolator.training_step

    def recording(self, batch, index):
        last = self.field.rgb.register_forward_hook(lambda *args: seen.add(args[-1].dtype))
        loss = step(self, batch, index)
        last.remove()
        return loss

    monkeypatch.setattr(ViewInterpolator, "training_step", recording)
    cfg = make_config(**{**LEARNING, **WITH_TOWER, "optim.steps": 40, "interpolation.every": 20,
                         "interpolation.alpha": 1e-3, "trainer.precision": precision})  # fmt: skip
    found = train(cfg, tmp_path)
    assert {w.dtype for k, w in checkpoint_of(tmp_path)["state_dict"].items() if k.startswith("field.")} == {weights}
    assert seen == {product}
    assert found["precision"] == precision
    assert found["known"]["psnr"] > 15  # a grey picture has 11 dB, an untrained field 7
    assert found["novel"]["psnr"] > 15
    assert load(tmp_path).codes.weight.isfinite().all()


@pytest.mark.parametrize("precision", ["bf16-true", "bf16-mixed"])
def test_pixels_of_a_wide_image_keep_their_places_in_a_narrow_format(make_config, tmp_path, monkeypatch, precision):
    for k in range(2):
        image.write(tmp_path / "wide" / f"{k}.png", torch.rand(2, 600, 3))
    columns, forward = [], ViewInterpolator.training_step

    def recording(self, batch, index):
        inner = self.field.forward
        self.field.forward = lambda xy, z: columns.append((xy[..., 0].double() + 1) * 300) or inner(xy, z)
        loss = forward(self, batch, index)
        self.field.forward = inner
        return loss

    monkeypatch.setattr(ViewInterpolator, "training_step", recording)
    train(make_config("pair", tmp_path / "wide", **{"trainer.precision": precision}), tmp_path / "run")
    off = torch.cat([c.flatten() for c in columns])
    assert (off - off.round()).abs().max() < 1e-3


# What train refuses, before anything is written


@pytest.mark.parametrize(
    ("values", "message"),
    [({"codes.p": "0.5"}, r"codes\.p=0\.5.*none, inf or a number >= 1"),
     ({"optim.steps": 0}, r"optim\.steps=0.*above 0"),
     ({"optim.training_seconds": -1.0}, r"optim\.training_seconds=-1"),
     ({"scene.endpoints": [0, 99]}, r"scene\.endpoints=\[0, 99\].*0 to 8"),
     ({"interpolation.alpha": 0.1}, r"features\.weights"),
     ({"interpolation.alpha": 0.1, "features.extractor": "eyes"}, r"features\.extractor=eyes.*clip, vgg16"),
     ({"interpolation.alpha": 0.1, "features.weights": "absent.pt"}, r"absent\.pt")],
)  # fmt: skip
def test_what_cannot_be_run_is_refused_with_the_key_to_change(make_config, tmp_path, values, message):
    with pytest.raises(UserError, match=message):
        train(make_config(**values), tmp_path / "run")
    assert not list((tmp_path / "run").rglob("*.ckpt"))


def test_without_alpha_the_extractor_is_not_even_looked_at(make_config, tmp_path):
    train(make_config(**{"features.extractor": "eyes", "features.weights": "absent.pt", "optim.steps": 1}), tmp_path)


def test_two_images_of_different_sizes_are_refused(make_config, tmp_path):
    root = draw_folder(tmp_path / "scene", 2)
    image.write(root / "9.png", torch.rand(8, 32, 3))
    with pytest.raises(UserError, match=r"9\.png.*one size"):
        train(make_config("folder", root), tmp_path / "run")


def test_every_scene_of_the_paper_and_the_demo_can_be_named():
    names = {str(f.relative_to(REPOSITORY / "conf" / "scene")) for f in (REPOSITORY / "conf" / "scene").rglob("*.yaml")}
    assert {"demo.yaml", "folder.yaml", "pair.yaml", "planar.yaml", "llff.yaml", "studio.yaml"} <= names
    assert len([name for name in names if name.startswith("stanford/")]) == 13
    assert len([name for name in names if name.startswith("llff/")]) == 8
    assert len([name for name in names if name.startswith("studio/")]) == 3
