"""A finished run drawn and measured again."""

import dataclasses
import json
import re
import shutil
import sys

import av
import pytest
import torch
from conftest import checkpoint_of, draw_folder, draw_planar, keep_config, settings
from PIL import Image

from viinter import image
from viinter.config import Easing, EvaluateConfig, FrameFormat, RenderConfig, UserError
from viinter.evaluate import evaluate
from viinter.module import load
from viinter.render import circle, render, square
from viinter.train import train
from viinter.views import draw


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a small planar scene, 32 x 32, 9 known views; its images are in `run.parent / "scene"`."""
    folder = tmp_path_factory.mktemp("run")
    size = {"model.width": 32, "model.depth": 3, "optim.steps": 150, "optim.batch_pixels": 1024, "optim.lr": 2e-3}
    cfg = settings("planar", draw_planar(folder / "scene"), {**size, "scene.endpoints": [2, 6]})
    train(cfg, folder / "run")
    keep_config(cfg, folder / "run")
    return folder / "run"


@pytest.fixture(scope="module")
def bright_run(tmp_path_factory):
    """A run of a scene with values up to 4, divided by that while training."""
    folder = tmp_path_factory.mktemp("bright")
    draw_folder(folder / "scene", 2)
    peak = torch.full((32, 32, 3), 2.0)
    peak[4, 5] = 4.0
    image.write(folder / "scene" / "2.exr", peak, bits=32)
    train(settings("folder", folder / "scene", {"scene.out_of_range": "scale", "optim.steps": 3}), folder / "run")
    return folder / "run"


def frames(out, ending="png"):
    return sorted(out.glob(f"frame_*.{ending}"))


def known(run_dir, view, height=32, width=32):
    model = load(run_dir)
    return draw(model.field, model.codes.weight[view].detach(), height, width)


# Drawing


@pytest.mark.parametrize(
    ("views", "loop", "count"), [([0, 8], False, 4), ([0, 4, 8], False, 7), ([0, 4, 8], True, 9), ([3, 3], False, 4)]
)
def test_a_path_of_k_views_has_so_many_frames_from_each_to_the_next(run, tmp_path, views, loop, count):
    found = render(RenderConfig(run=str(run), path=views, loop=loop, frames=3, out=str(tmp_path)))
    assert found == {"out": str(tmp_path), "frames": count, "height": 32, "width": 32}
    assert [file.name for file in frames(tmp_path)] == [f"frame_{k:05d}.png" for k in range(count)]
    with av.open(str(tmp_path / "interpolation.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == count
        assert (film.streams.video[0].height, film.streams.video[0].width) == (32, 32)
    with Image.open(tmp_path / "interpolation.gif") as film:
        assert film.size == (32, 32)
        if views == [0, 4, 8]:
            assert film.n_frames == count
    others = {file.name for file in tmp_path.iterdir()} - {file.name for file in frames(tmp_path)}
    assert others == {"interpolation.mp4", "interpolation.gif"}


def test_frames_at_the_views_of_a_path_are_the_known_views_as_drawn(run, tmp_path):
    render(RenderConfig(run=str(run), path=[0, 4, 8], frames=2, format=FrameFormat.exr, out=str(tmp_path)))
    shown = [image.read(file) for file in frames(tmp_path, "exr")]
    for k, view in ((0, 0), (2, 4), (4, 8)):
        assert torch.allclose(shown[k], known(run, view), atol=1e-6)
    model = load(run)
    between = draw(model.field, (model.codes.weight[0] + model.codes.weight[4]).detach() / 2, 32, 32)
    assert torch.allclose(shown[1], between, atol=1e-6)


def test_a_png_frame_is_the_drawing_to_a_step_of_eight_bits(run, tmp_path):
    render(RenderConfig(run=str(run), path=[1, 2], frames=1, out=str(tmp_path)))
    assert (image.read(frames(tmp_path)[0]) - known(run, 1).clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-6


def test_without_a_path_the_endpoints_of_the_scene_are_taken(run, tmp_path):
    render(RenderConfig(run=str(run), frames=1, format=FrameFormat.exr, out=str(tmp_path)))
    first, last = (image.read(file) for file in frames(tmp_path, "exr"))
    assert torch.allclose(first, known(run, 2), atol=1e-6)
    assert torch.allclose(last, known(run, 6), atol=1e-6)


def test_exr_frames_are_not_clamped_and_are_in_the_units_of_the_images(bright_run, tmp_path):
    assert load(bright_run).about["white"] == 4
    render(RenderConfig(run=str(bright_run), path=[0, 2], frames=1, format=FrameFormat.exr, out=str(tmp_path)))
    shown, drawn = image.read(frames(tmp_path, "exr")[0]), known(bright_run, 0)
    assert torch.allclose(shown, 4 * drawn, rtol=1e-6, atol=1e-6)
    assert drawn.min() < 0  # three steps: there is something that clamping would have changed


def test_a_run_folder_is_enough_and_its_drawings_lie_in_it_under_the_time(run, tmp_path):
    alone = tmp_path / "elsewhere"
    (alone / "checkpoints").mkdir(parents=True)
    shutil.copy(run / "checkpoints" / "last.ckpt", alone / "checkpoints")
    found = render(RenderConfig(run=str(alone), frames=1, format=FrameFormat.none))
    (folder,) = (alone / "render").iterdir()
    assert found["out"] == str(folder)
    assert {file.name for file in folder.iterdir()} == {"interpolation.mp4", "interpolation.gif"}
    again = render(RenderConfig(run=str(alone), frames=1, format=FrameFormat.none))
    assert again["out"] != found["out"]


@pytest.mark.parametrize(("height", "width"), [(20, 24), (33, 70), (1, 5)])
def test_any_size_can_be_drawn(run, tmp_path, height, width):
    found = render(RenderConfig(run=str(run), path=[0, 8], frames=1, size=[height, width], out=str(tmp_path)))
    assert (found["height"], found["width"]) == (height, width)
    assert image.size(frames(tmp_path)[0]) == (height, width)


def test_twice_the_size_shows_the_same_picture_with_new_pixels_between(run, tmp_path):
    render(RenderConfig(run=str(run), path=[0, 8], frames=1, size=[64, 64], format=FrameFormat.exr, out=str(tmp_path)))
    assert torch.allclose(image.read(frames(tmp_path, "exr")[0])[::2, ::2], known(run, 0), atol=1e-5)


def test_smooth_easing_slows_down_at_the_views(run, tmp_path):
    def steps(easing):
        out = tmp_path / easing.value
        render(RenderConfig(run=str(run), path=[0, 8], frames=10, easing=easing, format=FrameFormat.exr, out=str(out)))
        shown = torch.stack([image.read(file) for file in frames(out, "exr")])
        return (shown[1:] - shown[:-1]).square().mean((1, 2, 3)).sqrt()

    smooth, linear = steps(Easing.smooth), steps(Easing.linear)
    assert smooth[0] < 0.5 * linear[0]
    assert smooth[-1] < 0.5 * linear[-1]
    assert smooth[4:6].mean() > linear[4:6].mean()


def test_corners_give_a_sheet_of_mixes_and_a_film_round_them(run, tmp_path):
    found = render(RenderConfig(run=str(run), corners=[0, 2, 6, 8], side=3, frames=5, out=str(tmp_path)))
    assert found["frames"] == len(frames(tmp_path)) == 5
    sheet = image.read(tmp_path / "sheet.png")
    assert sheet.shape == (3 * 32, 3 * 32, 3)
    model = load(run)
    codes = model.codes.weight.detach()
    centre = draw(model.field, codes[[0, 2, 6, 8]].mean(0), 32, 32)
    for row, column, expected in (
        (0, 0, known(run, 0)), (0, 2, known(run, 2)), (2, 0, known(run, 6)), (2, 2, known(run, 8)), (1, 1, centre),
    ):  # fmt: skip
        part = sheet[32 * row : 32 * row + 32, 32 * column : 32 * column + 32]
        assert (part - expected.clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-5


@pytest.mark.parametrize("kind", [FrameFormat.png, FrameFormat.exr])
def test_an_interrupted_drawing_goes_on_in_its_folder_and_ends_the_same(bright_run, tmp_path, monkeypatch, kind):
    """Where another was drawn before: of that nothing is left."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    asked = RenderConfig(run=str(bright_run), path=[0, 2], frames=5, format=kind, out=str(parts))
    render(dataclasses.replace(asked, path=[2, 0]))
    render(dataclasses.replace(asked, out=str(whole)))
    drawn = []

    def interrupted(*values):
        if len(drawn) == 2:
            raise KeyboardInterrupt
        drawn.append(1)
        return draw(*values)

    monkeypatch.setattr("viinter.render.draw", interrupted)
    with pytest.raises(KeyboardInterrupt, match=f"2 of 6 frames; the same command with out={re.escape(str(parts))}"):
        render(asked)
    assert len(frames(parts, kind.value)) == 2
    drawn.clear()
    monkeypatch.setattr("viinter.render.draw", lambda *values: drawn.append(1) or draw(*values))
    render(asked)
    assert len(drawn) == 4  # of six
    assert {file.name for file in parts.iterdir()} == {file.name for file in whole.iterdir()}
    for file in frames(whole, kind.value):  # their bytes hold the time
        assert torch.equal(image.read(parts / file.name), image.read(file))
    assert (parts / "interpolation.gif").read_bytes() == (whole / "interpolation.gif").read_bytes()


