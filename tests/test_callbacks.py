"""What happens around a pixel step: codes on the sphere, the interpolation step, the budget, errors over time."""

import copy
import csv
import itertools
import math
import re
from types import SimpleNamespace

import lightning as L
import pytest
import torch
from conftest import WITH_TOWER, checkpoint_of

from viinter import callbacks, checkpoints, features, metrics, pictures, scenes
from viinter.callbacks import Budget, Clock, ErrorClock, InterpolationLoss, RenormalizeCodes, ViewLogger
from viinter.checkpoints import Interruption, SaveCheckpoint
from viinter.config import InterpolationConfig, OptimConfig, Patches
from viinter.fields.paper import PaperField
from viinter.guard import DivergenceGuard
from viinter.module import ViewInterpolator
from viinter.train import train
from viinter.views import draw, pixel_grid


class Watch(L.Callback):
    """Calls a function after each step, when all other callbacks are done; keeps the trainer and its module."""

    def __init__(self, after_step=lambda trainer, module: None):
        self.after_step = after_step

    def on_train_start(self, trainer, module):
        self.trainer, self.module = trainer, module

    def on_train_batch_end(self, trainer, module, *_):
        self.after_step(trainer, module)


class Crash(RuntimeError):
    pass


def crash_at(step):
    """A callback that ends the process, as far as training can tell, after so many steps."""

    def after_step(trainer, module):
        if trainer.global_step == step:
            raise Crash

    return Watch(after_step)


@pytest.fixture
def stopwatch(monkeypatch):
    """Time stands still, but for a quarter of a second in each pixel step (a binary fraction: sums are exact)."""
    watch = SimpleNamespace(now=100.0, perf_counter=lambda: watch.now)
    monkeypatch.setattr(callbacks, "time", watch)
    monkeypatch.setattr(checkpoints, "time", watch)
    step = ViewInterpolator.training_step

    def slow(self, *args):
        watch.now += 0.25
        return step(self, *args)

    monkeypatch.setattr(ViewInterpolator, "training_step", slow)
    return watch


def takes(monkeypatch, watch, owner, name, seconds):
    """Lets `owner.name` take so many seconds on the stopwatch."""
    inner = getattr(owner, name)

    def slow(*args, **kwargs):
        watch.now += seconds
        return inner(*args, **kwargs)

    monkeypatch.setattr(owner, name, slow)


# Codes on the sphere


@pytest.fixture
def entering(monkeypatch):
    """The code book, in float64, as each pixel step found it."""
    books, step = [], ViewInterpolator.training_step

    def recording(self, *args):
        books.append(self.codes.weight.detach().double().clone())
        return step(self, *args)

    monkeypatch.setattr(ViewInterpolator, "training_step", recording)
    return books


def norms(books, p):
    return torch.cat([torch.linalg.vector_norm(book, ord=float(p), dim=1) for book in books])


@pytest.mark.parametrize("tower", [{}, WITH_TOWER], ids=["pixels alone", "with the interpolation step"])
@pytest.mark.parametrize("p", ["inf", "2", "1.5", "1", "3"])
def test_codes_are_on_the_sphere_as_they_enter_every_pixel_step(make_config, tmp_path, entering, fake_tower, p, tower):
    cfg = make_config(**{"codes.p": p, "model.code_dim": 128, "optim.lr": 1e-2, **tower})
    train(cfg, tmp_path)
    assert len(entering) == 6
    assert (norms(entering, p) - 1).abs().max() < 1e-6
    assert (entering[1] - entering[0]).abs().max() > 1e-6  # and they do move


@pytest.mark.parametrize("radius", [100.0, 0.01])
@pytest.mark.parametrize("p", ["2", "1"])
def test_the_sphere_has_the_radius_asked_for(make_config, tmp_path, entering, p, radius):
    train(make_config(**{"codes.p": p, "codes.radius": radius, "optim.lr": radius / 100}), tmp_path)
    assert (norms(entering, p) / radius - 1).abs().max() < 1e-6


def test_without_a_norm_codes_go_where_the_optimiser_takes_them(make_config, tmp_path, entering):
    train(make_config(**{"codes.p": "none", "optim.lr": 1e-2}), tmp_path)
    assert norms(entering, 2)[:9].std() > 0.1
    moved = (entering[1] - entering[0]).abs()
    assert moved.max() == pytest.approx(1e-2, rel=1e-2)  # Adam's first step, untouched


