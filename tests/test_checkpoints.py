"""Checkpoints that are whole, the older one beside them, and signals that ask a run to stop."""

import os
import shutil
import signal

import lightning as L
import pytest
import torch
from conftest import Crash, CrashAt, checkpoint_of, draw_folder, same, settings, trained, without_times

from viinter import checkpoints, image
from viinter.checkpoints import SIGNALS
from viinter.config import ConfigError, UserError
from viinter.module import load
from viinter.train import train

OFTEN = {"checkpoint.every_seconds": 1e-9}


class At(L.Callback):
    """Calls `function` at the end of so many steps, before the callbacks that see the step's end later."""

    def __init__(self, step, function):
        self.step, self.function = step, function

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.step:
            self.function()


@pytest.fixture(scope="module")
def crashed_once(tmp_path_factory, drawn):
    run_dir, cfg = tmp_path_factory.mktemp("crashed") / "run", settings("planar", drawn("planar"), {**OFTEN})
    with pytest.raises(Crash):
        train(cfg, run_dir, more_callbacks=[CrashAt(4)])
    return cfg, run_dir


@pytest.fixture
def crashed(crashed_once, tmp_path):
    """The settings and the folder of a run that ended at step 4, with the checkpoints of steps 3 and 4."""
    return crashed_once[0], shutil.copytree(crashed_once[1], tmp_path / "run")


# Files


def test_the_last_two_checkpoints_are_kept(crashed):
    folder = crashed[1] / "checkpoints"
    assert sorted(file.name for file in folder.iterdir()) == ["last.ckpt", "previous.ckpt"]
    steps = [torch.load(folder / name, weights_only=True)["global_step"] for name in ("previous.ckpt", "last.ckpt")]
    assert steps == [3, 4]


@pytest.mark.parametrize("failing", ["save_checkpoint", "replace", "fsync"])
def test_a_checkpoint_that_cannot_be_written_leaves_the_last_one_and_says_how_to_go_on(
    make_config, tmp_path, monkeypatch, failing
):
    def full(*_):
        raise OSError(28, "No space left on device")

    def fail():
        owner = L.Trainer if failing == "save_checkpoint" else os
        monkeypatch.setattr(owner, failing, full)

    cfg = make_config(**OFTEN)
    said = r"last\.ckpt: .*No space left on device; .* go on with: python -m viinter\.train resume="
    with pytest.raises(UserError, match=said):
        train(cfg, tmp_path, more_callbacks=[At(3, fail)])
    assert checkpoint_of(tmp_path)["global_step"] == 3
    assert sorted(file.name for file in (tmp_path / "checkpoints").iterdir()) == ["last.ckpt", "previous.ckpt"]
    monkeypatch.undo()
    train(cfg, tmp_path, resume=True)
    assert checkpoint_of(tmp_path)["global_step"] == 6


def test_between_the_two_renamings_there_is_still_a_checkpoint(crashed, make_config):
    cfg, run_dir = crashed
    (run_dir / "checkpoints" / "last.ckpt").rename(run_dir / "checkpoints" / "previous.ckpt")
    assert load(run_dir).codes.weight.isfinite().all()
    straight = train(cfg, run_dir.parent / "straight")
    assert without_times(train(cfg, run_dir, resume=True)) == without_times(straight)


def test_a_run_killed_before_its_first_checkpoint_starts_again_in_its_folder(make_config, tmp_path):
    with pytest.raises(Crash):
        train(make_config(), tmp_path / "run", more_callbacks=[CrashAt(4)])
    assert not (tmp_path / "run" / "checkpoints").exists()
    again = train(make_config(), tmp_path / "run", resume=True)
    assert without_times(again) == without_times(train(make_config(), tmp_path / "straight"))


def test_a_folder_that_holds_a_run_is_not_written_over(crashed):
    cfg, run_dir = crashed
    with pytest.raises(ConfigError, match=rf"{run_dir} holds a run already.*resume={run_dir}"):
        train(cfg, run_dir)
    assert checkpoint_of(run_dir)["global_step"] == 4


# Checkpoints that cannot be used


class Dangerous:
    def __reduce__(self):
        return os.system, ("touch executed",)