def test_frames_of_another_drawing_in_the_folder_are_drawn_anew(run, tmp_path, monkeypatch):
    monkeypatch.setattr("viinter.video.write_mp4", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        render(RenderConfig(run=str(run), path=[0, 8], frames=1, out=str(tmp_path)))
    monkeypatch.undo()
    render(RenderConfig(run=str(run), path=[4, 8], frames=1, out=str(tmp_path)))
    assert (image.read(frames(tmp_path)[0]) - known(run, 4).clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-6


def test_a_square_of_mixes_has_its_corners_in_reading_order_and_a_circle_touches_its_sides():
    corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])  # codes are their places: right, down
    assert square(corners, 3)[0, 2].tolist() == [1, 0]
    assert square(corners, 3)[2, 0].tolist() == [0, 1]
    assert square(corners, 3)[1, 1].tolist() == [0.5, 0.5]
    ring = circle(corners, 4)
    assert torch.allclose(ring, torch.tensor([[1.0, 0.5], [0.5, 1.0], [0.0, 0.5], [0.5, 0.0]]), atol=1e-6)


@pytest.mark.parametrize(
    ("values", "message"),
    [({"path": [0, 9]}, r"view 9 .* 9 known views, 0 to 8"), ({"path": [-1, 0]}, r"view -1"),
     ({"path": [3]}, r"path=\[3\].*two or more"), ({"path": []}, r"path=\[\]"),
     ({"corners": [0, 1, 2]}, r"corners=\[0, 1, 2\].*four"), ({"corners": [0, 1, 2, 99]}, r"view 99"),
     ({"path": [0, 1], "corners": [0, 1, 2, 3]}, r"path.*corners"),
     ({"size": [32]}, r"size=\[32\].*height,width"), ({"size": [0, 5]}, r"size=\[0, 5\]"),
     ({"size": [-4, 5]}, r"size="), ({"frames": 0}, r"frames=0"), ({"fps": 0.0}, r"fps=0"),
     ({"corners": [0, 1, 2, 3], "side": 1}, r"side=1"), ({"accelerator": "abacus"}, r"accelerator=abacus")],
)  # fmt: skip
def test_what_cannot_be_drawn_is_refused_before_anything_is_written(run, tmp_path, values, message):
    with pytest.raises(UserError, match=message):
        render(RenderConfig(run=str(run), out=str(tmp_path / "out"), **values))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("door", [lambda d: render(RenderConfig(run=d)), lambda d: evaluate(EvaluateConfig(run=d))])