def test_codes_are_on_the_sphere_after_a_resume(make_config, tmp_path, entering, fake_tower):
    cfg = make_config(**{"checkpoint.every_seconds": 1e-9, "optim.lr": 1e-2, **WITH_TOWER})
    with pytest.raises(Crash):
        train(cfg, tmp_path, more_callbacks=[crash_at(3)])
    left = checkpoint_of(tmp_path)["state_dict"]["codes.weight"].double()
    entering.clear()
    train(cfg, tmp_path, resume=True)
    assert len(entering) == 3
    assert torch.equal(entering[0], left)
    assert (norms(entering, 1) - 1).abs().max() < 1e-6


def test_codes_off_the_sphere_in_a_checkpoint_are_projected_before_the_first_step(make_config, tmp_path, entering):
    cfg = make_config(**{"checkpoint.every_seconds": 1e-9})
    with pytest.raises(Crash):
        train(cfg, tmp_path, more_callbacks=[crash_at(3)])
    found = checkpoint_of(tmp_path)
    found["state_dict"]["codes.weight"] *= 1.01
    torch.save(found, tmp_path / "checkpoints" / "last.ckpt")
    entering.clear()
    train(cfg, tmp_path, resume=True)
    assert (norms(entering, 1) - 1).abs().max() < 1e-6


# The interpolation step


def interpolation_steps(cfg, run_dir):
    """Trains, and returns for each pixel step whether an interpolation step followed it, and what was trained."""
    taken, last = [], None

    def after_step(trainer, module):
        nonlocal last
        now = next(c for c in trainer.callbacks if isinstance(c, InterpolationLoss)).last
        taken.append(now is not last)
        last = now

    watch = Watch(after_step)
    train(cfg, run_dir, more_callbacks=[watch])
    return taken, watch


@pytest.mark.parametrize("every", [1, 2, 3])
def test_the_interpolation_step_follows_every_so_manieth_pixel_step(make_config, tmp_path, fake_tower, every):
    taken, _ = interpolation_steps(make_config(**{"interpolation.every": every, **WITH_TOWER}), tmp_path)
    assert taken == [step % every == 0 for step in range(6)]


def test_interpolation_steps_do_not_count_as_steps(make_config, tmp_path, fake_tower):
    taken, watch = interpolation_steps(make_config(**WITH_TOWER), tmp_path)
    assert watch.trainer.global_step == len(taken) == 6
    states = checkpoint_of(tmp_path)["optimizer_states"][0]["state"].values()
    assert {int(state["step"]) for state in states} == {6 + 3}  # but they are the optimiser's


def test_known_views_are_embedded_once_and_each_interpolation_step_embeds_one_frame(make_config, tmp_path, fake_tower):
    interpolation_steps(make_config(**WITH_TOWER), tmp_path)
    assert fake_tower.calls == 1 + 9 + 3  # one to learn the length of the features


def test_the_interpolation_loss_is_alpha_times_the_mean_squared_distance_to_the_mixed_features(
    make_config, tmp_path, fake_tower, monkeypatch
):
    cfg = make_config(**{**WITH_TOWER, "interpolation.alpha": 0.3, "optim.lr": 1e-2})
    drawn = []
    monkeypatch.setattr(
        callbacks, "lerp", lambda zi, zj, t: drawn.append((zi.detach().clone(), zj.detach().clone(), t))
        or (1 - t) * zi + t * zj
    )  # fmt: skip
    inner, pairs = InterpolationLoss.on_train_batch_end, []

    def compared(self, trainer, module, *args):
        field, book, count = copy.deepcopy(module.field), module.codes.weight.detach().clone(), len(drawn)
        inner(self, trainer, module, *args)
        if len(drawn) == count:
            return
        zi, zj, t = drawn[-1]
        assert 0 <= t <= 1
        i, j = ((book == z).all(1).nonzero().item() for z in (zi, zj))
        views = trainer.datamodule.scene.views.permute(0, 3, 1, 2)
        target = (1 - t) * self.tower(views[i : i + 1])[0] + t * self.tower(views[j : j + 1])[0]
        book.requires_grad_()
        z = (1 - t) * book[i] + t * book[j]
        frame = field(pixel_grid(32, 32)[None], z[None])[0].reshape(32, 32, 3).permute(2, 0, 1)
        loss = 0.3 * (self.tower(frame[None])[0] - target).square().mean()
        pairs.append((i, j, t, self.last.item(), loss.item()))
        by_hand = torch.autograd.grad(loss, [*field.parameters(), book])
        trained = [*module.field.parameters(), module.codes.weight]
        for gradient, weight in zip(by_hand, trained, strict=True):  # of this loss alone, not of the pixels' too
            assert torch.allclose(weight.grad, gradient, rtol=1e-3, atol=1e-5 * gradient.abs().max().item())
        assert not any(torch.equal(a, b) for a, b in zip([*field.parameters(), book], trained, strict=True))

    monkeypatch.setattr(InterpolationLoss, "on_train_batch_end", compared)
    train(cfg, tmp_path)
    assert len(pairs) == 3
    assert len({pair[:3] for pair in pairs}) == 3  # other views, other t, each time
    for *_, found, expected in pairs:
        assert found == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("chunk", [1024, 1000, 100, 1])