DAMAGE = {
    "empty": lambda file, whole: file.write_bytes(b""),
    "cut": lambda file, whole: file.write_bytes(whole[: len(whole) // 2]),
    "one byte short": lambda file, whole: file.write_bytes(whole[:-1]),
    "text": lambda file, whole: file.write_text("hello world\n" * 100),
    "another program's": lambda file, whole: torch.save({"weights": torch.zeros(3)}, file),
    "a tensor": lambda file, whole: torch.save(torch.zeros(3), file),
    "code": lambda file, whole: torch.save({"config": Dangerous()}, file),
}


@pytest.mark.parametrize(
    ("damage", "older"), [*((damage, "whole") for damage in DAMAGE), ("cut", "none"), ("cut", "damaged")]
)
def test_a_checkpoint_that_cannot_be_used_is_named_and_the_older_one_offered(
    crashed, tmp_path, monkeypatch, damage, older
):
    monkeypatch.chdir(tmp_path)
    cfg, run_dir = crashed
    last, previous = (run_dir / "checkpoints" / name for name in ("last.ckpt", "previous.ckpt"))
    DAMAGE[damage](last, last.read_bytes())
    if older == "damaged":
        DAMAGE[damage](previous, previous.read_bytes())
    if older == "none":
        previous.unlink()
    offered = {
        "whole": rf"The one before it, of step 3, is whole\. To take it: mv {previous} {last}",
        "none": r"There is no older one", "damaged": rf"Neither is {previous}",
    }[older]  # fmt: skip
    before = last.read_bytes()
    for use in (lambda: load(run_dir), lambda: train(cfg, run_dir, resume=True)):
        with pytest.raises(ConfigError, match=rf"last\.ckpt is not a whole checkpoint.*: .+\. {offered}"):
            use()
    assert last.read_bytes() == before
    assert not (tmp_path / "executed").exists()
    if older == "whole":
        shutil.move(previous, last)
        train(cfg, run_dir, resume=True)
        assert checkpoint_of(run_dir)["global_step"] == 6


def test_a_checkpoint_without_a_folder_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"no run folder with a checkpoint: there is no .*last\.ckpt"):
        load(tmp_path)


def test_a_checkpoint_of_another_scene_or_model_is_refused(crashed, make_config, tmp_path):
    _, run_dir = crashed
    with pytest.raises(ConfigError, match=r"model\.width=20: expected 16, with which .*last\.ckpt was trained"):
        train(make_config(**{"model.width": 20}), run_dir, resume=True)
    with pytest.raises(ConfigError, match=r"model\.name=fast: expected paper"):
        train(make_config(model="fast"), run_dir, resume=True)
    image.write(draw_folder(tmp_path / "scene", 3) / "4.png", torch.rand(32, 32, 3))
    with pytest.raises(ConfigError, match=r"scene does not hold the known views that .*last\.ckpt was trained on"):
        train(make_config("folder", tmp_path / "scene"), run_dir, resume=True)


# Signals


def straight_and(run_dir, cfg):
    return without_times(train(cfg, run_dir.parent / "straight")), trained(run_dir.parent / "straight")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGUSR2])
def test_a_signal_saves_at_the_end_of_the_step_and_the_run_goes_on_as_if_nothing_had_been(
    make_config, tmp_path, number
):
    cfg, before = make_config(), {each: signal.getsignal(each) for each in SIGNALS}

    class Inside(L.Callback):
        """In the middle of the step: the weights have moved, the codes are not yet projected."""

        def on_before_zero_grad(self, trainer, *_):
            if trainer.global_step == 3:
                os.kill(os.getpid(), number)

    with pytest.raises(KeyboardInterrupt, match=r"interrupted at step 4; go on with: .* resume=.*run$"):
        train(cfg, tmp_path / "run", more_callbacks=[Inside()])
    assert checkpoint_of(tmp_path / "run")["global_step"] == 4
    assert {each: signal.getsignal(each) for each in SIGNALS} == before
    metrics, left = straight_and(tmp_path / "run", cfg)
    assert without_times(train(cfg, tmp_path / "run", resume=True)) == metrics
    assert same(trained(tmp_path / "run"), left)


@pytest.mark.parametrize("kind", ["during training", "at the end"])
def test_a_signal_is_obeyed_while_views_are_measured(make_config, tmp_path, monkeypatch, kind):
    values = {"evaluation.first_seconds": 1e-9, "evaluation.max_share": 1e9} if kind == "during training" else {}
    cfg, compare, seen = make_config(**values), checkpoints.ErrorClock._seen, []

    def stopped(self, *args):
        seen.append(args)
        if len(seen) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        compare(self, *args)

    monkeypatch.setattr(checkpoints.ErrorClock, "_seen", stopped)
    step = 1 if kind == "during training" else 6
    with pytest.raises(KeyboardInterrupt, match=f"interrupted at step {step};"):
        train(cfg, tmp_path / "run")
    assert len(seen) == 2
    monkeypatch.undo()
    metrics, left = straight_and(tmp_path / "run", cfg)
    assert without_times(train(cfg, tmp_path / "run", resume=True)) == metrics
    assert same(trained(tmp_path / "run"), left)


def test_the_handler_of_a_cluster_is_called_after_the_checkpoint(make_config, tmp_path, monkeypatch):
    """submitit lets SIGTERM pass, and at its own signal puts the job back into the queue and ends the process."""
    called = []

    def requeue(number, frame):
        called.append((number, checkpoint_of(tmp_path)["global_step"]))
        raise SystemExit(-1)

    def note(number, frame):
        called.append((number, checkpoint_of(tmp_path)["global_step"]))

    before = [signal.signal(signal.SIGTERM, note), signal.signal(signal.SIGUSR2, requeue)]
    try:
        with pytest.raises(SystemExit) as ended:
            train(make_config(), tmp_path, more_callbacks=[
                At(2, lambda: os.kill(os.getpid(), signal.SIGTERM)), At(4, lambda: os.kill(os.getpid(), signal.SIGUSR2))
            ])  # fmt: skip
    finally:
        signal.signal(signal.SIGTERM, before[0])
        signal.signal(signal.SIGUSR2, before[1])
    assert ended.value.code == -1
    assert called == [(signal.SIGTERM, 3), (signal.SIGUSR2, 5)]


def test_on_a_cluster_lightning_leaves_requeueing_to_the_launcher(make_config, tmp_path, monkeypatch):
    for key, value in {"NTASKS": 1, "JOB_ID": 7, "JOB_NAME": "train", "PROCID": 0, "LOCALID": 0, "NODEID": 0}.items():
        monkeypatch.setenv(f"SLURM_{key}", str(value))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(KeyboardInterrupt, match="interrupted at step 3"):
        train(make_config(), tmp_path / "run", more_callbacks=[At(2, lambda: os.kill(os.getpid(), signal.SIGUSR1))])
    assert checkpoint_of(tmp_path / "run")["global_step"] == 3
    assert [file.name for file in tmp_path.iterdir()] == ["run"]