def test_a_folder_that_is_no_run_is_refused_by_name(tmp_path, door):
    with pytest.raises(UserError, match=re.escape(str(tmp_path))):
        door(str(tmp_path))


# Measuring


@pytest.fixture(scope="module")
def evaluated(run):
    """What `evaluate` returned, and the checkpoint's bytes before."""
    before = (run / "checkpoints" / "last.ckpt").read_bytes()
    return evaluate(EvaluateConfig(run=str(run), finetune_steps=30, finetune_pixels=512)), before


def test_known_views_and_probes_measure_as_at_the_end_of_training(run, evaluated):
    trained, found = json.loads((run / "metrics.json").read_text()), evaluated[0]
    for kind in ("known", "novel", "novel_cells"):
        assert found[kind]["per_view"].keys() == trained[kind]["per_view"].keys()
        for name, errors in found[kind]["per_view"].items():
            assert errors == pytest.approx(trained[kind]["per_view"][name], rel=1e-9)
        for key in ("psnr", "ssim", "mse"):
            assert found[kind][key] == pytest.approx(trained[kind][key], rel=1e-9)
    assert found["novel_quarters"] == trained["novel_quarters"]  # there are none


@pytest.mark.parametrize(
    ("model", "precision"), [("paper", "64-true"), ("paper", "bf16-true"), ("paper", "bf16-mixed"), ("fast", "64-true")]
)
def test_a_run_of_another_precision_measures_as_at_the_end_of_training(make_config, tmp_path, model, precision):
    cfg = make_config(**{"model": model, "trainer.precision": precision})
    trained = train(cfg, tmp_path)
    keep_config(cfg, tmp_path)
    found = evaluate(EvaluateConfig(run=str(tmp_path), finetune_steps=2))
    assert found["known"] == trained["known"]
    assert found["novel"] == trained["novel"]
    assert found["finetuned"]["mse"] < found["novel"]["mse"]