def test_the_gradient_of_a_frame_drawn_in_chunks_is_that_of_the_whole_frame(fake_tower, chunk):
    torch.manual_seed(0)
    side, field, code = (8, 8) if chunk == 1 else (32, 32), PaperField(4, 8, 2), torch.randn(4)
    tower = features.load(SimpleNamespace(extractor="fake", patches=Patches.cover), "cpu")

    def gradients(pixels):
        callback = InterpolationLoss(InterpolationConfig(0.1, 2, pixels), tower, torch.zeros(2, 8), side, 0)
        z = code.clone().requires_grad_()
        frame = callback.frame(field, z)
        assert frame.shape == (1, 3, *side)
        return torch.autograd.grad(tower(frame).square().mean(), [*field.parameters(), z])

    for part, whole in zip(gradients(chunk), gradients(10**6), strict=True):
        assert torch.allclose(part, whole, rtol=1e-4, atol=1e-5 * whole.abs().max().item())


def test_a_frame_has_its_rows_and_columns_where_a_view_has_them(fake_tower):
    field, z = PaperField(4, 8, 2), torch.randn(4)
    callback = InterpolationLoss(InterpolationConfig(0.1, 2, 50), None, torch.zeros(2, 8), (5, 20), 0)
    assert torch.allclose(callback.frame(field, z)[0].permute(1, 2, 0), draw(field, z, 5, 20), atol=1e-6)


def test_the_interpolation_step_comes_before_the_projection_and_both_before_what_only_looks(
    make_config, tmp_path, fake_tower
):
    _, watch = interpolation_steps(make_config(**WITH_TOWER), tmp_path)
    kinds = [type(callback) for callback in watch.trainer.callbacks]
    order = [DivergenceGuard, Budget, InterpolationLoss, RenormalizeCodes, ErrorClock, ViewLogger, Interruption,
             SaveCheckpoint, Watch]  # fmt: skip
    assert [kind for kind in kinds if kind in order] == order


def test_without_alpha_no_tower_is_built_and_the_run_says_so(make_config, tmp_path, fake_tower, monkeypatch):
    def refuse(*_):
        raise AssertionError("features were asked for")

    monkeypatch.setattr(features, "load", refuse)
    monkeypatch.setattr(features, "embed_views", refuse)
    watch = Watch()
    found = train(make_config(**{"features.extractor": "fake"}), tmp_path, more_callbacks=[watch])
    assert fake_tower.calls == 0
    assert not [c for c in watch.trainer.callbacks if isinstance(c, InterpolationLoss)]
    (part,) = [part for part in found["omitted"] if part["part"] == "interpolation step and feature tower"]
    assert part["reason"] == "interpolation.alpha is 0"
    assert "viinter.bench alpha" in part["how"]


def test_a_projection_that_is_left_out_is_timed(make_config, tmp_path):
    found = train(make_config(**{"codes.p": "none", "optim.steps": 3}), tmp_path)
    (part,) = [part for part in found["omitted"] if part["part"] == "code projection"]
    assert 0 < part["seconds"] < found["training_seconds"]


