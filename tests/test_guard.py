"""Losses and gradients that are not finite, put into runs at random steps: where they do not get to, what they cost."""

import json
import math
import random

import lightning as L
import pytest
import torch
from conftest import REPOSITORY, WITH_TOWER, Crash, CrashAt, checkpoint_of, same, settings, trained, without_times
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.precision import MixedPrecision
from torch.nn.utils import get_total_norm

from viinter import callbacks, guard
from viinter.data import SceneData
from viinter.guard import EVERY, MOST, DivergenceError, DivergenceGuard
from viinter.module import ViewInterpolator
from viinter.scenes import load
from viinter.train import about, train

DEMO_IMAGES = REPOSITORY / "data" / "demo" / "images"
FAST = {"model": "fast", "model.layers": 2, "optim.lr": 0.02, "optim.beta2": 0.99, "optim.pixels_from": "rows"}


def spoiled(loss, what, parameters):
    """`loss`, or its gradient alone, not finite or (huge) too large for Adam's square of it."""
    if what == "loss nan":
        return loss * math.nan
    if what == "loss inf":
        return loss * math.inf
    if what == "loss inf with a finite gradient":
        return loss + math.inf
    factor = {"gradient nan": math.nan, "gradient inf": math.inf, "gradient huge": 1e30}[what]
    hooks = []

    def spoil(gradient):
        for hook in hooks:
            hook.remove()
        gradient = gradient.clone()
        gradient.view(-1)[-1] = factor
        return gradient

    hooks.append(parameters[-1].register_hook(spoil))
    return loss


WHATS = ["loss nan", "loss inf", "loss inf with a finite gradient", "gradient nan", "gradient inf", "gradient huge"]


@pytest.fixture
def spoil(monkeypatch):
    """`spoil(steps, what)`: the pixel steps of these numbers go wrong in this way."""

    def install(steps, what="loss nan"):
        steps, step = set(steps), ViewInterpolator.training_step

        def training_step(self, *args):
            loss = step(self, *args)
            if self.trainer.global_step in steps:
                loss = spoiled(loss, what, [self.codes.weight])
            return loss

        monkeypatch.setattr(ViewInterpolator, "training_step", training_step)

    return install


class Steps(L.Callback):
    """The weights and Adam's state before and after each optimiser step, as copies."""

    def __init__(self):
        self.seen = []

    def on_train_start(self, trainer, module):
        optimizer = trainer.optimizers[0]
        inner = optimizer.step

        def state():
            weights = [p.detach().clone() for p in guard.weights_of(optimizer)]
            moments = [{k: v.clone() for k, v in optimizer.state.get(p, {}).items()}
                       for p in guard.weights_of(optimizer)]  # fmt: skip
            return weights, moments

        def step(*args, **kwargs):
            before = state()
            found = inner(*args, **kwargs)
            self.seen.append((trainer.global_step, before, state()))
            return found

        optimizer.step = step


def tensors(state):
    return [*state[0], *(t for moments in state[1] for t in moments.values())]