def test_what_was_measured_is_written_beside_the_metrics(run, evaluated):
    assert json.loads((run / "evaluation.json").read_text()) == evaluated[0]


def test_finetuned_codes_show_the_probes_better_than_mixed_ones(evaluated):
    novel, finetuned = evaluated[0]["novel"], evaluated[0]["finetuned"]
    assert finetuned["per_view"].keys() == novel["per_view"].keys()
    assert finetuned["psnr"] > novel["psnr"] + 0.5
    for name, errors in finetuned["per_view"].items():
        assert errors["mse"] < 1.05 * novel["per_view"][name]["mse"]


def test_probes_are_registered_if_there_is_opencv(run, evaluated, tmp_path, monkeypatch, capsys):
    pytest.importorskip("cv2")
    novel, registered = evaluated[0]["novel"], evaluated[0]["registered"]
    assert registered["per_view"].keys() == novel["per_view"].keys()
    assert registered["psnr"] != novel["psnr"]
    monkeypatch.setitem(sys.modules, "cv2", None)
    shutil.copytree(run, tmp_path / "run")
    found = evaluate(EvaluateConfig(run=str(tmp_path / "run"), finetune_steps=0))
    assert "registered" not in found
    assert found["novel"] == novel
    assert 'not registered: optical flow needs OpenCV: pip install "viinter[peers]"' in capsys.readouterr().out


def test_finetuning_leaves_field_and_codes_as_they_were(run, evaluated):
    assert (run / "checkpoints" / "last.ckpt").read_bytes() == evaluated[1]


def test_finetuning_does_not_touch_the_model_in_memory(run, monkeypatch):
    from viinter import evaluate as door

    models = []
    monkeypatch.setattr(door, "load", lambda *args: models.append(load(*args)) or models[-1])
    evaluate(EvaluateConfig(run=str(run), finetune_steps=2))
    stored = checkpoint_of(run)["state_dict"]
    now = models[0].state_dict()
    assert now.keys() == stored.keys()
    assert all(torch.equal(now[key], stored[key]) for key in stored)
    assert all(p.grad is None for p in models[0].parameters())


def test_without_finetune_steps_there_are_no_finetuned_codes(run, tmp_path, capsys):
    shutil.copytree(run, tmp_path / "run")
    found = evaluate(EvaluateConfig(run=str(tmp_path / "run"), finetune_steps=0))
    assert "finetuned" not in found
    assert "finetuning codes" not in capsys.readouterr().out
    assert found["novel"]["psnr"] is not None


def test_kinds_of_probes_that_a_scene_has_not_are_not_shown(run, tmp_path, capsys):
    shutil.copytree(run, tmp_path / "run")
    found = evaluate(EvaluateConfig(run=str(tmp_path / "run"), finetune_steps=0))
    empty = {kind for kind, values in found.items() if not values["per_view"]}
    assert empty
    assert set(re.findall(r"^(\w+) +\d+ views", capsys.readouterr().out, re.M)) == found.keys() - empty