def test_with_alpha_the_interpolation_step_is_not_among_the_omitted(make_config, tmp_path, fake_tower):
    found = train(make_config(**WITH_TOWER), tmp_path)
    assert not [part for part in found["omitted"] if "interpolation" in part["part"]]


# The clock and the budget


def test_a_paused_clock_stands_still(monkeypatch):
    watch = SimpleNamespace(now=0.0, perf_counter=lambda: watch.now)
    monkeypatch.setattr(callbacks, "time", watch)
    monkeypatch.setattr(checkpoints, "time", watch)
    clock = Clock()
    watch.now = 1.0
    assert clock.seconds == 0  # not started: setting up is not training
    clock.start()
    watch.now = 3.0
    with clock.paused():
        watch.now = 10.0
        with clock.paused():
            watch.now = 20.0
        assert clock.seconds == 2
    watch.now = 21.0
    assert clock.seconds == 3
    clock.stop()
    watch.now = 30.0
    with clock.paused():
        pass
    watch.now = 40.0
    assert clock.seconds == 3  # a pause does not start it
    assert clock.wall_seconds == 40


def test_a_clock_goes_on_from_its_state(monkeypatch):
    watch = SimpleNamespace(now=50.0, perf_counter=lambda: watch.now)
    monkeypatch.setattr(callbacks, "time", watch)
    monkeypatch.setattr(checkpoints, "time", watch)
    clock = Clock()
    clock.load_state_dict({"training_seconds": 7.0, "wall_seconds": 9.0})
    clock.start()
    watch.now = 51.0
    assert clock.state_dict() == {"training_seconds": 8.0, "wall_seconds": 10.0}


def test_nothing_but_training_steps_counts_as_training_seconds(make_config, tmp_path, stopwatch, monkeypatch):
    takes(monkeypatch, stopwatch, callbacks, "measure", 3)
    takes(monkeypatch, stopwatch, callbacks, "draw", 5)
    takes(monkeypatch, stopwatch, ViewLogger, "_scalars", 7)
    takes(monkeypatch, stopwatch, L.Trainer, "save_checkpoint", 11)
    slow = {"evaluation.first_seconds": 0.25, "evaluation.max_share": 1e9, "checkpoint.every_seconds": 1e-9}
    found = train(make_config(**{"logging.pictures": True, "logging.every_seconds": 0.25, **slow}), tmp_path)
    assert found["training_seconds"] == 6 * 0.25
    assert found["wall_seconds"] >= 6 * 0.25 + 5 * 3 + 6 * 7 + 6 * 11


@pytest.mark.parametrize("steps", [1, 7])
def test_a_budget_of_steps_ends_at_exactly_so_many(make_config, tmp_path, entering, steps):
    assert train(make_config(**{"optim.steps": steps}), tmp_path)["steps"] == len(entering) == steps


@pytest.mark.parametrize(("seconds", "steps"), [(1.0, 4), (1.1, 4), (1.25, 5), (0.1, 1)])
def test_a_step_that_would_end_beyond_a_budget_of_seconds_is_not_begun(
    make_config, tmp_path, stopwatch, seconds, steps
):
    """Steps of 0.25 s; the first is taken whatever it takes."""
    found = train(make_config(**{"optim.training_seconds": seconds}), tmp_path)
    assert (found["training_seconds"], found["steps"]) == (steps * 0.25, steps)


def test_what_the_first_step_takes_tells_nothing_of_the_next(make_config, tmp_path, stopwatch, monkeypatch):
    def at(field, progress, step):
        stopwatch.now += 0 if step else 5

    monkeypatch.setattr(PaperField, "at", at)
    assert train(make_config(**{"optim.training_seconds": 6.0}), tmp_path)["steps"] == 1 + 3  # 5.25 s and 3 of 0.25


def test_a_budget_of_real_seconds_is_kept_to_a_step(make_config, tmp_path):
    ends = []
    watch = Watch(lambda trainer, _: ends.append(trainer.callbacks[1].clock.seconds))
    found = train(make_config(**{"optim.training_seconds": 0.3}), tmp_path, more_callbacks=[watch])
    longest = max(b - a for a, b in itertools.pairwise([0, *ends]))
    off = found["training_seconds"] - 0.3
    assert -longest <= off <= longest + 0.3  # the last for a machine that does other things
    assert found["steps"] == len(ends) > 1