@pytest.mark.parametrize("what", WHATS)
@pytest.mark.parametrize("model", [{}, FAST], ids=["paper", "fast"])
def test_a_bad_step_changes_no_weight_no_code_and_no_moment(make_config, tmp_path, spoil, model, what):
    bad = random.Random(f"{model}{what}").randrange(0, 2 * EVERY)
    spoil([bad], what)
    steps = Steps()
    found = train(make_config(**{"optim.steps": 3 * EVERY, **model}), tmp_path, more_callbacks=[steps])
    assert len(steps.seen) == 3 * EVERY
    for _, _, after in steps.seen:
        assert all(torch.isfinite(t).all() for t in tensors(after))
    _, before, after = steps.seen[bad]
    assert same(before[0], after[0])
    # Adam makes its moments, zeros, at a weight's first step, good or bad
    for moments, now in zip(before[1], after[1], strict=True):
        assert same(moments or {k: torch.zeros_like(v) for k, v in now.items()}, now)
    notice = (bad // EVERY + 1) * EVERY
    gradients = what != "loss inf with a finite gradient"
    assert found["restarts"] == 1
    assert found["restarted"] == [
        {"step": notice, "back_to": notice - EVERY, "rate": 0.5, "losses": int("loss" in what), "gradients": gradients}
    ]
    # the state that the step after the restart found is that of the last reading before
    assert same(steps.seen[notice][1][0], steps.seen[notice - EVERY][1][0])
    if notice > EVERY:
        assert same(steps.seen[notice][1][1], steps.seen[notice - EVERY][1][1])


@pytest.mark.parametrize("what", WHATS)
def test_a_bad_interpolation_step_changes_nothing_either(make_config, tmp_path, fake_tower, monkeypatch, what):
    inner, calls, steps = callbacks.interpolation_loss, [], Steps()

    def loss(seen, *args):
        calls.append(0)
        found = inner(seen, *args)
        return spoiled(found, what, [seen]) if len(calls) == 7 else found

    monkeypatch.setattr(callbacks, "interpolation_loss", loss)
    cfg = make_config(**{**WITH_TOWER, "interpolation.every": 1, "optim.steps": EVERY + 2})
    found = train(cfg, tmp_path, more_callbacks=[steps])
    assert found["restarts"] == 1
    assert len(calls) == EVERY + 2
    for _, _, after in steps.seen:
        assert all(torch.isfinite(t).all() for t in tensors(after))
    _, before, after = steps.seen[2 * 7 - 1]
    assert same(before, after)


DEMO = {"scene.downsample": 8, "optim.steps": 400, "optim.batch_pixels": 512, "model.width": 32, "model.depth": 3}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return train(settings("planar", DEMO_IMAGES, dict(DEMO)), tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.parametrize("step", [1, random.Random(5).randrange(2, 399), 399])
def test_a_bad_step_anywhere_costs_less_than_a_third_of_a_decibel(make_config, tmp_path, undisturbed, spoil, step):
    spoil([step], random.Random(step).choice(WHATS))
    found = train(make_config("planar", DEMO_IMAGES, **DEMO), tmp_path)
    assert found["restarts"] == 1
    for kind in ("known", "novel"):
        assert found[kind]["psnr"] > undisturbed[kind]["psnr"] - 0.3


@pytest.mark.parametrize("model", [{}, FAST], ids=["paper", "fast"])
def test_a_run_without_bad_steps_is_the_run_without_a_guard(make_config, tmp_path, monkeypatch, model):
    cfg = make_config(**{"optim.steps": 30, **model})
    found = train(cfg, tmp_path / "guarded")
    assert (found["restarts"], found["restarted"]) == (0, [])
    for name in [name for name in vars(DivergenceGuard) if name.startswith("on_")]:
        monkeypatch.setattr(DivergenceGuard, name, getattr(L.Callback, name))
    train(cfg, tmp_path / "bare")
    assert same(trained(tmp_path / "guarded"), trained(tmp_path / "bare"))


def test_the_rate_is_halved_at_each_restart_and_comes_back_with_good_steps(make_config, tmp_path, spoil):
    spoil([3, 7])

    class Rates(L.Callback):
        seen = ()

        def on_train_batch_end(self, trainer, *_):
            self.seen = (*self.seen, trainer.optimizers[0].param_groups[0]["lr"] / 1e-3)

    rates = Rates()
    cfg = make_config(**{"optim.steps": 60, "optim.lr_decay": 1.0})
    found = train(cfg, tmp_path, more_callbacks=[rates])
    assert [event["rate"] for event in found["restarted"]] == [0.5, 0.25]
    # the second restart comes before the rate is back, and waits four times as long
    assert rates.seen == pytest.approx([1] * 5 + [0.5] * 5 + [0.25] * 20 + [0.5] * 20 + [1] * 10)


def test_a_state_that_had_already_gone_wrong_is_not_kept(make_config, tmp_path, monkeypatch, spoil):
    """Before the bad step come readings at which all is finite and the loss absurd: it goes back to before them."""
    spoil([5 * EVERY])
    inner = DivergenceGuard.on_train_batch_end

    def end(self, trainer, module, outputs, *args):
        absurd = EVERY < trainer.global_step <= 5 * EVERY
        inner(self, trainer, module, {"loss": outputs["loss"] * (1e6 if absurd else 1)}, *args)

    monkeypatch.setattr(DivergenceGuard, "on_train_batch_end", end)
    (event,) = train(make_config(**{"optim.steps": 7 * EVERY}), tmp_path)["restarted"]
    assert (event["step"], event["back_to"]) == (6 * EVERY, EVERY)


def test_weights_that_a_finite_gradient_has_thrown_off_are_brought_back(make_config, tmp_path, monkeypatch):
    class Throw(L.Callback):
        def on_train_batch_end(self, trainer, module, *_):
            if trainer.global_step == 2 * EVERY:
                with torch.no_grad():
                    module.field.rgb.bias[0] = math.inf

    found = train(make_config(**{"optim.steps": 2 * EVERY}), tmp_path, more_callbacks=[Throw()])
    (event,) = found["restarted"]
    assert (event["step"], event["back_to"]) == (2 * EVERY, EVERY)
    assert found["known"]["psnr"] is not None
    assert all(torch.isfinite(t).all() for t in checkpoint_of(tmp_path)["state_dict"].values())


@pytest.mark.parametrize("model", [{}, FAST], ids=["paper", "fast"])
def test_a_run_that_goes_wrong_again_and_again_stops_and_says_what_to_change(make_config, tmp_path, spoil, model):
    spoil(range(30, 10_000))
    cfg = make_config(**{**model, "optim.steps": 10_000, "trainer.precision": "bf16-mixed"})
    with pytest.raises(DivergenceError) as error:
        train(cfg, tmp_path)
    message = str(error.value)
    assert f"step {30 + (MOST + 1) * EVERY}:" in message
    assert f"after {MOST} restarts" in message
    for key in (f"optim.lr={cfg.optim.lr:g}", f"{cfg.optim.lr / 1000:g}", "trainer.precision=bf16-mixed"):
        assert key in message
    assert "alpha" not in message


def test_a_rate_that_throws_everything_off_ends_as_a_message_on_the_command_line(command_line, drawn, tmp_path):
    said = command_line(
        "viinter.train", "scene=planar", f"scene.root={drawn('planar')}", "scale=smoke", "optim.lr=1e38",
        "optim.steps=1000", "trainer.accelerator=cpu", cwd=tmp_path,
    )  # fmt: skip
    assert said.code == 1
    assert "DivergenceError: training diverged" in said.err
    assert "optim.lr=1e+38" in said.err
    assert "Traceback" not in said.err


@pytest.mark.parametrize("model", [{}, FAST], ids=["paper", "fast"])
def test_a_resumed_run_restarts_where_the_uninterrupted_one_does(make_config, tmp_path, spoil, model):
    """The bad step lies between the last good state and the interruption, its notice after it."""
    spoil([3, 27])
    cfg = make_config(**{"optim.steps": 50, "checkpoint.every_seconds": 1e-9, **model})
    straight = train(cfg, tmp_path / "straight")
    assert [event["step"] for event in straight["restarted"]] == [5, 30]
    for resume, step in ((False, 13), (True, 28)):
        with pytest.raises(Crash):
            train(cfg, tmp_path / "resumed", resume=resume, more_callbacks=[CrashAt(step)])
    resumed = train(cfg, tmp_path / "resumed", resume=True)
    assert same(trained(tmp_path / "straight"), trained(tmp_path / "resumed"))
    assert without_times(straight) == without_times(resumed)


def test_restarts_are_in_metrics_json_tensorboard_and_the_log(make_config, tmp_path, spoil, caplog):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    spoil([3, 12])
    train(make_config(**{"optim.steps": 30}), tmp_path)
    read = json.loads((tmp_path / "metrics.json").read_text())
    assert read["restarts"] == 2
    assert [event["back_to"] for event in read["restarted"]] == [0, 10]
    board = EventAccumulator(str(tmp_path))
    board.Reload()
    assert [(e.step, e.value) for e in board.Scalars("run/restarts")] == [(5, 1), (15, 2)]
    assert [r.message for r in caplog.records if r.name == "viinter"] == [
        f"not finite at or before step {step}: 1 losses and 1 gradients of the last steps; back to step {back}"
        f" at {rate} of the rate"
        for step, back, rate in ((5, 0, 0.5), (15, 10, 0.5))
    ]


def test_the_device_is_waited_for_only_at_readings(make_config, tmp_path, monkeypatch):
    asked = []
    for name in ("item", "tolist", "__bool__", "__float__"):
        inner = getattr(torch.Tensor, name)
        monkeypatch.setattr(torch.Tensor, name, lambda self, inner=inner: (asked.append(1), inner(self))[1])
    waits, hooks = [], [name for name in vars(DivergenceGuard) if name.startswith("on_")]

    def counting(inner):
        def counted(*args):
            before = len(asked)
            inner(*args)
            waits.append(len(asked) - before)

        return counted

    for name in hooks:
        monkeypatch.setattr(DivergenceGuard, name, counting(getattr(DivergenceGuard, name)))
    train(make_config(**{"optim.steps": 3 * EVERY}), tmp_path)
    assert len([n for n in waits if n]) == 3 + 1  # steps 0, 5, 10, and the end


@pytest.mark.filterwarnings("ignore:.isinstance.treespec, LeafSpec:FutureWarning")
@pytest.mark.parametrize("what", ["loss nan", "loss inf with a finite gradient", "gradients overflow"])
def test_with_a_gradient_scaler_too(make_config, tmp_path, monkeypatch, what):
    """float16 with a scaler, which Lightning keeps for GPUs: here on the CPU, put together by hand."""
    cfg = make_config(**{"optim.steps": 100})
    scene = load(cfg.scene)
    model = ViewInterpolator(cfg, scene.n, about(scene))
    plugin = MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu"))
    step = ViewInterpolator.training_step

    def training_step(self, *args):
        loss = step(self, *args)
        if what == "gradients overflow" and self.trainer.global_step >= 30:
            return loss * 1e38
        return spoiled(loss, what, []) if self.trainer.global_step == 30 else loss

    monkeypatch.setattr(ViewInterpolator, "training_step", training_step)
    watch, steps = DivergenceGuard(), Steps()
    trainer = L.Trainer(
        accelerator="cpu", max_steps=100, callbacks=[watch, steps], logger=TensorBoardLogger(tmp_path),
        plugins=[plugin], enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(model, SceneData(scene, 256, cfg.optim.pixels_from, 0))
    assert torch.isfinite(get_total_norm(guard.weights_of(trainer.optimizers[0])))
    assert all(torch.isfinite(t).all() for _, _, after in steps.seen for t in tensors(after))
    if what == "gradients overflow":
        assert watch.restarts
        assert plugin.scaler.get_scale() > 0
    else:
        (event,) = watch.restarts
        assert (event["step"], event["back_to"], event["losses"]) == (35, 30, 1)