def test_an_interrupted_evaluation_goes_on_and_ends_the_same(run, tmp_path, monkeypatch):
    shutil.copytree(run, tmp_path / "run")
    asked = EvaluateConfig(run=str(tmp_path / "run"), finetune_steps=3, finetune_pixels=512, chunk_pixels=4096)
    whole = evaluate(asked)
    (tmp_path / "run" / "evaluation.json").unlink()
    drawn = []

    def interrupted(*values):
        if len(drawn) == 5:  # two probes at a time
            raise KeyboardInterrupt
        drawn.append(1)
        return draw(*values)

    monkeypatch.setattr("viinter.evaluate.draw", interrupted)
    count = len(whole["finetuned"]["per_view"])
    with pytest.raises(KeyboardInterrupt, match=f"with 4 of {count} codes finetuned; the same command goes on"):
        evaluate(asked)
    assert not (tmp_path / "run" / "evaluation.json").exists()
    drawn.clear()
    monkeypatch.setattr("viinter.evaluate.draw", lambda *values: drawn.append(1) or draw(*values))
    monkeypatch.setattr("viinter.evaluate.measure", lambda *_: 1 / 0)
    assert evaluate(asked) == whole
    assert len(drawn) == count - 4
    monkeypatch.undo()
    assert {file.name for file in (tmp_path / "run").iterdir()} == {file.name for file in run.iterdir()} | {
        "evaluation.json"
    }


@pytest.mark.parametrize("change", ["settings", "checkpoint"])
def test_what_another_evaluation_left_is_not_taken(run, tmp_path, monkeypatch, change):
    shutil.copytree(run, tmp_path / "run")
    asked = EvaluateConfig(run=str(tmp_path / "run"), finetune_steps=2, finetune_pixels=64)
    monkeypatch.setattr("viinter.evaluate.finetune", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        evaluate(asked)
    if change == "settings":
        asked.finetune_lr = 0.1
    else:
        (tmp_path / "run" / "checkpoints" / "last.ckpt").touch()
    monkeypatch.setattr("viinter.evaluate.measured", lambda *_: {}["measured anew"])
    with pytest.raises(KeyError, match="measured anew"):
        evaluate(asked)


def test_a_scene_without_probes_is_evaluated_on_its_known_views(make_config, tmp_path):
    cfg = make_config("pair", **{"optim.steps": 2})
    train(cfg, tmp_path)
    keep_config(cfg, tmp_path)
    found = evaluate(EvaluateConfig(run=str(tmp_path)))
    assert found.keys() == {"known", "novel"}
    assert found["novel"]["psnr"] is None


@pytest.mark.parametrize("change", ["an image more", "another size", "gone"])
def test_a_scene_that_has_changed_since_training_is_refused(tmp_path, change):
    root = draw_folder(tmp_path / "scene", 3)
    cfg = settings("folder", root, {"optim.steps": 2})
    train(cfg, tmp_path / "run")
    keep_config(cfg, tmp_path / "run")
    if change == "an image more":
        image.write(root / "3.png", torch.rand(32, 32, 3))
    else:
        shutil.rmtree(root)
    if change == "another size":
        draw_folder(root, 3, side=24)
    with pytest.raises(UserError, match=re.escape(str(root))):
        evaluate(EvaluateConfig(run=str(tmp_path / "run")))


def test_a_scene_that_has_moved_is_found_where_paths_data_says(tmp_path, make_config):
    draw_folder(tmp_path / "here" / "set", 2)
    cfg = settings("folder", tmp_path / "here" / "set", {"optim.steps": 2, "paths.data": str(tmp_path / "here")})
    train(cfg, tmp_path / "run")
    keep_config(cfg, tmp_path / "run")
    file = tmp_path / "run" / ".hydra" / "config.yaml"  # as the files of conf/scene say it
    file.write_text(file.read_text().replace(f"root: {tmp_path}/here/set", "root: ${paths.data}/set"))
    shutil.move(tmp_path / "here", tmp_path / "there")
    found = evaluate(EvaluateConfig(run=str(tmp_path / "run"), data=str(tmp_path / "there")))
    assert found["known"]["psnr"] > 0