def test_what_a_field_does_after_the_last_step_is_within_the_budget(make_config, tmp_path, stopwatch, monkeypatch):
    """Steps of 0.25 s, drawing a view 0.5 s, five views to draw at the end, which may take half as long again: 20 of
    24.75 s are left for steps."""
    takes(monkeypatch, stopwatch, callbacks, "draw", 0.5)
    takes(monkeypatch, stopwatch, PaperField, "finish", 1.5 * 2.5)
    monkeypatch.setattr(PaperField, "settle", lambda field, seconds, n, batch, drawing: 5 * drawing())
    found = train(make_config(**{"optim.training_seconds": 24.75}), tmp_path)
    assert (found["training_seconds"], found["steps"]) == (24.75, (24.75 - 1.5 * 2.5 - 2 * 0.5) / 0.25)


def test_finishing_takes_at_most_half_of_a_budget_from_the_steps(make_config, tmp_path, stopwatch, monkeypatch):
    takes(monkeypatch, stopwatch, callbacks, "draw", 0.0)
    monkeypatch.setattr(callbacks, "seconds_to_draw", lambda *_: 100.0)
    monkeypatch.setattr(PaperField, "settle", lambda field, seconds, n, batch, drawing: n * drawing())
    assert train(make_config(**{"optim.training_seconds": 2.0}), tmp_path)["steps"] == 1.0 / 0.25


def test_the_schedule_begins_with_the_first_step_however_long_settling_took(
    make_config, tmp_path, stopwatch, monkeypatch
):
    """Steps of 0.25 s, ten seconds of settling: of 20 seconds half are left, and the schedule lies over these."""
    takes(monkeypatch, stopwatch, PaperField, "settle", 10.0)
    found, seen, values = rates(monkeypatch), [], {"optim.lr": 1e-3, "optim.lr_decay": 0.1}
    monkeypatch.setattr(PaperField, "at", lambda field, progress, step: seen.append(progress))
    metrics = train(make_config(**values, **{"optim.training_seconds": 20.0}), tmp_path)
    assert (metrics["training_seconds"], metrics["steps"]) == (20.0, 40)
    assert seen == pytest.approx([step / 40 for step in range(40)])
    assert found == pytest.approx([cosine(1e-3, 0.1, step / 40) for step in range(40)])


def test_a_schedule_that_goes_on_knows_where_it_began():
    trainer, cfg, clock = SimpleNamespace(global_step=0), OptimConfig(training_seconds=100.0), Clock()
    first, clock.before = Budget(cfg, clock), 40.0
    first.begun, first.kept_back = 20.0, 30.0
    assert first.progress(trainer) == pytest.approx((40 - 20) / (100 - 20 - 30))
    other = Budget(cfg, Clock())
    other.load_state_dict(first.state_dict())
    assert other.progress(trainer) == pytest.approx(first.progress(trainer))


def test_a_budget_that_settling_used_up_has_no_steps(make_config, tmp_path, stopwatch, monkeypatch):
    takes(monkeypatch, stopwatch, PaperField, "settle", 10.0)
    assert train(make_config(**{"optim.training_seconds": 9.0}), tmp_path)["steps"] == 0


def test_seconds_that_a_field_has_no_use_for_are_left_over(make_config, tmp_path, monkeypatch, capsys):
    """The schedule is laid over the steps that are of use; a budget of steps is kept."""
    passes = []

    def enough(field, steps_per_pass):
        passes.append(steps_per_pass)
        return 8

    monkeypatch.setattr(PaperField, "enough", enough)
    found = rates(monkeypatch)
    values = {"optim.lr": 1e-3, "optim.lr_decay": 0.1, "optim.training_seconds": 1000.0, "logging.progress": True}
    cfg = make_config(**values)
    metrics = train(cfg, tmp_path / "seconds")
    assert "ended before 1000 s" in capsys.readouterr().out
    assert metrics["steps"] == 8
    assert found == pytest.approx([cosine(1e-3, 0.1, step / 8) for step in range(8)], rel=0.01)
    pixels = metrics["views"] * metrics["height"] * metrics["width"]
    assert passes == [pixels / cfg.optim.batch_pixels]
    assert train(make_config(**{"optim.steps": 9}), tmp_path / "steps")["steps"] == 9


