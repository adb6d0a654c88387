"""Training steps as CUDA graphs. What needs a GPU is skipped where there is none."""

import pytest
import torch
from torch.fx.experimental.proxy_tensor import make_fx

from viinter import module as modules
from viinter.config import TrainConfig
from viinter.data import PixelBatch
from viinter.fields.field import Field
from viinter.module import ViewInterpolator
from viinter.replay import ReplayedLoss
from viinter.train import train
from viinter.twin import relative

gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
SIDE = 64
FIELDS = pytest.mark.parametrize(("name", "views"), [("fast", 5), ("fast", 3), ("paper", 5)])  # 3: mixes are held too


def model_and_batches(cfg: TrainConfig, device: str, views: int = 5) -> tuple[ViewInterpolator, list[PixelBatch]]:
    torch.manual_seed(0)
    model = ViewInterpolator(cfg, views, {"height": SIDE, "width": SIDE}).to(device)
    batches = []
    for _ in range(2):
        y, x = torch.meshgrid(torch.rand(12) * 2 - 1, torch.arange(SIDE) * 2 / SIDE - 1, indexing="ij")
        batch = torch.randint(views, (12,)), torch.stack([x, y], -1), torch.rand(12, SIDE, 3)
        batches.append(PixelBatch(*(part.to(device) for part in batch)))
    model.field.see(torch.rand(views, SIDE, SIDE, 3, device=device), model.codes.weight)
    return model, batches


def loss_and_gradients(model: ViewInterpolator, loss) -> list[torch.Tensor]:
    found = torch.autograd.grad(loss, list(model.parameters()), allow_unused=True)
    return [loss.detach(), *(g for g in found if g is not None)]


def change(model: ViewInterpolator) -> None:
    with torch.no_grad():
        for p in model.parameters():
            p += 0.01 * torch.randn_like(p)


@FIELDS
def test_within_a_stage_a_step_does_not_depend_on_what_python_decides(make_config, name, views):
    """A trace, like a CUDA graph, holds the operations of one step; it must be right for others of the same stage."""
    model, (first, second) = model_and_batches(make_config(model=name), "cpu", views)
    model.field.at(0.4, 401)
    stage = model.field.stage()
    change(model)
    traced = make_fx(lambda *batch: loss_and_gradients(model, model.loss(*batch)))(*first)
    for step in range(402, 408):
        model.field.at(0.4 + step / 1e4, step)
        assert model.field.stage() == stage
        assert relative(traced(*second), loss_and_gradients(model, model.loss(*second))) < 1e-6
    assert relative(traced(*first), traced(*second)) > 1e-3


def test_stages_follow_the_levels(make_config):
    model, _ = model_and_batches(make_config(model="fast"), "cpu")
    stages = []
    for progress in (0.0, 0.2, 1.0):
        model.field.at(progress, 0)
        stages.append(model.field.stage())
    assert stages == [0, 0, 1]
    assert modules.make_field(make_config(), 2, 8, 8).stage() == 0
    assert Field().stage() is None


@gpu
@FIELDS
@pytest.mark.parametrize("progress", [0.1, 0.6])
def test_a_replayed_loss_is_the_loss(make_config, name, views, progress):
    model, (first, second) = model_and_batches(make_config(model=name), "cuda", views)
    model.field.at(progress, 401)
    replayed = ReplayedLoss(model.loss, list(model.parameters()), first)
    for step in range(402, 408):
        change(model)
        model.field.at(progress + step / 1e5, step)
        model.train(step % 2 == 0).train()  # what is kept from step to step is forgotten then
        ours = loss_and_gradients(model, replayed(*second))
        exact = loss_and_gradients(model, model.loss(*second))
        assert relative(ours[:1], exact[:1]) < 1e-5
        assert relative(ours[1:], exact[1:]) < 1e-3  # a GPU adds gradients up in any order
        first, second = second, first


@gpu
@pytest.mark.parametrize("name", ["fast", "paper"])
def test_a_step_on_a_gpu_is_captured_once_for_each_stage_and_not_under_autocast(make_config, monkeypatch, name):
    captured = []
    monkeypatch.setattr(modules, "ReplayedLoss", lambda *args: captured.append(1) or ReplayedLoss(*args))
    model, batches = model_and_batches(make_config(model=name), "cuda")
    for progress in (0.0, 0.1, 0.5, 0.9):
        for batch in batches:
            model.field.at(progress, 1)
            model.training_step(batch, 0)
    assert len(captured) == (2 if name == "fast" else 1)
    with torch.autocast("cuda", torch.bfloat16):
        model.training_step(batches[0], 0)
    assert len(captured) == (2 if name == "fast" else 1)


@gpu
@pytest.mark.parametrize("name", ["fast", "paper"])
def test_a_run_on_a_gpu_stays_there(make_config, tmp_path, monkeypatch, name):
    """Its film is drawn there too, and `metrics.json` names it."""
    drawn = []
    monkeypatch.setattr("viinter.train.show", lambda cfg, scene, module, *_: drawn.append(module.device.type))
    values = {"trainer.accelerator": "cuda", "logging.pictures": True, "optim.steps": 60}
    metrics = train(make_config(model=name, **values), tmp_path)
    assert drawn == ["cuda"]
    assert metrics["device"] == "cuda:0"
    assert metrics["hardware"] == torch.cuda.get_device_name(0)
    assert metrics["peak_device_memory_mb"] > 0
    assert name == "paper" or metrics["known"]["psnr"] > 50


@gpu
def test_a_bad_step_on_a_gpu_is_noticed_and_taken_back(make_config, tmp_path, monkeypatch):
    """A loss that is not finite comes out of the graph as it would otherwise."""
    plain = ViewInterpolator.training_step

    def spoilt(self: ViewInterpolator, batch: PixelBatch, k: int) -> torch.Tensor:
        return plain(self, batch._replace(rgb=batch.rgb * torch.nan) if k == 12 else batch, k)

    monkeypatch.setattr(ViewInterpolator, "training_step", spoilt)
    values = {"trainer.accelerator": "cuda", "optim.steps": 40}
    metrics = train(make_config(model="fast", **values), tmp_path)
    assert metrics["restarts"] == 1
    assert metrics["known"]["psnr"] > 50