def rates(monkeypatch):
    found, step = [], ViewInterpolator.training_step

    def recording(self, *args):
        found.append(self.optimizers().param_groups[0]["lr"])
        return step(self, *args)

    monkeypatch.setattr(ViewInterpolator, "training_step", recording)
    return found


def cosine(first, decay, progress):
    return first * decay + (first - first * decay) * 0.5 * (1 + math.cos(math.pi * progress))


def test_the_rate_falls_along_a_cosine_over_the_steps(make_config, tmp_path, monkeypatch):
    found = rates(monkeypatch)
    train(make_config(**{"optim.lr": 1e-3, "optim.lr_decay": 0.1, "optim.steps": 8}), tmp_path)
    assert found == pytest.approx([cosine(1e-3, 0.1, step / 8) for step in range(8)])
    assert found[0] == 1e-3


def test_the_rate_falls_along_a_cosine_over_the_seconds(make_config, tmp_path, monkeypatch, stopwatch):
    found = rates(monkeypatch)
    train(make_config(**{"optim.lr": 1e-3, "optim.lr_decay": 0.2, "optim.training_seconds": 2.0}), tmp_path)
    assert found == pytest.approx([cosine(1e-3, 0.2, 0.25 * step / 2) for step in range(8)])


@pytest.mark.parametrize("past", [100, 101, 1000])
def test_the_rate_stays_at_its_end_past_the_schedule(past):
    steps = Budget(OptimConfig(steps=100, lr_decay=0.1), Clock())
    assert steps.factor(steps.progress(SimpleNamespace(global_step=past))) == pytest.approx(0.1)
    clock = Clock()
    clock.before = float(past)
    seconds = Budget(OptimConfig(training_seconds=100.0, lr_decay=0.1), clock)
    assert seconds.factor(seconds.progress(SimpleNamespace(global_step=0))) == pytest.approx(0.1)


def test_a_finished_run_takes_no_further_step_when_resumed(make_config, tmp_path, entering):
    cfg = make_config()
    before = train(cfg, tmp_path)
    weights = checkpoint_of(tmp_path)["state_dict"]
    entering.clear()
    after = train(cfg, tmp_path, resume=True)
    assert not entering
    assert (after["steps"], after["known"], after["novel"]) == (6, before["known"], before["novel"])
    assert all(torch.equal(weights[k], w) for k, w in checkpoint_of(tmp_path)["state_dict"].items())
    assert [int(row["step"]) for row in rows(tmp_path)] == [6]  # measured again, in the same place


# Error against run time


def rows(run_dir):
    with (run_dir / "error_vs_time.csv").open() as file:
        return list(csv.DictReader(file))


def test_the_table_of_errors_has_exactly_the_columns_of_the_design(make_config, tmp_path):
    train(make_config(), tmp_path)
    header = (tmp_path / "error_vs_time.csv").read_text().splitlines()[0]
    assert header == (
        "step,training_seconds,wall_seconds,known_mse,known_psnr,known_ssim,novel_mse,novel_psnr,novel_ssim,"
        "code_norm_min,code_norm_max,lr"
    )


def test_evaluations_come_at_geometrically_spaced_training_seconds(make_config, tmp_path, stopwatch, monkeypatch):
    takes(monkeypatch, stopwatch, callbacks, "measure", 100)
    spaced = {"evaluation.first_seconds": 1.0, "evaluation.factor": 2.0, "evaluation.max_share": 1e9}
    train(make_config(**{"optim.steps": 40, **spaced}), tmp_path)
    assert [float(row["training_seconds"]) for row in rows(tmp_path)] == [1, 2, 4, 8, 10]  # and the last
    assert [int(row["step"]) for row in rows(tmp_path)] == [4, 8, 16, 32, 40]
    walls = [float(row["wall_seconds"]) for row in rows(tmp_path)]
    assert [b - a for a, b in itertools.pairwise(walls)] == [101, 102, 104, 102]


def test_evaluations_take_no_more_than_their_share_of_the_training_seconds(
    make_config, tmp_path, stopwatch, monkeypatch
):
    takes(monkeypatch, stopwatch, callbacks, "draw", 1 / 32)
    takes(monkeypatch, stopwatch, callbacks, "measure", 21 / 32)  # 9 known views, 12 probes
    spaced = {"evaluation.first_seconds": 0.25, "evaluation.factor": 1.01, "evaluation.max_share": 0.5}
    train(make_config(**{"optim.steps": 60, **spaced}), tmp_path)
    during = [float(row["training_seconds"]) for row in rows(tmp_path)[:-1]]
    assert len(during) > 3
    for count, seconds in enumerate(during, 1):
        assert count * 21 / 32 <= 0.25 * seconds


def test_with_no_share_there_is_one_evaluation_at_the_end(make_config, tmp_path):
    train(make_config(**{"evaluation.first_seconds": 1e-6, "evaluation.max_share": 0.0}), tmp_path)
    assert [int(row["step"]) for row in rows(tmp_path)] == [6]


def test_the_last_measurement_of_views_that_take_long_to_draw_takes_evenly_spaced_ones(
    make_config, tmp_path, monkeypatch, capsys
):
    """Three and a half seconds a view: 30 s are enough for a third of 9 known views and 12 probes, 15 s for all of the
    4 cells, and for four frames of the film."""
    monkeypatch.setattr(callbacks, "seconds_to_draw", lambda *_: 3.5)
    films = []
    monkeypatch.setattr(pictures, "write_film", lambda file, field, codes, *_: films.append((len(codes), _[-1])))
    shown = {"logging.pictures": True, "logging.progress": True, "logging.frames": 60}
    cfg = make_config(**{**shown, "evaluation.first_seconds": 1e-9})
    found = train(cfg, tmp_path)
    counts = {kind: len(found[kind]["per_view"]) for kind in ("known", "novel", "novel_cells")}
    assert counts == {"known": 3, "novel": 4, "novel_cells": 4}
    assert found["measured_every"] == {"known": 3, "novel": 3, "novel_cells": 1, "novel_quarters": 1}
    names = list(scenes.load(cfg.scene).names)
    assert list(found["known"]["per_view"]) == [names[1], names[4], names[7]]
    assert films == [(4, 30 * 4 / 60)]
    clock = SimpleNamespace(seconds=0.0)
    errors = ErrorClock(cfg.evaluation, scenes.load(cfg.scene), clock, tmp_path)
    errors.one = 1.0
    assert [errors.film_frames(asked) for asked in (60, 8)] == [15, 8]
    assert len(rows(tmp_path)) == 1
    said = capsys.readouterr().out
    assert "(3 views, one of 3)" in said
    assert f"python -m viinter.evaluate run={tmp_path}" in said


def test_the_last_measurement_may_take_what_is_left_of_its_share(make_config, tmp_path, stopwatch, monkeypatch):
    """Ten seconds of training and a share of 104 / 10: all 21 views in 84 s and a strip in 20; none on the way, for
    half of it is less."""
    monkeypatch.setattr(callbacks, "seconds_to_draw", lambda *_: 4.0)
    share = {"evaluation.first_seconds": 0.25, "evaluation.max_share": 10.4}
    found = train(make_config(**{"optim.steps": 40, **share}), tmp_path)
    assert [int(row["step"]) for row in rows(tmp_path)] == [40]
    assert found["measured_every"]["novel"] == 1
    assert len(found["novel"]["per_view"]) == 12


def test_the_last_row_is_the_end_of_the_run_as_in_the_metrics(make_config, tmp_path):
    often = {"evaluation.first_seconds": 1e-6, "evaluation.factor": 1.0001, "evaluation.max_share": 1e9}
    found = train(make_config(**{**often, "codes.p": "2", "codes.radius": 3.0}), tmp_path)
    table = rows(tmp_path)
    assert [int(row["step"]) for row in table] == [1, 2, 3, 4, 5, 6]
    seconds = [float(row["training_seconds"]) for row in table]
    assert all(a < b for a, b in itertools.pairwise(seconds))
    last = table[-1]
    assert float(last["training_seconds"]) == found["training_seconds"]
    for kind in ("known", "novel"):
        for key in ("mse", "psnr", "ssim"):
            assert float(last[f"{kind}_{key}"]) == found[kind][key]
    assert float(last["code_norm_min"]) == pytest.approx(3, rel=1e-6)
    assert float(last["code_norm_max"]) == pytest.approx(3, rel=1e-6)
    assert float(last["lr"]) == pytest.approx(cosine(1e-3, 0.1, 5 / 6))  # of the step just taken


def test_rows_of_before_an_interruption_stay_in_the_table(make_config, tmp_path):
    often = {"evaluation.first_seconds": 1e-6, "evaluation.factor": 1.0001, "evaluation.max_share": 1e9}
    cfg = make_config(**{**often, "checkpoint.every_seconds": 1e-9})
    with pytest.raises(Crash):
        train(cfg, tmp_path, more_callbacks=[crash_at(3)])
    before = rows(tmp_path)
    train(cfg, tmp_path, resume=True)
    table = rows(tmp_path)
    assert len(before) == 3
    assert table[:3] == before
    assert [int(row["step"]) for row in table] == [1, 2, 3, 4, 5, 6]
    for key in ("training_seconds", "wall_seconds"):
        assert all(float(a[key]) < float(b[key]) for a, b in itertools.pairwise(table))


@pytest.mark.parametrize(
    ("stages", "first", "warned"),
    [
        ([0] * 8, "20.0 dB at step 2 and have 16.8 at step 4", ["24", "27"]),
        ([-1] * 3 + [0] * 5, "16.8 dB at step 4 and have 13.0 at step 5", ["45", "67"]),
    ],
)
def test_known_views_that_get_worse_by_half_are_warned_of_once(
    stages, first, warned, make_config, tmp_path, stopwatch, monkeypatch, caplog
):
    """In each stage of the field: what one has learned another may begin anew, as trials of motions do."""
    monkeypatch.setattr(PaperField, "stage", lambda self: stages[len(known) - 1])
    errors = iter([0.04, 0.01, 0.019, 0.021, 0.05, 0.015, 0.1, 0.1])
    known = []

    def measured(field, codes, scene, kinds, *_):
        if "known" in kinds:
            known.append(next(errors))
        error = metrics.ViewError(known[-1], metrics.psnr(known[-1]), None)
        return {kind: metrics.summary({"a view": error}) for kind in kinds}

    monkeypatch.setattr(callbacks, "measure", measured)
    often = {"evaluation.first_seconds": 0.25, "evaluation.factor": 1.0001, "evaluation.max_share": 1e9}
    train(make_config(**{**often, "optim.steps": 8, "optim.lr": 1e-3}), tmp_path)
    assert not list(errors)
    said = [r.message for r in caplog.records if r.name == "viinter"]
    assert [re.findall(r"at step (\d)", message) for message in said] == [list(steps) for steps in warned]
    assert said[0].startswith(f"the known views had {first}: what was learned")
    assert re.search(r"a lower optim.lr \(now [\d.e-]+\) may help$", said[0])


def test_a_clock_that_goes_on_knows_where_the_stage_began(make_config, tmp_path):
    """And one from before stages were told apart has one."""
    cfg = make_config()
    was, now, before = (ErrorClock(cfg.evaluation, scenes.load(cfg.scene), Clock(), tmp_path) for _ in range(3))
    was.rows, was.stage, was.since = [{"step": 1}, {"step": 2}], 0, 1
    now.load_state_dict(was.state_dict())
    assert (now.rows, now.stage, now.since) == (was.rows, 0, 1)
    before.load_state_dict({key: value for key, value in was.state_dict().items() if key not in ("stage", "since")})
    assert (before.rows, before.stage, before.since) == (was.rows, None, 0)


def test_a_scene_without_probes_has_empty_novel_columns(make_config, tmp_path):
    found = train(make_config("pair"), tmp_path)
    assert found["novel"] == {"psnr": None, "ssim": None, "mse": None, "per_view": {}}
    assert rows(tmp_path)[-1]["novel_psnr"] == ""
    assert "the scene has no probes" in {part["reason"] for part in found["omitted"]}


def test_a_checkpoint_is_written_every_so_many_wall_seconds(make_config, tmp_path, stopwatch, monkeypatch):
    saved, save = [], SaveCheckpoint.save
    monkeypatch.setattr(
        SaveCheckpoint, "save", lambda self, trainer: saved.append(trainer.global_step) or save(self, trainer)
    )
    train(make_config(**{"optim.steps": 10, "checkpoint.every_seconds": 1.0}), tmp_path)
    assert saved == [4, 8, 10]
